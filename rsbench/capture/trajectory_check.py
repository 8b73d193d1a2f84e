"""Whether a rig shakes: its frames then follow none of the motion models, and a ratio found under them is wrong.

A spline follows any motion that is slow against its knots (``trajectory_fit``), and leaves far smaller errors
then, whatever the ratio: an arbitrary motion within a readout looks the same at any. ``trajectory_ratio`` tells
the ratio of such a rig.
"""

from __future__ import annotations

from collections.abc import Sequence

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.estimate import Capture
from rsbench.capture.settle import shutter_of
from rsbench.capture.trajectory_data import pack_windows
from rsbench.capture.trajectory_estimate import TrajectoryOptions
from rsbench.capture.trajectory_fit import fit
from rsbench.capture.trajectory_spline import span_of
from rsbench.capture.trajectory_start import first_curve, window_motions
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig

SUCCESSIVE = 6
"""Windows that are looked at."""
_TRACKS = 200
"""Of each window, at most."""
_FAR_BETTER = 0.8
"""Scale of the errors about a trajectory over that about motion models, below which these are wrong."""


def shakes(capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> bool:
    """Whether a trajectory through successive windows leaves far smaller errors than the motion models did."""
    best = capture.likeliest
    if best is None or not best.scans.rolls or "global" in (best.scans.left, best.scans.right):
        return False
    shutter, options = shutter_of(best, rig), TrajectoryOptions()
    few = [Correspondences(tracks=each.tracks[:: max(len(each.tracks) // _TRACKS, 1)]) for each in windows]
    tracks = pack_windows(few, rig, shutter)
    motions = window_motions(few, rig, shutter, seed)
    curve = first_curve(motions, tracks, span_of(len(few), shutter), options.intervals[0])
    try:
        found = fit(curve, tracks, options.prior)
    except banded.NotDefiniteError:
        return False
    return found.tails.scale < _FAR_BETTER * capture.noise_px
