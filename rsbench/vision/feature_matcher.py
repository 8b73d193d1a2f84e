"""The interface of feature matchers, which find point correspondences of four images; loading by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components import plugins
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import SET_SIDES, Correspondences, lens_affine, lens_covariance
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, AlignedCamera, StereoRig, View
from rsbench.core.so3 import FloatArray

_FAR = -1e6
"""Pixel coordinate of rays beyond the reach of the lens."""

_OUTSIDE_PX = 1.0
"""How far beyond the centre of the outermost pixel a sub-pixel position may lie."""


class FeatureMatcher(ABC):
    """Correspondences of a rig over two frames; a frozen dataclass, whose fields a card may set."""

    @abstractmethod
    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        """Match ``images["left", 0]``, ``["right", 0]``, ``["left", 1]`` and ``["right", 1]``.

        Images are (H, W) or (H, W, 3) RGB, of one size. Positions are in pixels; the centre of the top-left pixel
        is (0, 0). Any set of the result may be empty. ``tracks`` are points that are visible in all four images.
        """

    def match_of_rig(self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig) -> Correspondences:
        """Match images of any cameras, in their pixels; by default after removing lens distortion and rotation."""
        straight = {view: undistorted(image, rig.eye(view[0])) for view, image in images.items()}
        return of_sensors(self.match(straight), rig)

    def apart(self) -> Self | None:
        """Return this matcher for cameras that read a row at different times: left-right matches on any rows.

        None (the default): the matcher may search along rows only.
        """
        return None

    def with_enough(self, tracks: int) -> Self:
        """Return this matcher; it may then return tracks alone if it finds at least ``tracks`` of them."""
        return self

    def faster(self) -> Self | None:
        """Return this matcher for half the image size; None (the default): not supported."""
        return None


FeatureEntry = Entry[FeatureMatcher, RunOptions]
FEATURE_MATCHERS: Kind[FeatureMatcher, RunOptions] = Kind(
    singular="feature matcher", cards="features", base=FeatureMatcher, options=RunOptions
)


def load_features(name_or_path: str | Path) -> FeatureEntry:
    """Load a feature matcher by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: the feature matcher does not exist, two have this name, or its card or class is wrong.
    """
    return plugins.load_entry(FEATURE_MATCHERS, name_or_path)


def find_correspondences(
    entry: FeatureEntry, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig | None = None
) -> Correspondences:
    """Match four images, and check that all positions lie inside the images.

    Args:
        rig: the rig that took the images; None: the pairs are rectified.

    Raises:
        RsbenchError: another package's matcher raised an exception, or a matcher returned a wrong result.
    """
    where = f"{FEATURE_MATCHERS.singular} {entry.name!r}"
    with plugins.blame(FEATURE_MATCHERS, entry):
        if rig is None or rig.rectified:
            found = entry.component.match(images)
        else:
            found = entry.component.match_of_rig(images, rig)
    if not isinstance(found, Correspondences):
        raise RsbenchError(f"{where}: must return Correspondences, got {type(found).__name__}")
    for name, sides in SET_SIDES.items():
        rows = getattr(found, name)
        for side in SIDES:
            own = [k for k, each in enumerate(sides) if each == side]
            points = rows.reshape(len(rows), len(sides), 2)[:, own].reshape(-1, 2)
            height, width = images[side, 0].shape[:2]
            most = np.array([width, height]) - 1.0 + _OUTSIDE_PX
            outside = np.any((points < -_OUTSIDE_PX) | (points > most), axis=1)
            if np.any(outside):
                raise RsbenchError(
                    f"{where}: {name}: {np.count_nonzero(outside)} positions lie outside the {width} x {height} "
                    f"image, such as {points[outside][0].tolist()}"
                )
    return found


def undistorted(image: NDArray[Any], camera: PinholeCamera | AlignedCamera) -> NDArray[Any]:
    """Resample an image (H, W[, 3]) to ideal pixels, at the size of the ideal camera, by cubic interpolation.

    Areas outside the image are filled by mirroring its border; ``of_sensors`` drops matches there. A row of the
    result was not read at one time: readout times belong to the pixels of the original image.
    """
    if camera.is_ideal:
        return image
    source = _lens_pixels(camera)
    return np.asarray(
        cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    )


@lru_cache(maxsize=2 * len(SIDES))
def _lens_pixels(camera: PinholeCamera | AlignedCamera) -> NDArray[np.float32]:
    """(H, W, 2) positions of the ideal camera's pixels in the image. The result is cached: do not modify it."""
    return np.nan_to_num(camera.lens_pixels(camera.ideal.pixel_grid()), nan=_FAR).astype(np.float32)


def of_sensors(matches: Correspondences, rig: StereoRig, border_px: float = 0.0) -> Correspondences:
    """Convert matches from ideal pixels to pixels of the images, without those outside or within ``border_px``."""
    if rig.rectified:
        return matches
    sets, kept = dict[str, FloatArray](), dict[str, NDArray[np.bool_]]()
    for name, sides in SET_SIDES.items():
        rows = getattr(matches, name)
        ideal = rows.reshape(len(rows), len(sides), 2)
        ends = np.stack([rig.eye(side).lens_pixels(ideal[:, k]) for k, side in enumerate(sides)], axis=1)
        inside = [_inside(ends[:, k], rig.sensor(side), border_px) for k, side in enumerate(sides)]
        kept[name] = np.all(inside, axis=0)
        sets[name] = ends[kept[name]].reshape(-1, rows.shape[1])
    affine = matches.affine[kept["left"][: len(matches.affine)]]
    covariance = matches.covariance[kept["tracks"][: len(matches.covariance)]]
    return replace(
        matches,
        **sets,
        affine=lens_affine(affine, sets["left"], rig.eye("left")),
        covariance=lens_covariance(covariance, sets["tracks"], rig.eye("left")),
    )


def _inside(points: FloatArray, camera: PinholeCamera, border_px: float) -> NDArray[np.bool_]:
    """Mask (n,) of points (n, 2), px, that are inside the image and at least ``border_px`` from its border."""
    shifts = [np.array([x, y]) for x in (-border_px, border_px) for y in (-border_px, border_px)]
    return np.all([camera.contains(points + shift) for shift in shifts], axis=0)
