from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core.projection import back_project, project_at, row_poses
from rsbench.core.se3 import Pose
from rsbench.vision.correction import LineView, WarpOptions, correct_frame, correction_flow, warp
from rsbench.vision.quality import psnr

GEOMETRY_PX = 0.01
"""Required of the source coordinates on planes and smooth surfaces."""
Build = Callable[..., Any]


def _correct(world: Any, side: Any = "left", frame: int = 1, tau: float | None = None, **options: Any) -> Any:
    image, depth = world.rolling(side, frame)
    return correct_frame(
        image.astype(np.float32), depth.astype(np.float32), world, (side, frame), target_tau=tau, **options
    )


def _flat(depth: np.ndarray, step: float = 0.01, reach: int = 2) -> np.ndarray:
    """Pixels with no jump of depth (relative to it) within ``reach`` px."""
    near = np.where(np.isfinite(depth), depth, 1e9).astype(np.float32)
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    return cv2.dilate(near, kernel) <= cv2.erode(near, kernel) * (1 + step * reach)


@pytest.mark.slow
@settings(max_examples=8)
@given(
    tilt=st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    move=st.tuples(*[st.floats(-0.4, 0.4)] * 3),
    middle=st.booleans(),
)
def test_slanted_planes_are_exact_and_whole(
    world: Build, shapes: Any, truth: Build, tilt: Any, turn: Any, move: Any, middle: bool
) -> None:
    """Every target pixel whose point the frame saw is covered, at the pixel that ``rs_project`` finds for it."""
    scene = world((shapes[0]((*tilt, 1.0), 6.0),), w_deg=turn, d=move)
    tau = 1.4 if middle else 1.0
    expected = truth(scene, "left", 1, tau)
    got = _correct(scene, tau=tau)
    grown = cv2.erode(expected.visible.astype(np.uint8), np.ones((3, 3))) > 0
    assert np.all(got.mask[grown])
    both = got.mask & expected.visible
    error = np.linalg.norm(got.source_map - expected.source, axis=-1)[both]
    assert error.max(initial=0.0) < GEOMETRY_PX
    # Inverse depth is affine on a plane of one pose; the shutter bends it a little.
    np.testing.assert_allclose(got.depth[both], expected.depth[both], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("frame", [0, 1])
def test_spheres_before_a_wall(world: Build, shapes: Any, truth: Build, side: str, frame: int) -> None:
    """Smooth surfaces, occlusion and disocclusion: exact where seen, absent where not, nearest first."""
    Plane, Sphere = shapes
    scene = world((Plane((0.1, 0.2, 1), 8), Sphere((0.2, 0.1, 4), 0.7), Sphere((-0.9, -0.3, 5), 0.5)))
    expected = truth(scene, side, frame, float(frame))
    got = _correct(scene, side, frame)
    smooth = _flat(expected.depth)
    seen = expected.visible & smooth
    # A pixel apart from depth edges everything seen is covered, with the right surface.
    assert np.mean(got.mask[seen]) > 0.999
    both = seen & got.mask
    np.testing.assert_allclose(got.depth[both], expected.depth[both], rtol=1e-3)
    error = np.linalg.norm(got.source_map - expected.source, axis=-1)[both]
    assert np.quantile(error, 0.999) < GEOMETRY_PX
    assert error.max() < 0.05
    # What the frame did not see is not made up: covered pixels lie within a pixel of seen ones.
    assert not np.any(got.mask & ~(cv2.dilate(expected.visible.astype(np.uint8), np.ones((3, 3))) > 0))


def test_occlusion_order(world: Build, shapes: Any, truth: Build) -> None:
    """A card before a wall: where both land on one pixel the card wins, and its shadow on the wall stays empty."""
    Plane, _ = shapes
    card = Plane((0, 0, 1), 3.0, lambda X: (np.abs(X[..., 0]) < 0.5) & (np.abs(X[..., 1]) < 0.4))
    scene = world((card, Plane((0, 0, 1), 9.0)), d=(0.6, 0.0, 0.0), w_deg=(0.0, 0.0, 0.0), readout_ratio=1.0)
    expected = truth(scene, "left", 0, 0.0)
    got = _correct(scene, frame=0)
    inner = _flat(expected.depth, reach=1)
    both = got.mask & inner & expected.visible
    np.testing.assert_allclose(got.depth[both], expected.depth[both], rtol=1e-5)
    projected = np.all(np.abs(expected.source - [99.5, 79.5]) < [98, 78], axis=-1)
    # The boundary is known to half a pixel of the source: look a pixel inside.
    hidden = cv2.erode((~expected.visible & inner & projected).astype(np.uint8), np.ones((3, 3))) > 0
    assert np.count_nonzero(hidden) > 100
    assert not np.any(got.mask[hidden])


def test_sky_moves_by_rotation_alone(world: Build, shapes: Any) -> None:
    """At infinity the map is K R K^-1 of the row's pose, whatever the translation, and everything hides it."""
    scene = world((), d=(0.5, -0.3, 0.4), w_deg=(1.0, -2.0, 1.5), sky=True)
    got = _correct(scene)
    assert np.all(np.isinf(got.depth[got.mask]))
    rows = got.source_map[got.mask][:, 1].astype(np.float64)
    tau = scene.shutter.row_time(rows, 1)
    source, target = (scene.rig.cam_from_world(scene.motion, t, "left").R for t in (tau, 1.0))
    rays = scene.rig.camera.unproject(got.source_map[got.mask])
    moved = scene.rig.camera.project((target @ np.swapaxes(source, -1, -2) @ rays[..., None])[..., 0])
    assert np.abs(moved - scene.rig.camera.pixel_grid()[got.mask]).max() < GEOMETRY_PX
    assert np.mean(got.mask) > 0.85


def test_sky_mask_and_infinite_depth_are_the_same(world: Build, shapes: Any, truth: Build) -> None:
    card = shapes[0]((0, 0, 1), 3.0, lambda X: (np.abs(X[..., 0]) < 0.4) & (np.abs(X[..., 1]) < 0.3))
    scene = world((card,), sky=True)
    image, depth = scene.rolling("left", 1)
    zero = np.where(np.isfinite(depth), depth, 0.0)
    arguments: Any = (scene, ("left", 1))
    a = correct_frame(image.astype(np.float32), depth, *arguments)
    b = correct_frame(image.astype(np.float32), zero, *arguments, sky_mask=zero == 0.0)
    c = correct_frame(image.astype(np.float32), zero, *arguments)
    np.testing.assert_array_equal(a.source_map, b.source_map)
    np.testing.assert_array_equal(a.image, b.image)
    expected = truth(scene, "left", 1, 1.0)
    covered = a.mask & expected.visible & _flat(expected.depth)
    np.testing.assert_array_equal(np.isinf(a.depth[covered]), np.isinf(expected.depth[covered]))
    # Without a mask a depth of 0 is unknown: only the card comes through.
    assert not np.any(np.isinf(c.depth)) and 0 < np.mean(c.mask) < 0.5


@pytest.mark.parametrize("case", ["readout", "motion"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_nothing_moves_without_readout_or_motion(world: Build, shapes: Any, case: str, dtype: type) -> None:
    """Identity: the same pixels, bit for bit, holes of unknown depth aside."""
    still = {"w_deg": (0.0, 0.0, 0.0), "d": (0.0, 0.0, 0.0)} if case == "motion" else {"readout_ratio": 0.0}
    scene = world((shapes[0]((0.3, 0.2, 1.0), 6.0), shapes[1]((0, 0, 3), 0.5)), **still)
    image, depth = scene.rolling("right", 1)
    image = (image if dtype is np.float32 else image * np.iinfo(dtype).max).astype(dtype)
    depth[10:20, 30:50] = np.nan
    got = correct_frame(image, depth, scene, ("right", 1))
    np.testing.assert_array_equal(got.mask, np.isfinite(depth))
    np.testing.assert_array_equal(got.image, np.where(np.isfinite(depth)[..., None], image, 0))
    moved = np.abs(got.source_map - scene.rig.camera.pixel_grid())[got.mask]
    assert moved.max() < 1e-4  # float32 of pixel coordinates, and R R^T of the pose composition
    np.testing.assert_allclose(got.depth[got.mask], depth[got.mask], rtol=1e-6)


def test_image_is_that_of_the_global_shutter(world: Build, shapes: Any, truth: Build) -> None:
    """On a texture that the pixels resolve, only the resampling error is left: far above 8 bits (59 dB)."""
    scene = world((shapes[0]((0.2, 0.3, 1.0), 6.0),), shortest=0.4)
    expected = truth(scene, "left", 1, 1.0)
    image, _ = scene.rolling("left", 1)
    got = _correct(scene)
    mask = cv2.erode((got.mask & expected.visible).astype(np.uint8), np.ones((7, 7))) > 0
    assert psnr(got.image, expected.image, mask) > 60.0
    assert psnr(image, expected.image, mask) < 30.0
    linear = _correct(scene, options=WarpOptions(interpolation="linear"))
    assert psnr(linear.image, expected.image, mask) < psnr(got.image, expected.image, mask) - 6


def test_other_poses_and_twist_motion(world: Build, shapes: Any, truth: Build) -> None:
    """``warp`` takes any poses: the left frame seen from the right camera, under another motion model."""
    scene = world((shapes[0]((0.2, 0.3, 1.0), 6.0),))
    twist = TwistMotion(scene.motion.w, scene.motion.d)
    object.__setattr__(scene, "motion", twist)
    image, depth = scene.rolling("left", 1)
    poses = row_poses(scene.rig, scene.shutter, twist, "left", 1)
    target = scene.rig.cam_from_world(twist, 1.0, "right")
    got = warp(LineView(image=image.astype(np.float32), depth=depth, poses=poses), scene.rig.camera, target)
    points = back_project(scene.rig, scene.shutter, twist, "left", 1, got.source_map[got.mask], 1.0)
    centre = back_project(scene.rig, scene.shutter, twist, "left", 1, got.source_map[got.mask], 0.0)
    n = np.array([0.2, 0.3, 1.0])
    scale = (6.0 - centre @ n) / ((points - centre) @ n)
    seen = project_at(scene.rig, twist, "right", 1.0, centre + scale[:, None] * (points - centre))
    assert np.abs(seen[:, :2] - scene.rig.camera.pixel_grid()[got.mask]).max() < GEOMETRY_PX
    np.testing.assert_allclose(got.depth[got.mask], seen[:, 2], rtol=1e-4)


def test_nothing_in_front_is_nothing_covered(world: Build, shapes: Any) -> None:
    """A target beyond the wall sees none of it; unknown depth everywhere neither."""
    scene = world((shapes[0]((0.0, 0.0, 1.0), 6.0),), d=(0.0, 0.0, -20.0))
    image, depth = scene.rolling("left", 0)
    depth[~np.isfinite(depth)] = np.nan  # the last rows are beyond it, too
    arguments: Any = (scene, ("left", 0))
    beyond = correct_frame(image.astype(np.float32), depth, *arguments, target_tau=0.9)
    unknown = correct_frame(image.astype(np.float32), np.full_like(depth, np.nan), *arguments)
    for got in (beyond, unknown):
        assert not np.any(got.mask) and np.all(np.isnan(got.source_map)) and not np.any(got.image)


@pytest.mark.parametrize(
    "wrong",
    [
        {"image": np.zeros((160, 201, 3), dtype=np.uint8)},
        {"image": np.zeros((160, 200), dtype=np.int32)},
        {"image": np.zeros((160, 200), dtype=np.float64)},
        {"image": np.zeros(160, dtype=np.uint8)},
        {"depth": np.ones((200, 160))},
        {"depth": np.ones((160, 200), dtype=np.int64)},
        {"sky_mask": np.zeros((160, 200))},
        {"sky_mask": np.zeros((160, 2), dtype=bool)},
        {"poses": Pose(np.zeros((3, 3, 3)), np.zeros((3, 3)))},
    ],
)
def test_bad_input(world: Build, wrong: dict[str, Any]) -> None:
    scene, wrong = world(()), dict(wrong)
    poses = row_poses(scene.rig, scene.shutter, LinearMotion(np.zeros(3), np.zeros(3)), "left", 0)
    right: dict[str, Any] = {
        "image": np.zeros((160, 200, 3), dtype=np.uint8),
        "depth": np.ones((160, 200)),
        "poses": poses,
    }
    sky_mask = wrong.pop("sky_mask", None)
    with pytest.raises(ValueError, match="must"):
        warp(LineView(**(right | wrong)), scene.rig.camera, Pose(np.eye(3), np.zeros(3)), sky_mask=sky_mask)


def test_bad_options_and_times(world: Build) -> None:
    bad: list[dict[str, Any]] = [{"interpolation": "nearest"}, {"tear_px": 0.0}, {"tear_px": float("nan")}]
    for options in bad:
        with pytest.raises(ValueError, match="must"):
            WarpOptions(**options)
    scene = world(())
    with pytest.raises(ValueError, match="target_tau"):
        correction_flow(np.ones((160, 200)), scene, ("left", 0), target_tau=float("nan"))
