"""Depth as simpler corrections see it: one plane, or two frames of a single camera."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.vision.flow import flow_depth

F32 = NDArray[np.float32]
_ROUNDS = 8
_NEAREST_SHARE = 0.999
_CHUNK_ROWS = 100


def plane_depth(depth: NDArray[Any], camera: PinholeCamera | None = None) -> F32:
    """Depth (H, W) of the plane that fits a depth map (H, W) best: inverse depth affine in the (ideal) pixel.

    Iterated least squares on absolute differences, so that the larger surface wins; 0 and NaN are unknown, inf is
    infinitely far. Where the plane lies behind the camera the result is inf. A correction with it is a homography
    per row. ``camera`` matters where it has a lens.
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    if camera is not None and camera.lens is not None:
        x, y = np.moveaxis(camera.unproject(camera.pixel_grid())[..., :2], -1, 0)
    basis = np.stack([np.ones_like(x), x, y], axis=-1)
    known = depth > 0.0
    if np.count_nonzero(known) < 3:
        return np.full(depth.shape, np.inf, dtype=np.float32)
    A, rho = basis[known], 1.0 / depth[known].astype(np.float64)
    least = 1e-3 * max(float(np.median(rho)), 1e-12)
    weights, plane = np.ones_like(rho), np.zeros(3)
    for _ in range(_ROUNDS):
        plane, *_ = np.linalg.lstsq(A * weights[:, None], rho * weights, rcond=None)
        weights = 1.0 / np.sqrt(np.maximum(np.abs(A @ plane - rho), least))
    fitted = basis @ plane
    with np.errstate(divide="ignore"):
        return np.where(fitted > 0.0, 1.0 / np.maximum(fitted, 0.0), np.inf).astype(np.float32)


def monocular_depth(
    flow: F32, rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int
) -> F32:
    """Depth (H, W) of every pixel of a frame from the flow (H, W, 2) to the other one, in the motion's unit.

    inf where the rays do not meet in front of the camera. Median-filtered in inverse depth.
    """
    grid = rig.camera.pixel_grid()
    rho = np.zeros(flow.shape[:2], dtype=np.float32)
    for start in range(0, len(rho), _CHUNK_ROWS):
        rows = slice(start, start + _CHUNK_ROWS)
        rho[rows] = 1.0 / flow_depth(grid[rows], flow[rows], rig, shutter, motion, side, frame)[0]
    # One pixel near the focus of expansion must not swallow the picture.
    rho = cv2.medianBlur(np.minimum(rho, np.float32(np.quantile(rho, _NEAREST_SHARE))), 5)
    with np.errstate(divide="ignore"):
        return np.where(rho > 0.0, 1.0 / rho, np.inf).astype(np.float32)
