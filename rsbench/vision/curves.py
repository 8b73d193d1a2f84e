"""Edges of an image as curves: chains of sub-pixel places, which straight things in space leave there.

A place is the maximum of the gradient's length along a row, by a parabola through its logarithm: exact where a
step was blurred by a Gaussian (C. Steger, An unbiased detector of curvilinear structures, PAMI 1998, has the
same of its profile). Places of neighbouring rows are one curve where the edge's own direction leads from one to
the other. A curve that no parabola follows is cut where it is farthest from it. Flat edges are found likewise in
the columns.
"""

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray
from rsbench.vision.images import grey_u8

F32 = NDArray[np.float32]
Curves = list[FloatArray]
"""Each (n, 2) places x, y, px, in the order in which it runs."""

_BLUR_PX = 1.0
_LEAST_GRADIENT = 6.0
"""Grey levels per px at an edge: three deviations of the gradient of 8-bit noise of 3 levels so blurred."""
_BESIDE_PX, _SAME_DIRECTION, _SAME_STRENGTH = 0.6, 0.94, 0.6
"""Of places that are one curve: how far the second is from where the first leads, the cosine of the angle between
their directions (20 degrees), and the least ratio of their gradients."""
_BENT_PX = 0.35
"""Greatest distance of a curve's smoothed places from a parabola."""
_SMOOTHED = 7


def image_curves(image: NDArray[Any], least_length: float) -> Curves:
    """Curves of at least ``least_length`` px, longest first, of an image (H, W[, 3]), uint8 or uint16."""
    grey = grey_u8(image).astype(np.float32)
    upright = _curves_down(grey, least_length)
    flat = [each[:, ::-1] for each in _curves_down(np.ascontiguousarray(grey.T), least_length)]
    return sorted([*upright, *flat], key=lambda each: -extent(each))


def extent(curve: FloatArray) -> float:
    """Distance between the ends of a curve (n, 2), px."""
    return float(np.linalg.norm(curve[-1] - curve[0]))


def _curves_down(grey: F32, least_length: float) -> Curves:
    """Curves that cross rows."""
    places = _places(grey)
    after = [_followers(here, there) for here, there in itertools.pairwise(places)]
    curves: Curves = []
    started: list[set[int]] = [set() for _ in places]
    for row, followers in enumerate(after):
        for first in range(len(followers)):
            if first in started[row] or followers[first] < 0:
                continue
            chain, y, k = list[tuple[float, float]](), row, first
            while k >= 0:
                chain.append((places[y][k, 0], float(y)))
                started[y].add(k)
                k = int(after[y][k]) if y < len(after) else -1
                y += 1
            curves += _parabolas(np.array(chain), least_length)
    return curves


def _places(grey: F32) -> list[FloatArray]:
    """Of each row, edges (n, 4): x, gradient along x and y, its length; those more upright than flat."""
    blurred = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    gx, gy = (cv2.Scharr(blurred, cv2.CV_32F, dx, dy, scale=1 / 32) for dx, dy in ((1, 0), (0, 1)))
    strength = np.maximum(np.hypot(gx, gy), np.float32(1e-3))
    inner = strength[:, 1:-1]
    peak = (inner >= strength[:, :-2]) & (inner > strength[:, 2:]) & (inner > _LEAST_GRADIENT)
    peak &= np.abs(gx[:, 1:-1]) >= np.abs(gy[:, 1:-1])
    log = np.log(strength.astype(np.float64))
    found = []
    for y, row in enumerate(peak):
        x = np.flatnonzero(row) + 1
        before, at, behind = log[y, x - 1], log[y, x], log[y, x + 1]
        offset = 0.5 * (behind - before) / np.maximum(2.0 * at - before - behind, 1e-9)
        found.append(np.column_stack([x + np.clip(offset, -0.5, 0.5), gx[y, x], gy[y, x], strength[y, x]]))
    return found


def _followers(here: FloatArray, there: FloatArray) -> NDArray[np.intp]:
    """For each place (n, 4) of a row that of the next one which goes on from it; -1 where there is none."""
    none = np.full(len(here), -1, dtype=np.intp)
    if len(here) == 0 or len(there) == 0:
        return none
    lead = here[:, 0] - here[:, 2] / here[:, 1]  # along the edge, across its gradient
    back = there[:, 0] + there[:, 2] / there[:, 1]
    apart = np.abs(there[None, :, 0] - lead[:, None]) + np.abs(back[None] - here[:, None, 0])
    cosine = (here[:, None, 1] * there[None, :, 1] + here[:, None, 2] * there[None, :, 2]) / (
        here[:, None, 3] * there[None, :, 3]
    )
    ratio = np.minimum(here[:, None, 3], there[None, :, 3]) / np.maximum(here[:, None, 3], there[None, :, 3])
    bad = (apart > 2.0 * _BESIDE_PX) | (cosine < _SAME_DIRECTION) | (ratio < _SAME_STRENGTH)
    apart = np.where(bad, np.inf, apart)
    best = np.argmin(apart, axis=1)
    mutual = np.argmin(apart, axis=0)[best] == np.arange(len(here))
    return np.where(mutual & np.isfinite(apart[np.arange(len(here)), best]), best, none)


def _parabolas(chain: FloatArray, least_length: float) -> Curves:
    """The parts of a chain (n, 2) that parabolas x(y) follow."""
    if len(chain) < _SMOOTHED or extent(chain) < least_length:
        return []
    y = chain[:, 1] - chain[:, 1].mean()
    basis = np.stack([np.ones_like(y), y, y * y / len(y)], axis=-1)
    fit, *_ = np.linalg.lstsq(basis, chain[:, 0], rcond=None)
    off = np.convolve(chain[:, 0] - basis @ fit, np.full(_SMOOTHED, 1.0 / _SMOOTHED), mode="same")
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) <= _BENT_PX:
        return [chain]
    cut = int(np.clip(worst, _SMOOTHED, len(chain) - _SMOOTHED))
    if not 0 < cut < len(chain):
        return []
    return [*_parabolas(chain[:cut], least_length), *_parabolas(chain[cut:], least_length)]
