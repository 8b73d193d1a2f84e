"""Dataset cards: what to render, with the keys of the paper's experiment."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal

from rsbench.components.cards import SHUTTER_KEY, card_path, in_all_tables, parse_card, read_toml, with_shutters
from rsbench.components.imports import search
from rsbench.components.rig_tables import RIG_KEY, RigTables, with_rig
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.channels import Channel, check_channels
from rsbench.dataset.imu import Imu
from rsbench.dataset.layout import MOST_FRAMES, MOST_TWINS
from rsbench.dataset.matches import Matching
from rsbench.dataset.motion_cards import MotionCard as MotionCard
from rsbench.dataset.motion_cards import (
    MovingCard,
    TrajectoryCard,
    check_moving,
    drawn,
    generator,
    parts_along,
)
from rsbench.dataset.sequence import check_sizes, sequence_manifest
from rsbench.renderers.image import Sensor, check_brightness
from rsbench.scenes.model import Start
from rsbench.storage.untrusted_files import check_name


@dataclass(frozen=True, kw_only=True)
class CameraCard:
    """A camera with a centred principal point."""

    width: int
    """Width of the images, pixels."""
    height: int
    """Height of the images, pixels."""
    focal: float
    """Focal length, pixels; the principal point is centred."""
    lens: Lens | None = None
    """Distortion of the lens. Absent: an ideal camera."""


@dataclass(frozen=True, kw_only=True)
class SequenceCard:
    """One scene seen from one viewpoint under one motion."""

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    name: str
    """Name of the sequence and of its folder."""
    scene: str
    """Name of a scene card, or a path to one."""
    viewpoint: str = "default"
    """Name of a viewpoint of the scene card: where the body, the middle of the baseline, stands at time 0 and
    looks. A vertical rig stands so that its left camera is upright."""
    motion: MotionCard | None = None
    """Motion of this sequence, in place of the dataset's."""
    rig: RigTables | None = None
    """Rig of this sequence, in place of the dataset's."""
    baseline: float | None = None
    """Full distance between the cameras, metres, in place of the dataset's."""
    readout_ratio: float | None = None
    """Readout time over frame period, in place of the dataset's."""
    frame_period_s: float | None = None
    """Seconds from one frame to the next, in place of the dataset's."""
    sensor: Sensor | None = None
    """Exposure and noise, in place of the dataset's."""
    scale: float = 1.0
    """Factor of baseline and translation: for scenes that are larger or nearer than others."""
    seed: int | None = None
    """Seed of this sequence, in place of the dataset's."""
    moving: tuple[MovingCard, ...] = ()
    """Objects that move by themselves."""
    start: Start | None = None
    """Pose of the body at time 0, where that is not at the viewpoint: made from a trajectory."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if not self.scale > 0.0:
            raise ValueError(f"scale = {self.scale}: must be positive")


@dataclass(frozen=True, kw_only=True)
class Variation:
    """What one value of an axis of a grid sets in every sequence; what is left out stays."""

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    motion: MotionCard | None = None
    """Motion, in place of the sequence's."""
    viewpoint: str | None = None
    """Name of a viewpoint, in place of the sequence's."""
    rig: RigTables | None = None
    """Rig, in place of the sequence's."""
    baseline: float | None = None
    """Full distance between the cameras, metres, in place of the sequence's."""
    readout_ratio: float | None = None
    """Readout time over frame period, in place of the sequence's."""
    frame_period_s: float | None = None
    """Seconds from one frame to the next, in place of the sequence's."""
    sensor: Sensor | None = None
    """Exposure and noise, in place of the sequence's."""
    moving: tuple[MovingCard, ...] | None = None
    """Objects that move, in place of the sequence's."""

    def of(self, sequence: SequenceCard) -> SequenceCard:
        """A sequence with it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(sequence, **{name: value for name, value in values.items() if value is not None})


Twin = Literal["first", "middle", "last"]


@dataclass(frozen=True, kw_only=True)
class DatasetCard(Scanning):
    """A dataset: its rig and shutter, and its sequences.

    From a key to pixels: ``rig_of``, ``shutter_for``, ``motion_of`` and ``sensor_of`` of this class make the
    objects of a sequence from its keys, and ``render_camera`` in rsbench/dataset/generation.py renders its frames
    with them. There ``shutter.row_time`` gives the time of each image row, the motion the pose at that time, the
    renderer the row seen from that pose, and the sensor turns it into digital numbers.
    """

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    name: str
    """Name of the dataset."""
    description: str = ""
    """One line for ``rsbench list datasets``."""
    license: str = "CC-BY-4.0"
    """SPDX name of the licence of the data: another one where meshes or textures of yours ask for it."""
    camera: CameraCard = None  # pyrefly: ignore[bad-assignment]
    """Image size, focal length and lens of both cameras. Required, unless there is a ``rig``."""
    baseline: float = None  # pyrefly: ignore[bad-assignment]
    """Full distance between the cameras, metres. Required with ``camera``."""
    rig: RigTables | None = None
    """Name of a rig card (``rsbench list rigs``) or a path to one, or its tables: a calibrated rig, in place of
    ``camera`` and ``baseline``. What it states of the readout goes before ``readout_ratio`` and ``scan`` here, but
    not before those of a sequence."""
    readout_ratio: float = None  # pyrefly: ignore[bad-assignment]
    """Readout time over frame period, 0 (global shutter) to 1: row y of frame k is exposed at the time k +
    readout_ratio * y / height, in frame periods. Required, unless ``shutter`` is given or the rig states it."""
    readout_range: tuple[float, float] | None = None
    """Two readout ratios: each sequence's is drawn evenly between them, by its seed and name; all other ratios
    of the card are ignored."""
    frame_period_s: float = 0.1
    """Seconds from one frame to the next."""
    frames: int = len(FRAMES)
    """Number of frames of each camera."""
    motion: MotionCard | None = None
    """Motion of the rig. Required, unless each sequence has its own, from the grid too, or there is a
    trajectory."""
    trajectory: TrajectoryCard | None = None
    """File of poses along which the rig moves, in place of a motion."""
    renderer: str = "default"
    """Name of a renderer card, or a path to one."""
    sensor: Sensor | None = None
    """Exposure and noise of the rolling-shutter frames. Absent: an ideal sensor."""
    channels: tuple[Channel, ...] = ()
    """Channels of ground truth beside images, depth and poses."""
    twins: tuple[int | Twin, ...] = ()
    """Rows, counted in the order of the readout, at whose poses global-shutter images are rendered too; that of
    the first row always is."""
    exposed_twins: bool = False
    """Whether global-shutter images are rendered as the sensor exposes them too: with its exposure time, fall-off
    and brightness, and without noise, mosaic and JPEG. A corrected frame of that sensor is compared with them."""
    imu: Imu | None = None
    """Rates and errors of the channel ``imu``. Absent: the defaults."""
    matches: Matching | None = None
    """Feature matcher of the channel ``matches``. Absent: the defaults."""
    seed: int = 0
    """Seed of everything that is drawn at random."""
    seeds: tuple[int, ...] = ()
    """When given, every sequence is made once per seed under the name NAME-SEED; random axes change with it."""
    grid: dict[str, dict[str, Variation]] = field(default_factory=dict)
    """Axes of named values: every sequence is made once per combination, under the name NAME-VALUE-VALUE."""
    sequence: tuple[SequenceCard, ...] = ()
    """The sequences, each a table ``[[sequence]]``; at least one."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,63}", self.license):
            raise ValueError(f"license = {self.license!r}: must be an SPDX name, such as CC-BY-4.0")
        if self.camera is not None and self.rig is not None:
            raise ValueError("rig and camera exclude each other; leave one out")
        if not len(FRAMES) <= self.frames <= MOST_FRAMES:
            raise ValueError(f"frames = {self.frames}: must lie in [{len(FRAMES)}, {MOST_FRAMES}]")
        for sequence in self.sequence:
            self._check_cameras(sequence)
            self._check_times(sequence)
            check_moving(sequence.moving, self.channels)
        low, high = self.readout_range or (0.0, 1.0)
        if not 0.0 <= low < high <= 1.0:
            raise ValueError(f"readout_range = {[low, high]}: must be two ratios in [0, 1], the smaller first")
        if len(set(self.channels)) < len(self.channels):
            raise ValueError(f"channels = {list(self.channels)}: must differ from each other")
        if any(sequence.seed is not None for sequence in self.sequence) and self.seeds:
            raise ValueError("seeds and the seed of a sequence exclude each other")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds = {list(self.seeds)}: must differ from each other")
        self._check_motions()
        names = [sequence.name for sequence in self.sequence]
        if not names:
            raise ValueError("a dataset needs at least one [[sequence]]")
        for name, count in Counter(
            name.lower() for name in names
        ).items():  # folders that many systems take for one
            if count > 1:
                raise ValueError(f"two sequences are named {name!r}")

    def _check_cameras(self, sequence: SequenceCard) -> None:
        rig, shutter = self.rig_of(sequence), self.shutter_for(sequence)
        check_sizes(rig)
        check_channels(self.channels, not rig.rectified, shutter.plain)

    def _check_times(self, sequence: SequenceCard) -> None:
        self.shutter_for(sequence)
        self.twins_of(sequence)
        period, sensor = self.period_of(sequence), self.sensor_of(sequence)
        if not period > 0:
            raise ValueError(f"frame_period_s must be positive, got {period}")
        if sensor is not None and sensor.longest_s > period:
            raise ValueError(f"sensor exposure_s = {sensor.longest_s}: longer than frame_period_s = {period}")
        if sensor is not None:
            check_brightness(sensor, self.frames)

    def _check_motions(self) -> None:
        own = [sequence.name for sequence in self.sequence if sequence.motion is not None]
        if self.trajectory is not None and (self.motion is not None or own):
            raise ValueError(f"trajectory and motion{' of ' + own[0] if own else ''} exclude each other")
        given = any(all(value.motion for value in axis.values()) for axis in self.grid.values())
        if self.trajectory is None and self.motion is None and len(own) < len(self.sequence) and not given:
            raise ValueError("'motion' is required")

    def rig_of(self, sequence: SequenceCard) -> StereoRig:
        """The rig of a sequence; ValueError for one that is not stated, or cannot be."""
        tables = sequence.rig or self.rig
        if tables is not None:
            rig = tables.rig()
            return rig if sequence.baseline is None else replace(rig, baseline=sequence.baseline)
        baseline = self.baseline if sequence.baseline is None else sequence.baseline
        if self.camera is None or baseline is None:
            raise ValueError(f"{'camera' if self.camera is None else 'baseline'!r} is required")
        camera = PinholeCamera.centred(self.camera.width, self.camera.height, self.camera.focal)
        return StereoRig(camera=replace(camera, lens=self.camera.lens), baseline=baseline)

    def shutter_for(self, sequence: SequenceCard) -> RollingShutter:
        """The shutter of a sequence; ValueError for one that is not stated, or cannot be."""
        tables = sequence.rig or self.rig
        stated = None if tables is None else tables.readout_ratio
        ratio = next(
            (each for each in (sequence.readout_ratio, stated, self.readout_ratio) if each is not None), None
        )
        if ratio is None:
            raise ValueError("'readout_ratio' is required")
        scanning = self if tables is None else tables.scanning or self
        return self.rig_of(sequence).shutter_of(scanning, ratio)

    def period_of(self, sequence: SequenceCard) -> float:
        """Seconds of a frame period."""
        tables = sequence.rig or self.rig
        stated = self.frame_period_s if tables is None else tables.frame_period_s or self.frame_period_s
        return stated if sequence.frame_period_s is None else sequence.frame_period_s

    def sensor_of(self, sequence: SequenceCard) -> Sensor | None:
        return self.sensor if sequence.sensor is None else sequence.sensor

    def twins_of(self, sequence: SequenceCard) -> tuple[int, ...]:
        """Rows of the twins but the first; ValueError for one that the cameras do not have."""
        shutter = self.shutter_for(sequence)
        lines = min(shutter.lines(side) for side in SIDES)
        if self.twins and lines < max(shutter.lines(side) for side in SIDES):
            raise ValueError(
                "twins: cameras of which one reads rows and one columns have no rows in common"
                if shutter.axis("left") != shutter.axis("right")
                else "twins: cameras of which one has more rows than the other have no rows in common"
            )
        named = {"first": 0, "middle": lines // 2, "last": lines - 1}
        rows = [named[row] if isinstance(row, str) else row for row in self.twins]
        if len(rows) > MOST_TWINS:
            raise ValueError(f"twins: {len(rows)} rows: at most {MOST_TWINS}")
        if wrong := [row for row in rows if not 0 <= row < lines]:
            raise ValueError(f"twins: {wrong[0]}: must be first, middle, last or a row from 0 to {lines - 1}")
        return tuple(sorted({*rows} - {0}))

    def motion_of(self, sequence: SequenceCard) -> Motion:
        return self._motion_card(sequence).motion()

    def geometry_of(self, sequence: SequenceCard) -> FixedGeometry:
        rig, shutter = self.rig_of(sequence), self.shutter_for(sequence)
        things = tuple(each.thing for each in sequence.moving)
        return FixedGeometry(rig, shutter, self.motion_of(sequence), self.frames, things)

    def _motion_card(self, sequence: SequenceCard) -> MotionCard:
        card = sequence.motion or self.motion
        if card is None:
            raise ValueError(f"{sequence.name}: the trajectory was not followed yet; load_dataset_card does it")
        return card if self.frames == len(FRAMES) else card.lasting(math.ceil(self._span(sequence)[1]))

    def _span(self, sequence: SequenceCard) -> tuple[float, float]:
        """From when to when its rows are exposed, frame periods."""
        period, sensor, shutter = self.period_of(sequence), self.sensor_of(sequence), self.shutter_for(sequence)
        half = 0.0 if sensor is None else 0.5 * sensor.longest_s / period
        starts = [float(shutter.start(0, side)) for side in SIDES]
        ends = [
            self.frames - 1 + shutter.ratio_of(side) + start for start, side in zip(starts, SIDES, strict=True)
        ]
        return min(starts) - half, max(ends) + half

    def seed_of(self, sequence: SequenceCard) -> int:
        return self.seed if sequence.seed is None else sequence.seed

    def manifest_of(self, sequence: SequenceCard) -> dict[str, Any]:
        """What the sequence.json of a sequence says whatever scene, renderer and seed are."""
        manifest = sequence_manifest(
            name=sequence.name,
            rig=self.rig_of(sequence),
            shutter=self.shutter_for(sequence),
            motion=self.motion_of(sequence),
            frame_period_s=self.period_of(sequence),
            frames=self.frames,
            moves=bool(sequence.moving),
        )
        own = self.sensor_of(sequence)
        sensor = {} if own is None else {"sensor": own.record}
        sensor |= {"exposed_twins": True} if own is not None and self.exposed_twins else {}
        channels = {"channels": list(self.channels)} if self.channels else {}
        imu = {"imu": asdict(self.imu or Imu())} if "imu" in self.channels else {}
        matches = {"matches": asdict(self.matches or Matching())} if "matches" in self.channels else {}
        twins = {"twins": list(rows)} if (rows := self.twins_of(sequence)) else {}
        moving = {"moving": [each.record for each in sequence.moving]} if sequence.moving else {}
        return {**manifest, **sensor, **channels, **imu, **matches, **twins, **moving}

    def only(self, names: list[str]) -> DatasetCard:
        """The same card with some of its sequences; RsbenchError for a name that it does not have."""
        known = {sequence.name: sequence for sequence in self.sequence}
        for name in names:
            if name not in known:
                raise RsbenchError(f"dataset {self.name}: no sequence {name!r}; there are: {', '.join(known)}")
        return replace(self, sequence=tuple(known[name] for name in names))

    def with_rig(self, rig: RigTables) -> DatasetCard:
        """The same card with this rig instead of its own cameras."""
        none: dict[str, Any] = {"camera": None, "baseline": None}
        return replace(self, rig=rig, **none)

    def with_channels(self, names: tuple[Channel, ...]) -> DatasetCard:
        """The same card with these channels instead of its own.

        Raises:
            RsbenchError: its cameras cannot have one of them.
        """
        try:
            return replace(self, channels=names)
        except ValueError as error:
            raise RsbenchError(f"dataset {self.name}: {error}") from error

    def shard(self, part: int, parts: int) -> DatasetCard:
        """The same card with every ``parts``-th sequence, from the ``part``-th, counted from 1.

        Raises:
            RsbenchError: no such part, or none of the sequences is in it.
        """
        if not 1 <= part <= parts:
            raise RsbenchError(f"shard {part}/{parts}: the first number goes from 1 to the second")
        if part > len(self.sequence):
            raise RsbenchError(
                f"shard {part}/{parts}: is empty, for {self.name} has {len(self.sequence)} sequences"
            )
        return replace(self, sequence=self.sequence[part - 1 :: parts])

    def along(self, file: Path) -> DatasetCard:
        """The same card with a trajectory from this file in place of all motions; other keys of its own stay."""
        own = self.trajectory or TrajectoryCard(file="")
        sequences = tuple(replace(sequence, motion=None) for sequence in self.sequence)
        return replace(self, motion=None, trajectory=replace(own, file=str(file.absolute())), sequence=sequences)

    def expanded(self, folder: Path = Path()) -> DatasetCard:
        """A card with every sequence that it makes: one per seed and part of a trajectory, random axes drawn.

        Args:
            folder: of the card, where the files of a trajectory and of moving meshes are looked for.

        Raises:
            RsbenchError: the file of a trajectory is wrong.
            ValueError: a motion is given for a shorter time than the frames take.
        """
        seeds: tuple[int | None, ...] = self.seeds or (None,)
        made = [each for sequence in self.sequence for seed in seeds for each in self._variants(sequence, seed)]
        if self.trajectory is not None:
            made = [each for sequence in made for each in self._followed(sequence, self.trajectory, folder)]
        made = [replace(each, moving=tuple(thing.found(folder) for thing in each.moving)) for each in made]
        return replace(self, sequence=tuple(made), grid={}, trajectory=None, seeds=(), readout_range=None)

    def _variants(self, sequence: SequenceCard, seed: int | None) -> list[SequenceCard]:
        """One sequence for each combination of the grid. What is drawn is drawn once for each motion."""
        own = sequence if seed is None else replace(sequence, seed=seed)
        ending = () if seed is None else (str(seed),)
        made = []
        for values in product(*(axis.items() for axis in self.grid.values())):
            varied = replace(own, name="-".join((sequence.name, *(label for label, _ in values), *ending)))
            for _, variation in values:
                varied = variation.of(varied)
            moved = (label for label, variation in values if variation.motion is not None)
            named = "-".join((sequence.name, *moved, *ending))
            varied = self._with_ratio(varied)
            lasting = None if self.frames == len(FRAMES) else self._span(varied)[1]
            things = drawn(varied.moving, self.seed_of(varied), named, lasting)
            made.append(self._scaled(self._drawn(replace(self._upright(varied), moving=things), named)))
        return made

    def _upright(self, sequence: SequenceCard) -> SequenceCard:
        """With the left camera upright, from whose axes those of the body of a vertical rig are a quarter turn
        away."""
        R = self.rig_of(sequence).own("left").R
        turn = 0.5 * math.pi * round(2.0 * math.atan2(R[1, 0], R[0, 0]) / math.pi)
        if turn == 0.0:
            return sequence
        return replace(sequence, start=Start(position=(0.0, 0.0, 0.0), quaternion=_about_z(turn)))

    def _with_ratio(self, sequence: SequenceCard) -> SequenceCard:
        """With a readout ratio of its own, where they are drawn."""
        if self.readout_range is None:
            return sequence
        share = generator(f"{self.seed_of(sequence)}/{sequence.name}/readout_ratio").random()
        low, high = self.readout_range
        return replace(sequence, readout_ratio=low + (high - low) * float(share))

    def _drawn(self, sequence: SequenceCard, name: str) -> SequenceCard:
        if self.trajectory is not None:
            return sequence
        motion = self._motion_card(sequence)
        drawn = motion.drawn(self.seed_of(sequence), name)
        lasts, end = drawn.motion().lasts, self._span(sequence)[1]
        if self.frames > len(FRAMES) and lasts < end:
            raise ValueError(
                f"{name}: motion {drawn.model!r} lasts {lasts:g} frame periods; {self.frames} frames need {end:g}"
            )
        return sequence if drawn == motion else replace(sequence, motion=drawn)

    def _scaled(self, sequence: SequenceCard) -> SequenceCard:
        if sequence.scale == 1.0:
            return sequence
        motion = None if self.trajectory is not None else self._motion_card(sequence)
        if motion is not None and motion.translation is not None:
            motion = replace(motion, translation=motion.translation * sequence.scale)
        baseline = self.rig_of(sequence).baseline * sequence.scale
        moving = tuple(each.scaled(sequence.scale) for each in sequence.moving)
        return replace(sequence, motion=motion, baseline=baseline, moving=moving, scale=1.0)

    def _followed(self, sequence: SequenceCard, card: TrajectoryCard, folder: Path) -> list[SequenceCard]:
        """One sequence for each so many frames on a trajectory."""
        parts = parts_along(card, folder, self.period_of(sequence), self._span(sequence), self.frames)
        return [
            replace(
                sequence,
                name=f"{sequence.name}-{number:04d}",
                motion=MotionCard(model="trajectory", parameters={"poses": pair.poses.tolist()}),
                start=pair.start,
            )
            for number, pair in enumerate(parts)
        ]


def _about_z(angle: float) -> tuple[float, float, float, float]:
    return math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)


def load_dataset_card(
    name_or_path: str | Path, trajectory: Path | None = None, seeds: tuple[int, ...] = ()
) -> DatasetCard:
    """Dataset card by name or path, expanded.

    Args:
        name_or_path: of the card.
        trajectory: file along which the rig moves, in place of the card's motions.
        seeds: in place of the card's.

    Raises RsbenchError as ``rsbench.components.cards.load_card``, or where the file of a trajectory is wrong.
    """
    path = card_path("datasets", name_or_path)
    card = read_dataset_card(path)
    try:
        card = card if trajectory is None else card.along(trajectory)
        return (replace(card, seeds=seeds) if seeds else card).expanded(path.parent)
    except ValueError as error:
        raise RsbenchError(f"{path}: {error}") from error


def read_dataset_card(path: Path) -> DatasetCard:
    """A dataset card as it stands in its file, nothing drawn; raises as ``load_dataset_card``."""
    search(path)
    card = in_all_tables(with_shutters(read_toml(path), str(path)), lambda table: with_rig(table, str(path)))
    return parse_card(DatasetCard, card, str(path))
