"""A corrected frame as a person would keep it: without specks and slits that no frame shows, and with even seams.

What is narrow shows the eye nothing that could be wrong but a hole; what is wide would be a guess at a scene, and
stays. A border between what is near and what another frame shows behind it is cut along pixels: the frame's own
edges are as fine as its optics, such a seam is a staircase.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.vision.fusion import Fused, Origin, inpaint

_WIDTH_SHARE, _LEAST_PX = 0.015, 5
"""Width of a hole that is closed, at most, as a share of the image's width; and px of small images."""
_LARGE_DISCS = 16
"""Area of a region that is left black, at least, in squares of that width: below that it is a blot."""
_RADIUS_PX = 3.0
_SEAM_PX, _JUMP = 0.5, 0.05
"""Deviation of the blur along seams, and relative difference of depths from which they are borders of things."""
_FAR = 1e6
"""Metres, or what else depth is in, in place of infinite and unknown depth."""


def narrow(holes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of ``holes`` (H, W) that are closed: but for those where discs of that width make a large region.

    The border of the image ends a hole.
    """
    size = max(round(_WIDTH_SHARE * holes.shape[1]), _LEAST_PX) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    given = holes.astype(np.uint8)
    core = cv2.erode(given, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    wide = cv2.dilate(core, disc)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LARGE_DISCS * size**2
    large[0] = False  # what is no hole
    return np.asarray(holes & ~large[labels])


def finished(fused: Fused) -> Fused:
    """With narrow holes INVENTED from what lies around them, and even seams; a failed one as it is."""
    return _even_seams(_closed(fused)) if fused.success else fused


def _closed(fused: Fused) -> Fused:
    holes = fused.origin == Origin.NOBODY
    closed = narrow(holes)
    if not np.any(closed):
        return fused
    # Wide holes are invented too and put back: their black is nothing that a slit should be closed with.
    image = inpaint(fused.image, holes, _RADIUS_PX)
    image[holes & ~closed] = 0
    origin = np.where(closed, np.uint8(Origin.INVENTED), fused.origin)
    return replace(fused, image=image, origin=origin)


def _even_seams(fused: Fused) -> Fused:
    """Blurred by half a pixel where one source ends and another begins, at a jump of the depth."""
    known = np.isfinite(fused.depth) & (fused.depth > 0.0)
    distance = np.log(np.where(known, fused.depth, np.float32(_FAR)))
    sources, jumps = (
        _beside([np.abs(np.diff(each, axis=axis)) > least for axis in (0, 1)])
        for each, least in ((fused.origin.astype(np.int16), 0), (distance, np.log1p(_JUMP)))
    )
    seen = cv2.erode((fused.origin != Origin.NOBODY).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    seam = sources & jumps & seen
    if not np.any(seam):
        return fused
    image = fused.image.copy()
    image[seam] = cv2.GaussianBlur(image, (3, 3), _SEAM_PX)[seam]
    return replace(fused, image=image)


def _beside(between: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """(H, W) pixels on either side of what holds between neighbours: (H - 1, W) of columns, (H, W - 1) of rows."""
    down, across = (
        np.pad(each, [(1, 1) if k == axis else (0, 0) for k in (0, 1)]) for axis, each in enumerate(between)
    )
    return np.asarray(down[1:] | down[:-1] | across[:, 1:] | across[:, :-1])
