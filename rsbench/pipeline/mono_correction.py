"""Correct frames of one camera: its motion from dense flow, one trajectory for several pairs, and any scan."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.hypotheses import Known
from rsbench.capture.model_choice import motion_at
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import CERTAIN, conclude, examine
from rsbench.capture.two_frame_spline import camera_trajectory, camera_two_frame_spline
from rsbench.components.motion_models import AcceleratedMotion, InertialMotion, LinearMotion, make_motion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import about_one
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.images import eight_bit, local_variance
from rsbench.vision.mono_fusion import Flows, MonoFusion, MonoFusionOptions, OwnMotion, find_flows

_CLEARLY_LESS = 0.75
"""An accelerated motion is used only if its error is at most this share of that of the best constant-speed model,
as its additional parameter also absorbs errors of flow and focal length: the share was 0.85 and 0.88 on published
pairs that it made worse by 3 to 7 dB, and 0.44 to 0.75 on simulated accelerations of 0.15 and 0.3."""
_LARGEST_PX = 1.25
"""Errors are clipped to this."""
_INLIER_SIGMAS = 3.0
"""Largest error of an inlier, standard deviations."""


def select_motion_model(
    found: RobustEstimate,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int = 0,
) -> tuple[RobustEstimate, Motion]:
    """Select the motion model by the matches; returns the estimate under it and the motion.

    Args:
        found: a successful estimate under ``inertial``, kept unless another model is clearly more probable.
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        rig: a rig whose left camera is the camera and whose body is at this camera.
        shutter: shutter of the camera.
        options: RANSAC of the search.
        seed: seed of the search.
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
    return (found, inertial) if law is inertial else _refined(found, law, matches, rig, shutter, capture.noise_px)


def _refined(
    found: RobustEstimate,
    law: Motion,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    noise_px: float,
) -> tuple[RobustEstimate, Motion]:
    """Refine a motion under its model by maximum likelihood, with points in front of the camera."""
    right = np.abs(rs_sampson_error(rig, shutter, law, "left", matches)) <= _INLIER_SIGMAS * noise_px
    solver = RefinedSolver(motion_model=law.name, motion_parameters=dict(law.parameters), one_camera=True)
    near = MotionEstimate(w=law.w, d=law.d, success=True)
    estimate = solver.improve(near, Correspondences(left=matches[right]), rig, shutter)
    count = MatchCount(inliers=int(np.count_nonzero(right)), matches=len(matches))
    if not (estimate.success and np.any(estimate.d)):
        return found, InertialMotion(found.estimate.w, found.estimate.d)
    refined = replace(
        found,
        estimate=estimate,
        inliers={**found.inliers, "left": right},
        counts={"left": count},
        motion_model=law.name,
    )
    return refined, law.with_endpoint(estimate.w, estimate.d)


def error_px(
    motion: Motion, matches: FloatArray, rig: StereoRig, shutter: RollingShutter, side: Side = "left"
) -> float:
    """Root mean square Sampson error, px, of matches (n, 4), each clipped to ``_LARGEST_PX``."""
    errors = np.abs(rs_sampson_error(rig, shutter, motion, side, matches))
    return float(np.sqrt(np.mean(np.fmin(errors, _LARGEST_PX) ** 2)))


# Correction of one camera's frames by ``mono-fusion``: its motion from dense flow, then both frames.


_MATCHES = 1500
"""Number of random matches of the dense flow from which a motion with six unknowns is estimated."""
_PIXELS = 600
"""Number of random pixels, the same in each frame, whose flow gives the matches for a trajectory."""
_FEWEST = 50
_RETURNS_PX = 0.3
"""Largest forward-backward error of the flow at a match; the flow (DIS) is then accurate to about 0.1 px."""
_TEXTURE_LEVELS = 3.0
"""Least standard deviation of grey levels in a textured window; camera noise is 1 to 2."""
_TEXTURED = 0.01
_STILL_PX, _MOST, _CLEAREST = 0.25, 0.95, 0.1
"""The camera is still if the flow is below the first value in the second share of the third share of pixels, those
with most texture. On six real and rendered pairs it stayed below 0.23 px under noise of 2 levels or JPEG of
quality 70, and 0.3 px of motion gave 0.43; with less texture, noise alone changes DIS by pixels."""
_LEAST_RETURNING = 0.05
"""Share of pixels with a small forward-backward error below which two frames show different scenes: at least 0.21
in each of twelve real and rendered pairs with up to 43 px of flow, at most 0.001 between different pairs, and 0.02
between two images of blurred noise."""
STILL = "nothing moves between the frames: a still camera needs no correction"
CUT = "shows another scene than the previous frame: there is a cut, or frames are missing"


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundOwnMotion:
    """The motion of one camera over two frames, or why there is none."""

    own: OwnMotion
    robust: RobustEstimate | None
    """The estimate of the motion; None if there were too few matches."""
    reason: str = ""
    """Why there is no motion and the frames are warped by scaled flow; empty with a motion."""
    unused: str = ""
    """Why given samples of a gyroscope were not used; empty otherwise."""


def refusal(images: Sequence[NDArray[Any]], flows: Flows) -> str:
    """Why two frames (H, W[, 3]) of one camera cannot be corrected; empty when they can."""
    height, width = flows.shape
    small = [image if image.shape[:2] == flows.shape else _shrunk(image, width, height) for image in images]
    variances = [local_variance(image) for image in eight_bit(small)]
    for name, variance in zip(("first", "second"), variances, strict=True):
        if np.mean(variance > _TEXTURE_LEVELS**2) < _TEXTURED:
            return f"the {name} frame shows no texture: its motion cannot be estimated"
    clear = variances[1] >= np.quantile(variances[1], 1.0 - _CLEAREST)
    if float(np.quantile(np.linalg.norm(flows.flow[1][clear], axis=-1), _MOST)) < _STILL_PX:
        return STILL
    if float(np.mean(flows.returns[1] < _RETURNS_PX)) < _LEAST_RETURNING:
        return CUT
    return ""


def _shrunk(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def flow_matches(flows: Flows, rng: np.random.Generator) -> FloatArray:
    """Matches (n, 4) x0, y0, x1, y1 at random pixels of frame 1 with a small forward-backward error."""
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
    there = here + flow.reshape(-1, 2)[chosen]
    return np.concatenate([flows.in_frame(there), flows.in_frame(here)], axis=-1)


def trajectory_matches(flows: Flows, seed: int, pixels: int = _PIXELS) -> FloatArray:
    """Matches (n, 4) by the flow, from the same random pixels of both frames; in random order.

    A match that ends at such a pixel is continued by a match of the next pair, which begins there.
    """
    height, width = flows.shape
    rng = np.random.default_rng(seed)
    chosen = rng.choice(height * width, min(pixels, height * width), replace=False)
    y, x = np.divmod(chosen, width)
    here, out = np.stack([x, y], axis=-1).astype(np.float64), list[FloatArray]()
    for frame, (flow, returns) in enumerate(zip(flows.flow, flows.returns, strict=True)):
        there = here + flow[y, x]
        good = (returns[y, x] < _RETURNS_PX) & np.all((there >= 0.0) & (there <= [width - 1, height - 1]), axis=-1)
        ends = flows.in_frame(here[good]), flows.in_frame(there[good])
        out.append(np.concatenate(ends[::-1] if frame else ends, axis=-1))
    return rng.permutation(np.concatenate(out))


def find_own_motion(
    flows: Flows, rig: StereoRig, shutter: RollingShutter, side: Side, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """The motion of one camera, by the model selected from its flow or a spline; its translation has length 1.

    The models are those of constant speed and an accelerated one.
    """
    return with_best_motion(find_steady_motion(flows, rig, shutter, side, robust, seed), flows, robust, seed)


def find_steady_motion(
    flows: Flows, rig: StereoRig, shutter: RollingShutter, side: Side, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """``find_own_motion`` with the fixed motion model ``inertial``."""
    own = rig.about(side)
    nothing = OwnMotion(rig=own, shutter=shutter, side=side, motion=None)
    matches = flow_matches(flows, np.random.default_rng(seed))
    if len(matches) < _FEWEST:
        return FoundOwnMotion(own=nothing, robust=None, reason=f"only {len(matches)} pixels have reliable flow")
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
    """The motion under the model that is selected from the flow, in place of ``inertial``."""
    own = found.own
    if found.robust is None or own.motion is None:
        return found
    matches = flow_matches(flows, np.random.default_rng(seed))
    refined, motion = select_motion_model(found.robust, matches, own.rig.about("left"), own.shutter, robust, seed)
    motion = motion.with_endpoint(motion.w, motion.d / np.linalg.norm(motion.d))
    return replace(found, own=replace(own, motion=motion), robust=refined)


def with_best_motion(found: FoundOwnMotion, flows: Flows, robust: RobustOptions, seed: int = 0) -> FoundOwnMotion:
    """``with_selected_model``, or a spline if two frames determine one (``camera_two_frame_spline``)."""
    lawful = with_selected_model(found, flows, robust, seed)
    own = lawful.own
    if lawful.robust is None or own.motion is None:
        return lawful
    path = camera_two_frame_spline(trajectory_matches(flows, seed), own.motion, own.rig.about("left"), own.shutter)
    return lawful if path is None else with_motion(lawful, path)


def with_motion(found: FoundOwnMotion, path: Motion) -> FoundOwnMotion:
    """The result for two frames with another motion."""
    robust = found.robust
    if robust is not None:
        estimate = replace(robust.estimate, w=path.w, d=path.d, covariance=None)
        robust = replace(robust, estimate=estimate, motion_model=path.name)
    return replace(found, own=replace(found.own, motion=path), robust=robust)


@final
@dataclass(frozen=True, kw_only=True)
class MonoFusionCorrector(Corrector):
    """Correct each camera alone: by geometry where epipolar curves explain the flow, else by scaled flow."""

    geometry: bool = True
    """Whether depth and motion are estimated; otherwise all pixels move by flow scaled by the times of rows."""
    fusion: MonoFusionOptions = field(default_factory=MonoFusionOptions)
    """Options of the fusion of two frames to one image."""
    robust: RobustOptions = field(default_factory=RobustOptions)
    """RANSAC of the motion."""
    seed: int = 0
    """Seed of the random samples."""

    spec = CorrectorSpec(
        needs=frozenset(),
        reference="rsbench; flow: Kroeger et al., ECCV 2016; search: Hirschmueller, PAMI 2008",
        assumes="one camera, two frames: constant velocity; moving objects move uniformly in the image",
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
        """The fusion of a camera's two frames; or why they cannot be corrected."""
        images = [problem.images[side, frame] for frame in (0, 1)]
        flows = find_flows(images)
        if reason := refusal(images, flows):
            return reason
        own = OwnMotion(rig=problem.rig.about(side), shutter=problem.shutter, side=side, motion=None)
        if self.geometry:
            own = find_own_motion(flows, problem.rig, problem.shutter, side, self.robust, self.seed).own
        return MonoFusion(images, own, flows, self.fusion)


# One trajectory of a camera through neighbouring pairs of frames, in place of a motion model for each pair.
# Two frames cannot reveal a shake that is the same in both; several can, as each frame is in two pairs. A
# trajectory is fitted to a fixed group of pairs and some on either side: thus the result for a pair does not
# depend on the frame at which a run begins, and memory does not grow with the number of frames.


_GROUP, _BESIDE = 10, 2
"""Number of pairs in a group, and of additional pairs on either side."""
_FEWEST_PAIRS = 3
"""Fewest successive pairs that determine a trajectory."""
PIXELS = 300
"""Pixels for ``trajectory_matches`` in a sequence: fewer than for two frames, as each frame is in two pairs."""
_LEAST = 50
"""Fewest matches of a pair in a trajectory."""
_FIVE_POINTS, _EPIPOLAR_PX = 5, 0.5
"""Fewest matches of an essential matrix, and distance from the epipolar line of an inlier, px."""
_NORMAL_QUARTILE = 0.6745
"""Median of the absolute value of a standard normal variable."""
_FLOW_PX = 0.15
"""Error of dense flow (root mean square, px of the size at which the flow is found): a trajectory with a smaller
error explains a pair."""
_AS_GOOD = 1.25
"""A trajectory also explains a pair if its error is at most this many times that of the pair's own motion, which
fits noise and moving objects that a trajectory, bound by the other pairs, does not. In a video of a phone in a car
the own motion fitted better in 47 of 102 pairs, 41 of them within this factor; compared with a gyroscope it was
worse (0.06 and 0.035 deg, median)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPair:
    """Two successive frames of a video."""

    matches: FloatArray
    """(n, 4) x0, y0, x1, y1, px, see ``trajectory_matches``; fewer than ``_LEAST`` exclude the pair."""
    period: float = 1.0
    """Time between the frames, frame periods."""


def motion_of_pair(
    path: Motion | None,
    matches: FloatArray,
    flows: Flows,
    rig: StereoRig,
    shutter: RollingShutter,
    robust: RobustOptions,
    seed: int = 0,
) -> FoundOwnMotion:
    """The motion of a pair: ``path`` of a trajectory if it explains the pair as well as the pair's own motion.

    That motion is estimated only if the error of the trajectory is above that of the flow.

    Args:
        path: from ``shared_trajectory``; None: the pair's own motion is used.
        matches: (n, 4) see ``trajectory_matches``.
        flows: flow of the pair.
        rig: a rig whose left camera is the camera and whose body is at this camera.
        shutter: shutter of the camera, with its ratio to the time between these frames.
        robust, seed: see ``find_own_motion``.
    """
    error = np.inf if path is None else error_px(path, matches, rig, shutter)
    if error > _FLOW_PX * max(flows.scale):
        own = find_steady_motion(flows, rig, shutter, "left", robust, seed)
        law = own.own.motion
        if path is None or law is None or error > _AS_GOOD * error_px(law, matches, rig, shutter):
            return with_best_motion(own, flows, robust, seed)
    assert path is not None
    errors = np.abs(rs_sampson_error(rig, shutter, path, "left", matches))
    noise = float(np.nanmedian(errors)) / _NORMAL_QUARTILE
    right, threshold = errors <= _INLIER_SIGMAS * noise, _INLIER_SIGMAS * noise
    estimate = MotionEstimate(w=path.w, d=path.d, success=True, metric=False, noise_px=noise)
    explained = RobustEstimate(
        estimate=estimate,
        inliers={"left": right},
        counts={"left": MatchCount(inliers=int(np.count_nonzero(right)), matches=len(matches))},
        iterations=0,
        seconds=0.0,
        threshold_px=threshold,
        motion_model=path.name,
    )
    return FoundOwnMotion(own=OwnMotion(rig=rig, shutter=shutter, side="left", motion=path), robust=explained)


def group_of(pair: int) -> tuple[int, int]:
    """Number of the first pair on which the result for a pair depends, and the number after the last."""
    return max(_next_group(pair) - _GROUP - _BESIDE, 0), _next_group(pair) + _BESIDE


def shared_trajectory(
    pairs: Iterable[SeenPair], rig: StereoRig, shutter: RollingShutter, begin: int = 0, first: int = 0
) -> Iterator[Motion | None]:
    """The motion over each pair, in order, along a trajectory shared by successive pairs; None if there is none.

    Args:
        pairs: pairs in order, starting with number ``begin``, at most ``group_of(first)[0]``.
        rig: a rig whose left camera is the camera and whose body is at this camera.
        shutter: shutter of the camera, with its ratio to the usual frame period.
        first: number of the first pair that is returned.
    """
    pending, group, number = dict[int, SeenPair](), first, begin - 1
    for number, pair in enumerate(pairs, start=begin):
        pending[number] = pair
        if number + 1 == group_of(group)[1]:
            yield from _group_motions(pending, group, rig, shutter)
            group = _next_group(group)
            pending = {k: each for k, each in pending.items() if k >= group_of(group)[0]}
    while group <= number:
        yield from _group_motions(pending, group, rig, shutter)
        group = _next_group(group)


def _next_group(pair: int) -> int:
    return pair // _GROUP * _GROUP + _GROUP


def _group_motions(
    pending: dict[int, SeenPair], first: int, rig: StereoRig, shutter: RollingShutter
) -> list[Motion | None]:
    """The motions of the group of pair ``first``, from that pair on."""
    low, high = group_of(first)
    numbers = [k for k in range(low, high) if k in pending]
    found = dict[int, Motion | None].fromkeys(numbers)
    for usable, run in itertools.groupby(numbers, lambda k: _is_usable(pending[k])):
        if usable:
            some = list(run)
            found |= zip(some, _trajectory_motions([pending[k] for k in some], rig, shutter), strict=False)
    return [found[k] for k in range(first, _next_group(first)) if k in found]


def _is_usable(pair: SeenPair) -> bool:
    return bool(about_one(pair.period)) and len(pair.matches) >= _LEAST


def _trajectory_motions(run: Sequence[SeenPair], rig: StereoRig, shutter: RollingShutter) -> Sequence[Motion]:
    """The motions of successive pairs along one trajectory; empty if there is none."""
    if len(run) < _FEWEST_PAIRS or shutter.readout_ratio == 0.0:
        return []
    matches, times = [pair.matches for pair in run], np.cumsum([0.0, *(pair.period for pair in run)])
    starts = [_global_shutter_motion(each, rig.camera) for each in matches]
    return camera_trajectory(matches, starts, rig, shutter, times) or []


def _global_shutter_motion(matches: FloatArray, camera: PinholeCamera) -> LinearMotion:
    """The motion of a global-shutter camera (OpenCV's MAGSAC++ and five points); no motion if none is found.

    Its sign of d is arbitrary. An essential matrix has two rotations; the smaller one is used, as a camera does
    not turn by more than 90 degrees between successive frames.
    """
    first, second = (camera.fx * camera.unproject(matches[:, k : k + 2])[:, :2] for k in (0, 2))
    seen = np.all(np.isfinite(first + second), axis=-1)  # a lens may show no ray at a match
    K, E = np.diag([camera.fx, camera.fx, 1.0]), None
    if np.count_nonzero(seen) >= _FIVE_POINTS:
        E, _ = cv2.findEssentialMat(first[seen], second[seen], K, cv2.USAC_MAGSAC, 0.99, _EPIPOLAR_PX)
    if E is None:
        return LinearMotion(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    *rotations, d = cv2.decomposeEssentialMat(E[:3])
    return LinearMotion(min((so3.log(R) for R in rotations), key=lambda w: float(np.linalg.norm(w))), d[:, 0])


# Frames whose lines are read from any side are mirrored or transposed to frames whose rows are read from the
# top: a phone in upright position, for instance, reads columns. Motions and times stay valid in a mirror, so
# one correction serves all scans; only the axis of a rotation changes its sign.


@dataclass(frozen=True, kw_only=True, eq=False)
class Turned:
    """A camera that reads rows from the top, and the transform of the real camera's frames to its frames."""

    camera: PinholeCamera
    shutter: RollingShutter
    exchanged: bool
    """Whether x and y are exchanged."""
    flipped: bool
    """Whether the order of the lines is then reversed."""

    def image(self, image: NDArray[Any]) -> NDArray[Any]:
        """A frame (H, W[, 3]) of the real camera as a frame of this camera."""
        lines_first = np.swapaxes(image, 0, 1) if self.exchanged else image
        return np.ascontiguousarray(lines_first[::-1] if self.flipped else lines_first)

    def paced(self, period: float) -> Turned:
        """The same camera for two frames that are ``period`` frame periods apart."""
        if period == 1.0:
            return self
        ratio = min(self.shutter.readout_ratio / period, 1.0)
        return replace(self, shutter=replace(self.shutter, readout_ratio=ratio))

    def line(self, row: float) -> float:
        """The line of this camera for a row of the real one; if columns are read, at the same share."""
        return row * (self.camera.height - 1) / (self.camera.width - 1) if self.exchanged else row

    def back(self, fused: Fused) -> Fused:
        """A corrected frame of this camera as a frame of the real one."""
        image, origin, depth = map(self._image_back, (fused.image, fused.origin, fused.depth))
        return replace(fused, image=image, origin=origin, depth=depth)

    def _image_back(self, image: NDArray[Any]) -> NDArray[Any]:
        lines = image[::-1] if self.flipped else image
        return np.ascontiguousarray(np.swapaxes(lines, 0, 1) if self.exchanged else lines)

    def found(self, found: FoundOwnMotion | None) -> FoundOwnMotion | None:
        """A result of this camera with the motion in the real camera's axes."""
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
        """Gyroscope samples (n, 4) tau, w of the real camera in this camera's axes."""
        return _axial(samples, self._axes())

    def _axes(self) -> FloatArray:
        """(3, 3) transform from the real camera's axes to this camera's."""
        exchange = np.eye(3)[[1, 0, 2]] if self.exchanged else np.eye(3)
        return np.diag([1.0, -1.0 if self.flipped else 1.0, 1.0]) @ exchange


def _axial(samples: FloatArray, P: FloatArray) -> FloatArray:
    """Samples (n, 4) tau, w after a change of axes (3, 3); a mirror reverses the sign of rotations."""
    return np.column_stack([samples[:, 0], np.linalg.det(P) * samples[:, 1:] @ P.T])


def turned(camera: PinholeCamera, shutter: RollingShutter) -> Turned:
    """The camera that reads rows from the top, for a camera that reads from any side."""
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
