"""What ``rsbench correct`` writes: corrected frames, masks, depth, the motion, and a page to look at."""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from numpy.typing import NDArray

from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.files import write_bytes, write_depth, write_json, write_png
from rsbench.errors import RsbenchError
from rsbench.pipeline.motion import RobustEstimate
from rsbench.pipeline.readout import ReadoutEstimate
from rsbench.report import pictures
from rsbench.report.pictures import Image
from rsbench.vision.fusion import Fused, Origin

MASK_VALUES = {
    Origin.NOBODY: 0,
    Origin.OTHER_FRAME: 64,
    Origin.OTHER_CAMERA: 128,
    Origin.GUESSED: 192,
    Origin.HERE: 255,
}
"""Grey value of each origin in the mask files: the larger, the better founded."""
_COLOURS = {
    Origin.NOBODY: (200, 40, 40),
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
    Origin.NOBODY: "seen by nobody",
}
_LONGEST = 900
MARKER = "motion.json"


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside ``out`` that takes its name when all is written; nothing is left after an error.

    Raises:
        RsbenchError: ``out`` cannot be written, or holds something that ``rsbench correct`` did not write.
    """
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / MARKER).is_file())):
        raise RsbenchError(f"{out}: exists and was not written by 'rsbench correct'; choose another --out")
    partial = out.with_name(f".{out.name}.partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True)
    except OSError as error:
        raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another --out") from error
    try:
        yield partial
        if out.exists():
            shutil.rmtree(out)
        os.replace(partial, out)
    finally:
        if partial.exists():
            shutil.rmtree(partial)


def write_frame(folder: Path, name: str, fused: Fused) -> None:
    """corrected/NAME.png, mask/NAME.png and depth/NAME.exr below ``folder``."""
    for part in ("corrected", "mask", "depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    write_png(folder / "corrected" / f"{name}.png", fused.image)
    values = np.zeros(len(Origin), dtype=np.uint8)
    values[list(MASK_VALUES)] = list(MASK_VALUES.values())
    write_png(folder / "mask" / f"{name}.png", values[fused.origin])
    depth = np.where(np.isfinite(fused.depth), fused.depth, np.float32(0.0))
    write_depth(folder / "depth" / f"{name}.exr", depth)


def motion_record(robust: RobustEstimate, model: str) -> dict[str, Any]:
    """The motion of one window, ready for JSON."""
    estimate = robust.estimate
    covariance = None if estimate.covariance is None else estimate.covariance.tolist()
    return {
        "model": model,
        "w": estimate.w.tolist(),
        "d": estimate.d.tolist(),
        "rotation_deg": float(np.rad2deg(np.linalg.norm(estimate.w))),
        "translation": float(np.linalg.norm(estimate.d)),
        "metric": estimate.metric,
        "note": estimate.reason,
        "noise_px": estimate.noise_px,
        "covariance_w_d": covariance,
        "inliers": {str(name): int(np.count_nonzero(mask)) for name, mask in robust.inliers.items()},
    }


def rig_record(
    rig: StereoRig, shutter_: RollingShutter, readout: ReadoutEstimate | None, target_row: float
) -> dict[str, Any]:
    """What the correction assumed, ready for JSON."""
    camera = rig.camera
    return {
        "units": {"length": "m", "angle": "rad", "time": "frame period", "depth": "m, 0 = infinite or unknown"},
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "baseline": rig.baseline,
        "readout_ratio": shutter_.readout_ratio,
        "readout_ratio_sigma": readout.sigma if readout is not None and np.isfinite(readout.sigma) else None,
        "readout_ratio_estimated": readout is not None,
        "target_row": target_row,
        "mask_values": {origin.name.lower(): value for origin, value in MASK_VALUES.items()},
    }


def write_record(folder: Path, record: dict[str, Any]) -> None:
    write_json(folder / MARKER, record)


def card_of(title: str, before: NDArray[Any], fused: Fused) -> dict[str, Any]:
    """One frame of the page: its pictures as URIs, small enough to carry many."""
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
        "near": f"{1.0 / high:.3g}",
        "far": f"{1.0 / low:.3g}" if low > 0 else "infinity",
        "shares": [
            {
                "colour": "#{:02x}{:02x}{:02x}".format(*_COLOURS[origin]),
                "text": text,
                "percent": f"{100 * shares[origin.name.lower()]:.2f}",
            }
            for origin, text in _LEGEND.items()
        ],
    }


def write_page(folder: Path, title: str, subtitle: str, facts: list[tuple[str, str]], cards: list[Any]) -> None:
    """report.html: opens from disk, needs no other file."""
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
    )
    record = json.loads((folder / MARKER).read_text("utf-8"))
    page = environment.get_template("correct.html.j2").render(
        title=title, subtitle=subtitle, facts=facts, cards=cards, record=json.dumps(record, indent=1)[:20000]
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
