"""Dense optical flow between two frames of a camera, and depth from it."""

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


_FINE_STRIDE, _FINE_STEPS, _FINE_VARIATIONS = 5, 12, 1
"""Distance between patches, px, descents of each, and variational refinements, at full resolution: 0.4 of the
time of OpenCV's preset (3, 25 and 5), with flow that differs by 0.04 px (median) and corrects as well."""


def dense_flow(
    first: NDArray[Any], second: NDArray[Any], start: F32 | None = None, *, quick: bool = False, fine: bool = False
) -> F32:
    """Displacement (H, W, 2), px, from ``first`` to ``second`` (H, W[, 3]), uint8 or uint16.

    Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV).

    Args:
        start: (H, W, 2) px, an approximation; None: no motion.
        quick: take a fifth of the time, with less accuracy: as the start of an alignment.
        fine: take twice the time, and match at full resolution, not at half of it: for shrunk images.
    """
    presets = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM, cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST
    dis = cv2.DISOpticalFlow.create(presets[quick])
    if fine:
        dis.setFinestScale(0)
        dis.setPatchStride(_FINE_STRIDE)
        dis.setGradientDescentIterations(_FINE_STEPS)
        dis.setVariationalRefinementIterations(_FINE_VARIATIONS)
    near = None if start is None else start.copy()  # OpenCV overwrites it
    return np.asarray(dis.calc(grey_u8(first), grey_u8(second), near), dtype=np.float32)


def returns_px(flow: F32, back: F32) -> F32:
    """Distance (H, W), px, from a pixel to the end of its flow there and back; flow that leaves the image
    continues as at its border."""
    there = followed(back, flow, cv2.BORDER_REPLICATE)
    return np.asarray(np.linalg.norm(flow + there, axis=-1), dtype=np.float32)


def leaves(flow: F32) -> NDArray[np.bool_]:
    """(H, W) whether a flow (H, W, 2), px, leads out of the image; False for NaN."""
    height, width = flow.shape[:2]
    x, y = np.arange(width) + flow[..., 0], np.arange(height)[:, None] + flow[..., 1]
    return np.asarray((x < 0.0) | (x > width - 1.0) | (y < 0.0) | (y > height - 1.0))


RETURNS_PX = 1.0
"""Distance, px, between a pixel and the end of the flow there and back, below which the flow is consistent."""
ON_CURVE_PX = 1.5
"""Distance, px, between the end of the flow and the epipolar curve, below which the point is static."""
_SIGMA_PX = 0.3
"""Standard deviation, px, of the error of flow that passes both checks, on rendered frames."""
_SMOOTH_PX = 5


def flow_share(miss: F32, off: F32, scale: F32 | None = None, least: float = 0.0) -> F32:
    """Weight (h, w), 0 to 1, of the displacement by flow beside that by geometry: both by their variances.

    Args:
        miss: (h, w) px by which the flow ends off the place of a static point; it measures the geometry's error.
        off: (h, w) px by which the flow is inconsistent, see ``returns_px``.
        scale: (h, w) factors on the flow's variance.
        least: variance that the geometry has in addition, px^2.
    """
    wrong = np.maximum(miss - ON_CURVE_PX, np.float32(0.0))
    geometry = np.minimum(wrong, np.float32(1e3)) ** 2 + np.float32(least)
    flow = (np.minimum(off, np.float32(1e3)) / RETURNS_PX) ** 4 + _SIGMA_PX**2
    flow = flow if scale is None else flow * scale
    share = (geometry / (geometry + flow)).astype(np.float32)
    return np.asarray(cv2.blur(cv2.medianBlur(share, 5), (_SMOOTH_PX, _SMOOTH_PX)))


def followed(image: NDArray[Any], flow: F32, border: int) -> NDArray[Any]:
    """Values of an image (H, W[, C]) at the ends of a flow (H, W, 2), px; ``border``: OpenCV's mode beyond it."""
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.asarray(cv2.remap(image, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=border))


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

    The point closest to both rays, each at the time of its own row, is used; parallel or diverging rays put the
    point at infinity. Returns the depth in the unit of the motion's translation, in the row's own camera, and the
    distance, px, from the end of the flow to the place to which the motion moves that point (infinite behind the
    camera), which is the flow's error across the epipolar curve.
    """
    targets = pixels + flow
    here = rig.cam_from_world(motion, shutter.pixel_time(pixels, frame, side), side)
    there = rig.cam_from_world(motion, shutter.pixel_time(targets, 1 - frame, side), side)
    R, T = compose(there, inverse(here))
    x, y = rig.sensor(side).unproject(pixels), rig.sensor(side).unproject(targets)
    z = ray_depths(compose(there, inverse(here)), x, y)
    front = np.all(np.where(np.isfinite(z), z, -1.0) > 0.0, axis=-1)
    depth = np.where(front, z[..., 0], np.inf)
    moved = (R @ x[..., None])[..., 0] + T / depth[..., None]
    ahead = moved[..., 2] > 0.0
    seen = rig.sensor(side).project(np.where(ahead[..., None], moved, 1.0))
    return depth, np.where(ahead, np.linalg.norm(seen - targets, axis=-1), np.inf)


_NEAREST_SHARE = 0.999
_CHUNK_ROWS = 100


def monocular_depth(
    flow: F32, rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int
) -> F32:
    """Depth (H, W) of every pixel of a frame from the flow (H, W, 2) to the other one, in the motion's unit.

    inf if the rays do not meet in front of the camera. The inverse depth is median-filtered.
    """
    grid = rig.sensor(side).pixel_grid()
    rho = np.zeros(flow.shape[:2], dtype=np.float32)
    for start in range(0, len(rho), _CHUNK_ROWS):
        rows = slice(start, start + _CHUNK_ROWS)
        rho[rows] = 1.0 / flow_depth(grid[rows], flow[rows], rig, shutter, motion, side, frame)[0]
    # A pixel near the focus of expansion must not cover the whole image.
    rho = cv2.medianBlur(np.minimum(rho, np.float32(np.quantile(rho, _NEAREST_SHARE))), 5)
    with np.errstate(divide="ignore"):
        return np.where(rho > 0.0, 1.0 / rho, np.inf).astype(np.float32)
