"""What the cameras of a rig did, from matches alone: motion, readout ratio, scans, delay, disparity offset.

The hypotheses are data: how each of the two cameras reads (all lines at once, or from one of the four sides: 25
scans), how the rig moves (``hypotheses.MODELS``), and whether the right camera is late. Each is fitted by maximum
likelihood with heavy tails, and they are compared by their evidence: the likelihood integrated over the unknowns
(Laplace's approximation) times the prior probability. Ratio, scans and motion model are estimated together,
because a ratio under the wrong motion model is wrong by many of its own standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from rsbench.capture.calibration import NO_ERRORS, OFFSET
from rsbench.capture.hypotheses import CALIBRATION, DELAY, GLOBAL, Hypothesis, Known, Scans
from rsbench.capture.hypothesis_ranking import (
    Peak,
    WindowEvidence,
    find_lag,
    find_start,
    window_evidence,
    without_leaps,
)
from rsbench.core.correspondences import Correspondences, join_stereo, temporal_pairs
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions

CERTAIN = 0.95
"""Probability of what is told."""
MAX_SIGMA = 0.015
"""Standard deviation, at most, of a readout ratio that is told: 0.03 is then two of them."""
FEWEST = 30
"""Matches between two times."""
_LEAST_SHARE = 0.3
"""Of the matches, that must agree with what is told."""
_NEARLY, _SMALL = 0.06, 0.15
"""Readout ratio of nearly a global shutter, within two deviations; and the root mean square, at most, of
the ratios that the matches then allow."""
_STILL_PX = 1.0
_UNLIKELY = 0.01
_EXPECTED = {"top": 0.5, "global": 0.25, "bottom": 0.1, "left": 0.04, "right": 0.04}
"""Probability, before matches are seen, of cameras that read alike, by where they begin."""
_APART, _ONE_GLOBAL = 0.06, 0.01
"""Probability of cameras that roll in different ways, and of one camera that rolls beside one that does not."""
_LATE = 0.2
"""Probability, before matches are seen, that the right camera is late."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """How the cameras may read, and what follows from it."""

    scans: Scans
    probability: float
    ratio: float
    sigma: float
    delay: float
    delay_sigma: float
    calibration: tuple[float, ...] = NO_ERRORS
    """What the calibration is wrong by, see ``calibration.TERMS``."""
    calibration_sigma: tuple[float, ...] = NO_ERRORS


@dataclass(frozen=True, kw_only=True, eq=False)
class Capture:
    """What matches say of the shutters and the motion of a rig."""

    candidates: tuple[Candidate, ...]
    """The most probable first; those below one in a hundred are left out."""
    models: Mapping[str, float]
    """Probability of each motion model, the most probable first."""
    peaks: Mapping[str, Peak]
    """Of each motion model under the most probable scans: of the last window, where there are several."""
    reason: str
    """Why it cannot be told; empty where it is."""
    named: bool
    """Whether it is known which camera rolls and from where, though perhaps not how fast."""
    windows: int
    """Pairs of times that it rests on."""
    matches: int
    used: int
    noise_px: float
    moved_px: float
    """Median distance that a match moves between the times."""

    @property
    def told(self) -> bool:
        """Whether the scans and their ratio are known."""
        return not self.reason

    @property
    def likeliest(self) -> Candidate | None:
        """The most probable candidate, told or not."""
        return self.candidates[0] if self.candidates else None

    @property
    def offset(self) -> float:
        """px by which disparities are too large, under the most probable candidate."""
        return self.calibration[OFFSET]

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of ``offset``."""
        return 0.0 if self.likeliest is None else self.likeliest.calibration_sigma[OFFSET]

    @property
    def calibration(self) -> tuple[float, ...]:
        """What the calibration is wrong by, under the most probable candidate."""
        return NO_ERRORS if self.likeliest is None else self.likeliest.calibration

    @property
    def motion_model(self) -> str:
        """The most probable one; empty where there is none."""
        return next(iter(self.models), "")


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The matches of two successive times, judged under each hypothesis."""

    evidence: WindowEvidence | None
    reason: str
    """Why there is none."""
    matches: int
    moved_px: float


def examine(
    matches: Correspondences,
    rig: StereoRig,
    known: Known | None = None,
    options: RobustOptions | None = None,
    seed: int = 0,
    start: Motion | None = None,
) -> Window:
    """The matches of two times, with outliers; left-right matches are joined where there are no tracks.

    Args:
        start: a motion near theirs, of any model; None has it looked for.
    """
    known, options = known or Known(), options or RobustOptions()
    if len(matches.tracks) == 0 and len(matches.stereo_0) + len(matches.stereo_1) > 0:
        matches = join_stereo(matches).correspondences
    pairs = np.concatenate([temporal_pairs(matches, side) for side in SIDES])
    count = len(pairs) - len(matches.tracks)
    moved = float(np.median(np.linalg.norm(pairs[:, 2:] - pairs[:, :2], axis=1))) if len(pairs) else 0.0
    if count < FEWEST:
        reason = f"{count} matches between two times, need {FEWEST}"
        return Window(evidence=None, reason=reason, matches=count, moved_px=moved)
    if start is None:
        found, lag = find_start(matches, rig, known, options, seed)
        if found is None:
            return Window(evidence=None, reason="no motion explains the matches", matches=count, moved_px=moved)
        motion = (found.estimate.w, found.estimate.d)
    else:
        motion, lag = (start.w, start.d), find_lag(matches.tracks, rig)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        evidence = window_evidence(without_leaps(matches, rig), rig, known, motion, lag)
    reason = "too few matches agree with any motion" if evidence is None else ""
    return Window(evidence=evidence, reason=reason, matches=count, moved_px=moved)


def conclude(windows: Sequence[Window], max_sigma: float = MAX_SIGMA) -> Capture:
    """What all windows of one rig say together, at least one.

    Args:
        max_sigma: standard deviation, at most, of a readout ratio that is told.
    """
    used = [window.evidence for window in windows if window.evidence is not None]
    moved = float(np.median([window.moved_px for window in windows]))
    matches = sum(window.matches for window in windows)
    if not used:
        return _nothing(windows[0].reason, matches, moved)
    sums = _combined(used)
    logs = {key: _log_prior(key) + each.log_evidence for key, each in sums.items()}
    total = scipy.special.logsumexp(list(logs.values()))
    shares = {key: float(np.exp(value - total)) for key, value in logs.items()}
    scans = dict.fromkeys(key.scans for key in sums)
    candidates = sorted((_candidate(each, sums, shares) for each in scans), key=lambda each: -each.probability)
    kept = sum(window.used for window in used)
    share = kept / sum(window.of for window in used)
    likely = sorted((key for key in sums if key.scans == candidates[0].scans), key=lambda key: shares[key])
    return Capture(
        candidates=tuple(each for each in candidates if each.probability >= _UNLIKELY),
        models=_shares_by(shares, lambda key: key.motion_model),
        peaks={key.motion_model: sums[key].last for key in likely},
        reason=_doubt(candidates, share, moved, max_sigma),
        named=share >= _LEAST_SHARE and candidates[0].probability >= CERTAIN,
        windows=len(used),
        matches=matches,
        used=kept,
        noise_px=float(np.median([window.noise_px for window in used])),
        moved_px=moved,
    )


def nearly_global(capture: Capture) -> tuple[Candidate, ...] | None:
    """The candidates with a global shutter first, where all that the matches allow is one or nearly one.

    Whatever side it begins at: errors of a calibration are taken for small differences of times, and no camera has
    a readout that short. None where the matches allow more, or a global shutter alone.
    """
    near = [each for each in capture.candidates if each.ratio - 2.0 * each.sigma <= _NEARLY]
    probability = sum(each.probability for each in near)
    if not near or probability < CERTAIN or all(each.scans == GLOBAL for each in near):
        return None
    sigma = float(np.sqrt(sum(each.probability * (each.ratio**2 + each.sigma**2) for each in near) / probability))
    still = Candidate(scans=GLOBAL, probability=probability, ratio=0.0, sigma=sigma, delay=0.0, delay_sigma=0.0)
    return None if sigma > _SMALL else (still, *(each for each in capture.candidates if each not in near))


def _nothing(reason: str, matches: int, moved_px: float) -> Capture:
    return Capture(
        candidates=(),
        models={},
        peaks={},
        reason=reason,
        named=False,
        windows=0,
        matches=matches,
        used=0,
        noise_px=float("nan"),
        moved_px=moved_px,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sum:
    """One hypothesis in all windows of a rig."""

    log_evidence: float
    at: float
    sigma: float
    mean: FloatArray
    """(17,) of the unknowns; of delay and calibration, which the windows share."""
    sigmas: FloatArray
    last: Peak


def _combined(windows: Sequence[WindowEvidence]) -> dict[Hypothesis, _Sum]:
    """The peaks of several windows of one rig, multiplied; their scatter counts where they say less."""
    keys = dict.fromkeys(key for window in windows for key in window.peaks)
    out = {}
    for key in keys:
        peaks = [window.peaks[key] for window in windows if key in window.peaks]
        lost = sum(window.lost for window in windows if key not in window.peaks)
        out[key] = _product(peaks, lost)
    return out


def _product(peaks: Sequence[Peak], lost: float) -> _Sum:
    at, information = peaks[0].at, peaks[0].information
    if len(peaks) > 1 and information > 0.0:
        weights, places = np.array([peak.information for peak in peaks]), np.array([peak.at for peak in peaks])
        information = float(np.sum(weights))
        at = float(weights @ places) / information
        scatter = float(weights @ (places - at) ** 2)
        lost += 0.5 * scatter
        information /= max(scatter / (len(peaks) - 1), 1.0)
    whole = Peak(
        value=sum(peak.value for peak in peaks) - lost,
        at=at,
        information=information,
        fit=peaks[-1].fit,
        trade=peaks[-1].trade,
    )
    precisions = np.array([np.maximum(peak.fit.sigma, 1e-12) ** -2.0 for peak in peaks])
    values, whole_precision = np.array([peak.fit.unknowns for peak in peaks]), np.sum(precisions, axis=0)
    mean = np.sum(precisions * values, axis=0) / whole_precision
    scatter = np.sum(precisions * (values - mean) ** 2, axis=0) / max(len(peaks) - 1, 1)
    sigmas = np.sqrt(np.maximum(scatter, 1.0) / whole_precision)
    return _Sum(
        log_evidence=whole.log_evidence,
        at=at,
        sigma=whole.sigma,
        mean=mean,
        sigmas=np.where(peaks[0].fit.sigma > 0.0, sigmas, 0.0),
        last=peaks[-1],
    )


def _log_prior(key: Hypothesis) -> float:
    """Of how the cameras read; motion models are equally likely."""
    late, scans = _LATE if key.delayed else 1.0 - _LATE, key.scans
    if scans.together:
        return float(np.log(_EXPECTED[scans.left] * late))
    one_global = "global" in (scans.left, scans.right)
    return float(np.log((_ONE_GLOBAL / 8.0 if one_global else _APART / 12.0) * late))


def _shares_by(shares: Mapping[Hypothesis, float], of: Callable[[Hypothesis], str]) -> dict[str, float]:
    """Sums of probabilities by a property, the largest first."""
    names = dict.fromkeys(map(of, shares))
    sums = {name: sum(share for key, share in shares.items() if of(key) == name) for name in names}
    return dict(sorted(sums.items(), key=lambda each: -each[1]))


def _candidate(scans: Scans, sums: Mapping[Hypothesis, _Sum], shares: Mapping[Hypothesis, float]) -> Candidate:
    """The scans under all motion models: mean and deviation of the mixture."""
    keys = [key for key in sums if key.scans == scans]
    weights = np.array([shares[key] for key in keys])
    probability = float(np.sum(weights))
    weights = weights / probability if probability > 0.0 else np.full(len(keys), 1.0 / len(keys))
    ratio, sigma = _mixture(weights, [(sums[key].at, sums[key].sigma) for key in keys])
    delay, delay_sigma = _mixture(weights, [(sums[key].mean[DELAY], sums[key].sigmas[DELAY]) for key in keys])
    errors, errors_sigma = _mixture(
        weights, [(sums[key].mean[CALIBRATION], sums[key].sigmas[CALIBRATION]) for key in keys]
    )
    return Candidate(
        scans=scans,
        probability=probability,
        ratio=float(np.clip(ratio, 0.0, 1.0)),
        sigma=float(sigma),
        delay=float(delay),
        delay_sigma=float(delay_sigma),
        calibration=tuple(errors.tolist()),
        calibration_sigma=tuple(errors_sigma.tolist()),
    )


def _mixture(weights: FloatArray, parts: Sequence[tuple[Any, Any]]) -> tuple[FloatArray, FloatArray]:
    """Means and deviations (...), of those of the parts."""
    means, sigmas = np.moveaxis(np.array(parts), 1, 0)
    mean = np.asarray(weights @ means)
    return mean, np.sqrt(weights @ (sigmas**2 + (means - mean) ** 2))


def _doubt(candidates: Sequence[Candidate], share: float, moved_px: float, max_sigma: float) -> str:
    """Why the best candidate cannot be told; empty where it can."""
    best = candidates[0]
    if share < _LEAST_SHARE:
        return f"only {share:.0%} of the matches agree with any motion and shutter"
    if best.probability >= CERTAIN and best.sigma <= max_sigma:
        return ""
    still = f"; matches move by {moved_px:.1f} px only" if moved_px < _STILL_PX else ""
    if best.probability >= CERTAIN:
        ratio = f"{best.ratio:.2f} +- {best.sigma:.2f}"
        return f"{best.scans}, but the matches do not determine how fast: {ratio}{still}"
    allowed = [f"{each.scans} ({each.probability:.0%})" for each in candidates if each.probability > 0.1]
    return f"the matches allow {', or '.join(allowed) or 'many scans'}{still}"
