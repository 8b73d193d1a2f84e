"""A solver's answer as the body's motion: converted exactly, or refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from solver_trials import RIG

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core.motion import Motion
from rsbench.pipeline.frame_motion import body_motion
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.essential_matrix import EightPointSolver
from rsbench.solvers.refined import RefinedSolver

BODY, LEFT = RefinedSolver().spec, EightPointSolver.spec
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def left_answer(motion: Motion) -> MotionEstimate:
    """What a metric solver of the left camera would say: cam1_from_cam0, composed from the rig's poses."""
    first, second = (rig_pose(motion, tau) for tau in (0.0, 1.0))
    moved = second @ np.linalg.inv(first)
    return MotionEstimate(w=motion.w, d=moved[:3, 3], success=True, metric=True)


def rig_pose(motion: Motion, tau: float) -> np.ndarray:
    R, t = RIG.cam_from_world(motion, tau, "left")
    return np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@given(w=vectors, d=vectors)
def test_a_left_cameras_motion_becomes_the_bodys(w: np.ndarray, d: np.ndarray) -> None:
    found = body_motion(left_answer(LinearMotion(w, d)), LEFT, RIG)
    assert isinstance(found, LinearMotion)
    np.testing.assert_allclose(found.w, w)
    np.testing.assert_allclose(found.d, d, atol=1e-14)  # a few roundings of numbers near 1


@given(w=vectors, d=vectors)
def test_a_constant_twist_stays_one_between_the_rows(w: np.ndarray, d: np.ndarray) -> None:
    """The left camera's own screw, at half the period, against the rig's camera pose at that time."""
    answer = left_answer(TwistMotion(w, d))
    found = body_motion(answer, replace(LEFT, motion_model="twist"), RIG)
    assert isinstance(found, Motion)
    R, t = TwistMotion(answer.w, answer.d).body_from_world(0.5)  # of the camera about its own centre
    moved = rig_pose(found, 0.5) @ np.linalg.inv(rig_pose(found, 0.0))
    np.testing.assert_allclose(moved[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(moved[:3, 3], t, atol=1e-12)


def test_a_body_motion_in_metres_stays_as_it_is() -> None:
    answer = MotionEstimate(w=np.full(3, 0.01), d=np.full(3, 0.2), success=True, metric=True)
    found = body_motion(answer, BODY, RIG)
    assert isinstance(found, LinearMotion)
    np.testing.assert_array_equal([found.w, found.d], [answer.w, answer.d])


@pytest.mark.parametrize(("spec", "word"), [(LEFT, "left camera"), (BODY, "metres")])
def test_a_direction_is_refused(spec: object, word: str) -> None:
    answer = MotionEstimate(w=np.zeros(3), d=np.array([0.0, 0.0, 1.0]), success=True, metric=False)
    found = body_motion(answer, spec, RIG)  # pyrefly: ignore[bad-argument-type]
    assert isinstance(found, str) and word in found


def test_a_failure_keeps_its_reason() -> None:
    assert body_motion(MotionEstimate.failed("three matches"), BODY, RIG) == "three matches"
