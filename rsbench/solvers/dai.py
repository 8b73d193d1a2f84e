"""Generalised essential matrices of one rolling-shutter camera, by singular value decomposition.

Y. Dai, H. Li, L. Kneip, Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016. With the
rows s0 and s1 as times, the essential matrix of two rows is a polynomial in them,

    E(s0, s1) = [t + s1 v1]x Q - Q [s0 v0]x,   Q = (I + s1 [w1]x) R (I - s0 [w0]x),

of degree 1 in each where w0 = w1 = 0 (linear), else 2 (uniform). y^T E x is then a bilinear form of the monomials

    (p s^i, i <= degree; s^j, j <= degree + 1)   of each ray (p, s, 1),

5 x 5 or 7 x 7 of them without the 2 x 2 products of the highest ones, which do not occur: 21 or 45 coefficients,
of 20 or 44 matches. Several entries of the E's fall into one coefficient, so that the E's cannot be read off
alone; R, t and the velocities are those whose coefficients come nearest to the null vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.eight_point import decompose_essential, eight_point
from rsbench.solvers.engine.base import MatchSet, MotionEstimate
from rsbench.solvers.engine.free_descent import nearest
from rsbench.solvers.engine.free_solver import FreeVelocitySolver
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows
from rsbench.solvers.engine.generalised_essential import coefficients, places, with_derivatives
from rsbench.solvers.engine.linear_systems import null_vector

_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_ALTERNATIONS, _MOST = 4, 30
_SAMPLE = 20
_ROUNDING = 1e-14
"""The 45 coefficients of slow motion are separate by 1e-10 of the largest singular value and less."""


def monomials(x: FloatArray, degree: int) -> FloatArray:
    """(n, 2 degree + 3) of rays (n, 3)."""
    p, s = x[:, 0], x[:, 1]
    return np.stack([*(p * s**i for i in range(degree + 1)), *(s**j for j in range(degree + 2))], axis=-1)


def system(rows: Rows, degree: int) -> FloatArray:
    """(n, 21) or (n, 45) of rows whose s = 0 is the principal point's."""
    products = monomials(rows.y, degree)[:, :, None] * monomials(rows.x, degree)[:, None, :]
    return products[:, places(degree) >= 0]


def extract(F: FloatArray, degree: int) -> list[FreeMotion]:
    """Motions whose coefficients are near to F, (21,) or (45,) of arbitrary length and sign; the nearest first.

    Least squares over all unknowns, from either rotation of an essential matrix. Where all velocities are along t,
    as in slow motion nearly, the twin of each has nearly the same coefficients.
    """
    F = F / np.linalg.norm(F)
    ends = [nearest(_start(F, quarter, degree), F, degree, _MOST) for quarter in (_QUARTER, _QUARTER.T)]
    near = [end for end, _ in sorted(ends, key=lambda end: end[1])]
    return [*near, *(end.twin() for end in near)]


def without_velocities(rows: Rows) -> FreeMotion | None:
    """R and t of one essential matrix for all rows, of the eight-point algorithm; None where there are more."""
    E = eight_point(rows.x, rows.y)
    if E is None:
        return None
    pose, _ = decompose_essential(E, rows.x, rows.y)
    return FreeMotion(pose.R, pose.t, *np.zeros((4, 3)))


def _start(F: FloatArray, quarter: FloatArray, degree: int) -> FreeMotion:
    """By turns the translations that fit a rotation best, and the rotation of what they leave of t's matrix."""
    G, place = np.zeros((2 * degree + 3, 2 * degree + 3)), places(degree)
    G[place >= 0] = F
    block = np.ix_([0, degree + 2, degree + 1], [0, degree + 2, degree + 1])
    E = G[block]
    for _ in range(_ALTERNATIONS):
        U, _, Vt = np.linalg.svd(E)
        R = U @ quarter @ Vt
        motion = _translations(F, R * np.sign(np.linalg.det(R)), degree)
        others = np.zeros_like(G)
        others[place >= 0] = coefficients(motion._replace(t=np.zeros(3)), degree)
        E = (G - others)[block]
    return motion


def _translations(F: FloatArray, R: FloatArray, degree: int) -> FreeMotion:
    zero = np.zeros(3)
    basis = with_derivatives(FreeMotion(R, *np.zeros((5, 3))), degree)[1][3:12]
    found = np.asarray(np.linalg.lstsq(basis.T, F, rcond=None)[0], dtype=np.float64)
    return FreeMotion(R, found[:3], found[3:6], found[6:], zero, zero)


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
        return _SAMPLE if self.model == "linear" else 44

    @property
    def about(self) -> tuple[str, str]:
        held = "no rotation within a frame" if self.model == "linear" else "small rotation within a frame"
        return (
            "Dai, Li, Kneip: Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016",
            f"{held}; a constant velocity in each; readout ratio above 0; a scene that is not planar; translation",
        )

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        degree = 2 if self.turning else 1
        F, reason = null_vector(system(rows, degree), unit_columns=True, rounding=_ROUNDING)
        return reason if F is None else extract(F, degree)

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Motions of the smaller models: noise spoils 45 coefficients long before it spoils 21 or 9."""
        F, _ = null_vector(system(rows, 1), unit_columns=True) if self.turning else (None, "")
        still = without_velocities(rows)
        return [*([] if F is None else extract(F, 1)), *([] if still is None else [still])]

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": _SAMPLE}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        """By the linear model: no 44 matches with noise of 0.3 px give a rotation, and few are free of outliers."""
        linear = replace(self, model="linear") if self.turning else self
        return super(DaiSolver, linear).propose(sample, rig, shutter)
