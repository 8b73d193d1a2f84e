"""Rotation of one frame from curves that were straight lines, some of which were not.

Y. Lao, O. Ait-Aider, CVPR 2018: samples of four curves, the linear model of ``straightness``, and the curves that
become straight with it; then least squares of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.vision.straightness import FARTHEST, Points, Step, Turn, Turned, lines_at, step_of, straightened

FEWEST = 4
"""Curves of a sample, and below which there is no rotation."""
_ROUNDS = 5


@dataclass(frozen=True, kw_only=True)
class LineOptions:
    """Of the search."""

    threshold_px: float = 0.2
    """Root mean square by which the points of a curve may miss a line."""
    samples: int = 500
    """Random samples of the search."""
    prior_deg: float = 3.0
    """What a component of the rotation in a frame period is expected to be, a standard deviation."""

    @property
    def prior(self) -> float:
        return float(np.radians(self.prior_deg))


def rotation_of_lines(points: Points | None, options: LineOptions, rng: np.random.Generator) -> Turn | str:
    """The rotation that makes most curves straight, or why there is none; None are the points of no curve."""
    count = 0 if points is None else points.count
    if points is None or count < FEWEST:
        return f"{count} curves that may be lines; {FEWEST} are needed"
    still = Turned.by(points, np.zeros(3))
    w = _best_sample(step_of(still, lines_at(still)), points, options, rng)
    kept = np.zeros(count, dtype=np.bool_)
    for _ in range(_ROUNDS):
        at = Turned.by(points, w)
        errors = at.errors(lines_at(at))
        straight = points.means(errors**2) < options.threshold_px**2
        if np.count_nonzero(straight) < FEWEST:
            return f"{np.count_nonzero(straight)} of {count} curves become straight together; {FEWEST} are needed"
        if np.array_equal(straight, kept):
            break
        kept = straight
        w = straightened(points.chosen(kept), w, options.prior).w
    return straightened(points.chosen(kept), w, options.prior)


def _best_sample(system: Step, points: Points, options: LineOptions, rng: np.random.Generator) -> FloatArray:
    """w (3,) of the sample whose motion leaves the least truncated squared errors; that of none among them."""
    chosen = np.argsort(rng.random((options.samples, points.count)), axis=1)[:, :FEWEST]
    hold = (options.threshold_px / options.prior) ** 2
    A = system.A[chosen].sum(axis=1) + hold * np.eye(3)
    w = np.concatenate([np.zeros((1, 3)), -np.linalg.solve(A, system.b[chosen].sum(axis=1)[..., None])[..., 0]])
    w = w[np.max(np.abs(w), axis=1) <= FARTHEST * options.prior]
    squares = system.c + 2.0 * w @ system.b.T + np.einsum("si,kij,sj->sk", w, system.A, w)
    most = options.threshold_px**2 * points.sums(np.ones(len(points.time)))
    return np.asarray(w[np.argmin(np.minimum(squares, most).sum(axis=1))])
