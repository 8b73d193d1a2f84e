"""The two programs that draw rolling shutters from splats: our points, moved by the laws that their code has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_data import HEIGHT, SAME_PX, WIDTH, dataset, exported, only, opencv_pixels, seen
from scipy.spatial.transform import Rotation, Slerp

from rsbench.core.rig import SIDES, views_of
from rsbench.core.so3 import FloatArray
from rsbench.storage.files import read_json, write_json

# gsplat


def _relative_times(pixels: FloatArray, shutter: str) -> FloatArray:
    """``shutter_relative_frame_time`` of gsplat/cuda/_torch_cameras.py, in its pixels."""
    x, y = pixels.T
    return {
        "ROLLING_TOP_TO_BOTTOM": np.floor(y) / (HEIGHT - 1),
        "ROLLING_LEFT_TO_RIGHT": np.floor(x) / (WIDTH - 1),
        "ROLLING_BOTTOM_TO_TOP": (HEIGHT - np.ceil(y)) / (HEIGHT - 1),
        "ROLLING_RIGHT_TO_LEFT": (WIDTH - np.ceil(x)) / (WIDTH - 1),
        "GLOBAL": np.zeros(len(x)),
    }[shutter]


def _gsplat_pixels(start: FloatArray, end: FloatArray, world: FloatArray, K: FloatArray, about: Any) -> FloatArray:
    """Project with the first pose, then ten times with that of the line found: as gsplat does."""
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]])))
    t = np.zeros(len(world))
    pixels = np.zeros((len(world), 2))
    for _ in range(11):
        shift = (1.0 - t)[:, None] * start[:3, 3] + t[:, None] * end[:3, 3]
        pixels = opencv_pixels(turn(np.clip(t, 0.0, 1.0)).apply(world) + shift, K, about["lens"])
        t = _relative_times(pixels, about["rolling_shutter"])
    return pixels


@pytest.mark.parametrize(
    ("lens", "scanning", "shutters"),
    [
        ("none", {}, ("TOP_TO_BOTTOM", "TOP_TO_BOTTOM")),
        (
            "brown-k3",
            {"scan": "bottom", "right_scan": "top", "right_delay": 0.1},
            ("BOTTOM_TO_TOP", "TOP_TO_BOTTOM"),
        ),
        ("fisheye", {"scan": "left", "right_scan": "right"}, ("LEFT_TO_RIGHT", "RIGHT_TO_LEFT")),
    ],
)
def test_gsplat_sees_our_points_in_their_pixels(
    tmp_path: Path, lens: str, scanning: dict[str, Any], shutters: tuple[str, str]
) -> None:
    data = dataset(tmp_path / "data", lens, **scanning)
    out, note = exported(data, "gsplat", tmp_path / "out")
    assert note["largest_row_error_px"] < SAME_PX and note["told"] == []
    for side, frame in views_of(2):
        with np.load(out / f"planes/{side}.npz") as arrays:
            held = {name: arrays[name] for name in arrays}
        about = json.loads((out / f"planes/{side}.json").read_text())
        assert about["rolling_shutter"] == f"ROLLING_{shutters[SIDES.index(side)]}"
        assert about["camera_model"] == ("fisheye" if lens == "fisheye" else "pinhole")
        assert {name: array.shape[1:] for name, array in held.items()} == {
            "viewmats": (4, 4),
            "viewmats_rs": (4, 4),
            "Ks": (3, 3),
            **({} if lens == "none" else {"radial_coeffs": (4,) if lens == "fisheye" else (6,)}),
            **({"tangential_coeffs": (2,)} if lens == "brown-k3" else {}),
        }
        shown = seen(only(data), side, frame, "rs", rows=(1, 24, 47))
        inside = np.ptp(np.stack([held["viewmats"][frame], held["viewmats_rs"][frame]]), axis=0)
        assert np.max(inside) > 0.01, "the camera moves"
        start, end = held["viewmats"][frame], held["viewmats_rs"][frame]
        found = _gsplat_pixels(start, end, shown.world, held["Ks"][frame], about | {"lens": lens})
        # A pixel's centre is half a pixel from where the time of its line would be another's.
        np.testing.assert_allclose(found, shown.pixels + 0.5, atol=SAME_PX)
        image = out / "planes" / about["images"][frame]
        assert image.read_bytes() == (data / f"planes/rs/{side}_{frame}.png").read_bytes()


def test_gsplat_gets_global_shutter_twins_where_they_are_asked_for(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", "brown")
    out, note = exported(data, "gsplat", tmp_path / "out", "gs")
    about = json.loads((out / "planes/right.json").read_text())
    with np.load(out / "planes/right.npz") as arrays:
        assert "viewmats_rs" not in arrays and about["rolling_shutter"] == "GLOBAL" and note["told"] == []
        shown, pose = seen(only(data), "right", 1, "gs"), arrays["viewmats"][1]
        found = _gsplat_pixels(pose, pose, shown.world, arrays["Ks"][1], about | {"lens": "brown"})
    np.testing.assert_allclose(found, shown.pixels + 0.5, atol=SAME_PX)


# nerfstudio and 3dgs-deblur


def _in_camera(frame: dict[str, Any], world: FloatArray) -> FloatArray:
    """Points in camera axes x right, y down, z forward, as nerfstudio's splatfacto turns its own."""
    world_from_camera = np.array(frame["transform_matrix"])
    world_from_camera[:3, 1:3] *= -1
    camera_from_world = np.linalg.inv(world_from_camera)
    return world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]


def _calibration(content: dict[str, Any]) -> FloatArray:
    return np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1.0]])


def _pixel_velocities(frame: dict[str, Any], x: FloatArray, K: FloatArray) -> FloatArray:
    """``compute_pix_velocity`` of SpectacularAI/gsplat, px/s."""
    flip = np.array([1.0, -1.0, -1.0])
    linear, angular = (flip * frame[f"camera_{kind}_velocity"] for kind in ("linear", "angular"))
    v, z = linear + np.cross(angular, x), x[:, 2]
    across = -K[0, 0] * (v[:, 0] - v[:, 2] * x[:, 0] / z) / z
    return np.stack([across, -K[1, 1] * (v[:, 1] - v[:, 2] * x[:, 1] / z) / z], axis=-1)


def test_3dgs_deblur_sees_the_middle_row_in_its_pixels_and_the_rows_move_as_the_camera(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", right_delay=0.1)
    out, note = exported(data, "nerfstudio", tmp_path / "out")
    content, sequence = json.loads((out / "planes/transforms.json").read_text()), only(data)
    assert content["exposure_time"] == 0.0
    np.testing.assert_allclose(content["rolling_shutter_time"], 0.08)
    frames, K, worst = {frame["file_path"]: frame for frame in content["frames"]}, _calibration(content), 0.0
    for side, number in views_of(2):
        frame = frames[f"images/{side}_{number:04d}.png"]
        middle = seen(sequence, side, number, "rs", rows=(24,))
        x = _in_camera(frame, middle.world)
        np.testing.assert_allclose(opencv_pixels(x, K, "none"), middle.pixels + 0.5, atol=SAME_PX)
        # Each row's delay, from the poses of the rows around: the error of the difference is below 1e-7 px.
        _, poses = sequence.poses(side, number)
        ends = (opencv_pixels(middle.world @ poses.R[k].T + poses.t[k], K, "none") for k in (23, 25))
        before, after = ends
        rates = _pixel_velocities(frame, x, K)
        np.testing.assert_allclose(rates * content["rolling_shutter_time"] / 49, (after - before) / 2, atol=1e-7)
        shown = seen(sequence, side, number, "rs", rows=tuple(range(49)))
        x = _in_camera(frame, shown.world)
        roll = content["rolling_shutter_time"] * ((shown.lines + 0.5) / 49 - 0.5)
        law = opencv_pixels(x, K, "none") + roll[:, None] * _pixel_velocities(frame, x, K)
        worst = max(worst, float(np.max(np.linalg.norm(law - shown.pixels - 0.5, axis=-1))))
    # Told, of more columns than these: the law is of first order.
    assert 0.001 < worst < note["largest_row_error_px"] + 1e-9 < 0.5
    assert "first order in pixels" in note["told"][0]


@pytest.mark.parametrize(
    ("lens", "model"), [("none", "OPENCV"), ("brown-k3", "OPENCV"), ("fisheye", "OPENCV_FISHEYE")]
)
def test_nerfstudio_sees_global_shutter_twins_in_their_pixels(tmp_path: Path, lens: str, model: str) -> None:
    data = dataset(tmp_path / "data", lens, scan="right")
    out, note = exported(data, "nerfstudio", tmp_path / "out", "gs")
    content, sequence = json.loads((out / "planes/transforms.json").read_text()), only(data)
    assert content["camera_model"] == model and note["told"] == []
    assert "rolling_shutter_time" not in content and "camera_linear_velocity" not in content["frames"][0]
    coefficients = {name: content[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2") if name in content}
    shape = sequence.rig.camera.lens
    assert coefficients == {name: getattr(shape, name, 0.0) for name in coefficients}
    for (side, number), frame in zip([(s, k) for k in (0, 1) for s in SIDES], content["frames"], strict=True):
        shown = seen(sequence, side, number, "gs")
        found = opencv_pixels(_in_camera(frame, shown.world), _calibration(content), lens)
        np.testing.assert_allclose(found, shown.pixels + 0.5, atol=SAME_PX)
        image = out / "planes" / frame["file_path"]
        assert image.read_bytes() == (data / f"planes/gs/{side}_{number}.png").read_bytes()


def test_one_exposure_time_is_written_and_two_are_refused(tmp_path: Path) -> None:
    from rsbench.core.errors import RsbenchError

    data = dataset(tmp_path / "data")
    path, sensor = data / "planes/sequence.json", {"exposure_s": 0.01, "full_well": 6000.0, "gain": 4.0}
    write_json(path, read_json(path) | {"sensor": sensor})
    out, _ = exported(data, "nerfstudio", tmp_path / "out")
    assert json.loads((out / "planes/transforms.json").read_text())["exposure_time"] == 0.01
    write_json(path, read_json(path) | {"sensor": sensor | {"right_exposure_s": 0.005}})
    with pytest.raises(RsbenchError, match="exposures differ, and exposure_time is one for all; take --images gs"):
        exported(data, "nerfstudio", tmp_path / "two")
