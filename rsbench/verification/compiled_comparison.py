"""Compiled loops over pixels for ``depth_checks`` and ``image_checks``, which compare two pictures of one surface.

Pixels and colours are computed in float32, in the order of the formulas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled

Bits = NDArray[np.uint8]
Flags = NDArray[np.bool_]
F32 = NDArray[np.float32]


class Evidence(NamedTuple):
    """Evidence of the partners on every ``stride``-th pixel (h, w) of a depth map, filled in by the loops; in
    ``Bits`` each partner has one bit."""

    confirmed: Bits
    """The partner sees the same surface there, or also sees the sky."""
    contradicted: Bits
    """The partner sees through the surface, or sees another one slightly in front of it."""
    near: Flags
    """Some partner contradicts it by less than ``NEAR_MISS``."""
    hidden: Bits
    """The partner sees one clearly in front of it: an occlusion, unless another partner sees one too."""
    difference: F32
    """Smallest relative difference from a partner; infinite if there was no comparison."""


DEPTH_TOLERANCE = 1e-4
"""Relative difference up to which two depths of one surface point agree."""
NEAR_MISS = 1e-3
"""A surface hidden by less than this is a disagreement, not an occlusion; shallow reliefs hide by little more."""
_LEAST_WIDTH = 0.5
_CENTRED = 0.3
"""Distance in pixels from a pixel's centre within which its ray must meet a surface that covers its neighbours."""


@compiled(error_model="numpy")
def weigh_rows(
    reprojection: tuple[F32, F32],
    even: tuple[Flags, F32, int],
    evidence: Evidence,
    target: tuple[Bits, F32],
    bits: tuple[int, int],
    near: F32,
    first: int,
    last: int,
) -> None:
    """Add the evidence in some rows of a source to both maps of a pair.

    Args:
        reprojection: pixels (h, w, 2) and relative depth (h, w) of every ``stride``-th pixel of the source.
        even: of the source: whether each pixel (H, W) lies on one flat surface; its depth (H, W); ``stride``.
        evidence: evidence on the source, updated.
        target: holes (H, W) of the target, updated; two bands may set the same bit. Its depth (H, W).
        bits: bit of the target among the source's partners, and of the source among the target's.
        near: (h, w) output: relative distance of flat surfaces that are not hidden; -1 elsewhere.
        first, last: range of rows, ``last`` excluded.
    """
    pixels, relative = reprojection
    flats, depth, stride = even
    holes, target_depth = target
    bit, back = np.uint8(bits[0]), np.uint8(bits[1])
    for y in range(first, last):
        for x in range(relative.shape[1]):
            value, size = relative[y, x], abs(relative[y, x])
            wide = _is_wide(pixels, y, x, stride)
            flat = flats[y * stride, x * stride] and depth[y * stride, x * stride] > 0 and wide
            agrees, nearby = size <= DEPTH_TOLERANCE, value < NEAR_MISS
            through = nearby and not agrees and (flat or (np.isfinite(value) and wide))
            if agrees:
                evidence.confirmed[y, x] |= bit
            if through:
                evidence.contradicted[y, x] |= bit
                if size < NEAR_MISS:
                    evidence.near[y, x] = True
            if value >= NEAR_MISS:
                evidence.hidden[y, x] |= bit
            near[y, x] = size if flat and nearby else np.float32(-1.0)
            if size < evidence.difference[y, x]:
                evidence.difference[y, x] = size
            if flat:
                _mark_hole(pixels[y, x, 0], pixels[y, x, 1], holes, target_depth, back)


@compiled(error_model="numpy")
def _is_wide(pixels: F32, y: int, x: int, stride: int) -> bool:
    """Return whether a source pixel covers ``_LEAST_WIDTH`` pixels of the target in every direction."""
    height, width = pixels.shape[:2]
    if height < 2 or width < 2:
        return False
    left, right, up, down = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, height - 1)
    by, over_x, over_y = np.float32(stride), np.float32(right - left), np.float32(down - up)
    ax = (pixels[y, right, 0] / by - pixels[y, left, 0] / by) / over_x
    ay = (pixels[y, right, 1] / by - pixels[y, left, 1] / by) / over_x
    dx = (pixels[down, x, 0] / by - pixels[up, x, 0] / by) / over_y
    dy = (pixels[down, x, 1] / by - pixels[up, x, 1] / by) / over_y
    area = abs(ax * dy - ay * dx)
    longest = np.sqrt((ax * ax + dx * dx) + (ay * ay + dy * dy))
    return area >= np.float32(_LEAST_WIDTH) * longest


@compiled(error_model="numpy")
def _mark_hole(u: float, v: float, holes: Bits, depth: F32, bit: np.uint8) -> None:
    """Mark a target pixel without a surface if a flat source surface lands near its centre."""
    if not np.isfinite(u):
        return
    near_x, near_y = np.rint(u), np.rint(v)
    if not max(abs(u - near_x), abs(v - near_y)) <= np.float32(_CENTRED):
        return
    x = min(max(int(near_x), 0), depth.shape[1] - 1)
    y = min(max(int(near_y), 0), depth.shape[0] - 1)
    if depth[y, x] == 0:
        holes[y, x] |= bit


class Shown(NamedTuple):
    """A source, and where a target shows its pixels."""

    colours: F32
    """(H, W, 3) codes of the source."""
    even: Flags
    """(H, W) whether a pixel sees one flat surface, or the sky."""
    pixels: F32
    """(h, w, 2) place in the target of every ``stride``-th pixel of the source."""
    relative: F32
    """(h, w) relative depth, see ``reprojection.Reprojection``."""
    stride: int


@compiled(error_model="numpy")
def vote_rows(
    shown: Shown,
    span: tuple[Bits, Bits, float],
    votes: tuple[Bits, Bits],
    bands: tuple[NDArray[np.int64], NDArray[np.int64]],
    first: int,
    last: int,
) -> NDArray[np.int64]:
    """Count the pixels in rows of a source whose surface the target sees too, and those with another colour there.

    Args:
        shown: the source, and its places in the target.
        span: smallest and largest codes (H, W, 3) of the 3 x 3 neighbourhoods of the target; the tolerance beyond
            them.
        votes: votes on the source, updated; see ``image_checks.compare``.
        bands: number of the band (H,) of each row; an array (2, B) of which only the shape is used.
        first, last: range of the strided rows, ``last`` excluded.

    Returns:
        (2, B) numbers of compared pixels, and of those beyond the tolerance, in these rows.
    """
    low, high, allowed = span
    seen, against = votes
    counts = np.zeros_like(bands[1])
    beyond = np.float32(allowed)
    height, width = low.shape[:2]
    for row in range(first, last):
        y = row * shown.stride
        band = bands[0][y]
        for column in range(shown.relative.shape[1]):
            x = column * shown.stride
            if not (shown.even[y, x] and abs(shown.relative[row, column]) <= DEPTH_TOLERANCE):
                continue
            near_x = min(max(int(np.rint(shown.pixels[row, column, 0])), 0), width - 1)
            near_y = min(max(int(np.rint(shown.pixels[row, column, 1])), 0), height - 1)
            spanned = True
            for k in range(3):
                code = shown.colours[y, x, k]
                least = np.float32(low[near_y, near_x, k]) - beyond
                most = np.float32(high[near_y, near_x, k]) + beyond
                spanned = spanned and code >= least and code <= most
            seen[y, x] += np.uint8(1)
            counts[0, band] += 1
            if not spanned:
                against[y, x] += np.uint8(1)
                counts[1, band] += 1
    return counts


@compiled(error_model="numpy")
def every_nth(shown: Shown, every: int, places: NDArray[np.int64]) -> int:
    """Fill ``places`` (n, 2) with the row and column of every ``every``-th source pixel that ``vote_rows`` counts;
    return the number of places."""
    number, found = 0, 0
    for row in range(shown.relative.shape[0]):
        for column in range(shown.relative.shape[1]):
            y, x = row * shown.stride, column * shown.stride
            if shown.even[y, x] and abs(shown.relative[row, column]) <= DEPTH_TOLERANCE:
                if number % every == 0:
                    places[found, 0], places[found, 1] = y, x
                    found += 1
                number += 1
    return found


@compiled(error_model="numpy")
def costs_of_changes(
    image: F32,
    places: NDArray[np.int64],
    shown: F32,
    bands: NDArray[np.int64],
    changes: NDArray[np.int64],
    cap: float,
    sums: NDArray[np.float64],
) -> None:
    """Sum the differences from the target that each change of an image leaves, over the samples of each band.

    Args:
        image: (H, W, 3) codes.
        places: (n, 2) rows and columns of samples.
        shown: (n, 3) codes of the target at the samples.
        bands: (n,) number of the band of each sample.
        changes: (C, 7) ``down``, ``right``, ``flip_x``, ``flip_y`` and ``order`` of each; the first is no change.
        cap: the largest difference of a channel that counts.
        sums: (2, C, B) output, to which capped differences and squared gains over no change are added.
    """
    height, width = image.shape[:2]
    for i in range(len(places)):
        as_is = np.float32(0.0)
        for c in range(len(changes)):
            y, x = places[i, 0], places[i, 1]
            y = (height - 1 - y if changes[c, 3] else y) + changes[c, 0]
            x = (width - 1 - x if changes[c, 2] else x) + changes[c, 1]
            y, x = min(max(y, 0), height - 1), min(max(x, 0), width - 1)
            unlike = np.float32(0.0)
            for k in range(3):
                apart = abs(image[y, x, changes[c, 4 + k]] - shown[i, k])
                unlike += min(apart, np.float32(cap))
            unlike /= np.float32(3.0)
            if c == 0:
                as_is = unlike
            gain = as_is - unlike
            sums[0, c, bands[i]] += unlike
            sums[1, c, bands[i]] += gain * gain
