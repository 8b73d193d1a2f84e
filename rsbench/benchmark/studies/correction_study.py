"""The correction study: every way to correct a frame, on the same frames, matches and pixels.

A method is a depth, a motion and a corrector of the chain that users have. Those that know a scene fill what a
frame did not see from the other frames; what remains is invented (inpainted), so that every method gives a whole
picture, which 'all' scores. 'Covered' scores the pixels that every method of a view draws from the frame itself:
nothing there is filled or invented. A method that finds no motion has failed: it scores the worst values, and
takes no pixels from the others. Nor do methods on request, which are compared when they are
asked for: what they do not cover is invented.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.scoring import pose_errors
from rsbench.benchmark.seeds import generator
from rsbench.benchmark.standard_metrics import Flip, Psnr, Ssim
from rsbench.benchmark.studies.correction_methods import METHODS, ON_REQUEST
from rsbench.benchmark.studies.layer_methods import asked_layers
from rsbench.benchmark.studies.resumable_rows import ResumableRows, Row, Rows
from rsbench.benchmark.studies.rotation_methods import asked_rotation
from rsbench.capture.settle import NoMotionError
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import GivenGeometry
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, VIEWS, Side, View
from rsbench.dataset.sequence import Sequence, read_dataset, read_sequence
from rsbench.jobs.isolation import EntryFailure
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.pipeline.baseline_motions import global_shutter_motion, kept_matches, monocular_motion, solved_alone
from rsbench.pipeline.chain import Given, correct_four, correct_frames, uncorrected
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Pairs, frame_pairs, known_depth
from rsbench.pipeline.frame_matches import find_matches
from rsbench.pipeline.frame_motion import FoundMotion, find_motion
from rsbench.pipeline.one_camera import ZhuangCorrector, depth_alone
from rsbench.solvers.engine.registry import SolverEntry, load_solver_entry
from rsbench.vision.baseline_depths import plane_depth
from rsbench.vision.correction import correction_flow
from rsbench.vision.corrector import load_corrector
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.published_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import psnr, ssim_within

Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]
ROW_BANDS = 9
"""Bands of rows in which the flow error is reported; their distance from row 0 is the distance in time."""
WORST = {column.name: column.worst for metric in (Psnr, Ssim, Flip) for column in metric.columns}
"""Scores of a failure, as in the score tables."""


_SLOW = {method.key for method in METHODS if method.slow_scores}
_SCALED, _MONOCULAR = "gs-stereo-tracks-scaled", "gs-poselib-scaled"


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """What a method made of one view."""

    image: NDArray[Any]
    """(H, W, C), every pixel."""
    covered: Mask
    """(H, W) pixels drawn from the frame itself at a depth that was not guessed."""
    flow: NDArray[np.float32]
    """(H, W, 2) where it moves the pixels of the rolling-shutter frame, px; NaN where it does not know."""


def study_dataset(
    dataset: Path,
    step: Callable[[str], None],
    seed: int = 0,
    solver: str = "rs-stereo-refined",
    workers: int | None = 1,
    kept: Path | None = None,
    others: tuple[str, ...] = (),
) -> Rows:
    """Scores of every method on every view, errors by row band, and the motion errors, of all sequences.

    ``solver`` names the solver of "our" motion, whose model the corrections take. ``step`` is called with the name
    of each sequence done; ``workers`` processes share them, one per core for None. A folder ``kept`` holds what is
    done of a run that is cut off. ``others`` are keys of ``ON_REQUEST`` methods to have too.

    Raises:
        RsbenchError: the dataset cannot be read, or there is no such solver.
        LostJobsError: see ``finished_jobs``.
    """
    sequences = read_dataset(dataset)
    found: dict[str, Rows] = {}
    store = (
        None
        if kept is None
        else ResumableRows(folder=kept, dataset=dataset, seed=seed, solver=solver, others=others)
    )
    if store is not None:
        found = {one.name: rows for one in sequences if (rows := store.read(one.name)) is not None}
    for name in found:
        step(name)
    missing = [sequence for sequence in sequences if sequence.name not in found]
    with closing(_studied(missing, dataset, seed, solver, workers, others)) as outcomes:
        for name, rows in outcomes:
            found[name] = rows
            if store is not None:
                store.write(name, rows)
            step(name)
    images, bands, motions = (
        [row for sequence in sequences for row in found[sequence.name][table]] for table in range(3)
    )
    return images, bands, motions


def _studied(
    sequences: list[Sequence],
    dataset: Path,
    seed: int,
    solver: str,
    workers: int | None,
    others: tuple[str, ...],
) -> Generator[tuple[str, Rows], None, None]:
    """Names of sequences with their rows, as they become ready."""
    if workers == 1:
        for sequence in sequences:
            yield sequence.name, study_sequence(sequence, seed, solver, others)
    else:
        names, count = [sequence.name for sequence in sequences], workers or os.cpu_count() or 1
        yield from finished_jobs(_serve, names, count, {}, dataset, seed, solver, others)


def _serve(dataset: Path, seed: int, solver: str, others: tuple[str, ...]) -> Callable[[str], Rows]:
    """What studies sequences by their names, in a child."""

    def study(name: str) -> Rows:
        try:
            return study_sequence(read_sequence(dataset / name), seed, solver, others)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return study


def study_sequence(
    sequence: Sequence, seed: int = 0, solver: str = "rs-stereo-refined", others: tuple[str, ...] = ()
) -> Rows:
    """What ``study_dataset`` says of one sequence."""
    bench = Bench(sequence, seed, solver)
    attempts = {key: bench.attempt(key) for key in (*(method.key for method in METHODS), *others)}
    images: list[Row] = []
    bands: list[Row] = []
    for view in VIEWS:
        found = {key: None if attempt is None else attempt.get(view) for key, attempt in attempts.items()}
        identity = {"sequence": sequence.name, "side": view[0], "frame": view[1]}
        images += [identity | row for row in _image_rows(sequence, view, found)]
        bands += [identity | row for row in _band_rows(found)]
    return images, bands, [{"sequence": sequence.name, **bench.motion_errors()}]


class Bench:
    """Everything the methods share on one sequence."""

    def __init__(self, sequence: Sequence, seed: int, solver: str = "rs-stereo-refined") -> None:
        self.sequence = sequence
        self.options = CorrectionOptions(inpaint=True, solver=load_solver_entry(solver))
        self.images = {view: sequence.image("rs", *view) for view in VIEWS}
        self.rig, self.shutter = sequence.rig, sequence.shutter
        self.matches = find_matches(self.images, self.options)
        self._seed = seed
        self.found = self._found("rs", self.options.solver)
        self.scaled = self._found("gs-scaled", load_solver_entry(_SCALED))
        rng = generator(seed, "study", sequence.name, "gs")
        self.gs_motion = global_shutter_motion(self.matches, self.rig, self.options.robust, rng)
        self.sgm = frame_pairs(self.images, self.rig, self.options)
        true = {view: sequence.depth("rs", *view) for view in VIEWS}
        self.true = known_depth(
            self.images, {view: np.where(z > 0, z, np.float32(np.inf)) for view, z in true.items()}
        )

    def _found(self, name: str, solver: SolverEntry) -> FoundMotion | None:
        options, rng = (
            replace(self.options, solver=solver),
            generator(self._seed, "study", self.sequence.name, name),
        )
        try:
            return find_motion(self.matches, self.rig, self.shutter, options, rng)
        except NoMotionError:
            return None

    @property
    def motion(self) -> Motion | None:
        """Ours, of the model that the solver assumes; None when there is none."""
        return None if self.found is None else self.found.motion

    def motion_errors(self) -> Row:
        """e_R and e_T, degrees, of our motion and of the global-shutter ones; a failure scores the worst."""
        true, nothing = self.sequence.motion, np.full(3, np.nan)
        row: Row = {}
        scaled = None if self.scaled is None else self.scaled.motion
        for name, motion in (("ours", self.motion), ("gs", self.gs_motion), ("gs_scaled", scaled)):
            w, d = (nothing, nothing) if motion is None else (motion.w, motion.d)
            errors = pose_errors(w, d, true_w=true.w, true_d=true.d, rig=self.rig)
            row |= {f"{error}_{name}": float(errors[error]) for error in ("e_R_deg", "e_T_deg")}
        return row

    def attempt(self, key: str) -> dict[View, Attempt] | None:
        """What one method makes of the views, but those in which it found no motion; None when in none."""
        true = self.sequence.motion
        if key == "none":
            return self._nothing()
        alone = {"mono": self._velocity, "gs-mono": self._scaled_monocular, "zhuang": self._zhuang}
        if key in alone:
            return self._mono(alone[key])
        if key == "vasu-layers":
            layered = asked_layers(key, self.sequence, self.images, self.matches, self._seed)
            return {view: _attempt(fused, flow) for view, (fused, flow) in layered.items()}
        if key in _ASKED:
            return self._turned(key)
        motions = {"gs": self.gs_motion, "gyro": true, "true-motion": true, "truth": true}
        motions["gs-scaled"] = None if self.scaled is None else self.scaled.motion
        motion = motions.get(key, self.motion)
        if motion is None:
            return None
        pairs = self.true if key in ("true-depth", "truth") else self.sgm
        frames, pairs = self.corrected(pairs, motion, _CORRECTORS.get(key, "fusion"))
        out = {}
        for (side, frame), fused in frames.items():
            depth = _DEPTHS.get(key, _as_it_is)(pairs[frame].depth[side])
            flow = correction_flow(depth, GivenGeometry(self.rig, self.shutter, motion), (side, frame))
            out[side, frame] = _attempt(fused, flow)
        return out

    def corrected(
        self, pairs: Pairs, motion: Motion, corrector: str = "fusion", views: tuple[View, ...] = VIEWS
    ) -> tuple[dict[View, Fused], Pairs]:
        """Frames by the chain from a depth and a motion, and the depth that the corrector was given."""
        # Simpler corrections know one camera's frame, and no depth from two of them.
        options = replace(
            self.options, corrector=load_corrector(corrector), depth_from_motion=corrector == "fusion"
        )
        given = Given(matches=self.matches, motion=motion, pairs=pairs)
        ratio = self.shutter.readout_ratio
        result = correct_four(self.images, self.rig, ratio, options, given=given, views=views)
        return result.frames, result.pairs or pairs

    def _nothing(self) -> dict[View, Attempt]:
        flow = np.zeros((self.rig.camera.height, self.rig.camera.width, 2), dtype=np.float32)
        return {view: _attempt(fused, flow) for view, fused in uncorrected(self.images).items()}

    def _velocity(self, side: Side) -> Motion | None:
        if self.found is None:
            return None
        inliers = kept_matches(self.matches, self.found.robust)
        return monocular_motion(inliers, self.rig, self.shutter, side, self.found.motion)

    def _scaled_monocular(self, side: Side) -> Motion | None:
        rng = generator(self._seed, "study", self.sequence.name, "gs-mono", side)
        solver = load_solver_entry(_MONOCULAR).solver
        return solved_alone(self.matches, self.rig, self.shutter, side, solver, self.options.robust, rng)

    def _zhuang(self, side: Side) -> Motion | None:
        return ZhuangCorrector(seed=self._seed).motion(self.matches, self.rig, self.shutter, side)

    def _turned(self, key: str) -> dict[View, Attempt]:
        """By a rotation that may be another one in each view."""
        out: dict[View, Attempt] = {}
        far = _infinitely_far(self.true[0].depth["left"])
        for view in VIEWS:
            motion = asked_rotation(key, self.sequence, self.images, view)
            if motion is not None:
                frames, _ = self.corrected(self.sgm, motion, "rotation-only", (view,))
                flow = correction_flow(far, GivenGeometry(self.rig, self.shutter, motion), view)
                out[view] = _attempt(frames[view], flow)
        return out

    def _mono(self, motion_of: Callable[[Side], Motion | None]) -> dict[View, Attempt] | None:
        """Each camera by itself: its motion from its own matches, depth from its own flow in the same unit."""
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
            out[view] = _attempt(frames[view], correction_flow(depth[view], GivenGeometry(*geometry), view))
        return out


def _infinitely_far(depth: Depth) -> Depth:
    return np.full_like(depth, np.inf)


def _as_it_is(depth: Depth) -> Depth:
    return depth


_ASKED = {method.key for method in ON_REQUEST}
_PUBLISHED = {method.key for method in METHODS}
_CORRECTORS = {"gyro": "rotation-only", "rotation": "rotation-only", "plane": "one-plane"}
_DEPTHS: dict[str, Callable[[Depth], Depth]] = {
    "gyro": _infinitely_far,
    "rotation": _infinitely_far,
    "plane": plane_depth,
}
"""The depth with which a method's corrector moves pixels, from the depth that it is given."""


def _attempt(fused: Fused, flow: NDArray[np.float32]) -> Attempt:
    return Attempt(image=fused.image, covered=fused.origin == Origin.HERE, flow=flow)


def _image_rows(sequence: Sequence, view: View, attempts: dict[str, Attempt | None]) -> list[Row]:
    truth, found = sequence.image("gs", *view), _found(attempts)
    common = np.logical_and.reduce([attempt.covered for key, attempt in found.items() if key in _PUBLISHED])
    rows = []
    for key, attempt in attempts.items():
        if attempt is None:
            scores = _worst_scores(truth, view == VIEWS[0] and key in _SLOW)
        else:
            error = flow_error(attempt.flow, found["truth"].flow)
            known = np.isfinite(error)
            ssim_covered, ssim_all = ssim_within(attempt.image, truth, (common, None))
            scores = {
                "psnr_covered": psnr(attempt.image, truth, common),
                "ssim_covered": ssim_covered,
                "psnr_all": psnr(attempt.image, truth),
                "ssim_all": ssim_all,
                "flow_mean_px": float(np.mean(error[known])) if np.any(known) else float("nan"),
                "flow_median_px": float(np.median(error[known])) if np.any(known) else float("nan"),
                "flow_known": float(np.mean(known)),
                "coverage": float(np.mean(attempt.covered)),
                **_extra_scores(attempt.image, truth, common, view == VIEWS[0] and key in _SLOW),
            }
        rows.append({"method": key, "success": attempt is not None, **scores, "common": float(np.mean(common))})
    return rows


def _found(attempts: dict[str, Attempt | None]) -> dict[str, Attempt]:
    """The attempts that did not fail."""
    return {key: attempt for key, attempt in attempts.items() if attempt is not None}


def _worst_scores(image: NDArray[Any], extra: bool) -> dict[str, float]:
    """What a failed method scores on an image: the rule of failures of docs/explanation/conventions.md."""
    scores = {f"{name}_{part}": WORST[name] for part in ("covered", "all") for name in ("psnr", "ssim")}
    scores |= {name: worst_flow(image) for name in ("flow_mean_px", "flow_median_px")}
    slow = {"flip_covered": "flip", "flip_all": "flip", "ssim_deepunroll": "ssim", "ssim_uniform": "ssim"}
    scores |= {name: WORST[kind] if extra else float("nan") for name, kind in slow.items()}
    return scores | {"flow_known": 0.0, "coverage": 0.0}


def worst_flow(image: NDArray[Any]) -> float:
    """The diagonal of an image (H, W[, C]), px: a pixel that stays in the image cannot be farther off."""
    return float(np.hypot(*image.shape[:2]))


def _extra_scores(image: NDArray[Any], truth: NDArray[Any], common: Mask, wanted: bool) -> dict[str, float]:
    """Slow scores, of one view per sequence and some methods: FLIP and SSIM by others' protocols."""
    names = ("flip_covered", "flip_all", "ssim_deepunroll", "ssim_uniform")
    if not wanted:
        return dict.fromkeys(names, float("nan"))
    errors = flip(image, truth)
    if errors is None:
        errors = np.full(common.shape, np.nan)
    covered = float(np.mean(errors[common])) if np.any(common) else float("nan")
    scores = covered, float(np.mean(errors)), ssim_deepunroll(image, truth), ssim_uniform(image, truth)
    return dict(zip(names, scores, strict=True))


def _band_rows(attempts: dict[str, Attempt | None]) -> list[Row]:
    truth, rows = _found(attempts)["truth"], list[Row]()
    for key, attempt in attempts.items():
        error = np.full(truth.covered.shape, worst_flow(truth.image))
        if attempt is not None:
            error = flow_error(attempt.flow, truth.flow)
        for band, part in enumerate(np.array_split(error, ROW_BANDS)):
            known = np.isfinite(part)
            mean = float(np.mean(part[known])) if np.any(known) else float("nan")
            rows.append({"method": key, "band": band, "flow_mean_px": mean})
    return rows


def flow_error(flow: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """End-point error (H, W), px; NaN where either flow is not known."""
    return np.linalg.norm(flow.astype(np.float64) - truth, axis=-1)
