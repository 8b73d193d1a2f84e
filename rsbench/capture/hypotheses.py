"""What may be known of a capture, and what it may have been: the hypotheses that matches decide between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.capture.calibration_errors import NO_ERRORS, TERMS
from rsbench.capture.scans import ALL_SCANS, Scans
from rsbench.core.so3 import FloatArray

RATIO, DELAY, ACCELERATION = range(3)
"""Places of the first unknowns: readout ratio, delay of the right camera (frame periods), k."""
CALIBRATION = slice(3, 3 + len(TERMS))
"""Places of what the calibration is wrong by, see ``calibration_errors.TERMS``."""
UNKNOWNS = CALIBRATION.stop
LEAST_RATIO = 0.05
"""Readout ratios below this are taken for a global shutter's."""
MODELS = ("linear", "twist", "inertial", "accelerated")
"""Motion models that are tried."""
DELAY_SIGMA = 0.3
"""Frame periods by which a right camera that is late or early is so: what is expected before matches are seen."""
ACCELERATION_SIGMA = 0.2
"""Standard deviation of k that is expected of motions that accelerate."""


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """How the cameras read and how the rig moves, and which of the unknowns are free beside the motion."""

    scans: Scans
    motion_model: str
    delayed: bool = False
    """Whether the right camera may be late."""

    @property
    def accelerations(self) -> tuple[float, ...]:
        """k that its fits start from: from 0 alone, two of eighteen rigs that turned by 6 deg and slowed down were
        taken for ones in reverse."""
        return (0.0, -0.3, 0.3) if self.motion_model == "accelerated" else (0.0,)


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is known of a capture beforehand; None: it is looked for."""

    ratio: float | None = None
    scans: tuple[Scans, ...] = ALL_SCANS
    """Those that are possible."""
    delay: float | None = None
    """Frame periods by which the right camera is late."""
    calibration: tuple[float, ...] = NO_ERRORS
    """What the calibration is wrong by, see ``calibration_errors.TERMS``."""
    calibration_sigma: tuple[float, ...] = NO_ERRORS
    """Standard deviation of each of them, about 0; 0: it is known."""
    models: tuple[str, ...] = MODELS

    def prior(self, hypothesis: Hypothesis) -> FloatArray:
        """(17,) standard deviations of the unknowns, as ``CaptureCost`` takes them."""
        ratio = np.inf if self.ratio is None and hypothesis.scans.rolls else 0.0
        delay = DELAY_SIGMA if hypothesis.delayed else 0.0
        acceleration = ACCELERATION_SIGMA if hypothesis.motion_model == "accelerated" else 0.0
        return np.array([ratio, delay, acceleration, *self.calibration_sigma])

    def start(self, hypothesis: Hypothesis, ratio: float, delay: float) -> FloatArray:
        """(17,) unknowns of a hypothesis, of which these are guesses."""
        out = np.zeros(UNKNOWNS)
        out[RATIO], out[DELAY] = ratio, delay if hypothesis.delayed else self.delay or 0.0
        out[CALIBRATION] = self.calibration
        if not hypothesis.scans.rolls:
            out[RATIO] = 0.0
        elif self.ratio is not None:
            out[RATIO] = self.ratio
        return out

    @property
    def shutter_known(self) -> bool:
        """Whether nothing but the motion and its model is looked for."""
        return len(self.scans) == 1 and self.ratio is not None and self.delay is not None

    @property
    def delays(self) -> tuple[bool, ...]:
        """Whether the right camera may be late."""
        return (False, True) if self.delay is None else (False,)
