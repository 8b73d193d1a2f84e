"""Row poses against the motion: unit quaternions of the documented sign, at the row times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, views_of
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.storage.files import read_pose_table
from rsbench.verification.findings import Finding, rows_of

_ROUNDING = 1e-12
"""Of row times (frame periods), quaternions and places (metres): a thousand roundings of numbers near 1."""


def pose_faults(sequence: Sequence) -> Iterator[Finding]:
    """Stored row poses that are not the motion at the row times."""
    for side, frame in views_of(sequence.frames):
        file = f"poses/{side}_{frame}.csv"
        try:
            table = read_pose_table(sequence.folder / file)
        except RsbenchError as error:
            yield Finding.of(error)
            continue
        if len(table) != (lines := sequence.shutter.lines(side)):
            yield Finding(file, f"has {len(table)} rows, the camera has {lines}")
        else:
            yield from _table_faults(sequence, file, side, frame, table)


def _table_faults(sequence: Sequence, file: str, side: Side, frame: int, table: FloatArray) -> Iterator[Finding]:
    norm = np.linalg.norm(table[:, 2:6], axis=1)
    zero = norm == 0
    if np.any(zero):
        yield Finding(file, "the quaternion is zero", rows_of(zero))
        return
    unlike_unit = np.abs(norm - 1) > _ROUNDING
    if np.any(unlike_unit):
        worst = norm[np.argmax(np.abs(norm - 1))]
        yield Finding(file, f"quaternion of norm {worst:.9g}, not 1", rows_of(unlike_unit))
    # At w = 0, half a turn, both signs are right.
    negated = table[:, 2] < -_ROUNDING
    if np.any(negated):
        yield Finding(
            file, f"quaternion with w = {table[negated, 2].min():.6g}: w >= 0 is needed", rows_of(negated)
        )
    expected = _table(sequence, side, frame)
    wrong_time, wrong_angle, wrong_place = _differences(table, expected)
    wrong = np.maximum.reduce([wrong_time, wrong_angle, wrong_place]) > _ROUNDING
    if np.any(wrong):
        what = (
            f"differs from the motion by {np.max(wrong_time):.1e} periods, {np.max(wrong_angle):.1e} rad, "
            f"{np.max(wrong_place):.1e} m"
        )
        yield Finding(file, what, rows_of(wrong), _likely(sequence, side, frame, table))


def _table(sequence: Sequence, side: Side, frame: int) -> FloatArray:
    """Row time, rotation matrix and translation (H, 13) that the motion gives."""
    pose = row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame)
    tau = sequence.shutter.line_times(frame, side)
    return np.concatenate([tau[:, None], pose.R.reshape(-1, 9), pose.t], axis=1)


def _differences(table: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each row: time (frame periods), angle (rad) and place (m)."""
    R = so3.from_quaternion(table[:, 2:6])
    angle = so3.angle(R @ np.swapaxes(expected[:, 1:10].reshape(-1, 3, 3), -1, -2))
    place = np.max(np.abs(table[:, 6:9] - expected[:, 10:]), axis=1)
    return np.abs(table[:, 1] - expected[:, 0]), np.abs(angle), place


def _likely(sequence: Sequence, side: Side, frame: int, table: FloatArray) -> str:
    """What the poses are instead, where that is plain."""
    own = _table(sequence, side, frame)
    turned = inverse(row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame))
    back = np.concatenate([own[:, :1], turned.R.reshape(-1, 9), turned.t], axis=1)
    candidates = [("shifted by one row", np.roll(own, rows, axis=0)) for rows in (-1, 1)]
    candidates += [
        (f"the poses of {other}_{number}", _table(sequence, other, number))
        for other, number in views_of(sequence.frames)
        if (other, number) != (side, frame) and sequence.shutter.lines(other) == len(table)
    ]
    candidates.append(("world_from_cam instead of cam_from_world", back))
    return next((f"looks like {words}" for words, each in candidates if _mostly(table, each)), "")


def _mostly(table: FloatArray, expected: FloatArray) -> bool:
    """Whether places and rotations are the expected ones in nearly all rows; times may be those of the file."""
    _, angle, place = _differences(table, expected)
    return bool(np.mean(np.maximum(angle, place) <= 1e-9) > 0.95)
