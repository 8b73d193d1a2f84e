"""Sequences evaluated in child processes: the same files, hashes and progress, whatever dies."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from evaluations import KEPT, QUICK, contents

from rsbench.benchmark.images.evaluation import open_evaluation, read_scores
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.dataset.sequence import read_dataset

DEADLY = """
import os, signal
from pathlib import Path
from rsbench.benchmark.scoring import Column, PoseMetric


class Deadly(PoseMetric):
    columns = (Column(name="alive", better="higher", worst=0.0),)

    def __init__(self, test, mark):
        self.test, self.mark = test, Path(mark)

    def compute(self, case):
        # Once, the process that asks; not that of the test.
        if os.getppid() != self.test and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getppid(), signal.SIGKILL)
        return {"alive": 1.0}
"""


def scored(
    dataset: Path, evaluated: Path, out: Path, workers: int, options: EvaluationOptions
) -> dict[str, bytes]:
    """What is in a copy of an evaluation that was evaluated again."""
    shutil.copytree(evaluated, out)
    steps: list[str] = []
    evaluation = open_evaluation(dataset, out, options)
    assert evaluation.run("test", steps.append, workers) == []
    assert len(steps) == evaluation.steps
    return contents(out)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_scores_are_made_where_a_death_costs_nothing(smoke_dataset: Path, evaluated: Path, tmp_path: Path) -> None:
    mark, card = tmp_path / "killed", tmp_path / "deadly.toml"
    (tmp_path / "deadly_plugin.py").write_text(DEADLY)
    card.write_text(f'class = "deadly_plugin:Deadly"\n[parameters]\ntest = {os.getpid()}\nmark = "{mark}"\n')
    options = replace(QUICK, metrics=(str(card),))
    one = scored(smoke_dataset, evaluated, tmp_path / "one", 1, options)
    assert not mark.exists()
    two = scored(smoke_dataset, evaluated, tmp_path / "two", 2, options)
    assert mark.exists()
    assert set(read_scores(tmp_path / "two", "pose")["alive"]) == {1.0}
    assert one == two


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 2])
def test_all_is_scored_and_hashes_of_what_children_read_are_kept(
    smoke_dataset: Path, evaluated: Path, tmp_path: Path, seeds: int
) -> None:
    last = read_dataset(smoke_dataset)[-1].name
    options = replace(QUICK, only=(last, "gs-8pt"), force=True, seeds=seeds, rehash=True)
    found = []
    for workers in (1, 2):
        out = tmp_path / str(workers)
        files = scored(smoke_dataset, evaluated, out, workers, options)
        found.append((files, set((out / KEPT).read_text().split("\n"))))
    assert found[0] == found[1]
