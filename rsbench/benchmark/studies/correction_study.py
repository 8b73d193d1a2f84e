"""The correction study: every way to correct a frame, on the same frames, matches and pixels.

A method is a depth and a motion. Those that know a scene fill what a frame did not see from the other frames; what
remains is invented (inpainted), so that every method gives a whole picture, which 'all' scores. 'Covered' scores
the pixels that every method of a view draws from the frame itself: nothing there is filled or invented.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.seeds import generator
from rsbench.core.metrics import rotation_error, translation_error
from rsbench.core.motion import LinearMotion, Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.chain import (
    CorrectionOptions,
    FramePair,
    complete_depth,
    correct_frames,
    frame_pairs,
    match_frames,
)
from rsbench.pipeline.footage import VIEWS, View
from rsbench.pipeline.readout import select
from rsbench.pipeline.robust_motion import RobustEstimate, estimate_motion
from rsbench.pipeline.simpler_motions import global_shutter_motion, monocular_motion
from rsbench.vision.correction import correct_frame, correction_flow
from rsbench.vision.flow import dense_flow
from rsbench.vision.fusion import Origin, inpaint
from rsbench.vision.legacy_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import psnr, ssim
from rsbench.vision.simpler_depths import monocular_depth, plane_depth

Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]
Row = dict[str, Any]
ROW_BANDS = 9
"""Bands of rows in which the flow error is reported; their distance from row 0 is the distance in time."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One line of the table."""

    key: str
    title: str
    kind: str
    """``none``, ``baseline``, ``ours`` or ``oracle``."""
    knows: str
    """What it assumes or is given."""


METHODS = (
    Method(key="none", title="uncorrected", kind="none", knows="nothing"),
    Method(key="gyro", title="rotation only, true", kind="baseline", knows="true rotation, as of a perfect gyro"),
    Method(key="rotation", title="rotation only, estimated", kind="baseline", knows="our rotation; no depth"),
    Method(
        key="gs",
        title="GS motion, SGM depth",
        kind="baseline",
        knows="motion solved as if the shutter was global; depth as ours, with that motion",
    ),
    Method(
        key="mono",
        title="monocular, constant velocity",
        kind="baseline",
        knows="one camera, two frames: its motion up to scale (descending from ours), depth from dense flow in "
        "the same unit",
    ),
    Method(
        key="plane", title="one plane", kind="baseline", knows="our motion; the plane that fits SGM depth best"
    ),
    Method(
        key="ours",
        title="ours",
        kind="ours",
        knows="estimated motion; SGM depth, and depth from the motion where SGM finds none",
    ),
    Method(key="true-motion", title="true motion, SGM depth", kind="oracle", knows="true motion; depth as ours"),
    Method(key="true-depth", title="our motion, true depth", kind="oracle", knows="true depth"),
    Method(key="truth", title="true motion, true depth", kind="oracle", knows="true motion and depth"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """What a method made of one view."""

    image: NDArray[Any]
    """(H, W, C), every pixel."""
    covered: Mask
    """(H, W) pixels drawn from the frame itself at a depth that was not guessed."""
    flow: NDArray[np.float32]
    """(H, W, 2) where it moves the pixels of the rolling-shutter frame, px; NaN where it does not know."""


def study_steps(dataset: Path) -> int:
    """How often ``study_dataset`` reports progress."""
    return len(read_dataset(dataset)) * (1 + len(METHODS))


def study_dataset(
    dataset: Path, step: Callable[[str], None], seed: int = 0
) -> tuple[list[Row], list[Row], list[Row]]:
    """Scores of every method on every view, errors by row band, and the motion errors, of all sequences.

    Raises:
        RsbenchError: the dataset cannot be read.
    """
    images: list[Row] = []
    bands: list[Row] = []
    motions: list[Row] = []
    for sequence in read_dataset(dataset):
        bench = Bench(sequence, seed)
        motions.append({"sequence": sequence.name, **bench.motion_errors()})
        step(sequence.name)
        attempts = {}
        for method in METHODS:
            attempts[method.key] = bench.attempt(method.key)
            step(sequence.name)
        for view in VIEWS:
            found = {key: attempt[view] for key, attempt in attempts.items() if attempt is not None}
            identity = {"sequence": sequence.name, "side": view[0], "frame": view[1]}
            images += [identity | row for row in _image_rows(sequence, view, found)]
            bands += [identity | row for row in _band_rows(found)]
    return images, bands, motions


class Bench:
    """Everything the methods share on one sequence."""

    def __init__(self, sequence: Sequence, seed: int) -> None:
        self.sequence = sequence
        self.options = CorrectionOptions(inpaint=True)
        self.images = {view: sequence.image("rs", *view) for view in VIEWS}
        self.rig, self.shutter = sequence.rig, sequence.shutter
        self.matches = match_frames(self.images, self.options)
        self.robust = self._robust(generator(seed, "study", sequence.name))
        self.motion = LinearMotion(self.robust.estimate.w, self.robust.estimate.d)
        rng = generator(seed, "study", sequence.name, "gs")
        self.gs_motion = global_shutter_motion(self.matches, self.rig, self.options.robust, rng)
        self.sgm = frame_pairs(self.images, self.rig, self.options)
        self.true = (self._true_pair(0), self._true_pair(1))

    def _robust(self, rng: np.random.Generator) -> RobustEstimate:
        options = self.options
        result = estimate_motion(self.matches, self.rig, self.shutter, options.solver, options.robust, rng)
        if not result.estimate.success:
            raise RuntimeError(f"{self.sequence.name}: no motion: {result.estimate.reason}")
        return result

    def _true_pair(self, frame: int) -> FramePair:
        depth = {}
        for side in SIDES:
            z = self.sequence.depth("rs", side, frame)
            depth[side] = np.where(z > 0, z, np.float32(np.inf))
        nothing = np.zeros((self.rig.camera.height, self.rig.camera.width), dtype=np.float32)
        images = {side: self.images[side, frame] for side in SIDES}
        return FramePair(images=images, depth=depth, guess=dict.fromkeys(SIDES, nothing))

    def motion_errors(self) -> Row:
        """e_R and e_T, degrees, of our motion and of the global-shutter one; NaN for a failure."""
        true = self.sequence.motion
        row: Row = {}
        for name, motion in (("ours", self.motion), ("gs", self.gs_motion)):
            e_R, e_T = np.full(2, np.nan)
            if motion is not None:
                e_R, e_T = rotation_error(motion.w, true.w), translation_error(motion.d, true.d)
            row[f"e_R_deg_{name}"] = float(np.rad2deg(e_R))
            row[f"e_T_deg_{name}"] = float(np.rad2deg(e_T))
        return row

    def attempt(self, key: str) -> dict[View, Attempt] | None:
        """What one method makes of the four views; None when it found no motion."""
        true = self.sequence.motion
        if key == "none":
            return {view: self._uncorrected(view) for view in VIEWS}
        if key in ("gyro", "rotation"):
            w = true.w if key == "gyro" else self.motion.w
            far = np.full((self.rig.camera.height, self.rig.camera.width), np.inf, dtype=np.float32)
            turning = LinearMotion(w, np.zeros(3))
            return {view: self._alone(view, far, self.rig.about(view[0]), turning) for view in VIEWS}
        if key == "plane":
            planes = {(s, f): plane_depth(self.sgm[f].depth[s]) for s, f in VIEWS}
            return {view: self._alone(view, planes[view], self.rig, self.motion) for view in VIEWS}
        if key == "mono":
            return self._mono()
        pairs = self.true if key in ("true-depth", "truth") else self.sgm
        motion = {"gs": self.gs_motion, "true-motion": true, "truth": true}.get(key, self.motion)
        return None if motion is None else self._whole(pairs, motion)

    def _uncorrected(self, view: View) -> Attempt:
        image = self.images[view]
        size = image.shape[:2]
        flow = np.zeros((*size, 2), dtype=np.float32)
        return Attempt(image=image, covered=np.ones(size, dtype=np.bool_), flow=flow)

    def _alone(self, view: View, depth: Depth, rig: StereoRig, motion: Motion) -> Attempt:
        """A correction that knows one frame only."""
        geometry = rig, self.shutter, motion
        corrected = correct_frame(self.images[view], depth, *geometry, *view)
        flow = correction_flow(depth, *geometry, *view)
        return Attempt(image=inpaint(corrected.image, ~corrected.mask), covered=corrected.mask, flow=flow)

    def _mono(self) -> dict[View, Attempt] | None:
        inliers = select(self.matches, self.robust)
        out: dict[View, Attempt] = {}
        for side, frame in VIEWS:
            motion = monocular_motion(inliers, self.rig, self.shutter, side, self.motion)
            if motion is None:
                return None
            flow = dense_flow(self.images[side, frame], self.images[side, 1 - frame])
            rig = self.rig.about(side)
            depth = monocular_depth(flow, rig, self.shutter, motion, side, frame)
            out[side, frame] = self._alone((side, frame), depth, rig, motion)
        return out

    def _whole(self, pairs: tuple[FramePair, FramePair], motion: Motion) -> dict[View, Attempt]:
        """Depth and motion of the whole rig: holes are filled from the other frames."""
        pairs = complete_depth(pairs, self.rig, self.shutter, motion)
        fused = correct_frames(pairs, self.rig, self.shutter, motion, self.options)
        out = {}
        for (side, frame), result in fused.items():
            depth = pairs[frame].depth[side]
            flow = correction_flow(depth, self.rig, self.shutter, motion, side, frame)
            covered = result.origin == Origin.HERE
            out[side, frame] = Attempt(image=result.image, covered=covered, flow=flow)
        return out


def _image_rows(sequence: Sequence, view: View, attempts: dict[str, Attempt]) -> list[Row]:
    truth = sequence.image("gs", *view)
    common = np.logical_and.reduce([attempt.covered for attempt in attempts.values()])
    rows = []
    for key, attempt in attempts.items():
        error = flow_error(attempt.flow, attempts["truth"].flow)
        known = np.isfinite(error)
        rows.append(
            {
                "method": key,
                "psnr_covered": psnr(attempt.image, truth, common),
                "ssim_covered": ssim(attempt.image, truth, common),
                "psnr_all": psnr(attempt.image, truth),
                "ssim_all": ssim(attempt.image, truth),
                "flow_mean_px": float(np.mean(error[known])) if np.any(known) else float("nan"),
                "flow_median_px": float(np.median(error[known])) if np.any(known) else float("nan"),
                "flow_known": float(np.mean(known)),
                "coverage": float(np.mean(attempt.covered)),
                "common": float(np.mean(common)),
                **_extra_scores(attempt.image, truth, common, view == VIEWS[0]),
            }
        )
    return rows


def _extra_scores(image: NDArray[Any], truth: NDArray[Any], common: Mask, wanted: bool) -> dict[str, float]:
    """Slow scores, of one view per sequence: FLIP on covered pixels and all, SSIM by the protocols of others."""
    names = ("flip_covered", "flip_all", "ssim_deepunroll", "ssim_uniform")
    if not wanted:
        return dict.fromkeys(names, float("nan"))
    errors = flip(image, truth)
    if errors is None:
        errors = np.full(common.shape, np.nan)
    covered = float(np.mean(errors[common])) if np.any(common) else float("nan")
    scores = covered, float(np.mean(errors)), ssim_deepunroll(image, truth), ssim_uniform(image, truth)
    return dict(zip(names, scores, strict=True))


def _band_rows(attempts: dict[str, Attempt]) -> list[Row]:
    rows = []
    for key, attempt in attempts.items():
        error = flow_error(attempt.flow, attempts["truth"].flow)
        for band, part in enumerate(np.array_split(error, ROW_BANDS)):
            known = np.isfinite(part)
            mean = float(np.mean(part[known])) if np.any(known) else float("nan")
            rows.append({"method": key, "band": band, "flow_mean_px": mean})
    return rows


def flow_error(flow: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """End-point error (H, W), px; NaN where either flow is not known."""
    return np.linalg.norm(flow.astype(np.float64) - truth, axis=-1)
