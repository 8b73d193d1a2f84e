"""A user's own trajectory: poses from a file in TUM's format, cut into sequences of so many frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import LARGEST_TURN_DEG, turns_deg, world_from_body
from rsbench.scenes.model import Start
from rsbench.storage.untrusted_files import check_amount, read_text

FORMAT = "timestamp tx ty tz qx qy qz qw"
_NEARLY_UNIT = 0.01
"""Quaternions are written with four digits or more; beyond, another order of their parts is more likely."""
_AROUND = 24
"""Poses before and after that a sequence keeps: of farther ones the spline feels 0.27^24."""
_MOST_PARTS = 100_000


@dataclass(frozen=True, kw_only=True)
class TrajectoryCard:
    """The rig goes along the poses of a file: each two frames, or as many as the card says, are a sequence."""

    file: str
    """File of poses in TUM's format, relative to the card: lines ``timestamp tx ty tz qx qy qz qw``, seconds and
    metres."""
    absolute: bool = False
    """Whether the poses are in the frame of the scene (z up); otherwise the first sequence starts at the
    viewpoint."""
    start_s: float = 0.0
    """Seconds from the first pose of the file to the first frame."""
    step: float | None = None
    """Frame periods from one sequence to the next. Absent: as many as a sequence has frames; with one less,
    successive sequences share a frame."""
    pairs: int | None = None
    """Number of sequences, at most. Absent: all that the file holds."""
    longest_gap_s: float = 1.0
    """Longest time between two poses, seconds; files with longer gaps are refused."""

    def __post_init__(self) -> None:
        if not self.start_s >= 0.0:
            raise ValueError(f"start_s = {self.start_s}: must not be negative")
        for name in ("step", "longest_gap_s"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} = {value}: must be positive")
        if self.pairs is not None and self.pairs < 1:
            raise ValueError(f"pairs = {self.pairs}: must be 1 or more")


class Trajectory(NamedTuple):
    """Poses of a body in a frame that stands still: world_from_body."""

    seconds: FloatArray
    """(n,) from the first one."""
    poses: FloatArray
    """(n, 7) position x, y, z, metres, and unit quaternion x, y, z, w."""


class Part(NamedTuple):
    """The frames of one sequence on the way."""

    poses: FloatArray
    """(m, 8) as ``TrajectoryMotion`` takes them: time 0 is the start of frame 0."""
    start: Start


def read_trajectory(path: Path, longest_gap_s: float) -> Trajectory:
    """Poses of a file in TUM's format; blank lines and those that begin with # say nothing.

    Raises:
        RsbenchError: it cannot be read, or a line is wrong: one line with its number and a remedy.
    """
    stamps, poses, lines = list[Decimal](), list[FloatArray](), list[int]()
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        words = text.split()
        if words and not words[0].startswith("#"):
            stamp, pose = _line(words, f"{path}: line {number}")
            stamps.append(stamp)
            poses.append(pose)
            lines.append(number)
    if len(poses) < 2:
        raise RsbenchError(f"{path}: has {len(poses)} poses, at least 2 are needed: lines of {FORMAT}")
    # Exact where the stamps are: seconds since 1970 leave a float a quarter of a microsecond.
    trajectory = Trajectory(np.array([float(stamp - stamps[0]) for stamp in stamps]), np.array(poses))
    _check_steps(trajectory, path, lines, longest_gap_s)
    return trajectory


def _line(words: list[str], where: str) -> tuple[Decimal, FloatArray]:
    if len(words) != 8:
        raise RsbenchError(f"{where}: has {len(words)} words; write the 8 numbers {FORMAT}, with blanks between")
    try:
        stamp, values = Decimal(words[0]), np.array([float(word) for word in words[1:]])
        if not (stamp.is_finite() and np.all(np.isfinite(values))):
            raise ValueError
    except (InvalidOperation, ValueError):
        raise RsbenchError(f"{where}: not 8 finite numbers {FORMAT}; correct it or put # before it") from None
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _NEARLY_UNIT:
        raise RsbenchError(
            f"{where}: its quaternion has the length {length:.3g}, not 1; the order is {FORMAT}, qw last"
        )
    values[3:] /= length
    return stamp, values


def _check_steps(trajectory: Trajectory, path: Path, lines: list[int], longest_gap_s: float) -> None:
    steps = np.diff(trajectory.seconds)
    turns = turns_deg(trajectory.poses[:, 3:])
    for number, step, turn in zip(lines[1:], steps, turns, strict=True):
        where = f"{path}: line {number}"
        if step <= 0.0:
            raise RsbenchError(
                f"{where}: its timestamp is not later than the one before; sort the lines, each once"
            )
        if step > longest_gap_s:
            raise RsbenchError(
                f"{where}: is {step:g} s after the pose before (longest_gap_s = {longest_gap_s:g}); timestamps "
                "are seconds; cut the file there, or give more poses or a larger longest_gap_s in [trajectory]"
            )
        if turn > LARGEST_TURN_DEG:
            raise RsbenchError(
                f"{where}: turns by {turn:.0f} degrees from the pose before, more than {LARGEST_TURN_DEG:g}; "
                "cut the file there or give more poses"
            )


def parts_along(
    card: TrajectoryCard, folder: Path, period_s: float, span: tuple[float, float], frames: int
) -> list[Part]:
    """The sequences that a card makes of its file.

    Args:
        card: see there.
        folder: of the dataset's card.
        period_s: seconds of a frame period.
        span: from when to when a sequence needs poses: frame periods from the start of its frame 0.
        frames: of a sequence.

    Raises:
        RsbenchError: the file is wrong, or too short for one sequence.
    """
    path = folder / card.file
    trajectory = read_trajectory(path, card.longest_gap_s)
    seconds, step = trajectory.seconds, frames if card.step is None else card.step
    before, after = (time * period_s for time in span)
    first, left = card.start_s - before, float(seconds[-1]) - (card.start_s - before) - after
    words = "a pair of frames" if frames == 2 else f"{frames} frames"
    if left < 0.0:
        raise RsbenchError(
            f"{path}: lasts {seconds[-1]:g} s; {words} from start_s = {card.start_s:g} on "
            f"need{'s' if frames == 2 else ''} {card.start_s - before + after:g} s: give more poses or a shorter "
            "frame_period_s"
        )
    count = 1 + math.floor(left / (step * period_s) + 1e-9)
    count = count if card.pairs is None else min(count, card.pairs)
    check_amount(path, "sequences", count, _MOST_PARTS)
    rows = []
    for k in range(count):
        zero = first + k * step * period_s
        low, high = np.searchsorted(seconds, [zero + before, zero + after])
        near = slice(max(int(low) - _AROUND, 0), int(high) + _AROUND)
        times = (seconds[near] - zero) / period_s
        rows.append(np.concatenate([times[:, None], trajectory.poses[near]], axis=1))
    places = [world_from_body(each, 0.0) for each in rows]
    return [Part(each, _start(place, places[0], card.absolute)) for each, place in zip(rows, places, strict=True)]


def _start(place: Pose, first: Pose, absolute: bool) -> Start:
    R, t = place if absolute else compose(inverse(first), place)
    x, y, z = t.tolist()
    a, b, c, d = so3.quaternion(R).tolist()
    return Start(position=(x, y, z), quaternion=(a, b, c, d), absolute=absolute)
