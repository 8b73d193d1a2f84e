"""docs/report.md: every figure in it is read from the results; what is left holds no digit but of settings."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from documents import ROOT, results

from rsbench.benchmark.studies.claims import CLAIMS

REPORT = (ROOT / "docs" / "report.md").read_text("utf-8")
TEXT = " ".join(REPORT.split())
SETTINGS = (
    *("release 1.0", "2020", "0.001 px", "0.81 px", "0.3 px, 100 matches", "rotation of 2 deg", "twist of 2 deg"),
    *("up to 5 deg", "AUC@5", "Figure 3", "Figure 4", "x86-64", "30 dB on the pixels"),
)
"""Sizes of experiments, names and years."""


def claims() -> Iterator[str]:
    """Verdicts (claim, matches, the literal and the best reading at both noises) as on the page of results, whose
    rows test_house holds to results/."""
    lines = (ROOT / "docs/results-paper.md").read_text("utf-8").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    rows = [row for row in cells if row[0] in {claim.key for claim in CLAIMS} and len(row) == 6]
    assert len(rows) == len(CLAIMS) == 13
    literal, best, _, best_noisy = (sum(row[k] == "holds" for row in rows) for k in range(2, 6))
    yield f"{literal} of 13 claims hold in the literal reading and {best} of 13 in the best one"
    yield f"{best_noisy} of 13 hold in the best reading"
    for row in rows:
        assert row[4:] == ["fails", "fails"] or "better than" not in row[0]


def medians() -> Iterator[str]:
    pose = [row for row in results("images/scores/pose.csv") if row["sequence"] == "castle"]

    def e_T(solver: str) -> float:
        found = [float(row["e_T_deg"]) for row in pose if row["solver"] == solver]
        assert len(found) == 20
        return float(np.median(found))

    linear, refined = e_T("rs-stereo-linear"), e_T("rs-stereo-refined")
    words = "over twenty seeds of its samples, on one frame pair,"
    yield f"{words} is {linear:.3g} deg, that of `rs-stereo-refined` {refined:.2g} deg"
    wrong = {
        row["solver"]: float(row["e_T_median"])
        for row in results("sweeps/wrong-motion.csv")
        if (row["variant"], float(row["value"])) == ("twist", 2.0)
    }
    own, twist, ignoring = (
        wrong[name] for name in ("rs-stereo-refined", "rs-stereo-refined-twist", "gs-stereo-tracks")
    )
    yield f"median e_T of {own:.2g} deg, worse than the {ignoring:.2g} deg"
    yield f"assumes a twist has {twist:.2g} deg"
    views = {
        tuple(row[key] for key in ("stratum", "sequence", "side", "frame", "method")): float(row["psnr_covered"])
        for row in results("correction/views.csv")
    }
    cost = max(value - views[(*key[:4], "ours")] for key, value in views.items() if key[4] == "true-motion")
    yield f"at most {cost:.2f} dB in any view"


def bounds() -> Iterator[str]:
    """The solver's table: published lines."""
    page = (ROOT / "results/sweeps/README.md").read_text("utf-8").splitlines()
    found = [line for line in REPORT.splitlines() if re.match(r"\| [gr]s-", line)]
    assert len(found) == 4 and set(found) <= set(page)
    yield from found


def cameras() -> Iterator[str]:
    boards = [next((ROOT / "results/leaderboard/site").glob(f"{name}-1--*.csv")) for name in ("points", "pose")]
    rows = [{row["method"]: row for row in results(f"leaderboard/site/{board.name}")} for board in boards]
    shown = re.findall(r"^\| .*: `(.*?)` \| (.*) \| (.*) \|$", REPORT, re.MULTILINE)
    assert len(shown) == 4
    for method, *cells in shown:
        for cell, board in zip(cells, rows, strict=True):
            value, low, high = (float(board[method][f"auc_5{end}"]) for end in ("", "_low", "_high"))
            digits = 3 if high - low < 0.06 else 2
            assert cell == f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]", method
            yield cell
    gains = []
    for board in rows:
        pairs, mono = (board[name] for name in ("rs-stereo-refined-pairs", "rs-mono-refined"))
        gains.append(float(pairs["auc_5"]) - float(mono["auc_5"]))
    yield "{:.2f} on simulated points, which the paired test finds significant, and {:.2f} on images".format(
        *gains
    )
    laws = [next((ROOT / "results/laws/site").glob(f"{name}-2--*.csv")) for name in ("points", "pose")]
    rows += [{row["method"]: row for row in results(f"laws/site/{board.name}")} for board in laws]
    tied = ["rs-mono-refined" in board["rs-stereo-refined-pairs"]["ties"].split() for board in rows]
    assert tied == [False, True, False, True], "significant on points, not on images"


def ranks() -> Iterator[str]:
    """Of the default and of the solver that assumes `linear`, under several motion models."""
    words = {
        "4": "fourth of 27, and ranks {} to {} are not excluded",
        "5": "fifth, with ranks {} to {} not excluded",
    }
    for name in ("points", "pose"):
        (board,) = (ROOT / "results/laws/site").glob(f"{name}-2--*.csv")
        table = {row["method"]: row for row in results(f"laws/site/{board.name}")}
        assert [table["rs-stereo-auto"][f"rank{end}"] for end in ("", "_low", "_high")] == ["1", "1", "1"]
        refined = table["rs-stereo-refined"]
        assert refined["peers"] == "27"
        yield words[refined["rank"]].format(refined["rank_low"], refined["rank_high"])


def literal() -> Iterator[str]:
    """Of the paper's own solver, matches and view: the means of the views of each seed, from the least on."""
    seeds: dict[str, list[float]] = {}
    for row in results("fig4/literal.csv"):
        seeds.setdefault(row["ransac_seed"], []).append(float(row["psnr_drawn"]))
    means = [float(np.mean(views)) for views in seeds.values()]
    yield f"{min(means):.1f} to {max(means):.1f} dB"


def corrections() -> Iterator[str]:
    (board,) = (ROOT / "results/laws/site").glob("correction-3--*.csv")
    table = {row["method"]: row for row in results(f"laws/site/{board.name}")}
    one, two = (float(table[name]["corrected"]) for name in ("mono-fusion", "fusion"))
    assert "mono-fusion" in table["fusion"]["ties"].split()
    yield f"scores {one:.2f} and `fusion`, with two cameras, {two:.2f}, which is not a significant difference"


def test_every_figure_of_the_report_is_one_of_the_results() -> None:
    left = TEXT
    facts = [*claims(), *medians(), *bounds(), *cameras(), *ranks(), *literal(), *corrections()]
    for fact in facts:
        assert fact in TEXT, fact
        left = left.replace(fact, " ")
    left = re.sub(r"\]\(.*?\)", "]", re.sub(r"!\[.*?\]\(.*?\)", "", left))
    for words in SETTINGS:
        assert words in TEXT, words
        left = left.replace(words, " ")
    assert re.findall(r".{0,20}\d+.{0,20}", left) == []


def test_the_report_has_four_pages_at_most() -> None:
    """A page has some 500 words where it has a table or a figure too."""
    assert len(TEXT.split()) < 4 * 500 and REPORT.count("![") == 3
