"""Rectified pairs of corrected frames, read with OpenCV: a world in closed form, two cameras that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from general_rigs import LEFT, RIGS

from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.layouts import read_colmap
from rsbench.interop.writers.rectified_pairs import (
    FOLDER,
    rectified_camera,
    rectify,
    write_calibration,
    write_rectified,
)
from rsbench.storage.files import read_depth
from rsbench.vision.fusion import Fused, Origin

DISTANCE, NORMAL = 4.0, np.array([0.1, 0.15, 1.0])
"""A wall n . X = distance in the body's axes, metres."""
_SPHERES = Lens(model="double-sphere", xi=-0.18, alpha=0.59)
_SMALL = PinholeCamera(width=320, height=240, fx=250.0, fy=252.0, cx=162.0, cy=118.0)
ALL = {
    **RIGS,
    "ideal": StereoRig(camera=_SMALL, baseline=0.2),
    "lens": StereoRig(camera=replace(LEFT, fx=520.0), baseline=0.2),
    "spheres": StereoRig.of_cameras(
        replace(_SMALL, fx=160.0, fy=160.0, lens=_SPHERES),
        replace(_SMALL, lens=Lens(model="rational", k1=0.9, k2=0.06, k3=0.001, k4=1.25, k5=0.22, k6=0.006)),
        so3.exp(np.array([0.01, -0.02, 0.03])),
        [-0.2, 0.0, 0.01],
    ),
}


class Seen(NamedTuple):
    """What a camera sees in pixels (..., 2)."""

    image: FloatArray
    depth: FloatArray
    """(...) z in its own axes."""
    X: FloatArray
    """(..., 3) in the body's axes, from the middle of the baseline."""


def see(rig: StereoRig, side: Side, rays: FloatArray) -> Seen:
    """Along rays (..., 3) with z = 1 in the body's axes."""
    centre = -rig.offset(side)
    z = (DISTANCE - NORMAL @ centre) / (rays @ NORMAL)
    X = centre + z[..., None] * rays
    x, y = X[..., 0], X[..., 1]
    waves = np.sin(9.0 * x + 2.0 * y) + np.sin(4.0 * y - 7.0 * x) + np.sin(11.0 * y)
    return Seen(127.5 + 40.0 * waves, z * (rays @ rig.own(side).R[2]), X)


def frame(rig: StereoRig, side: Side) -> Fused:
    """A corrected frame of the wall; the left fifth of it was seen by nobody."""
    sensor = rig.sensor(side)
    seen = see(rig, side, rig.eye(side).unproject(sensor.pixel_grid()))
    image = np.round(seen.image).astype(np.uint8)
    origin = np.full(image.shape, np.uint8(Origin.HERE))
    origin[:, : sensor.width // 5] = Origin.NOBODY
    hidden = origin == Origin.NOBODY
    return Fused(
        image=np.where(hidden, np.uint8(0), image),
        origin=origin,
        depth=np.where(hidden, np.nan, seen.depth).astype(np.float32),
    )


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", ALL)
def test_the_rectified_camera_sees_the_wall(name: str, side: Side) -> None:
    rig = ALL[name]
    camera, found = rectified_camera(rig), rectify(frame(rig, side), rig, side)
    rays = camera.unproject(camera.pixel_grid())
    expected = see(rig, side, rays)
    there = found.origin == Origin.HERE
    assert there.shape == (camera.height, camera.width) and np.mean(there) > 0.4
    inner = cv2.erode(there.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    # Grey levels are rounded twice; waves of 40 px and more.
    assert np.sqrt(np.mean((found.image - expected.image)[inner] ** 2)) < 0.6
    off = np.abs(found.depth / expected.X[..., 2] - 1.0)[inner]
    assert np.quantile(off, 0.99) < 3e-6 and np.max(off) < 3e-4  # half a pixel beyond the outermost centres
    # Beside what nobody saw, depth is that of the nearest pixel instead of a mean with nothing.
    np.testing.assert_allclose(found.depth[there], (expected.X[..., 2])[there], rtol=5e-3)
    assert np.all(found.image[~there] == 0) and np.all(np.isnan(found.depth[~there]))


def test_an_ideal_pair_stays_as_it_is() -> None:
    rig = ALL["ideal"]
    fused = frame(rig, "left")
    assert rectify(fused, rig, "left") is fused


def test_surfaces_are_not_mixed_and_infinity_stays() -> None:
    rig = ALL["turned"]
    fused = frame(rig, "left")
    depth = np.where(np.arange(640) < 300, np.float32(2.0), np.float32(np.inf)) * np.ones((480, 1), np.float32)
    found = rectify(replace(fused, depth=depth, origin=np.full_like(fused.origin, Origin.HERE)), rig, "left")
    camera = rectified_camera(rig)
    factor = camera.unproject(camera.pixel_grid()) @ rig.own("left").R[2]
    own = (found.depth * factor)[found.origin == Origin.HERE]
    np.testing.assert_allclose(np.unique(np.round(own[np.isfinite(own)], 4)), [2.0])
    assert np.count_nonzero(np.isinf(own)) > 50_000


def read_calibration(path: Path) -> dict[str, Any]:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    names = [f"{key}{k}" for key in ("M", "D", "R", "P", "size") for k in (1, 2)] + ["R", "T", "Q"]
    found: dict[str, Any] = {name: storage.getNode(name).mat() for name in names}
    found["size"] = tuple(int(storage.getNode(f"image_{each}").real()) for each in ("width", "height"))
    found["lenses"] = [storage.getNode(f"lens{k}").string() for k in (1, 2)]
    return found


@pytest.fixture(scope="module", params=["turned", "vertical", "toed in", "ideal", "lens", "spheres"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[StereoRig, Path]:
    rig, folder = ALL[request.param], tmp_path_factory.mktemp("pair")
    for side in SIDES:
        write_rectified(folder, f"{side}_0", frame(rig, side), rig, side)
    write_calibration(folder, rig)
    return rig, folder / FOLDER


def test_opencv_reads_the_pair(made: tuple[StereoRig, Path]) -> None:
    """Q turns the disparities of the files into points, which P1 and P2 see where both images show the same."""
    rig, folder = made
    known = read_calibration(folder / "calibration.yml")
    left, right = (cv2.imread(str(folder / f"{side}_0.png"), cv2.IMREAD_GRAYSCALE) for side in SIDES)
    assert left.shape == right.shape == known["size"][::-1]
    disparity = cv2.imread(str(folder / "disparity/left_0.png"), cv2.IMREAD_UNCHANGED) / np.float32(256.0)
    depth = read_depth(folder / "depth/left_0.exr")
    inner = cv2.erode((disparity > 0.0).astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    X = cv2.reprojectImageTo3D(disparity, known["Q"])[inner]
    # Disparities are rounded to 1/256 px.
    np.testing.assert_allclose(X[:, 2], depth[inner], rtol=2e-3)
    exact = see(rig, "left", rectified_camera(rig).unproject(rectified_camera(rig).pixel_grid())).X
    np.testing.assert_allclose(X, exact[inner] + rig.offset("left"), rtol=0, atol=2e-3 * DISTANCE * 2)
    grid = rectified_camera(rig).pixel_grid()[inner]
    x = np.append(X, np.ones((len(X), 1)), axis=1) @ np.stack([known["P1"], known["P2"]]).transpose(0, 2, 1)
    ends = x[..., :2] / x[..., 2:]
    np.testing.assert_allclose(ends[0], grid, atol=1e-3)
    np.testing.assert_allclose(ends[1], grid - np.outer(disparity[inner], [1.0, 0.0]), atol=1e-3)
    places = np.full((*inner.shape, 2), -9.0, np.float32)
    places[inner] = ends[1]
    seen = cv2.remap(right, places[..., 0], places[..., 1], cv2.INTER_LINEAR)[inner]
    both = (seen > 0) & (left[inner] > 0)
    assert np.mean(both) > 0.5
    assert np.mean(np.abs(seen[both].astype(float) - left[inner][both])) < 1.0  # grey levels
    # R1 and R2 turn the cameras' axes into the pair's: R2 (R X + T) = R1 X - (B, 0, 0).
    X_left = exact[inner][::500] @ known["R1"]
    in_right = (X_left @ known["R"].T + known["T"].T) @ known["R2"].T
    np.testing.assert_allclose(in_right, X_left @ known["R1"].T - [rig.baseline, 0.0, 0.0], atol=1e-9)


def test_opencv_would_resample_the_sensor_in_the_same_places(made: tuple[StereoRig, Path]) -> None:
    rig, folder = made
    known = read_calibration(folder / "calibration.yml")
    rays = rectified_camera(rig).unproject(rectified_camera(rig).pixel_grid())
    for k, side in enumerate(SIDES, start=1):
        lens, M, D, R, P = known["lenses"][k - 1], *(known[f"{key}{k}"] for key in "MDRP")
        ours = rig.eye(side).project(rays)
        assert known[f"size{k}"].ravel().tolist() == [rig.sensor(side).width, rig.sensor(side).height]
        if lens == "double-sphere":
            continue  # OpenCV has no such lens
        maps: Any = cv2.fisheye if lens == "kannala-brandt" else cv2
        theirs = np.stack(maps.initUndistortRectifyMap(M, D, R, P[:, :3], known["size"], cv2.CV_32FC1), axis=-1)
        seen = rig.sensor(side).contains(ours)
        np.testing.assert_allclose(theirs[seen], ours[seen], atol=1e-3)  # single precision


def test_opencv_rectifies_the_same_rig_alike() -> None:
    """Its rectified axes share the baseline with ours, and are turned about it by less than the cameras apart."""
    left = replace(LEFT, lens=None)
    rig = StereoRig.of_cameras(left, left, so3.exp(np.array([0.01, -0.02, 0.03])), [-0.25, 0.01, -0.02])
    R, T = rig.right_from_left
    R1, R2, *_ = cv2.stereoRectify(left.K, np.zeros(5), left.K, np.zeros(5), (640, 480), R, T[:, None])
    ours = [rig.own(side).R.T for side in SIDES]
    for theirs, mine in zip((R1, R2), ours, strict=True):
        about_x = so3.log(theirs @ mine.T)
        np.testing.assert_allclose(about_x[1:], 0.0, atol=1e-9)
        assert abs(about_x[0]) < 0.01
    assert np.trace(R1 @ ours[0].T) == pytest.approx(np.trace(R2 @ ours[1].T), abs=1e-12)


def test_we_and_colmap_read_the_cameras(made: tuple[StereoRig, Path]) -> None:
    rig, folder = made
    camera = rectified_camera(rig)
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 left_0.png\n\n2 1 0 0 0 0 0 0 2 right_0.png\n\n")
    assert [recording.cameras["left"] for recording in read_colmap(folder, folder)] == [camera] * 2
    pycolmap = pytest.importorskip("pycolmap")
    for name in ("images.txt", "points3D.txt"):
        (folder / name).write_text("")
    cameras = pycolmap.Reconstruction(folder).cameras
    assert sorted(cameras) == [1, 2]
    for each in cameras.values():
        assert (each.model.name, each.width, each.height) == ("PINHOLE", camera.width, camera.height)
        np.testing.assert_allclose(each.params, [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5])
