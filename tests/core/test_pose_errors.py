"""Error metrics at angles known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsbench.components.motion_models import LinearMotion
from rsbench.core import pose_errors
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray

few = settings(max_examples=40)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@pytest.mark.parametrize("degrees", [1e-9, 1e-6, 45.0, 90.0, 135.0, 180.0])
def test_angles_between_directions(degrees: float) -> None:
    a = np.radians(degrees)
    direction = [np.cos(a), np.sin(a), 0.0]
    # Exact where acos reads 0 (below 1e-6 deg); cos(a) itself has 1e-16 of rounding.
    assert pose_errors.translation_error(direction, [2.0, 0, 0]) == pytest.approx(a, rel=1e-12)
    assert pose_errors.rotation_error([0.0, a, 0.0], np.zeros(3)) == pytest.approx(a, rel=1e-12)


def test_no_error_is_zero_exactly() -> None:
    w, d = [0.1, -0.2, 0.3], [1.0, 2.0, -3.0]
    assert pose_errors.translation_error(d, d) == 0.0
    assert pose_errors.scale_error(d, d) == 0.0
    assert pose_errors.rotation_error(w, w) == pytest.approx(0.0, abs=1e-15)  # rounding of R R^T


@few
@given(vectors, vectors)
def test_rotation_error_equals_scipys(w_est: FloatArray, w_gt: FloatArray) -> None:
    difference = Rotation.from_rotvec(w_est) * Rotation.from_rotvec(w_gt).inv()
    assert pose_errors.rotation_error(w_est, w_gt) == pytest.approx(difference.magnitude(), abs=1e-14)


@pytest.mark.parametrize("factor", [1.01, 2.0, 0.5])
def test_scale_error_is_the_logarithm_of_the_ratio(factor: float) -> None:
    assert pose_errors.scale_error([0, 0, factor * 0.3], [0.3, 0, 0]) == pytest.approx(
        abs(np.log(factor)), rel=1e-12
    )


def test_a_zero_estimate_scores_the_worst_value() -> None:
    assert pose_errors.translation_error(np.zeros(3), [1.0, 0, 0]) == pose_errors.WORST_ANGLE
    assert pose_errors.scale_error(np.zeros(3), [1.0, 0, 0]) == pose_errors.WORST_SCALE


def test_a_zero_truth_has_neither_direction_nor_scale() -> None:
    for estimate in ([1.0, 0, 0], np.zeros(3)):
        assert np.isnan(pose_errors.translation_error(estimate, np.zeros(3)))
        assert np.isnan(pose_errors.scale_error(estimate, np.zeros(3)))


@few
@given(vectors, vectors, vectors)
def test_translation_of_offset_is_the_relative_pose_of_that_camera(
    w: FloatArray, d: FloatArray, offset: FloatArray
) -> None:
    # cam = body shifted by offset at both times; chain world <- cam0 and cam1 <- world explicitly.
    cam_from_body = Pose(np.eye(3), offset)
    cam0, cam1 = (compose(cam_from_body, Pose(*LinearMotion(w, d).body_from_world(tau))) for tau in (0.0, 1.0))
    expected = compose(cam1, inverse(cam0)).t
    np.testing.assert_allclose(pose_errors.translation_of_offset(w, d, offset), expected, rtol=0, atol=1e-14)


def test_batches_match_single_calls() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 4, 3))
    a[1], b[2] = 0.0, 0.0
    for metric in (pose_errors.rotation_error, pose_errors.translation_error, pose_errors.scale_error):
        singles = [metric(x, y) for x, y in zip(a, b, strict=True)]
        np.testing.assert_allclose(metric(a, b), singles, rtol=1e-14)


@settings(max_examples=300)
@given(vectors, vectors, st.integers(-1074, 1023), st.floats(0.5, 1.0))
def test_a_direction_has_one_error_at_every_length(
    d_est: FloatArray, d_gt: FloatArray, power: int, factor: float
) -> None:
    # A length below 2^-1022 keeps fewer than 53 bits of each component; the direction is then another one.
    longer = np.ldexp(factor * d_est, power)
    assume(np.max(np.abs(d_est)) > 1e-3 and np.max(np.abs(d_gt)) > 1e-3)
    kept = np.ldexp(longer, -power) / factor if power > -1000 else d_est
    assume(np.max(np.abs(longer)) > 1e-290 and np.max(np.abs(kept - d_est)) < 1e-12)
    expected = pose_errors.translation_error(d_est, d_gt)
    assert pose_errors.translation_error(longer, d_gt) == pytest.approx(expected, abs=1e-12)
    assert pose_errors.translation_error(d_gt, longer) == pytest.approx(expected, abs=1e-12)
    # e_s by logarithms alone, which no length takes out of range; of about 700, it rounds at 1e-13.
    lengths = [np.log(np.linalg.norm(d / np.max(np.abs(d)))) + np.log(np.max(np.abs(d))) for d in (longer, d_gt)]
    assert pose_errors.scale_error(longer, d_gt) == pytest.approx(abs(lengths[0] - lengths[1]), abs=1e-11)


@pytest.mark.parametrize("length", [5e-324, 1e-320, 1e-170, 1e-30, 1e30, 1e200, 1.7e308])
def test_extreme_lengths_lie_at_their_angle(length: float) -> None:
    along = [length, 0.0, 0.0]
    assert np.degrees(pose_errors.translation_error(along, [1.0, 2.0, 0.0])) == pytest.approx(
        np.degrees(np.arctan(2.0)), rel=1e-15
    )
    assert np.degrees(pose_errors.translation_error([-1.0, 0.0, 0.0], along)) == 180.0
    assert pose_errors.scale_error(along, [1.0, 0.0, 0.0]) == pytest.approx(abs(np.log(length)), rel=1e-14)
