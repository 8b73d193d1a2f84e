"""The trajectory of arrays, as ``rsbench.estimate_trajectory`` finds it."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from rsbench.capture.sequence_shutter import shutter_of_sequence
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, Trajectory, estimate_trajectory
from rsbench.core.correspondences import Correspondences
from rsbench.core.geometry import check_image, four_images
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_matches import find_matches
from rsbench.vision.feature_matcher import load_features

FEWEST_FRAMES = 4
"""Of a sequence that shows its shutter."""


def matches_of(frames: Sequence[Any], rig: StereoRig, features: str) -> list[Correspondences]:
    """Of each two successive times; frames are (left, right) images.

    Raises:
        ValueError: not two images of each time, not of the rig's size, or of one time only.
        RsbenchError: no such feature matcher.
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
    """The trajectory, and the shutter where that is not known.

    Raises:
        ValueError: no tracks; without a shutter, too few frames; samples of a gyroscope of another time.
        NoMotionError: the matches do not tell the shutter, or no trajectory explains them.
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
