"""Trials of one cell of a sweep: simulate matches, run each solver on those that it uses, and return its answers
with the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.simulated.bound import Bound, bound_from_root, bound_of_one_camera, joined, motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, simulate
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.components.seeds import generator
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.errors import naming
from rsbench.core.so3 import FloatArray
from rsbench.jobs.isolation import EntryFailure
from rsbench.pipeline.isolated_components import GuardedSolver, SolverRunner
from rsbench.solvers.engine.base import BESIDE, MotionEstimate, Solver, SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions

Arrays = dict[str, NDArray[Any]]
Information = Literal["left pairs", "left and right pairs", "linked pairs", "tracks"]
"""Matches that a solver gets: matches over time of one or both cameras, with separate points; matches over time of
equal points in both cameras, with left-right matches; or tracks through all four images. The last two determine
metric depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entrant:
    """A solver and the kind of matches that it gets."""

    entry: SolverEntry
    information: Information

    @property
    def name(self) -> str:
        return self.entry.name

    @property
    def solver(self) -> Solver:
        return self.entry.solver


def enter(entry: SolverEntry) -> Entrant:
    """Return a solver and the kind of matches that it gets: the simplest one with all match sets that it uses.

    Raises:
        RsbenchError: another package's solver does not state how many matches it needs.
    """
    solver, needs = entry.solver, entry.solver.spec.needs
    probe = Correspondences(left=np.ones((50, 4)), right=np.ones((50, 4)), tracks=np.ones((50, 8)))
    with naming(f"solver {entry.name!r}: sample_sizes", EntryFailure):
        sizes = (solver if entry.built_in else GuardedSolver(solver)).sample_sizes(probe)
    if "tracks" in needs or sizes.get("tracks", 0) > 0:
        return Entrant(entry=entry, information="tracks")
    if "stereo" in needs:
        return Entrant(entry=entry, information="linked pairs")
    alone = needs - BESIDE.keys() == {"left"}
    return Entrant(entry=entry, information="left pairs" if alone else "left and right pairs")


def given_matches(simulation: Simulation, information: Information) -> Correspondences:
    """Select the simulated matches of the kind ``information``."""
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


def run_trials(
    setting: Setting,
    solvers: tuple[str, ...],
    seed: int,
    first: int,
    count: int,
    *,
    robust: bool,
    runner: SolverRunner,
) -> Arrays:
    """Run trials ``first`` to ``first + count - 1`` of a setting.

    The random numbers for scene, motion and noise of a trial depend only on its number and the seed, so that all
    solvers, values and sweeps share them as far as their settings allow. An error of another package's solver is a
    failure; an exception of one of rsbench's solvers is raised.

    Returns:
        ``w``, ``d`` (trials, 3), the truth; ``w_est``, ``d_est`` (trials, solvers, 3), ``success``, ``metric``,
            ``direction_known``, ``reason`` and ``seconds`` (trials, solvers).

    Raises:
        RsbenchError: a solver does not exist, or too few points are in view under the motion of the setting.
    """
    entrants = [enter(load_solver_entry(name)) for name in solvers]
    truth, seconds = list[tuple[FloatArray, FloatArray]](), list[list[float]]()
    answers: list[list[MotionEstimate]] = []
    for trial in range(first, first + count):
        simulation = _simulation(setting, entrants, seed, trial)
        truth.append((simulation.motion.w, simulation.motion.d))
        timed = [_timed(e, simulation, setting, seed, trial, robust, runner) for e in entrants]
        answers.append([estimate for estimate, _ in timed])
        seconds.append([duration for _, duration in timed])
    return {
        "w": np.array([w for w, _ in truth]),
        "d": np.array([d for _, d in truth]),
        "w_est": np.array([[a.w for a in row] for row in answers]),
        "d_est": np.array([[a.d for a in row] for row in answers]),
        "success": np.array([[a.success for a in row] for row in answers], dtype=np.bool_),
        "metric": np.array([[a.metric for a in row] for row in answers], dtype=np.bool_),
        "direction_known": np.array([[a.direction_known for a in row] for row in answers], dtype=np.bool_),
        "reason": np.array([[a.reason for a in row] for row in answers], dtype=np.str_),
        "seconds": np.array(seconds),
    }


def run_bounds(setting: Setting, solvers: tuple[str, ...], seed: int, first: int, count: int) -> Arrays:
    """Compute Cramer-Rao bounds of trials for a noise of 1 px, without outliers.

    Returns:
        ``rotation`` (trials, solvers, 3), ``direction`` (trials, solvers, 2) and ``scale`` (trials, solvers):
            smallest root mean square errors of an unbiased solver, along the principal axes of the rotation and
            of the direction of d (radians), and of the length of d (relative), for the matches that each solver
            gets; infinite if these do not determine the value.
    """
    entrants = [enter(load_solver_entry(name)) for name in solvers]
    rows = []
    for trial in range(first, first + count):
        simulation = _simulation(setting.exact(), entrants, seed, trial)
        found = _bounds(simulation, {e.information for e in entrants})
        rows.append([found[e.information] for e in entrants])
    return {
        "rotation": np.array([[bound.rotation_axes for bound in row] for row in rows]),
        "direction": np.array([[bound.direction_axes for bound in row] for row in rows]),
        "scale": np.array([[bound.scale for bound in row] for row in rows]),
    }


def _simulation(setting: Setting, entrants: list[Entrant], seed: int, trial: int) -> Simulation:
    tracks = any(e.information in ("linked pairs", "tracks") for e in entrants)
    motion = setting.motion(generator(seed, "simulate", "motion", trial))
    rng = generator(seed, "simulate", "scene", trial)
    with naming(f"trial {trial}"):
        return simulate(setting.rig(), setting.shutter(), motion, setting.options(tracks), rng)


def _bounds(simulation: Simulation, kinds: set[Information]) -> dict[Information, Bound]:
    """Return bounds for a noise of 1 px and the matches of each kind of input."""
    c, rig, motion = simulation.correspondences, simulation.rig, simulation.motion
    good = {name: getattr(c, name)[~simulation.outliers[name]] for name in ("left", "right", "tracks")}

    def of(name: str) -> Bound:
        return motion_bound(Correspondences(**{name: good[name]}), rig, simulation.shutter, motion, 1.0)

    found: dict[Information, Bound] = {}
    if "tracks" in kinds or "linked pairs" in kinds:
        found["tracks"] = found["linked pairs"] = of("tracks")
    if "left pairs" in kinds or "left and right pairs" in kinds:
        found["left pairs"] = bound_of_one_camera(good["left"], rig, simulation.shutter, motion, 1.0)
        if "left and right pairs" in kinds:
            both = joined(of("left").root, of("right").root)
            found["left and right pairs"] = bound_from_root(both, motion.w, motion.d)
    return found


def _timed(
    e: Entrant,
    simulation: Simulation,
    setting: Setting,
    seed: int,
    trial: int,
    robust: bool,
    runner: SolverRunner,
) -> tuple[MotionEstimate, float]:
    """Run a solver; return its answer and its processor time, seconds, which excludes other processes."""
    matches, rig, shutter = given_matches(simulation, e.information), setting.rig(), setting.given_shutter()
    sensed = {name: getattr(simulation.correspondences, name) for name in BESIDE if name in e.solver.spec.needs}
    matches = replace(matches, **sensed)
    if not robust:
        return runner.bare(e.entry, matches, rig, shutter)
    rng = generator(seed, "simulate", "robust", e.name, trial)
    start = time.process_time()
    answer = runner.robust(e.entry, matches, rig, shutter, RobustOptions(), rng)
    # For a solver in another process: wall-clock time of the robust loop there.
    seconds = time.process_time() - start if e.entry.built_in else answer.seconds
    return answer.estimate, seconds
