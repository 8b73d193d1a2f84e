"""Objects that move by themselves, as a card and a sequence.json say them; and their files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.components.motion_models import motion_record, read_motion
from rsbench.core.geometry import MovingObject
from rsbench.dataset.channels import CHANNELS, Channel
from rsbench.dataset.motion_card import MotionCard
from rsbench.scenes.object_meshes import MOST_MOVING, Body, MeshFile

TAKEN: tuple[Channel, ...] = ("disparity", "flow", "gs_flow", "timing", "normals", "instances", "imu", "hdr")
"""Channels that know of moving objects, or that these do not matter to."""
NUMBER, SHADED = 127, 128
"""Of a label: the bits of the number, and the one that says that a moving object hides the sun."""


@dataclass(frozen=True, kw_only=True)
class MovingCard(Body):
    """An object and how it moves: turned about its position and shifted, as the motion says of a body."""

    motion: MotionCard
    """The object's own motion: it turns about its position and is shifted."""

    def scaled(self, by: float) -> MovingCard:
        """All lengths times a factor."""
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
        """With the path of its mesh file, which a card names relative to its folder."""
        if self.mesh is None:
            return self
        path = folder / Path(self.mesh.file).expanduser()
        return replace(self, mesh=replace(self.mesh, file=str(path)))

    @property
    def thing(self) -> MovingObject:
        return MovingObject(np.array(self.position), self.motion.motion())

    @property
    def record(self) -> dict[str, Any]:
        """As sequence.json holds it; of a mesh file, the name without folders."""
        values = {field.name: getattr(self, field.name) for field in fields(Body) if field.name != "mesh"}
        listed = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
        mesh: dict[str, Any] = (
            {} if self.mesh is None else {"mesh": asdict(replace(self.mesh, file=self.mesh.name))}
        )
        return listed | mesh | {"motion": motion_record(self.motion.motion())}


def drawn(
    moving: Sequence[MovingCard], seed: int, name: str, lasting: float | None = None
) -> tuple[MovingCard, ...]:
    """With the axes of their motions drawn, see ``MotionCard.drawn``.

    Args:
        moving: the objects.
        seed: of the sequence.
        name: of the sequence.
        lasting: until when they move, frame periods; by default as long as those of two frames.

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


def check_moving(moving: Sequence[Body], channels: Sequence[str]) -> None:
    """Raises ValueError for too many objects, two files of one name, or a channel that knows nothing of them."""
    if len(moving) > MOST_MOVING:
        raise ValueError(f"moving: {len(moving)} objects: at most {MOST_MOVING}")
    named = {(each.mesh.name, each.mesh.file) for each in moving if each.mesh is not None}
    for name, count in Counter(name for name, _ in named).items():
        if count > 1:
            raise ValueError(f"moving: two mesh files are named {name!r}: rename one")
    refused = [name for name in channels if name in CHANNELS and name not in TAKEN]
    if moving and refused:
        raise ValueError(
            f"channels: {refused[0]!r} does not know of moving objects; these sequences have {', '.join(TAKEN)}"
        )


def _times(vector: tuple[float, float, float], by: float) -> tuple[float, float, float]:
    x, y, z = (by * value for value in vector)
    return x, y, z
