"""Where the descent to a trajectory begins: the motions of neighbouring frames, one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsbench.capture.trajectory_data import TimedTracks, is_of_one_camera, thinned
from rsbench.capture.trajectory_fit import squared_errors
from rsbench.capture.trajectory_spline import (
    ContinuousMotion,
    Curve,
    control_count,
    evaluate,
    from_pose_at,
    make_curve,
)
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import LinearMotion, Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

_SOME = 250
"""Tracks of a window, about: enough to begin with."""
_SUSPECT = 4.0
"""Times the error of a window whose motion is made of its neighbours', from which on its own is wrong."""


def window_motions(
    windows: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter, seed: int
) -> list[Motion | None]:
    """The paper's motion in each window, of some of its tracks; None where they show none."""
    out, solver = list[Motion | None](), RefinedSolver(one_camera=is_of_one_camera(windows))
    for window in thinned(windows, _SOME):
        rng = np.random.default_rng(seed)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            found = estimate_motion(window, rig, shutter, solver, RobustOptions(), rng).estimate
        out.append(LinearMotion(found.w, found.d) if found.success else None)
    return out


def first_curve(
    motions: Sequence[Motion | None], tracks: TimedTracks, span: tuple[float, float], interval: float
) -> Curve:
    """A spline along the motions of the windows; one that is missing or wrong is made of its neighbours'.

    Args:
        span: times of the first and the last line.
    """
    known = np.array([motion is not None for motion in motions])
    rates = np.array([[0.0] * 6 if motion is None else [*motion.w, *motion.d] for motion in motions])
    own = _chained(_bridged(rates, known), span, interval)
    others = np.stack([_without(rates, known, k) for k in range(len(rates))])
    bridged = _chained(others, span, interval)
    errors = [_median_errors(squared_errors(curve, tracks), tracks) for curve in (own, bridged)]
    known &= ~(errors[0] > _SUSPECT * errors[1])
    return _chained(_bridged(rates, known), span, interval)


def continued(curve: Curve, motions: Sequence[Motion | None], start: int, last: float) -> Curve:
    """A spline, longer: along the motions of the windows from ``start`` on, to a time."""
    known = np.array([motion is not None for motion in motions])
    if not np.any(known):
        motions, known = [ContinuousMotion.of(curve).from_time(start - 1.0)], np.ones(1, dtype=np.bool_)
    rates = np.array([[0.0] * 6 if motion is None else [*motion.w, *motion.d] for motion in motions])
    rates = _bridged(rates, known)
    count = control_count(curve.first, last, curve.interval)
    taus = curve.first + curve.interval * (np.arange(count) - 1.0)
    ahead = from_pose_at(_chained(rates, (0.0, max(last - start, 1.0)), curve.interval), 0.0)
    own, later = evaluate(curve, taus)[0], evaluate(ahead, taus - start)[0]
    here = evaluate(curve, float(start))[0]
    R, p = curve.R, curve.p
    for k in range(len(p), count):
        far = taus[k] > start
        pose = compose(Pose(later.R[k], later.t[k]), here) if far else Pose(own.R[k], own.t[k])
        R, p = np.concatenate([R, pose.R[None]]), np.concatenate([p, -(pose.R.T @ pose.t)[None]])
    return make_curve(curve.first, curve.interval, R, p)


def _median_errors(squares: FloatArray, tracks: TimedTracks) -> FloatArray:
    """(windows,) of the tracks of each window; 0 of none."""
    chosen = [squares[members] for members in tracks.members]
    return np.array([float(np.median(each)) if len(each) else 0.0 for each in chosen])


def _bridged(rates: FloatArray, known: BoolArray) -> FloatArray:
    """Rates (n, 6), those that are not known between those of neighbours; 0 where none is."""
    if not np.any(known):
        return np.zeros_like(rates)
    places = np.arange(len(rates))
    return np.stack([np.interp(places, places[known], column[known]) for column in rates.T], axis=1)


def _without(rates: FloatArray, known: BoolArray, k: int) -> FloatArray:
    """What the neighbours of window k say of it (6,)."""
    others = known.copy()
    others[k] = False
    return _bridged(rates, others)[k]


def _chained(rates: FloatArray, span: tuple[float, float], interval: float) -> Curve:
    """Through the poses that rates of rotation and translation (n, 6) lead to."""
    poses = [Pose(np.eye(3), np.zeros(3))]
    for rate in rates:
        poses.append(compose(Pose(*LinearMotion(rate[:3], rate[3:]).body_from_world(1.0)), poses[-1]))
    taus = span[0] + interval * (np.arange(control_count(*span, interval)) - 1.0)
    controls = []
    for tau in taus:
        k = int(np.clip(np.floor(tau), 0, len(rates) - 1))
        along = LinearMotion(rates[k, :3], rates[k, 3:]).body_from_world(tau - k)
        controls.append(inverse(compose(along, poses[k])))
    R = np.swapaxes(np.stack([each.R for each in controls]), 1, 2)
    return make_curve(span[0], interval, R, np.stack([each.t for each in controls]))
