"""What every registered solver promises, whichever it is."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.metrics import rotation_error, translation_error, translation_of_offset
from rsbench.core.motion import MOTION_MODELS
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.registry import list_solvers, load_solver, load_solver_entry

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
ROLLING = RollingShutter(height=900, readout_ratio=0.8)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)
W, D = np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18])

# Radians, rotation and translation, on exact data of 60 + 60 matches and 60 tracks at 1.6 degrees per frame: the
# linearisation of linear solvers and of the flow scaling (second order in the rotation), rounding for exact ones.
MODEL_ERROR = {
    "rs-stereo-linear": (2e-3, 3e-3),
    "rs-stereo-linear-symmetric": (2e-3, 3e-3),
    "rs-stereo-iterated": (1e-3, 1e-3),
    "rs-stereo-iterated-metric": (1e-3, 1e-3),
    "gs-8pt-scaled": (5e-4, 3e-3),
    "gs-poselib-scaled": (5e-4, 3e-3),
    "gs-poselib-stereo-scaled": (5e-4, 3e-3),
    "gs-stereo-pnp-scaled": (5e-4, 3e-3),
    "gs-stereo-tracks-scaled": (5e-4, 3e-3),
}
# OpenCV draws five of the matches, in the order given, and keeps one model.
ORDER = {"gs-5pt-opencv": (1e-6, 1e-5)}
EXACT = (1e-7, 1e-6)

pytestmark = pytest.mark.parametrize("name", list_solvers())


def own_problem(
    solver: Solver, pairs: int = 60, tracks: int = 60, w: FloatArray = W, d: FloatArray = D
) -> Simulation:
    """Noise-free data that satisfy what the solver assumes."""
    shutter = ROLLING if solver.spec.shutter == "rolling" else GLOBAL
    motion = MOTION_MODELS[solver.spec.motion_model](w, d)
    options = SimulationOptions(pairs=pairs, tracks=tracks)
    return simulate(RIG, shutter, motion, options, np.random.default_rng(5))


def solve(solver: Solver, correspondences: Correspondences, shutter: RollingShutter) -> MotionEstimate:
    estimate = solver.estimate(correspondences, RIG, shutter)
    assert estimate.success == bool(np.all(np.isfinite([estimate.w, estimate.d])))
    assert estimate.success or estimate.reason
    if estimate.covariance is not None:
        assert np.all(np.isfinite(estimate.covariance))
        assert np.all(np.linalg.eigvalsh(estimate.covariance) >= 0.0)
    return estimate


def true_translation(solver: Solver, simulation: Simulation) -> FloatArray:
    motion = simulation.motion
    if solver.spec.reference_point == "body":
        return motion.d
    return translation_of_offset(motion.w, motion.d, RIG.offset("left"))


def test_declares_what_it_is(name: str) -> None:
    entry = load_solver_entry(name)
    assert entry.name == name
    assert entry.solver.spec.motion_model in MOTION_MODELS  # the rest is checked when a spec is made


def test_finds_the_truth(name: str) -> None:
    solver = load_solver(name)
    simulation = own_problem(solver)
    estimate = solve(solver, simulation.correspondences, simulation.shutter)
    assert estimate.success, estimate.reason
    tolerance = MODEL_ERROR.get(name, EXACT)
    d = true_translation(solver, simulation)
    assert rotation_error(estimate.w, simulation.motion.w) < tolerance[0]
    assert translation_error(estimate.d, d) < tolerance[1]
    if estimate.metric:
        # The linear solvers' scale hangs on w x baseline alone: 1 % per 0.01 % of model error.
        assert np.linalg.norm(estimate.d) == pytest.approx(
            np.linalg.norm(d), rel=0.1 if name in MODEL_ERROR else 1e-6
        )


def test_order_of_matches_does_not_matter(name: str) -> None:
    solver = load_solver(name)
    simulation = own_problem(solver)
    c = simulation.correspondences
    rng = np.random.default_rng(1)
    shuffled = Correspondences(
        left=rng.permutation(c.left), right=rng.permutation(c.right), tracks=rng.permutation(c.tracks)
    )
    first, second = (solve(solver, each, simulation.shutter) for each in (c, shuffled))
    w_tolerance, d_tolerance = ORDER.get(name, (1e-9, 1e-7))
    np.testing.assert_allclose(second.w, first.w, atol=w_tolerance)
    np.testing.assert_allclose(second.d, first.d, atol=d_tolerance)


def test_is_deterministic_and_leaves_its_input_alone(name: str) -> None:
    solver = load_solver(name)
    simulation = own_problem(solver)
    c = simulation.correspondences
    before = [c.left.copy(), c.right.copy(), c.tracks.copy()]
    first, second = (solve(solver, c, simulation.shutter) for _ in range(2))
    assert first.w.tobytes() == second.w.tobytes() and first.d.tobytes() == second.d.tobytes()
    for old, new in zip(before, [c.left, c.right, c.tracks], strict=True):
        assert old.tobytes() == new.tobytes()


def degenerate(case: str, rng: np.random.Generator) -> tuple[Correspondences, RollingShutter]:
    zeros = Correspondences(left=np.zeros((20, 4)), right=np.zeros((20, 4)), tracks=np.zeros((20, 8)))
    if case == "all zero":
        return zeros, ROLLING
    motions = {"pure rotation": (W, 0 * D), "pure translation": (0 * W, D), "no motion": (0 * W, 0 * D)}
    w, d = motions.get(case, (W, D))
    shutter = GLOBAL if case == "global shutter" else ROLLING
    options = SimulationOptions(pairs=30, tracks=30, shape="plane" if case == "plane" else "box")
    c = simulate(RIG, shutter, MOTION_MODELS["linear"](w, d), options, rng).correspondences
    if case == "repeated":
        return Correspondences(left=c.left[[0] * 20], right=c.right[[0] * 20], tracks=c.tracks[[0] * 20]), shutter
    if case == "too few":
        return Correspondences(left=c.left[:2], right=c.right[:2], tracks=c.tracks[:2]), shutter
    if case == "one camera":
        return Correspondences(left=c.left), shutter
    if case == "empty":
        return Correspondences(), shutter
    if case == "collinear":
        line = np.linspace(100.0, 800.0, 20)
        pair = np.column_stack([line, line, line + 9.0, line + 7.0])
        tracks = np.column_stack([line, line, line - 60, line, line + 9, line + 7, line - 51, line + 7])
        return Correspondences(left=pair, right=pair, tracks=tracks), shutter
    if case == "negative disparity":
        return Correspondences(tracks=c.tracks[:, [2, 3, 0, 1, 6, 7, 4, 5]]), shutter
    if case == "random":
        return Correspondences(
            left=rng.uniform(0, 899, (30, 4)),
            right=rng.uniform(0, 899, (30, 4)),
            tracks=rng.uniform(0, 899, (30, 8)),
        ), shutter
    if case == "far outside":
        return Correspondences(left=1e7 * c.left, right=1e7 * c.right, tracks=1e7 * c.tracks), shutter
    return c, shutter


@pytest.mark.parametrize(
    "case",
    [
        "all zero",
        "pure rotation",
        "pure translation",
        "no motion",
        "global shutter",
        "plane",
        "repeated",
        "too few",
        "one camera",
        "empty",
        "collinear",
        "negative disparity",
        "random",
        "far outside",
    ],
)
@pytest.mark.parametrize("sets", ["pairs", "tracks", "both"])
def test_degenerate_input_gives_a_finite_motion_or_a_failure(name: str, case: str, sets: str) -> None:
    c, shutter = degenerate(case, np.random.default_rng(2))
    if sets == "pairs":
        c = Correspondences(left=c.left, right=c.right)
    elif sets == "tracks":
        c = Correspondences(tracks=c.tracks)
    estimate = solve(load_solver(name), c, shutter)  # checks finiteness
    if case in ("too few", "empty"):
        assert not estimate.success


def test_a_mirrored_world_has_the_mirrored_motion(name: str) -> None:
    """Left and right change places when x is mirrored: d_x, w_y and w_z change sign."""
    solver = load_solver(name)
    if solver.spec.reference_point == "left":
        pytest.skip("the mirror image of the left camera is the right one")
    simulation = own_problem(solver)
    c = simulation.correspondences
    last = RIG.camera.width - 1

    def flip(matches: FloatArray) -> FloatArray:
        out = matches.copy()
        out[:, ::2] = last - out[:, ::2]
        return out

    mirrored = Correspondences(
        left=flip(c.right), right=flip(c.left), tracks=flip(c.tracks[:, [2, 3, 0, 1, 6, 7, 4, 5]])
    )
    first, second = (solve(solver, each, simulation.shutter) for each in (c, mirrored))
    np.testing.assert_allclose(second.w, first.w * [1, -1, -1], atol=1e-8)
    np.testing.assert_allclose(second.d, first.d * [-1, 1, 1], atol=1e-6)
