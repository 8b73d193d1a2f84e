"""Fit the spline of largest posterior probability by robust Levenberg-Marquardt steps on banded normal equations.

The fit starts from the motions of the windows, chained (``first_curve``). Scale and tails of the errors are
estimated with the spline by maximum likelihood; the prior's variances, the knot interval and the kind of prior
(``choose``) by maximum evidence (D. MacKay, Bayesian interpolation, Neural Computation 1992).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rsbench.capture.trajectory_gyro import (
    Border,
    Drift,
    Sensed,
    border_of,
    bordered_inverse,
    bordered_step,
    eliminated,
    first_drift,
    learned,
    sensed,
)
from rsbench.capture.trajectory_spline import (
    ContinuousMotion,
    Curve,
    NotDefiniteError,
    Prior,
    Roughness,
    anchors,
    approximated,
    band_factor,
    band_inner,
    band_log_determinant,
    band_solve,
    control_count,
    evaluate,
    from_pose_at,
    log_prior,
    make_curve,
    moved,
    roughness,
)
from rsbench.capture.trajectory_tracks import (
    LEAST_SCALE_PX,
    REACH,
    Past,
    Tails,
    TimedTracks,
    add_tracks,
    blank_shared,
    inverse_depths,
    is_of_one_camera,
    observed,
    thinned,
)
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.levenberg_marquardt import Damping, descend
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

NORMAL = 1e9
"""Degrees of freedom at which a t distribution is practically normal."""
_ROUNDS, _STEPS_A_ROUND, _LAST_STEPS = 15, 2, 10
_FLAT, _FLAT_VARIANCE, _FLAT_EVIDENCE = 0.01, 0.05, 0.1
_FLAT_COST, _NEAR = 1e-3, 1.0
_MANY = 300
"""With this many tracks, two threads are faster than one."""
_LEAST_WIDTH = 5
"""Number of control poses that one term of the prior, or one gyroscope sample, depends on."""
ANCHORED = 1e4
"""Precision of the pose at time 0 divided by that of the most certain control pose."""
_ROUNDING = 1e-15
"""Precision of all poses of one camera divided by that of the most certain one."""
_FEWEST = 2.0
"""Number of accelerations that the tracks must determine before the prior's variance is estimated."""
_LIMITS = (1e-10, 1e2)
"""Smallest and largest variance of accelerations, far beyond those of hand-carried cameras."""
DAMPING = Damping(least=0.0, first=1e-6, largest=3e8, dropped=1e-6)
_SOME = 250
"""Approximate number of tracks per window from which the first motions are estimated."""
SHORT = 0.03
"""Length at the start of one camera's translations, whose scale is unknown: a hand's, in metres, as the prior's
start variance is in metres too. With a length of 1, that variance was never adapted to the large accelerations,
and errors were 0.28 px instead of 0.05."""
_WEAKEST = 100.0
"""Least precision of poses in the evidence: nothing else bounds the scale of one camera's uniform translation, and
a precision of 0.1 would hardly do so at the length ``SHORT``."""
_SUSPECT = 4.0
"""A window's own motion is wrong if its error is this many times that of the motion of its neighbours."""
_TRIED, _TRIED_KNOTS, _STEPS_TRIED, _STEPS_ADDED, _TRIED_TAILS = 4, 0.5, 12, 3, Tails(3.0, 0.3)
"""Number of windows in which directions of one camera's translation are tried, the knots and steps of that, the
steps for each further window, and the error distribution."""
_WALLS = 4
"""Most times at which a trajectory is tried with all later translations negated, and most such changes."""
_ONE_SIGN = 0.95
"""Mean sign of the inverse depths below which a fit may be a local minimum, and other starts are tried."""
_DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], float)
"""(n, 3) axes and diagonals; their opposites are as good."""
MEMORIES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Candidates for ``Prior.memory``, frame periods."""
_PRECISION = 1e12
_LEAST_GAIN = 1.0
"""Least gain in the logarithm of evidence for which another prior or knot interval is chosen."""


class Equations(NamedTuple):
    """Normal equations of the fit, linearised at a spline."""

    cost: float
    """Negative logarithm of likelihood times prior, up to constants."""
    gradient: FloatArray
    band: FloatArray
    """Normal matrix without ``anchors``."""
    squares: FloatArray
    """(n,) squared errors of the tracks, px^2."""
    rough: Roughness
    sensed: Sensed | None = None
    """The part of a gyroscope's samples."""
    border: Border | None = None
    """The part of a gyroscope's errors, or of unknowns that all observations share."""

    @property
    def slope(self) -> FloatArray:
        """Gradient by all unknowns, including the gyroscope's errors."""
        return self.gradient if self.border is None else np.concatenate([self.gradient, self.border.slope])


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A fitted spline with its error distribution and prior."""

    curve: Curve
    tails: Tails
    prior: Prior
    trust: FloatArray
    """(n,) 1 for inlier tracks, 0 for outliers."""
    equations: Equations
    drift: Drift | None = None
    """Errors of a gyroscope."""


def width_of(tracks: TimedTracks, curve: Curve) -> int:
    """Width of the band: number of unknowns that one track, term of the prior or ``Past`` couples."""
    last = len(curve.p) - 4
    places = [np.clip(np.floor((tau - curve.first) / curve.interval), 0, last) for tau in tracks.span]
    known = 0 if tracks.past is None else len(tracks.past.p)
    return 6 * max(int(np.max(places[1] - places[0], initial=0)) + 4, _LEAST_WIDTH, known)


def normal_equations(
    curve: Curve,
    tracks: TimedTracks,
    tails: Tails,
    prior: Prior,
    trust: FloatArray,
    want: bool = True,
    until: int | None = None,
    drift: Drift | None = None,
) -> Equations:
    """The normal equations at a spline, for given error distribution and prior.

    Args:
        until: only terms of the prior that begin before the control pose of this number are added.
        drift: errors of the gyroscope, if the tracks have one.
    """
    n, past = len(curve.p), tracks.past
    width = width_of(tracks, curve)
    band, gradient, squares = np.zeros((6 * n, width)), np.zeros(6 * n), np.zeros(len(trust))
    shared = blank_shared(n, tracks.by_ratio is not None)
    cost = _add_in_threads(curve, tracks, tails, tracks.share * trust, (squares, band, gradient, shared), want)
    rough = roughness(curve, prior.memory, prior.smooth, width, past is None, until)
    for kind, strength in enumerate((prior.rotation, prior.position)):
        cost += 0.5 * rough.squares[kind] / strength
        gradient += rough.gradients[kind] / strength
        band += rough.bands[kind] / strength
    found, border = None, None if tracks.by_ratio is None else shared
    if tracks.gyro is not None and drift is not None:
        found = sensed(curve, tracks.gyro, drift, width)
        gradient += found.gradient / drift.variance
        band += found.band / drift.variance
        more, border = border_of(found, drift, past is None)
        cost += more
    if past is not None:
        cost += _add_past(past, curve, gradient, band, border, drift)
    return Equations(cost, gradient, band, squares, rough, found, border)


def _add_in_threads(
    curve: Curve,
    tracks: TimedTracks,
    tails: Tails,
    trust: FloatArray,
    out: tuple[FloatArray, FloatArray, FloatArray, Border],
    want: bool,
) -> float:
    """``add_tracks``; many tracks run as two halves in threads, on all machines, so that sums are identical."""
    starts, middle, same = tracks.starts, len(trust) // 2, (tracks.focal, tails)
    by_ratio = np.zeros((0, 3)) if tracks.by_ratio is None else tracks.by_ratio
    if len(trust) < _MANY:
        return add_tracks(curve, tracks.ends, starts, *same, trust, *out, by_ratio, want)
    squares, band, gradient, shared = out
    later = np.zeros_like(band), np.zeros_like(gradient), Border(*map(np.zeros_like, shared))
    half = curve, tracks.ends, starts[middle:], *same, trust[middle:], squares[middle:]
    other = _pool(os.getpid()).submit(add_tracks, *half, *later, by_ratio, want)
    half = trust[:middle], squares[:middle], band, gradient, shared, by_ratio, want
    cost = add_tracks(curve, tracks.ends, starts[: middle + 1], *same, *half)
    cost += other.result()
    for whole, part in zip((band, gradient, *shared), (*later[:2], *later[2]), strict=True):
        whole += part
    return cost


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of a process that wait for work, as starting one takes as long as a tenth of the equations."""
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix=f"tracks-{process}")


def _add_past(
    past: Past, curve: Curve, gradient: FloatArray, band: FloatArray, border: Border | None, drift: Drift | None
) -> float:
    """Add the quadratic cost of marginalised windows to the equations; returns the cost."""
    k = len(past.p)
    turned = so3.log(curve.R[:k] @ np.swapaxes(past.R, 1, 2))
    away = np.concatenate([turned, curve.p[:k] - past.p], axis=1).ravel()
    if border is not None and drift is not None and past.errors is not None:
        away = np.concatenate([away, drift.errors - past.errors])
        border.mixed[: 6 * k] += past.H[: 6 * k, 6 * k :]
        border.corner[...] += past.H[6 * k :, 6 * k :]
        border.slope[...] += past.H[6 * k :] @ away + past.gradient[6 * k :]
    slope = past.H @ away
    gradient[: 6 * k] += (slope + past.gradient)[: 6 * k]
    for i in range(6 * k):
        band[: 6 * k - i, i] += np.diagonal(past.H[: 6 * k, : 6 * k], -i)
    return float(away @ (0.5 * slope + past.gradient))


def anchored(equations: Equations, curve: Curve, tracks: TimedTracks, certain: float) -> FloatArray:
    """The normal matrix, a band; without marginalised windows, the pose at time 0 is fixed as the origin.

    One camera does not determine the scale of its translation, and the prior hardly bounds it: rounding could make
    the matrix indefinite, so that all poses get a precision above rounding errors.

    Args:
        certain: precision of that pose divided by that of the most certain control pose.
    """
    band = equations.band
    if tracks.past is not None:
        return band
    largest = float(np.max(band[:, 0]))
    out = band + anchors(curve, band.shape[1], certain * largest)
    if not np.any(tracks.ends[:, 9]):
        out[:, 0] += _ROUNDING * largest
    return out


def covariance_band(found: Fit, tracks: TimedTracks, share: float = 1.0) -> FloatArray:
    """Covariance of the control poses, in its band, from the expected information; the pose at time 0 is fixed.

    Args:
        share: weight of a track relative to the prior, in place of its weight in the fit.

    Raises:
        NotDefiniteError: the tracks do not determine the spline.
    """
    each = replace(tracks, share=share)
    equations = expected_equations(found.curve, each, found.tails, found.prior, found.trust, found.drift)
    return bordered_inverse(band_factor(anchored(equations, found.curve, tracks, ANCHORED)), equations.border)


def expected_equations(
    curve: Curve, tracks: TimedTracks, tails: Tails, prior: Prior, trust: FloatArray, drift: Drift | None = None
) -> Equations:
    """``normal_equations`` with the expected information in place of the observed one."""
    # Weights of a t distribution: K. Lange, R. Little, J. Taylor, see ``packed.HeavyTailed``.
    expected = trust * (tails.nu + tracks.freedom) / (tails.nu + tracks.freedom + 2.0)
    return normal_equations(curve, tracks, Tails(NORMAL, tails.scale), prior, expected, drift=drift)


def log_evidence(found: Fit, precision: float) -> float:
    """Logarithm of the marginal likelihood of the tracks (Laplace's approximation), up to constants.

    It compares fits to the same tracks under the same error distribution, with different knots or priors.

    Args:
        precision: precision of the pose at time 0, which must be the same for all compared fits.
    """
    curve, equations = found.curve, found.equations
    anchor = anchors(curve, equations.band.shape[1], precision)
    anchor[:, 0] += _WEAKEST
    lower = band_factor(equations.band + anchor)
    after = band_log_determinant(lower)
    if equations.border is not None:
        after += eliminated(lower, equations.border).log_determinant
    if equations.sensed is not None and found.drift is not None:
        after += equations.sensed.count * float(np.log(found.drift.variance))
    return log_prior(curve, found.prior, equations.rough) - 0.5 * after - equations.cost


def squared_errors(curve: Curve, tracks: TimedTracks) -> FloatArray:
    """(n,) squared errors of the tracks at their best points, px^2."""
    squares, trust, nothing = *np.zeros((2, len(tracks))), np.zeros((1, width_of(tracks, curve)))
    of_tracks = tracks.ends, tracks.starts, tracks.focal, Tails(3.0, 1.0)
    unused = blank_shared(0, False), np.zeros((0, 3))
    add_tracks(curve, *of_tracks, trust, squares, nothing, np.zeros(1), *unused, False)
    return squares


def right_tracks(found: Fit, tracks: TimedTracks) -> FloatArray:
    """(n,) 1 for tracks that are inliers of a fit, which may be to other tracks, else 0."""
    reach = tracks.freedom * (REACH * found.tails.scale) ** 2
    return (squared_errors(found.curve, tracks) <= reach).astype(np.float64)


class _Place(NamedTuple):
    """A point of the descent."""

    curve: Curve
    drift: Drift | None
    equations: Equations
    predicted: float = 0.0
    """Decrease of the cost that was predicted for the last step."""


@dataclass(frozen=True)
class Descent:
    """The cost of a spline for a given error distribution and prior, in the form that ``descend`` takes.

    Steps with a small predicted decrease are always accepted: the equations treat the weights of pixels as
    constants, so their root is not exactly the minimum of the cost.
    """

    tracks: TimedTracks
    tails: Tails
    prior: Prior
    trust: FloatArray

    def place(self, curve: Curve, drift: Drift | None, predicted: float = 0.0) -> _Place:
        here = normal_equations(curve, self.tracks, self.tails, self.prior, self.trust, drift=drift)
        return _Place(curve, drift, here, predicted)

    def stepped(self, here: _Place, damping: float) -> _Place | None:
        equations, drift = here.equations, here.drift
        damped = anchored(equations, here.curve, self.tracks, 1.0).copy()
        damped[:, 0] += damping * equations.band[:, 0]
        try:
            lower = band_factor(damped)
            if equations.border is None:
                step = -band_solve(lower, equations.gradient)
            else:
                step = np.concatenate(bordered_step(lower, equations.gradient, equations.border))
        except NotDefiniteError:
            return None
        curve, predicted = moved(here.curve, step[: len(damped)]), -0.5 * float(step @ equations.slope)
        if self.tracks.past is None:
            curve = from_pose_at(curve, 0.0)
        there = self.place(curve, None if drift is None else drift.moved(step[len(damped) :]), predicted)
        near = damping == 0.0 and abs(predicted) < _NEAR
        return there if there.equations.cost <= equations.cost + (_NEAR if near else 0.0) else None

    def settled(self, before: _Place, after: _Place) -> bool:
        return after.predicted < _FLAT_COST

    def descended(self, curve: Curve, drift: Drift | None, steps: int) -> tuple[Curve, Equations, Drift | None]:
        """Descend until the predicted decrease of the cost is below a thousandth of a unit."""
        found = descend(self, self.place(curve, drift), steps, DAMPING)
        return found.curve, found.equations, found.drift


def fit(
    curve: Curve,
    tracks: TimedTracks,
    prior: Prior,
    learn: bool = True,
    tails: Tails | None = None,
    trust: FloatArray | None = None,
    drift: Drift | None = None,
) -> Fit:
    """Fit the spline and the error distribution from a start nearby, and with ``learn`` the prior's variances.

    Args:
        trust: if given, ``tails`` and ``trust`` stay fixed.
        drift: start values of the gyroscope's errors, if the tracks have one.
    """
    fixed = trust is not None
    trust = np.ones(len(tracks)) if trust is None else trust
    if tails is None:
        median = float(np.median(squared_errors(curve, tracks) / tracks.freedom))
        tails = Tails(3.0, max(float(np.sqrt(median)), LEAST_SCALE_PX))
    if tracks.gyro is not None and drift is None:
        drift = first_drift(curve, tracks.gyro)
    for _ in range(_ROUNDS):
        curve, here, drift = Descent(tracks, tails, prior, trust).descended(curve, drift, _STEPS_A_ROUND)
        last = variances(prior, drift)
        old, lower = tails.scale, band_factor(anchored(here, curve, tracks, ANCHORED))
        used, determined, better, drift = estimate_variances(here, lower, prior, drift)
        if not fixed:
            tails, trust = observed(here.squares, tracks.freedom, tails, used)
        prior = better if learn else prior
        change = np.abs(np.log(variances(prior, drift) / last))
        settling = (change > _FLAT_VARIANCE) & (change * determined > _FLAT_EVIDENCE)
        if abs(np.log(tails.scale / old)) < _FLAT and not np.any(settling):
            break
    curve, here, drift = Descent(tracks, tails, prior, trust).descended(curve, drift, _LAST_STEPS)
    return Fit(curve=curve, tails=tails, prior=prior, trust=trust, equations=here, drift=drift)


def variances(prior: Prior, drift: Drift | None) -> FloatArray:
    """(2 or 3,) variances that are estimated with the spline."""
    return np.array([prior.rotation, prior.position, *([] if drift is None else [drift.variance])])


def estimate_variances(
    here: Equations, lower: FloatArray, prior: Prior, drift: Drift | None
) -> tuple[float, FloatArray, Prior, Drift | None]:
    """Re-estimate the variances by evidence: returns the number of parameters that tracks determine, the numbers
    (2 or 3,) of accelerations and gyroscope errors that determine variances, the prior and the drift."""
    inverse, old = bordered_inverse(lower, here.border), np.array([prior.rotation, prior.position])
    tied = np.array([band_inner(inverse, band) for band in here.rough.bands]) / old
    determined = np.maximum(here.rough.count - tied, 1e-3)
    new = np.where(determined > _FEWEST, np.clip(here.rough.squares / determined, *_LIMITS), old)
    used = len(lower) - 6.0 - float(np.sum(tied))
    if here.sensed is not None and here.border is not None and drift is not None:
        own, left, drift = learned(here.sensed, drift, lower, inverse, here.border)
        used, determined = used + len(drift.errors) - own, np.append(determined, left)
    return used, determined, prior._replace(rotation=float(new[0]), position=float(new[1])), drift


# Start of the fit


def window_motions(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    seed: int,
    times: FloatArray | None = None,
) -> list[Motion | None]:
    """The paper's linear motion of each window, from some of its tracks; None if none is found.

    The unknown length of one camera's translation is set to ``SHORT`` per frame period.

    Args:
        times: (n + 1,) times of the frames' first lines, frame periods; None: 0, 1, 2, ... A motion has the time
            between its two frames as unit.
    """
    lengths = np.ones(len(windows)) if times is None else np.diff(times)
    alone = is_of_one_camera(windows)
    out, solver, unit = list[Motion | None](), RefinedSolver(one_camera=alone), SHORT if alone else 1.0
    for window, length in zip(thinned(windows, _SOME), lengths.tolist(), strict=True):
        rng, paced = np.random.default_rng(seed), shutter
        if length != 1.0:
            paced = shutter.with_ratio(min(shutter.readout_ratio / length, 1.0))
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            found = estimate_motion(window, rig, paced, solver, RobustOptions(), rng).estimate
        # If the disparities are negative, the opposite motion would explain them, with points beyond infinity.
        scale = unit * length if alone else -unit if _converges_too_little(window, rig) else unit
        out.append(LinearMotion(found.w, scale * found.d) if found.success else None)
    return out


def _converges_too_little(window: Correspondences, rig: StereoRig) -> bool:
    """Whether most disparities are negative: points far away, and cameras that converge less than calibrated."""
    left, right = (rig.eye(side).ideal_pixels(window.tracks[:, 2 * k : 2 * k + 2]) for k, side in enumerate(SIDES))
    return int(np.count_nonzero(left[:, 0] < right[:, 0])) > len(left) // 2


def first_curve(
    motions: Sequence[Motion | None],
    tracks: TimedTracks,
    span: tuple[float, float],
    interval: float,
    times: FloatArray | None = None,
) -> Curve:
    """The spline through the motions of the windows; missing and wrong ones are interpolated from neighbours.

    Args:
        span: times of the first and the last line.
        times: see ``window_motions``.
    """
    rates, known = _rates(motions)
    times = np.arange(len(rates) + 1.0) if times is None else times
    rates = rates / np.diff(times)[:, None]
    places = np.arange(len(rates))
    others = np.stack([_interpolated(rates, known & (places != k))[k] for k in places])
    both = _interpolated(rates, known), others
    own, bridged = (_spline_through(each, span, interval, times) for each in both)
    errors = []
    for curve in (own, bridged):
        chosen = [squared_errors(curve, tracks)[members] for members in tracks.members]
        errors.append(np.array([float(np.median(each)) if len(each) else 0.0 for each in chosen]))
    known &= ~(errors[0] > _SUSPECT * errors[1])
    return _spline_through(_interpolated(rates, known), span, interval, times)


def first_curve_of_camera(
    motions: Sequence[Motion | None],
    tracks: TimedTracks,
    span: tuple[float, float],
    interval: float,
    prior: Prior,
    times: FloatArray | None = None,
) -> Curve:
    """``first_curve`` for one camera, near the minimum of the cost.

    Motions of single windows, which assume a constant speed, are often so wrong that a fit from them ends in a
    local minimum. So several directions of translation are tried in some windows in the middle, and the best fit
    to these is extended to the other windows one by one: points that are seen again determine them. A trajectory
    with all translations and inverse depths negated fits as well, and a fit may pass from one into the other where
    the camera nearly stops: one side is then negated. If points are still on both sides of the camera, windows at
    the ends are tried as well. In the returned trajectory most points are in front of the camera.

    Args:
        tracks: tracks that extend over several windows.

    Raises:
        NotDefiniteError: the tracks do not determine the spline.
    """
    count = len(tracks.members)
    times = np.arange(count + 1.0) if times is None else times
    start = first_curve(motions, tracks, span, _TRIED_KNOTS, times)

    def fitted(curve: Curve, steps: int, first: int = 0, last: int = count) -> _Place:
        """The fit to the windows from ``first`` to before ``last``."""
        inside = np.ones(len(tracks), dtype=np.bool_)
        for own in (*tracks.members[:first], *tracks.members[last:]):
            inside[own] = False
        descent = Descent(tracks.only(inside), _TRIED_TAILS, prior, np.ones(np.count_nonzero(inside)))
        return descend(descent, descent.place(curve, None), steps, DAMPING)

    def extended(first: int) -> _Place:
        """The best direction in the windows from ``first`` on, extended to all windows."""
        last = min(first + _TRIED, count)
        places = [fitted(each, _STEPS_TRIED, first, last) for each in straight_curves(start, times[first])]
        curve = min(places, key=lambda each: each.equations.cost).curve
        while last - first < count:
            first, last = max(first - 1, 0), min(last + 1, count)
            curve = fitted(curve, _STEPS_ADDED, first, last).curve
        return fitted(curve, _STEPS_ADDED)

    def repaired(best: _Place) -> _Place:
        """The fit with all translations after some times negated, if that reduces the cost."""
        for _ in range(_WALLS):
            near = _signs(best.curve, tracks)
            walls = 1 + np.flatnonzero(near[:-1] * near[1:] < 0.0)
            others = [fitted(_mirrored(best.curve, times[wall]), _STEPS_TRIED) for wall in walls[:_WALLS]]
            other = min(others, key=lambda each: each.equations.cost, default=best)
            if other.equations.cost >= best.equations.cost:
                break
            best = other
        return best

    spare = max(count - _TRIED, 0)
    best = repaired(extended(spare // 2))
    if np.min(np.abs(_signs(best.curve, tracks))) < _ONE_SIGN:
        others = (repaired(extended(first)) for first in {0, spare} - {spare // 2})
        best = min([best, *others], key=lambda each: each.equations.cost)
    curve = best.curve
    if np.sum(_signs(curve, tracks)) < 0.0:
        curve = from_pose_at(make_curve(curve.first, curve.interval, curve.R, -curve.p), 0.0)
    return approximated(lambda tau: evaluate(curve, tau)[0], (curve.first, curve.last), interval)


def straight_curves(curve: Curve, start: float) -> list[Curve]:
    """Splines with the rotations of one, and uniform translations from a time on in several directions."""
    taus = curve.first + curve.interval * (np.arange(len(curve.p)) - 1.0) - start
    speeds = (
        SHORT * (_DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)) @ evaluate(curve, start)[0].R
    )
    return [make_curve(curve.first, curve.interval, curve.R, taus[:, None] * speed) for speed in speeds]


def _signs(curve: Curve, tracks: TimedTracks) -> FloatArray:
    """(n,) mean sign of the inverse depths in each window, -1 to 1, in which points far away count little."""
    rho = inverse_depths(curve, tracks.ends, tracks.starts, tracks.focal)
    most = 2.0 * float(np.median(np.abs(rho))) + 1e-300
    near = np.clip(rho, -most, most)
    return np.array([np.sum(near[own]) / (np.sum(np.abs(near[own])) + 1e-300) for own in tracks.members])


def _mirrored(curve: Curve, start: float) -> Curve:
    """The spline with all translations after a time negated."""
    taus = curve.first + curve.interval * (np.arange(len(curve.p)) - 1.0)
    middle = evaluate(curve, np.array([start]))[0]
    p = np.where(taus[:, None] > start, -2.0 * (middle.R[0].T @ middle.t[0]) - curve.p, curve.p)
    return make_curve(curve.first, curve.interval, curve.R, p)


def continued(curve: Curve, motions: Sequence[Motion | None], start: int, last: float) -> Curve:
    """The spline extended to time ``last`` along the motions of the windows from number ``start`` on."""
    rates, known = _rates(motions)
    if not np.any(known):
        rates, known = _rates([ContinuousMotion.of(curve).from_time(start - 1.0)])
    rates = _interpolated(rates, known)
    count = control_count(curve.first, last, curve.interval)
    taus = curve.first + curve.interval * (np.arange(count) - 1.0)
    steps = np.arange(len(rates) + 1.0)
    ahead = from_pose_at(_spline_through(rates, (0.0, max(last - start, 1.0)), curve.interval, steps), 0.0)
    own, later = evaluate(curve, taus)[0], evaluate(ahead, taus - start)[0]
    here = evaluate(curve, float(start))[0]
    R, p = curve.R, curve.p
    for k in range(len(p), count):
        far = taus[k] > start
        pose = compose(Pose(later.R[k], later.t[k]), here) if far else Pose(own.R[k], own.t[k])
        R, p = np.concatenate([R, pose.R[None]]), np.concatenate([p, -(pose.R.T @ pose.t)[None]])
    return make_curve(curve.first, curve.interval, R, p)


def _rates(motions: Sequence[Motion | None]) -> tuple[FloatArray, BoolArray]:
    """(n, 6) rates of rotation and translation, and a mask (n,) of known ones."""
    rates = np.array([[0.0] * 6 if motion is None else [*motion.w, *motion.d] for motion in motions])
    return rates, np.array([motion is not None for motion in motions])


def _interpolated(rates: FloatArray, known: BoolArray) -> FloatArray:
    """Rates (n, 6) with unknown ones interpolated; all 0 if none is known."""
    if not np.any(known):
        return np.zeros_like(rates)
    places = np.arange(len(rates))
    return np.stack([np.interp(places, places[known], column[known]) for column in rates.T], axis=1)


def _spline_through(rates: FloatArray, span: tuple[float, float], interval: float, times: FloatArray) -> Curve:
    """The spline through the poses that result from rates (n, 6) of rotation and translation between times."""
    motions, poses = [LinearMotion(rate[:3], rate[3:]) for rate in rates], [Pose(np.eye(3), np.zeros(3))]
    for motion, length in zip(motions, np.diff(times), strict=True):
        poses.append(compose(Pose(*motion.body_from_world(length)), poses[-1]))
    controls = []
    for tau in span[0] + interval * (np.arange(control_count(*span, interval)) - 1.0):
        k = int(np.clip(np.searchsorted(times, tau, side="right") - 1, 0, len(rates) - 1))
        controls.append(inverse(compose(motions[k].body_from_world(tau - times[k]), poses[k])))
    R = np.swapaxes(np.stack([each.R for each in controls]), 1, 2)
    return make_curve(span[0], interval, R, np.stack([each.t for each in controls]))


# Knots and kind of prior


def choose(found: Fit, tracks: TimedTracks, intervals: Sequence[float]) -> Fit:
    """Improve the evidence of a fit by changing the prior's memory, its smoothness, and the knot interval."""
    best, most = found, log_evidence(found, _PRECISION)

    def better(curve: Curve, memory: float, smooth: int) -> bool:
        """Whether another prior or knot interval has more evidence, with the same tails; it then becomes best."""
        nonlocal best, most
        prior = best.prior._replace(memory=memory, smooth=smooth)
        try:
            other = fit(curve, tracks, prior, tails=best.tails, trust=best.trust, drift=best.drift)
            evidence = log_evidence(other, _PRECISION)
        except NotDefiniteError:
            return False
        gained = evidence > most + _LEAST_GAIN
        if gained:
            best, most = other, evidence
        return gained

    start = int(np.argmin(np.abs(np.log(np.array(MEMORIES) / best.prior.memory))))
    for step in (-1, 1):
        place = start + step
        while 0 <= place < len(MEMORIES) and better(best.curve, MEMORIES[place], best.prior.smooth):
            place += step
        if place != start + step:
            break
    better(best.curve, best.prior.memory, 3 - best.prior.smooth)
    for interval in intervals:
        old = best.curve
        if abs(interval - old.interval) > 1e-9:
            curve = approximated(lambda tau: evaluate(old, tau)[0], (old.first, old.last), interval)  # noqa: B023
            better(curve, best.prior.memory, best.prior.smooth)
    return best
