"""Depth of painted planes from cameras that read their lines at different times, against the planes themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from analytic_dataset import plane_colours, plane_depth
from numpy.typing import NDArray

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.vision.moving_stereo import moving_disparities
from rsbench.vision.stereo_depth import stereo_disparities
from rsbench.vision.stereo_matcher import load_matcher

CAMERA = PinholeCamera.centred(160, 120, 140.0)
MOTION = LinearMotion([0.06, -0.03, 0.05], [0.15, 0.12, 0.1])
BARREL = Lens(model="brown-conrady", k1=-0.1)


def seen(rig: StereoRig, shutter: RollingShutter, side: Side) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image and depth of frame 0."""
    poses = row_poses(rig, shutter, MOTION, side, 0)
    if shutter.axis(side) == 1:
        depth = plane_depth(rig.camera, poses)
        return plane_colours(rig.camera, poses, depth), depth
    # Columns are the rows of a camera whose axes x and y are exchanged; the lens is alike in all directions.
    camera = replace(rig.camera, width=120, height=160, cx=rig.camera.cy, cy=rig.camera.cx)
    turned = Pose(poses.R[:, [1, 0, 2]], poses.t[:, [1, 0, 2]])
    depth = plane_depth(camera, turned)
    return np.swapaxes(plane_colours(camera, turned, depth), 0, 1).copy(), depth.T.copy()


@pytest.mark.parametrize(
    ("lens", "scanning"),
    [
        (None, {"right_delay": 0.3}),
        (None, {"scan": "top", "right_scan": "bottom"}),
        (BARREL, {"scan": "left"}),
    ],
    ids=["late", "opposite", "columns through a lens"],
)
def test_depth_is_that_of_the_planes(lens: Lens | None, scanning: dict[str, Any]) -> None:
    rig = StereoRig(camera=replace(CAMERA, lens=lens), baseline=0.4)
    shutter = Scanning(**scanning).shutter_of(160, 120, 0.9)
    images, truth = dict[Side, NDArray[np.uint8]](), dict[Side, NDArray[np.float32]]()
    for side in SIDES:
        images[side], truth[side] = seen(rig, shutter, side)
    found = moving_disparities(load_matcher("sgm"), images, rig, shutter, MOTION, 0)
    for side, disparity in zip(SIDES, found, strict=True):
        known, right = np.isfinite(disparity), rig.disparity(truth[side])
        off = np.abs(disparity - right)
        # Waves of 12 px are matched to some hundredths of a pixel; the corner of both planes is where it errs.
        assert np.mean(known) > 0.6
        assert np.median(off[known]) < 0.1 and np.mean(off[known] > 1.0) < 0.05
    still = stereo_disparities(images["left"], images["right"], rig.ideal)[0]
    wrong = ~(np.abs(still - rig.disparity(truth["left"])) <= 1.0)
    assert np.mean(wrong) > 2 * np.mean(~(np.abs(found[0] - rig.disparity(truth["left"])) <= 1.0))
