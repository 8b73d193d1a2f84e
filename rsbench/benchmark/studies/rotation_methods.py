"""Rotations of single frames by methods of the correction study on request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import View
from rsbench.dataset.imu import gyro_samples
from rsbench.dataset.sequence import Sequence
from rsbench.vision.corrector import CorrectionProblem, load_corrector
from rsbench.vision.rotation_correctors import ImageRotationCorrector


def asked_rotation(key: str, sequence: Sequence, images: Mapping[View, NDArray[Any]], view: View) -> Motion | None:
    """The rotation of a frame by the gyroscope, or by the card of a corrector of one image; None when it fails.

    Raises:
        RsbenchError: the sequence has no channel imu, or no such card.
        ValueError: the card is of a corrector that needs more than the image.
    """
    if key == "gyroscope":
        return GyroMotion(gyro_samples(sequence.inertial(), sequence.frame_period_s), np.zeros(3))
    corrector = load_corrector(key).component
    if not isinstance(corrector, ImageRotationCorrector):
        raise ValueError(f"{key!r} is no corrector of one image")
    problem = CorrectionProblem(
        images=images,
        rig=sequence.rig,
        shutter=sequence.shutter,
        target_row=0.0,
        motion=None,
        depth=None,
        guess=None,
    )
    motion = corrector.rotation(problem, view)
    return motion if isinstance(motion, Motion) else None
