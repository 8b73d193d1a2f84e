"""Depth and correction through lenses and with other scans, against the closed-form world of conftest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import back_project, project_at, row_poses, rs_project_near
from rsbench.core.shutter import Scanning
from rsbench.vision.correction import correct_frame, correction_flow
from rsbench.vision.epipolar_search import depth_from_motion
from rsbench.vision.fusion import Origin, SourceView, fuse
from rsbench.vision.quality import psnr
from rsbench.vision.reprojection import distort, optics_of
from rsbench.vision.stereo_depth import seen_by_other, timed_depth
from rsbench.vision.stereo_matcher import load_matcher, sensor_disparities

GEOMETRY_PX = 0.01
BARREL = Lens(model="brown-conrady", k1=-0.22, k2=0.05, p1=0.002, p2=-0.001)
CUSHION = Lens(model="brown-conrady", k1=0.15, k3=0.1)
FISHEYE = Lens(model="kannala-brandt", k1=-0.03, k2=0.01, k4=0.002)
RATIONAL = Lens(model="rational", k1=0.9, k2=0.06, p1=-0.0004, p2=0.0002, k3=0.001, k4=1.25, k5=0.22, k6=0.006)
SPHERES = Lens(model="double-sphere", xi=-0.18, alpha=0.59)
Build = Callable[..., Any]
CASES: dict[str, tuple[Lens | None, Scanning]] = {
    "barrel": (BARREL, Scanning()),
    "fisheye": (FISHEYE, Scanning()),
    "rational": (RATIONAL, Scanning()),
    "spheres": (SPHERES, Scanning()),
    "bottom": (None, Scanning(scan="bottom")),
    "barrel, bottom": (BARREL, Scanning(scan="bottom")),
    "columns": (None, Scanning(scan="left")),
    "fisheye, columns from the right, late": (FISHEYE, Scanning(scan="left", right_scan="right", right_delay=0.2)),
}


def _seen(scene: Any, lens: Lens | None, scanning: Scanning = Scanning()) -> Any:  # noqa: B008
    """The same world through a lens, with another scan."""
    camera = replace(scene.rig.camera, lens=lens)
    shutter = scanning.shutter_of(camera.width, camera.height, scene.shutter.readout_ratio)
    return replace(scene, rig=replace(scene.rig, camera=camera), shutter=shutter)


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A card before a leaning wall."""

    def inside(X: np.ndarray) -> np.ndarray:
        return (np.abs(X[..., 0] + 0.2) < 0.5) & (np.abs(X[..., 1]) < 0.6)

    surfaces = (shapes[0]((0.05, 0.2, 1.0), 7.0), shapes[0]((0.1, 0.0, 1.0), 3.0, inside))
    return world(surfaces, shortest=0.3, w_deg=(0.9, 1.2, -1.0))


def _smooth(depth: np.ndarray) -> np.ndarray:
    """Pixels without a jump of depth near them."""
    kernel = np.ones((5, 5), np.uint8)
    return cv2.dilate(depth, kernel) <= cv2.erode(depth, kernel) * 1.04


@settings(max_examples=60)
@given(st.sampled_from([BARREL, CUSHION, FISHEYE, RATIONAL, SPHERES]), st.floats(-200, 400), st.floats(-200, 400))
def test_the_compiled_lens_is_the_one_of_the_camera(lens: Lens, x: float, y: float) -> None:
    camera = PinholeCamera(width=200, height=160, fx=260.0, fy=250.0, cx=97.0, cy=81.0, lens=lens)
    numbers, expected = optics_of(camera).lens, camera.lens_pixels(np.array([x, y]))
    assert numbers is not None
    np.testing.assert_allclose(np.array(distort(numbers, x, y)), expected, atol=1e-9)
    centre = np.array(distort(numbers, 97.0 + 1e-7, 81.0))
    np.testing.assert_allclose(centre, [97.0 + 1e-7 / (1.0 + lens.xi), 81.0], atol=1e-12)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("case", CASES)
def test_every_pixel_lands_where_the_twin_sees_its_point(scene: Any, truth: Build, case: str, side: Any) -> None:
    """Source coordinates, depth and image against traced rays and ``rs_project``: resampled once."""
    real = _seen(scene, *CASES[case])
    tau = float(real.shutter.start(1, side))
    image, depth = real.rolling(side, 1)
    expected = truth(real, side, 1, tau)
    got = correct_frame(image.astype(np.float32), depth.astype(np.float32), real, (side, 1))
    seen = expected.visible & _smooth(expected.depth.astype(np.float32))
    assert np.mean(got.mask[seen]) > 0.999
    both = seen & got.mask
    error = np.linalg.norm(got.source_map - expected.source, axis=-1)[both]
    assert np.quantile(error, 0.999) < GEOMETRY_PX
    np.testing.assert_allclose(got.depth[both], expected.depth[both], rtol=1e-3)
    # Waves of ten pixels and more, resampled once.
    assert psnr(got.image, expected.image.astype(np.float32), both) > 45.0
    assert psnr(image, expected.image, both) < 35.0


@pytest.mark.parametrize("case", CASES)
def test_flow_is_back_projection_and_projection(scene: Any, case: str) -> None:
    real = _seen(scene, *CASES[case])
    _, depth = real.rolling("right", 1)
    grid = real.rig.camera.pixel_grid()
    X = back_project(real.rig, real.shutter, real.motion, "right", 1, grid, depth)
    expected = project_at(real.rig, real.motion, "right", 1.3, X)[..., :2] - grid
    np.testing.assert_allclose(correction_flow(depth, real, ("right", 1), target_tau=1.3), expected, atol=1e-4)


@pytest.mark.parametrize("case", ["barrel", "fisheye", "columns", "fisheye, columns from the right, late"])
def test_holes_are_filled_from_the_other_frames(scene: Any, truth: Build, case: str) -> None:
    real = _seen(scene, *CASES[case])

    def view(side: Any, frame: int, origin: Origin) -> SourceView:
        image, depth = real.rolling(side, frame)
        poses, columns = row_poses(real.rig, real.shutter, real.motion, side, frame), real.shutter.axis(side) == 0
        return SourceView(
            image=image.astype(np.float32),
            depth=depth.astype(np.float32),
            poses=poses,
            origin=origin,
            columns=columns,
        )

    views = [
        view("left", 1, Origin.HERE),
        view("right", 1, Origin.OTHER_CAMERA),
        view("left", 0, Origin.OTHER_FRAME),
    ]
    got = fuse(views, real.rig.camera, real.rig.cam_from_world(real.motion, 1.0, "left"))
    expected = truth(real, "left", 1, 1.0)
    filled = np.isin(got.origin, [Origin.OTHER_CAMERA, Origin.OTHER_FRAME]) & _smooth(expected.depth.astype("f4"))
    assert np.count_nonzero(filled) > 100
    wrong = np.abs(got.depth[filled] - expected.depth[filled]) > 0.01 * expected.depth[filled]
    assert np.mean(wrong) < 0.03  # the rim of a surface may go to either side
    assert psnr(got.image, expected.image.astype(np.float32), filled) > 35.0


@pytest.mark.parametrize("case", CASES)
def test_the_other_frame_gives_depth_where_the_other_camera_gives_none(scene: Any, u8: Build, case: str) -> None:
    real = _seen(scene, *CASES[case])
    (first, z0), (second, z1) = (real.rolling("left", frame) for frame in (0, 1))
    known = [depth.astype(np.float32) for depth in (z0, z1)]
    known[0][60:80, 80:120] = 0.0
    found = depth_from_motion(
        (u8(first), u8(second)), (known[0], known[1]), real.rig, real.shutter, real.motion, "left"
    )
    part = found[0][60:80, 80:120]
    assert np.mean(part > 0.0) > 0.7
    # Within half a pixel of parallax, of some twenty.
    assert np.median(np.abs(part[part > 0.0] / z0[60:80, 80:120][part > 0.0] - 1.0)) < 0.03


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("lens", [BARREL, FISHEYE])
def test_depth_counts_that_both_ends_of_a_disparity_have_their_own_time(scene: Any, lens: Lens, side: Any) -> None:
    """From the column at which the other camera sees a point, by ``rs_project``, back to the point's depth."""
    real = _seen(scene, lens)
    camera = real.rig.camera
    other: Any = "right" if side == "left" else "left"
    geometry = real.rig, real.shutter, real.motion
    _, depth = real.rolling(side, 1)
    grid = camera.pixel_grid()
    seen = rs_project_near(*geometry, other, 1, back_project(*geometry, side, 1, grid, depth), grid[..., 1])
    disparity = np.abs(camera.ideal_pixels(grid)[..., 0] - camera.ideal_pixels(seen.pixels)[..., 0])
    at_rest = np.nan_to_num(real.rig.depth(disparity)).astype(np.float32)
    got = timed_depth(at_rest, *geometry, side, 1)
    known = at_rest > 0.0
    assert np.mean(known) > 0.5
    shift = np.abs(real.rig.disparity(got) - real.rig.disparity(depth))[known]
    # What is left: the row of the other end is that of a rig at rest, which the motion misses by a tenth of a row.
    assert shift.max() < 0.005
    assert np.abs(disparity - real.rig.disparity(depth))[known].max() > 10 * shift.max()
    np.testing.assert_array_equal(got == 0.0, ~known)


@pytest.mark.parametrize("lens", [BARREL, CUSHION, FISHEYE])
def test_disparities_lie_on_the_pixels_of_the_sensor(scene: Any, u8: Build, lens: Lens) -> None:
    """Of a rig at rest, so that nothing but the lens is between the disparity and fx b / z."""
    real = replace(_seen(scene, lens), motion=type(scene.motion)(np.zeros(3), np.zeros(3)))
    (left, depth), (right, other) = (real.rolling(side, 0) for side in ("left", "right"))
    found = sensor_disparities(load_matcher("sgm"), u8(left), u8(right), real.rig)
    for side, mine, theirs, disparity in (("left", depth, other, found[0]), ("right", other, depth, found[1])):
        seen: Any = seen_by_other(mine, theirs, real.rig, side)
        seen &= _smooth(mine.astype(np.float32))
        error = np.abs(disparity - real.rig.disparity(mine))[seen]
        assert np.mean(np.isfinite(error)) > 0.9
        assert np.nanmedian(error) < 0.05
        assert np.nanquantile(error, 0.95) < 0.5
