"""Depth as simpler corrections see it: one plane, or two frames of a single camera."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.epipolar import ray_depths
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.vision.images import grey_u8

F32 = NDArray[np.float32]
_ROUNDS = 8
_NEAREST_SHARE = 0.999
_CHUNK_ROWS = 100


def plane_depth(depth: NDArray[Any]) -> F32:
    """Depth (H, W) of the plane that fits a depth map (H, W) best: inverse depth affine in the pixel.

    Iterated least squares on absolute differences, so that the larger surface wins; 0 and NaN are unknown, inf is
    infinitely far. Where the plane lies behind the camera the result is inf. A correction with it is a
    homography per row.
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    basis = np.stack([np.ones_like(x), x, y], axis=-1)
    known = depth > 0.0
    if np.count_nonzero(known) < 3:
        return np.full(depth.shape, np.inf, dtype=np.float32)
    A, rho = basis[known], 1.0 / depth[known].astype(np.float64)
    least = 1e-3 * max(float(np.median(rho)), 1e-12)
    weights = np.ones_like(rho)
    for _ in range(_ROUNDS):
        plane, *_ = np.linalg.lstsq(A * weights[:, None], rho * weights, rcond=None)
        weights = 1.0 / np.sqrt(np.maximum(np.abs(A @ plane - rho), least))
    fitted = basis @ plane
    with np.errstate(divide="ignore"):
        return np.where(fitted > 0.0, 1.0 / np.maximum(fitted, 0.0), np.inf).astype(np.float32)


def dense_flow(first: NDArray[Any], second: NDArray[Any]) -> F32:
    """Displacement (H, W, 2), px, from ``first`` to ``second`` (H, W[, 3]), uint8 or uint16.

    Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV).
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(dis.calc(grey_u8(first), grey_u8(second), None), dtype=np.float32)


def flow_depth(flow: F32, camera: PinholeCamera, poses: Pose, other_poses: Pose) -> F32:
    """Depth (H, W) of one moving camera's frame from the flow (H, W, 2) to its other frame.

    ``poses`` and ``other_poses`` are ``cam_from_world`` of the rows of both frames; the depth is in the unit of
    their translation. Every pixel's two rays are brought closest (the row that sees the target decides its pose);
    a point behind either camera or with parallel rays is put at infinity. Median-filtered in inverse depth.
    """
    grid = camera.pixel_grid()
    height = camera.height
    rho = np.zeros((height, camera.width), dtype=np.float32)
    for start in range(0, height, _CHUNK_ROWS):
        rows = slice(start, min(start + _CHUNK_ROWS, height))
        target = grid[rows] + flow[rows]
        other = np.clip(np.rint(target[..., 1]), 0, height - 1).astype(np.intp)
        from_world = inverse(Pose(poses.R[rows, None], poses.t[rows, None]))
        relative = compose(Pose(other_poses.R[other], other_poses.t[other]), from_world)
        z = ray_depths(relative, camera.unproject(grid[rows]), camera.unproject(target))
        front = np.all(np.where(np.isfinite(z), z, -1.0) > 0.0, axis=-1)
        rho[rows] = np.where(front, 1.0 / np.where(front, z[..., 0], 1.0), 0.0)
    # One pixel near the focus of expansion must not swallow the picture.
    rho = cv2.medianBlur(np.minimum(rho, np.float32(np.quantile(rho, _NEAREST_SHARE))), 5)
    with np.errstate(divide="ignore"):
        return np.where(rho > 0.0, 1.0 / rho, np.inf).astype(np.float32)
