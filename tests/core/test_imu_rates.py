"""Rates and forces of motions against differences of their poses, and integrated back to them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.imu import STANDARD_GRAVITY, inertial
from rsbench.core.motion import Motion
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion, TrajectoryMotion

W, D = np.array([0.08, -0.12, 0.05]), np.array([0.2, -0.1, 0.3])
DOWN = np.array([0.0, STANDARD_GRAVITY, 0.0])


def _along(w: FloatArray, d: FloatArray) -> Motion:
    """Through poses a quarter of a period apart, of a smooth path that is none of the models."""
    tau = np.arange(-2, 11) * 0.25
    R, t = TwistMotion(w, d).body_from_world(tau + 0.1 * np.sin(2 * tau))
    place = inverse(AcceleratedMotion(0.5 * w, d[::-1], 0.4).body_from_world(tau))
    q = so3.quaternion(np.swapaxes(R, 1, 2) @ place.R)
    poses = np.column_stack([tau, place.t - t, q[:, 1:], q[:, 0]])
    end = TrajectoryMotion.endpoint({"poses": poses})
    assert end is not None
    return TrajectoryMotion(*end, poses=poses)


MODELS: dict[str, Callable[[FloatArray, FloatArray], Motion]] = {
    "linear": LinearMotion,
    "twist": TwistMotion,
    "accelerated": lambda w, d: AcceleratedMotion(w, d, 0.3),
    "spline": lambda w, d: SplineMotion(w, d, preset="handheld", seed=2),
    "trajectory": _along,
}


class _Plain(LinearMotion):  # pyrefly: ignore[invalid-inheritance]  # final
    """A model that does not say its accelerations."""

    accelerations = Motion.accelerations

    def velocity(self, tau):  # pyrefly: ignore[implicit-any-parameter, unannotated-return]
        tau = np.asarray(tau)[..., None]
        return np.sin(3 * tau) * self.w, np.exp(tau) * self.d


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=5)
@given(place=st.integers(-1, 7), within=st.floats(0.05, 0.95), scale=st.floats(0.1, 1.5))
def test_accelerations_are_the_derivatives_of_velocities(
    name: str, place: int, within: float, scale: float
) -> None:
    """Between the knots, every quarter of a period. h^2 / 6 of a third derivative below 100, and rounding / h."""
    motion, tau, h = MODELS[name](scale * W, scale * D), 0.25 * (place + within), 1e-5
    for k in (0, 1):
        difference = (motion.velocity(tau + h)[k] - motion.velocity(tau - h)[k]) / (2 * h)
        np.testing.assert_allclose(motion.accelerations(tau)[k], difference, rtol=0, atol=1e-8)


def test_a_model_that_does_not_say_them_has_differences() -> None:
    tau = np.linspace(0.0, 1.0, 7)[:, None]
    w, t = _Plain(W, D).accelerations(tau[:, 0])
    np.testing.assert_allclose(w, 3 * np.cos(3 * tau) * W, rtol=0, atol=1e-10)
    np.testing.assert_allclose(t, np.exp(tau) * D, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", MODELS)
def test_rates_and_forces_integrate_back_to_the_poses(name: str) -> None:
    """Steps of the middle rule, whose error is h^2 / 24 of second derivatives below 1e4 / s^2, over 0.18 s."""
    motion, period, h = MODELS[name](W, D), 0.1, 2e-5
    steps = round(1.8 * period / h)
    felt = inertial(motion, (np.arange(steps) + 0.5) * h / period, period, DOWN)
    start = inverse(motion.body_from_world(0.0))
    speed_in_body = motion.velocity(0.0)[1] - np.cross(motion.velocity(0.0)[0], motion.body_from_world(0.0).t)
    R, p, v = start.R, start.t, -(start.R @ speed_in_body) / period
    for turn, force in zip(so3.exp(h * felt.turn), felt.force, strict=True):
        later = R @ turn
        a = 0.5 * (R + later) @ force + DOWN
        p, v, R = p + h * v + 0.5 * h * h * a, v + h * a, later
    end = inverse(motion.body_from_world(1.8))
    assert so3.angle(R.T @ end.R) < 1e-7
    np.testing.assert_allclose(p, end.t, rtol=0, atol=2e-5)


def test_at_rest_one_feels_that_one_does_not_fall() -> None:
    felt = inertial(LinearMotion(np.zeros(3), np.zeros(3)), 0.3, 0.1, DOWN)
    np.testing.assert_allclose([felt.turn, felt.force], [np.zeros(3), -DOWN], rtol=0, atol=1e-15)


def test_a_turn_to_the_right_is_positive_about_the_axis_down() -> None:
    """Points move to the left in the body, by exp(-angle about y)."""
    felt = inertial(LinearMotion([0.0, -0.05, 0.0], np.zeros(3)), 0.3, 0.1, DOWN)
    np.testing.assert_allclose(felt.turn, [0.0, 0.5, 0.0], rtol=0, atol=1e-15)
