"""The spline of largest posterior probability: robust Levenberg-Marquardt steps on banded normal equations.

The descent starts from the motions of neighbouring frames, one after the other (``first_curve``). Noise, its tails
and the strength of the prior are estimated on the way: the first two by maximum likelihood, the last by maximum
evidence (D. MacKay, Bayesian interpolation, Neural Computation 1992), as are the knots and the kind of prior
(``choose``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    is_of_one_camera,
    observed,
    thinned,
)
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

NORMAL = 1e9
"""Degrees of freedom of tails that are none."""
_ROUNDS, _STEPS_A_ROUND, _LAST_STEPS = 15, 2, 10
_FLAT, _FLAT_STRENGTH, _FLAT_EVIDENCE = 0.01, 0.05, 0.1
_FLAT_COST, _NEAR = 1e-3, 1.0
_MANY = 300
"""Tracks from which on it pays to share them."""
_LEAST_WIDTH = 5
"""Control poses that the prior ties, and a moment of a gyroscope."""
ANCHORED = 1e4
"""Precision of the pose at time 0, in those of the most certain control pose."""
_TELLING = 2.0
"""Accelerations that tracks must determine, at least, to say how strong they are."""
_STRENGTHS = (1e-10, 1e2)
"""Least and largest, of both kinds: far below and far above what anybody holds a camera with."""
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e8


class Equations(NamedTuple):
    """Normal equations at a spline."""

    cost: float
    """Negative logarithm of likelihood and prior, but for constants."""
    gradient: FloatArray
    band: FloatArray
    """Without anchors."""
    squares: FloatArray
    """(n,) of the tracks, px^2."""
    rough: Roughness
    sensed: Sensed | None = None
    """Of a gyroscope."""
    border: Border | None = None
    """Of its errors."""

    @property
    def slope(self) -> FloatArray:
        """Gradient by all unknowns."""
        return self.gradient if self.border is None else np.concatenate([self.gradient, self.border.slope])


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A spline, and the distributions that it was found under."""

    curve: Curve
    tails: Tails
    prior: Prior
    trust: FloatArray
    """(n,) 1 of tracks that count, else 0."""
    equations: Equations
    drift: Drift | None = None
    """Of a gyroscope."""


def width_of(tracks: TimedTracks, curve: Curve) -> int:
    """Width of the band: unknowns that are felt together."""
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
    """At a spline, under given distributions.

    Args:
        until: number of a control pose; only that part of the prior which begins before it.
        drift: of the gyroscope, where the tracks have one.
    """
    n, past = len(curve.p), tracks.past
    width = width_of(tracks, curve)
    band, gradient, squares = np.zeros((6 * n, width)), np.zeros(6 * n), np.zeros(len(trust))
    cost = _add_halves(curve, tracks, tails, tracks.share * trust, (squares, band, gradient), want)
    rough = roughness(curve, prior.memory, prior.smooth, width, past is None, until)
    for kind, strength in enumerate((prior.rotation, prior.position)):
        cost += 0.5 * rough.squares[kind] / strength
        gradient += rough.gradients[kind] / strength
        band += rough.bands[kind] / strength
    found = border = None
    if tracks.gyro is not None and drift is not None:
        found = sensed(curve, tracks.gyro, drift, width)
        gradient += found.gradient / drift.variance
        band += found.band / drift.variance
        more, border = border_of(found, drift, past is None)
        cost += more
    if past is not None:
        cost += _add_past(past, curve, gradient, band, border, drift)
    return Equations(cost, gradient, band, squares, rough, found, border)


def _add_halves(
    curve: Curve,
    tracks: TimedTracks,
    tails: Tails,
    trust: FloatArray,
    out: tuple[FloatArray, FloatArray, FloatArray],
    want: bool,
) -> float:
    """``add_tracks``, many of them in two halves side by side: on any machine, so that sums are the same."""
    starts, middle, same = tracks.starts, len(trust) // 2, (tracks.focal, tails)
    if len(trust) < _MANY:
        return add_tracks(curve, tracks.ends, starts, *same, trust, *out, want)
    squares, band, gradient = out
    later = np.zeros_like(band), np.zeros_like(gradient)
    with ThreadPoolExecutor(1) as pool:
        half = (curve, tracks.ends, starts[middle:], *same, trust[middle:], squares[middle:], *later, want)
        other = pool.submit(add_tracks, *half)
        half = trust[:middle], squares[:middle], band, gradient, want
        cost = add_tracks(curve, tracks.ends, starts[: middle + 1], *same, *half)
    band += later[0]
    gradient += later[1]
    return cost + other.result()


def _add_past(
    past: Past, curve: Curve, gradient: FloatArray, band: FloatArray, border: Border | None, drift: Drift | None
) -> float:
    """Cost of control poses, and errors of a gyroscope, that are not as they were earlier, and its equations."""
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


def held(equations: Equations, curve: Curve, tracks: TimedTracks, certain: float) -> FloatArray:
    """The normal matrix, a band, with the pose at time 0 held where nothing else holds the spline.

    Args:
        certain: precision of that pose, in those of the most certain control pose.
    """
    band = equations.band
    if tracks.past is not None:
        return band
    return band + anchors(curve, band.shape[1], certain * float(np.max(band[:, 0])))


def information(
    curve: Curve,
    tracks: TimedTracks,
    tails: Tails,
    prior: Prior | None,
    trust: FloatArray,
    drift: Drift | None = None,
    share: float = 1.0,
) -> tuple[FloatArray, Border | None]:
    """Factor of the expected information of the control poses, a band, and its border; the pose at time 0 is held.

    Args:
        prior: None: what the tracks alone say.
        drift: of the gyroscope, where the tracks have one.
        share: what a track counts beside the prior, in place of what it counted in a fit.

    Raises:
        NotDefiniteError: they do not determine the spline.
    """
    # Of a t distribution: K. Lange, R. Little, J. Taylor, see ``packed.HeavyTailed``.
    expected = trust * (tails.nu + tracks.freedom) / (tails.nu + tracks.freedom + 2.0)
    silent = prior or Prior(1.0, 1, np.inf, np.inf)
    each = replace(tracks, share=share)
    found = normal_equations(curve, each, Tails(NORMAL, tails.scale), silent, expected, drift=drift)
    return band_factor(held(found, curve, tracks, ANCHORED)), found.border


def covariance_band(found: Fit, tracks: TimedTracks, share: float = 1.0) -> FloatArray:
    """Covariance of the control poses of a fit, in its band, see ``information``. Raises NotDefiniteError."""
    told = information(found.curve, tracks, found.tails, found.prior, found.trust, found.drift, share)
    return bordered_inverse(*told)


def log_evidence(found: Fit, precision: float) -> float:
    """Logarithm of the probability of the tracks under the prior (Laplace's approximation), but for constants.

    To compare fits of other knots and orders, under the same tails and of the same tracks.

    Args:
        precision: of the pose at time 0, the same for all.
    """
    curve, equations = found.curve, found.equations
    anchor = anchors(curve, equations.band.shape[1], precision)
    lower = band_factor(equations.band + anchor)
    after = band_log_determinant(lower)
    if equations.sensed is not None and equations.border is not None and found.drift is not None:
        after += eliminated(lower, equations.border).log_determinant
        after += equations.sensed.count * float(np.log(found.drift.variance))
    return log_prior(curve, found.prior, equations.rough) - 0.5 * after - equations.cost


def squared_errors(curve: Curve, tracks: TimedTracks) -> FloatArray:
    """(n,) of the best points of tracks, px^2."""
    squares, nothing = np.zeros(len(tracks)), np.zeros((1, width_of(tracks, curve)))
    trust = np.zeros(len(squares))
    add_tracks(
        curve,
        tracks.ends,
        tracks.starts,
        tracks.focal,
        Tails(3.0, 1.0),
        trust,
        squares,
        nothing,
        np.zeros(1),
        False,
    )
    return squares


def right_tracks(found: Fit, tracks: TimedTracks) -> FloatArray:
    """(n,) which tracks are right by a fit to others, 1 or 0."""
    reach = tracks.freedom * (REACH * found.tails.scale) ** 2
    return (squared_errors(found.curve, tracks) <= reach).astype(np.float64)


def descend(
    curve: Curve,
    tracks: TimedTracks,
    tails: Tails,
    prior: Prior,
    trust: FloatArray,
    steps: int,
    drift: Drift | None = None,
) -> tuple[Curve, Equations, Drift | None]:
    """Levenberg-Marquardt steps, until one promises to lower the cost by less than a thousandth of a unit.

    Steps that promise little are taken as they are: the equations take the weights of pixels as given, and their
    root is not quite the least cost.
    """
    here, damping = normal_equations(curve, tracks, tails, prior, trust, drift=drift), 0.0
    for _ in range(steps):
        matrix = held(here, curve, tracks, 1.0)
        promise, trial, there, other = 0.0, curve, here, drift
        while damping <= _LARGEST_DAMPING:
            step = _step(matrix, here, damping)
            if step is not None:
                promise = -0.5 * float(step @ here.slope)
                trial, other = moved(curve, step[: len(matrix)]), _moved(drift, step[len(matrix) :])
                if tracks.past is None:
                    trial = from_pose_at(trial, 0.0)
                there = normal_equations(trial, tracks, tails, prior, trust, drift=other)
                near = damping == 0.0 and abs(promise) < _NEAR
                if there.cost <= here.cost + (_NEAR if near else 0.0):
                    break
            damping = max(10.0 * damping, _LEAST_DAMPING)
        if damping > _LARGEST_DAMPING:
            break
        curve, here, drift = trial, there, other
        damping = 0.1 * damping if damping > _LEAST_DAMPING else 0.0
        if promise < _FLAT_COST:
            break
    return curve, here, drift


def _moved(drift: Drift | None, step: FloatArray) -> Drift | None:
    return None if drift is None else drift.moved(step)


def _step(matrix: FloatArray, here: Equations, damping: float) -> FloatArray | None:
    """Of the control poses and, where there is a gyroscope, of its errors."""
    damped = matrix.copy()
    damped[:, 0] += damping * here.band[:, 0]
    try:
        lower = band_factor(damped)
        if here.border is None:
            return -band_solve(lower, here.gradient)
        return np.concatenate(bordered_step(lower, here.gradient, here.border))
    except NotDefiniteError:
        return None


def fit(
    curve: Curve,
    tracks: TimedTracks,
    prior: Prior,
    learn: bool = True,
    tails: Tails | None = None,
    trust: FloatArray | None = None,
    drift: Drift | None = None,
) -> Fit:
    """The spline, from one that is near, with the noises, tails and, if ``learn``, the prior's strength.

    Args:
        trust: with it, ``tails`` and ``trust`` stay as they are.
        drift: of the gyroscope that the tracks have, to begin with.
    """
    settled = trust is not None
    trust = np.ones(len(tracks)) if trust is None else trust
    if tails is None:
        median = float(np.median(squared_errors(curve, tracks) / tracks.freedom))
        tails = Tails(3.0, max(float(np.sqrt(median)), LEAST_SCALE_PX))
    if tracks.gyro is not None and drift is None:
        drift = first_drift(curve, tracks.gyro)
    for _ in range(_ROUNDS):
        curve, here, drift = descend(curve, tracks, tails, prior, trust, _STEPS_A_ROUND, drift)
        last = _strengths_of(prior, drift)
        old, lower = tails.scale, band_factor(held(here, curve, tracks, ANCHORED))
        used, determined, better, drift = _strengths(here, lower, prior, drift)
        if not settled:
            tails, trust = observed(here.squares, tracks.freedom, tails, used)
        prior = better if learn else prior
        change = np.abs(np.log(_strengths_of(prior, drift) / last))
        settling = (change > _FLAT_STRENGTH) & (change * determined > _FLAT_EVIDENCE)
        if abs(np.log(tails.scale / old)) < _FLAT and not np.any(settling):
            break
    curve, here, drift = descend(curve, tracks, tails, prior, trust, _LAST_STEPS, drift)
    return Fit(curve=curve, tails=tails, prior=prior, trust=trust, equations=here, drift=drift)


def _strengths_of(prior: Prior, drift: Drift | None) -> FloatArray:
    """Variances that are found with the spline."""
    return np.array([prior.rotation, prior.position, *([] if drift is None else [drift.variance])])


def _strengths(
    here: Equations, lower: FloatArray, prior: Prior, drift: Drift | None
) -> tuple[float, FloatArray, Prior, Drift | None]:
    """Numbers of parameters that tracks determine, and of accelerations and errors of a gyroscope that are left
    beside them (2 or 3,); the prior and the gyroscope's noise of more evidence."""
    inverse, old = bordered_inverse(lower, here.border), np.array([prior.rotation, prior.position])
    tied = np.array([band_inner(inverse, band) for band in here.rough.bands]) / old
    determined = np.maximum(here.rough.count - tied, 1e-3)
    new = np.where(determined > _TELLING, np.clip(here.rough.squares / determined, *_STRENGTHS), old)
    used = len(lower) - 6.0 - float(np.sum(tied))
    if here.sensed is not None and here.border is not None and drift is not None:
        own, left, drift = learned(here.sensed, drift, lower, inverse, here.border)
        used, determined = used + len(drift.errors) - own, np.append(determined, left)
    return used, determined, prior._replace(rotation=float(new[0]), position=float(new[1])), drift


_SOME = 250
"""Tracks of a window, about: enough to begin with."""
_SUSPECT = 4.0
"""Times the error of a window whose motion is made of its neighbours', from which on its own is wrong."""


def window_motions(
    windows: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter, seed: int
) -> list[Motion | None]:
    """The paper's motion in each window, of some of its tracks; None where they show none."""
    out, solver = list[Motion | None](), RefinedSolver(one_camera=is_of_one_camera(windows))
    for window in thinned(windows, _SOME):
        rng = np.random.default_rng(seed)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            found = estimate_motion(window, rig, shutter, solver, RobustOptions(), rng).estimate
        out.append(LinearMotion(found.w, found.d) if found.success else None)
    return out


def first_curve(
    motions: Sequence[Motion | None], tracks: TimedTracks, span: tuple[float, float], interval: float
) -> Curve:
    """A spline along the motions of the windows; one that is missing or wrong is made of its neighbours'.

    Args:
        span: times of the first and the last line.
    """
    known = np.array([motion is not None for motion in motions])
    rates = np.array([[0.0] * 6 if motion is None else [*motion.w, *motion.d] for motion in motions])
    own = _chained(_bridged(rates, known), span, interval)
    others = np.stack([_without(rates, known, k) for k in range(len(rates))])
    bridged = _chained(others, span, interval)
    errors = [_median_errors(squared_errors(curve, tracks), tracks) for curve in (own, bridged)]
    known &= ~(errors[0] > _SUSPECT * errors[1])
    return _chained(_bridged(rates, known), span, interval)


def continued(curve: Curve, motions: Sequence[Motion | None], start: int, last: float) -> Curve:
    """A spline, longer: along the motions of the windows from ``start`` on, to a time."""
    known = np.array([motion is not None for motion in motions])
    if not np.any(known):
        motions, known = [ContinuousMotion.of(curve).from_time(start - 1.0)], np.ones(1, dtype=np.bool_)
    rates = np.array([[0.0] * 6 if motion is None else [*motion.w, *motion.d] for motion in motions])
    rates = _bridged(rates, known)
    count = control_count(curve.first, last, curve.interval)
    taus = curve.first + curve.interval * (np.arange(count) - 1.0)
    ahead = from_pose_at(_chained(rates, (0.0, max(last - start, 1.0)), curve.interval), 0.0)
    own, later = evaluate(curve, taus)[0], evaluate(ahead, taus - start)[0]
    here = evaluate(curve, float(start))[0]
    R, p = curve.R, curve.p
    for k in range(len(p), count):
        far = taus[k] > start
        pose = compose(Pose(later.R[k], later.t[k]), here) if far else Pose(own.R[k], own.t[k])
        R, p = np.concatenate([R, pose.R[None]]), np.concatenate([p, -(pose.R.T @ pose.t)[None]])
    return make_curve(curve.first, curve.interval, R, p)


def _median_errors(squares: FloatArray, tracks: TimedTracks) -> FloatArray:
    """(windows,) of the tracks of each window; 0 of none."""
    chosen = [squares[members] for members in tracks.members]
    return np.array([float(np.median(each)) if len(each) else 0.0 for each in chosen])


def _bridged(rates: FloatArray, known: BoolArray) -> FloatArray:
    """Rates (n, 6), those that are not known between those of neighbours; 0 where none is."""
    if not np.any(known):
        return np.zeros_like(rates)
    places = np.arange(len(rates))
    return np.stack([np.interp(places, places[known], column[known]) for column in rates.T], axis=1)


def _without(rates: FloatArray, known: BoolArray, k: int) -> FloatArray:
    """What the neighbours of window k say of it (6,)."""
    others = known.copy()
    others[k] = False
    return _bridged(rates, others)[k]


def _chained(rates: FloatArray, span: tuple[float, float], interval: float) -> Curve:
    """Through the poses that rates of rotation and translation (n, 6) lead to."""
    poses = [Pose(np.eye(3), np.zeros(3))]
    for rate in rates:
        poses.append(compose(Pose(*LinearMotion(rate[:3], rate[3:]).body_from_world(1.0)), poses[-1]))
    taus = span[0] + interval * (np.arange(control_count(*span, interval)) - 1.0)
    controls = []
    for tau in taus:
        k = int(np.clip(np.floor(tau), 0, len(rates) - 1))
        along = LinearMotion(rates[k, :3], rates[k, 3:]).body_from_world(tau - k)
        controls.append(inverse(compose(along, poses[k])))
    R = np.swapaxes(np.stack([each.R for each in controls]), 1, 2)
    return make_curve(span[0], interval, R, np.stack([each.t for each in controls]))


MEMORIES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Frame periods."""
_PRECISION = 1e12
_WORTH = 1.0
"""Logarithm of evidence that another choice must gain."""


def choose(found: Fit, tracks: TimedTracks, intervals: Sequence[float]) -> Fit:
    """The fit of most evidence, by climbing from one: its memory, then its smoothness, then its knots."""
    best, most = found, log_evidence(found, _PRECISION)

    def better(trial: Callable[[], Fit]) -> bool:
        nonlocal best, most
        try:
            other = trial()
            evidence = log_evidence(other, _PRECISION)
        except NotDefiniteError:
            return False
        gained = evidence > most + _WORTH
        if gained:
            best, most = other, evidence
        return gained

    def with_memory(memory: float, smooth: int) -> Fit:
        return again(best, best.curve, tracks, memory, smooth)

    start = int(np.argmin(np.abs(np.log(np.array(MEMORIES) / best.prior.memory))))
    for way in (-1, 1):
        place = start + way
        while 0 <= place < len(MEMORIES) and better(lambda: with_memory(MEMORIES[place], best.prior.smooth)):  # noqa: B023
            place += way
        if place != start + way:
            break
    better(lambda: with_memory(best.prior.memory, 3 - best.prior.smooth))
    for interval in intervals:
        if abs(interval - best.curve.interval) > 1e-9:
            curve = approximated(
                lambda tau: evaluate(best.curve, tau)[0], (best.curve.first, best.curve.last), interval
            )
            better(lambda: again(best, curve, tracks, best.prior.memory, best.prior.smooth))  # noqa: B023
    return best


def again(found: Fit, curve: Curve, tracks: TimedTracks, memory: float, smooth: int) -> Fit:
    """A fit under another prior or with other knots, with the same tails and the same tracks."""
    prior = found.prior._replace(memory=memory, smooth=smooth)
    return fit(curve, tracks, prior, tails=found.tails, trust=found.trust, drift=found.drift)
