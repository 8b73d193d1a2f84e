"""``rsbench.estimate_trajectory``: the way of a rig through a whole sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from rsbench.components import arguments
from rsbench.core import given
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter

if TYPE_CHECKING:
    from rsbench.capture.trajectory_estimate import Trajectory


def estimate_trajectory(
    sequence: Sequence[Correspondences] | Sequence[Sequence[NDArray[Any]]],
    rig: StereoRig,
    shutter: RollingShutter | None = None,
    *,
    features: str = "sift-refined",
    seed: int = 0,
) -> Trajectory:
    """The way of the rig through a sequence, one continuous-time spline, from matches that may hold outliers.

    Args:
        sequence: the matches of frames 0 and 1, 1 and 2, ..., of which ``tracks`` must be there; or the frames: of
            each time the images of the left and the right camera, rectified.
        rig: both cameras.
        shutter: how they read; None has it found, of four frames and more.
        features: name or card of the feature matcher, where frames are given.
        seed: of the search for motions of single windows.

    Returns:
        ``motion``: ``body_from_world(tau)`` at any times in frame periods, seen from the body at time 0;
        ``covariance(tau)`` and ``covariance_between(start, tau)`` (n, 6, 6) of turns about the body's axes,
        radians, and of its position, metres; ``shutter``; ``noise_px``; for each window ``inliers`` and
        ``supported``, False where its own matches do not carry it and the spline bridges it.

    Raises:
        ValueError: an argument of another type or out of its range; no tracks.
        RsbenchError: no such feature matcher; a shutter that the matches do not tell.
    """
    from rsbench.pipeline.array_trajectory import matches_of, trajectory_of

    given.check_whole("seed", seed, 0)
    if shutter is not None:
        arguments.check_rows(rig, shutter)
    windows = list[Correspondences]()
    for number, each in enumerate(sequence):
        if len(windows) == number and isinstance(each, Correspondences):
            windows.append(each)
    if len(windows) < len(sequence):
        windows = matches_of(sequence, rig, features)
    return trajectory_of(windows, rig, shutter, seed)
