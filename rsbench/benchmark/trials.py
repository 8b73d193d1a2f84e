"""Trials of one cell of a sweep: simulate, let every solver see what it needs, keep its answer and the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulation import Simulation, simulate
from rsbench.benchmark.sweeps import Setting
from rsbench.core.correspondences import Correspondences
from rsbench.errors import RsbenchError
from rsbench.pipeline.motion import RobustOptions, estimate_motion
from rsbench.solvers.base import MotionEstimate, Solver
from rsbench.solvers.packed import track_pairs
from rsbench.solvers.registry import load_solver

Arrays = dict[str, NDArray[Any]]
Information = Literal["left pairs", "left and right pairs", "linked pairs", "tracks"]
"""What a solver is given: matches over time of one or both cameras, of points of their own; the same points in
both cameras with their left-right matches; or tracks through all four images. The last two hold metric depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entrant:
    """A solver and the matches that it is given."""

    solver: Solver
    information: Information


def entrant(name_or_path: str) -> Entrant:
    """The solver of a card with the least information that it can use fully.

    Raises:
        RsbenchError: no such solver.
    """
    solver = load_solver(name_or_path)
    probe = Correspondences(left=np.ones((50, 4)), right=np.ones((50, 4)), tracks=np.ones((50, 8)))
    if "tracks" in solver.needs or solver.sample_sizes(probe).get("tracks", 0) > 0:
        return Entrant(solver=solver, information="tracks")
    if "stereo" in solver.needs:
        return Entrant(solver=solver, information="linked pairs")
    return Entrant(solver=solver, information="left pairs" if solver.needs == {"left"} else "left and right pairs")


def given_matches(simulation: Simulation, information: Information) -> Correspondences:
    """The part of the simulated matches that ``information`` names."""
    c = simulation.correspondences
    if information == "tracks":
        return Correspondences(tracks=c.tracks)
    if information == "linked pairs":
        return Correspondences(
            left=track_pairs(c.tracks, "left"),
            right=track_pairs(c.tracks, "right"),
            stereo_0=c.tracks[:, :4],
            stereo_1=c.tracks[:, 4:],
        )
    return Correspondences(left=c.left, right=c.right if information == "left and right pairs" else c.right[:0])


class Trials(NamedTuple):
    """Answers of all solvers to some trials of a cell."""

    predictions: Arrays
    """``w``, ``d`` (trials, 3): the truth; ``w_est``, ``d_est`` (trials, solvers, 3), ``success``, ``metric``,
    ``direction_known`` and ``reason`` (trials, solvers)."""
    seconds: NDArray[np.float64]
    """(trials, solvers); apart, because no two runs agree on them."""


def run_trials(
    setting: Setting, solvers: tuple[str, ...], seed: int, first: int, count: int, robust: bool
) -> Trials:
    """Trials ``first`` to ``first + count - 1`` of a setting.

    A trial's scene, motion and noise depend on its number and the seed alone, so that all solvers, values and
    sweeps share them as far as their settings allow.

    Raises:
        RsbenchError: no such solver; the motion of the setting leaves too few points in view.
    """
    entrants = [entrant(name) for name in solvers]
    tracks = any(e.information in ("linked pairs", "tracks") for e in entrants)
    truth, answers, seconds = [], [], []
    for trial in range(first, first + count):
        motion = setting.motion(generator(seed, "simulate", "motion", trial))
        rng = generator(seed, "simulate", "scene", trial)
        try:
            simulation = simulate(setting.rig(), setting.shutter(), motion, setting.options(tracks), rng)
        except ValueError as error:
            raise RsbenchError(f"trial {trial}: {error}") from error
        truth.append((motion.w, motion.d))
        timed = [_timed(e, simulation, setting, seed, trial, robust) for e in entrants]
        answers.append([estimate for estimate, _ in timed])
        seconds.append([duration for _, duration in timed])
    predictions: Arrays = {
        "w": np.array([w for w, _ in truth]),
        "d": np.array([d for _, d in truth]),
        "w_est": np.array([[a.w for a in row] for row in answers]),
        "d_est": np.array([[a.d for a in row] for row in answers]),
        "success": np.array([[a.success for a in row] for row in answers], dtype=np.bool_),
        "metric": np.array([[a.metric for a in row] for row in answers], dtype=np.bool_),
        "direction_known": np.array([[a.direction_known for a in row] for row in answers], dtype=np.bool_),
        "reason": np.array([[a.reason for a in row] for row in answers], dtype=np.str_),
    }
    return Trials(predictions, np.array(seconds))


def _timed(
    e: Entrant, simulation: Simulation, setting: Setting, seed: int, trial: int, robust: bool
) -> tuple[MotionEstimate, float]:
    matches, rig, shutter = given_matches(simulation, e.information), setting.rig(), setting.told_shutter()
    start = time.perf_counter()
    try:
        if robust:
            rng = generator(seed, "simulate", "robust", e.solver.name, trial)
            estimate = estimate_motion(matches, rig, shutter, e.solver, RobustOptions(), rng).estimate
        else:
            estimate = e.solver.estimate(matches, rig, shutter)
    except Exception as error:  # a plug-in that breaks the contract must not end a run of hours
        estimate = MotionEstimate.failed(f"raised {type(error).__name__}: {error}")
    return estimate, time.perf_counter() - start
