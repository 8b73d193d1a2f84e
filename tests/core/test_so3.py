"""Rotations against SciPy's matrix exponential, its Rotation class and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rsbench.core import so3
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


@given(
    st.integers(0, 2**32 - 1), st.sampled_from([((3,), (3,)), ((5, 3), (3,)), ((4, 1, 3), (2, 3)), ((0, 3), (3,))])
)
def test_cross_has_the_bits_of_numpy(seed: int, shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.normal(size=shape) for shape in shapes)
    np.testing.assert_array_equal(so3.cross(a, b), np.cross(a, b), strict=True)
