"""Motion models against closed forms, the 4 x 4 matrix exponential and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from rsbench.core import so3
from rsbench.core.motion import MOTION_MODELS, LinearMotion, Motion, TwistMotion
from rsbench.core.so3 import FloatArray

few = settings(max_examples=25, deadline=None, derandomize=True)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
times = st.floats(-2, 3)


def _matrix(motion: Motion, tau: float) -> FloatArray:
    R, t = motion.body_from_world(tau)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = R, t
    return M


@few
@given(vectors, vectors, times)
def test_linear_motion_is_the_papers(w: FloatArray, d: FloatArray, tau: float) -> None:
    R, t = LinearMotion(w, d).body_from_world(tau)
    np.testing.assert_allclose(R, expm(tau * so3.hat(w)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, tau * d, rtol=1e-15)


@few
@given(vectors, vectors, times)
def test_twist_motion_is_the_matrix_exponential_of_its_twist(w: FloatArray, d: FloatArray, tau: float) -> None:
    motion = TwistMotion(w, d)
    xi = np.zeros((4, 4))
    xi[:3, :3], xi[:3, 3] = so3.hat(w), motion.v
    np.testing.assert_allclose(_matrix(motion, tau), expm(tau * xi), rtol=0, atol=1e-13)


@few
@given(vectors, vectors, times, times)
def test_twist_motion_is_a_one_parameter_group(w: FloatArray, d: FloatArray, s: float, t: float) -> None:
    motion = TwistMotion(w, d)
    np.testing.assert_allclose(_matrix(motion, s + t), _matrix(motion, s) @ _matrix(motion, t), rtol=0, atol=1e-13)


def test_the_twist_is_the_matrix_logarithm_of_the_pose_after_one_period() -> None:
    w, d = np.array([0.3, -0.2, 0.4]), np.array([0.1, 0.7, -0.2])
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = expm(so3.hat(w)), d
    np.testing.assert_allclose(TwistMotion(w, d).v, logm(M)[:3, 3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", MOTION_MODELS.values())
@few
@given(vectors, vectors)
def test_every_model_starts_at_the_world_and_reaches_w_and_d(
    model: type[LinearMotion] | type[TwistMotion], w: FloatArray, d: FloatArray
) -> None:
    R, t = model(w, d).body_from_world([0.0, 1.0])
    np.testing.assert_allclose(R, [np.eye(3), expm(so3.hat(w))], rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, [np.zeros(3), d], rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", MOTION_MODELS.values())
@few
@given(vectors, vectors, times)
def test_velocity_is_the_derivative_of_the_pose(
    model: type[LinearMotion] | type[TwistMotion], w: FloatArray, d: FloatArray, tau: float
) -> None:
    motion, step = model(w, d), 1e-5
    before, after = motion.body_from_world(tau - step), motion.body_from_world(tau + step)
    w_rate, t_rate = motion.velocity(tau)
    # Central differences: truncation step^2, rounding 1e-16 / step.
    np.testing.assert_allclose(so3.log(after.R @ before.R.T) / (2 * step), w_rate, rtol=0, atol=1e-9)
    np.testing.assert_allclose((after.t - before.t) / (2 * step), t_rate, rtol=0, atol=1e-9)


def test_models_agree_without_rotation_and_differ_with_it() -> None:
    d, tau = np.array([0.1, 0.2, 0.3]), np.linspace(0, 1, 5)
    still = [model(np.array([0, 0, 0]), d).body_from_world(tau).t for model in (LinearMotion, TwistMotion)]
    np.testing.assert_allclose(still[0], still[1], rtol=0, atol=1e-15)
    turning = [model(np.array([0.2, 0, 0]), d).body_from_world(tau).t for model in (LinearMotion, TwistMotion)]
    assert np.max(np.abs(turning[0][2] - turning[1][2])) > 1e-3


@pytest.mark.parametrize("model", MOTION_MODELS.values())
@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3)])
def test_times_of_any_shape(model: type[LinearMotion] | type[TwistMotion], shape: tuple[int, ...]) -> None:
    motion = model(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    tau = np.linspace(0, 1, int(np.prod(shape))).reshape(shape)
    R, t = motion.body_from_world(tau)
    w_rate, t_rate = motion.velocity(tau)
    assert (R.shape, t.shape) == ((*shape, 3, 3), (*shape, 3))
    assert w_rate.shape == t_rate.shape == (*shape, 3)


def test_the_given_arrays_are_copied_and_frozen() -> None:
    w = np.array([0.1, 0.2, 0.3])
    motion = LinearMotion(w, w)
    w[0] = 9.0
    assert motion.w[0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        motion.d[0] = 1.0


@pytest.mark.parametrize("bad", [[1.0, 2.0], [1.0, 2.0, np.nan], [[1.0, 2.0, 3.0]], 4.0])
def test_anything_but_three_finite_numbers_is_refused(bad: object) -> None:
    with pytest.raises(ValueError, match="motion d must be 3 finite numbers"):
        LinearMotion(np.zeros(3), bad)  # type: ignore[arg-type]
