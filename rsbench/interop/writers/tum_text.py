"""Trajectories in the format of the TUM RGB-D benchmark, as evo reads it: of frames, and of every line of them.

Format: ``timestamp tx ty tz qx qy qz qw``, seconds and metres, ``world_from_camera``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import Images, numbers, write_lines

ABOUT = (
    "SEQUENCE/left.txt and right.txt have the pose of each frame at the time of the line that is read "
    "first, left_rows.txt and right_rows.txt that of every line at its own time, body.txt that of the "
    "middle of the rig. Seconds count from the first line of the left camera's frame 0; the world is the "
    "body then, camera axes are x right, y down, z forward."
)
_HEADER = "# timestamp tx ty tz qx qy qz qw"


def check(sequence: Sequence, images: Images) -> None:
    """A trajectory holds every pose of a rig, whatever its cameras are."""


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in a folder of its name below ``root``; what has to be said of them."""
    folder = root / sequence.name
    folder.mkdir(parents=True)
    shutter, motion, rig = sequence.shutter, sequence.motion, sequence.rig
    frames = np.arange(sequence.frames, dtype=np.float64)
    _write(folder / "body.txt", sequence.frame_period_s * frames, motion.body_from_world(frames))
    told = list[str]()
    for side in SIDES:
        starts = shutter.start(frames, side)
        _write(folder / f"{side}.txt", sequence.frame_period_s * starts, rig.cam_from_world(motion, starts, side))
        times = line_times(sequence, side)
        if times is None:
            told = ["all lines are read at once: there is no trajectory of lines"]
        else:
            poses = rig.cam_from_world(motion, times, side)
            _write(folder / f"{side}_rows.txt", sequence.frame_period_s * times, poses)
    return {"told": told}


def line_times(sequence: Sequence, side: Side) -> FloatArray | None:
    """Times (n) of all lines of all frames in the order of time, frame periods; None of a global shutter."""
    if sequence.shutter.readout_ratio == 0.0:
        return None
    frames = range(sequence.frames)
    return np.sort(np.concatenate([sequence.shutter.line_times(frame, side) for frame in frames]))


def _write(path: Path, seconds: FloatArray, cam_from_world: Pose) -> None:
    R, t = inverse(cam_from_world)
    quaternions = so3.quaternion(R)[:, [1, 2, 3, 0]]
    table = np.concatenate([seconds[:, None], t, quaternions], axis=1)
    write_lines(path, [_HEADER, *map(numbers, table)])
