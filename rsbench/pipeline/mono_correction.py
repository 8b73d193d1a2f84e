"""Which law of motion one camera followed, from its matches: ``inertial`` unless they ask for another one."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.hypotheses import Known
from rsbench.capture.model_choice import motion_at
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import CERTAIN, conclude, examine
from rsbench.capture.two_frame_spline import camera_trajectory, camera_two_frame_spline
from rsbench.components.motion_models import AcceleratedMotion, InertialMotion, make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.images import eight_bit, local_variance
from rsbench.vision.mono_fusion import Flows, MonoFusion, MonoFusionOptions, OwnMotion, find_flows

_CLEARLY_LESS = 0.75
"""Of the error of the best law of constant speed, that is left where one that accelerates is believed. It has a
number more, which takes up what dense flow and a focal length err by: 0.85 and 0.88 on published pairs that it
made worse by 3 to 7 dB, 0.44 to 0.75 on simulated accelerations of 0.15 and 0.3."""
_LARGEST_PX = 1.25
"""Errors count up to here."""
_REACH = 3.0
"""Deviations up to which a match is right."""


def select_motion_model(
    found: RobustEstimate,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int = 0,
) -> tuple[RobustEstimate, Motion]:
    """The motion by the law that the matches ask for, and its estimate; that of ``found`` without such a one.

    Args:
        found: under ``inertial``, a success; it stays where no other law is clearly more probable.
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        rig: its body is where the camera is, the left one.
        shutter: of the camera.
        options: RANSAC of the search.
        seed: of the search.
    """
    inertial = InertialMotion(found.estimate.w, found.estimate.d)
    given = Correspondences(left=matches)
    capture = conclude([examine(given, rig, Known().with_shutter(shutter), options, seed, inertial)])
    laws = [name for name in capture.models if name in capture.peaks]
    if not laws or laws[0] == inertial.name or capture.models.get(inertial.name, 0.0) > 1.0 - CERTAIN:
        return found, inertial
    law = motion_at(capture.peaks[laws[0]])
    if law.name == AcceleratedMotion.name:
        steady = [motion_at(capture.peaks[name]) for name in laws[1:] if name != inertial.name]
        best = min([inertial, *steady], key=lambda each: error_px(each, matches, rig, shutter))
        if error_px(law, matches, rig, shutter) > _CLEARLY_LESS * error_px(best, matches, rig, shutter):
            law = best
    return (found, inertial) if law is inertial else _settled(found, law, matches, rig, shutter, capture.noise_px)


def _settled(
    found: RobustEstimate,
    law: Motion,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    noise_px: float,
) -> tuple[RobustEstimate, Motion]:
    """The maximum of likelihood next to a motion by a law, with points before the camera."""
    right = np.abs(rs_sampson_error(rig, shutter, law, "left", matches)) <= _REACH * noise_px
    solver = RefinedSolver(motion_model=law.name, motion_parameters=dict(law.parameters), one_camera=True)
    near = MotionEstimate(w=law.w, d=law.d, success=True)
    estimate = solver.improve(near, Correspondences(left=matches[right]), rig, shutter)
    count = MatchCount(inliers=int(np.count_nonzero(right)), matches=len(matches))
    if not (estimate.success and np.any(estimate.d)):
        return found, InertialMotion(found.estimate.w, found.estimate.d)
    robust_of_law = replace(
        found,
        estimate=estimate,
        inliers={**found.inliers, "left": right},
        counts={"left": count},
        motion_model=law.name,
    )
    return robust_of_law, law.with_endpoint(estimate.w, estimate.d)


def error_px(
    motion: Motion, matches: FloatArray, rig: StereoRig, shutter: RollingShutter, side: Side = "left"
) -> float:
    """Root mean square Sampson error, px, of matches (n, 4) with outliers: each counts up to ``_LARGEST_PX``."""
    errors = np.abs(rs_sampson_error(rig, shutter, motion, side, matches))
    return float(np.sqrt(np.mean(np.fmin(errors, _LARGEST_PX) ** 2)))


# Correction of one camera's frames by ``mono-fusion``: its motion from dense flow, then both frames.


_MATCHES = 1500
"""Of the dense flow, drawn at random: what a motion of six unknowns is solved from."""
_PIXELS = 600
"""Random pixels, the same in each frame, that are followed to the frames before and after it for a trajectory."""
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
    if float(np.quantile(np.linalg.norm(flows.flow[1][clear], axis=-1), _MOST)) < _STILL_PX * flows.scale:
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


def trajectory_matches(flows: Flows, seed: int, pixels: int = _PIXELS) -> FloatArray:
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
    return with_best_motion(find_steady_motion(flows, rig, shutter, side, robust, seed), flows, robust, seed)


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


def with_selected_model(
    found: FoundOwnMotion, flows: Flows, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """A steady motion by the law that the flow asks for, if another one; what else is found stays."""
    own = found.own
    if found.robust is None or own.motion is None:
        return found
    matches = flow_matches(flows, np.random.default_rng(seed))
    robust_of_law, motion = select_motion_model(
        found.robust, matches, own.rig.about("left"), own.shutter, robust, seed
    )
    motion = motion.with_endpoint(motion.w, motion.d / np.linalg.norm(motion.d))
    return replace(found, own=replace(own, motion=motion), robust=robust_of_law)


def with_best_motion(found: FoundOwnMotion, flows: Flows, robust: RobustOptions, seed: int = 0) -> FoundOwnMotion:
    """As ``with_selected_model``, or shaken, where two frames show how (``camera_two_frame_spline``)."""
    lawful = with_selected_model(found, flows, robust, seed)
    own = lawful.own
    if lawful.robust is None or own.motion is None:
        return lawful
    path = camera_two_frame_spline(trajectory_matches(flows, seed), own.motion, own.rig.about("left"), own.shutter)
    return lawful if path is None else with_motion(lawful, path)


def with_motion(found: FoundOwnMotion, path: Motion) -> FoundOwnMotion:
    """What is found of two frames, with another motion."""
    robust = found.robust
    if robust is not None:
        estimate = replace(robust.estimate, w=path.w, d=path.d, covariance=None)
        robust = replace(robust, estimate=estimate, motion_model=path.name)
    return replace(found, own=replace(found.own, motion=path), robust=robust)


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


# One trajectory of a camera through neighbouring pairs of frames, in place of a motion model for each pair.
# Two frames do not show what both shake alike; several do, for each frame is in two pairs. Pairs are worked
# on in groups with some on both sides that help: what is found of a pair does not depend on where a run
# began, and memory does not grow with the number of frames.


_GROUP, _BESIDE = 10, 2
"""Pairs of a group, and those on either side that help."""
_FEWEST_PAIRS = 3
"""Fewest successive pairs that determine a trajectory."""
PIXELS = 300
"""As of ``trajectory_matches``: fewer than of two frames alone do, for each frame is in two pairs."""
_LEAST = 50
"""Matches."""
_FLOW_PX = 0.15
"""Root mean square error of dense flow, px: up to here a trajectory explains a pair, and where it explains it as
well as a motion of its own."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPair:
    """Two successive frames."""

    found: FoundOwnMotion | None
    """None where they show none at all."""
    matches: FloatArray
    """(n, 4) x0, y0, x1, y1, px, see ``trajectory_matches``."""
    even: bool = True
    """Whether about one frame period lies between them."""

    @property
    def motion(self) -> Motion | None:
        return None if self.found is None or self.found.own.far else self.found.own.motion


def group_of(pair: int) -> tuple[int, int]:
    """First pair that decides what is found of a pair, and the one after the last."""
    return max(_next_group(pair) - _GROUP - _BESIDE, 0), _next_group(pair) + _BESIDE


def with_shared_trajectory(
    pairs: Iterable[SeenPair], begin: int = 0, first: int = 0
) -> Iterator[FoundOwnMotion | None]:
    """Motions of pairs, in order: from the trajectory through their neighbours where it explains them as well.

    Args:
        pairs: in order, from number ``begin`` on: ``group_of(first)[0]`` at the latest.
        first: number of the first pair that is requested.
    """
    pending, group, number = dict[int, SeenPair](), first, begin - 1
    for number, pair in enumerate(pairs, start=begin):
        pending[number] = pair
        if number + 1 == group_of(group)[1]:
            yield from _group_motions(pending, group)
            group = _next_group(group)
            pending = {k: each for k, each in pending.items() if k >= group_of(group)[0]}
    while group <= number:
        yield from _group_motions(pending, group)
        group = _next_group(group)


def _next_group(pair: int) -> int:
    return pair // _GROUP * _GROUP + _GROUP


def _group_motions(pending: dict[int, SeenPair], first: int) -> list[FoundOwnMotion | None]:
    """Of the group of one pair, from that pair on."""
    low, high = group_of(first)
    numbers = [k for k in range(low, high) if k in pending]
    found = {k: pending[k].found for k in numbers}
    for shows, run in itertools.groupby(numbers, lambda k: _shows(pending[k])):
        found |= _along([(k, pending[k]) for k in run]) if shows else {}
    return [found[k] for k in range(first, _next_group(first)) if k in found]


def _shows(pair: SeenPair) -> bool:
    return pair.even and pair.motion is not None and len(pair.matches) >= _LEAST


def _along(run: Sequence[tuple[int, SeenPair]]) -> dict[int, FoundOwnMotion]:
    """Motions of successive pairs that follow the one trajectory of all of them."""
    motions = [pair.motion for _, pair in run if pair.motion is not None]
    owns = [pair.found.own for _, pair in run if pair.found is not None]
    if len(run) < _FEWEST_PAIRS or owns[0].shutter.readout_ratio == 0.0:
        return {}
    trajectories = camera_trajectory(
        [pair.matches for _, pair in run], motions, owns[0].rig.about("left"), owns[0].shutter
    )
    out = dict[int, FoundOwnMotion]()
    for (number, pair), own, steady, path in zip(run, owns, motions, trajectories or [], strict=False):
        errors = [error_px(each, pair.matches, own.rig, own.shutter, own.side) for each in (path, steady)]
        if pair.found is not None and errors[0] <= max(errors[1], _FLOW_PX):
            out[number] = with_motion(pair.found, path)
    return out


# Frames whose lines are read from any side, as frames whose rows are read from the top: mirrored, or turned.
# A phone pending upright reads columns. A mirror keeps motions and times valid, so what corrects rows
# from the top corrects the others; a rotation's axis turns round in it.


@dataclass(frozen=True, kw_only=True, eq=False)
class Turned:
    """A camera that reads rows from the top, and how the frames of the real one become its frames."""

    camera: PinholeCamera
    shutter: RollingShutter
    exchanged: bool
    """Whether x and y are."""
    flipped: bool
    """Whether the lines are in the opposite order after that."""

    def image(self, image: NDArray[Any]) -> NDArray[Any]:
        """A frame (H, W[, 3]) as this camera has it."""
        lines_first = np.swapaxes(image, 0, 1) if self.exchanged else image
        return np.ascontiguousarray(lines_first[::-1] if self.flipped else lines_first)

    def paced(self, period: float) -> Turned:
        """The same where so many frame periods lie between two frames."""
        if period == 1.0:
            return self
        ratio = min(self.shutter.readout_ratio / period, 1.0)
        return replace(self, shutter=replace(self.shutter, readout_ratio=ratio))

    def line(self, row: float) -> float:
        """The number of lines read at the time of so many rows; of columns, a like share of the width."""
        return row * (self.camera.height - 1) / (self.camera.width - 1) if self.exchanged else row

    def back(self, fused: Fused) -> Fused:
        """A corrected frame as the real camera has it."""
        image, origin, depth = map(self._image_back, (fused.image, fused.origin, fused.depth))
        return replace(fused, image=image, origin=origin, depth=depth)

    def _image_back(self, image: NDArray[Any]) -> NDArray[Any]:
        lines = image[::-1] if self.flipped else image
        return np.ascontiguousarray(np.swapaxes(lines, 0, 1) if self.exchanged else lines)

    def found(self, found: FoundOwnMotion | None) -> FoundOwnMotion | None:
        """A motion as the real camera makes it."""
        if found is None or found.own.motion is None:
            return found
        motion, P = found.own.motion, self._axes()
        w, d = np.linalg.det(P) * P.T @ motion.w, P.T @ motion.d
        if isinstance(motion, GyroMotion):
            real: Motion = GyroMotion(_axial(motion.samples, P.T), d)
        elif isinstance(motion, ContinuousMotion):
            real = motion.seen(P.T)
        else:
            real = make_motion(motion.name, w, d, motion.parameters)
        return replace(found, own=replace(found.own, motion=real))

    def gyro(self, samples: FloatArray) -> FloatArray:
        """Samples (n, 4) tau, w of a gyroscope as this camera turns."""
        return _axial(samples, self._axes())

    def _axes(self) -> FloatArray:
        """(3, 3) this camera's axes from the real one's."""
        exchange = np.eye(3)[[1, 0, 2]] if self.exchanged else np.eye(3)
        return np.diag([1.0, -1.0 if self.flipped else 1.0, 1.0]) @ exchange


def _axial(samples: FloatArray, P: FloatArray) -> FloatArray:
    """Samples (n, 4) tau, w after a change of axes (3, 3); in a mirror, a rotation's axis turns round."""
    return np.column_stack([samples[:, 0], np.linalg.det(P) * samples[:, 1:] @ P.T])


def turned(camera: PinholeCamera, shutter: RollingShutter) -> Turned:
    """The camera that reads rows from the top in place of one that reads from any side."""
    scan, c = shutter.scan_of("left"), camera
    exchanged, flipped = scan in ("left", "right"), scan in ("bottom", "right")
    if exchanged:
        lens = None if c.lens is None else replace(c.lens, p1=c.lens.p2, p2=c.lens.p1)
        c = PinholeCamera(width=c.height, height=c.width, fx=c.fy, fy=c.fx, cx=c.cy, cy=c.cx, lens=lens)
    if flipped:
        lens = None if c.lens is None else replace(c.lens, p1=-c.lens.p1)
        c = replace(c, cy=c.height - 1 - c.cy, lens=lens)
    rows = RollingShutter(height=c.height, readout_ratio=shutter.readout_ratio)
    return Turned(camera=c, shutter=rows, exchanged=exchanged, flipped=flipped)
