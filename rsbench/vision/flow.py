"""Depth from a camera's own motion: where the other camera of the rig sees nothing, its other frame often does."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.epipolar import ray_depths
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import grey_u8

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_SMALLEST = 32
"""Pixels of the shorter side below which the flow's coarsest level has nothing to match."""


def dense_flow(first: NDArray[Any], second: NDArray[Any]) -> F32:
    """Displacement (H, W, 2), px, from ``first`` to ``second`` (H, W[, 3]), uint8 or uint16.

    Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV).
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(dis.calc(grey_u8(first), grey_u8(second), None), dtype=np.float32)


def flow_returns(flow: F32, back: F32, tolerance: float) -> Mask:
    """Pixels (H, W) that the flow (H, W, 2) and the opposite one, ``back``, bring home within ``tolerance`` px."""
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    nowhere = (float("nan"), float("nan"))
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=nowhere)
    return np.asarray(np.linalg.norm(flow + returned, axis=-1) <= tolerance)


def flow_depth(
    pixels: FloatArray,
    flow: FloatArray | F32,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
) -> tuple[FloatArray, FloatArray]:
    """Depth (...) of pixels (..., 2) of a frame from their flow (..., 2), px, to the other frame of that camera.

    The two rays, each at the time of its own row, are brought closest; parallel or diverging rays put the point at
    infinity. Returns the depth in the unit of the motion's translation, in the row's own camera, and how far, px,
    the flow ends from where the motion takes that point (infinite behind the camera): the flow's error across the
    epipolar curve.
    """
    targets = pixels + flow
    here = rig.cam_from_world(motion, shutter.row_time(pixels[..., 1], frame), side)
    there = rig.cam_from_world(motion, shutter.row_time(targets[..., 1], 1 - frame), side)
    R, T = compose(there, inverse(here))
    x, y = rig.camera.unproject(pixels), rig.camera.unproject(targets)
    z = ray_depths(compose(there, inverse(here)), x, y)
    front = np.all(np.where(np.isfinite(z), z, -1.0) > 0.0, axis=-1)
    depth = np.where(front, z[..., 0], np.inf)
    moved = (R @ x[..., None])[..., 0] + T / depth[..., None]
    ahead = moved[..., 2] > 0.0
    seen = rig.camera.project(np.where(ahead[..., None], moved, 1.0))
    return depth, np.where(ahead, np.linalg.norm(seen - targets, axis=-1), np.inf)


def depth_from_motion(
    images: tuple[NDArray[Any], NDArray[Any]],
    unknown: tuple[Mask, Mask],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    tolerance: float = 1.0,
) -> tuple[F32, F32]:
    """Depth (H, W), metres, of the ``unknown`` pixels of both frames of one camera; 0 where it stays unknown.

    A depth counts when the flow between the frames (H, W[, 3]) returns and agrees with the motion, both within
    ``tolerance`` px; inf is infinitely far. The warp moves such a pixel by less than its flow, so the depth is as
    good as the correction needs it, however small the parallax.
    """
    depths = np.zeros((2, *images[0].shape[:2]), dtype=np.float32)
    if min(images[0].shape[:2]) >= _SMALLEST and any(np.any(mask) for mask in unknown):
        flows = dense_flow(*images), dense_flow(*images[::-1])
        for frame in (0, 1):
            y, x = np.nonzero(unknown[frame] & flow_returns(flows[frame], flows[1 - frame], tolerance))
            pixels = np.stack([x, y], axis=-1).astype(np.float64)
            found, error = flow_depth(pixels, flows[frame][y, x], rig, shutter, motion, side, frame)
            depths[frame, y, x] = np.where(error <= tolerance, found, 0.0)
    return depths[0], depths[1]
