"""Gyroscope samples for one camera: the offset of their clock, and motions with their rotation.

Each pair of frames gives an angular rate: the mean over all rows of the gyroscope's mean rate between the two
times at which a row is read. ``find_clock`` finds the time shift at which both agree best, up to a bias.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import about_one
from rsbench.pipeline.mono_correction import (
    FoundOwnMotion,
    error_px,
    find_own_motion,
    flow_matches,
    refusal,
    turned,
)
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.gyro_and_gravity import GyroSolver
from rsbench.vision.mono_fusion import Flows, OwnMotion, find_flows

FARTHEST_S = 0.5
"""Largest shift of a clock that is estimated, seconds."""
PAIRS = 24
"""Most pairs of frames from which the shift is estimated; they are evenly spaced in the video."""
_STEP = 1.0 / 32
"""Step of the search, frame periods; a tenth of the period of a hand's fastest shakes at 30 frames/s."""
_ROWS = 9
"""Number of rows over which a pair's rate is averaged."""
_FREEDOM = 4.0
"""Degrees of freedom of the t distribution of the differences, which gives wrong pairs little weight."""
_LEAST_RATE = 2e-4
"""Least standard deviation of a pair's rate, rad per frame period: 0.1 px at a focal length of 500 px."""
_APART = 1.0
"""Two shifts that differ by more than this, frame periods, are different solutions; the search extends this far
beyond the largest shift."""
_CERTAIN, _MOST_SIGMA, _FEWEST = 0.99, 0.15, 6
"""Least probability, largest deviation (frame periods) and fewest pairs of a shift that counts as determined."""
_CLEARLY = 2.5
"""A shift is applied if it exceeds this many standard deviations: recorded times are mostly better."""
_EXPLAINED = 0.2
"""Largest share of the variance of the pairs' rates that may remain at the best shift. On rendered sequences of
eight frames and more, the log of another sequence, or the right one with another sign, left 0.28 and more."""
_LEAST_SIGMA = 0.02
"""Least standard deviation of a shift, frame periods, as a pair's rate is not exactly the mean over its rows."""


class Clock(NamedTuple):
    """The estimated error of a gyroscope's clock."""

    shift: float
    """Frame periods to subtract from the times of its samples; 0 if the frames do not determine it."""
    sigma: float
    told: bool  # a key of motion.json
    """Whether the frames determine the shift."""
    used: bool
    """Whether the shift is applied; a smaller one may be due to noise."""
    pairs: int
    """Number of pairs of frames that were used."""


class PairRates(NamedTuple):
    """Angular rates of a camera from pairs of frames."""

    starts: FloatArray
    """(n,) time of the first row of each pair's first frame, frame periods."""
    rates: FloatArray
    """(n, 3) ``mean_turn``, rad per frame period, in the convention of ``Correspondences.gyro``."""


def pair_rates(
    frames: Iterable[NDArray[Any]],
    count: int,
    camera: PinholeCamera,
    shutter: RollingShutter,
    robust: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
    begins: FloatArray | None = None,
) -> PairRates:
    """The rates of some pairs of frames (H, W[, 3]), in the axes of the ``turned`` camera.

    Args:
        frames, count: frames in order, which are iterated once, and their approximate number.
        advance: called before each pair that is examined.
        begins: (n,) times of the frames' first rows, frame periods; pairs that are not about 1 apart are left out.
    """
    turn = turned(camera, shutter)
    rig = StereoRig.of_one(turn.camera)
    starts, rates = list[float](), list[FloatArray]()
    every = max((count - 1) // PAIRS, 1)
    for number, images in islice(enumerate(pairwise(frames)), 0, every * PAIRS, every):
        advance(f"frame {number}")
        if begins is not None and not about_one(begins[number + 1] - begins[number]):
            continue
        pair = [turn.image(image) for image in images]
        flows = find_flows(pair)
        if refusal(pair, flows):
            continue
        motion = find_own_motion(flows, rig, turn.shutter, "left", robust, seed).own.motion
        if motion is not None:
            starts.append(float(number) if begins is None else float(begins[number]))
            rates.append(mean_turn(motion, turn.shutter.readout_ratio))
    return PairRates(np.array(starts), np.reshape(rates, (-1, 3)))


def mean_turn(motion: Motion, readout_ratio: float) -> FloatArray:
    """(3,) mean over the rows of the rotation vector during one period from each row's time."""
    rows = np.linspace(0.0, readout_ratio, _ROWS)
    before, after = motion.body_from_world(rows)[0], motion.body_from_world(rows + 1.0)[0]
    return np.mean(so3.log(after @ np.swapaxes(before, -1, -2)), axis=0)


def with_clock_corrected(
    pairs: PairRates, samples: FloatArray, camera: PinholeCamera, shutter: RollingShutter, farthest: float
) -> tuple[FloatArray, Clock]:
    """The samples (n, 4) with their clock's shift subtracted if it is used; and the clock."""
    turn = turned(camera, shutter)
    clock = find_clock(pairs, turn.gyro(samples), turn.shutter.readout_ratio, farthest)
    return (samples - [clock.shift, 0.0, 0.0, 0.0] if clock.used else samples), clock


def find_clock(pairs: PairRates, samples: FloatArray, readout_ratio: float, farthest: float) -> Clock:
    """Estimate the time shift at which samples (n, 4) tau, w agree best with the rates of pairs.

    Larger shifts than ``farthest``, frame periods, do not count as determined. Some are searched all the same, so
    that the best shift up to there is not merely the one that is nearest to a better one beyond.
    """
    count = len(pairs.starts)
    if count < _FEWEST:
        return Clock(0.0, farthest, False, False, count)
    steps = int((farthest + _APART) / _STEP)
    shifts = _STEP * np.arange(-steps, steps + 1)
    differences = pairs.rates - mean_rates(samples, pairs.starts + shifts[:, None], readout_ratio)
    differences -= np.median(differences, axis=1, keepdims=True)  # the bias
    squares = np.sum(differences**2, axis=-1)
    # The median of chi-squared with three degrees of freedom is 2.37.
    left = float(np.min(np.median(squares, axis=1)))
    shaken = float(np.median(np.sum((pairs.rates - np.median(pairs.rates, axis=0)) ** 2, axis=-1)))
    variance = max(left / 2.37, _LEAST_RATE**2)
    costs = 0.5 * (_FREEDOM + 3.0) * np.sum(np.log1p(squares / (_FREEDOM * variance)), axis=1)
    shares = np.exp(np.min(costs) - costs)
    shares /= np.sum(shares)
    near = np.abs(shifts - shifts[np.argmax(shares)]) <= _APART
    certainty = float(np.sum(shares[near]))
    shift = float(shifts[near] @ shares[near]) / certainty
    sigma = float(np.sqrt((shifts[near] - shift) ** 2 @ shares[near] / certainty + _LEAST_SIGMA**2))
    if certainty < _CERTAIN or sigma > _MOST_SIGMA or abs(shift) > farthest + sigma or left > _EXPLAINED * shaken:
        return Clock(0.0, farthest, False, False, count)
    return Clock(shift, sigma, True, abs(shift) > _CLEARLY * sigma, count)


def mean_rates(samples: FloatArray, starts: FloatArray, readout_ratio: float) -> FloatArray:
    """(..., 3) mean over the rows of the mean rate of samples (n, 4) during a period from each row's time.

    ``starts`` (...) are times of first rows. Rates are linear between the samples and 0 beyond them.
    """
    times, ratio = samples[:, 0], max(readout_ratio, 1e-3)
    grid = np.arange(np.min(starts) - _STEP, np.max(starts) + 2.0 * _STEP + 1.0 + ratio, _STEP)
    rates = np.stack([np.interp(grid, times, samples[:, k], 0.0, 0.0) for k in (1, 2, 3)], axis=-1)

    def summed(values: FloatArray) -> FloatArray:
        return np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * _STEP * (values[1:] + values[:-1]), axis=0)])

    turns = summed(summed(rates))

    def at(moments: FloatArray) -> FloatArray:
        return np.stack([np.interp(moments, grid, turns[:, k]) for k in range(3)], axis=-1)

    return (at(starts + 1.0 + ratio) - at(starts + 1.0) - at(starts + ratio) + at(starts)) / ratio


# Motion of one camera whose rotation a gyroscope measured: its bias and the translation, from dense flow.
# Two frames determine a constant angular rate. A gyroscope measures how the rate changes between the rows, up
# to a bias that is constant during two frames: three unknowns, as many as the constant rate has. The bias is
# estimated with the translation from the flow, with a prior that keeps it small if the flow does not determine it.


NOT_COVERED = "the gyroscope's samples do not cover these frames"
CONTRADICTED = "the gyroscope contradicts the frames"
_BIAS = 1e-3
"""Prior standard deviation of the bias, rad per frame period: 0.03 rad/s at 30 frames a second."""
_MATCHES = 400
_SAMPLES = 100
"""Most RANSAC samples of two matches for the translation: enough if three in four matches are wrong."""
_WORTH = 200.0
"""Largest effective number of independent matches, as neighbours in dense flow are correlated."""
_NOISE_PX = 0.05
"""Least standard deviation of the flow, px."""
_PX_PER_SIGMA = 2.5
"""The robust loop's threshold, in standard deviations."""
_WORSE, _BIASED, _FAR_WORSE = 1.15, 2.0, 2.0
"""A gyroscope contradicts the frames if its error exceeds that of a constant angular rate by the first factor at a
bias of more standard deviations than the second value, or by the third factor at any bias. On shakes of three
kinds in a closed-form world, right samples fulfilled at most one of the first two and had at most 1.63 times the
error; samples with another sign, axes or time with such an error fulfilled both."""


def around(samples: FloatArray, first: float, last: float) -> FloatArray | None:
    """Samples (n, 4) tau, w from half a period before ``first`` to as much after ``last``; None: not covered."""
    tau = samples[:, 0]
    chosen = samples[(tau >= first - 0.5) & (tau <= last + 0.5)]
    if len(chosen) < 2 or chosen[:, 0].min() > first or chosen[:, 0].max() < last:
        return None
    return chosen


def rotation_alone(rig: StereoRig, shutter: RollingShutter, side: Side, samples: FloatArray) -> FoundOwnMotion:
    """The rotation of the samples with all points at infinity, for frames that do not show a translation."""
    motion = GyroMotion(samples, np.zeros(3))
    own = OwnMotion(rig=rig.about(side), shutter=shutter, side=side, motion=motion, far=True)
    return FoundOwnMotion(own=own, robust=None)


def with_gyro(
    found: FoundOwnMotion, flows: Flows, samples: FloatArray, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """Replace the constant rate of a motion by the rotation of the samples (n, 4) with an estimated bias.

    ``found`` is the result from the images alone. It is kept, with a reason in ``unused``, if they contradict it.
    """
    own, rng = found.own, np.random.default_rng(seed)
    rig, shutter, side = own.rig, own.shutter, own.side
    matches = flow_matches(flows, rng)
    few = matches[:_MATCHES]  # they are in random order
    given = Correspondences(left=few, gyro=samples)
    quick = replace(robust, max_iterations=min(robust.max_iterations, _SAMPLES))
    first = estimate_motion(given, rig, shutter, GyroSolver(), quick, rng)
    if not first.estimate.success:
        if own.motion is None:
            return rotation_alone(rig, shutter, side, samples)
        return replace(found, unused=CONTRADICTED)
    noise_px = max(first.threshold_px / _PX_PER_SIGMA, _NOISE_PX)
    weight = float(np.sqrt(min(_WORTH, len(few)) / len(few))) / noise_px

    def moving(x: FloatArray) -> GyroMotion:
        return GyroMotion(samples + np.concatenate([[0.0], _BIAS * x[:3]]), x[3:] / np.linalg.norm(x[3:]))

    def residuals(x: FloatArray) -> FloatArray:
        errors = weight * rs_sampson_error(rig, shutter, moving(x), side, few)
        tamed = np.sign(errors) * np.sqrt(2.0 * (np.sqrt(1.0 + errors**2) - 1.0))  # linear where they are large
        return np.concatenate([tamed, x[:3], [float(np.linalg.norm(x[3:])) - 1.0]])

    start = np.concatenate([np.zeros(3), first.estimate.d])
    bias_d = scipy.optimize.least_squares(residuals, start, method="lm", max_nfev=200, xtol=1e-6).x
    motion = moving(bias_d)

    def miss_px(one: Motion) -> float:
        return error_px(one, matches, rig, shutter, side)

    worse = _WORSE if float(np.linalg.norm(bias_d[:3])) > _BIASED else _FAR_WORSE
    if own.motion is not None and miss_px(motion) > worse * miss_px(own.motion):
        return replace(found, unused=CONTRADICTED)
    return FoundOwnMotion(own=replace(own, motion=motion), robust=first)
