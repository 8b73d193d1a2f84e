"""Motion models against closed forms, the 4 x 4 matrix exponential and finite differences."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from rsbench.components.motion_models import AcceleratedMotion, InertialMotion, LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import PRESETS, SplineMotion

Model = (
    type[LinearMotion] | type[InertialMotion] | type[TwistMotion] | type[AcceleratedMotion] | type[SplineMotion]
)
MODELS: tuple[Model, ...] = (LinearMotion, TwistMotion, InertialMotion, AcceleratedMotion, SplineMotion)

few = settings(max_examples=25)
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
@given(vectors, vectors, st.floats(-1.0, 2.0))
def test_an_inertial_body_keeps_its_velocity_in_the_world_and_its_rate_of_turn(
    w: FloatArray, d: FloatArray, start: float
) -> None:
    """Its centre -R^T t moves along a line at one speed; seen from a later time it does too."""
    tau = np.linspace(-1.0, 2.0, 7)
    for motion in (InertialMotion(w, d), InertialMotion(w, d).from_time(start)):
        R, t = motion.body_from_world(tau)
        centres = -np.einsum("nji,nj->ni", R, t)
        np.testing.assert_allclose(centres, tau[:, None] * -(so3.exp(-w) @ motion.d), rtol=0, atol=1e-12)
        np.testing.assert_allclose(R, so3.exp(tau[:, None] * w), rtol=0, atol=1e-12)
    later, general = InertialMotion(w, d).from_time(start), LaterMotion.of(InertialMotion(w, d), start)
    np.testing.assert_allclose(_matrix(later, 0.7), _matrix(general, 0.7), rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors)
def test_every_model_starts_at_the_world_and_reaches_w_and_d(model: Model, w: FloatArray, d: FloatArray) -> None:
    R, t = model(w, d).body_from_world([0.0, 1.0])
    np.testing.assert_allclose(R, [np.eye(3), expm(so3.hat(w))], rtol=0, atol=1e-14)
    np.testing.assert_allclose(t, [np.zeros(3), d], rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors, times)
def test_velocity_is_the_derivative_of_the_pose(model: Model, w: FloatArray, d: FloatArray, tau: float) -> None:
    motion, step = model(w, d), 1e-5
    before, after = motion.body_from_world(tau - step), motion.body_from_world(tau + step)
    w_rate, t_rate = motion.velocity(tau)
    # Central differences: truncation step^2 times the third derivative, which a shake every quarter of a period
    # makes large; rounding 1e-16 / step; where a spline is only once differentiable, at its ends, step.
    at_end = model is SplineMotion and min(abs(tau), abs(tau - 2.0)) <= step
    atol = 1e-4 if at_end else 1e-8
    np.testing.assert_allclose(so3.log(after.R @ before.R.T) / (2 * step), w_rate, rtol=0, atol=atol)
    np.testing.assert_allclose((after.t - before.t) / (2 * step), t_rate, rtol=0, atol=atol)


@pytest.mark.parametrize("model", MODELS)
def test_times_of_any_shape(model: Model) -> None:
    motion = model(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    for shape in ((), (1,), (2, 3)):
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
        LinearMotion(np.zeros(3), bad)  # pyrefly: ignore[bad-argument-type]


accelerations = st.floats(-0.45, 3.0)


@few
@given(vectors, vectors, accelerations, st.floats(0, 2))
def test_accelerated_motion_has_constant_acceleration(w: FloatArray, d: FloatArray, k: float, tau: float) -> None:
    motion = AcceleratedMotion(w, d, acceleration=k)
    # t'' = k t'(0), and t(1) = d: the two facts that define the law.
    (_, start), (_, now) = motion.velocity(0.0), motion.velocity(tau)
    np.testing.assert_allclose(now, (1.0 + k * tau) * start, rtol=0, atol=1e-14)
    path = LinearMotion(w, d).body_from_world(motion.share(tau))
    np.testing.assert_allclose(motion.body_from_world(tau).R, path.R, rtol=0, atol=1e-14)
    assert motion.speed(tau) > 0.0
    if k == 0.0:
        np.testing.assert_array_equal(motion.share(tau), tau)


@pytest.mark.parametrize("k", [-0.5, -3.0, np.nan, np.inf])
def test_a_motion_that_would_turn_back_is_refused(k: float) -> None:
    with pytest.raises(ValueError, match=r"acceleration = .*: must be a number (above -0\.5|that is finite)"):
        AcceleratedMotion(np.zeros(3), np.zeros(3), acceleration=k)


@few
@given(vectors, vectors, times, st.sampled_from([0.1, 0.3, 0.5, 2.0]))
def test_a_spline_without_shake_is_a_constant_twist(
    w: FloatArray, d: FloatArray, tau: float, interval: float
) -> None:
    motion = SplineMotion(w, d, interval=interval, shake=np.zeros((int(np.ceil(2 / interval)) + 3, 6)))
    np.testing.assert_allclose(_matrix(motion, tau), _matrix(TwistMotion(w, d), tau), rtol=0, atol=1e-12)


def control(seed: int, n: int, size: float = 0.05) -> FloatArray:
    rng = np.random.default_rng(seed)
    return size * rng.standard_normal((n, 6)) + np.arange(n)[:, None] * np.array([0.01, 0.02, 0, 0.1, 0, 0.05])


@few
@given(st.integers(0, 10**6), st.floats(0, 2))
def test_the_spline_is_the_cumulative_one_of_its_poses(seed: int, tau: float) -> None:
    """By 4 x 4 matrices and SciPy's exponential and logarithm, and by the basis in its recursive form."""
    interval, poses = 0.5, control(seed, 7)
    w, d = SplineMotion.endpoint({"interval": interval, "poses": poses}) or (None, None)
    assert w is not None and d is not None
    motion = SplineMotion(w, d, interval=interval, poses=poses)

    def matrix(pose: FloatArray) -> FloatArray:
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = expm(so3.hat(pose[:3])), pose[3:]
        return M

    matrices = [matrix(pose) for pose in poses]
    steps = [np.real(logm(after @ np.linalg.inv(before))) for before, after in pairwise(matrices)]

    def raw(time: float) -> FloatArray:
        # De Boor's recursion, summed from the back, weighs the steps between control poses.
        knots, x = np.arange(-3.0, 9.0), time / interval
        basis = [1.0 * (knots[k] <= x < knots[k + 1]) for k in range(len(knots) - 1)]
        for degree in (1, 2, 3):
            basis = [
                (x - knots[k]) / degree * basis[k] + (knots[k + degree + 1] - x) / degree * basis[k + 1]
                for k in range(len(knots) - 1 - degree)
            ]
        weights = np.cumsum(basis[::-1])[::-1]
        M = matrices[0]
        for k, step in enumerate(steps, start=1):
            M = expm(weights[k] * step) @ M
        return M

    expected = raw(tau) @ np.linalg.inv(raw(0.0))
    np.testing.assert_allclose(_matrix(motion, tau), expected, rtol=0, atol=1e-10)


@few
@given(st.sampled_from(list(PRESETS)), vectors, vectors, st.integers(0, 10**6))
def test_a_shake_moves_neither_end(preset: str, w: FloatArray, d: FloatArray, seed: int) -> None:
    R, t = SplineMotion(0.3 * w, 0.3 * d, preset=preset, seed=seed).body_from_world([0.0, 1.0])
    np.testing.assert_allclose(R, [np.eye(3), expm(so3.hat(0.3 * w))], rtol=0, atol=1e-12)
    np.testing.assert_allclose(t, [np.zeros(3), 0.3 * d], rtol=0, atol=1e-12)


@few
@given(st.integers(0, 10**6), st.integers(1, 7))
def test_a_spline_is_twice_differentiable_at_its_knots(seed: int, knot: int) -> None:
    motion = SplineMotion([0.02, -0.03, 0.01], [0.2, 0.1, -0.1], preset="handheld", seed=seed)
    tau, step = 0.25 * knot, 1e-4
    velocity = np.concatenate(motion.velocity(tau + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])), axis=-1)
    below, above = (velocity[2] - velocity[1]) / step, (velocity[3] - velocity[2]) / step
    # Each one-sided difference errs by step times the third derivative at most, the second of the velocity.
    third = np.abs(np.diff(velocity[:3], 2, axis=0)) + np.abs(np.diff(velocity[2:], 2, axis=0))
    np.testing.assert_array_less(np.abs(above - below), 2.0 * np.max(third) / step + 1e-9)
    # Were it only once differentiable, the acceleration would jump by about its own size.
    assert np.max(np.abs(above - below)) < 0.02 * np.max(np.abs(above)) + 1e-3


@pytest.mark.parametrize("model", MODELS)
@few
@given(vectors, vectors, st.integers(0, 1))
def test_no_speed_exceeds_the_bound(model: Model, w: FloatArray, d: FloatArray, frame: int) -> None:
    motion = model(w, d)
    bound = motion.fastest(frame, frame + 1.0)
    assert bound is not None
    for rate, most in zip(motion.velocity(np.linspace(frame, frame + 1.0, 200)), bound, strict=True):
        assert np.max(np.linalg.norm(rate, axis=-1)) <= most * (1.0 + 1e-12) + 1e-150  # squares below lose digits


@pytest.mark.parametrize(
    "motion",
    [
        TwistMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2]),
        InertialMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2]),
        AcceleratedMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2], acceleration=1.5),
        SplineMotion([0.1, 0.2, 0.3], [0.3, 0.1, 0.2], preset="drone", seed=8),
    ],
)
def test_parameters_make_the_motion_again(motion: Motion) -> None:
    tau = np.linspace(-0.2, 2.2, 30)
    again = type(motion)(motion.w, motion.d, **motion.parameters)
    for now, before in zip(again.body_from_world(tau), motion.body_from_world(tau), strict=True):
        np.testing.assert_array_equal(now, before)
    moved = motion.with_endpoint(2.0 * motion.w, -motion.d)
    assert moved.parameters == motion.parameters
    np.testing.assert_allclose(moved.body_from_world(1.0).t, -motion.d, rtol=0, atol=1e-12)


def test_explicit_poses_fix_the_motion() -> None:
    given = {"interval": 0.4, "poses": control(3, 8)}
    w, d = SplineMotion.endpoint(given) or (None, None)
    assert w is not None and d is not None
    motion = SplineMotion(w, d, **given)
    # The poses are seen through the spline, which passes near them, and from its own pose at time 0.
    near = Pose(so3.exp(control(3, 8)[:, :3]), control(3, 8)[:, 3:])
    R, t = motion.body_from_world(0.4 * np.arange(1, 6))
    expected = compose(Pose(near.R[2:7], near.t[2:7]), inverse(Pose(near.R[1], near.t[1])))
    assert np.max(so3.angle(R @ np.swapaxes(expected.R, -1, -2))) < 0.2
    assert np.max(np.abs(t - expected.t)) < 0.2
    with pytest.raises(ValueError, match="are those of its poses"):
        SplineMotion(w, 1.1 * d, **given)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"preset": "boat"}, "must be one of 'steady', 'handheld', 'drone', 'driving'"),
        ({"seed": -1}, "seed = -1: must be a whole number"),
        ({"interval": 0.5}, "interval goes with shake or poses"),
        ({"shake": np.zeros((7, 6))}, "interval = None: must be a number"),
        ({"shake": np.zeros((6, 6)), "interval": 0.5}, "shake has 6 rows; an interval of 0.5 needs 7"),
        ({"shake": np.zeros((7, 5)), "interval": 0.5}, "rows of 6 finite numbers"),
        ({"shake": np.zeros((7, 6)), "interval": 0.5, "seed": 1}, "shake and seed exclude each other"),
    ],
)
def test_a_spline_refuses_what_it_cannot_be(parameters: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SplineMotion(np.zeros(3), np.zeros(3), **parameters)  # pyrefly: ignore[bad-argument-type]


def test_a_spline_of_half_a_turn_is_refused() -> None:
    with pytest.raises(ValueError, match="below a half turn"):
        SplineMotion([0.0, 3.2, 0.0], np.zeros(3))


def test_the_pose_alone_of_a_spline_is_that_of_its_pose_with_velocity() -> None:
    """To the bit: a frame's rows are asked for one way, and for channels of truth the other."""
    motion = SplineMotion([0.02, 0.01, -0.03], [0.1, 0.0, 0.2], seed=4)
    inside = np.concatenate([np.linspace(0.0, motion.lasts, 97), motion.interval * np.arange(5)])
    for tau in (inside, np.array([-0.3, 0.5]), np.array([0.5, motion.lasts + 0.1])):
        whole, alone = motion._spline.at(tau)[0], motion.body_from_world(tau)
        np.testing.assert_array_equal(alone.R, whole.R)
        np.testing.assert_array_equal(alone.t, whole.t)
