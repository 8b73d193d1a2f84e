"""Objects that move: their points, and the rig seen from them, against points moved by hand and differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.geometry import MovingObject, RelativeMotion, poses_of
from rsbench.core.motion import Motion
from rsbench.core.se3 import transform

Triple = tuple[float, float, float]
VECTOR = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
MODELS: list[type[Motion]] = [LinearMotion, TwistMotion, AcceleratedMotion]


@given(VECTOR, VECTOR, VECTOR, st.floats(0.0, 2.0), VECTOR)
def test_an_object_turns_about_its_pivot_and_is_shifted(
    w: Triple, d: Triple, pivot: Triple, tau: float, X: Triple
) -> None:
    thing = MovingObject(np.array(pivot), LinearMotion(w, d))
    turned = Rotation.from_rotvec(tau * np.array(w)).apply(np.array(X) - pivot)
    moved = transform(thing.world_from_object(tau), np.array(X))
    np.testing.assert_allclose(moved, turned + pivot + tau * np.array(d), atol=1e-13)  # some roundings


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("own", MODELS)
def test_the_rig_seen_from_an_object(model: type[Motion], own: type[Motion]) -> None:
    """A point of the object is where the rig sees it in the world; velocities against central differences."""
    rng = np.random.default_rng(4)
    rig = model(0.3 * rng.normal(size=3), rng.normal(size=3))
    thing = MovingObject(rng.normal(size=3), own(0.5 * rng.normal(size=3), rng.normal(size=3)))
    relative, tau, X = RelativeMotion(rig, thing), rng.uniform(0.0, 2.0, 7), rng.normal(size=(7, 3))
    in_world = transform(thing.world_from_object(tau), X)
    expected = transform(rig.body_from_world(tau), in_world)
    np.testing.assert_allclose(transform(relative.body_from_world(tau), X), expected, atol=1e-13)
    np.testing.assert_allclose(so3.exp(relative.w), relative.body_from_world(1.0).R, atol=1e-13)
    step = 1e-5  # truncation 1e-10, rounding 1e-11
    after, before = (relative.body_from_world(tau + by) for by in (step, -step))
    w_rate, t_rate = relative.velocity(tau)
    R = relative.body_from_world(tau).R
    np.testing.assert_allclose((after.R - before.R) / (2 * step), so3.hat(w_rate) @ R, atol=1e-8)
    np.testing.assert_allclose((after.t - before.t) / (2 * step), t_rate, atol=1e-8)


def test_without_objects_there_are_no_poses() -> None:
    assert poses_of((), np.zeros(3)) is None
