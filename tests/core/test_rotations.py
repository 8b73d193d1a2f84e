"""Rotations against SciPy, rigid transforms against 4 x 4 matrices, pose errors at known angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rsbench.components.motion_models import LinearMotion
from rsbench.core import pose_errors, so3
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.so3 import FloatArray

few = settings(max_examples=40)
unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
angles = st.one_of(
    st.floats(0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, 0.00999999, 0.01, 0.01000001, 3.14, np.pi - 1e-7, np.pi - 1e-12]),
)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> FloatArray:
    axis = np.array(draw(unit))
    return draw(angles) * axis / np.linalg.norm(axis)


def test_hat_is_the_cross_product() -> None:
    rng = np.random.default_rng(0)
    w, x = rng.normal(size=(2, 5, 3))
    np.testing.assert_allclose((so3.hat(w) @ x[..., None])[..., 0], np.cross(w, x), rtol=0, atol=1e-15)


@few
@given(rotation_vectors())
def test_exp_equals_the_matrix_exponential(w: FloatArray) -> None:
    np.testing.assert_allclose(so3.exp(w), expm(so3.hat(w)), rtol=0, atol=4e-15)  # expm's own rounding


@few
@given(rotation_vectors())
def test_log_inverts_exp(w: FloatArray) -> None:
    back = so3.log(so3.exp(w))
    assert np.linalg.norm(back) <= np.pi
    # At pi both signs of the axis are right, so the comparison there is between rotations.
    np.testing.assert_allclose(so3.exp(back), so3.exp(w), rtol=0, atol=4e-15)
    if np.linalg.norm(w) < np.pi - 1e-6:
        np.testing.assert_allclose(back, w, rtol=0, atol=2e-14)


@pytest.mark.parametrize("magnitude", [1e-3, 1e-7, 1e-12])
def test_log_keeps_the_relative_precision_of_small_rotations(magnitude: float) -> None:
    w = magnitude * np.array([0.3, -0.5, 0.8])
    np.testing.assert_allclose(so3.log(so3.exp(w)), w, rtol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0, -0.8), (-2 / 3, 1 / 3, 2 / 3)])
def test_log_at_exactly_pi(axis: tuple[float, float, float]) -> None:
    a = np.array(axis)
    w = so3.log(2.0 * np.outer(a, a) - np.eye(3))  # the half turn about a, in closed form
    assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-14)
    assert abs(w @ a) == pytest.approx(np.pi, abs=1e-14)


@few
@given(rotation_vectors())
def test_left_jacobian_is_the_integral_of_the_rotation(w: FloatArray) -> None:
    # J(w) = integral of exp(s w) over s in [0, 1]: the upper right block of an augmented exponential.
    augmented = np.zeros((6, 6))
    augmented[:3, :3], augmented[:3, 3:] = so3.hat(w), np.eye(3)
    np.testing.assert_allclose(so3.left_jacobian(w), expm(augmented)[:3, 3:], rtol=0, atol=1e-14)


@pytest.mark.parametrize("true", [1e-14, 1e-12, 1e-9, 1e-6, 0.5, np.pi / 2, 3.0, np.pi])
def test_angle_is_exact_where_acos_fails(true: float) -> None:
    R = so3.exp(true * np.array([2, -1, 2]) / 3)
    # Rounding of R's entries limits the absolute error near pi only, where the sine vanishes.
    assert so3.angle(R) == pytest.approx(true, rel=1e-12, abs=1e-15)


@few
@given(rotation_vectors())
def test_quaternion_equals_scipys(w: FloatArray) -> None:
    q = so3.quaternion(so3.exp(w))
    assert q[0] >= 0.0
    x, y, z, s = Rotation.from_rotvec(w).as_quat(canonical=False)
    same = np.array([s, x, y, z])
    same *= np.sign(same @ q)  # q and -q are one rotation
    np.testing.assert_allclose(q, same, rtol=0, atol=1e-12)  # log's precision near pi


@few
@given(rotation_vectors(), st.floats(0.1, 10))
def test_from_quaternion_inverts_quaternion_at_any_norm(w: FloatArray, norm: float) -> None:
    R = so3.exp(w)
    np.testing.assert_allclose(so3.from_quaternion(norm * so3.quaternion(R)), R, rtol=0, atol=1e-12)


def test_batch_axes_match_single_calls() -> None:
    # Small, ordinary and half-turn rotations in one batch: each takes its own branch.
    axes = np.random.default_rng(1).normal(size=(2, 3, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    w = axes * np.array([[0.0, 1e-9, 0.3], [2.0, np.pi - 1e-9, np.pi]])[..., None]
    R = so3.exp(w)
    assert R.shape == (2, 3, 3, 3)
    results = (R, so3.log(R), so3.left_jacobian(w), so3.angle(R), so3.quaternion(R))
    for i, j in np.ndindex(2, 3):
        one = so3.exp(w[i, j])
        singles = (one, so3.log(one), so3.left_jacobian(w[i, j]), so3.angle(one), so3.quaternion(one))
        for batch, single in zip(results, singles, strict=True):
            np.testing.assert_allclose(batch[i, j], single, rtol=0, atol=1e-15)


def _random_poses(seed: int, n: int = 6) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(so3.exp(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))


def _matrix(pose: Pose) -> FloatArray:
    M = np.zeros((len(pose.R), 4, 4))
    M[:, :3, :3], M[:, :3, 3], M[:, 3, 3] = pose.R, pose.t, 1.0
    return M


def test_transforms_are_homogeneous_matrices() -> None:
    pose, first, x = _random_poses(0), _random_poses(4), np.random.default_rng(1).normal(size=(6, 3))
    M, homogeneous = _matrix(pose), np.concatenate([x, np.ones((6, 1))], axis=1)
    expected = np.einsum("nij,nj->ni", M, homogeneous)[:, :3]
    np.testing.assert_allclose(transform(pose, x), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(_matrix(inverse(pose)), np.linalg.inv(M), rtol=0, atol=1e-13)
    np.testing.assert_allclose(_matrix(compose(pose, first)), M @ _matrix(first), rtol=0, atol=1e-14)


vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@pytest.mark.parametrize("degrees", [1e-9, 1e-6, 45.0, 90.0, 135.0, 180.0])
def test_angles_between_directions(degrees: float) -> None:
    a = np.radians(degrees)
    direction = [np.cos(a), np.sin(a), 0.0]
    # Exact where acos reads 0 (below 1e-6 deg); cos(a) itself has 1e-16 of rounding.
    assert pose_errors.translation_error(direction, [2.0, 0, 0]) == pytest.approx(a, rel=1e-12)
    assert pose_errors.rotation_error([0.0, a, 0.0], np.zeros(3)) == pytest.approx(a, rel=1e-12)


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


def test_a_zero_estimate_scores_the_worst_value_and_a_zero_truth_none() -> None:
    along, zero = [1.0, 0, 0], np.zeros(3)
    assert pose_errors.translation_error(zero, along) == pose_errors.WORST_ANGLE
    assert pose_errors.scale_error(zero, along) == pose_errors.WORST_SCALE
    for estimate in (along, zero):
        assert np.isnan(pose_errors.translation_error(estimate, zero))
        assert np.isnan(pose_errors.scale_error(estimate, zero))


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
