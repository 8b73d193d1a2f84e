"""Hand-held motion: a cumulative cubic B-spline on SE(3) through given or drawn control poses.

S. Lovegrove, A. Patron-Perez, G. Sibley, Spline Fusion: a continuous-time representation for visual-inertial
fusion with application to rolling shutter cameras, BMVC 2013, for the spline; C. Sommer, V. Usenko, D. Schubert,
N. Demmel, D. Cremers, Efficient derivative computation for cumulative B-splines on Lie groups, CVPR 2020, for its
velocity. They write world_from_body; here the poses are its inverse, so the factors stand the other way round:

    P(u) = exp(b3 O[i+3]) exp(b2 O[i+2]) exp(b1 O[i+1]) C[i],   O[k] = log(C[k] C[k-1]^-1)

    b1 = (5 + 3u - 3u^2 + u^3) / 6,  b2 = (1 + 3u + 3u^2 - 2u^3) / 6,  b3 = u^3 / 6

in the interval i, u in [0, 1]. It is twice continuously differentiable.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import given, se3, so3
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shake_spectrum import ShakeSpectrum
from rsbench.core.so3 import FloatArray

LAST = 2.0
"""Rows of frame 1 are read until then, at the latest: how long a shake is that does not say."""
_TOLERANCE = 1e-12
_SAME = 1e-9
"""Largest difference of w and d that are still those of given poses."""
_MAX_ITERATIONS = 100
_LONGEST, _MOST_DRAWN = 1e4, 20_000


class Shake(NamedTuple):
    """How control poses leave the smooth path: independent normal draws, of these standard deviations."""

    interval: float
    """Frame periods between two control poses: shakes of up to 1 / (2 interval) cycles per period."""
    rotation_deg: tuple[float, float, float]
    """About x (pitch), y (yaw), z (roll)."""
    translation: tuple[float, float, float]
    """Along x, y (heave), z, metres."""


PRESETS = {
    "steady": Shake(1.5, (0.1, 0.1, 0.1), (0.001, 0.001, 0.001)),
    "handheld": Shake(0.25, (0.15, 0.15, 0.15), (0.002, 0.002, 0.002)),
    "drone": Shake(0.1, (0.06, 0.04, 0.06), (0.0005, 0.001, 0.0005)),
    "driving": Shake(0.5, (0.3, 0.05, 0.15), (0.005, 0.015, 0.005)),
}
"""Chosen, not measured: a steady hand sways below a third of the frame rate, one that trembles shakes at about
that rate, rotors shake a frame faster and by less, a road slower and by more, in pitch and heave above all."""


@final
@dataclass(frozen=True, eq=False, init=False)
class SplineMotion(Motion):
    """Constant twist with a shake: control pose k is exp(shake[k]) exp(tau_k xi), tau_k = (k - 1) interval.

    The twist xi is such that the spline, seen from its own pose at time 0, is (exp([w]x), d) at time 1. Without a
    shake it is ``TwistMotion``. Before time 0 and after the last interval it goes on at the velocity it has there.

    The shake comes from a preset and a seed, or is given; or the control poses are, which fix w and d.
    """

    name: ClassVar[str] = "spline"
    interval: float
    """Frame periods between two control poses."""
    shake: FloatArray
    """(n, 6) twists (w, v), radians and metres, by which each control pose leaves the path."""

    def __init__(
        self,
        w: ArrayLike,
        d: ArrayLike,
        preset: str | None = None,
        seed: int | None = None,
        interval: float | None = None,
        shake: ArrayLike | None = None,
        poses: ArrayLike | None = None,
        periods: float | None = None,
        spectrum: Mapping[str, Any] | None = None,
    ) -> None:
        """From ``preset`` ("handheld") and ``seed`` (0), or ``interval`` and ``shake``, ``poses`` or ``spectrum``.

        Args:
            periods: until when a shake that is drawn lasts, frame periods; a longer one begins as a shorter one.
            poses: (n, 6) rotation vectors (radians) and translations (metres) of the body's control poses;
                w and d must be their ``endpoint``.
            spectrum: ``path`` and ``bands``, see ``ShakeSpectrum.of``; ``seed`` draws; w and d as of ``poses``.

        Raises:
            ValueError: another combination, too few control poses, a half turn or more, or a shake so strong
                that no path leads to (w, d).
        """
        super().__init__(w, d)
        if float(np.linalg.norm(self.w)) >= np.pi:
            raise ValueError(f"w of a spline must be below a half turn, got {self.w.tolist()}")
        chosen = {"preset": preset, "seed": seed, "interval": interval, "shake": shake, "poses": poses}
        chosen |= {"periods": periods, "spectrum": spectrum}
        parameters = {key: value for key, value in chosen.items() if value is not None}
        fixed = self.endpoint(parameters)
        if fixed is not None and np.max(np.abs(np.concatenate(fixed) - [*self.w, *self.d])) > _SAME:
            raise ValueError(
                "w and d of a spline with poses or a spectrum are those of its poses, and were given otherwise"
            )
        step, offsets = _shake(parameters)
        offsets.setflags(write=False)
        object.__setattr__(self, "interval", step)
        object.__setattr__(self, "shake", offsets)
        _ = self._spline  # a shake that no path carries is refused here, not at the first use

    @cached_property
    def _spline(self) -> _Spline:
        return _through(self.interval, self.shake, Pose(so3.exp(self.w), self.d))

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return self._spline.pose(tau)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        (_, t), twist, _ = self._spline.at(tau)
        w = twist[..., :3]
        return w, so3.cross(w, t) + twist[..., 3:]

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        (_, t), twist, change = self._spline.at(tau)
        w, speed = twist[..., :3], so3.cross(twist[..., :3], t) + twist[..., 3:]
        turn = change[..., :3]
        return turn, so3.cross(turn, t) + so3.cross(w, speed) + change[..., 3:]

    @property
    def parameters(self) -> dict[str, Any]:
        return {"interval": self.interval, "shake": self.shake.tolist()}

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        return self._spline.fastest(first, last)

    @property
    def lasts(self) -> float:
        return self.interval * (len(self.shake) - 3)

    @classmethod
    def lasting(cls, parameters: Mapping[str, Any], periods: float) -> dict[str, Any]:
        drawn = not any(key in parameters for key in ("shake", "poses", "periods"))
        return {**parameters, "periods": periods} if drawn else dict(parameters)

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        if parameters.get("poses") is None and parameters.get("spectrum") is None:
            return None
        R, t = _given_spline(parameters).from_start(1.0)
        return so3.log(R), t

    @classmethod
    def drawn(cls, parameters: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        if any(key in parameters for key in ("seed", "shake", "poses")):
            return dict(parameters)
        return {**parameters, "seed": int(rng.integers(2**32))}


class _Spline:
    """The spline of control poses (n); the first stands one interval before time 0."""

    def __init__(self, interval: float, control: Pose) -> None:
        self.interval, self.control = interval, control
        later, earlier = Pose(control.R[1:], control.t[1:]), Pose(control.R[:-1], control.t[:-1])
        self.steps = se3.log(compose(later, inverse(earlier)))

    def pose(self, tau: ArrayLike) -> Pose:
        """The pose alone at times (...): a third of the work of ``at``, the same bits."""
        tau = np.asarray(tau, dtype=np.float64)
        if not np.all((tau >= 0.0) & (tau <= (len(self.steps) - 2) * self.interval)):
            return self.at(tau)[0]
        i, u = _place(tau, self.interval, len(self.steps) + 1)
        pose = Pose(self.control.R[i], self.control.t[i])
        for j, share in enumerate(_cumulative(u)):
            pose = compose(se3.exp(share[..., None] * self.steps[i + j]), pose)
        return pose

    def at(self, tau: ArrayLike) -> tuple[Pose, FloatArray, FloatArray]:
        """Pose, spatial twist (..., 6) and its derivative (..., 6) at times (...): dP/dtau = [twist] P."""
        tau = np.asarray(tau, dtype=np.float64)
        i, u = _place(tau, self.interval, len(self.steps) + 1)
        b = _cumulative(u)
        rate = (0.5 + u * (0.5 * u - 1), 0.5 + u * (1 - u), 0.5 * u * u)
        rate_change = (u - 1, 1 - 2 * u, u)
        pose, twist, change = Pose(self.control.R[i], self.control.t[i]), *np.zeros((2, *tau.shape, 6))
        for j in range(3):
            step = self.steps[i + j]
            factor, moved = se3.exp(b[j][..., None] * step), (rate[j] / self.interval)[..., None] * step
            pose, twist = compose(factor, pose), se3.adjoint_apply(factor, twist)
            change = se3.adjoint_apply(factor, change) + se3.bracket(moved, twist)
            change = change + (rate_change[j] / self.interval**2)[..., None] * step
            twist = twist + moved
        beyond = tau - (i + u) * self.interval
        inside = (tau >= 0.0) & (tau <= (len(self.steps) - 2) * self.interval)
        going_on = compose(se3.exp(np.where(u % 1.0 == 0.0, beyond, 0.0)[..., None] * twist), pose)
        return going_on, twist, np.where(inside[..., None], change, 0.0)

    def from_start(self, tau: float) -> Pose:
        """Pose at a time from that at time 0."""
        return compose(self.at(tau)[0], inverse(self.at(0.0)[0]))

    def fastest(self, first: float, last: float) -> tuple[float, float]:
        """Bounds of |w'| and |t'|: the rates of the three factors are positive and add up to 1 / interval."""
        ends = np.clip(np.floor(np.array([first, last]) / self.interval), 0, len(self.steps) - 3).astype(np.int64)
        steps = np.stack([self.steps[ends[0] + j : ends[1] + j + 1] for j in range(3)], axis=1)
        turn, shift = np.linalg.norm(steps[..., :3], axis=-1), np.linalg.norm(steps[..., 3:], axis=-1)
        # No partial product brings the origin farther out than the sum of all that its factors shift.
        reach = np.linalg.norm(self.control.t[ends[0] : ends[1] + 1], axis=-1) + np.sum(shift, axis=-1)
        speed = np.max(shift + turn * reach[:, None])
        return float(np.max(turn)) / self.interval, float(speed) / self.interval


def _shake(parameters: Mapping[str, Any]) -> tuple[float, FloatArray]:
    """Interval and shake (n, 6) that the parameters of ``SplineMotion`` mean."""
    if "poses" in parameters or "spectrum" in parameters:
        spline = _given_spline(parameters)
        xi = se3.log(spline.from_start(1.0))
        anchored = compose(spline.control, inverse(spline.at(0.0)[0]))
        return spline.interval, se3.log(compose(anchored, se3.exp(-_times(spline.interval, anchored) * xi)))
    if "shake" in parameters:
        _only(parameters, "shake")
        return _interval(parameters), _twists(parameters["shake"], _interval(parameters), "shake")
    preset = parameters.get("preset", "handheld")
    given.check_one_of("preset", preset, PRESETS)
    if "interval" in parameters:
        raise ValueError("interval goes with shake or poses, or spectrum; a preset has its own")
    interval, rotation_deg, translation = PRESETS[preset]
    rng, periods = _generator(preset, parameters), _periods(parameters)
    sigma = np.concatenate([np.deg2rad(rotation_deg), translation])
    return interval, sigma * rng.standard_normal((least_poses(interval, periods), 6))


def _generator(purpose: str, parameters: Mapping[str, Any]) -> np.random.Generator:
    """What is drawn with the seed of the parameters."""
    seed = parameters.get("seed", 0)
    given.check_whole("seed", seed, 0, 1 << 256)
    digest = hashlib.sha256(f"{purpose}/{int(seed)}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))


def _periods(parameters: Mapping[str, Any]) -> float:
    periods = parameters.get("periods", LAST)
    if isinstance(periods, bool) or not isinstance(periods, int | float) or not LAST <= periods <= _LONGEST:
        raise ValueError(f"periods = {periods!r}: must be a number from {LAST:g} to {_LONGEST:g}")
    return float(periods)


def _given_spline(parameters: Mapping[str, Any]) -> _Spline:
    if "spectrum" in parameters:
        return _spectral_spline(parameters)
    _only(parameters, "poses")
    interval = _interval(parameters)
    poses = _twists(parameters["poses"], interval, "poses")
    return _Spline(interval, Pose(so3.exp(poses[:, :3]), poses[:, 3:]))


def _spectral_spline(parameters: Mapping[str, Any]) -> _Spline:
    _only(parameters, "spectrum", "seed", "periods")
    interval = _interval(parameters)
    spectrum = ShakeSpectrum.of(parameters["spectrum"], interval)
    count = least_poses(interval, _periods(parameters))
    if count > _MOST_DRAWN:
        raise ValueError(
            f"interval = {interval:g}: too small: {count} control poses, at most {_MOST_DRAWN} are drawn"
        )
    times = np.asarray(interval * (np.arange(count) - 1.0), dtype=np.float64)
    poses = spectrum.control(times, interval, _generator("spectrum", parameters))
    return _Spline(interval, Pose(so3.exp(poses[:, :3]), poses[:, 3:]))


def _only(parameters: Mapping[str, Any], name: str, *more: str) -> None:
    others = set(parameters) - {"interval", name, *more}
    if others:
        raise ValueError(f"{name} and {', '.join(sorted(others))} exclude each other")


def _interval(parameters: Mapping[str, Any]) -> float:
    value = parameters.get("interval")
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= LAST:
        raise ValueError(f"interval = {value!r}: must be a number of frame periods above 0, at most {LAST:g}")
    return float(value)


def _place(tau: FloatArray, interval: float, count: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Interval (...) of times (...), and where in it they are, from 0 to 1."""
    i = np.clip(np.floor(tau / interval), 0, count - 4).astype(np.int64)
    return i, np.clip(tau / interval - i, 0.0, 1.0)


def _cumulative(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return (5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u**3 / 6


def least_poses(interval: float, periods: float = LAST) -> int:
    """Control poses that reach a time."""
    return int(np.ceil(periods / interval - 1e-9)) + 3


def _twists(value: ArrayLike, interval: float, name: str) -> FloatArray:
    rows = given.real_array(name, value)
    if rows.ndim != 2 or rows.shape[1] != 6 or not np.all(np.abs(rows) <= given.LARGEST):
        raise ValueError(f"{name} must be rows of 6 finite numbers: rotation vector and translation")
    if len(rows) < least_poses(interval):
        raise ValueError(f"{name} has {len(rows)} rows; an interval of {interval:g} needs {least_poses(interval)}")
    return rows


def _times(interval: float, control: Pose) -> FloatArray:
    """Times (n, 1) of control poses."""
    return np.asarray(interval * (np.arange(len(control.t)) - 1.0)[:, None], dtype=np.float64)


def _through(interval: float, shake: FloatArray, end: Pose) -> _Spline:
    """The spline from the identity at 0 to ``end`` at 1: a fixed point of the path's twist."""
    offsets = se3.exp(shake)
    times, xi, before = _times(interval, offsets), se3.log(end), np.inf
    for _ in range(_MAX_ITERATIONS):
        control = compose(offsets, se3.exp(times * xi))
        spline = _Spline(interval, control)
        missing = compose(end, inverse(spline.from_start(1.0)))
        error = float(np.linalg.norm(se3.log(missing)))
        # Until rounding: who takes differences of w and d wants more than the tolerance.
        if error == 0.0 or (error <= _TOLERANCE and error >= 0.5 * before):
            return _Spline(interval, compose(control, inverse(spline.at(0.0)[0])))
        before = error
        xi = se3.log(compose(missing, se3.exp(xi)))
    raise ValueError("shake: too strong: no smooth path leads to w and d")
