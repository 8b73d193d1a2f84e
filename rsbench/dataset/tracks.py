"""The channels ``tracks`` (surface points and where each frame sees them) and ``affine`` (their surroundings)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from rsbench.core.camera import inverse_2x2
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import ProjectionStatus, back_project, pixel_moves, plane_basis, rs_project
from rsbench.core.rig import SIDES, View
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.views import PixelClass, Rays
from rsbench.storage.files import save_arrays
from rsbench.storage.untrusted_files import load_arrays

if TYPE_CHECKING:
    from rsbench.core.geometry import Geometry

IN_ALL = 2048
"""Points drawn from the pixels of all frames, of each as many."""


def track_views(frames: int) -> tuple[View, ...]:
    """Left 0, right 0, left 1, right 1, ...: the order of the frames in the arrays, and of ``Sequence.images``."""
    return tuple((side, frame) for frame in range(frames) for side in SIDES)


def _source_type(views: int) -> np.dtype[Any]:
    """Type of the numbers of frames."""
    return np.min_scalar_type(views - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class ArrayFile:
    """Arrays that are stored as an npz file under the names of their fields."""

    def check_arrays(self, wanted: Mapping[str, tuple[tuple[int, ...], DTypeLike]]) -> None:
        """Raises ValueError for an array of another shape or type than is wanted by its name."""
        for name, (shape, kind) in wanted.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != kind:
                raise ValueError(
                    f"{name} is {value.dtype} of shape {value.shape}: {np.dtype(kind)} of {shape} is needed"
                )

    def save(self, path: Path) -> None:
        """Write the file."""
        save_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the file; RsbenchError as of ``load_arrays``, and for arrays that are not possible."""
        try:
            return cls(**load_arrays(path))
        except (TypeError, ValueError) as error:
            raise RsbenchError(f"{path}: {error}") from error


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks(ArrayFile):
    """Points (n) and what became of them in all frames (v), in the order of ``track_views``.

    Raises:
        ValueError: arrays of other shapes or types, or of points, sources or classes that cannot be.
    """

    points: FloatArray
    """(n, 3) world frame, metres."""
    sources: NDArray[np.unsignedinteger[Any]]
    """(n,) number of the frame from whose pixels the point was drawn."""
    pixels: FloatArray
    """(n, v, 2) px, between pixels too; NaN where a frame does not see the point."""
    tau: FloatArray
    """(n, v) times at which the frames see it, frame periods; NaN likewise."""
    classes: NDArray[np.uint8]
    """(n, v) of ``PixelClass``: VISIBLE, OCCLUDED (the pixel is known), OUT_OF_VIEW or UNSOLVED."""

    def __post_init__(self) -> None:
        n, f8 = len(self.points), np.float64
        v = self.tau.shape[1] if self.tau.ndim == 2 and self.tau.shape[1] else 4
        seen = {"pixels": ((n, v, 2), f8), "tau": ((n, v), f8), "classes": ((n, v), np.uint8)}
        self.check_arrays({"points": ((n, 3), f8), "sources": ((n,), _source_type(v)), **seen})
        if not np.all(np.isfinite(self.points)) or np.any(self.sources >= v):
            raise ValueError(f"points must be finite, and sources 0 to {v - 1}")
        if np.any(self.classes > PixelClass.OUT_OF_VIEW):
            raise ValueError(f"classes holds {np.max(self.classes)}: a point is of class 0 to 3")


def make_tracks(
    geometry: Geometry,
    depths: Mapping[View, NDArray[np.float32]],
    blocked: Callable[[FloatArray, FloatArray], NDArray[np.bool_]],
    seed: str,
) -> Tracks:
    """Draw pixels with a surface from each frame, ``IN_ALL`` together, and look for their points in all of them.

    Args:
        geometry: of the sequence.
        depths: (H, W) of each rolling-shutter frame, metres, 0 = no surface.
        blocked: see ``views.Blocked``.
        seed: of the draw.
    """
    views = track_views(geometry.frames)
    count = max(1, IN_ALL // len(views))
    drawn = [_drawn(geometry, view, depths[view], f"{seed}/tracks/{view[0]}_{view[1]}", count) for view in views]
    points = np.concatenate([X for X, _ in drawn])
    sources = np.repeat(np.arange(len(drawn), dtype=_source_type(len(views))), [len(X) for X, _ in drawn])
    seen = [look_for(geometry, view, points, blocked) for view in views]
    pixels, tau, classes = (np.stack(each, axis=1) for each in zip(*seen, strict=True))
    # A frame that sees a point twice names the first row; where it was drawn, it is the pixel of the draw.
    for k, (view, (_, grid)) in enumerate(zip(views, drawn, strict=True)):
        own = sources == k
        pixels[own, k], classes[own, k] = grid, PixelClass.VISIBLE
        tau[own, k] = geometry.shutter.pixel_time(grid, view[1], view[0])
    return Tracks(points=points, sources=sources, pixels=pixels, tau=tau, classes=classes)


def _drawn(
    geometry: Geometry, view: View, depth: NDArray[np.float32], seed: str, count: int
) -> tuple[FloatArray, FloatArray]:
    """World points (n, 3) and the pixels (n, 2) that see them."""
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(seed.encode()).digest()[:16], "little"))
    solid = np.flatnonzero(depth)
    chosen = np.sort(rng.permutation(solid)[:count])
    y, x = np.divmod(chosen, depth.shape[1])
    pixels = np.column_stack([x, y]).astype(np.float64)
    return points_at(geometry, view, pixels, depth), pixels


def points_at(geometry: Geometry, view: View, pixels: FloatArray, depth: NDArray[np.float32]) -> FloatArray:
    """World points (n, 3) that whole pixels (n, 2) of a frame see."""
    z = depth[pixels[:, 1].astype(np.int64), pixels[:, 0].astype(np.int64)]
    return back_project(geometry.rig, geometry.shutter, geometry.motion, *view, pixels, z)


def look_for(
    geometry: Geometry,
    view: View,
    points: FloatArray,
    blocked: Callable[[FloatArray, FloatArray], NDArray[np.bool_]],
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
    """Pixels (n, 2), times (n,) and classes (n,) of points in a frame."""
    side, frame = view
    found = rs_project(geometry.rig, geometry.shutter, geometry.motion, side, frame, points)
    inside = np.isfinite(found.tau)
    eyes = inverse(geometry.rig.cam_from_world(geometry.motion, found.tau[inside], side)).t
    lost = found.status == ProjectionStatus.NOT_CONVERGED
    classes = np.where(lost, PixelClass.UNSOLVED, PixelClass.OUT_OF_VIEW).astype(np.uint8)
    hidden = blocked(eyes, points[inside]) if np.any(inside) else np.zeros(0, dtype=np.bool_)
    classes[inside] = np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE)
    return found.pixels, found.tau, classes


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineFrames(ArrayFile):
    """Affine frames of the points (n) of ``tracks``.

    Raises:
        ValueError: arrays of other shapes or types.
    """

    jacobians: FloatArray
    """(n, v, 2, 2) derivative of the pixel in each frame (rows x, y) by the pixel in the source (columns x, y), on
    the plane that the source sees; 1 in the source itself, NaN where a frame does not see the point."""
    normals: FloatArray
    """(n, 3) unit normal of that plane, towards the source, world frame; 0 where the ray met none, between two."""

    def __post_init__(self) -> None:
        n, views = len(self.normals), self.jacobians.shape[1:2]
        self.check_arrays({"jacobians": ((n, *views, 2, 2), np.float64), "normals": ((n, 3), np.float64)})
        if not np.all(np.isfinite(self.normals)):
            raise ValueError("normals must be finite")

    def between(self, one: int, other: int) -> FloatArray:
        """(n, 2, 2) derivative of the pixel in frame ``other`` by that in frame ``one``, by their numbers."""
        return self.jacobians[:, other] @ inverse_2x2(self.jacobians[:, one])


def make_affine(geometry: Geometry, tracks: Tracks, rays: Rays) -> AffineFrames:
    """The affine frames of tracks, on the surfaces that rays through their pixels meet."""
    normals = np.zeros_like(tracks.points)
    for k, (side, _) in enumerate(track_views(geometry.frames)):
        own = tracks.sources == k
        if np.any(own):
            eyes = inverse(geometry.rig.cam_from_world(geometry.motion, tracks.tau[own, k], side)).t
            normals[own] = rays.surfaces(eyes, tracks.points[own]).normals
    return AffineFrames(jacobians=jacobians_of(geometry, tracks, normals), normals=normals)


def jacobians_of(geometry: Geometry, tracks: Tracks, normals: FloatArray) -> FloatArray:
    """``AffineFrames.jacobians`` (n, v, 2, 2) of tracks on planes with these normals (n, 3)."""
    along = plane_basis(normals)
    views = enumerate(track_views(geometry.frames))
    moves = [_moves(geometry, view, tracks, k, along) for k, view in views]
    by_plane = np.stack(moves, axis=1)
    source = by_plane[np.arange(len(normals)), tracks.sources]
    jacobians = by_plane @ inverse_2x2(source)[:, None]
    jacobians[np.arange(len(normals)), tracks.sources] = np.eye(2)
    jacobians[np.all(normals == 0.0, axis=1)] = np.nan
    return jacobians


def _moves(geometry: Geometry, view: View, tracks: Tracks, k: int, along: FloatArray) -> FloatArray:
    """(n, 2, 2) derivative of the pixels of a frame by steps along two directions (n, 3, 2) from the points."""
    tau = np.where(np.isnan(tracks.tau[:, k]), 0.0, tracks.tau[:, k])
    moves = pixel_moves(geometry.rig, geometry.shutter, geometry.motion, view[0], tau, tracks.points, along)
    return np.where(np.isnan(tracks.tau[:, k])[:, None, None], np.nan, moves)
