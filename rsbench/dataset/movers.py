"""Objects that move by themselves, as a card and a sequence.json say them; and their files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.moving import MovingObject
from rsbench.core.rig import FRAMES
from rsbench.dataset.channels import CHANNELS, Channel
from rsbench.dataset.motion_card import MotionCard
from rsbench.motions import motion_record, read_motion
from rsbench.scenes.bodies import MOST_MOVING, Body

TAKEN: tuple[Channel, ...] = ("disparity", "flow", "gs_flow", "timing", "normals", "instances", "imu", "hdr")
"""Channels that know of moving objects, or that these do not matter to."""
NUMBER, SHADED = 127, 128
"""Of a label: the bits of the number, and the one that says that a moving object hides the sun."""


@dataclass(frozen=True, kw_only=True)
class MovingCard(Body):
    """An object and how it moves: turned about its position and shifted, as the motion says of a body."""

    motion: MotionCard

    def scaled(self, by: float) -> MovingCard:
        """All lengths times a factor."""
        motion, box = self.motion, self.box
        if motion.translation is not None:
            motion = replace(motion, translation=motion.translation * by)
        position = _times(self.position, by)
        return replace(self, motion=motion, position=position, box=None if box is None else _times(box, by))

    @property
    def thing(self) -> MovingObject:
        return MovingObject(np.array(self.position), self.motion.motion())

    @property
    def record(self) -> dict[str, Any]:
        """As sequence.json holds it."""
        values = {field.name: getattr(self, field.name) for field in fields(Body)}
        listed = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
        return listed | {"motion": motion_record(self.motion.motion())}


def drawn(moving: Sequence[MovingCard], seed: int, name: str) -> tuple[MovingCard, ...]:
    """With the axes of their motions drawn, see ``MotionCard.drawn``."""
    return tuple(
        replace(each, motion=each.motion.drawn(seed, f"{name}/moving/{number}"))
        for number, each in enumerate(moving, start=1)
    )


@dataclass(frozen=True, kw_only=True)
class MovingManifest(Body):
    """The same in a sequence.json."""

    motion: dict[str, Any]

    @property
    def thing(self) -> MovingObject:
        """Raises RsbenchError as ``motions.read_motion``."""
        return MovingObject(np.array(self.position), read_motion(self.motion))

    def __post_init__(self) -> None:
        super().__post_init__()
        if missing := {"model", "w", "d"} - self.motion.keys():
            raise ValueError(f"moving: motion: {min(missing)!r} is required")


def numbers_of(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Of the objects at labels (...); 0 = none."""
    return np.asarray(labels & NUMBER, dtype=np.uint8)


def check_moving(moving: Sequence[Body], channels: Sequence[str], frames: int) -> None:
    """Raises ValueError for too many objects or frames, or a channel that knows nothing of them."""
    if moving and frames > len(FRAMES):
        raise ValueError(f"moving: objects move in sequences of {len(FRAMES)} frames only, not of {frames}")
    if len(moving) > MOST_MOVING:
        raise ValueError(f"moving: {len(moving)} objects: at most {MOST_MOVING}")
    refused = [name for name in channels if name in CHANNELS and name not in TAKEN]
    if moving and refused:
        raise ValueError(
            f"channels: {refused[0]!r} does not know of moving objects; these sequences have {', '.join(TAKEN)}"
        )


def _times(vector: tuple[float, float, float], by: float) -> tuple[float, float, float]:
    x, y, z = (by * value for value in vector)
    return x, y, z
