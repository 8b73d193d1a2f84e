"""Figures on the results pages and in README are those of the committed results."""

from __future__ import annotations

import re
import statistics

from documents import ROOT, results, rows, section

from rsbench.benchmark.studies.claims import CLAIMS
from rsbench.benchmark.studies.correction_bench import METHODS

DOCS = ROOT / "docs"
RESULTS = {path.name: path.read_text("utf-8") for path in sorted((ROOT / "docs").glob("results*.md"))}


README_ROWS = {
    "8-point, global shutter (`gs-8pt`)": "gs-8pt",
    "linear, Wang et al. 2020 (`rs-stereo-linear`)": "rs-stereo-linear",
    "**maximum likelihood** (`rs-stereo-refined`)": "rs-stereo-refined",
    "nothing": "uncorrected",
    "global-shutter motion, scaled matches": "GS motion of scaled matches, SGM depth",
    "**our motion**, best-fitting model": "**ours**",
    "true motion and depth (limit)": "true motion, true depth",
}
"""What README calls a row, and the results pages."""


def test_readme_is_short_and_shows_rows_of_the_results_pages() -> None:
    """In plainer words: solvers (without their input column), models at 2 deg, frames at aggressive motion."""
    readme = (ROOT / "README.md").read_text("utf-8")
    assert readme.count("\n") <= 160
    pages: dict[str, list[list[str]]] = {}
    for text in RESULTS.values():
        for line in text.splitlines():
            name, *cells = line.strip("| ").split(" | ")
            pages.setdefault(name, []).append(cells)
    shown = {name: cells for name, *cells in rows(readme) if re.search(r"\d", " ".join(cells))}
    assert shown.keys() == {*README_ROWS, "`linear`", "`twist`", "`inertial`"}
    for name, cells in shown.items():
        if name in README_ROWS:
            wanted = cells[1:] if "rs-" in name or "gs-" in name else cells
            wanted = [re.sub(r"\(\+?(-?[\d.]+) to \+?(-?[\d.]+)\)", r"[\1, \2]", cell) for cell in wanted]
            found = [row[-len(wanted) :] for row in pages[README_ROWS[name]]]
        else:
            wanted, found = ["2", *cells], pages[name.strip("`")]
        assert wanted in found, name
    assert (DOCS / "before-after.gif").stat().st_size < 1.5e6


def test_figures_shown_are_those_of_the_committed_results() -> None:
    published = {
        line for path in (ROOT / "results").rglob("*.md") for line in path.read_text("utf-8").splitlines()
    }
    shown = "|".join(
        ["castle", "old-town", "room", "[gr]s-[a-z0-9-]+", *(re.escape(claim.key) for claim in CLAIMS)]
    )
    lines = re.findall(rf"^\| (?:{shown}) \|.*$", "\n".join(RESULTS.values()), re.MULTILINE)
    assert {claim.key for claim in CLAIMS} <= {line.split(" | ")[0].removeprefix("| ") for line in lines}
    assert len(lines) > 60
    assert [line for line in lines if line not in published] == []


def test_real_cameras_shown_are_those_of_the_study() -> None:
    text = section(RESULTS["results-correction.md"], "Cameras with lens")
    published = (ROOT / "results" / "real" / "README.md").read_text("utf-8")
    shown = re.findall(r"^(\| [a-z-]+, (?:mild|aggressive) .*)\|$", text, re.MULTILINE)
    assert len(shown) == 8 and all(line in published for line in shown)
    assert max(float(row["sigmas"]) for row in results("real/summary.csv")) < 4.0, "64 of 64"


def test_the_cost_of_a_wrong_motion_model_is_that_of_the_sweep() -> None:
    sweep = {
        (row["variant"], row["value"], row["solver"]): float(row["e_T_median"])
        for row in results("sweeps/wrong-motion.csv")
    }
    header, _, *body = rows(section(RESULTS["results-solvers.md"], "A wrong motion model"))
    solvers = [cell.strip("`") for cell in header[2:]]
    shown = {(data, value, s): float(e) for data, value, *es in body for s, e in zip(solvers, es, strict=True)}
    assert shown.keys() == sweep.keys()
    assert all(shown[key] == float(f"{sweep[key]:.2g}") for key in sweep)


def test_the_cost_of_estimated_motion_is_that_of_the_study() -> None:
    """At most 0.03 dB in any view on covered pixels, 0.16 dB on all."""
    views = {
        (v["stratum"], v["sequence"], v["side"], v["frame"], v["method"]): v
        for v in results("correction/views.csv")
    }
    for column, figure in (("psnr_covered", "0.03 dB"), ("psnr_all", "0.16 dB")):
        worst = max(
            float(view[column]) - float(views[*key[:4], "ours"][column])
            for key, view in views.items()
            if key[4] == "true-motion"
        )
        assert f"{worst:.2f} dB" == figure
        assert f"at most {figure}" in " ".join(RESULTS["results-correction.md"].split())


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
    text = " ".join(section(RESULTS["results-paper.md"], "Corrected images").split())
    assert f"ten RANSAC seeds have {bounds} on the pixels that have a depth" in text
    assert f"uncorrected frame has {statistics.mean(before):.1f} dB" in text
    assert bounds in " ".join((DOCS / "report.md").read_text("utf-8").split())


def test_corrections_shown_are_those_of_the_study() -> None:
    """Covered / all PSNR, and the interval of what ours gains on the covered pixels, of each stratum."""
    summary = {(row["stratum"], row["method"]): row for row in results("correction/summary.csv")}
    keys = {method.title: method.key for method in METHODS}
    shown = rows(section(RESULTS["results-correction.md"], "Correction against"))[2:]
    assert len(shown) > 5
    for title, *cells in shown:
        key = keys[title.removesuffix(" (oracle)").strip("*")]
        for stratum, cell in zip(("mild", "moderate", "aggressive"), cells, strict=True):
            row = summary[stratum, key]
            expected = f"{float(row['psnr_covered']):.1f} / {float(row['psnr_all']):.1f}"
            if key != "ours":
                low, high = (round(float(row[f"gain_{end}"]), 1) + 0.0 for end in ("low", "high"))  # no -0.0
                expected += f" [{low:.1f}, {high:.1f}]"
            assert cell == expected, (title, stratum)


def test_results_tell_the_bound_and_rows_of_the_committed_board() -> None:
    tables = {
        path.name.removesuffix(".md"): path.read_text("utf-8").splitlines()
        for folder in ("leaderboard", "laws", "footage")
        for path in (ROOT / "results" / folder / "site").glob("*.md")
    }

    def table(start: str) -> list[str]:
        (found,) = (lines for name, lines in tables.items() if name.startswith(start))
        return found

    page = RESULTS["results-leaderboard.md"]
    words = " ".join(page.split())
    for protocol, score, column in (("points-1--", "an AUC@5", 3), ("points-2--", "a `near bound`", 4)):
        bound = next(line for line in table(protocol) if line.startswith("| cramer-rao"))
        assert f"reach {score} of {bound.split(' | ')[column]}." in words
    ranked = [each for each in page.split("\n\n") if " rank |" in each.partition("\n")[0]]
    shown = [each.splitlines() for each in ranked]
    boards = (
        *("points-2--", "pose-2--", "readout-3--", "correction-3--"),
        *("points-1--", "pose-1--", "depth-1--", "correction-1--"),
        *("correction-mono-1--footage", "correction-mono-1--standard"),
    )
    for lines, board in zip(shown, boards, strict=True):
        assert set(lines) <= set(table(board)) and len(lines) > 5
