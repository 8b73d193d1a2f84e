"""Affine frames against finite differences of rays of our own, and against homographies."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.geometry import FixedGeometry, Geometry
from rsbench.core.motion import Motion
from rsbench.core.projection import rs_project, rs_project_near
from rsbench.core.rig import StereoRig, View
from rsbench.core.se3 import inverse, transform
from rsbench.core.shutter import Scanning
from rsbench.dataset.point_channels import AffineFrames, Tracks, jacobians_of, track_views

TRACK_VIEWS = track_views(2)
Array = NDArray[np.float64]
CAMERA = PinholeCamera.centred(640, 480, 500.0)
BARREL = Lens(model="brown-conrady", k1=-0.2, k2=0.05, p1=0.001)
FISHEYE = Lens(model="kannala-brandt", k1=0.02, k2=-0.01)
RIG = StereoRig.of_cameras(
    replace(CAMERA, lens=BARREL),
    PinholeCamera(width=800, height=440, fx=520.0, fy=519.0, cx=410.0, cy=212.0, lens=FISHEYE),
    so3.exp(np.array([0.03, -0.06, 0.05])),
    (-0.3, 0.02, -0.03),
)
MOTION = LinearMotion([0.03, -0.05, 0.06], [0.2, -0.1, 0.3])


def geometry_of(
    lens: Lens | None = None, ratio: float = 0.9, motion: Motion = MOTION, **scanning: Any
) -> FixedGeometry:
    shutter = Scanning(**scanning).shutter_of(CAMERA.width, CAMERA.height, ratio)
    return FixedGeometry(StereoRig(camera=replace(CAMERA, lens=lens), baseline=0.3), shutter, motion)


def points_on_planes(geometry: Geometry, rng: np.random.Generator, count: int) -> tuple[Tracks, Array]:
    """Tracks of points that the left camera sees in frame 0, each on a plane of its own; and the normals."""
    source = rng.uniform(60, [580, 420], (count, 2))
    eyes, ways = ray(geometry, TRACK_VIEWS[0], source)
    points = eyes + rng.uniform(3, 12, (count, 1)) * ways
    # Facing the camera within 72 degrees: a plane seen from its edge has no derivative.
    normals = -ways / np.linalg.norm(ways, axis=1, keepdims=True) + 0.75 * unit(rng.normal(size=(count, 3)))
    found = [rs_project(geometry.rig, geometry.shutter, geometry.motion, *view, points) for view in TRACK_VIEWS]
    pixels, tau = (np.stack([getattr(f, name) for f in found], axis=1) for name in ("pixels", "tau"))
    classes = np.where(np.isfinite(tau), 1, 3).astype(np.uint8)
    sources = np.zeros(count, dtype=np.uint8)
    return Tracks(points=points, sources=sources, pixels=pixels, tau=tau, classes=classes), unit(normals)


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def ray(geometry: Geometry, view: View, pixels: Array) -> tuple[Array, Array]:
    tau = geometry.shutter.pixel_time(pixels, view[1], view[0])
    world = inverse(geometry.rig.cam_from_world(geometry.motion, tau, view[0]))
    return world.t, transform(world, geometry.rig.sensor(view[0]).unproject(pixels)) - world.t


def differences(geometry: Geometry, tracks: Tracks, normals: Array, view: View, k: int, step: float) -> Array:
    """Central differences (n, 2, 2): rays of moved pixels at the times of their own lines, met with the planes."""
    columns = []
    for axis in np.eye(2):
        ends = []
        for sign in (1.0, -1.0):
            eyes, ways = ray(geometry, TRACK_VIEWS[0], tracks.pixels[:, 0] + sign * step * axis)
            share = np.sum((tracks.points - eyes) * normals, axis=1) / np.sum(ways * normals, axis=1)
            X = eyes + share[:, None] * ways
            line = tracks.pixels[:, k, geometry.shutter.axis(view[0])]
            args = geometry.rig, geometry.shutter, geometry.motion, *view
            ends.append(rs_project_near(*args, X, np.nan_to_num(line)).pixels)
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize(
    "geometry",
    [
        geometry_of(),
        geometry_of(BARREL, motion=TwistMotion(MOTION.w, MOTION.d)),
        geometry_of(FISHEYE, scan="left", right_scan="bottom", right_delay=0.2),
        geometry_of(scan="bottom", right_scan="top"),
        FixedGeometry(RIG, RIG.shutter_of(Scanning(right_scan="left", right_readout_ratio=0.3), 0.9), MOTION),
    ],
    ids=["plain", "barrel", "fisheye, columns, late", "opposite", "rig"],
)
def test_derivatives_are_those_of_traced_rays(geometry: FixedGeometry) -> None:
    """A step of 0.01 px errs by its square times third derivatives, and by 1e-9 px of rows over 0.02 px."""
    tracks, normals = points_on_planes(geometry, np.random.default_rng(7), 300)
    found = jacobians_of(geometry, tracks, normals)
    for k, view in enumerate(TRACK_VIEWS):
        seen = np.isfinite(tracks.tau[:, k])
        made = differences(geometry, tracks, normals, view, k, 0.01)
        both = seen & np.isfinite(made).all(axis=(1, 2))
        assert np.sum(both) > 100 and np.all(np.isnan(found[~seen, k]))
        size = np.max(np.abs(made[both]), axis=(1, 2))[:, None, None]
        np.testing.assert_allclose(found[both, k] / size, made[both] / size, rtol=0, atol=2e-6)
    assert np.array_equal(found[:, 0], np.broadcast_to(np.eye(2), (300, 2, 2)))


def test_of_a_global_shutter_they_are_those_of_homographies() -> None:
    """H = K (R + t n' / d) K^-1 of each plane n' X = d, differentiated at the pixel."""
    geometry = geometry_of(ratio=0.0)
    tracks, normals = points_on_planes(geometry, np.random.default_rng(3), 50)
    found = jacobians_of(geometry, tracks, normals)
    K, rig, motion = CAMERA.K, geometry.rig, geometry.motion
    first = rig.cam_from_world(motion, 0.0, "left")
    for i in range(50):
        X, n = transform(first, tracks.points[i]), first.R @ normals[i]
        for k, (side, frame) in enumerate(TRACK_VIEWS):
            if np.isnan(tracks.tau[i, k]):
                continue
            pose = rig.cam_from_world(motion, float(frame), side)
            R = pose.R @ first.R.T
            H = K @ (R + np.outer(pose.t - R @ first.t, n) / (n @ X)) @ np.linalg.inv(K)
            h = H @ [*tracks.pixels[i, 0], 1.0]
            J = (H[:2, :2] - np.outer(h[:2] / h[2], H[2, :2])) / h[2]
            np.testing.assert_allclose(found[i, k], J, rtol=0, atol=1e-9 * np.max(np.abs(J)))


def test_between_two_frames_is_a_chain() -> None:
    geometry = geometry_of(BARREL)
    tracks, normals = points_on_planes(geometry, np.random.default_rng(5), 40)
    affine = AffineFrames(jacobians=jacobians_of(geometry, tracks, normals), normals=normals)
    seen = np.all(np.isfinite(tracks.tau), axis=1)
    chained = affine.between(2, 3)[seen] @ affine.between(0, 2)[seen]
    np.testing.assert_allclose(chained, affine.jacobians[seen, 3], rtol=0, atol=1e-12 * np.max(np.abs(chained)))


def test_a_point_without_a_plane_has_none() -> None:
    geometry = geometry_of()
    tracks, normals = points_on_planes(geometry, np.random.default_rng(5), 4)
    normals[1] = 0.0
    without = np.isnan(jacobians_of(geometry, tracks, normals)).all(axis=(1, 2, 3))
    assert without.tolist() == [False, True, False, False]
