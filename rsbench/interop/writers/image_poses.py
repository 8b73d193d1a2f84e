"""What exports share: poses of images, the pixels of others, and files that are taken as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side
from rsbench.core.se3 import Pose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import inside, read_bytes

Images = Literal["rs", "gs"]
"""Rolling-shutter frames, or their global-shutter twins from the pose of the line that is read first."""
CORNER_PX = 0.5
"""Added to pixels where a format has the corner of the image at (0, 0); ours has the centre of a pixel there."""


class View(NamedTuple):
    """One image of a sequence."""

    side: Side
    frame: int

    @property
    def name(self) -> str:
        return f"{self.side}_{self.frame:04d}.png"


def views_in_time(sequence: Sequence) -> list[View]:
    """Left 0, right 0, left 1, and so on."""
    return [View(side, frame) for frame in range(sequence.frames) for side in SIDES]


def first_pose(sequence: Sequence, view: View) -> Pose:
    """``cam_from_world`` (3, 3), (3,) of the line that is read first: that of the global-shutter twin."""
    start = sequence.shutter.start(view.frame, view.side)
    return sequence.rig.cam_from_world(sequence.motion, start, view.side)


def line_poses(sequence: Sequence, view: View) -> Pose:
    """``cam_from_world`` (lines, 3, 3), (lines, 3) in the order of the image."""
    return row_poses(sequence.rig, sequence.shutter, sequence.motion, view.side, view.frame)


def first_second(sequence: Sequence, view: View) -> float:
    """When the line that is read first is read, s; 0 is row 0 of frame 0."""
    return sequence.frame_period_s * float(sequence.shutter.start(view.frame, view.side))


def camera_velocity(sequence: Sequence, side: Side, tau: float) -> tuple[FloatArray, FloatArray]:
    """Linear and angular velocity (3,) of a camera in its own axes, m/s and rad/s, at a time in frame periods.

    A point of the world is at x = R X + t in the camera and R' = [w]x R, so it moves by w x (x - t) + t', which is
    -(v + a x x) of a camera that moves by v and turns by a: a = -w, v = w x t - t'.
    """
    w, rate = sequence.motion.velocity(tau)
    t = sequence.rig.cam_from_world(sequence.motion, tau, side).t
    return (so3.cross(w, t) - rate) / sequence.frame_period_s, -w / sequence.frame_period_s


def matrix(pose: Pose) -> FloatArray:
    """Homogeneous (..., 4, 4) of a transform."""
    out = np.zeros((*pose.t.shape[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = pose.R, pose.t, 1.0
    return out


def world_from_camera(pose: Pose) -> FloatArray:
    """Homogeneous (..., 4, 4) of the inverse of ``cam_from_world``."""
    return matrix(inverse(pose))


def corner_matrix(camera: PinholeCamera) -> FloatArray:
    """Calibration matrix (3, 3), lens apart, of pixels whose (0, 0) is the corner of the image."""
    K = camera.ideal.K
    K[:2, 2] += CORNER_PX
    return K


def copy_image(sequence: Sequence, view: View, images: Images, path: Path) -> None:
    """The PNG of a view, byte for byte."""
    source = inside(sequence.folder, picture_file(images, view.side, view.frame + sequence.first))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, read_bytes(source))


def number(value: float) -> str:
    """A decimal number that reads back as it was, with a point: YAML 1.1 takes 1e-05 for a word."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def numbers(values: object) -> str:
    """Decimal numbers with blanks between, row by row."""
    return " ".join(number(value) for value in np.ravel(np.asarray(values, dtype=np.float64)))


def write_lines(path: Path, lines: list[str]) -> None:
    """Text in UTF-8, each line with its end."""
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def refuse(sequence: Sequence, format_name: str, what: str, remedy: str) -> None:
    """One line that names what a format cannot hold.

    Raises:
        RsbenchError: always.
    """
    raise RsbenchError(f"--to {format_name}: sequence {sequence.name}: {what}; {remedy}")


def about_moving_objects(sequence: Sequence) -> list[str]:
    """What has to be said of objects that move, where a format knows a still world alone."""
    if not sequence.moving:
        return []
    count = len(sequence.moving)
    return [f"{count} object{'s' if count > 1 else ''} move in the images; the format knows a still world alone"]
