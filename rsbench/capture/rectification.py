"""What left-right matches say of a rig's rectification: row differences, the sign of disparity, distortion.

In a rectified pair a point lies on the same row of both images. Real calibrations leave row differences of some
tenths of a pixel that change slowly over the image; a lens that was not undistorted leaves differences that grow
with disparity; images of two times leave no pattern at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.calibration_errors import row_terms
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.vision.features import ROW_TOLERANCE_PX, Gate, MatchOptions, detect, match
from rsbench.vision.images import eight_bit
from rsbench.vision.undistortion import undistorted

_FEWEST = 30
"""Left-right matches below which nothing is said of the rig."""
_FAR_OFF_PX, _ROUNDS, _SIGMAS, _LEAST_PX = 10.0, 8, 3.0, 0.05
_SAME_ROW = 0.68
"""Share of matches on the same row: at least 0.80 in real rectified pairs, at most 0.56 in those of two times."""
_OPPOSITE = 0.5
"""Share of negative disparities: at most 0.03 in real pairs in order, at least 0.86 in exchanged ones."""
_BACK_PX = 1.0
"""Disparities above this have a sign: it is beyond noise and the errors of most calibrations."""
_DISTORTED = 0.1
"""Coefficient of radial distortion of no rectified pair: at most 0.03 in real ones, -1/3 in f-theta lenses."""
_CLEARLY = 5.0


class RefusedFramesError(RsbenchError):
    """Frames that cannot be what they are said to be; ``reason`` says why without naming them."""

    def __init__(self, reason: str, where: str = "frames") -> None:
        super().__init__(f"{where}: {reason}")
        self.reason = reason


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
    """Pattern of left-right matches (n, 4) xl, yl, xr, yr with outliers; None of too few.

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
    """Whether two images (H, W[, 3]) can be the left and right one of a rectified rig at one time, lens or not.

    Too few matches say nothing.

    Raises:
        RefusedFramesError: the sides are exchanged, the lens is not undistorted, or the rows do not agree.
    """
    options, camera, reach = MatchOptions(), rig.camera, float(max(left.shape[:2]))
    a, b = (detect(undistorted(level, camera), options) for level in eight_bit([left, right]))
    anywhere = Gate(dx=(-reach, reach), dy=(-reach, reach))
    pairs = match(a, b, anywhere, options)
    ends = a.points[pairs[:, 0]], b.points[pairs[:, 1]]
    # Beyond the borders of what the lens shows there is a mirror of it.
    shown = np.logical_and.reduce([camera.contains(camera.lens_pixels(end)) for end in ends])
    if np.count_nonzero(shown) < _FEWEST:
        return
    judge_stereo(np.concatenate(ends, axis=1)[shown], rig, ROW_TOLERANCE_PX)


def judge_stereo(stereo: FloatArray, rig: StereoRig, row_tolerance: float) -> None:
    """``check_rig`` of left-right matches (n, 4), ideal px, that were looked for in the whole image.

    Distortion is looked for where no lens is given: a given one is taken for calibrated.
    """
    share = float(np.mean(np.abs(stereo[:, 1] - stereo[:, 3]) <= row_tolerance))
    pattern = row_pattern(stereo, rig) if rig.camera.lens is None else None
    if pattern is not None and _is_distorted(pattern, share):
        raise RefusedFramesError(
            f"the row differences of left and right matches show a lens that was not undistorted (k1 about "
            f"{pattern.distortion:.2f}); give the lens, or undistort and rectify the images first"
        )
    if share < _SAME_ROW:
        raise RefusedFramesError(
            f"only {share:.0%} of the left-right matches lie on the same row; the frames must be rectified, in "
            "the order LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, and left and right of one time (is one camera a frame late?)"
        )
    disparity = stereo[:, 0] - stereo[:, 2]
    clear = disparity[np.abs(disparity) > _BACK_PX]
    if len(clear) >= _FEWEST // 2 and np.mean(clear < 0.0) > _OPPOSITE:
        raise RefusedFramesError("the left and the right images are exchanged; give the left ones first")


def _is_distorted(pattern: RowPattern, share: float) -> bool:
    # Images of two times fit any pattern badly, and then its coefficients mean nothing.
    clear = abs(pattern.distortion) > max(_DISTORTED, _CLEARLY * pattern.distortion_sigma)
    return clear and pattern.noise_px < 0.5 and share > 0.6
