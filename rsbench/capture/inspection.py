"""Which camera of a rig rolls, from which side of the image and how fast: from matches alone.

Each of the two cameras may read all lines at once, or begin at one of the four sides: 25 readings. Each is fitted
by maximum likelihood (``reading_fit``): the motion of the rig, the readout ratio, and by how much the right camera
is late. What the matches prefer is said with its probability: the likelihood of a reading, integrated over its
parameters (Laplace's approximation), times what was expected before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from rsbench.capture.reading_evidence import Hypothesis, Peak, WindowEvidence, combined, window_evidence
from rsbench.capture.reading_start import find_start
from rsbench.capture.scan_reading import GLOBAL, READINGS, Reading
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.core.track_building import join_stereo
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver

CERTAIN = 0.95
"""Probability of a reading that is told."""
MAX_SIGMA = 0.015
"""Standard deviation, at most, of a readout ratio that is told: 0.03 is then two of them."""
FEWEST = 30
"""Matches between two times."""
_LEAST_SHARE = 0.3
"""Of the matches, that must agree with what is told."""
_STILL_PX = 1.0
MODELS = ("linear", "twist")
"""Motion models that are tried."""
_UNLIKELY = 0.01
_EXPECTED = {"global": 0.25, "together": 0.5, "apart": 0.25}
"""Probability, before matches are seen, of a global shutter, of cameras that roll alike, and that do not."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One reading that the matches allow."""

    reading: Reading
    probability: float
    ratio: float
    sigma: float
    delay: float
    delay_sigma: float


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """What matches say of the shutters of a rig."""

    candidates: tuple[Candidate, ...]
    """The most probable first; those below one in a hundred are left out."""
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
    motion_model: str
    """The most probable one."""

    @property
    def told(self) -> bool:
        """Whether the reading and its ratio are known."""
        return not self.reason

    @property
    def best(self) -> Candidate | None:
        """The most probable reading, told or not."""
        return self.candidates[0] if self.candidates else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The matches of two successive times, judged under each motion model."""

    evidence: WindowEvidence | None
    reason: str
    """Why there is none."""
    matches: int
    moved_px: float


def inspect_window(
    matches: Correspondences,
    rig: StereoRig,
    options: RobustOptions | None = None,
    models: Sequence[str] = MODELS,
    seed: int = 0,
) -> Window:
    """The matches of two times, with outliers; left-right matches are joined where there are no tracks."""
    options = options or RobustOptions()
    if len(matches.tracks) == 0 and len(matches.stereo_0) + len(matches.stereo_1) > 0:
        matches = join_stereo(matches).correspondences
    pairs = np.concatenate([temporal_pairs(matches, side) for side in SIDES])
    count = len(pairs) - len(matches.tracks)
    moved = float(np.median(np.linalg.norm(pairs[:, 2:] - pairs[:, :2], axis=1))) if len(pairs) else 0.0
    if count < FEWEST:
        return Window(
            evidence=None,
            reason=f"{count} matches between two times, need {FEWEST}",
            matches=count,
            moved_px=moved,
        )
    start, lag = find_start(matches, rig, RefinedSolver(), options, seed)
    if start is None:
        return Window(evidence=None, reason="no motion explains the matches", matches=count, moved_px=moved)
    motion = (start.estimate.w, start.estimate.d)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        evidence = window_evidence(matches, rig, models, motion, lag)
    reason = "too few matches agree with any motion" if evidence is None else ""
    return Window(evidence=evidence, reason=reason, matches=count, moved_px=moved)


def conclude(windows: Sequence[Window], max_sigma: float = MAX_SIGMA) -> Inspection:
    """What all windows of one rig say together, at least one.

    Args:
        max_sigma: standard deviation, at most, of a readout ratio that is told.
    """
    used = [window.evidence for window in windows if window.evidence is not None]
    moved = float(np.median([window.moved_px for window in windows]))
    matches = sum(window.matches for window in windows)
    if not used:
        return Inspection(
            candidates=(),
            reason=windows[0].reason,
            named=False,
            windows=0,
            matches=matches,
            used=0,
            noise_px=float("nan"),
            moved_px=moved,
            motion_model="",
        )
    peaks = combined(used)
    logs = {key: _log_prior(key[1]) + peak.log_evidence for key, peak in peaks.items()}
    total = scipy.special.logsumexp(list(logs.values()))
    shares = {key: float(np.exp(value - total)) for key, value in logs.items()}
    candidates = sorted(
        (_candidate(reading, peaks, shares) for reading in READINGS), key=lambda each: -each.probability
    )
    models = sorted({model for model, _ in peaks})
    kept = sum(window.used for window in used)
    share = kept / sum(window.of for window in used)
    return Inspection(
        candidates=tuple(each for each in candidates if each.probability >= _UNLIKELY),
        reason=_doubt(candidates, share, moved, max_sigma),
        named=share >= _LEAST_SHARE and candidates[0].probability >= CERTAIN,
        windows=len(used),
        matches=matches,
        used=kept,
        noise_px=float(np.median([window.noise_px for window in used])),
        moved_px=moved,
        motion_model=max(models, key=lambda name: sum(shares[name, reading] for reading in READINGS)),
    )


def _log_prior(reading: Reading) -> float:
    if reading == GLOBAL:
        return float(np.log(_EXPECTED["global"]))
    alike = [each for each in READINGS if each.rolls and each.together == reading.together]
    return float(np.log(_EXPECTED["together" if reading.together else "apart"] / len(alike)))


def _candidate(reading: Reading, peaks: dict[Hypothesis, Peak], shares: dict[Hypothesis, float]) -> Candidate:
    """One reading under all motion models: mean and deviation of the mixture."""
    keys = [key for key in peaks if key[1] == reading]
    weights = np.array([shares[key] for key in keys])
    probability = float(np.sum(weights))
    weights = weights / probability if probability > 0.0 else np.full(len(keys), 1.0 / len(keys))
    ratio, sigma = _mixture(weights, [(peaks[key].at, peaks[key].sigma) for key in keys])
    delay, delay_sigma = _mixture(weights, [(peaks[key].delay, peaks[key].delay_sigma) for key in keys])
    return Candidate(
        reading=reading,
        probability=probability,
        ratio=float(np.clip(ratio, 0.0, 1.0)),
        sigma=sigma,
        delay=delay,
        delay_sigma=delay_sigma,
    )


def _mixture(weights: FloatArray, parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Mean and deviation, of means and deviations."""
    means, sigmas = np.array(parts).T
    mean = float(weights @ means)
    return mean, float(np.sqrt(weights @ (sigmas**2 + (means - mean) ** 2)))


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
        return f"{best.reading}, but the matches do not determine how fast: {ratio}{still}"
    allowed = [f"{each.reading} ({each.probability:.0%})" for each in candidates if each.probability > 0.1]
    return f"the matches allow {', or '.join(allowed) or 'many readings'}{still}"
