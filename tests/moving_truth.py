"""What ``traced_truth`` is, where things move: triangles in float64 at each ray's own time, rows by bisection."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from traced_truth import Array, axis_of, crossing, first_hit, grid_of, line_of, line_times, look, rays, within

from rsbench.core.rig import Side
from rsbench.dataset.channels import PairChannel
from rsbench.dataset.sequence import Sequence as Recorded
from rsbench.dataset.views import PixelClass


class Thing(NamedTuple):
    """Triangles (m, 3, 3) at time 0, and how they turn about a pivot and are shifted in one frame period."""

    triangles: Array
    pivot: Array
    w: Array
    d: Array

    def moved(self, X: Array, tau: Array) -> Array:
        """Points (n, 3) of time 0 at times (n,)."""
        return (
            Rotation.from_rotvec(tau[:, None] * self.w).apply(X - self.pivot) + self.pivot + tau[:, None] * self.d
        )

    def back(self, X: Array, tau: Array) -> Array:
        turn = Rotation.from_rotvec(tau[:, None] * self.w).inv()
        return np.asarray(turn.apply(X - self.pivot - tau[:, None] * self.d) + self.pivot)


class World(NamedTuple):
    """What stands still, and what moves."""

    still: Array
    things: Sequence[Thing]

    def hit(self, origins: Array, directions: Array, tau: Array) -> tuple[Array, NDArray[np.int64]]:
        """Parameter (n,) of the first triangle along rays at times (n,), and the number of its thing; 0: still."""
        nearest = first_hit(self.still, origins, directions)
        owner = np.zeros(len(nearest), dtype=np.int64)
        for number, thing in enumerate(self.things, start=1):
            start = thing.back(origins, tau)
            own = first_hit(thing.triangles, start, thing.back(origins + directions, tau) - start)
            owner[own < nearest] = number
            nearest = np.minimum(nearest, own)
        return nearest, owner

    def carried(self, X: Array, owner: NDArray[np.int64], tau: Array, to: Array) -> Array:
        """Points (n, 3) at times ``tau`` (n,), at times ``to``."""
        result = X.copy()
        for number, thing in enumerate(self.things, start=1):
            own = owner == number
            result[own] = thing.moved(thing.back(X[own], tau[own]), to[own])
        return result


def row_times(sequence: Recorded, frame: int, y: Array) -> Array:
    return np.asarray(frame + sequence.shutter.readout_ratio / sequence.shutter.height * y)


def truth(
    sequence: Recorded,
    world: World,
    channel: PairChannel,
    side: Side,
    frame: int,
    row: int = 0,
    *,
    back: bool = False,
) -> tuple[Array, Array, NDArray[np.int64]]:
    """As ``traced_truth.truth``, of all pixels, ``back``: to the frame before; and the thing (n,) of each."""
    pixels = grid_of(sequence, side)
    start = line_times(sequence, side, frame, pixels[:, axis_of(sequence, side)])
    origins, directions = rays(sequence, side, start, pixels)
    depth, owner = world.hit(origins, directions, start)
    sky = np.isinf(depth)
    X = origins + directions * np.where(sky, 1e8, depth)[:, None]
    to, there = frame, side
    if channel == "disparity":
        there, tau = ("right" if side == "left" else "left"), start
    elif channel == "flow":
        to = frame - 1 if back or frame == sequence.frames - 1 else frame + 1
        lines = crossing(sequence, side, to, lambda time: world.carried(X, owner, start, time), len(X))
        tau = line_times(sequence, side, to, lines)
    else:
        tau = np.full(len(X), line_times(sequence, side, frame, np.array(float(line_of(sequence, side, row)))))
    lost = np.isnan(tau)
    tau = np.where(lost, 0.0, tau)
    arrived = world.carried(X, owner, start, tau)
    landed = look(sequence, there, tau, arrived)
    inside = ~lost & within(sequence, there, landed)
    eyes, _ = rays(sequence, there, tau, pixels)
    hidden = world.hit(eyes, arrived - eyes, tau)[0] < 1 - 1e-6  # as in ``traced_truth``
    classes = np.where(
        sky,
        np.where(hidden, PixelClass.SKY_OCCLUDED, PixelClass.SKY),
        np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE),
    )
    return landed - pixels, np.where(inside, classes, PixelClass.OUT_OF_VIEW), owner
