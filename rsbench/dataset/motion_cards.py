"""Motions on dataset cards: a motion model or a trajectory file for the rig, and motions of moving objects."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.components.motion_models import (
    drawn_parameters,
    fixed_endpoint,
    make_motion,
    motion_model,
    motion_record,
    read_motion,
)
from rsbench.components.seeds import generator
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import MovingObject
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import LARGEST_TURN_DEG, turns_deg, world_from_body
from rsbench.dataset.channels import CHANNELS, OBJECTS, Channel
from rsbench.scenes.model import Start
from rsbench.scenes.object_meshes import MOST_MOVING, Body, MeshFile
from rsbench.storage.untrusted_files import check_amount, read_text

Vector = tuple[float, float, float]
Axis = Vector | str


@dataclass(frozen=True, kw_only=True)
class MotionCard:
    """Motion in one frame period as magnitudes and axes, which need not be unit vectors."""

    model: str = "linear"
    """Name of a motion model, or ``package.module:Class``."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the motion model; absent ones have defaults, or are drawn per sequence (a shake's seed)."""
    rotation_deg: float | None = None
    """Angle of the rotation in one frame period, degrees. Required, like the axes and the translation, unless
    the parameters alone determine the motion."""
    rotation_axis: Axis | None = None
    """Axis of the rotation (x right, y down, z forward), of any length; or ``"random"``: drawn for each sequence
    from its seed and name when the card is loaded."""
    translation: float | None = None
    """Length of the translation in one frame period, metres."""
    translation_axis: Axis | None = None
    """Direction of the translation, of any length; or ``"random"``."""

    def __post_init__(self) -> None:
        names = ("rotation_deg", "rotation_axis", "translation", "translation_axis")
        given = [name for name in names if getattr(self, name) is not None]
        if fixed_endpoint(self.model, self.parameters) is not None:
            if given:
                raise ValueError(f"{given[0]}: leave it out, as parameters of model {self.model!r} fix the motion")
            self.motion()
            return
        for name in names:
            if name not in given:
                raise ValueError(f"{name!r} is required")
        for name, length in (("rotation", self.rotation_deg), ("translation", self.translation)):
            if length is not None and length < 0:
                raise ValueError(f"{name} must not be negative, got {length}")
            axis = getattr(self, f"{name}_axis")
            if isinstance(axis, str) and axis != "random":
                raise ValueError(f'{name}_axis = {axis!r}: must be three numbers or "random"')
            if length and not isinstance(axis, str) and not np.any(axis):
                raise ValueError(f"{name}_axis must not be zero when there is {name}")
        make_motion(self.model, np.zeros(3), np.zeros(3), self.parameters)

    def motion(self) -> Motion:
        """The motion of the rig's body, radians and metres per frame period.

        Raises ValueError if a random axis has not been drawn yet.
        """
        w, d = fixed_endpoint(self.model, self.parameters) or (
            _scaled(self.rotation_axis, np.deg2rad(self.rotation_deg or 0.0)),
            _scaled(self.translation_axis, self.translation or 0.0),
        )
        return make_motion(self.model, w, d, self.parameters)

    def lasting(self, periods: float) -> MotionCard:
        """The card with the model's default parameters for a motion that lasts for ``periods`` frame periods."""
        return replace(self, parameters=motion_model(self.model).lasting(self.parameters, periods))

    def drawn(self, seed: int, name: str) -> MotionCard:
        """The card with random axes drawn uniformly on the sphere, independent of the lengths, and parameters."""
        axes = {
            field: _random_axis(f"{seed}/{name}/{field}")
            for field in ("rotation_axis", "translation_axis")
            if getattr(self, field) == "random"
        }
        parameters = drawn_parameters(self.model, self.parameters, generator(f"{seed}/{name}/parameters"))
        return replace(self, parameters=parameters, **axes)


def _random_axis(text: str) -> Vector:
    v = generator(text).standard_normal(3)
    x, y, z = (v / np.linalg.norm(v)).tolist()
    return x, y, z


def _scaled(axis: Axis | None, length: float) -> np.ndarray:
    if axis is None or isinstance(axis, str):
        raise ValueError('an axis is still "random"; load_dataset_card draws it')
    v = np.asarray(axis, dtype=np.float64)
    return v * (length / np.linalg.norm(v)) if length > 0 else np.zeros(3)


FORMAT = "timestamp tx ty tz qx qy qz qw"
_NEARLY_UNIT = 0.01
"""Largest deviation of a quaternion's length from 1; a larger one suggests another order of its components."""
_AROUND = 24
"""Number of poses that a sequence keeps before and after its time; the spline depends on others by 0.27^24."""
_MOST_PARTS = 100_000


@dataclass(frozen=True, kw_only=True)
class TrajectoryCard:
    """The rig follows the poses of a file; each two frames, or as many as the card says, are a sequence."""

    file: str
    """File of poses in TUM's format, relative to the card: lines ``timestamp tx ty tz qx qy qz qw``, seconds and
    metres."""
    absolute: bool = False
    """Whether poses are in the frame of the scene (z up); else the first sequence starts at the viewpoint."""
    start_s: float = 0.0
    """Time from the first pose of the file to the first frame, seconds."""
    step: float | None = None
    """Frame periods from one sequence to the next. Absent: as many as a sequence has frames; with one less,
    successive sequences share a frame."""
    pairs: int | None = None
    """Largest number of sequences. Absent: as many as the file allows."""
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
    """Poses of a body in a fixed frame: world_from_body."""

    seconds: FloatArray
    """(n,) times since the first pose."""
    poses: FloatArray
    """(n, 7) position x, y, z, metres, and unit quaternion x, y, z, w."""


class Part(NamedTuple):
    """The part of a trajectory for one sequence."""

    poses: FloatArray
    """(m, 8) poses as ``TrajectoryMotion`` takes them; time 0 is the start of frame 0."""
    start: Start


def read_trajectory(path: Path, longest_gap_s: float) -> Trajectory:
    """Read poses from a file in TUM's format; blank lines and those that begin with # are skipped.

    Raises:
        RsbenchError: the file cannot be read, or a line is wrong; the message has its number and a remedy.
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
    # Subtract as decimals: a float resolves seconds since 1970 to a quarter of a microsecond only.
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
                f"{where}: its timestamp is not later than the previous one; sort the lines and remove duplicates"
            )
        if step > longest_gap_s:
            raise RsbenchError(
                f"{where}: is {step:g} s after the previous pose (longest_gap_s = {longest_gap_s:g}); timestamps "
                "are seconds; cut the file there, or give more poses or a larger longest_gap_s in [trajectory]"
            )
        if turn > LARGEST_TURN_DEG:
            raise RsbenchError(
                f"{where}: turns by {turn:.0f} degrees from the previous pose, more than {LARGEST_TURN_DEG:g}; "
                "cut the file there or give more poses"
            )


def parts_along(
    card: TrajectoryCard, folder: Path, period_s: float, span: tuple[float, float], frames: int
) -> list[Part]:
    """Split the trajectory file of a card into sequences.

    Args:
        card: the card.
        folder: folder of the dataset's card.
        period_s: frame period, seconds.
        span: start and end of the time for which a sequence needs poses, frame periods from its frame 0.
        frames: number of frames of a sequence.

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
        rows.append(poses_around(trajectory, first + k * step * period_s, period_s, span))
    places = [world_from_body(each, 0.0) for each in rows]
    return [Part(each, _start(place, places[0], card.absolute)) for each, place in zip(rows, places, strict=True)]


def poses_around(trajectory: Trajectory, zero_s: float, period_s: float, span: tuple[float, float]) -> FloatArray:
    """Poses (m, 8) as ``TrajectoryMotion`` takes them, for frame periods ``span`` from time ``zero_s`` on."""
    low, high = np.searchsorted(trajectory.seconds, [zero_s + time * period_s for time in span])
    near = slice(max(int(low) - _AROUND, 0), int(high) + _AROUND)
    times = (trajectory.seconds[near] - zero_s) / period_s
    return np.concatenate([times[:, None], trajectory.poses[near]], axis=1)


def _start(place: Pose, first: Pose, absolute: bool) -> Start:
    R, t = place if absolute else compose(inverse(first), place)
    x, y, z = t.tolist()
    a, b, c, d = so3.quaternion(R).tolist()
    return Start(position=(x, y, z), quaternion=(a, b, c, d), absolute=absolute)


TAKEN: tuple[Channel, ...] = tuple(name for name, channel in OBJECTS.items() if channel.supports_moving)
"""Channels that support moving objects, or do not depend on them."""


@dataclass(frozen=True, kw_only=True)
class MovingCard(Body):
    """An object and its motion: a rotation about its position, and a translation."""

    motion: MotionCard
    """The object's motion: a rotation about its position, and a translation."""

    def scaled(self, by: float) -> MovingCard:
        """The object with all lengths multiplied by a factor."""
        motion, box = self.motion, self.box
        if motion.translation is not None:
            motion = replace(motion, translation=motion.translation * by)
        position = _times(self.position, by)
        box = None if box is None else _times(box, by)
        return replace(self, motion=motion, position=position, box=box, mesh=self._scaled_mesh(by))

    def _scaled_mesh(self, by: float) -> MeshFile | None:
        mesh = self.mesh
        if mesh is None or mesh.size is None:
            return mesh and replace(mesh, metres_per_unit=mesh.metres_per_unit * by)
        return replace(mesh, size=mesh.size * by)

    def found(self, folder: Path) -> MovingCard:
        """The object with the full path of its mesh file, which a card gives relative to its folder."""
        if self.mesh is None:
            return self
        path = folder / Path(self.mesh.file).expanduser()
        return replace(self, mesh=replace(self.mesh, file=str(path)))

    @property
    def thing(self) -> MovingObject:
        return MovingObject(np.array(self.position), self.motion.motion())

    @property
    def record(self) -> dict[str, Any]:
        """The fields that are written to sequence.json; a mesh file is named without its folder."""
        values = {field.name: getattr(self, field.name) for field in fields(Body) if field.name != "mesh"}
        listed = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
        mesh: dict[str, Any] = (
            {} if self.mesh is None else {"mesh": asdict(replace(self.mesh, file=self.mesh.name))}
        )
        return listed | mesh | {"motion": motion_record(self.motion.motion())}


def drawn(
    moving: Sequence[MovingCard], seed: int, name: str, lasting: float | None = None
) -> tuple[MovingCard, ...]:
    """The objects with the axes of their motions drawn, see ``MotionCard.drawn``.

    Args:
        moving: the objects.
        seed: seed of the sequence.
        name: name of the sequence.
        lasting: time until which they move, frame periods; by default that of two frames.

    Raises:
        ValueError: a motion is given for a shorter time.
    """
    made = []
    for number, each in enumerate(moving, start=1):
        motion = each.motion if lasting is None else each.motion.lasting(math.ceil(lasting))
        motion = motion.drawn(seed, f"{name}/moving/{number}")
        if lasting is not None and (lasts := motion.motion().lasts) < lasting:
            raise ValueError(
                f"{name}: moving object {number}: motion {motion.model!r} lasts {lasts:g} frame periods; the "
                f"frames need {lasting:g}"
            )
        made.append(replace(each, motion=motion))
    return tuple(made)


@dataclass(frozen=True, kw_only=True)
class MovingManifest(Body):
    """A moving object in a sequence.json."""

    motion: dict[str, Any]

    @property
    def thing(self) -> MovingObject:
        """The object's geometry; raises RsbenchError as ``read_motion`` does."""
        return MovingObject(np.array(self.position), read_motion(self.motion))

    def __post_init__(self) -> None:
        super().__post_init__()
        if missing := {"model", "w", "d"} - self.motion.keys():
            raise ValueError(f"moving: motion: {min(missing)!r} is required")


def check_moving(moving: Sequence[Body], channels: Sequence[str]) -> None:
    """Raise ValueError for too many objects, two files with one name, or a channel that does not support them."""
    if len(moving) > MOST_MOVING:
        raise ValueError(f"moving: {len(moving)} objects: at most {MOST_MOVING}")
    named = {(each.mesh.name, each.mesh.file) for each in moving if each.mesh is not None}
    for name, count in Counter(name for name, _ in named).items():
        if count > 1:
            raise ValueError(f"moving: two mesh files are named {name!r}: rename one")
    refused = [name for name in channels if name in CHANNELS and name not in TAKEN]
    if moving and refused:
        raise ValueError(
            f"channels: {refused[0]!r} does not support moving objects; these sequences have {', '.join(TAKEN)}"
        )


def _times(vector: tuple[float, float, float], by: float) -> tuple[float, float, float]:
    x, y, z = (by * value for value in vector)
    return x, y, z
