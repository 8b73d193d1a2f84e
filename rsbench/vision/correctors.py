"""Our correctors: the whole fusion, and what simpler assumptions leave of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from rsbench.core.rig import VIEWS, Side, View
from rsbench.core.se3 import Pose
from rsbench.vision.baseline_depths import plane_depth
from rsbench.vision.correction import WarpOptions, warp_gain
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec, Depths
from rsbench.vision.frame_threads import map_frames
from rsbench.vision.fusion import Fused, Origin, SourceView, fuse
from rsbench.vision.moving_things import Moving, draw_moving, find_moving

F32 = NDArray[np.float32]
_NEAREST_SHARE = 0.999
_NEARER = 0.5
"""What has no depth may be nearer than the nearest that has: down to this share of its depth."""
_FUSION_BYTES = 150.0
"""Per pixel of a frame: what is carried over from the four, float32 and float64."""


@final
@dataclass(frozen=True, kw_only=True)
class FusionCorrector(Corrector):
    """Every pixel moved by its depth and its row's pose; holes filled from the other frames."""

    use_other_views: bool = True
    """Fill what the frame did not see from the other three."""
    guess_depth: bool = True
    """Where no depth was found, take that of the farther neighbour in the row."""
    moving: bool = True
    """Whether what moves by itself is looked for, and goes its flow."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion", "depth"},
        reference="Wang, Fan, Dai, eq. 11, with the holes filled (rsbench)",
        assumes="a scene that stands still, or moves evenly in the image; edges of depth are as good as the depth",
        cameras="any",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        poses, camera = {view: problem.row_poses(view) for view in VIEWS}, problem.rig.camera
        depth, moving = problem.depth or {}, dict[View, Moving]()
        if self.moving and depth:
            moving = find_moving(problem.images, depth, poses, problem.rig, problem.shutter)
            problem = _standing(problem, moving) if moving else problem

        def corrected(view: View) -> Fused:
            sources = self._sources(problem, view, poses)
            sources[0] = self._placed(problem, view, sources[0])
            fused = fuse(sources, camera, problem.target_pose(view), self.warp)
            if not moving:
                return fused
            tau = float(problem.shutter.time_after(problem.target_row, view[1], view[0]))
            known = problem.images[view], moving[view], depth[view], view, problem.shutter, tau
            return draw_moving(fused, *known, self.warp.interpolation)

        found = map_frames(corrected, views, camera.width * camera.height, _FUSION_BYTES)
        return dict(zip(views, found, strict=True))

    def _sources(self, problem: CorrectionProblem, view: View, poses: Mapping[View, Pose]) -> list[SourceView]:
        """The images that a corrected view is made of, in the order in which they are trusted."""
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
            replace(_source(problem, source, poses[source], origin), camera=problem.camera(source[0], side))
            for source, origin in order
        ]

    def _placed(self, problem: CorrectionProblem, view: View, source: SourceView) -> SourceView:
        """The frame with a depth in the lines where no depth would move a pixel by more than ``tear_px``."""
        known = source.depth[source.depth > 0.0]
        if problem.guess is None or known.size == 0:
            return source
        nearest = _NEARER * float(np.quantile(known, 1.0 - _NEAREST_SHARE))
        gain = warp_gain(problem.rig.camera, source.poses, problem.target_pose(view), source.columns)
        certain = (source.depth == 0.0) & (gain <= self.warp.tear_px * nearest)
        guess = np.where(problem.guess[view] > 0.0, problem.guess[view], np.float32(np.inf))
        return replace(source, depth=np.where(certain, guess, source.depth))


def _standing(problem: CorrectionProblem, moving: Mapping[View, Moving]) -> CorrectionProblem:
    """Without the depth of what moves."""

    def still(depth: Depths | None) -> Depths | None:
        if depth is None:
            return None
        return {view: np.where(moving[view].mask, np.float32(0.0), depth[view]) for view in VIEWS}

    return replace(problem, depth=still(problem.depth), guess=still(problem.guess))


def _source(problem: CorrectionProblem, view: View, poses: Pose, origin: Origin) -> SourceView:
    depth = problem.guess if origin is Origin.GUESSED else problem.depth
    if depth is None:
        raise ValueError("the depth is not known: 'depth' must be among the needs of the corrector")
    columns = problem.shutter.axis(view[0]) == 0
    return SourceView(image=problem.images[view], depth=depth[view], poses=poses, origin=origin, columns=columns)


@final
@dataclass(frozen=True, kw_only=True)
class RotationCorrector(Corrector):
    """Everything at infinity, which moves by the rotation alone: one homography per row."""

    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion"},
        reference="Forssen, Ringaby, Rectifying rolling shutter video from hand-held devices, CVPR 2010",
        assumes="a scene so far away that translation moves no pixel",
        cameras="any",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return {view: turned(problem, view, self.warp) for view in views}


@final
@dataclass(frozen=True, kw_only=True)
class PlaneCorrector(Corrector):
    """Everything on the plane that fits the depth of the frame best: one homography per row."""

    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"motion", "depth"},
        reference="Wang, Fan, Dai, eq. 11, at the depth of one plane (rsbench)",
        assumes="a scene that is one plane",
        cameras="any",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        if problem.depth is None:
            raise ValueError("the depth is not known: 'depth' must be among the needs of the corrector")
        depth = problem.depth
        return {
            view: _alone(problem, view, plane_depth(depth[view], problem.rig.camera), self.warp) for view in views
        }


def turned(problem: CorrectionProblem, view: View, options: WarpOptions) -> Fused:
    """A frame as the rotation of the problem's motion alone moves it: everything is at infinity."""
    far = np.full((problem.rig.camera.height, problem.rig.camera.width), np.inf, dtype=np.float32)
    return _alone(problem, view, far, options)


def _alone(problem: CorrectionProblem, view: View, depth: F32, options: WarpOptions) -> Fused:
    source = SourceView(
        image=problem.images[view],
        depth=depth,
        poses=problem.row_poses(view),
        origin=Origin.HERE,
        columns=problem.shutter.axis(view[0]) == 0,
    )
    return fuse([source], problem.rig.camera, problem.target_pose(view), options)
