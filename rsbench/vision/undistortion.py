"""Images as the camera without its lens would have them, and matches found in such images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences

_SETS = ("left", "right", "stereo_0", "stereo_1", "tracks")
_FAR = -1e6
"""Pixel of what the lens does not reach."""


def undistorted(image: NDArray[Any], camera: PinholeCamera) -> NDArray[Any]:
    """The image (H, W[, 3]) without distortion, of the same size and intrinsics; cubic interpolation.

    What lies beyond the distorted image is a mirror of its border: ``with_lens`` drops matches there. Rows of the
    result are not read at one time: times belong to the pixels of the image as it was.
    """
    source = np.nan_to_num(camera.lens_pixels(camera.pixel_grid()), nan=_FAR).astype(np.float32)
    return np.asarray(
        cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    )


def with_lens(matches: Correspondences, camera: PinholeCamera) -> Correspondences:
    """Matches of undistorted images in pixels of the distorted ones; those with an end outside are dropped."""
    if camera.lens is None:
        return matches
    sets = {}
    for name in _SETS:
        rows = getattr(matches, name)
        ends = camera.lens_pixels(rows.reshape(len(rows), -1, 2))
        sets[name] = ends[np.all(camera.contains(ends), axis=1)].reshape(-1, rows.shape[1])
    return replace(matches, **sets)
