"""Which motion model the matches of two frames prefer, how sure that is, and what the choice does to d.

All models are equally likely beforehand, and so are the presets of a spline; the rest is the evidence of the
matches, by Laplace's approximation, at one scale of the errors: that of the model which fits best. (D. MacKay,
Bayesian interpolation, Neural Computation 1992.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from rsbench.capture.model_fit import ACCELERATION_SIGMA, CANDIDATES, Errors, ModelFit, dispersion, fit_model
from rsbench.components.cards import choices
from rsbench.components.motion_models import make_motion
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.track_building import join_stereo
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.registry import SolverEntry
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

AUTO = "auto"
MODELS = tuple(dict.fromkeys(candidate.name for candidate in CANDIDATES))
_SURE = 0.95
"""Probability from which a model is found; one that has less than the rest of it is excluded."""
_HOPELESS = 50.0
"""Log-evidence behind the best from which a fit is not repeated at the common scale, where it is only worse."""
_CELLS = 8
"""Cells across the image within which matches may err together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelChoice:
    """What the matches say about the motion model."""

    used: str
    motion: Motion
    """Of the model used: its most probable parameters."""
    covariance: FloatArray
    """(6, 6) of its w and d, whatever its own parameters are."""
    probability: dict[str, float]
    """Of each of ``MODELS``, the most probable first."""
    decided: bool
    """Whether the first of them is beyond doubt."""
    rival: str
    """The most probable one of the others."""
    d_angle_deg: float
    """Between the d of the model used and that of the rival."""
    d_length_percent: float
    """By how much the rival's d is longer."""
    acceleration: float
    """k of the accelerated model, if it is that."""
    acceleration_sigma: float

    def record(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {
            "text": str(self),
            "used": self.used,
            "decided": self.decided,
            "probability": self.probability,
            "rival": self.rival,
            "d_angle_to_rival_deg": self.d_angle_deg,
            "d_length_of_rival_percent": self.d_length_percent,
            "acceleration": self.acceleration,
            "acceleration_sigma": self.acceleration_sigma,
        }

    def __str__(self) -> str:
        likely = [(name, p) for name, p in self.probability.items() if p >= 0.001][:3]
        shares = ", ".join(f"{name} {_percent(p)}" for name, p in likely)
        change = f"with {self.rival} d turns by {self.d_angle_deg:.2g} deg and its length changes by "
        change += f"{self.d_length_percent:+.2g} %"
        head = self.used if self.decided else f"cannot tell, so {self.used} is used"
        return f"{head} ({shares}); {change}{self._open()}"

    def _open(self) -> str:
        if self.acceleration_sigma <= 0.5 * ACCELERATION_SIGMA:
            return ""
        return "; the matches do not determine an acceleration"


def choose_model(
    correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, start: Motion, asked: str = AUTO
) -> ModelChoice:
    """The motion model that matches with outliers prefer.

    Args:
        start: a motion near theirs, of any model.
        asked: a model that is used whatever they prefer.
    """
    if len(correspondences.tracks) == 0:
        correspondences = join_stereo(correspondences).correspondences
    fits, spread = _fits(Errors(correspondences, rig, shutter, start), start, rig)
    evidence = {
        name: float(scipy.special.logsumexp(found) - np.log(len(found)))
        for name in MODELS
        for found in [[fit.log_evidence(spread) for fit in fits if fit.candidate.name == name]]
    }
    total = scipy.special.logsumexp(list(evidence.values()))
    probability = {
        name: float(np.exp(evidence[name] - total)) for name in sorted(MODELS, key=lambda n: -evidence[n])
    }
    best, second = list(probability)[:2]
    used = preferred(probability) if asked == AUTO else asked
    rival = second if used == best else best
    chosen, other = (_likeliest(fits, name, spread) for name in (used, rival))
    accelerated = _likeliest(fits, "accelerated", spread)
    d, d_rival = chosen.motion.d, other.motion.d
    longer = float(np.linalg.norm(d_rival)) / max(float(np.linalg.norm(d)), 1e-12) - 1.0
    return ModelChoice(
        used=used,
        motion=chosen.motion,
        covariance=chosen.covariance(spread)[:6, :6],
        probability=probability,
        decided=used == best and probability[best] >= _SURE,
        rival=rival,
        d_angle_deg=float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(d, d_rival)), d @ d_rival))),
        d_length_percent=100.0 * longer,
        acceleration=float(accelerated.phi[6]),
        acceleration_sigma=float(np.sqrt(accelerated.covariance(spread)[6, 6])),
    )


def preferred(probability: dict[str, float]) -> str:
    """The model to use: the one found, else linear, the paper's, unless it is excluded itself."""
    best = max(probability, key=lambda name: probability[name])
    undecided = probability[best] < _SURE and probability["linear"] > 1.0 - _SURE
    return "linear" if undecided else best


def _fits(errors: Errors, start: Motion, rig: StereoRig) -> tuple[list[ModelFit], float]:
    """Every candidate at the scale of the best one, and the dispersion that the best one leaves."""
    phi, fits = np.concatenate([start.w, start.d]), list[ModelFit]()
    for candidate in CANDIDATES:
        fits.append(fit_model(errors, candidate, np.concatenate([phi, np.zeros(len(candidate.sigma))])))
    evidence = [fit.log_evidence(1.0) for fit in fits]
    best = fits[int(np.argmax(evidence))]
    for k, fit in enumerate(fits):
        if evidence[k] > max(evidence) - _HOPELESS and fit is not best:
            fits[k] = fit_model(errors, fit.candidate, fit.phi, best.scale_px)
    return fits, dispersion(best, rig.camera.width / _CELLS)


def _likeliest(fits: Sequence[ModelFit], name: str, spread: float) -> ModelFit:
    """Of the candidates of one model."""
    return max((fit for fit in fits if fit.candidate.name == name), key=lambda fit: fit.log_evidence(spread))


def check_asked(asked: str, entry: SolverEntry) -> None:
    """Raises RsbenchError when there is no such model to ask for, or the solver cannot take another one."""
    known = (AUTO, *MODELS)
    if asked not in known:
        raise RsbenchError(f"--motion-model {asked}: {asked!r} is unknown{choices(asked, known)}")
    solver = entry.solver
    if not isinstance(solver, RefinedSolver) or solver.shutter != "rolling" or solver.one_camera:
        spec = solver.spec
        known_to = f"solver {entry.name!r} knows only {spec.motion_model} motion and a {spec.shutter} shutter"
        known_to += "" if spec.metric else ", without a length"
        raise RsbenchError(f"--motion-model {asked}: {known_to}; take rs-stereo-refined")


def settle_model(
    asked: str,
    robust: RobustEstimate,
    entry: SolverEntry,
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    rng: np.random.Generator,
) -> tuple[RobustEstimate, ModelChoice | None]:
    """A refined solver's answer under the model that the matches prefer (``auto``) or that is asked for.

    A failure stays one, with None, and cameras with a lens or another scan are one. The covariance counts what is
    not known of the model's own parameters.

    Raises:
        RsbenchError: see ``check_asked``.
    """
    check_asked(asked, entry)
    if rig.camera.lens is not None or not shutter.plain:
        why = f"motion_model = {asked!r} takes cameras without a lens that read rows from the top at once"
        nothing = {name: np.zeros_like(mask) for name, mask in robust.inliers.items()}
        return replace(robust, estimate=MotionEstimate.failed(why), inliers=nothing), None
    solver = entry.solver
    assert isinstance(solver, RefinedSolver)
    if not robust.estimate.success:
        return robust, None
    start = make_motion(solver.motion_model, robust.estimate.w, robust.estimate.d, solver.motion_parameters)
    choice = choose_model(correspondences, rig, shutter, start, asked)
    if choice.used == solver.motion_model and not choice.motion.parameters:
        return robust, replace(choice, motion=start)
    estimate = replace(robust.estimate, w=choice.motion.w, d=choice.motion.d, covariance=choice.covariance)
    if choice.used == "spline":  # no kernel: the solver's inliers are those of its own model
        return replace(robust, estimate=estimate), choice
    model = replace(solver, motion_model=choice.used, motion_parameters=choice.motion.parameters)
    again = estimate_motion(correspondences, rig, shutter, model, options, rng, entry.options.robust)
    if not again.estimate.success:
        return replace(robust, estimate=estimate), choice
    motion = choice.motion.with_endpoint(again.estimate.w, again.estimate.d)
    estimate = replace(again.estimate, covariance=choice.covariance)
    return replace(again, estimate=estimate), replace(choice, motion=motion)


def _percent(probability: float) -> str:
    if 0.0005 < probability < 0.9995:
        return f"{100 * probability:.2g} %" if probability < 0.99 else f"{100 * probability:.1f} %"
    return "> 99.9 %" if probability > 0.5 else "< 0.1 %"
