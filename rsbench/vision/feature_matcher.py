"""The contract of feature matchers, point correspondences of four images, and how they are found by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components import plugins
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import SET_COLUMNS, Correspondences, lens_affine
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray

_FAR = -1e6
"""Pixel of what the lens does not reach."""

_OUTSIDE_PX = 1.0
"""How far beyond the centre of the outermost pixel a sub-pixel position may lie."""


class FeatureMatcher(ABC):
    """Correspondences of a rig over two frames; a frozen dataclass, whose fields a card may set."""

    @abstractmethod
    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        """Matches between ``images["left", 0]``, ``["right", 0]``, ``["left", 1]`` and ``["right", 1]``.

        Images (H, W) or (H, W, 3) RGB of one size; positions in pixels, the centre of the top-left one (0, 0).
        Sets may come out empty; the solver says what it needs. ``tracks`` are points seen in all four images.
        """

    def match_with_lens(self, images: Mapping[View, NDArray[np.uint8]], camera: PinholeCamera) -> Correspondences:
        """``match`` of images that have the lens of ``camera``, in their pixels: of the images without it."""
        straight = {view: undistorted(image, camera) for view, image in images.items()}
        return with_lens(self.match(straight), camera)


FeatureEntry = Entry[FeatureMatcher, RunOptions]
FEATURE_MATCHERS: Kind[FeatureMatcher, RunOptions] = Kind(
    singular="feature matcher", cards="features", base=FeatureMatcher, options=RunOptions
)


def load_features(name_or_path: str | Path) -> FeatureEntry:
    """A feature matcher by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such feature matcher, two of that name, or its card or class is wrong.
    """
    return plugins.load_entry(FEATURE_MATCHERS, name_or_path)


def find_correspondences(
    entry: FeatureEntry, images: Mapping[View, NDArray[np.uint8]], camera: PinholeCamera | None = None
) -> Correspondences:
    """What a feature matcher finds in four images, checked: finite positions inside the images.

    Args:
        camera: whose lens the images have; None: they have none.

    Raises:
        RsbenchError: another package's matcher raised, or answered something else: one line with its name.
    """
    where = f"{FEATURE_MATCHERS.singular} {entry.name!r}"
    with plugins.blame(FEATURE_MATCHERS, entry):
        if camera is None or camera.lens is None:
            found = entry.component.match(images)
        else:
            found = entry.component.match_with_lens(images, camera)
    if not isinstance(found, Correspondences):
        raise RsbenchError(f"{where}: must return Correspondences, got {type(found).__name__}")
    height, width = images["left", 0].shape[:2]
    most = np.array([width, height]) - 1.0 + _OUTSIDE_PX
    for name in SET_COLUMNS:
        points = getattr(found, name).reshape(-1, 2)
        outside = np.any((points < -_OUTSIDE_PX) | (points > most), axis=1)
        if np.any(outside):
            raise RsbenchError(
                f"{where}: {name}: {np.count_nonzero(outside)} positions lie outside the {width} x {height} "
                f"image, such as {points[outside][0].tolist()}"
            )
    return found


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
