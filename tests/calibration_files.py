"""One made-up rig in the files of every tool, each by its documents; OpenCV's written by OpenCV."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

SIZE = (1280, 720)
LEFT, RIGHT = (701.2, 701.5, 640.8, 358.1), (699.4, 699.9, 633.9, 365.2)
D_LEFT, D_RIGHT = (-0.171, 0.026, 0.0002, -0.0001), (-0.170, 0.0255, -0.0001, 0.0003)
TURN = np.array([0.004, -0.010, 0.003])
R, T = Rotation.from_rotvec(TURN).as_matrix(), np.array([-0.1198, 0.0006, -0.0012])
KB = (-0.01, 0.02, -0.01, 0.002)
LINE_DELAY = 25.6e-6
OWN = {"left": (LEFT, D_LEFT), "right": (RIGHT, D_RIGHT)}
"""Intrinsics and distortion of each camera."""
PINHOLE = ("fx", "fy", "cx", "cy")
EIGHT = (*PINHOLE, "k1", "k2", "p1", "p2")


def matrix(intrinsics: tuple[float, ...]) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def five(d: tuple[float, ...]) -> np.ndarray:
    return np.array([[*d, 0.0]])


def square(R_: np.ndarray, t: Any) -> np.ndarray:
    """A pose as a matrix (4, 4)."""
    return np.vstack([np.column_stack([R_, t]), [0, 0, 0, 1]])


FOUR = square(R, T)
RECTIFIED = dict(
    zip(
        ("R1", "R2", "P1", "P2", "Q"),
        cv2.stereoRectify(matrix(LEFT), five(D_LEFT), matrix(RIGHT), five(D_RIGHT), SIZE, R, T[:, None], alpha=0),
        strict=False,
    )
)


def keyed(names: tuple[str, ...], *values: tuple[float, ...]) -> dict[str, float]:
    """The numbers of one camera under the names of a tool."""
    return dict(zip(names, [number for each in values for number in each], strict=True))


def opencv(path: Path, **values: Any) -> Path:
    """A file of cv2.FileStorage; its suffix chooses the syntax."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


def opencv_yml(folder: Path, suffix: str = "yml") -> Path:
    values = {"M1": matrix(LEFT), "D1": five(D_LEFT), "M2": matrix(RIGHT), "D2": five(D_RIGHT), "R": R, "T": T}
    return opencv(folder / f"stereo.{suffix}", **values)


def opencv_two_files(folder: Path) -> Path:
    """As OpenCV's sample stereo_calib writes them."""
    opencv(folder / "intrinsics.yml", M1=matrix(LEFT), D1=five(D_LEFT), M2=matrix(RIGHT), D2=five(D_RIGHT))
    return opencv(folder / "extrinsics.yml", R=R, T=T[:, None], **RECTIFIED)


def opencv_rectified(folder: Path) -> Path:
    """Without R and T; a name for each key that others use."""
    values = {"cameraMatrixL": matrix(LEFT), "distCoeffsL": five(D_LEFT)}
    values |= {"cameraMatrixR": matrix(RIGHT), "distCoeffsR": five(D_RIGHT)}
    values |= {name: RECTIFIED[name] for name in ("R1", "R2", "P1", "P2")}
    return opencv(folder / "rectified.xml", **values, imageSize=np.array(SIZE))


def opencv_zed(folder: Path) -> Path:
    """As the ZED's own calibration tool writes it: a rotation vector, millimetres and a size."""
    values = {"K_LEFT": matrix(LEFT), "K_RIGHT": matrix(RIGHT), "D_LEFT": five(D_LEFT), "D_RIGHT": five(D_RIGHT)}
    return opencv(folder / "zed.yml", Size=np.array(SIZE), **values, R=TURN, T=1000 * T)


def kalibr_camera(intrinsics: tuple[float, ...], d: tuple[float, ...], model: str = "radtan") -> str:
    return (
        f"  camera_model: pinhole\n  intrinsics: {list(intrinsics)}\n  distortion_model: {model}\n"
        f"  distortion_coeffs: {list(d)}\n  resolution: [1280, 720]\n  rostopic: /cam/image_raw\n"
    )


def four_by_four(name: str, T4: np.ndarray) -> str:
    rows = "".join(f"  - [{', '.join(map(repr, row))}]\n" for row in T4.tolist())
    return f"  {name}:\n{rows}"


def kalibr(folder: Path) -> Path:
    path = folder / "camchain.yaml"
    path.write_text(
        f"cam0:\n  cam_overlaps: [1]\n{kalibr_camera(LEFT, D_LEFT)}  line_delay: {LINE_DELAY!r}\n"
        f"cam1:\n  cam_overlaps: [0]\n{kalibr_camera(RIGHT, D_RIGHT)}  line_delay: {LINE_DELAY!r}\n"
        f"{four_by_four('T_cn_cnm1', FOUR)}"
    )
    return path


def openvins(folder: Path) -> Path:
    """T_imu_cam, with the IMU somewhere, and OpenCV's first line."""
    imu = square(Rotation.from_rotvec([1.0, 0.5, -2.0]).as_matrix(), [0.1, 0.2, 0.3])
    blocks = [
        f"cam{k}:\n{four_by_four('T_imu_cam', imu @ np.linalg.inv(each))}{kalibr_camera(*own)}"
        f"  timeshift_cam_imu: {shift} # s\n"
        for k, (each, own, shift) in enumerate(
            ((np.eye(4), (LEFT, D_LEFT), 0.001), (FOUR, (RIGHT, D_RIGHT), 0.004))
        )
    ]
    path = folder / "kalibr_imucam_chain.yaml"
    path.write_text("%YAML:1.0\n\n" + "".join(blocks))
    return path


def ros_text(intrinsics: tuple[float, ...], d: tuple[float, ...], R_: np.ndarray, P: np.ndarray) -> str:
    def block(name: str, values: np.ndarray) -> str:
        rows, cols = values.shape
        return f"{name}:\n  rows: {rows}\n  cols: {cols}\n  data: {values.ravel().tolist()}\n"

    return (
        "image_width: 1280\nimage_height: 720\ncamera_name: narrow\n"
        + block("camera_matrix", matrix(intrinsics))
        + "distortion_model: plumb_bob\n"
        + block("distortion_coefficients", five(d))
        + block("rectification_matrix", R_)
        + block("projection_matrix", P)
    )


def ros(folder: Path) -> Path:
    for number, (side, own) in enumerate(OWN.items(), start=1):
        text = ros_text(*own, RECTIFIED[f"R{number}"], RECTIFIED[f"P{number}"])
        (folder / f"{side}.yaml").write_text(text)
    return folder / "left.yaml"


def basalt(folder: Path) -> Path:
    centre, q = -R.T @ T, Rotation.from_matrix(R.T).as_quat()
    names = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    poses = [dict.fromkeys(names, 0.0) | {"qw": 1.0}, dict(zip(names, [*centre, *q], strict=True))]
    cameras = [{"camera_type": "pinhole-radtan8", "intrinsics": keyed(EIGHT, *own)} for own in OWN.values()]
    path = folder / "calib.json"
    path.write_text(
        json.dumps({"value0": {"T_imu_cam": poses, "intrinsics": cameras, "resolution": [SIZE, SIZE]}})
    )
    return path


def zed(folder: Path) -> Path:
    def camera(name: str, own: tuple[float, ...], d: tuple[float, ...]) -> str:
        numbers = keyed(EIGHT, own, d).items()
        return f"[{name}]\n" + "".join(f"{key}={value!r}\n" for key, value in numbers) + "k3=0\n"

    small = (350.0, 350.0, 336.0, 188.0)
    vga = camera("LEFT_CAM_VGA", small, D_LEFT) + camera("RIGHT_CAM_VGA", small, D_RIGHT)
    turn = "".join(
        f"{key}_{size}={value!r}\n"
        for size in ("HD", "VGA")
        for key, value in zip(("RX", "CV", "RZ"), TURN.tolist(), strict=True)
    )
    path = folder / "SN1234.conf"
    path.write_text(
        vga
        + camera("LEFT_CAM_HD", LEFT, D_LEFT)
        + camera("RIGHT_CAM_HD", RIGHT, D_RIGHT)
        + f"[STEREO]\nBaseline=119.8\nTY=0.6\nTZ=-1.2\n{turn}"
    )
    return path


def depthai(folder: Path) -> Path:
    def camera(own: tuple[float, ...], d: tuple[float, ...], apart: dict[str, Any]) -> dict[str, Any]:
        return {
            "cameraType": 0,
            "width": 1280,
            "height": 720,
            "intrinsicMatrix": matrix(own).tolist(),
            "distortionCoeff": [*d, *[0.0] * 10],
            "extrinsics": apart,
        }

    # The left one to the colour camera in the middle, that to the right one.
    middle = Rotation.from_rotvec([0.01, 0.02, 0.03]).as_matrix(), np.array([-0.06, 0.001, 0.0])
    rest = R @ middle[0].T, T - R @ middle[0].T @ middle[1]

    def apart(pose: Any, to: int) -> dict[str, Any]:
        shift = dict(zip("xyz", (100 * pose[1]).tolist(), strict=True))
        return {
            "rotationMatrix": pose[0].tolist(),
            "translation": shift,
            "specTranslation": shift,
            "toCameraSocket": to,
        }

    end: dict[str, Any] = {"rotationMatrix": [], "toCameraSocket": -1, "translation": dict.fromkeys("xyz", 0.0)}
    cameras = [
        [0, camera((1000.0, 1000.0, 640.0, 360.0), D_LEFT, apart(rest, 2))],
        [1, camera(LEFT, D_LEFT, apart(middle, 0))],
        [2, camera(RIGHT, D_RIGHT, end)],
    ]
    path = folder / "eeprom.json"
    path.write_text(json.dumps({"version": 7, "boardName": "X", "cameraData": cameras}))
    return path


def realsense(folder: Path) -> Path:
    def camera(own: tuple[float, ...], d: tuple[float, ...]) -> dict[str, Any]:
        model = {"model": "distortion.brown_conrady", "coeffs": [*d, 0.0]}
        return {"width": 1280, "height": 720, **keyed(("fx", "fy", "ppx", "ppy"), own), **model}

    apart = {"rotation": R.T.ravel().tolist(), "translation": T.tolist()}
    path = folder / "realsense.json"
    path.write_text(json.dumps({side: camera(*own) for side, own in OWN.items()} | {"left_to_right": apart}))
    return path


def half(own: tuple[float, ...], d: tuple[float, ...]) -> list[float]:
    return [own[0], own[1], own[2] + 0.5, own[3] + 0.5, *d]


def wxyz(matrix_: np.ndarray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(matrix_).as_quat().tolist()
    return [w, x, y, z]


def rig_config(folder: Path) -> Path:
    places = {
        "left": {"ref_sensor": True},
        "right": {"cam_from_rig_rotation": wxyz(R), "cam_from_rig_translation": T.tolist()},
    }
    cameras = [
        {"image_prefix": f"{side}/", "camera_model_name": "OPENCV", "camera_params": half(*own), **places[side]}
        for side, own in OWN.items()
    ]
    path = folder / "rig_config.json"
    path.write_text(json.dumps([{"cameras": cameras}]))
    return path


def colmap(folder: Path) -> Path:
    cameras = [
        f"{k} OPENCV 1280 720 {' '.join(map(repr, half(own, d)))}"
        for k, (own, d) in enumerate(OWN.values(), start=1)
    ]
    (folder / "cameras.txt").write_text("# Camera list\n" + "\n".join(cameras) + "\n")
    pose = " ".join(map(repr, [*wxyz(R), *T.tolist()]))
    (folder / "rigs.txt").write_text(f"# Rig calib list\n1 2 CAMERA 1 CAMERA 2 1 {pose}\n")
    return folder


def rig_config_and_cameras(folder: Path) -> Path:
    """Without parameters, which cameras.txt has."""
    colmap(folder)
    (folder / "rigs.txt").unlink()
    path = rig_config(folder)
    tree = json.loads(path.read_text())
    for camera in tree[0]["cameras"]:
        del camera["camera_model_name"], camera["camera_params"]
    path.write_text(json.dumps(tree))
    return path


def euroc(folder: Path) -> Path:
    body = square(Rotation.from_rotvec([0.3, 1.5, -0.2]).as_matrix(), [0.1, -0.2, 0.05])
    for k, (each, own, d) in enumerate(((np.eye(4), LEFT, D_LEFT), (FOUR, RIGHT, D_RIGHT))):
        (folder / f"cam{k}").mkdir()
        data = (body @ np.linalg.inv(each)).ravel().tolist()
        (folder / f"cam{k}" / "sensor.yaml").write_text(
            f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {data}\nrate_hz: 20\n"
            f"resolution: [1280, 720]\n"
            f"camera_model: pinhole\nintrinsics: {list(own)} #fu, fv, cu, cv\n"
            f"distortion_model: radial-tangential\n"
            f"distortion_coefficients: {list(d)}\n"
        )
    return folder


def toml(folder: Path) -> Path:
    path = folder / "rig.toml"
    sides = [
        f"[{side}]\nwidth = 1280\nheight = 720\n"
        + "".join(f"{key} = {value!r}\n" for key, value in keyed(PINHOLE, own).items())
        + f'lens = {{ model = "brown-conrady", k1 = {d[0]}, k2 = {d[1]}, p1 = {d[2]}, p2 = {d[3]} }}\n'
        for side, (own, d) in OWN.items()
    ]
    path.write_text("".join(sides) + f"[right_from_left]\ntranslation = {T.tolist()}\nrotation = {R.tolist()}\n")
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "rig.toml": toml,
    "kalibr": kalibr,
    "openvins": openvins,
    "opencv yml": opencv_yml,
    "opencv xml": lambda folder: opencv_yml(folder, "xml"),
    "opencv json": lambda folder: opencv_yml(folder, "json"),
    "opencv two files": opencv_two_files,
    "opencv rectified": opencv_rectified,
    "opencv of zed": opencv_zed,
    "ros": ros,
    "basalt": basalt,
    "zed": zed,
    "depthai": depthai,
    "realsense": realsense,
    "colmap rig_config": rig_config,
    "colmap rig_config with cameras.txt": rig_config_and_cameras,
    "colmap text": colmap,
    "euroc": euroc,
}
