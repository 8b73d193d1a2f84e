"""The channel ``affine``: how the surroundings of the points of ``tracks`` lie in each frame, to first order.

A pixel p of the source sees a point X of the plane of the triangle that the ray through the track's pixel meets;
another frame sees X at q. Both rows read it at their own times: p = proj(pose(time(p)) X), and so q. With B a
basis of the plane, J the derivative of a projection by X, v the velocity of its pixel and r the derivative of the
time by the pixel, differentiating both implicit equations gives (1 - v r') dp = J B du, and so for q, hence

    dq/dp = (1 - v_q r_q')^-1 (J_q B) (J_p B)^-1 (1 - v_p r_p').

A global shutter has r = 0, and what is left is the affine map of the homography of the plane.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rsbench.core.camera import inverse_2x2
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import pixel_moves, plane_basis
from rsbench.core.rig import View
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.tracks import Tracks, track_views
from rsbench.storage.files import save_arrays
from rsbench.storage.untrusted_files import load_arrays

if TYPE_CHECKING:  # which reads affine frames
    from rsbench.core.geometry import Geometry
    from rsbench.renderers.visibility import Surfaces


class Meets(Protocol):
    """Rays through a scene, as ``renderers.segments.SceneRays``."""

    def surfaces(self, eyes: FloatArray, points: FloatArray) -> Surfaces: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineFrames:
    """Of the points (n) of ``tracks``.

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
        for name, shape in (("jacobians", (n, *views, 2, 2)), ("normals", (n, 3))):
            value = getattr(self, name)
            if value.shape != shape or value.dtype != np.float64:
                raise ValueError(f"{name} is {value.dtype} of shape {value.shape}: float64 of {shape} is needed")
        if not np.all(np.isfinite(self.normals)):
            raise ValueError("normals must be finite")

    def between(self, one: int, other: int) -> FloatArray:
        """(n, 2, 2) derivative of the pixel in frame ``other`` by that in frame ``one``, by their numbers."""
        return self.jacobians[:, other] @ inverse_2x2(self.jacobians[:, one])


def make_affine(geometry: Geometry, tracks: Tracks, rays: Meets) -> AffineFrames:
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
    """(n, 2, 2) derivative of the pixels of a frame by steps along two ways (n, 3, 2) from the points."""
    tau = np.where(np.isnan(tracks.tau[:, k]), 0.0, tracks.tau[:, k])
    moves = pixel_moves(geometry.rig, geometry.shutter, geometry.motion, view[0], tau, tracks.points, along)
    return np.where(np.isnan(tracks.tau[:, k])[:, None, None], np.nan, moves)


def save_affine(path: Path, affine: AffineFrames) -> None:
    """The arrays by their names."""
    save_arrays(path, {field.name: getattr(affine, field.name) for field in fields(affine)})


def read_affine(path: Path) -> AffineFrames:
    """Raises RsbenchError as ``reading.load_arrays``, and for arrays that are no affine frames."""
    try:
        return AffineFrames(**load_arrays(path))
    except (TypeError, ValueError) as error:
        raise RsbenchError(f"{path}: {error}") from error
