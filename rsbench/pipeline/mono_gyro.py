"""Motion of one camera whose rotation a gyroscope measured: its bias and the translation, from dense flow.

Two frames tell a constant rate of turn. A gyroscope tells how the rate changes between the rows, up to a bias that
hardly changes in two frames: three numbers, as many as the constant rate has. They are found with the translation
from the flow, and expected to be small where the flow leaves them open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_correction import FoundOwnMotion, flow_matches
from rsbench.pipeline.mono_law import error_px
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.gyro_and_gravity import GyroSolver
from rsbench.vision.mono_fusion import Flows, OwnMotion

NOT_COVERED = "the gyroscope's samples do not reach over these frames"
CONTRADICTED = "the gyroscope contradicts the frames"
_BIAS = 1e-3
"""Standard deviation of the bias, rad per frame period: 0.03 rad/s at 30 frames a second."""
_MATCHES = 400
_SAMPLES = 100
"""Of two matches, at most, in the search for the translation: enough for three wrong ones in four."""
_WORTH = 200.0
"""Matches, at most, that count as apart: neighbours in dense flow err alike."""
_NOISE_PX = 0.05
"""Standard deviation of the flow, at least."""
_PX_PER_SIGMA = 2.5
"""Of the robust loop's threshold."""
_WORSE, _BIASED, _FAR_WORSE = 1.15, 2.0, 2.0
"""A gyroscope contradicts the frames where it fits them by so much worse than a constant rate of turn does, at a
bias of so many standard deviations, or by far worse. On shakes of three kinds in a closed-form world, right
samples had one of the first two at most, and 1.63 times the error; those with another sign, axes or time that
fitted so much worse had both."""


def around(samples: FloatArray, first: float, last: float) -> FloatArray | None:
    """Samples (n, 4) tau, w from half a period before a time to half after another; None: not over both."""
    tau = samples[:, 0]
    chosen = samples[(tau >= first - 0.5) & (tau <= last + 0.5)]
    if len(chosen) < 2 or chosen[:, 0].min() > first or chosen[:, 0].max() < last:
        return None
    return chosen


def rotation_alone(rig: StereoRig, shutter: RollingShutter, side: Side, samples: FloatArray) -> FoundOwnMotion:
    """What the samples say, and everything infinitely far: frames that show nothing to find a translation by."""
    motion = GyroMotion(samples, np.zeros(3))
    own = OwnMotion(rig=rig.about(side), shutter=shutter, side=side, motion=motion, far=True)
    return FoundOwnMotion(own=own, robust=None)


def with_gyro(
    found: FoundOwnMotion, flows: Flows, samples: FloatArray, robust: RobustOptions, seed: int = 0
) -> FoundOwnMotion:
    """The motion with the rotation of the samples (n, 4), and their bias, in place of one that turns evenly.

    ``found`` is that of the images alone. It stays where the samples contradict it; its ``unused`` says so.
    """
    own, rng = found.own, np.random.default_rng(seed)
    rig, shutter, side = own.rig, own.shutter, own.side
    matches = flow_matches(flows, rng)
    few = matches[:_MATCHES]  # they are in random order
    given = Correspondences(left=few, gyro=samples)
    quick = replace(robust, max_iterations=min(robust.max_iterations, _SAMPLES))
    told = estimate_motion(given, rig, shutter, GyroSolver(), quick, rng)
    if not told.estimate.success:
        if own.motion is None:
            return rotation_alone(rig, shutter, side, samples)
        return replace(found, unused=CONTRADICTED)
    noise_px = max(told.threshold_px / _PX_PER_SIGMA, _NOISE_PX)
    weight = float(np.sqrt(min(_WORTH, len(few)) / len(few))) / noise_px

    def moving(x: FloatArray) -> GyroMotion:
        return GyroMotion(samples + np.concatenate([[0.0], _BIAS * x[:3]]), x[3:] / np.linalg.norm(x[3:]))

    def residuals(x: FloatArray) -> FloatArray:
        errors = weight * rs_sampson_error(rig, shutter, moving(x), side, few)
        tamed = np.sign(errors) * np.sqrt(2.0 * (np.sqrt(1.0 + errors**2) - 1.0))  # linear where they are large
        return np.concatenate([tamed, x[:3], [float(np.linalg.norm(x[3:])) - 1.0]])

    start = np.concatenate([np.zeros(3), told.estimate.d])
    bias_d = scipy.optimize.least_squares(residuals, start, method="lm", max_nfev=200, xtol=1e-6).x
    motion = moving(bias_d)

    def miss_px(one: Motion) -> float:
        return error_px(one, matches, rig, shutter, side)

    worse = _WORSE if float(np.linalg.norm(bias_d[:3])) > _BIASED else _FAR_WORSE
    if own.motion is not None and miss_px(motion) > worse * miss_px(own.motion):
        return replace(found, unused=CONTRADICTED)
    return FoundOwnMotion(own=replace(own, motion=motion), robust=told)
