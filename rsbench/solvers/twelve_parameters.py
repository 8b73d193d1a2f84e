"""One essential matrix for the frame, then twelve velocities by linear least squares.

The rolling-shutter baselines of D. Barath (Rolling Shutter Made Practical, ECCV 2026), there named after the
solvers of Dai et al., whose algorithm it is not: ``rsbench.solvers.dai`` is that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.solvers.eight_point import decompose_essential, eight_point
from rsbench.solvers.engine.free_solver import FreeVelocitySolver
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, constraint


def velocities(still: FreeMotion, rows: Rows) -> FreeMotion:
    """The velocities that fit best to first order beside an R and t that keep the rows of the principal point.

    y^T E x is linear in (v0, v1, w0, w1) where these are small: with p = R x and n = p x y, its derivatives are
    -s0 R^T n, s1 n, -s0 R^T g and s1 g, g = p x (y x t). Each row is weighed by its Sampson norm.
    """
    value, gradient = constraint(still, rows)
    norm = np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None]
    p = rows.x @ still.R.T
    n, g = np.cross(p, rows.y), np.cross(p, np.cross(rows.y, still.t))
    s0, s1 = rows.s0[:, None], rows.s1[:, None]
    A = np.concatenate([-s0 * (n @ still.R), s1 * n, -s0 * (g @ still.R), s1 * g], axis=1)
    found: FloatArray = np.linalg.lstsq(A / norm, -value / norm[:, 0], rcond=None)[0]
    v0, v1, w0, w1 = found.reshape(4, 3)
    return FreeMotion(still.R, still.t, v0, v1, w0, w1)


@final
@dataclass(frozen=True, kw_only=True)
class TwelveParameterSolver(FreeVelocitySolver):
    """The eight-point algorithm, then a linear correction by the velocities of both frames."""

    @property
    def turning(self) -> bool:
        return True

    @property
    def least(self) -> int:
        return 20

    @property
    def about(self) -> tuple[str, str]:
        return (
            "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its baseline); Hartley, PAMI 1997",
            "slow motion within the frames; readout ratio above 0; a scene that is not planar; translation",
        )

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        E = eight_point(rows.x, rows.y)
        if E is None:
            return "the matches fit more than one essential matrix: degenerate scene or motion"
        pose, _ = decompose_essential(E, rows.x, rows.y)
        zero = np.zeros(3)
        return [velocities(FreeMotion(pose.R, pose.t, zero, zero, zero, zero), rows)]
