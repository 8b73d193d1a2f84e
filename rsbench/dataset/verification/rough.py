"""Depth maps without one flat place, of leaves or wires that are thinner than a pixel: compared roughly."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rsbench.dataset.sequence import Sequence
from rsbench.dataset.shots import Shot, points_of, seen_by
from rsbench.dataset.verification.landing import DepthMap

_NEAR = 5e-3
"""Relative difference of two depths that may be of one thin thing."""
ALIKE = 0.6
"""Share of a map's pixels that two partners must see about where they are. Sound maps of the scene ``forest`` at
96 x 72 px, moved by 6 degrees, have 0.72 to 0.82; with noise of 1 % 0.46 to 0.53, shifted by two pixels 0.41 to
0.56, scaled by 1.02 at most 0.24; of the other camera 0.46, of the other frame and flipped 0.2."""
_TRIED_PIXELS = 20_000


def roughly_alike(sequence: Sequence, maps: Mapping[Shot, DepthMap], shot: Shot) -> bool:
    """Whether two partners of a depth map see most of its pixels about where they are.

    One alone may be spoilt in the same way: rows of a frame and of its global-shutter twin lie hardly apart.
    """
    shares = (_share(sequence, maps[shot], maps[each]) for each in shot.partners() if each in maps)
    return sum(share > ALIKE for share in shares) >= 2


def _share(sequence: Sequence, source: DepthMap, target: DepthMap) -> float:
    """Of the pixels with a surface that the target has in view, those that one of 3 x 3 pixels there shares."""
    stride = max(1, int(np.sqrt(source.depth.size / _TRIED_PIXELS)))
    grid, depth = source.camera.pixel_grid()[::stride, ::stride], source.depth[::stride, ::stride]
    pixels, z = grid[depth > 0], depth[depth > 0].astype(np.float64)
    X = points_of(sequence, source.shot, pixels, z)
    seen = seen_by(sequence, target.shot, X, pixels[:, sequence.shutter.axis(target.shot.side)])
    height, width = target.depth.shape
    middle = np.rint(np.nan_to_num(seen.pixels, nan=-9.0)).astype(np.int64)
    inside = np.all((middle >= 1) & (middle < np.array([width - 1, height - 1])), axis=1)
    x, y = middle[inside].T
    around = np.stack([target.depth[y + down, x + across] for down in (-1, 0, 1) for across in (-1, 0, 1)])
    near = np.any(np.abs(around / seen.depth[inside] - 1.0) < _NEAR, axis=0)
    return float(np.mean(near)) if near.size else 0.0
