"""How far a found motion is off an even one, and what the page says of it, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.capture.trajectory_spline import ContinuousMotion, approximated
from rsbench.components.motion_models import make_motion
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray, exp
from rsbench.pipeline.frame_motion import FoundMotion
from rsbench.report.corrected_page import draw_own_motion, draw_trajectory
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import RobustEstimate

W, V = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.0, 0.05])
SHAKE_RAD, SHAKE_M = 0.003, 0.004


def _shaken(tau: FloatArray) -> Pose:
    """Even, and half a sine about and along y within every period."""
    half = np.sin(np.pi * tau)[:, None] * [0.0, 1.0, 0.0]
    R = exp(SHAKE_RAD * half) @ exp(tau[:, None] * W)
    place = tau[:, None] * V + SHAKE_M * half
    return Pose(R, -(R @ place[..., None])[..., 0])


def _found(motion: Any) -> FoundMotion:
    estimate = MotionEstimate(w=motion.w, d=motion.d, success=True, metric=True)
    robust = RobustEstimate(estimate=estimate, iterations=0, seconds=0.0, threshold_px=0.0)
    return FoundMotion(motion=motion, robust=robust, solver="", reference_point="body")


def test_half_a_sine_is_off_by_its_root_mean_square() -> None:
    motion = ContinuousMotion.of(approximated(_shaken, (0.0, 1.5), 0.05))
    turned, shifted = _found(motion).unevenness
    # The mean of a squared sine is a half; 33 moments with both ends make it 16 of 33.
    assert turned == pytest.approx(SHAKE_RAD * np.sqrt(16 / 33), rel=1e-3)
    assert shifted == pytest.approx(SHAKE_M * np.sqrt(16 / 33), rel=1e-3)


def test_a_coasting_body_is_even() -> None:
    d = -exp(W) @ V
    turned, shifted = _found(make_motion("inertial", W, d)).unevenness
    assert turned < 1e-12 and shifted < 1e-12


@pytest.mark.parametrize(
    ("moved", "uneven", "said"),
    [(0.0005, 0.0, "stands still"), (0.02, 0.0005, "coasts"), (0.02, 0.002, "shakes or changes its speed")],
)
def test_the_page_names_what_the_deviations_tell(moved: float, uneven: float, said: str) -> None:
    """Deviations of 0.0003 rad and m: three of them are between the last two."""
    motion = {
        "covariance_w_d": (0.0003**2 * np.eye(6)).tolist(),
        "rotation_deg": np.rad2deg(moved),
        "translation": moved,
        "uneven": {"rotation_deg": np.rad2deg(uneven), "translation": uneven},
    }
    poses = np.array([[k, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for k in range(4)])
    drawn = draw_trajectory(poses, [{"number": k, "motion": motion} for k in range(4)])
    assert drawn is not None and f"The rig {said}" in drawn["caption"]


def test_the_page_draws_how_one_camera_turns_and_where_it_moves() -> None:
    """Frame 2 has no motion and is grey; a translation has a direction alone."""
    frames: list[dict[str, Any]] = [
        {"number": k, "motion": {"w": [0.0, np.deg2rad(0.5 * k), 0.0], "d": [0.0, 0.0, 3.0]}} for k in range(5)
    ]
    assert draw_own_motion(frames[:1]) is None and draw_own_motion([{"number": 0, "reason": "still"}] * 3) is None
    frames[2] = {"number": 2, "reason": "too dark"}
    drawn = draw_own_motion(frames)
    assert drawn is not None and "not how far" in drawn["caption"] and "Grey" in drawn["caption"]
    rotation, direction = drawn["drawings"]
    assert rotation.count("<rect") == 1 and rotation.count("<polyline") == 3
    assert ">2</text>" in rotation  # deg, the largest; directions end at 1
    assert ">1</text>" in direction and ">3</text>" not in direction
