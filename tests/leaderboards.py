"""Small splits and predictions for the tests of the leaderboard."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from commands import run_here

from rsbench.benchmark.leaderboard.board import Scored, add, entries_of
from rsbench.benchmark.leaderboard.submissions import read_submission, truth_text, write_oracles
from rsbench.benchmark.leaderboard.track import Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter

Line = dict[str, Any]


def small_split(problems: int = 12) -> Split:
    """The first problems of the public split of points."""
    split = TRACKS["points"].split(None)
    return replace(split, truths=split.truths[:problems])


def truth_lines(split: Split) -> list[Line]:
    """The truth as a submission: header and answers."""
    return [json.loads(line) for line in truth_text(split).splitlines()]


def write(path: Path, lines: Iterable[Mapping[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")
    return path


def named(lines: list[Line], method: str, uses: tuple[str, ...] = ("left",)) -> list[Line]:
    """The same predictions by another method."""
    return [{**lines[0], "method": method, "uses": uses}, *lines[1:]]


def scores_of(split: Split, predictions: Path | Iterable[Line], folder: Path = Path()) -> pd.DataFrame:
    """Scores of a file of predictions, or of lines, which are written into ``folder``."""
    path = predictions if isinstance(predictions, Path) else write(folder / "scored.jsonl", predictions)
    return mark(read_submission(path, split), split)


def oracle_scores(split: Split, folder: Path) -> dict[str, pd.DataFrame]:
    """Scores of the oracles of a split, whose predictions are written into ``folder``."""
    return {path.parent.name: scores_of(split, path) for path in write_oracles(split, folder)}


def leaderboard(*words: object) -> str:
    """What ``rsbench leaderboard`` prints where it succeeds."""
    ran = run_here("leaderboard", *words)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def run_entries(track: str, entries: Iterable[object], *where: object) -> str:
    """``rsbench leaderboard run`` of some entries."""
    return leaderboard("run", track, *where, *(word for entry in entries for word in ("--entry", entry)))


def handed_in(board: Path, lines: Iterable[Line], split: Split, command: str = "", **options: Any) -> Scored:
    """The entry that lines become on a board."""
    return add(board, write(board.with_suffix(".jsonl"), lines), split, {"command": command}, **options)


def entered(board: Path, split: Split) -> dict[str, Scored]:
    """The entries of a board by the names of their methods."""
    return {entry.header.method: entry for entry in entries_of(board, split.track.id, split.name)}


def erring(lines: Iterable[Line], w: float, d: float, seed: int = 0) -> list[Line]:
    """Answers with normal errors of these deviations of w and d: an exact one would be in doubt."""
    random, answers = np.random.default_rng(seed), list[Line]()
    for line in lines:
        errors = random.standard_normal((2, 3)) * [[w], [d]]
        wrong = {name: (np.array(line[name]) + error).tolist() for name, error in zip("wd", errors, strict=True)}
        answers.append({**line, **wrong})
    return answers


_RIG = StereoRig(camera=PinholeCamera.centred(96, 80, 110.0), baseline=0.3)
_SHUTTER = RollingShutter(height=80, readout_ratio=0.9)
_MOTION = LinearMotion(np.array([0.01, 0.02, -0.01]), np.array([0.1, -0.05, 0.08]))
PLANES = _RIG, _SHUTTER, _MOTION
ASK_PICTURES = ("depth", "correction")


def jobs_here(serve: Any, jobs: Any, workers: int, environment: object, *arguments: object) -> Any:
    """``finished_jobs`` without a child."""
    run = serve(*arguments)
    yield from ((job, run(job)) for job in jobs)


def lines_of(path: Path) -> list[Line]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def pictures_of(path: Path) -> list[Path]:
    return sorted(p for p in (path.parent / "pictures").rglob("*") if p.is_file())


def files_below(folder: Path) -> dict[str, bytes]:
    """All files, large ones by their size."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and not p.is_symlink()]
    return {
        str(p): p.read_bytes() if p.stat().st_size < 1 << 24 else str(p.stat().st_size).encode() for p in files
    }
