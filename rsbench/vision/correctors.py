"""Our correctors: the complete fusion, and correctors with simpler assumptions.

Independently moving objects in front of a moving rig are found where flow contradicts geometry. Their depth comes
from two cameras at one time and is right, but the motion of the rig does not predict their position at another
time. Their flow does, scaled by the times of the rows, if they move uniformly in the image. Around them each
pixel moves to the mean of both places, weighted by their variances. If flow contradicts geometry in much of the
image beside them, the motion of the rig is wrong: the share that it explains is returned with the frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import SIDES, VIEWS, Side, StereoRig, View
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.vision.correction import (
    WarpOptions,
    draw_joined,
    draw_within,
    inverse_depth,
    joined_inside,
    line_maps,
    move_pixels,
    warp_gain,
)
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec, Depths
from rsbench.vision.flow import RETURNS_PX, dense_flow, flow_share, followed, leaves, returns_px
from rsbench.vision.fusion import Fused, Origin, SourceView, fuse
from rsbench.vision.images import Interpolation, grey_u8, local_variance, map_frames, resample
from rsbench.vision.reprojection import LineMaps, reproject_pixels, reprojection_of

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_MOVED_PX = 2.0
"""Least distance, px, between the end of the flow and the place of a static point, for a pixel that moved."""
_DISPARITY_PX = 1.0
"""Relative error of depth by which a static point may be farther or nearer."""
_NOISE_LEVELS, _CLEARLY = 1.0, 0.7
"""Flow is clearly better if its difference of grey levels, plus the first value, is below the second value times
the difference at the position by geometry."""
_AROUND = 1 / 16
"""Side of the window in which both places are compared, as a share of the image's width."""
_MEDIAN = 9
"""Side, px, of the window in which most pixels must move."""
_LEAST, _SEEN = 0.004, 0.1
"""Least area in which flow is clearly better, as a share of the image's, since errors also occur in small spots;
and as a share of the region that then moves along its flow."""
_TEXTURE_LEVELS, _BESIDE, _MOST, _FEW = 4.0, 5, 0.95, 0.01
"""Least standard deviation of grey levels around a pixel whose flow is trusted; side, px, of the window in which
it may be on a curve; share of such flow on the curves above which all counts as explained; least share of the
image with such flow for a conclusion."""
_EDGE = 7
"""Side, px, of the window whose nearest surface may hide a point: depth has errors at edges."""
_SMALLEST = 12
"""Least side of an image, px, for dense flow (OpenCV 5.0)."""
_STRETCH_PX = 2.5
"""Largest distance, px, between neighbours at the target for which the area between them is drawn."""
_BESIDE_PX, _LITTLE = 12, 0.1
"""Distance, px, from a moving region up to which flow has a weight, and least weight at which a pixel is moved."""
_SAME_DEPTH = 0.06
"""Relative difference of inverse depth that a nearer surface exceeds."""
_AGREE = 0.03
"""Relative difference of depth below which a moving object lies on a static surface, and is visible."""
_FLOW_BYTES = 100.0


class _Still(NamedTuple):
    """Motion of static points: (H, W, 2) px, NaN where it is unknown, and (H, W) masks."""

    far: F32
    """(H, W, 2) displacement, px, of a static point that is somewhat farther."""
    near: F32
    hidden: Mask
    """Whether a nearer surface hides the point, so that the other frame shows another colour there."""
    unknown: Mask
    """Whether the point's depth is unknown."""

    def nearest(self, flow: F32) -> F32:
        """(H, W, 2) displacement, px, between ``far`` and ``near`` that is closest to the ``flow`` (H, W, 2)."""
        along = self.near - self.far
        share = np.sum((flow - self.far) * along, axis=-1)
        share /= np.maximum(np.sum(along * along, axis=-1), np.float32(1e-6))
        return self.far + np.clip(share, 0.0, 1.0)[..., None] * along


class Moving(NamedTuple):
    """Independently moving objects in a frame."""

    share: F32
    """(H, W) weight of the displacement by flow beside that of a static point, 0 to 1; 0 away from the objects."""
    flow: F32
    """(H, W, 2) px, to the other frame of the camera."""


def find_moving(
    images: Mapping[View, NDArray[Any]],
    depth: Mapping[View, F32],
    poses: Mapping[View, Pose],
    rig: StereoRig,
    shutter: RollingShutter,
) -> tuple[dict[View, Moving], float]:
    """Find independently moving objects in four frames (H, W[, 3]), by depth (H, W) and the lines' poses.

    In most scenes, half-size frames suffice to exclude them. Returns also the share of the flow beside such
    objects that the motion of the rig and the depth explain: if it is small, the motion is wrong.
    """
    size = max(rig.sensor(side).width * rig.sensor(side).height for side in SIDES)
    grids = {side: rig.sensor(side).pixel_grid().astype(np.float32) for side in SIDES}

    def stays(view: View, step: int = 1) -> _Still:
        """Motion of every ``step``-th pixel in each direction, in pixels of an image smaller by this factor."""
        axis, other, camera, grid = shutter.axis(view[0]), _other(view), rig.sensor(view[0]), grids[view[0]]
        off, chosen = _DISPARITY_PX / (camera.fx * rig.baseline), np.s_[step - 1 :: step, step - 1 :: step]
        maps = reprojection_of(camera, poses[view], poses[other], (axis, axis))
        lines, rho = np.indices(depth[view].shape, dtype=np.int32)[1 - axis], np.full_like(depth[view], np.nan)
        rho[chosen] = inverse_depth(depth[view][chosen])  # NaN is skipped
        both = np.maximum(rho - np.float32(off), np.float32(0.0)), rho + np.float32(off)
        beyond = float(max(camera.width, camera.height))
        ends = [reproject_pixels(maps, each, np.ascontiguousarray(lines), beyond) for each in both]
        (far, first), (near, second) = ((places[chosen], factors[chosen]) for places, factors in ends)
        there = cv2.dilate(np.nan_to_num(inverse_depth(depth[other])), np.ones((_EDGE, _EDGE), np.uint8))
        farther, nearer = (each[chosen] for each in both)
        before = np.float32(1.0 + _SAME_DEPTH) * np.maximum(farther * first, nearer * second) + np.float32(off)
        far, near = np.asarray(far - grid[chosen]), np.asarray(near - grid[chosen])
        ends_at = grid[chosen] + np.asarray((far + near) / 2.0, dtype=np.float32)
        seen = cv2.remap(there, ends_at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return _Still(
            far / np.float32(step), near / np.float32(step), np.asarray(seen > before), np.isnan(rho[chosen])
        )

    first = VIEWS[0]
    half = rig.sensor("left").width // 2, rig.sensor("left").height // 2
    if min(half) < _SMALLEST:
        return {}, 1.0
    small = [np.asarray(cv2.resize(grey_u8(images[view]), half)) for view in (first, _other(first))]
    known = small, dense_flow(*small), cache(lambda: dense_flow(*small[::-1])), stays(first, 2), 0.5 * _MOVED_PX
    evidence = _evidence(*known)
    explained = _explained(*known, evidence)
    if evidence is None:
        return {}, explained
    both = map_frames(lambda view: dense_flow(images[view], images[_other(view)]), VIEWS, size, _FLOW_BYTES)
    flows, greys = dict(zip(VIEWS, both, strict=True)), {view: grey_u8(images[view]) for view in VIEWS}

    def found(view: View) -> Moving:
        other, still = _other(view), stays(view)
        known = (greys[view], greys[other]), flows[view], lambda: flows[other], still, _MOVED_PX
        evidence = _evidence(*known)
        share = np.zeros(greys[view].shape, dtype=np.float32)
        if evidence is not None:
            miss = np.linalg.norm(flows[view] - still.nearest(flows[view]), axis=-1)
            off = returns_px(flows[view], flows[other])
            share = _around(evidence, flow_share(np.nan_to_num(miss, nan=np.inf), off))
        return Moving(share, flows[view])

    return dict(zip(VIEWS, map_frames(found, VIEWS, size, _FLOW_BYTES), strict=True)), explained


def _evidence(
    greys: Sequence[NDArray[np.uint8]], flow: F32, back: Callable[[], F32], still: _Still, least: float
) -> Mask | None:
    """(H, W) pixels whose consistent flow ends off the curves on which static points move, or that would be behind
    the camera if they were static; None if these make no large region.

    Around a pixel, the other frame must also look clearly more similar at the end of the flow than at the place of
    a static point: flow has errors too. ``back`` returns the flow in the other direction, and is called only if
    there are large regions before they are compared with it.
    """
    nearest = still.nearest(flow)
    behind = ~still.unknown & np.isnan(nearest[..., 0])
    moved = (behind | (np.linalg.norm(flow - nearest, axis=-1) > least)) & ~still.hidden
    if not np.any(_large_regions(moved)[1]):
        return None
    moved &= returns_px(flow, back()) < RETURNS_PX
    if not np.any(_large_regions(moved)[1]):
        return None
    labels, large = _large_regions(moved & _clearly_better(greys, flow, nearest, moved, behind | leaves(nearest)))
    return np.asarray(large[labels]) if np.any(large) else None


def _explained(
    greys: Sequence[NDArray[np.uint8]],
    flow: F32,
    back: Callable[[], F32],
    still: _Still,
    least: float,
    evidence: Mask | None,
) -> float:
    """Share of the consistent flow of textured pixels that ends on the curves on which static points move, there
    or beside, since flow extends over edges; without the ``evidence`` (H, W) of objects that move.

    Flow off the curves counts only where the other frame looks clearly more similar at its end than on the curve:
    among posts that look alike, flow is consistent and wrong. ``back`` is called only if flow off the curves may
    be inconsistent.
    """
    nearest = still.nearest(flow)
    on = (np.linalg.norm(flow - nearest, axis=-1) <= least).astype(np.uint8)  # 0 for NaN
    on = cv2.dilate(on, np.ones((_BESIDE, _BESIDE), np.uint8)) > 0
    used = (local_variance(greys[0]) > _TEXTURE_LEVELS**2) & ~still.unknown & ~leaves(flow)
    if evidence is not None and 2 * np.count_nonzero(used & evidence) < np.count_nonzero(used):
        used &= ~evidence  # evidence in most of the image is due to the rig's motion
    if np.count_nonzero(on & used) >= _MOST * np.count_nonzero(used):
        return 1.0
    used &= returns_px(flow, back()) < 0.5 * RETURNS_PX
    if np.count_nonzero(used) <= _FEW * used.size:
        return 1.0
    off, behind = used & ~on, ~still.unknown & np.isnan(nearest[..., 0])
    off &= _clearly_better(greys, flow, nearest, off, behind | leaves(nearest))
    agreeing, contradicting = np.count_nonzero(used & on), np.count_nonzero(off)
    return agreeing / (agreeing + contradicting) if agreeing or contradicting else 1.0


def _regions(mask: Mask) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Labels (H, W) of the regions where most pixels are in a mask (H, W), 0 outside, and their areas (n,)."""
    dense = cv2.medianBlur(mask.astype(np.uint8), _MEDIAN)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dense, connectivity=8)
    return labels, stats[:, cv2.CC_STAT_AREA]


def _large_regions(mask: Mask) -> tuple[NDArray[np.int32], Mask]:
    """Labels (H, W) of the regions of a mask (H, W), and whether each label (n,) is a large one."""
    labels, areas = _regions(mask)
    large = areas >= _LEAST * mask.size
    large[0] = False
    return labels, large


def _around(evidence: Mask, share: F32) -> F32:
    """The weight of flow (H, W) in regions that the ``evidence`` (H, W) shows to move, and beside them; else 0."""
    labels, areas = _regions(share > 0.5)
    moves = np.bincount(labels[evidence], minlength=len(areas)) >= _SEEN * areas
    moves[0] = False
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _BESIDE_PX + 1, 2 * _BESIDE_PX + 1))
    near = cv2.dilate(moves[labels].astype(np.uint8), disc)
    return np.where(near > 0, share, np.float32(0.0))


def _clearly_better(
    greys: Sequence[NDArray[np.uint8]], flow: F32, still: F32, judged: Mask, outside: Mask
) -> Mask:
    """Mask (H, W) of pixels around which ``flow`` (H, W, 2), px, clearly gives smaller differences than ``still``.

    Means over the ``judged`` pixels (H, W) in a window are compared. For pixels whose ``still`` position is
    ``outside`` (H, W), the difference to the mean around the pixel is used."""
    window = (round(_AROUND * flow.shape[1]) | 1,) * 2
    weight = judged.astype(np.float32)
    there = _unlike(greys, np.nan_to_num(still), window)
    plain = greys[0].astype(np.float32)
    there[outside] = np.abs(plain - cv2.blur(plain, window))[outside]
    means = [cv2.blur(each * weight, window) for each in (_unlike(greys, flow, window), there)]
    return np.asarray(means[0] + _NOISE_LEVELS * cv2.blur(weight, window) < _CLEARLY * means[1])


def _unlike(greys: Sequence[NDArray[np.uint8]], flow: F32, window: tuple[int, int]) -> F32:
    """(H, W) absolute difference of grey levels between a frame and the other one at the end of ``flow`` (H, W,
    2), px, after subtraction of its mean in the window, so that differences of brightness do not count."""
    apart = followed(greys[1], flow, cv2.BORDER_REPLICATE).astype(np.float32) - greys[0]
    return np.asarray(np.abs(apart - cv2.blur(apart, window)))


def draw_moving(
    fused: Fused,
    image: NDArray[Any],
    moving: Moving,
    depth: F32,
    maps: LineMaps,
    view: View,
    shutter: RollingShutter,
    target_tau: float,
    interpolation: Interpolation,
) -> Fused:
    """Draw independently moving objects into a corrected frame, in front of farther surfaces.

    Args:
        fused: the frame without them, see ``find_moving``.
        image, depth: (H, W[, 3]) and (H, W) of the frame ``view``; the depth includes guesses.
        moving: the objects in that frame.
        maps: of the frame's lines to the target.
        target_tau: time of the corrected frame, frame periods.
    """
    mask = moving.share > _LITTLE
    if not np.any(mask):
        return fused
    rho = np.nan_to_num(inverse_depth(depth))
    moved = np.zeros((3, *mask.shape))
    move_pixels(rho, maps, moved)
    here = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in mask.shape[::-1])))
    flow, share = np.moveaxis(moving.flow, -1, 0), moving.share
    start = shutter.pixel_time(np.moveaxis(here, 0, -1), view[1], view[0])
    passed = shutter.pixel_time(np.moveaxis(here + flow, 0, -1), 1 - view[1], view[0]) - start
    with np.errstate(divide="ignore", invalid="ignore"):  # flow between equal times has no speed, and is not drawn
        moved[:2] = share * (here + (target_tau - start) / passed * flow) + (1.0 - share) * moved[:2]
    moved[:, ~mask] = np.nan
    places = np.ascontiguousarray(np.moveaxis(moved, 0, -1))
    source_map, buffer = draw_within(places, _STRETCH_PX)
    whole, behind = draw_joined(places, joined_inside(mask))
    # Cracks in an object are closed, but not the gap between two of them.
    shown = cv2.morphologyEx((buffer >= 0.0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_EDGE, _EDGE), np.uint8))
    cracks = (shown > 0) & (buffer < 0.0) & (behind >= 0.0)
    source_map[cracks], buffer[cracks] = whole[cracks], behind[cracks]
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.where(fused.origin == Origin.HERE, np.float32(1.0) / fused.depth, np.float32(-1.0))
    take = (buffer >= 0.0) & ~(there * (1.0 - _AGREE) > buffer)
    drawn = resample(image, source_map, interpolation)
    out, origin, z = fused.image.copy(), fused.origin.copy(), fused.depth.copy()
    out[take], origin[take] = drawn[take], Origin.HERE
    z[take] = 1.0 / np.maximum(buffer[take], np.float32(1e-9))
    return Fused(image=out, origin=origin, depth=z)


def _other(view: View) -> View:
    return view[0], 1 - view[1]


_NEAREST_SHARE = 0.999
_PLANE_ROUNDS = 8
_NEARER = 0.5
"""Pixels without depth may be nearer than the nearest known one: down to this share of its depth."""
_FUSION_BYTES = 150.0
"""Bytes per pixel of a frame, for data from all four frames, float32 and float64."""


@final
@dataclass(frozen=True, kw_only=True)
class FusionCorrector(Corrector):
    """Move every pixel by its depth and the pose of its row; fill holes from the other frames."""

    use_other_views: bool = True
    """Fill areas that the frame did not see from the other three."""
    guess_depth: bool = True
    """Where depth is unknown, use that of the farther neighbour in the row."""
    moving: bool = True
    """Whether to find independently moving objects, and to move them by their flow."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion", "depth"},
        reference="Wang, Fan, Dai, eq. 11, with the holes filled (rsbench)",
        assumes="a scene that stands still, or moves evenly in the image; edges of depth are as good as the depth",
        cameras="rig",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        poses = {view: problem.row_poses(view) for view in VIEWS}
        depth, moving, explained = problem.depth or {}, dict[View, Moving](), math.nan
        if self.moving and depth:
            if problem.guess is not None:
                depth = {view: np.where(depth[view] > 0.0, depth[view], problem.guess[view]) for view in VIEWS}
            moving, explained = find_moving(problem.images, depth, poses, problem.rig, problem.shutter)
            problem = _standing(problem, moving) if moving else problem

        def corrected(view: View) -> Fused:
            sources = self._sources(problem, view, poses)
            sources[0] = self._placed(problem, view, sources[0])
            fused = fuse(sources, problem.rig.sensor(view[0]), problem.target_pose(view), self.warp)
            if not moving:
                return fused
            camera, columns = problem.rig.sensor(view[0]), problem.shutter.axis(view[0]) == 0
            maps = line_maps(camera, poses[view], problem.target_pose(view), columns)
            known = problem.images[view], moving[view], depth[view], maps, view, problem.shutter
            return draw_moving(fused, *known, float(problem.target_time(view)), self.warp.interpolation)

        pixels = max(image.shape[0] * image.shape[1] for image in problem.images.values())
        found = [
            replace(each, explained=explained) for each in map_frames(corrected, views, pixels, _FUSION_BYTES)
        ]
        return dict(zip(views, found, strict=True))

    def _sources(self, problem: CorrectionProblem, view: View, poses: Mapping[View, Pose]) -> list[SourceView]:
        """The source images of a corrected view, from the most to the least trusted."""
        side, frame = view
        other: Side = "right" if side == "left" else "left"
        order = [(view, Origin.HERE)]
        if self.use_other_views:
            order += [
                ((other, frame), Origin.OTHER_CAMERA),
                ((side, 1 - frame), Origin.OTHER_FRAME),
                ((other, 1 - frame), Origin.OTHER_FRAME),
            ]
        if self.guess_depth:
            order.append((view, Origin.GUESSED))
        return [
            replace(
                _source(problem, source, poses[source], _depths(problem, origin)[source], origin),
                camera=problem.camera(source[0], side),
            )
            for source, origin in order
        ]

    def _placed(self, problem: CorrectionProblem, view: View, source: SourceView) -> SourceView:
        """Guess unknown depth in lines where any plausible depth moves pixels by less than ``tear_px``."""
        known = source.depth[source.depth > 0.0]
        if problem.guess is None or known.size == 0:
            return source
        nearest = _NEARER * float(np.quantile(known, 1.0 - _NEAREST_SHARE))
        gain = warp_gain(problem.rig.sensor(view[0]), source.poses, problem.target_pose(view), source.columns)
        certain = (source.depth == 0.0) & (gain <= self.warp.tear_px * nearest)
        guess = np.where(problem.guess[view] > 0.0, problem.guess[view], np.float32(np.inf))
        return replace(source, depth=np.where(certain, guess, source.depth))


def _standing(problem: CorrectionProblem, moving: Mapping[View, Moving]) -> CorrectionProblem:
    """Set the depth of moving objects to unknown."""

    def still(depth: Depths | None) -> Depths | None:
        if depth is None:
            return None
        return {view: np.where(moving[view].share > 0.5, np.float32(0.0), depth[view]) for view in VIEWS}

    return replace(problem, depth=still(problem.depth), guess=still(problem.guess))


def _source(problem: CorrectionProblem, view: View, poses: Pose, depth: F32, origin: Origin) -> SourceView:
    columns = problem.shutter.axis(view[0]) == 0
    return SourceView(image=problem.images[view], depth=depth, poses=poses, origin=origin, columns=columns)


def _depths(problem: CorrectionProblem, origin: Origin = Origin.HERE) -> Depths:
    depth = problem.guess if origin is Origin.GUESSED else problem.depth
    if depth is None:
        raise ValueError("the depth is not known: 'depth' must be among the needs of the corrector")
    return depth


@final
@dataclass(frozen=True, kw_only=True)
class RotationCorrector(Corrector):
    """Treat everything as being at infinity: only the rotation moves it, by one homography per row."""

    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion"},
        reference="Forssen, Ringaby, Rectifying rolling shutter video from hand-held devices, CVPR 2010",
        assumes="a scene so far away that translation moves no pixel",
        cameras="rig",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return {view: turned(problem, view, self.warp) for view in views}


@final
@dataclass(frozen=True, kw_only=True)
class PlaneCorrector(Corrector):
    """Treat everything as lying on the plane that fits the depth of the frame best: one homography per row."""

    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion", "depth"},
        reference="Wang, Fan, Dai, eq. 11, at the depth of one plane (rsbench)",
        assumes="a scene that is one plane",
        cameras="rig",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        depth = _depths(problem)
        return {
            view: _alone(problem, view, plane_depth(depth[view], problem.rig.sensor(view[0])), self.warp)
            for view in views
        }


def plane_depth(depth: NDArray[Any], camera: PinholeCamera | None = None) -> F32:
    """Depth (H, W) of the plane that fits a depth map (H, W) best: inverse depth affine in the (ideal) pixel.

    Iterated least squares on absolute differences, so that the larger surface wins; 0 and NaN are unknown, inf is
    infinitely far. The result is inf where the plane lies behind the camera. A correction with it is a homography
    per row. ``camera`` is needed only if it has a lens.
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    if camera is not None and camera.lens is not None:
        x, y = np.moveaxis(camera.unproject(camera.pixel_grid())[..., :2], -1, 0)
    basis = np.stack([np.ones_like(x), x, y], axis=-1)
    known = depth > 0.0
    if np.count_nonzero(known) < 3:
        return np.full(depth.shape, np.inf, dtype=np.float32)
    A, rho = basis[known], 1.0 / depth[known].astype(np.float64)
    least = 1e-3 * max(float(np.median(rho)), 1e-12)
    weights, plane = np.ones_like(rho), np.zeros(3)
    for _ in range(_PLANE_ROUNDS):
        plane, *_ = np.linalg.lstsq(A * weights[:, None], rho * weights, rcond=None)
        weights = 1.0 / np.sqrt(np.maximum(np.abs(A @ plane - rho), least))
    fitted = basis @ plane
    with np.errstate(divide="ignore"):
        return np.where(fitted > 0.0, 1.0 / np.maximum(fitted, 0.0), np.inf).astype(np.float32)


def turned(problem: CorrectionProblem, view: View, options: WarpOptions) -> Fused:
    """Correct a frame by the rotation of the problem's motion alone: all depth is infinite."""
    camera = problem.rig.sensor(view[0])
    far = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    return _alone(problem, view, far, options)


def _alone(problem: CorrectionProblem, view: View, depth: F32, options: WarpOptions) -> Fused:
    source = _source(problem, view, problem.row_poses(view), depth, Origin.HERE)
    return fuse([source], problem.rig.sensor(view[0]), problem.target_pose(view), options)
