"""Hypotheses about how the cameras read their lines and how the rig moves, and the best fit of each.

A hypothesis names the scan of each camera, the motion model, and whether the right camera may be delayed.
``fit_capture`` fits its six motion parameters and its unknowns (readout ratio, delay, acceleration, calibration
errors) jointly, by a damped Newton method on compiled equations with a heavy-tailed error distribution.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Literal, NamedTuple, get_args

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, STRETCHING, TERMS, CardSigma, ray_shifts, ray_stretches
from rsbench.components.motion_kernels import MotionKernel
from rsbench.components.motion_models import AcceleratedKernel, any_law, load_kernel
from rsbench.core.correspondences import BoolArray, Correspondences, unlinked_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.levenberg_marquardt import Damping, descend
from rsbench.solvers.engine.packed import HeavyTailed, Packed, pack
from rsbench.solvers.engine.residuals import add_pairs, add_tracks

Start = Literal["global", "top", "bottom", "left", "right"]
"""The side of the image at which a camera begins to read, or ``global`` for all lines at once."""
_LINES: dict[Start, tuple[float, float, float]] = {
    "global": (0.0, 0.0, 0.0),
    "top": (0.0, 0.0, 1.0),
    "bottom": (1.0, 0.0, -1.0),
    "left": (0.0, 1.0, 0.0),
    "right": (1.0, -1.0, 0.0),
}
"""Readout time of a pixel for a ratio of 1: a constant, and slopes per image width and per image height."""
_FRAMES = np.array([0.0, 1.0])
_FRAMES_OF_TRACKS, _LATE_OF_TRACKS = np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
"""For the four image points of a track: the frame index; and 1 where the right camera sees the point."""
RATIO, DELAY, ACCELERATION = range(3)
"""Indices of the first unknowns: readout ratio, delay of the right camera (frame periods), k."""
CALIBRATION = slice(3, 3 + len(TERMS))
"""Indices of the calibration errors, see ``calibration.TERMS``."""
UNKNOWNS = CALIBRATION.stop
LEAST_RATIO = 0.05
"""A camera with a smaller readout ratio is treated as one with a global shutter."""
MODELS = ("linear", "twist", "inertial", "accelerated")
"""Motion models that are compared."""
DELAY_SIGMA = 0.3
"""Prior standard deviation of the right camera's delay, where there is one, frame periods."""
ACCELERATION_SIGMA = 0.2
"""Prior standard deviation of the acceleration k of the accelerated motion model."""
BEYOND_RATIO = 1.2
"""Upper limit of a fitted ratio: true ratios are at most 1, but noise may move the best fit beyond that."""
_MAX_TRANSLATION_M = 50.0
_LOWER = np.array([LEAST_RATIO, -1.0, -0.45, *10 * [-50.0], *3 * [-2.0], -0.4])
_UPPER = np.array([BEYOND_RATIO, 1.0, 3.0, *10 * [50.0], *3 * [2.0], 0.4])
_LARGEST_STEP = np.array([0.4, 0.4, 0.3, 2.0, *9 * [20.0], *3 * [0.2], 0.1])
_DAMPING = Damping(least=1e-8, first=1e-4, largest=1e6)
"""A change of the motion makes up for most of a wrong ratio, so stronger damping would freeze the ratio."""
_MOTION = 6
_STRETCHING = tuple(CALIBRATION.start + term for term in STRETCHING)
_STEP = 1e-7
_EXPECTED_GAIN = 5.0
"""Largest decrease of the cost that is expected of a descent, as a multiple of Newton's prediction."""
_MEDIAN, LEAST_SCALE_PX = 0.6, 0.005
"""Median of the mean of one or of five squared normal errors; smallest error scale, used for exact matches."""


@dataclass(frozen=True, order=True)
class Scans:
    """The side at which each camera begins to read; rolling cameras have one ratio, unless both are given."""

    left: Start
    right: Start

    @property
    def rolls(self) -> bool:
        """Whether any camera has a rolling shutter."""
        return self != GLOBAL

    @property
    def together(self) -> bool:
        """Whether both cameras read in the same direction."""
        return self.left == self.right

    def start(self, side: Side) -> Start:
        """The side at which one camera begins to read."""
        return self.left if side == "left" else self.right

    def __str__(self) -> str:
        if self.together:
            return "both cameras global" if self.left == "global" else f"both cameras from the {self.left}"
        left, right = (s if s == "global" else f"from the {s}" for s in (self.left, self.right))
        return f"left camera {left}, right camera {right}"


GLOBAL = Scans("global", "global")
ALL_SCANS = tuple(Scans(*starts) for starts in product(get_args(Start), repeat=2))
"""All 25 combinations of a left and a right start."""


def scans_of(shutter: RollingShutter) -> Scans:
    """The scans of a known shutter."""
    left, right = (shutter.scan_of(side) if shutter.ratio_of(side) > 0.0 else "global" for side in SIDES)
    return Scans(left, right)


def shutter_under(
    scans: Scans, ratio: float, rig: StereoRig, delay: float = 0.0, right_share: float = 1.0
) -> RollingShutter:
    """The shutter with these scans; ``right_share`` is explained at ``Known``."""
    sides = [None if scans.start(side) == "global" else scans.start(side) for side in SIDES]
    left, right = (0.0 if side is None else ratio for side in sides)
    scanning = Scanning(
        scan=sides[0] or "top",  # pyrefly: ignore[bad-argument-type]
        right_scan=sides[1],  # pyrefly: ignore[bad-argument-type]
        right_delay=delay,
        right_readout_ratio=None if right * right_share == left else right * right_share,
    )
    return rig.shutter_of(scanning, left)


def line_of(scans: Scans, side: Side) -> FloatArray:
    """(3,) readout time of a camera's pixels for a ratio of 1: constant, slope per width, slope per height."""
    return np.array(_LINES[scans.start(side)])


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One assumption about how the cameras read and how the rig moves."""

    scans: Scans
    motion_model: str
    delayed: bool = False
    """Whether the right camera's delay is a free unknown."""

    @property
    def accelerations(self) -> tuple[float, ...]:
        """Values of k at which fits start. When all started at 0, two of eighteen rigs that turned by 6 deg and
        slowed down were estimated as moving in reverse."""
        return (0.0, -0.3, 0.3) if self.motion_model == "accelerated" else (0.0,)


@dataclass(frozen=True, kw_only=True)
class KnownInputs:
    """What the caller knows about a capture; None: the value is estimated."""

    readout_ratio: float | None = None
    scanning: Scanning | None = None
    """Scan of each camera, delay and ratio of the right one."""
    calibration: tuple[float, ...] | None = None
    """Calibration errors, see ``calibration.TERMS``."""
    sigma: CardSigma = field(default_factory=CardSigma)
    """Standard deviations of the rig's focal length and k1; a value with 0 is exact."""
    models: tuple[str, ...] = MODELS

    @classmethod
    def of(cls, shutter: RollingShutter) -> KnownInputs:
        """The inputs for a known shutter."""
        return cls(readout_ratio=shutter.readout_ratio, scanning=shutter.scanning)

    @property
    def reading(self) -> Scanning:
        """The given scanning; without one, both cameras read rows from the top."""
        return self.scanning or Scanning()

    def shutter_of(self, rig: StereoRig) -> RollingShutter:
        """The shutter with the given readout ratio; ValueError if none is given."""
        if self.readout_ratio is None:
            raise ValueError("readout_ratio: must be given")
        return rig.shutter_of(self.reading, self.readout_ratio)


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known about a capture before its matches are fitted; None: the value is estimated."""

    ratio: float | None = None
    """Readout ratio of the left camera, or of the right one if only that one has a rolling shutter."""
    right_share: float = 1.0
    """Readout ratio of the right camera divided by that of the left one, if both have a rolling shutter."""
    scans: tuple[Scans, ...] = ALL_SCANS
    """The scans that are compared."""
    delay: float | None = None
    """Delay of the right camera, frame periods."""
    calibration: tuple[float, ...] = NO_ERRORS
    """Calibration errors, see ``calibration.TERMS``."""
    calibration_sigma: tuple[float, ...] = NO_ERRORS
    """Prior standard deviation of each calibration error about 0; 0: the error is known."""
    models: tuple[str, ...] = MODELS

    def with_shutter(self, shutter: RollingShutter) -> Known:
        """The same knowledge plus that of the whole shutter."""
        left, right = (shutter.ratio_of(side) for side in SIDES)
        return replace(
            self,
            ratio=left or right,
            right_share=right / left if left * right > 0.0 else 1.0,
            scans=(scans_of(shutter),),
            delay=shutter.right_delay,
        )

    def shutter(self, rig: StereoRig) -> RollingShutter | None:
        """The shutter if it is known (``shutter_known``), else None."""
        if self.ratio is None or not self.shutter_known:
            return None
        return shutter_under(self.scans[0], self.ratio, rig, self.delay or 0.0, self.right_share)

    def prior(self, hypothesis: Hypothesis) -> FloatArray:
        """(17,) prior standard deviations of the unknowns, as ``CaptureCost`` takes them."""
        ratio = np.inf if self.ratio is None and hypothesis.scans.rolls else 0.0
        delay = DELAY_SIGMA if hypothesis.delayed else 0.0
        acceleration = ACCELERATION_SIGMA if hypothesis.motion_model == "accelerated" else 0.0
        return np.array([ratio, delay, acceleration, *self.calibration_sigma])

    def start(self, hypothesis: Hypothesis, ratio: float, delay: float) -> FloatArray:
        """(17,) unknowns at which the fit of a hypothesis starts; ``ratio`` and ``delay`` are used if unknown."""
        out = np.zeros(UNKNOWNS)
        if hypothesis.scans.rolls:
            out[RATIO] = ratio if self.ratio is None else self.ratio
        out[DELAY] = delay if hypothesis.delayed else self.delay or 0.0
        out[CALIBRATION] = self.calibration
        return out

    @property
    def shutter_known(self) -> bool:
        """Whether the shutter is known, so that only the motion and its model are estimated."""
        return len(self.scans) == 1 and self.ratio is not None and self.delay is not None

    @property
    def delays(self) -> tuple[bool, ...]:
        """The values of ``Hypothesis.delayed`` that are compared."""
        return (False, True) if self.delay is None else (False,)


_Masks = tuple[BoolArray, BoolArray]
"""Masks (n,) over the pairs and (m,) over the tracks."""


class _Ends(NamedTuple):
    """A value per image point: (n, 2, ...) of pairs; (m, 4, ...) of tracks: left 0, right 0, left 1, right 1."""

    pairs: FloatArray
    tracks: FloatArray

    def only(self, chosen: _Masks) -> _Ends:
        return _Ends(self.pairs[chosen[0]], self.tracks[chosen[1]])


class TimedMatches:
    """Matches for which the readout times under any scans can be computed.

    Each image point has its own time under all scans, so that all are compared by the same errors.

    Args:
        right_share: see ``Known``.
    """

    def __init__(
        self, matches: Correspondences, rig: StereoRig, motion_model: str = "linear", right_share: float = 1.0
    ) -> None:
        packs = {scan: pack(matches, rig, _distinct_times(rig, scan), motion_model) for scan in get_args(Scan)}
        self._base = base = next(iter(packs.values()))
        self.left: BoolArray = base.pairs[:, 6] >= 0.0
        """(n,) whether a pair belongs to the left camera."""
        late = np.where(self.left, 0.0, 1.0)[:, None]
        pairs, tracks = np.where(self.left, 1.0, right_share)[:, None], np.array([[1.0], [right_share]] * 2)
        self._times: dict[Start, tuple[_Ends, _Ends]] = {
            scan: (
                _Ends(
                    pairs * (each.pairs[:, 4:6] - _FRAMES - late),
                    tracks[:, 0] * (each.tracks[:, :, 2] - (0.0, 1.0, 1.0, 2.0)),
                ),
                _Ends(pairs * each.pairs[:, 15:17], tracks * each.tracks[:, :, 7:9]),
            )
            for scan, each in packs.items()
        }
        """For a ratio of 1: times of the points after their frame begins, and the derivatives by the pixel."""
        times, slopes = (_Ends(*map(np.zeros_like, each)) for each in self._times["top"])
        self._times["global"] = times, slopes
        self.count = len(base.pairs) + len(base.tracks)
        """Number of measurements: the pairs that are not part of a track come first, then the tracks."""
        sets = [getattr(matches, side)[unlinked_pairs(matches, side)] for side in SIDES]
        self.pixels: FloatArray = np.concatenate([*(each[:, :2] for each in sets), matches.tracks[:, :2]])
        """(count, 2) pixel of each measurement in frame 0."""
        lens, rays = rig.camera.lens, _Ends(base.pairs[:, :4].reshape(-1, 2, 2), base.tracks[:, :, :2])
        either = [ray_shifts(rays.pairs, side, float(base.focal[0]), lens) for side in SIDES]
        four = [ray_shifts(rays.tracks[:, k], SIDES[k % 2], float(base.focal[0]), lens) for k in range(4)]
        shifts = np.where(self.left[:, None, None, None], *either), np.stack(four, axis=1)
        self._shifts = _Ends(*(np.ascontiguousarray(each.swapaxes(2, 3)) for each in shifts))
        """(n, 2, 2, 14) and (m, 4, 2, 14): ``ray_shifts`` with the errors as the last axis."""
        self._stretches = _Ends(*(ray_stretches(each, lens) for each in rays))
        """(n, 2, 2, 2, 2) and (m, 4, 2, 2, 2), see ``ray_stretches``."""

    def under(self, motion_model: str) -> TimedMatches:
        """The same matches under another motion model."""
        other = copy.copy(self)
        other._base = replace(self._base, kernel=load_kernel(motion_model))
        return other

    def read(self, scans: Scans, chosen: BoolArray | None = None) -> ReadMatches:
        """The matches selected by a mask (count,), by default all, with their times under the scans."""
        chosen = np.ones(self.count, dtype=np.bool_) if chosen is None else chosen
        pairs, tracks = np.split(chosen, [len(self._base.pairs)])
        masks, is_left, of_left = (pairs, tracks), self.left[pairs], np.array([True, False, True, False])
        (left, left_slopes), (right, right_slopes) = (
            [each.only(masks) for each in self._times[scans.start(side)]] for side in SIDES
        )
        times = _Ends(
            np.where(is_left[:, None], left.pairs, right.pairs), np.where(of_left, left.tracks, right.tracks)
        )
        slopes = _Ends(
            np.where(is_left[:, None], left_slopes.pairs, right_slopes.pairs),
            np.where(of_left[:, None], left_slopes.tracks, right_slopes.tracks),
        )
        optics = self._shifts.only(masks), self._stretches.only(masks)
        return ReadMatches(self._base.only(chosen), is_left, (times, slopes), optics)

    def packed(self, scans: Scans, unknowns: FloatArray) -> Packed:
        """All measurements with their times under the scans, see ``ReadMatches.packed``."""
        return self.read(scans).packed(unknowns)

    def kernel(self, unknowns: FloatArray) -> MotionKernel:
        """The kernel of the motion model, with the acceleration from the unknowns (17,)."""
        return _accelerated(self._base.kernel, float(unknowns[ACCELERATION]))


class ReadMatches:
    """Matches with their times under given scans, as a function of the unknowns of the capture."""

    def __init__(
        self, base: Packed, left: BoolArray, times: tuple[_Ends, _Ends], optics: tuple[_Ends, _Ends]
    ) -> None:
        self._base, (self._times, self._slopes), (self._shifts, self._stretches) = base, times, optics
        self.count = len(base.pairs) + len(base.tracks)
        self._late = np.where(left, 0.0, 1.0)[:, None]
        """(n, 1) 1 for pairs of the right camera, 0 for those of the left one."""
        self._constant: tuple[list[int], FloatArray, FloatArray] | None = None

    def packed(self, unknowns: FloatArray) -> Packed:
        """The measurements for given unknowns.

        Args:
            unknowns: (17,) readout ratio; delay of the right camera, frame periods; acceleration of the motion,
                0 for a model without one; calibration errors.
        """
        ratio, delay, acceleration, *errors = map(float, unknowns)
        pairs, tracks = self._base.pairs.copy(), self._base.tracks.copy()
        pairs[:, 4:6] = _FRAMES + delay * self._late + ratio * self._times.pairs
        pairs[:, 15:17] = ratio * self._slopes.pairs
        tracks[:, :, 2] = _FRAMES_OF_TRACKS + delay * _LATE_OF_TRACKS + ratio * self._times.tracks
        tracks[:, :, 7:9] = ratio * self._slopes.tracks
        if any(errors):
            pairs[:, :4] -= (self._shifts.pairs @ errors).reshape(-1, 4)
            tracks[:, :, :2] -= self._shifts.tracks @ errors
        if any(stretching := [errors[term] for term in STRETCHING]):
            ends = self._stretched(pairs[:, 7:15].reshape(-1, 2, 4), self._stretches.pairs, stretching)
            pairs[:, 7:15] = ends.reshape(-1, 8)
            tracks[:, :, 3:7] = self._stretched(tracks[:, :, 3:7], self._stretches.tracks, stretching)
        kernel = _accelerated(self._base.kernel, acceleration)
        return replace(self._base, pairs=pairs, tracks=tracks, h=0.0, kernel=kernel)

    def _stretched(self, by_pixel: FloatArray, stretches: FloatArray, errors: list[float]) -> FloatArray:
        """Derivatives (n, k, 4) of the ideal pixels by the pixels, where the rays' shifts vary over the image."""
        fx, fy = self._base.focal
        by_ray = np.eye(2) - np.einsum("k,...kij->...ij", errors, stretches)
        by_ray = by_ray * [[1.0, fx / fy], [fy / fx, 1.0]]
        return np.asarray((by_ray @ by_pixel.reshape(*by_pixel.shape[:-1], 2, 2)).reshape(by_pixel.shape))

    def derivatives(self, packed: Packed, acceleration: float, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Derivatives of rays and times by k free unknowns: (n, 2, k, 3) for pairs, (m, 4, k, 3) for tracks.

        The acceleration changes all times: the motion is evaluated at beta(tau), see ``AcceleratedKernel``. The
        next call may overwrite the returned arrays.
        """
        if self._constant is None or self._constant[0] != free:
            self._constant = (free, *self._constant_derivatives(free))
        _, pairs, tracks = self._constant
        if ACCELERATION in free:
            k = free.index(ACCELERATION)
            for by, tau in ((pairs, packed.pairs[:, 4:6]), (tracks, packed.tracks[:, :, 2])):
                by[:, :, k, 2] = (tau**2 - tau) / ((2.0 + acceleration) * (1.0 + acceleration * tau))
        return pairs, tracks

    def _constant_derivatives(self, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """The derivatives by the free unknowns, 0 for the acceleration."""
        pairs = np.zeros((len(self._base.pairs), 2, len(free), 3))
        tracks = np.zeros((len(self._base.tracks), 4, len(free), 3))
        for k, unknown in enumerate(free):
            if unknown >= CALIBRATION.start:
                pairs[:, :, k, :2] = -self._shifts.pairs[..., unknown - CALIBRATION.start]
                tracks[:, :, k, :2] = -self._shifts.tracks[..., unknown - CALIBRATION.start]
            elif unknown == RATIO:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._times
            elif unknown == DELAY:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._late, _LATE_OF_TRACKS
        return pairs, tracks


def _accelerated(kernel: MotionKernel, acceleration: float) -> MotionKernel:
    return AcceleratedKernel(acceleration=acceleration) if isinstance(kernel, AcceleratedKernel) else kernel


def _distinct_times(rig: StereoRig, scan: Scan) -> RollingShutter:
    """Both cameras read alike, the right one a frame period later: all points of a match have different times."""
    return rig.shutter_of(Scanning(scan=scan, right_delay=1.0), 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """The measurements that are used, and the distribution of their errors (``heavy_tailed``)."""

    nu: float
    scale: float
    """px."""
    chosen: BoolArray
    """(n + m,) which of the pairs and tracks are used."""
    trust: FloatArray | None = None
    """Weights of the used measurements; None: 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CaptureFit:
    """The best parameters under one hypothesis."""

    hypothesis: Hypothesis
    theta: FloatArray
    """(6,) motion parameters."""
    unknowns: FloatArray
    """(17,), in the order of ``RATIO``, ``DELAY``, ``ACCELERATION``, ``CALIBRATION``."""
    cost: float
    """Negative logarithm of likelihood times prior, multiplied by the squared scale, px^2."""
    sigma: FloatArray
    """(17,) standard deviations of the unknowns; 0 for a ratio that was fixed."""
    spread: FloatArray
    """(6, 6) part of the covariance of theta that the uncertain unknowns cause, except a fixed ratio."""
    occam: float
    """Logarithm of posterior over prior volume of all free unknowns but the ratio (Occam factor)."""


class CaptureCost:
    """The cost of one hypothesis as a function of the motion and the unknowns.

    Args:
        prior: (17,) standard deviations of the unknowns about 0; 0: the unknown is fixed; infinity: no prior.
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

    def _squares(self, theta: FloatArray, unknowns: FloatArray) -> tuple[HeavyTailed, FloatArray]:
        """The measurements for given unknowns (17,), and their squared errors (n,), px^2."""
        packed, likelihood = self._matches.packed(unknowns), self.likelihood
        tailed = HeavyTailed(**vars(packed), nu=likelihood.nu, scale=likelihood.scale, trust=self._trust)
        return tailed, np.concatenate([tailed.pair_residuals(theta) ** 2, tailed.track_squares(theta)])

    def each(self, theta: FloatArray, unknowns: FloatArray) -> FloatArray:
        """(n,) contribution of each measurement to the cost, px^2."""
        tailed, squares = self._squares(theta, unknowns)
        factor = 0.5 * tailed.scale**2 * tailed.trust * (tailed.nu + tailed.freedom)
        return np.asarray(factor * np.log1p(squares / (tailed.nu * tailed.scale**2)))

    def typical_error(self, theta: FloatArray, unknowns: FloatArray) -> float:
        """Scale of the errors, px, from their median, which tolerates up to half of wrong matches."""
        tailed, squares = self._squares(theta, unknowns)
        return max(float(np.sqrt(np.median(squares / tailed.freedom) / _MEDIAN)), LEAST_SCALE_PX)

    def __call__(self, theta: FloatArray, unknowns: FloatArray) -> float:
        return float(np.sum(self.each(theta, unknowns))) + 0.5 * float(self._weight @ unknowns**2)

    def local(
        self, theta: FloatArray, unknowns: FloatArray, free: list[int]
    ) -> tuple[float, FloatArray, FloatArray]:
        """The cost, and its gradient and Hessian with respect to theta and the free unknowns."""
        packed, size = self._matches.packed(unknowns), _MOTION + len(free)
        by = self._matches.derivatives(packed, float(unknowns[ACCELERATION]), free)
        tails, trust = np.array([self.likelihood.nu, self.likelihood.scale]), self._trust
        gradient, H, n = np.zeros(size), np.zeros((size, size)), len(packed.pairs)
        at, focal, baseline = (theta, any_law(packed.kernel)), packed.focal, packed.baseline
        cost = add_pairs(*at, packed.pairs, by[0], focal, tails, trust[:n], gradient, H)
        cost += add_tracks(*at, packed.tracks, by[1], focal, baseline, tails, trust[n:], gradient, H)
        for unknown in set(_STRETCHING) & set(free):  # these also scale the conversion from rays to pixels
            ahead = float(np.sum(self.each(theta, unknowns + _STEP * np.eye(UNKNOWNS)[unknown])))
            gradient[_MOTION + free.index(unknown)] = (ahead - cost) / _STEP  # moves the minimum by half a step
        gradient[_MOTION:] += self._weight[free] * unknowns[free]
        H[range(_MOTION, size), range(_MOTION, size)] += self._weight[free]
        return cost + 0.5 * float(self._weight @ unknowns**2), gradient, H


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    """A point of a descent: the parameters, and the cost with its derivatives by theta and the free unknowns."""

    theta: FloatArray
    unknowns: FloatArray
    cost: float
    gradient: FloatArray
    H: FloatArray
    free: list[int]

    @cached_property
    def _newton(self) -> tuple[BoolArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Mask of parameters that may move (unknowns at a limit may not); their scales; eigenvalues and vectors
        of the scaled Hessian; the gradient in that eigenbasis."""
        out, outwards = self.unknowns[self.free], -self.gradient[_MOTION:]
        at_limit = (out <= _LOWER[self.free]) & (outwards < 0.0) | (out >= _UPPER[self.free]) & (outwards > 0.0)
        moves = np.concatenate([np.ones(_MOTION, dtype=np.bool_), ~at_limit])
        A, g = self.H[np.ix_(moves, moves)], self.gradient[moves]
        size = np.sqrt(np.maximum(np.abs(np.diagonal(A)), 1e-12 * np.abs(A).max()) + 1e-300)
        values, vectors = np.linalg.eigh(A / np.outer(size, size))
        values = np.maximum(np.abs(values), 1e-9)  # so that the step decreases the cost at any curvature
        return moves, size, values, vectors, vectors.T @ (g / size)

    @property
    def gain(self) -> float:
        """Decrease of the cost by a full Newton step if the cost were quadratic."""
        _, _, values, _, slopes = self._newton
        return 0.5 * float(np.sum(slopes**2 / values))

    def stepped(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Parameters after a damped step."""
        moves, size, values, vectors, slopes = self._newton
        step = np.zeros(len(moves))
        step[moves] = -(vectors @ (slopes / (values + damping))) / size
        theta, unknowns, free = self.theta + step[:_MOTION], self.unknowns.copy(), self.free
        unknowns[free] += np.clip(step[_MOTION:], -_LARGEST_STEP[free], _LARGEST_STEP[free])
        length = float(np.linalg.norm(theta[3:]))
        theta[3:] *= min(1.0, _MAX_TRANSLATION_M / max(length, _MAX_TRANSLATION_M))
        return theta, _within(unknowns, free)


@dataclass(frozen=True)
class _Problem:
    """A ``CaptureCost`` as a function of theta and the free unknowns, in the form that ``descend`` takes."""

    cost: CaptureCost
    free: list[int]
    still: float
    hopeless: float

    def place(self, theta: FloatArray, unknowns: FloatArray) -> _Place:
        now, gradient, H = self.cost.local(theta, unknowns, self.free)
        return _Place(theta=theta, unknowns=unknowns, cost=now, gradient=gradient, H=H, free=self.free)

    def stepped(self, here: _Place, damping: float) -> _Place | None:
        if here.cost - _EXPECTED_GAIN * here.gain > self.hopeless:
            return None
        there = self.place(*here.stepped(damping))
        return there if there.cost <= here.cost else None

    def settled(self, before: _Place, after: _Place) -> bool:
        return before.cost - after.cost < self.still * self.cost.likelihood.scale**2


def fit_capture(
    cost: CaptureCost,
    theta: FloatArray,
    unknowns: FloatArray,
    *,
    iterations: int = 20,
    still: float = 1e-4,
    fix_ratio: bool = False,
    hopeless: float = np.inf,
) -> CaptureFit:
    """Minimise the cost by a damped Newton method that starts at theta (6,) and unknowns (17,).

    Args:
        still: the descent stops when a step decreases the cost by less than this times the squared error scale.
        fix_ratio: whether the readout ratio keeps its start value.
        hopeless: the descent stops when the cost is not expected to fall below this.
    """
    free = [k for k in cost.free if k != RATIO or not fix_ratio]
    problem = _Problem(cost, free, still, hopeless)
    found = descend(problem, problem.place(theta, _within(unknowns, free)), iterations, _DAMPING)
    sigma = np.zeros(UNKNOWNS)
    whole = cost.likelihood.scale**2 * np.linalg.pinv(found.H, hermitian=True)
    covariance, shared = whole[_MOTION:, _MOTION:], whole[:_MOTION, _MOTION:]
    sigma[free] = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    others = [k for k, j in enumerate(free) if j != RATIO]
    values = np.linalg.eigvalsh(covariance[np.ix_(others, others)]) if others else np.zeros(0)
    volume = 0.5 * float(np.sum(np.log(np.maximum(values, 1e-30))))
    return CaptureFit(
        hypothesis=cost.hypothesis,
        theta=found.theta,
        unknowns=found.unknowns,
        cost=found.cost,
        sigma=sigma,
        spread=shared @ np.linalg.pinv(covariance, hermitian=True) @ shared.T,
        occam=volume - float(np.sum(np.log(cost.prior[[free[k] for k in others]]))),
    )


def _within(unknowns: FloatArray, free: list[int]) -> FloatArray:
    """The unknowns (17,) with the free ones clipped to their limits."""
    out = unknowns.copy()
    out[free] = np.clip(unknowns[free], _LOWER[free], _UPPER[free])
    return out
