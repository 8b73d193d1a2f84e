"""Our correctors: the complete fusion, and correctors with simpler assumptions.

Independently moving objects in front of a moving rig are found where flow contradicts geometry. Their depth comes
from two cameras at one time and is right, but the motion of the rig does not predict their position at another
time. Their flow does, scaled by the times of the rows, if they move uniformly in the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import SIDES, VIEWS, Side, StereoRig, View
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.vision.correction import WarpOptions, draw_within, inverse_depth, warp_gain
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec, Depths
from rsbench.vision.flow import dense_flow, followed, returns_px
from rsbench.vision.fusion import Fused, Origin, SourceView, fuse
from rsbench.vision.images import Interpolation, grey_u8, map_frames, resample
from rsbench.vision.reprojection import reproject_pixels, reprojection_of

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_RETURNS_PX = 1.0
"""Largest distance, px, between a pixel and the end of its flow there and back, for flow that is trusted."""
_MOVED_PX = 2.0
"""Least distance, px, between the end of the flow and the place of a static point, for a pixel that moved."""
_DISPARITY_PX = 1.0
"""Relative error of depth by which a static point may be farther or nearer."""
_NOISE_LEVELS, _CLEARLY = 1.0, 0.7
"""Difference of grey levels that is always tolerated, and the share of the difference at the place by geometry
that the place by flow may have."""
_MEDIAN, _CORE, _NEAR_PX = 9, 9, 12
"""Sides, px, of the windows in which most or all pixels must move, and distance, px, by which an object is
extended."""
_LEAST = 0.004
"""Least share of the image's area: smaller objects are left to geometry, because errors also occur in such
spots."""
_SAME_DEPTH, _SAME_FLOW_PX = 0.06, 3.0
"""Largest relative difference of inverse depth from the nearest certain pixel of an object, for a pixel that
belongs to it; and of flow, for a pixel that keeps its own."""
_EDGE = 7
"""Side, px, of the window whose nearest surface may hide a point: depth has errors at edges."""
_SMALLEST = 12
"""Least side of an image, px, for dense flow (OpenCV 5.0)."""
_STRETCH_PX = 2.5
"""Largest distance, px, between neighbours at the target for which the area between them is drawn."""
_AGREE = 0.03
"""Relative difference of depth below which a moving object lies on a static surface, and is visible."""
_FLOW_BYTES = 100.0


class _Still(NamedTuple):
    """Motion of static points: (H, W, 2) px, NaN where it is unknown, and (H, W) whether they are hidden there."""

    far: F32
    """(H, W, 2) displacement, px, of a static point that is somewhat farther."""
    near: F32
    hidden: Mask
    """Whether a nearer surface hides the point, so that the other frame shows another colour there."""


class Moving(NamedTuple):
    """Independently moving objects in a frame."""

    mask: Mask
    """(H, W)."""
    flow: F32
    """(H, W, 2) px, to the other frame of the camera."""


def find_moving(
    images: Mapping[View, NDArray[Any]],
    depth: Mapping[View, F32],
    poses: Mapping[View, Pose],
    rig: StereoRig,
    shutter: RollingShutter,
) -> dict[View, Moving]:
    """Find independently moving objects in four frames (H, W[, 3]), by depth (H, W) and the lines' poses; there
    may be none.

    In most scenes, half-size frames suffice to exclude them.
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
        ends = [reproject_pixels(maps, each, np.ascontiguousarray(lines)) for each in both]
        (far, first), (near, second) = ((places[chosen], factors[chosen]) for places, factors in ends)
        there = cv2.dilate(np.nan_to_num(inverse_depth(depth[other])), np.ones((_EDGE, _EDGE), np.uint8))
        farther, nearer = (each[chosen] for each in both)
        before = np.float32(1.0 + _SAME_DEPTH) * np.maximum(farther * first, nearer * second) + np.float32(off)
        far, near = np.asarray(far - grid[chosen]), np.asarray(near - grid[chosen])
        ends_at = grid[chosen] + np.asarray((far + near) / 2.0, dtype=np.float32)
        seen = cv2.remap(there, ends_at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return _Still(far / np.float32(step), near / np.float32(step), np.asarray(seen > before))

    first = VIEWS[0]
    half = rig.sensor("left").width // 2, rig.sensor("left").height // 2
    if min(half) < _SMALLEST:
        return {}
    small = [np.asarray(cv2.resize(grey_u8(images[view]), half)) for view in (first, _other(first))]
    flow = dense_flow(*small)
    if not np.any(_moved(small, flow, lambda: dense_flow(*small[::-1]), stays(first, 2), 0.5 * _MOVED_PX)):
        return {}
    both = map_frames(lambda view: dense_flow(images[view], images[_other(view)]), VIEWS, size, _FLOW_BYTES)
    flows, greys = dict(zip(VIEWS, both, strict=True)), {view: grey_u8(images[view]) for view in VIEWS}

    def found(view: View) -> Moving:
        other = _other(view)
        mask = _moved((greys[view], greys[other]), flows[view], lambda: flows[other], stays(view), _MOVED_PX)
        return _outlined(Moving(mask, flows[view]), inverse_depth(depth[view]))

    return dict(zip(VIEWS, map_frames(found, VIEWS, size, _FLOW_BYTES), strict=True))


def _moved(
    greys: Sequence[NDArray[np.uint8]], flow: F32, back: Callable[[], F32], still: _Still, least: float
) -> Mask:
    """(H, W) large regions whose consistent flow ends off the curves on which static points move.

    The place by flow must also look clearly more similar: flow has errors too. ``back`` returns the flow in the
    other direction, and is called only if there are large regions before they are compared with it.
    """
    far, along = still.far, still.near - still.far
    share = np.sum((flow - far) * along, axis=-1) / np.maximum(np.sum(along * along, axis=-1), np.float32(1e-6))
    nearest = far + np.clip(share, 0.0, 1.0)[..., None] * along
    moved = np.linalg.norm(flow - nearest, axis=-1) > least  # False for NaN
    moved &= ~still.hidden
    if not np.any(_large_regions(moved)[1]):
        return np.zeros_like(moved)
    labels, large = _large_regions(moved & (returns_px(flow, back()) < _RETURNS_PX))
    if not np.any(large):
        return np.zeros_like(moved)
    chosen, count = large[labels] & np.isfinite(nearest[..., 0]) & ~still.hidden, len(large)
    unlike = [np.bincount(labels[chosen], _unlike(greys, each)[chosen], count) for each in (flow, nearest)]
    large &= unlike[0] + _NOISE_LEVELS * np.bincount(labels[chosen], minlength=count) < _CLEARLY * unlike[1]
    return np.asarray(large[labels])


def _large_regions(mask: Mask) -> tuple[NDArray[np.int32], Mask]:
    """Labels (H, W) of regions where most pixels are in a mask (H, W), and whether each label (n,) is a large
    one."""
    dense = cv2.medianBlur(mask.astype(np.uint8), _MEDIAN)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(dense, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST * mask.size
    large[0] = False
    return labels, large


def _unlike(greys: Sequence[NDArray[np.uint8]], flow: F32) -> F32:
    """(H, W) difference of grey levels between a frame and the other one at the end of ``flow`` (H, W, 2), px."""
    return np.abs(followed(greys[1], flow, cv2.BORDER_CONSTANT).astype(np.float32) - greys[0])


def _outlined(moving: Moving, rho: F32) -> Moving:
    """Objects extended to the limits of their own depth, with the flow of nearby pixels: flow extends over
    edges."""
    core = cv2.erode(moving.mask.astype(np.uint8), np.ones((_CORE, _CORE), np.uint8)) & np.isfinite(rho)
    if not np.any(core):
        return Moving(np.zeros_like(moving.mask), moving.flow)
    apart, label = cv2.distanceTransformWithLabels(1 - core, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    y, x = np.nonzero(core)
    at = np.zeros((label.max() + 1, 2), dtype=np.intp)
    at[label[y, x]] = np.stack([y, x], axis=-1)
    v, u = np.moveaxis(at[label], -1, 0)
    beside, flow = rho[v, u], moving.flow[v, u]
    mask = (apart <= _NEAR_PX) & (np.abs(rho - beside) <= _SAME_DEPTH * beside)
    own = moving.mask & (np.linalg.norm(moving.flow - flow, axis=-1) <= _SAME_FLOW_PX)
    return Moving(np.asarray(mask), np.where(own[..., None], moving.flow, flow))


def draw_moving(
    fused: Fused,
    image: NDArray[Any],
    moving: Moving,
    depth: F32,
    view: View,
    shutter: RollingShutter,
    target_tau: float,
    interpolation: Interpolation,
) -> Fused:
    """Draw independently moving objects into a corrected frame, in front of farther surfaces.

    Args:
        fused: the frame without them, see ``find_moving``.
        image, depth: (H, W[, 3]), (H, W) of the frame of the ``view``.
        moving: the objects in that frame.
        target_tau: time of the corrected frame, frame periods.
    """
    mask = moving.mask & (depth > 0.0)
    if not np.any(mask):
        return fused
    y, x = np.nonzero(mask)
    here = np.stack([x, y], axis=-1).astype(np.float64)
    flow = moving.flow[y, x]
    start = shutter.pixel_time(here, view[1], view[0])
    passed = shutter.pixel_time(here + flow, 1 - view[1], view[0]) - start
    with np.errstate(divide="ignore", invalid="ignore"):  # flow between equal times has no speed, and is not drawn
        share = (target_tau - start) / passed
    moved = np.full((*mask.shape, 3), np.nan)
    moved[y, x, :2] = here + share[:, None] * flow
    moved[y, x, 2] = inverse_depth(depth)[y, x]
    source_map, buffer = draw_within(moved, _STRETCH_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        behind = np.where(fused.origin == Origin.NOBODY, np.float32(-1.0), np.float32(1.0) / fused.depth)
    take = (buffer >= 0.0) & ~(behind * (1.0 - _AGREE) > buffer)
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
        depth, moving = problem.depth or {}, dict[View, Moving]()
        if self.moving and depth:
            moving = find_moving(problem.images, depth, poses, problem.rig, problem.shutter)
            problem = _standing(problem, moving) if moving else problem

        def corrected(view: View) -> Fused:
            sources = self._sources(problem, view, poses)
            sources[0] = self._placed(problem, view, sources[0])
            fused = fuse(sources, problem.rig.sensor(view[0]), problem.target_pose(view), self.warp)
            if not moving:
                return fused
            tau = float(problem.target_time(view))
            known = problem.images[view], moving[view], depth[view], view, problem.shutter, tau
            return draw_moving(fused, *known, self.warp.interpolation)

        pixels = max(image.shape[0] * image.shape[1] for image in problem.images.values())
        found = map_frames(corrected, views, pixels, _FUSION_BYTES)
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
        """The frame with a depth in those lines where any depth moves a pixel by less than ``tear_px``."""
        known = source.depth[source.depth > 0.0]
        if problem.guess is None or known.size == 0:
            return source
        nearest = _NEARER * float(np.quantile(known, 1.0 - _NEAREST_SHARE))
        gain = warp_gain(problem.rig.sensor(view[0]), source.poses, problem.target_pose(view), source.columns)
        certain = (source.depth == 0.0) & (gain <= self.warp.tear_px * nearest)
        guess = np.where(problem.guess[view] > 0.0, problem.guess[view], np.float32(np.inf))
        return replace(source, depth=np.where(certain, guess, source.depth))


def _standing(problem: CorrectionProblem, moving: Mapping[View, Moving]) -> CorrectionProblem:
    """Depth without that of moving objects."""

    def still(depth: Depths | None) -> Depths | None:
        if depth is None:
            return None
        return {view: np.where(moving[view].mask, np.float32(0.0), depth[view]) for view in VIEWS}

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
    infinitely far. Where the plane lies behind the camera the result is inf. A correction with it is a homography
    per row. ``camera`` matters where it has a lens.
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
    """A frame moved only by the rotation of the problem's motion: everything is at infinity."""
    camera = problem.rig.sensor(view[0])
    far = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    return _alone(problem, view, far, options)


def _alone(problem: CorrectionProblem, view: View, depth: F32, options: WarpOptions) -> Fused:
    source = _source(problem, view, problem.row_poses(view), depth, Origin.HERE)
    return fuse([source], problem.rig.sensor(view[0]), problem.target_pose(view), options)
