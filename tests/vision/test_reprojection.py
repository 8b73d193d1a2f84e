"""Where another view sees a pixel of known depth, against the exact projection of ``rsbench.core``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import back_project, row_poses, rs_project_near
from rsbench.core.rig import StereoRig, View
from rsbench.core.shutter import Scanning
from rsbench.vision.reprojection import parallax_gain, reproject_pixels, reprojection_of

MOTION = LinearMotion([0.06, -0.03, 0.05], [0.15, 0.12, 0.1])


@pytest.mark.parametrize(
    ("lens", "scanning"),
    [(None, {}), (Lens(model="brown-conrady", k1=-0.1), {"scan": "left", "right_scan": "bottom"})],
    ids=["rows", "columns to rows through a lens"],
)
@pytest.mark.parametrize("there", [("left", 1), ("right", 0), ("right", 1)])
def test_places_are_those_of_the_projection(lens: Lens | None, scanning: dict[str, Any], there: View) -> None:
    camera = PinholeCamera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5, lens=lens)
    rig, here = StereoRig(camera=camera, baseline=0.4), ("left", 0)
    shutter = Scanning(**scanning).shutter_of(160, 120, 0.9)
    poses = [row_poses(rig, shutter, MOTION, *view) for view in (here, there)]
    maps = reprojection_of(camera, *poses, axes=(shutter.axis(here[0]), shutter.axis(there[0])))
    depth = np.random.default_rng(0).uniform(2.0, 9.0, (120, 160)).astype(np.float32)
    own_line = np.indices((120, 160), dtype=np.int32)[0 if shutter.axis(there[0]) == 1 else 1]
    places, factors = reproject_pixels(maps, (1 / depth).astype(np.float32), own_line)

    points = back_project(rig, shutter, MOTION, "left", 0, camera.pixel_grid(), depth)
    exact = rs_project_near(rig, shutter, MOTION, *there, points, own_line)
    both = np.isfinite(places[..., 0]) & np.isfinite(exact.depth)
    assert np.mean(both) > 0.4
    # They differ in who is inside by the pixel's half at the border alone.
    assert np.mean(np.isfinite(places[..., 0]) != np.isfinite(exact.depth)) < 0.02
    # Between two lines the place is taken as straight; positions are float32.
    np.testing.assert_allclose(places[both], exact.pixels[both], atol=2e-4)
    np.testing.assert_allclose(depth[both] / factors[both], exact.depth[both], rtol=1e-4)


def test_the_gain_is_the_parallax_of_a_sideways_step() -> None:
    rig = StereoRig(camera=PinholeCamera.centred(40, 30, 50.0), baseline=0.3)
    shutter, still = Scanning().shutter_of(40, 30, 0.5), LinearMotion(np.zeros(3), np.zeros(3))
    left, right = (row_poses(rig, shutter, still, side, 0) for side in ("left", "right"))
    gain = parallax_gain(
        rig.camera, reprojection_of(rig.camera, left, right), reprojection_of(rig.camera, right, left)
    )
    np.testing.assert_allclose(gain, 50.0 * 0.3)  # the disparity at 1 m
