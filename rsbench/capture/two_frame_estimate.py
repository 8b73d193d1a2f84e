"""Estimate motion, readout ratio, scans, delay and disparity offset of a rig from matches alone.

A hypothesis says how each of the two cameras reads (all lines at once, or from one of the four sides: 25 scans),
how the rig moves (``hypotheses.MODELS``), and whether the right camera is delayed. ``examine`` fits each by
maximum likelihood with heavy tails; ``conclude`` compares them by their evidence: the likelihood integrated over
the unknowns (Laplace's approximation) times the prior probability. Ratio, scans and motion model are estimated
jointly, because a ratio under the wrong motion model is wrong by many of its standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
"""Least probability of a candidate that counts as determined."""
MAX_SIGMA = 0.015
"""Largest standard deviation of a determined readout ratio, so that two of them are 0.03."""
FEWEST = 30
"""Fewest matches between two frame times."""
_LEAST_SHARE = 0.3
"""Least share of inliers among the matches for a determined shutter."""
_NEARLY, _SMALL = 0.06, 0.15
"""Largest ratio, minus two standard deviations, of a shutter that may be global; and the largest root mean square
of the ratios that the matches allow if it is."""
_STILL_PX = 1.0
_UNLIKELY = 0.01
_EXPECTED = {"top": 0.5, "global": 0.25, "bottom": 0.1, "left": 0.04, "right": 0.04}
"""Prior probability of two cameras with the same scan, by the side at which they begin to read."""
_APART, _ONE_GLOBAL = 0.06, 0.01
"""Prior probability of two rolling cameras with different scans, and of a rolling and a global one."""
_LATE = 0.2
"""Prior probability that the right camera is delayed."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A possible pair of scans, with its probability and the values of the unknowns under it."""

    scans: Scans
    probability: float
    ratio: float
    sigma: float
    delay: float
    delay_sigma: float
    calibration: tuple[float, ...] = NO_ERRORS
    """Calibration errors, see ``calibration.TERMS``."""
    calibration_sigma: tuple[float, ...] = NO_ERRORS


@dataclass(frozen=True, kw_only=True, eq=False)
class Capture:
    """The estimated shutter and motion of a rig, from the matches of one or more windows."""

    candidates: tuple[Candidate, ...] = ()
    """Scans in descending probability, without those below 0.01."""
    models: Mapping[str, float] = field(default_factory=dict)
    """Probability of each motion model, in descending order."""
    peaks: Mapping[str, Peak] = field(default_factory=dict)
    """The peak of each motion model under the most probable scans, in the last window."""
    reason: str
    """Why the shutter is not determined; empty if it is."""
    named: bool = False
    """Whether the scans are determined, even if the readout ratio is not."""
    windows: int = 0
    """Number of windows that were used."""
    matches: int
    used: int = 0
    """Number of inliers among ``matches``."""
    noise_px: float = float("nan")
    moved_px: float
    """Median displacement of the matches between the frame times, px."""

    @property
    def determined(self) -> bool:
        """Whether the scans and their ratio are determined."""
        return not self.reason

    @property
    def likeliest(self) -> Candidate | None:
        """The most probable candidate, determined or not."""
        return self.candidates[0] if self.candidates else None

    @property
    def offset(self) -> float:
        """Excess of the disparities, px, under the most probable candidate."""
        return self.calibration[OFFSET]

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of ``offset``."""
        return 0.0 if self.likeliest is None else self.likeliest.calibration_sigma[OFFSET]

    @property
    def calibration(self) -> tuple[float, ...]:
        """Calibration errors under the most probable candidate."""
        return NO_ERRORS if self.likeliest is None else self.likeliest.calibration

    @property
    def motion_model(self) -> str:
        """The most probable motion model; empty if none was estimated."""
        return next(iter(self.models), "")


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The result for the matches of two successive frame times."""

    evidence: WindowEvidence | None = None
    reason: str
    """Why ``evidence`` is None."""
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
    """Fit all hypotheses to the matches of two frame times, with outliers.

    Left-right matches are joined to tracks if there are no tracks.

    Args:
        start: a motion near the true one, of any model; None: a robust search finds one.
    """
    known, options = known or Known(), options or RobustOptions()
    if len(matches.tracks) == 0 and len(matches.stereo_0) + len(matches.stereo_1) > 0:
        matches = join_stereo(matches).correspondences
    pairs = np.concatenate([temporal_pairs(matches, side) for side in SIDES])
    count = len(pairs) - len(matches.tracks)
    moved = float(np.median(np.linalg.norm(pairs[:, 2:] - pairs[:, :2], axis=1))) if len(pairs) else 0.0
    if count < FEWEST:
        return Window(reason=f"{count} matches between two times, need {FEWEST}", matches=count, moved_px=moved)
    if start is None:
        found, lag = find_start(matches, rig, known, options, seed)
        if found is None:
            return Window(reason="no motion explains the matches", matches=count, moved_px=moved)
        motion = (found.estimate.w, found.estimate.d)
    else:
        motion, lag = (start.w, start.d), find_lag(matches.tracks, rig)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        evidence = window_evidence(without_leaps(matches, rig), rig, known, motion, lag)
    reason = "too few matches agree with any motion" if evidence is None else ""
    return Window(evidence=evidence, reason=reason, matches=count, moved_px=moved)


def conclude(windows: Sequence[Window], max_sigma: float = MAX_SIGMA, *, under_laws: bool = False) -> Capture:
    """Combine the windows of one rig, at least one, to an estimate.

    Args:
        max_sigma: largest standard deviation of a determined readout ratio.
        under_laws: whether windows whose rows contradict every motion model count for the ratio too.
    """
    used = [window.evidence for window in windows if window.evidence is not None]
    used = [each.of_any_ratio if each.contradicted and not under_laws else each for each in used]
    moved = float(np.median([window.moved_px for window in windows]))
    matches = sum(window.matches for window in windows)
    if not used:
        return Capture(reason=windows[0].reason, matches=matches, moved_px=moved)
    sums = _combined(used)
    logs = {key: _log_prior(key) + each.log_evidence for key, each in sums.items()}
    total = scipy.special.logsumexp(list(logs.values()))
    shares = {key: float(np.exp(value - total)) for key, value in logs.items()}
    scans = dict.fromkeys(key.scans for key in sums)
    candidates = sorted((_candidate(each, sums, shares) for each in scans), key=lambda each: -each.probability)
    kept = sum(window.used for window in used)
    share = kept / sum(window.total for window in used)
    likely = sorted((key for key in sums if key.scans == candidates[0].scans), key=lambda key: shares[key])
    names = dict.fromkeys(key.motion_model for key in shares)
    models = {name: sum(p for key, p in shares.items() if key.motion_model == name) for name in names}
    return Capture(
        candidates=tuple(each for each in candidates if each.probability >= _UNLIKELY),
        models=dict(sorted(models.items(), key=lambda each: -each[1])),
        peaks={key.motion_model: sums[key].last for key in likely},
        reason=_doubt(candidates, share, moved, max_sigma, all(each.contradicted for each in used)),
        named=share >= _LEAST_SHARE and candidates[0].probability >= CERTAIN,
        windows=len(used),
        matches=matches,
        used=kept,
        noise_px=float(np.median([window.noise_px for window in used])),
        moved_px=moved,
    )


def nearly_global(capture: Capture) -> tuple[Candidate, ...] | None:
    """If the matches allow only (nearly) global shutters, the candidates with these merged to one global shutter.

    Scans with small ratios from any side are merged: calibration errors resemble small time differences, and no
    camera reads that fast. None if the matches allow larger ratios, or already allow only a global shutter.
    """
    near = [each for each in capture.candidates if each.ratio - 2.0 * each.sigma <= _NEARLY]
    probability = sum(each.probability for each in near)
    if not near or probability < CERTAIN or all(each.scans == GLOBAL for each in near):
        return None
    sigma = float(np.sqrt(sum(each.probability * (each.ratio**2 + each.sigma**2) for each in near) / probability))
    still = Candidate(scans=GLOBAL, probability=probability, ratio=0.0, sigma=sigma, delay=0.0, delay_sigma=0.0)
    return None if sigma > _SMALL else (still, *(each for each in capture.candidates if each not in near))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sum:
    """One hypothesis, combined over all windows of a rig."""

    log_evidence: float
    at: float
    sigma: float
    mean: FloatArray
    """(17,) weighted mean of the unknowns; it is used for delay and calibration, which the windows share."""
    sigmas: FloatArray
    last: Peak


def _combined(windows: Sequence[WindowEvidence]) -> dict[Hypothesis, _Sum]:
    """Multiply the likelihoods of several windows of one rig, for each hypothesis."""
    out = {}
    for key in dict.fromkeys(key for window in windows for key in window.peaks):
        peaks = [window.peaks[key] for window in windows if key in window.peaks]
        out[key] = _product(peaks, sum(window.lost for window in windows if key not in window.peaks))
    return out


def _product(peaks: Sequence[Peak], lost: float) -> _Sum:
    """Multiply the peaks of several windows; scatter beyond their standard deviations widens the result."""
    at, information = peaks[0].at, peaks[0].information
    if len(peaks) > 1 and information > 0.0:
        weights, places = np.array([peak.information for peak in peaks]), np.array([peak.at for peak in peaks])
        information = float(np.sum(weights))
        at = float(weights @ places) / information
        scatter = float(weights @ (places - at) ** 2)
        lost += 0.5 * scatter
        information /= max(scatter / (len(peaks) - 1), 1.0)
    value = sum(peak.value for peak in peaks) - lost
    whole = replace(peaks[-1], value=value, at=at, information=information)
    precisions = np.array([np.maximum(peak.fit.sigma, 1e-12) ** -2.0 for peak in peaks])
    values, whole_precision = np.array([peak.fit.unknowns for peak in peaks]), np.sum(precisions, axis=0)
    mean = np.sum(precisions * values, axis=0) / whole_precision
    scatter = np.sum(precisions * (values - mean) ** 2, axis=0) / max(len(peaks) - 1, 1)
    sigmas = np.where(peaks[0].fit.sigma > 0.0, np.sqrt(np.maximum(scatter, 1.0) / whole_precision), 0.0)
    evidence = whole.log_evidence
    return _Sum(log_evidence=evidence, at=at, sigma=whole.sigma, mean=mean, sigmas=sigmas, last=peaks[-1])


def _log_prior(key: Hypothesis) -> float:
    """Log prior probability of a hypothesis's scans and delay; all motion models are equally probable."""
    late, scans = _LATE if key.delayed else 1.0 - _LATE, key.scans
    if scans.together:
        return float(np.log(_EXPECTED[scans.left] * late))
    one_global = "global" in (scans.left, scans.right)
    return float(np.log((_ONE_GLOBAL / 8.0 if one_global else _APART / 12.0) * late))


def _candidate(scans: Scans, sums: Mapping[Hypothesis, _Sum], shares: Mapping[Hypothesis, float]) -> Candidate:
    """The candidate for given scans, with mean and standard deviation of the mixture over motion models."""
    keys = [key for key in sums if key.scans == scans]
    parts, weights = [sums[key] for key in keys], np.array([shares[key] for key in keys])
    probability = float(np.sum(weights))
    weights = weights / probability if probability > 0.0 else np.full(len(keys), 1.0 / len(keys))
    ratio, sigma = _mixture(weights, [(each.at, each.sigma) for each in parts])
    delay, delay_sigma = _mixture(weights, [(each.mean[DELAY], each.sigmas[DELAY]) for each in parts])
    errors, errors_sigma = _mixture(
        weights, [(each.mean[CALIBRATION], each.sigmas[CALIBRATION]) for each in parts]
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
    """Mean and standard deviation (...) of a mixture of parts with given means and standard deviations."""
    means, sigmas = np.moveaxis(np.array(parts), 1, 0)
    mean = np.asarray(weights @ means)
    return mean, np.sqrt(weights @ (sigmas**2 + (means - mean) ** 2))


def _doubt(
    candidates: Sequence[Candidate], share: float, moved_px: float, max_sigma: float, contradicted: bool
) -> str:
    """Text on why the best candidate is not determined; empty if it is."""
    best = candidates[0]
    if share < _LEAST_SHARE:
        return f"only {share:.0%} of the matches agree with any motion and shutter"
    if best.probability >= CERTAIN and best.sigma <= max_sigma:
        return ""
    still = f"; matches move by {moved_px:.1f} px only" if moved_px < _STILL_PX else ""
    if best.probability >= CERTAIN:
        if contradicted:
            return f"{best.scans}, but no motion model holds for all rows, so that any ratio is as likely{still}"
        ratio = f"{best.ratio:.2f} +- {best.sigma:.2f}"
        return f"{best.scans}, but the matches do not determine the readout ratio: {ratio}{still}"
    allowed = [f"{each.scans} ({each.probability:.0%})" for each in candidates if each.probability > 0.1]
    return f"the matches allow {', or '.join(allowed) or 'many scans'}{still}"
