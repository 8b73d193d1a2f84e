"""The page and the figure of the correction study, from its stored tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.statistics import share_interval
from rsbench.benchmark.studies.correction_bench import METHODS, ON_REQUEST, methods_among
from rsbench.benchmark.studies.correction_study import (
    ROW_BANDS,
    by_scene,
    law_and_size,
    loss_to_true_motion,
    masks,
    verdict,
)
from rsbench.benchmark.studies.real_cameras import BEYOND, within_stated
from rsbench.benchmark.studies.sgm_timing import DELAYS
from rsbench.report import pictures
from rsbench.report.markup import rendered, table_lines
from rsbench.storage.files import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TITLES = {method.key: method.title for method in (*METHODS, *ON_REQUEST)}
_BOUNDED = 6
"""Least number of sequences of a stratum for a median with an interval; with fewer, nothing is judged."""
SIZES = ("moderate", "aggressive")
"""Sizes of the motions of the card ``laws``."""
_LINES = {
    "none": ("#000000", "--", "x"),
    "gyro": ("#CC79A7", "-.", "+"),
    "gs": ("#E69F00", ":", "s"),
    "gs-scaled": ("#E69F00", "-", "s"),
    "mono": ("#56B4E9", "-", "^"),
    "plane": ("#D55E00", "-", "v"),
    "ours": ("#0072B2", "-", "o"),
    "true-depth": ("#009E73", ":", "D"),
}


def _page(folder: Path, text: str) -> Path:
    """Write README.md and return its path."""
    write_bytes(folder / "README.md", text.encode())
    return folder / "README.md"


def write_study(folder: Path) -> list[Path]:
    """Write README.md and rows.svg from the tables in ``folder``; returns the files."""
    page = _page(folder, study_page(pd.read_csv(folder / "views.csv"), pd.read_csv(folder / "summary.csv")))
    return [page, _draw_rows(pd.read_csv(folder / "rows.csv"), folder / "rows.svg")]


def write_laws(folder: Path) -> Path:
    """Write README.md from the tables in ``folder``: ``by_law``, ``by_sequence``, and the errors of motions."""
    tables = [pd.read_csv(folder / f"{name}.csv") for name in ("summary", "sequences", "motions")]
    return _page(folder, laws_page(*tables))


def laws_page(summary: pd.DataFrame, sequences: pd.DataFrame, motions: pd.DataFrame) -> str:
    """The page of frames under several motion models, as Markdown.

    Args:
        summary, sequences: results of ``by_law`` and ``by_sequence``.
        motions: errors of the estimated motions, a row for each sequence.
    """
    return rendered(
        "laws-correction.md.j2",
        methods=methods_among(set(summary["method"])),
        tables=[law_table(summary, size) for size in SIZES],
        worst=worst_table(sequences, motions),
    )


def worst_table(sequences: pd.DataFrame, motions: pd.DataFrame) -> str:
    """A row for each motion model and size: the sequences with our lowest score and with our largest e_T."""
    wide = sequences.pivot(index="sequence", columns="method", values="psnr_covered")
    errors = motions.set_index("sequence")
    head = (
        "motion model, size",
        "least PSNR of ours",
        "uncorrected",
        "sequence",
        "largest e_T (e_R there), deg",
        "sequence",
    )
    rows = []
    for stratum, names in sequences.drop_duplicates("sequence").groupby(law_and_size(sequences), sort=False):
        own = list(names["sequence"])
        dark, off = wide.loc[own, "ours"].idxmin(), errors.loc[own, "e_T_deg_ours"].idxmax()
        error = f"{errors.loc[off, 'e_T_deg_ours']:.3g} ({errors.loc[off, 'e_R_deg_ours']:.2g})"
        psnrs = [f"{wide.loc[dark, method]:.1f}" for method in ("ours", "none")]
        rows.append([stratum, *psnrs, dark, error, off])
    return "\n".join(table_lines(head, rows))


def study_page(images: pd.DataFrame, summary: pd.DataFrame) -> str:
    """The page as Markdown."""
    strata = list(dict.fromkeys(summary["stratum"]))
    return rendered(
        "correction.md.j2",
        strata=", ".join(strata),
        methods=methods_among(set(summary["method"])),
        tables=[_sections(images, summary, stratum) for stratum in strata],
        findings=_findings(images, summary),
        bands=ROW_BANDS,
    )


def law_table(laws: pd.DataFrame, size: str) -> str:
    """Covered PSNR, dB, for motions of one size by motion model; in brackets the paired gain of ours."""
    own = laws[laws["stratum"].str.endswith(f", {size}")]
    strata = list(dict.fromkeys(own["stratum"]))
    names = [stratum.partition(",")[0] for stratum in strata]
    lines = []
    for method in methods_among(set(own["method"])):
        rows = own[own["method"] == method.key].set_index("stratum")
        cells = [_with_gain(rows.loc[stratum]) for stratum in strata]
        lines.append([f"**{method.title}**" if method.key == "ours" else method.title, *cells])
    return "\n".join(table_lines([size, *names], lines))


def _with_gain(row: pd.Series) -> str:
    score = f"{row['psnr_covered']:.1f}" + (f" ({row['failures']:.0f} failed)" if row["failures"] else "")
    if row["method"] == "ours":
        return score
    low, high = (round(float(row[f"gain_{end}"]), 1) + 0.0 for end in ("low", "high"))
    return f"{score} [{low:.1f}, {high:.1f}]"


def _sections(images: pd.DataFrame, summary: pd.DataFrame, stratum: str) -> dict[str, str]:
    """Text on the mask of one stratum, and its tables over all sequences and by scene."""
    own = images[images["stratum"] == stratum]
    mask = masks(own).iloc[0]
    share = (
        f"Covered by every method: {100 * mask['median']:.0f} % of the pixels at the median view, "
        f"{100 * mask['least']:.0f} % at the least."
    )
    table = _correction_table(summary[summary["stratum"] == stratum])
    scores, gains = _scene_tables(by_scene(own))
    return {"stratum": stratum, "mask": share, "table": table, "scenes": scores, "gains": gains}


def _scene_tables(scenes: pd.DataFrame) -> tuple[str, str]:
    """Two tables by scene, dB: PSNR of covered / of all pixels; gain of ours over each method, covered pixels."""
    names = list(dict.fromkeys(scenes["scene"]))
    counts = scenes.groupby("scene")["sequences"].first()
    headings = [f"{name} ({counts[name]})" for name in names]
    scores, gains = list[list[str]](), list[list[str]]()
    for method in methods_among(set(scenes["method"])):
        own = scenes[scenes["method"] == method.key].set_index("scene")
        cells = [f"{own.loc[name, 'psnr_covered']:.2f} / {own.loc[name, 'psnr_all']:.2f}" for name in names]
        scores.append([method.title, *cells])
        if method.key != "ours":
            cells = [_with_interval(own.loc[name], "gain", 2) for name in names]
            gains.append([method.title, *cells])
    found = (table_lines(["method", *headings], scores), table_lines(["ours above", *headings], gains))
    return "\n".join(found[0]), "\n".join(found[1])


_COLUMNS: dict[str, Callable[[pd.Series], str]] = {
    "PSNR covered (dB)": lambda row: _with_interval(row, "psnr_covered", 2),
    "ours + (dB)": lambda row: "" if row["method"] == "ours" else _with_interval(row, "gain", 2),
    "SSIM covered": lambda row: _with_interval(row, "ssim_covered", 3),
    "PSNR all (dB)": lambda row: _with_interval(row, "psnr_all", 2),
    "SSIM all": lambda row: f"{row['ssim_all']:.3f}",
    "flow, median (px)": lambda row: _with_interval(row, "flow_median_px", 3),
    "flow, mean (px)": lambda row: f"{row['flow_mean_px']:.3f}",
    "FLIP covered": lambda row: _with_interval(row, "flip_covered", 4),
    "own pixels": lambda row: f"{100 * row['coverage']:.1f} %",
}
"""Columns of the table over all sequences, after that of the method."""


def _correction_table(summary: pd.DataFrame) -> str:
    rows = []
    for _, row in summary.iterrows():
        name = _TITLES[str(row["method"])] + (f" ({row['failures']:.0f} failed)" if row["failures"] else "")
        if row["method"] == "ours":
            name = f"**{name}**"  # only the name: bold figures would look like the best ones
        rows.append([name, *(cell(row) for cell in _COLUMNS.values())])
    return "\n".join(table_lines(["method", *_COLUMNS], rows))


def _with_interval(row: pd.Series, name: str, digits: int) -> str:
    value, low, high = (round(float(row[key]), digits) + 0.0 for key in (name, f"{name}_low", f"{name}_high"))
    if np.isnan(value):  # computed for the strongest of each family only
        return "–"
    if np.isinf(low):  # fewer than six sequences give no interval of a median
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"  # + 0.0: no minus sign before zero


def _findings(images: pd.DataFrame, summary: pd.DataFrame) -> str:
    lines = []
    for _, row in loss_to_true_motion(images).iterrows():
        median = round(float(row["median_loss_db"]), 3) + 0.0
        lines.append(
            f"- {row['stratum']}: replacing our motion by the true one on the same SGM depth gains "
            f"{median:.3f} dB at the median view, {row['largest_loss_db']:.3f} dB at most."
        )
    checked = verdict(summary[summary["sequences"] >= _BOUNDED])
    if checked.empty:
        return "\n".join(lines)
    for column, text in (
        ("flow_apart", "median flow error, separate intervals do not overlap"),
        ("covered_apart", "covered PSNR, separate intervals do not overlap"),
        ("covered_paired", "covered PSNR, paired difference above 0"),
        ("all_apart", "PSNR of all pixels, separate intervals do not overlap"),
        ("all_paired", "PSNR of all pixels, paired difference above 0"),
    ):
        wrong = checked[~checked[column]]
        names = ", ".join(
            f"{_TITLES[str(m)]} ({s})" for s, m in zip(wrong["stratum"], wrong["method"], strict=True)
        )
        lines.append(
            f"- Ours against every baseline in every stratum of {_BOUNDED} sequences and more, {text}: "
            f"{len(checked) - len(wrong)} of {len(checked)}" + (f"; not: {names}." if names else ".")
        )
    return "\n".join(lines)


@contextmanager
def _drawn(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure and write it as SVG at the end, with text as text; equal data give equal files."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"font.size": 8, "svg.hashsalt": "rsbench", "svg.fonttype": "none"}):
        figure = Figure(figsize=size, layout="constrained")
        yield figure
        figure.savefig(path, metadata={"Date": None})


def _draw_rows(rows: pd.DataFrame, path: Path) -> Path:
    strata = list(dict.fromkeys(rows["stratum"]))
    middle = (np.arange(ROW_BANDS) + 0.5) / ROW_BANDS
    with _drawn(path, (2.6 * len(strata), 3.0)) as figure:
        panels = figure.subplots(1, len(strata), sharey=True, squeeze=False)[0]
        for axes, stratum in zip(panels, strata, strict=True):
            own = rows[rows["stratum"] == stratum]
            for key, (colour, line, marker) in _LINES.items():
                values = own[own["method"] == key].sort_values("band")["flow_mean_px"].to_numpy()
                if len(values) == ROW_BANDS:
                    style = {"color": colour, "linestyle": line, "marker": marker, "markersize": 3, "linewidth": 1}
                    axes.plot(middle, values, label=_TITLES[key], **style)
            axes.set(yscale="log", title=stratum, xlabel="row / height")
            axes.grid(True, which="major", linewidth=0.3)
        panels[0].set_ylabel("mean flow error (px)")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return path


_CAMERAS = ("ideal", "real")
_GAP = 8
_LONGEST = 560


def write_real_page(folder: Path, card: dict[str, Any]) -> Path:
    """Write README.md from motions.csv and summary.csv in ``folder``; ``card`` is that of the real camera's
    dataset."""
    summary, motions = pd.read_csv(folder / "summary.csv"), pd.read_csv(folder / "motions.csv")
    return _page(folder, real_page(summary, motions, card))


def real_page(summary: pd.DataFrame, motions: pd.DataFrame, card: dict[str, Any]) -> str:
    """The page as Markdown."""
    return rendered(
        "real.md.j2",
        table=_table(summary),
        errors=_errors(summary),
        kept={camera: _kept(motions, camera) for camera in _CAMERAS},
        beyond=BEYOND,
        seeds=int(summary["seeds"].min()),
        camera=card["camera"],
        exposure_ms=1e3 * card["sensor"]["exposure_s"],
        period_ms=1e3 * card["frame_period_s"],
        readout=card["readout_ratio"],
    )


def _kept(motions: pd.DataFrame, camera: str) -> str:
    count, sequences = within_stated(motions, camera)
    low, high = share_interval(count, sequences)
    return f"{count} of {sequences} sequences (95 % interval of the share: {low:.2f} to {high:.2f})"


def _pairs(summary: pd.DataFrame) -> list[tuple[str, pd.Series, pd.Series]]:
    """Scene and stratum with the rows of both cameras."""
    found = []
    for (scene, stratum), group in summary.groupby(["scene", "stratum"], sort=False):
        ideal, real = (group[group["camera"] == camera].iloc[0] for camera in _CAMERAS)
        found.append((f"{scene}, {stratum}", ideal, real))
    return found


def _table(summary: pd.DataFrame) -> str:
    head = ("scene, motion", "e_R (deg): ideal, real", "e_T (deg): ideal, real", "PSNR (dB), ideal: before, after")
    rows = []
    for name, ideal, real in _pairs(summary):
        cells = [name, *(f"{ideal[e]:.3f}, {real[e]:.3f}" for e in ("e_R_deg", "e_T_deg"))]
        cells += [f"{row['psnr_none']:.1f}, {row['psnr_median']:.1f}" for row in (ideal, real)]
        rows.append([*cells, f"{real['psnr_clean_median']:.1f}", f"{real['coverage']:.1%}"])
    return "\n".join(table_lines([*head, "real: before, after", "real, clean: after", "drawn"], rows))


def _errors(summary: pd.DataFrame) -> str:
    head = ("scene, motion", "camera", "failed", "e_R of the worst seed (deg)", "e_T of the worst seed (deg)")
    lines = []
    for name, *rows in _pairs(summary):
        for row in rows:
            cells = [name, row["camera"], f"{row['failures']} of {row['sequences'] * row['seeds']}"]
            cells += [f"{row['e_R_worst_deg']:.3f}", f"{row['e_T_worst_deg']:.3f}", f"{row['sigmas']:.1f}"]
            lines.append([*cells, f"{row['psnr_worst']:.1f}"])
    return "\n".join(table_lines([*head, "largest error in stated sigmas", "PSNR of that seed (dB)"], lines))


def draw_frames(frames: dict[str, NDArray[np.uint8]], path: Path) -> Path:
    """Draw pictures of one size side by side, each with its name in its upper left corner."""
    small = [pictures.label(pictures.shrink(frame, _LONGEST).copy(), name) for name, frame in frames.items()]
    white = np.full((small[0].shape[0], _GAP, 3), 255, dtype=np.uint8)
    row = [part for image in small for part in (image, white)][:-1]
    path.write_bytes(pictures.encode_jpeg(np.asarray(cv2.hconcat(row), dtype=np.uint8)))
    return path


_STYLES = {"mild": ("#0072B2", "o"), "moderate": ("#D55E00", "s"), "aggressive": ("#009E73", "^")}


def write_sgm_page(folder: Path) -> list[Path]:
    """Write README.md and sgm.svg from sgm.csv in ``folder``; returns the files."""
    table = pd.read_csv(folder / "sgm.csv")
    return [_page(folder, sgm_page(table)), _draw(table, folder / "sgm.svg")]


def sgm_page(table: pd.DataFrame) -> str:
    """The page as Markdown."""
    delayed, opposite = table[~table["opposite"]], table[table["opposite"]]
    none = delayed[delayed["delay"] == 0.0]
    worst = delayed.sort_values("vertical_px").iloc[-1]
    before = none[(none["sequence"] == worst["sequence"]) & (none["stratum"] == worst["stratum"])].iloc[0]
    return rendered(
        "sgm.md.j2",
        table=_markdown(table),
        floor_low=none["error_px"].min(),
        floor_high=none["error_px"].max(),
        lost_rows=worst["vertical_px"],
        lost_where=f"{worst['stratum']}, {worst['sequence']}",
        lost_share=100 * (1 - worst["coverage"] / before["coverage"]),
        opposite_low=100 * opposite["coverage"].min(),
        opposite_high=100 * opposite["coverage"].max(),
        tolerable=_tolerable(delayed),
        **_underestimate(delayed),
    )


def _underestimate(delayed: pd.DataFrame) -> dict[str, Any]:
    """Find the case in which the first-order formula with the matcher's own error underestimates most."""
    floors = delayed[delayed["delay"] == 0.0].set_index(["stratum", "sequence"])["error_px"]
    later = delayed[delayed["delay"] > 0.0]
    floor = floors.loc[list(zip(later["stratum"], later["sequence"], strict=True))].to_numpy()
    ratio = later["error_px"] / np.hypot(later["predicted_px"], floor)
    worst = later.loc[ratio.idxmax()]
    return {"short_factor": ratio.max(), "short_where": f"{worst['stratum']}, {worst['sequence']}"}


def _tolerable(delayed: pd.DataFrame) -> str:
    """Text: the delay for an error of 0.1 px in each sequence; the predicted error is proportional to it."""
    longest = delayed[delayed["delay"] == max(DELAYS)]
    parts = []
    for _, row in longest.iterrows():
        delay = 0.1 * row["delay"] / row["predicted_px"]
        parts.append(f"{delay:.4f} frame periods ({row['stratum']}, {row['sequence']})")
    return ", ".join(parts)


def _markdown(table: pd.DataFrame) -> str:
    names = {
        "stratum": "motion",
        "sequence": "sequence",
        "timing": "right camera",
        "coverage": "coverage",
        "error_px": "error (px)",
        "predicted_px": "predicted (px)",
        "unexplained_px": "unexplained (px)",
        "vertical_px": "rows",
        "depth_error_m": "depth error (m)",
        "over_2m": "> 2 m",
    }
    rows = [[row[name] for name in names] for _, row in table.iterrows()]
    words = [[f"{value:.3f}" if isinstance(value, float) else value for value in row] for row in rows]
    return "\n".join(table_lines(list(names.values()), words))


def _draw(table: pd.DataFrame, path: Path) -> Path:
    delayed = table[~table["opposite"]]
    with _drawn(path, (5.2, 3.2)) as figure:
        axes = figure.add_subplot()
        for (stratum, sequence), rows in delayed.groupby(["stratum", "sequence"], sort=False):
            colour, marker = _STYLES[str(stratum)]
            floor = float(rows[rows["delay"] == 0.0]["error_px"].iloc[0])
            later = rows[rows["delay"] > 0.0]
            axes.plot(later["delay"], (later["predicted_px"] ** 2 + floor**2) ** 0.5, color=colour, linewidth=0.9)
            style: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": "none", "markersize": 4}
            style["fillstyle"] = "full" if str(sequence).startswith("castle") else "none"
            axes.plot(later["delay"], later["error_px"], label=f"{stratum}, {sequence}", **style)
        axes.set(xscale="log", yscale="log", xlabel="delay of the right camera (frame periods)")
        axes.set_ylabel("median disparity error (px)")
        axes.grid(True, which="major", linewidth=0.3)
        axes.legend(fontsize=7, frameon=False)
    return path
