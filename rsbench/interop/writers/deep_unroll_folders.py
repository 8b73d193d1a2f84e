"""The layouts of Carla-RS and Fastec-RS (Liu, Cui, Larsson, Pollefeys, Deep Shutter Unrolling Network, CVPR 2020).

Carla-RS, as written by its generator (ethliup/UnrealCV, ``capture_rolling_shutter.py``): each camera has a folder
with its frames and gt_vel.log, which has its velocities wx wy wz x y z in its own axes at the first row, rad/s and
m/s. A row that is read t seconds later has the pose ``camera_0 from camera_t`` = (exp(w t), v t). The loader of
DeepUnrollNet negates the velocities. Depth is stored as text, as the distance along the ray, not as z.

Fastec-RS: frames and their truth, without calibration, depth or motion, as the loader of DeepUnrollNet
(``dataset_fastec_rs.py``) expects them.
"""

from __future__ import annotations

import io
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import SIDES, Side, views_of
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import SHUTTERS, picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.sequence_views import (
    CORNER_PX,
    Format,
    Images,
    Note,
    Points,
    View,
    about_moving_objects,
    camera_velocity,
    compare_rows,
    copy_file,
    first_pose,
    lens_fault,
    number,
    numbers,
    one_by_one,
    reads_from_top,
    seen_by,
    write_lines,
)
from rsbench.storage.files import write_bytes

_CARLA_ABOUT = (
    "SEQUENCE/seq_left and seq_right, each with NNNN_rs.png, NNNN_gs_f.png (the twin of the first row), "
    "NNNN_gs_m.png (of row height // 2, where the dataset has that twin), NNNN_rs.depth and NNNN_gs_f.depth"
    " (text, metres along the ray, 0 = no surface) and gt_vel.log (rad/s and m/s of the camera in its own "
    "axes at its first row); SEQUENCE/rs_calib.txt and intrinsics.txt, whose pixels have (0, 0) in the "
    "corner of the image. The loader of DeepUnrollNet takes .png with img_ext, and negates the velocities. "
    "There are no masks and no flow."
)
_CARLA_LAW = "constant velocities from the first row of the first frame on"
_LOADED = 10


def _carla_fault(sequence: Sequence, images: Images) -> str:
    if fault := lens_fault(sequence.rig):
        return fault
    left, right = (sequence.rig.sensor(side) for side in SIDES)
    ratios = {sequence.shutter.ratio_of(side) for side in SIDES}
    if (left.width, left.height) != (right.width, right.height) or len(ratios) > 1:
        return "its cameras have one size and one readout; choose other sequences"
    return "" if reads_from_top(sequence) else "its rows are read from the top; choose other sequences"


def _write_carla(sequence: Sequence, root: Path, images: Images) -> Note:
    folder = root / sequence.name
    for side in SIDES:
        place = folder / f"seq_{side}"
        place.mkdir(parents=True)
        velocity = numbers(np.concatenate(first_velocity(sequence, side)))
        write_lines(
            place / "gt_vel.log", ["# Ground truth velocity in camera frame", "# wx, wy, wz, x, y, z", velocity]
        )
    views = [View(*view) for view in views_of(sequence.frames)]
    for view in views:
        _write_carla_frame(sequence, view, folder / f"seq_{view.side}")
    _write_carla_calibration(sequence, folder)
    sentences, record = compare_rows(sequence, views, partial(_carla_pixels, sequence), _CARLA_LAW)
    if sequence.frames > _LOADED:
        sentences.append(f"the loader of DeepUnrollNet takes the first {_LOADED} of {sequence.frames} frames")
    if sequence.shutter.right_delay:
        sentences.append("the two cameras are sequences of their own: the delay of the right one is not written")
    return sentences + about_moving_objects(sequence), record


def first_velocity(sequence: Sequence, side: Side) -> tuple[FloatArray, FloatArray]:
    """Return angular and linear velocity (3,) of a camera, in its axes at frame 0's first row, rad/s and m/s."""
    linear, angular = camera_velocity(sequence, side, float(sequence.shutter.start(0, side)))
    return angular, linear


def _write_carla_frame(sequence: Sequence, view: View, place: Path) -> None:
    camera = sequence.rig.sensor(view.side)
    _copy_pictures(sequence, view, f"{place}/{view.frame:04d}", ("rs", "gs_f", "gs_m"))
    for name, shutter in zip(("rs", "gs_f"), SHUTTERS, strict=True):
        depth = sequence.depth(shutter, view.side, view.frame)
        write_bytes(place / f"{view.frame:04d}_{name}.depth", _depth_text(radial(camera, depth)))


def _copy_pictures(sequence: Sequence, view: View, stem: str, names: tuple[str, str, str]) -> None:
    """Copy a frame and its twins of the first and, if the dataset has it, the middle row to STEM_NAME.png."""
    side, frame, middle = view.side, view.frame, sequence.shutter.lines(view.side) // 2
    files = [picture_file("rs", side, frame), picture_file("gs", side, frame)]
    if middle in sequence.twins:
        files.append(picture_file("gs", side, frame, middle))
    for name, file in zip(names, files, strict=False):
        copy_file(sequence.folder, file, Path(f"{stem}_{name}.png"))


def radial(camera: PinholeCamera, depth: NDArray[np.float32]) -> FloatArray:
    """Convert depths z (H, W) to distances (H, W) along the rays."""
    return depth * np.linalg.norm(camera.unproject(camera.pixel_grid()), axis=-1)


def _depth_text(values: FloatArray) -> bytes:
    """Format depth with ``np.savetxt`` and nine digits, which represent a float32 exactly."""
    stream = io.StringIO()
    np.savetxt(stream, values, fmt="%.9g")
    return stream.getvalue().encode()


def _write_carla_calibration(sequence: Sequence, folder: Path) -> None:
    camera, shutter = sequence.rig.sensor("left"), sequence.shutter
    delay_ms = 1e3 * shutter.readout_ratio * sequence.frame_period_s / shutter.lines("left")
    rows = ["#Rolling shutter camera intrinsic parameters", f"FPS: {number(1.0 / sequence.frame_period_s)}"]
    rows += [f"ROW_READOUT_TIME(ms): {number(delay_ms)}", f"RESOLUTION_H: {camera.height}"]
    write_lines(folder / "rs_calib.txt", [*rows, f"RESOLUTION_W: {camera.width}"])
    lines = ["# Camera intrinsic parameters", "", "numCameras 2", ""]
    for k, side in enumerate(SIDES):
        camera = sequence.rig.sensor(side)
        values = numbers([camera.fx, camera.fy, camera.cx + CORNER_PX, camera.cy + CORNER_PX])
        lines += [f"devName cam{k}", "# resolution: nCols, nRows", f"resolution {camera.width} {camera.height}"]
        lines += ["# K: fx fy cx cy with pinhole camera model", f"K {values}", ""]
    write_lines(folder / "intrinsics.txt", lines)


def _carla_pixels(sequence: Sequence, view: View, points: Points) -> FloatArray:
    """Project points to pixels (n, 2) with the motion model of Carla-RS."""
    w, v = first_velocity(sequence, view.side)
    shutter = sequence.shutter
    tau = shutter.line_time(points.pixels[:, 1], view.frame, view.side) - shutter.start(0, view.side)
    seconds = (sequence.frame_period_s * tau)[:, None]
    moved = inverse(Pose(so3.exp(seconds * w), seconds * v))
    start = first_pose(sequence, View(view.side, 0))
    return seen_by(sequence, view.side, compose(moved, start), points.world)


_FASTEC_ABOUT = (
    "SEQUENCE_left and SEQUENCE_right, each with NNN_rolling.png, NNN_global_first.png (the twin of the first "
    "row), NNN_global_middle.png (of row height // 2, where the dataset has that twin) and meta.log, by which "
    "the loader knows the folder of a sequence. There is no calibration, depth or motion: a readout ratio of 1 "
    "is what those who use the layout assume."
)
_META = "meta.log"
"""File by whose presence the loader recognises the folder of a sequence; its content is not read."""
_MOST = 1000
"""Largest number of frames, as frame numbers have three digits."""


def _fastec_fault(sequence: Sequence, images: Images) -> str:
    if not reads_from_top(sequence):
        return "its rows are read from the top; choose other sequences"
    many = sequence.frames > _MOST
    return f"its frames have three digits, {sequence.frames} are more; choose other sequences" if many else ""


def _write_fastec(sequence: Sequence, root: Path, images: Images) -> Note:
    shutter, sentences = sequence.shutter, list[str]()
    for side in SIDES:
        middle, ratio = shutter.lines(side) // 2, shutter.ratio_of(side)
        place = root / f"{sequence.name}_{side}"
        place.mkdir(parents=True)
        write_lines(place / _META, [f"# {sequence.name}, {side} camera: readout ratio {ratio:g}"])
        for frame in range(sequence.frames):
            names = ("rolling", "global_first", "global_middle")
            _copy_pictures(sequence, View(side, frame), f"{place}/{frame:03d}", names)
        if middle not in sequence.twins:
            sentences.append(
                f"there is no twin of row {middle}, so no NNN_global_middle.png, which training reads"
            )
        if ratio != 1.0:
            sentences.append(f"the readout ratio is {ratio:g}, where those who use the layout assume 1")
    return list(dict.fromkeys(sentences)), {}


CARLA_RS = Format(_CARLA_ABOUT, (), one_by_one(_write_carla), fault=_carla_fault)
FASTEC_RS = Format(_FASTEC_ABOUT, (), one_by_one(_write_fastec), fault=_fastec_fault)
