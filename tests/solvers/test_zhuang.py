"""The differential solvers: exact on instantaneous flow, of the order of their truncation on finite motions."""

from __future__ import annotations

import numpy as np
import pytest
from differences import derivatives
from solver_trials import CAMERA, RIG, SHUTTER, W, assert_near, assert_second_order, matches_of, robust
from solver_trials import D as V

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.so3 import FloatArray
from rsbench.solvers.zhuang import Flow, Velocity, ZhuangSolver, accelerations, reprojection

LEFT = RIG.about("left")
UNIT = V / np.linalg.norm(V)
SOLVERS = {
    (kind, how): ZhuangSolver(acceleration=kind, refinement=how)
    for kind in ("none", "constant")
    for how in ("none", "reprojection")
}


def instantaneous(count: int, k: float, seed: int = 0) -> Correspondences:
    """Flow that is exactly ``beta P(x) (w x x + v / Z)``: what the method assumes, and no rigid motion."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(100.0, 800.0, (count, 2))
    x, depth = CAMERA.unproject(pixels), rng.uniform(2.0, 10.0, count)
    rate = np.cross(W, x) + V / depth[:, None]
    flow = 810.0 * (rate[:, :2] - x[:, :2] * rate[:, 2:])
    ends = pixels.copy()
    for _ in range(100):  # the share of the motion depends on the row of the end
        tau0, tau1 = SHUTTER.row_time(pixels[:, 1], 0), SHUTTER.row_time(ends[:, 1], 1)
        beta = (tau1 - tau0 + 0.5 * k * (tau1**2 - tau0**2)) * 2.0 / (2.0 + k)
        ends = pixels + beta[:, None] * flow
    return Correspondences(left=np.hstack([pixels, ends]))


@pytest.mark.parametrize("kind", ["none", "constant"])
@pytest.mark.parametrize("how", ["none", "reprojection"])
@pytest.mark.parametrize("count", [0, 50])
def test_instantaneous_flow_gives_the_exact_velocity(kind: str, how: str, count: int) -> None:
    solver, k = SOLVERS[kind, how], 0.4 if kind == "constant" else 0.0
    matches = instantaneous(count or solver.spec.minimum["left"], k)
    found = solver.estimate(matches, LEFT, SHUTTER) if count else None
    candidates = [found] if found is not None else solver.propose(matches, LEFT, SHUTTER)
    w = min((each.w for each in candidates), key=lambda w: float(np.linalg.norm(w - W)))
    # Eight matches amplify the rounding of 1e-16 by up to 1e6 (see ROUNDING in linear).
    np.testing.assert_allclose(w, W, atol=1e-8)
    if found is not None and kind == "constant":
        assert found.motion_parameters["acceleration"] == pytest.approx(k, abs=1e-6)
        np.testing.assert_allclose(found.d, UNIT, atol=1e-8)


def test_nine_matches_have_the_true_acceleration_among_the_eigenvalues() -> None:
    """The sign of k = -eig is that of a determinant which vanishes, not that of the public code."""
    flow = Flow.of(instantaneous(9, 0.4), LEFT, SHUTTER)
    Z0, Z1 = flow.system()
    found = accelerations(Z0, Z1)
    assert min(abs(k - 0.4) for k in found) < 1e-6
    for k in found:
        Z = Z0 + k * Z1
        s = np.linalg.svd(Z / np.linalg.norm(Z, axis=0), compute_uv=False)
        assert s[-1] < 1e-10 * s[0]


@pytest.mark.parametrize("kind", ["none", "constant"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_translation_along_an_axis_is_exact(kind: str, axis: int) -> None:
    """The flow of finite translations is along that of instantaneous ones: nothing is truncated."""
    solver = SOLVERS[kind, "reprojection"]
    d = 0.3 * np.eye(3)[axis]
    motion = make_motion(solver.spec.motion_model, np.zeros(3), d, solver.spec.motion_parameters)
    c = matches_of(motion, rig=LEFT, pairs=60)
    found = solver.estimate(c, LEFT, SHUTTER)
    assert found.success, found.reason
    assert rotation_error(found.w, motion.w) < 1e-8 and translation_error(found.d, d) < 1e-8
    still = make_motion(solver.spec.motion_model, np.zeros(3), np.zeros(3), solver.spec.motion_parameters)
    c = matches_of(still, rig=LEFT, pairs=60)
    assert "more than one solution" in solver.estimate(c, LEFT, SHUTTER).reason


@pytest.mark.parametrize("kind", ["none", "constant"])
@pytest.mark.parametrize("how", ["none", "reprojection"])
def test_half_the_motion_has_a_quarter_of_the_rotation_s_and_half_of_the_direction_s_error(
    kind: str, how: str
) -> None:
    """Flow of finite motion is its velocity plus terms of second order."""
    assert_second_order(SOLVERS[kind, how], seeds=10, rig=LEFT, pairs=60)


def test_derivatives_are_those_of_finite_differences() -> None:
    flow = Flow.of(instantaneous(20, 0.1), LEFT, SHUTTER)
    p = np.concatenate([W + 0.01, UNIT, [0.3]])

    def at(p: FloatArray) -> FloatArray:
        return reprojection(flow, Velocity(p[:3], p[3:6], float(p[6])))[0]

    found = reprojection(flow, Velocity(p[:3], p[3:6], 0.3))[1]
    np.testing.assert_allclose(found, derivatives(at, p, 1e-6), rtol=1e-5, atol=1e-5)


def test_the_robust_loop_judges_matches_by_the_acceleration_that_was_found() -> None:
    """With that of the spec, 0.2, half of these matches would be outliers."""
    solver = SOLVERS["constant", "reprojection"]
    motion = make_motion("accelerated", 0.5 * W, 0.5 * V, {"acceleration": 1.5})
    options = SimulationOptions(pairs=150, noise_px=0.1, outlier_ratio=0.2)
    s = simulate(RIG, SHUTTER, motion, options, np.random.default_rng(3))
    found = robust(s.correspondences, solver)
    assert found.estimate.motion_parameters["acceleration"] == pytest.approx(1.5, abs=0.5)
    assert np.mean(found.inliers["left"]) > 0.7
    assert_near(found.estimate, motion, 0.1, 3.0, "left")
