"""Predictions on image sequences: matches, motions, disparity and corrected frames, stored before any scoring.

Only the oracles read the ground truth of a sequence: they use it in place of an estimated motion or depth. Each
prediction is an artefact (see ``store``). Current artefacts are reused, so adding a solver repeats nothing else.
An error in a component of another package is recorded as a failed prediction with the reason.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.plan import NONE, HashOf, Places, Plan, Recipe, reference_of
from rsbench.benchmark.images.store import Artefact, read_record
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.seeds import generator
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, VIEWS, Side, StereoRig, View
from rsbench.dataset.clock_channels import gyro_samples
from rsbench.dataset.corrected_frames import write_origin
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import (
    FramePair,
    Images,
    Pairs,
    depth_of_pair,
    known_depth,
    motion_disparities,
    pair_with_motion,
)
from rsbench.pipeline.frame_motion import body_motion
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import SOLVERS, MotionEstimate, SolverEntry
from rsbench.solvers.engine.robust_motion import RobustEstimate
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import (
    MATCH_SETS,
    load_arrays,
    load_matches,
    save_arrays,
    save_matches,
    sha256,
    write_png,
)
from rsbench.vision.stereo_depth import timed_depth
from rsbench.vision.stereo_matcher import STEREO_MATCHERS, MatcherEntry, needs_motion, sensor_disparities

Step = Callable[[str], None]


def prediction_steps(plan: Plan) -> int:
    """Return the number of progress reports of ``Bench.predict`` for a sequence."""
    solvers = len(plan.solver_names)
    return 1 + solvers + (1 + len(Recipe(chain=plan.chain).variants()) if plan.corrects else 0)


class Bench:
    """The predictions on one sequence."""

    def __init__(
        self, sequence: Sequence, folder: Path, plan: Plan, runner: SolverRunner, hash_of: HashOf = sha256
    ) -> None:
        self.sequence, self.plan, self.runner = sequence, plan, runner
        self.places = Places(sequence, folder, plan.chain, hash_of)

    @cached_property
    def images(self) -> dict[View, NDArray[np.uint8]]:
        return {view: self.sequence.image("rs", *view) for view in VIEWS}

    def predict(self, step: Step) -> None:
        """Make the planned predictions that are not current."""
        if self.plan.force and len(self.plan.solver_names) == len(self.plan.solvers):
            self.places.matches().forget()
        self._match()
        step(f"{self.sequence.name}: matches")
        for entry in self.plan.solvers:
            if entry.name in self.plan.solver_names:
                self.move(entry)
                step(f"{self.sequence.name}: {entry.name}")
        if self.plan.corrects:
            # If the cameras read rows at different times, disparity depends on the motion.
            if self.sequence.shutter.rows_together or needs_motion(self.plan.chain.matcher):
                self._find_depth()
            step(f"{self.sequence.name}: depth")
            for recipe in Recipe(chain=self.plan.chain).variants():
                self._correct(recipe)
                step(f"{self.sequence.name}: correction")

    def stands(self, artefact: Artefact) -> bool:
        """Return whether an artefact is current and need not be computed again."""
        return not self.plan.force and artefact.record() is not None

    # Matches

    def _match(self) -> None:
        artefact, entry = self.places.matches(), self.plan.chain.features
        if artefact.record() is not None:
            return
        artefact.start()
        images, start = self.images, time.perf_counter()
        try:
            matches = find_matches_of_rig(
                images, self.sequence.rig, self.sequence.shutter.scanning, self.plan.chain
            )
        except RsbenchError as error:
            artefact.finish({"features": entry.name, "success": False, "reason": str(error), "matches": {}})
            return
        seconds = time.perf_counter() - start
        save_matches(artefact.file(".npz"), matches)
        counts = {name: len(getattr(matches, name)) for name in MATCH_SETS}
        record = {"features": entry.name, "success": True, "reason": "", "matches": counts}
        artefact.finish(record, seconds)

    @cached_property
    def _matches(self) -> Correspondences | str:
        """Return the matches, or the reason why there are none."""
        artefact = self.places.matches()
        record = artefact.record() or {"success": False, "reason": "not made"}
        return load_matches(artefact.file(".npz")) if record["success"] else str(record["reason"])

    # Motion

    def move(self, entry: SolverEntry, seed: int = 0) -> None:
        """Estimate the motion with RANSAC seed ``seed``; for seed 0, run time and inliers are stored too."""
        artefact = self.places.motion(entry, seed)
        if self.stands(artefact):
            return
        self._refuse_another(entry, artefact)
        rng = generator(self.plan.chain.seed, "images", self.sequence.name, entry.name, seed)
        matches = self._matches
        artefact.start()
        if isinstance(matches, str):
            estimate = MotionEstimate.failed(f"no matches: {matches}")
            robust = RobustEstimate(estimate=estimate, iterations=0, seconds=0.0, threshold_px=0.0)
        else:
            options = self.plan.chain.robust
            if entry.built_in:
                warm_up((entry.solver.spec.motion_model,))  # compiling is not in the solver's time
            robust = self.runner.robust(entry, matches, self.sequence.rig, self.sequence.shutter, options, rng)
        if seed == 0:
            masks = {str(name): mask for name, mask in robust.inliers.items()}
            save_arrays(artefact.file("-inliers.npz"), masks)
        record = {**_motion_record(entry, robust), "seed": seed}
        artefact.finish(record, robust.seconds if seed == 0 else None)

    def _refuse_another(self, entry: SolverEntry, artefact: Artefact) -> None:
        """Raise RsbenchError if the prediction of another solver with the same name would be overwritten."""
        stored = read_record(artefact.file(".json")) or {}
        other, own = stored.get("entry", ""), reference_of(SOLVERS, entry)
        if not self.plan.force and other not in ("", own) and stored.get("key") != entry.key:
            raise RsbenchError(
                f"{artefact.file('.json')}: is the prediction of another {entry.name!r}, {other}, not of {own}; "
                "rename one of them, choose another --out, or replace it with --force"
            )

    # Depth

    def _find_depth(self) -> None:
        entry = self.plan.chain.matcher
        artefact = self.places.depth(entry)
        if self.stands(artefact):
            return
        artefact.start()
        start = time.perf_counter()
        record = {
            "matcher": entry.name,
            "entry": reference_of(STEREO_MATCHERS, entry),
            "timed": needs_motion(entry),
            "success": True,
            "reason": "",
        }
        try:
            found = self._disparities(entry)
        except RsbenchError as error:
            artefact.finish(record | {"success": False, "reason": str(error)})
            return
        seconds = time.perf_counter() - start
        save_arrays(artefact.file(".npz"), found)
        artefact.finish(record, seconds)

    def _disparities(self, entry: MatcherEntry) -> dict[str, NDArray[np.float32]]:
        """Return disparities by the name of the view; a matcher that needs a motion gets the estimated one."""
        images, sequence = self.images, self.sequence
        found: dict[View, NDArray[np.float32]] = {}
        if needs_motion(entry):
            motion = read_motion(self.places, self.plan.chain.solver)
            if isinstance(motion, str):
                raise RsbenchError(f"no motion: {motion}")
            found = motion_disparities(entry, images, sequence.rig, sequence.shutter, motion)
        else:
            for frame in FRAMES:
                both = sensor_disparities(entry, images["left", frame], images["right", frame], sequence.rig)
                found |= {("left", frame): both[0], ("right", frame): both[1]}
        return {f"{side}_{frame}": disparity for (side, frame), disparity in found.items()}

    # Correction

    def _correct(self, recipe: Recipe) -> None:
        artefact = self.places.corrected(recipe)
        if self.stands(artefact):
            return
        artefact.start()
        record = {**recipe.names, "entries": recipe.references, "success": True, "reason": ""}
        given = self._given(recipe)
        if isinstance(given, str):
            artefact.finish(record | {"success": False, "reason": given})
            return
        images, start = self.images, time.perf_counter()
        inputs = KnownInputs.of(self.sequence.shutter)
        try:
            found = correct_four(images, self.sequence.rig, inputs, recipe.chain, given=given)
            frames = found.frames
        except RsbenchError as error:
            artefact.finish(record | {"success": False, "reason": str(error)})
            return
        seconds = time.perf_counter() - start
        record["failures"] = {f"{s}_{f}": fused.reason for (s, f), fused in frames.items() if not fused.success}
        for (side, frame), fused in frames.items():
            write_png(artefact.file(f"-{side}_{frame}.png"), fused.image)
            write_origin(artefact.file(f"-{side}_{frame}-origin.png"), fused.origin)
        artefact.finish(record, seconds)

    def _given(self, recipe: Recipe) -> Given | str:
        """Return the given inputs of a recipe, or the reason why one of them is missing."""
        motion: Motion | str | None = None
        pairs: Pairs | str | None = None
        if recipe.names["solver"] != NONE:
            motion = self.sequence.motion if recipe.true_motion else read_motion(self.places, recipe.chain.solver)
        if recipe.names["matcher"] != NONE:
            pairs = true_pairs(self.sequence, self.images) if recipe.true_depth else self._pairs(recipe)
        if isinstance(motion, str):
            return f"no motion: {motion}"
        if isinstance(pairs, str):
            return f"no depth: {pairs}"
        needs = recipe.chain.corrector.component.spec.needs
        matches = self._matches if "matches" in needs else None
        if isinstance(matches, str):
            return f"no matches: {matches}"
        gyro = None
        if "gyro" in needs and "imu" in self.sequence.channels:
            gyro = gyro_samples(self.sequence.inertial(), self.sequence.frame_period_s)
        return Given(matches=matches, motion=motion, pairs=pairs, gyro=gyro)

    def _pairs(self, recipe: Recipe) -> Pairs | str | None:
        """Return the pairs with the matcher's depth; None if the correction computes depth with its own motion."""
        moved = needs_motion(recipe.chain.matcher)
        if recipe.true_motion if moved else not self.sequence.shutter.rows_together:
            return None
        artefact = self.places.depth(recipe.chain.matcher)
        record = artefact.record()
        if record is None or not record["success"]:
            return str(record["reason"]) if record else "not made"
        rig, find_sky = self.sequence.rig, recipe.chain.find_sky
        stored = load_disparities(artefact.file(".npz"), rig)

        def pair(frame: int) -> FramePair:
            disparities = [stored[f"{side}_{frame}"] for side in SIDES]
            if moved:
                return pair_with_motion(self.images, disparities, frame, rig, find_sky=find_sky)
            left, right = (self.images[side, frame] for side in SIDES)
            return depth_of_pair(left, right, disparities, rig, find_sky=find_sky)

        return pair(0), pair(1)


def _motion_record(entry: SolverEntry, robust: RobustEstimate) -> dict[str, Any]:
    estimate, spec = robust.estimate, entry.solver.spec
    return {
        "solver": entry.name,
        "entry": reference_of(SOLVERS, entry),
        "key": entry.key,
        "success": estimate.success,
        "reason": estimate.reason,
        "w": estimate.w.tolist() if estimate.success else None,
        "d": estimate.d.tolist() if estimate.success else None,
        "metric": estimate.metric,
        "reference_point": spec.reference_point,
        "motion_model": spec.motion_model,
        "motion_parameters": dict(spec.motion_parameters),
        "shutter": spec.shutter,
        "uses": sorted(spec.needs | {name for name, count in robust.counts.items() if count.matches}),
        "inliers": {str(name): count.inliers for name, count in robust.counts.items()},
        "matches": {str(name): count.matches for name, count in robust.counts.items()},
        "iterations": robust.iterations,
    }


def read_motion(places: Places, solver: SolverEntry) -> Motion | str:
    """Read the predicted motion of the body, in metres, or return the reason why there is none."""
    record = places.motion(solver).record()
    if record is None:
        return "not made"
    if not record["success"]:
        return str(record["reason"])
    estimate = MotionEstimate(w=record["w"], d=record["d"], success=True, metric=record["metric"])
    return body_motion(estimate, solver.solver.spec, places.sequence.rig)


def load_disparities(path: Path, rig: StereoRig) -> dict[str, NDArray[np.float32]]:
    """Read the disparities (H, W) of all views, by names such as ``left_0``.

    Raises:
        RsbenchError: the file is damaged, or is of another camera.
    """
    stored, shape = load_arrays(path), (rig.camera.height, rig.camera.width)
    for side, frame in VIEWS:
        found = stored.get(f"{side}_{frame}")
        if found is None or found.dtype != np.float32 or found.shape != shape:
            raise RsbenchError(
                f"{path}: must hold {side}_{frame} as float32 {shape}; delete {path.stem}.json beside it, "
                "and the same command makes it again"
            )
    return stored


def true_pairs(sequence: Sequence, images: Images) -> Pairs:
    """Return rolling-shutter frames with their true depth, which is infinite where there is no surface."""
    truth = {view: sequence.depth("rs", *view) for view in VIEWS}
    return known_depth(images, {view: np.where(z > 0, z, np.float32(np.inf)) for view, z in truth.items()})


def depth_of(
    disparity: NDArray[np.float32], sequence: Sequence, side: Side, frame: int, *, timed: bool = False
) -> NDArray[np.float32]:
    """Convert disparity to depth (H, W), metres, 0 where unknown, in the depth convention of the dataset.

    ``timed``: whether the disparities already account for the motion. If not, and the camera has a lens, the two
    ends of a disparity are read at different times; the true motion then gives both poses, because the matcher is
    scored and not the motion.
    """
    rig = sequence.rig
    depth = np.nan_to_num(rig.depth(disparity), nan=0.0).astype(np.float32)
    if timed or rig.camera.lens is None:
        return depth
    found = timed_depth(depth, rig, sequence.shutter, sequence.motion, side, frame)
    return np.where(np.isfinite(found), found, np.float32(0.0))
