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
from rsbench.vision.reprojection import Reprojection, homography, land, parallax_gain, reproject, reprojection_of

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_REACH = 0.2
"""Of the image's longer side: the largest parallax that is searched."""
_WINDOW = 5
_NOWHERE = 40
"""Cost of a place outside the frame; inside it is at most 24 bits and ``_LEVELS``."""
_LEVELS = 16
_BAND = 32
"""Rows whose costs of all depths are kept at a time."""
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
    wanted: tuple[int, ...] = (0, 1),
) -> tuple[F32, F32]:
    """Depth (H, W), metres, of the pixels of both frames of one camera whose depth is 0; 0 where it stays unknown.

    ``images`` (H, W[, 3]) are uint8 or uint16, ``depths`` (H, W) what is known of both; inf is infinitely far. The
    warp moves a pixel by less than its parallax between the frames, so the depth is as good as the correction
    needs it, however small the parallax.

    Args:
        wanted: frames whose depth is asked for; that of the others stays unknown.
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
    for frame in (*wanted, *({0, 1} - set(wanted))):
        searched = unknown[frame]
        if frame not in wanted:  # only to confirm the other one
            searched = searched & _landed(rhos[1 - frame], unknown[1 - frame], maps[1 - frame])
        y, x = np.nonzero(searched)
        both = (greys[frame], greys[1 - frame], censuses[frame], censuses[1 - frame])
        rhos[frame][y, x] = _search(y, x, both, maps[frame], count, 1.0 / gain)
    for frame in wanted:
        _keep_agreeing(rhos[frame], rhos[1 - frame], unknown[frame], maps[frame], _AGREE_PX / gain, found[frame])
    return found


def _landed(rho: F32, wanted: Mask, maps: Reprojection) -> Mask:
    """Places (H, W) of the other frame where ``wanted`` pixels are seen, and those in their windows."""
    marks = np.zeros(rho.shape, dtype=np.uint8)
    _mark(rho, wanted, maps, marks)
    return np.asarray(cv2.dilate(marks, np.ones((_WINDOW, _WINDOW), np.uint8)) > 0)


def _search(
    y: NDArray[np.int64],
    x: NDArray[np.int64],
    both: tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint32], NDArray[np.uint32]],
    maps: Reprojection,
    count: int,
    step: float,
) -> F32:
    """Inverse depth (n,) at which pixels (n,), in order of rows, look most alike, of multiples of ``step``; NaN:
    none does."""
    numbers = np.full(both[0].shape, -1, dtype=np.int64)
    numbers[y, x] = np.arange(len(y))
    best, costs = np.zeros(len(y), dtype=np.int64), np.zeros((len(y), 3), dtype=np.float32)
    firsts = np.searchsorted(y, np.arange(len(numbers) + 1))
    _find_best(y, x, numbers, firsts, *both, maps, count, step, best, costs)
    before, least, after = costs.T
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
def ones(bits: np.uint32) -> np.int64:
    """Number of bits that are 1 (Warren, "Hacker's delight", 2002)."""
    n = np.uint64(bits)
    n -= (n >> np.uint64(1)) & np.uint64(0x5555555555555555)
    n = (n & np.uint64(0x3333333333333333)) + ((n >> np.uint64(2)) & np.uint64(0x3333333333333333))
    n = (n + (n >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((n * np.uint64(0x0101010101010101)) >> np.uint64(56))


@compiled(error_model="numpy")
def _find_best(
    y: NDArray[np.int64],
    x: NDArray[np.int64],
    numbers: NDArray[np.int64],
    firsts: NDArray[np.int64],
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    census: NDArray[np.uint32],
    other_census: NDArray[np.uint32],
    maps: Reprojection,
    count: int,
    step: float,
    best: NDArray[np.int64],
    costs: F32,
) -> None:
    """Number of the best inverse depth of each pixel (n,), and the mean costs in its window (n, 3) of that before
    it, of itself, and of that after it; infinite of none.

    Args:
        numbers: (H, W) of the pixels, -1 of those that are not searched.
        firsts: (H + 1,) number of the first pixel of each row.
    """
    height, width = grey.shape
    reach = _WINDOW // 2
    most = 0
    for top in range(0, height, _BAND):
        low, high = firsts[max(top - reach, 0)], firsts[min(top + _BAND + reach, height)]
        most = max(most, high - low)
    volume = np.zeros((most, count), dtype=np.uint8)
    total = np.zeros(count, dtype=np.uint16)
    for top in range(0, height, _BAND):
        low, high = firsts[max(top - reach, 0)], firsts[min(top + _BAND + reach, height)]
        for i in range(low, high):
            here = grey[y[i], x[i]], census[y[i], x[i]]
            _fill_costs(y[i], x[i], here[0], here[1], other, other_census, maps, step, volume[i - low])
        for i in range(firsts[top], firsts[min(top + _BAND, height)]):
            total[:] = 0
            weight = 0
            for v in range(max(y[i] - reach, 0), min(y[i] + reach + 1, height)):
                for u in range(max(x[i] - reach, 0), min(x[i] + reach + 1, width)):
                    if numbers[v, u] >= 0:
                        weight += 1
                        row = volume[numbers[v, u] - low]
                        for k in range(count):
                            total[k] += row[k]
            best[i] = _least(total, np.float32(weight), costs[i])


@compiled(error_model="numpy")
def _least(total: NDArray[np.uint16], weight: np.float32, costs: F32) -> int:
    """The first number of the least cost; fills it and those beside it."""
    best = 0
    for k in range(1, len(total)):
        if total[k] < total[best]:
            best = k
    costs[0] = total[best - 1] / weight if best > 0 else np.inf
    costs[1] = total[best] / weight
    costs[2] = total[best + 1] / weight if best + 1 < len(total) else np.inf
    return best


@compiled(error_model="numpy")
def _fill_costs(
    y: int,
    x: int,
    level: np.uint8,
    bits: np.uint32,
    other: NDArray[np.uint8],
    other_census: NDArray[np.uint32],
    maps: Reprojection,
    step: float,
    cost: NDArray[np.uint8],
) -> None:
    """Cost of each inverse depth (count,) at a pixel."""
    height, width = other.shape
    lines = len(maps.A)
    line = line_of(maps.columns, x, y)
    M, b = homography(x, y, line, maps)
    for k in range(len(cost)):
        # One step along the curve changes the line by one at most: its pose is that of the last landing.
        u, v, _ = land(M, b, k * step, maps.lens)
        along = across_lines(maps.there, u, v)
        if -lines < along < 2 * lines:
            landed = min(max(int(along + 0.5), 0), lines - 1)
            if landed != line:
                line = landed
                M, b = homography(x, y, line, maps)
        value = _NOWHERE
        if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
            ty, tx = int(v + 0.5), int(u + 0.5)
            unlike = abs(np.int64(level) - np.int64(other[ty, tx]))
            value = ones(bits ^ other_census[ty, tx]) + min(unlike, _LEVELS)
        cost[k] = value


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
    for y in range(height):
        for x in range(width):
            if not wanted[y, x] or not rho[y, x] >= 0.0:
                continue
            u, v, s = _seen_at(x, y, rho[y, x], maps)
            inside = -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5
            if inside and abs(other[int(v + 0.5), int(u + 0.5)] - rho[y, x] * s) <= tolerance:
                depth[y, x] = 1.0 / rho[y, x] if rho[y, x] > 0.0 else np.inf


@compiled(error_model="numpy")
def _mark(rho: F32, wanted: Mask, maps: Reprojection, marks: NDArray[np.uint8]) -> None:
    """Mark where the other frame sees ``wanted`` pixels."""
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            if wanted[y, x] and rho[y, x] >= 0.0:
                u, v, _ = _seen_at(x, y, rho[y, x], maps)
                if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
                    marks[int(v + 0.5), int(u + 0.5)] = 1


@compiled(error_model="numpy")
def _seen_at(x: int, y: int, rho: float, maps: Reprojection) -> tuple[float, float, float]:
    """Where the other frame sees a pixel, and its inverse depth there by that here."""
    lines = len(maps.A)
    line, u, v, s = line_of(maps.columns, x, y), np.nan, np.nan, np.nan
    for _ in range(6):
        u, v, s = reproject(x, y, rho, line, maps)
        along = across_lines(maps.there, u, v)
        if not -lines < along < 2 * lines:
            break
        line = min(max(int(along + 0.5), 0), lines - 1)
    return u, v, s
