"""What simpler assumptions find, on data that satisfy them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from solver_trials import RIG, SHUTTER

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import SIDES, Side
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.baseline_motions import global_shutter_motion, monocular_motion, solved_alone
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion

MOTION = LinearMotion(np.array([0.02, -0.03, 0.025]), np.array([0.2, -0.12, 0.18]))


def camera_matches(motion: LinearMotion, count: int = 80, shutter: RollingShutter = SHUTTER) -> np.ndarray:
    """Rolling-shutter matches (n, 4) of a camera that moves so about its own centre, each row at its own time."""
    camera, rng = RIG.camera, np.random.default_rng(0)
    points = rng.uniform([-2.0, -2.0, 5.0], [2.0, 2.0, 12.0], (count, 3))
    ends = []
    for frame in (0, 1):
        row = np.full(count, 450.0)
        for _ in range(
            30
        ):  # the row decides the time and the time the row: a contraction by about h times the flow
            tau = shutter.row_time(row, frame)
            R, t = motion.body_from_world(tau)
            seen = (R @ points[:, :, None])[:, :, 0] + t
            row = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
        ends.append(np.stack([camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, row], axis=1))
    return np.concatenate(ends, axis=1)


@pytest.mark.parametrize("side", SIDES)
def test_one_camera_finds_its_own_motion_in_unit_length(side: Side) -> None:
    matches = Correspondences(**{side: camera_matches(MOTION)})
    # The start is the motion of a rig whose camera moves so, a degree and a tenth of the length off.
    offset = RIG.offset(side)
    d = MOTION.d - translation_of_offset(MOTION.w, np.zeros(3), offset)
    start = LinearMotion(MOTION.w + 0.01, d + 0.02)
    found = monocular_motion(matches, RIG, SHUTTER, side, start)
    assert found is not None
    # Exact matches: what is left is where the descent stops.
    np.testing.assert_allclose(found.w, MOTION.w, atol=1e-8)
    np.testing.assert_allclose(found.d, MOTION.d / np.linalg.norm(MOTION.d), atol=1e-7)


@pytest.mark.parametrize("side", SIDES)
def test_either_camera_alone_is_solved_about_its_own_centre(side: Side) -> None:
    """By a solver that knows the left camera only, on exact global-shutter matches."""
    still = RollingShutter(height=900, readout_ratio=0.0)
    matches = Correspondences(**{side: camera_matches(MOTION, shutter=still)})
    solver, rng = load_solver_entry("gs-8pt").solver, np.random.default_rng(0)
    found = solved_alone(matches, RIG, still, side, solver, RobustOptions(), rng)
    assert found is not None
    np.testing.assert_allclose(found.w, MOTION.w, atol=1e-7)
    np.testing.assert_allclose(found.d, MOTION.d / np.linalg.norm(MOTION.d), atol=1e-6)
    few = Correspondences(**{side: camera_matches(MOTION, 4, still)})
    assert solved_alone(few, RIG, still, side, solver, RobustOptions(), rng) is None


def test_the_global_motion_of_global_shutter_matches_is_theirs() -> None:
    shutter = RollingShutter(height=900, readout_ratio=0.0)
    options = SimulationOptions(tracks=60)
    c = simulate(RIG, shutter, MOTION, options, np.random.default_rng(1)).correspondences
    found = global_shutter_motion(c, RIG, RobustOptions(), np.random.default_rng(0))
    assert found is not None
    np.testing.assert_allclose(np.concatenate([found.w, found.d]), [*MOTION.w, *MOTION.d], atol=1e-7)


def test_the_callers_options_reach_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[RobustOptions] = []

    def spy(*arguments: Any) -> Any:
        seen.append(arguments[4])
        return estimate_motion(*arguments)

    monkeypatch.setattr("rsbench.pipeline.baseline_motions.estimate_motion", spy)
    asked = RobustOptions(threshold_px=1.0, adapt_threshold=False, confidence=0.9, lo_steps=1, max_iterations=77)
    c = Correspondences(tracks=np.random.default_rng(0).uniform(0, 899, (20, 8)))
    global_shutter_motion(c, RIG, asked, np.random.default_rng(0))
    assert seen == [
        RobustOptions(threshold_px=4.0, adapt_threshold=False, confidence=0.9, lo_steps=1, max_iterations=77)
    ]
