"""Figures on the results pages and in README are those of the committed results."""

from __future__ import annotations

import re
import statistics

from documents import ROOT, results, rows, section

from rsbench.benchmark.studies.claims import CLAIMS

DOCS = ROOT / "docs"
PAPER = (DOCS / "results-paper.md").read_text("utf-8")
PUBLISHED = [
    line for path in sorted((ROOT / "results").rglob("*.md")) for line in path.read_text("utf-8").splitlines()
]
README_ROWS = {
    "8-point, global shutter (`gs-8pt`)": "gs-8pt",
    "linear, Wang et al. 2020 (`rs-stereo-linear`)": "rs-stereo-linear",
    "**maximum likelihood** (`rs-stereo-refined`)": "rs-stereo-refined",
    "nothing": "uncorrected",
    "global-shutter motion, scaled matches": "GS motion of scaled matches, SGM depth",
    "**our motion**, best-fitting model": "**ours**",
    "true motion and depth (limit)": "true motion, true depth",
}
"""What README calls a row, and the results."""
README_SOLVERS = ("rs-stereo-refined", "rs-stereo-refined-twist", "gs-stereo-tracks-scaled", "gs-stereo-tracks")


def test_readme_is_short_and_shows_rows_of_the_results() -> None:
    """In plainer words: solvers (without their input column), models at 2 deg, frames at aggressive motion."""
    readme = (ROOT / "README.md").read_text("utf-8")
    assert readme.count("\n") <= 160
    published: dict[str, list[list[str]]] = {}
    for line in PUBLISHED:
        name, *cells = line.strip("| ").split(" | ")
        published.setdefault(name, []).append(cells)
    sweep = {
        (row["variant"], row["solver"]): float(row["e_T_median"])
        for row in results("sweeps/wrong-motion.csv")
        if float(row["value"]) == 2.0
    }
    shown = {name: cells for name, *cells in rows(readme) if re.search(r"\d", " ".join(cells))}
    assert shown.keys() == {*README_ROWS, "`linear`", "`twist`", "`inertial`"}
    for name, cells in shown.items():
        if name in README_ROWS:
            wanted = cells[1:] if "rs-" in name or "gs-" in name else cells
            wanted = [re.sub(r"\(\+?(-?[\d.]+) to \+?(-?[\d.]+)\)", r"[\1, \2]", cell) for cell in wanted]
            assert wanted in [row[-len(wanted) :] for row in published[README_ROWS[name]]], name
        else:
            errors = [float(f"{sweep[name.strip('`'), solver]:.2g}") for solver in README_SOLVERS]
            assert [float(cell) for cell in cells] == errors, name
    assert (DOCS / "before-after.gif").stat().st_size < 1.5e6


def test_figures_shown_are_those_of_the_committed_results() -> None:
    shown = "|".join(
        ["castle", "old-town", "room", "[gr]s-[a-z0-9-]+", *(re.escape(claim.key) for claim in CLAIMS)]
    )
    lines = re.findall(rf"^\| (?:{shown}) \|.*$", PAPER, re.MULTILINE)
    assert {claim.key for claim in CLAIMS} <= {line.split(" | ")[0].removeprefix("| ") for line in lines}
    assert len(lines) > 40
    assert [line for line in lines if line not in PUBLISHED] == []


def test_the_literal_correction_is_that_of_figure_4() -> None:
    """Least and largest mean of the views over the seeds, on pixels with depth, and that of the uncorrected."""
    seeds: dict[str, list[dict[str, str]]] = {}
    for row in results("fig4/literal.csv"):
        seeds.setdefault(row["ransac_seed"], []).append(row)
    psnr, before = (
        [statistics.mean(float(row[column]) for row in of_seed) for of_seed in seeds.values()]
        for column in ("psnr_drawn", "psnr_rolling_drawn")
    )
    bounds = f"{min(psnr):.1f} to {max(psnr):.1f} dB"
    assert len(seeds) == 10
    text = " ".join(section(PAPER, "Corrected images").split())
    assert f"ten RANSAC seeds have {bounds} on the pixels that have a depth" in text
    assert f"uncorrected frame has {statistics.mean(before):.1f} dB" in text
    assert bounds in " ".join((DOCS / "report.md").read_text("utf-8").split())
