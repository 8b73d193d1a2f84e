"""The paper's Figures 3 and 4, from stored summaries and panels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from rsbench.benchmark.simulated.sweep_card import Setting, SweepCard
from rsbench.benchmark.studies.claims import OURS, READINGS, Centre
from rsbench.benchmark.studies.fig4_panels import LITERAL, Panels
from rsbench.core.errors import RsbenchError
from rsbench.report import pictures
from rsbench.report.markup import frame_text
from rsbench.report.pictures import Image
from rsbench.storage.files import read_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SWEEPS = ("noise", "baseline", "translation", "rotation", "readout")
CENTRES: tuple[Centre, ...] = ("median", "mean")
_ENDINGS = {"1e-3 px": "px", "0.81 px": "normalised"}
_X_LABELS = {
    "noise": "noise (px)",
    "baseline": "baseline (m)",
    "translation": "translation per frame (m)",
    "rotation": "rotation per frame (deg)",
    "readout": "readout time ratio",
}
_Y_LABELS = {"e_R": r"$e_R$ (deg)", "e_T": r"$e_T$ (deg)"}
_LOG_X = ("noise", "translation", "rotation")
# Okabe and Ito's colours are distinct for any colour vision; lines and markers also differ, for print in grey.
_STYLES: dict[str, dict[str, Any]] = {
    "rs-stereo-linear": {"color": "#D55E00", "linestyle": "-", "marker": "o"},
    "rs-stereo-linear-symmetric": {"color": "#CC79A7", "linestyle": "-.", "marker": "s"},
    "gs-8pt": {"color": "#000000", "linestyle": "--", "marker": "^"},
    "rs-stereo-iterated": {"color": "#E69F00", "linestyle": "-.", "marker": "P"},
    "rs-stereo-refined-pairs": {"color": "#0072B2", "linestyle": "-", "marker": "D"},
}
_BOUND: dict[str, Any] = {"color": "0.45", "linestyle": ":", "zorder": 3}
_OTHER = {"color": "#009E73", "linestyle": ":", "marker": "x"}
_LABELS = {
    "rs-stereo-linear": "paper's solver, literal",
    "rs-stereo-linear-symmetric": "paper's solver, symmetric part",
    "gs-8pt": "global shutter, 8 points",
    "rs-stereo-iterated": "linear, iterated *",
    "rs-stereo-refined-pairs": "maximum likelihood *",
}
COLUMN_MM = 88.0
"""Width of a printed column, mm."""
_INCH_MM = 25.4
_COLUMN_IN, _WIDE_IN = (COLUMN_MM / _INCH_MM, 6.3), (13.2, 6.0)
_COLUMN: dict[str, Any] = {
    "font.size": 6.5,
    "lines.linewidth": 0.9,
    "lines.markersize": 2.5,
    "axes.linewidth": 0.5,
}
_COLUMN |= {"xtick.major.width": 0.5, "ytick.major.width": 0.5, "xtick.major.pad": 2.0, "ytick.major.pad": 1.5}
_COLUMN |= {"axes.titlesize": 7, "axes.labelpad": 1.5}
_TICK_DECADES = 2


def read_summaries(folder: Path, sweeps: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """Read the stored summaries ``<sweep>.csv``, by the name of the sweep.

    Raises:
        RsbenchError: a file is missing or damaged.
    """
    tables = {}
    for name in sweeps:
        path = folder / f"{name}.csv"
        if not path.is_file():
            raise RsbenchError(f"{path}: no such summary; run: rsbench reproduce fig3")
        tables[name] = read_table(path)
    return tables


def draw_fig3(folder: Path) -> list[Path]:
    """Draw Figure 3 for both readings of the noise and both statistics into ``folder``; returns the files.

    Equal summaries give equal files.
    """
    tables = read_summaries(folder, SWEEPS)
    paths: list[Path] = []
    for variant in READINGS:
        for centre in CENTRES:
            paths += _draw_fig3(tables, variant, centre, folder / f"fig3-{_ENDINGS[variant]}-{centre}")
    return paths


def _draw_fig3(tables: dict[str, pd.DataFrame], variant: str, centre: Centre, stem: Path) -> list[Path]:
    """Draw the figure as PDF for a printed column, and as PNG for a screen."""
    paths = [stem.with_suffix(ending) for ending in (".pdf", ".png")]
    with _style(_COLUMN):
        metadata: dict[str, Any] = {"CreationDate": None, "Producer": None, "Creator": None}
        fig3(tables, variant, centre, upright=True).savefig(paths[0], metadata=metadata)
    with _style():
        fig3(tables, variant, centre, upright=False).savefig(paths[1], dpi=130, metadata={"Software": None})
    return paths


def fig3(tables: dict[str, pd.DataFrame], variant: str, centre: Centre, *, upright: bool) -> Figure:
    """Draw the figure: sweeps in the paper's order; one scale for errors of rotation, one for those of direction.

    Args:
        tables: result of ``read_summaries``.
        variant: reading of the noise.
        centre: statistic over the trials.
        upright: whether each sweep is a row of panels, instead of a column.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=_COLUMN_IN if upright else _WIDE_IN, layout="constrained")
    shape, along = (len(SWEEPS), len(_Y_LABELS)), ("row", "col")
    panels = figure.subplots(
        *(shape if upright else shape[::-1]),
        sharex=along[not upright],
        sharey=along[upright],
        squeeze=False,
    )
    for row, name in zip(panels if upright else panels.T, SWEEPS, strict=True):
        table = tables[name] if name == "noise" else tables[name][tables[name].variant == variant]
        for axes, measure in zip(row, _Y_LABELS, strict=True):
            _curves(axes, table, measure, centre)
            _scales(axes, table, name)
            axes.set_xlabel(_X_LABELS[name])
            if name == "noise":
                axes.axvline(READINGS[variant], color="0.5", linewidth=0.7, zorder=0)
                axes.set(**{"title" if upright else "ylabel": _Y_LABELS[measure]})
    for axes in panels.flat:
        _tick_decades(axes)
        if not upright:
            axes.label_outer()
    handles, labels = panels[0, 0].get_legend_handles_labels()
    trials = int(tables["noise"].trials.iloc[0])
    words = "$10^{-3}$ px" if variant == "1e-3 px" else "$10^{-3}$ of the image plane = 0.81 px"
    title = f"Noise read as {words}: {centre} of {trials} trials, 95 % interval"
    columns = 2 if upright else len(labels)
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, title=title)
    return figure


def _curves(axes: Axes, table: pd.DataFrame, measure: str, centre: Centre) -> None:
    """Draw a curve with 95 % band for each solver of one sweep, and the bound of the same statistic."""
    for solver, rows in table.groupby("solver", sort=False):
        style = _STYLES.get(str(solver), _OTHER)
        key = f"{measure}_{centre}"
        axes.plot(rows.value, rows[key], label=_LABELS.get(str(solver), str(solver)), **style)
        axes.fill_between(
            rows.value, rows[f"{key}_low"], rows[f"{key}_high"], color=style["color"], alpha=0.2, linewidth=0
        )
    limit = table[table.solver == OURS]
    axes.plot(limit.value, limit[f"{measure}_bound_{centre}"], label="at the Cramér-Rao bound *", **_BOUND)


def _scales(axes: Axes, table: pd.DataFrame, name: str) -> None:
    axes.set_yscale("log")
    if name in _LOG_X:
        axes.set_xscale("log")
    if name in ("rotation", "translation", "readout"):
        values = sorted(set(table.value))
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.xaxis.minorticks_off()
    axes.grid(True, which="major", color="0.88", linewidth=0.5)


def _tick_decades(axes: Axes) -> None:
    """Put ticks at every other decade, as the panels are low."""
    from matplotlib.ticker import FixedLocator, NullFormatter

    low, high = (math.log10(end) for end in axes.get_ylim())
    first = _TICK_DECADES * math.ceil(low / _TICK_DECADES)
    axes.yaxis.set_major_locator(
        FixedLocator([10.0**e for e in range(first, math.floor(high) + 1, _TICK_DECADES)])
    )
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.minorticks_off()


@contextmanager
def _style(more: dict[str, Any] | None = None) -> Iterator[None]:
    """Use fixed settings of matplotlib, so that files do not depend on the user or the run."""
    from matplotlib import rc_context, style

    settings: Any = {
        "font.size": 9,
        "axes.titlesize": 10,
        "lines.linewidth": 1.3,
        "lines.markersize": 4,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "svg.hashsalt": "rsbench",
        "pdf.fonttype": 42,
    }
    with style.context("default"), rc_context(settings | (more or {})):
        yield


def setting_table(cards: list[SweepCard]) -> pd.DataFrame:
    """Table of the fixed settings of each sweep, most of which the paper does not state."""
    rows = []
    for card in cards:
        s: Setting = card.setting
        fixed = {
            "points": ("points per camera", f"{s.points}"),
            "depth": ("depth (m)", f"{s.depth[0]:g} to {s.depth[1]:g}, uniform"),
            "rotation_deg": ("rotation (deg)", f"{s.rotation_deg:g}, random axis"),
            "translation": ("translation (m)", f"{s.translation:g}, random direction"),
            "baseline": ("baseline (m)", f"{s.baseline:g}"),
            "readout_ratio": ("readout ratio", f"{s.readout_ratio:g}"),
        }
        row = {
            "sweep": card.name,
            "varies": f"{card.axis}: {', '.join(f'{value:g}' for value in card.values)}",
            "image": f"{s.width} x {s.height}, f = {s.focal:g} px",
        }
        row |= {title: "varies" if card.axis == key else text for key, (title, text) in fixed.items()}
        rows.append(row | {"trials": str(card.trials)})
    return pd.DataFrame(rows)


_PAGE = """# The paper's Figure 3, made again

Made by `rsbench reproduce fig3`: simulated points, solvers without RANSAC, the same scenes and noise for all of
them. The paper's noise of "10^-3" has no unit, so each figure exists for both readings. The paper plots means,
which a few flipped translations can dominate; medians are shown too. Bands are 95 % bootstrap intervals, 10 000
draws. All panels of an error share one scale. A star marks what the paper excludes: non-linear optimisation, and
the Cramer-Rao bound (the same statistic of Gaussian errors at the bound of the left and right pairs). The
vertical line marks the reading. No row was run again: by chance one in forty ratios of a solver at its bound is
below 1 with its interval, and so are other rows of the sweep, which share scenes and noise. The eight-point
algorithm, which is biased, is below the bound in places.

| | 10^-3 px | 10^-3 of the normalised image plane, 0.81 px |
|---|---|---|
| median | ![median, 10^-3 px](fig3-px-median.png) | ![median, 0.81 px](fig3-normalised-median.png) |
| mean | ![mean, 10^-3 px](fig3-px-mean.png) | ![mean, 0.81 px](fig3-normalised-mean.png) |

Each is also a PDF for a column of 88 mm, with a row for each sweep: [median](fig3-px-median.pdf) and
[mean](fig3-px-mean.pdf) of 10^-3 px, [median](fig3-normalised-median.pdf) and [mean](fig3-normalised-mean.pdf) of
0.81 px. Sweeps are in the order of the paper's columns: noise and baseline, whose panels there have both errors,
translation, rotation, readout. Where the two readings of the paper's solver agree, as in most e_T, the second
covers the first; *symmetric part* takes w from the symmetric part of E. The baseline is the distance between the
cameras; the paper may mean half of it. The eight-point algorithm uses the left camera alone and is scored against
that camera's own translation; the others use left and right pairs.
The tables `<sweep>.csv` have all figures, also of scale, failures and error over bound.
[trials.npz](trials.npz) has the errors of every trial in single precision: `<sweep>_e_R_deg` and
`<sweep>_e_T_deg` (rows, trials), whose row k is that of the table.

What the paper does not state had to be chosen:

"""


def fig3_page(settings: pd.DataFrame) -> str:
    """Return the page of Figure 3 as Markdown, with the result of ``setting_table``."""
    return _PAGE + frame_text(settings) + "\n"


TITLES = (
    "(a) rolling shutter (RS)",
    "(b) corrected",
    "(c) true depth",
    "(d) RS over GS",
    "(e) corrected over GS",
    "(f) depth error",
)
ERROR_M = (0.001, 2.0)
"""Ends of the logarithmic scale of depth errors, metres: below usual errors indoors, and the paper's limit."""
INVENTED = (0, 190, 255)
"""Colour of depth where there is no surface; it is not in the colour map."""
_COLOURS = 256
_PIXELS = {"pdf": 210, "jpg": 250}
_JPEG = {"subsampling": 0, "optimize": True}
_WIDTH_IN, _TEXT_IN, _HEAD_IN, _BAR_IN, _GAP_IN = 7.2, 0.56, 0.2, 0.2, 0.03


def draw_fig4(rows: list[tuple[str, Panels]], stem: Path, quality: int = 84) -> list[Path]:
    """Draw rows of panels to ``stem``.pdf and ``stem``.jpg; returns the files. Equal panels give equal files.

    Args:
        rows: name and panels of each row, from the top.
        stem: path of the files without suffix.
        quality: quality of the JPEG, 1 to 95.
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
    """A colour scale. Ends and ticks (text and value) are in the unit of the drawn values."""

    low: float
    high: float
    ticks: dict[str, float]
    colours: str


def depth_scale(panels: Panels) -> Scale:
    """Scale of inverse depth, 1/m, from the 1st to the 99th percentile of the surfaces; ticks show metres."""
    low, high = np.nanpercentile(1.0 / panels.true_depth, [1, 99])
    even = (low + np.linspace(0.0, 1.0, 4) * (high - low)).tolist()
    texts = [f"{1.0 / value:.2g} m" if k == 0 else f"{1.0 / value:.2g}" for k, value in enumerate(even)]
    return Scale(low=float(low), high=float(high), ticks=dict(zip(texts, even, strict=True)), colours="viridis")


def _error_scale() -> Scale:
    """Scale of the decimal logarithm of the depth error, metres."""
    low, high = (math.log10(end) for end in ERROR_M)
    ticks = {"1 mm": -3.0, "1 cm": -2.0, "10 cm": -1.0, "1 m": 0.0}
    return Scale(low=low, high=high, ticks=ticks, colours="inferno")


def _draw_scale(figure: Any, place_in: tuple[float, float, float, float], scale: Scale) -> None:
    """Draw a colour bar with ticks below; ``place_in``: left, bottom, width and height, inches."""
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
    """Return the six panels as RGB images."""
    depth, error = depth_scale(panels), _error_scale()
    # Smaller errors, also of 0, get the lowest value of the scale.
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
    """Return the lines of text below a row."""
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
    """Reduce an image to 256 colours: files are a third as large, and look equal at the size of a panel."""
    from PIL import Image as Pillow

    reduced = Pillow.fromarray(image).quantize(_COLOURS, method=Pillow.Quantize.MEDIANCUT)
    return np.asarray(reduced.convert("RGB"), dtype=np.uint8)
