"""Errors of a rig's calibration: what they do to pixels, and what left-right matches show of them.

A rectified pair shows a point on the same row of both images. Real rectified pairs leave row differences of some
tenths of a pixel that change slowly over the image, disparities that are too large or too small in such a pattern,
and a little distortion of the lenses. ``TERMS`` describes these errors as shifts of the rays of both cameras, each
linear in one number, so that they can be estimated with the motion. ``check_rig`` refuses image pairs that no
rectified rig takes: exchanged sides, an undistorted lens, rows that do not agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import Lens, PinholeCamera, inverse_2x2
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, AlignedCamera, Side, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.vision.dense_matcher import stereo_by_flow
from rsbench.vision.feature_matcher import undistorted
from rsbench.vision.features import ROW_TOLERANCE_PX, Gate, MatchOptions, detect, match
from rsbench.vision.images import eight_bit

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
"""Terms that change by more than a hundredth how many pixels an error of a ray is."""
_STEP = 1e-5
_STEPS = _STEP * np.eye(2)
NO_ERRORS = (0.0,) * len(TERMS)
_HALF: dict[Side, float] = {"left": 0.5, "right": -0.5}


@dataclass(frozen=True, kw_only=True)
class CardSigma:
    """Standard deviations of a card's values for a camera; 0: exact."""

    focal: float = 0.0
    """px, of fx; fy goes with it."""
    k1: float = 0.0
    """Of the lens; without one, of the distortion that undistortion has left."""

    def __bool__(self) -> bool:
        """Whether there is anything to estimate."""
        return self.focal > 0.0 or self.k1 > 0.0


def ray_shifts(rays: FloatArray, side: Side, focal: float, lens: Lens | None = None) -> FloatArray:
    """(..., 14, 2) by which measured rays x, y (..., 2) of one camera are too large for 1 of each of ``TERMS``.

    Half of an offset and of a row difference belongs to each camera. Behind a lens, shifts of its distorted rays
    by the radial coefficient and the focal length are mapped back through it.
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
    """(..., 2, 2) by ``STRETCHING``: of the distorted rays, mapped back through the lens."""
    square = np.sum(rays**2, axis=-1, keepdims=True)
    if lens is None:
        return np.stack([square * rays, rays], axis=-2)
    distorted, radial = lens.distort(rays), square
    if lens.model == "kannala-brandt":  # whose k1 is of the angle from the axis, not of its tangent
        radius = np.sqrt(square)
        radial = np.arctan(radius) ** 3 / np.where(radius > 0.0, radius, 1.0)
    elif lens.model == "rational":
        radial = square / lens.denominator(square)
    shifts = np.stack([radial * rays, distorted.xy], axis=-1)
    return np.asarray((inverse_2x2(distorted.jacobian) @ shifts).swapaxes(-1, -2))


def ray_stretches(rays: FloatArray, lens: Lens | None = None) -> FloatArray:
    """(..., 2, 2, 2) derivative by the ray, the last axis, of what 1 of each of ``STRETCHING`` shifts it by.

    By central differences, whose own error is of second order in the step.
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
    """The matches, px, without the errors (14,) of their calibration; for cameras without a lens.

    Errors of a rig that is not ideal are shifts of its ideal pixels.
    """
    if not np.any(errors):
        return matches
    camera = rig.camera
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])

    def taken(ends: FloatArray, sides: tuple[Side, ...]) -> FloatArray:
        points = ends.reshape(-1, len(sides), 2)
        if not rig.aligned:
            points = np.stack([rig.eye(side).ideal_pixels(points[:, k]) for k, side in enumerate(sides)], axis=1)
        rays = (points - centre) / focal
        shifts = [ray_shifts(rays[:, k], side, camera.fx) for k, side in enumerate(sides)]
        moved = np.stack([np.einsum("ncx,c->nx", each, errors) for each in shifts], axis=1) * focal
        points = points - moved
        if not rig.aligned:
            points = np.stack([rig.eye(side).lens_pixels(points[:, k]) for k, side in enumerate(sides)], axis=1)
        return np.asarray(points.reshape(ends.shape))

    return replace(
        matches,
        left=taken(matches.left, ("left", "left")),
        right=taken(matches.right, ("right", "right")),
        stereo_0=taken(matches.stereo_0, ("left", "right")),
        stereo_1=taken(matches.stereo_1, ("left", "right")),
        tracks=taken(matches.tracks, ("left", "right", "left", "right")),
    )


_FEWEST = 30
"""Fewest left-right matches for a decision on the rig."""
_FAR_OFF_PX, _ROUNDS, _SIGMAS, _LEAST_PX = 10.0, 8, 3.0, 0.05
_SAME_ROW = 0.68
"""Share of matches on the same row: at least 0.80 in real rectified pairs, at most 0.56 in those of two times."""
_MANY, _ON_ROWS = 200, 0.9
"""Matches by dense flow, and the share of them on the row and of disparities that are not negative, from which
on features are not looked for."""
_OPPOSITE = 0.5
"""Share of negative disparities: at most 0.03 in real pairs in order, at least 0.86 in exchanged ones."""
_BACK_PX = 1.0
"""Disparities above this have a sign: it is beyond noise and the errors of most calibrations."""
_DISTORTED = 0.1
"""Coefficient of radial distortion of no rectified pair: at most 0.03 in real ones, -1/3 in f-theta lenses."""
_CLEARLY = 5.0


class RefusedFramesError(RsbenchError):
    """Frames that contradict what is given; ``reason`` says why without naming them."""

    def __init__(self, reason: str, where: str = "frames", stereo: FloatArray | None = None) -> None:
        super().__init__(f"{where}: {reason}")
        self.reason = reason
        self.stereo = stereo
        """(n, 4) left-right matches, ideal px, of frames that are refused for their rows; None for others."""


@dataclass(frozen=True, kw_only=True)
class RowPattern:
    """The row differences of left-right matches, ``y_left - y_right``, as a smooth function of the image."""

    systematic_px: float
    """Root mean square of what 1, x, y and x y fit of it, less what noise would give."""
    distortion: float
    """Coefficient k of a lens that maps radius r to r (1 + k r^2), in focal lengths."""
    distortion_sigma: float
    noise_px: float
    """Standard deviation of what the pattern leaves."""


def row_pattern(stereo: FloatArray, rig: StereoRig) -> RowPattern | None:
    """Pattern of left-right matches (n, 4) xl, yl, xr, yr, ideal px, with outliers; None of too few.

    To first order errors of relative rotation and of focal length give 1, x, y and xy; equal lenses with radial
    distortion give k y (xl^2 - xr^2).
    """
    camera = rig.camera
    xl, xr = (stereo[:, 0] - camera.cx) / camera.fx, (stereo[:, 2] - camera.cx) / camera.fx
    x, y = 0.5 * (xl + xr), (0.5 * (stereo[:, 1] + stereo[:, 3]) - camera.cy) / camera.fy
    columns = np.column_stack([row_terms(x, y), camera.fy * y * (xl**2 - xr**2)])
    difference = stereo[:, 1] - stereo[:, 3]
    near = np.abs(difference) < _FAR_OFF_PX
    keep, noise, fit = near, _LEAST_PX, np.zeros(columns.shape[1])
    for _ in range(_ROUNDS):
        if np.count_nonzero(keep) < _FEWEST:
            return None
        fit, *_ = np.linalg.lstsq(columns[keep], difference[keep], rcond=None)
        left = np.abs(difference - columns @ fit)
        noise = max(1.4826 * float(np.median(left[keep])), _LEAST_PX)
        keep = near & (left < _SIGMAS * noise)
    # Without distortion, which at one disparity is the same as x y, and would be balanced by it.
    smooth = columns[keep, :4] @ np.linalg.lstsq(columns[keep, :4], difference[keep], rcond=None)[0]
    # By leaving out one match after the other: a wrong one of large disparity may make up the coefficient alone.
    hat = np.linalg.pinv(columns[keep])
    leverage = np.einsum("ij,ji->i", columns[keep], hat)
    left_out = hat[-1] * (difference - columns @ fit)[keep] / np.maximum(1.0 - leverage, 1e-6)
    excess = float(np.mean(smooth**2)) - 4.0 * noise**2 / len(smooth)
    return RowPattern(
        systematic_px=float(np.sqrt(max(excess, 0.0))),
        distortion=float(fit[-1]),
        distortion_sigma=max(float(np.linalg.norm(left_out)), noise * float(np.linalg.norm(hat[-1]))),
        noise_px=noise,
    )


def check_rig(left: NDArray[np.generic], right: NDArray[np.generic], rig: StereoRig) -> None:
    """Whether two images (H, W[, 3]) can be the left and right one of the rig at one time.

    Too few matches say nothing.

    Raises:
        RefusedFramesError: the sides are exchanged, the lens is not undistorted, or the rows do not agree.
    """
    options, reach = MatchOptions(), float(max(left.shape[:2]))
    eyes = [rig.eye(side) for side in SIDES]
    levels = list(zip(eight_bit([left, right]), eyes, strict=True))
    straight = [undistorted(level, eye) for level, eye in levels]
    if _agrees(_shown(stereo_by_flow(*straight), eyes), rig):
        return
    if rig.aligned:
        a, b = (detect(image, options) for image in straight)
    else:  # as matches will ask for them
        a, b = (detect(level, options, eye) for level, eye in levels)
    anywhere = Gate(dx=(-reach, reach), dy=(-reach, reach))
    pairs = match(a, b, anywhere, options)
    stereo = _shown(np.concatenate([a.places[pairs[:, 0]], b.places[pairs[:, 1]]], axis=1), eyes)
    if len(stereo) >= _FEWEST:
        judge_stereo(stereo, rig, ROW_TOLERANCE_PX)


def _shown(stereo: FloatArray, eyes: Sequence[PinholeCamera | AlignedCamera]) -> FloatArray:
    """The matches (n, 4) that lenses show: beyond the borders of images there is a mirror of them."""
    ends = zip(eyes, (stereo[:, :2], stereo[:, 2:]), strict=True)
    return stereo[np.logical_and.reduce([eye.contains(eye.lens_pixels(end)) for eye, end in ends])]


def _agrees(stereo: FloatArray, rig: StereoRig) -> bool:
    """Whether matches (n, 4) by dense flow are beyond doubt those of a rectified pair in the right order."""
    if len(stereo) < _MANY:
        return False
    pattern = row_pattern(stereo, rig) if rig.rectified else None
    if pattern is not None and abs(pattern.distortion) > _DISTORTED:
        return False
    on_rows = np.abs(stereo[:, 1] - stereo[:, 3]) <= ROW_TOLERANCE_PX
    back = stereo[:, 0] - stereo[:, 2] < -_BACK_PX
    return float(np.mean(on_rows)) > _ON_ROWS and float(np.mean(back)) < 1.0 - _ON_ROWS


def judge_stereo(stereo: FloatArray, rig: StereoRig, row_tolerance: float) -> None:
    """``check_rig`` of left-right matches (n, 4), ideal px, that were looked for in the whole image.

    Distortion is looked for where no lens is given: a given one is taken for calibrated.
    """
    share = float(np.mean(np.abs(stereo[:, 1] - stereo[:, 3]) <= row_tolerance))
    pattern = row_pattern(stereo, rig) if rig.rectified else None
    if pattern is not None and _is_distorted(pattern, share):
        raise RefusedFramesError(
            f"the row differences of left and right matches show a lens that was not undistorted (k1 about "
            f"{pattern.distortion:.2f}); give the lens, or undistort and rectify the images first",
            stereo=stereo,
        )
    if share < _SAME_ROW and not rig.aligned:
        raise RefusedFramesError(
            f"only {share:.0%} of the left-right matches lie on the rig's epipolar lines: left and right are "
            "exchanged or of two times, or the calibration is not that of these frames",
            stereo=stereo,
        )
    if share < _SAME_ROW:
        raise RefusedFramesError(
            f"only {share:.0%} of the left-right matches lie on the same row; the frames must be rectified, in "
            "the order LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, and left and right of one time (is one camera a frame "
            "late?)",
            stereo=stereo,
        )
    disparity = stereo[:, 0] - stereo[:, 2]
    clear = disparity[np.abs(disparity) > _BACK_PX]
    if len(clear) >= _FEWEST // 2 and np.mean(clear < 0.0) > _OPPOSITE:
        raise RefusedFramesError("the left and the right images are exchanged; give the left ones first")


def _is_distorted(pattern: RowPattern, share: float) -> bool:
    # Images of two times fit any pattern badly, and then its coefficients mean nothing.
    clear = abs(pattern.distortion) > max(_DISTORTED, _CLEARLY * pattern.distortion_sigma)
    return clear and pattern.noise_px < 0.5 and share > 0.6
