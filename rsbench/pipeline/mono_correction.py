"""Correction of one camera's frames by ``mono-fusion``: its motion from dense flow, then both frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.two_frame_spline import camera_two_frame_spline
from rsbench.components.motion_models import InertialMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_law import asked_for
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.images import eight_bit, local_variance
from rsbench.vision.mono_fusion import Flows, MonoFusion, MonoFusionOptions, OwnMotion, find_flows

_MATCHES = 1500
"""Of the dense flow, drawn at random: what a motion of six unknowns is solved from."""
_PIXELS = 600
"""Of each frame, at random and the same in all, that are followed to the frames before and after it, for a way."""
_FEWEST = 50
_RETURNS_PX = 0.3
"""Flow there and back ends so near where it began, for a match; DIS errs by about 0.1 px where it does."""
_TEXTURE_LEVELS = 3.0
"""Standard deviation of grey levels in a window, above which it shows something; noise of cameras is 1 to 2."""
_TEXTURED = 0.01
_STILL_PX, _MOST, _CLEAREST = 0.25, 0.95, 0.1
"""Flow below which, in most of the tenth of the pixels with the most texture, nothing moved. On frames of six
real and rendered pairs it stayed below 0.23 px under noise of 2 levels or JPEG of quality 70, and 0.3 px of motion
showed as 0.43; where there is less texture, noise alone moves DIS by pixels."""
_FOLLOWED = 0.05
"""Share of the pixels whose flow returns, below which two frames show different scenes: at least 0.21 in each of
twelve real and rendered pairs with up to 43 px of flow, at most 0.001 in pairs of different ones of them, and 0.02
where blurred noise meets other noise."""
STILL = "nothing moves between the frames: a still camera needs no correction"
CUT = "shows another scene than the frame before it: a cut, or frames that are missing"


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundOwnMotion:
    """The motion of one camera over two frames, or why there is none."""

    own: OwnMotion
    robust: RobustEstimate | None
    """Where it comes from; None without matches."""
    reason: str = ""
    """Why everything goes its flow; empty with a motion."""
    unused: str = ""
    """Why the samples of a gyroscope were given and not used; empty otherwise."""


def refusal(images: Sequence[NDArray[Any]], flows: Flows) -> str:
    """Why two frames (H, W[, 3]) of one camera cannot be corrected; empty when they can."""
    variances = [local_variance(image) for image in eight_bit(list(images))]
    for name, variance in zip(("first", "second"), variances, strict=True):
        if np.mean(variance > _TEXTURE_LEVELS**2) < _TEXTURED:
            return f"the {name} frame shows no texture: nothing to find its motion by"
    clear = variances[1] >= np.quantile(variances[1], 1.0 - _CLEAREST)
    if float(np.quantile(np.linalg.norm(flows.flow[1][clear], axis=-1), _MOST)) < _STILL_PX:
        return STILL
    if float(np.mean(flows.returns[1] < _RETURNS_PX)) < _FOLLOWED:
        return CUT
    return ""


def flow_matches(flows: Flows, rng: np.random.Generator) -> FloatArray:
    """Matches (n, 4) x0, y0, x1, y1 at random pixels of frame 1 whose flow returns to where it began."""
    flow = flows.flow[1]
    height, width = flow.shape[:2]
    x, y = (
        flow[..., 0] + np.arange(width, dtype=np.float32),
        flow[..., 1] + np.arange(height, dtype=np.float32)[:, None],
    )
    inside = (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
    good = np.flatnonzero(inside & (flows.returns[1] < _RETURNS_PX))
    chosen = rng.choice(good, min(_MATCHES, good.size), replace=False)
    here = np.stack([chosen % width, chosen // width], axis=-1).astype(np.float64)
    return np.concatenate([here + flow.reshape(-1, 2)[chosen], here], axis=-1)


def way_matches(flows: Flows, seed: int, pixels: int = _PIXELS) -> FloatArray:
    """Matches (n, 4) by the flow, from the same random pixels of both frames; in random order.

    One that ends at such a pixel goes on in the next pair with the one that begins there.
    """
    height, width = flows.returns[0].shape
    rng = np.random.default_rng(seed)
    chosen = rng.choice(height * width, min(pixels, height * width), replace=False)
    y, x = np.divmod(chosen, width)
    here, out = np.stack([x, y], axis=-1).astype(np.float64), list[FloatArray]()
    for frame, (flow, returns) in enumerate(zip(flows.flow, flows.returns, strict=True)):
        there = here + flow[y, x]
        good = (returns[y, x] < _RETURNS_PX) & np.all((there >= 0.0) & (there <= [width - 1, height - 1]), axis=-1)
        out.append(np.concatenate([there, here] if frame else [here, there], axis=-1)[good])
    return rng.permutation(np.concatenate(out))


def find_own_motion(
    flows: Flows, rig: StereoRig, shutter: RollingShutter, side: Side, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """The motion of one camera, by the law that its flow asks for, or as it shook; its translation has length 1.

    Of laws of constant speed, and one that accelerates.
    """
    return as_asked(find_steady_motion(flows, rig, shutter, side, robust, seed), flows, robust, seed)


def find_steady_motion(
    flows: Flows, rig: StereoRig, shutter: RollingShutter, side: Side, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """As of ``find_own_motion``, by the law ``inertial`` whatever the flow asks for."""
    own = rig.about(side)
    nothing = OwnMotion(rig=own, shutter=shutter, side=side, motion=None)
    matches = flow_matches(flows, np.random.default_rng(seed))
    if len(matches) < _FEWEST:
        return FoundOwnMotion(own=nothing, robust=None, reason=f"only {len(matches)} pixels have a certain flow")
    solver = RefinedSolver(motion_model=InertialMotion.name, one_camera=True)
    found = estimate_motion(
        Correspondences(left=matches), own, shutter, solver, robust, np.random.default_rng(seed)
    )
    estimate, length = found.estimate, float(np.linalg.norm(found.estimate.d))
    if not (estimate.success and length > 0.0):
        return FoundOwnMotion(own=nothing, robust=found, reason=estimate.reason or "no translation is found")
    motion = InertialMotion(estimate.w, estimate.d / length)
    return FoundOwnMotion(own=OwnMotion(rig=own, shutter=shutter, side=side, motion=motion), robust=found)


def by_asked_law(found: FoundOwnMotion, flows: Flows, robust: RobustOptions, seed: int = 0) -> FoundOwnMotion:
    """A steady motion by the law that the flow asks for, if another one; what else is found stays."""
    own = found.own
    if found.robust is None or own.motion is None:
        return found
    matches = flow_matches(flows, np.random.default_rng(seed))
    told, motion = asked_for(found.robust, matches, own.rig.about("left"), own.shutter, robust, seed)
    motion = motion.with_endpoint(motion.w, motion.d / np.linalg.norm(motion.d))
    return replace(found, own=replace(own, motion=motion), robust=told)


def as_asked(found: FoundOwnMotion, flows: Flows, robust: RobustOptions, seed: int = 0) -> FoundOwnMotion:
    """As ``by_asked_law``, or shaken, where two frames show how (``camera_two_frame_spline``)."""
    lawful = by_asked_law(found, flows, robust, seed)
    own = lawful.own
    if lawful.robust is None or own.motion is None:
        return lawful
    way = camera_two_frame_spline(way_matches(flows, seed), own.motion, own.rig.about("left"), own.shutter)
    return lawful if way is None else on_way(lawful, way)


def on_way(found: FoundOwnMotion, way: Motion) -> FoundOwnMotion:
    """What is found of two frames, with another motion."""
    robust = found.robust
    if robust is not None:
        estimate = replace(robust.estimate, w=way.w, d=way.d, covariance=None)
        robust = replace(robust, estimate=estimate, motion_model=way.name)
    return replace(found, own=replace(found.own, motion=way), robust=robust)


@final
@dataclass(frozen=True, kw_only=True)
class MonoFusionCorrector(Corrector):
    """Each camera by itself: geometry where its rows' epipolar curves explain the flow, scaled flow elsewhere."""

    geometry: bool = True
    """Whether depth and motion are looked for; without, everything goes its flow, scaled by the times of rows."""
    fusion: MonoFusionOptions = field(default_factory=MonoFusionOptions)
    """How two frames become one image."""
    robust: RobustOptions = field(default_factory=RobustOptions)
    """RANSAC of the motion."""
    seed: int = 0
    """Seed of the random samples."""

    spec = CorrectorSpec(
        needs=frozenset(),
        reference="rsbench; flow: Kroeger et al., ECCV 2016; search: Hirschmueller, PAMI 2008",
        assumes="one camera, two frames: constant velocity; what moves by itself does so evenly in the image",
        sees={"time"},
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return self.correct_rows(problem, views, (problem.target_row,))[0]

    def correct_rows(
        self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
    ) -> list[dict[View, Fused]]:
        ready = {side: self._ready(problem, side) for side in dict(views)}

        def corrected(view: View, row: float) -> Fused:
            side, frame = view
            fusion = ready[side]
            if isinstance(fusion, str):
                return Fused.failed(problem.images[view], fusion)
            return fusion.corrected(frame, float(problem.shutter.time_after(row, frame, side)))

        return [{view: corrected(view, row) for view in views} for row in rows]

    def _ready(self, problem: CorrectionProblem, side: Side) -> MonoFusion | str:
        """The two frames of a camera; or why they cannot be corrected."""
        images = [problem.images[side, frame] for frame in (0, 1)]
        flows = find_flows(images)
        if reason := refusal(images, flows):
            return reason
        own = OwnMotion(rig=problem.rig.about(side), shutter=problem.shutter, side=side, motion=None)
        if self.geometry:
            own = find_own_motion(flows, problem.rig, problem.shutter, side, self.robust, self.seed).own
        return MonoFusion(images, own, flows, self.fusion)
