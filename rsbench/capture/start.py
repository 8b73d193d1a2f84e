"""Where the comparison of scans starts: a motion, and by how much the cameras' times differ over the image.

A point that moves by v_y rows per frame period lies dt v_y rows apart in two cameras that see it dt apart. So the
row differences of left-right matches show, by least squares, how the times of the two cameras differ. With that
taken back, the matches are nearly those of cameras that read together, and a robust search finds the motion.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rsbench.capture.hypotheses import Known
from rsbench.capture.scans import Scans, line_of
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

COARSE: tuple[tuple[Scan, float], ...] = (
    ("top", 0.0),
    ("top", 0.5),
    ("bottom", 0.5),
    ("left", 0.5),
    ("right", 0.5),
)
"""Shutters of cameras that read together, under which a motion is looked for: between them points err little."""
_SAMPLES, _ROUNDS = 400, 6
_NOISE_PX, _TIME_SIGMA = 0.5, 0.5
"""Expected noise of a row difference, and expected size of a difference of times, frame periods."""
_LEAST_PX = 0.1
_LONGEST_LEAP = 0.75
"""Of the image's width or height, over a frame period: far from the reciprocal of the largest ratio, 1 / 1.2."""
_BEND, _FAR = 0.1, 40.0
"""Error of a lag, frame periods, and squared deviations beyond which scans disagree with it."""


class Lag(NamedTuple):
    """Time of the left camera less that of the right one at one place, frame periods."""

    line: FloatArray
    """(3,) constant, per image width, per image height."""
    H: FloatArray
    """(3, 3) how well the matches determine it: inverse covariance."""

    def at(self, pixels: FloatArray, rig: StereoRig) -> FloatArray:
        """(n,) at pixels (n, 2)."""
        return _columns(pixels, rig) @ self.line


def find_lag(tracks: FloatArray, rig: StereoRig) -> Lag:
    """From tracks (n, 8) with outliers; 0 where nothing moves across the rows."""
    prior = np.eye(3) / _TIME_SIGMA**2
    if len(tracks) < 3:
        return Lag(np.zeros(3), prior)
    moved = 0.5 * (tracks[:, 5] - tracks[:, 1] + tracks[:, 7] - tracks[:, 3])
    A = np.concatenate([moved[:, None] * _columns(tracks[:, k : k + 2], rig) for k in (0, 4)])
    e = np.concatenate([tracks[:, 1] - tracks[:, 3], tracks[:, 5] - tracks[:, 7]])
    line, H = _sampled(A, e), prior
    for _ in range(_ROUNDS):
        left = e - A @ line
        scale = max(1.4826 * float(np.median(np.abs(left))), _LEAST_PX)
        weights = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2) ** 2 / scale**2
        H = (A * weights[:, None]).T @ A + prior
        line = np.asarray(np.linalg.solve(H, A.T @ (weights * e)), dtype=np.float64)
    return Lag(line, H)


def _sampled(A: FloatArray, e: FloatArray) -> FloatArray:
    """The line of the smallest median error, of those through three row differences and of none."""
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(e), (_SAMPLES, 4))
    ridge = (_NOISE_PX / _TIME_SIGMA) ** 2 * np.eye(3)
    normal = np.swapaxes(A[chosen], 1, 2) @ A[chosen] + ridge
    lines = np.linalg.solve(normal, np.swapaxes(A[chosen], 1, 2) @ e[chosen][..., None])[..., 0]
    lines = np.concatenate([np.zeros((1, 3)), np.clip(lines, -2.0, 2.0)])
    errors = np.median(np.abs(e[:, None] - A @ lines.T), axis=0)
    return np.asarray(lines[np.argmin(errors)])


def _columns(pixels: FloatArray, rig: StereoRig) -> FloatArray:
    size = np.array([rig.camera.width, rig.camera.height])
    return np.column_stack([np.ones(len(pixels)), pixels / size])


def with_lag_taken(matches: Correspondences, lag: Lag, rig: StereoRig) -> Correspondences:
    """The ideal matches as the right camera would have had them at the left one's times, to first order.

    In ideal pixels, for a lens shows no ray at some of the pixels that a lag may lead to.
    """
    ideal = without_lens(matches, rig.camera)
    tracks, right = ideal.tracks.copy(), ideal.right.copy()
    moved = tracks[:, 6:8] - tracks[:, 2:4]
    tracks[:, 2:4] += lag.at(matches.tracks[:, 0:2], rig)[:, None] * moved
    tracks[:, 6:8] += lag.at(matches.tracks[:, 4:6], rig)[:, None] * moved
    moved = right[:, 2:4] - right[:, 0:2]
    right[:, 0:2] += lag.at(matches.right[:, 0:2], rig)[:, None] * moved
    right[:, 2:4] += lag.at(matches.right[:, 2:4], rig)[:, None] * moved
    return Correspondences(left=ideal.left, right=right, tracks=tracks)


def without_leaps(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """The matches but for pairs that leap over most of the image, which are wrong.

    The ends of a pair that lie a share 1 / ratio of the image apart are read at one time: between them is no
    motion, and no error, whatever was matched. One such pair held a ratio of 0.8 at 1.17.
    """
    longest = _LONGEST_LEAP * np.array([rig.camera.width, rig.camera.height])
    left, right = (
        pairs[np.all(np.abs(pairs[:, 2:] - pairs[:, :2]) <= longest, axis=1)]
        for pairs in (matches.left, matches.right)
    )
    return Correspondences(left=left, right=right, tracks=matches.tracks)


def find_start(
    matches: Correspondences, rig: StereoRig, known: Known, options: RobustOptions, seed: int
) -> tuple[RobustEstimate | None, Lag]:
    """The motion that explains most matches, of those under ``COARSE``; None when there is none.

    A lens is taken from the matches beforehand: their times are then a little off, as they are under any of these.
    """
    lag = find_lag(matches.tracks, rig)
    taken = with_lag_taken(matches, lag, rig)
    rig, camera, found = rig.ideal, rig.camera, list[RobustEstimate]()
    for scan, ratio in _coarse(known):
        shutter = RollingShutter(height=camera.height, width=camera.width, readout_ratio=ratio, scan=scan)
        with np.errstate(invalid="ignore", over="ignore"):
            result = estimate_motion(taken, rig, shutter, RefinedSolver(), options, np.random.default_rng(seed))
        if result.estimate.success:
            found.append(result)
    best = max(found, key=lambda each: (each.inlier_count / each.threshold_px, each.inlier_count), default=None)
    return best, lag


def _coarse(known: Known) -> list[tuple[Scan, float]]:
    """Those of ``COARSE`` that are possible; where cameras read apart, all."""
    starts = {scans.left for scans in known.scans}
    possible = [(scan, ratio) for scan, ratio in COARSE if ("global" if ratio == 0.0 else scan) in starts]
    if not all(scans.together for scans in known.scans) or not possible:
        possible = list(COARSE)
    known_ratio = known.ratio
    return possible if known_ratio is None else [(s, known_ratio if r else 0.0) for s, r in possible]


def first_shutter(scans: Scans, lag: Lag) -> FloatArray:
    """Ratio and delay (2,) of a scans that fit a lag best; a ratio of 0.5 where the cameras read alike."""
    if scans.together:
        return np.array([0.5 if scans.rolls else 0.0, -lag.line[0]])
    A = np.column_stack([_columns_of_lag(scans), [-1.0, 0.0, 0.0]])
    ratio, delay = np.linalg.solve(A.T @ lag.H @ A + 1e-9 * np.eye(2), A.T @ lag.H @ lag.line)
    return np.array([np.clip(ratio, 0.1, 1.0), np.clip(delay, -0.9, 0.9)])


def largest_ratio(scans: Scans, lag: Lag) -> float:
    """The largest readout ratio at which scans agree with a lag; 0: none does; 1: the cameras read alike.

    A lag is of first order: flow that changes while it is read bends it by some hundredths.
    """
    if scans.together:
        return 1.0
    bend = _columns_of_lag(scans)
    H = np.linalg.inv(np.linalg.inv(lag.H) + _BEND**2 * np.eye(3))
    constant = np.array([1.0, 0.0, 0.0])
    for ratio in np.arange(1.1, 0.0, -0.05):
        off = lag.line - ratio * bend
        off = off - constant * (constant @ H @ off) / H[0, 0]  # the delay that fits best
        if float(off @ H @ off) <= _FAR:
            return float(min(ratio, 1.0))
    return 0.0


def _columns_of_lag(scans: Scans) -> FloatArray:
    """(3,) lag per readout ratio."""
    return line_of(scans, "left") - line_of(scans, "right")
