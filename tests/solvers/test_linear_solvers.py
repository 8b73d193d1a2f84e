"""The paper's solver, the reduced one and the eight-point algorithm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from solver_trials import GLOBAL, RIG, SHUTTER, assert_near, matches_of, median_errors, trial

from rsbench.components.motion_models import LinearMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import Side
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.engine.packed import pack
from rsbench.solvers.essential_matrix import EightPointSolver, decompose_essential, eight_point
from rsbench.solvers.linear import (
    IteratedSolver,
    LinearSolver,
    far_apart,
    length_from_tracks,
    null_vector,
    reduced_blocks,
    rotation_from_essential,
    scaled_translation,
    system_rows,
)

SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def unknowns(w: FloatArray, d: FloatArray) -> FloatArray:
    """X (19,) of a motion, in the order of ``system_rows``."""
    E = hat(d) @ hat(w)
    products = [w[0] * w[1], w[0] * w[2], w[1] * w[1], w[1] * w[2], w[2] * w[2]]
    return np.concatenate([d, w[1:], E.ravel(), products])


def all_unknowns(w: FloatArray, d: FloatArray) -> FloatArray:
    """X (27,) of a motion, with the eight third-order unknowns."""
    return np.concatenate([unknowns(w, d), np.outer(w, np.cross(w, d)).ravel()[:8]])


def paper_constraint(
    match: FloatArray, sign: float, w: FloatArray, d: FloatArray, complete: bool = False
) -> float:
    """Eq. 7 (sign 1) and 8 (sign -1), with or without the last term, in the paper's axes (down, right, forward).

    Written out with the paper's own matrices, baseline (0, b, 0), and rays whose first component is the row.
    """
    camera, h = RIG.camera, SHUTTER.readout_ratio / SHUTTER.height
    x0, y0, x1, y1 = match
    ray0 = np.array([(y0 - camera.cy) / camera.fy, (x0 - camera.cx) / camera.fx, 1.0])
    ray1 = np.array([(y1 - camera.cy) / camera.fy, (x1 - camera.cx) / camera.fx, 1.0])
    k1, k3 = h * y0, 1 + h * y1
    a = k3 - k1
    b = sign * np.array([0.0, RIG.baseline / 2, 0.0])
    E = (
        a * hat(d)
        - a * hat(hat(w) @ b)
        + a**2 * hat(d) @ hat(w)
        - a * k1 * hat(hat(w) @ d)
        - a**2 * hat(hat(w) @ b) @ hat(w)
    )
    if complete:
        E -= a**2 * k1 * hat(hat(w) @ d) @ hat(w)
    return float(ray1 @ E @ ray0)


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=25)
def test_rows_equal_the_papers_equations_in_the_papers_axes(side: Side, sign: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    match = rng.uniform(0, 899, 4)
    w, d = rng.standard_normal(3), rng.standard_normal(3)
    # Swapping two axes mirrors space: a rotation vector changes sign, and so does every triple product.
    for complete, X in ((False, unknowns(w, d)), (True, all_unknowns(w, d))):
        expected = -paper_constraint(match, sign, -SWAP @ w, SWAP @ d, complete)
        rows = system_rows(match[None], side, RIG, SHUTTER, complete)
        assert rows[0] @ X == pytest.approx(expected, abs=1e-12)


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), sign=st.sampled_from([-1.0, 1.0]))
def test_tracks_hold_the_length_of_a_known_direction(seed: int, sign: float) -> None:
    """Exact for exact matches, with the sign, whatever the motion; rounding of the tracks is all that remains."""
    s = trial(np.random.default_rng(seed), tracks=12)
    packed = pack(Correspondences(tracks=s.correspondences.tracks), RIG, SHUTTER)
    length = length_from_tracks(packed.tracks, packed, s.motion.w, sign * s.motion.d / 0.3)
    assert length == pytest.approx(0.3 * sign, rel=1e-8)


def test_left_right_matches_give_what_the_baseline_columns_cannot() -> None:
    """At 0.3 px and 100 tracks the length is off by 1 % with the disparities, by 4 % without."""
    errors = []
    for seed in range(20):
        c = trial(np.random.default_rng([9, seed]), tracks=100, noise_px=0.3).correspondences
        for scale in ("pairs", "tracks"):
            estimate = IteratedSolver(scale=scale).estimate(c, RIG, SHUTTER)
            errors.append(abs(float(np.linalg.norm(estimate.d)) / 0.3 - 1.0) if estimate.metric else 1.0)
    pairs, metric = np.median(np.reshape(errors, (20, 2)), axis=0)
    assert metric < 0.02 and pairs > 2.0 * metric


def test_the_symmetric_extraction_is_better_with_minimal_samples() -> None:
    """0.057 degrees against 0.319 in the design's NumPy code (see above)."""
    full, symmetric = (median_errors(LinearSolver(extraction=e), pairs=9)[0] for e in ("full", "symmetric"))
    assert symmetric < 0.1
    assert full > 2 * symmetric


def test_with_nine_matches_no_scaling_changes_the_solution() -> None:
    """Eighteen equations in 19 unknowns have one solution, whatever is minimised."""
    c = trial(np.random.default_rng(4), pairs=9, noise_px=0.3).correspondences
    literal = LinearSolver().estimate(c, RIG, SHUTTER)
    others = [LinearSolver(scaling="unit-columns"), LinearSolver(baseline_unit="half-baseline")]
    for solver in others:
        found = solver.estimate(c, RIG, SHUTTER)
        # Rounding, times the condition of A.
        np.testing.assert_allclose(found.w, literal.w, atol=1e-6)
        np.testing.assert_allclose(found.d, literal.d, atol=1e-5)


def test_all_unknowns_need_more_matches_and_leave_less_error() -> None:
    """Without noise, what remains of the 27 is the small-angle approximation; refused below 13 + 13."""
    s = trial(np.random.default_rng(0), pairs=100)
    c, found = s.correspondences, LinearSolver(terms="third").estimate(s.correspondences, RIG, SHUTTER)
    assert found.success and rotation_error(found.w, s.motion.w) < np.radians(0.2)
    few = Correspondences(left=c.left[:12], right=c.right[:12])
    assert "need 13" in LinearSolver(terms="third").estimate(few, RIG, SHUTTER).reason


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 40))
def test_chosen_matches_stand_apart(seed: int, n: int) -> None:
    """Against brute force: what is left out stands no farther from the chosen than the chosen from each other."""
    matches = np.random.default_rng(seed).uniform(0.0, 900.0, (n, 4))
    chosen = far_apart(matches, 9)
    assert len(chosen) == min(n, 9) and len(np.unique(chosen, axis=0)) == len(chosen)
    gaps = np.linalg.norm(chosen[:, None, :2] - chosen[None, :, :2], axis=2)
    least = np.min(gaps[np.triu_indices(len(chosen), 1)], initial=np.inf)
    left_out = np.min(np.linalg.norm(matches[:, None, :2] - chosen[None, :, :2], axis=2), axis=1)
    assert np.max(left_out) <= least


def test_nine_far_apart_solve_better_than_any_nine() -> None:
    errors = []
    for seed in range(30):
        s = trial(np.random.default_rng([7, seed]), pairs=100, noise_px=1e-3)
        c = s.correspondences
        nine = Correspondences(left=c.left[:9], right=c.right[:9])
        estimates = [LinearSolver(sampling="nine-apart").estimate(c, RIG, SHUTTER)]
        estimates.append(LinearSolver().estimate(nine, RIG, SHUTTER))
        errors.append([rotation_error(found.w, s.motion.w) for found in estimates])
    apart, any_nine = np.median(errors, axis=0)
    assert apart < any_nine


def estimate_linear(w: FloatArray, d: FloatArray, shutter: RollingShutter = SHUTTER, noise_px: float = 0.0) -> str:
    c = matches_of(LinearMotion(w, d), seed=1, shutter=shutter, pairs=100, noise_px=noise_px)
    return LinearSolver().estimate(c, RIG, shutter).reason


@pytest.mark.parametrize("direction", [[0.3, 0.2, -0.4], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
def test_pure_translation_is_singular_for_the_paper_s_system(direction: list[float]) -> None:
    assert estimate_linear(np.zeros(3), 0.3 * np.array(direction))


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_a_global_shutter_is_singular_for_the_paper_s_system(noise_px: float) -> None:
    reason = estimate_linear(np.array([0.01, 0.02, -0.01]), np.array([0.1, 0.2, 0.1]), GLOBAL, noise_px)
    assert "more than one solution" in reason


@pytest.mark.parametrize("phi", [0.2, 0.8, 1.0])
def test_generic_motion_is_regular_at_every_readout_ratio(phi: float) -> None:
    shutter = RollingShutter(height=900, readout_ratio=phi)
    assert not estimate_linear(np.array([0.01, 0.02, -0.01]), np.array([0.1, 0.2, 0.1]), shutter)


@pytest.mark.parametrize("unit_columns", [False, True])
def test_null_vector_refuses_ambiguity(unit_columns: bool) -> None:
    rng = np.random.default_rng(0)
    X = rng.standard_normal(5)
    A = rng.standard_normal((30, 5))
    A -= np.outer(A @ X, X) / (X @ X)
    found, _ = null_vector(A, unit_columns)
    assert found is not None
    assert abs(found @ X) == pytest.approx(np.linalg.norm(found) * np.linalg.norm(X))
    assert null_vector(A[:3], unit_columns)[0] is None
    assert null_vector(A * [1, 1, 1, 1, 0], unit_columns)[0] is None


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6))
def test_choices_left_open_agree_without_noise(seed: int) -> None:
    """The null space of exact data of the paper's own truncated model has one dimension, however A is scaled."""
    c = trial(np.random.default_rng(seed), degrees=0.2, pairs=100).correspondences
    literal = LinearSolver(scaling="none").estimate(c, RIG, SHUTTER)
    others = [
        LinearSolver(scaling="unit-columns"),
        LinearSolver(scaling="none", baseline_unit="half-baseline"),
        LinearSolver(extraction="symmetric"),
        LinearSolver(scale="constraint"),
    ]
    for solver in others:
        found = solver.estimate(c, RIG, SHUTTER)
        # Truncation error of the model, third order in the motion.
        assert rotation_error(found.w, literal.w) < 1e-4
        assert translation_error(found.d, literal.d) < 1e-3


@pytest.mark.parametrize("symmetric", [False, True])
def test_rotation_from_essential_inverts_its_definition(symmetric: bool) -> None:
    rng = np.random.default_rng(0)
    w, d = rng.standard_normal(3), rng.standard_normal(3)
    np.testing.assert_allclose(rotation_from_essential(hat(d) @ hat(w), d, symmetric), w, atol=1e-12)


def test_rows_and_reduced_rows_vanish_to_third_order_on_exact_data() -> None:
    sizes = []
    for scale in (1.0, 0.1):
        w, d = scale * np.array([0.02, -0.03, 0.025]), scale * np.array([0.2, 0.1, -0.2])
        c = matches_of(LinearMotion(w, d), pairs=50)
        rows = system_rows(c.left, "left", RIG, SHUTTER)
        by_d, shifted, rest = reduced_blocks(pack(c, RIG, SHUTTER).pairs)
        E = hat(d) @ hat(w)
        E = 0.5 * (E + E.T)
        products = [w[0] * w[1], w[0] * w[2], w[1] * w[2], w[2] ** 2 - w[1] ** 2]
        others = np.concatenate([w[1:], E[np.triu_indices(3)], products])
        reduced = (by_d + np.cross(w, shifted)) @ d + rest @ others
        sizes.append([np.max(np.abs(rows @ unknowns(w, d))), np.max(np.abs(reduced))])
    np.testing.assert_allclose(np.divide(sizes[0], sizes[1]), 1000.0, rtol=0.3)


def test_scaled_translation_is_exact_for_the_true_rotation() -> None:
    motion = LinearMotion(np.array([0.02, -0.03, 0.025]), np.array([0.2, 0.1, -0.2]))
    c = matches_of(motion, seed=5, pairs=20)
    d = scaled_translation(pack(c, RIG, SHUTTER).pairs, motion.w, limit=50.0)
    assert d is not None
    np.testing.assert_allclose(d, motion.d, atol=1e-9)


@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3),
    t=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda t: np.linalg.norm(t) > 0.2),
)
@settings(max_examples=25)
def test_eight_point_on_exact_global_shutter_data(
    axis: tuple[float, float, float], t: tuple[float, float, float]
) -> None:
    R = Rotation.from_rotvec(0.3 * np.array(axis)).as_matrix()
    X = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 8], (20, 3))
    Y = X @ R.T + np.array(t)
    x0, x1 = X / X[:, 2:], Y / Y[:, 2:]
    E = eight_point(x0, x1)
    assert E is not None
    pose, front = decompose_essential(E, x0, x1)
    assert front == 20
    np.testing.assert_allclose(pose.R, R, atol=1e-7)
    np.testing.assert_allclose(pose.t, np.array(t) / np.linalg.norm(t), atol=1e-6)


def test_eight_point_gives_the_left_camera_s_motion() -> None:
    motion = LinearMotion(np.array([0.01, 0.05, -0.02]), np.array([0.2, 0.1, -0.2]))
    estimate = EightPointSolver().estimate(matches_of(motion, shutter=GLOBAL, pairs=30), RIG, GLOBAL)
    assert_near(estimate, motion, 5e-7, 5e-6, "left")
    assert translation_error(estimate.d, motion.d) > 1e-3 and not estimate.metric
