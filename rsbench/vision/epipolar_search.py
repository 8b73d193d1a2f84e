"""Depth from the known motion of one camera: a search along the epipolar curve of each pixel.

Dense flow follows gradients and loses objects that move by more than their own size: posts, signs, branches. If
the motion is known, the flow of a pixel has one unknown, its inverse depth. Evenly spaced values of it are
compared with the other frame (census and the truncated difference of grey levels). A result is used if the search
in the other frame agrees.

``depth_from_motion`` searches single pixels that need a depth, and averages costs over a small window of them;
``sweep_frames`` searches both frames at a fraction of their size and aggregates costs semi-globally
(``plane_sweep.aggregated``).

Costs: Zabih, Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import FRAMES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.vision.correction import inverse_depth
from rsbench.vision.images import grey_u8, map_frames
from rsbench.vision.plane_sweep import aggregated, winners
from rsbench.vision.reprojection import (
    Reprojection,
    across_lines,
    line_of,
    parallax_gain,
    reproject,
    reproject_pixels,
    reprojection_of,
)

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_REACH = 0.2
"""Largest parallax that is searched, as a share of the image's longer side."""
_WINDOW = 5
_PLAIN = 1, 1, 40
"""Cost of each of 24 bits that differs, of a grey level of difference, and of a place outside the other frame."""
_LEVELS = 16
"""Largest difference of grey levels that counts."""
_BAND = 32
"""Number of rows for which the costs of all depths are stored at a time."""
_ALIKE = 14.0
"""Largest mean cost, in the window, of an accepted depth; at wrong places it is about 20."""
_CHORD = 8
"""Number of steps along the curve between exactly computed places. Between them it is straight to 0.03 px."""
_BETTER = 6.0
"""Least difference of mean costs at which a found depth replaces a known one."""
_WORSE = 0.5
"""Difference of mean costs above which a depth fits the other camera's image clearly worse."""
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
    replace_unlike: bool = False,
    most_near: float = math.inf,
) -> tuple[F32, F32]:
    """Depth (H, W), metres, for pixels of both frames of one camera whose depth is 0; 0 where it stays unknown.

    ``images`` (H, W[, 3]) are uint8 or uint16, ``depths`` (H, W) the known depths of both frames; inf is
    infinitely far. The warp moves a pixel by less than its parallax between the frames, so the depth is accurate
    enough for the correction, however small the parallax is.

    Args:
        wanted: frames whose depth is needed; the depth of the others stays unknown.
        replace_unlike: also search pixels whose known depth leads to a place of the other frame that looks
            different, and replace it if another depth leads to a place that looks much more similar. Such errors
            of stereo occur on texture along the baseline.
        most_near: largest inverse depth, 1 / m, that is searched, if its parallax is below ``_REACH``.
    """
    found = np.zeros_like(depths[0]), np.zeros_like(depths[1])
    poses = [row_poses(rig, shutter, motion, side, frame) for frame in (0, 1)]
    axes = (shutter.axis(side), shutter.axis(side))
    maps = [reprojection_of(rig.sensor(side), poses[frame], poses[1 - frame], axes) for frame in (0, 1)]
    gain = parallax_gain(rig.sensor(side), *maps)
    unknown = [depth == 0.0 for depth in depths]
    if gain == 0.0 or not (replace_unlike or any(np.any(mask) for mask in unknown)):
        return found
    count = int(min(_REACH * max(depths[0].shape), math.ceil(min(gain * most_near, 1e6)) + _FEWEST))
    greys = [grey_u8(image) for image in images]
    censuses = [census(grey) for grey in greys]
    rhos = [inverse_depth(depth) for depth in depths]
    pairs = [(greys[k], greys[1 - k], censuses[k], censuses[1 - k]) for k in FRAMES]
    most = [np.full(depth.shape, _ALIKE, dtype=np.float32) for depth in depths]
    if replace_unlike:
        for k in FRAMES:
            cost = _known_costs(rhos[k], pairs[k], maps[k])
            unknown[k] |= cost > _ALIKE
            most[k] = np.where(depths[k] == 0.0, most[k], np.minimum(cost - np.float32(_BETTER), most[k]))
    for frame in (*wanted, *({0, 1} - set(wanted))):
        searched = unknown[frame]
        if frame not in wanted:  # only to confirm the other one
            searched = searched & _landed(rhos[1 - frame], unknown[1 - frame], maps[1 - frame])
        y, x = np.nonzero(searched)
        result = _search(y, x, pairs[frame], maps[frame], count, 1.0 / gain, most[frame][y, x])
        rhos[frame][y, x] = np.where(np.isnan(result), rhos[frame][y, x], result)
    for frame in wanted:
        _keep_agreeing(rhos[frame], rhos[1 - frame], unknown[frame], maps[frame], _AGREE_PX / gain, found[frame])
    return found


def stereo_contradicts(
    images: tuple[NDArray[Any], NDArray[Any]],
    known: F32,
    found: F32,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
) -> Mask:
    """(H, W) whether the depth ``found`` of a pixel fits the other camera's image clearly worse than ``known``.

    This is the case for independently moving objects: stereo gives their depth, the motion of the rig does not.

    Args:
        images: (H, W[, 3]) of that camera and of the other one, at one frame time; sizes may differ.
        known, found: (H, W) metres along that camera's axis; 0 where it is unknown.
    """
    other_side: Side = "right" if side == "left" else "left"
    here, there = (
        reprojection_of(rig.sensor(each), poses, poses, (shutter.axis(each),) * 2)
        for each in (side, other_side)
        for poses in (row_poses(rig, shutter, motion, each, frame),)
    )
    maps = here._replace(A=there.A, B=there.B, lens=there.lens, there=there.there)
    greys = [grey_u8(image) for image in images]
    both = (greys[0], greys[1], census(greys[0]), census(greys[1]))
    compared = (known > 0.0) & (found > 0.0)
    near = _windows(compared.astype(np.uint8))
    costs = [
        _known_costs(np.where(near, inverse_depth(depth), np.float32(np.nan)), both, maps)
        for depth in (known, found)
    ]
    return np.asarray(compared & (costs[1] > costs[0] + _WORSE))


def _known_costs(
    rho: F32,
    both: tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint32], NDArray[np.uint32]],
    maps: Reprojection,
) -> F32:
    """(H, W) mean cost, in the window, of known inverse depths ``rho`` (H, W); 0 outside the other frame."""
    costs = np.zeros(rho.shape, dtype=np.float32)
    seen = np.zeros(rho.shape, dtype=np.float32)
    _fill_known_costs(rho, *both, maps, costs, seen)
    window = (_WINDOW, _WINDOW)
    mean = cv2.blur(costs, window) / np.maximum(cv2.blur(seen, window), np.float32(1e-6))
    return np.where(seen > 0.0, mean, np.float32(0.0))


@compiled(error_model="numpy")
def _fill_known_costs(
    rho: F32,
    grey: NDArray[np.uint8],
    other: NDArray[np.uint8],
    code: NDArray[np.uint32],
    other_code: NDArray[np.uint32],
    maps: Reprojection,
    costs: F32,
    seen: F32,
) -> None:
    """Fill the cost (H, W) of known inverse depths, and whether (H, W) their places lie inside the other frame."""
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            if not rho[y, x] >= 0.0:
                continue
            u, v, _ = _seen_at(x, y, rho[y, x], maps)
            if -0.5 < u < other.shape[1] - 0.5 and -0.5 < v < other.shape[0] - 0.5:
                costs[y, x] = _cost(grey[y, x], code[y, x], other, other_code, u, v, _PLAIN)
                seen[y, x] = 1.0


def _landed(rho: F32, wanted: Mask, maps: Reprojection) -> Mask:
    """Places (H, W) of the other frame where ``wanted`` pixels are seen, and those in their windows."""
    marks = np.zeros(rho.shape, dtype=np.uint8)
    _mark(rho, wanted, maps, marks)
    return _windows(marks)


def _windows(marks: NDArray[np.uint8]) -> Mask:
    """Pixels (H, W) in the windows of those that are marked."""
    return np.asarray(cv2.dilate(marks, np.ones((_WINDOW, _WINDOW), np.uint8)) > 0)


def _search(
    y: NDArray[np.int64],
    x: NDArray[np.int64],
    both: tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint32], NDArray[np.uint32]],
    maps: Reprojection,
    count: int,
    step: float,
    most: F32,
) -> F32:
    """Multiple (n,) of ``step`` that is the best inverse depth of each pixel (n,), in order of rows; NaN: none
    costs at most ``most`` (n,)."""
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
    return np.where((least <= most) & (best < count - 1), rho, np.nan).astype(np.float32)


def census(grey: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(H, W) census of 24 bits: which of the 5 x 5 neighbours are darker than the pixel."""
    bits = np.zeros(grey.shape, dtype=np.uint32)
    _fill_census(cv2.copyMakeBorder(grey, 2, 2, 2, 2, cv2.BORDER_REPLICATE), bits)
    return bits


@compiled(error_model="numpy")
def _fill_census(padded: NDArray[np.uint8], bits: NDArray[np.uint32]) -> None:
    """Fill ``bits`` (H, W) with the census of an image (H + 4, W + 4) that is padded by 2 px."""
    height, width = bits.shape
    for y in range(height):
        row, centre = bits[y], padded[y + 2]
        for k in range(25):
            if k != 12:
                down, right = k // 5, k % 5
                beside = padded[y + down]
                for x in range(width):
                    row[x] = (row[x] << np.uint32(1)) | np.uint32(beside[x + right] < centre[x + 2])


@compiled(error_model="numpy", inline="always")
def ones(bits: np.uint32) -> np.int64:
    """Number of bits that are 1 (Warren, "Hacker's delight", 2002)."""
    n = np.uint64(bits)
    n -= (n >> np.uint64(1)) & np.uint64(0x5555555555555555)
    n = (n & np.uint64(0x3333333333333333)) + ((n >> np.uint64(2)) & np.uint64(0x3333333333333333))
    n = (n + (n >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((n * np.uint64(0x0101010101010101)) >> np.uint64(56))


@compiled(error_model="numpy", inline="always")
def _cost(
    level: np.uint8,
    bits: np.uint32,
    other: NDArray[np.uint8],
    other_census: NDArray[np.uint32],
    u: float,
    v: float,
    prices: tuple[int, int, int],
) -> np.int64:
    """Cost of a pixel of grey ``level`` and census ``bits`` at a place in the other frame; see ``_fill_costs``."""
    ty, tx = int(v + 0.5), int(u + 0.5)
    unlike = min(abs(np.int64(level) - np.int64(other[ty, tx])), _LEVELS)
    return prices[0] * ones(bits ^ other_census[ty, tx]) + prices[1] * unlike


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
    """Index of the best inverse depth of each pixel (n,), and mean costs (n, 3) in its window for the index before
    it, for it, and for the one after it; infinite if there is none.

    Args:
        numbers: (H, W) of the pixels, -1 of those that are not searched.
        firsts: (H + 1,) number of the first pixel of each row.
    """
    height, width = grey.shape
    reach, lines = _WINDOW // 2, len(maps.A)
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
            _fill_costs(
                y[i], x[i], here[0], here[1], other, other_census, maps, step, lines, _PLAIN, volume[i - low]
            )
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
    """Index of the least cost; fills that cost and its neighbours."""
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
    far: int,
    prices: tuple[int, int, int],
    cost: NDArray[np.uint8],
) -> None:
    """Fill the cost of each inverse depth 0, step, 2 step, ... (count,) for a pixel of grey ``level`` and census
    ``bits``.

    Args:
        far: places more lines above the frame than this, or twice as many below its top, are not followed.
        prices: of a bit that differs, of a grey level, and of a place outside the other frame.
    """
    height, width = other.shape
    last = len(maps.A) - 1
    line = min(line_of(maps.columns, x, y), last)
    u, v, line = _land_on_line(x, y, 0.0, line, far, maps)
    ahead = line
    for start in range(0, len(cost), _CHORD):
        u_0, v_0 = u, v
        u, v, seen_by = _land_on_line(x, y, (start + _CHORD) * step, ahead, far, maps)
        line, ahead = seen_by, min(max(2 * seen_by - line, 0), last)  # the next chord passes as many lines
        along, down = (u - u_0) / _CHORD, (v - v_0) / _CHORD
        for k in range(min(_CHORD, len(cost) - start)):
            here_u, here_v = u_0 + k * along, v_0 + k * down
            cost[start + k] = prices[2]
            if -0.5 < here_u < width - 0.5 and -0.5 < here_v < height - 0.5:
                cost[start + k] = _cost(level, bits, other, other_census, here_u, here_v, prices)


@compiled(error_model="numpy")
def _land_on_line(x: int, y: int, rho: float, line: int, far: int, maps: Reprojection) -> tuple[float, float, int]:
    """Place of a pixel in the other frame, by the pose of a line near ``line`` that sees it; and that line."""
    last, u, v = len(maps.A) - 1, np.nan, np.nan
    for _ in range(3):
        u, v, _ = reproject(x, y, rho, line, maps)
        along = across_lines(maps.there, u, v)
        seen_by = min(max(int(along + 0.5), 0), last) if -far < along < 2 * far else line
        if abs(seen_by - line) <= 1:
            return u, v, seen_by
        line = seen_by
    return u, v, line


@compiled(error_model="numpy")
def _keep_agreeing(rho: F32, other: F32, wanted: Mask, maps: Reprojection, tolerance: float, depth: F32) -> None:
    """Write the depth of ``wanted`` pixels if the inverse depth of the other frame at their places confirms it."""
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
    """Mark the places of ``wanted`` pixels in the other frame."""
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            if wanted[y, x] and rho[y, x] >= 0.0:
                u, v, _ = _seen_at(x, y, rho[y, x], maps)
                if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
                    marks[int(v + 0.5), int(u + 0.5)] = 1


@compiled(error_model="numpy")
def _seen_at(x: int, y: int, rho: float, maps: Reprojection) -> tuple[float, float, float]:
    """Place of a pixel in the other frame, and its inverse depth there, for a given inverse depth here."""
    lines = len(maps.A)
    line, u, v, s = min(line_of(maps.columns, x, y), lines - 1), np.nan, np.nan, np.nan
    for _ in range(6):
        u, v, s = reproject(x, y, rho, line, maps)
        along = across_lines(maps.there, u, v)
        if not -lines < along < 2 * lines:
            break
        seen_by = min(max(int(along + 0.5), 0), lines - 1)
        if seen_by == line:
            break
        line = seen_by
    return u, v, s


U8 = NDArray[np.uint8]
_AGGREGATED = 6, 4, 90
"""Cost of each of 24 bits that differs, of a grey level of difference (of at most ``_LEVELS``; 208 together), and
of a place outside the other frame, between the costs of right and of wrong places."""
_MEDIAN = 5
_FEWEST = 4
_COARSE, _COARSE_SIDE, _COARSE_REACH = 4, 320, 0.2
"""Least factor by which the first search shrinks frames, with the options at half the size; longest side after it,
px; and its largest parallax, as a share of the image's longer side."""
_TEXTURED, _TEXTURE_LEVELS = 5, 5.0
"""Side of a window, px, and least standard deviation of its grey levels; without texture, as in a smooth sky, any
places look alike."""
_NEAREST, _MARGIN, _MARGIN_PX = 0.998, 1.2, 2.0
_BYTES = 500.0
"""Bytes per pixel of the searched frame: the cost volume and its sums."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of the search along the curves."""

    shrink: int = 2
    """Factor by which frames are shrunk before they are compared."""
    step_px: float = 1.0
    """Parallax between two planes at the reduced size, px."""
    planes: int = 128
    """Largest number of planes."""
    window: int = 3
    """Side, px, of the square over which costs are averaged."""
    p1: int = 48
    """Cost of a step to the next plane, on a scale of 255."""
    p2: int = 255
    """Cost of larger steps."""
    agree_px: float = 1.0
    """Largest difference of parallax from the other frame's, px, at the reduced size."""

    def __post_init__(self) -> None:
        if not (self.shrink >= 1 and self.step_px > 0.0 and self.planes >= _FEWEST and self.agree_px > 0.0):
            raise ValueError(f"shrink, step_px, agree_px must be positive and planes at least {_FEWEST}: {self}")
        if self.window % 2 == 0 or not 0 <= self.p1 <= self.p2 <= 4000:
            raise ValueError(f"window must be odd and 0 <= p1 <= p2 <= 4000: {self}")


class Swept(NamedTuple):
    """Result of the search in one frame, at the size of the search."""

    rho: F32
    """(h, w) inverse depth in each row's own camera, in the motion's unit; at least 0."""
    agrees: Mask
    """(h, w) whether the other frame's search confirms it."""


def sweep_frames(
    greys: Sequence[U8],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    most: float,
    options: SweepOptions,
) -> tuple[Swept, Swept]:
    """Inverse depth of both frames of one camera, searched from 0 to ``most``.

    Args:
        greys: (H, W) of frames 0 and 1.
        rig: its body is where that camera is.
        shutter: reads rows.
        motion: of the body.
        side: which camera.
        most: largest inverse depth.
        options: see there.
    """
    height, width = search_size(greys[0].shape, options)
    camera = rig.sensor(side).resized(width, height)
    small = [np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)) for grey in greys]
    poses = [line_poses(rig, shutter, motion, side, frame, height) for frame in FRAMES]
    maps = [reprojection_of(camera, poses[frame], poses[1 - frame]) for frame in FRAMES]
    gain = parallax_gain(camera, *maps)
    count = min(max(math.ceil(gain * most / options.step_px) + 1, _FEWEST), options.planes)
    step = most / (count - 1)
    codes = [census(grey) for grey in small]

    def search(frame: int) -> F32:
        volume = np.zeros((height, width, count), dtype=np.uint8)
        other = 1 - frame
        _fill_volume(small[frame], small[other], codes[frame], codes[other], maps[frame], step, volume)
        volume = np.asarray(cv2.blur(volume, (options.window, options.window))).reshape(volume.shape)
        found = winners(aggregated(volume, options.p1, options.p2)) * np.float32(step)
        return np.asarray(cv2.medianBlur(np.maximum(found, np.float32(0.0)), _MEDIAN))

    rhos = map_frames(search, FRAMES, width * height, _BYTES)
    least = options.agree_px / max(gain, 1e-12)
    first, second = (Swept(rhos[i], _agrees(rhos[i], rhos[1 - i], maps[i], least)) for i in FRAMES)
    return first, second


def largest_seen(
    greys: Sequence[U8], rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, options: SweepOptions
) -> float:
    """Largest inverse depth of textured places that both frames show, with a margin; 0 if there are none.
    Arguments as in ``sweep_frames``.

    It is searched at a quarter of the size or less and over the largest expected parallax: flow may have lost near
    objects, whose depth would then not be searched.
    """
    poses = [line_poses(rig, shutter, motion, side, frame, greys[0].shape[0]) for frame in FRAMES]
    maps = [reprojection_of(rig.sensor(side), poses[frame], poses[1 - frame]) for frame in FRAMES]
    gain = max(parallax_gain(rig.sensor(side), *maps), 1e-9)
    longest = max(greys[0].shape) // reduction(greys[0].shape)
    coarse = replace(options, shrink=max(_COARSE * options.shrink // 2, math.ceil(longest / _COARSE_SIDE)))
    swept = sweep_frames(greys, rig, shutter, motion, side, _COARSE_REACH * max(greys[0].shape) / gain, coarse)
    height, width = swept[0].rho.shape
    known = []
    for grey, each in zip(greys, swept, strict=True):
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        mean, square = (cv2.blur(part, (_TEXTURED, _TEXTURED)) for part in (small, small * small))
        known.append(each.rho[each.agrees & (square - mean * mean > _TEXTURE_LEVELS**2)])
    rho = np.concatenate(known)
    return _MARGIN * float(np.quantile(rho, _NEAREST)) + _MARGIN_PX / gain if len(rho) else 0.0


def search_size(shape: tuple[int, ...], options: SweepOptions) -> tuple[int, int]:
    """Numbers of rows and columns at which frames (H, W) are compared."""
    shrink = options.shrink * reduction(shape)
    return max(shape[0] // shrink, 8), max(shape[1] // shrink, 8)


_ENOUGH = 1 << 20
"""Largest number of pixels, between 1280 x 720 and 1920 x 1080: more do not improve motion and depth
(``benchmarks/footage_sizes.py``)."""


def reduction(shape: tuple[int, ...]) -> int:
    """Factor by which frames (H, W[, C]) are shrunk before motion and depth are estimated: 3 for 4K, 2 for HD."""
    return max(math.ceil(math.sqrt(shape[0] * shape[1] / _ENOUGH) - 1e-9), 1)


def line_poses(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int, height: int
) -> Pose:
    """``cam_from_world`` of the rows of a frame of ``height`` rows, each at the mean time of its own."""
    scale = shutter.lines(side) / height
    rows = (np.arange(height) + 0.5) * scale - 0.5
    tau = shutter.pixel_time(np.stack([np.zeros_like(rows), rows], axis=-1), frame, side)
    return rig.cam_from_world(motion, tau, side)


def _agrees(rho: F32, other: F32, maps: Reprojection, tolerance: float) -> Mask:
    """(h, w) whether the other frame's inverse depth there is equal to within ``tolerance``."""
    height, width = rho.shape
    places, factors = reproject_pixels(maps, rho, np.indices(rho.shape, dtype=np.int32)[0])
    seen = np.isfinite(places[..., 0])
    nearest = np.rint(np.where(seen[..., None], places, 0.0)).astype(np.intp)
    x, y = np.moveaxis(np.clip(nearest, 0, (width - 1, height - 1)), -1, 0)
    return np.asarray(seen & (np.abs(other[y, x] - rho * factors) < tolerance))


@compiled(error_model="numpy")
def _fill_volume(
    grey: U8,
    other: U8,
    code: NDArray[np.uint32],
    other_code: NDArray[np.uint32],
    maps: Reprojection,
    step: float,
    volume: U8,
) -> None:
    """Fill the costs (h, w, n) of the inverse depths 0, step, 2 step, ... of every pixel."""
    last = len(maps.A) - 1
    for y in range(len(grey)):
        for x in range(grey.shape[1]):
            _fill_costs(
                y, x, grey[y, x], code[y, x], other, other_code, maps, step, last, _AGGREGATED, volume[y, x]
            )
