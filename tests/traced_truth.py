"""Where pixels of a rolling-shutter frame lie in another picture, by triangles traced in float64 and bisection.

Shares nothing with rsbench but the numbers of a sequence: the truth that channels are compared with.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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


def pose_at(sequence: Sequence, side: str, tau: Array) -> tuple[Array, Array]:
    """``cam_from_world`` (n, 3, 3), (n, 3) of the paper's motion at times (n,)."""
    half = 0.5 * sequence.rig.baseline * (1.0 if side == "left" else -1.0)
    R = Rotation.from_rotvec(tau[:, None] * sequence.motion.w).as_matrix()
    return R, tau[:, None] * sequence.motion.d + [half, 0.0, 0.0]


def rays(sequence: Sequence, side: str, tau: Array, pixels: Array) -> tuple[Array, Array]:
    """Origins and directions (n, 3), camera z = 1, world frame."""
    camera = sequence.rig.camera
    R, t = pose_at(sequence, side, tau)
    local = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))])
    return -np.einsum("nji,nj->ni", R, t), np.einsum("nji,nj->ni", R, local)


def look(sequence: Sequence, side: str, tau: Array, X: Array) -> Array:
    """Pixels (n, 2) of points (n, 3) at times (n,); NaN behind the camera."""
    camera = sequence.rig.camera
    R, t = pose_at(sequence, side, tau)
    x = np.einsum("nij,nj->ni", R, X) + t
    z = np.where(x[:, 2:] > 0, x[:, 2:], np.nan)
    return np.asarray(x[:, :2] / z * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def row_seeing(sequence: Sequence, side: str, frame: int, X: Array) -> Array:
    """Rows (n,) that see points, by bisection; NaN where there is none in the picture."""
    height, h = sequence.shutter.height, sequence.shutter.readout_ratio / sequence.shutter.height

    def below(y: Array) -> Array:
        return look(sequence, side, frame + h * y, X)[:, 1] - y

    low, high = np.full(len(X), -0.5), np.full(len(X), height - 0.5)
    crosses = (below(low) >= 0) & (below(high) <= 0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        right = below(middle) >= 0
        low, high = np.where(right, middle, low), np.where(right, high, middle)
    return np.where(crosses, low, np.nan)


def truth(
    sequence: Sequence,
    hit: FirstHit,
    channel: PairChannel,
    side: str,
    frame: int,
    row: int = 0,
    chosen: NDArray[np.int64] | None = None,
) -> tuple[Array, Array]:
    """Offsets (n, 2) x_target - x_source and classes (n,) of pixels, in the order of their rows.

    ``row``: of a global-shutter twin; ``chosen`` (n,): numbers of pixels, all by default.
    """
    width, height = sequence.rig.camera.width, sequence.rig.camera.height
    y, x = (each.ravel().astype(float) for each in np.mgrid[:height, :width])
    y, x = (y, x) if chosen is None else (y[chosen], x[chosen])
    pixels, h = np.column_stack([x, y]), sequence.shutter.readout_ratio / height
    origins, ways = rays(sequence, side, frame + h * y, pixels)
    depth = hit(origins, ways)
    sky = np.isinf(depth)
    X = origins + ways * np.where(sky, 1e8, depth)[:, None]
    if channel == "disparity":
        side, tau = ("right" if side == "left" else "left"), frame + h * y
    elif channel == "flow":
        frame = 1 - frame
        tau = frame + h * row_seeing(sequence, side, frame, X)
    else:
        tau = np.full(len(X), frame + h * row)
    lost = np.isnan(tau)
    tau = np.where(lost, 0.0, tau)
    landed = look(sequence, side, tau, X)
    with np.errstate(invalid="ignore"):
        inside = ~lost & np.all((landed >= -0.5) & (landed <= [width - 0.5, height - 0.5]), axis=1)
    eyes, _ = rays(sequence, side, tau, pixels)
    # The eye is off the surface that ends the segment by far more than rounding: 1e-6 of the way.
    hidden = hit(eyes, X - eyes) < 1 - 1e-6
    classes = np.where(
        sky,
        np.where(hidden, PixelClass.SKY_OCCLUDED, PixelClass.SKY),
        np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE),
    )
    return landed - pixels, np.where(inside, classes, PixelClass.OUT_OF_VIEW)
