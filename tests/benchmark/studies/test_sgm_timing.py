"""The prediction of what a late or reversed right camera does to disparity, against the exact row equation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.benchmark.studies.sgm_timing import TIMINGS, Timing, predicted_shift, right_row_poses
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.projection import back_project, project_at, row_poses, rs_project_near
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.report.correction_page import sgm_page, write_sgm_page

CAMERA = PinholeCamera.centred(60, 50, 90.0)
RIG = StereoRig(camera=CAMERA, baseline=0.3)
SHUTTER = RollingShutter(height=50, readout_ratio=0.8)
_VECTOR = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def _exact(depth: np.ndarray, motion: LinearMotion, timing: Timing) -> np.ndarray:
    """Disparity error and row offset (H, W, 2): the right camera's row equation, solved by fixed-point steps."""
    grid = CAMERA.pixel_grid()
    points = back_project(RIG, SHUTTER, motion, "left", 0, grid, depth)
    row = grid[..., 1].copy()
    for _ in range(60):
        seen = project_at(RIG, motion, "right", timing.row_time(SHUTTER, row, 0), points)
        row = seen[..., 1]
    disparity = grid[..., 0] - seen[..., 0]
    return np.stack([disparity - CAMERA.fx * RIG.baseline / depth, seen[..., 1] - grid[..., 1]], axis=-1)


@settings(max_examples=20)
@given(_VECTOR, _VECTOR, st.floats(2.0, 20.0), st.sampled_from(TIMINGS))
def test_the_prediction_is_first_order(
    w: tuple[float, ...], d: tuple[float, ...], z: float, timing: Timing
) -> None:
    """Halving the motion halves what is predicted and quarters what the prediction misses."""
    y, x = np.mgrid[:50, :60] / 50.0
    depth = z * (1.0 + 0.3 * x + 0.2 * y)
    missed, predicted = list[float](), list[float]()
    for size in (0.02, 0.01):
        motion = LinearMotion(size * np.array(w), size * np.array(d))
        shift = predicted_shift(depth, RIG, SHUTTER, motion, timing)
        missed.append(np.max(np.abs(_exact(depth, motion, timing) - shift)))
        predicted.append(np.max(np.abs(shift)))
    # Twice 0.02 rad and 0.02 m at 2 m, 90 px: up to 3 px of motion, whose square over 90 px is what is left out.
    assert missed[0] < 0.25
    assert missed[1] <= 0.3 * missed[0] + 1e-6
    assert predicted[1] == pytest.approx(0.5 * predicted[0], rel=0.1, abs=1e-6)


def test_cameras_in_step_see_every_point_on_one_row_whatever_the_motion() -> None:
    """The claim itself, by the row equation of the right camera and not by the prediction."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(2.0, 10.0, (50, 60))
    motion = LinearMotion([0.1, -0.2, 0.15], [0.3, 0.2, -0.4])
    grid = CAMERA.pixel_grid()
    points = back_project(RIG, SHUTTER, motion, "left", 0, grid, depth)
    seen = rs_project_near(RIG, SHUTTER, motion, "right", 0, points, grid[..., 1])
    inside = np.isfinite(seen.depth)
    assert np.count_nonzero(inside) > 1000
    np.testing.assert_allclose(seen.pixels[inside][:, 1], grid[inside][:, 1], atol=1e-8)
    disparity = grid[inside][:, 0] - seen.pixels[inside][:, 0]
    np.testing.assert_allclose(disparity, CAMERA.fx * RIG.baseline / depth[inside], atol=1e-8)
    np.testing.assert_array_equal(predicted_shift(depth, RIG, SHUTTER, motion, Timing()), 0.0)


def test_without_delay_the_poses_are_the_rigs_own() -> None:
    motion = LinearMotion([0.1, -0.2, 0.15], [0.3, 0.2, -0.4])
    own = row_poses(RIG, SHUTTER, motion, "right", 0)
    same = right_row_poses(RIG, SHUTTER, motion, Timing())
    np.testing.assert_array_equal(own.R, same.R)
    np.testing.assert_array_equal(own.t, same.t)
    opposite = right_row_poses(RIG, SHUTTER, motion, Timing(opposite=True))
    np.testing.assert_array_equal(own.R[::-1], opposite.R)


def test_the_page_says_what_the_table_says(tmp_path: Path) -> None:
    rows = [
        (each.name, each.delay, each.opposite, 0.25 if each.opposite else 0.9 - 4 * each.delay) for each in TIMINGS
    ]
    table = pd.DataFrame(rows, columns=["timing", "delay", "opposite", "coverage"])
    predicted = 10 * table["delay"]
    table = table.assign(error_px=0.03 + predicted, predicted_px=predicted, vertical_px=2 * predicted)
    table = table.assign(stratum="mild", sequence="castle-2", unexplained_px=0.03)
    table = table.assign(bad_1px=0.0, depth_error_m=0.1, over_2m=0.0)
    text = " ".join(sgm_page(table).split())
    assert "0.0100 frame periods (mild, castle-2)" in text  # 0.1 px at 10 px per frame period
    assert "by 2 rows it has lost 44 % of them" in text
    assert "coverage 25 to 25 %" in text
    table.to_csv(tmp_path / "sgm.csv", index=False)
    first = [path.read_bytes() for path in write_sgm_page(tmp_path)]
    assert [path.read_bytes() for path in write_sgm_page(tmp_path)] == first
