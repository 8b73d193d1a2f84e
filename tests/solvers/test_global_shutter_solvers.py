"""Global-shutter baselines, and what one line of flow scaling makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error, translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.zhuang import FlowScaledSolver, scale_flow

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)


def trial(
    seed: int, model: str, noise_px: float, shutter: RollingShutter = SHUTTER, tracks: bool = False
) -> Simulation:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng, np.radians(2.0), 0.3, "twist" if model == "twist" else "linear")
    options = SimulationOptions(pairs=0 if tracks else 100, tracks=100 if tracks else 0, noise_px=noise_px)
    return simulate(RIG, shutter, motion, options, np.random.default_rng(seed))


def medians(name: str, model: str, noise_px: float, trials: int = 30) -> tuple[float, float]:
    """Median e_R and e_T in degrees, e_T of the solver's own point of the rig."""
    solver = load_solver(name)
    errors = []
    for seed in range(trials):
        s = trial(seed, model, noise_px, tracks="tracks" in solver.spec.needs)
        estimate = solver.estimate(s.correspondences, RIG, SHUTTER)
        assert estimate.success, estimate.reason
        d = s.motion.d
        if solver.spec.reference_point == "left":
            d = translation_of_offset(s.motion.w, d, RIG.offset("left"))
        errors.append([float(rotation_error(estimate.w, s.motion.w)), float(translation_error(estimate.d, d))])
    e_R, e_T = np.degrees(np.median(errors, axis=0))
    return float(e_R), float(e_T)


# Bands around medians of 150 motions of 2 degrees and 0.3 m, from the scripts that this package was designed with
# (PoseLib 2.0.5 and OpenCV called directly, the rest in NumPy; none of it is in here). They catch a wrong frame or
# scale, not a per cent: 30 motions scatter by 25 %.
@pytest.mark.parametrize(
    ("name", "model", "noise_px", "e_R", "e_T"),
    [
        ("gs-poselib", "linear", 0.0, 0.051, 0.95),
        ("gs-poselib", "linear", 0.81, 0.077, 1.19),
        ("gs-poselib-stereo", "linear", 0.0, 0.051, 0.92),
        ("gs-poselib-stereo", "linear", 0.81, 0.069, 1.08),
        ("gs-stereo-pnp", "linear", 0.0, 0.077, 0.80),
        ("gs-stereo-pnp", "linear", 0.81, 0.084, 0.90),
        ("gs-stereo-tracks", "linear", 0.0, 0.075, 0.79),
        ("gs-stereo-tracks", "linear", 0.81, 0.070, 0.88),
        ("gs-8pt", "twist", 0.0, 0.048, 0.56),
        ("gs-8pt-scaled", "twist", 0.81, 0.105, 0.72),
        ("gs-poselib-stereo", "twist", 0.0, 0.044, 0.49),
        ("gs-poselib-stereo-scaled", "twist", 0.81, 0.042, 0.40),
        ("rs-stereo-tracks", "linear", 0.81, 0.021, 0.23),
    ],
)
def test_accuracy_is_the_known_one(name: str, model: str, noise_px: float, e_R: float, e_T: float) -> None:
    measured = medians(name, model, noise_px)
    assert e_R / 1.6 < measured[0] < 1.6 * e_R
    assert e_T / 1.6 < measured[1] < 1.6 * e_T


@pytest.mark.parametrize(
    "name", ["gs-8pt", "gs-poselib", "gs-poselib-stereo", "gs-stereo-pnp", "gs-stereo-tracks"]
)
def test_flow_scaling_removes_most_of_the_error_on_twist_data(name: str) -> None:
    plain, scaled = medians(name, "twist", 0.0), medians(f"{name}-scaled", "twist", 0.0)
    assert scaled[0] < 0.15 * plain[0]
    assert scaled[1] < 0.2 * plain[1]


@pytest.mark.parametrize("name", ["gs-poselib-stereo", "gs-stereo-tracks", "gs-stereo-pnp"])
def test_stereo_baselines_are_metric(name: str) -> None:
    solver = load_solver(name)
    s = trial(0, "linear", 0.0, GLOBAL, tracks="tracks" in solver.spec.needs)
    estimate = solver.estimate(s.correspondences, RIG, GLOBAL)
    assert estimate.metric and scale_error(estimate.d, s.motion.d) < 1e-6


def test_both_global_shutter_optima_agree(tmp_path: Path) -> None:
    """Our descent without readout and PoseLib's on the same left and right pairs."""
    card = tmp_path / "ours.toml"
    card.write_text(
        'class = "rsbench.solvers.refined:RefinedSolver"\n[parameters]\nshutter = "global"\nuse_tracks = false\n'
    )
    ours, theirs = load_solver(card), load_solver("gs-poselib-stereo")
    assert ours.spec.shutter == "global"
    for seed in range(5):
        s = trial(seed, "linear", 0.5)
        first, second = (solver.estimate(s.correspondences, RIG, SHUTTER) for solver in (ours, theirs))
        assert np.degrees(rotation_error(first.w, second.w)) < 1e-5
        assert np.degrees(translation_error(first.d, second.d)) < 1e-4


def test_scaled_matches_took_one_frame_period() -> None:
    """Points that move at constant image velocity: exact for the scaling."""
    rng = np.random.default_rng(0)
    start, velocity = rng.uniform(200, 700, (20, 2)), rng.uniform(-30, 30, (20, 2))
    duration = np.ones(20)
    for _ in range(30):
        duration = 1.0 + SHUTTER.h * velocity[:, 1] * duration
    left = np.hstack([start, start + velocity * duration[:, None]])
    tracks = np.hstack([start, start - [40, 0], left[:, 2:], left[:, 2:] - [40, 0]])
    scaled = scale_flow(Correspondences(left=left, right=left, tracks=tracks), RIG, SHUTTER)
    expected = np.hstack([start, start + velocity])
    np.testing.assert_allclose(scaled.left, expected, atol=1e-9)
    np.testing.assert_allclose(scaled.right, expected, atol=1e-9)
    np.testing.assert_allclose(scaled.tracks[:, [0, 1, 4, 5]], expected, atol=1e-9)
    np.testing.assert_allclose(scaled.tracks[:, [2, 3, 6, 7]], expected - [40, 0, 40, 0], atol=1e-9)


def test_without_readout_scaling_changes_nothing() -> None:
    c = trial(0, "linear", 0.5, tracks=True).correspondences
    np.testing.assert_allclose(scale_flow(c, RIG, GLOBAL).tracks, c.tracks, atol=1e-9)


def test_scaled_solver_declares_what_its_inner_one_does(tmp_path: Path) -> None:
    solver = load_solver("gs-poselib-scaled")
    assert isinstance(solver, FlowScaledSolver)
    inner = load_solver("gs-poselib")
    assert (solver.spec.needs, solver.spec.minimum, solver.spec.reference_point) == (
        inner.spec.needs,
        inner.spec.minimum,
        "left",
    )
    assert (
        solver.spec.shutter == "rolling"
        and solver.spec.motion_model == "twist"
        and "Zhuang" in solver.spec.reference
    )
    for text, message in (("rs-stereo-linear", "must be a global-shutter solver"), ("gs-9pt", "gs-9pt")):
        card = tmp_path / "bad.toml"
        card.write_text(f'class = "rsbench.solvers.zhuang:FlowScaledSolver"\n[parameters]\nsolver = "{text}"\n')
        with pytest.raises(RsbenchError, match=message):
            load_solver(card)
    card.write_text(f'class = "rsbench.solvers.zhuang:FlowScaledSolver"\n[parameters]\nsolver = "{card}"\n')
    with pytest.raises(RsbenchError, match="refers to this card itself"):
        load_solver(card)


def test_tracks_only_solver_wants_tracks() -> None:
    motion = LinearMotion(np.array([0.01, 0.02, -0.01]), np.array([0.1, 0.2, 0.1]))
    c = simulate(RIG, SHUTTER, motion, SimulationOptions(pairs=30), np.random.default_rng(0)).correspondences
    estimate = load_solver("rs-stereo-tracks").estimate(c, RIG, SHUTTER)
    assert not estimate.success and "tracks" in estimate.reason
    assert load_solver("rs-stereo-tracks").spec.needs == {"tracks"}
