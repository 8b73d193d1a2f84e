"""Estimate the rotation during one rolling-shutter frame from images of straight lines, which it bends to curves.

Curves are edges of the image, i.e. chains of sub-pixel points. A point is the maximum of the gradient's length
along a row, by a parabola through its logarithm, which is exact for a step blurred by a Gaussian (compare C.
Steger, An unbiased detector of curvilinear structures, PAMI 1998). Points in neighbouring rows are linked if the
direction of the edge leads from one to the other. A chain that deviates from a parabola is cut at the largest
deviation. Nearly horizontal edges are found likewise in the columns.

A camera that rotates by exp(s w) in the time s sees the points of a line in space, whose plane through the centre
has the normal l at s = 0, on rays r with

    l . q = 0,   q = exp(-s w) r.

The curve depends on the two degrees of freedom of l and on the rotation. To first order, l . (r - s w x r) = 0,
the model of Y. Lao, O. Ait-Aider, A Robust Method for Strong Rolling Shutter Effects Correction Using Lines with
Automatic Feature Selection, CVPR 2018. A vertical line determines roll and, away from the middle, pitch; yaw
shears it, which leaves it straight, so only slanted lines away from the middle determine yaw.

One rotation makes all curves straight: the pitch that turns the rays of all rows into one plane (height / (focal
length x readout ratio), tens of degrees in a frame period; C. Albl, A. Sugimoto, T. Pajdla, Degeneracies in
Rolling Shutter SfM, ECCV 2016, describe it for points). Errors are therefore in px of the original frame (for
horizontal curves including the change of time with the row): as l . q, or in the corrected image, they would
vanish for that rotation and bias all estimates towards it. The search ends at ``FARTHEST`` prior deviations.

``rotation_of_lines`` (Lao, Ait-Aider) draws samples of four curves, solves the linear model, and fits all curves
that it makes straight. ``rotation_of_directions`` estimates three orthogonal directions and the rotation jointly
from short segments (P. Purkait, C. Zach, A. Leonardis, Rolling Shutter Correction in Manhattan World, ICCV 2017):
a segment along direction v has a normal l with l . v = 0 when its rows are rotated back. So segments that are too
short to be bent contribute, and a line that is sheared by yaw deviates from its direction. Directions are first
searched without rotation from samples of three segments (two for the first direction, one for the second), and
then fitted with the rotation to the segments that agree, with decreasing thresholds.

The points of all curves are concatenated, (N,); ``curve`` (N,) is the index of each point's curve, 0 to K - 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import grey_u8

F32 = NDArray[np.float32]
Curves = list[FloatArray]
"""Points (n, 2) x, y, px, of each curve in order."""

_BLUR_PX = 1.0
_LEAST_GRADIENT = 6.0
"""Least gradient of an edge, grey levels per px: three standard deviations for blurred 8-bit noise of 3 levels."""
_BESIDE_PX, _SAME_DIRECTION, _SAME_STRENGTH = 0.6, 0.94, 0.6
"""Conditions to link two points: largest distance from the extrapolated edge, px, least cosine of the angle
between their directions (20 degrees), and least ratio of their gradients."""
_BENT_PX = 0.35
"""Largest distance of a curve's smoothed points from a parabola, px."""
_SMOOTHED = 7


def image_curves(image: NDArray[Any], least_length: float) -> Curves:
    """Curves of at least ``least_length`` px in an image (H, W[, 3]), uint8 or uint16, sorted from the longest."""
    grey = grey_u8(image).astype(np.float32)
    upright = _curves_down(grey, least_length)
    flat = [each[:, ::-1] for each in _curves_down(np.ascontiguousarray(grey.T), least_length)]
    return sorted([*upright, *flat], key=lambda each: -extent(each))


def extent(curve: FloatArray) -> float:
    """Distance between the ends of a curve (n, 2), px."""
    return float(np.linalg.norm(curve[-1] - curve[0]))


def _curves_down(grey: F32, least_length: float) -> Curves:
    """Curves that cross rows."""
    places = _places(grey)
    after = [_followers(here, there) for here, there in itertools.pairwise(places)]
    curves: Curves = []
    started: list[set[int]] = [set() for _ in places]
    for row, followers in enumerate(after):
        for first in range(len(followers)):
            if first in started[row] or followers[first] < 0:
                continue
            chain, y, k = list[tuple[float, float]](), row, first
            while k >= 0:
                chain.append((places[y][k, 0], float(y)))
                started[y].add(k)
                k = int(after[y][k]) if y < len(after) else -1
                y += 1
            curves += _parabolas(np.array(chain), least_length)
    return curves


def _places(grey: F32) -> list[FloatArray]:
    """Edge points (n, 4) of each row: x, gradient along x and y, its length; only edges nearer to vertical."""
    blurred = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    gx, gy = (cv2.Scharr(blurred, cv2.CV_32F, dx, dy, scale=1 / 32) for dx, dy in ((1, 0), (0, 1)))
    strength = np.maximum(np.hypot(gx, gy), np.float32(1e-3))
    inner = strength[:, 1:-1]
    peak = (inner >= strength[:, :-2]) & (inner > strength[:, 2:]) & (inner > _LEAST_GRADIENT)
    peak &= np.abs(gx[:, 1:-1]) >= np.abs(gy[:, 1:-1])
    log = np.log(strength.astype(np.float64))
    found = []
    for y, row in enumerate(peak):
        x = np.flatnonzero(row) + 1
        before, at, behind = log[y, x - 1], log[y, x], log[y, x + 1]
        offset = 0.5 * (behind - before) / np.maximum(2.0 * at - before - behind, 1e-9)
        found.append(np.column_stack([x + np.clip(offset, -0.5, 0.5), gx[y, x], gy[y, x], strength[y, x]]))
    return found


def _followers(here: FloatArray, there: FloatArray) -> NDArray[np.intp]:
    """For each point (n, 4) of a row, the index of the point of the next row that continues it; -1: none."""
    none = np.full(len(here), -1, dtype=np.intp)
    if len(here) == 0 or len(there) == 0:
        return none
    lead = here[:, 0] - here[:, 2] / here[:, 1]  # along the edge, across its gradient
    back = there[:, 0] + there[:, 2] / there[:, 1]
    apart = np.abs(there[None, :, 0] - lead[:, None]) + np.abs(back[None] - here[:, None, 0])
    cosine = (here[:, None, 1] * there[None, :, 1] + here[:, None, 2] * there[None, :, 2]) / (
        here[:, None, 3] * there[None, :, 3]
    )
    ratio = np.minimum(here[:, None, 3], there[None, :, 3]) / np.maximum(here[:, None, 3], there[None, :, 3])
    bad = (apart > 2.0 * _BESIDE_PX) | (cosine < _SAME_DIRECTION) | (ratio < _SAME_STRENGTH)
    apart = np.where(bad, np.inf, apart)
    best = np.argmin(apart, axis=1)
    mutual = np.argmin(apart, axis=0)[best] == np.arange(len(here))
    return np.where(mutual & np.isfinite(apart[np.arange(len(here)), best]), best, none)


def _parabolas(chain: FloatArray, least_length: float) -> Curves:
    """Split a chain (n, 2) into parts that parabolas x(y) fit."""
    if len(chain) < _SMOOTHED or extent(chain) < least_length:
        return []
    y = chain[:, 1] - chain[:, 1].mean()
    basis = np.stack([np.ones_like(y), y, y * y / len(y)], axis=-1)
    fit, *_ = np.linalg.lstsq(basis, chain[:, 0], rcond=None)
    off = np.convolve(chain[:, 0] - basis @ fit, np.full(_SMOOTHED, 1.0 / _SMOOTHED), mode="same")
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) <= _BENT_PX:
        return [chain]
    cut = int(np.clip(worst, _SMOOTHED, len(chain) - _SMOOTHED))
    if not 0 < cut < len(chain):
        return []
    return [*_parabolas(chain[:cut], least_length), *_parabolas(chain[cut:], least_length)]


FARTHEST = 4.0
"""Largest component of the rotation in the search, in standard deviations of the prior."""
_ALIKE_PX = 8.0
"""Length along a curve over which errors of its points are correlated, px, as the adjacent surface causes them."""
_STEPS, _DONE = 30, 1e-3
"""Most steps; length of the last step relative to the standard deviations."""
_FLATTEST = 1e-9
"""Least absolute slope of ``Turned.slopes``, 1 / px, to avoid division by 0."""
_PARTS = (1.0, 0.3, 0.1, 0.03)
"""Shares of a step that are tried in turn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """The points of K curves."""

    rays: FloatArray
    """(N, 3) rays with z = 1."""
    time: FloatArray
    """(N,) frame periods since the middle of the frame's readout."""
    curve: NDArray[np.intp]
    """(N,) index of the curve, ascending."""
    upright: NDArray[np.bool_]
    """(N,) whether the point was found in its row and its error is along the row; otherwise along its column."""
    focal: FloatArray
    """(2,) px."""
    row_time: float
    """Frame periods of one row."""

    @classmethod
    def of(
        cls, curves: Sequence[FloatArray], camera: PinholeCamera, shutter: RollingShutter, view: View
    ) -> Points:
        """The points of one or more curves (n, 2), px, of a frame without a lens with rows read from the top."""
        side, frame = view
        pixels = np.concatenate(curves)
        lines = shutter.line_times(frame, side)
        counts = [len(each) for each in curves]
        spans = [np.abs(each[-1] - each[0]) for each in curves]
        return cls(
            rays=camera.unproject(pixels),
            time=shutter.pixel_time(pixels, frame, side) - 0.5 * float(lines[0] + lines[-1]),
            curve=np.repeat(np.arange(len(curves)), counts),
            upright=np.repeat([span[1] >= span[0] for span in spans], counts),
            focal=np.array([camera.fx, camera.fy]),
            row_time=shutter.h,
        )

    @property
    def count(self) -> int:
        """Number of curves, K."""
        return int(self.curve[-1]) + 1

    def chosen(self, curves: NDArray[np.bool_]) -> Points:
        """The points of the curves selected by a mask (K,)."""
        keep, number = curves[self.curve], np.cumsum(curves) - 1
        parts = {name: getattr(self, name)[keep] for name in ("rays", "time", "upright")}
        return Points(**parts, curve=number[self.curve[keep]], focal=self.focal, row_time=self.row_time)

    def sums(self, values: FloatArray) -> FloatArray:
        """(K, ...) sums of values (N, ...) over each curve."""
        starts = np.flatnonzero(np.diff(self.curve, prepend=-1))
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    def means(self, values: FloatArray) -> FloatArray:
        """(K,) means of values (N,) over each curve."""
        return self.sums(values) / self.sums(np.ones_like(values))


@dataclass(frozen=True, eq=False)
class Turned:
    """Points for a rotation w, and their errors for lines with given normals (K, 3)."""

    points: Points
    w: FloatArray
    R: FloatArray
    """(N, 3, 3) exp(s w)."""
    q: FloatArray
    """(N, 3) the rays rotated to the middle of the readout."""

    @classmethod
    def by(cls, points: Points, w: FloatArray) -> Turned:
        R = so3.exp(points.time[:, None] * w)
        return cls(points, w, R, (points.rays[:, None] @ R)[:, 0])

    def own(self, vectors: FloatArray) -> FloatArray:
        """(N, 3) vectors (K, 3) in the camera's axes at the points' times."""
        return np.asarray((self.R @ vectors[self.points.curve][..., None])[..., 0])

    def slopes(self, own: FloatArray) -> FloatArray:
        """(N,) change of l . q if a point moves by 1 px along its row or column, 1 / px; linear in l."""
        p = self.points
        later = p.row_time * np.sum(so3.cross(self.w, p.rays) * own, axis=1)
        return np.where(p.upright, own[:, 0] / p.focal[0], own[:, 1] / p.focal[1] - later)

    def errors(self, normals: FloatArray) -> FloatArray:
        """(N,) distances of points from their lines, px."""
        return np.sum(self.q * normals[self.points.curve], axis=1) / _safe(self.slopes(self.own(normals)))

    def by_turn(self, normals: FloatArray) -> FloatArray:
        """(N, 3) derivatives of ``errors`` by w."""
        p, own = self.points, self.own(normals)
        J = so3.left_jacobian(p.time[:, None] * self.w)
        above = (J @ so3.cross(normals[p.curve], self.q)[..., None])[..., 0]
        # ``own`` changes by s (J dw) x own; the cross product of own and the slope's direction is its derivative.
        direction = np.where(
            p.upright[:, None],
            np.array([1.0 / p.focal[0], 0.0, 0.0]),
            np.array([0.0, 1.0 / p.focal[1], 0.0]) - p.row_time * so3.cross(self.w, p.rays),
        )
        below = p.time[:, None] * (so3.cross(own, direction)[:, None] @ J)[:, 0]
        below -= np.where(p.upright[:, None], 0.0, p.row_time * so3.cross(p.rays, own))
        slope = _safe(self.slopes(own))[:, None]
        return np.asarray((p.time[:, None] * above - self.errors(normals)[:, None] * below) / slope)

    def by_normals(self, normals: FloatArray, directions: FloatArray) -> FloatArray:
        """(N, m) derivatives of ``errors`` by steps of the normals along m directions (K, m, 3)."""
        above = np.einsum("ni,nmi->nm", self.q, directions[self.points.curve])
        below = np.stack([self.slopes(self.own(directions[:, k])) for k in range(directions.shape[1])], axis=-1)
        slope = _safe(self.slopes(self.own(normals)))[:, None]
        return np.asarray((above - self.errors(normals)[:, None] * below) / slope)

    def nearest_normals(self) -> FloatArray:
        """(K, 3) unit normals of the planes next to each curve."""
        products = self.points.sums(self.q[:, :, None] * self.q[:, None])
        return np.asarray(np.linalg.eigh(products)[1][..., 0])


def _safe(slopes: FloatArray) -> FloatArray:
    return np.where(np.abs(slopes) > _FLATTEST, slopes, _FLATTEST)


class Step(NamedTuple):
    """Squared errors of each curve as a quadratic form of the p global unknowns, with its own m eliminated."""

    A: FloatArray
    """(K, p, p)"""
    b: FloatArray
    """(K, p)"""
    c: FloatArray
    """(K,) px^2; after a global step x, the squared error is c + 2 b . x + x . A x."""
    own: FloatArray
    """(K, m, p + 1): the step of a curve's own unknowns is -own (x, 1)."""


def reduced(points: Points, errors: FloatArray, by_all: FloatArray, by_own: FloatArray) -> Step:
    """Schur complement of the curves' own unknowns (N, m), from errors (N,) and derivatives (N, p)."""
    S = points.sums(by_own[:, :, None] * by_own[:, None])
    C = points.sums(by_own[:, :, None] * by_all[:, None])
    g = points.sums(by_own * errors[:, None])
    own = np.linalg.pinv(S, hermitian=True) @ np.concatenate([C, g[..., None]], axis=-1)
    A = points.sums(by_all[:, :, None] * by_all[:, None]) - np.swapaxes(C, 1, 2) @ own[..., :-1]
    b = points.sums(by_all * errors[:, None]) - (np.swapaxes(C, 1, 2) @ own[..., -1:])[..., 0]
    return Step(A, b, points.sums(errors * errors) - np.sum(g * own[..., -1], axis=1), own)


def across(normals: FloatArray) -> FloatArray:
    """(K, 2, 3) the two directions in which unit normals (K, 3) can turn."""
    return np.asarray(np.linalg.svd(normals[:, None])[2][:, 1:])


def step_of(turned: Turned, normals: FloatArray) -> Step:
    """Gauss-Newton step of w; at w = 0 it is the paper's model, linear in w and in the change of the lines."""
    by_normals = turned.by_normals(normals, across(normals))
    return reduced(turned.points, turned.errors(normals), turned.by_turn(normals), by_normals)


def moved(normals: FloatArray, directions: FloatArray, step: Step, x: FloatArray) -> FloatArray:
    """(K, 3) the normals after the own unknowns' step that belongs to the global step x (p,)."""
    t = -step.own @ np.append(x, 1.0)
    there = normals + np.einsum("km,kmi->ki", t, directions)
    return np.asarray(there / np.linalg.norm(there, axis=1, keepdims=True))


def lines_at(turned: Turned) -> FloatArray:
    """(K, 3) normals of the best line for each curve."""
    normals = turned.nearest_normals()
    return moved(normals, across(normals), step_of(turned, normals), np.zeros(3))


def noise_variance(points: Points, squares: float, unknowns: int) -> float:
    """Variance of a point's error, px^2, from the sum of squares; errors of neighbours are correlated."""
    return squares / max(len(points.time) / _ALIKE_PX - unknowns, 1.0)


class Turn(NamedTuple):
    """A rotation that makes curves straight."""

    w: FloatArray
    """(3,) rad per frame period."""
    normals: FloatArray
    """(K, 3) normals of the lines."""
    covariance: FloatArray
    """(3, 3) covariance of w, rad^2, from the errors and the prior."""

    def determined(self, prior: float) -> FloatArray | None:
        """w (3,) projected to the directions that the curves determine; None if they determine none.

        A direction is determined if its standard deviation is at most half of ``prior``, rad.
        """
        variances, axes = np.linalg.eigh(self.covariance)
        known = axes[:, variances <= 0.25 * prior**2]
        return np.asarray(known @ (known.T @ self.w)) if known.shape[1] else None


def straightened(points: Points, start: FloatArray, prior: float) -> Turn:
    """The rotation with the least squared distances of curves from lines, by Gauss-Newton from ``start`` (3,).

    ``prior`` is the standard deviation of a component of w, rad. It is weighted by the noise estimated from the
    errors, so that it determines what the lines do not, and exact curves give the exact rotation.
    """
    at, unknowns = Turned.by(points, np.asarray(start, dtype=np.float64)), 3 + 2 * points.count
    normals, covariance = lines_at(at), np.zeros((3, 3))
    for _ in range(_STEPS):
        step = step_of(at, normals)
        variance = noise_variance(points, float(np.sum(at.errors(normals) ** 2)), unknowns)
        hold = variance / prior**2
        A = step.A.sum(axis=0) + hold * np.eye(3)
        x = -np.linalg.lstsq(A, step.b.sum(axis=0) + hold * at.w, rcond=None)[0]
        covariance = variance * np.linalg.pinv(A, hermitian=True)
        found = _descended(at, normals, step, x, hold, FARTHEST * prior)
        if found is None:
            break
        at, normals = found
        if not x @ x > _DONE**2 * np.trace(covariance):
            break
    return Turn(at.w, normals, np.asarray(covariance))


def _descended(
    at: Turned, normals: FloatArray, step: Step, x: FloatArray, hold: float, most: float
) -> tuple[Turned, FloatArray] | None:
    """The state after the step x, or the first part of it that lowers the errors; None if none does."""

    def cost(at: Turned, normals: FloatArray) -> float:
        return float(np.sum(at.errors(normals) ** 2)) + hold * float(at.w @ at.w)

    before, directions = cost(at, normals), across(normals)
    for part in _PARTS:
        w = at.w + part * x
        if not np.max(np.abs(w)) <= most:
            continue
        there, lines = Turned.by(at.points, w), moved(normals, directions, step, part * x)
        if cost(there, lines) < before:
            return there, lines
    return None


FEWEST_LINES = 4
"""Number of curves in a sample, and fewest curves for a rotation."""
_ROUNDS = 5


@dataclass(frozen=True, kw_only=True)
class LineOptions:
    """Options of the search for the rotation from lines."""

    threshold_px: float = 0.2
    """Largest root mean square distance of a curve's points from a line, px."""
    samples: int = 500
    """Number of random samples of the search."""
    prior_deg: float = 3.0
    """Prior standard deviation of a component of the rotation in a frame period, degrees."""

    @property
    def prior(self) -> float:
        return float(np.radians(self.prior_deg))


def rotation_of_lines(points: Points | None, options: LineOptions, rng: np.random.Generator) -> Turn | str:
    """The rotation that makes most curves straight, or why there is none; ``points`` is None without curves."""
    count = 0 if points is None else points.count
    if points is None or count < FEWEST_LINES:
        return f"{count} curves that may be lines; {FEWEST} are needed"
    still = Turned.by(points, np.zeros(3))
    w = _best_sample(step_of(still, lines_at(still)), points, options, rng)
    kept = np.zeros(count, dtype=np.bool_)
    for _ in range(_ROUNDS):
        at = Turned.by(points, w)
        errors = at.errors(lines_at(at))
        straight = points.means(errors**2) < options.threshold_px**2
        if np.count_nonzero(straight) < FEWEST_LINES:
            return f"{np.count_nonzero(straight)} of {count} curves become straight together; {FEWEST} are needed"
        if np.array_equal(straight, kept):
            break
        kept = straight
        w = straightened(points.chosen(kept), w, options.prior).w
    return straightened(points.chosen(kept), w, options.prior)


def _best_sample(system: Step, points: Points, options: LineOptions, rng: np.random.Generator) -> FloatArray:
    """w (3,) with the least truncated squared errors among those of random samples and 0."""
    chosen = np.argsort(rng.random((options.samples, points.count)), axis=1)[:, :FEWEST_LINES]
    hold = (options.threshold_px / options.prior) ** 2
    A = system.A[chosen].sum(axis=1) + hold * np.eye(3)
    w = np.concatenate([np.zeros((1, 3)), -np.linalg.solve(A, system.b[chosen].sum(axis=1)[..., None])[..., 0]])
    w = w[np.max(np.abs(w), axis=1) <= FARTHEST * options.prior]
    squares = system.c + 2.0 * w @ system.b.T + np.einsum("si,kij,sj->sk", w, system.A, w)
    most = options.threshold_px**2 * points.sums(np.ones(len(points.time)))
    return np.asarray(w[np.argmin(np.minimum(squares, most).sum(axis=1))])


FEWEST = 8
"""Fewest inlier curves for a rotation: as many as there are unknowns, six, and two more."""
_SIN = 0.1
"""Sine of the largest angle between a segment and its direction in the search: fast rotations shear by it."""
_COARSER = (8.0, 4.0, 2.0, 1.0)
"""Thresholds of the rounds, relative to the last one."""
_STARTS, _ROUND_STEPS, _LAST_STEPS = 3, 3, 30
_CONVERGED = 1e-3


@dataclass(frozen=True, kw_only=True)
class ManhattanOptions:
    """Options of the search for the rotation from three orthogonal directions."""

    threshold_px: float = 0.3
    """Largest root mean square distance of a curve's points from a line along its direction, px."""
    least_share: float = 0.3
    """Least share of all points that lie on lines along the directions."""
    samples: int = 500
    """Number of random samples of the search."""
    prior_deg: float = 3.0
    """Prior standard deviation of a component of the rotation in a frame period, degrees."""

    @property
    def prior(self) -> float:
        return float(np.radians(self.prior_deg))


class _World(NamedTuple):
    """Curves for a rotation, three orthogonal directions, and the direction of each curve."""

    at: Turned
    axes: FloatArray
    """(3, 3) directions in the middle of the readout, as columns."""
    normals: FloatArray
    """(K, 3) normals of the lines."""
    own: NDArray[np.intp]
    """(K,) index of each curve's direction."""

    def along(self) -> FloatArray:
        """(K, 3) the direction of each curve."""
        return np.asarray(self.axes.T[self.own])

    def squares(self) -> FloatArray:
        """(K,) mean squared errors, px^2."""
        return self.at.points.means(self.at.errors(self.normals) ** 2)


def rotation_of_directions(
    points: Points | None, options: ManhattanOptions, rng: np.random.Generator
) -> Turn | str:
    """The rotation for which most curves follow three directions, or why not; ``points`` None: no curves."""
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
    """Distinct triples of directions (3, 3), as columns, with which most points agree without a rotation."""
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
    """Fit rotation and directions; returns truncated squared errors of all curves and the rotation, or why not."""
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
    """Assign to each curve the direction with the smallest error, and the best line along it."""
    products = at.points.sums(at.q[:, :, None] * at.q[:, None])
    normals = np.zeros((3, at.points.count, 3))
    for k in range(3):
        basis = np.delete(axes, k, axis=1)
        normals[k] = np.linalg.eigh(basis.T @ products @ basis)[1][..., 0] @ basis.T
    squares = np.stack([at.points.means(at.errors(each) ** 2) for each in normals])
    own = np.argmin(squares, axis=0)
    return _World(at, axes, normals[own, np.arange(at.points.count)], own)


def _least_squares(world: _World, prior: float, steps: int) -> tuple[Turn, FloatArray]:
    """Gauss-Newton steps of rotation and directions; ``prior`` is explained at ``straightened``."""
    points, covariance = world.at.points, np.zeros((3, 3))
    for _ in range(steps):
        step, directions = _step(world)
        squares = float(np.sum(world.at.errors(world.normals) ** 2))
        variance = noise_variance(points, squares, 6 + points.count)
        hold = np.diag([variance / prior**2] * 3 + [0.0] * 3)
        A, w = step.A.sum(axis=0) + hold, np.append(world.at.w, np.zeros(3))
        x = -np.linalg.lstsq(A, step.b.sum(axis=0) + hold @ w, rcond=None)[0]
        covariance = variance * np.linalg.pinv(A, hermitian=True)[:3, :3]
        after = _descended_world(world, step, directions, x, hold[0, 0], FARTHEST * prior)
        if after is None:
            break
        world = after
        if not x[:3] @ x[:3] > _CONVERGED**2 * np.trace(covariance):
            break
    return Turn(world.at.w, world.normals, np.asarray(covariance)), world.axes


def _step(world: _World) -> tuple[Step, FloatArray]:
    """The equations by the rotation and a rotation of the directions (6,); tangents (K, 1, 3) of normals."""
    directions = so3.cross(world.along(), world.normals)[:, None]
    turns = so3.cross(np.eye(3), world.normals[:, None])  # change of the normals with the directions, by x, y, z
    by_all = np.hstack([world.at.by_turn(world.normals), world.at.by_normals(world.normals, turns)])
    errors, by_own = world.at.errors(world.normals), world.at.by_normals(world.normals, directions)
    return reduced(world.at.points, errors, by_all, by_own), directions


def _descended_world(
    world: _World, step: Step, directions: FloatArray, x: FloatArray, hold: float, most: float
) -> _World | None:
    """The state after the step x, or the first part of it that lowers the errors; None if none does."""

    def cost(each: _World) -> float:
        return float(np.sum(each.at.errors(each.normals) ** 2)) + hold * float(each.at.w @ each.at.w)

    before = cost(world)
    for part in _PARTS:
        w = world.at.w + part * x[:3]
        if not np.max(np.abs(w)) <= most:
            continue
        turn = so3.exp(part * x[3:])
        axes = turn @ world.axes
        normals = moved(world.normals, directions, step, part * x) @ turn.T
        along = axes.T[world.own]  # project the normals back to the directions after the finite step
        normals = normals - np.sum(normals * along, axis=1, keepdims=True) * along
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        after = _World(Turned.by(world.at.points, w), axes, normals, world.own)
        if cost(after) < before:
            return after
    return None
