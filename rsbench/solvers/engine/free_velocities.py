"""Two frames of one rolling-shutter camera, each with a velocity of its own that nothing ties to the other.

Time s is a ray's second coordinate (of rows read from the top at constant speed) less that of a row to start from.
The camera of frame 0 moves as ``(exp(s w0), s v0)``, that of frame 1 as ``(exp(s w1) R, t + s v1)``, of the camera
that frame 0 has at s = 0. Between two rows the pose is

    R(s0, s1) = exp(s1 w1) R exp(-s0 w0),   T(s0, s1) = t + s1 v1 - s0 R(s0, s1) v0.

The paper's motion is one of these when s is 0 at the first row; linearisations hold best with 0 in the middle.

Y. Dai, H. Li, L. Kneip, Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016: the linear
model has w0 = w1 = 0, the uniform one all of it. How long the readout takes matters to neither.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.epipolar import epipolar_gradient, in_front
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.engine.free_kernels import free_from_row, free_in_front, free_terms


class FreeMotion(NamedTuple):
    """R (3, 3) and t, v0, v1, w0, w1 (3,), the velocities by s; all translations have one unknown unit."""

    R: FloatArray
    t: FloatArray
    v0: FloatArray
    v1: FloatArray
    w0: FloatArray
    w1: FloatArray

    def between(self, s0: FloatArray, s1: FloatArray) -> Pose:
        """Pose (..., 3, 3), (..., 3) of row s1 (...) of frame 1 from row s0 (...) of frame 0."""
        s0, s1 = s0[..., None], s1[..., None]
        R = so3.exp(s1 * self.w1) @ self.R @ so3.exp(-s0 * self.w0)
        return Pose(R, self.t + s1 * self.v1 - s0 * (R @ self.v0))

    def moved(self, step: FloatArray) -> FreeMotion:
        """With a step (..., 18) or, without rotations in the frames, (..., 12)."""
        step = np.concatenate([step, np.zeros((*step.shape[:-1], 18 - step.shape[-1]))], axis=-1)
        turn, *rest = np.split(step, 6, axis=-1)
        return FreeMotion(so3.exp(turn) @ self.R, *(a + b for a, b in zip(self[1:], rest, strict=True)))

    def of_unit_length(self) -> FreeMotion:
        """With |t| = 1."""
        length = max(float(np.linalg.norm(self.t)), 1e-300)
        return self._replace(t=self.t / length, v0=self.v0 / length, v1=self.v1 / length)

    def flipped(self) -> FreeMotion:
        """All translations the other way: the other sign of the essential matrices."""
        return self._replace(t=-self.t, v0=-self.v0, v1=-self.v1)

    def twin(self) -> FreeMotion:
        """Frame 1 turned by half a turn about t: where all translations are along t, the same constraints."""
        return self._replace(R=so3.exp(np.pi * self.t / np.linalg.norm(self.t)) @ self.R)

    def at_rest(self) -> FreeMotion:
        """Without velocities."""
        return FreeMotion(self.R, self.t, *np.zeros((4, 3)))


class Rows(NamedTuple):
    """Matches of one camera: rays (n, 3) of frames 0 and 1, z = 1, and their s (n,)."""

    x: FloatArray
    y: FloatArray
    s0: FloatArray
    s1: FloatArray
    camera: PinholeCamera
    affine: FloatArray
    """(n, 4) of ``Correspondences.affine``, or (n, 0)."""

    @classmethod
    def of(cls, matches: FloatArray, camera: PinholeCamera, first: float) -> Rows:
        """Of matches (n, 4), or (n, 8) with affine frames, with s = 0 at the row ``first``."""
        x, y = camera.unproject(matches[:, :2]), camera.unproject(matches[:, 2:4])
        s0, s1 = (matches[:, 1] - first) / camera.fy, (matches[:, 3] - first) / camera.fy
        return cls(x, y, s0, s1, camera, matches[:, 4:])

    def packed(self) -> FloatArray:
        """(n, 6) as the kernels take them."""
        return np.column_stack([self.x[:, :2], self.y[:, :2], self.s0, self.s1])


def constraint(motion: FreeMotion, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """y^T [T]x R x (n,) and its derivatives (n, 4) by the pixels: a row that moves is another pose too."""
    x, y, s0, s1, camera, _ = rows
    R, T = motion.between(s0, s1)
    p, Rv0 = (R @ x[:, :, None])[:, :, 0], R @ motion.v0
    gradient = epipolar_gradient(hat(T) @ R, x, y, camera)
    spin0 = -(so3.exp(s1[:, None] * motion.w1) @ (motion.R @ motion.w0))  # dR/ds0 = [spin0]x R
    for column, spin, rate in (
        (1, spin0, -Rv0 - s0[:, None] * so3.cross(spin0, Rv0)),
        (3, motion.w1, motion.v1 - s0[:, None] * so3.cross(motion.w1, Rv0)),
    ):
        change = so3.cross(rate, p) + so3.cross(T, so3.cross(spin, p))
        gradient[:, column] += np.sum(y * change, axis=1) / camera.fy
    return np.sum(y * so3.cross(T, p), axis=1), gradient


def sampson(motion: FreeMotion, rows: Rows) -> FloatArray:
    """Rolling-shutter Sampson errors (n,), px."""
    value, gradient = constraint(motion, rows)
    norm = np.linalg.norm(gradient, axis=1)
    return np.where(norm > 0.0, value / np.where(norm > 0.0, norm, 1.0), 0.0)


def sampson_jacobian(motion: FreeMotion, rows: Rows) -> FloatArray:
    """(n, 18) by ``FreeMotion.moved``, such that J^T times the errors is the gradient of half their squares.

    The constraint's derivative at the corrected measurement, over the norm: see ``engine.kernels``.
    """
    value, gradient = constraint(motion, rows)
    norm = np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None]
    step = (value[:, None] / norm**2 * gradient).reshape(-1, 2, 2) / [rows.camera.fx, rows.camera.fy]
    pad = np.zeros((len(step), 1))
    x, y = rows.x - np.hstack([step[:, 0], pad]), rows.y - np.hstack([step[:, 1], pad])
    s0, s1 = (rows.s0 - step[:, 0, 1])[:, None], (rows.s1 - step[:, 1, 1])[:, None]
    R, T = motion.between(s0[:, 0], s1[:, 0])
    A, p = so3.exp(s1 * motion.w1), (R @ x[:, :, None])[:, :, 0]
    n = so3.cross(p, y)
    by_turn = so3.cross(p, so3.cross(y, T)) - s0 * so3.cross(R @ motion.v0, n)  # of R, as [turn]x R

    def back(M: FloatArray, rows_of: FloatArray) -> FloatArray:
        return np.asarray((np.swapaxes(M, 1, 2) @ rows_of[:, :, None])[:, :, 0])

    by_w0 = back(A @ motion.R @ so3.left_jacobian(-s0 * motion.w0), by_turn)
    by_w1 = back(so3.left_jacobian(s1 * motion.w1), by_turn)
    parts = [back(A, by_turn), n, -s0 * back(R, n), s1 * n, -s0 * by_w0, s1 * by_w1]
    return np.concatenate(parts, axis=1) / norm


def errors(motion: FreeMotion, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """``sampson`` (n,) and ``sampson_jacobian`` (n, 18), compiled."""
    r, J = np.zeros(len(rows.x)), np.zeros((len(rows.x), 18))
    focal = np.array([rows.camera.fx, rows.camera.fy])
    free_terms(motion.R, np.stack(motion[1:]), rows.packed(), focal, r, J)
    return r, J


def squares(motion: FreeMotion, rows: Rows) -> float:
    """Sum of the squares of ``sampson``, compiled."""
    r, focal = np.zeros(len(rows.x)), np.array([rows.camera.fx, rows.camera.fy])
    free_terms(motion.R, np.stack(motion[1:]), rows.packed(), focal, r, np.zeros((0, 18)))
    total = float(r @ r)
    return total if np.isfinite(total) else np.inf


def signed(motion: FreeMotion, rows: Rows) -> tuple[FreeMotion, int]:
    """The sign of the translations that has more points in front of both cameras, and how many.

    The length of T over that of t is the least certain of all: estimates of it pass zero in the middle of the
    image, where then half of the points would vote for either sign of t. T is taken to lie on the side of t.
    """
    front, back = (free_in_front(each.R, np.stack(each[1:]), rows.packed()) for each in (motion, motion.flipped()))
    return (motion, front) if front >= back else (motion.flipped(), back)


def in_front_of_both(motion: FreeMotion, rows: Rows) -> int:
    """How many points lie in front of both cameras if T lies on the side of t."""
    R, T = motion.between(rows.s0, rows.s1)
    return int(np.count_nonzero(in_front(Pose(R, T * np.sign(T @ motion.t)[:, None]), rows.x, rows.y)))


def from_row(motion: FreeMotion, s: float) -> FreeMotion:
    """The motion with s = 0 at another row: its pose exactly, its velocities as they are there."""
    R, vectors = np.zeros((3, 3)), np.zeros((5, 3))
    free_from_row(motion.R, np.stack(motion[1:]), s, R, vectors)
    return FreeMotion(R, *vectors)
