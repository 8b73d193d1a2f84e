"""Rigs of two cameras that differ and do not look the same way, against the cameras' own projections."""

from __future__ import annotations

import numpy as np
import pytest
from differences import derivatives
from general_rigs import LEFT, RIGHT, RIGS, SCANS, rig_of
from hypothesis import given
from hypothesis import strategies as st

from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.projection import back_project, rs_project, rs_project_near
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import transform
from rsbench.core.shutter import Scanning
from rsbench.solvers.engine.base import load_solver_entry

small = st.floats(-0.2, 0.2)


@given(st.tuples(small, small, small), st.tuples(small, small))
def test_right_camera_sees_what_the_calibration_says(
    w: tuple[float, float, float], t: tuple[float, float]
) -> None:
    R, translation = so3.exp(np.array(w)), np.array([-0.3, *t])
    rig = StereoRig.of_cameras(LEFT, RIGHT, R, translation)
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-12)
    np.testing.assert_allclose(rig.right_from_left.t, translation, atol=1e-12)
    X = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 9], (50, 3))
    in_left = (X + rig.offset("left")) @ rig.own("left").R.T
    in_right = (X + rig.offset("right")) @ rig.own("right").R.T
    np.testing.assert_allclose(in_right, in_left @ R.T + translation, atol=1e-12)
    # In ideal pixels both ends lie on one row, and their difference is the disparity of the depth along z.
    ends = [rig.eye(side).ideal_pixels(rig.eye(side).project(X + rig.offset(side))) for side in SIDES]
    seen = np.all(np.isfinite(np.stack(ends)), axis=(0, 2))
    assert np.count_nonzero(seen) > 10
    np.testing.assert_allclose(ends[0][seen, 1], ends[1][seen, 1], atol=1e-7)
    np.testing.assert_allclose((ends[0] - ends[1])[seen, 0], rig.disparity(X[seen, 2]), atol=1e-7)


def test_ideal_pixels_have_the_derivative_of_finite_differences() -> None:
    eye = rig_of((0.02, -0.05, 0.3)).eye("right")
    pixels = np.random.default_rng(1).uniform([100, 100], [1100, 600], (40, 2))
    numeric = derivatives(eye.ideal_pixels, pixels, 1e-4)
    np.testing.assert_allclose(eye.ideal_by_pixel(pixels), numeric, atol=1e-6)
    np.testing.assert_allclose(eye.lens_pixels(eye.ideal_pixels(pixels)), pixels, atol=1e-8)


def test_equal_aligned_cameras_are_the_ideal_rig() -> None:
    assert StereoRig.of_cameras(LEFT, LEFT, np.eye(3), (-0.3, 0, 0)) == StereoRig(camera=LEFT, baseline=0.3)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.zeros((3, 3)), (-1, 0, 0), "rotation matrix"),
        (np.eye(3), (0, 0, 0), "one place"),
        (np.eye(3), (0, 0, -1), "along the line between"),
    ],
)
def test_impossible_extrinsics_are_refused(
    rotation: np.ndarray, translation: tuple[float, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        StereoRig.of_cameras(LEFT, RIGHT, rotation, translation)


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
@pytest.mark.parametrize("scanning", SCANS.values(), ids=SCANS)
def test_projection_returns_from_where_it_went_and_matches_meet_the_constraint(
    rig: StereoRig, scanning: Scanning
) -> None:
    shutter = rig.shutter_of(scanning, 0.8)
    motion = make_motion("linear", np.array([0.01, 0.03, -0.02]), np.array([0.05, -0.1, 0.12]))
    X = np.random.default_rng(2).uniform([-1.2, -0.9, 3], [1.2, 0.9, 8], (300, 3))
    ends = []
    for frame in (0, 1):
        for side in SIDES:
            seen = rs_project(rig, shutter, motion, side, frame, X)
            good = np.isfinite(seen.depth)
            back = back_project(rig, shutter, motion, side, frame, seen.pixels[good], seen.depth[good])
            np.testing.assert_allclose(back, X[good], atol=1e-8)
            pose = rig.cam_from_world(motion, seen.tau[good], side)
            own = transform(pose, X[good])
            np.testing.assert_allclose(rig.sensor(side).project(own), seen.pixels[good], atol=1e-8)
            axis = shutter.axis(side)
            near = rs_project_near(rig, shutter, motion, side, frame, X[good], seen.pixels[good, axis] + 1.0)
            np.testing.assert_allclose(near.depth, seen.depth[good], atol=1e-8)
            ends.append(seen.pixels)
    tracks = np.concatenate(ends, axis=1)
    tracks = tracks[np.all(np.isfinite(tracks), axis=1)]
    assert len(tracks) > 60
    for side, columns in (("left", [0, 1, 4, 5]), ("right", [2, 3, 6, 7])):
        assert np.max(np.abs(rs_sampson_error(rig, shutter, motion, side, tracks[:, columns]))) < 1e-6


def test_solvers_of_the_ideal_rig_refuse_another_by_name() -> None:
    rig = rig_of((0.0, 0.01, 0.0))
    reason = load_solver_entry("rs-r6p").solver.spec.refusal(rig, rig.shutter_of(Scanning(), 0.5))
    assert "perfect alignment" in reason
