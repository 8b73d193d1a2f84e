"""Writers of calibrations for other tools; ``rsbench.interop.readers.calibrations`` has the conventions."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.calibration_parts import Calibration, Table, camera_of
from rsbench.interop.writers.colmap_and_tum import camera_line
from rsbench.interop.writers.kitti_and_kalibr import KALIBR_LENSES, kalibr_camera, write_chain, yaml_transform
from rsbench.interop.writers.sequence_views import number, projections
from rsbench.storage.files import write_bytes


def write_calibration(found: Calibration, kind: str, out: Path) -> list[Path]:
    """Write a calibration as one of ``WRITERS``; returns the files.

    Raises:
        RsbenchError: image sizes are unknown, or the format does not support a lens.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    return WRITERS[kind](found, out)


def cameras_of(found: Calibration) -> dict[Side, PinholeCamera]:
    """Return the cameras by side; RsbenchError if an image size is unknown."""
    made = dict[Side, PinholeCamera]()
    for side, table in found.cameras.items():
        if "width" not in table:
            raise RsbenchError(
                f"{side}: the size of the images is not known: give --size, such as --size 1280x720"
            )
        made[side] = camera_of(table, side)
    return made


def rig_of(found: Calibration) -> StereoRig | None:
    """Return the rig; None for a single camera."""
    if found.right_from_left is None:
        return None
    cameras = cameras_of(found)
    with naming("right_from_left"):
        return StereoRig.of_cameras(cameras["left"], cameras["right"], *found.right_from_left)


# rig.toml


def _write_toml(found: Calibration, out: Path) -> list[Path]:
    write_bytes(out, toml_of(found).encode())
    return [out]


def toml_of(found: Calibration) -> str:
    """Return the text of rig.toml, or of camera.toml for one camera."""
    top, tables = dict(found.readout), found.tables()
    period = top.get("frame_period_s")
    lines = [f"# {found.format}: {', '.join(path.name for path in found.files)}"] if found.files else []
    lines += [f"# {note}" for note in found.notes]
    if found.right is not None and found.right_delay_s and period:
        top["right_delay"] = found.right_delay_s / period
    lines += [f"{key} = {_toml(value)}" for key, value in top.items()]
    delays: dict[str, Any] = {side: own.get("line_delay_s") for side, own in found.cameras.items()}
    for name, table in tables.items():
        delay = delays.get(name)
        if delay is not None and found.right is not None:
            table |= {"line_delay_s": delay} if period else {"readout_ratio": 0.0} if delay == 0.0 else {}
        lines += ["", f"[{'camera' if found.right is None else name}]"]
        if found.right is None:  # the card of one camera takes the size from the frames
            table = {key: value for key, value in table.items() if key not in ("width", "height")}
        lines += [f"{key} = {_toml(value)}" for key, value in table.items()]
        if delay and not period:
            lines.append(f"# line_delay_s = {delay!r}, with frame_period_s above the tables")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        shown = {key: each for key, each in value.items() if each != 0.0}
        return f"{{ {', '.join(f'{key} = {_toml(each)}' for key, each in shown.items())} }}"
    return json.dumps(value)


# Kalibr


def _write_kalibr(found: Calibration, out: Path) -> list[Path]:
    chain = list[list[str]]()
    for k, (side, camera) in enumerate(cameras_of(found).items()):
        lens = camera.lens
        if lens is not None and (lens.model not in KALIBR_LENSES or any(lens.coefficients[4:])):
            raise RsbenchError(f"{side}: Kalibr has no place for {_name(camera)}: its radtan has k1, k2, p1, p2")
        lines = kalibr_camera(camera, side, _line_delay(found, side, camera))
        if found.right_delay_s:
            lines.append(f"timeshift_cam_imu: {found.right_delay_s if k else 0.0!r}")
        if k == 1:
            assert found.right_from_left is not None
            lines += yaml_transform("T_cn_cnm1", Pose(*found.right_from_left))
        chain.append(lines)
    write_chain(out, chain)
    return [out]


def _line_delay(found: Calibration, side: Side, camera: PinholeCamera) -> float | None:
    """Return the time between successive rows, seconds; None if unknown."""
    own = found.cameras[side].get("line_delay_s")
    if own is not None:
        return float(own)
    top = found.readout
    ratio = top.get("readout_ratio")
    if side == "right":
        ratio = top.get("right_readout_ratio", ratio)
    if ratio == 0.0:
        return 0.0
    downwards = {top.get("scan", "top"), top.get("right_scan", "top")} == {"top"}
    known = ratio is not None and "frame_period_s" in top and downwards
    return ratio * top["frame_period_s"] / camera.height if known else None


def _name(camera: PinholeCamera) -> str:
    return "no lens" if camera.lens is None else f"the lens {camera.lens.model} {list(camera.lens.coefficients)}"


# OpenCV


def opencv_distortion(camera: PinholeCamera, side: str) -> FloatArray:
    """Return OpenCV's distortion vector (1, n); RsbenchError if OpenCV does not support the lens."""
    if camera.lens is None:
        return np.zeros((1, 5))
    if camera.lens.model == "double-sphere":
        raise RsbenchError(f"{side}: OpenCV and ROS have no double-sphere lens; keep Kalibr's file or rig.toml")
    return np.array([camera.lens.coefficients])


def _write_opencv(found: Calibration, out: Path) -> list[Path]:
    cameras, rig = cameras_of(found), rig_of(found)
    values = dict[str, Any]()
    sizes = {(camera.width, camera.height) for camera in cameras.values()}
    fisheye = {camera.lens is not None and camera.lens.model == "kannala-brandt" for camera in cameras.values()}
    if len(fisheye) > 1:
        raise RsbenchError("OpenCV: one camera is a fisheye and the other is not, which its functions do not take")
    for k, (side, camera) in enumerate(cameras.items(), start=1):
        values |= {f"M{k}": camera.ideal.K, f"D{k}": opencv_distortion(camera, side)}
        if len(sizes) > 1:
            values[f"imageSize{k}"] = np.array([[camera.width, camera.height]], dtype=np.int32)
    if len(sizes) == 1:
        values["imageSize"] = np.array([sizes.pop()], dtype=np.int32)
    if fisheye == {True}:
        values["fisheye"] = 1
    if rig is not None and found.right_from_left is not None:
        values |= {"R": found.right_from_left.R, "T": found.right_from_left.t[:, None], **rectifying(rig)}
    storage = cv2.FileStorage(str(out), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise RsbenchError(f"{out}: cannot be written by OpenCV; its name must end in .yml, .yaml, .xml or .json")
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return [out]


def rectifying(rig: StereoRig) -> dict[str, FloatArray]:
    """Return R1, R2, P1, P2 of the rig's rectified frame, as in ``cv2.stereoRectify``."""
    P1, P2 = projections(rig.camera.ideal, rig.baseline)
    return {"R1": rig.own("left").R.T, "R2": rig.own("right").R.T, "P1": P1, "P2": P2}


# ROS


def _write_ros(found: Calibration, out: Path) -> list[Path]:
    cameras, rig, files = cameras_of(found), rig_of(found), list[Path]()
    if out.suffix:
        raise RsbenchError(f"{out}: camera_info is a file for each camera: give a folder")
    out.mkdir(parents=True, exist_ok=True)
    for k, (side, camera) in enumerate(cameras.items(), start=1):
        model = "plumb_bob" if camera.lens is None else _ROS_MODELS.get(camera.lens.model, "")
        rectified = rectifying(rig) if rig is not None else {}
        blocks = {
            "camera_matrix": camera.ideal.K,
            "distortion_coefficients": opencv_distortion(camera, side),
            "rectification_matrix": rectified.get(f"R{k}", np.eye(3)),
            "projection_matrix": rectified.get(f"P{k}", np.column_stack([camera.ideal.K, np.zeros(3)])),
        }
        text = f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {side}\n"
        text += f"distortion_model: {model}\n"
        for name, block in blocks.items():
            rows, cols = block.shape
            data = ", ".join(number(value) for value in block.ravel().tolist())
            text += f"{name}:\n  rows: {rows}\n  cols: {cols}\n  data: [{data}]\n"
        files.append(out / f"{side}.yaml")
        write_bytes(files[-1], text.encode())
    return files


_ROS_MODELS = {"brown-conrady": "plumb_bob", "rational": "rational_polynomial", "kannala-brandt": "equidistant"}


# COLMAP


def _write_colmap(found: Calibration, out: Path) -> list[Path]:
    cameras, listed = cameras_of(found), list[Table]()
    if found.right_from_left is None:
        raise RsbenchError("COLMAP: a rig_config.json is of two cameras; this calibration has one")
    for side, camera in cameras.items():
        if camera.lens is not None and camera.lens.model == "double-sphere":
            raise RsbenchError(f"{side}: COLMAP has no double-sphere lens; keep Kalibr's file or rig.toml")
        _, model, _, _, *params = camera_line(1, camera).split()
        listed.append(
            {
                "image_prefix": f"{side}/",
                "camera_model_name": model,
                "camera_params": [float(each) for each in params],
            }
        )
    R, t = found.right_from_left
    listed[0]["ref_sensor"] = True
    listed[1] |= {"cam_from_rig_rotation": so3.quaternion(R).tolist(), "cam_from_rig_translation": t.tolist()}
    write_bytes(out, (json.dumps([{"cameras": listed}], indent=2) + "\n").encode())
    return [out]


WRITERS: Mapping[str, Callable[[Calibration, Path], list[Path]]] = {
    "rig.toml": _write_toml,
    "kalibr": _write_kalibr,
    "opencv": _write_opencv,
    "ros": _write_ros,
    "colmap": _write_colmap,
}
