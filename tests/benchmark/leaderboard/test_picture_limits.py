"""Limits of time and memory on the tracks depth and correction: who takes more fails alone, by name."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from commands import run_here
from leaderboards import ASK_PICTURES, lines_of

from rsbench.benchmark.leaderboard import running
from rsbench.benchmark.leaderboard.board import entries_of
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.jobs.isolation import Outcome

METHODS = """
import time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from rsbench.vision.corrector import Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import StereoMatcher

def misbehave(mood):
    "Once: the first problem alone."
    done = Path(__file__).with_name(f"{mood}.done")
    if mood == "sound" or done.exists():
        return
    done.touch()
    held = np.ones((1 << 17, 900 if mood == "hungry" else 1))
    time.sleep(1000.0)

@dataclass(frozen=True)
class Level(StereoMatcher):
    mood: str = "sound"

    def disparities(self, left, right, rig):
        misbehave(self.mood)
        return (np.full(left.shape[:2], 5.0),) * 2

@dataclass(frozen=True)
class Same(Corrector):
    mood: str = "sound"
    spec = CorrectorSpec(needs=set(), reference="this file", assumes="nothing")

    def correct(self, problem, views):
        misbehave(self.mood)
        seen = np.ones(problem.images["left", 0].shape[:2], bool)
        return {view: Fused.seen(problem.images[view], seen) for view in views}
"""
CLASSES = {"depth": "Level", "correction": "Same"}
MOODS = {
    "hanging": (("--time-limit", 2), "took longer than 2 s"),
    "hungry": (("--memory", 900), "used more than 900 MB of memory"),
}
"""The limit, and what is said. The hungry one uses 944 MB beside what it imports, and has time for it."""


def _here(
    serve: Any, jobs: Any, workers: int, environment: object, *arguments: object, seconds_of: Any, memory_mb: Any
) -> Any:
    """``run_jobs`` without a child of ours: that of the method is enough."""
    run = serve(*arguments)
    for job in jobs:
        assert seconds_of(job) == math.inf, "the start of the method's process is not in its time"
        yield job, Outcome(value=run(job), reason="", output="")


@pytest.mark.slow
@pytest.mark.parametrize("mood", MOODS)
@pytest.mark.parametrize("track", ASK_PICTURES)
def test_a_method_that_takes_too_much_fails_alone(
    track: str, mood: str, planes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first problem, in a process of the method's own, with the reason; the second is in order."""
    monkeypatch.setattr(running, "run_jobs", _here)
    limit, words = MOODS[mood]
    module = f"{mood}_{track}"
    (tmp_path / f"{module}.py").write_text(METHODS, "utf-8")
    card = tmp_path / f"{mood}.toml"
    card.write_text(
        f'class = "{module}:{CLASSES[track]}"\ntime_limit_s = 300\nparameters = {{ mood = "{mood}" }}\n', "utf-8"
    )
    where = ("--data", planes, "--board", tmp_path / "board")
    ran = run_here("leaderboard", "run", track, *where, "--entry", card, *limit)
    assert ran.returncode == 0, ran.stderr
    split = TRACKS[track].split(planes)
    (found,) = entries_of(tmp_path / "board", split.track.id, split.name)
    first, second = lines_of(found.folder / "predictions.jsonl")[1:]
    assert words in str(first["reason"]) and mood in str(first["reason"])
    assert "reason" not in second
    assert list(found.scores["failure"]) == [1.0, 0.0]
