"""Others' layouts: read, checked against themselves, and corrected frames scored against their truth."""

from __future__ import annotations

import csv
import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
import scipy
from carla_frames import FPS, HEIGHT, SEEN, WIDTH, V, W, skew, write, write_carla, write_image
from commands import run_here
from exported_data import HEIGHT as LINES
from exported_data import dataset, exported, only
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from programs import ROOT
from scipy.spatial.transform import Rotation

from rsbench.benchmark.recordings import correction_scores, pairs_with_truth, pose_scores
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.se3 import Pose
from rsbench.interop.readers.check import agreements, epipolar_distance, file_faults, sights
from rsbench.interop.readers.layouts import (
    FORMATS,
    read_carla,
    read_colmap,
    read_euroc,
    read_fastec,
    read_kitti,
    read_kitti_raw,
    read_middlebury,
    read_others,
)
from rsbench.vision.corrector import load_corrector

Array = NDArray[Any]


def only_row(path: Path) -> dict[str, str]:
    with path.open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    return row


# Carla-RS


def test_carla_has_velocities_of_the_camera_and_distances_along_rays(tmp_path: Path) -> None:
    (recording,) = read_carla(write_carla(tmp_path))
    assert recording.shutters["left"].readout_ratio == pytest.approx(1.0)
    assert recording.right_from_left is None  # one camera: no rig is made up
    for frame in (0, 1):
        np.testing.assert_allclose(recording.depths["left", frame](), SEEN[frame][0], atol=1e-6)  # six decimals
    pose = recording.poses["left"](np.array([0.0, 0.7]))
    t = 0.7 / FPS
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = scipy.linalg.expm(skew(W * t)), V * t
    found = np.column_stack([pose.R[1], pose.t[1]])
    np.testing.assert_allclose(found, np.linalg.inv(world_from_camera)[:3], atol=1e-12)


def test_carla_agrees_with_itself(tmp_path: Path) -> None:
    """1e-4: inverse depth is a plane in the image of one pose, and bends by the motion between two rows."""
    (found,) = agreements(read_carla(write_carla(tmp_path))[0])
    assert not found.fault
    assert found.share > 0.99
    assert found.typical < 1e-4
    assert found.pixels > WIDTH * HEIGHT / 2


@pytest.mark.parametrize("trap", [{"sign": -1.0}, {"suffix": ".pdepth"}], ids=["velocities", "radial taken for z"])
def test_carla_read_otherwise_does_not_agree(tmp_path: Path, trap: dict[str, Any]) -> None:
    run = run_here("verify", write_carla(tmp_path, **trap), "--from", "carla-rs")
    assert run.returncode == 1
    assert "do not agree" in run.stderr


def test_carla_is_verified_and_scored(tmp_path: Path) -> None:
    folder = write_carla(tmp_path / "data")
    run = run_here("verify", folder, "--from", "carla-rs")
    assert run.returncode == 0, run.stderr
    run = run_here("evaluate", folder, "--from", "carla-rs", "--out", tmp_path / "out")
    assert run.returncode == 0, run.stderr
    row = only_row(tmp_path / "out" / "scores" / "pose.csv")
    assert float(row["e_R_deg"]) < 0.2  # of 4; SIFT in 160 x 120 px errs by a tenth of a pixel, 0.07 deg
    assert float(row["e_T_deg"]) < 6.0
    assert not (tmp_path / "out" / "scores" / "depth.csv").exists()  # of one camera there is none


# Rectified stereo

GRADIENT = np.linspace(8.0, 20.0, 60)[:, None] * np.ones(200)
"""Disparities that grow from the first row to the last one: a flipped reading shows."""


@pytest.mark.parametrize(("order", "name"), [("<", "disp0.pfm"), (">", "disp0.pfm"), ("<", "disp0GT.pfm")])
def test_middlebury(tmp_path: Path, order: str, name: str) -> None:
    """MiddEval3 and ETH3D write disp0GT.pfm (IGEV#20)."""
    write(
        tmp_path / "pipes" / "calib.txt",
        "cam0=[400 0 90; 0 400 30; 0 0 1]\ncam1=[400 0 95; 0 400 30; 0 0 1]\ndoffs=5\nbaseline=160\n"
        "width=200\nheight=60\nndisp=64\n",
    )
    for k in range(2):
        write_image(tmp_path / "pipes" / f"im{k}.png", np.full((60, 200), 128, dtype=np.uint8))
    assert len(read_middlebury(tmp_path)[0].notes) == 1  # without disparities
    stored = GRADIENT.astype(f"{order}f4")
    stored[3, 4] = np.inf
    scale = -1.0 if order == "<" else 1.0
    header = f"Pf\n200 60\n{scale}\n".encode()
    (tmp_path / "pipes" / name).write_bytes(header + stored[::-1].tobytes())
    (recording,) = read_middlebury(tmp_path)
    assert not recording.notes
    found = recording.disparities["left", 0]()
    assert np.argwhere(np.isnan(found)).tolist() == [[3, 4]]
    assert recording.right_from_left is not None
    baseline, fx = -recording.right_from_left.t[0], recording.cameras["left"].fx
    expected = 160e-3 * 400 / (GRADIENT[50, 7] + 5)  # z of their documents, in metres
    assert baseline * fx / found[50, 7] == pytest.approx(expected, rel=1e-6)
    assert not recording.shutters  # the layout says nothing of one


def write_kitti(root: Path) -> Path:
    noise = np.random.default_rng(0).uniform(0, 255, (120, 360)).astype(np.uint8)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.2)
    for name, shift in (("image_2", 0), ("image_3", 16)):
        write_image(root / name / "000000_10.png", texture[:, shift : shift + 320])
    disparity = np.full((120, 320), 16 * 256, dtype=np.uint16)
    disparity[:, :20] = 0
    write_image(root / "disp_occ_0" / "000000_10.png", disparity)
    rows = {"P_rect_02": "300 0 160 18 0 300 60 0 0 0 1 0", "P_rect_03": "300 0 160 -132 0 300 60 0 0 0 1 0"}
    text = "calib_time: 09-Jan-2012 13:57:47\n" + "".join(f"{key}: {value}\n" for key, value in rows.items())
    write(root / "calib_cam_to_cam" / "000000.txt", text)
    return root


def test_kitti(tmp_path: Path) -> None:
    (recording,) = read_kitti(write_kitti(tmp_path / "data"))
    assert recording.right_from_left is not None
    np.testing.assert_allclose(recording.right_from_left.t, [-0.5, 0.0, 0.0])  # (18 + 132) / 300
    found = recording.disparities["left", 0]()
    assert np.all(np.isnan(found[:, :20]))
    np.testing.assert_array_equal(found[:, 20:], 16.0)
    assert set(recording.images) == {("left", 0), ("right", 0)}  # no picture of the next time was written
    assert run_here("verify", tmp_path / "data", "--from", "kitti").returncode == 0
    run = run_here("evaluate", tmp_path / "data", "--from", "kitti", "--out", tmp_path / "out")
    assert run.returncode == 0, run.stderr
    row = only_row(tmp_path / "out" / "scores" / "depth.csv")
    assert float(row["bad_1px"]) < 0.02
    assert float(row["coverage"]) > 0.9


# Of 2011_09_26, published with the data: cameras 0 and 1.
KITTI_RAW = """calib_time: 09-Jan-2012 13:57:47
S_00: 1.392000e+03 5.120000e+02
K_00: 9.842439e+02 0.000000e+00 6.900000e+02 0.000000e+00 9.808141e+02 2.331966e+02 0.000000e+00 0.000000e+00 1.000000e+00
D_00: -3.728755e-01 2.037299e-01 2.219027e-03 1.383707e-03 -7.233722e-02
R_00: 1.000000e+00 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00
T_00: 2.573699e-16 -1.059758e-16 1.614870e-16
S_rect_00: 1.242000e+03 3.750000e+02
R_rect_00: 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 9.999631e-01
P_rect_00: 7.215377e+02 0.000000e+00 6.095593e+02 0.000000e+00 0.000000e+00 7.215377e+02 1.728540e+02 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00 0.000000e+00
S_01: 1.392000e+03 5.120000e+02
K_01: 9.895267e+02 0.000000e+00 7.020000e+02 0.000000e+00 9.878386e+02 2.455590e+02 0.000000e+00 0.000000e+00 1.000000e+00
D_01: -3.644661e-01 1.790019e-01 1.148107e-03 -6.298563e-04 -5.314062e-02
R_01: 9.993513e-01 1.860866e-02 -3.083487e-02 -1.887662e-02 9.997863e-01 -8.421873e-03 3.067156e-02 8.998467e-03 9.994890e-01
T_01: -5.370000e-01 4.822061e-03 -1.252488e-02
S_rect_01: 1.242000e+03 3.750000e+02
R_rect_01: 9.996878e-01 -8.976826e-03 2.331651e-02 8.876121e-03 9.999508e-01 4.418952e-03 -2.335503e-02 -4.210612e-03 9.997184e-01
P_rect_01: 7.215377e+02 0.000000e+00 6.095593e+02 -3.875744e+02 0.000000e+00 7.215377e+02 1.728540e+02 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00 0.000000e+00
"""  # noqa: E501


def write_kitti_raw(root: Path, size: tuple[int, int]) -> Path:
    write(root / "calib_cam_to_cam.txt", KITTI_RAW)
    for name in ("image_00", "image_01"):
        for k in range(3):
            path = root / "drive_0001" / name / "data" / f"{k:010d}.png"
            write_image(path, np.full(size[::-1], 90, dtype=np.uint8))
        times = "2011-09-26 23:59:59.900000000\n2011-09-27 00:00:00.003000000\n"
        write(root / "drive_0001" / name / "timestamps.txt", times)
    return root


def test_kitti_raw_keeps_what_its_rectification_was_made_from(tmp_path: Path) -> None:
    fields = {key: values for key, _, values in (line.partition(": ") for line in KITTI_RAW.splitlines())}
    matrix = {key: np.array([float(each) for each in fields[key].split()]) for key in fields if key[0] != "c"}
    (recording,) = read_kitti_raw(write_kitti_raw(tmp_path / "extract", (1392, 512)))
    rig, shutter = recording.rig, recording.shutter
    assert rig is not None and shutter is not None and shutter.still
    assert recording.frame_period_s == pytest.approx(0.103)  # over midnight
    assert rig.baseline == pytest.approx(387.5744 / 721.5377, abs=5e-5)  # of the rectified pair
    for side, number in (("left", 0), ("right", 1)):
        # Rows of R_rect are the axes of the rectified pair in the camera: x is along the baseline of both.
        along = matrix[f"R_rect_0{number}"].reshape(3, 3)[0]
        np.testing.assert_allclose(rig.own(side).R[:, 0], along, atol=1e-6)
    X = np.random.default_rng(0).uniform([-3.0, -1.0, 6.0], [3.0, 1.0, 20.0], (40, 3))
    K, rotation = matrix["K_01"].reshape(3, 3), cv2.Rodrigues(matrix["R_01"].reshape(3, 3))[0]
    theirs, _ = cv2.projectPoints(X, rotation, matrix["T_01"], K, matrix["D_01"])
    ours = rig.sensor("right").project(X @ rig.right_from_left.R.T + rig.right_from_left.t)
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-3)  # a matrix of seven digits at 1000 px
    (recording,) = read_kitti_raw(write_kitti_raw(tmp_path / "sync", (1242, 375)) / "drive_0001")
    assert recording.rig is not None and recording.rig.rectified
    assert recording.rig.baseline == pytest.approx(387.5744 / 721.5377)
    assert run_here("verify", tmp_path / "sync", "--from", "kitti-raw").returncode == 0
    with pytest.raises(RsbenchError, match=r"800 x 600 pixels: neither S_00 nor S_rect_00"):
        read_kitti_raw(write_kitti_raw(tmp_path / "other", (800, 600)))


# EuRoC and TUM RS-VI

BODY_FROM = {
    0: np.array([[0.0, -1, 0, -0.02], [1, 0, 0, -0.06], [0, 0, 1, 0.01], [0, 0, 0, 1]]),
    1: np.array([[0.0, -1, 0, -0.02], [1, 0, 0, 0.05], [0, 0, 1, 0.01], [0, 0, 0, 1]]),
}
START, PERIOD = 1403636579763555584, 50000000


def pose_row(stamp: int, T: Array) -> str:
    """A line of a body's pose: time, position and quaternion (w, x, y, z)."""
    q = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return f"{stamp}," + ",".join(f"{value:.12f}" for value in (*T[:3, 3], *q))


def body(t: float) -> Array:
    """``world_from_body``, t in seconds: a turn at constant speed along a straight line."""
    out = np.eye(4)
    out[:3, :3] = scipy.linalg.expm(skew(np.array([0.4, -0.2, 0.7]) * t))
    out[:3, 3] = np.array([1.0, 2.0, 3.0]) + np.array([0.5, -0.3, 0.2]) * t
    return out


def write_euroc(root: Path) -> Path:
    stamps = [START + k * PERIOD for k in range(4)]
    for k, T in BODY_FROM.items():
        cam = root / "mav0" / f"cam{k}"
        rows = ["".join(f"{value:g}, " for value in row).strip() for row in T]
        data = "\n         ".join(rows).rstrip(",")
        write(
            cam / "sensor.yaml",
            "#Default\nsensor_type: camera\ncomment: VI-Sensor\nT_BS:\n  cols: 4\n  rows: 4\n"
            f"  data: [{data}]\nrate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\n"
            "intrinsics: [46.0, 45.5, 31.2, 24.1] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
            "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n",
        )
        seen = stamps[:3] if k == 0 else stamps[1:]
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in seen)
        write(cam / "data.csv", "#timestamp [ns],filename\n" + rows)
        for stamp in seen:
            write_image(cam / "data" / f"{stamp}.png", np.full((48, 64), 100, dtype=np.uint8))
    rows = []
    for k in range(-5, 60):  # every 2.5 ms, 1 ns beside the images
        stamp = START + k * 2_500_000 + 1
        rows.append(f"{pose_row(stamp, body((stamp - START) * 1e-9))},0.0,0.0,0.0")
    header = "#timestamp, p_RS_R_x [m], y, z, q_RS_w [], x, y, z, v\n"
    write(root / "mav0" / "state_groundtruth_estimate0" / "data.csv", header + "\n".join(rows) + "\n")
    return root


def test_euroc(tmp_path: Path) -> None:
    (recording,) = read_euroc(write_euroc(tmp_path))
    assert recording.frames == 2  # two times at which both cameras saw something
    assert recording.images["right", 0].name == f"{START + PERIOD}.png"
    assert recording.frame_period_s == pytest.approx(0.05)
    assert not recording.shutters
    for side, k in (("left", 0), ("right", 1)):
        pose = recording.poses[side](np.array([0.25]))
        expected = np.linalg.inv(body(1.25 * PERIOD * 1e-9) @ BODY_FROM[k])
        # 1e-9: twelve decimals; a time that was a float of nanoseconds would be off by 1e-7 m.
        np.testing.assert_allclose(np.column_stack([pose.R[0], pose.t[0]]), expected[:3], atol=1e-9)
    assert recording.right_from_left is not None
    apart = np.linalg.inv(BODY_FROM[1]) @ BODY_FROM[0]
    np.testing.assert_allclose(recording.right_from_left.t, apart[:3, 3], atol=1e-12)
    camera = recording.cameras["left"]
    assert camera.lens is not None
    assert (camera.cx, camera.lens.k1, camera.lens.p2) == (31.2, -0.28, 1.8e-05)
    assert np.all(np.isnan(recording.poses["left"](np.array([9.0])).t))  # unknown outside the file's times
    assert run_here("verify", tmp_path, "--from", "euroc").returncode == 0


def test_stamps_that_differ_by_less_than_half_a_row_are_one_time(tmp_path: Path) -> None:
    """ORB_SLAM3#20: clocks of their own, or stamps that went through floats."""
    root = write_euroc(tmp_path)
    path = root / "mav0" / "cam1" / "data.csv"
    half = PERIOD / 48 / 2  # of the rows of a frame that takes the whole period
    for shift, frames in ((-200, 2), (int(0.9 * half), 2), (int(1.1 * half), None)):
        stamps = [START + k * PERIOD for k in (1, 2, 3)]
        write(path, "".join(f"{stamp + shift},{stamp}.png\n" for stamp in stamps))
        if frames is None:
            with pytest.raises(RsbenchError, match="0 times in common"):
                read_euroc(root)
        else:
            (recording,) = read_euroc(root)
            assert recording.frames == frames and recording.images["right", 0].name == f"{stamps[0]}.png"


@pytest.mark.parametrize("chained", [False, True])
def test_a_camchain_stands_in_for_the_sensors_files(tmp_path: Path, chained: bool) -> None:
    """As TUM VI and TUM RS-VI are distributed (open_vins#152)."""
    root = write_euroc(tmp_path)
    (expected,) = read_euroc(root)
    text = ""
    for k, T in BODY_FROM.items():
        (root / "mav0" / f"cam{k}" / "sensor.yaml").unlink()
        key, matrix = "T_cam_imu", np.linalg.inv(T)
        if k and chained:
            key, matrix = "T_cn_cnm1", np.linalg.inv(T) @ BODY_FROM[0]
        text += (
            f"cam{k}:\n  camera_model: pinhole\n  distortion_model: radtan\n  resolution: [64, 48]\n"
            "  intrinsics: [46.0, 45.5, 31.2, 24.1]\n  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
            f"  {key}: {matrix.tolist()}\n" + ("  line_delay: 0.0001\n" if chained else "")
        )
    write(root / "dso" / "camchain.yaml", text)
    (found,) = read_euroc(root)
    assert found.cameras == expected.cameras and found.images == expected.images
    tau = np.array([0.25, 0.5])
    for side in ("left", "right"):
        for a, b in zip(found.poses[side](tau), expected.poses[side](tau), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
        assert (found.shutters[side].readout_ratio if chained else 0.096) == pytest.approx(1e-4 * 48 * 20)


def test_tum_rsvi_has_its_line_delay(tmp_path: Path) -> None:
    (recording,) = read_others(write_euroc(tmp_path), "tum-rsvi")
    assert recording.shutters["left"].readout_ratio == 0.0
    assert recording.shutters["right"].readout_ratio == pytest.approx(29.4737e-6 * 48 * 20)  # rows times rate
    rig, shutter = recording.rig, recording.shutter
    assert rig is not None and shutter is not None  # a global camera and one that rolls are a rig
    seconds = shutter.pixel_time(np.array([[3.0, 7.0]]), 1, "right") * 0.05
    np.testing.assert_allclose(seconds, 0.05 + 7 * 29.4737e-6, rtol=1e-12)
    assert shutter.pixel_time(np.array([3.0, 7.0]), 1, "left") == 1.0
    right_from_left = np.linalg.inv(BODY_FROM[1]) @ BODY_FROM[0]
    np.testing.assert_allclose(rig.right_from_left.R, right_from_left[:3, :3], atol=1e-12)
    np.testing.assert_allclose(rig.right_from_left.t, right_from_left[:3, 3], atol=1e-12)
    assert rig.sensor("right") == recording.cameras["right"]


IMU_FROM_LEFT = np.eye(4)
IMU_FROM_LEFT[:3, :3] = scipy.linalg.expm(skew(np.array([0.3, -1.2, 0.4])))
IMU_FROM_LEFT[:3, 3] = [0.05, -0.02, 0.01]


def write_rsvi(root: Path, case: Any, rolling: dict[tuple[str, int], Array]) -> Path:
    """A traced rig of a global camera and one that rolls in the layout of TUM RS-VI, whose line delay is fixed."""
    period = round(1e9 * 29.4737e-6 * case.rig.right.height / case.rig.right.ratio)
    right_from_left = np.eye(4)
    right_from_left[:3, :3], right_from_left[:3, 3] = case.rig.R, case.rig.t
    places = {"left": IMU_FROM_LEFT, "right": IMU_FROM_LEFT @ np.linalg.inv(right_from_left)}
    for k, (side, T) in enumerate(places.items()):
        camera, home = case.rig.camera(side), root / "mav0" / f"cam{k}"
        intrinsics = [float(each) for each in (camera.fx, camera.fy, *camera.centre)]
        write(
            home / "sensor.yaml",
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\nresolution: "
            f"[{camera.width}, {camera.height}]\nintrinsics: {intrinsics}\ndistortion_model: none\n",
        )
        write(home / "data.csv", "".join(f"{START + n * period},{n}.png\n" for n in (0, 1)))
        for n in (0, 1):
            image = np.clip(np.rint(rolling[side, n]), 0, 255).astype(np.uint8)
            write_image(home / "data" / f"{n}.png", image)
    rows = []
    for n in range(-10, 40):
        tau = np.array([n / 20])
        R, t = case.rig.poses(case.law, "left", tau)
        left_from_world = np.eye(4)
        left_from_world[:3, :3], left_from_world[:3, 3] = R[0], t[0]
        T = np.linalg.inv(left_from_world) @ np.linalg.inv(IMU_FROM_LEFT)
        rows.append(pose_row(START + n * period // 20, T) + "\n")
    write(root / "mav0" / "mocap0" / "data.csv", "".join(rows))
    return root


@pytest.mark.slow
def test_a_global_camera_beside_one_that_rolls_is_scored_as_a_rig(tmp_path: Path) -> None:
    """Traced by a program that shares no code; the frames of each camera alone say less, and no length."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        frames = importlib.import_module("foreign_frames")
        case, rng = frames.draw_case("global-left", 0)
        traced = frames.trace_case(case, rng, frames.read_photographs(None))
    (recording,) = read_others(write_rsvi(tmp_path, case, traced.rolling), "tum-rsvi")
    assert all(not sight.fault and sight.share > 0.8 for sight in sights(recording))
    table = pose_scores([recording], 0).set_index("camera")
    assert table["e_R_deg"]["both"] < 0.01 and table["e_T_deg"]["both"] < 0.3
    assert table["e_s"]["both"] < 0.01 and np.all(np.isnan(table["e_s"][["left", "right"]]))


# COLMAP


def test_colmap(tmp_path: Path) -> None:
    write(
        tmp_path / "sparse" / "cameras.txt",
        "# Camera list\n1 OPENCV 640 480 500 510 320 240 -0.1 0.02 0.001 -0.002\n"
        "2 SIMPLE_PINHOLE 64 48 50 32 24\n",
    )
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3])
    q = " ".join(f"{value:.12f}" for value in turn.as_quat(scalar_first=True))
    write(
        tmp_path / "sparse" / "images.txt",
        f"# Image list\n2 {q} 0.1 0.2 0.3 1 b b.png\n\n"
        "1 1 0 0 0 0 0 0 1 a.png\n10.5 20.5 -1\n3 1 0 0 0 0 0 0 2 c.png\n\n",
    )
    first, second = sorted(read_colmap(tmp_path / "sparse"), key=lambda each: each.name)
    assert [first.images["left", k].name for k in (0, 1)] == ["a.png", "b b.png"]
    X = np.array([0.4, -0.3, 2.0])
    pose = first.poses["left"](np.array([0.0, 0.5, 1.0]))
    moved = pose.R[2] @ X + pose.t[2]
    np.testing.assert_allclose(moved, turn.as_matrix() @ X + [0.1, 0.2, 0.3], atol=1e-9)
    assert np.all(np.isnan(pose.t[1]))  # between images nothing is known
    x, y = moved[:2] / moved[2]
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2
    xd = x * radial + 2 * 0.001 * x * y - 0.002 * (r2 + 2 * x * x)
    yd = y * radial + 0.001 * (r2 + 2 * y * y) - 2 * 0.002 * x * y
    theirs = np.array([500 * xd + 320, 510 * yd + 240])  # counted from the corner of the image
    np.testing.assert_allclose(first.cameras["left"].project(moved), theirs - 0.5, atol=1e-6)
    assert (second.cameras["left"].fy, second.cameras["left"].cx) == (50.0, 31.5)
    assert not first.shutters


@pytest.mark.parametrize("turned", [False, True])
def test_a_rig_that_colmap_wrote_is_one_recording(tmp_path: Path, turned: bool) -> None:
    """Of two sizes and lenses; the camera that is at the right is the right one, whichever COLMAP lists first."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    lens = [60, 61, 32, 24, -0.1, 0.01, 0, 0]
    cameras = [
        pycolmap.Camera(camera_id=4, model="OPENCV", width=64, height=48, params=lens),
        pycolmap.Camera(camera_id=7, model="PINHOLE", width=128, height=96, params=[120, 121, 64, 48]),
    ]
    turn, t = Rotation.from_rotvec([0.01, 0.02, 0.03]), np.array([-0.2, 0.01, 0.02])
    second_from_first = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), t)
    if turned:
        cameras, second_from_first = cameras[::-1], second_from_first.inverse()
    for camera in cameras:
        model.add_camera(camera)
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(cameras[0].sensor_id)
    rig.add_sensor(cameras[1].sensor_id, second_from_first)
    model.add_rig(rig)
    for k in (1, 2):
        frame = pycolmap.Frame(frame_id=k, rig_id=1)
        about_x = pycolmap.Rotation3d(np.array([0.1 * k, 0, 0]))
        frame.rig_from_world = pycolmap.Rigid3d(about_x, [0.1 * k, 0.0, 0.0])
        for camera in cameras:
            frame.add_data_id(pycolmap.data_t(camera.sensor_id, 10 * k + camera.camera_id))
        model.add_frame(frame)
        for camera in cameras:
            number, name = 10 * k + camera.camera_id, f"{camera.camera_id}/{3 - k}.png"
            image = pycolmap.Image(image_id=number, name=name, camera_id=camera.camera_id)
            image.frame_id = k
            model.add_image(image)
        model.register_frame(k)
    model.write_text(str(tmp_path))
    (recording,) = read_colmap(tmp_path)
    assert recording.name == "rig 1" and recording.rig is not None
    assert [recording.cameras[side].width for side in SIDES] == [64, 128]
    assert recording.images["right", 0].name == "1.png" and recording.images["right", 0].parent.name == "7"
    np.testing.assert_allclose(recording.rig.right_from_left.R, turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(recording.rig.right_from_left.t, t, atol=1e-9)
    X = np.array([0.3, -0.2, 2.0])
    for k in (1, 2):  # frame 0 is the one with the first name, COLMAP's frame 2
        for side, number in (("left", 4), ("right", 7)):
            pose = recording.poses[side](np.array([2.0 - k]))
            ours = recording.cameras[side].project(X @ pose.R[0].T + pose.t[0])
            theirs = model.image(10 * k + number).project_point(X)
            np.testing.assert_allclose(ours, theirs - 0.5, atol=1e-9)


# What is wrong


@pytest.mark.parametrize("layout", FORMATS)
def test_an_empty_folder_has_no_layout(tmp_path: Path, layout: str) -> None:
    with pytest.raises(RsbenchError, match=r"holds no"):
        read_others(tmp_path, layout)


def test_a_layout_that_does_not_exist_is_named(tmp_path: Path) -> None:
    run = run_here("verify", tmp_path, "--from", "kity")
    assert run.returncode == 2
    assert "kitti" in run.stderr


def write_points(folder: Path, shift: float = 0.0) -> Path:
    """A model of one camera, two images and 40 points, each image ``shift`` m beside where it says."""
    write(folder / "cameras.txt", "1 PINHOLE 640 480 500 510 320 240\n")
    rng = np.random.default_rng(3)
    points = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (40, 3))
    lines = [f"{7 + k} {x} {y} {z} 0 0 0 0.5\n" for k, (x, y, z) in enumerate(points)]
    write(folder / "points3D.txt", "".join(lines))
    text = ""
    for number, x in enumerate((0.0, 0.3)):
        at = points + np.array([x + shift, 0.0, 0.0])
        seen = at[:, :2] / at[:, 2:] * [500, 510] + [320, 240]
        rest = "".join(f" {u} {v} {7 + k}" for k, (u, v) in enumerate(seen))
        text += f"{number + 1} 1 0 0 0 {x} 0 0 1 {number}.png\n3.5 4.5 -1{rest}\n"
    write(folder / "images.txt", text)
    for number in range(2):
        write_image(folder / "images" / f"{number}.png", np.zeros((480, 640), dtype=np.uint8))
    return folder


def test_colmap_points_are_seen_where_its_poses_say(tmp_path: Path) -> None:
    found = list(sights(read_colmap(write_points(tmp_path))[0]))
    assert [(each.count, each.fault) for each in found] == [(40, ""), (40, "")]
    assert max(each.typical for each in found) < 1e-9  # the half pixel of the corner on both sides


def test_colmap_images_that_stand_elsewhere_are_faults(tmp_path: Path) -> None:
    run = run_here("verify", write_points(tmp_path, shift=0.1), "--from", "colmap")
    assert run.returncode == 1 and run.stderr.count("points of left image") == 2


def test_matches_of_rolling_frames_lie_where_poses_of_their_rows_say(tmp_path: Path) -> None:
    (right,) = sights(read_carla(write_carla(tmp_path / "right"))[0])
    (still,) = sights(read_carla(write_carla(tmp_path / "still", row_ms=0.0))[0])
    assert right.count > 100 and right.share > 0.95 and right.typical < 0.15  # features err by a tenth of a pixel
    assert still.typical > 3.0 * right.typical


seconds, thirds = st.floats(-0.2, 0.2), st.floats(-1.0, 1.0)


@given(w=st.tuples(seconds, seconds, seconds), t=st.tuples(thirds, thirds, thirds), seed=st.integers(0, 100))
def test_exact_matches_are_on_their_half_of_the_line(
    w: tuple[float, float, float], t: tuple[float, float, float], seed: int
) -> None:
    """With the other sign of the translation they are as far from it as they moved since infinity."""
    assume(np.linalg.norm(t) > 0.05)
    camera = PinholeCamera.centred(640, 480, 500.0)
    points = np.random.default_rng(seed).uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 8.0], (20, 3))
    pose = Pose(scipy.linalg.expm(skew(np.array(w))), np.array(t))
    there, far = points @ pose.R.T + pose.t, points @ pose.R.T
    matches = np.concatenate([camera.project(points), camera.project(there)], axis=1)
    # 1e-6: where the epipole is near, both sides of the quotient are rounding of small numbers.
    assert np.max(epipolar_distance(pose, matches, camera, camera)) < 1e-6
    moved = np.linalg.norm(camera.project(there) - camera.project(far), axis=1)
    found = epipolar_distance(Pose(pose.R, -pose.t), matches, camera, camera)
    np.testing.assert_allclose(found, moved, rtol=1e-6, atol=1e-6)


WIDE, HIGH, PX = 160, 120, 9.0
"""Size of the panning camera's frames, and how far the picture moves in a frame period."""


def panned(times: NDArray[Any]) -> NDArray[np.uint8]:
    """What rows (h,) that are read at these times show, frame periods."""
    blots = cv2.GaussianBlur(np.random.default_rng(5).uniform(size=(HIGH, 240)), (0, 0), 2.0)
    blots = (255 * (blots - blots.min()) / np.ptp(blots)).astype(np.float32)
    x, y = np.meshgrid(np.arange(WIDE), np.arange(HIGH))
    where = (x + 20.0 + PX * times[:, None]).astype(np.float32)
    drawn = cv2.remap(blots, where, y.astype(np.float32), cv2.INTER_CUBIC)
    return np.asarray(np.clip(np.rint(drawn), 0, 255), dtype=np.uint8)


def write_fastec(root: Path, frames: int = 3) -> Path:
    rows = np.arange(HIGH) / HIGH
    for frame in range(frames):
        for name, times in (
            ("rolling", frame + rows),
            ("global_first", np.full(HIGH, float(frame))),
            ("global_middle", np.full(HIGH, frame + 0.5)),
        ):
            write_image(root / "drive" / f"{frame:03d}_{name}.png", panned(times))
    return root


def test_fastec_is_scored_against_its_truth(tmp_path: Path) -> None:
    folder = write_fastec(tmp_path / "data")
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "out")
    assert run.returncode == 0, run.stderr
    assert "a focal length of 160 px, the width, and a readout ratio of 1 are assumed" in run.stdout + run.stderr
    table = pd.read_csv(tmp_path / "out" / "scores" / "correction.csv")
    # Every frame but the first, at the first and the middle row, by three methods.
    assert len(table) == 2 * 2 * 3
    assert table["success"].all()
    scores = table.set_index(["frame", "row", "method"])["psnr"]
    for frame in (1, 2):
        for row in (0, 60):
            rolling, truth = (
                panned(times).astype(np.float64)
                for times in (frame + np.arange(HIGH) / HIGH, np.full(HIGH, frame + row / HIGH))
            )
            expected = 10.0 * np.log10(255.0**2 / np.mean((rolling - truth) ** 2))
            assert scores[frame, row, "uncorrected"] == pytest.approx(expected, abs=1e-4)  # six digits in the file
            # A pan of 9 px leaves at most 4.5 px of a column that no frame shows: 10 dB are left far above noise.
            assert min(scores[frame, row, name] for name in ("flow-scaled", "mono-fusion")) > expected + 5.0


def test_what_is_exported_to_fastec_and_carla_reads_back(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", frames=3)
    sequence = only(data)
    for name, read, ends in (
        ("fastec-rs", read_fastec, {side: f"planes_{side}" for side in SIDES}),
        ("carla-rs", read_carla, {side: f"seq_{side}" for side in SIDES}),
    ):
        out, _ = exported(data, name, tmp_path / name)
        recordings = {each.name: each for each in read(out)}
        for side in SIDES:
            found = recordings[ends[side]]
            assert set(found.images) == {("left", frame) for frame in range(3)}
            assert set(found.truths) == {("left", frame, row) for frame in range(3) for row in (0, LINES // 2)}
            for frame in range(3):
                twin = data / "planes" / "gs_twin" / f"{LINES // 2:04d}" / f"{side}_{frame}.png"
                assert found.truths["left", frame, LINES // 2].read_bytes() == twin.read_bytes()
                shown = cv2.imread(str(found.truths["left", frame, 0]))[..., ::-1]
                np.testing.assert_array_equal(shown, sequence.image("gs", side, frame))


def test_the_mask_of_carla_weighs_pixels(tmp_path: Path) -> None:
    """Only its lower half counts there, and of that the right half half as much: PSNR written out."""
    (seq,) = [path.parent for path in write_carla(tmp_path).rglob("gt_vel.log")]
    frame = cv2.imread(str(seq / "0001_rs.png"), cv2.IMREAD_GRAYSCALE)
    truth = np.clip(frame.astype(int) + np.random.default_rng(0).integers(-20, 20, frame.shape), 0, 255)
    weights = np.zeros(frame.shape, dtype=np.uint8)
    weights[frame.shape[0] // 2 :] = 200
    weights[:, frame.shape[1] // 2 :] //= 2
    write_image(seq / "0001_gs_m.png", truth.astype(np.uint8))
    write_image(seq / "0001_mask.png", weights)
    (row,) = correction_scores(pairs_with_truth(read_carla(tmp_path)), []).to_dict("records")
    squares, weights = ((frame.astype(np.float64) - truth) / 255.0) ** 2, weights.astype(np.float64)
    expected = -20.0 * np.log10(np.sqrt(np.sum(squares * weights) / np.sum(weights)))
    assert row["psnr_mask"] == pytest.approx(expected, abs=1e-9)
    assert row["psnr"] == pytest.approx(-10.0 * np.log10(np.mean(squares)), abs=1e-9)
    write_image(seq / "0001_mask.png", weights[1:])
    with pytest.raises(RsbenchError, match=r"0001_mask.png: is 160 x 119 pixels, its frame 160 x 120"):
        correction_scores(pairs_with_truth(read_carla(tmp_path)), [])


def test_a_frame_that_is_not_corrected_counts_as_it_was_read(tmp_path: Path) -> None:
    """Here it equals its truth, which scores 100 as published."""
    for frame in range(2):
        for name in ("rolling", "global_middle"):
            write_image(tmp_path / f"{frame:03d}_{name}.png", panned(np.zeros(HIGH)))
    table = correction_scores(pairs_with_truth(read_fastec(tmp_path)), [load_corrector("mono-fusion")])
    assert list(table["success"]) == [True, False]
    assert "still camera" in table["reason"][1]
    assert list(table["psnr"]) == [100.0, 100.0]


def test_bad_recordings_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = write_fastec(tmp_path / "data")
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "a", "--corrector", "zhuang")
    assert run.returncode == 2
    assert "--corrector zhuang: needs matches, the other camera" in run.stderr
    write_image(folder / "drive" / "001_global_middle.png", panned(np.zeros(HIGH))[:-1])
    fault = f"{folder / 'drive' / '001_global_middle.png'}: is 160 x 119 pixels, its camera 160 x 120"
    assert list(file_faults(read_fastec(folder)[0])) == [fault]
    run = run_here("verify", folder, "--from", "fastec-rs")
    assert run.returncode == 1 and fault in run.stderr
    run = run_here("evaluate", folder, "--from", "fastec-rs", "--out", tmp_path / "b")
    assert run.returncode == 2
    assert "001_global_middle.png: is 160 x 119" in run.stderr


@pytest.mark.parametrize("empty", ["\n", "", "\n\n"])
def test_colmap_images_without_lines_of_points(tmp_path: Path, empty: str) -> None:
    """Some programs leave out the second lines (colmap#965), which are empty where nothing was matched."""
    write_points(tmp_path)
    images = "".join(f"{k + 1} 1 0 0 0 {0.1 * k} 0 0 1 {k} 7.png\n{empty}" for k in range(4))
    write(tmp_path / "images.txt", images)
    (recording,) = read_colmap(tmp_path)
    assert [path.name for path in recording.images.values()] == [f"{k} 7.png" for k in range(4)]
    found = recording.poses["left"](np.arange(4.0)).t[:, 0]
    np.testing.assert_allclose(found, 0.1 * np.arange(4), atol=1e-12)
