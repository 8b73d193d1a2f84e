"""KITTI's layout: rectified pairs, the left camera's disparity, calibration and poses.

Of the odometry benchmark: image_2 (left), image_3 (right), calib.txt, times.txt, poses (3 x 4
``world_from_camera`` of the left camera, the first being the identity). Of the stereo benchmark: disp_occ_0, a
PNG of 16 bits, disparity times 256, 0 where it is not known. Pixels are ours: (0, 0) is the centre of the first
one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.rig import SIDES
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import (
    Images,
    View,
    about_moving_objects,
    copy_image,
    first_pose,
    first_second,
    matrix,
    number,
    numbers,
    refuse,
    world_from_camera,
    write_lines,
)
from rsbench.storage.files import write_png16

ABOUT = (
    "sequences/SEQUENCE holds image_2 (left), image_3 (right), disp_occ_0 (of the left camera, what the "
    "right one cannot see included), calib.txt and times.txt; poses/SEQUENCE.txt the poses of the left "
    "camera, relative to its first one. Disparities are rounded to 1/256 px; 0 is unknown."
)
_SCALE, _MOST = 256.0, 65535
_NAME = "kitti"
_ONE_POSE = "the images are rolling-shutter frames: poses are those of the line that is read first"


def check(sequence: Sequence, images: Images) -> None:
    """Raises RsbenchError for pairs that are not rectified: seen through a lens, or at two times."""
    if sequence.rig.camera.lens is not None:
        refuse(
            sequence, _NAME, "its images are rectified, these are seen through a lens", "choose other sequences"
        )
    if images == "gs" and sequence.shutter.right_delay:
        refuse(sequence, _NAME, "the right camera is late, so a pair is of two times", "choose other sequences")
    if images == "rs" and not sequence.shutter.rows_together:
        refuse(sequence, _NAME, "the cameras do not read each row at one time", "take --images gs")


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence below ``root``; what has to be said of them."""
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
    write_lines(folder / "calib.txt", _calibration(sequence))
    write_lines(folder / "times.txt", [number(first_second(sequence, view)) for view in lefts])
    start = matrix(first_pose(sequence, lefts[0]))
    places = [start @ world_from_camera(first_pose(sequence, view)) for view in lefts]
    (root / "poses").mkdir(exist_ok=True)
    write_lines(root / "poses" / f"{sequence.name}.txt", [numbers(place[:3]) for place in places])
    told = [_ONE_POSE] if images == "rs" else []
    told += [f"{lost} disparities are too small or too large for the format, and unknown there"] if lost else []
    return {"told": told + about_moving_objects(sequence)}


def disparity_values(disparity: FloatArray) -> tuple[NDArray[np.uint16], int]:
    """What the PNG holds of disparities (H, W) px, NaN where there is none; and how many it cannot hold."""
    scaled = np.round(_SCALE * np.nan_to_num(disparity, nan=0.0))
    held = (scaled >= 1.0) & (scaled <= _MOST)
    beyond = np.count_nonzero(np.isfinite(disparity) & ~held)
    return np.where(held, scaled, 0.0).astype(np.uint16), int(beyond)


def _calibration(sequence: Sequence) -> list[str]:
    """P0 to P3 (3 x 4) from the frame of the left camera; the grey cameras 0 and 1 stand where 2 and 3 do."""
    left = np.concatenate([sequence.rig.camera.K, np.zeros((3, 1))], axis=1)
    right = left.copy()
    right[0, 3] = -sequence.rig.camera.fx * sequence.rig.baseline
    return [f"P{k}: {numbers(right if k % 2 else left)}" for k in range(4)]
