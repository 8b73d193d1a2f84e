"""Generalised essential matrices of one rolling-shutter camera, by singular value decomposition.

Y. Dai, H. Li, L. Kneip, Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016. With the
rows s0 and s1 as times, the essential matrix of two rows is a polynomial in them,

    E(s0, s1) = [t + s1 v1]x Q - Q [s0 v0]x,   Q = (I + s1 [w1]x) R (I - s0 [w0]x),

of degree 1 in each where w0 = w1 = 0 (linear), else 2 (uniform). y^T E x is then a bilinear form of the monomials

    (p s^i, i <= degree; s^j, j <= degree + 1)   of each ray (p, s, 1),

5 x 5 or 7 x 7 of them without the 2 x 2 products of the highest ones, which do not occur: 21 or 45 coefficients,
of 20 or 44 matches. Several entries of the E's fall into one coefficient, so that the E's cannot be read off
alone; R, t and the velocities are those whose coefficients come nearest to the null vector.

No card names it yet: its Sampson descent is stopped before it ends, which would show the method weaker than it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import scipy
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.engine.free_solver import FreeVelocitySolver
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, in_front_of_both, signed
from rsbench.solvers.engine.linear_systems import null_vector

_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_ALTERNATIONS = 6
_STEP, _MOST = 1e-6, 25
_ROUNDING = 1e-14
"""The 45 coefficients of slow motion are separate by 1e-10 of the largest singular value and less."""


def monomials(x: FloatArray, degree: int) -> FloatArray:
    """(n, 2 degree + 3) of rays (n, 3)."""
    p, s = x[:, 0], x[:, 1]
    return np.stack([*(p * s**i for i in range(degree + 1)), *(s**j for j in range(degree + 2))], axis=-1)


def occurring(degree: int) -> NDArray[np.bool_]:
    """Mask (m, m) of the products of monomials that occur, frame 1 first."""
    highest = np.zeros(2 * degree + 3, dtype=np.bool_)
    highest[[degree, 2 * degree + 2]] = True
    return ~np.outer(highest, highest)


def system(rows: Rows, degree: int) -> FloatArray:
    """(n, 21) or (n, 45) of rows whose s = 0 is the principal point's."""
    products = monomials(rows.y, degree)[:, :, None] * monomials(rows.x, degree)[:, None, :]
    return products[:, occurring(degree)]


def _places(power: int, degree: int) -> list[int]:
    """Monomials of the ray's entries p, s and 1 times s^power."""
    return [power, degree + 2 + power, degree + 1 + power]


def coefficients(motion: FreeMotion, degree: int) -> FloatArray:
    """The (..., 21) or (..., 45) coefficients of motions."""
    before = [np.eye(3), hat(motion.w1)][:degree]
    after = [np.eye(3), -hat(motion.w0)][:degree]
    t, v0, v1 = hat(motion.t), hat(motion.v0), hat(motion.v1)
    G = np.zeros((*motion.t.shape[:-1], 2 * degree + 3, 2 * degree + 3))
    for a, L in enumerate(before):
        for b, N in enumerate(after):
            Q = L @ motion.R @ N
            for power1, power0, E in ((a, b, t @ Q), (a + 1, b, v1 @ Q), (a, b + 1, -Q @ v0)):
                rows, columns = np.array(_places(power1, degree)), np.array(_places(power0, degree))
                G[..., rows[:, None], columns] += E
    return np.asarray(G[..., occurring(degree)])


def extract(F: FloatArray, degree: int) -> list[FreeMotion]:
    """Two motions whose coefficients are near to F, (21,) or (45,) of arbitrary length and sign; the nearer first.

    Where all velocities are parallel to t, as in slow motion nearly, frame 1 may be turned by half a turn about
    it. Least squares over all unknowns, from the best of ``_starts``, and from there turned so.
    """
    F = F / np.linalg.norm(F)

    def misfit(motion: FreeMotion) -> float:
        return float(np.linalg.norm(_difference(motion, F, degree)))

    end = _nearest(F, min(_starts(F, degree), key=misfit), degree)
    twin = _translations(F, so3.exp(np.pi * end.t) @ end.R, degree)
    return sorted([end, _nearest(F, twin._replace(w0=end.w0, w1=end.w1), degree)], key=misfit)


def _difference(motion: FreeMotion, F: FloatArray, degree: int) -> FloatArray:
    """(..., 21) or (..., 45) what unit coefficients have across F."""
    C = coefficients(motion, degree)
    C = C / np.maximum(np.linalg.norm(C, axis=-1, keepdims=True), 1e-300)
    return np.asarray(C - (C @ F)[..., None] * F)


def _nearest(F: FloatArray, start: FreeMotion, degree: int) -> FreeMotion:
    start, unknowns = start.of_unit_length(), 12 if degree == 1 else 18

    def difference(step: FloatArray) -> FloatArray:
        return _difference(start.moved(step), F, degree)

    def jacobian(step: FloatArray) -> FloatArray:
        shifts = _STEP * np.eye(unknowns)
        return (difference(step + shifts) - difference(step - shifts)).T / (2.0 * _STEP)

    end = scipy.optimize.least_squares(
        difference, np.zeros(unknowns), jacobian, method="lm", xtol=1e-14, ftol=1e-6, max_nfev=_MOST
    )
    return start.moved(end.x).of_unit_length()


def _starts(F: FloatArray, degree: int) -> list[FreeMotion]:
    """By turns the translations that fit a rotation best, and the rotation of what they leave of t's matrix.

    From either rotation of an essential matrix.
    """
    G = np.zeros((2 * degree + 3, 2 * degree + 3))
    G[occurring(degree)] = F
    place = np.ix_(_places(0, degree), _places(0, degree))
    found = []
    for quarter in (_QUARTER, _QUARTER.T):
        E = G[place]
        for _ in range(_ALTERNATIONS):
            U, _, Vt = np.linalg.svd(E)
            R = U @ quarter @ Vt
            motion = _translations(F, R * np.sign(np.linalg.det(R)), degree)
            others = np.zeros_like(G)
            others[occurring(degree)] = coefficients(motion._replace(t=np.zeros(3)), degree)
            E = (G - others)[place]
            found.append(motion)
    return found


def _translations(F: FloatArray, R: FloatArray, degree: int) -> FreeMotion:
    zero = np.zeros((9, 3))
    units = np.swapaxes(np.eye(9).reshape(9, 3, 3), 0, 1)
    basis = coefficients(FreeMotion(R, units[0], units[1], units[2], zero, zero), degree)
    found = np.asarray(np.linalg.lstsq(basis.T, F, rcond=None)[0], dtype=np.float64)
    return FreeMotion(R, found[:3], found[3:6], found[6:], zero[0], zero[0])


@final
@dataclass(frozen=True, kw_only=True)
class DaiSolver(FreeVelocitySolver):
    """The null vector of 21 or 45 coefficients, the motion nearest to it, and a descent on Sampson errors.

    The velocities of both frames are free and are not returned: on data that have one velocity, 6 or 12 unknowns
    are estimated for nothing, and what noise does grows by a factor of ten and more. In slow motion s0 and s1 are
    nearly equal, and the 45 coefficients nearly collinear.
    """

    model: Literal["linear", "uniform"] = "linear"
    """Whether the camera turns within a frame; the linear one leaves that out and is biased where it does."""

    @property
    def turning(self) -> bool:
        return self.model == "uniform"

    @property
    def least(self) -> int:
        return 20 if self.model == "linear" else 44

    @property
    def about(self) -> tuple[str, str]:
        held = "no rotation within a frame" if self.model == "linear" else "small rotation within a frame"
        return (
            "Dai, Li, Kneip: Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016",
            f"{held}; a constant velocity in each; readout ratio above 0; a scene that is not planar; translation",
        )

    def linear(self, rows: Rows) -> FreeMotion | str:
        degree = 2 if self.turning else 1
        F, reason = null_vector(system(rows, degree), unit_columns=True, rounding=_ROUNDING)
        if F is None:
            return reason
        return max(extract(F, degree), key=lambda end: in_front_of_both(signed(end, rows), rows))
