"""How far the clock of a gyroscope's log is off that of one camera's frames, from how both turn.

Each pair of frames shows a rate of turn: the mean of what the gyroscope measured between the two moments at which
a row is read, over the rows. The shift at which both agree best is looked for, beside a bias of the gyroscope.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

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
"""Largest shift that is looked for."""
PAIRS = 24
"""Of frames, at most, by which it is found; they lie evenly over the video."""
_STEP = 1.0 / 32
"""Frame periods between shifts that are tried; a tenth of the period of a hand's fastest shakes at 30 frames/s."""
_FREEDOM = 4.0
"""Of the t distribution of the differences: a pair whose motion is wrong counts little."""
_LEAST_RATE = 2e-4
"""Standard deviation, rad per frame period, that a pair's rate has at least: 0.1 px of a focal length of 500."""
_APART = 1.0
"""Frame periods beyond which a shift is another one."""
_CERTAIN, _MOST_SIGMA, _FEWEST = 0.99, 0.15, 6
"""Least probability, largest deviation (frame periods) and fewest pairs of a shift that counts as determined."""
_CLEARLY = 2.5
"""Deviations from 0 of a shift that is used: who recorded both together knows the clock better than frames do."""
_EXPLAINED = 0.2
"""Of the variance of the pairs' rates, at most, may be left where both agree best. On rendered sequences of eight
frames and more the log of another one, or its own with another sign, left 0.28 and more."""
_LEAST_SIGMA = 0.02
"""Standard deviation, frame periods: a pair's rate is no exact mean over its rows."""


class Clock(NamedTuple):
    """What frames say of the clock of a gyroscope."""

    shift: float
    """Frame periods to take from the times of its samples; 0 where the frames do not tell it."""
    sigma: float
    told: bool
    used: bool
    """Whether it is large enough to be taken from the times; a smaller one may be the noise of the frames."""
    pairs: int
    """That it rests on."""


class PairRates(NamedTuple):
    """What pairs of frames show of a camera's turning."""

    starts: FloatArray
    """(n,) frame periods: first row of the first frame of each."""
    rates: FloatArray
    """(n, 3) rad per frame period, in the convention of ``Correspondences.gyro``."""


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
    """Of some pairs of frames (H, W[, 3]), in the axes of the camera whose lines are rows from the top.

    Args:
        frames, count: in order, gone through once, and how many there are, about.
        advance: called for each pair that is looked at.
        begins: (n,) times of the frames' first rows, frame periods; pairs not about 1 apart are left out.
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
            rates.append(motion.w)
    return PairRates(np.array(starts), np.reshape(rates, (-1, 3)))


def in_time(
    pairs: PairRates, samples: FloatArray, camera: PinholeCamera, shutter: RollingShutter, farthest: float
) -> tuple[FloatArray, Clock]:
    """The samples (n, 4) of the camera with the shift of their clock taken from their times, where it is used."""
    turn = turned(camera, shutter)
    clock = find_clock(pairs, turn.gyro(samples), turn.shutter.readout_ratio, farthest)
    return (samples - [clock.shift, 0.0, 0.0, 0.0] if clock.used else samples), clock


def find_clock(pairs: PairRates, samples: FloatArray, readout_ratio: float, farthest: float) -> Clock:
    """The shift of samples (n, 4) tau, w, at which they turn as the pairs do.

    Args:
        farthest: frame periods, the largest shift that is looked for.
    """
    count = len(pairs.starts)
    if count < _FEWEST:
        return Clock(0.0, farthest, False, False, count)
    shifts = _STEP * np.arange(-int(farthest / _STEP), int(farthest / _STEP) + 1)
    differences = pairs.rates - mean_rates(samples, pairs.starts + shifts[:, None], readout_ratio)
    differences -= np.median(differences, axis=1, keepdims=True)  # the bias
    squares = np.sum(differences**2, axis=-1)
    # Of three normal errors half have a sum of squares below 2.37 variances.
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
    inside = abs(shift) < farthest - _APART
    if certainty < _CERTAIN or sigma > _MOST_SIGMA or not inside or left > _EXPLAINED * shaken:
        return Clock(0.0, farthest, False, False, count)
    return Clock(shift, sigma, True, abs(shift) > _CLEARLY * sigma, count)


def mean_rates(samples: FloatArray, starts: FloatArray, readout_ratio: float) -> FloatArray:
    """(..., 3) mean rates of samples (n, 4) over a period from each row's time, over the rows.

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
# Two frames tell a constant rate of turn. A gyroscope tells how the rate changes between the rows, up to a
# bias that hardly changes in two frames: three numbers, as many as the constant rate has. They are found with
# the translation from the flow, and expected to be small where the flow leaves them open.


NOT_COVERED = "the gyroscope's samples do not reach over these frames"
CONTRADICTED = "the gyroscope contradicts the frames"
_BIAS = 1e-3
"""Standard deviation of the bias, rad per frame period: 0.03 rad/s at 30 frames a second."""
_MATCHES = 400
_SAMPLES = 100
"""Of two matches, at most, in the search for the translation: enough for three wrong ones in four."""
_WORTH = 200.0
"""Matches, at most, that count as apart: neighbours in dense flow err alike."""
_NOISE_PX = 0.05
"""Standard deviation of the flow, at least."""
_PX_PER_SIGMA = 2.5
"""Of the robust loop's threshold."""
_WORSE, _BIASED, _FAR_WORSE = 1.15, 2.0, 2.0
"""A gyroscope contradicts the frames where it fits them by so much worse than a constant rate of turn does, at a
bias of so many standard deviations, or by far worse. On shakes of three kinds in a closed-form world, right
samples had one of the first two at most, and 1.63 times the error; those with another sign, axes or time that
fitted so much worse had both."""


def around(samples: FloatArray, first: float, last: float) -> FloatArray | None:
    """Samples (n, 4) tau, w from half a period before a time to half after another; None: not over both."""
    tau = samples[:, 0]
    chosen = samples[(tau >= first - 0.5) & (tau <= last + 0.5)]
    if len(chosen) < 2 or chosen[:, 0].min() > first or chosen[:, 0].max() < last:
        return None
    return chosen


def rotation_alone(rig: StereoRig, shutter: RollingShutter, side: Side, samples: FloatArray) -> FoundOwnMotion:
    """What the samples say, and everything infinitely far: frames that show nothing to find a translation by."""
    motion = GyroMotion(samples, np.zeros(3))
    own = OwnMotion(rig=rig.about(side), shutter=shutter, side=side, motion=motion, far=True)
    return FoundOwnMotion(own=own, robust=None)


def with_gyro(
    found: FoundOwnMotion, flows: Flows, samples: FloatArray, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """The motion with the rotation of the samples (n, 4), and their bias, in place of one that turns evenly.

    ``found`` is that of the images alone. It stays where the samples contradict it; its ``unused`` says so.
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
