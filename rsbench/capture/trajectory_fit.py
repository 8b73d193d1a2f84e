"""The spline of largest posterior probability: robust Levenberg-Marquardt steps on banded normal equations.

Noise, its tails and the strength of the prior are found on the way: the first two by maximum likelihood, the last
by maximum evidence (D. MacKay, Bayesian interpolation, Neural Computation 1992).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_data import Past, TimedTracks
from rsbench.capture.trajectory_kernels import Tails, add_tracks
from rsbench.capture.trajectory_prior import Prior, Roughness, anchors, log_prior, roughness
from rsbench.capture.trajectory_spline import Curve, from_pose_at, moved
from rsbench.core import so3
from rsbench.core.so3 import FloatArray

_TAILS = (3.0, 5.0, 10.0, 30.0)
"""Degrees of freedom to choose from, as in ``heavy_tails``."""
NORMAL = 1e9
"""Degrees of freedom of tails that are none."""
_REACH = 10.0
"""Errors, in scales, beyond which a track is wrong."""
_LEAST_SCALE_PX = 1e-3
_ROUNDS, _STEPS_A_ROUND, _LAST_STEPS = 15, 2, 10
_FLAT, _FLAT_STRENGTH, _FLAT_EVIDENCE = 0.01, 0.05, 0.1
_FLAT_COST, _NEAR = 1e-3, 1.0
_MANY = 300
"""Tracks from which on it pays to share them."""
_LEAST_WIDTH = 5
"""Control poses that the prior ties."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A spline, and the distributions that it was found under."""

    curve: Curve
    tails: Tails
    prior: Prior
    trust: FloatArray
    """(n,) 1 of tracks that count, else 0."""
    equations: Equations


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
) -> Equations:
    """At a spline, under given distributions.

    Args:
        until: number of a control pose; only that part of the prior which begins before it.
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
    if past is not None:
        cost += _add_past(past, curve, gradient, band)
    return Equations(cost, gradient, band, squares, rough)


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


def _add_past(past: Past, curve: Curve, gradient: FloatArray, band: FloatArray) -> float:
    """Cost of control poses that are not where earlier matches had them, and its equations."""
    k = len(past.p)
    turned = so3.log(curve.R[:k] @ np.swapaxes(past.R, 1, 2))
    away = np.concatenate([turned, curve.p[:k] - past.p], axis=1).ravel()
    slope = past.H @ away
    gradient[: 6 * k] += slope + past.gradient
    for i in range(6 * k):
        band[: 6 * k - i, i] += np.diagonal(past.H, -i)
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
    curve: Curve, tracks: TimedTracks, tails: Tails, prior: Prior | None, trust: FloatArray
) -> FloatArray:
    """Factor of the expected information of the control poses, whose pose at time 0 is held; a band.

    Every track counts for one.

    Args:
        prior: None: what the tracks alone say.

    Raises:
        NotDefiniteError: they do not determine the spline.
    """
    # Of a t distribution: K. Lange, R. Little, J. Taylor, see ``heavy_tails``.
    expected = trust * (tails.nu + tracks.freedom) / (tails.nu + tracks.freedom + 2.0)
    silent = prior or Prior(1.0, 1, np.inf, np.inf)
    each = replace(tracks, share=1.0)
    found = normal_equations(curve, each, Tails(NORMAL, tails.scale), silent, expected)
    return banded.factor(held(found, curve, tracks, ANCHORED))


def log_evidence(found: Fit, precision: float) -> float:
    """Logarithm of the probability of the tracks under the prior (Laplace's approximation), but for constants.

    To compare fits of other knots and orders, under the same tails and of the same tracks.

    Args:
        precision: of the pose at time 0, the same for all.
    """
    curve, equations = found.curve, found.equations
    anchor = anchors(curve, equations.band.shape[1], precision)
    after = banded.log_determinant(banded.factor(equations.band + anchor))
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
    reach = tracks.freedom * (_REACH * found.tails.scale) ** 2
    return (squared_errors(found.curve, tracks) <= reach).astype(np.float64)


def descend(
    curve: Curve, tracks: TimedTracks, tails: Tails, prior: Prior, trust: FloatArray, steps: int
) -> tuple[Curve, Equations]:
    """Levenberg-Marquardt steps, until one promises to lower the cost by less than a thousandth of a unit.

    Steps that promise little are taken as they are: the equations take the weights of pixels as given, and their
    root is not quite the least cost.
    """
    here, damping = normal_equations(curve, tracks, tails, prior, trust), 0.0
    for _ in range(steps):
        matrix = held(here, curve, tracks, 1.0)
        promise, trial, there = 0.0, curve, here
        while damping <= _LARGEST_DAMPING:
            step = _step(matrix, here, damping)
            if step is not None:
                promise = -0.5 * float(step @ here.gradient)
                trial = moved(curve, step)
                if tracks.past is None:
                    trial = from_pose_at(trial, 0.0)
                there = normal_equations(trial, tracks, tails, prior, trust)
                near = damping == 0.0 and abs(promise) < _NEAR
                if there.cost <= here.cost + (_NEAR if near else 0.0):
                    break
            damping = max(10.0 * damping, _LEAST_DAMPING)
        if damping > _LARGEST_DAMPING:
            break
        curve, here, damping = trial, there, 0.1 * damping if damping > _LEAST_DAMPING else 0.0
        if promise < _FLAT_COST:
            break
    return curve, here


def _step(matrix: FloatArray, here: Equations, damping: float) -> FloatArray | None:
    damped = matrix.copy()
    damped[:, 0] += damping * here.band[:, 0]
    try:
        return -banded.solve(banded.factor(damped), here.gradient)
    except banded.NotDefiniteError:
        return None


def fit(
    curve: Curve,
    tracks: TimedTracks,
    prior: Prior,
    learn: bool = True,
    tails: Tails | None = None,
    trust: FloatArray | None = None,
) -> Fit:
    """The spline, from one that is near, with noise, tails and, if ``learn``, the prior's strength.

    Args:
        trust: with it, ``tails`` and ``trust`` stay as they are.
    """
    settled = trust is not None
    trust = np.ones(len(tracks)) if trust is None else trust
    if tails is None:
        median = float(np.median(squared_errors(curve, tracks) / tracks.freedom))
        tails = Tails(3.0, max(float(np.sqrt(median)), _LEAST_SCALE_PX))
    for _ in range(_ROUNDS):
        curve, here = descend(curve, tracks, tails, prior, trust, _STEPS_A_ROUND)
        last = np.array([tails.scale, prior.rotation, prior.position])
        lower = banded.factor(held(here, curve, tracks, ANCHORED))
        used, determined, learned = _strengths(here, lower, prior)
        if not settled:
            tails, trust = observed(here.squares, tracks.freedom, tails, used)
        prior = learned if learn else prior
        change = np.abs(np.log([tails.scale, prior.rotation, prior.position] / last))
        settling = (change[1:] > _FLAT_STRENGTH) & (change[1:] * determined > _FLAT_EVIDENCE)
        if change[0] < _FLAT and not np.any(settling):
            break
    curve, here = descend(curve, tracks, tails, prior, trust, _LAST_STEPS)
    return Fit(curve=curve, tails=tails, prior=prior, trust=trust, equations=here)


def _strengths(here: Equations, lower: FloatArray, prior: Prior) -> tuple[float, FloatArray, Prior]:
    """Numbers of parameters, and of accelerations (2,), that the data determine; the prior of more evidence."""
    inverse, old = banded.inverse_band(lower), np.array([prior.rotation, prior.position])
    tied = np.array([banded.inner(inverse, band) for band in here.rough.bands]) / old
    determined = np.maximum(here.rough.count - tied, 1e-3)
    new = np.where(determined > _TELLING, np.clip(here.rough.squares / determined, *_STRENGTHS), old)
    used = len(lower) - 6.0 - float(np.sum(tied))
    return used, determined, prior._replace(rotation=float(new[0]), position=float(new[1]))


def observed(squares: FloatArray, freedom: FloatArray, tails: Tails, used: float) -> tuple[Tails, FloatArray]:
    """Distribution of errors, and which tracks (n,) are right, 1 or 0.

    Args:
        used: degrees of freedom that the trajectory has taken.
    """
    scale = tails.scale
    near = squares <= freedom * (_REACH * scale) ** 2
    if not np.any(near):
        return tails, np.ones(len(squares))
    q, p = squares[near], freedom[near]
    left = max(float(np.sum(p)) - used, 0.1 * float(np.sum(p)))
    found = [Tails(nu, _scale(q, p, nu, scale, left)) for nu in _TAILS]
    best = max(found, key=lambda each: _likelihood(q, p, each))
    return best, (squares <= freedom * (_REACH * best.scale) ** 2).astype(np.float64)


def _scale(q: FloatArray, p: FloatArray, nu: float, scale: float, left: float) -> float:
    """Of the largest likelihood (parameter-expanded EM, see ``heavy_tails``)."""
    count = len(p) + (float(np.sum(p)) - left) / nu
    for _ in range(50):
        weights = (nu + p) / (nu + q / scale**2)
        last, scale = scale, max(float(np.sqrt(weights @ q / left * count / np.sum(weights))), _LEAST_SCALE_PX)
        if abs(scale - last) <= 1e-4 * scale:
            break
    return scale


def _likelihood(q: FloatArray, p: FloatArray, tails: Tails) -> float:
    """Logarithm, without terms that are the same for all."""
    nu, scale = tails
    gammaln = scipy.special.gammaln
    norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * scale**2)
    return float(np.sum(norm - 0.5 * (nu + p) * np.log1p(q / (nu * scale**2))))
