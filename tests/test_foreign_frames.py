"""Foreign frames: their laws, times, lens and visibility against rsbench's, which shares no code with them."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from programs import ROOT

from rsbench.components.motion_models import AcceleratedMotion, InertialMotion, LinearMotion, TwistMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side
from rsbench.interop.readers.rig_files import Readout, read_rig_file
from rsbench.pipeline.footage import read_rig_card

SMALL = {"width": 160, "height": 120, "focal": 130.0}
W, D = np.array([0.03, -0.055, 0.02]), np.array([-0.12, 0.05, -0.15])
RIGS = ["ideal", "turned", "focal", "printed", "toed-in", "vertical", "sizes", "fisheye", "late"]
RIGS += ["global-left", "global-right"]
CASES = [(0.8, ("top", "top"), 0.0), (0.7, ("bottom", "left"), -0.15), (0.6, ("right", "bottom"), 0.1)]


class Programs(NamedTuple):
    case: ModuleType
    frames: ModuleType
    motion: ModuleType
    rectify: ModuleType
    rig: ModuleType
    table: ModuleType
    world: ModuleType


@pytest.fixture(scope="module")
def programs_() -> Iterator[Programs]:
    """The programs, which find each other in their folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        names = ["rectify_study" if name == "rectify" else f"foreign_{name}" for name in Programs._fields]
        yield Programs(*map(importlib.import_module, names))


def _laws(motion: ModuleType) -> list[tuple[Any, type[Motion], dict[str, float]]]:
    return [
        (motion.Linear(W, D), LinearMotion, {}),
        (motion.Twist(W, D), TwistMotion, {}),
        (motion.Inertial(W, D), InertialMotion, {}),
        (motion.Accelerated(W, D, 0.3), AcceleratedMotion, {"acceleration": 0.3}),
        (motion.Shaken(W, D), InertialMotion, {}),  # with amplitudes of 0, nothing pushes
    ]


def test_laws_are_those_of_the_models_with_their_end_points(programs_: Programs) -> None:
    tau = np.linspace(0.0, 2.0, 23)
    for law, model, parameters in _laws(programs_.motion):
        R, t = law.body(tau)
        true = model(*programs_.motion.between(law, 0.0, 1.0), **parameters).body_from_world(tau)
        # Rounding, which the vector of a rotation matrix enlarges.
        np.testing.assert_allclose(R, true.R, atol=1e-12)
        np.testing.assert_allclose(t, true.t, atol=1e-12)


def test_depth_is_that_of_a_wall(programs_: Programs) -> None:
    """z = n c / (n ray) of a pixel's ray, in the camera of its line; infinite beside the wall."""
    foreign, law = programs_.rig.equal(ratio=0.8, **SMALL), programs_.motion.Linear(W, D)
    corner, across, down = np.array([-0.5, -9.0, 4.0]), np.array([9.0, 0.0, 2.0]), np.array([0.0, 18.0, 0.0])
    quad = programs_.world.Quad(corner, across, down)
    world = programs_.world.assemble([quad], [np.zeros((8, 8), np.float32)])
    camera = foreign.left
    R, t = foreign.poses(law, "left", camera.times(1))
    found = programs_.frames.trace_depth(world, camera, (R, t))
    rays = programs_.case.our_camera(camera).unproject(
        np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=-1)
    )
    normal = R @ np.cross(across, down)
    distance = np.sum(normal * (R @ corner + t), axis=-1)
    known = np.isfinite(found)
    true = distance[:, None] / np.sum(normal[:, None] * rays, axis=-1)
    np.testing.assert_allclose(found[known], true[known], rtol=1e-5)  # of float32
    assert 0.4 < np.mean(known) < 0.9


def _points(directions: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Points (n, 3), 3 to 12 m away, of image coordinates x and y of a focal length of 1."""
    x, y = directions
    depth = np.random.default_rng(7).uniform(3.0, 12.0, x.shape)
    return np.stack([x * depth, y * depth, depth], axis=-1).reshape(-1, 3)


def _found(image: NDArray[np.float32], expected: Iterable[NDArray[np.float64] | None], border: float) -> int:
    """How many dots lie within a border, all where they are expected."""
    found, (height, width) = 0, image.shape
    for true in expected:
        if true is not None and np.all((true > border) & (true < np.array([width, height]) - border)):
            # Across a dot of 1.4 px a tilt of 6 deg shifts the centroid by 0.005 px and the lens by up to 0.02.
            np.testing.assert_allclose(_centroid(image, true), true, atol=0.03)
            found += 1
    return found


def _dots(programs_: Programs, rig: Any, law: Any, points: NDArray[np.float64], side: Side) -> NDArray[np.float32]:
    """Frame 1 of a moving camera that sees a soft dot at each point."""
    at = np.linspace(-1.0, 1.0, 33)
    dot = 200.0 * np.exp(-0.5 * (at**2 + at[:, None] ** 2) / 0.23**2)
    quads = [
        programs_.world.Quad(point - [size, size, 0.0], np.array([2.0 * size, 0, 0]), np.array([0, 2.0 * size, 0]))
        for point, size in zip(points, points[:, 2] * 6.0 / rig.camera(side).focal, strict=True)
    ]
    world = programs_.world.assemble(quads, [dot.astype(np.float32)] * len(quads))
    camera = rig.camera(side)
    image: NDArray[np.float32] = programs_.frames.trace(world, camera, rig.poses(law, side, camera.times(1)))
    return image


@pytest.mark.parametrize("row", RIGS)
@pytest.mark.parametrize("side", SIDES)
def test_rigs_show_dots_where_opencv_projects_them(programs_: Programs, row: str, side: Side) -> None:
    rig, law = programs_.frames.RIGS[row], programs_.motion.Linear(W, D)
    points = _points(np.meshgrid(np.linspace(-0.5, 0.5, 6), np.linspace(-0.4, 0.4, 5)))
    image = _dots(programs_, rig, law, points, side)
    assert _found(image, [_seen_by_opencv(rig, rig.camera(side), side, point) for point in points], 15.0) >= 10


def _seen_by_opencv(rig: Any, camera: Any, side: Side, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pixel of frame 1 at the time of its row, from R and t of the calibration alone."""
    centre = -rig.R.T @ rig.t  # of the right camera, in the left one
    across = centre / np.linalg.norm(centre)
    ahead = np.array([0.0, 0.0, 1.0]) + rig.R.T @ [0.0, 0.0, 1.0]
    ahead -= (ahead @ across) * across
    ahead /= np.linalg.norm(ahead)
    axes = np.stack([across, np.cross(ahead, across), ahead])
    K = np.array([[camera.fx, 0.0, camera.centre[0]], [0.0, camera.fy, camera.centre[1]], [0.0, 0.0, 1.0]])
    pixel = np.array(camera.centre)
    for _ in range(30):
        tau = 1.0 + camera.delay + camera.ratio * pixel[1] / camera.height
        in_left = axes.T @ (cv2.Rodrigues(tau * W)[0] @ point + tau * D) + centre / 2.0
        seen = in_left if side == "left" else rig.R @ in_left + rig.t
        if camera.lens == "kannala-brandt":
            k = np.array(camera.coefficients)
            pixel = cv2.fisheye.projectPoints(seen.reshape(1, 1, 3), np.zeros(3), np.zeros(3), K, k)[0].ravel()
        else:
            k = np.array([*camera.coefficients, *[0.0] * (5 - len(camera.coefficients))])
            pixel = cv2.projectPoints(seen.reshape(1, 1, 3), np.zeros(3), np.zeros(3), K, k)[0].ravel()
    return np.asarray(pixel)


def test_rsbench_has_the_poses_that_rigs_were_traced_with(programs_: Programs) -> None:
    tau = np.linspace(0.0, 2.0, 7)
    for row, foreign in programs_.frames.RIGS.items():
        rig, shutter = programs_.case.ours(foreign)
        law = programs_.motion.Linear(W, D)
        for side in SIDES:
            R, t = foreign.poses(law, side, tau)
            pose = rig.cam_from_world(LinearMotion(W, D), tau, side)
            np.testing.assert_allclose(pose.R, R, atol=1e-12, err_msg=row)
            np.testing.assert_allclose(pose.t, t, atol=1e-12, err_msg=row)
            np.testing.assert_allclose(shutter.line_times(1, side), foreign.camera(side).times(1), atol=1e-12)


@pytest.mark.parametrize("row", RIGS)
def test_rsbench_reads_the_files_of_a_rig_as_it_was_traced(programs_: Programs, row: str, tmp_path: Path) -> None:
    foreign = programs_.frames.RIGS[row]
    rig, shutter = programs_.case.ours(foreign)
    (tmp_path / "rig.toml").write_text(programs_.rig.card(foreign, True), "utf-8")
    (tmp_path / "camchain.yaml").write_text(programs_.rig.camchain(foreign), "utf-8")
    for name, fps in (("rig.toml", None), ("camchain.yaml", 30.0)):
        card = read_rig_file(tmp_path / name, Readout(fps=fps))[0]
        found = card.rig(*((c.width, c.height) for c in (foreign.left, foreign.right)))
        assert [found.sensor(side) for side in SIDES] == [rig.sensor(side) for side in SIDES]
        np.testing.assert_allclose(found.right_from_left.R, foreign.R, atol=1e-12)
        np.testing.assert_allclose(found.right_from_left.t, foreign.t, atol=1e-12)
        assert found.aligned == rig.aligned == (row == "ideal")
        assert card.readout_ratio == shutter.readout_ratio
        assert card.scanning == shutter.scanning


def _centroid(image: NDArray[np.float32], near: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the grey values within 8 px."""
    x, y = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    weight = np.where(np.hypot(x - near[0], y - near[1]) < 8.0, image, 0.0)
    return np.array([np.sum(x * weight), np.sum(y * weight)]) / np.sum(weight)


@pytest.mark.parametrize(("ratio", "scans", "k1"), CASES)
def test_each_pixel_shows_the_nearest_quad_of_its_ray_at_its_time(
    programs_: Programs, ratio: float, scans: tuple[str, str], k1: float
) -> None:
    rng, foreign = np.random.default_rng(5), programs_.rig.equal(ratio=ratio, scans=scans, k1=k1, **SMALL)
    quads = programs_.world.random_world(rng, np.zeros((1, 3)), 20.0).quads
    greys = [np.full((9, 9), 10.0 * (k + 1), dtype=np.float32) for k in range(len(quads))]
    world = programs_.world.assemble(quads, greys)
    law, (rig, shutter) = programs_.motion.Linear(W, D), programs_.case.ours(foreign)
    for side in SIDES:
        camera = foreign.camera(side)
        image = programs_.frames.trace(world, camera, foreign.poses(law, side, camera.times(0)), samples=1)
        for pixel in rng.integers(0, (160, 120), (60, 2)):
            R, t = rig.cam_from_world(LinearMotion(W, D), shutter.pixel_time(pixel, 0, side), side)
            start, ray = -R.T @ t, R.T @ rig.camera.unproject(pixel)
            assert abs(image[pixel[1], pixel[0]] - 10.0 * (_nearest(quads, start, ray) + 1)) < 0.01


def _nearest(quads: list[Any], start: NDArray[np.float64], ray: NDArray[np.float64]) -> int:
    """Number of the quad that a ray meets first."""
    hits = []
    for number, quad in enumerate(quads):
        u, v, z = np.linalg.solve(np.stack([-quad.across, -quad.down, ray], axis=-1), quad.corner - start)
        if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0 and z > 0.0:
            hits.append((z, number))
    return min(hits)[1]


def test_a_case_is_written_with_rigs_that_the_command_reads_and_poses_that_are_true(
    programs_: Programs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = programs_.frames
    small = programs_.rig.equal(ratio=0.6, scans=("top", "right"), k1=-0.1, width=48, height=36, focal=40.0)
    case = frames.Case(law=programs_.motion.Linear(W, D), rig=small, frames=3)
    monkeypatch.setitem(frames.ROWS, "tiny", lambda rng: case)
    frames.write_case("tiny", 0, tmp_path, [])
    told, untold = (read_rig_card(tmp_path / f"{name}.toml") for name in ("told", "untold"))
    assert (told.readout_ratio, told.scan, told.right_scan) == (0.6, "top", "right")
    assert untold.readout_ratio is None and untold.scanning is None
    assert told.rig((48, 36)) == untold.rig((48, 36)) == programs_.case.ours(small)[0]
    truth = json.loads((tmp_path / "truth.json").read_text("utf-8"))
    times = programs_.case.ours(small)[1].line_times(2, "right")
    R, t = LinearMotion(W, D).body_from_world(times)
    poses = np.array(truth["poses"]["right"][2])
    np.testing.assert_allclose(programs_.motion.matrices(poses[:, :3]), R, atol=1e-10)
    np.testing.assert_allclose(poses[:, 3:], t, atol=1e-10)
    assert len(list(tmp_path.rglob("*.png"))) == 12  # two cameras, three times, rolling and global
