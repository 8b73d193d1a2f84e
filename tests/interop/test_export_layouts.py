"""Exports to COLMAP, trajectories, calibrations, layouts and splatting, read back by others' conventions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from analytic_dataset import PLANES
from evo.tools import file_interface
from exported_data import LENSES, MOTION, PLACE, SAME_PX, TURN, dataset, exported, only, opencv_pixels, seen
from scipy.spatial.transform import Rotation, Slerp

from rsbench.components.cards import parse_card
from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.components.rig_tables import RigTables
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig, views_of
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.calibration_parts import Calibration
from rsbench.interop.readers.calibrations import read_calibration
from rsbench.interop.readers.layouts import read_colmap
from rsbench.interop.writers.kitti_and_kalibr import disparity_values
from rsbench.storage.files import read_json, write_json

K = np.array([[60.0, 0.0, 30.5], [0.0, 61.0, 25.0], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[75.0, 0.0, 41.0], [0.0, 74.0, 20.5], [0.0, 0.0, 1.0]])
"""Of the right camera of a general rig, which has 80 x 45 pixels."""
RIGHT_FROM_LEFT = np.eye(4)
RIGHT_FROM_LEFT[:3, :3], RIGHT_FROM_LEFT[:3, 3] = Rotation.from_rotvec(TURN).as_matrix(), PLACE


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset(tmp_path_factory.mktemp("plain") / "data")


# Trajectories


@pytest.mark.parametrize(
    "scanning",
    [
        {},
        {"scan": "bottom", "right_scan": "left", "right_delay": -0.1},
        {"right": "none", "right_scan": "left", "right_readout_ratio": 0.5},
    ],
)
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
        own = K_RIGHT if side == "right" and "right" in scanning else K
        np.testing.assert_allclose(opencv_pixels(x, own, "none"), shown.pixels, atol=SAME_PX)
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


MODELS_OF_KALIBR = {"none": "none", "brown": "radtan", "fisheye": "equidistant"}


@pytest.mark.parametrize(
    ("lens", "right"),
    [("none", ""), ("brown", ""), ("fisheye", ""), ("brown", "fisheye"), ("none", "brown")],
)
def test_a_camera_chain_projects_our_points(tmp_path: Path, lens: str, right: str) -> None:
    data = dataset(tmp_path / "data", lens, right=right)
    path = data / "planes/sequence.json"
    write_json(path, read_json(path) | {"imu": {"time_offset_s": 0.00001, "clock_drift": 1e-5}})
    out, note = exported(data, "kalibr", tmp_path / "out")
    assert "drifts by 1.0e-05" in note["told"][0]
    chain = yaml.safe_load((out / "planes/camchain.yaml").read_text())
    lenses, size = (lens, right or lens), [80, 45] if right else [64, 49]
    for camera, each, (width, height) in zip(chain.values(), lenses, ([64, 49], size), strict=True):
        # What kalibr_common/ConfigReader.py demands.
        model = MODELS_OF_KALIBR[each]
        assert camera["camera_model"] == "pinhole" and camera["distortion_model"] == model
        assert len(camera["distortion_coeffs"]) == (0 if model == "none" else 4)
        assert all(isinstance(value, float) for value in [*camera["intrinsics"], *camera["distortion_coeffs"]])
        assert camera["resolution"] == [width, height] and isinstance(camera["rostopic"], str)
        assert isinstance(camera["timeshift_cam_imu"], float) and camera["timeshift_cam_imu"] == 0.00001
        np.testing.assert_allclose(camera["line_delay"] * height, 0.08, rtol=1e-12)
    assert sorted(yaml.safe_load((out / "planes/imu.yaml").read_text()))[0] == "accelerometer_noise_density"
    sequence = only(data)
    shown = seen(sequence, "right", 1, "gs")
    _, poses = sequence.poses("left", 1)
    in_left = np.append(shown.world @ poses.R[0].T + poses.t[0], np.ones((len(shown.world), 1)), axis=1)
    in_right = in_left @ np.array(chain["cam1"]["T_cn_cnm1"]).T
    fu, fv, pu, pv = chain["cam1"]["intrinsics"]
    found = opencv_pixels(in_right[:, :3], np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]]), right or lens)
    np.testing.assert_allclose(found, shown.pixels, atol=SAME_PX)
    for camera, each in zip(chain.values(), lenses, strict=True):
        if (shape := LENSES[each]) is not None:
            order = ("k1", "k2", "p1", "p2") if each == "brown" else ("k1", "k2", "k3", "k4")
            assert camera["distortion_coeffs"] == [getattr(shape, name) for name in order]
    body_from_left, body_from_right = (np.linalg.inv(camera["T_cam_imu"]) for camera in chain.values())
    half = 0.5 * float(np.linalg.norm(PLACE)) if right else 0.15
    np.testing.assert_allclose(body_from_left[:3, 3], [-half, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(body_from_right[:3, 3], [half, 0.0, 0.0], atol=1e-15)
    if right:
        np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], RIGHT_FROM_LEFT, atol=1e-14)
    check_rig(read_calibration(out / "planes/camchain.yaml"), sequence.rig)


def check_rig(found: Calibration, rig: StereoRig) -> None:
    """What was written is the rig, to rounding."""
    read = parse_card(RigTables, found.tables(), "read").rig()
    for side in SIDES:
        assert read.sensor(side) == rig.sensor(side)
        np.testing.assert_allclose(read.own(side).rotation, rig.own(side).rotation, atol=1e-12)
    assert abs(read.baseline - rig.baseline) < 1e-12


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
        (words,) = note["told"]
        assert worst < SAME_PX and words.endswith("the delay of the right one is not written")
    names = ("gs_f.depth", "gs_f.png", "gs_m.png", "rs.depth", "rs.png")
    files = {f"000{k}_{name}" for k in (0, 1) for name in names} | {"gt_vel.log"}
    assert {path.name for path in (out / "planes/seq_left").iterdir()} == files
    middle = data / "planes/gs_twin/0024/left_1.png"
    assert (out / "planes/seq_left/0001_gs_m.png").read_bytes() == middle.read_bytes()
    assert "ROW_READOUT_TIME(ms): 1.63265" in (out / "planes/rs_calib.txt").read_text()  # 80 ms / 49


def test_fastec_rs_has_the_frames_that_its_loader_asks_for(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", frames=3)
    out, note = exported(data, "fastec-rs", tmp_path / "out")
    for side in SIDES:
        place = out / f"planes_{side}"
        # As dataset_fastec_rs.py finds them: in folders with a meta.log, NNN_rolling.png from 000 on.
        assert (place / "meta.log").is_file()
        frames = sorted(place.glob("*_rolling.png"))
        assert [path.name for path in frames] == [f"{k:03d}_rolling.png" for k in range(3)]
        for frame, path in enumerate(frames):  # of the twins: test_importing.py
            np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], only(data).image("rs", side, frame))
    assert note["told"] == ["the readout ratio is 0.8, where those who use the layout assume 1"]


@pytest.mark.parametrize(
    ("name", "lens", "scanning", "images", "words"),
    [
        ("kitti", "none", {"right": "none"}, None, "rsbench correct --rectify writes rectified pairs"),
        ("kalibr", "none", {"right": "rational"}, None, "the right camera's is rational"),
        ("nerfstudio", "brown", {"right": "fisheye"}, None, "one for all images"),
        ("nerfstudio", "none", {"right": "none", "right_readout_ratio": 0.5}, "rs", "readouts of the cameras"),
        ("carla-rs", "none", {"right": "none"}, None, "one size and one readout"),
        ("kalibr", "brown-k3", {}, None, "radtan has k1, k2, p1, p2 but no k3"),
        ("kalibr", "none", {"right_scan": "bottom"}, None, "rows that are read from the top"),
        ("kitti", "brown", {}, None, "rectified"),
        ("kitti", "none", {"right_delay": 0.1}, None, "late"),
        ("kitti", "none", {"right_scan": "bottom"}, "rs", "at one time"),
        ("nerfstudio", "brown", {}, None, "undistorts images before it trains"),
        ("nerfstudio", "none", {"scan": "bottom"}, None, "only rows that are read from the top"),
        ("carla-rs", "fisheye", {}, None, "no lens"),
        ("carla-rs", "none", {"scan": "left"}, None, "from the top"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_by_name(
    tmp_path: Path, name: str, lens: str, scanning: dict[str, Any], images: str | None, words: str
) -> None:
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


MODELS = {"none": "PINHOLE", "brown": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""All others are FULL_OPENCV."""


@pytest.fixture(scope="module", params=["none", "brown", "brown-k3", "fisheye", "brown fisheye", "none rational"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path]:
    """Names of the lenses, dataset and export: the scan must not matter to global-shutter twins."""
    folder = tmp_path_factory.mktemp("colmap")
    scanning: dict[str, Any] = {} if request.param == "none" else {"scan": "bottom", "right_scan": "top"}
    scanning |= {"right_delay": 0.1} if request.param == "fisheye" else {}
    lens, _, right = request.param.partition(" ")
    data = dataset(folder / "data", lens, right=right, **scanning)
    return request.param, data, exported(data, "colmap", folder / "out")[0] / "planes"


def _table(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines()]


def test_our_points_fall_on_their_pixels(made: tuple[str, Path, Path]) -> None:
    lens, data, out = made
    left, right = _table(out / "sparse/cameras.txt")
    lenses = dict(zip(SIDES, (lens.split() * 2)[:2], strict=True))
    models = {side: MODELS.get(each, "FULL_OPENCV") for side, each in lenses.items()}
    assert left[1:4] == [models["left"], "64", "49"]
    assert right[1:4] == [models["right"], "80", "45"] if " " in lens else right[1:] == left[1:]
    poses = {row[-1]: np.array(row[1:8], dtype=float) for row in _table(out / "sparse/images.txt")[::2]}
    for side, frame in views_of(2):
        pose, shown = poses[f"{side}_{frame:04d}.png"], seen(only(data), side, frame, "gs")
        fx, fy, cx, cy = (float(value) for value in (left if side == "left" else right)[4:8])
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        x = shown.world @ Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix().T + pose[4:]
        np.testing.assert_allclose(opencv_pixels(x, K, lenses[side]), shown.pixels + 0.5, atol=SAME_PX)


def test_the_rig_of_colmap_reads_back(made: tuple[str, Path, Path]) -> None:
    """By pycolmap and by ours: both cameras of a frame stand as rigs.txt says, and at the same places as alone."""
    pycolmap = pytest.importorskip("pycolmap")
    lens, data, out = made
    if lens == "fisheye":
        assert not (out / "sparse/rigs.txt").exists()  # a late camera
        return
    own = only(data).rig
    if " " in lens:
        np.testing.assert_allclose(own.right_from_left.t, PLACE, atol=1e-14)
    (rig,) = pycolmap.Reconstruction(out / "sparse").rigs.values()
    (found,) = rig.non_ref_sensors.values()
    theirs = found.matrix()
    np.testing.assert_allclose(theirs, np.column_stack(own.right_from_left), atol=1e-12)
    (recording,) = read_colmap(out / "sparse")
    assert recording.rig is not None
    for name in ("left", "right"):
        np.testing.assert_allclose(recording.rig.own(name).rotation, own.own(name).rotation, atol=1e-12)
        assert recording.rig.sensor(name) == own.sensor(name)
    check_rig(read_calibration(out / "sparse"), own)
    assert set(recording.images) == set(views_of(2))
    assert all(path.is_file() for path in recording.images.values())


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


# gsplat


def _relative_times(pixels: FloatArray, about: Any) -> FloatArray:
    """``shutter_relative_frame_time`` of gsplat/cuda/_torch_cameras.py, in its pixels."""
    (x, y), width, height = pixels.T, about["width"], about["height"]
    return {
        "ROLLING_TOP_TO_BOTTOM": np.floor(y) / (height - 1),
        "ROLLING_LEFT_TO_RIGHT": np.floor(x) / (width - 1),
        "ROLLING_BOTTOM_TO_TOP": (height - np.ceil(y)) / (height - 1),
        "ROLLING_RIGHT_TO_LEFT": (width - np.ceil(x)) / (width - 1),
        "GLOBAL": np.zeros(len(x)),
    }[about["rolling_shutter"]]


def _gsplat_pixels(start: FloatArray, end: FloatArray, world: FloatArray, K: FloatArray, about: Any) -> FloatArray:
    """Project with the first pose, then ten times with that of the line found: as gsplat does."""
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]])))
    t = np.zeros(len(world))
    pixels = np.zeros((len(world), 2))
    for _ in range(11):
        shift = (1.0 - t)[:, None] * start[:3, 3] + t[:, None] * end[:3, 3]
        pixels = opencv_pixels(turn(np.clip(t, 0.0, 1.0)).apply(world) + shift, K, about["lens"])
        t = _relative_times(pixels, about)
    return pixels


_OPPOSITE = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}


@pytest.mark.parametrize(
    ("lens", "scanning"),
    [
        ("none", {}),
        ("brown-k3", {"scan": "bottom", "right_scan": "top", "right_delay": 0.1}),
        ("fisheye", {"scan": "left", "right_scan": "right"}),
        ("brown-k3", {"right": "fisheye", "right_scan": "left", "right_readout_ratio": 0.6}),
        ("none", {"right": "rational"}),
    ],
)
def test_gsplat_sees_our_points_in_their_pixels(tmp_path: Path, lens: str, scanning: dict[str, Any]) -> None:
    data = dataset(tmp_path / "data", lens, **scanning)
    out, note = exported(data, "gsplat", tmp_path / "out")
    assert note["largest_row_error_px"] < SAME_PX and note["told"] == []
    for side, frame in views_of(2):
        own = scanning.get("right", lens) if side == "right" else lens
        with np.load(out / f"planes/{side}.npz") as arrays:
            loaded = dict(arrays)
        about = json.loads((out / f"planes/{side}.json").read_text())
        scan = scanning.get("right_scan" if side == "right" else "scan", "top")
        assert about["rolling_shutter"] == f"ROLLING_{scan}_TO_{_OPPOSITE[scan]}".upper()
        assert about["camera_model"] == ("fisheye" if own == "fisheye" else "pinhole")
        assert {name: array.shape[1:] for name, array in loaded.items()} == {
            "viewmats": (4, 4),
            "viewmats_rs": (4, 4),
            "Ks": (3, 3),
            **({} if own == "none" else {"radial_coeffs": (4,) if own == "fisheye" else (6,)}),
            **({"tangential_coeffs": (2,)} if own in ("brown-k3", "rational") else {}),
        }
        shown = seen(only(data), side, frame, "rs", rows=(1, 24, 43))
        inside = np.ptp(np.stack([loaded["viewmats"][frame], loaded["viewmats_rs"][frame]]), axis=0)
        assert np.max(inside) > 0.01, "the camera moves"
        start, end = loaded["viewmats"][frame], loaded["viewmats_rs"][frame]
        found = _gsplat_pixels(start, end, shown.world, loaded["Ks"][frame], about | {"lens": own})
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


@pytest.mark.parametrize("right", ["", "none"])
def test_3dgs_deblur_sees_the_middle_row_in_its_pixels_and_the_rows_move_as_the_camera(
    tmp_path: Path, right: str
) -> None:
    data = dataset(tmp_path / "data", right=right, right_delay=0.1)
    out, note = exported(data, "nerfstudio", tmp_path / "out")
    content, sequence = json.loads((out / "planes/transforms.json").read_text()), only(data)
    assert content["exposure_time"] == 0.0
    np.testing.assert_allclose(content["rolling_shutter_time"], 0.08)
    frames, worst = {frame["file_path"]: frame for frame in content["frames"]}, 0.0
    for side, number in views_of(2):
        frame = frames[f"images/{side}_{number:04d}.png"]
        K, rows = _calibration(content | frame), 45 if right and side == "right" else 49
        middle = seen(sequence, side, number, "rs", rows=(rows // 2,))
        x = _in_camera(frame, middle.world)
        np.testing.assert_allclose(opencv_pixels(x, K, "none"), middle.pixels + 0.5, atol=SAME_PX)
        # Each row's delay, from the poses of the rows around: the error of the difference is below 1e-7 px.
        _, poses = sequence.poses(side, number)
        before, after = (
            opencv_pixels(middle.world @ poses.R[k].T + poses.t[k], K, "none")
            for k in (rows // 2 - 1, rows // 2 + 1)
        )
        rates = _pixel_velocities(frame, x, K)
        np.testing.assert_allclose(rates * content["rolling_shutter_time"] / rows, (after - before) / 2, atol=1e-7)
        shown = seen(sequence, side, number, "rs", rows=tuple(range(rows)))
        x = _in_camera(frame, shown.world)
        roll = content["rolling_shutter_time"] * ((shown.lines + 0.5) / rows - 0.5)
        law = opencv_pixels(x, K, "none") + roll[:, None] * _pixel_velocities(frame, x, K)
        worst = max(worst, float(np.max(np.linalg.norm(law - shown.pixels - 0.5, axis=-1))))
    # Told, of more columns than these: the law is of first order.
    assert 0.001 < worst < note["largest_row_error_px"] + 1e-9 < 0.5
    assert "first order in pixels" in note["told"][0]


@pytest.mark.parametrize(("lens", "right"), [("none", ""), ("brown-k3", ""), ("fisheye", ""), ("none", "brown")])
def test_nerfstudio_sees_global_shutter_twins_in_their_pixels(tmp_path: Path, lens: str, right: str) -> None:
    data = dataset(tmp_path / "data", lens, right=right, scan="right")
    out, note = exported(data, "nerfstudio", tmp_path / "out", "gs")
    content, sequence = json.loads((out / "planes/transforms.json").read_text()), only(data)
    assert content["camera_model"] == ("OPENCV_FISHEYE" if lens == "fisheye" else "OPENCV")
    assert note["told"] == []
    assert "rolling_shutter_time" not in content and "camera_linear_velocity" not in content["frames"][0]
    for (side, number), frame in zip([(s, k) for k in (0, 1) for s in SIDES], content["frames"], strict=True):
        shown, own, both = seen(sequence, side, number, "gs"), right if side == "right" else "", content | frame
        coefficients = {name: both[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2") if name in both}
        shape = LENSES[own or lens]
        assert coefficients == {name: getattr(shape, name, 0.0) for name in coefficients}
        found = opencv_pixels(_in_camera(frame, shown.world), _calibration(both), own or lens)
        np.testing.assert_allclose(found, shown.pixels + 0.5, atol=SAME_PX)
        image = out / "planes" / frame["file_path"]
        assert image.read_bytes() == (data / f"planes/gs/{side}_{number}.png").read_bytes()


def test_one_exposure_time_is_written_and_two_are_refused(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data")
    path, sensor = data / "planes/sequence.json", {"exposure_s": 0.01, "full_well": 6000.0, "gain": 4.0}
    write_json(path, read_json(path) | {"sensor": sensor})
    out, _ = exported(data, "nerfstudio", tmp_path / "out")
    assert json.loads((out / "planes/transforms.json").read_text())["exposure_time"] == 0.01
    write_json(path, read_json(path) | {"sensor": sensor | {"right_exposure_s": 0.005}})
    with pytest.raises(RsbenchError, match="exposures differ, and exposure_time is one for all; take --images gs"):
        exported(data, "nerfstudio", tmp_path / "two")
