"""What the calibration of a rig may be wrong by: smooth errors of its pixels, each known by one number.

Real rectified pairs leave row differences of some tenths of a pixel that change slowly over the image, disparities
that are too large or too small in such a pattern too, and lenses that were not quite undistorted.
Here each is a shift of the rays of both cameras, linear in its number, so that it can be found with the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.lens import Lens, inverse_2x2
from rsbench.core.rig import Side, StereoRig
from rsbench.core.so3 import FloatArray

TERMS = (
    "offset",
    "offset_x",
    "offset_y",
    "offset_xx",
    "offset_xy",
    "offset_yy",
    "row",
    "row_x",
    "row_y",
    "row_xy",
    "radial",
    "tangential_x",
    "tangential_y",
    "focal",
)
"""px by which disparities are too large, as a function 1, x, y, xx, xy, yy of the ray; row differences, px, as one
of 1, x, y, xy (to first order errors of the relative rotation and focal lengths); k1, p2, p1 of both lenses; the
share by which both focal lengths are too short."""
OFFSET = 0
BENDS, ROWS, LENS, FOCAL = slice(1, 6), slice(6, 10), slice(10, 13), 13
RADIAL = LENS.start
STRETCHING = (RADIAL, FOCAL)
"""Those that change how many pixels an error of a ray is by more than a hundredth."""
_STEP = 1e-5
_STEPS = _STEP * np.eye(2)
NO_ERRORS = (0.0,) * len(TERMS)
_HALF: dict[Side, float] = {"left": 0.5, "right": -0.5}


@dataclass(frozen=True, kw_only=True)
class CardSigma:
    """How sure a card is of a camera: standard deviations; 0: it is exact."""

    focal: float = 0.0
    """px, of fx; fy goes with it."""
    k1: float = 0.0
    """Of the lens; where there is none, of what undistortion left."""

    def __bool__(self) -> bool:
        """Whether there is anything to find."""
        return self.focal > 0.0 or self.k1 > 0.0


def ray_shifts(rays: FloatArray, side: Side, focal: float, lens: Lens | None = None) -> FloatArray:
    """(..., 14, 2) by which measured rays x, y (..., 2) of one camera are too large for 1 of each of ``TERMS``.

    Half of an offset and of a row difference is the left camera's, half the right one's. Behind a lens, what the
    radial coefficient and the focal length do to its distorted rays is taken back through it.
    """
    x, y, out = rays[..., 0], rays[..., 1], np.zeros((*rays.shape[:-1], len(TERMS), 2))
    half = _HALF[side] / focal
    out[..., OFFSET, 0] = half
    out[..., BENDS, 0] = half * np.stack([x, y, x * x, x * y, y * y], axis=-1)
    out[..., ROWS, 1] = half * row_terms(x, y)
    out[..., LENS, :] = lens_terms(x, y)
    out[..., STRETCHING, :] = _stretching_shifts(rays, lens)
    return out


def _stretching_shifts(rays: FloatArray, lens: Lens | None) -> FloatArray:
    """(..., 2, 2) those of ``STRETCHING``: of the distorted rays, taken back through the lens."""
    square = np.sum(rays**2, axis=-1, keepdims=True)
    if lens is None:
        return np.stack([square * rays, rays], axis=-2)
    distorted, radial = lens.distort(rays), square
    if lens.model == "kannala-brandt":  # whose k1 is of the angle from the axis, not of its tangent
        radius = np.sqrt(square)
        radial = np.arctan(radius) ** 3 / np.where(radius > 0.0, radius, 1.0)
    shifts = np.stack([radial * rays, distorted.xy], axis=-1)
    return np.asarray((inverse_2x2(distorted.jacobian) @ shifts).swapaxes(-1, -2))


def ray_stretches(rays: FloatArray, lens: Lens | None = None) -> FloatArray:
    """(..., 2, 2, 2) derivative by the ray, the last axis, of what 1 of each of ``STRETCHING`` shifts it by.

    By central differences, whose own error is of the square of the step.
    """
    ends = [_stretching_shifts(rays + step, lens) - _stretching_shifts(rays - step, lens) for step in _STEPS]
    return np.stack(ends, axis=-1) / (2.0 * _STEP)


def term_sizes(rays: FloatArray, focal: float) -> FloatArray:
    """(14,) px, root mean square over rays (n, 2), that 1 of each of ``TERMS`` moves the ends of a match by."""
    size = focal * np.sqrt(np.mean(np.sum(ray_shifts(rays, "left", focal) ** 2, axis=-1), axis=0))
    size[: ROWS.stop] *= 2.0  # either end by half of it
    return np.asarray(size)


def lens_terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., 3, 2) of ``LENS`` at rays x, y (...): OpenCV's k1, p2 and p1."""
    square = x**2 + y**2
    radial = np.stack([square * x, square * y], axis=-1)
    across = np.stack([square + 2.0 * x * x, 2.0 * x * y], axis=-1)
    along = np.stack([2.0 * x * y, square + 2.0 * y * y], axis=-1)
    return np.stack([radial, across, along], axis=-2)


def row_terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., 4) of ``ROWS`` at rays x, y (...)."""
    return np.stack([np.ones_like(x), x, y, x * y], axis=-1)


def of_offset(offset: float) -> tuple[float, ...]:
    """The errors of a calibration whose disparities alone are wrong, too large by ``offset`` px."""
    return (offset, *NO_ERRORS[1:])


def in_words(errors: Sequence[float], rig: StereoRig) -> str:
    """What errors (14,) do to the images of a rig; empty where there are none."""
    if not np.any(errors):
        return ""
    camera, values = rig.camera, np.asarray(errors)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    x, y = ((corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    rows = float(np.max(np.abs(row_terms(x, y) @ values[ROWS])))
    lens = f"; k1 {values[LENS][0]:+.3f}" if np.any(values[LENS]) else ""
    return f"disparities {values[OFFSET]:+.2f} px in the middle; rows by up to {rows:.1f} px{lens}"


def recalibrated(matches: Correspondences, rig: StereoRig, errors: Sequence[float]) -> Correspondences:
    """The matches, px, with the errors (14,) of their calibration taken from them; of cameras without a lens."""
    if not np.any(errors):
        return matches
    camera = rig.camera
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])

    def taken(ends: FloatArray, sides: tuple[Side, ...]) -> FloatArray:
        points = ends.reshape(-1, len(sides), 2)
        rays = (points - centre) / focal
        shifts = [ray_shifts(rays[:, k], side, camera.fx) for k, side in enumerate(sides)]
        moved = np.stack([np.einsum("ncx,c->nx", each, errors) for each in shifts], axis=1) * focal
        return np.asarray((points - moved).reshape(ends.shape))

    return replace(
        matches,
        left=taken(matches.left, ("left", "left")),
        right=taken(matches.right, ("right", "right")),
        stereo_0=taken(matches.stereo_0, ("left", "right")),
        stereo_1=taken(matches.stereo_1, ("left", "right")),
        tracks=taken(matches.tracks, ("left", "right", "left", "right")),
    )
