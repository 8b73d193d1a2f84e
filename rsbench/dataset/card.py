"""Dataset cards: what to render, in the words of the paper's experiment."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.cards import card_path, load_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.lens import Lens
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.channels import Channel, check_channels
from rsbench.dataset.sequence import sequence_manifest
from rsbench.dataset.trajectory import TrajectoryCard, pairs_along
from rsbench.errors import RsbenchError
from rsbench.imports import search
from rsbench.motions import drawn_parameters, fixed_endpoint, make_motion
from rsbench.reading import check_name, check_size
from rsbench.renderers.electrons import Sensor
from rsbench.scenes.model import Start

Vector = tuple[float, float, float]
Axis = Vector | str


@dataclass(frozen=True, kw_only=True)
class CameraCard:
    """A camera with a centred principal point."""

    width: int
    height: int
    focal: float
    """Pixels."""
    lens: Lens | None = None
    """None: an ideal one."""


@dataclass(frozen=True, kw_only=True)
class MotionCard:
    """Magnitudes and axes of one frame period's motion; the axes need not be unit vectors."""

    model: str = "linear"
    """Name of a motion model, or ``package.module:Class``."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Of the model; absent ones have its defaults, or are drawn for each sequence (a shake's seed)."""
    rotation_deg: float | None = None
    """Required, as the axis and the translation are, unless the parameters alone fix the motion."""
    rotation_axis: Axis | None = None
    """Or ``"random"``: drawn for each sequence from its seed and name when the card is loaded."""
    translation: float | None = None
    """Metres."""
    translation_axis: Axis | None = None

    def __post_init__(self) -> None:
        names = ("rotation_deg", "rotation_axis", "translation", "translation_axis")
        given = [name for name in names if getattr(self, name) is not None]
        if fixed_endpoint(self.model, self.parameters) is not None:
            if given:
                raise ValueError(f"{given[0]}: the parameters of the model {self.model!r} fix the motion already")
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

        Raises ValueError when an axis was not drawn yet.
        """
        w, d = fixed_endpoint(self.model, self.parameters) or (
            _scaled(self.rotation_axis, np.deg2rad(self.rotation_deg or 0.0)),
            _scaled(self.translation_axis, self.translation or 0.0),
        )
        return make_motion(self.model, w, d, self.parameters)

    def drawn(self, seed: int, name: str) -> MotionCard:
        """With axes drawn, uniform on the sphere, the same whatever the lengths are; and random parameters."""
        axes = {
            field: _random_axis(f"{seed}/{name}/{field}")
            for field in ("rotation_axis", "translation_axis")
            if getattr(self, field) == "random"
        }
        parameters = drawn_parameters(self.model, self.parameters, _generator(f"{seed}/{name}/parameters"))
        return replace(self, parameters=parameters, **axes)  # type: ignore[arg-type]


def _generator(text: str) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little"))


def _random_axis(text: str) -> Vector:
    v = _generator(text).standard_normal(3)
    x, y, z = (v / np.linalg.norm(v)).tolist()
    return x, y, z


def _scaled(axis: Axis | None, length: float) -> np.ndarray:
    if axis is None or isinstance(axis, str):
        raise ValueError('an axis is still "random"; load_dataset_card draws it')
    v = np.asarray(axis, dtype=np.float64)
    return v * (length / np.linalg.norm(v)) if length > 0 else np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class SequenceCard:
    """One scene seen from one viewpoint under one motion."""

    name: str
    scene: str
    """Name of a scene card, or a path to one."""
    viewpoint: str = "default"
    motion: MotionCard | None = None
    """Replaces the dataset's motion."""
    baseline: float | None = None
    """Replaces the dataset's baseline, metres."""
    seed: int | None = None
    """Replaces the dataset's seed."""
    start: Start | None = None
    """Of the body at time 0, where that is not at the viewpoint: made from a trajectory."""

    def __post_init__(self) -> None:
        check_name(self.name)


@dataclass(frozen=True, kw_only=True)
class DatasetCard(Scanning):
    """A dataset: one camera, rig and shutter, and its sequences."""

    name: str
    description: str = ""
    camera: CameraCard
    baseline: float
    """Full distance between the cameras, metres."""
    readout_ratio: float
    frame_period_s: float = 0.1
    motion: MotionCard | None = None
    """Required, unless each sequence has its own or there is a trajectory."""
    trajectory: TrajectoryCard | None = None
    """Moves the rig along the poses of a file instead."""
    renderer: str = "default"
    """Name of a renderer card, or a path to one."""
    sensor: Sensor | None = None
    """Exposure and noise of the rolling-shutter frames; absent, an ideal sensor's."""
    channels: tuple[Channel, ...] = ()
    """Of ground truth, beside images, depth and poses."""
    seed: int = 0
    seeds: tuple[int, ...] = ()
    """When given, every sequence is made once per seed under the name NAME-SEED; random axes change with it."""
    sequence: tuple[SequenceCard, ...] = field(default=())

    def __post_init__(self) -> None:
        check_size("camera", (self.camera.width, self.camera.height))
        self.shutter()
        for sequence in self.sequence:
            self.rig_of(sequence)
        if not self.frame_period_s > 0:
            raise ValueError(f"frame_period_s must be positive, got {self.frame_period_s}")
        if self.sensor is not None and self.sensor.exposure_s > self.frame_period_s:
            raise ValueError(
                f"sensor exposure_s = {self.sensor.exposure_s}: longer than frame_period_s = {self.frame_period_s}"
            )
        if len(set(self.channels)) < len(self.channels):
            raise ValueError(f"channels = {list(self.channels)}: must differ from each other")
        check_channels(self.channels, self.camera.lens is not None, self.plain)
        if any(sequence.seed is not None for sequence in self.sequence) and self.seeds:
            raise ValueError("seeds and the seed of a sequence exclude each other")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds = {list(self.seeds)}: must differ from each other")
        self._check_motions()
        names = [sequence.name for sequence in self.sequence]
        if not names:
            raise ValueError("a dataset needs at least one [[sequence]]")
        for name, count in Counter(names).items():
            if count > 1:
                raise ValueError(f"two sequences are named {name!r}")

    def _check_motions(self) -> None:
        own = [sequence.name for sequence in self.sequence if sequence.motion is not None]
        if self.trajectory is not None and (self.motion is not None or own):
            raise ValueError(f"trajectory and motion{' of ' + own[0] if own else ''} exclude each other")
        if self.trajectory is None and self.motion is None and len(own) < len(self.sequence):
            raise ValueError("'motion' is required")

    def rig_of(self, sequence: SequenceCard) -> StereoRig:
        camera = PinholeCamera.centred(self.camera.width, self.camera.height, self.camera.focal)
        camera = replace(camera, lens=self.camera.lens)
        baseline = self.baseline if sequence.baseline is None else sequence.baseline
        return StereoRig(camera=camera, baseline=baseline)

    def shutter(self) -> RollingShutter:
        return self.shutter_of(self.camera.width, self.camera.height, self.readout_ratio)

    def motion_of(self, sequence: SequenceCard) -> Motion:
        return self._motion_card(sequence).motion()

    def _motion_card(self, sequence: SequenceCard) -> MotionCard:
        card = sequence.motion or self.motion
        if card is None:
            raise ValueError(f"{sequence.name}: the trajectory was not followed yet; load_dataset_card does it")
        return card

    def seed_of(self, sequence: SequenceCard) -> int:
        return self.seed if sequence.seed is None else sequence.seed

    def manifest_of(self, sequence: SequenceCard) -> dict[str, Any]:
        """What the sequence.json of a sequence says whatever scene, renderer and seed are."""
        manifest = sequence_manifest(
            name=sequence.name,
            rig=self.rig_of(sequence),
            shutter=self.shutter(),
            motion=self.motion_of(sequence),
            frame_period_s=self.frame_period_s,
        )
        sensor = {} if self.sensor is None else {"sensor": asdict(self.sensor)}
        channels = {"channels": list(self.channels)} if self.channels else {}
        return {**manifest, **sensor, **channels}

    def only(self, names: list[str]) -> DatasetCard:
        """The same card with some of its sequences.

        Raises:
            RsbenchError: a name that the card does not have.
        """
        known = {sequence.name: sequence for sequence in self.sequence}
        for name in names:
            if name not in known:
                raise RsbenchError(f"dataset {self.name}: no sequence {name!r}; there are: {', '.join(known)}")
        return replace(self, sequence=tuple(known[name] for name in names))

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
        """A card that says all that it will make: one sequence per seed and pair of frames, random axes drawn.

        Args:
            folder: of the card, where the file of a trajectory is looked for.

        Raises:
            RsbenchError: the file of a trajectory is wrong.
        """
        sequences = self.sequence
        if self.seeds:
            sequences = tuple(
                replace(sequence, name=f"{sequence.name}-{seed}", seed=seed)
                for sequence in self.sequence
                for seed in self.seeds
            )
        if self.trajectory is None:
            return replace(self, sequence=tuple(map(self._drawn, sequences)), seeds=())
        pairs = pairs_along(self.trajectory, folder, self.frame_period_s, self._span)
        motions = [MotionCard(model="trajectory", parameters={"poses": pair.poses.tolist()}) for pair in pairs]
        followed = tuple(
            replace(sequence, name=f"{sequence.name}-{number:04d}", motion=motion, start=pair.start)
            for sequence in sequences
            for number, (pair, motion) in enumerate(zip(pairs, motions, strict=True))
        )
        return replace(self, sequence=followed, trajectory=None, seeds=())

    @property
    def _span(self) -> tuple[float, float]:
        """From when to when something is exposed, frame periods."""
        half = 0.0 if self.sensor is None else 0.5 * self.sensor.exposure_s / self.frame_period_s
        return min(0.0, self.right_delay) - half, 1.0 + self.readout_ratio + max(0.0, self.right_delay) + half

    def _drawn(self, sequence: SequenceCard) -> SequenceCard:
        motion = self._motion_card(sequence)
        drawn = motion.drawn(self.seed_of(sequence), sequence.name)
        return sequence if drawn == motion else replace(sequence, motion=drawn)


def load_dataset_card(name_or_path: str, trajectory: Path | None = None) -> DatasetCard:
    """Dataset card by name or path, expanded; with ``trajectory``, moved along that file.

    Raises:
        RsbenchError: as ``rsbench.cards.load_card``, or the file of a trajectory is wrong.
    """
    path = card_path("datasets", name_or_path)
    search(path)
    card = load_card(DatasetCard, "datasets", name_or_path)
    return (card if trajectory is None else card.along(trajectory)).expanded(path.parent)
