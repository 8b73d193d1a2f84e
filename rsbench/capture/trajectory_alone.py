"""The way of one camera through successive frames, from matches of neighbouring ones; its length has no unit.

The spline and the fit are those of a rig (``trajectory_fit``). One camera shows no length: that of its translation
stays near where the search begins, and the prior, which follows the matches, does not mind which it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_data import TimedTracks, pack_windows
from rsbench.capture.trajectory_fit import Fit, fit, right_tracks
from rsbench.capture.trajectory_prior import Prior
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, part, span_of
from rsbench.capture.trajectory_start import first_curve
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_INTERVAL = 0.25
"""Frame periods between control poses."""
_PRIOR = Prior(memory=0.25, smooth=1, rotation=1e-4, position=1e-2)
"""To begin with; its strength follows the matches."""
_SHARE = 0.5
"""What a track counts beside the prior, see ``TrajectoryOptions``."""
_JUDGED_BY = 150
"""Matches of a window, about, by which the prior is found, and which of the others are right."""


def trajectory_alone(
    windows: Sequence[FloatArray], motions: Sequence[Motion], rig: StereoRig, shutter: RollingShutter
) -> list[ContinuousMotion] | None:
    """The motion in each window, seen from the camera at its start, d of length 1; None where none is found.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, with outliers, of the frames 0 and 1, 1 and 2, ...; those that
            end where others begin are one track.
        motions: of each window, to begin with; d of any length.
        rig: its body is where the camera is, the left one.
        shutter: of the camera.
    """
    try:
        curve = _fitted(windows, motions, rig, shutter).curve
    except banded.NotDefiniteError:
        return None
    found = [_window(curve, number, shutter) for number in range(len(windows))]
    ways = [each for each in found if each is not None]
    return ways if len(ways) == len(windows) else None


def _fitted(
    windows: Sequence[FloatArray], motions: Sequence[Motion], rig: StereoRig, shutter: RollingShutter
) -> Fit:
    """Some of the matches say first which are right."""

    def packed(each: Sequence[FloatArray], right: Sequence[FloatArray] | None = None) -> TimedTracks:
        return pack_windows([Correspondences(left=one) for one in each], rig, shutter, right, share=_SHARE)

    few = packed([each[:: max(len(each) // _JUDGED_BY, 1)] for each in windows])
    first = fit(first_curve(motions, few, span_of(len(windows), shutter), _INTERVAL), few, _PRIOR)
    tracks = packed(windows)
    trust = right_tracks(first, tracks)
    tracks = packed(windows, [trust[each] for each in tracks.members])
    return fit(first.curve, tracks, first.prior, False, first.tails)


def _window(curve: Curve, number: int, shutter: RollingShutter) -> ContinuousMotion | None:
    """None where it does not move."""
    start, end = span_of(1, shutter)
    motion = ContinuousMotion.of(part(curve, number + start, number + end, float(number)))
    length = float(np.linalg.norm(motion.d))
    if not length > 0.0:
        return None
    return motion.seen(np.eye(3), 1.0 / length)
