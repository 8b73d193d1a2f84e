"""How straight curves of a rolling-shutter frame become when its rows are turned: rotation from straight lines.

A camera that turns by exp(s w) in the time s sees the points of a line in space, whose plane through the centre
has the normal l at s = 0, on rays r with

    l . q = 0,   q = exp(-s w) r.

A curve is l's two degrees of freedom and what the rotation bends. To first order, l . (r - s w x r) = 0, the
model of Y. Lao, O. Ait-Aider, A Robust Method for Strong Rolling Shutter Effects Correction Using Lines with
Automatic Feature Selection, CVPR 2018. An upright line that is not slanted tells roll, and off the middle pitch;
yaw shears it, which leaves it straight: only slanted lines off the middle tell yaw.

One rotation makes everything straight: the pitch that turns all rows' rays into one plane (height / (focal
length x readout ratio), tens of degrees in a frame period; C. Albl, A. Sugimoto, T. Pajdla, Degeneracies in
Rolling Shutter SfM, ECCV 2016, have it of points). Errors are therefore px in the frame as it was, a flat
curve's at the time that an error of its row changes too: as l . q, or in the corrected image, they would shrink
towards that rotation and draw every estimate there. Nothing is looked for beyond ``FARTHEST`` expected sizes of
a component.

All curves' points lie one after another, (N,); ``curve`` (N,) says whose each is, from 0 to K - 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

FARTHEST = 4.0
"""Standard deviations of a component of the rotation within which it is looked for."""
_ALIKE_PX = 8.0
"""Length along a curve over which the errors of its places are one: the surface beside it makes them."""
_STEPS, _DONE = 30, 1e-3
"""The last step is this share of the standard deviations."""
_FLATTEST = 1e-9
"""Slope, 1 / px, of a curve along its row."""
_PARTS = (1.0, 0.3, 0.1, 0.03)
"""Of a step, tried in turn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """The points of K curves."""

    rays: FloatArray
    """(N, 3) z = 1."""
    time: FloatArray
    """(N,) frame periods since the middle of the frame's readout."""
    curve: NDArray[np.intp]
    """(N,) grows."""
    upright: NDArray[np.bool_]
    """(N,) whether a point was found in its row, with an error along it; else in its column."""
    focal: FloatArray
    """(2,) px."""
    row_time: float
    """Frame periods of one row."""

    @classmethod
    def of(
        cls, curves: Sequence[FloatArray], camera: PinholeCamera, shutter: RollingShutter, view: View
    ) -> Points:
        """Of one curve (n, 2), px, or more of a frame without a lens whose rows are read from the top."""
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
        """K, of curves."""
        return int(self.curve[-1]) + 1

    def chosen(self, curves: NDArray[np.bool_]) -> Points:
        """Those of the curves of a mask (K,)."""
        keep, number = curves[self.curve], np.cumsum(curves) - 1
        parts = {name: getattr(self, name)[keep] for name in ("rays", "time", "upright")}
        return Points(**parts, curve=number[self.curve[keep]], focal=self.focal, row_time=self.row_time)

    def sums(self, values: FloatArray) -> FloatArray:
        """(K, ...) of values (N, ...) over each curve."""
        starts = np.flatnonzero(np.diff(self.curve, prepend=-1))
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    def means(self, values: FloatArray) -> FloatArray:
        """(K,) of values (N,) over each curve."""
        return self.sums(values) / self.sums(np.ones_like(values))


@dataclass(frozen=True, eq=False)
class Turned:
    """Points at a rotation w, and what lines of normals (K, 3) there mean."""

    points: Points
    w: FloatArray
    R: FloatArray
    """(N, 3, 3) exp(s w)."""
    q: FloatArray
    """(N, 3) the rays as the camera would see them in the middle of the readout."""

    @classmethod
    def by(cls, points: Points, w: FloatArray) -> Turned:
        R = so3.exp(points.time[:, None] * w)
        return cls(points, w, R, (points.rays[:, None] @ R)[:, 0])

    def own(self, vectors: FloatArray) -> FloatArray:
        """(N, 3) vectors (K, 3) as the camera sees them at the points' times."""
        return np.asarray((self.R @ vectors[self.points.curve][..., None])[..., 0])

    def slopes(self, own: FloatArray) -> FloatArray:
        """(N,) what l . q changes by when a point moves by 1 px along its row or column, 1 / px; linear in l."""
        p = self.points
        later = p.row_time * np.sum(so3.cross(self.w, p.rays) * own, axis=1)
        return np.where(p.upright, own[:, 0] / p.focal[0], own[:, 1] / p.focal[1] - later)

    def errors(self, normals: FloatArray) -> FloatArray:
        """(N,) px by which points are off their lines."""
        return np.sum(self.q * normals[self.points.curve], axis=1) / _safe(self.slopes(self.own(normals)))

    def by_turn(self, normals: FloatArray) -> FloatArray:
        """(N, 3) derivatives of ``errors`` by w."""
        p, own = self.points, self.own(normals)
        J = so3.left_jacobian(p.time[:, None] * self.w)
        above = (J @ so3.cross(normals[p.curve], self.q)[..., None])[..., 0]
        # Own turns by s (J dw) x own; each slope's direction, crossed with own, is the derivative by J dw.
        way = np.where(
            p.upright[:, None],
            np.array([1.0 / p.focal[0], 0.0, 0.0]),
            np.array([0.0, 1.0 / p.focal[1], 0.0]) - p.row_time * so3.cross(self.w, p.rays),
        )
        below = p.time[:, None] * (so3.cross(own, way)[:, None] @ J)[:, 0]
        below -= np.where(p.upright[:, None], 0.0, p.row_time * so3.cross(p.rays, own))
        slope = _safe(self.slopes(own))[:, None]
        return np.asarray((p.time[:, None] * above - self.errors(normals)[:, None] * below) / slope)

    def by_normals(self, normals: FloatArray, ways: FloatArray) -> FloatArray:
        """(N, m) derivatives of ``errors`` by steps of the normals along m ways (K, m, 3)."""
        above = np.einsum("ni,nmi->nm", self.q, ways[self.points.curve])
        below = np.stack([self.slopes(self.own(ways[:, k])) for k in range(ways.shape[1])], axis=-1)
        slope = _safe(self.slopes(self.own(normals)))[:, None]
        return np.asarray((above - self.errors(normals)[:, None] * below) / slope)

    def nearest_normals(self) -> FloatArray:
        """(K, 3) unit normals of the planes next to each curve."""
        products = self.points.sums(self.q[:, :, None] * self.q[:, None])
        return np.asarray(np.linalg.eigh(products)[1][..., 0])


def _safe(slopes: FloatArray) -> FloatArray:
    return np.where(np.abs(slopes) > _FLATTEST, slopes, _FLATTEST)


class Step(NamedTuple):
    """Errors of each curve as a quadratic form of the p global unknowns, its own m ones at their best."""

    A: FloatArray
    """(K, p, p)"""
    b: FloatArray
    """(K, p)"""
    c: FloatArray
    """(K,) px^2: squared errors at no step; at a step x, c + 2 b . x + x . A x."""
    own: FloatArray
    """(K, m, p + 1): the own unknowns' best step is -own (x, 1)."""


def reduced(points: Points, errors: FloatArray, by_all: FloatArray, by_own: FloatArray) -> Step:
    """Schur's complement of the unknowns (N, m) of the single curves, from errors (N,) and derivatives (N, p)."""
    S = points.sums(by_own[:, :, None] * by_own[:, None])
    C = points.sums(by_own[:, :, None] * by_all[:, None])
    g = points.sums(by_own * errors[:, None])
    own = np.linalg.pinv(S, hermitian=True) @ np.concatenate([C, g[..., None]], axis=-1)
    A = points.sums(by_all[:, :, None] * by_all[:, None]) - np.swapaxes(C, 1, 2) @ own[..., :-1]
    b = points.sums(by_all * errors[:, None]) - (np.swapaxes(C, 1, 2) @ own[..., -1:])[..., 0]
    return Step(A, b, points.sums(errors * errors) - np.sum(g * own[..., -1], axis=1), own)


def across(normals: FloatArray) -> FloatArray:
    """(K, 2, 3) the two ways in which unit normals (K, 3) can turn."""
    return np.asarray(np.linalg.svd(normals[:, None])[2][:, 1:])


def step_of(turned: Turned, normals: FloatArray) -> Step:
    """Gauss and Newton's of w; at w = 0 the paper's model, linear in w and in the change of the lines."""
    by_normals = turned.by_normals(normals, across(normals))
    return reduced(turned.points, turned.errors(normals), turned.by_turn(normals), by_normals)


def moved(normals: FloatArray, ways: FloatArray, step: Step, x: FloatArray) -> FloatArray:
    """(K, 3) the normals after the own unknowns' best step beside the global step x (p,)."""
    t = -step.own @ np.append(x, 1.0)
    there = normals + np.einsum("km,kmi->ki", t, ways)
    return np.asarray(there / np.linalg.norm(there, axis=1, keepdims=True))


def lines_at(turned: Turned) -> FloatArray:
    """(K, 3) normals of the lines nearest to each curve."""
    normals = turned.nearest_normals()
    return moved(normals, across(normals), step_of(turned, normals), np.zeros(3))


def noise_variance(points: Points, squares: float, unknowns: int) -> float:
    """px^2 of a point whose neighbours err alike: from the sum of squares and the number of unknowns."""
    return squares / max(len(points.time) / _ALIKE_PX - unknowns, 1.0)


class Turn(NamedTuple):
    """A rotation that makes curves straight."""

    w: FloatArray
    """(3,) rad per frame period."""
    normals: FloatArray
    """(K, 3)"""
    covariance: FloatArray
    """(3, 3) rad^2 of w, from the errors and the prior."""

    def determined(self, prior: float) -> FloatArray | None:
        """w (3,) in the directions that the curves tell, 0 in those they leave open; None where they tell none.

        A direction is told where its standard deviation is at most half of ``prior``, rad.
        """
        variances, axes = np.linalg.eigh(self.covariance)
        told = axes[:, variances <= 0.25 * prior**2]
        return np.asarray(told @ (told.T @ self.w)) if told.shape[1] else None


def straightened(points: Points, start: FloatArray, prior: float) -> Turn:
    """Rotation of least squared distance of all curves from lines, Gauss and Newton's steps from ``start`` (3,).

    ``prior`` is what a component of w is expected to be, rad: a standard deviation. It is weighed by the noise
    that the errors show, so that it holds what the lines leave open, and exact curves have their exact rotation.
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
    """Where the step x, or a part of it, lowers the errors; None where none does."""

    def cost(at: Turned, normals: FloatArray) -> float:
        return float(np.sum(at.errors(normals) ** 2)) + hold * float(at.w @ at.w)

    before, ways = cost(at, normals), across(normals)
    for part in _PARTS:
        w = at.w + part * x
        if not np.max(np.abs(w)) <= most:
            continue
        there, lines = Turned.by(at.points, w), moved(normals, ways, step, part * x)
        if cost(there, lines) < before:
            return there, lines
    return None
