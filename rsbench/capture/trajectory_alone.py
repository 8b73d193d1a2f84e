"""The way of one camera through successive frames, from matches of neighbouring ones; its length has no unit.

The spline and the fit are those of a rig (``trajectory_fit``). One camera shows no length: that of its translation
stays near where the search begins, and the prior, which follows the matches, does not mind which it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_choice import approximated
from rsbench.capture.trajectory_covariance import covariance_between
from rsbench.capture.trajectory_data import TimedTracks, pack_windows
from rsbench.capture.trajectory_fit import Fit, covariance_band, fit, normal_equations, right_tracks
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
_SHARE, _SHARE_OF_TWO = 0.5, 0.15
"""What a track counts beside the prior, see ``TrajectoryOptions``: of many frames, and of two, where tracks that
err together turn what hardly anything else holds."""
_GAINED = 0.3
"""Logarithm of the likelihood that a match of two frames must gain, in the mean, for a way in place of a law.
Neighbours err alike in dense flow, so that many of them count for one; of rendered motions by laws of constant
speed it was 0.1 at most."""
_OPEN_PX = 0.15
"""Deviation, root mean square, of where turns of the rows of a frame put what is far: above, two frames leave open
how they shook."""
_ROWS, _FEWEST = 24, 30
_NO_PRIOR = Prior(1.0, 1, np.inf, np.inf)
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
        curve = _fitted(windows, motions, rig, shutter, _SHARE)[0].curve
    except banded.NotDefiniteError:
        return None
    found = [_window(curve, number, shutter) for number in range(len(windows))]
    ways = [each for each in found if each is not None]
    return ways if len(ways) == len(windows) else None


def way_of_two(
    matches: FloatArray, law: Motion, rig: StereoRig, shutter: RollingShutter
) -> ContinuousMotion | None:
    """As ``trajectory_alone`` of two frames; None where a law is as good, or they leave open which way it was.

    Args:
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        law: the motion by the law that fits best.
        rig, shutter: as there.
    """
    if shutter.readout_ratio == 0.0 or len(matches) < _FEWEST:
        return None
    try:
        found, tracks = _fitted([matches], [law], rig, shutter, _SHARE_OF_TWO)
        inverse = covariance_band(found, tracks, _SHARE_OF_TWO)
    except banded.NotDefiniteError:
        return None
    theirs = approximated(law.body_from_world, span_of(1, shutter), _INTERVAL)
    each = replace(tracks, share=1.0)
    costs = [
        normal_equations(curve, each, found.tails, _NO_PRIOR, found.trust, want=False).cost
        for curve in (found.curve, theirs)
    ]
    gained = (costs[1] - costs[0]) / max(float(np.sum(found.trust)), 1.0)
    if gained < _GAINED or _open_px(found.curve, inverse, rig, shutter) > _OPEN_PX:
        return None
    return _window(found.curve, 0, shutter)


def _open_px(curve: Curve, inverse: FloatArray, rig: StereoRig, shutter: RollingShutter) -> float:
    """Root mean square deviation, px, of where rows of frame 1 put what is far at the time of its middle row."""
    lines = np.linspace(0.0, shutter.height - 1.0, _ROWS)
    middle = float(shutter.time_after((shutter.height - 1) / 2, 1, "left"))
    taus = shutter.pixel_time(np.stack([np.zeros(_ROWS), lines], axis=-1), 1, "left")
    turns = covariance_between(curve, inverse, middle, taus)
    return rig.camera.fx * float(np.sqrt(np.mean(turns[:, 0, 0] + turns[:, 1, 1])))


def _fitted(
    windows: Sequence[FloatArray],
    motions: Sequence[Motion],
    rig: StereoRig,
    shutter: RollingShutter,
    share: float,
) -> tuple[Fit, TimedTracks]:
    """Some of the matches say first which are right."""

    def packed(each: Sequence[FloatArray], right: Sequence[FloatArray] | None = None) -> TimedTracks:
        return pack_windows([Correspondences(left=one) for one in each], rig, shutter, right, share=share)

    few = packed([each[:: max(len(each) // _JUDGED_BY, 1)] for each in windows])
    first = fit(first_curve(motions, few, span_of(len(windows), shutter), _INTERVAL), few, _PRIOR)
    tracks = packed(windows)
    trust = right_tracks(first, tracks)
    tracks = packed(windows, [trust[each] for each in tracks.members])
    return fit(first.curve, tracks, first.prior, False, first.tails), tracks


def _window(curve: Curve, number: int, shutter: RollingShutter) -> ContinuousMotion | None:
    """None where it does not move."""
    start, end = span_of(1, shutter)
    motion = ContinuousMotion.of(part(curve, number + start, number + end, float(number)))
    length = float(np.linalg.norm(motion.d))
    if not length > 0.0:
        return None
    return motion.seen(np.eye(3), 1.0 / length)
