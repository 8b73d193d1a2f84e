"""One essential matrix and twelve velocities of both frames from seven affine correspondences.

An affine correspondence is a match p0 to p1 with A = dp1/dp0. The constraint f(p0, p1) = 0 of
``engine.free_velocities`` holds for the pixels around p0 too, so that its total derivative

    f_p0 + A^T f_p1 = 0

is zero, in which a row that moves is another time: three equations a match, 21 of seven for 17 unknowns. They are
of first order in the velocities, beside R and t of any size: Gauss and Newton's steps in all from the essential
matrix of a camera at rest. What they leave is of second order in the velocities.

The equations, and that seven matches suffice, are those of D. Barath, Rolling Shutter Made Practical, ECCV 2026,
which finds all their solutions algebraically; this is the one next to a camera at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import epipolar_gradient
from rsbench.core.given import check_number
from rsbench.core.projection import plane_basis
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.eight_point import normalising_transform, null_essential
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, SolverSpec
from rsbench.solvers.engine.free_solver import FreeVelocitySolver, at_rest_of, first_of
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows

_STEPS = 6
"""Of Gauss and Newton: of exact matches at 6 degrees and 1.2 m a frame the last changes w by 1e-9 rad."""


_ROUNDING = 1e-14
"""Of singular values."""
_DEGENERATE = "the matches fit more than one essential matrix: degenerate scene or motion"


def jets(rows: Rows, patch_px: float) -> tuple[FloatArray, FloatArray]:
    """Rays of both frames (n, 3, 3): the ray, and what it changes by where frame 0's pixel moves along x and y.

    By as many px as ``patch_px``, to first order.
    """
    focal = np.array([rows.camera.fx, rows.camera.fy])
    x, y = np.zeros((2, len(rows.x), 3, 3))
    x[:, 0], y[:, 0] = rows.x, rows.y
    x[:, [1, 2], [0, 1]] = patch_px / focal
    y[:, 1:, :2] = patch_px * np.swapaxes(rows.affine.reshape(-1, 2, 2), 1, 2) / focal
    return x, y


def _product(of: Callable[[FloatArray, FloatArray], FloatArray], a: FloatArray, b: FloatArray) -> FloatArray:
    """A bilinear product of jets (..., 3, c), to first order."""
    moved = [of(a[..., k, :], b[..., 0, :]) + of(a[..., 0, :], b[..., k, :]) for k in (1, 2)]
    return np.stack([of(a[..., 0, :], b[..., 0, :]), *moved], axis=-2)


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], 9)


def essential_of_jets(x: FloatArray, y: FloatArray) -> FloatArray | None:
    """As ``eight_point``, of the rays and their changes (n, 3, 3)."""
    T0, T1 = normalising_transform(x[:, 0, :2]), normalising_transform(y[:, 0, :2])
    E = null_essential(_product(_outer, y @ T1.T, x @ T0.T).reshape(-1, 9))
    return None if E is None else T1.T @ E @ T0


def equations(R: FloatArray, t: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values (..., n, 3) of a camera at rest, and their derivatives (..., n, 3, 18) by ``FreeMotion.moved``.

    Those by the velocities are exact; those by R and t are the ones of a camera at rest.

    Args:
        R, t: (..., 3, 3), (..., 3).
        x, y: jets (..., n, 3, 3).
    """
    R, t = R[..., None, :, :], t[..., None, None, :]
    p, s0, s1 = x @ np.swapaxes(R, -1, -2), x[..., 1:2], y[..., 1:2]
    n = _product(so3.cross, p, y)
    by_turn = _product(so3.cross, p, so3.cross(y, t))
    parts = [by_turn, n]
    for each in (n, by_turn):
        parts += [-_product(np.multiply, s0, each @ R), _product(np.multiply, s1, each)]
    return np.sum(n * t, axis=-1), np.concatenate(parts, axis=-1)


def moving(stills: list[FreeMotion], x: FloatArray, y: FloatArray, camera: PinholeCamera) -> list[FreeMotion]:
    """R, t and velocities that fit the jets (k, n, 3, 3) of k samples best, to first order in the velocities."""
    R, t = np.stack([each.R for each in stills]), np.stack([each.t for each in stills])
    v = np.zeros((len(R), 12))
    for _ in range(_STEPS):
        value, J = equations(R, t, x, y)
        E = (hat(t) @ R)[:, None]
        gradient = epipolar_gradient(E, x[..., 0, :], y[..., 0, :], camera)
        weight = 1.0 / np.maximum(np.linalg.norm(gradient, axis=-1), 1e-300)[..., None, None]
        across = plane_basis(t)
        columns = np.concatenate([J[..., :3], J[..., 3:6] @ across[:, None], J[..., 6:]], axis=-1) * weight
        A, b = columns.reshape(len(R), -1, 17), (value[..., None] * weight).reshape(len(R), -1, 1)
        finite = np.all(np.isfinite(A), axis=(1, 2)) & np.all(np.isfinite(b), axis=(1, 2))
        step = np.full((len(R), 17), np.nan)
        step[finite] = -(np.linalg.pinv(A[finite], rcond=_ROUNDING) @ b[finite])[..., 0]
        t = t + (across @ step[:, 3:5, None])[..., 0]
        R, v, length = so3.exp(step[:, :3]) @ R, step[:, 5:], np.linalg.norm(t, axis=1, keepdims=True)
        t = t / length
    return [FreeMotion(*each, *velocities.reshape(4, 3)) for *each, velocities in zip(R, t, v, strict=True)]


@final
@dataclass(frozen=True, kw_only=True)
class AffineSolver(FreeVelocitySolver):
    """An essential matrix of affine correspondences, then all unknowns together; points alone in the descent.

    The descent on Sampson errors needs 17 matches; of fewer the answer is what the equations give.
    """

    patch_px: float = 10.0
    """Noise of points over that of affine frames, px: as far from its point a frame is as uncertain as that."""

    def __post_init__(self) -> None:
        check_number("patch_px", self.patch_px, 1e-3, 1e3)

    @property
    def turning(self) -> bool:
        return True

    @property
    def least(self) -> int:
        return 7

    @property
    def about(self) -> tuple[str, str]:
        return (
            "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its equations); Hartley, PAMI 1997",
            "affine frames of the left matches; slow motion within the frames; readout ratio above 0; translation",
        )

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": self.least, "affine": self.least}
        return replace(super().spec, needs=set(minimum), minimum=minimum)

    def matches_of(self, correspondences: Correspondences) -> FloatArray:
        if len(correspondences.affine) == 0:
            return correspondences.left
        return np.hstack([correspondences.left, correspondences.affine])

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        x, y = jets(rows, self.patch_px)
        E = essential_of_jets(x, y)
        if E is None:
            return _DEGENERATE
        still = at_rest_of(E, rows)
        return [*moving([still], x[None], y[None], rows.camera), still]

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self.propose_all([sample], rig, shutter)[0]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> list[list[MotionEstimate]]:
        """With the velocities, and at rest: noise of a few matches may have spoiled them."""
        sets = [self.matches_of(sample) for sample in samples]
        short = self.spec.shortage({"left": len(sets[0]), "affine": len(samples[0].affine)})
        if short is not None:
            return [[short] for _ in samples]
        rows = [Rows.of(matches, rig.camera, rig.camera.cy) for matches in sets]
        x, y = (np.stack(part) for part in zip(*(jets(each, self.patch_px) for each in rows), strict=True))
        found = [essential_of_jets(*each) for each in zip(x, y, strict=True)]
        stills = {k: at_rest_of(E, rows[k]) for k, E in enumerate(found) if E is not None}
        out = [[MotionEstimate.failed(_DEGENERATE)] for _ in samples]
        known = [*stills]
        moved = moving([*stills.values()], x[known], y[known], rig.camera) if known else []
        for k, motion in zip(known, moved, strict=True):
            out[k] = [first_of([each], sets[k], rig) for each in (motion, stills[k])]
        return out
