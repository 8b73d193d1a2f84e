"""The law of motion of one camera. Truth: simulated matches under each law, and a focal length that is wrong."""

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_law import asked_for
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

SHUTTER = RollingShutter(height=480, readout_ratio=0.8)
RIG = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.4).about("left")


def matches_of(motion: Motion, rng: np.random.Generator) -> FloatArray:
    options = SimulationOptions(tracks=1000, noise_px=0.1, outlier_ratio=0.05)
    return temporal_pairs(simulate(RIG, SHUTTER, motion, options, rng).correspondences, "left")


def found_of(matches: FloatArray, rig: StereoRig, seed: int = 0) -> RobustEstimate:
    solver = RefinedSolver(motion_model="inertial", one_camera=True)
    given, rng = Correspondences(left=matches), np.random.default_rng(seed)
    return estimate_motion(given, rig, SHUTTER, solver, RobustOptions(), rng)


def turns_between(a: Motion, b: Motion) -> float:
    """Degrees, the largest at the times of rows."""
    tau = np.linspace(0.0, 1.8, 19)
    R, S = a.body_from_world(tau).R, b.body_from_world(tau).R
    trace = np.trace(R @ np.swapaxes(S, 1, 2), axis1=1, axis2=2)
    return float(np.rad2deg(np.max(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))))


@pytest.mark.parametrize("acceleration", [-0.3, 0.3])
def test_a_camera_that_accelerates_is_told(acceleration: float) -> None:
    """A law of constant speed leaves half a degree of a turn of 4; the points lie before the camera."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        true = make_motion("accelerated", 0.07 * w, 0.4 * d, {"acceleration": acceleration})
        matches = matches_of(true, rng)
        before = found_of(matches, RIG)
        robust, motion = asked_for(before, matches, RIG, SHUTTER, RobustOptions())
        assert motion.name == "accelerated" and robust.estimate.success
        constant = make_motion("inertial", before.estimate.w, before.estimate.d)
        assert turns_between(motion, true) < 0.2 * turns_between(constant, true)
        assert motion.d @ d > 0.99 * np.linalg.norm(motion.d)
        assert robust.inlier_count > 0.85 * robust.match_count == 0.85 * len(matches)


@pytest.mark.parametrize("model", ["linear", "twist", "inertial"])
def test_constant_speed_stays_constant_speed(model: str) -> None:
    """And rows turn as they did to a fiftieth of a degree, whichever of these laws is taken."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        true = make_motion(model, 0.07 * w, 0.4 * d)
        matches = matches_of(true, rng)
        motion = asked_for(found_of(matches, RIG), matches, RIG, SHUTTER, RobustOptions())[1]
        assert motion.name != "accelerated" and turns_between(motion, true) < 0.02 * 4.0


@pytest.mark.parametrize("focal", [440.0, 600.0])
def test_a_wrong_focal_length_is_not_taken_for_an_acceleration(focal: float) -> None:
    """Said to be a sixth shorter or longer than it is: an acceleration would take up some of the error."""
    wrong = StereoRig(camera=PinholeCamera.centred(640, 480, focal), baseline=0.4).about("left")
    for seed in range(4):
        rng = np.random.default_rng(seed)
        w, d = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
        matches = matches_of(make_motion("inertial", 0.03 * w, 0.4 * d), rng)
        motion = asked_for(found_of(matches, wrong), matches, wrong, SHUTTER, RobustOptions())[1]
        assert motion.name != "accelerated"
