"""Sub-pixel refinement of point matches by aligning small patches: affine least squares matching.

A keypoint detector places the two ends of a match alone, each to a tenth of a pixel or so. The grey levels around
them say more: the patch at one end is fitted to the other image by an affine map, a gain and a bias, which leaves
a few hundredths. A plain shift is not enough: where a patch is turned or slanted, it errs by a tenth itself.

Gruen, "Adaptive least squares correlation", South African Journal of Photogrammetry 1985; the iteration is the
inverse compositional one of Baker and Matthews, IJCV 2004.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.correspondences import BoolArray, Correspondences, track_pairs, unlinked_pairs
from rsbench.core.rig import Side, View
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import grey_u8
from rsbench.vision.resample import keys_weights

F32 = NDArray[np.float32]
_BLUR_PX = 0.8
"""Standard deviation of the smoothing before: the cubic kernel interpolates what is left without a bias."""
_HALF = 7
"""Patches are 2 _HALF + 1 px wide, with Gaussian weights."""
_SPREAD = 0.6 * _HALF
_ROUNDS, _STILL_PX = 12, 1e-3
_MOST_PX, _MOST_SHEAR, _MOST_GAIN = 1.0, 0.5, 0.5
"""Changes, at most: of the place, of an element of the affine map, and of the contrast."""
_MOST_SIGMA_PX = 0.1
"""Standard deviation, as the patch's gradients and what the fit leaves say, of a place that is taken."""
_PARAMETERS = 8
_LEFT: Side = "left"
_RIGHT: Side = "right"


def refine_matches(images: Mapping[View, NDArray[Any]], matches: Correspondences) -> Correspondences:
    """The matches with their later ends aligned to their first one; where that fails they stay as they are.

    The first end is the left one of frame 0 where there is such, then the right one, then the left one of frame 1.
    What several sets hold of one track stays one. The order within a set may change but for ``left`` with affine
    frames, whose ends stay in place.

    Args:
        images: (H, W) or (H, W, 3), uint8 or uint16, of both sides and frames, in whose pixels the matches are.
    """
    with ThreadPoolExecutor() as pool:
        views: list[View] = [("left", 0), ("right", 0), ("left", 1), ("right", 1)]
        smooth = dict(zip(views, pool.map(lambda view: smoothed(images[view]), views), strict=True))
        tracks, left, right = matches.tracks, matches.left, matches.right[unlinked_pairs(matches, _RIGHT)]
        stereo_0, stereo_1 = (_not_of_tracks(matches, frame) for frame in (0, 1))
        tasks = [
            (views[0], views[1], tracks[:, 0:2], tracks[:, 2:4]),
            (views[0], views[2], tracks[:, 0:2], tracks[:, 4:6]),
            (views[0], views[3], tracks[:, 0:2], tracks[:, 6:8]),
            (views[0], views[2], left[:, :2], left[:, 2:]),
            (views[1], views[3], right[:, :2], right[:, 2:]),
            (views[0], views[1], stereo_0[:, :2], stereo_0[:, 2:]),
            (views[2], views[3], stereo_1[:, :2], stereo_1[:, 2:]),
        ]
        found = list(pool.map(lambda t: aligned(smooth[t[0]], smooth[t[1]], t[2], t[3])[0], tasks))
    tracks = np.concatenate([tracks[:, :2], *found[:3]], axis=1)
    return replace(
        matches,
        tracks=tracks,
        left=np.concatenate([left[:, :2], found[3]], axis=1),
        right=np.concatenate([track_pairs(tracks, _RIGHT), np.concatenate([right[:, :2], found[4]], axis=1)]),
        stereo_0=np.concatenate([tracks[:, :4], np.concatenate([stereo_0[:, :2], found[5]], axis=1)]),
        stereo_1=np.concatenate([tracks[:, 4:], np.concatenate([stereo_1[:, :2], found[6]], axis=1)]),
    )


def _not_of_tracks(matches: Correspondences, frame: int) -> FloatArray:
    """The left-right matches of a frame that no track repeats."""
    rows = matches.stereo_1 if frame else matches.stereo_0
    half = matches.tracks[:, 4 * frame : 4 * frame + 4]
    return rows[unlinked_pairs(Correspondences(left=rows, tracks=half[:, [0, 1, 0, 1, 2, 3, 2, 3]]), _LEFT)]


def smoothed(image: NDArray[Any]) -> F32:
    """Grey levels (H, W) as patches are cut from them."""
    return np.asarray(cv2.GaussianBlur(grey_u8(image).astype(np.float32), (0, 0), _BLUR_PX))


def aligned(a: F32, b: F32, points_a: FloatArray, points_b: FloatArray) -> tuple[FloatArray, BoolArray]:
    """The places (n, 2) in b of what is at points a, from places near them, and which of them were aligned.

    Args:
        a, b: (H, W) of ``smoothed``.
        points_a, points_b: (n, 2) px; a point that cannot be aligned keeps its place in b.
    """
    out = np.array(points_b, dtype=np.float64)
    done = np.zeros(len(out), dtype=np.bool_)
    _align_all(a, b, np.ascontiguousarray(points_a, dtype=np.float64), out, done)
    return out, done


@compiled(error_model="numpy", fastmath={"contract"})
def _sample(image: F32, x: float, y: float) -> np.float32:
    """The image at a place whose window of 4 x 4 px lies inside it."""
    i, j = int(x), int(y)
    wx, wy = keys_weights(np.float32(x - i)), keys_weights(np.float32(y - j))
    total = np.float32(0.0)
    for k in range(4):
        row = image[j - 1 + k]
        total += wy[k] * (wx[0] * row[i - 1] + wx[1] * row[i] + wx[2] * row[i + 1] + wx[3] * row[i + 2])
    return total


@compiled(error_model="numpy", fastmath={"contract"})
def _template(image: F32, x: float, y: float, grid: F32, J: F32) -> None:
    """Derivatives (n, 8) of the patch's grey levels by the parameters; the last two are 1 and the levels."""
    size = 2 * _HALF + 3
    for j in range(size):
        for i in range(size):
            grid[j, i] = _sample(image, x + i - _HALF - 1, y + j - _HALF - 1)
    half, k = np.float32(0.5), 0
    for j in range(1, size - 1):
        for i in range(1, size - 1):
            gx, gy = half * (grid[j, i + 1] - grid[j, i - 1]), half * (grid[j + 1, i] - grid[j - 1, i])
            u, v = np.float32(i - _HALF - 1), np.float32(j - _HALF - 1)
            J[k, 0], J[k, 1], J[k, 2], J[k, 3], J[k, 4], J[k, 5] = gx, gy, gx * u, gx * v, gy * u, gy * v
            J[k, 6], J[k, 7] = np.float32(1.0), grid[j, i]
            k += 1


@compiled(error_model="numpy")
def _align_all(a: F32, b: F32, points: FloatArray, places: FloatArray, done: BoolArray) -> None:
    size = 2 * _HALF + 1
    grid, J = (
        np.zeros((size + 2, size + 2), dtype=np.float32),
        np.zeros((size * size, _PARAMETERS), dtype=np.float32),
    )
    weights = np.zeros(size * size)
    for k in range(size * size):
        weights[k] = np.exp(-((k % size - _HALF) ** 2 + (k // size - _HALF) ** 2) / (2.0 * _SPREAD**2))
    margin = _HALF + 3
    for n in range(len(points)):
        x, y = points[n]
        if not (margin <= x < a.shape[1] - margin and margin <= y < a.shape[0] - margin):
            continue
        _template(a, x, y, grid, J)
        done[n] = _align(b, J, weights, places[n])


@compiled(error_model="numpy")
def _align(b: F32, J: F32, weights: FloatArray, place: FloatArray) -> bool:
    """Move one place (2,) to where the patch fits; False, and no move, where it cannot be."""
    count = len(J)
    H = np.zeros((_PARAMETERS, _PARAMETERS))
    for k in range(count):
        for p in range(_PARAMETERS):
            for q in range(p + 1):
                H[p, q] += weights[k] * J[k, p] * J[k, q]
    for p in range(_PARAMETERS):
        H[p, p] *= 1.0 + 1e-9
        for q in range(p):
            H[q, p] = H[p, q]
        if not H[p, p] > 0.0:
            return False
    inverse = np.linalg.inv(H)
    x, y, gain, bias = place[0], place[1], 1.0, 0.0
    A = np.zeros((2, 2))
    A[0, 0] = A[1, 1] = 1.0
    residuals = np.zeros(count)
    for _ in range(_ROUNDS):
        if not _residuals(b, J, A, x, y, gain, bias, residuals):
            return False
        step = _step(J, weights, residuals, inverse)  # pyrefly: ignore[bad-argument-type]
        M = np.linalg.inv(np.array([[1.0 + step[2], step[3]], [step[4], 1.0 + step[5]]]))
        A = A @ M
        dx, dy = A[0, 0] * step[0] + A[0, 1] * step[1], A[1, 0] * step[0] + A[1, 1] * step[1]
        x, y, bias, gain = x - dx, y - dy, bias + step[6], gain + step[7]
        if not (abs(x - place[0]) < _MOST_PX and abs(y - place[1]) < _MOST_PX):
            return False
        if dx * dx + dy * dy < _STILL_PX**2:
            break
    shear = max(abs(A[0, 0] - 1.0), abs(A[0, 1]), abs(A[1, 0]), abs(A[1, 1] - 1.0))
    variance = np.sum(weights * residuals**2) / np.sum(weights) * max(inverse[0, 0], inverse[1, 1])
    if not (shear < _MOST_SHEAR and abs(gain - 1.0) < _MOST_GAIN and variance < _MOST_SIGMA_PX**2):
        return False
    place[0], place[1] = x, y
    return True


@compiled(error_model="numpy")
def _residuals(
    b: F32, J: F32, A: FloatArray, x: float, y: float, gain: float, bias: float, out: FloatArray
) -> bool:
    """Grey levels of b under the patch less the patch's; False where it leaves the image."""
    reach_x, reach_y = _HALF * (abs(A[0, 0]) + abs(A[0, 1])) + 2.0, _HALF * (abs(A[1, 0]) + abs(A[1, 1])) + 2.0
    if not (reach_x <= x < b.shape[1] - reach_x - 1.0 and reach_y <= y < b.shape[0] - reach_y - 1.0):
        return False
    size = 2 * _HALF + 1
    for k in range(len(out)):
        u, v = k % size - _HALF, k // size - _HALF
        level = _sample(b, x + A[0, 0] * u + A[0, 1] * v, y + A[1, 0] * u + A[1, 1] * v)
        out[k] = level - (gain * J[k, 7] + bias)
    return True


@compiled(error_model="numpy")
def _step(J: F32, weights: FloatArray, residuals: FloatArray, inverse: FloatArray) -> FloatArray:
    """Least squares change (8,) of the parameters."""
    g = np.zeros(_PARAMETERS)
    for k in range(len(residuals)):
        r = weights[k] * residuals[k]
        for p in range(_PARAMETERS):
            g[p] += r * J[k, p]
    return inverse @ g
