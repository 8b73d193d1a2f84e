"""``rsbench.estimate_trajectory``: the trajectory of a rig through a whole sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments
from rsbench.core.correspondences import Correspondences, gyro_samples
from rsbench.core.geometry import check_rows
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter

if TYPE_CHECKING:
    from rsbench.capture.trajectory_estimate import Trajectory
    from rsbench.solvers.engine.base import SolverEntry
    from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions


def estimate_trajectory(
    sequence: Sequence[Correspondences] | Sequence[Sequence[NDArray[Any]]],
    rig: StereoRig,
    shutter: RollingShutter | None = None,
    *,
    features: str = "dense",
    seed: int = 0,
    gyro: ArrayLike | None = None,
) -> Trajectory:
    """The rig's trajectory through a sequence, one continuous-time spline, from matches with or without outliers.

    Args:
        sequence: the matches of frames 0 and 1, 1 and 2, ..., of which ``tracks`` must be there; or the frames: of
            each time the images of the left and the right camera, rectified.
        rig: both cameras.
        shutter: how they read; None has it found, of four frames and more.
        features: name or card of the feature matcher, where frames are given.
        seed: of the search for motions of single windows.
        gyro: (n, 4) samples of a gyroscope, as of ``Correspondences``, tau in frame periods of the sequence. Bias,
            noise, a clock that is off by up to half a frame period, and axes and scales that are off by some
            degrees and hundredths are found; the shutter is found without it.

    Returns:
        ``motion``: ``body_from_world(tau)`` at any times in frame periods, seen from the body at time 0;
        ``covariance(tau)`` and ``covariance_between(start, tau)`` (n, 6, 6) of turns about the body's axes,
        radians, and of its position, metres; ``shutter``; ``noise_px``; for each window ``inliers`` and
        ``supported``, False where its own matches do not carry it and the spline bridges it; ``gyro``: ``bias``,
        ``shift``, ``matrix``, ``noise`` and whether it is ``used``, which one is not that contradicts the matches.

    Raises:
        ValueError: an argument of another type or out of its range; no tracks.
        RsbenchError: no such feature matcher; a shutter that the matches do not tell; matches of no motion.
    """
    from rsbench.pipeline.arrays import matches_of, trajectory_of

    arguments.check_whole("seed", seed, 0)
    arguments.check_type("rig", rig, StereoRig)
    if shutter is not None:
        check_rows(rig, shutter)
    samples = gyro_samples(gyro)
    windows = [each for each in arguments.items("sequence", sequence) if isinstance(each, Correspondences)]
    if len(windows) != len(sequence):
        windows = matches_of(sequence, rig, str(arguments.name_or_path("features", features)))
    return trajectory_of(windows, rig, shutter, seed, samples)


def estimate_under(
    requested: str,
    entry: SolverEntry,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int,
) -> RobustEstimate:
    """An estimate under the motion model that is requested or that the matches prefer (``auto``).

    Raises:
        RsbenchError: no such model, or the solver can take no other than its own.
        NoMotionError: the solver found only the direction of the translation.
    """
    from rsbench.pipeline.frame_motion import Matched, check_model, motion_of, under_model
    from rsbench.solvers.engine.robust_motion import estimate_motion

    def solve(entry: SolverEntry) -> RobustEstimate:
        rng = np.random.default_rng(seed)
        return estimate_motion(matches, rig, shutter, entry.solver, options, rng, entry.options.robust)

    check_model(requested, entry)
    given = Matched(matches, rig, shutter)
    found, entry, choice, motion = under_model(requested, entry, solve, given, options, seed)
    if found.estimate.success and isinstance(motion, str):
        motion_of(found.estimate, entry, rig)
    return found if choice is None else replace(found, motion_model=choice.used)
