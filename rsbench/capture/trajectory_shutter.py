"""The readout ratio of a sequence whose rig shakes: of most evidence with one trajectory through its frames.

Two frames of a rig that shakes follow none of the motion models, and a ratio found under them is wrong. A spline
follows any motion that is slow against its knots (``trajectory_fit``); what it leaves of the errors, and how much
shake it needs, say the ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.estimate import CERTAIN, Candidate, Capture
from rsbench.capture.scans import GLOBAL, Scans
from rsbench.capture.trajectory_data import TimedTracks, pack_windows
from rsbench.capture.trajectory_estimate import TrajectoryOptions
from rsbench.capture.trajectory_fit import Fit, fit, log_evidence
from rsbench.capture.trajectory_spline import span_of
from rsbench.capture.trajectory_start import first_curve, window_motions
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning

WINDOWS = 6
"""Successive ones, that are looked at."""
_TRACKS = 200
"""Of each window, at most."""
_COARSE = (0.25, 0.5, 0.75, 1.0)
_BESIDE, _LONGEST, _ROUNDS = 0.04, 0.15, 5
_PRECISION = 1e12
_FAR_BETTER = 0.8
"""Scale of the errors about a trajectory over that about motion models, below which these are wrong."""
_LEAST_SIGMA = 0.003


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """The trajectory at one shutter."""

    scans: Scans
    ratio: float
    found: Fit
    evidence: float


class _Sequence:
    """Windows whose trajectory is fitted at any shutter."""

    def __init__(self, windows: Sequence[Correspondences], rig: StereoRig, seed: int) -> None:
        self.windows, self.rig, self.seed = [_thinned(each) for each in windows[:WINDOWS]], rig, seed
        self.options = TrajectoryOptions()

    def tried(self, scans: Scans, ratio: float, like: _Trial | None = None) -> _Trial | None:
        """None where no spline is determined.

        Args:
            like: whose errors, right tracks and prior are taken as known, so that evidences compare.
        """
        shutter = self._shutter(scans, ratio)
        tracks = pack_windows(self.windows, self.rig, shutter)
        motions = window_motions(self.windows, self.rig, shutter, self.seed)
        interval = self.options.intervals[0]
        curve = first_curve(motions, tracks, span_of(len(self.windows), shutter), interval)
        try:
            found = self._fit(curve, tracks, like)
            evidence = log_evidence(found, _PRECISION)
        except banded.NotDefiniteError:
            return None
        return _Trial(scans=scans, ratio=ratio, found=found, evidence=evidence)

    def _fit(self, curve: object, tracks: TimedTracks, like: _Trial | None) -> Fit:
        if like is None:
            return fit(curve, tracks, self.options.prior)  # pyrefly: ignore[bad-argument-type]
        known = like.found
        return fit(curve, tracks, known.prior, tails=known.tails, trust=known.trust)  # pyrefly: ignore[bad-argument-type]

    def _shutter(self, scans: Scans, ratio: float) -> RollingShutter:
        camera = self.rig.camera
        if not scans.rolls:
            return RollingShutter(height=camera.height, readout_ratio=0.0)
        scanning = Scanning(scan=scans.left, right_scan=scans.right)  # pyrefly: ignore[bad-argument-type]
        return scanning.shutter_of(camera.width, camera.height, ratio)


def _thinned(window: Correspondences) -> Correspondences:
    step = max(len(window.tracks) // _TRACKS, 1)
    return Correspondences(tracks=window.tracks[::step])


def follows_no_model(capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, seed: int) -> bool:
    """Whether a trajectory through successive windows leaves far smaller errors than the motion models do."""
    best = capture.likeliest
    if best is None:
        return True
    if "global" in (best.scans.left, best.scans.right) and best.scans.rolls:
        return False
    trial = _Sequence(windows, rig, seed).tried(best.scans, best.ratio)
    return trial is not None and trial.found.tails.scale < _FAR_BETTER * capture.noise_px


def shutter_by_trajectory(
    capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, scans: Sequence[Scans], seed: int = 0
) -> Capture:
    """A capture whose shutter is that of most evidence with one trajectory; as it was where none is found.

    Args:
        windows: successive ones.
        scans: those that are possible; of them, those that both cameras read alike are tried.
    """
    sequence = _Sequence(windows, rig, seed)
    alike = [each for each in scans if each.together]
    places = [(each, ratio) for each in alike for ratio in (_COARSE if each.rolls else (0.0,))]
    coarse = [trial for place in places if (trial := sequence.tried(*place)) is not None]
    if not coarse:
        return capture
    best = min(coarse, key=lambda trial: trial.found.tails.scale / max(float(np.mean(trial.found.trust)), 0.1))
    tops = [_climbed(sequence, each, coarse, best) for each in alike]
    candidates = sorted((each for each in tops if each is not None), key=lambda each: -each[1])
    if not candidates:
        return capture
    weights = scipy.special.softmax([weight for _, weight in candidates])
    found = [replace(each, probability=float(p)) for (each, _), p in zip(candidates, weights, strict=True)]
    named = found[0].probability > CERTAIN
    return replace(
        capture,
        candidates=tuple(each for each in found if each.probability >= 0.01),
        models={"spline": 1.0},
        peaks={},
        reason=""
        if found[0].sigma <= 0.1 and found[0].probability > 0.95
        else "the sequence does not determine it",
        named=found[0].probability > 0.95,
        windows=len(sequence.windows),
        noise_px=best.found.tails.scale,
    )


def _climbed(
    sequence: _Sequence, scans: Scans, coarse: Sequence[_Trial], like: _Trial
) -> tuple[Candidate, float] | None:
    """The ratio of most evidence under the errors of the best trial, and the logarithm of all its evidence."""
    own = [trial for trial in coarse if trial.scans == scans]
    if not own:
        return None
    ratio = min(own, key=lambda trial: trial.found.tails.scale).ratio
    if scans == GLOBAL:
        still = sequence.tried(scans, 0.0, like)
        return None if still is None else (_candidate(scans, 0.0, 0.0), still.evidence)
    at = sequence.tried(scans, ratio, like)
    for _ in range(_ROUNDS):
        beside = [sequence.tried(scans, float(np.clip(ratio + s * _BESIDE, 0.01, 1.2)), like) for s in (-1.0, 1.0)]
        below, above = beside
        if at is None or below is None or above is None:
            return None
        slope = (above.evidence - below.evidence) / (2.0 * _BESIDE)
        bend = -(above.evidence - 2.0 * at.evidence + below.evidence) / _BESIDE**2
        step = slope / bend if bend > 0.0 else np.sign(slope) * _LONGEST
        if abs(step) <= _BESIDE or not 0.02 < ratio < 1.0:
            break
        ratio = float(np.clip(ratio + np.clip(step, -_LONGEST, _LONGEST), 0.02, 1.0))
        at = sequence.tried(scans, ratio, like)
    assert at is not None
    sigma = max(float(max(bend, 1e-9) ** -0.5), _LEAST_SIGMA)
    top = float(np.clip(ratio + np.clip(step, -_BESIDE, _BESIDE), 0.0, 1.0))
    return _candidate(scans, top, sigma), at.evidence + 0.5 * float(np.log(2.0 * np.pi)) + float(np.log(sigma))


def _candidate(scans: Scans, ratio: float, sigma: float) -> Candidate:
    return Candidate(scans=scans, probability=0.0, ratio=ratio, sigma=sigma, delay=0.0, delay_sigma=0.0)
