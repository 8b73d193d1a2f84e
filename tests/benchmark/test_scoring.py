"""The one scorer of motions, against poses chained by hand and the policy of docs/explanation/conventions.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from solver_trials import RIG

from rsbench.benchmark.scoring import WORST_POSE, answered, pose_errors
from rsbench.core.so3 import FloatArray

W, D = np.array([0.01, -0.03, 0.02]), np.array([0.1, -0.05, 0.3])
few = settings(max_examples=40)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


def errors(w: Any = W, d: Any = D, **changes: Any) -> dict[str, FloatArray]:
    truth: dict[str, Any] = {"true_w": W, "true_d": D, "rig": RIG}
    return pose_errors(w, d, **truth | changes)


def test_the_truth_scores_the_best_value_of_each_error() -> None:
    found = errors()
    assert list(found) == list(WORST_POSE)
    # Rounding of R R^T; direction and length of equal vectors are exact.
    assert found["e_R_deg"] == pytest.approx(0.0, abs=1e-13)
    assert found["e_T_deg"] == found["e_s"] == 0.0


@few
@given(vectors, vectors)
def test_errors_are_those_of_scipys_rotations_and_of_angles_between_vectors(w: FloatArray, d: FloatArray) -> None:
    found = errors(w, d)
    turned = Rotation.from_rotvec(w) * Rotation.from_rotvec(W).inv()
    assert found["e_R_deg"] == pytest.approx(np.degrees(turned.magnitude()), abs=1e-11)
    if np.linalg.norm(d) > 1e-6:
        unit, true = d / np.linalg.norm(d), D / np.linalg.norm(D)
        # Kahan's angle between unit vectors: exact near 0 and 180 degrees, unlike acos.
        angle = 2 * np.arctan2(np.linalg.norm(unit - true), np.linalg.norm(unit + true))
        assert found["e_T_deg"] == pytest.approx(np.degrees(angle), abs=1e-11)
        assert found["e_s"] == pytest.approx(abs(np.log(np.linalg.norm(d)) - np.log(np.linalg.norm(D))), abs=1e-11)


@pytest.mark.parametrize("w", [np.zeros(3), W, np.array([1.0, -2.0, 0.5])])
def test_an_answer_for_the_left_camera_is_scored_against_the_path_of_that_camera(w: FloatArray) -> None:
    # The body stands at the world's origin at first, so the left camera is where x_body = (-baseline / 2, 0, 0).
    start = np.array([-RIG.baseline / 2, 0.0, 0.0])
    # A point of the first left camera's frame, in that of the second: to the body, through the motion, back.
    own = Rotation.from_rotvec(w).apply(start) + D - start
    found = errors(w, 3.0 * own, true_w=w, reference_point="left", metric=False)
    assert found["e_T_deg"] == pytest.approx(0.0, abs=1e-9)  # rounding of a difference of numbers near 1
    assert np.isnan(found["e_s"])
    turns = np.any(w != 0.0)
    assert (errors(w, own, true_w=w)["e_T_deg"] > 0.1) == turns


FAILURES = {
    "says so": {"success": False},
    "has no rotation": {"w": np.full(3, np.nan)},
    "has no translation": {"d": np.array([1.0, np.inf, 0.0])},
    "says so without metres": {"success": False, "metric": False, "w": np.full(3, np.nan)},
}


@pytest.mark.parametrize("changes", FAILURES.values(), ids=FAILURES)
def test_a_failure_scores_the_worst_value_of_each_error(changes: dict[str, Any]) -> None:
    assert {name: float(value) for name, value in errors(**changes).items()} == {
        "e_R_deg": 180.0,
        "e_T_deg": 180.0,
        "e_s": np.inf,
    }
    given: dict[str, Any] = {"w": W, "d": D, "success": True} | changes
    assert not answered(given["w"], given["d"], given["success"])


def test_no_direction_is_scored_where_the_true_translation_is_zero() -> None:
    for success in (True, False):
        assert np.isnan(errors(true_d=np.zeros(3), success=success)["e_T_deg"])
    assert np.isnan(errors(true_d=np.zeros(3))["e_s"])
    # The left camera of a turning rig moves even then.
    assert np.isfinite(errors(true_d=np.zeros(3), reference_point="left")["e_T_deg"])


def test_the_sign_of_the_translation_counts() -> None:
    assert errors(d=-2.0 * D)["e_T_deg"] == pytest.approx(180.0, abs=1e-12)
    assert errors(d=-2.0 * D)["e_s"] == pytest.approx(np.log(2.0), rel=1e-12)


def test_a_point_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="reference_point = 'Left': must be 'body' or 'left'"):
        errors(reference_point="Left")
