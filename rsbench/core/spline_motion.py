"""Motions along splines: a shaking rig (``SplineMotion``), and a path through poses (``TrajectoryMotion``).

``SplineMotion`` is a cumulative cubic B-spline on SE(3) with given or random control poses. The spline follows S.
Lovegrove, A. Patron-Perez, G. Sibley, Spline Fusion: a continuous-time representation for visual-inertial fusion
with application to rolling shutter cameras, BMVC 2013; its velocity follows C. Sommer, V. Usenko, D. Schubert, N.
Demmel, D. Cremers, Efficient derivative computation for cumulative B-splines on Lie groups, CVPR 2020. They write
world_from_body; here the poses are its inverse, so the factors are in the opposite order:

    P(u) = exp(b3 O[i+3]) exp(b2 O[i+2]) exp(b1 O[i+1]) C[i],   O[k] = log(C[k] C[k-1]^-1)

    b1 = (5 + 3u - 3u^2 + u^3) / 6,  b2 = (1 + 3u + 3u^2 - 2u^3) / 6,  b3 = u^3 / 6

in the interval i, u in [0, 1]. It is twice continuously differentiable.

A shake may also be given by its power spectrum (``ShakeSpectrum``): in each band, every rotation and translation
is a sum of sines with random frequencies and phases, one in each of equal parts of the band. As their number
grows, this approaches a Gaussian process with a flat spectrum (S. Rice, Mathematical Analysis of Random Noise,
1944). A longer shake begins like a shorter one with the same seed.

``TrajectoryMotion`` interpolates positions and unit quaternions (with consistent signs) component by component by
the cubic spline that is twice continuously differentiable (C. de Boor, A Practical Guide to Splines, 1978;
not-a-knot condition at both ends), and normalises the quaternion. Poses are interpolated up to rounding; between
them, the error for a path f and step h is about 5/384 h^4 max |f''''| (C. Hall, W. Meyer, J. Approx. Theory 1976).
A rotation or translation of the frame of all poses only rotates or translates the path.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments, se3, so3
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray

_SINES = 8
"""Number of sines in a band, for each axis."""
_FASTEST = 0.25
"""Largest frequency of a band, cycles per interval of the control poses: a cubic spline with four points per cycle
differs from a sine by less than 3 % of its amplitude."""
_MOST_BANDS = 32
_LARGEST_DEG, _LARGEST_M = 45.0, 1e3


@dataclass(frozen=True, eq=False)
class ShakeSpectrum:
    """A uniform path, and the frequency bands of the shake around it."""

    path: FloatArray
    """(6,) motion in one frame period: rotation vector, radians, and translation, metres."""
    bands: FloatArray
    """(n, 4) lowest and highest frequency, cycles per frame period, and standard deviations about and along each
    axis, radians and metres."""

    @classmethod
    def of(cls, record: Any, interval: float) -> ShakeSpectrum:
        """Read ``path``, in degrees and metres, and ``bands``, with degrees and metres, of a card.

        Args:
            interval: frame periods between the control poses of the spline.

        Raises:
            ValueError: there is another key, values are not such numbers, or a band is too fast for the interval.
        """
        if not isinstance(record, Mapping) or set(record) != {"path", "bands"}:
            raise ValueError("spectrum must be a table with path and bands, and no other key")
        path, bands = (arguments.real_array(f"spectrum.{key}", record[key]) for key in ("path", "bands"))
        if path.shape != (6,) or not np.all(np.abs(path) < [180.0] * 3 + [_LARGEST_M] * 3):
            raise ValueError("spectrum.path must be 6 finite numbers: degrees (3) and metres (3) per frame period")
        if bands.ndim != 2 or bands.shape[1] != 4 or not 1 <= len(bands) <= _MOST_BANDS:
            raise ValueError(f"spectrum.bands must be 1 to {_MOST_BANDS} rows of 4: from, to, degrees, metres")
        most = _FASTEST / interval
        for row in bands.tolist():
            low, high, turn, shift = row
            if not (0.0 <= low < high <= most and 0.0 <= turn <= _LARGEST_DEG and 0.0 <= shift <= _LARGEST_M):
                raise ValueError(
                    f"spectrum.bands: {row}: must rise from 0 or more to at most {most:g} cycles per frame period "
                    f"(0.25 / interval), with standard deviations from 0 to {_LARGEST_DEG:g} deg and "
                    f"{_LARGEST_M:g} m"
                )
        turned = np.concatenate([np.deg2rad(path[:3]), path[3:]])
        return cls(turned, bands * [1.0, 1.0, np.pi / 180.0, 1.0])

    def control(self, times: FloatArray, interval: float, rng: np.random.Generator) -> FloatArray:
        """Control poses (n, 6), rotation vectors and translations, at times (n,) one interval apart.

        The spline has the values of the sines at these times.
        """
        low, high, turn, shift = self.bands.T[..., None, None]
        part, phase = np.moveaxis(rng.random((len(self.bands), 6, _SINES, 2)), -1, 0)
        frequency = low + (high - low) * (np.arange(_SINES) + part) / _SINES
        sigma = np.concatenate(
            [np.broadcast_to(turn, (len(turn), 3, 1)), np.broadcast_to(shift, (len(turn), 3, 1))], 1
        )
        # A cubic B-spline whose control points are samples of a sine is smaller by this factor at its knots.
        kept = (2.0 + np.cos(2.0 * np.pi * frequency * interval)) / 3.0
        size = sigma * np.sqrt(2.0 / _SINES) / kept
        waves = np.sin(2.0 * np.pi * (frequency * times[:, None, None, None] + phase))
        shake = np.sum(size * waves, axis=(1, 3))
        steady = se3.log(Pose(so3.exp(self.path[:3]), self.path[3:]))
        R, t = compose(se3.exp(shake), se3.exp(times[:, None] * steady))
        return np.concatenate([so3.log(R), t], axis=1)


LAST = 2.0
"""Latest time at which a row of frame 1 is read: the default length of a shake."""
_TOLERANCE = 1e-12
_SAME = 1e-9
"""Largest difference of w and d from those of the given poses."""
_MAX_ITERATIONS = 100
_LONGEST, _MOST_DRAWN = 1e4, 20_000


class Shake(NamedTuple):
    """Standard deviations of the independent normal deviations of control poses from the smooth path."""

    interval: float
    """Frame periods between two control poses: the shake has up to 1 / (2 interval) cycles per period."""
    rotation_deg: tuple[float, float, float]
    """Rotation about x (pitch), y (yaw), z (roll), degrees."""
    translation: tuple[float, float, float]
    """Translation along x, y (heave), z, metres."""


PRESETS = {
    "steady": Shake(1.5, (0.1, 0.1, 0.1), (0.001, 0.001, 0.001)),
    "handheld": Shake(0.25, (0.15, 0.15, 0.15), (0.002, 0.002, 0.002)),
    "drone": Shake(0.1, (0.06, 0.04, 0.06), (0.0005, 0.001, 0.0005)),
    "driving": Shake(0.5, (0.3, 0.05, 0.15), (0.005, 0.015, 0.005)),
}
"""Chosen, not measured: a steady hand sways below a third of the frame rate, a trembling one at about that rate;
rotors cause faster and smaller shakes, and roads slower and larger ones, mostly in pitch and heave."""


@final
@dataclass(frozen=True, eq=False, init=False)
class SplineMotion(Motion):
    """Constant twist with a shake: control pose k is exp(shake[k]) exp(tau_k xi), tau_k = (k - 1) interval.

    The twist xi is such that the spline, relative to its pose at time 0, is (exp([w]x), d) at time 1. Without a
    shake it is ``TwistMotion``. Before time 0 and after the last interval, the velocity is constant.

    The shake comes from a preset and a seed, or is given; or the control poses are given, which determine w and d.
    """

    name: ClassVar[str] = "spline"
    interval: float
    """Frame periods between two control poses."""
    shake: FloatArray
    """(n, 6) twists (w, v), radians and metres, by which control poses deviate from the path."""

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
        """Give ``preset`` ("handheld") and ``seed`` (0), or ``interval`` and ``shake``, ``poses`` or ``spectrum``.

        Args:
            periods: length of a random shake, frame periods; a longer one begins like a shorter one.
            poses: (n, 6) rotation vectors (radians) and translations (metres) of the body's control poses;
                w and d must be their ``endpoint``.
            spectrum: ``path`` and ``bands``, see ``ShakeSpectrum.of``, with ``seed``; w and d as for ``poses``.

        Raises:
            ValueError: other combinations, too few control poses, a rotation of 180 degrees or more, or a shake so
                strong that no path leads to (w, d).
        """
        super().__init__(w, d)
        if float(np.linalg.norm(self.w)) >= np.pi:
            raise ValueError(f"w of a spline must be shorter than pi (180 degrees), got {self.w.tolist()}")
        chosen = {"preset": preset, "seed": seed, "interval": interval, "shake": shake, "poses": poses}
        chosen |= {"periods": periods, "spectrum": spectrum}
        parameters = {key: value for key, value in chosen.items() if value is not None}
        fixed = self.endpoint(parameters)
        if fixed is not None and np.max(np.abs(np.concatenate(fixed) - [*self.w, *self.d])) > _SAME:
            raise ValueError(
                "w and d of a spline with poses or a spectrum must be those of its poses, but differ from them"
            )
        step, offsets = _shake(parameters)
        offsets.setflags(write=False)
        object.__setattr__(self, "interval", step)
        object.__setattr__(self, "shake", offsets)
        _ = self._spline  # refuse a too strong shake here, not at the first use

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
    """The spline of control poses (n); the first is one interval before time 0."""

    def __init__(self, interval: float, control: Pose) -> None:
        self.interval, self.control = interval, control
        later, earlier = Pose(control.R[1:], control.t[1:]), Pose(control.R[:-1], control.t[:-1])
        self.steps = se3.log(compose(later, inverse(earlier)))

    def pose(self, tau: ArrayLike) -> Pose:
        """The pose at times (...), with the same bits as that of ``at``, in a third of the time."""
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
        """Pose at a time relative to that at time 0."""
        return compose(self.at(tau)[0], inverse(self.at(0.0)[0]))

    def fastest(self, first: float, last: float) -> tuple[float, float]:
        """Upper bounds of |w'| and |t'|: the rates of the three factors are positive and sum to 1 / interval."""
        ends = np.clip(np.floor(np.array([first, last]) / self.interval), 0, len(self.steps) - 3).astype(np.int64)
        steps = np.stack([self.steps[ends[0] + j : ends[1] + j + 1] for j in range(3)], axis=1)
        turn, shift = np.linalg.norm(steps[..., :3], axis=-1), np.linalg.norm(steps[..., 3:], axis=-1)
        # No partial product moves the origin farther than the sum of the translations of its factors.
        reach = np.linalg.norm(self.control.t[ends[0] : ends[1] + 1], axis=-1) + np.sum(shift, axis=-1)
        speed = np.max(shift + turn * reach[:, None])
        return float(np.max(turn)) / self.interval, float(speed) / self.interval


def _shake(parameters: Mapping[str, Any]) -> tuple[float, FloatArray]:
    """Interval and shake (n, 6) for parameters of ``SplineMotion``."""
    if "poses" in parameters or "spectrum" in parameters:
        spline = _given_spline(parameters)
        xi = se3.log(spline.from_start(1.0))
        anchored = compose(spline.control, inverse(spline.at(0.0)[0]))
        return spline.interval, se3.log(compose(anchored, se3.exp(-_times(spline.interval, anchored) * xi)))
    if "shake" in parameters:
        _only(parameters, "shake")
        return _interval(parameters), _twists(parameters["shake"], _interval(parameters), "shake")
    preset = parameters.get("preset", "handheld")
    arguments.check_one_of("preset", preset, PRESETS)
    if "interval" in parameters:
        raise ValueError("interval goes with shake or poses, or spectrum; a preset has its own")
    interval, rotation_deg, translation = PRESETS[preset]
    rng, periods = _generator(preset, parameters), _periods(parameters)
    sigma = np.concatenate([np.deg2rad(rotation_deg), translation])
    return interval, sigma * rng.standard_normal((least_poses(interval, periods), 6))


def _generator(purpose: str, parameters: Mapping[str, Any]) -> np.random.Generator:
    """The random generator for a purpose, with the seed of the parameters."""
    seed = parameters.get("seed", 0)
    arguments.check_whole("seed", seed, 0, 1 << 256)
    digest = hashlib.sha256(f"{purpose}/{int(seed)}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))


def _periods(parameters: Mapping[str, Any]) -> float:
    periods = parameters.get("periods", LAST)
    arguments.check_number("periods", periods, LAST, _LONGEST)
    return float(periods)


def _given_spline(parameters: Mapping[str, Any]) -> _Spline:
    spectral = "spectrum" in parameters
    _only(parameters, *(("spectrum", "seed", "periods") if spectral else ("poses",)))
    interval = _interval(parameters)
    poses = _spectral_poses(parameters, interval) if spectral else _twists(parameters["poses"], interval, "poses")
    return _Spline(interval, Pose(so3.exp(poses[:, :3]), poses[:, 3:]))


def _spectral_poses(parameters: Mapping[str, Any], interval: float) -> FloatArray:
    spectrum = ShakeSpectrum.of(parameters["spectrum"], interval)
    count = least_poses(interval, _periods(parameters))
    if count > _MOST_DRAWN:
        raise ValueError(
            f"interval = {interval:g}: too small: {count} control poses, at most {_MOST_DRAWN} are drawn"
        )
    times = np.asarray(interval * (np.arange(count) - 1.0), dtype=np.float64)
    return spectrum.control(times, interval, _generator("spectrum", parameters))


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
    """Index (...) of the interval of times (...), and their position in it, 0 to 1."""
    i = np.clip(np.floor(tau / interval), 0, count - 4).astype(np.int64)
    return i, np.clip(tau / interval - i, 0.0, 1.0)


def _cumulative(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return (5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u**3 / 6


def least_poses(interval: float, periods: float = LAST) -> int:
    """Number of control poses needed until time ``periods``."""
    return int(np.ceil(periods / interval - 1e-9)) + 3


def _twists(value: ArrayLike, interval: float, name: str) -> FloatArray:
    rows = arguments.real_array(name, value)
    if rows.ndim != 2 or rows.shape[1] != 6 or not np.all(np.abs(rows) <= arguments.LARGEST):
        raise ValueError(f"{name} must be rows of 6 finite numbers: rotation vector and translation")
    if len(rows) < least_poses(interval):
        raise ValueError(f"{name} has {len(rows)} rows; an interval of {interval:g} needs {least_poses(interval)}")
    return rows


def _times(interval: float, control: Pose) -> FloatArray:
    """Times (n, 1) of control poses."""
    return np.asarray(interval * (np.arange(len(control.t)) - 1.0)[:, None], dtype=np.float64)


def _through(interval: float, shake: FloatArray, end: Pose) -> _Spline:
    """The spline from the identity at time 0 to ``end`` at time 1, by fixed-point iteration of its twist."""
    offsets = se3.exp(shake)
    times, xi, before = _times(interval, offsets), se3.log(end), np.inf
    for _ in range(_MAX_ITERATIONS):
        control = compose(offsets, se3.exp(times * xi))
        spline = _Spline(interval, control)
        missing = compose(end, inverse(spline.from_start(1.0)))
        error = float(np.linalg.norm(se3.log(missing)))
        # Iterate until rounding, as finite differences by w and d need more than the tolerance.
        if error == 0.0 or (error <= _TOLERANCE and error >= 0.5 * before):
            return _Spline(interval, compose(control, inverse(spline.at(0.0)[0])))
        before = error
        xi = se3.log(compose(missing, se3.exp(xi)))
    raise ValueError("shake: too strong: no smooth path leads to w and d")


LARGEST_TURN_DEG = 90.0
"""Largest rotation between two poses, as the path between them would be ambiguous beyond it."""
_UNIT = 1e-6
"""Tolerance of the length of a quaternion, for rounding in a file."""


@final
@dataclass(frozen=True, eq=False, init=False)
class TrajectoryMotion(Motion):
    """Motion through poses of the body, relative to the body at time 0; velocity is constant beyond both ends."""

    name: ClassVar[str] = "trajectory"
    poses: FloatArray
    """(n, 8) time in frame periods, position x, y, z in metres and quaternion x, y, z, w: world_from_body."""

    def __init__(self, w: ArrayLike, d: ArrayLike, poses: ArrayLike) -> None:
        """Create the motion from poses; w and d must be their ``endpoint``.

        Raises:
            ValueError: rows are not such poses, times do not increase or do not reach from 0 to 1, the rotation
                between successive poses exceeds ``LARGEST_TURN_DEG``, or w or d differ.
        """
        super().__init__(w, d)
        rows = _checked(poses)
        rows.setflags(write=False)
        object.__setattr__(self, "poses", rows)
        R, t = self.body_from_world(1.0)
        if np.max(np.abs(np.concatenate([so3.log(R) - self.w, t - self.d]))) > _SAME:
            raise ValueError("w and d of a trajectory must be those of its poses, but differ from them")

    @cached_property
    def _path(self) -> _Path:
        return _Path.through(self.poses)

    @cached_property
    def _start(self) -> Pose:
        return self._path.at(0.0).world_from_body

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return compose(inverse(self._path.at(tau).world_from_body), self._start)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        place, turn, speed, *_ = self._path.at(tau)
        body = inverse(place)
        t = compose(body, self._start).t
        return -turn, -so3.cross(turn, t) - (body.R @ speed[..., None])[..., 0]

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        place, turn, speed, turn_change, speed_change = self._path.at(tau)
        body = inverse(place)
        t, (_, t_rate) = compose(body, self._start).t, self.velocity(tau)
        v, v_change = ((body.R @ each[..., None])[..., 0] for each in (speed, speed_change))
        return -turn_change, so3.cross(turn, v) - v_change - so3.cross(turn_change, t) - so3.cross(turn, t_rate)

    @property
    def lasts(self) -> float:
        return float(self.poses[-1, 0])

    @property
    def parameters(self) -> dict[str, Any]:
        return {"poses": self.poses.tolist()}

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        if "poses" not in parameters:
            raise ValueError("poses are required: (time, x, y, z, qx, qy, qz, qw) of the body")
        path = _Path.through(_checked(parameters["poses"]))
        R, t = compose(inverse(path.at(1.0).world_from_body), path.at(0.0).world_from_body)
        return so3.log(R), t


class Moving(NamedTuple):
    """Pose, velocities and accelerations of the body."""

    world_from_body: Pose
    turn: FloatArray
    """(..., 3) angular rate in the body's axes, rad per unit of time."""
    speed: FloatArray
    """(..., 3) velocity in the world's axes, metres per unit of time."""
    turn_change: FloatArray
    """(..., 3) derivative of ``turn``."""
    speed_change: FloatArray
    """(..., 3) derivative of ``speed``."""


class _Path(NamedTuple):
    """The spline of positions and quaternions (7 components), from the first time to the last."""

    spline: Any
    first: float
    last: float

    @classmethod
    def through(cls, poses: FloatArray) -> _Path:
        from scipy.interpolate import CubicSpline

        quaternions = _one_sign(poses[:, 4:] / np.linalg.norm(poses[:, 4:], axis=1, keepdims=True))
        values = np.concatenate([poses[:, 1:4], quaternions], axis=1)
        return cls(CubicSpline(poses[:, 0], values), float(poses[0, 0]), float(poses[-1, 0]))

    def at(self, tau: ArrayLike) -> Moving:
        """The motion at times (...); velocity is constant before the first pose and after the last."""
        tau = np.asarray(tau, dtype=np.float64)
        within = np.clip(tau, self.first, self.last)
        beyond = (tau - within)[..., None]
        still = (beyond == 0.0).astype(np.float64)
        place, rate, change = self.spline(within), self.spline(within, 1), still * self.spline(within, 2)
        x, y, z, w = np.moveaxis(place[..., 3:], -1, 0)
        v, dv, dw = place[..., 3:6], rate[..., 3:6], rate[..., 6:]
        square = np.sum(place[..., 3:] ** 2, axis=-1, keepdims=True)
        # 2 q* q' / |q|^2 for a quaternion q of any length.
        turn = 2.0 * (w[..., None] * dv - dw * v - so3.cross(v, dv)) / square
        ddv, ddw = change[..., 3:6], change[..., 6:]
        growth = 2.0 * np.sum(place[..., 3:] * rate[..., 3:], axis=-1, keepdims=True) / square
        turn_change = 2.0 * (w[..., None] * ddv - ddw * v - so3.cross(v, ddv)) / square - still * growth * turn
        R = so3.from_quaternion(np.stack([w, x, y, z], axis=-1)) @ so3.exp(beyond * turn)
        moved = Pose(R, place[..., :3] + beyond * rate[..., :3])
        return Moving(moved, turn, rate[..., :3], turn_change, change[..., :3])


def world_from_body(poses: ArrayLike, tau: ArrayLike) -> Pose:
    """Pose (..., 3, 3), (..., 3) at times (...) of the spline through poses (n, 8), see ``TrajectoryMotion``.

    Raises:
        ValueError: the rows are no path.
    """
    return _Path.through(_checked(poses, spans=False)).at(tau).world_from_body


def turns_deg(quaternions: FloatArray) -> FloatArray:
    """Angles (n - 1,) between successive unit quaternions (n, 4), degrees."""
    cosine = np.abs(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    return np.asarray(np.rad2deg(2.0 * np.arccos(np.minimum(cosine, 1.0))))


def _one_sign(quaternions: FloatArray) -> FloatArray:
    """The same rotations, with the sign of each quaternion chosen to be near the previous one."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.concatenate([[1.0], np.where(flips, -1.0, 1.0)])
    return np.asarray(quaternions * np.cumprod(signs)[:, None])


def _checked(value: ArrayLike, spans: bool = True) -> FloatArray:
    rows = arguments.real_array("poses", value)
    if rows.ndim != 2 or rows.shape[1] != 8 or len(rows) < 2 or not np.all(np.abs(rows) <= arguments.LARGEST):
        raise ValueError("poses must be two or more rows of 8 finite numbers: time, x, y, z, qx, qy, qz, qw")
    if np.any(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0) > _UNIT):
        raise ValueError("poses: a quaternion is not of length 1")
    if np.any(np.diff(rows[:, 0]) <= 0.0):
        raise ValueError("poses: each time must be later than the previous one")
    if spans and not rows[0, 0] <= 0.0 < 1.0 <= rows[-1, 0]:
        raise ValueError(f"poses must reach from time 0 to 1, they are from {rows[0, 0]:g} to {rows[-1, 0]:g}")
    if np.max(turns_deg(rows[:, 4:])) > LARGEST_TURN_DEG:
        raise ValueError(f"poses: more than {LARGEST_TURN_DEG:g} degrees from one to the next")
    return rows
