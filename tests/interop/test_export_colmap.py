"""COLMAP's text model, read by pycolmap where it is installed, and by a few lines and OpenCV's lenses anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic_dataset import PLANES
from exported_data import SAME_PX, dataset, exported, only, opencv_pixels, seen
from scipy.spatial.transform import Rotation

from rsbench.core.rig import views_of
from rsbench.core.so3 import FloatArray

MODELS = {"none": "PINHOLE", "brown": "OPENCV", "brown-k3": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}


@pytest.fixture(scope="module", params=["none", "brown", "brown-k3", "fisheye"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """Name of the lens, dataset and export: the scan must not matter to global-shutter twins."""
    folder = tmp_path_factory.mktemp("colmap")
    scanning: dict[str, Any] = (
        {} if request.param == "none" else {"scan": "bottom", "right_scan": "top", "right_delay": 0.1}
    )
    data = dataset(folder / "data", request.param, **scanning)
    return request.param, data, exported(data, "colmap", folder / "out")[0] / "planes"


def _table(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines()]


def test_our_points_fall_on_their_pixels(made: tuple[str, Path, Path]) -> None:
    lens, data, out = made
    left, right = _table(out / "sparse/cameras.txt")
    assert left[1:] == right[1:] and left[1:4] == [MODELS[lens], "64", "49"]
    fx, fy, cx, cy = (float(value) for value in left[4:8])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    poses = {row[-1]: np.array(row[1:8], dtype=float) for row in _table(out / "sparse/images.txt")[::2]}
    for side, frame in views_of(2):
        pose, shown = poses[f"{side}_{frame:04d}.png"], seen(only(data), side, frame, "gs")
        x = shown.world @ Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix().T + pose[4:]
        np.testing.assert_allclose(opencv_pixels(x, K, lens), shown.pixels + 0.5, atol=SAME_PX)


def test_pycolmap_reads_every_observation_where_it_projects(made: tuple[str, Path, Path]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    _, data, out = made
    model = pycolmap.Reconstruction(out / "sparse")
    assert len(model.images) == 4 and len(model.points3D) > 1000
    for image in model.images.values():
        side, frame = image.name.removesuffix(".png").split("_")
        shown = seen(only(data), side, int(frame), "gs")
        for world, pixel in zip(shown.world, shown.pixels, strict=True):
            np.testing.assert_allclose(image.project_point(world), pixel + 0.5, atol=SAME_PX)
        for point in list(image.points2D)[::20]:
            found = image.project_point(model.points3D[point.point3D_id].xyz)
            np.testing.assert_allclose(found, point.xy, atol=SAME_PX)
    for point in list(model.points3D.values())[::20]:
        for element in point.track.elements:  # both lists say the same
            assert model.images[element.image_id].points2D[element.point2D_idx].has_point3D()


def test_points_lie_on_the_surfaces_and_nothing_hides_them(made: tuple[str, Path, Path]) -> None:
    """The floor and the wall: no point is on the other side of one."""
    _, _, out = made
    rows = _table(out / "sparse/points3D.txt")
    world = np.array([row[1:4] for row in rows], dtype=float)
    gaps = np.stack([world @ normal - offset for normal, offset in PLANES], axis=-1)
    # Depth is float32: 6e-8 of 10 m.
    assert np.max(np.min(np.abs(gaps), axis=-1)) < 1e-5
    assert np.max(gaps) < 1e-5
    assert min(len(row[8:]) for row in rows) >= 4, "image and place of two observations at least"
    colours = np.array([row[4:7] for row in rows], dtype=int)
    waves = np.array([[5.0, 4.0, 3.0], [-4.0, 5.0, 2.0], [3.0, -5.0, 4.0]])
    np.testing.assert_allclose(colours, 128 + 50 * np.sin(world @ waves.T), atol=0.51)  # rounded once


def test_rolling_frames_have_the_first_rows_pose_and_say_so(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data")
    out, note = exported(data, "colmap", tmp_path / "out", "rs")
    assert "the pose of the line that is read first" in note["told"][0]
    images = _table(out / "planes/sparse/images.txt")
    twins = exported(data, "colmap", tmp_path / "gs")[0] / "planes/sparse/images.txt"
    assert [row[:8] for row in images[::2]] == [row[:8] for row in _table(twins)[::2]]
    assert (out / "planes/images/left_0001.png").read_bytes() == (data / "planes/rs/left_1.png").read_bytes()
    # Observations are where the rolling shutter sees the points: those of row 24 are pixels of it.
    points = {row[0]: np.array(row[1:4], dtype=float) for row in _table(out / "planes/sparse/points3D.txt")}
    world, pixels = _observations(images[1], points)
    shown = seen(only(data), "left", 0, "rs", rows=tuple(range(49)))
    near = np.linalg.norm(world[:, None] - shown.world, axis=-1)
    same = np.nonzero(near < 1e-9)
    assert len(same[0]) > 20
    np.testing.assert_allclose(pixels[same[0]], shown.pixels[same[1]] + 0.5, atol=SAME_PX)


def _observations(row: list[str], points: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) and pixels (n, 2) of a second line of images.txt."""
    table = np.array(row).reshape(-1, 3)
    return np.array([points[name] for name in table[:, 2]]), table[:, :2].astype(float)
