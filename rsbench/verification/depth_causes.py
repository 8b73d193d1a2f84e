"""Causes of a wrong depth map: candidates are tried against the maps of its partners."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView, nearby_views
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, BoolArray, DepthMap, reproject

_TRIED_PIXELS = 20_000
_PLAIN = 0.8
"""Share of the comparable pixels that a candidate must explain, and 0.3 more than the map as it is."""

Depth = NDArray[np.float32]


def likely_cause(sequence: Sequence, maps: Mapping[ImageView, DepthMap], view: ImageView, rows: BoolArray) -> str:
    """In words, "" where nothing explains it. ``rows`` (H,) are those that are wrong."""
    depth = maps[view].depth
    if not np.any(depth[rows]):
        return "zeroed"
    same = [other for other in maps if other != view and np.array_equal(depth[rows], maps[other].depth[rows])]
    if same:
        return f"the same as {same[0].depth}"
    partners = [maps[partner] for partner in view.partners() if partner in maps]
    if not partners:
        return ""
    best, words = _agreeing(sequence, maps[view], partners, rows) + 0.3, ""
    for name, candidate in _candidates(sequence, maps, view):
        share = _agreeing(sequence, candidate, partners, rows)
        if share > max(best, _PLAIN):
            best, words = share, name
    if words:
        return words
    scale, share, spread = _scale(sequence, maps[view], partners, rows)
    if share > _PLAIN and abs(scale - 1) > 1e-6:
        return f"looks scaled by {scale:.7g}"
    return f"looks like noise of {spread:.1e} of the depth" if DEPTH_TOLERANCE / 3 < spread < 0.3 else ""


def _candidates(
    sequence: Sequence, maps: Mapping[ImageView, DepthMap], view: ImageView
) -> Iterator[tuple[str, DepthMap]]:
    """Depth maps that the stored one may have been, or the views whose depth it may be."""
    stored = maps[view]
    depth = stored.depth
    for other in nearby_views(view, sequence.frames):
        yield f"looks like {other.depth}", replace(stored, view=other)
    lines = sequence.shutter.lines(view.side)
    for line in {1, 2, lines // 4, lines // 2, 3 * lines // 4, lines - 1} if view.shutter == "gs" else set():
        words = f"looks like the global shutter at the pose of line {line}"
        yield words, replace(stored, view=view._replace(row=line))
    for by in (-1, 1, -2, 2):
        plural = "s" if abs(by) > 1 else ""
        yield f"looks shifted by {abs(by)} row{plural}", replace(stored, depth=np.roll(depth, -by, axis=0))
        yield f"looks shifted by {abs(by)} column{plural}", replace(stored, depth=np.roll(depth, -by, axis=1))
    yield "looks flipped left to right", replace(stored, depth=np.ascontiguousarray(depth[:, ::-1]))
    yield "looks flipped upside down", replace(stored, depth=np.ascontiguousarray(depth[::-1]))
    rays = np.linalg.norm(stored.camera.unproject(stored.camera.pixel_grid()), axis=-1)
    along = (depth / rays).astype(np.float32)
    yield "looks like the distance along the ray instead of z", replace(stored, depth=along)


def _relative(sequence: Sequence, source: DepthMap, partner: DepthMap, rows: BoolArray) -> NDArray[np.float32]:
    """(n,) relative differences of pixels in these rows that meet a flat surface of a partner, or -inf."""
    stride = max(1, int(np.sqrt(np.sum(rows) * source.depth.shape[1] / _TRIED_PIXELS)))
    if not np.any(rows[::stride]):
        stride = 1
    relative = reproject(sequence, source, partner, stride).relative
    chosen = rows[::stride, None] & (source.depth[::stride, ::stride] > 0) & ~np.isnan(relative)
    return relative[chosen]


def _agreeing(sequence: Sequence, source: DepthMap, partners: list[DepthMap], rows: BoolArray) -> float:
    """Share of these rows that agrees with the middle one of the partners: one may be wrong itself."""
    shares = []
    for partner in partners:
        relative = _relative(sequence, source, partner, rows)
        near = relative[relative < 0.01]
        shares.append(float(np.mean(np.abs(near) <= DEPTH_TOLERANCE)) if len(near) else 0.0)
    return float(np.median(shares)) if shares else 0.0


def _scale(
    sequence: Sequence, source: DepthMap, partners: list[DepthMap], rows: BoolArray
) -> tuple[float, float, float]:
    """Factor that the depth has too much, the share that agrees without it, and the scatter that is left."""
    scale, share, spread = 1.0, 0.0, 0.0
    for _ in range(5):
        scaled = replace(source, depth=(source.depth / np.float32(scale)).astype(np.float32))
        relative = np.concatenate([_relative(sequence, scaled, partner, rows) for partner in partners])
        near = relative[np.abs(relative) < 0.5]
        if len(near) == 0:
            break
        middle = float(np.median(near))
        spread = 1.4826 * float(np.median(np.abs(near - middle)))
        share = float(np.mean(np.abs(near) <= DEPTH_TOLERANCE))
        if abs(middle) < 1e-6:
            break
        scale *= 1 + middle
    return scale, share, spread
