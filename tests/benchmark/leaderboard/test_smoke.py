"""The stored scores of the smoke run are those of today's code; what differs is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here

from rsbench.benchmark.leaderboard.smoke import differences, read_scores

STORED = Path(__file__).parents[3] / "results" / "leaderboard" / "smoke"
QUICK = ("rs-stereo-refined", "gs-poselib", "gs-stereo-tracks")
"""Of the least time; none of them takes another sample on another processor."""


@pytest.mark.skipif(not STORED.is_dir(), reason="needs the committed results")
def test_the_stored_scores_are_those_of_this_code() -> None:
    entries = [word for name in QUICK for word in ("--entry", name)]
    ran = run_here("leaderboard", "smoke", "--stored", STORED, "--problems", 2, *entries)
    assert ran.returncode == 0, ran.stdout
    assert ran.stdout.startswith("6 answers of 3 solvers, 0 differ from ")


def test_each_difference_is_named(tmp_path: Path) -> None:
    text = "method,problem,success,e_R_deg,e_T_deg,e_s,metres,e_row_deg,nees\n"
    rows = ["a,p000,True,0.5,2.0,,,0.6,\n", "a,p001,False,180,180,inf,inf,180,\n", "b,p000,True,1,1,1,1,1,6\n"]
    (tmp_path / "scores.csv").write_text(text + "".join(rows[:2]), "utf-8")
    stored = read_scores(tmp_path)
    (tmp_path / "scores.csv").write_text(text + "".join(rows), "utf-8")
    found = read_scores(tmp_path)
    assert list(differences(found, stored)) == ["b, p000: has no stored scores"]
    found.loc[0, "e_T_deg"], found.loc[1, "success"] = 2.0 * (1 + 1e-3), True
    found.loc[0, "e_R_deg"] = 0.5 * (1 + 1e-6)  # rounding
    assert list(differences(found.iloc[:2], stored)) == [
        "a, p000: e_T_deg = 2.002, stored 2",
        "a, p001: success = True, stored False",
    ]
    found.loc[0, "nees"] = np.inf
    assert "a, p000: nees = inf, stored nan" in differences(found, stored)


def test_without_stored_scores_nothing_runs(tmp_path: Path) -> None:
    assert_refused(run_here("leaderboard", "smoke", "--stored", tmp_path), "scores.csv")
    assert_refused(
        run_here("leaderboard", "smoke", "--write", "--stored", tmp_path, "--problems", 251, "--entry", "gs-8pt"),
        "--problems 251",
    )
