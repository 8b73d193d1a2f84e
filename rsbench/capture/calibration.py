"""Errors of a rig's calibration: how they shift pixels, and how left-right matches reveal them.

In a rectified pair, a point lies on the same row of both images. Real rectified pairs have row differences of some
tenths of a pixel that vary slowly over the image, errors of the disparities that vary likewise, and some residual
lens distortion. ``TERMS`` describes these errors as shifts of the rays of both cameras, each linear in one number,
so that they can be estimated together with the motion. ``check_rig`` refuses image pairs that cannot come from the
given rig: exchanged sides, lens distortion that was not removed, row differences.
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
"""Excess of the disparities, px, as polynomial terms 1, x, y, xx, xy, yy of the ray; row differences, px, as terms
1, x, y, xy (to first order, errors of the relative rotation and focal lengths); k1, p2, p1 of both lenses; the
relative error by which both focal lengths are too short."""
OFFSET = 0
BENDS, ROWS, LENS, FOCAL = slice(1, 6), slice(6, 10), slice(10, 13), 13
RADIAL = LENS.start
STRETCHING = (RADIAL, FOCAL)
"""Terms that change the conversion from rays to pixels by more than one per cent."""
_STEP = 1e-5
_STEPS = _STEP * np.eye(2)
NO_ERRORS = (0.0,) * len(TERMS)
_HALF: dict[Side, float] = {"left": 0.5, "right": -0.5}


@dataclass(frozen=True, kw_only=True)
class CardSigma:
    """Standard deviations of the calibration values on a camera card; 0: exact."""

    focal: float = 0.0
    """Standard deviation of fx, px; fy has the same relative error."""
    k1: float = 0.0
    """Standard deviation of the lens's k1; without a lens, of the distortion that undistortion has left."""

    def __bool__(self) -> bool:
        """Whether any value is uncertain and can be estimated."""
        return self.focal > 0.0 or self.k1 > 0.0


def ray_shifts(rays: FloatArray, side: Side, focal: float, lens: Lens | None = None) -> FloatArray:
    """(..., 14, 2) errors of one camera's measured rays x, y (..., 2) for a value of 1 of each of ``TERMS``.

    Each camera has half of an offset and of a row difference. For a camera with a lens, radial coefficient and
    focal length shift the distorted rays, and these shifts are mapped back through the lens.
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
    """(..., 2, 2) ray shifts for ``STRETCHING``: those of the distorted rays, mapped back through the lens."""
    square = np.sum(rays**2, axis=-1, keepdims=True)
    if lens is None:
        return np.stack([square * rays, rays], axis=-2)
    distorted, radial = lens.distort(rays), square
    if lens.model == "kannala-brandt":  # its k1 multiplies the angle from the axis, not its tangent
        radius = np.sqrt(square)
        radial = np.arctan(radius) ** 3 / np.where(radius > 0.0, radius, 1.0)
    elif lens.model == "rational":
        radial = square / lens.denominator(square)
    shifts = np.stack([radial * rays, distorted.xy], axis=-1)
    return np.asarray((inverse_2x2(distorted.jacobian) @ shifts).swapaxes(-1, -2))


def ray_stretches(rays: FloatArray, lens: Lens | None = None) -> FloatArray:
    """(..., 2, 2, 2) derivatives by the ray (last axis) of its shifts for a value of 1 of each of ``STRETCHING``.

    They are central differences, whose error is of second order in the step.
    """
    ends = [_stretching_shifts(rays + step, lens) - _stretching_shifts(rays - step, lens) for step in _STEPS]
    return np.stack(ends, axis=-1) / (2.0 * _STEP)


def term_sizes(rays: FloatArray, focal: float) -> FloatArray:
    """(14,) root mean square over rays (n, 2) of the shift of a match by a value of 1 of each of ``TERMS``, px."""
    size = focal * np.sqrt(np.mean(np.sum(ray_shifts(rays, "left", focal) ** 2, axis=-1), axis=0))
    size[: ROWS.stop] *= 2.0  # each of the two points is shifted by half
    return np.asarray(size)


def lens_terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., 3, 2) ray shifts for 1 of each of ``LENS`` at rays x, y (...): OpenCV's k1, p2 and p1."""
    square = x**2 + y**2
    radial = np.stack([square * x, square * y], axis=-1)
    across = np.stack([square + 2.0 * x * x, 2.0 * x * y], axis=-1)
    along = np.stack([2.0 * x * y, square + 2.0 * y * y], axis=-1)
    return np.stack([radial, across, along], axis=-2)


def row_terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., 4) polynomial terms of ``ROWS`` at rays x, y (...)."""
    return np.stack([np.ones_like(x), x, y, x * y], axis=-1)


def offset_error(offset: float) -> tuple[float, ...]:
    """The calibration errors (14,) of a rig whose disparities are ``offset`` px too large and nothing else."""
    return (offset, *NO_ERRORS[1:])


def describe_errors(errors: Sequence[float], rig: StereoRig) -> str:
    """Text on the pixel shifts that calibration errors (14,) cause; empty if there are none."""
    if not np.any(errors):
        return ""
    camera, values = rig.camera, np.asarray(errors)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    x, y = ((corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    rows = float(np.max(np.abs(row_terms(x, y) @ values[ROWS])))
    lens = f"; k1 {values[LENS][0]:+.3f}" if np.any(values[LENS]) else ""
    return f"disparities {values[OFFSET]:+.2f} px in the middle; rows by up to {rows:.1f} px{lens}"


def recalibrated(matches: Correspondences, rig: StereoRig, errors: Sequence[float]) -> Correspondences:
    """The matches, px, corrected for the calibration errors (14,), for cameras without a lens.

    For a rig that is not aligned, the errors are shifts of its ideal pixels.
    """
    if not np.any(errors):
        return matches
    camera = rig.camera
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])

    def corrected(ends: FloatArray, sides: tuple[Side, ...]) -> FloatArray:
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
        left=corrected(matches.left, ("left", "left")),
        right=corrected(matches.right, ("right", "right")),
        stereo_0=corrected(matches.stereo_0, ("left", "right")),
        stereo_1=corrected(matches.stereo_1, ("left", "right")),
        tracks=corrected(matches.tracks, ("left", "right", "left", "right")),
    )


_FEWEST_MATCHES = 30
"""Fewest left-right matches by which a rig is accepted or refused."""
_FAR_OFF_PX, _ROUNDS, _SIGMAS, _LEAST_PX = 10.0, 8, 3.0, 0.05
_SAME_ROW = 0.68
"""Least share of matches on one row: real rectified pairs have 0.80 or more, pairs of two times at most 0.56."""
_MANY_FLOW, _ON_ROWS = 200, 0.9
"""With this many dense-flow matches, and this share of them on the same row and with a disparity of 0 or more, the
rig is accepted without a search for features."""
_MOST_NEGATIVE = 0.5
"""Largest share of negative disparities: real pairs have at most 0.03 in order, and at least 0.86 if exchanged."""
_CERTAIN_SIGN_PX = 1.0
"""The sign of larger disparities is certain: noise and the errors of most calibrations are smaller."""
_DISTORTED = 0.1
"""Radial coefficient above which a pair is not rectified: real ones have at most 0.03, f-theta lenses -1/3."""
_CLEARLY = 5.0


class RefusedFramesError(RsbenchError):
    """Raised if frames contradict the given calibration; ``reason`` is the message without the frames' names."""

    def __init__(self, reason: str, where: str = "frames", stereo: FloatArray | None = None) -> None:
        super().__init__(f"{where}: {reason}")
        self.reason = reason
        self.stereo = stereo
        """(n, 4) left-right matches, ideal px, if the frames are refused because of their rows; else None."""


@dataclass(frozen=True, kw_only=True)
class RowPattern:
    """A smooth fit to the row differences ``y_left - y_right`` of left-right matches."""

    systematic_px: float
    """Root mean square of a fit of terms 1, x, y and x y, minus what noise alone would give."""
    distortion: float
    """Coefficient k of a lens that maps radius r to r (1 + k r^2), in focal lengths."""
    distortion_sigma: float
    noise_px: float
    """Standard deviation of the residuals."""


def row_pattern(stereo: FloatArray, rig: StereoRig) -> RowPattern | None:
    """Fit row differences of left-right matches (n, 4) xl, yl, xr, yr, ideal px, with outliers; None: too few.

    To first order, errors of relative rotation and of focal length cause terms 1, x, y and xy; equal lenses with
    radial distortion cause k y (xl^2 - xr^2).
    """
    camera = rig.camera
    xl, xr = (stereo[:, 0] - camera.cx) / camera.fx, (stereo[:, 2] - camera.cx) / camera.fx
    x, y = 0.5 * (xl + xr), (0.5 * (stereo[:, 1] + stereo[:, 3]) - camera.cy) / camera.fy
    columns = np.column_stack([row_terms(x, y), camera.fy * y * (xl**2 - xr**2)])
    difference = stereo[:, 1] - stereo[:, 3]
    near = np.abs(difference) < _FAR_OFF_PX
    keep, noise, fit = near, _LEAST_PX, np.zeros(columns.shape[1])
    for _ in range(_ROUNDS):
        if np.count_nonzero(keep) < _FEWEST_MATCHES:
            return None
        fit, *_ = np.linalg.lstsq(columns[keep], difference[keep], rcond=None)
        left = np.abs(difference - columns @ fit)
        noise = max(1.4826 * float(np.median(left[keep])), _LEAST_PX)
        keep = near & (left < _SIGMAS * noise)
    # The term of distortion is left out: at a constant disparity it equals x y, and the two would cancel.
    smooth = columns[keep, :4] @ np.linalg.lstsq(columns[keep, :4], difference[keep], rcond=None)[0]
    # Leave-one-out deviation: a single wrong match with a large disparity may determine the coefficient.
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
    """Check that two images (H, W[, 3]) can be a left and right image of the rig at one time.

    With too few matches, nothing is checked.

    Raises:
        RefusedFramesError: the sides are exchanged, lens distortion was not removed, or the rows do not agree.
    """
    # Matches alone need none of these, and loading them takes a tenth of a solve.
    from rsbench.vision.dense_matcher import stereo_by_flow
    from rsbench.vision.feature_matcher import undistorted
    from rsbench.vision.features import ROW_TOLERANCE_PX, Gate, MatchOptions, detect, match
    from rsbench.vision.images import eight_bit

    options, reach = MatchOptions(), float(max(left.shape[:2]))
    eyes = [rig.eye(side) for side in SIDES]
    levels = list(zip(eight_bit([left, right]), eyes, strict=True))
    straight = [undistorted(level, eye) for level, eye in levels]
    if _flow_agrees(_within_images(stereo_by_flow(*straight), eyes), rig):
        return
    if rig.aligned:
        a, b = (detect(image, options) for image in straight)
    else:  # detect on the original images, as the matcher does later
        a, b = (detect(level, options, eye) for level, eye in levels)
    anywhere = Gate(dx=(-reach, reach), dy=(-reach, reach))
    pairs = match(a, b, anywhere, options)
    stereo = _within_images(np.concatenate([a.places[pairs[:, 0]], b.places[pairs[:, 1]]], axis=1), eyes)
    if len(stereo) >= _FEWEST_MATCHES:
        judge_stereo(stereo, rig, ROW_TOLERANCE_PX)


def _within_images(stereo: FloatArray, eyes: Sequence[PinholeCamera | AlignedCamera]) -> FloatArray:
    """The matches (n, 4) that lie within both original images; undistorted images mirror their borders beyond."""
    ends = zip(eyes, (stereo[:, :2], stereo[:, 2:]), strict=True)
    return stereo[np.logical_and.reduce([eye.contains(eye.lens_pixels(end)) for eye, end in ends])]


def _flow_agrees(stereo: FloatArray, rig: StereoRig) -> bool:
    """Whether dense-flow matches (n, 4) suffice to show a rectified pair in the right order."""
    from rsbench.vision.features import ROW_TOLERANCE_PX

    if len(stereo) < _MANY_FLOW:
        return False
    pattern = row_pattern(stereo, rig) if rig.rectified else None
    if pattern is not None and abs(pattern.distortion) > _DISTORTED:
        return False
    on_rows = np.abs(stereo[:, 1] - stereo[:, 3]) <= ROW_TOLERANCE_PX
    back = stereo[:, 0] - stereo[:, 2] < -_CERTAIN_SIGN_PX
    return float(np.mean(on_rows)) > _ON_ROWS and float(np.mean(back)) < 1.0 - _ON_ROWS


def judge_stereo(stereo: FloatArray, rig: StereoRig, row_tolerance: float) -> None:
    """``check_rig`` for left-right matches (n, 4), ideal px, that were searched for in the whole image.

    Lens distortion is checked only if no lens is given, since a given lens is assumed to be calibrated.
    """
    share = float(np.mean(np.abs(stereo[:, 1] - stereo[:, 3]) <= row_tolerance))
    pattern = row_pattern(stereo, rig) if rig.rectified else None
    if pattern is not None and _is_distorted(pattern, share):
        raise RefusedFramesError(
            f"the row differences of left-right matches show lens distortion that was not removed (k1 about "
            f"{pattern.distortion:.2f}); give the lens, or undistort and rectify the images first",
            stereo=stereo,
        )
    if share < _SAME_ROW and not rig.aligned:
        raise RefusedFramesError(
            f"only {share:.0%} of the left-right matches lie on the rig's epipolar lines: left and right are "
            "exchanged, were taken at different times, or the calibration belongs to other frames",
            stereo=stereo,
        )
    if share < _SAME_ROW:
        raise RefusedFramesError(
            f"only {share:.0%} of the left-right matches lie on the same row; the frames must be rectified, in "
            "the order LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, and left and right must be taken at the same time (is one "
            "camera a frame late?)",
            stereo=stereo,
        )
    disparity = stereo[:, 0] - stereo[:, 2]
    clear = disparity[np.abs(disparity) > _CERTAIN_SIGN_PX]
    if len(clear) >= _FEWEST_MATCHES // 2 and np.mean(clear < 0.0) > _MOST_NEGATIVE:
        raise RefusedFramesError("the left and the right images are exchanged; give the left ones first")


def _is_distorted(pattern: RowPattern, share: float) -> bool:
    # Images taken at two times fit badly, and then the coefficients mean nothing.
    clear = abs(pattern.distortion) > max(_DISTORTED, _CLEARLY * pattern.distortion_sigma)
    return clear and pattern.noise_px < 0.5 and share > 0.6
