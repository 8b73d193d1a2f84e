"""Every solver on every kind of rig: it finds the motion as on the ideal one, or refuses, as the page says."""

from __future__ import annotations

import fnmatch
import functools
import re
from pathlib import Path

import numpy as np
import pytest
from general_rigs import LEFT, RIGS, SCANS

from rsbench.benchmark.simulated.bound import Views, motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import list_solvers, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion, inputs_of

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "cameras.md"
IDEAL = StereoRig(camera=LEFT.ideal, baseline=0.25)
CASES = {
    "ideal": (IDEAL, Scanning()),
    "lens": (StereoRig(camera=LEFT, baseline=0.25), Scanning()),
    "scan": (IDEAL, Scanning(scan="bottom", right_delay=0.1)),
    **{
        f"{rig}, {scan}": (RIGS[rig], SCANS[scan])
        for rig, scan in (
            ("turned", "rows"),
            ("turned", "late"),
            ("vertical", "columns"),
            ("toed in", "global right"),
        )
    },
}
W, D = np.array([0.01, 0.03, -0.02]), np.array([0.05, -0.1, 0.12])
COLUMNS = {"lens": 1, "scan": 2}
"""Of the table of docs/reference/cameras.md; the fourth is any other rig."""


@functools.cache
def table() -> dict[str, list[str]]:
    """The cells beside each name or pattern of solvers."""
    page = PAGE.read_text("utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in page.splitlines() if "| " in line]
    return {name: row for row in rows for name in re.findall(r"`((?:rs|gs)-[^`]*)`", row[0])}


@functools.cache
def simulated(case: str, model: str, ratio: float, size: float) -> Simulation:
    rig, scanning = CASES[case]
    parameters = {"acceleration": 0.2} if model == "accelerated" else {}
    motion = make_motion(model, size * W, size * D, parameters)
    options = SimulationOptions(
        pairs=60, tracks=60, lines=20, depth=(3.0, 8.0), gyro_rate=400, gravity=True, affine=True
    )
    shutter = rig.shutter_of(scanning if ratio else Scanning(), ratio)
    return simulate(rig, shutter, motion, options, np.random.default_rng(3))


def errors(name: str, case: str, size: float) -> FloatArray | None:
    """Of the rotation (rad) and of the translation (its direction alone, of a solver without metres), over the
    size of the motion; None where the solver refuses the rig."""
    solver = load_solver_entry(name).solver
    spec, still = solver.spec, solver.spec.shutter == "global"
    data = simulated(case, spec.motion_model, 0.0 if still else 0.8, size)
    w, d = data.motion.w, data.motion.d
    try:
        matches, rig, shutter = inputs_of(spec, data.correspondences, data.rig, data.shutter)
    except ValueError as error:
        assert str(error) == spec.refusal(data.rig, data.shutter)
        return None
    found = solver.estimate(matches, rig, shutter)
    assert found.success, found.reason
    if spec.reference_point == "left":
        d = translation_of_offset(w, d, rig.offset("left"))
    if not found.metric:
        d = d * (np.linalg.norm(found.d) / np.linalg.norm(d))
    return np.array([float(np.linalg.norm(found.w - w)), float(np.linalg.norm(found.d - d))]) / size


@pytest.mark.parametrize("name", list_solvers())
def test_a_solver_finds_the_motion_of_a_rig_or_refuses_it_as_the_page_says(name: str) -> None:
    patterns = [pattern for pattern in table() if fnmatch.fnmatch(name, pattern)]
    assert patterns, f"docs/reference/cameras.md does not name {name}"
    row = table()[max(patterns, key=len)]
    usual = errors(name, "ideal", 1.0)
    assert usual is not None
    for case in list(CASES)[1:]:
        found, cell = errors(name, case, 1.0), row[COLUMNS.get(case, 3)]
        assert (found is None) == ("refused" in cell), f"{name} on {case}: the page says {cell!r}"
        if found is None or np.all(found <= np.maximum(1e-6, 5.0 * usual)):
            continue
        # What is exact to first order leaves a fourth of the error, over the motion, in a fourth of the motion.
        smaller = errors(name, case, 0.25)
        assert smaller is not None and np.all(smaller <= np.maximum(0.5 * found, 5.0 * usual)), (name, case, found)


@pytest.mark.parametrize(
    ("name", "pairs", "tracks"),
    [("rs-stereo-refined", 60, 60), pytest.param("rs-stereo-refined-pairs", 150, 0, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("case", list(CASES)[4:])
def test_errors_of_cameras_of_two_resolutions_are_the_stated_ones_and_those_of_the_bound(
    case: str, name: str, pairs: int, tracks: int
) -> None:
    """Noise of 0.3 px in each camera's own pixels; squared errors over the bound are chi-squared.

    Stated covariances are for few matches, by Hotelling's factor: up to 1.3 times as long an axis.
    """
    (rig, scanning), solver = CASES[case], load_solver_entry(name).solver
    motion, shutter = make_motion("linear", 2.0 * W, D), rig.shutter_of(scanning, 0.8)
    options = SimulationOptions(pairs=pairs, tracks=tracks, depth=(3.0, 8.0))
    exact = simulate(rig, shutter, motion, options, np.random.default_rng(3)).correspondences
    views: Views = "four-view" if tracks else "pairs"
    bound = motion_bound(exact, rig, shutter, motion, 0.3, views).covariance
    assert bound is not None
    stated, ideal, noise = list[float](), list[float](), list[float]()
    for seed in range(100):
        rng = np.random.default_rng(seed)
        sets = {key: getattr(exact, key) for key in ("left", "right", "tracks")}
        matches = Correspondences(**{key: x + 0.3 * rng.standard_normal(x.shape) for key, x in sets.items()})
        found = solver.estimate(matches, rig, shutter)
        error = np.concatenate([found.w - motion.w, found.d - motion.d])
        assert found.covariance is not None and found.noise_px is not None
        stated.append(float(error @ np.linalg.solve(found.covariance, error)))
        ideal.append(float(error @ np.linalg.solve(bound, error)))
        noise.append(found.noise_px)
    spread = 4.0 * np.sqrt(2.0 * 6 / 100)  # four deviations of a mean of 100
    assert 6.0 / 1.3**2 - spread < np.mean(stated) < 6.0 + spread and abs(np.mean(ideal) - 6.0) < spread
    assert np.mean(noise) == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("name", ["rs-stereo-refined", "gs-stereo-tracks"])
def test_the_robust_loop_finds_the_noise_of_two_resolutions(name: str) -> None:
    """0.3 px in each camera's own pixels, which are 0.41 and 0.24 px of the ideal camera; a tenth is wrong."""
    rig, ratio = RIGS["turned"], 0.0 if name.startswith("gs") else 0.8
    shutter = rig.shutter_of(Scanning(), ratio)
    options = SimulationOptions(tracks=300, depth=(3.0, 8.0), noise_px=0.3, outlier_ratio=0.1, outlier_px=20.0)
    data = simulate(rig, shutter, make_motion("linear", W, D), options, np.random.default_rng(8))
    solver = load_solver_entry(name).solver
    found = estimate_motion(data.correspondences, rig, shutter, solver, RobustOptions(), np.random.default_rng(0))
    assert found.estimate.noise_px == pytest.approx(0.3, rel=0.05)
    wrong = data.outliers["tracks"]
    assert np.mean(found.inliers["tracks"][~wrong]) > 0.97 and np.mean(found.inliers["tracks"][wrong]) < 0.1


@pytest.mark.parametrize("seed", [1, 3, 11, 14, 22])
def test_a_rolling_and_a_global_camera_next_to_each_other_show_the_motion(seed: int) -> None:
    """Matches move by more than their disparities while lines are read: no motion at all is no start."""
    rig = StereoRig(camera=PinholeCamera.centred(1280, 720, 912.0), baseline=0.015)
    shutter = rig.shutter_of(Scanning(right_readout_ratio=0.0), 0.8)
    motion = random_motion(np.random.default_rng(seed), np.radians(2.0), 0.06)
    options = SimulationOptions(tracks=100, noise_px=0.3)
    matches = simulate(rig, shutter, motion, options, np.random.default_rng(seed)).correspondences
    solver = load_solver_entry("rs-stereo-refined").solver
    found = solver.estimate(matches, rig, shutter)
    assert found.noise_px == pytest.approx(0.3, abs=0.06)
    np.testing.assert_allclose(found.w, motion.w, atol=3e-3)
    robust = estimate_motion(matches, rig, shutter, solver, RobustOptions(), np.random.default_rng(0))
    assert robust.inlier_count >= 90
