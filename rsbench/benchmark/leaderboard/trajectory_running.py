"""Running the methods of the track ``trajectory`` on exported inputs: each sequence is a job, kept when done."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.benchmark.leaderboard.running import jobs_done, read_inputs
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import submission_text
from rsbench.benchmark.leaderboard.track import Limits, Track
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.benchmark.trajectory_methods import METHODS, Estimate, Given
from rsbench.benchmark.trajectory_scores import LINES, scored_times
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.jobs.isolation import use_one_thread
from rsbench.jobs.workers import Workers
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.warm_up import warm_up
from rsbench.storage.files import sha256, write_bytes, write_json

_MOST_POSES = 500
"""Of an answer: a line of a file of answers has its length."""
APART = 1e-5
"""Frame periods, at least, between two poses of an answer: rows are farther apart, and a spline through nearer
ones may go anywhere."""


class _Job(NamedTuple):
    method: str
    name: str
    path: Path

    def __str__(self) -> str:
        return f"{self.method}, {self.name}"


def answer_of(estimate: Estimate, shutter: RollingShutter, frames: int) -> dict[str, Any]:
    """A trajectory as an answer: poses at lines of all frames of the left camera.

    Raises:
        RsbenchError: it is not known throughout.
    """
    lines = min(max(_MOST_POSES // frames, 2), LINES)
    rows = list[FloatArray]()
    for frame in range(frames):
        tau = scored_times(shutter, frame, lines) if shutter.readout_ratio > 0.0 else np.array([float(frame)])
        R, t = inverse(compose(estimate.within(frame, tau), estimate.start(frame)))
        if not (np.all(np.isfinite(R)) and np.all(np.isfinite(t))):
            raise RsbenchError(f"no motion from frame {frame} on: {estimate.failed} windows have none")
        rows.append(np.concatenate([tau[:, None], t, so3.quaternion(R)[:, [1, 2, 3, 0]]], axis=1))
    found = np.concatenate(rows)
    found = found[np.append(True, np.diff(found[:, 0]) > APART)]
    return {"poses": np.round(found, 10).tolist(), "metric": estimate.positions}


def run_methods(
    track: Track,
    names: Sequence[str],
    split: Split,
    inputs: Path,
    work: Path,
    *,
    workers: Workers = 1,
    limits: Limits = Limits(),  # noqa: B008  it is a constant
    step: Callable[[str], None] = lambda word: None,
) -> list[Path]:
    """Run methods of ours on exported inputs; returns for each a file of predictions in ``work``.

    Raises:
        RsbenchError: no such method; processes died each time over the same problem: what is done is kept.
    """
    track.load(names)
    data, jobs, paths = sha256(inputs / "problems.jsonl"), list[_Job](), dict[str, list[Path]]()
    for name in names:
        identity = identity_of(
            source=numeric_version(), method=name, protocol=track.id, data=data, limits=list(limits)
        )
        paths[name] = [work / name / f"{identity[:16]}-{truth.name}.json" for truth in split.truths]
        for truth, path in zip(split.truths, paths[name], strict=True):
            if read_record(path) is None:
                jobs.append(_Job(name, truth.name, path))
            else:
                step(name)

    def fail(job: _Job, reason: str) -> None:
        job.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(job.path, {"name": job.name, "success": False, "reason": reason})

    for job in jobs_done(partial(_serve, track), jobs, workers, inputs, limits, fail):
        step(job.method)
    return [_joined(name, split, work, paths[name]) for name in names]


def _joined(name: str, split: Split, work: Path, paths: Sequence[Path]) -> Path:
    method = METHODS[name]
    header = {
        "protocol": split.track.id,
        "split": split.name,
        "method": name,
        "uses": method.uses,
        "description": method.description,
        "code": "rsbench",
        "hardware": f"{processor()}, 1 thread"[:300],
        "motion_model": method.motion_model,
    }
    answers = (read_record(path) or {} for path in paths)
    write_bytes(work / name / "predictions.jsonl", submission_text(header, answers).encode())
    return work / name / "predictions.jsonl"


def _serve(track: Track, inputs: Path, limits: Limits) -> Callable[[_Job], None]:
    use_one_thread()
    warm_up()
    windows = read_inputs(inputs, track)
    sequences = {
        name: list(each) for name, each in groupby(windows, lambda window: window.name.rpartition(".")[0])
    }

    def run(job: _Job) -> None:
        try:
            answer = _solve(job, sequences[job.name])
        except (RsbenchError, ValueError, ArithmeticError) as error:  # such as matches that determine nothing
            answer = {"success": False, "reason": " ".join(str(error).split())[:300]}
        job.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(job.path, {"name": job.name, **answer})

    return run


def _solve(job: _Job, windows: Sequence[Problem]) -> dict[str, Any]:
    first = windows[0]
    gyro = first.correspondences.gyro
    seed = int.from_bytes(hashlib.sha256(f"leaderboard {job.name} {job.method}".encode()).digest()[:4], "big")
    given = Given(
        rig=first.rig,
        shutter=first.shutter,
        matches=[replace(each.correspondences, gyro=np.zeros((0, 4))) for each in windows],
        gyro=gyro if len(gyro) else None,
        seed=seed,
    )
    began = time.perf_counter()
    estimate = METHODS[job.method].solve(given)
    seconds = round(time.perf_counter() - began, 4)
    if estimate is None:
        return {"success": False, "reason": "the dataset has no gyroscope (channel imu)", "seconds": seconds}
    return {**answer_of(estimate, first.shutter, len(windows) + 1), "seconds": seconds}
