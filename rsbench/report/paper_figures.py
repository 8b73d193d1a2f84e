"""The paper's Figure 3: eight panels from stored summaries, for one reading of the noise and one statistic."""

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
from rsbench.report.markup import table_lines
from rsbench.report.pictures import Image
from rsbench.storage.files import read_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
# Okabe and Ito's colours, which readers of all colour vision tell apart; line and marker do so in grey.
_STYLES: dict[str, dict[str, Any]] = {
    "rs-stereo-linear": {"color": "#D55E00", "linestyle": "-", "marker": "o"},
    "rs-stereo-linear-symmetric": {"color": "#CC79A7", "linestyle": "-.", "marker": "s"},
    "gs-8pt": {"color": "#000000", "linestyle": "--", "marker": "^"},
    "rs-stereo-iterated": {"color": "#E69F00", "linestyle": "-.", "marker": "P"},
    "rs-stereo-refined-pairs": {"color": "#0072B2", "linestyle": "-", "marker": "D"},
}
_PAPERS = ("rs-stereo-linear", "rs-stereo-linear-symmetric", "gs-8pt")
"""What the paper compares; the others stand below, outside its terms."""
_BOUND: dict[str, Any] = {"color": "0.45", "linestyle": ":", "linewidth": 2.0, "zorder": 1}
_OTHER = {"color": "#009E73", "linestyle": ":", "marker": "x"}
_LABELS = {
    "rs-stereo-linear": "paper's solver, literal",
    "rs-stereo-linear-symmetric": "paper's solver, w from the symmetric part of E",
    "gs-8pt": "global-shutter 8-point",
    "rs-stereo-iterated": "iterated linear (not the paper's)",
    "rs-stereo-refined-pairs": "refined (non-linear: outside the paper's terms)",
}


def read_summaries(folder: Path, sweeps: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """Stored summaries ``<sweep>.csv`` by the name of the sweep.

    Raises:
        RsbenchError: one is missing or damaged.
    """
    tables = {}
    for name in sweeps:
        path = folder / f"{name}.csv"
        if not path.is_file():
            raise RsbenchError(f"{path}: no such summary; run: rsbench reproduce fig3")
        tables[name] = read_table(path)
    return tables


def draw_fig3(folder: Path) -> list[Path]:
    """Draw the figure for both readings and both statistics next to the summaries; returns the files.

    Equal summaries give equal bytes.
    """
    tables = read_summaries(folder, SWEEPS)
    paths: list[Path] = []
    for variant in READINGS:
        for centre in CENTRES:
            paths += _draw_fig3(tables, variant, centre, folder / f"fig3-{_ENDINGS[variant]}-{centre}")
    return paths


# The paper's arrangement. Its first column shows e_R and e_T in one panel; here such a panel has two halves.
_PANELS = (
    (("a", "noise", "e_R e_T"), ("b", "translation", "e_R"), ("c", "rotation", "e_R"), ("d", "readout", "e_R")),
    (("e", "baseline", "e_R e_T"), ("f", "translation", "e_T"), ("g", "rotation", "e_T"), ("h", "readout", "e_T")),
)


def _draw_fig3(tables: dict[str, pd.DataFrame], variant: str, centre: Centre, stem: Path) -> list[Path]:
    with _style() as plt:
        figure = plt.figure(figsize=(13.2, 10.2))
        grid = figure.add_gridspec(2, 4, left=0.052, right=0.992, bottom=0.05, top=0.87, wspace=0.25, hspace=0.17)
        for row, panels in enumerate(_PANELS):
            for column, (letter, name, measures) in enumerate(panels):
                table = tables[name]
                chosen = table if name == "noise" else table[table.variant == variant]
                halves = grid[row, column].subgridspec(len(measures.split()), 1, hspace=0.12)
                for number, measure in enumerate(measures.split()):
                    parts = halves[number].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.06)
                    upper, lower = (figure.add_subplot(part) for part in parts)
                    _comparison(upper, chosen, name, measure, centre)
                    _beyond(lower, chosen, name, measure, centre)
                    if name == "noise":
                        for axes in (upper, lower):
                            axes.axvline(READINGS[variant], color="0.5", linewidth=0.9, zorder=0)
                    if number == 0:
                        upper.set_title(f"({letter}) {name}", loc="left")
                    if number < len(measures.split()) - 1:
                        lower.set_xlabel("")
                        lower.tick_params(labelbottom=False)
        _title(figure, tables, variant, centre)
        paths = [stem.with_suffix(ending) for ending in (".pdf", ".png")]
        figure.savefig(paths[0], metadata={"CreationDate": None, "Producer": None, "Creator": None})
        figure.savefig(paths[1], dpi=130, metadata={"Software": None})
        plt.close(figure)
    return paths


def _comparison(axes: Axes, table: pd.DataFrame, name: str, measure: str, centre: Centre) -> None:
    """What the paper draws: its solver against the global-shutter algorithm."""
    _curves(axes, table[table.solver.isin(_PAPERS)], measure, centre)
    _scales(axes, table, name)
    axes.set_ylabel(_Y_LABELS[measure], labelpad=1)
    axes.tick_params(labelbottom=False)


def _beyond(axes: Axes, table: pd.DataFrame, name: str, measure: str, centre: Centre) -> None:
    """Solvers outside the paper's terms on an axis of their own, and the bound of the same statistic."""
    _curves(axes, table[~table.solver.isin(_PAPERS)], measure, centre)
    limit = table[table.solver == OURS]
    axes.plot(limit.value, limit[f"{measure}_bound_{centre}"], label=f"{centre} at the Cramér-Rao bound", **_BOUND)
    axes.set_facecolor("0.96")
    _scales(axes, table, name)
    axes.set_xlabel(_X_LABELS[name])


def _curves(axes: Axes, table: pd.DataFrame, measure: str, centre: Centre) -> None:
    """Curves with 95 % bands over the values of one sweep."""
    for solver, rows in table.groupby("solver", sort=False):
        style = _STYLES.get(str(solver), _OTHER)
        key = f"{measure}_{centre}"
        given = rows["information"].iloc[0]
        axes.plot(rows.value, rows[key], label=f"{_LABELS.get(str(solver), solver)} ({given})", **style)
        axes.fill_between(
            rows.value, rows[f"{key}_low"], rows[f"{key}_high"], color=style["color"], alpha=0.2, linewidth=0
        )


def _scales(axes: Axes, table: pd.DataFrame, name: str) -> None:
    axes.set_yscale("log")
    _label_decades(axes)
    if name in _LOG_X:
        axes.set_xscale("log")
    if name in ("rotation", "translation", "readout"):
        values = sorted(set(table.value))
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    axes.grid(True, which="major", color="0.88", linewidth=0.6)


def _label_decades(axes: Axes) -> None:
    """Ticks that fit: decades where there are some, else 1, 2 and 5 of each, else three or four even ones."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

    low, high = axes.get_ylim()
    if high < 50 * low:
        locator = MaxNLocator(3) if high < 4 * low else LogLocator(subs=(1.0, 2.0, 5.0))
        axes.yaxis.set_major_locator(locator)
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _title(figure: Any, tables: dict[str, pd.DataFrame], variant: str, centre: Centre) -> None:
    for axes, height in ((figure.axes[0], 0.965), (figure.axes[1], 0.94)):
        handles, labels = axes.get_legend_handles_labels()
        place = (0.5, height)
        figure.legend(handles, labels, loc="upper center", ncol=len(labels), frameon=False, bbox_to_anchor=place)
    trials = int(tables["noise"].trials.iloc[0])
    words = "$10^{-3}$ px" if variant == "1e-3 px" else "$10^{-3}$ of the normalised image plane = 0.81 px"
    figure.suptitle(
        f"Figure 3, noise read as {words}: {centre} of {trials} trials with 95 % interval; no RANSAC", y=0.985
    )


@contextmanager
def _style() -> Iterator[Any]:
    """matplotlib without a screen, the user's settings and anything that differs between runs."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

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
    with plt.style.context("default"), plt.rc_context(settings):
        yield plt


def setting_table(cards: list[SweepCard]) -> pd.DataFrame:
    """What each sweep holds fixed; most of it is not in the paper."""
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

Made by `rsbench reproduce fig3`: simulated points, bare solvers without RANSAC, the same scenes and the same
noise for all of them. The paper's noise of "10^-3" has no unit, so each figure exists for both readings; the
paper plots means, which a few flipped translations can dominate, so medians stand beside them. Bands are 95 %
bootstrap intervals, 10 000 draws. Upper halves: what the paper compares, its solver (read literally, and with w
from the symmetric part of E) against the global-shutter eight-point algorithm. Lower halves, with an axis of
their own: what lies outside the paper's terms, which exclude non-linear optimisation, and the same statistic of
a solver whose errors are Gaussian and at the Cramer-Rao bound of the left and right pairs. The vertical line
marks the reading. Every row is one draw of its trials and none was drawn again, so that of the ratios of a solver
at its bound one in forty lies below 1 with its interval; rows of one sweep share scenes and noise, and do so
together. The eight-point algorithm, which is biased, is below in places.

| | 10^-3 px | 10^-3 of the normalised image plane, 0.81 px |
|---|---|---|
| median | ![median, 10^-3 px](fig3-px-median.png) | ![median, 0.81 px](fig3-normalised-median.png) |
| mean | ![mean, 10^-3 px](fig3-px-mean.png) | ![mean, 0.81 px](fig3-normalised-mean.png) |

The panels stand where the paper has them; its first column shows both errors in one panel, which has two halves
here. Where the two readings of the paper's solver agree, as in most e_T, the second covers the first. The baseline
is the distance between the cameras; the paper may mean half of it. The eight-point algorithm sees the left camera
alone and is scored against that camera's own translation.
The tables `<sweep>.csv` hold all figures, also of scale, failures and error over bound.
[trials.npz](trials.npz) holds what they summarise, the errors of every trial in single precision:
`<sweep>_e_R_deg` and `<sweep>_e_T_deg` (rows, trials), whose row k is that of the table; NumPy reads it.

What the paper does not state had to be chosen:

"""


def fig3_page(settings: pd.DataFrame) -> str:
    """Markdown around the figures, with the table of ``setting_table``."""
    return _PAGE + "\n".join(table_lines(list(settings.columns), settings.itertuples(index=False))) + "\n"


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
    """Scale of inverse depth, 1/m, without the nearest and farthest hundredth of the surfaces; ticks in metres."""
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
