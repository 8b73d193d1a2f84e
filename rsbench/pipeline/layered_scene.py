"""Correction with one camera alone for a scene of a few planes: layers and motion are estimated alternately.

Vasu, Mohan M. R., Rajagopalan, "Occlusion-aware rolling shutter rectification of 3D scenes", CVPR 2018. We had its
abstract but not its text: camera motion and scene structure are estimated alternately, considering shutter and
occlusion, then several frames are rectified with depth and occlusion. All other choices are ours; they are
described at the fields and in ``rsbench.vision.layers``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from rsbench.components.motion_models import make_motion
from rsbench.core.arguments import check_whole
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import FRAMES, SIDES, Side, View
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.correction import WarpOptions
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused, Origin, SourceView, fuse
from rsbench.vision.images import grey_u8
from rsbench.vision.layers import (
    Labelled,
    LabelOptions,
    MovingCamera,
    PlaneOptions,
    followed,
    fronto_parallel,
    label_pixels,
    on_layers,
    refined,
)
from rsbench.vision.reprojection import F32

_STILL_PX = 0.1
"""Least median displacement of the matches, px, for an estimate of the motion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LayeredScene:
    """The layers and the motion that were estimated from two frames of one camera."""

    camera: MovingCamera
    """The camera with its motion about its own centre; d has length 1, or 0 if there is no translation."""
    planes: FloatArray
    """(n, 3), see ``rsbench.vision.layers``."""
    labelled: Labelled
    rounds: int
    """Number of rounds in which layers and motion were estimated."""

    def depth(self, frame: int) -> F32:
        """(H, W) depth of a frame at each row's time, in the unit of d; inf at infinity, NaN behind the camera."""
        rho = self.camera.inverse_depths(self.planes, frame)
        chosen = np.take_along_axis(rho, self.labelled.labels[frame][None], axis=0)[0]
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.abs(chosen), dtype=np.float32)


@final
@dataclass(frozen=True, kw_only=True)
class LayersCorrector(Corrector):
    """Correct each camera alone by a few planar layers; nearer ones are rendered over farther ones."""

    motion_model: str = "linear"
    """Motion model of the rows' poses: constant velocity over both frames instead of one pose per row."""
    planes: PlaneOptions = field(default_factory=PlaneOptions)
    """Options of the fitted planes."""
    labels: LabelOptions = field(default_factory=LabelOptions)
    """Assignment of pixels to planes."""
    rounds: int = 3
    """Most rounds of layers and motion; they end when the cost does not decrease."""
    use_other_frame: bool = True
    """Fill areas that the frame does not show from the camera's other frame."""
    robust: RobustOptions = field(default_factory=RobustOptions)
    """RANSAC of the motion."""
    seed: int = 0
    """Seed of the random samples."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"matches"},
        reference="Vasu, Mohan M. R., Rajagopalan: Occlusion-aware rolling shutter rectification of 3D scenes, "
        "CVPR 2018",
        assumes="one camera, two frames: constant velocity; a static scene of a few planes, each at one depth",
    )

    def __post_init__(self) -> None:
        check_whole("rounds", self.rounds, 1, 20)
        self._solver()

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return self.correct_rows(problem, views, (problem.target_row,))[0]

    def correct_rows(
        self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
    ) -> list[dict[View, Fused]]:
        scenes = {side: self.scene(problem, side) for side in dict(views)}

        def corrected(view: View, row: float) -> Fused:
            scene = scenes[view[0]]
            if isinstance(scene, str):
                return Fused.failed(problem.images[view], scene)
            return self.rendered(replace(problem, target_row=row), view, scene)

        return [{view: corrected(view, row) for view in views} for row in rows]

    def scene(self, problem: CorrectionProblem, side: Side) -> LayeredScene | str:
        """Estimate layers and motion of one camera, or return why not. Raises ValueError without matches."""
        started = self._start(problem, side)
        if isinstance(started, str):
            return started
        camera, matches = started
        planes = fronto_parallel(matches, camera, self.planes)
        first, second = (grey_u8(problem.images[side, frame]).astype(np.float32) for frame in FRAMES)
        greys = first, second
        best = LayeredScene(camera=camera, planes=planes, labelled=self._labelled(greys, camera, planes), rounds=1)
        for number in range(2, self.rounds + 1):
            sets = on_layers(matches, best.labelled), followed(greys, best.labelled)
            motion, planes = refined(sets, best.camera, best.planes)
            camera = best.camera._replace(motion=motion)
            labelled = self._labelled(greys, camera, planes)
            if labelled.cost >= best.labelled.cost:
                break
            best = LayeredScene(camera=camera, planes=planes, labelled=labelled, rounds=number)
        return best

    def _labelled(self, greys: tuple[F32, F32], camera: MovingCamera, planes: FloatArray) -> Labelled:
        return label_pixels(greys, camera, planes, self.labels, self.planes.thickness_px)

    def _start(self, problem: CorrectionProblem, side: Side) -> tuple[MovingCamera, FloatArray] | str:
        """The camera with the motion estimated from its temporal matches, and the inliers (n, 4)."""
        if problem.matches is None:
            raise ValueError("the matches are not known: 'matches' must be among the needs of the corrector")
        pairs = temporal_pairs(problem.matches, side)
        moved = float(np.median(np.linalg.norm(pairs[:, 2:] - pairs[:, :2], axis=1))) if len(pairs) else 0.0
        if len(pairs) and moved < _STILL_PX:
            return f"the matches of the {side} camera move by {moved:.2g} px only: there is no motion to correct"
        rng = np.random.default_rng([self.seed, SIDES.index(side)])
        rig = problem.rig.about(side)
        given = Correspondences(left=pairs)
        found = estimate_motion(given, problem.rig, problem.shutter, self._solver(), self.robust, rng)
        if not found.estimate.success:
            return f"no motion of the {side} camera explains its matches: {found.estimate.reason}"
        d, length = found.estimate.d, float(np.linalg.norm(found.estimate.d))
        motion = make_motion(self.motion_model, found.estimate.w, d / length if length > 0.0 else d)
        return MovingCamera(rig, problem.shutter, side, motion), pairs[found.inliers["left"]]

    def rendered(self, problem: CorrectionProblem, view: View, scene: LayeredScene) -> Fused:
        """Render the corrected frame of a view from the layers, nearer ones over farther ones."""
        side, frame = view
        known = replace(problem, rig=scene.camera.rig, motion=scene.camera.motion)
        order = [(frame, Origin.HERE)]
        if self.use_other_frame:
            order.append((1 - frame, Origin.OTHER_FRAME))
        sources = [
            SourceView(
                image=problem.images[side, each],
                depth=scene.depth(each),
                poses=scene.camera.row_poses(each),
                origin=origin,
            )
            for each, origin in order
        ]
        return fuse(sources, known.rig.camera, known.target_pose(view), self.warp)

    def _solver(self) -> RefinedSolver:
        return RefinedSolver(one_camera=True, motion_model=self.motion_model)
