"""What two frames can tell of each motion model's own parameters, by the covariance of the most probable fit.

python benchmarks/model_identifiability.py

Simulated matches with normal errors, the model known. "Before" is what is expected of a motion before a match is
seen: k of ``accelerated`` 0 +- 0.2, shakes of the size of the ``handheld`` preset of ``spline``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.model_fit import CANDIDATES, Candidate, Errors, ModelFit, fit_model
from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
AXIS, DIRECTION = np.array([0.5, 0.8, -0.4]), np.array([-0.6, 0.2, 0.7])
TIMES = np.linspace(0.0, 0.8, 17)
"""Of rows of frame 0."""
_STEP = 1e-4
_NOTHING = 1e-9
"""Information about a combination of parameters, in units of what was known before, that is none."""


def candidate(name: str, label: str = "") -> Candidate:
    return next(each for each in CANDIDATES if each.name == name and each.label == label)


def fitted(chosen: Candidate, degrees: float, metres: float, tracks: int, noise_px: float) -> ModelFit:
    """The fit to matches of a motion of this model, all its own parameters 0."""
    w, d = np.radians(degrees) * AXIS / np.linalg.norm(AXIS), metres * DIRECTION / np.linalg.norm(DIRECTION)
    phi = np.concatenate([w, d, np.zeros(len(chosen.sigma))])
    motion, options = chosen.make(phi), SimulationOptions(tracks=tracks, noise_px=noise_px)
    matches = simulate(RIG, SHUTTER, motion, options, np.random.default_rng(0)).correspondences
    return fit_model(Errors(matches, RIG, SHUTTER, make_motion("linear", w, d)), chosen, phi)


def _words(degrees: float, metres: float, tracks: int, noise_px: float) -> str:
    return f"{degrees:g} deg, {metres:g} m, {tracks} tracks, {noise_px:g} px"


def acceleration(degrees: float, metres: float, tracks: int, noise_px: float) -> str:
    fit = fitted(candidate("accelerated"), degrees, metres, tracks, noise_px)
    free, held = fit.covariance(1.0), np.linalg.inv(fit.curvature[:6, :6])
    worse = np.sqrt(np.trace(free[3:6, 3:6]) / np.trace(held[3:, 3:])) - 1.0
    numbers = [_condition(fit.curvature[:size, :size]) for size in (6, 7)]
    return (
        f"accelerated, {_words(degrees, metres, tracks, noise_px)}: k +- {np.sqrt(free[6, 6]):.4f}"
        f", d worse by {worse:.0%} than with k known; condition {numbers[1]:.0f}, with k known {numbers[0]:.0f}"
    )


def _condition(H: FloatArray) -> float:
    """Of normal equations whose unknowns are scaled to a unit diagonal."""
    scale = np.sqrt(np.diagonal(H))
    return float(np.linalg.cond(H / np.outer(scale, scale)))


def shake(degrees: float, metres: float, tracks: int, noise_px: float) -> Iterator[str]:
    chosen = candidate("spline", "handheld")
    fit = fitted(chosen, degrees, metres, tracks, noise_px)
    sigma, posterior = chosen.sigma, fit.covariance(1.0)
    # What matches say of the shake when w and d are free, in units of what is expected of it.
    H = fit.curvature
    shaken = H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[:6, 6:])
    told = np.linalg.eigvalsh(np.outer(sigma, sigma) * shaken)
    yield (
        f"spline handheld, {_words(degrees, metres, tracks, noise_px)}: of {len(sigma)} parameters "
        f"{np.sum(told > _NOTHING)} combinations matter, {np.sum(told > 1.0)} are better known than before"
    )
    prior = np.zeros_like(posterior)
    prior[6:, 6:] = np.diag(sigma**2)
    for name, rows in (
        ("frame 1 against frame 0", _slopes(fit, _between)),
        ("within frame 0", _slopes(fit, _within)),
    ):
        before, after = (np.sqrt(np.trace(rows @ C @ rows.T) / len(rows)) for C in (prior, posterior))
        line = f"rotation, {name}: before {np.degrees(before):.4f} deg, then {np.degrees(after):.4f} deg"
        yield f"{line}, 1 / {before / after:.1f}"
    known = np.linalg.inv(H[:6, :6])
    for name, part in (("w", slice(0, 3)), ("d", slice(3, 6))):
        factor = np.sqrt(np.trace(posterior[part, part]) / np.trace(known[part, part]))
        yield f"standard deviation of {name}: {factor:.1f} times that under a known path"


def _between(motion: Motion) -> FloatArray:
    """Rotations (t, 3, 3) from each row's time in frame 0 to the same row's in frame 1."""
    return _turned(motion, TIMES, TIMES + 1.0)


def _within(motion: Motion) -> FloatArray:
    """Rotations (t, 3, 3) from the time of row 0 to that of the other rows of frame 0."""
    return _turned(motion, np.zeros(len(TIMES) - 1), TIMES[1:])


def _turned(motion: Motion, start: FloatArray, end: FloatArray) -> FloatArray:
    return motion.body_from_world(end).R @ np.swapaxes(motion.body_from_world(start).R, -1, -2)


def _slopes(fit: ModelFit, rotations: Callable[[Motion], FloatArray]) -> FloatArray:
    """Derivative (3 t, n) of rotations of the motion, as rotation vectors, by phi."""
    columns = []
    for step in _STEP * np.eye(len(fit.phi)):
        below, above = (rotations(fit.candidate.make(fit.phi + sign * step)) for sign in (-1.0, 1.0))
        columns.append(so3.log(above @ np.swapaxes(below, -1, -2)).ravel() / (2.0 * _STEP))
    return np.stack(columns, axis=1)


def main() -> None:
    for case in ((2.0, 0.3, 300, 0.3), (0.3, 0.05, 300, 0.3), (0.1, 0.01, 60, 1.0)):
        sys.stdout.write(acceleration(*case) + "\n")
    for line in shake(2.0, 0.3, 300, 0.3):
        sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
