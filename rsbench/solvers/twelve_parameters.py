"""One essential matrix for the frame, then twelve velocities by linear least squares.

The rolling-shutter baselines of D. Barath (Rolling Shutter Made Practical, ECCV 2026), there named after the
solvers of Dai et al., whose algorithm it is not: ``rsbench.solvers.dai`` is that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from rsbench.solvers.engine.free_solver import FreeVelocitySolver, without_velocities
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, errors


def velocities(still: FreeMotion, rows: Rows) -> FreeMotion:
    """The velocities that fit best to first order beside an R and t that keep the rows of the principal point.

    y^T E x is linear in (v0, v1, w0, w1) where these are small. Each row is weighed by its Sampson norm.
    """
    r, J = errors(still, rows)
    found = np.asarray(np.linalg.lstsq(J[:, 6:], -r, rcond=None)[0], dtype=np.float64)
    return FreeMotion(still.R, still.t, *found.reshape(4, 3))


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
        still = without_velocities(rows)
        if still is None:
            return "the matches fit more than one essential matrix: degenerate scene or motion"
        return [velocities(still, rows)]
