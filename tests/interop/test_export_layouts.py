"""Trajectories, calibrations and folders of others, each read back as those who use them do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from evo.tools import file_interface
from exported_data import LENSES, MOTION, SAME_PX, dataset, exported, only, opencv_pixels, seen
from scipy.spatial.transform import Rotation

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core.rig import SIDES, views_of
from rsbench.core.so3 import FloatArray
from rsbench.storage.files import read_json, write_json

K = np.array([[60.0, 0.0, 30.5], [0.0, 61.0, 25.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset(tmp_path_factory.mktemp("plain") / "data")


# Trajectories


@pytest.mark.parametrize("scanning", [{}, {"scan": "bottom", "right_scan": "left", "right_delay": -0.1}])
def test_evo_reads_the_pose_of_every_row_in_the_order_of_time(tmp_path: Path, scanning: dict[str, Any]) -> None:
    data = dataset(tmp_path / "data", frames=3, **scanning)
    out, _ = exported(data, "tum", tmp_path / "out")
    sequence = only(data)
    for side, frame in views_of(3):
        read = file_interface.read_tum_trajectory_file(out / f"planes/{side}_rows.txt")
        assert read.check()[0], read.check()[1]
        shown = seen(sequence, side, frame, "rs")
        tau, _ = sequence.poses(side, frame)
        index = np.searchsorted(read.timestamps, 0.1 * tau[shown.lines.astype(int)] - 1e-9)
        camera_from_world = np.linalg.inv(np.array(read.poses_se3)[index])
        x = np.einsum("nij,nj->ni", camera_from_world[:, :3, :3], shown.world) + camera_from_world[:, :3, 3]
        np.testing.assert_allclose(opencv_pixels(x, K, "none"), shown.pixels, atol=SAME_PX)
        first = file_interface.read_tum_trajectory_file(out / f"planes/{side}.txt")
        start = np.argmin(tau)
        np.testing.assert_allclose(first.timestamps[frame], 0.1 * tau[start], atol=1e-12)
        again = np.searchsorted(read.timestamps, first.timestamps[frame] - 1e-9)
        np.testing.assert_allclose(first.poses_se3[frame], read.poses_se3[again], atol=1e-12)


def test_a_global_shutter_has_no_trajectory_of_rows(tmp_path: Path) -> None:
    out, note = exported(dataset(tmp_path / "data", readout=0.0), "tum", tmp_path / "out")
    assert sorted(path.name for path in (out / "planes").iterdir()) == ["body.txt", "left.txt", "right.txt"]
    assert note["told"] == ["all lines are read at once: there is no trajectory of lines"]
    body = file_interface.read_tum_trajectory_file(out / "planes/body.txt")
    turned = Rotation.from_rotvec(MOTION.w.copy()).inv()
    np.testing.assert_allclose(body.poses_se3[1][:3, :3], turned.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(body.positions_xyz[1], -turned.apply(MOTION.d.copy()), atol=1e-12)


# Calibrations


@pytest.mark.parametrize(("lens", "model"), [("none", "none"), ("brown", "radtan"), ("fisheye", "equidistant")])
def test_a_camera_chain_projects_our_points(tmp_path: Path, lens: str, model: str) -> None:
    data = dataset(tmp_path / "data", lens)
    path = data / "planes/sequence.json"
    write_json(path, read_json(path) | {"imu": {"time_offset_s": 0.00001, "clock_drift": 1e-5}})
    out, note = exported(data, "kalibr", tmp_path / "out")
    assert "drifts by 1.0e-05" in note["told"][0]
    chain = yaml.safe_load((out / "planes/camchain.yaml").read_text())
    for camera in chain.values():  # what kalibr_common/ConfigReader.py demands
        assert camera["camera_model"] == "pinhole" and camera["distortion_model"] == model
        assert len(camera["distortion_coeffs"]) == (0 if model == "none" else 4)
        assert all(isinstance(value, float) for value in [*camera["intrinsics"], *camera["distortion_coeffs"]])
        assert camera["resolution"] == [64, 49] and isinstance(camera["rostopic"], str)
        assert isinstance(camera["timeshift_cam_imu"], float) and camera["timeshift_cam_imu"] == 0.00001
        np.testing.assert_allclose(camera["line_delay"] * 49, 0.08, rtol=1e-12)
    assert sorted(yaml.safe_load((out / "planes/imu.yaml").read_text()))[0] == "accelerometer_noise_density"
    sequence = only(data)
    shown = seen(sequence, "right", 1, "gs")
    _, poses = sequence.poses("left", 1)
    in_left = np.append(shown.world @ poses.R[0].T + poses.t[0], np.ones((len(shown.world), 1)), axis=1)
    in_right = in_left @ np.array(chain["cam1"]["T_cn_cnm1"]).T
    fu, fv, pu, pv = chain["cam1"]["intrinsics"]
    found = opencv_pixels(in_right[:, :3], np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]]), lens)
    np.testing.assert_allclose(found, shown.pixels, atol=SAME_PX)
    if (shape := LENSES[lens]) is not None:
        order = ("k1", "k2", "p1", "p2") if model == "radtan" else ("k1", "k2", "k3", "k4")
        assert chain["cam0"]["distortion_coeffs"] == [getattr(shape, name) for name in order]
    body_from_left = np.linalg.inv(np.array(chain["cam0"]["T_cam_imu"]))
    np.testing.assert_allclose(body_from_left[:3, 3], [-0.15, 0.0, 0.0])  # half the baseline to the left


# KITTI


@pytest.mark.parametrize("images", ["gs", "rs"])
def test_disparities_and_poses_of_kitti(plain: Path, tmp_path: Path, images: str) -> None:
    out, note = exported(plain, "kitti", tmp_path / "out", images)  # pyrefly: ignore[bad-argument-type]
    folder, sequence = out / "sequences/planes", only(plain)
    assert bool(note["told"]) == (images == "rs")
    rows = (line.split(": ") for line in (folder / "calib.txt").read_text().splitlines())
    P = {name: np.array(values.split(), dtype=float).reshape(3, 4) for name, values in rows}
    poses = file_interface.read_kitti_poses_file(out / "poses/planes.txt")
    np.testing.assert_allclose(poses.poses_se3[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(np.loadtxt(folder / "times.txt"), [0.0, 0.1])
    _, first = sequence.poses("left", 0)
    for frame in range(2):
        file = f"{frame:06d}.png"
        for place, side in (("image_2", "left"), ("image_3", "right")):
            original = plain / f"planes/{images}/{side}_{frame}.png"
            assert (folder / place / file).read_bytes() == original.read_bytes()
        shown = seen(sequence, "left", frame, images)  # pyrefly: ignore[bad-argument-type]
        raw = cv2.imread(str(folder / "disp_occ_0" / file), cv2.IMREAD_UNCHANGED)
        assert raw.dtype == np.uint16
        x, y = shown.pixels.astype(int).T
        z = sequence.depth(images, "left", frame)[y, x]  # pyrefly: ignore[bad-argument-type]
        np.testing.assert_allclose(raw[y, x] / 256.0, 60.0 * 0.3 / z, atol=0.5 / 256 + 1e-6)
        rays = z[:, None] * np.linalg.solve(K, np.append(shown.pixels, np.ones((len(z), 1)), axis=1).T).T
        left, right = (_through(P[name], rays) for name in ("P2", "P3"))
        np.testing.assert_allclose(left, shown.pixels, atol=SAME_PX)
        np.testing.assert_allclose((left - right)[:, 0], 60.0 * 0.3 / z, atol=SAME_PX)
        if images == "gs":
            in_first = shown.world @ first.R[0].T + first.t[0]
            camera_from_first = np.linalg.inv(poses.poses_se3[frame])
            in_camera = in_first @ camera_from_first[:3, :3].T + camera_from_first[:3, 3]
            np.testing.assert_allclose(_through(P["P2"], in_camera), shown.pixels, atol=SAME_PX)


def _through(P: FloatArray, points: FloatArray) -> FloatArray:
    x = points @ P[:, :3].T + P[:, 3]
    return x[:, :2] / x[:, 2:]


def test_disparities_that_a_png_cannot_hold_are_unknown_and_counted(tmp_path: Path) -> None:
    from rsbench.interop.writers.kitti_and_kalibr import disparity_values

    values, lost = disparity_values(np.array([[np.nan, 1e-4, 0.002, 1.0, 255.998, 300.0]]))
    assert values.tolist() == [[0, 0, 1, 256, 65535, 0]] and lost == 2


# Carla-RS


def _carla_pixels(place: Path, world_in_first: FloatArray, seconds: FloatArray) -> FloatArray:
    """As its generator moves the camera: camera 0 from camera t is (exp(w t), v t)."""
    (line,) = [row for row in (place / "gt_vel.log").read_text().splitlines() if "#" not in row]
    velocity = np.array([float(value) for value in line.split(" ")])  # as the loader splits it
    x = [
        Rotation.from_rotvec(velocity[:3] * t).inv().apply(X - velocity[3:] * t)
        for X, t in zip(world_in_first, seconds, strict=True)
    ]
    return opencv_pixels(np.array(x), K, "none")


@pytest.mark.parametrize("turning", [False, True])
def test_carla_rs_velocities_and_radial_depth(tmp_path: Path, turning: bool) -> None:
    """Its law is exact for translations alone; else it says by how much not, and is right at the first row."""
    motion = MOTION if turning else LinearMotion([0.0, 0.0, 0.0], MOTION.d)
    data = dataset(tmp_path / "data", motion=motion, right_delay=0.2)
    out, note = exported(data, "carla-rs", tmp_path / "out")
    sequence, worst = only(data), 0.0
    for side, frame in views_of(2):
        place = out / f"planes/seq_{side}"
        tau, poses = sequence.poses(side, frame)
        begin, first = sequence.poses(side, 0)
        radial = np.loadtxt(place / f"{frame:04d}_rs.depth")
        rays = sequence.rig.camera.unproject(sequence.rig.camera.pixel_grid())
        z = radial / np.linalg.norm(rays, axis=-1)
        np.testing.assert_allclose(z, sequence.depth("rs", side, frame), rtol=1e-8)  # nine digits
        x_in_cam = z[..., None] * rays
        world = np.einsum("hji,hwj->hwi", poses.R, x_in_cam - poses.t[:, None])
        in_first = (world @ first.R[0].T + first.t[0]).reshape(-1, 3)
        found = _carla_pixels(place, in_first, 0.1 * np.repeat(tau - begin[0], 64))
        away = np.linalg.norm(found - sequence.rig.camera.pixel_grid().reshape(-1, 2), axis=-1)
        worst = max(worst, float(np.max(away)))
        if frame == 0:
            assert np.max(away[:64]) < SAME_PX
            assert np.max(away[64:128]) < (1e-3 if turning else SAME_PX)  # second order of a hundredth of the turn
    if turning:
        np.testing.assert_allclose(note["largest_row_error_px"], worst, rtol=1e-6)
        assert worst > 0.1 and "up to" in note["told"][0]
    else:
        assert worst < SAME_PX and note["told"] == [
            "the two cameras are sequences of their own: the delay of the right one is not written"
        ]
    assert sorted(path.name for path in (out / "planes/seq_left").iterdir()) == [
        *(
            f"000{k}_{name}"
            for k in (0, 1)
            for name in ("gs_f.depth", "gs_f.png", "gs_m.png", "rs.depth", "rs.png")
        ),
        "gt_vel.log",
    ]
    middle = data / "planes/gs_twin/0024/left_1.png"
    assert (out / "planes/seq_left/0001_gs_m.png").read_bytes() == middle.read_bytes()
    assert "ROW_READOUT_TIME(ms): 1.63265" in (out / "planes/rs_calib.txt").read_text()  # 80 ms / 49


def test_fastec_rs_has_the_frames_that_its_loader_asks_for(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", frames=3)
    out, note = exported(data, "fastec-rs", tmp_path / "out")
    sequence = only(data)
    for side in SIDES:
        place = out / f"planes_{side}"
        # As dataset_fastec_rs.py finds them: in folders with a meta.log, NNN_rolling.png from 000 on.
        assert (place / "meta.log").is_file()
        assert sorted(path.name for path in place.glob("*_rolling.png")) == [
            f"{i:03d}_rolling.png" for i in range(3)
        ]
        for frame in range(3):
            for name, kind in (("rolling", "rs"), ("global_first", "gs")):
                shown = cv2.imread(str(place / f"{frame:03d}_{name}.png"))[..., ::-1]
                np.testing.assert_array_equal(shown, sequence.image(kind, side, frame))
            middle = data / "planes" / "gs_twin" / "0024" / f"{side}_{frame}.png"
            assert (place / f"{frame:03d}_global_middle.png").read_bytes() == middle.read_bytes()
    assert note["told"] == ["the readout ratio is 0.8, where those who use the layout assume 1"]


@pytest.mark.parametrize(
    ("name", "lens", "scanning", "images", "words"),
    [
        ("kalibr", "brown-k3", {}, None, "radtan has k1, k2, p1, p2 but no k3"),
        ("kalibr", "none", {"right_scan": "bottom"}, None, "rows that are read from the top"),
        ("kitti", "brown", {}, None, "rectified"),
        ("kitti", "none", {"right_delay": 0.1}, None, "late"),
        ("kitti", "none", {"right_scan": "bottom"}, "rs", "at one time"),
        ("nerfstudio", "brown", {}, None, "undistorts images before it trains"),
        ("nerfstudio", "none", {"scan": "bottom"}, None, "from the top alone"),
        ("carla-rs", "fisheye", {}, None, "no lens"),
        ("carla-rs", "none", {"scan": "left"}, None, "from the top"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_by_name(
    tmp_path: Path, name: str, lens: str, scanning: dict[str, Any], images: str | None, words: str
) -> None:
    from rsbench.core.errors import RsbenchError

    data = dataset(tmp_path / "data", lens, **scanning)
    with pytest.raises(RsbenchError, match=f"^--to {name}: sequence planes: .*{words}"):
        exported(data, name, tmp_path / "out", images)  # pyrefly: ignore[bad-argument-type]
    assert not (tmp_path / "out").exists()


def test_a_motion_that_a_format_only_approximates_is_measured(tmp_path: Path) -> None:
    """Of gsplat's law: linear motions are its own, twists are not."""
    for motion, exact in ((MOTION, True), (TwistMotion([0.02, -0.03, 0.3], [0.5, -0.1, 0.15]), False)):
        data = dataset(tmp_path / motion.name, motion=motion)
        _, note = exported(data, "gsplat", tmp_path / f"{motion.name}-out")
        assert (note["largest_row_error_px"] < SAME_PX) == exact == (not note["told"]), SIDES
