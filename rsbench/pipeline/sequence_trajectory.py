"""The motion of every window of a sequence from one trajectory through all of them.

Two frames do not show what both shake alike; a sequence does, for its windows overlap. Windows wait until those
after them have been seen too, some at a time, so that memory does not grow with the length of the footage.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import recalibrated
from rsbench.capture.trajectory_estimate import StreamedWindow, stream_trajectory
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images, Pairs
from rsbench.pipeline.frame_motion import FoundMotion
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate

BRIDGED = "few of the matches agree with the motion"
TURNED = "; they turn as the gyroscope says, and stay where they are"
_LONGEST_BRIDGE = 2
"""Windows from the nearest one with matches up to which a spline is believed: the middle one of eight without any
is wrong by 1 deg where a hand turns by 1.5 deg a frame, that of four by 0.16 deg."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """What was found for two consecutive frames; ``found`` is None and ``reason`` says why when no motion was."""

    images: Images
    pairs: Pairs | None
    """With depth from the other camera; None when the corrector needs none, or it is found with the motion."""
    found: FoundMotion | None
    reason: str = ""
    matches: Correspondences | None = None
    """None when the corrector needs none, or they were refused."""
    pose: Pose | None = None
    """Body from world at the start of its first frame, where a trajectory was found; the world: the first body."""


def on_one_trajectory(
    windows: Iterable[Window],
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    calibration: tuple[float, ...],
    gyro: FloatArray | None = None,
) -> Iterator[Window]:
    """Windows with the motion of one trajectory in place of that of each; those without matches are bridged.

    Args:
        windows: in order.
        calibration: what the calibration is wrong by, see ``calibration.TERMS``.
        gyro: (n, 4) samples as of ``Correspondences.gyro``, tau of the sequence. It bridges any number of windows:
            far from those with matches it alone tells how the rig turns, and nobody where it is.
    """
    waiting = deque[Window]()

    def matches() -> Iterator[Correspondences]:
        for window in windows:
            waiting.append(window)
            yield recalibrated(window.matches or Correspondences(), rig, calibration)

    for streamed in stream_trajectory(matches(), rig, shutter, options.seed, gyro=gyro):
        window = waiting.popleft()
        found = _found(streamed, options, calibration)
        reason = "" if streamed.supported else window.reason or BRIDGED
        pose = streamed.body_from_world
        if streamed.apart > _LONGEST_BRIDGE:
            by_gyro = streamed.gyro is not None and streamed.gyro.used
            found, pose = _turning(found) if by_gyro else None, None
            reason += TURNED if by_gyro else ""
        yield replace(window, found=found, reason=reason, pose=pose)


def _found(streamed: StreamedWindow, options: CorrectionOptions, calibration: tuple[float, ...]) -> FoundMotion:
    motion, right = streamed.motion, int(np.count_nonzero(streamed.inliers))
    estimate = MotionEstimate(
        w=motion.w,
        d=motion.d,
        success=True,
        reason="" if streamed.supported else BRIDGED,
        metric=True,
        noise_px=streamed.noise_px,
        covariance=streamed.covariance,
    )
    robust = RobustEstimate(
        estimate=estimate,
        inliers={"tracks": streamed.inliers},
        counts={"tracks": MatchCount(inliers=right, matches=len(streamed.inliers))},
        iterations=0,
        seconds=0.0,
        threshold_px=0.0,
    )
    return FoundMotion(
        motion=motion,
        robust=robust,
        solver=options.solver.name,
        reference_point="body",
        calibration=calibration,
        gyro=streamed.gyro,
    )


def _turning(found: FoundMotion) -> FoundMotion:
    """Of a rig that turns as it does and stays where it is."""
    assert isinstance(found.motion, ContinuousMotion)
    curve = found.motion.curve
    motion = ContinuousMotion.of(curve._replace(p=np.zeros_like(curve.p)))
    estimate = replace(found.robust.estimate, d=motion.d, covariance=None)
    return replace(found, motion=motion, robust=replace(found.robust, estimate=estimate))
