"""Zhuang's corrector: the order of what it neglects on exact flow, and images of closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.components.motion_models import TwistMotion
from rsbench.components.plugins import wrap
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.geometry import FixedGeometry
from rsbench.core.projection import rs_project
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.baseline_motions import ZhuangCorrector
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import CORRECTORS, CorrectionProblem, find_corrected
from rsbench.vision.flow import monocular_depth
from rsbench.vision.fusion import Origin

RIG = StereoRig(camera=PinholeCamera.centred(96, 96, 120.0), baseline=0.4)
SHUTTER = RollingShutter(height=96, readout_ratio=0.8)


def exact_flow(motion: TwistMotion, depth: np.ndarray) -> np.ndarray:
    """(96, 96, 2) px from frame 0 to frame 1 of the left camera, of depth in each row's own camera."""
    grid = RIG.camera.pixel_grid()
    R, t = RIG.cam_from_world(motion, SHUTTER.pixel_time(grid, 0, "left"), "left")
    points = (np.swapaxes(R, -1, -2) @ (depth[..., None] * RIG.camera.unproject(grid) - t)[..., None])[..., 0]
    return np.asarray(rs_project(RIG, SHUTTER, motion, "left", 1, points).pixels - grid)


def left_over(part: float) -> float:
    """Mean error, px, of the correction's flow by motion and depth from exact flow of a part of a motion."""
    motion = TwistMotion(part * np.radians([0.8, 1.2, -1.0]), part * np.array([0.3, -0.1, 0.2]))
    depth = np.random.default_rng(0).uniform(4.0, 9.0, (12, 12)).repeat(8, axis=0).repeat(8, axis=1)
    flow = exact_flow(motion, depth)
    seen = np.all(np.isfinite(flow), axis=-1)
    matches = np.concatenate([RIG.camera.pixel_grid(), RIG.camera.pixel_grid() + flow], axis=-1)[seen][::37]
    # All matches count: which of them agree must not depend on the size of what is neglected.
    robust = RobustOptions(threshold_px=20.0, adapt_threshold=False)
    found = ZhuangCorrector(robust=robust).motion(Correspondences(left=matches), RIG, SHUTTER, "left")
    assert isinstance(found, TwistMotion)
    about = RIG.about("left")
    estimated = monocular_depth(flow.astype(np.float32), about, SHUTTER, found, "left", 0)
    expected = correction_flow(depth.astype(np.float32), FixedGeometry(RIG, SHUTTER, motion), ("left", 0))
    got = correction_flow(estimated, FixedGeometry(about, SHUTTER, found), ("left", 0))
    # Inside of the patches of equal depth, which the median filter of the depth map leaves as they are.
    inner = np.zeros((96, 96), dtype=np.bool_)
    inner[3::8, 3::8] = inner[4::8, 4::8] = True
    return float(np.mean(np.linalg.norm(got - expected, axis=-1)[inner & seen]))


def test_what_the_differential_model_neglects_is_of_second_order() -> None:
    """Rotation errs by the square of the motion, translation's direction by its first power times the parallax."""
    errors = [left_over(part) for part in (4.0, 2.0, 1.0)]
    assert errors[0] < 0.5
    assert all(3.0 < ratio < 6.0 for ratio in (errors[0] / errors[1], errors[1] / errors[2])), errors


@pytest.mark.parametrize("count", [0, 5])
def test_without_matches_a_frame_fails_by_value(count: int) -> None:
    image = np.zeros((96, 96, 3), dtype=np.uint8)
    rng = np.random.default_rng(0)
    problem = CorrectionProblem(
        images=dict.fromkeys(VIEWS, image),
        rig=RIG,
        shutter=SHUTTER,
        target_row=0.0,
        motion=None,
        depth=None,
        guess=None,
        matches=Correspondences(left=rng.uniform(0, 90, (count, 4))),
    )
    found = find_corrected(wrap(CORRECTORS, ZhuangCorrector()), problem, VIEWS)
    assert all(
        "no motion of the" in fused.reason and np.all(fused.origin == Origin.NOBODY) for fused in found.values()
    )
    with pytest.raises(ValueError, match="'matches' must be among the needs"):
        ZhuangCorrector().correct(replace(problem, matches=None), VIEWS)
