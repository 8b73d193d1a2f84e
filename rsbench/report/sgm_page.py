"""The page and the figure of the study of semi-global matching, from its stored table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.studies.sgm_timing import DELAYS
from rsbench.report import pages

_STYLES = {"mild": ("#0072B2", "o"), "moderate": ("#D55E00", "s"), "aggressive": ("#009E73", "^")}


def write_sgm_page(folder: Path) -> list[Path]:
    """README.md and sgm.svg from sgm.csv in ``folder``; returns the files."""
    table = pd.read_csv(folder / "sgm.csv")
    page = folder / "README.md"
    page.write_text(sgm_page(table), "utf-8", newline="\n")
    return [page, _draw(table, folder / "sgm.svg")]


def sgm_page(table: pd.DataFrame) -> str:
    """The page as Markdown."""
    delayed, opposite = table[~table["opposite"]], table[table["opposite"]]
    none = delayed[delayed["delay"] == 0.0]
    worst = delayed.sort_values("vertical_px").iloc[-1]
    before = none[(none["sequence"] == worst["sequence"]) & (none["stratum"] == worst["stratum"])].iloc[0]
    return pages.markdown(
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
    """Where the first-order formula, with the matcher's own error, falls short most."""
    floors = delayed[delayed["delay"] == 0.0].set_index(["stratum", "sequence"])["error_px"]
    later = delayed[delayed["delay"] > 0.0]
    floor = floors.loc[list(zip(later["stratum"], later["sequence"], strict=True))].to_numpy()
    ratio = later["error_px"] / np.hypot(later["predicted_px"], floor)
    worst = later.loc[ratio.idxmax()]
    return {"short_factor": ratio.max(), "short_where": f"{worst['stratum']}, {worst['sequence']}"}


def _tolerable(delayed: pd.DataFrame) -> str:
    """Delay of 0.1 px per sequence: the predicted error is proportional to it."""
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
    lines = ["| " + " | ".join(names.values()) + " |", "|" + "---|" * len(names)]
    for _, row in table.iterrows():
        cells = []
        for name in names:
            value = row[name]
            cells.append(f"{value:.3f}" if isinstance(value, float) else str(value))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _draw(table: pd.DataFrame, path: Path) -> Path:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    delayed = table[~table["opposite"]]
    with rc_context({"font.size": 8, "svg.hashsalt": "rsbench", "svg.fonttype": "none"}):
        figure = Figure(figsize=(5.2, 3.2), layout="constrained")
        axes = figure.add_subplot()
        for (stratum, sequence), rows in delayed.groupby(["stratum", "sequence"], sort=False):
            colour, marker = _STYLES[str(stratum)]
            floor = float(rows[rows["delay"] == 0.0]["error_px"].iloc[0])
            later = rows[rows["delay"] > 0.0]
            filled = str(sequence).startswith("castle")
            label = f"{stratum}, {sequence}"
            axes.plot(later["delay"], (later["predicted_px"] ** 2 + floor**2) ** 0.5, color=colour, linewidth=0.9)
            style: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": "none", "markersize": 4}
            axes.plot(
                later["delay"], later["error_px"], label=label, fillstyle="full" if filled else "none", **style
            )
        axes.set(xscale="log", yscale="log", xlabel="delay of the right camera (frame periods)")
        axes.set_ylabel("median disparity error (px)")
        axes.grid(True, which="major", linewidth=0.3)
        axes.legend(fontsize=7, frameon=False)
        figure.savefig(path, metadata={"Date": None})
    return path
