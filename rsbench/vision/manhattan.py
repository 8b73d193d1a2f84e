"""Rotation of one frame from lines along three orthogonal directions, which a camera that turned shows off them.

P. Purkait, C. Zach, A. Leonardis, Rolling Shutter Correction in Manhattan World, ICCV 2017: the vanishing
directions and the rotation within the frame together, from short pieces of lines. A piece whose line runs along
the direction v has a normal l with l . v = 0 (``straightness``), once its rows are turned back. So a piece that
is too short to be bent tells something too, and a line that yaw sheared is off its direction. The directions are
searched for by those of three pieces as if nothing had turned (two for the first direction, one for the second),
and then fitted with the rotation to the pieces that agree, ever more strictly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.so3 import FloatArray
from rsbench.vision.straightness import FARTHEST, Points, Step, Turn, Turned, moved, noise_variance, reduced

FEWEST = 8
"""Curves that agree, below which there is no rotation: six unknowns, and two that could contradict."""
_SIN = 0.1
"""Sine of the angle within which a piece of a search agrees with a direction: a fast turn shears by so much."""
_COARSER = (8.0, 4.0, 2.0, 1.0)
"""Thresholds of the rounds, in units of the last."""
_STARTS, _ROUND_STEPS, _LAST_STEPS = 3, 3, 30
_DONE = 1e-3
_PARTS = (1.0, 0.3, 0.1, 0.03)


@dataclass(frozen=True, kw_only=True)
class ManhattanOptions:
    """Of the search."""

    threshold_px: float = 0.3
    """Root mean square by which the points of a curve may miss a line along its direction."""
    least_share: float = 0.3
    """Of all points that must lie on lines along the directions."""
    samples: int = 500
    """Random samples of the search."""
    prior_deg: float = 3.0
    """What a component of the rotation in a frame period is expected to be, a standard deviation."""

    @property
    def prior(self) -> float:
        return float(np.radians(self.prior_deg))


class _World(NamedTuple):
    """Curves at a rotation, the directions, and each curve's."""

    at: Turned
    axes: FloatArray
    """(3, 3) columns are the directions in the middle of the readout."""
    normals: FloatArray
    """(K, 3)"""
    own: NDArray[np.intp]
    """(K,) number of a curve's direction."""

    def along(self) -> FloatArray:
        """(K, 3) the direction of each curve."""
        return np.asarray(self.axes.T[self.own])

    def squares(self) -> FloatArray:
        """(K,) mean squared errors, px^2."""
        return self.at.points.means(self.at.errors(self.normals) ** 2)


def rotation_of_directions(
    points: Points | None, options: ManhattanOptions, rng: np.random.Generator
) -> Turn | str:
    """The rotation with which most curves run along three directions, or why there is none; None: no curves."""
    count = 0 if points is None else points.count
    if points is None or count < FEWEST:
        return f"{count} curves that may be lines; {FEWEST} are needed"
    best: tuple[float, Turn] | None = None
    reason = "no three directions"
    for axes in _directions(points, options, rng):
        found = _fitted(points, axes, options)
        if isinstance(found, str):
            reason = found
        elif best is None or found[0] < best[0]:
            best = found
    return reason if best is None else best[1]


def _directions(points: Points, options: ManhattanOptions, rng: np.random.Generator) -> list[FloatArray]:
    """Triples of directions (3, 3), columns, that most points agree with as if nothing had turned, apart."""
    n, weights = Turned.by(points, np.zeros(3)).nearest_normals(), points.sums(np.ones(len(points.time)))
    i, j, k = np.argsort(rng.random((options.samples, points.count)), axis=1)[:, :3].T
    first = so3.cross(n[i], n[j])
    second = so3.cross(first, n[k])
    lengths = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
    good = (lengths[0] > 0.02) & (lengths[1] > 0.02 * lengths[0])
    first, second = first[good] / lengths[0][good, None], second[good] / lengths[1][good, None]
    triples = np.stack([first, second, so3.cross(first, second)], axis=-1)  # (S, 3, 3)
    off = np.min(np.abs(np.einsum("ki,sij->skj", n, triples)), axis=2)
    scores = np.maximum(1.0 - (off / _SIN) ** 2, 0.0) @ weights
    chosen: list[FloatArray] = []
    for best in np.argsort(-scores):
        alike = [np.max(np.abs(triples[best].T @ other), axis=1).min() for other in chosen]
        if all(each < np.cos(2.0 * _SIN) for each in alike):
            chosen.append(triples[best])
        if len(chosen) == _STARTS:
            break
    return chosen


def _fitted(points: Points, axes: FloatArray, options: ManhattanOptions) -> tuple[float, Turn] | str:
    """Truncated squared errors of all curves, and the rotation; or why there is none."""
    world = _assigned(Turned.by(points, np.zeros(3)), axes)
    turn, kept = None, np.zeros(points.count, dtype=np.bool_)
    for coarser in _COARSER:
        kept = world.squares() < (coarser * options.threshold_px) ** 2
        if np.count_nonzero(kept) < FEWEST:
            agree = f"{np.count_nonzero(kept)} of {points.count} curves agree with three directions"
            return f"{agree}; {FEWEST} are needed"
        inner = _World(
            Turned.by(points.chosen(kept), world.at.w), world.axes, world.normals[kept], world.own[kept]
        )
        turn, axes = _least_squares(inner, options.prior, _LAST_STEPS if coarser == 1.0 else _ROUND_STEPS)
        world = _assigned(Turned.by(points, turn.w), axes)
    counts = points.sums(np.ones(len(points.time)))
    if (share := float(counts[kept].sum() / counts.sum())) < options.least_share:
        return f"only {share:.0%} of the curves' points lie on lines along three directions"
    if np.count_nonzero(np.bincount(world.own[kept], minlength=3) > 1) < 2:
        return "lines along one direction alone"
    assert turn is not None
    return float(counts @ np.minimum(world.squares(), options.threshold_px**2)), turn


def _assigned(at: Turned, axes: FloatArray) -> _World:
    """Each curve with the direction that it misses least, and the line nearest to it along that direction."""
    products = at.points.sums(at.q[:, :, None] * at.q[:, None])
    normals = np.zeros((3, at.points.count, 3))
    for k in range(3):
        basis = np.delete(axes, k, axis=1)
        normals[k] = np.linalg.eigh(basis.T @ products @ basis)[1][..., 0] @ basis.T
    squares = np.stack([at.points.means(at.errors(each) ** 2) for each in normals])
    own = np.argmin(squares, axis=0)
    return _World(at, axes, normals[own, np.arange(at.points.count)], own)


def _least_squares(world: _World, prior: float, steps: int) -> tuple[Turn, FloatArray]:
    """Gauss and Newton's steps of rotation and directions; ``prior`` as in ``straightness.straightened``."""
    points, covariance = world.at.points, np.zeros((3, 3))
    for _ in range(steps):
        step, ways = _step(world)
        squares = float(np.sum(world.at.errors(world.normals) ** 2))
        variance = noise_variance(points, squares, 6 + points.count)
        hold = np.diag([variance / prior**2] * 3 + [0.0] * 3)
        A, w = step.A.sum(axis=0) + hold, np.append(world.at.w, np.zeros(3))
        x = -np.linalg.lstsq(A, step.b.sum(axis=0) + hold @ w, rcond=None)[0]
        covariance = variance * np.linalg.pinv(A, hermitian=True)[:3, :3]
        after = _descended(world, step, ways, x, hold[0, 0], FARTHEST * prior)
        if after is None:
            break
        world = after
        if not x[:3] @ x[:3] > _DONE**2 * np.trace(covariance):
            break
    return Turn(world.at.w, world.normals, np.asarray(covariance)), world.axes


def _step(world: _World) -> tuple[Step, FloatArray]:
    """Of rotation and a turn of the directions, (6,), and the ways (K, 1, 3) of lines about their directions."""
    ways = so3.cross(world.along(), world.normals)[:, None]
    turns = so3.cross(np.eye(3), world.normals[:, None])  # of the normals with the directions, about x, y, z
    by_all = np.hstack([world.at.by_turn(world.normals), world.at.by_normals(world.normals, turns)])
    errors, by_own = world.at.errors(world.normals), world.at.by_normals(world.normals, ways)
    return reduced(world.at.points, errors, by_all, by_own), ways


def _descended(
    world: _World, step: Step, ways: FloatArray, x: FloatArray, hold: float, most: float
) -> _World | None:
    """Where the step x, or a part of it, lowers the errors; None where none does."""

    def cost(each: _World) -> float:
        return float(np.sum(each.at.errors(each.normals) ** 2)) + hold * float(each.at.w @ each.at.w)

    before = cost(world)
    for part in _PARTS:
        w = world.at.w + part * x[:3]
        if not np.max(np.abs(w)) <= most:
            continue
        turn = so3.exp(part * x[3:])
        axes = turn @ world.axes
        normals = moved(world.normals, ways, step, part * x) @ turn.T
        along = axes.T[world.own]  # what the finite steps moved off the directions goes back
        normals = normals - np.sum(normals * along, axis=1, keepdims=True) * along
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        after = _World(Turned.by(world.at.points, w), axes, normals, world.own)
        if cost(after) < before:
            return after
    return None
