"""The paper's Figure 4 from stored panels: one row per scene, six panels each, numbers under them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.benchmark.studies.fig4_panels import Panels
from rsbench.report import pictures
from rsbench.report.pictures import Image

TITLES = (
    "(a) rolling shutter (RS)",
    "(b) corrected",
    "(c) true depth",
    "(d) RS over GS",
    "(e) corrected over GS",
    "(f) depth error",
)
DEPTH_ERROR_M = 2.0
"""End of the scale of depth errors, as in the paper."""
_COLOURS = 256
_PIXELS = {"pdf": 210, "jpg": 250}
_JPEG = {"quality": 84, "subsampling": 0, "optimize": True}
_WIDTH_IN, _TEXT_IN, _HEAD_IN, _BAR_IN, _GAP_IN = 7.2, 0.43, 0.2, 0.42, 0.03


def draw_fig4(rows: list[tuple[str, Panels]], stem: Path) -> list[Path]:
    """Draw named rows into ``stem``.pdf and ``stem``.jpg; returns the files. Equal panels give equal bytes."""
    from matplotlib import rc_context

    paths = []
    with rc_context({"font.size": 7, "font.family": "DejaVu Sans", "pdf.fonttype": 42, "svg.hashsalt": "rsbench"}):
        for kind, pixels in _PIXELS.items():
            path = stem.with_suffix(f".{kind}")
            _draw(rows, path, pixels)
            paths.append(path)
    return paths


def _draw(rows: list[tuple[str, Panels]], path: Path, pixels: int) -> None:
    from matplotlib.figure import Figure

    side = (_WIDTH_IN - _BAR_IN - 5 * _GAP_IN) / len(TITLES)
    height = _HEAD_IN + len(rows) * (side + _TEXT_IN)
    figure = Figure(figsize=(_WIDTH_IN, height), facecolor="white")
    for r, (name, panels) in enumerate(rows):
        bottom = height - _HEAD_IN - r * (side + _TEXT_IN) - side
        for c, (title, image) in enumerate(zip(TITLES, panel_images(panels), strict=True)):
            left = c * (side + _GAP_IN)
            axes = figure.add_axes((left / _WIDTH_IN, bottom / height, side / _WIDTH_IN, side / height))
            small = pictures.shrink(image, pixels)
            axes.imshow(few_colours(small) if path.suffix == ".pdf" else small, interpolation="none")
            axes.set_axis_off()
            if r == 0:
                axes.set_title(title, fontsize=7, pad=3)
        for line, text in enumerate(caption(name, panels.numbers)):
            y = (bottom - 0.04 - 0.115 * line) / height
            figure.text(0.0, y, text, fontsize=6, va="top", color="0.15" if line else "0.0")
    _colour_bar(figure, (height - _HEAD_IN - side) / height, side / height)
    if path.suffix == ".pdf":
        figure.savefig(path, metadata={"CreationDate": None})
    else:
        figure.savefig(path, dpi=pixels / side, pil_kwargs=_JPEG)


def _colour_bar(figure: Any, bottom: float, height: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.add_axes((1.0 - (_BAR_IN - 0.06) / _WIDTH_IN, bottom + 0.05 * height, 0.012, 0.9 * height))
    bar = figure.colorbar(ScalarMappable(Normalize(0.0, DEPTH_ERROR_M), "inferno"), cax=axes)
    bar.set_ticks([0.0, 1.0, DEPTH_ERROR_M], labels=["0", "1", f"{DEPTH_ERROR_M:g} m"])
    bar.ax.tick_params(labelsize=6, length=2, pad=1)


def panel_images(panels: Panels) -> list[Image]:
    """The six panels as RGB images."""
    inverse = 1.0 / panels.true_depth
    low, high = np.nanpercentile(inverse, [1, 99])
    return [
        panels.rolling,
        pictures.masked(panels.corrected, panels.known),
        pictures.colour_map(inverse, low, high),
        pictures.overlay(panels.rolling, panels.truth),
        pictures.overlay(panels.corrected, panels.truth, panels.known),
        pictures.colour_map(panels.depth_error, 0.0, DEPTH_ERROR_M, "inferno"),
    ]


def caption(name: str, n: dict[str, Any]) -> tuple[str, ...]:
    """The lines under a row."""
    filled = n["share_other_camera"] + n["share_other_frame"]
    return (
        f"{name}: {n['rotation_deg']:.2g} deg and {n['translation']:.2g} m per frame, readout ratio "
        f"{n['readout_ratio']:g}. Error of the motion: {_small(n['e_R_deg'])} deg (rotation), "
        f"{_small(n['e_T_deg'])} deg (direction).",
        f"PSNR of what the frame saw: {n['psnr_rolling']:.1f} dB before, {n['psnr_corrected']:.1f} dB after, "
        f"{n['psnr_oracle']:.1f} dB with true depth and motion. Depth: median error "
        f"{100 * n['depth_median_m']:.1f} cm, {_percent(n['depth_over_2m'])} above 2 m, "
        f"{_percent(n['depth_coverage'])} known.",
        f"Corrected frame: {_percent(n['share_here'])} its own pixels, {_percent(n['share_guessed'])} at a "
        f"guessed depth, {_percent(filled)} from the other frames, {_percent(n['share_nobody'])} seen by nobody "
        "(dark).",
    )


def _small(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def few_colours(image: Image) -> Image:
    """The image in 256 colours: a third of the bytes in a file, and no difference at the size of a panel."""
    from PIL import Image as Pillow

    reduced = Pillow.fromarray(image).quantize(_COLOURS, method=Pillow.Quantize.MEDIANCUT)
    return np.asarray(reduced.convert("RGB"), dtype=np.uint8)
