"""Implementation of ``rsbench.correct`` and ``rsbench.estimate_trajectory``, whose images are arrays."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.sequence_shutter import shutter_of_sequence
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, Trajectory, estimate_trajectory
from rsbench.core import arguments
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, gyro_samples
from rsbench.core.geometry import check_image, check_times, four_images
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.chain import CorrectedFrames, Given, correct_four
from rsbench.pipeline.footage import ImageSource, OneCameraCard
from rsbench.pipeline.frame_capture import find_matches
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import model_to_use
from rsbench.pipeline.isolated_chain import Isolation
from rsbench.pipeline.mono_sequence import options_of_camera
from rsbench.pipeline.sequence_capture import FEWEST_FRAMES, Gyroscope, know_capture
from rsbench.pipeline.sequence_correction import correct_sequence
from rsbench.solvers.engine.base import Solver, entry_of
from rsbench.vision.corrector import demand_corrected, load_corrector
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.fusion import Fused, finished
from rsbench.vision.images import single_opencv
from rsbench.vision.stereo_matcher import load_matcher


def options_of(
    solver: str | Path | Solver,
    motion_model: str | None,
    matcher: str | Path,
    features: str | Path,
    corrector: str | Path,
    **others: Any,
) -> CorrectionOptions:
    """Return the options with components given by name or card. Raises RsbenchError for an unknown name."""
    entry = entry_of(solver)
    for name, value in (("matcher", matcher), ("features", features), ("corrector", corrector)):
        arguments.name_or_path(name, value)
    if motion_model is not None:
        arguments.name_or_path("motion_model", motion_model)
    return CorrectionOptions(
        features=load_features(features),
        solver=entry,
        motion_model=model_to_use(motion_model, entry),
        matcher=load_matcher(matcher),
        corrector=load_corrector(corrector),
        **others,
    )


def of_rig(
    images: Sequence[NDArray[Any]],
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    gyro: ArrayLike | None = None,
    *,
    close: bool = False,
) -> CorrectedFrames:
    """Correct the images left 0, right 0, left 1, right 1 of a rig. Raises as ``rsbench.correct`` does.

    ``close``: whether to close narrow holes.
    """
    check_times(inputs.readout_ratio, options.target_row, rig)
    views, known = four_images(images, rig), Given(gyro=gyro_samples(gyro))
    with Isolation() as isolation:
        found = correct_four(views, rig, inputs, isolation.chain(options), given=known)
    demand_corrected(found.frames, options.corrector.name)
    if not close:
        return found
    return replace(found, frames={view: finished(fused) for view, fused in found.frames.items()})


def of_one_camera(
    images: Sequence[NDArray[Any]],
    camera: PinholeCamera | float | None,
    readout_ratio: float | None,
    target_row: float,
    inpaint: bool | None,
    seed: int,
    gyro: ArrayLike | None = None,
    gyro_clock_error: float = 0.0,
) -> list[Fused]:
    """Correct the images of one camera, which are in order. Raises as ``rsbench.correct`` does."""
    known = StereoRig.of_one(camera) if isinstance(camera, PinholeCamera) else None
    for number, image in enumerate(arguments.items("images", images)):
        check_image(f"frame {number}", image, known)
    if len(images) > 0:
        arguments.check_number("target_row", target_row, 0.0, images[0].shape[0] - 1.0)
    arguments.check_whole("seed", seed, 0)
    if readout_ratio is not None:
        arguments.check_number("readout_ratio", readout_ratio, 0.0, 1.0)
    if camera is not None and not isinstance(camera, PinholeCamera):
        arguments.check_number("camera", camera)  # degrees; OneCameraCard checks the range
    samples = gyro_samples(gyro)
    log = None if samples is None else Gyroscope(samples=samples, clock_error=gyro_clock_error)
    options, sources = options_of_camera(inpaint, seed, target_row), [ImageSource(images)]
    with single_opencv():
        found = know_capture(sources, OneCameraCard.of(camera, readout_ratio), options, log)
        frames = [moment.shown["left"] for moment in correct_sequence(sources, found, options)]
    return [finished(fused) for fused in frames] if inpaint is None else frames


# Implementation of ``rsbench.estimate_trajectory``.


def matches_of(frames: Sequence[Any], rig: StereoRig, features: str) -> list[Correspondences]:
    """Match each two successive frame times; ``frames`` are pairs (left, right) of images.

    Raises:
        ValueError: a time does not have two images of the rig's size, or there are fewer than two times.
        RsbenchError: the feature matcher does not exist.
    """
    options = CorrectionOptions(features=load_features(features))
    for number, both in enumerate(frames):
        if isinstance(both, Correspondences) or not isinstance(both, Collection) or len(both) != 2:
            raise ValueError(f"sequence[{number}]: must be Correspondences, as all others, or two images")
        for side, image in zip(("left", "right"), both, strict=True):
            check_image(f"sequence[{number}], {side}", image, rig)
    if len(frames) < 2:
        raise ValueError(f"sequence: {len(frames)} times, at least 2 are needed")
    return [find_matches(four_images([*a, *b]), options) for a, b in itertools.pairwise(frames)]


def trajectory_of(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter | None,
    seed: int,
    gyro: FloatArray | None = None,
) -> Trajectory:
    """Estimate the trajectory, and the shutter if it is None.

    Raises:
        ValueError: no tracks; too few frames to estimate the shutter; gyroscope samples outside the frames' times.
        NoMotionError: the matches do not determine the shutter, or no trajectory explains them.
    """
    if shutter is None and len(windows) + 1 < FEWEST_FRAMES:
        raise ValueError(f"shutter: is found of {FEWEST_FRAMES} frames and more; these are {len(windows) + 1}")
    if gyro is not None and not np.any((gyro[:, 0] >= 0.0) & (gyro[:, 0] <= len(windows))):
        raise ValueError(f"gyro: no sample is of the times from 0 to {len(windows)} frame periods")
    shutter = shutter or shutter_of_sequence(windows, rig, seed)
    found = estimate_trajectory(windows, rig, shutter, seed=seed, gyro=gyro)
    if found.noise_px > MOST_NOISE_PX:
        raise NoMotionError(
            f"no trajectory explains the matches: they err by some {found.noise_px:.0f} px about the best "
            "one; are they of one scene, and the frames in order?"
        )
    return found
