"""Least squares of the Sampson errors of one camera with free velocities in both frames.

The length of T(s0, s1), beside that of t, is undetermined where its direction and the rotation are the same for
all rows: any factor 1 + a s1 - b s0 leaves every constraint as it is. A constant velocity is that but for terms of
second order, so that two of the velocities' numbers are lost in noise of 1e-3 px, and least squares alone lets T
vanish in the middle of the image. What is minimised is therefore the most probable motion for velocities that in a
whole frame lead as far as t, within a standard deviation: with C the sum of squares of n matches,

    C (1 + (|v0|^2 + |v1|^2) (height / fy)^2 / n),

which on exact matches has its minimum at the truth.

The unknowns are a turn of R, t on the unit sphere, and half the sum and the difference of the velocities of both
frames in one frame's axes: both frames see a point at nearly the same row, and of slow motion the difference alone
is well determined.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, errors

_FLAT = 1e-9
"""Relative decrease at which to stop: sqrt(n 1e-9) standard deviations from the end."""
_EXACT_PX = 1e-11
"""Root mean square of what rounding leaves."""
_LARGEST_DAMPING = 1e8


def refine(start: FreeMotion, rows: Rows, *, turning: bool, most: int) -> tuple[FreeMotion, float]:
    """Where a descent from a start ends, and what was minimised, px^2; the start where matches are too few.

    Args:
        turning: whether the camera turns within a frame.
        most: evaluations.
    """
    unknowns = 17 if turning else 11
    if len(rows.x) < unknowns:
        return start, np.inf
    if not turning:
        start = start._replace(w0=np.zeros(3), w1=np.zeros(3))
    return descend(_Sampson(rows, unknowns), start, most, len(rows.x) * _EXACT_PX**2)


class Normal(NamedTuple):
    """What is minimised, at one motion."""

    cost: float
    gradient: FloatArray
    """(unknowns,)."""
    H: FloatArray
    """(unknowns, unknowns), Gauss and Newton's."""
    chart: FloatArray
    """(18, unknowns) what they do to those of ``FreeMotion.moved``."""


class Problem(Protocol):
    """What can be minimised."""

    def at(self, motion: FreeMotion) -> Normal:
        """Of a motion whose t has the length 1."""


def descend(problem: Problem, motion: FreeMotion, most: int, exact: float) -> tuple[FreeMotion, float]:
    """Levenberg and Marquardt's descent in at most so many evaluations, and the cost; ``exact`` is as good as 0."""
    motion = motion.of_unit_length()
    here, damping = problem.at(motion), 1e-3
    for _ in range(most):
        if here.cost <= exact or damping > _LARGEST_DAMPING:
            break
        trial = motion.moved(here.chart @ _step(here, damping)).of_unit_length()
        there = problem.at(trial)
        if not there.cost < here.cost:
            damping *= 10.0
            continue
        flat = here.cost - there.cost <= _FLAT * here.cost
        motion, here, damping = trial, there, max(0.1 * damping, 1e-14)
        if flat:
            break
    return motion, here.cost


class _Sampson:
    """Sampson errors, with velocities that are not faster than the matches say."""

    def __init__(self, rows: Rows, unknowns: int) -> None:
        camera, n = rows.camera, len(rows.x)
        self.rows, self.unknowns, self.slowness = rows, unknowns, (camera.height / camera.fy) ** 2 / n

    def at(self, motion: FreeMotion) -> Normal:
        r, J = errors(motion, self.rows)
        C = chart(motion)[:, : self.unknowns]
        J, velocities, by_velocity = J @ C, np.concatenate([motion.v0, motion.v1]), C[6:12]
        squares = float(r @ r)
        fast = 1.0 + self.slowness * float(velocities @ velocities)
        gradient = fast * (J.T @ r) + self.slowness * squares * (velocities @ by_velocity)
        H = fast * (J.T @ J) + self.slowness * squares * (by_velocity.T @ by_velocity)
        cost = squares * fast
        return Normal(cost if np.isfinite(cost) else np.inf, gradient, H, C)


def chart(motion: FreeMotion) -> FloatArray:
    """(18, 17) what the unknowns of the descent do to those of ``FreeMotion.moved``."""
    C, eye, back = np.zeros((18, 17)), np.eye(3), motion.R.T
    C[:3, :3] = eye
    C[3:6, 3:5] = np.linalg.svd(motion.t[None])[2][1:].T
    for row, column in ((6, 5), (12, 11)):
        C[row : row + 3, column : column + 3], C[row : row + 3, column + 3 : column + 6] = -0.5 * back, back
        C[row + 3 : row + 6, column : column + 3], C[row + 3 : row + 6, column + 3 : column + 6] = 0.5 * eye, eye
    return C


def _step(here: Normal, damping: float) -> FloatArray:
    """Damped step, each unknown in its own unit; none where there is no finite one."""
    unit = np.sqrt(np.maximum(np.diag(here.H), 1e-300))
    H = here.H / np.outer(unit, unit)
    H.flat[:: len(H) + 1] += damping
    try:
        return np.asarray(-np.linalg.solve(H, here.gradient / unit) / unit)
    except np.linalg.LinAlgError:
        return np.zeros_like(unit)
