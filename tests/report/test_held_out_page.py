"""The page of public and held-out splits, against SciPy and the committed table."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
from documents import ROOT, rows
from scipy.stats import ttest_ind

from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import format_interval
from rsbench.dataset.secret_split import read_secret
from rsbench.report.points_pages import DEV, OURS, TEST, difference, held_out_page

FOLDER = ROOT / "results/held-out"
ANNOUNCED = json.loads((FOLDER / "announced.json").read_text("utf-8"))


def test_the_interval_of_a_difference_is_welch_s() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(0.5, 0.1, 40), rng.normal(0.6, 0.3, 25)
    found = difference(first, second)
    expected = ttest_ind(second, first, equal_var=False).confidence_interval(0.95)
    np.testing.assert_allclose(found, [second.mean() - first.mean(), *expected], rtol=1e-12)


def test_the_revealed_text_draws_what_was_announced() -> None:
    seed_file = FOLDER / "seed.txt"
    assert read_secret(seed_file).commitment == ANNOUNCED["commitment"]
    for protocol, announced in ANNOUNCED["splits"].items():
        split = track_of_id(protocol).split(None, seed_file)
        assert (split.name, split.fingerprint) == (announced["split"], announced["fingerprint"])


def test_the_committed_page_is_that_of_the_committed_table() -> None:
    table = pd.read_csv(FOLDER / "scores.csv")
    assert list(table["protocol"].unique()) == list(ANNOUNCED["splits"])
    assert held_out_page(table, ANNOUNCED) == (FOLDER / "README.md").read_text("utf-8")
    for split in (DEV, TEST):
        assert (table[f"{split}_score"].between(table[f"{split}_score_low"], table[f"{split}_score_high"])).all()
    assert set(table["code"].map(lambda code: code == OURS)) == {True, False}


def test_the_pages_of_the_site_show_lines_of_it() -> None:
    published = set((FOLDER / "README.md").read_text("utf-8").splitlines())
    for name, least in (("results-held-out.md", 40), ("explanation/public-implementations.md", 8)):
        text = (ROOT / "docs" / name).read_text("utf-8").partition("## Solver by solver")[0]
        shown = [line for line in text.splitlines() if line.startswith("| ") and line.count("[0.") >= 2]
        assert len(shown) >= least and [line for line in shown if line not in published] == []


def test_the_summary_counts_the_differences() -> None:
    table = pd.read_csv(FOLDER / "scores.csv")
    apart = table[(table["difference_low"] > 0.0) | (table["difference_high"] < 0.0)]
    words = " ".join((ROOT / "docs/results-held-out.md").read_text("utf-8").split())
    assert f"Of {len(table)} differences between held-out and public scores one excludes zero" in words
    assert list(zip(apart["protocol"], apart["method"], strict=True)) == [("points-2", "gs-8pt")]
    for protocol, first in (
        ("points-2", "rs-stereo-auto"),
        ("points-recorded-1", "rs-stereo-auto"),
        ("points-1", "rs-stereo-refined"),
    ):
        row = table[(table["protocol"] == protocol) & (table["method"] == first)].iloc[0]
        assert (row["test_rank"], row["test_rank_high"]) == (1, 1)
        score = format_interval(*(row[f"test_score{end}"] for end in ("", "_low", "_high")))
        assert f"({score})" in words


_NOT_ALONE = ("points-1--dev-f88c896f", "points-recorded-1--dev-0bc59642")


def test_the_page_of_public_code_says_which_entry_is_better() -> None:
    """By the boards with all entries of ours: alone on the first place of its input, but on two public ones."""
    for path in (FOLDER / "tables").glob("*.md"):
        (row,) = (row for row in rows(path.read_text("utf-8")) if row[0] == r"poselib\_rig")
        assert ("1 [1, 1] of 6" in row) == (path.stem not in _NOT_ALONE), path
