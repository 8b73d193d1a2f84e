"""The paper's Figure 4 from stored panels: one row per scene, six panels each, numbers under them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.benchmark.studies.fig4_panels import LITERAL, Panels
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
ERROR_M = (0.001, 2.0)
"""Ends of the logarithmic scale of depth errors, metres: less than is usual indoors, and the paper's limit."""
INVENTED = (0, 190, 255)
"""Colour of depth where there is no surface; none of the scale's."""
_COLOURS = 256
_PIXELS = {"pdf": 210, "jpg": 250}
_JPEG = {"subsampling": 0, "optimize": True}
_WIDTH_IN, _TEXT_IN, _HEAD_IN, _BAR_IN, _GAP_IN = 7.2, 0.56, 0.2, 0.2, 0.03


def draw_fig4(rows: list[tuple[str, Panels]], stem: Path, quality: int = 84) -> list[Path]:
    """Draw named rows into ``stem``.pdf and ``stem``.jpg; returns the files. Equal panels give equal bytes.

    Args:
        rows: drawn one below the other.
        stem: of the files' names.
        quality: of the JPEG, 1 to 95.
    """
    from matplotlib import rc_context

    paths = []
    with rc_context({"font.size": 7, "font.family": "DejaVu Sans", "pdf.fonttype": 42, "svg.hashsalt": "rsbench"}):
        for kind, pixels in _PIXELS.items():
            path = stem.with_suffix(f".{kind}")
            _draw(rows, path, pixels, quality)
            paths.append(path)
    return paths


def _draw(rows: list[tuple[str, Panels]], path: Path, pixels: int, quality: int) -> None:
    from matplotlib.figure import Figure

    side = (_WIDTH_IN - 5 * _GAP_IN) / len(TITLES)
    row = side + _BAR_IN + _TEXT_IN
    height = _HEAD_IN + len(rows) * row
    figure = Figure(figsize=(_WIDTH_IN, height), facecolor="white")
    for r, (name, panels) in enumerate(rows):
        bottom = height - _HEAD_IN - r * row - side
        for c, (title, image) in enumerate(zip(TITLES, panel_images(panels), strict=True)):
            left = c * (side + _GAP_IN)
            axes = figure.add_axes((left / _WIDTH_IN, bottom / height, side / _WIDTH_IN, side / height))
            small = pictures.shrink(image, pixels)
            axes.imshow(few_colours(small) if path.suffix == ".pdf" else small, interpolation="none")
            axes.set_axis_off()
            if r == 0:
                axes.set_title(title, fontsize=7, pad=3)
        for c, scale in ((2, depth_scale(panels)), (5, _error_scale())):
            left = c * (side + _GAP_IN) + 0.08 * side
            _draw_scale(figure, (left, bottom - 0.06, 0.84 * side, 0.04), scale)
        for line, text in enumerate(caption(name, panels.numbers)):
            y = (bottom - _BAR_IN - 0.04 - 0.115 * line) / height
            figure.text(0.0, y, text, fontsize=6, va="top", color="0.15" if line else "0.0")
    if path.suffix == ".pdf":
        figure.savefig(path, metadata={"CreationDate": None})
    else:
        figure.savefig(path, dpi=pixels / side, pil_kwargs={**_JPEG, "quality": quality})


@dataclass(frozen=True, kw_only=True)
class Scale:
    """A colour scale: its ends in what is drawn, and the ticks there."""

    low: float
    high: float
    ticks: dict[str, float]
    colours: str


def depth_scale(panels: Panels) -> Scale:
    """Of inverse depth, 1/m, over all but the nearest and farthest hundredth of the surfaces; ticks in metres."""
    low, high = np.nanpercentile(1.0 / panels.true_depth, [1, 99])
    even = (low + np.linspace(0.0, 1.0, 4) * (high - low)).tolist()
    texts = [f"{1.0 / value:.2g} m" if k == 0 else f"{1.0 / value:.2g}" for k, value in enumerate(even)]
    return Scale(low=float(low), high=float(high), ticks=dict(zip(texts, even, strict=True)), colours="viridis")


def _error_scale() -> Scale:
    """Of the decimal logarithm of the depth error, metres."""
    low, high = (math.log10(end) for end in ERROR_M)
    ticks = {"1 mm": -3.0, "1 cm": -2.0, "10 cm": -1.0, "1 m": 0.0}
    return Scale(low=low, high=high, ticks=ticks, colours="inferno")


def _draw_scale(figure: Any, place_in: tuple[float, float, float, float], scale: Scale) -> None:
    """A bar with ticks below; left, bottom, width and height in inches."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = figure.get_size_inches()
    left, bottom, wide, high = place_in
    axes = figure.add_axes((left / width, bottom / height, wide / width, high / height))
    colours = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
    bar = figure.colorbar(colours, cax=axes, orientation="horizontal")
    bar.set_ticks(list(scale.ticks.values()), labels=list(scale.ticks))
    bar.outline.set_linewidth(0.3)
    bar.ax.tick_params(labelsize=5, length=1.5, width=0.3, pad=1)
    bar.minorticks_off()


def panel_images(panels: Panels) -> list[Image]:
    """The six panels as RGB images."""
    depth, error = depth_scale(panels), _error_scale()
    # No error at all is below the scale, as its smallest value is.
    size = np.log10(np.maximum(panels.depth_error, ERROR_M[0]))
    errors = pictures.colour_map(size, error.low, error.high, error.colours)
    errors[np.isinf(panels.depth_error)] = INVENTED
    return [
        panels.rolling,
        pictures.masked(panels.corrected, panels.known),
        pictures.colour_map(1.0 / panels.true_depth, depth.low, depth.high, depth.colours),
        pictures.overlay(panels.rolling, panels.truth),
        pictures.overlay(panels.corrected, panels.truth, panels.known),
        errors,
    ]


def caption(name: str, n: dict[str, Any]) -> tuple[str, ...]:
    """The lines under a row."""
    filled = n["share_other_camera"] + n["share_other_frame"]
    literal = ", ".join(n[option] for option in LITERAL if option in n)
    holes, by = ("black", f" ({literal})") if literal else ("inpainted", "")
    return (
        f"{name}: {n['rotation_deg']:.2g} deg and {n['translation']:.2g} m per frame, readout ratio "
        f"{n['readout_ratio']:g}; seed {n['seed']}, RANSAC seed {n['ransac_seed']}. Error of the motion: "
        f"{_small(n['e_R_deg'])} deg (rotation), {_small(n['e_T_deg'])} deg (direction).",
        f"PSNR of the frame's own pixels: {n['psnr_rolling']:.1f} dB before, {n['psnr_corrected']:.1f} dB after, "
        f"{n['psnr_oracle']:.1f} dB with true depth and motion; of all pixels, {holes} where nobody saw: "
        f"{n['psnr_rolling_all']:.1f} and {n['psnr_corrected_all']:.1f} dB.",
        f"SGM depth: median error {100 * n['depth_median_m']:.1f} cm, {_percent(n['depth_over_2m'])} above 2 m, "
        f"{_percent(n['depth_coverage'])} known, the rest grey{_sky(n['depth_on_sky'])}.",
        f"Corrected frame{by}: {_percent(n['share_here'])} its own pixels, {_percent(n['share_guessed'])} at a "
        f"guessed depth, {_percent(filled)} from the other frames, {_percent(n['share_nobody'])} seen by nobody "
        "(dark).",
    )


def _sky(share: float | None) -> str:
    return "" if share is None else f"; {_percent(share)} of the sky has a depth (blue)"


def _small(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def few_colours(image: Image) -> Image:
    """The image in 256 colours: a third of the bytes in a file, and no difference at the size of a panel."""
    from PIL import Image as Pillow

    reduced = Pillow.fromarray(image).quantize(_COLOURS, method=Pillow.Quantize.MEDIANCUT)
    return np.asarray(reduced.convert("RGB"), dtype=np.uint8)
