"""Depth maps without one flat place, of leaves or wires that are thinner than a pixel: compared roughly."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rsbench.core.geometry import Geometry
from rsbench.core.so3 import FloatArray
from rsbench.dataset.object_records import numbers_of
from rsbench.dataset.views import ImageView
from rsbench.verification.frame_comparison import DepthMap, seen_with

_NEAR = 5e-3
"""Relative difference of two depths that may be of one thin thing."""
_JUMP, _JUMPS = 3e-2, 0.5
"""Relative second difference of inverse depth at an edge, and the share of pixels beside one in a picture of thin
things: 0.69 to 0.85 in the scene ``forest`` at 63 to 128 px, 0.35 in ``castle`` at 128 px, 0.05 at 900 px."""
_LIKER, _AWAY = 1.6, 7
"""How many times as many pixels two partners must see where they are than up to 7 px beside. Sound maps of
``forest`` and ``old-town`` at 52 to 96 px: 2.3 and more. Scaled by 1.02, flipped, of the other frame: 0.6 to 1.5
in ``forest``."""
_TRIED_PIXELS = 20_000


def roughly_agree(geometry: Geometry, maps: Mapping[ImageView, DepthMap], view: ImageView) -> bool:
    """Whether a depth map shows thin things, and two partners see them about where they are.

    A map that could show flat places and shows none is spoilt. One partner alone may be spoilt in the same way:
    rows of a frame and of its global-shutter twin lie hardly apart.
    """
    alike = (_alike(geometry, maps[view], maps[each]) for each in view.partners() if each in maps)
    return maps[view].share_of_edges(_JUMP) > _JUMPS and sum(alike) >= 2


def _alike(geometry: Geometry, source: DepthMap, target: DepthMap) -> bool:
    stride = max(1, int(np.sqrt(source.depth.size / _TRIED_PIXELS)))
    grid, depth = source.camera.pixel_grid()[::stride, ::stride], source.depth[::stride, ::stride]
    numbers = None if source.labels is None else numbers_of(source.labels[::stride, ::stride][depth > 0])
    pixels, z = grid[depth > 0], depth[depth > 0].astype(np.float64)
    seen = seen_with(geometry, source.view, target.view, pixels, z, numbers)
    inside = np.isfinite(seen.depth)
    middle = np.rint(seen.pixels[inside]).astype(np.int64)
    shares = [
        _share(target, middle + np.array(by) * _AWAY, seen.depth[inside]) for by in product((0, 1, -1), repeat=2)
    ]
    return shares[0] > _LIKER * max(shares[1:])


def _share(target: DepthMap, middle: NDArray[np.int64], depth: FloatArray) -> float:
    """Of points (n,) those that are as deep as one of the 3 x 3 pixels (n, 2) around, in the picture."""
    height, width = target.depth.shape
    inside = np.all((middle >= 1) & (middle < np.array([width - 1, height - 1])), axis=1)
    x, y = middle[inside].T
    around = np.stack([target.depth[y + down, x + across] for down, across in product((-1, 0, 1), repeat=2)])
    near = np.any(np.abs(around / depth[inside] - 1.0) < _NEAR, axis=0)
    return float(np.mean(near)) if near.size else 0.0
