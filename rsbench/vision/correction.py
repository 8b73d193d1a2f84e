"""Correction of a rolling-shutter frame: the global-shutter image at a chosen time.

Every pixel is back-projected with its row's pose (paper, eq. 11a) and projected at the target pose (eq. 11b). The
two steps are one map in the pixel and its inverse depth, ``h = M_y (x, y, 1) + rho b_y`` with
``M_y = K R K^-1``, ``b_y = K t`` and ``R, t`` the target pose from row y's pose, so a surface at infinity
(rho = 0) needs no special case: it moves by rotation alone and every other surface hides it. The images are
resampled once, at source coordinates interpolated over the mesh of pixel centres (``forward_warp``).

A lens changes where the maps begin and end, not how often an image is resampled: source and target are both images
of the camera with its lens, and times belong to the pixels of the source as the sensor has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import MovingRig
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, View
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision import forward_warp
from rsbench.vision.compiled_camera import LineMaps, optics_of
from rsbench.vision.resample import Interpolation, resample

_IMAGE_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


@dataclass(frozen=True, kw_only=True)
class WarpOptions:
    """How the source image becomes the target image."""

    interpolation: Interpolation = "cubic"
    """Interpolation of colours between the source image's pixels."""
    tear_px: float = 0.2
    """Two neighbours are torn apart when a step of depth between them, which neither side's surface explains,
    moves them apart by more than this many px; so the mesh is at most this wrong between surfaces."""

    def __post_init__(self) -> None:
        if self.interpolation not in get_args(Interpolation):
            raise ValueError(f"interpolation must be one of {get_args(Interpolation)}, got {self.interpolation!r}")
        if not self.tear_px > 0.0:
            raise ValueError(f"tear_px must be positive, got {self.tear_px}")


@dataclass(frozen=True, kw_only=True, eq=False)
class LineView:
    """A frame each of whose lines has a pose of its own."""

    image: NDArray[Any]
    """(H, W) or (H, W, C) of uint8, uint16 or float32."""
    depth: NDArray[Any]
    """(H, W) z in each line's own camera, metres; inf is infinitely far, 0, negative or NaN unknown."""
    poses: Pose
    """``cam_from_world`` of every line, (lines, 3, 3) and (lines, 3)."""
    camera: PinholeCamera | None = None
    """Where it is not the target's: a rig whose disparities are off has two principal points. None with a lens."""
    columns: bool = False
    """Whether lines are columns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Corrected:
    """A frame as one camera at one time would have seen it."""

    image: NDArray[Any]
    """(H, W) or (H, W, C), type of the source; 0 where the mask is False."""
    mask: NDArray[np.bool_]
    """(H, W) what the source frame saw."""
    source_map: NDArray[np.float32]
    """(H, W, 2) source pixel (x, y) of every target pixel; NaN where the mask is False."""
    depth: NDArray[np.float32]
    """(H, W) z in the target camera, metres; inf at infinity, NaN where the mask is False."""


def line_maps(
    camera: PinholeCamera,
    source_poses: Pose,
    target_pose: Pose,
    columns: bool = False,
    source_camera: PinholeCamera | None = None,
) -> LineMaps:
    """Where the pixels of a frame, one pose per line, lie in ``camera`` at the target pose.

    Poses are ``cam_from_world``, of every line and of the target; either may be the one that has lines.
    ``source_camera`` is the frame's when it is another one, of the same lens.
    """
    R, t = compose(target_pose, inverse(source_poses))
    K = camera.ideal.K
    M = K @ R @ np.linalg.inv((source_camera or camera).ideal.K)
    return LineMaps(M, t @ K.T, *optics_of(camera, columns))


def warp_gain(camera: PinholeCamera, source_poses: Pose, target_pose: Pose, columns: bool = False) -> FloatArray:
    """(H, 1) px m, (1, W) of ``columns``: a step of inverse depth moves a pixel by about this times it, f |t|."""
    lengths = np.linalg.norm(compose(target_pose, inverse(source_poses)).t, axis=-1)
    gain = np.asarray(max(camera.fx, camera.fy) * lengths)
    return gain[np.newaxis] if columns else gain[:, np.newaxis]


def inverse_depth(depth: NDArray[Any], sky_mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """1 / depth (H, W): 0 at infinity and under ``sky_mask``, NaN where the depth is unknown (not positive)."""
    rho = np.full(depth.shape, np.nan, dtype=np.float32)
    np.divide(1.0, depth, out=rho, where=depth > 0.0, casting="same_kind")
    if sky_mask is not None:
        rho[sky_mask] = 0.0
    return rho


def warp(
    view: LineView,
    camera: PinholeCamera,
    target_pose: Pose,
    *,
    sky_mask: NDArray[np.bool_] | None = None,
    options: WarpOptions | None = None,
) -> Corrected:
    """Warp a frame with one pose per line to any pose (3, 3), (3,) of the same camera model; z-buffered.

    Pixels under ``sky_mask`` (H, W) are infinitely far. Raises ValueError on other shapes or types.
    """
    options = options or WarpOptions()
    _check(view.image, view.depth, camera, view.poses, sky_mask, view.columns)
    maps = line_maps(camera, view.poses, target_pose, view.columns, view.camera)
    rho = inverse_depth(view.depth, sky_mask)
    gain = np.broadcast_to(warp_gain(camera, view.poses, target_pose, view.columns), rho.shape)
    joined = forward_warp.connect(rho, options.tear_px / np.maximum(gain, np.finfo(np.float64).tiny))
    source_map = np.full((*rho.shape, 2), np.nan, dtype=np.float32)
    buffer = np.full(rho.shape, -1.0, dtype=np.float32)
    forward_warp.draw_mesh(rho, joined, maps, source_map, buffer)
    forward_warp.draw_cells(rho, joined, maps, source_map, buffer)
    mask = buffer >= 0.0
    return Corrected(
        image=resample(view.image, source_map, options.interpolation),
        mask=mask,
        source_map=source_map,
        depth=_depth(buffer, mask),
    )


def correct_frame(
    image: NDArray[Any],
    depth: NDArray[Any],
    moving: MovingRig,
    view: View,
    *,
    target_tau: float | None = None,
    sky_mask: NDArray[np.bool_] | None = None,
    options: WarpOptions | None = None,
) -> Corrected:
    """Rolling-shutter frame (H, W[, C]) to the global-shutter image of the same camera at ``target_tau``.

    ``target_tau`` is in frame periods; by default that of the first line read. ``depth`` (H, W) and the errors
    are those of ``warp``.
    """
    poses, target, columns = _poses(moving, view, target_tau)
    frame = LineView(image=image, depth=depth, poses=poses, columns=columns)
    return warp(frame, moving.rig.camera, target, sky_mask=sky_mask, options=options)


def correction_flow(
    depth: NDArray[Any],
    moving: MovingRig,
    view: View,
    *,
    target_tau: float | None = None,
    sky_mask: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Displacement (H, W, 2), px, that takes each rolling-shutter pixel to its place at ``target_tau``.

    ``x_target - x_source`` on the grid of the source; NaN where the depth is unknown or the point is behind the
    target camera. Arguments as in ``correct_frame``.
    """
    camera = moving.rig.camera
    poses, target, columns = _poses(moving, view, target_tau)
    _check(None, depth, camera, poses, sky_mask, columns)
    moved = np.zeros((3, *depth.shape))
    forward_warp.move_pixels(inverse_depth(depth, sky_mask), line_maps(camera, poses, target, columns), moved)
    return np.asarray(np.moveaxis(moved[:2], 0, -1) - camera.pixel_grid(), dtype=np.float32)


def _poses(moving: MovingRig, view: View, target_tau: float | None) -> tuple[Pose, Pose, bool]:
    """Poses of a frame's lines and of its target, and whether lines are columns."""
    rig, shutter, motion, (side, frame) = moving.rig, moving.shutter, moving.motion, view
    target = rig.cam_from_world(motion, _target_time(shutter, side, frame, target_tau), side)
    return row_poses(rig, shutter, motion, side, frame), target, shutter.axis(side) == 0


def _target_time(shutter: RollingShutter, side: Side, frame: int, target_tau: float | None) -> float:
    tau = float(shutter.start(frame, side)) if target_tau is None else float(target_tau)
    if not math.isfinite(tau):
        raise ValueError(f"target_tau must be a finite time in frame periods, got {target_tau}")
    return tau


def _depth(buffer: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    depth = np.full(buffer.shape, np.nan, dtype=np.float32)
    with np.errstate(divide="ignore"):  # at infinity
        return np.divide(np.float32(1.0), buffer, out=depth, where=mask)


def _check(
    image: NDArray[Any] | None,
    depth: NDArray[Any],
    camera: PinholeCamera,
    source_poses: Pose,
    sky_mask: NDArray[np.bool_] | None,
    columns: bool,
) -> None:
    size = (camera.height, camera.width)
    if image is not None:
        if image.ndim not in (2, 3) or image.shape[:2] != size:
            raise ValueError(f"image must have shape {size} or {size} + channels, got {image.shape}")
        if image.dtype not in _IMAGE_TYPES:
            raise ValueError(f"image must be uint8, uint16 or float32, got {image.dtype}")
    if depth.shape != size or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth must be floating point of shape {size}, got {depth.dtype} {depth.shape}")
    lines = camera.width if columns else camera.height
    if source_poses.R.shape != (lines, 3, 3) or source_poses.t.shape != (lines, 3):
        raise ValueError(f"source_poses must have one pose per line, {lines}, got {source_poses.R.shape}")
    if sky_mask is not None and (sky_mask.shape != size or sky_mask.dtype != np.bool_):
        raise ValueError(f"sky_mask must be bool of shape {size}, got {sky_mask.dtype} {sky_mask.shape}")
