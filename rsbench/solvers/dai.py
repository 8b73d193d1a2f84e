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

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate
from rsbench.solvers.engine.free_descent import nearest
from rsbench.solvers.engine.free_samples import propose
from rsbench.solvers.engine.free_solver import QUARTER, FreeVelocitySolver, motion_of, without_velocities
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows
from rsbench.solvers.engine.generalised_essential import places, with_derivatives
from rsbench.solvers.engine.linear_systems import null_vector

_MOST = 30
_SAMPLE, _SAMPLE_MOST = 20, (10, 16)
"""Matches of a sample of the robust search; evaluations of its descents to coefficients and of Sampson errors."""
_SINGULAR = "the linear system has more than one solution: degenerate motion, scene or readout ratio"
_ROUNDING = 1e-14
"""The 45 coefficients of slow motion are separate by 1e-10 of the largest singular value and less."""


def monomials(x: FloatArray, degree: int) -> FloatArray:
    """(..., 2 degree + 3) of rays (..., 3)."""
    p, s = x[..., 0], x[..., 1]
    return np.stack([*(p * s**i for i in range(degree + 1)), *(s**j for j in range(degree + 2))], axis=-1)


def system(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """(..., 21) or (..., 45) of rays (..., 3) of frames 0 and 1, z = 1: s = 0 is the principal point's row."""
    products = monomials(y, degree)[..., :, None] * monomials(x, degree)[..., None, :]
    return products[..., places(degree) >= 0]


def extract(F: FloatArray, degree: int) -> list[FreeMotion]:
    """Motions whose coefficients are near to F, (21,) or (45,) of arbitrary length and sign; the nearest first.

    Least squares over all unknowns, from either rotation of an essential matrix. Where all velocities are along t,
    as in slow motion nearly, the twin of each has nearly the same coefficients.
    """
    F = F / np.linalg.norm(F)
    begun = [FreeMotion(R, *vectors) for R, vectors in zip(*_starts(F, degree), strict=True)]
    ends = [nearest(each, F, degree, _MOST) for each in begun]
    twin = min(ends, key=lambda end: end[1])[0].twin()
    t, v0, v1 = _translations(F, twin.R, degree)
    ends.append(nearest(twin._replace(t=t, v0=v0, v1=v1), F, degree, _MOST))
    near = [end for end, _ in sorted(ends, key=lambda end: end[1])]
    return [*near, *(end.twin() for end in near)]


def _starts(F: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """R (..., 2, 3, 3) and t, v0, v1, 0, 0 (..., 2, 5, 3) of unit coefficients (..., 21 or 45).

    Either rotation of t's essential matrix, whose entries the velocities share, with the translations that fit it.
    """
    block = places(degree)[np.ix_([0, degree + 2, degree + 1], [0, degree + 2, degree + 1])]
    U, _, Vt = np.linalg.svd(F[..., None, block])
    R = U @ np.stack([QUARTER, QUARTER.T]) @ Vt
    R = R * np.sign(np.linalg.det(R))[..., None, None]
    found = _translations(F[..., None, :], R, degree)
    return R, np.concatenate([found, np.zeros((*found.shape[:-2], 2, 3))], axis=-2)


def _translations(F: FloatArray, R: FloatArray, degree: int) -> FloatArray:
    """t, v0 and v1 (..., 3, 3) that fit best to coefficients and a rotation (..., 3, 3), without w0 and w1."""
    basis = np.tensordot(R, _translating(degree), axes=2)
    found = np.linalg.solve(basis @ np.swapaxes(basis, -1, -2), basis @ F[..., None])
    return np.asarray(found.reshape(*R.shape[:-2], 3, 3), dtype=np.float64)


@functools.cache
def _translating(degree: int) -> FloatArray:
    """(3, 3, 9, 21 or 45): coefficients by R and by (t, v0, v1), without rotations in the frames."""
    units = np.eye(9).reshape(3, 3, 3, 3)
    still = np.zeros((5, 3))
    return np.array([[with_derivatives(FreeMotion(R, *still), degree)[1][3:12] for R in row] for row in units])


def _sampled(matches: FloatArray, camera: PinholeCamera, refined: bool) -> list[MotionEstimate]:
    """Motions by the linear model of samples (b, n, 4), n >= 20."""
    x, y = camera.unproject(matches[..., :2]), camera.unproject(matches[..., 2:])
    A = system(x, y, 1)
    norms = np.maximum(np.linalg.norm(A, axis=1), 1e-300)
    good = np.all(np.isfinite(A), axis=(1, 2))
    _, sizes, Vt = np.linalg.svd(np.where(good[:, None, None], A / norms[:, None], 0.0))
    good &= sizes[:, 19] > _ROUNDING * sizes[:, 0]
    F = np.where(good[:, None], Vt[:, -1] / norms, 1.0)
    F /= np.linalg.norm(F, axis=-1, keepdims=True)
    data = np.concatenate([x[..., :2], y[..., :2], x[..., 1:2], y[..., 1:2]], axis=-1)
    most = (_SAMPLE_MOST[0], _SAMPLE_MOST[1] if refined else 0)
    focal, slowness = np.array([camera.fx, camera.fy]), (camera.height / camera.fy) ** 2 / matches.shape[1]
    first, place, R, vectors = (
        -camera.cy / camera.fy,
        places(1),
        np.zeros((len(F), 3, 3)),
        np.zeros((len(F), 5, 3)),
    )
    for k, (Rs, begun) in enumerate(zip(*_starts(F, 1), strict=True)):
        propose(Rs, begun, F[k], place, data[k], focal, first, slowness, most, R[k], vectors[k])
    return [
        motion_of(*motion) if usable else MotionEstimate.failed(_SINGULAR)
        for motion, usable in zip(zip(so3.log(R), vectors[:, 0], strict=True), good, strict=True)
    ]


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
        F, reason = null_vector(system(rows.x, rows.y, degree), unit_columns=True, rounding=_ROUNDING)
        return reason if F is None else extract(F, degree)

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Motions of the smaller models: noise spoils 45 coefficients long before it spoils 21 or 9."""
        F, _ = null_vector(system(rows.x, rows.y, 1), unit_columns=True) if self.turning else (None, "")
        still = without_velocities(rows)
        return [*([] if F is None else extract(F, 1)), *([] if still is None else [still])]

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": _SAMPLE}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return next(iter(self.propose_all([sample], rig, shutter)))

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        """By the linear model: noise of 0.3 px leaves nothing of 44 matches, and few 44 are free of outliers."""
        matches = np.stack([temporal_pairs(sample, "left") for sample in samples])
        if matches.shape[1] < _SAMPLE:
            return [[MotionEstimate.failed(f"{matches.shape[1]} left matches, need {_SAMPLE}")] for _ in matches]
        return [[each] for each in _sampled(matches, rig.camera, self.refinement == "sampson")]
