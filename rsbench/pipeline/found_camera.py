"""The focal length and k1 of a rig whose card says how sure it is of them, from some of its frames."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from rsbench.capture.calibration import CardSigma, RefusedFramesError
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.self_calibration import FoundCamera, find_camera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.frame_matches import match_frames, match_unknown
from rsbench.pipeline.sequence_windows import window_images

_WINDOWS = 8
"""At most, of a sequence."""


def spread_windows(left: FrameSource, right: FrameSource) -> Iterable[Images]:
    """Some windows of a sequence, evenly spread."""
    every = max((left.count - 1) // _WINDOWS, 1)
    return islice(window_images(left, right), every // 2, None, every)


def camera_of_frames(
    windows: Iterable[Images],
    rig: StereoRig,
    sigma: CardSigma,
    options: CorrectionOptions,
    readout_ratio: float | None = None,
    scanning: Scanning | None = None,
) -> FoundCamera:
    """``find_camera`` from the matches of a few windows; those without matches say nothing.

    Args:
        readout_ratio, scanning: see ``solve_frames``.
    """
    matches = list[Correspondences]()
    for images in islice(windows, _WINDOWS):
        try:
            if readout_ratio is None and scanning is None:
                matches.append(match_unknown(images, rig, options, judge_rig=False)[0])
            else:
                matches.append(match_frames(images, rig, options, scanning, judge_rig=False))
        except RefusedFramesError:
            continue  # the correction says so of each
    if not matches:
        return FoundCamera(rig=rig, sigma=sigma, determined=(False, False))
    return find_camera(
        matches,
        rig,
        sigma,
        KnownInputs(readout_ratio=readout_ratio, scanning=scanning),
        options.robust,
        options.seed,
    )
