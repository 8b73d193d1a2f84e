"""Depth of thin and near things from a camera's own known motion: a search along every pixel's epipolar curve.

Dense flow carries a thin post along with what is behind it. Where the motion is known the flow of a pixel has one
unknown, its inverse depth; every value of a grid is tried, and the one at which the other frame looks most alike
in a small window, of pixels that need a depth themselves, wins. It counts where the other frame's depth agrees.

Costs: Zabih, Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994, and the
truncated difference of grey levels.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.vision.compiled_camera import across_lines, line_of
from rsbench.vision.correction import inverse_depth
from rsbench.vision.images import grey_u8
from rsbench.vision.reprojection import Reprojection, parallax_gain, reproject, reprojection_of

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_REACH = 0.2
"""Of the image's longer side: the largest parallax that is searched."""
_WINDOW = 5
_NOWHERE = 40.0
"""Cost of a place outside the frame; inside it is at most 24 bits and ``_LEVELS``."""
_LEVELS = 16.0
_ALIKE = 14.0
"""Largest mean cost in the window of a depth that counts; unlike places cost about 20."""
_AGREE_PX = 1.5
"""Largest difference of parallax between a pixel and the place where the other frame sees it."""


def depth_from_motion(
    images: tuple[NDArray[Any], NDArray[Any]],
    depths: tuple[F32, F32],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
) -> tuple[F32, F32]:
    """Depth (H, W), metres, of the pixels of both frames of one camera whose depth is 0; 0 where it stays unknown.

    ``images`` (H, W[, 3]) are uint8 or uint16, ``depths`` (H, W) what is known of both; inf is infinitely far. The
    warp moves a pixel by less than its parallax between the frames, so the depth is as good as the correction
    needs it, however small the parallax.
    """
    found = np.zeros_like(depths[0]), np.zeros_like(depths[1])
    poses = [row_poses(rig, shutter, motion, side, frame) for frame in (0, 1)]
    axes = (shutter.axis(side), shutter.axis(side))
    maps = [reprojection_of(rig.camera, poses[frame], poses[1 - frame], axes) for frame in (0, 1)]
    gain = parallax_gain(rig.camera, *maps)
    count = int(_REACH * max(depths[0].shape))
    unknown = [depth == 0.0 for depth in depths]
    if gain == 0.0 or not any(np.any(mask) for mask in unknown):
        return found
    greys = [grey_u8(image) for image in images]
    censuses = [census(grey) for grey in greys]
    rhos = [inverse_depth(depth) for depth in depths]
    for frame in (0, 1):
        y, x = (places.astype(np.int32) for places in np.nonzero(unknown[frame]))
        both = (greys[frame], greys[1 - frame], censuses[frame], censuses[1 - frame])
        rhos[frame][y, x] = _search(y, x, both, maps[frame], count, 1.0 / gain)
    for frame in (0, 1):
        _keep_agreeing(rhos[frame], rhos[1 - frame], unknown[frame], maps[frame], _AGREE_PX / gain, found[frame])
    return found


def _search(
    y: NDArray[np.int32],
    x: NDArray[np.int32],
    both: tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint32], NDArray[np.uint32]],
    maps: Reprojection,
    count: int,
    step: float,
) -> F32:
    """Inverse depth (n,) at which pixels (n,) look most alike, of multiples of ``step``; NaN: none does."""
    size, window = both[0].shape, (_WINDOW, _WINDOW)
    cost, weight = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float32)
    weight[y, x] = 1.0
    weight = cv2.boxFilter(weight, -1, window, borderType=cv2.BORDER_CONSTANT)[y, x]
    lines, best = (x if maps.columns else y).copy(), np.full(len(y), -1, dtype=np.int32)
    costs = np.full((len(y), 4), np.inf, dtype=np.float32)
    for k in range(count):
        _fill_costs(y, x, lines, *both, maps, k * step, cost)
        mean = cv2.boxFilter(cost, -1, window, borderType=cv2.BORDER_CONSTANT)[y, x] / weight
        _keep_best(k, mean, best, costs)
    before, least, after = costs[:, 1], costs[:, 0], costs[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        bend = before - 2.0 * least + after
        offset = np.where(np.isfinite(bend) & (bend > 0.0), 0.5 * (before - after) / bend, 0.0)
    rho = np.maximum(best + np.clip(offset, -0.5, 0.5), 0.0) * step
    return np.where((least <= _ALIKE) & (best < count - 1), rho, np.nan).astype(np.float32)


def census(grey: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(H, W) of 24 bits: which of the 5 x 5 neighbours are darker than the pixel."""
    padded = cv2.copyMakeBorder(grey, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    height, width = grey.shape
    bits = np.zeros(grey.shape, dtype=np.uint32)
    for k in range(25):
        if k != 12:
            bits = (bits << np.uint32(1)) | (padded[k // 5 :, k % 5 :][:height, :width] < grey)
    return bits


@compiled(error_model="numpy", inline="always")
def ones(bits: np.uint32) -> float:
    """Number of bits that are 1 (Warren, "Hacker's delight", 2002)."""
    n = np.int64(bits)
    n -= (n >> 1) & 0x55555555
    n = (n & 0x33333333) + ((n >> 2) & 0x33333333)
    n = (n + (n >> 4)) & 0x0F0F0F0F
    return float(((n * 0x01010101) & 0xFFFFFFFF) >> 24)


@compiled(error_model="numpy")
def _fill_costs(
    y: NDArray[np.int32],
    x: NDArray[np.int32],
    lines: NDArray[np.int32],
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    census: NDArray[np.uint32],
    other_census: NDArray[np.uint32],
    maps: Reprojection,
    rho: float,
    cost: F32,
) -> None:
    """Cost of one inverse depth at every pixel (n,); ``lines`` (n,) are those where the last one landed."""
    height, width = grey.shape
    count = len(maps.A)
    for i in range(len(y)):
        # One step along the curve changes the line by one at most: its pose is that of the last landing.
        u, v, _ = reproject(x[i], y[i], rho, lines[i], maps)
        along = across_lines(maps.there, u, v)
        if -count < along < 2 * count:
            lines[i] = min(max(int(along + 0.5), 0), count - 1)
        value = _NOWHERE
        if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
            ty, tx = int(v + 0.5), int(u + 0.5)
            bits = census[y[i], x[i]] ^ other_census[ty, tx]
            value = ones(bits) + min(abs(float(grey[y[i], x[i]]) - float(other[ty, tx])), _LEVELS)
        cost[y[i], x[i]] = value


@compiled(error_model="numpy")
def _keep_best(k: int, mean: F32, best: NDArray[np.int32], costs: F32) -> None:
    """``costs`` (n, 4): the least so far, those before and after it, and the last."""
    for i in range(len(mean)):
        if best[i] == k - 1:
            costs[i, 2] = mean[i]
        if mean[i] < costs[i, 0]:
            costs[i, 0], costs[i, 1], costs[i, 2] = mean[i], costs[i, 3], np.inf
            best[i] = k
        costs[i, 3] = mean[i]


@compiled(error_model="numpy")
def _keep_agreeing(
    rho: F32,
    other: F32,
    wanted: Mask,
    maps: Reprojection,
    tolerance: float,
    depth: F32,
) -> None:
    """Write the depth of ``wanted`` pixels whose inverse depth the other frame confirms where it sees them."""
    height, width = rho.shape
    lines = len(maps.A)
    for y in range(height):
        for x in range(width):
            if not wanted[y, x] or not rho[y, x] >= 0.0:
                continue
            line, u, v, s = line_of(maps.columns, x, y), np.nan, np.nan, np.nan
            for _ in range(6):
                u, v, s = reproject(x, y, rho[y, x], line, maps)
                along = across_lines(maps.there, u, v)
                if not -lines < along < 2 * lines:
                    break
                line = min(max(int(along + 0.5), 0), lines - 1)
            inside = -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5
            if inside and abs(other[int(v + 0.5), int(u + 0.5)] - rho[y, x] * s) <= tolerance:
                depth[y, x] = 1.0 / rho[y, x] if rho[y, x] > 0.0 else np.inf
