"""Where pixels of a rolling-shutter frame lie in another picture, by triangles traced in float64 and bisection.

Things that move are traced at each ray's own time.

Shares nothing with rsbench but the numbers of a sequence: the truth that channels are compared with. Lenses are
OpenCV's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import Side
from rsbench.dataset.channels import PairChannel
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import PixelClass

Array = NDArray[np.float64]
FirstHit = Callable[[Array, Array], Array]
"""Parameter (n,) of the first triangle along rays: origins and directions (n, 3); inf where there is none."""


def first_hit(triangles: Array, origins: Array, ways: Array) -> Array:
    """Parameter (n,) of the first triangle along rays (n, 3); inf where there is none (Moeller and Trumbore)."""
    nearest = np.full(len(origins), np.inf)
    for a, b, c in triangles:
        p = np.cross(ways, c - a)
        det = p @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum((origins - a) * p, axis=1) / det
            q = np.cross(origins - a, b - a)
            v = np.sum(ways * q, axis=1) / det
            t = q @ (c - a) / det
        hit = (np.abs(det) > 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
        nearest = np.where(hit & (t < nearest), t, nearest)
    return nearest


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

    still: FirstHit
    things: tuple[Thing, ...] = ()

    def hit(self, origins: Array, directions: Array, tau: Array) -> tuple[Array, NDArray[np.int64]]:
        """Parameter (n,) of the first triangle along rays at times (n,), and the number of its thing; 0: still."""
        nearest = self.still(origins, directions)
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


def pose_at(sequence: Sequence, side: Side, tau: Array) -> tuple[Array, Array]:
    """``cam_from_world`` (n, 3, 3), (n, 3) of the paper's motion at times (n,)."""
    half = 0.5 * sequence.rig.baseline * (1.0 if side == "left" else -1.0)
    turn = Rotation.from_rotvec(sequence.rig.own(side).rotation)
    R = turn * Rotation.from_rotvec(tau[:, None] * sequence.motion.w)
    return R.as_matrix(), turn.apply(tau[:, None] * sequence.motion.d + [half, 0.0, 0.0])


def matrices(camera: PinholeCamera) -> tuple[Array, Array, bool]:
    """OpenCV's camera matrix and coefficients, and whether they are those of its fisheye."""
    lens = camera.lens
    names = ("k1", "k2", "p1", "p2", "k3")
    fisheye = lens is not None and lens.model == "kannala-brandt"
    values = [getattr(lens, name, 0.0) for name in (("k1", "k2", "k3", "k4") if fisheye else names)]
    return camera.ideal.K, np.array(values), fisheye


def rays(sequence: Sequence, side: Side, tau: Array, pixels: Array) -> tuple[Array, Array]:
    """Origins and directions (n, 3), camera z = 1, world frame."""
    K, k, fisheye = matrices(sequence.rig.sensor(side))
    R, t = pose_at(sequence, side, tau)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-13)
    undistort = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    xy = undistort(np.ascontiguousarray(pixels)[:, None], K, k, criteria=stop)[:, 0]
    local = np.column_stack([xy, np.ones(len(pixels))])
    return -np.einsum("nji,nj->ni", R, t), np.einsum("nji,nj->ni", R, local)


def look(sequence: Sequence, side: Side, tau: Array, X: Array) -> Array:
    """Pixels (n, 2) of points (n, 3) at times (n,); NaN behind the camera."""
    K, k, fisheye = matrices(sequence.rig.sensor(side))
    R, t = pose_at(sequence, side, tau)
    x = np.einsum("nij,nj->ni", R, X) + t
    none, before = np.zeros(3), np.where(x[:, 2:] > 0, x, [0.0, 0.0, 1.0])
    if fisheye:
        pixels, _ = cv2.fisheye.projectPoints(before[:, None], none, none, K, k)
    else:
        pixels, _ = cv2.projectPoints(before[:, None], none, none, K, k)
    return np.where(x[:, 2:] > 0, pixels[:, 0], np.nan)


def line_times(sequence: Sequence, side: Side, frame: int, lines: Array) -> Array:
    """Times (n,) at which a camera reads lines, counted from the top or the left."""
    s, camera = sequence.shutter, sequence.rig.sensor(side)
    scan, late, ratio = s.scan, 0.0, s.readout_ratio
    if side == "right":
        scan, late = s.right_scan or scan, s.right_delay
        ratio = ratio if s.right_readout_ratio is None else s.right_readout_ratio
    count = camera.height if scan in ("top", "bottom") else camera.width
    read = count - 1 - lines if scan in ("bottom", "right") else lines
    return np.asarray(frame + late + ratio / count * read)


def axis_of(sequence: Sequence, side: Side) -> int:
    """1 where a camera reads rows, 0 where it reads columns."""
    s = sequence.shutter
    return int(((s.right_scan or s.scan) if side == "right" else s.scan) in ("top", "bottom"))


def crossing(sequence: Sequence, side: Side, frame: int, at: Callable[[Array], Array], count: int) -> Array:
    """Lines (n,) that see points, which are ``at`` (n, 3) at times (n,), by bisection; NaN where none does."""
    axis, camera = axis_of(sequence, side), sequence.rig.sensor(side)
    last = (camera.width, camera.height)[axis] - 0.5

    def below(line: Array) -> Array:
        tau = line_times(sequence, side, frame, line)
        return look(sequence, side, tau, at(tau))[:, axis] - line

    low, high = np.full(count, -0.5), np.full(count, last)
    crosses = (below(low) >= 0) & (below(high) <= 0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        right = below(middle) >= 0
        low, high = np.where(right, middle, low), np.where(right, high, middle)
    return np.where(crosses, low, np.nan)


def row_seeing(sequence: Sequence, side: Side, frame: int, X: Array) -> Array:
    """Rows (n,) that see points, by bisection; NaN where there is none in the picture."""
    return crossing(sequence, side, frame, lambda tau: X, len(X))


def grid_of(sequence: Sequence, side: Side) -> Array:
    """Pixels (n, 2), row by row."""
    camera = sequence.rig.sensor(side)
    y, x = (each.ravel().astype(float) for each in np.mgrid[: camera.height, : camera.width])
    return np.column_stack([x, y])


def line_of(sequence: Sequence, side: Side, row: int) -> int:
    """The line that is read after so many others."""
    s, camera = sequence.shutter, sequence.rig.sensor(side)
    scan = (s.right_scan or s.scan) if side == "right" else s.scan
    last = (camera.height if scan in ("top", "bottom") else camera.width) - 1
    return last - row if scan in ("bottom", "right") else row


def within(sequence: Sequence, side: Side, pixels: Array) -> NDArray[np.bool_]:
    """Whether pixels (n, 2) lie in a camera's image."""
    camera = sequence.rig.sensor(side)
    with np.errstate(invalid="ignore"):
        last = [camera.width - 0.5, camera.height - 0.5]
        return np.asarray(np.all((pixels >= -0.5) & (pixels <= last), axis=1))


def truth(
    sequence: Sequence,
    world: World,
    channel: PairChannel,
    side: Side,
    frame: int,
    row: int = 0,
    *,
    back: bool = False,
    chosen: NDArray[np.int64] | None = None,
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Offsets (n, 2) x_target - x_source and classes (n,) of pixels, in the order of their rows, and their things.

    ``row``: of a global-shutter twin; ``back``: to the frame before; ``chosen`` (n,): numbers of pixels.
    """
    pixels = grid_of(sequence, side) if chosen is None else grid_of(sequence, side)[chosen]
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
    # The eye is off the surface that ends the segment by far more than rounding: 1e-6 of the way.
    hidden = world.hit(eyes, arrived - eyes, tau)[0] < 1 - 1e-6
    classes = np.where(
        sky,
        np.where(hidden, PixelClass.SKY_OCCLUDED, PixelClass.SKY),
        np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE),
    )
    return landed - pixels, np.where(inside, classes, PixelClass.OUT_OF_VIEW), owner


class Agreement(NamedTuple):
    """Of pixels (n,): both pictures have it, it is within 0.01 px of the truth, of the same class; its thing."""

    both: NDArray[np.bool_]
    near: NDArray[np.bool_]
    alike: NDArray[np.bool_]
    owner: NDArray[np.int64]


def agreement(
    sequence: Sequence,
    world: World,
    channel: PairChannel,
    side: Side,
    frame: int,
    row: int = 0,
    back: bool = False,
) -> Agreement:
    """Of a stored channel with the truth."""
    offset, classes, owner = truth(sequence, world, channel, side, frame, row, back=back)
    if channel == "disparity":
        offset = offset[:, :1] * (1 if side == "right" else -1)
    stored = sequence.offsets(channel, side, frame, row, back).reshape(offset.shape)
    kinds = sequence.classes(channel, side, frame, row, back).ravel()
    both = (kinds != PixelClass.OUT_OF_VIEW) & (classes != PixelClass.OUT_OF_VIEW)
    near = np.max(np.abs(stored - offset), axis=1) <= 0.01
    return Agreement(both, ~both | near, kinds == classes, owner)
