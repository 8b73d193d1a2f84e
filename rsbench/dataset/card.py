"""Dataset cards: what to render, in the words of the paper's experiment."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

import numpy as np

from rsbench.cards import load_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import MOTION_MODELS, Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class CameraCard:
    """A pinhole camera with a centred principal point."""

    width: int
    height: int
    focal: float
    """Pixels."""


@dataclass(frozen=True, kw_only=True)
class MotionCard:
    """Magnitudes and axes of one frame period's motion; the axes need not be unit vectors."""

    model: str = "linear"
    rotation_deg: float
    rotation_axis: Vector
    translation: float
    """Metres."""
    translation_axis: Vector

    def __post_init__(self) -> None:
        if self.model not in MOTION_MODELS:
            raise ValueError(f"model = {self.model!r}: must be one of {', '.join(MOTION_MODELS)}")
        for name, length in (("rotation", self.rotation_deg), ("translation", self.translation)):
            if length < 0:
                raise ValueError(f"{name} must not be negative, got {length}")
            if length > 0 and not np.any(getattr(self, f"{name}_axis")):
                raise ValueError(f"{name}_axis must not be zero when there is {name}")

    def motion(self) -> Motion:
        """The motion of the rig's body, radians and metres per frame period."""
        w = _scaled(self.rotation_axis, np.deg2rad(self.rotation_deg))
        return MOTION_MODELS[self.model](w, _scaled(self.translation_axis, self.translation))


def _scaled(axis: Vector, length: float) -> np.ndarray:
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

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", self.name):
            raise ValueError(f"name = {self.name!r}: a folder name of letters, digits, '.', '_' and '-'")


@dataclass(frozen=True, kw_only=True)
class DatasetCard:
    """A dataset: one camera, rig and shutter, and its sequences."""

    name: str
    description: str = ""
    camera: CameraCard
    baseline: float
    """Full distance between the cameras, metres."""
    readout_ratio: float
    frame_period_s: float = 0.1
    motion: MotionCard
    renderer: str = "default"
    """Name of a renderer card, or a path to one."""
    seed: int = 0
    sequence: tuple[SequenceCard, ...] = field(default=())

    def __post_init__(self) -> None:
        self.shutter()
        for sequence in self.sequence:
            self.rig_of(sequence)
        if not self.frame_period_s > 0:
            raise ValueError(f"frame_period_s must be positive, got {self.frame_period_s}")
        names = [sequence.name for sequence in self.sequence]
        if not names:
            raise ValueError("a dataset needs at least one [[sequence]]")
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two sequences are named {name!r}")

    def rig_of(self, sequence: SequenceCard) -> StereoRig:
        camera = PinholeCamera.centred(self.camera.width, self.camera.height, self.camera.focal)
        baseline = self.baseline if sequence.baseline is None else sequence.baseline
        return StereoRig(camera=camera, baseline=baseline)

    def shutter(self) -> RollingShutter:
        return RollingShutter(height=self.camera.height, readout_ratio=self.readout_ratio)

    def motion_of(self, sequence: SequenceCard) -> Motion:
        return (sequence.motion or self.motion).motion()

    def seed_of(self, sequence: SequenceCard) -> int:
        return self.seed if sequence.seed is None else sequence.seed

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


def load_dataset_card(name_or_path: str) -> DatasetCard:
    """Dataset card by name or path; errors as ``rsbench.cards.load_card``."""
    return load_card(DatasetCard, "datasets", name_or_path)
