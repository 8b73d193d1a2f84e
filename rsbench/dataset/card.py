"""Dataset cards, which describe what is rendered, with the keys of the paper's experiment."""

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
from rsbench.components.seeds import generator
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.geometry import FixedGeometry
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.channels import Channel, check_channels
from rsbench.dataset.clock_channels import Imu
from rsbench.dataset.layout import MOST_FRAMES, MOST_TWINS
from rsbench.dataset.motion_cards import MotionCard as MotionCard
from rsbench.dataset.motion_cards import MovingCard, TrajectoryCard, check_moving, drawn, parts_along
from rsbench.dataset.point_channels import Matching
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
    """One scene rendered from one viewpoint under one motion."""

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    name: str
    """Name of the sequence and of its folder."""
    scene: str
    """Name of a scene card, or a path to one."""
    viewpoint: str = "default"
    """Name of a viewpoint of the scene card: the pose of the body, at the middle of the baseline, at time 0. A
    vertical rig is placed so that its left camera is upright."""
    motion: MotionCard | None = None
    """Motion of this sequence, in place of the dataset's."""
    rig: RigTables | None = None
    """Rig of this sequence, in place of the dataset's."""
    baseline: float | None = None
    """Distance between the cameras, metres, in place of the dataset's."""
    readout_ratio: float | None = None
    """Readout time divided by frame period, in place of the dataset's."""
    frame_period_s: float | None = None
    """Time between frames, seconds, in place of the dataset's."""
    sensor: Sensor | None = None
    """Exposure and noise, in place of the dataset's."""
    scale: float = 1.0
    """Factor on baseline and translation, for scenes that are larger or nearer than others."""
    seed: int | None = None
    """Seed of this sequence, in place of the dataset's."""
    moving: tuple[MovingCard, ...] = ()
    """Moving objects."""
    start: Start | None = None
    """Pose of the body at time 0 if it is not at the viewpoint; computed from a trajectory."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if not self.scale > 0.0:
            raise ValueError(f"scale = {self.scale}: must be positive")


@dataclass(frozen=True, kw_only=True)
class Variation:
    """The values that one value of a grid's axis sets in every sequence; values that are absent stay unchanged."""

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    motion: MotionCard | None = None
    """Motion, in place of the sequence's."""
    viewpoint: str | None = None
    """Name of a viewpoint, in place of the sequence's."""
    rig: RigTables | None = None
    """Rig, in place of the sequence's."""
    baseline: float | None = None
    """Distance between the cameras, metres, in place of the sequence's."""
    readout_ratio: float | None = None
    """Readout time divided by frame period, in place of the sequence's."""
    frame_period_s: float | None = None
    """Time between frames, seconds, in place of the sequence's."""
    sensor: Sensor | None = None
    """Exposure and noise, in place of the sequence's."""
    moving: tuple[MovingCard, ...] | None = None
    """Moving objects, in place of the sequence's."""

    def of(self, sequence: SequenceCard) -> SequenceCard:
        """The sequence with the values of this variation."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(sequence, **{name: value for name, value in values.items() if value is not None})


Twin = Literal["first", "middle", "last"]


@dataclass(frozen=True, kw_only=True)
class DatasetCard(Scanning):
    """A dataset: its rig and shutter, and its sequences.

    ``rig_of``, ``shutter_for``, ``motion_of`` and ``sensor_of`` create the objects of a sequence from its keys,
    and ``render_camera`` in rsbench/dataset/generation.py renders its frames with them: ``shutter.row_time`` gives
    the time of each image row, the motion the pose at that time, the renderer the row from that pose, and the
    sensor converts it to digital numbers.
    """

    SHORTHANDS: ClassVar = SHUTTER_KEY | RIG_KEY

    name: str
    """Name of the dataset."""
    description: str = ""
    """One line for ``rsbench list datasets``."""
    license: str = "CC-BY-4.0"
    """SPDX name of the licence of the data; choose another one if your meshes or textures require it."""
    camera: CameraCard = None  # pyrefly: ignore[bad-assignment]
    """Image size, focal length and lens of both cameras. Required, unless there is a ``rig``."""
    baseline: float = None  # pyrefly: ignore[bad-assignment]
    """Distance between the cameras, metres. Required with ``camera``."""
    rig: RigTables | None = None
    """Name of a rig card (``rsbench list rigs``) or a path to one, or its tables: a calibrated rig, in place of
    ``camera`` and ``baseline``. Its readout takes precedence over ``readout_ratio`` and ``scan`` here, but not
    over those of a sequence."""
    readout_ratio: float = None  # pyrefly: ignore[bad-assignment]
    """Readout time divided by frame period, 0 (global shutter) to 1: row y of frame k is exposed at the time k +
    readout_ratio * y / height, in frame periods. Required, unless ``shutter`` or a rig with a readout is given."""
    readout_range: tuple[float, float] | None = None
    """Two readout ratios, between which that of each sequence is drawn uniformly, by its seed and name; all other
    ratios of the card are ignored."""
    frame_period_s: float = 0.1
    """Time between frames, seconds."""
    frames: int = len(FRAMES)
    """Number of frames of each camera."""
    motion: MotionCard | None = None
    """Motion of the rig. Required, unless each sequence or a grid has motions, or there is a trajectory."""
    trajectory: TrajectoryCard | None = None
    """File of poses along which the rig moves, in place of a motion."""
    renderer: str = "default"
    """Name of a renderer card, or a path to one."""
    sensor: Sensor | None = None
    """Exposure and noise of the rolling-shutter frames. Absent: an ideal sensor."""
    channels: tuple[Channel, ...] = ()
    """Channels of ground truth in addition to images, depth and poses."""
    twins: tuple[int | Twin, ...] = ()
    """Rows, in the order of the readout, besides the first, at whose poses global-shutter images are rendered."""
    exposed_twins: bool = False
    """Whether global-shutter images are also rendered with the sensor's exposure time, fall-off and brightness,
    but without noise, mosaic and JPEG, for comparison with corrected frames of that sensor."""
    imu: Imu | None = None
    """Rates and errors of the channel ``imu``. Absent: the defaults."""
    matches: Matching | None = None
    """Feature matcher of the channel ``matches``. Absent: the defaults."""
    seed: int = 0
    """Seed of all random values."""
    seeds: tuple[int, ...] = ()
    """If given, each sequence is made once per seed, as NAME-SEED; random axes depend on the seed."""
    grid: dict[str, dict[str, Variation]] = field(default_factory=dict)
    """Axes of named values: each sequence is generated once per combination with the name NAME-VALUE-VALUE."""
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
            self._check_sequence(sequence)
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
        for name, count in Counter(name.lower() for name in names).items():  # many file systems ignore case
            if count > 1:
                raise ValueError(f"two sequences are named {name!r}")

    def _check_sequence(self, sequence: SequenceCard) -> None:
        rig, shutter = self.rig_of(sequence), self.shutter_for(sequence)
        check_sizes(rig)
        check_channels(self.channels, not rig.rectified, shutter.plain)
        self.twins_of(sequence)
        period, sensor = self.period_of(sequence), self.sensor_of(sequence)
        if not period > 0:
            raise ValueError(f"frame_period_s must be positive, got {period}")
        if sensor is not None:
            if sensor.longest_s > period:
                raise ValueError(f"sensor exposure_s = {sensor.longest_s}: longer than frame_period_s = {period}")
            check_brightness(sensor, self.frames)

    def _check_motions(self) -> None:
        own = [sequence.name for sequence in self.sequence if sequence.motion is not None]
        if self.trajectory is not None and (self.motion is not None or own):
            raise ValueError(f"trajectory and motion{' of ' + own[0] if own else ''} exclude each other")
        given = any(all(value.motion for value in axis.values()) for axis in self.grid.values())
        if self.trajectory is None and self.motion is None and len(own) < len(self.sequence) and not given:
            raise ValueError("'motion' is required")

    def rig_of(self, sequence: SequenceCard) -> StereoRig:
        """The rig of a sequence; ValueError if it is missing or impossible."""
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
        """The shutter of a sequence; ValueError if it is missing or impossible."""
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
        """Frame period of a sequence, seconds."""
        tables = sequence.rig or self.rig
        stated = self.frame_period_s if tables is None else tables.frame_period_s or self.frame_period_s
        return stated if sequence.frame_period_s is None else sequence.frame_period_s

    def sensor_of(self, sequence: SequenceCard) -> Sensor | None:
        return self.sensor if sequence.sensor is None else sequence.sensor

    def twins_of(self, sequence: SequenceCard) -> tuple[int, ...]:
        """Rows of the twins except row 0; ValueError for a row that the cameras do not have."""
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
            raise ValueError(f"{sequence.name}: has no motion from the trajectory yet; use load_dataset_card")
        return card if self.frames == len(FRAMES) else card.lasting(math.ceil(self._span(sequence)[1]))

    def _span(self, sequence: SequenceCard) -> tuple[float, float]:
        """Start and end of the exposure of all rows of a sequence, frame periods."""
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
        """The part of a sequence's sequence.json that does not depend on scene, renderer and seed."""
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
        """The card with some of its sequences; RsbenchError for an unknown name."""
        known = {sequence.name: sequence for sequence in self.sequence}
        for name in names:
            if name not in known:
                raise RsbenchError(f"dataset {self.name}: no sequence {name!r}; there are: {', '.join(known)}")
        return replace(self, sequence=tuple(known[name] for name in names))

    def with_rig(self, rig: RigTables) -> DatasetCard:
        """The card with this rig instead of its cameras."""
        none: dict[str, Any] = {"camera": None, "baseline": None}
        return replace(self, rig=rig, **none)

    def with_channels(self, names: tuple[Channel, ...]) -> DatasetCard:
        """The card with these channels instead of its own.

        Raises:
            RsbenchError: a channel is not available for its cameras.
        """
        with naming(f"dataset {self.name}"):
            return replace(self, channels=names)

    def shard(self, part: int, parts: int) -> DatasetCard:
        """The card with every ``parts``-th sequence, beginning with number ``part``, counted from 1.

        Raises:
            RsbenchError: there is no such part, or it has no sequences.
        """
        if not 1 <= part <= parts:
            raise RsbenchError(f"shard {part}/{parts}: the first number goes from 1 to the second")
        if part > len(self.sequence):
            raise RsbenchError(
                f"shard {part}/{parts}: is empty, for {self.name} has {len(self.sequence)} sequences"
            )
        return replace(self, sequence=self.sequence[part - 1 :: parts])

    def along(self, file: Path) -> DatasetCard:
        """The card with a trajectory from this file in place of all motions; other keys of a trajectory stay."""
        own = self.trajectory or TrajectoryCard(file="")
        sequences = tuple(replace(sequence, motion=None) for sequence in self.sequence)
        return replace(self, motion=None, trajectory=replace(own, file=str(file.absolute())), sequence=sequences)

    def expanded(self, folder: Path = Path()) -> DatasetCard:
        """The card with all sequences explicit: one per seed, grid value and part of a trajectory, axes drawn.

        Args:
            folder: folder of the card, to which the files of a trajectory and of moving meshes are relative.

        Raises:
            RsbenchError: the file of a trajectory is wrong.
            ValueError: a motion is given for a shorter time than the frames take.
        """
        seeds: tuple[int | None, ...] = self.seeds or (None,)
        made = [each for sequence in self.sequence for seed in seeds for each in self._variants(sequence, seed)]
        if self.trajectory is not None:
            made = [
                each for sequence in made for each in self._along_trajectory(sequence, self.trajectory, folder)
            ]
        made = [replace(each, moving=tuple(thing.found(folder) for thing in each.moving)) for each in made]
        return replace(self, sequence=tuple(made), grid={}, trajectory=None, seeds=(), readout_range=None)

    def _variants(self, sequence: SequenceCard, seed: int | None) -> list[SequenceCard]:
        """One sequence for each combination of the grid; random values are drawn once per motion."""
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
        """The sequence with its start rotated so that the left camera is upright: the body's axes of a vertical
        rig are rotated by 90 degrees against the camera's."""
        R = self.rig_of(sequence).own("left").R
        turn = 0.5 * math.pi * round(2.0 * math.atan2(R[1, 0], R[0, 0]) / math.pi)
        if turn == 0.0:
            return sequence
        return replace(sequence, start=Start(position=(0.0, 0.0, 0.0), quaternion=_about_z(turn)))

    def _with_ratio(self, sequence: SequenceCard) -> SequenceCard:
        """The sequence with a random readout ratio if there is a ``readout_range``."""
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

    def _along_trajectory(self, sequence: SequenceCard, card: TrajectoryCard, folder: Path) -> list[SequenceCard]:
        """One sequence for each part of a trajectory."""
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
    """Load a dataset card and expand it.

    Args:
        name_or_path: name or path of the card.
        trajectory: file along which the rig moves, in place of the card's motions.
        seeds: seeds in place of the card's.

    Raises RsbenchError as ``rsbench.components.cards.load_card`` does, or if the file of a trajectory is wrong.
    """
    path = card_path("datasets", name_or_path)
    card = read_dataset_card(path)
    with naming(path):
        card = card if trajectory is None else card.along(trajectory)
        return (replace(card, seeds=seeds) if seeds else card).expanded(path.parent)


def read_dataset_card(path: Path) -> DatasetCard:
    """Read a dataset card without expanding it; raises as ``load_dataset_card`` does."""
    search(path)
    card = in_all_tables(with_shutters(read_toml(path), str(path)), lambda table: with_rig(table, str(path)))
    return parse_card(DatasetCard, card, str(path))
