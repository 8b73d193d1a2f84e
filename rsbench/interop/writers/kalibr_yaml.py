"""Kalibr's camchain.yaml and imu.yaml.

Fields are those of ``kalibr_common/ConfigReader.py``; ``line_delay`` (s) is what its rolling-shutter calibration
writes. Pixels are ours: (0, 0) is the centre of the first one. ``T_cn_cnm1`` leads from the camera before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.imu import Imu
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import Images, matrix, number, refuse
from rsbench.storage.files import write_bytes

ABOUT = (
    "SEQUENCE/camchain.yaml: cam0 is the left camera, cam1 the right one; imu.yaml where the sequence has "
    "an IMU. A frame's stamp is the time of its row 0, line_delay the seconds from each row to the next."
)
_NAME = "kalibr"


def check(sequence: Sequence, images: Images) -> None:
    """Raises RsbenchError for a scan or a lens for which Kalibr has no model."""
    lens = sequence.rig.camera.lens
    if {sequence.shutter.scan_of(side) for side in SIDES} != {"top"}:
        refuse(sequence, _NAME, "its line delay is of rows that are read from the top", "choose other sequences")
    if lens is not None and lens.model == "brown-conrady" and lens.k3 != 0.0:
        refuse(sequence, _NAME, "its lens radtan has k1, k2, p1, p2 but no k3", "choose other sequences")


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in a folder of its name below ``root``; what has to be said of them."""
    folder = root / sequence.name
    folder.mkdir(parents=True)
    blocks = [
        f"cam{k}:\n" + "".join(f"  {line}\n" for line in _camera(sequence, side)) for k, side in enumerate(SIDES)
    ]
    write_bytes(folder / "camchain.yaml", "".join(blocks).encode())
    told = list[str]()
    if delay := sequence.shutter.right_delay * sequence.frame_period_s:
        told.append(
            f"camera chains have no delay of a camera: stamps of cam1 are {number(delay)} s after those of cam0"
        )
    if sequence.imu is not None:
        write_bytes(folder / "imu.yaml", _imu(sequence.imu).encode())
        if sequence.imu.clock_drift:
            told.append(
                f"the IMU's clock drifts by {number(sequence.imu.clock_drift)}, for which there is no field"
            )
    return {"told": told}


def _camera(sequence: Sequence, side: Side) -> list[str]:
    camera, lens, shutter = sequence.rig.camera, sequence.rig.camera.lens, sequence.shutter
    if lens is None:
        model, values = "none", list[float]()
    elif lens.model == "kannala-brandt":
        model, values = "equidistant", [lens.k1, lens.k2, lens.k3, lens.k4]
    else:
        model, values = "radtan", [lens.k1, lens.k2, lens.p1, lens.p2]
    lines = [
        "camera_model: pinhole",
        f"intrinsics: {_list([camera.fx, camera.fy, camera.cx, camera.cy])}",
        f"distortion_model: {model}",
        f"distortion_coeffs: {_list(values)}",
        f"resolution: [{camera.width}, {camera.height}]",
        f"rostopic: /{side}/image_raw",
        f"line_delay: {number(shutter.readout_ratio * sequence.frame_period_s / shutter.lines(side))}",
    ]
    if side == "right":
        lines += _transform("T_cn_cnm1", sequence.rig.offset("right") - sequence.rig.offset("left"))
    if sequence.imu is not None:
        lines += _transform("T_cam_imu", sequence.rig.offset(side))
        lines.append(f"timeshift_cam_imu: {number(sequence.imu.time_offset_s)}")
    return lines


def _transform(name: str, translation: FloatArray) -> list[str]:
    return [f"{name}:", *(f"- {_list(row)}" for row in matrix(Pose(np.eye(3), translation)).tolist())]


def _list(values: list[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def _imu(imu: Imu) -> str:
    fields = {
        "rostopic": "/imu",
        "update_rate": number(imu.rate_hz),
        "accelerometer_noise_density": number(imu.accelerometer_noise_density),
        "accelerometer_random_walk": number(imu.accelerometer_random_walk),
        "gyroscope_noise_density": number(imu.gyroscope_noise_density),
        "gyroscope_random_walk": number(imu.gyroscope_random_walk),
    }
    return "".join(f"{name}: {value}\n" for name, value in fields.items())
