"""The page of ``rsbench correct``: every frame before and after, from what was stored."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from numpy.typing import NDArray

from rsbench.dataset.corrected_frames import MARKER
from rsbench.report import pictures
from rsbench.report.pictures import Image
from rsbench.storage.files import read_json, write_bytes
from rsbench.vision.fusion import Fused, Origin

_COLOURS = {
    Origin.NOBODY: (200, 40, 40),
    Origin.INVENTED: (240, 150, 150),
    Origin.OTHER_FRAME: (240, 170, 60),
    Origin.OTHER_CAMERA: (80, 150, 240),
    Origin.GUESSED: (170, 120, 200),
    Origin.HERE: (225, 228, 230),
}
_LEGEND = {
    Origin.HERE: "seen in this frame",
    Origin.GUESSED: "seen in this frame, depth guessed from neighbours",
    Origin.OTHER_CAMERA: "from the other camera",
    Origin.OTHER_FRAME: "from the other frame",
    Origin.INVENTED: "seen by nobody, closed from around",
    Origin.NOBODY: "seen by nobody",
}
_LONGEST = 900


def card_of(title: str, before: NDArray[Any], fused: Fused, unit: str = " m") -> dict[str, Any]:
    """One frame of the page: its pictures as URIs, small enough to carry many; ``unit`` of depth."""
    finite = np.isfinite(fused.depth) & (fused.depth > 0)
    inverse = np.where(finite, 1.0 / np.where(finite, fused.depth, 1.0), np.nan)
    low, high = np.nanpercentile(inverse, [1, 99]) if np.any(finite) else (0.0, 1.0)
    origin_picture = np.zeros((*fused.origin.shape, 3), dtype=np.uint8)
    for origin, colour in _COLOURS.items():
        origin_picture[fused.origin == origin] = colour
    shares = fused.shares()
    return {
        "title": title,
        "before": _uri(_eight_bit(before)),
        "after": _uri(_eight_bit(fused.image)),
        "origin": _uri(origin_picture),
        "depth": _uri(pictures.colour_map(inverse, low, high)),
        "near": f"{1.0 / high:.3g}{unit}",
        "far": f"{1.0 / low:.3g}{unit}" if low > 0 else "infinity",
        "shares": [
            {
                "colour": "#{:02x}{:02x}{:02x}".format(*_COLOURS[origin]),
                "text": text,
                "percent": f"{100 * shares[origin.name.lower()]:.2f}",
            }
            for origin, text in _LEGEND.items()
        ],
    }


def write_page(
    folder: Path,
    title: str,
    subtitle: str,
    facts: list[tuple[str, str]],
    cards: list[Any],
    trajectory: dict[str, Any] | None = None,
) -> None:
    """report.html: opens from disk, needs no other file; ``trajectory`` is of ``draw_trajectory``."""
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
    )
    record = read_json(folder / MARKER)
    page = environment.get_template("correct.html.j2").render(
        title=title,
        subtitle=subtitle,
        facts=facts,
        cards=cards,
        trajectory=trajectory,
        record=json.dumps(record, indent=1)[:20000],
    )
    write_bytes(folder / "report.html", page.encode())


def _eight_bit(image: NDArray[Any]) -> Image:
    """RGB uint8; 16-bit images are stretched to their brightest pixels, which may use few of the 16 bits."""
    if image.dtype != np.uint8:
        top = max(float(np.percentile(image, 99.9)), 1.0)
        image = np.clip(image * (255.0 / top), 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image, dtype=np.uint8)


def _uri(image: Image) -> str:
    data = pictures.encode_jpeg(pictures.shrink(image, _LONGEST))
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
