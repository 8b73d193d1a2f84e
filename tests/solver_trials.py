"""The rig of the simulated experiments, motions of its size, and how far answers are off."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error, translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver, load_solver
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion

CAMERA = PinholeCamera.centred(900, 900, 810.0)
RIG = StereoRig(camera=CAMERA, baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)
W, D = np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18])


def matches_of(
    motion: Motion, *, seed: int = 0, rig: StereoRig = RIG, shutter: RollingShutter = SHUTTER, **options: Any
) -> Correspondences:
    """Simulated matches of a motion; ``options`` are those of ``SimulationOptions``."""
    chosen = SimulationOptions(**options)
    return simulate(rig, shutter, motion, chosen, np.random.default_rng(seed)).correspondences


def trial(
    seed: int | np.random.Generator,
    *,
    degrees: float = 2.0,
    metres: float = 0.3,
    model: str = "linear",
    rig: StereoRig = RIG,
    shutter: RollingShutter = SHUTTER,
    **options: Any,
) -> Simulation:
    """A random motion of these sizes and its matches; a generator draws one after the other."""
    motion = random_motion(np.random.default_rng(seed), np.radians(degrees), metres, model)
    return simulate(rig, shutter, motion, SimulationOptions(**options), np.random.default_rng(seed))


def robust(
    c: Correspondences,
    solver: Solver | str,
    *,
    rig: StereoRig = RIG,
    shutter: RollingShutter = SHUTTER,
    loop: Literal["ransac", "own"] = "ransac",
    seed: int | np.random.Generator = 0,
    **options: Any,
) -> RobustEstimate:
    """What the robust loop finds; ``options`` are those of ``RobustOptions``."""
    chosen = load_solver(solver) if isinstance(solver, str) else solver
    return estimate_motion(c, rig, shutter, chosen, RobustOptions(**options), np.random.default_rng(seed), loop)


def true_d(motion: Motion, point: str) -> FloatArray:
    """The translation (3,) of the body or of the left camera."""
    return motion.d if point == "body" else translation_of_offset(motion.w, motion.d, RIG.offset("left"))


def errors_deg(found: MotionEstimate, motion: Motion, point: str = "body") -> FloatArray:
    """Errors of the rotation and of the direction of the translation (2,), in degrees."""
    e_T = translation_error(found.d, true_d(motion, point))
    return np.degrees([float(rotation_error(found.w, motion.w)), float(e_T)])


def median_errors(solver: Solver, *, trials: int = 30, **options: Any) -> FloatArray:
    """Median errors (2,) in degrees over random trials, of the solver's own point; 180 where it fails."""
    errors, point = list[FloatArray](), solver.spec.reference_point
    for seed in range(trials):
        s = trial(np.random.default_rng(seed), **options)
        found = solver.estimate(s.correspondences, s.rig, s.shutter)
        errors.append(errors_deg(found, s.motion, point) if found.success else np.array([180.0, 180.0]))
    return np.median(errors, axis=0)


def errors_of_size(
    solver: Solver, size: float, *, seeds: int = 8, rig: StereoRig = RIG, **options: Any
) -> FloatArray:
    """Median errors (2,) in rad of a solver on exact matches of ``size`` times the motion (W, D)."""
    spec, errors = solver.spec, list[FloatArray]()
    motion = make_motion(spec.motion_model, size * W, size * D, spec.motion_parameters)
    for seed in range(seeds):
        found = solver.estimate(matches_of(motion, seed=seed, rig=rig, **options), rig, SHUTTER)
        assert found.success, found.reason
        errors.append(np.radians(errors_deg(found, motion)))
    return np.median(errors, axis=0)


def assert_second_order(solver: Solver, **options: Any) -> None:
    """Half the motion has a quarter of the rotation's error, and half of the direction's."""
    half, quarter = (errors_of_size(solver, size, **options) for size in (0.5, 0.25))
    np.testing.assert_allclose(half / quarter, [4.0, 2.0], rtol=0.25)


def assert_near(found: MotionEstimate, motion: Motion, e_R: float, e_T: float, point: str = "body") -> None:
    """A success whose rotation and direction are at most so many degrees off."""
    assert found.success, found.reason
    assert np.all(errors_deg(found, motion, point) < [e_R, e_T])
