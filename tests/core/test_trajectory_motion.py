"""The path along given poses: through them, of fourth order between them, and its velocity by differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import make_motion, motion_record, read_motion
from rsbench.core import so3
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import TrajectoryMotion, world_from_body

few = settings(max_examples=25)


def _smooth(tau: FloatArray) -> Pose:
    """A path of our own: a rotation about an axis that turns itself, and a bent way."""
    tau = np.asarray(tau, dtype=np.float64)
    turn = so3.exp(np.stack([0.3 * np.sin(tau), 0.2 * tau, 0.1 * np.cos(2 * tau)], axis=-1))
    way = np.stack([np.sin(1.3 * tau), 0.4 * tau**2, np.cos(tau)], axis=-1)
    return Pose(turn @ so3.exp(np.stack([0 * tau, 0 * tau, 0.5 * tau], axis=-1)), way)


def _rows(tau: FloatArray, path: Pose) -> FloatArray:
    w, x, y, z = np.moveaxis(so3.quaternion(path.R), -1, 0)
    return np.column_stack([tau, path.t, x, y, z, w])


def _motion(poses: FloatArray) -> TrajectoryMotion:
    parameters = {"poses": poses.tolist()}
    ends = TrajectoryMotion.endpoint(parameters)
    assert ends is not None
    motion = make_motion("trajectory", *ends, parameters)
    assert isinstance(motion, TrajectoryMotion)
    return motion


@few
@given(st.integers(0, 2**32 - 1))
def test_poses_are_hit_at_their_times(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tau = np.cumsum(rng.uniform(0.05, 0.5, 30)) - 0.6
    poses = _rows(tau, Pose(so3.exp(np.cumsum(rng.normal(0, 0.3, (30, 3)), axis=0)), rng.normal(0, 5, (30, 3))))
    poses[::3, 4:] *= -1  # the same rotations
    motion = _motion(poses)
    given = Pose(so3.from_quaternion(poses[:, [7, 4, 5, 6]]), poses[:, 1:4])
    start = world_from_body(poses, 0.0)
    found = compose(start, inverse(motion.body_from_world(tau)))
    np.testing.assert_allclose(found.R, given.R, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.t, given.t, rtol=0, atol=1e-11)


def test_between_poses_the_error_falls_with_the_fourth_power_of_the_step() -> None:
    between = np.linspace(0.0, 1.0, 101)
    expected, errors = _smooth(between), list[list[float]]()
    for step in (0.1, 0.05, 0.025):
        tau = np.arange(-1.0, 2.0 + step, step)
        found = world_from_body(_rows(tau, _smooth(tau)), between)
        errors.append(
            [np.max(np.abs(found.t - expected.t)), np.max(so3.angle(found.R @ np.swapaxes(expected.R, 1, 2)))]
        )
    # 16 in the limit; terms of the next order change it by some tenths.
    ratios = np.divide(errors[:-1], errors[1:])
    assert np.all((ratios > 14.0) & (ratios < 18.5)), ratios
    # The bound of Hall and Meyer for the position: fourth derivatives are 1.3^4 and 1 at most.
    assert errors[0][0] <= 5 / 384 * 0.1**4 * 1.3**4


@few
@given(st.floats(-1.2, 2.2))
def test_velocity_is_the_derivative_also_beyond_the_poses(tau: float) -> None:
    times = np.arange(-0.5, 1.6, 0.15)
    motion, step = _motion(_rows(times, _smooth(times))), 1e-5
    (R0, t0), (R1, t1) = motion.body_from_world(tau - step), motion.body_from_world(tau + step)
    w, t = motion.velocity(tau)
    # Central differences: step^2 by the third derivative, below 1e2, and 1e-16 / step; at a pose and at the ends,
    # where the second derivative of the path jumps at most, step.
    np.testing.assert_allclose(so3.log(R1 @ R0.T) / (2 * step), w, rtol=0, atol=1e-4)
    np.testing.assert_allclose((t1 - t0) / (2 * step), t, rtol=0, atol=1e-4)


def test_moving_the_frame_of_all_poses_changes_nothing() -> None:
    times = np.arange(-0.5, 1.6, 0.15)
    path, move = _smooth(times), Pose(so3.exp(np.array([1.0, -2.0, 0.4])), np.array([3.0, -5.0, 7.0]))
    one, other = _motion(_rows(times, path)), _motion(_rows(times, compose(move, path)))
    tau = np.linspace(0, 1.5, 31)
    for first, second in zip(one.body_from_world(tau), other.body_from_world(tau), strict=True):
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-13)


def test_a_record_makes_the_same_motion_again() -> None:
    times = np.arange(-0.5, 1.6, 0.3)
    motion = _motion(_rows(times, _smooth(times)))
    again = read_motion(motion_record(motion))
    np.testing.assert_array_equal(again.body_from_world(0.37).t, motion.body_from_world(0.37).t)
    np.testing.assert_allclose(motion.body_from_world(1.0).R, so3.exp(motion.w), rtol=0, atol=1e-15)


STRAIGHT = np.array([[-1.0, 0, 0, 0, 0, 0, 0, 1], [0.5, 1, 0, 0, 0, 0, 0, 1], [2.0, 2, 0, 0, 0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p[:, :7], "rows of 8"),
        (lambda p: p[:1], "two or more"),
        (lambda p: p * np.nan, "finite"),
        (lambda p: p[::-1], "later"),
        (lambda p: 1.1 * p, "length 1"),
        (lambda p: p + 2 * np.eye(8)[0], "reach from time 0 to 1"),
        (lambda p: np.vstack([p[:2], [2, 0, 0, 0, 1, 0, 0, 0]]), "90 degrees"),
    ],
)
def test_poses_that_cannot_be_are_refused(change: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        TrajectoryMotion.endpoint({"poses": change(STRAIGHT)})  # pyrefly: ignore[not-callable]


def test_another_end_than_that_of_the_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="are those of its poses"):
        TrajectoryMotion(np.zeros(3), np.zeros(3), STRAIGHT)
