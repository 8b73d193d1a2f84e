"""The compiled reprojection against the row equation with the pose at each pixel's own time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from general_rigs import LENSES

from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry, MovingObject
from rsbench.core.motion import Motion
from rsbench.core.projection import back_project, project_at, rs_project, rs_project_near
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.views import FAR, VIEW_PAIRS, ImageView, SeenSurfaces, carry, seen_from
from rsbench.verification.reprojection import DepthMap, Reprojection, relative_depth, reproject

W, D = [0.03, -0.05, 0.04], [0.2, -0.1, 0.25]
CAMERA = PinholeCamera.centred(64, 48, 60.0)
BROWN, FISHEYE = LENSES["brown-conrady"], LENSES["kannala-brandt"]


class Kinked(Motion):
    """A motion that turns back in the middle of the frame, and shakes faster than any table of lines knows."""

    name = "kinked"

    def body_from_world(self, tau: Any) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)
        found: Pose = LinearMotion(self.w, self.d).body_from_world(np.abs(tau - 0.3711) + 1e-6 * np.sin(1e4 * tau))
        return found

    def velocity(self, tau: Any) -> Any:
        return LinearMotion(self.w, self.d).velocity(tau)


def geometry_of(motion: Motion, lens: Lens | None = None, **shutter: Any) -> FixedGeometry:
    rig = StereoRig(camera=replace(CAMERA, lens=lens), baseline=0.3)
    whole: dict[str, Any] = {"height": 48, "width": 64, "readout_ratio": 0.9} | shutter
    return FixedGeometry(rig, RollingShutter(**whole), motion, 2)


def of_rig(motion: Motion, left: Lens | None, right: Lens | None, scanning: Scanning) -> FixedGeometry:
    """Two cameras of two sizes and directions."""
    wide = PinholeCamera(width=80, height=45, fx=70.0, fy=69.0, cx=41.0, cy=20.0, lens=right)
    turn = so3.exp(np.array([0.05, -0.08, 0.1]))
    rig = StereoRig.of_cameras(replace(CAMERA, lens=left), wide, turn, (-0.3, 0.05, 0.02))
    return FixedGeometry(rig, rig.shutter_of(scanning, 0.9), motion, 2)


def room(view: ImageView, camera: PinholeCamera) -> DepthMap:
    """A slanted wall with a step and a hole through which the sky is seen."""
    depth = 1.0 / (camera.unproject(camera.pixel_grid()) @ np.array([0.03, 0.12, 0.2]))
    depth[10:20, 30:40] *= 0.7
    depth[30:40, 10:30] = 0.0
    return DepthMap(view, depth.astype(np.float32), camera)


def both_ways(
    geometry: Any, source: DepthMap, target: DepthMap, stride: int = 1
) -> tuple[Reprojection, Reprojection]:
    depth = source.depth[::stride, ::stride].astype(np.float64)
    grid, sky = source.camera.pixel_grid()[::stride, ::stride], depth == 0
    numbers = np.zeros(depth.shape) if source.labels is None else source.labels[::stride, ::stride]
    pixels, z = np.full(grid.shape, np.nan), np.full(depth.shape, np.nan)
    for number in np.unique(numbers).astype(int):
        chosen = numbers == number
        own = seen_from(geometry, number)
        X = world_points(own, source.view, grid[chosen], np.where(sky, FAR, depth)[chosen])
        pixels[chosen], z[chosen] = where_seen(own, target.view, X, grid[chosen])
    relative = relative_depth(target, pixels, z, sky, target.camera.ideal_pixels(pixels))
    exact = Reprojection(pixels.astype(np.float32), relative.astype(np.float32))
    return reproject(geometry, source, target, stride), exact


def world_points(geometry: FixedGeometry, view: ImageView, pixels: FloatArray, z: FloatArray) -> FloatArray:
    rig, shutter, motion = geometry[:3]
    if view.shutter == "rs":
        return back_project(rig, shutter, motion, view.side, view.frame, pixels, z)
    pose = rig.cam_from_world(motion, shutter.time_after(view.row, view.frame, view.side), view.side)
    return transform(inverse(pose), z[..., None] * rig.sensor(view.side).unproject(pixels))


def where_seen(
    geometry: FixedGeometry, view: ImageView, X: FloatArray, near: FloatArray
) -> tuple[FloatArray, FloatArray]:
    rig, shutter, motion = geometry[:3]
    if view.shutter == "rs":
        lines = near[..., shutter.axis(view.side)]
        found = rs_project_near(rig, shutter, motion, view.side, view.frame, X, lines)
        if motion.name == "kinked":  # some points are seen twice: the first row counts
            found = rs_project(rig, shutter, motion, view.side, view.frame, X)
        return found.pixels, found.depth
    seen = project_at(rig, motion, view.side, shutter.time_after(view.row, view.frame, view.side), X)
    seen[~rig.sensor(view.side).contains(seen[..., :2])] = np.nan
    return seen[..., :2], seen[..., 2]


def check_alike(found: Reprojection, exact: Reprojection) -> None:
    for quick, slow in zip(found, exact, strict=True):
        np.testing.assert_array_equal(np.isnan(quick), np.isnan(slow))
        # Pixels and shares of depth: float32 of 64 px rounds by 4e-6; a table may err by 1e-8 px here.
        np.testing.assert_allclose(quick, slow, rtol=0, atol=8e-6)
    inner = np.isfinite(exact.relative)
    np.testing.assert_allclose(found.relative[inner], exact.relative[inner], rtol=0, atol=2e-9)
    assert np.mean(inner) > 0.1


HANDHELD, DRONE = (SplineMotion(W, D, preset=name, seed=seed) for name, seed in (("handheld", 3), ("drone", 1)))
GEOMETRIES = {
    "linear": geometry_of(LinearMotion(W, D)),
    "twist": geometry_of(TwistMotion(W, D)),
    "accelerated, lens": geometry_of(AcceleratedMotion(W, D), BROWN, scan="bottom"),
    "spline": geometry_of(HANDHELD, FISHEYE, scan="left"),
    "apart": geometry_of(DRONE, right_scan="right", right_delay=0.2),
    "global": geometry_of(LinearMotion(W, D), readout_ratio=0.0),
    "no table": geometry_of(Kinked(W, D)),
    "rig": of_rig(LinearMotion(W, D), None, None, Scanning()),
    "rig of lenses": of_rig(
        TwistMotion(W, D), BROWN, FISHEYE, Scanning(right_scan="left", right_readout_ratio=0.4)
    ),
    "rig, global right": of_rig(
        LinearMotion(W, D), FISHEYE, None, Scanning(right_readout_ratio=0.0, right_delay=0.1)
    ),
}


@pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)
def test_every_pixel_lands_where_the_row_equation_says(geometry: FixedGeometry) -> None:
    rig = geometry.rig
    for source, target in VIEW_PAIRS[:: 1 if geometry.motion.name == "linear" else 5]:
        here, there = (room(view, rig.sensor(view.side)) for view in (source, target))
        check_alike(*both_ways(geometry, here, there, 2))


def test_a_motion_that_no_table_follows_is_refused() -> None:
    depth = np.ones((48, 64), np.float32)
    surfaces = SeenSurfaces(geometry_of(Kinked(W, D)), ImageView("rs", "right", 0), depth)
    with pytest.raises(RsbenchError, match="Kinked: jumps"):
        carry(surfaces, ImageView("rs", "left", 0))


def test_what_moves_is_carried_along() -> None:
    own = LinearMotion([0.0, 0.1, 0.0], [0.3, 0.0, 0.1])
    geometry = geometry_of(TwistMotion(W, D))._replace(objects=(MovingObject(np.array([0.0, 0.0, 5.0]), own),))
    source, target = (room(view, CAMERA) for view in VIEW_PAIRS[0])
    labels = np.zeros(source.depth.shape, np.uint8)
    labels[5:25, 5:60] = 1
    moved = replace(source, labels=labels)
    found, exact = both_ways(geometry, moved, target)
    check_alike(found, exact)
    still, _ = both_ways(geometry, source, target)
    assert np.nanmax(np.abs(found.pixels - still.pixels)) > 1.0
