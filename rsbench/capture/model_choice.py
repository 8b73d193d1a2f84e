"""The motion model that a correction uses: the one that the matches support most, or a spline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsbench.capture.hypotheses import ACCELERATION, MODELS
from rsbench.capture.hypothesis_ranking import Peak
from rsbench.capture.two_frame_estimate import CERTAIN, Capture
from rsbench.components.motion_models import load_kernel, make_motion
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import spread_about

AUTO = "auto"
_EQUAL = 0.9
"""Models with at least this share of the largest probability count as equal; the first in ``MODELS`` is used."""
_SAME_DEG, _SAME_PERCENT = 1e-3, 1e-3
"""Motions that differ by less are the same, as those of all models are under a global shutter."""


def compared_models(motion_model: str | None) -> tuple[str, ...]:
    """The motion models to compare: all for ``auto`` or None, otherwise the requested one."""
    return MODELS if motion_model in (None, AUTO) else (str(motion_model),)


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelChoice:
    """The motion model that is used, and how it was chosen."""

    used: str
    parameters: Mapping[str, float]
    """Parameters of the used model besides w and d."""
    probability: Mapping[str, float]
    """Probability of each model that was compared, in descending order."""
    decided: bool
    """Whether the used model has a probability of 0.95 or more."""
    requested: bool = False
    """Whether the used model was given, not chosen by the matches."""
    rival: str
    """The most probable of the other models; empty if none was compared."""
    d_angle_deg: float
    """Angle between the d of the used model and that of the rival."""
    d_length_percent: float
    """How much longer the rival's d is."""
    spread: FloatArray
    """(6, 6) covariance of w and d due to the uncertain ratio, disparity offset and model parameters; if the
    matches chose the model, plus that due to the distance of the other models' motions."""

    def record(self) -> dict[str, Any]:
        """The fields that are written to JSON."""
        return {
            "text": str(self),
            "used": self.used,
            "decided": self.decided,
            "probability": dict(self.probability),
            "rival": self.rival,
            "d_angle_to_rival_deg": self.d_angle_deg,
            "d_length_of_rival_percent": self.d_length_percent,
        }

    def __str__(self) -> str:
        likely = [(name, p) for name, p in list(self.probability.items())[:3] if p >= 0.001]
        shares = ", ".join(f"{name} {100.0 * p:.1f} %" if p <= 0.999 else f"{name} > 99.9 %" for name, p in likely)
        head = self.used if self.decided else f"cannot tell, so {self.used} is used"
        if self.requested:
            head = f"{self.used}, as requested"
        if not self.rival:
            return head
        if self.d_angle_deg < _SAME_DEG and abs(self.d_length_percent) < _SAME_PERCENT:
            return f"{self.used}; the others give the same motion"
        change = f"with {self.rival} d turns by {self.d_angle_deg:.2g} deg and its length changes by "
        return f"{head} ({shares}); {change}{self.d_length_percent:+.2g} %"


def choose_model(capture: Capture, requested: str = AUTO) -> ModelChoice | None:
    """Choose the most probable model, or a requested one; None if no hypothesis was compared.

    ``spread`` of a chosen model includes the distances of the other models' motions, by their probabilities.

    Args:
        requested: ``AUTO``, or a model that is used whatever the matches prefer.
    """
    if requested not in (AUTO, *capture.peaks) or not capture.peaks:
        return None
    probability = {name: p for name, p in capture.models.items() if name in capture.peaks}
    most = max(probability.values())
    best = next(name for name in (*MODELS, *probability) if probability.get(name, 0.0) >= _EQUAL * most)
    used = best if requested == AUTO else requested
    rival = next((name for name in probability if name != used), "")
    motions = {name: motion_at(capture.peaks[name]) for name in probability}
    angle, percent = _translation_difference(motions[used].d, motions[rival or used].d)
    spread = spread_by_unknowns(capture.peaks[used])
    if requested == AUTO:
        values = {name: np.concatenate([each.w, each.d]) for name, each in motions.items()}
        spread = spread + spread_about(values[used], list(probability.values()), np.stack(list(values.values())))
    return ModelChoice(
        used=used,
        parameters=_parameters(capture.peaks[used]),
        probability=probability,
        decided=probability[used] >= CERTAIN,
        requested=requested != AUTO,
        rival=rival,
        d_angle_deg=angle,
        d_length_percent=percent,
        spread=spread,
    )


def spline_choice(
    choice: ModelChoice | None, spline: Motion, law: Motion, probability: float, unique: bool
) -> ModelChoice:
    """The record of a spline with the given probability that is used instead of the motion model ``law``.

    Args:
        unique: whether no other spline explains the matches as well.
    """
    laws = {law.name: 1.0} if choice is None else choice.probability
    angle, percent = _translation_difference(spline.d, law.d)
    return ModelChoice(
        used=spline.name,
        parameters={},
        probability={spline.name: probability, **{name: (1.0 - probability) * p for name, p in laws.items()}},
        decided=unique,
        rival=law.name,
        d_angle_deg=angle,
        d_length_percent=percent,
        spread=np.zeros((6, 6)),
    )


def _translation_difference(d: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Angle between two translations, degrees, and the relative excess length of the second, per cent."""
    angle = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(d, other)), d @ other))
    length = max(float(np.linalg.norm(d)), 1e-12)
    return float(angle), 100.0 * (float(np.linalg.norm(other)) / length - 1.0)


def _parameters(peak: Peak) -> dict[str, float]:
    accelerated = peak.fit.hypothesis.motion_model == "accelerated"
    return {"acceleration": float(peak.fit.unknowns[ACCELERATION])} if accelerated else {}


def motion_at(peak: Peak) -> Motion:
    """The motion of the body, metres, at the best fit of a hypothesis."""
    model = peak.fit.hypothesis.motion_model
    w, d = load_kernel(model, _parameters(peak)).motion(peak.fit.theta)
    return make_motion(model, w, d, _parameters(peak))


def spread_by_unknowns(peak: Peak) -> FloatArray:
    """(6, 6) covariance of w and d that is due to the uncertain ratio and other unknowns."""
    J = load_kernel(peak.fit.hypothesis.motion_model, _parameters(peak)).motion_jacobian(peak.fit.theta)
    slope = J @ peak.trade[:6]
    return np.asarray(J @ peak.fit.spread @ J.T + peak.sigma**2 * np.outer(slope, slope))
