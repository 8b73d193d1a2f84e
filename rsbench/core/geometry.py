"""A moving rig as one object: cameras, shutter and motion, with the objects that it passes."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from rsbench.core.motion import Motion
from rsbench.core.moving_objects import MovingObject
from rsbench.core.rig import FRAMES, StereoRig
from rsbench.core.shutter import RollingShutter


class MovingRig(Protocol):
    """What sees, how it reads and how it moves."""

    @property
    def rig(self) -> StereoRig: ...
    @property
    def shutter(self) -> RollingShutter: ...
    @property
    def motion(self) -> Motion: ...


class Geometry(MovingRig, Protocol):
    """A rig on its way past objects, which may move by themselves: a ``Sequence`` is one."""

    @property
    def frames(self) -> int: ...
    @property
    def objects(self) -> tuple[MovingObject, ...]: ...


class GivenGeometry(NamedTuple):
    """A ``Geometry`` that is no sequence."""

    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    frames: int = len(FRAMES)
    objects: tuple[MovingObject, ...] = ()
    """Those that move by themselves, in the order of their numbers from 1."""
