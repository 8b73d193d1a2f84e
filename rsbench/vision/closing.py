"""Specks and slits of a corrected frame that no frame shows, closed from their surroundings; whole regions stay.

What is narrow shows the eye nothing that could be wrong but a hole; what is wide would be a guess at a scene.
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


def close_narrow(fused: Fused) -> Fused:
    """A corrected frame whose narrow holes are INVENTED from what lies around them; a failed one as it is."""
    holes = fused.origin == Origin.NOBODY
    closed = narrow(holes) if fused.success else np.zeros_like(holes)
    if not np.any(closed):
        return fused
    # Wide holes are invented too and put back: their black is nothing that a slit should be closed with.
    image = inpaint(fused.image, holes, _RADIUS_PX)
    image[holes & ~closed] = 0
    origin = np.where(closed, np.uint8(Origin.INVENTED), fused.origin)
    return replace(fused, image=image, origin=origin)
