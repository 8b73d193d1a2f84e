"""The stereo rig: the side a camera stands on, and the sign and size of the disparity."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.projection import project_at
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose, inverse

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 1384.6), baseline=0.2)


def test_the_left_camera_stands_half_a_baseline_to_the_left() -> None:
    still = LinearMotion(np.zeros(3), np.zeros(3))
    left, right = (inverse(Pose(*RIG.cam_from_world(still, 0.0, side))).t for side in SIDES)
    np.testing.assert_allclose(left, [-0.1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(right, [0.1, 0, 0], atol=1e-15)


@pytest.mark.parametrize("model", [LinearMotion, TwistMotion])
def test_cameras_of_one_time_are_a_rectified_pair(model: type[LinearMotion] | type[TwistMotion]) -> None:
    motion = model(np.array([0.02, -0.05, 0.03]), np.array([0.1, 0.2, -0.1]))
    points = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 9], size=(30, 3))
    left, right = (project_at(RIG, motion, side, 0.7, points) for side in SIDES)
    np.testing.assert_allclose(left[:, 1], right[:, 1], rtol=0, atol=1e-11)  # the same row
    np.testing.assert_allclose(left[:, 2], right[:, 2], rtol=1e-15)
    disparity = left[:, 0] - right[:, 0]
    np.testing.assert_allclose(disparity, 1384.6 * 0.2 / left[:, 2], rtol=1e-11)
    np.testing.assert_allclose(RIG.disparity(left[:, 2]), disparity, rtol=1e-11)
    np.testing.assert_allclose(RIG.depth(disparity), left[:, 2], rtol=1e-11)


def test_a_rig_about_a_camera_has_that_camera_for_its_body() -> None:
    still = LinearMotion(np.zeros(3), np.zeros(3))
    for origin, centres in (("left", [0.0, 0.2]), ("right", [-0.2, 0.0]), ("middle", [-0.1, 0.1])):
        rig = RIG.about(origin)
        found = [inverse(Pose(*rig.cam_from_world(still, 0.0, side))).t[0] for side in SIDES]
        np.testing.assert_allclose(found, centres, atol=1e-15)
    assert RIG.about("left").about("middle") == RIG
    with pytest.raises(ValueError, match="origin"):
        RIG.about("top")  # pyrefly: ignore[bad-argument-type]


def test_depth_and_disparity_of_nothing_are_nan() -> None:
    assert np.all(np.isnan(RIG.depth([0.0, -1.0, np.nan])))
    assert np.all(np.isnan(RIG.disparity([0.0, -1.0, np.nan])))


@pytest.mark.parametrize("baseline", [0.0, -0.1, float("nan"), float("inf")])
def test_a_baseline_that_is_not_positive_is_refused(baseline: float) -> None:
    with pytest.raises(ValueError, match="baseline"):
        StereoRig(camera=RIG.camera, baseline=baseline)
