"""One line that turns any global-shutter solver into one for a rolling shutter and a constant twist.

B. Zhuang, L.-F. Cheong, G. Lee, Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017: at
constant velocity, a match that took ``a = 1 + h (y1 - y0)`` frame periods has moved a times as far as in one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from rsbench.core.correspondences import Correspondences, track_pairs, without_lens
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.registry import SolverEntry, load_solver_entry

_LEAST_DURATION = 0.05
"""Frame periods; a shorter one means a jump of nearly the whole image upwards, which no flow survives."""


def scale_flow(correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter) -> Correspondences:
    """Matches, without a lens, whose frame-1 ends are moved to where they are after exactly one frame period."""
    ideal = without_lens(correspondences, rig.camera)
    halves = [
        _scaled(track_pairs(correspondences.tracks, side), track_pairs(ideal.tracks, side), side, shutter)
        for side in SIDES
    ]
    return Correspondences(
        left=_scaled(correspondences.left, ideal.left, "left", shutter),
        right=_scaled(correspondences.right, ideal.right, "right", shutter),
        tracks=np.concatenate([ideal.tracks[:, :4], halves[0][:, 2:], halves[1][:, 2:]], axis=1),
    )


def _scaled(pixels: FloatArray, matches: FloatArray, side: Side, shutter: RollingShutter) -> FloatArray:
    duration = shutter.pixel_time(pixels[:, 2:], 1, side) - shutter.pixel_time(pixels[:, :2], 0, side)
    duration = np.maximum(duration, _LEAST_DURATION)[:, None]
    return np.concatenate([matches[:, :2], matches[:, :2] + (matches[:, 2:] - matches[:, :2]) / duration], axis=1)


@final
@dataclass(frozen=True, kw_only=True)
class FlowScaledSolver(Solver):
    """A global-shutter solver on scaled matches; its motion is that of a constant twist to first order."""

    solver: str
    """Name or card of the global-shutter solver."""

    def __post_init__(self) -> None:
        if self._entry.solver.spec.shutter != "global":
            raise RsbenchError(f"solver = {self.solver!r}: must be a global-shutter solver")
        if "stereo" in self._entry.solver.spec.needs:
            raise RsbenchError(
                f"solver = {self.solver!r}: needs left-right matches, which take no time that could be scaled; "
                "must be one of matches over time or tracks"
            )

    @cached_property
    def _entry(self) -> SolverEntry:
        try:
            return load_solver_entry(self.solver)
        except RecursionError:
            raise RsbenchError(f"solver = {self.solver!r}: refers to this card itself") from None

    @property
    def inner(self) -> Solver:
        """The global-shutter solver."""
        return self._entry.solver

    @property
    def inner_keys(self) -> tuple[str, ...]:
        return (self._entry.key,)

    @property
    def spec(self) -> SolverSpec:
        """What the solver inside declares, on a rolling shutter."""
        inner = self.inner.spec
        return replace(
            inner,
            motion_model="twist",
            shutter="rolling",
            cameras="any" if inner.needs == {"left"} else "lens",
            reference=f"Zhuang, Cheong, Lee, ICCV 2017, eq. 8-9; {inner.reference}",
            assumes=f"constant twist, small motion; {inner.assumes}",
        )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        return self.inner.estimate(scale_flow(correspondences, rig, shutter), rig.ideal, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return self.inner.sample_sizes(correspondences)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self.inner.propose(scale_flow(sample, rig, shutter), rig.ideal, shutter)

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        return self.inner.propose_all([scale_flow(sample, rig, shutter) for sample in samples], rig.ideal, shutter)

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        return self.inner.improve(motion, scale_flow(correspondences, rig, shutter), rig.ideal, shutter, quick)
