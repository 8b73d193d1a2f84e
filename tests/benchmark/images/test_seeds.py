"""Runs of one solver with other samples: made in child processes, scored one by one, told by their quartiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.images.evaluation import open_evaluation, read_scores
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.benchmark.statistics import median_and_quartiles
from rsbench.components.seeds import generator
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import read_sequence
from rsbench.report.evaluation_page import summary_tables
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.storage.files import load_matches, read_json

SOLVER = "rs-stereo-linear"
"""Its answer depends on the samples most."""
QUICK = EvaluationOptions(solvers=(SOLVER,), only=("castle", SOLVER), seeds=3)


def test_each_seed_is_a_run_of_its_own_and_a_row(smoke_dataset: Path, tmp_path: Path) -> None:
    steps: list[str] = []
    evaluation = open_evaluation(smoke_dataset, tmp_path, QUICK)
    evaluation.run("test", steps.append)
    assert len(steps) == evaluation.steps
    pose = read_scores(tmp_path, "pose")
    assert list(pose["seed"]) == [0, 1, 2]

    sequence, folder = read_sequence(smoke_dataset / "castle"), tmp_path / "predictions" / "castle"
    given = load_matches(folder / "matches.npz"), sequence.rig, sequence.shutter, load_solver(SOLVER)
    for seed, name in enumerate(("motion", "seeds/1", "seeds/2")):
        rng = generator(0, "images", "castle", SOLVER, seed)
        stored = read_json(folder / name / f"{SOLVER}.json")
        # The children sum with one thread.
        np.testing.assert_allclose(
            stored["w"], estimate_motion(*given, RobustOptions(), rng).estimate.w, rtol=1e-6
        )

    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.json")}
    open_evaluation(smoke_dataset, tmp_path, QUICK).run("test", lambda word: None)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.json")} == before

    table = summary_tables(tmp_path)[0]
    (row,) = table.brief.to_dict("records")
    assert (row["runs"], row["failures"]) == (3, 0)
    assert row["e_R (deg)"] == median_and_quartiles(pose["e_R_deg"])
    assert "lower quartile" in table.note


def test_no_run_is_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="--seeds 0: must be at least 1"):
        open_evaluation(smoke_dataset, tmp_path / "out", EvaluationOptions(solvers=("gs-8pt",), seeds=0))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([5.7, 160.4, 10.0, 8.2, 9.1], "9.1 [8.2, 10.0]"),
        ([0.00024161, 0.00024163, 0.0002417], "0.000242"),  # no more than three digits
        ([0.0241, 0.0312, 0.0279, 0.0255, 0.0290], "0.0279 [0.0255, 0.0290]"),
        ([44.21, 12.02, 45.93, 48.17, 160.1], "45.9 [44.2, 48.2]"),
        ([1.0, 180.0, 180.0, 180.0, 180.0], "180"),
        ([0.3, 0.4, 0.5, np.inf], "0.45 [0.30, 0.50]"),  # of an even number the mean of the two in the middle
        ([0.3, 0.5, np.inf, np.inf], "inf"),
        ([np.inf, np.inf], "inf"),
        ([np.nan], "–"),
        ([0.0, 0.0], "0.00"),
    ],
)
def test_quartiles_have_the_digits_that_their_distance_allows(values: list[float], text: str) -> None:
    assert median_and_quartiles(pd.Series(values)) == text
