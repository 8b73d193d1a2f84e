"""KITTI's folders and Kalibr's calibration files.

KITTI's odometry benchmark: image_2 (left), image_3 (right), calib.txt, times.txt, poses (3 x 4
``world_from_camera`` of the left camera, the first being the identity); its stereo benchmark: disp_occ_0, a PNG of
16 bits, disparity times 256, 0 where unknown.

Kalibr's camchain.yaml and imu.yaml have the fields of ``kalibr_common/ConfigReader.py``; ``line_delay`` (s) is
a result of its rolling-shutter calibration. ``T_cn_cnm1`` is the transform from the previous camera.

Both have our pixel convention: (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import LensModel, PinholeCamera
from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.dataset.clock_channels import Imu
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.sequence_views import (
    Format,
    Images,
    Note,
    View,
    about_moving_objects,
    copy_image,
    first_pose,
    first_second,
    lens_fault,
    line_delay,
    matrix,
    number,
    numbers,
    one_by_one,
    projections,
    reads_from_top,
    world_from_camera,
    write_lines,
)
from rsbench.storage.files import write_bytes, write_png16

_KITTI_ABOUT = (
    "sequences/SEQUENCE holds image_2 (left), image_3 (right), disp_occ_0 (of the left camera, what the "
    "right one cannot see included), calib.txt and times.txt; poses/SEQUENCE.txt the poses of the left "
    "camera, relative to its first one. Disparities are rounded to 1/256 px; 0 is unknown."
)
_SCALE, _LARGEST = 256.0, 65535
_ONE_POSE = "the images are rolling-shutter frames: poses are those of the line that is read first"


def _kitti_fault(sequence: Sequence, images: Images) -> str:
    if not sequence.rig.rectified:
        return (
            "its pairs are rectified, and these cameras have lenses, differ, or look in two directions; "
            "rsbench correct --rectify writes rectified pairs"
        )
    if images == "gs" and sequence.shutter.right_delay:
        return "the right camera is late, so a pair is of two times; choose other sequences"
    if images == "rs" and not sequence.shutter.rows_together:
        return "the cameras do not read each row at one time; take --images gs"
    return ""


def _write_kitti(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / "sequences" / sequence.name
    lefts = [View("left", frame) for frame in range(sequence.frames)]
    (folder / "disp_occ_0").mkdir(parents=True)
    lost = 0
    for view in lefts:
        depth = sequence.depth(images, "left", view.frame)
        values, beyond = disparity_values(sequence.rig.disparity(depth))
        lost += beyond
        write_png16(folder / "disp_occ_0" / f"{view.frame:06d}.png", values)
        for number_, side in zip((2, 3), SIDES, strict=True):
            path = folder / f"image_{number_}" / f"{view.frame:06d}.png"
            copy_image(sequence, View(side, view.frame), images, path)
    write_lines(folder / "calib.txt", _kitti_calibration(sequence))
    write_lines(folder / "times.txt", [number(first_second(sequence, view)) for view in lefts])
    start = matrix(first_pose(sequence, lefts[0]))
    places = [start @ world_from_camera(first_pose(sequence, view)) for view in lefts]
    (root / "poses").mkdir(exist_ok=True)
    write_lines(root / "poses" / f"{sequence.name}.txt", [numbers(place[:3]) for place in places])
    sentences = [_ONE_POSE] if images == "rs" else []
    if lost:
        sentences.append(f"{lost} disparities are too small or too large for the format, and unknown there")
    return sentences + about_moving_objects(sequence), {}


def disparity_values(disparity: FloatArray) -> tuple[NDArray[np.uint16], int]:
    """Return PNG values of disparities (H, W) px, NaN where unknown, and how many cannot be represented."""
    scaled = np.round(_SCALE * np.nan_to_num(disparity, nan=0.0))
    representable = (scaled >= 1.0) & (scaled <= _LARGEST)
    beyond = np.count_nonzero(np.isfinite(disparity) & ~representable)
    return np.where(representable, scaled, 0.0).astype(np.uint16), int(beyond)


def _kitti_calibration(sequence: Sequence) -> list[str]:
    """Return P0 to P3 (3 x 4) in the left camera's axes; the grey cameras 0 and 1 are equal to 2 and 3."""
    both = projections(sequence.rig.camera, sequence.rig.baseline)
    return [f"P{k}: {numbers(both[k % 2])}" for k in range(4)]


_KALIBR_ABOUT = (
    "SEQUENCE/camchain.yaml: cam0 is the left camera, cam1 the right one; imu.yaml where the sequence has "
    "an IMU. A frame's stamp is the time of its row 0, line_delay the seconds from each row to the next."
)


def _kalibr_fault(sequence: Sequence, images: Images) -> str:
    if not reads_from_top(sequence):
        return "its line delay is of rows that are read from the top; choose other sequences"
    lenses = [sequence.rig.sensor(side).lens for side in SIDES]
    if any(lens is not None and lens.model == "brown-conrady" and lens.k3 != 0.0 for lens in lenses):
        return "its lens radtan has k1, k2, p1, p2 but no k3; choose other sequences"
    return lens_fault(sequence.rig, *KALIBR_LENSES)


KALIBR_LENSES: Mapping[LensModel, tuple[str, str]] = {
    "brown-conrady": ("pinhole", "radtan"),
    "kannala-brandt": ("pinhole", "equidistant"),
    "double-sphere": ("ds", "none"),
}
"""Kalibr's camera model and distortion model; the two numbers of a double sphere precede the intrinsics."""


def _write_kalibr(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / sequence.name
    folder.mkdir(parents=True)
    write_chain(folder / "camchain.yaml", [_kalibr_camera(sequence, side) for side in SIDES])
    sentences = list[str]()
    if delay := sequence.shutter.right_delay * sequence.frame_period_s:
        sentences.append(
            f"camera chains have no delay of a camera: stamps of cam1 are {number(delay)} s after those of cam0"
        )
    if sequence.imu is not None:
        write_bytes(folder / "imu.yaml", _yaml_imu(sequence.imu).encode())
        if sequence.imu.clock_drift:
            sentences.append(
                f"the IMU's clock drifts by {number(sequence.imu.clock_drift)}, for which there is no field"
            )
    return sentences, {}


def _kalibr_camera(sequence: Sequence, side: Side) -> list[str]:
    rig = sequence.rig
    lines = kalibr_camera(rig.sensor(side), side, line_delay(sequence, side))
    if side == "right":
        lines += yaml_transform("T_cn_cnm1", rig.right_from_left)
    if sequence.imu is not None:
        lines += yaml_transform("T_cam_imu", Pose(rig.own(side).R, rig.own(side).R @ rig.offset(side)))
        lines.append(f"timeshift_cam_imu: {number(sequence.imu.time_offset_s)}")
    return lines


def write_chain(path: Path, cameras: Iterable[list[str]]) -> None:
    """Write a camera chain from the lines of each camera."""
    lines = [line for k, own in enumerate(cameras) for line in (f"cam{k}:", *(f"  {each}" for each in own))]
    write_lines(path, lines)


def kalibr_camera(camera: PinholeCamera, side: Side, line_delay_s: float | None) -> list[str]:
    """Return the lines of a camera in camchain.yaml; its lens must be one of ``KALIBR_LENSES``."""
    lens = camera.lens
    model, distortion = ("pinhole", "none") if lens is None else KALIBR_LENSES[lens.model]
    coefficients = () if lens is None else lens.coefficients[:4]
    before, after = (coefficients, ()) if model == "ds" else ((), coefficients)
    lines = [
        f"camera_model: {model}",
        f"intrinsics: {_yaml_list([*before, camera.fx, camera.fy, camera.cx, camera.cy])}",
        f"distortion_model: {distortion}",
        f"distortion_coeffs: {_yaml_list([*after])}",
        f"resolution: [{camera.width}, {camera.height}]",
        f"rostopic: /{side}/image_raw",
    ]
    return lines if line_delay_s is None else [*lines, f"line_delay: {number(line_delay_s)}"]


def yaml_transform(name: str, pose: Pose) -> list[str]:
    """Return the lines of a matrix (4, 4)."""
    return [f"{name}:", *(f"- {_yaml_list(row)}" for row in matrix(pose).tolist())]


def _yaml_list(values: list[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def _yaml_imu(imu: Imu) -> str:
    fields = {
        "rostopic": "/imu",
        "update_rate": number(imu.rate_hz),
        "accelerometer_noise_density": number(imu.accelerometer_noise_density),
        "accelerometer_random_walk": number(imu.accelerometer_random_walk),
        "gyroscope_noise_density": number(imu.gyroscope_noise_density),
        "gyroscope_random_walk": number(imu.gyroscope_random_walk),
    }
    return "".join(f"{name}: {value}\n" for name, value in fields.items())


KITTI = Format(_KITTI_ABOUT, ("gs", "rs"), one_by_one(_write_kitti), fault=_kitti_fault)
KALIBR = Format(_KALIBR_ABOUT, (), one_by_one(_write_kalibr), fault=_kalibr_fault)
