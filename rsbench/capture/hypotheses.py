"""Hypotheses on how the cameras read their lines and how the rig moves, and the best fit of one of them.

A hypothesis names the scan of each camera, the motion model, and whether the right camera may be late. Its six
motion parameters and its unknowns (readout ratio, delay, acceleration, errors of the calibration) are fitted
together by a damped Newton method on compiled equations, under heavy-tailed errors.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, STRETCHING, TERMS, ray_shifts, ray_stretches
from rsbench.components.motion_kernels import MotionKernel
from rsbench.components.motion_models import AcceleratedKernel, any_law, load_kernel
from rsbench.core.correspondences import BoolArray, Correspondences, unlinked_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import HeavyTailed, Packed, pack
from rsbench.solvers.engine.residuals import add_pairs, add_tracks

Start = Literal["global", "top", "bottom", "left", "right"]
"""The side of the image at which a camera begins to read, or ``global`` for all lines at once."""
_FRAMES = np.array([0.0, 1.0])
_RATIO, _DELAY, _ACCELERATION, _FIRST_ERROR = range(4)
"""Places of the unknowns; after the first error of the calibration come the others."""
STARTS: tuple[Start, ...] = get_args(Start)
_FRAMES_OF_TRACKS, _LATE_OF_TRACKS = np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
"""Of the ends of a track: the frame, and 1 of those of the right camera."""


@dataclass(frozen=True, order=True)
class Scans:
    """Where each camera begins to read; those that roll share one readout ratio."""

    left: Start
    right: Start

    @property
    def rolls(self) -> bool:
        """Whether any camera does."""
        return self != GLOBAL

    @property
    def together(self) -> bool:
        """Whether both read alike."""
        return self.left == self.right

    def start(self, side: Side) -> Start:
        """Where one camera begins."""
        return self.left if side == "left" else self.right

    def __str__(self) -> str:
        if self.together:
            return "both cameras global" if self.left == "global" else f"both cameras from the {self.left}"
        words = {
            side: "global" if self.start(side) == "global" else f"from the {self.start(side)}" for side in SIDES
        }
        return f"left camera {words['left']}, right camera {words['right']}"


GLOBAL = Scans("global", "global")
ALL_SCANS = tuple(Scans(*starts) for starts in product(STARTS, STARTS))
"""All 25."""


def scans_of(shutter: RollingShutter) -> Scans:
    """The scans of a known shutter."""
    if shutter.readout_ratio == 0.0:
        return GLOBAL
    return Scans(shutter.scan_of("left"), shutter.scan_of("right"))


def line_of(scans: Scans, side: Side) -> FloatArray:
    """Time (3,) of one camera's pixels per readout ratio: constant, per image width, per image height."""
    return np.array(
        {
            "global": (0.0, 0.0, 0.0),
            "top": (0.0, 0.0, 1.0),
            "bottom": (1.0, 0.0, -1.0),
            "left": (0.0, 1.0, 0.0),
            "right": (1.0, -1.0, 0.0),
        }[scans.start(side)]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lines:
    """Per readout ratio: times of the ends after the start of their frame, and their derivatives by the pixel."""

    pairs: FloatArray
    """(n, 2) of both ends."""
    slopes: FloatArray
    """(n, 2)."""
    tracks: FloatArray
    """(m, 4) of the ends left 0, right 0, left 1, right 1."""
    track_slopes: FloatArray
    """(m, 4, 2)."""

    def only(self, pairs: BoolArray, tracks: BoolArray) -> _Lines:
        """Those of masks (n,), (m,)."""
        return _Lines(
            pairs=self.pairs[pairs],
            slopes=self.slopes[pairs],
            tracks=self.tracks[tracks],
            track_slopes=self.track_slopes[tracks],
        )


class TimedMatches:
    """Matches whose ends can be given the times of any scans.

    Every end has a time of its own here (``timed_tracks``), whatever the scans, so that all scans are judged
    by the same errors.
    """

    def __init__(self, matches: Correspondences, rig: StereoRig, motion_model: str = "linear") -> None:
        packs = {scan: pack(matches, rig, _late(rig, scan), motion_model) for scan in get_args(Scan)}
        self._base = next(iter(packs.values()))
        self.left: BoolArray = self._base.pairs[:, 6] >= 0.0
        """(n,) which pairs are the left camera's."""
        late = np.where(self.left, 0.0, 1.0)
        self._lines: dict[Start, _Lines] = {
            scan: _Lines(
                pairs=packed.pairs[:, 4:6] - (0.0, 1.0) - late[:, None],
                slopes=packed.pairs[:, 15:17],
                tracks=packed.tracks[:, :, 2] - (0.0, 1.0, 1.0, 2.0),
                track_slopes=packed.tracks[:, :, 7:9],
            )
            for scan, packed in packs.items()
        }
        pairs, tracks = len(self._base.pairs), len(self._base.tracks)
        self.count = pairs + tracks
        """Measurements: pairs that no track repeats, then tracks."""
        sets = [getattr(matches, side)[unlinked_pairs(matches, side)] for side in SIDES]
        self.pixels: FloatArray = np.concatenate([*(each[:, :2] for each in sets), matches.tracks[:, :2]])
        """(count, 2) where each is seen in frame 0."""
        self._shifts, self._stretches = self._ray_shifts(rig), self._ray_stretches(rig)
        self._lines["global"] = _Lines(
            pairs=np.zeros((pairs, 2)),
            slopes=np.zeros((pairs, 2)),
            tracks=np.zeros((tracks, 4)),
            track_slopes=np.zeros((tracks, 4, 2)),
        )

    def _ray_shifts(self, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
        """(n, 2, 2, 14) of the pairs' ends and (m, 4, 2, 14) of the tracks': ``ray_shifts``, the errors last."""
        base, optics = self._base, (float(self._base.focal[0]), rig.camera.lens)
        pairs = base.pairs[:, :4].reshape(-1, 2, 2)
        either = [ray_shifts(pairs, side, *optics) for side in SIDES]
        tracks = [ray_shifts(base.tracks[:, k, :2], SIDES[k % 2], *optics) for k in range(4)]
        found = np.where(self.left[:, None, None, None], *either), np.stack(tracks, axis=1)
        return np.ascontiguousarray(found[0].swapaxes(2, 3)), np.ascontiguousarray(found[1].swapaxes(2, 3))

    def _ray_stretches(self, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
        """(n, 2, 2, 2, 2) of the pairs' ends and (m, 4, 2, 2, 2) of the tracks', see ``ray_stretches``."""
        pairs, tracks = self._base.pairs[:, :4].reshape(-1, 2, 2), self._base.tracks[:, :, :2]
        return ray_stretches(pairs, rig.camera.lens), ray_stretches(tracks, rig.camera.lens)

    def under(self, motion_model: str) -> TimedMatches:
        """The same matches under another motion model."""
        other = copy.copy(self)
        other._base = replace(self._base, kernel=load_kernel(motion_model))
        return other

    def subset(self, chosen: BoolArray) -> TimedMatches:
        """Of a mask (count,) over pairs and tracks."""
        other = copy.copy(self)
        other._base = self._base.only(chosen)
        pairs, tracks = np.split(chosen, [len(self._base.pairs)])
        other.left, other.pixels, other.count = (
            self.left[pairs],
            self.pixels[chosen],
            int(np.count_nonzero(chosen)),
        )
        other._shifts = self._shifts[0][pairs], self._shifts[1][tracks]
        other._stretches = self._stretches[0][pairs], self._stretches[1][tracks]
        other._lines = {start: lines.only(pairs, tracks) for start, lines in self._lines.items()}
        return other

    def read(self, scans: Scans, chosen: BoolArray | None = None) -> ReadMatches:
        """Those of a mask (count,) as these scans time them; None: all."""
        chosen = np.ones(self.count, dtype=np.bool_) if chosen is None else chosen
        pairs, tracks = np.split(chosen, [len(self._base.pairs)])
        left, right = (self._lines[scans.start(side)].only(pairs, tracks) for side in SIDES)
        first, of_left = self.left[pairs][:, None], np.array([True, False, True, False])
        lines = _Lines(
            pairs=np.where(first, left.pairs, right.pairs),
            slopes=np.where(first, left.slopes, right.slopes),
            tracks=np.where(of_left, left.tracks, right.tracks),
            track_slopes=np.where(of_left[:, None], left.track_slopes, right.track_slopes),
        )
        shifts, stretches = ((each[0][pairs], each[1][tracks]) for each in (self._shifts, self._stretches))
        return ReadMatches(self._base.only(chosen), self.left[pairs], lines, shifts, stretches)

    def packed(self, scans: Scans, unknowns: FloatArray) -> Packed:
        """The measurements as these scans time them, see ``ReadMatches.packed``."""
        return self.read(scans).packed(unknowns)

    def kernel(self, unknowns: FloatArray) -> MotionKernel:
        """Of the motion model, with the acceleration among some unknowns (17,)."""
        return _accelerated(self._base.kernel, float(unknowns[_ACCELERATION]))


class ReadMatches:
    """Matches as two cameras read them, one scan each, but for the unknowns of their capture."""

    def __init__(
        self,
        base: Packed,
        left: BoolArray,
        lines: _Lines,
        shifts: tuple[FloatArray, FloatArray],
        stretches: tuple[FloatArray, FloatArray],
    ) -> None:
        self._base, self._lines, self._shifts, self._stretches = base, lines, shifts, stretches
        self.count = len(base.pairs) + len(base.tracks)
        self._late = np.where(left, 0.0, 1.0)[:, None]
        """(n, 1) of the pairs, 1 of those of the right camera."""
        self._constant: tuple[list[int], FloatArray, FloatArray] | None = None

    def packed(self, unknowns: FloatArray) -> Packed:
        """The measurements at some unknowns.

        Args:
            unknowns: (17,) readout ratio; frame periods by which the right camera is late; the motion's
                acceleration, 0 of a model without one; what the calibration is wrong by.
        """
        ratio, delay, acceleration, *errors = map(float, unknowns)
        pairs, tracks, lines = self._base.pairs.copy(), self._base.tracks.copy(), self._lines
        pairs[:, 4:6] = _FRAMES + delay * self._late + ratio * lines.pairs
        pairs[:, 15:17] = ratio * lines.slopes
        tracks[:, :, 2] = _FRAMES_OF_TRACKS + delay * _LATE_OF_TRACKS + ratio * lines.tracks
        tracks[:, :, 7:9] = ratio * lines.track_slopes
        if any(errors):
            pairs[:, :4] -= (self._shifts[0] @ errors).reshape(-1, 4)
            tracks[:, :, :2] -= self._shifts[1] @ errors
        if any(stretching := [errors[term] for term in STRETCHING]):
            ends = self._stretched(pairs[:, 7:15].reshape(-1, 2, 4), self._stretches[0], stretching)
            pairs[:, 7:15] = ends.reshape(-1, 8)
            tracks[:, :, 3:7] = self._stretched(tracks[:, :, 3:7], self._stretches[1], stretching)
        kernel = _accelerated(self._base.kernel, acceleration)
        return replace(self._base, pairs=pairs, tracks=tracks, h=0.0, kernel=kernel)

    def _stretched(self, by_pixel: FloatArray, stretches: FloatArray, errors: list[float]) -> FloatArray:
        """Derivatives (n, k, 4) of the ideal pixels by the pixels, of rays that errors shift unevenly."""
        fx, fy = self._base.focal
        by_ray = np.eye(2) - np.einsum("k,...kij->...ij", errors, stretches)
        by_ray = by_ray * [[1.0, fx / fy], [fy / fx, 1.0]]
        return np.asarray((by_ray @ by_pixel.reshape(*by_pixel.shape[:-1], 2, 2)).reshape(by_pixel.shape))

    def derivatives(self, packed: Packed, acceleration: float, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Of the ends' rays and times by k free unknowns: (n, 2, k, 3) of pairs, (m, 4, k, 3) of tracks.

        An acceleration is one of all times: the motion is at beta(tau), see ``AcceleratedKernel``. The next call
        may write into what this one gave.
        """
        if self._constant is None or self._constant[0] != free:
            self._constant = (free, *self._constant_derivatives(free))
        _, pairs, tracks = self._constant
        if _ACCELERATION in free:
            k = free.index(_ACCELERATION)
            for by, tau in ((pairs, packed.pairs[:, 4:6]), (tracks, packed.tracks[:, :, 2])):
                by[:, :, k, 2] = (tau**2 - tau) / ((2.0 + acceleration) * (1.0 + acceleration * tau))
        return pairs, tracks

    def _constant_derivatives(self, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Those by all but an acceleration."""
        pairs = np.zeros((len(self._base.pairs), 2, len(free), 3))
        tracks = np.zeros((len(self._base.tracks), 4, len(free), 3))
        for k, unknown in enumerate(free):
            if unknown >= _FIRST_ERROR:
                pairs[:, :, k, :2] = -self._shifts[0][..., unknown - _FIRST_ERROR]
                tracks[:, :, k, :2] = -self._shifts[1][..., unknown - _FIRST_ERROR]
            elif unknown == _RATIO:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._lines.pairs, self._lines.tracks
            elif unknown == _DELAY:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._late, _LATE_OF_TRACKS
        return pairs, tracks


def _accelerated(kernel: MotionKernel, acceleration: float) -> MotionKernel:
    return AcceleratedKernel(acceleration=acceleration) if isinstance(kernel, AcceleratedKernel) else kernel


def _late(rig: StereoRig, scan: Scan) -> RollingShutter:
    """Both cameras read alike, the right one a period late: no two ends of a match are of one time."""
    camera = rig.camera
    return RollingShutter(height=camera.height, width=camera.width, readout_ratio=1.0, scan=scan, right_delay=1.0)


RATIO, DELAY, ACCELERATION = range(3)
"""Places of the first unknowns: readout ratio, delay of the right camera (frame periods), k."""
CALIBRATION = slice(3, 3 + len(TERMS))
"""Places of what the calibration is wrong by, see ``calibration.TERMS``."""
UNKNOWNS = CALIBRATION.stop
LEAST_RATIO = 0.05
"""Readout ratios below this are taken for a global shutter's."""
MODELS = ("linear", "twist", "inertial", "accelerated")
"""Motion models that are tried."""
DELAY_SIGMA = 0.3
"""Frame periods by which a right camera that is late or early is so: what is expected before matches are seen."""
ACCELERATION_SIGMA = 0.2
"""Standard deviation of k that is expected of motions that accelerate."""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """How the cameras read and how the rig moves, and which of the unknowns are free beside the motion."""

    scans: Scans
    motion_model: str
    delayed: bool = False
    """Whether the right camera may be late."""

    @property
    def accelerations(self) -> tuple[float, ...]:
        """k that its fits start from: from 0 alone, two of eighteen rigs that turned by 6 deg and slowed down were
        taken for ones in reverse."""
        return (0.0, -0.3, 0.3) if self.motion_model == "accelerated" else (0.0,)


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of a capture beforehand; None: it is looked for."""

    ratio: float | None = None
    scans: tuple[Scans, ...] = ALL_SCANS
    """Those that are possible."""
    delay: float | None = None
    """Frame periods by which the right camera is late."""
    calibration: tuple[float, ...] = NO_ERRORS
    """What the calibration is wrong by, see ``calibration.TERMS``."""
    calibration_sigma: tuple[float, ...] = NO_ERRORS
    """Standard deviation of each of them, about 0; 0: it is known."""
    models: tuple[str, ...] = MODELS

    def prior(self, hypothesis: Hypothesis) -> FloatArray:
        """(17,) standard deviations of the unknowns, as ``CaptureCost`` takes them."""
        ratio = np.inf if self.ratio is None and hypothesis.scans.rolls else 0.0
        delay = DELAY_SIGMA if hypothesis.delayed else 0.0
        acceleration = ACCELERATION_SIGMA if hypothesis.motion_model == "accelerated" else 0.0
        return np.array([ratio, delay, acceleration, *self.calibration_sigma])

    def start(self, hypothesis: Hypothesis, ratio: float, delay: float) -> FloatArray:
        """(17,) unknowns of a hypothesis, of which these are guesses."""
        out = np.zeros(UNKNOWNS)
        out[RATIO], out[DELAY] = ratio, delay if hypothesis.delayed else self.delay or 0.0
        out[CALIBRATION] = self.calibration
        if not hypothesis.scans.rolls:
            out[RATIO] = 0.0
        elif self.ratio is not None:
            out[RATIO] = self.ratio
        return out

    @property
    def shutter_known(self) -> bool:
        """Whether nothing but the motion and its model is looked for."""
        return len(self.scans) == 1 and self.ratio is not None and self.delay is not None

    @property
    def delays(self) -> tuple[bool, ...]:
        """Whether the right camera may be late."""
        return (False, True) if self.delay is None else (False,)


BEYOND_RATIO = 1.2
"""No ratio is beyond 1, but the top of what noise makes of one near 1 may be."""
_MAX_TRANSLATION_M = 50.0
_LEAST = np.array([LEAST_RATIO, -1.0, -0.45, *10 * [-50.0], *3 * [-2.0], -0.4])
_MOST = np.array([BEYOND_RATIO, 1.0, 3.0, *10 * [50.0], *3 * [2.0], 0.4])
_LONGEST_STEP = np.array([0.4, 0.4, 0.3, 2.0, *9 * [20.0], *3 * [0.2], 0.1])
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-8, 1e6
"""A motion makes up for most of a wrong ratio: more damping than this would hold the ratio where it is."""
_MOTION = 6
_STRETCHING = tuple(CALIBRATION.start + term for term in STRETCHING)
_STEP = 1e-7
_OVER = 5.0
"""Times Newton's prediction that a cost may fall, at most."""
_MEDIAN, LEAST_SCALE_PX = 0.6, 0.005
"""Median of squared normal errors, one or five together; and what exact matches are taken for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """Which measurements count, and the distribution of their errors (``heavy_tails``)."""

    nu: float
    scale: float
    """px."""
    chosen: BoolArray
    """(n + m,) of the pairs and tracks."""
    trust: FloatArray | None = None
    """Weights of the chosen ones; None: 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CaptureFit:
    """The best parameters under one hypothesis."""

    hypothesis: Hypothesis
    theta: FloatArray
    """(6,) of the motion."""
    unknowns: FloatArray
    """(17,)."""
    cost: float
    """Negative logarithm of likelihood and prior, times the squared scale, px^2."""
    sigma: FloatArray
    """(17,) standard deviations of the unknowns; the ratio's is 0 where it was held."""
    spread: FloatArray
    """(6, 6) what not knowing them, but for a ratio that was held, adds to the covariance of theta."""
    occam: float
    """Logarithm of the volume of the posterior of the unknowns beside the ratio over that of their prior."""


class CaptureCost:
    """The cost of one hypothesis as a function of the motion and the unknowns.

    Args:
        prior: (17,) standard deviations of the unknowns about 0; 0 holds an unknown where it starts, and infinity
            says nothing of it.
    """

    def __init__(
        self, matches: TimedMatches, hypothesis: Hypothesis, likelihood: Likelihood, prior: FloatArray
    ) -> None:
        self.hypothesis, self.likelihood, self.prior = hypothesis, likelihood, prior
        self._matches = matches.read(hypothesis.scans, likelihood.chosen)
        self.free = [k for k in range(UNKNOWNS) if prior[k] > 0.0]
        self._weight = np.zeros(UNKNOWNS)
        self._weight[self.free] = (likelihood.scale / prior[self.free]) ** 2
        count = self._matches.count
        self._trust = np.ones(count) if likelihood.trust is None else likelihood.trust

    def tailed(self, unknowns: FloatArray) -> HeavyTailed:
        """The measurements at some unknowns (17,)."""
        packed = self._matches.packed(unknowns)
        return HeavyTailed(**vars(packed), nu=self.likelihood.nu, scale=self.likelihood.scale, trust=self._trust)

    def each(self, theta: FloatArray, unknowns: FloatArray) -> FloatArray:
        """(n,) what each measurement adds."""
        tailed = self.tailed(unknowns)
        squares = _squares(tailed, theta)
        factor = 0.5 * tailed.scale**2 * tailed.trust * (tailed.nu + tailed.freedom)
        return np.asarray(factor * np.log1p(squares / (tailed.nu * tailed.scale**2)))

    def typical_error(self, theta: FloatArray, unknowns: FloatArray) -> float:
        """Scale of the errors, px, that their median shows: up to half of them may be wrong."""
        tailed = self.tailed(unknowns)
        squares = _squares(tailed, theta)
        return max(float(np.sqrt(np.median(squares / tailed.freedom) / _MEDIAN)), LEAST_SCALE_PX)

    def __call__(self, theta: FloatArray, unknowns: FloatArray) -> float:
        return float(np.sum(self.each(theta, unknowns))) + 0.5 * float(self._weight @ unknowns**2)

    def local(
        self, theta: FloatArray, unknowns: FloatArray, free: list[int]
    ) -> tuple[float, FloatArray, FloatArray]:
        """The cost, its gradient and its Hessian by theta and the free unknowns."""
        packed, size = self._matches.packed(unknowns), _MOTION + len(free)
        by = self._matches.derivatives(packed, float(unknowns[ACCELERATION]), free)
        tails, trust = np.array([self.likelihood.nu, self.likelihood.scale]), self._trust
        gradient, H, n = np.zeros(size), np.zeros((size, size)), len(packed.pairs)
        at, focal, baseline = (theta, any_law(packed.kernel)), packed.focal, packed.baseline
        cost = add_pairs(*at, packed.pairs, by[0], focal, tails, trust[:n], gradient, H)
        cost += add_tracks(*at, packed.tracks, by[1], focal, baseline, tails, trust[n:], gradient, H)
        for unknown in set(_STRETCHING) & set(free):  # by which the same errors of rays are more pixels, too
            ahead = float(np.sum(self.each(theta, unknowns + _STEP * np.eye(UNKNOWNS)[unknown])))
            gradient[_MOTION + free.index(unknown)] = (ahead - cost) / _STEP  # finds it to half a step
        gradient[_MOTION:] += self._weight[free] * unknowns[free]
        H[range(_MOTION, size), range(_MOTION, size)] += self._weight[free]
        return cost + 0.5 * float(self._weight @ unknowns**2), gradient, H


def _squares(tailed: HeavyTailed, theta: FloatArray) -> FloatArray:
    return np.concatenate([tailed.pair_residuals(theta) ** 2, tailed.track_squares(theta)])


def fit_capture(
    cost: CaptureCost,
    theta: FloatArray,
    unknowns: FloatArray,
    *,
    iterations: int = 20,
    still: float = 1e-4,
    hold_ratio: bool = False,
    hopeless: float = np.inf,
) -> CaptureFit:
    """Newton's method, damped, from a start (6,), (17,).

    Args:
        still: decrease of the cost, in squared scales of the errors, at which to stop.
        hold_ratio: whether the ratio stays as it is.
        hopeless: cost that must come within reach, or it is given up: then the cost is above this.
    """
    free = [k for k in cost.free if k != RATIO or not hold_ratio]
    unknowns = _within(unknowns, free)
    damping = _LEAST_DAMPING
    now, gradient, H = cost.local(theta, unknowns, free)
    for _ in range(iterations):
        before, newton = now, _Newton(gradient, H, unknowns, free)
        if now - _OVER * newton.gain > hopeless:
            break
        while damping < _LARGEST_DAMPING:
            moved = newton.stepped(theta, damping)
            trial = cost.local(*moved, free)
            if trial[0] <= now:
                (theta, unknowns), (now, gradient, H) = moved, trial
                damping = max(0.1 * damping, _LEAST_DAMPING)
                break
            damping = max(10.0 * damping, 1e-4)
        if before - now < still * cost.likelihood.scale**2:
            break
    sigma = np.zeros(UNKNOWNS)
    whole = cost.likelihood.scale**2 * np.linalg.pinv(H, hermitian=True)
    covariance, shared = whole[_MOTION:, _MOTION:], whole[:_MOTION, _MOTION:]
    sigma[free] = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    others = [k for k, j in enumerate(free) if j != RATIO]
    values = np.linalg.eigvalsh(covariance[np.ix_(others, others)]) if others else np.zeros(0)
    volume = 0.5 * float(np.sum(np.log(np.maximum(values, 1e-30))))
    return CaptureFit(
        hypothesis=cost.hypothesis,
        theta=theta,
        unknowns=unknowns,
        cost=now,
        sigma=sigma,
        spread=shared @ np.linalg.pinv(covariance, hermitian=True) @ shared.T,
        occam=volume - float(np.sum(np.log(cost.prior[[free[k] for k in others]]))),
    )


class _Newton:
    """Newton's step from one place; an unknown at its limit stays there."""

    def __init__(self, gradient: FloatArray, H: FloatArray, unknowns: FloatArray, free: list[int]) -> None:
        self._moves = np.ones(len(gradient), dtype=np.bool_)
        for k, j in enumerate(free, start=_MOTION):
            outwards = -gradient[k]
            self._moves[k] = not (
                (unknowns[j] <= _LEAST[j] and outwards < 0.0) or (unknowns[j] >= _MOST[j] and outwards > 0.0)
            )
        A, g = H[np.ix_(self._moves, self._moves)], gradient[self._moves]
        self._size = np.sqrt(np.maximum(np.abs(np.diagonal(A)), 1e-12 * np.abs(A).max()) + 1e-300)
        values, self._vectors = np.linalg.eigh(A / np.outer(self._size, self._size))
        self._values = np.maximum(np.abs(values), 1e-9)  # downhill, whatever the curvature
        self._slopes = self._vectors.T @ (g / self._size)
        self._unknowns, self._free = unknowns, free

    @property
    def gain(self) -> float:
        """By how much the cost would fall, if it were as here everywhere."""
        return 0.5 * float(np.sum(self._slopes**2 / self._values))

    def stepped(self, theta: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Where a damped step leads."""
        step = np.zeros(len(self._moves))
        step[self._moves] = -(self._vectors @ (self._slopes / (self._values + damping))) / self._size
        theta, unknowns, free = theta + step[:_MOTION], self._unknowns.copy(), self._free
        unknowns[free] += np.clip(step[_MOTION:], -_LONGEST_STEP[free], _LONGEST_STEP[free])
        length = float(np.linalg.norm(theta[3:]))
        theta[3:] *= min(1.0, _MAX_TRANSLATION_M / max(length, _MAX_TRANSLATION_M))
        return theta, _within(unknowns, free)


def _within(unknowns: FloatArray, free: list[int]) -> FloatArray:
    """With those that are free within their limits."""
    out = unknowns.copy()
    out[free] = np.clip(unknowns[free], _LEAST[free], _MOST[free])
    return out
