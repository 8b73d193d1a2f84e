"""Which knots and which prior the matches ask for, by their evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_data import TimedTracks
from rsbench.capture.trajectory_fit import Fit, fit, log_evidence
from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_prior import add_blocks
from rsbench.capture.trajectory_spline import Curve, control_count, evaluate, make_curve, moved
from rsbench.core import so3
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray

MEMORIES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Frame periods."""
_PRECISION = 1e12
_SAMPLES, _STEPS = 4, 4
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
        except banded.NotDefiniteError:
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
            curve = resampled(best.curve, interval)
            better(lambda: again(best, curve, tracks, best.prior.memory, best.prior.smooth))  # noqa: B023
    return best


def again(found: Fit, curve: Curve, tracks: TimedTracks, memory: float, smooth: int) -> Fit:
    """A fit under another prior or with other knots, with the same tails and the same tracks."""
    prior = found.prior._replace(memory=memory, smooth=smooth)
    return fit(curve, tracks, prior, tails=found.tails, trust=found.trust, drift=found.drift)


def resampled(curve: Curve, interval: float) -> Curve:
    """The same way with other knots, as near as they allow."""
    return approximated(lambda tau: evaluate(curve, tau)[0], (curve.first, curve.last), interval)


def approximated(
    body_from_world: Callable[[FloatArray], Pose], span: tuple[float, float], interval: float
) -> Curve:
    """The spline next to poses at times (n,), of a motion that lasts for a span."""
    count = control_count(*span, interval)
    R, t = body_from_world(np.asarray(span[0] + interval * (np.arange(count) - 1.0), dtype=np.float64))
    curve = make_curve(span[0], interval, R, _positions(R, t))
    shares = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    taus = [span[0] + interval * (np.arange(count - 3) + share) for share in shares]
    wanted = [body_from_world(each) for each in taus]
    first = np.arange(count - 3)
    for _ in range(_STEPS):
        gradient, band = np.zeros(6 * count), np.zeros((6 * count, 24))
        band[:, 0] = 1e-9
        views = blank_views(count - 3)
        for each, (R, t) in zip(taus, wanted, strict=True):
            fill_views(curve, each, views)
            turned = so3.log(R @ np.swapaxes(views.R, 1, 2))
            add_blocks(gradient, band, views.turn, turned, first, 0)
            by = views.share[..., None, None] * np.eye(3)
            add_blocks(gradient, band, by, _positions(R, t) - views.p, first, 3)
        curve = moved(curve, banded.solve(banded.factor(band), gradient))
    return curve


def _positions(R: FloatArray, t: FloatArray) -> FloatArray:
    """Of bodies in the world (n, 3)."""
    return -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]
