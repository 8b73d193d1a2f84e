"""The parts of a dataset card: its camera, a sequence, and what one value of a grid sets in each sequence."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

from rsbench.components.cards import SHUTTER_KEY
from rsbench.core.camera import Lens
from rsbench.dataset.motion_card import MotionCard
from rsbench.dataset.object_records import MovingCard
from rsbench.renderers.image import Sensor
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

    SHORTHANDS: ClassVar = SHUTTER_KEY

    name: str
    """Name of the sequence and of its folder."""
    scene: str
    """Name of a scene card, or a path to one."""
    viewpoint: str = "default"
    """Name of a viewpoint of the scene card."""
    motion: MotionCard | None = None
    """Motion of this sequence, in place of the dataset's."""
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

    SHORTHANDS: ClassVar = SHUTTER_KEY

    motion: MotionCard | None = None
    """Motion, in place of the sequence's."""
    viewpoint: str | None = None
    """Name of a viewpoint, in place of the sequence's."""
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
