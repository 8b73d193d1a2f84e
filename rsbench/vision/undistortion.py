"""Images as the camera without its lens would have them, and matches and disparities found in such images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import SET_COLUMNS, Correspondences, lens_affine
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.vision.resample import resample
from rsbench.vision.stereo_matcher import F32, MatcherEntry, find_disparities

_FAR = -1e6
"""Pixel of what the lens does not reach."""
_WIDEST = 2.0
"""Times the size of the image: what a lens shows beyond has no depth from the other camera."""
_ONE_SURFACE_PX = 1.0
"""Disparities of neighbours that differ by more are not interpolated."""


def undistorted(image: NDArray[Any], camera: PinholeCamera) -> NDArray[Any]:
    """The image (H, W[, 3]) without distortion, of the same size and intrinsics; cubic interpolation.

    What lies beyond the distorted image is a mirror of its border: ``with_lens`` drops matches there. Rows of the
    result are not read at one time: times belong to the pixels of the image as it was.
    """
    if camera.lens is None:
        return image
    source = np.nan_to_num(camera.lens_pixels(camera.pixel_grid()), nan=_FAR).astype(np.float32)
    return np.asarray(
        cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    )


def with_lens(matches: Correspondences, camera: PinholeCamera) -> Correspondences:
    """Matches of undistorted images in pixels of the distorted ones; those with an end outside are dropped."""
    if camera.lens is None:
        return matches
    sets, kept = dict[str, FloatArray](), dict[str, NDArray[np.bool_]]()
    for name in SET_COLUMNS:
        rows = getattr(matches, name)
        ends = camera.lens_pixels(rows.reshape(len(rows), rows.shape[1] // 2, 2))
        kept[name] = np.all(camera.contains(ends), axis=1)
        sets[name] = ends[kept[name]].reshape(-1, rows.shape[1])
    affine = matches.affine[kept["left"][: len(matches.affine)]]
    return replace(matches, **sets, affine=lens_affine(affine, sets["left"], camera))


def sensor_disparities(
    entry: MatcherEntry, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
) -> tuple[F32, F32]:
    """``find_disparities`` on the pixels (H, W) of cameras with or without a lens, in ideal px.

    The matcher sees a pair without distortion that is as wide as the images reach. Its disparities are carried
    back to the pixels of the images; those whose other end lies outside the other image are dropped.

    Raises:
        RsbenchError: see ``find_disparities``.
    """
    camera = rig.camera
    if camera.lens is None:
        return find_disparities(entry, left, right, rig)
    ideal, wide = camera.ideal_pixels(camera.pixel_grid()), widened(camera)
    places = camera.project(wide.unproject(wide.pixel_grid()))
    inside: F32 = np.where(camera.contains(places)[..., None], places, np.nan).astype(np.float32)
    levels = [resample(image, inside) for image in (left, right)]
    both = find_disparities(entry, levels[0], levels[1], replace(rig, camera=wide))
    shift = np.array([wide.cx - camera.cx, wide.cy - camera.cy])
    first, second = (
        _with_partner(between_pixels(found, ideal + shift), ideal, camera, 1.0 if side == "left" else -1.0)
        for side, found in zip(SIDES, both, strict=True)
    )
    return first, second


def widened(camera: PinholeCamera) -> PinholeCamera:
    """The camera without its lens, with an image that holds all that this one shows; the camera without a lens."""
    return camera if camera.lens is None else _around(camera.ideal, camera.ideal_pixels(camera.pixel_grid()))


def _around(ideal: PinholeCamera, pixels: FloatArray) -> PinholeCamera:
    """The ideal camera with an image that holds these pixels (..., 2), by whole pixels, at most ``_WIDEST``."""
    size = np.array([ideal.width, ideal.height])
    spare = np.floor((_WIDEST - 1.0) * 0.5 * size)
    low = np.clip(np.ceil(-np.nanmin(pixels, axis=(0, 1))), 0.0, spare).astype(int)
    high = np.clip(np.ceil(np.nanmax(pixels, axis=(0, 1)) - (size - 1)), 0.0, spare).astype(int)
    width, height = (size + low + high).tolist()
    return replace(ideal, width=width, height=height, cx=ideal.cx + low[0], cy=ideal.cy + low[1])


def between_pixels(disparity: F32, places: FloatArray) -> F32:
    """Disparity (H, W), px, at places (h, w, 2): between its pixels on one surface, else that of the nearest."""
    height, width = disparity.shape
    x, y = np.moveaxis(np.clip(np.floor(places).astype(np.int64), 0, [width - 2, height - 2]), -1, 0)
    s, t = places[..., 0] - x, places[..., 1] - y
    corners = [disparity[y, x], disparity[y, x + 1], disparity[y + 1, x], disparity[y + 1, x + 1]]
    upper, lower = (a + s * (b - a) for a, b in (corners[:2], corners[2:]))
    nearest = np.select([(t < 0.5) & (s < 0.5), t < 0.5, s < 0.5], corners[:3], corners[3])
    one = np.ptp(np.stack(corners), axis=0) <= _ONE_SURFACE_PX  # false where one of them is not known
    inside = np.all((places >= -0.5) & (places <= np.array([width, height]) - 0.5), axis=-1)
    return np.where(inside, np.where(one, upper + t * (lower - upper), nearest), np.nan).astype(np.float32)


def _with_partner(disparity: F32, ideal: FloatArray, camera: PinholeCamera, sign: float) -> F32:
    """The disparities whose other end the other camera shows."""
    other = np.stack([ideal[..., 0] - sign * disparity, ideal[..., 1]], axis=-1)
    return np.where(camera.contains(camera.lens_pixels(other)), disparity, np.float32(np.nan))
