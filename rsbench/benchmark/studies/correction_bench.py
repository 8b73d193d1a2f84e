"""Methods of the correction study, and the inputs that they share on a sequence: matches, motions and depths."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.images.store import identity_of
from rsbench.benchmark.provenance import numeric_version
from rsbench.benchmark.scoring import motion_errors
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.components.imports import hash_of_files
from rsbench.components.seeds import generator
from rsbench.core.geometry import FixedGeometry
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, VIEWS, Side, View
from rsbench.dataset.clock_channels import gyro_samples
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.baseline_motions import (
    ZhuangCorrector,
    depth_alone,
    global_shutter_motion,
    kept_matches,
    monocular_motion,
    solved_alone,
)
from rsbench.pipeline.chain import Given, correct_four, correct_frames, uncorrected
from rsbench.pipeline.frame_capture import find_matches
from rsbench.pipeline.frame_depth import CorrectionOptions, Pairs, frame_pairs, known_depth
from rsbench.pipeline.frame_motion import FoundMotion, find_motion, model_to_use
from rsbench.pipeline.layered_scene import LayersCorrector
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.storage.files import sha256
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import CorrectionProblem, load_corrector
from rsbench.vision.correctors import plane_depth
from rsbench.vision.fusion import Fused, Origin, inpaint
from rsbench.vision.rotation_correctors import ImageRotationCorrector

Row = dict[str, Any]
Rows = tuple[list[Row], list[Row], list[Row]]
"""Scores of every method on every view, errors by row band, motion errors."""


def rows_identity(dataset: Path, name: str, **options: object) -> str:
    """Return a hash of code, packages, data and ``options``; stored rows with the same hash are up to date."""
    benchmark = Path(str(resources.files("rsbench"))) / "benchmark"
    return identity_of(
        numeric=numeric_version(),
        studies=hash_of_files(benchmark, sorted(benchmark.rglob("*.py"))),
        sequence=sha256(dataset / name / "sequence.json"),
        **options,
    )


@dataclass(frozen=True, kw_only=True)
class Method:
    """A correction method, which is a row of the tables."""

    key: str
    title: str
    kind: str
    """``none``, ``baseline``, ``ours``, ``law`` (ours, given a motion model) or ``oracle``."""
    knows: str
    """Assumptions and inputs of the method."""
    slow_scores: bool = False
    """Whether FLIP and the SSIM of other protocols are computed, as for the best methods of each family."""


METHODS = (
    Method(key="none", title="uncorrected", kind="none", knows="nothing", slow_scores=True),
    Method(key="gyro", title="rotation only, true", kind="baseline", knows="true rotation, as of a perfect gyro"),
    Method(key="rotation", title="rotation only, estimated", kind="baseline", knows="our rotation; no depth"),
    Method(
        key="gs",
        title="GS motion, SGM depth",
        kind="baseline",
        knows="motion solved as if the shutter was global; depth as ours, with that motion",
    ),
    Method(
        key="gs-scaled",
        title="GS motion of scaled matches, SGM depth",
        kind="baseline",
        knows="`gs-stereo-tracks-scaled`: motion as if the shutter was global, of matches scaled to one "
        "frame period by their rows, which suits a twist; depth as ours, with that motion",
        slow_scores=True,
    ),
    Method(
        key="gs-mono",
        title="monocular GS of scaled matches",
        kind="baseline",
        knows="one camera, two frames: `gs-poselib-scaled`, the strongest monocular solver that knows no rolling "
        "shutter but in the scale of its matches; depth from dense flow in the same unit",
    ),
    Method(
        key="mono",
        title="monocular, constant velocity",
        kind="baseline",
        knows="one camera, two frames: its motion up to scale (descending from ours), depth from dense flow in "
        "the same unit",
        slow_scores=True,
    ),
    Method(
        key="plane",
        title="one plane",
        kind="baseline",
        knows="our motion; the plane that fits SGM depth best",
        slow_scores=True,
    ),
    Method(
        key="ours",
        title="ours",
        kind="ours",
        knows="estimated motion, of the law that the matches prefer; SGM depth, and depth from the motion where "
        "SGM finds none",
        slow_scores=True,
    ),
    Method(key="linear", title="ours, linear", kind="law", knows="the same, given that the motion is `linear`"),
    Method(key="twist", title="ours, twist", kind="law", knows="the same, given that the motion is a `twist`"),
    Method(key="true-motion", title="true motion, SGM depth", kind="oracle", knows="true motion; depth as ours"),
    Method(key="true-depth", title="our motion, true depth", kind="oracle", knows="true depth"),
    Method(key="truth", title="true motion, true depth", kind="oracle", knows="true motion and depth"),
)
ON_REQUEST = (
    Method(
        key="gyroscope",
        title="rotation only, measured",
        kind="baseline",
        knows="what the gyroscope of the channel `imu` measured, with its noise, bias and clock; no depth",
    ),
    Method(
        key="zhuang",
        title="monocular, Zhuang et al.",
        kind="baseline",
        knows="one camera, two frames: its motion by `rs-zhuang-8pt`, depth from dense flow in the same unit",
    ),
    Method(
        key="vasu-layers",
        title="monocular, Vasu et al.",
        kind="baseline",
        knows="one camera, two frames: planes of one depth each, and its motion, in turn",
    ),
    Method(key="lao-lines", title="lines, Lao et al.", kind="baseline", knows="one image: curves that were lines"),
    Method(
        key="purkait-manhattan",
        title="Manhattan, Purkait et al.",
        kind="baseline",
        knows="one image: lines along three orthogonal directions",
    ),
)
"""Methods that a study includes on request: docs/explanation/correctors.md compares them."""


def methods_among(keys: Collection[str]) -> list[Method]:
    """Return the methods with these keys, in the order of the tables."""
    return [method for method in (*METHODS, *ON_REQUEST) if method.key in keys]


Depth = NDArray[np.float32]
_SCALED, _MONOCULAR = "gs-stereo-tracks-scaled", "gs-poselib-scaled"
_OF_LAW = {"linear": "rs-stereo-refined", "twist": "rs-stereo-refined-twist"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """A view corrected by a method."""

    image: NDArray[Any]
    """(H, W, C) corrected image, complete."""
    covered: NDArray[np.bool_]
    """(H, W) mask of the pixels drawn from the frame itself with an estimated or true depth."""
    flow: NDArray[np.float32]
    """(H, W, 2) displacement of the pixels of the rolling-shutter frame, px; NaN where unknown."""


class Bench:
    """Inputs and intermediate results that all methods share on one sequence."""

    def __init__(self, sequence: Sequence, seed: int, solver: str = "rs-stereo-refined") -> None:
        self.sequence = sequence
        entry = load_solver_entry(solver)
        self.options = CorrectionOptions(inpaint=True, solver=entry, motion_model=model_to_use(None, entry))
        self.images = {view: sequence.image("rs", *view) for view in VIEWS}
        self.rig, self.shutter = sequence.rig, sequence.shutter
        self.matches = find_matches(self.images, self.options)
        self._seed = seed
        self.found = self._found("rs", self.options)
        self.sgm = frame_pairs(self.images, self.rig, self.options)

    @cached_property
    def scaled(self) -> FoundMotion | None:
        """Motion estimated for a global shutter from matches scaled to one frame period."""
        return self._found("gs-scaled", self._own_law(_SCALED))

    @cached_property
    def of_law(self) -> dict[str, FoundMotion | None]:
        """Estimated motions by the assumed motion model."""
        return {law: self._found("rs", self._own_law(name)) for law, name in _OF_LAW.items()}

    @cached_property
    def gs_motion(self) -> Motion | None:
        """Motion estimated for a global shutter."""
        rng = generator(self._seed, "study", self.sequence.name, "gs")
        return global_shutter_motion(self.matches, self.rig, self.options.robust, rng)

    @cached_property
    def true(self) -> Pairs:
        """The frames with their true depth."""
        return true_pairs(self.sequence, self.images)

    def _own_law(self, solver: str) -> CorrectionOptions:
        """Return options with a solver that uses its own motion model, even if another one fits better."""
        return replace(self.options, solver=load_solver_entry(solver), motion_model=None)

    def _found(self, name: str, options: CorrectionOptions) -> FoundMotion | None:
        rng = generator(self._seed, "study", self.sequence.name, name)
        try:
            return find_motion(self.matches, self.rig, self.shutter, options, rng)
        except NoMotionError:
            return None

    @property
    def motion(self) -> Motion | None:
        """The estimated motion under the selected motion model; None if the estimation failed."""
        return _motion(self.found)

    def motion_errors(self) -> Row:
        """Return e_R and e_T, degrees, of all estimated motions; failures get the worst scores."""
        row: Row = {}
        motions = {"ours": self.motion, "gs": self.gs_motion, "gs_scaled": _motion(self.scaled)}
        for name, motion in (motions | {law: _motion(found) for law, found in self.of_law.items()}).items():
            errors = motion_errors(motion, self.sequence.motion, self.rig)
            row |= {f"{error}_{name}": value for error, value in errors.items()}
        return row

    def attempt(self, key: str) -> dict[View, Attempt] | None:
        """Return the views corrected by a method, except views without a motion; None if its motion is missing."""
        true = self.sequence.motion
        if key == "none":
            return self._nothing()
        alone = {"mono": self._velocity, "gs-mono": self._scaled_monocular, "zhuang": self._zhuang}
        if key in alone:
            return self._mono(alone[key])
        if key == "vasu-layers":
            return self._layers(key)
        if key in _ASKED:
            return self._turned(key)
        motions = {"gs": self.gs_motion, "gyro": true, "true-motion": true, "truth": true}
        motions |= {"gs-scaled": _motion(self.scaled), **{law: _motion(each) for law, each in self.of_law.items()}}
        motion = motions.get(key, self.motion)
        if motion is None:
            return None
        pairs = self.true if key in ("true-depth", "truth") else self.sgm
        frames, pairs = self.corrected(pairs, motion, _CORRECTORS.get(key, "fusion"))
        out = {}
        for (side, frame), fused in frames.items():
            depth = pairs[frame].depth[side]
            if key in _DEPTHS:
                depth = _DEPTHS[key](depth)
            flow = correction_flow(depth, FixedGeometry(self.rig, self.shutter, motion), (side, frame))
            out[side, frame] = _attempt(fused, flow)
        return out

    def corrected(
        self, pairs: Pairs, motion: Motion, corrector: str = "fusion", views: tuple[View, ...] = VIEWS
    ) -> tuple[dict[View, Fused], Pairs]:
        """Correct frames with a depth and a motion; also return the depth that the corrector used."""
        # The simpler correctors use one camera, so unknown depth is not estimated from the motion.
        options = replace(
            self.options, corrector=load_corrector(corrector), depth_from_motion=corrector == "fusion"
        )
        given = Given(matches=self.matches, motion=motion, pairs=pairs)
        inputs = KnownInputs.of(self.shutter)
        result = correct_four(self.images, self.rig, inputs, options, given=given, views=views)
        return result.frames, result.pairs or pairs

    def _nothing(self) -> dict[View, Attempt]:
        flow = np.zeros((self.rig.camera.height, self.rig.camera.width, 2), dtype=np.float32)
        return {view: _attempt(fused, flow) for view, fused in uncorrected(self.images).items()}

    def _velocity(self, side: Side) -> Motion | None:
        start = self.of_law["linear"]
        if start is None:
            return None
        inliers = kept_matches(self.matches, start.robust)
        return monocular_motion(inliers, self.rig, self.shutter, side, start.motion)

    def _scaled_monocular(self, side: Side) -> Motion | None:
        rng = generator(self._seed, "study", self.sequence.name, "gs-mono", side)
        solver = load_solver_entry(_MONOCULAR).solver
        return solved_alone(self.matches, self.rig, self.shutter, side, solver, self.options.robust, rng)

    def _zhuang(self, side: Side) -> Motion | None:
        return ZhuangCorrector(seed=self._seed).motion(self.matches, self.rig, self.shutter, side)

    def _problem(self) -> CorrectionProblem:
        """Return the problem with frames and matches, without estimated motion or depth."""
        return CorrectionProblem(
            images=self.images,
            rig=self.rig,
            shutter=self.shutter,
            target_row=0.0,
            motion=None,
            depth=None,
            guess=None,
            matches=self.matches,
        )

    def _layers(self, key: str) -> dict[View, Attempt]:
        """Return the views of the cameras for which the corrector by layers found a scene."""
        corrector = load_corrector(key).component
        assert isinstance(corrector, LayersCorrector)
        corrector, problem, out = replace(corrector, seed=self._seed), self._problem(), dict[View, Attempt]()
        for side in SIDES:
            scene = corrector.scene(problem, side)
            if isinstance(scene, str):
                continue
            for frame in FRAMES:
                fused = corrector.rendered(problem, (side, frame), scene)
                rig, shutter, _, motion = scene.camera
                flow = correction_flow(scene.depth(frame), FixedGeometry(rig, shutter, motion), (side, frame))
                whole = inpaint(fused.image, fused.origin == Origin.NOBODY)
                out[side, frame] = _attempt(replace(fused, image=whole), flow)
        return out

    def _rotation(self, key: str, view: View) -> Motion | None:
        """Return the rotation of a frame from the gyroscope or a single-image corrector; None if it fails.

        Raises:
            RsbenchError: the sequence has no channel ``imu``.
        """
        sequence = self.sequence
        if key == "gyroscope":
            return GyroMotion(gyro_samples(sequence.inertial(), sequence.frame_period_s), np.zeros(3))
        corrector = load_corrector(key).component
        assert isinstance(corrector, ImageRotationCorrector)
        motion = corrector.rotation(self._problem(), view)
        return motion if isinstance(motion, Motion) else None

    def _turned(self, key: str) -> dict[View, Attempt]:
        """Correct each view by a rotation, which may differ between views."""
        out: dict[View, Attempt] = {}
        far = _infinitely_far(self.true[0].depth["left"])
        for view in VIEWS:
            motion = self._rotation(key, view)
            if motion is not None:
                frames, _ = self.corrected(self.sgm, motion, "rotation-only", (view,))
                flow = correction_flow(far, FixedGeometry(self.rig, self.shutter, motion), view)
                out[view] = _attempt(frames[view], flow)
        return out

    def _mono(self, motion_of: Callable[[Side], Motion | None]) -> dict[View, Attempt] | None:
        """Correct each camera separately, with motion and depth from its own matches and flow."""
        motions: dict[str, Motion] = {}
        for side in SIDES:
            motion = motion_of(side)
            if motion is None:
                return None
            motions[side] = motion
        depth = {}
        for side, frame in VIEWS:
            about = self.rig.about(side)
            depth[side, frame] = depth_alone(self.images, about, self.shutter, motions[side], (side, frame))
        options = replace(self.options, corrector=load_corrector("single-view"))
        out: dict[View, Attempt] = {}
        for view in VIEWS:
            geometry = self.rig.about(view[0]), self.shutter, motions[view[0]]
            frames = correct_frames(self.images, known_depth(self.images, depth), *geometry, options, (view,))
            out[view] = _attempt(frames[view], correction_flow(depth[view], FixedGeometry(*geometry), view))
        return out


def _motion(found: FoundMotion | None) -> Motion | None:
    return None if found is None else found.motion


def _infinitely_far(depth: Depth) -> Depth:
    return np.full_like(depth, np.inf)


_ASKED = {method.key for method in ON_REQUEST}
_CORRECTORS = {"gyro": "rotation-only", "rotation": "rotation-only", "plane": "one-plane"}
_DEPTHS: dict[str, Callable[[Depth], Depth]] = {
    "gyro": _infinitely_far,
    "rotation": _infinitely_far,
    "plane": plane_depth,
}
"""Functions from the estimated depth to the depth with which a method's corrector moves pixels."""


def _attempt(fused: Fused, flow: NDArray[np.float32]) -> Attempt:
    return Attempt(image=fused.image, covered=fused.origin == Origin.HERE, flow=flow)
