"""Motion models: the table of their names, rsbench's own models and their kernels, and motions as JSON.

A name in a card, a file or a solver's spec is one of rsbench's own models (``MOTIONS.built_in``), an entry
point of the group ``rsbench.motions``, or ``package.module:Class``. A model of rsbench's own is a class, a
kernel (``motion_kernels.MotionKernel``) where solvers can assume it, and a row of the table, all of them here.
Kernels and classes are the same motion: ``rsbench.core.epipolar.row_pair_pose`` of the class is what the kernel
computes.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.components.cards import choices
from rsbench.components.compiled import compiled
from rsbench.components.imports import blaming, import_target
from rsbench.components.motion_kernels import (
    KERNELS,
    MotionKernel,
    Moved,
    Vector,
    apply,
    coefficients,
    cross,
    dot,
    fill_rotation,
    kernel_for,
    plus,
    times,
)
from rsbench.components.plugins import Kind, NoOptions, list_names, load_class
from rsbench.core import arguments, so3
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray

MOTIONS: Kind[Motion, NoOptions] = Kind(
    singular="motion model",
    group="rsbench.motions",
    base=Motion,
    options=NoOptions,
    built_in={
        "linear": "rsbench.components.motion_models:LinearMotion",
        "twist": "rsbench.components.motion_models:TwistMotion",
        "inertial": "rsbench.components.motion_models:InertialMotion",
        "accelerated": "rsbench.components.motion_models:AcceleratedMotion",
        "spline": "rsbench.core.spline_motion:SplineMotion",
        "trajectory": "rsbench.core.spline_motion:TrajectoryMotion",
    },
)
_SAME = 1e-9
"""Radians and metres by which the poses of another package's model may differ from its own w and d."""


def motion_model(name: str) -> type[Motion]:
    """Class of a motion model.

    Raises:
        RsbenchError: no such model, two of that name, or it cannot be loaded: one line.
    """
    return _built_in(name) if name in MOTIONS.built_in else load_class(MOTIONS, name)


@functools.cache
def _built_in(name: str) -> type[Motion]:
    return load_class(MOTIONS, name)


def model_name(model: type[Motion]) -> str:
    """The name by which ``motion_model`` finds a class."""
    own = f"{model.__module__}:{model.__qualname__}"
    name = getattr(model, "name", "")
    known = name in MOTIONS.built_in or name in list_names(MOTIONS)  # reads the metadata of all packages
    return name if known and motion_model(name) is model else own


def motion_record(motion: Motion) -> dict[str, Any]:
    """A motion as JSON, for ``read_motion``."""
    own = {"parameters": motion.parameters} if motion.parameters else {}
    return {"model": model_name(type(motion)), "w": motion.w.tolist(), "d": motion.d.tolist(), **own}


def read_motion(record: Mapping[str, Any]) -> Motion:
    """The motion of a ``motion_record``.

    A class that it names must be installed or on Python's path: no code is run from the folder of the data.

    Raises:
        RsbenchError: see ``make_motion``.
        KeyError: ``model``, ``w`` or ``d`` is missing.
    """
    if ":" in record["model"]:
        import_target(record["model"], None, f"motion model = {record['model']!r}")
    return make_motion(record["model"], record["w"], record["d"], record.get("parameters", {}))


def make_motion(name: str, w: ArrayLike, d: ArrayLike, parameters: Mapping[str, Any] | None = None) -> Motion:
    """Motion of a model from its pose after one frame period and the model's own parameters.

    Raises:
        RsbenchError: no such model, or it cannot have such parameters: one line.
    """
    model, where = motion_model(name), f"motion model {name!r}"
    check_parameters(name, parameters or {})
    if model.__module__.partition(".")[0] == "rsbench":
        try:
            return model(w, d, **dict(parameters or {}))
        except (TypeError, ValueError, ArithmeticError, LookupError) as error:  # parameters of any type and shape
            raise RsbenchError(f"{where}: {error}") from error
    with blaming(where, "cannot be made"):
        motion = model(w, d, **dict(parameters or {}))
    _check_ends(motion, where)
    return motion


def check_parameters(name: str, parameters: Mapping[str, Any]) -> None:
    """Refuse an unknown model or unknown parameters, with RsbenchError."""
    if not parameters and name in MOTIONS.built_in:
        return
    known = list(inspect.signature(motion_model(name)).parameters)[2:]
    for key in parameters:
        if key not in known:
            raise RsbenchError(f"motion model {name!r}: unknown parameter {key!r}{choices(key, known)}")


def drawn_parameters(name: str, parameters: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The parameters, and random draws of those that are random by default, such as the seed of a shake."""
    check_parameters(name, parameters)
    return motion_model(name).drawn(parameters, rng)


def fixed_endpoint(name: str, parameters: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """``(w, d)`` where the parameters alone fix them; None where they are free.

    Raises:
        RsbenchError: no such model, or it cannot have such parameters.
    """
    check_parameters(name, parameters)
    try:
        return motion_model(name).endpoint(parameters)
    except ValueError as error:
        raise RsbenchError(f"motion model {name!r}: {error}") from error


def _check_ends(motion: Motion, where: str) -> None:
    """Check that another package's model starts at the identity and reaches (w, d) after a period, as all scores
    assume."""
    with blaming(where, "body_from_world fails"):
        R, t = motion.body_from_world(np.array([0.0, 1.0]))
        missed = [so3.angle(R @ np.stack([np.eye(3), so3.exp(motion.w).T])), t - np.stack([np.zeros(3), motion.d])]
    for time, wrong in ((0, "the identity"), (1, "(exp([w]x), d)")):
        if not max(float(np.max(np.abs(part[time]))) for part in missed) <= _SAME:
            raise RsbenchError(f"{where}: its pose at time {time} is not {wrong}")


@final
@dataclass(frozen=True, eq=False, init=False)
class LinearMotion(Motion):
    """The paper's model, equations (2)-(5): R(tau) = exp(tau [w]x), t(tau) = tau d."""

    name: ClassVar[str] = "linear"

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        shape = (*np.shape(tau), 3)
        return np.broadcast_to(self.w, shape), np.broadcast_to(self.d, shape)

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        shape = (*np.shape(tau), 3)
        return np.zeros(shape), np.zeros(shape)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        return float(np.linalg.norm(self.w)), float(np.linalg.norm(self.d))


@final
@dataclass(frozen=True, eq=False, init=False)
class TwistMotion(Motion):
    """Constant body twist (a screw): the pose is exp(tau xi) with exp(xi) = (exp([w]x), d)."""

    name: ClassVar[str] = "twist"

    @cached_property
    def v(self) -> FloatArray:
        """Linear part (3,) of the twist, metres per frame period."""
        return np.asarray(np.linalg.solve(so3.left_jacobian(self.w), self.d), dtype=np.float64)

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * (so3.left_jacobian(tau * self.w) @ self.v))

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        R, _ = self.body_from_world(tau)
        return np.broadcast_to(self.w, (*np.shape(tau), 3)), R @ self.v

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        w, speed = self.velocity(tau)
        return np.zeros(speed.shape), so3.cross(w, speed)

    def from_time(self, start: float) -> Motion:
        return self  # the twist of a screw motion is constant

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        return float(np.linalg.norm(self.w)), float(np.linalg.norm(self.v))


@final
@dataclass(frozen=True, eq=False, init=False)
class InertialMotion(Motion):
    """A body without external forces: constant velocity in the world, constant angular velocity.

    The body's centre is at tau c in the world, c = -R(1)^T d, so

        R(tau) = exp(tau [w]x),  t(tau) = -tau R(tau) c = tau exp((tau - 1) [w]x) d.
    """

    name: ClassVar[str] = "inertial"

    def _ahead(self, tau: FloatArray) -> FloatArray:
        """-R(tau) c (..., 3): the world's velocity as seen from the body; tau (..., 1)."""
        return so3.exp((tau - 1.0) * self.w) @ self.d

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * self._ahead(tau))

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        ahead = self._ahead(tau)
        return np.broadcast_to(self.w, ahead.shape), ahead + tau * so3.cross(self.w, ahead)

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        turned = so3.cross(self.w, self._ahead(tau))
        return np.zeros(turned.shape), 2.0 * turned + tau * so3.cross(self.w, turned)

    def from_time(self, start: float) -> Motion:
        return InertialMotion(self.w, so3.exp(start * self.w) @ self.d)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        turn, speed = float(np.linalg.norm(self.w)), float(np.linalg.norm(self.d))
        return turn, speed * (1.0 + max(abs(first), abs(last)) * turn)


@final
@dataclass(frozen=True, eq=False, init=False)
class AcceleratedMotion(Motion):
    """Constant acceleration along the paper's path: R(tau) = exp(beta [w]x), t(tau) = beta d, with

        beta(tau) = (tau + k tau^2 / 2) 2 / (2 + k),   so that beta(1) = 1.

    B. Zhuang, L.-F. Cheong, G. H. Lee, Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017,
    for the differential model; here the displacement is that of the exact one.
    """

    name: ClassVar[str] = "accelerated"
    acceleration: float = 0.2
    """k, per frame period: the speed grows by k times its value at time 0 in each period; above -1/2, or the rig
    would stop and turn back before time 2, when the last row of frame 1 is read at the latest."""

    def __init__(self, w: ArrayLike, d: ArrayLike, acceleration: float = 0.2) -> None:
        super().__init__(w, d)
        arguments.check_number("acceleration", acceleration)
        if not acceleration > -0.5:
            raise ValueError(f"acceleration = {acceleration}: must be a number above -0.5")
        object.__setattr__(self, "acceleration", float(acceleration))

    def share(self, tau: ArrayLike) -> FloatArray:
        """beta (...) of the displacement of one period, at times ``tau`` (...)."""
        tau, k = np.asarray(tau, dtype=np.float64), self.acceleration
        return np.asarray((tau + 0.5 * k * tau * tau) * (2.0 / (2.0 + k)))

    def speed(self, tau: ArrayLike) -> FloatArray:
        """Derivative (...) of ``share``."""
        tau, k = np.asarray(tau, dtype=np.float64), self.acceleration
        return np.asarray((1.0 + k * tau) * (2.0 / (2.0 + k)))

    def body_from_world(self, tau: ArrayLike) -> Pose:
        beta = self.share(tau)[..., None]
        return Pose(so3.exp(beta * self.w), beta * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        speed = self.speed(tau)[..., None]
        return speed * self.w, speed * self.d

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        k, shape = self.acceleration, (*np.shape(tau), 3)
        change = 2.0 * k / (2.0 + k)
        return np.broadcast_to(change * self.w, shape), np.broadcast_to(change * self.d, shape)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        speed = float(np.max(np.abs(self.speed([first, last]))))
        return speed * float(np.linalg.norm(self.w)), speed * float(np.linalg.norm(self.d))


@compiled
def rotate(w: Vector, a: float, R: FloatArray, A: FloatArray) -> None:
    """Fill R = exp(a [w]x) (the paper's (2) and (3), Rodrigues) and A = a J(a w), so that dR = [A dw]x R."""
    phi = times(a, w)
    s = dot(phi, phi)
    c0, c1, c2, _, _ = coefficients(s)
    fill_rotation(phi, 1.0 - c1 * s, c0, c1, R)
    fill_rotation(phi, a * (1.0 - c2 * s), a * c1, a * c2, A)


@compiled(inline="always")  # else LLVM keeps the call, which costs a third of the residuals
def linear_move(theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """Return T = tau1 d - tau0 R d and derivatives: the paper's (6) with exact R.

    The NumPy version is ``epipolar.row_pair_pose`` of LinearMotion.
    """
    w, v = (theta[0], theta[1], theta[2]), (theta[3], theta[4], theta[5])
    rotate(w, tau1 - tau0, R, A)
    Rv = apply(R, v)
    turn = cross(w, Rv)
    T = plus(times(tau1, v), -tau0, Rv)
    return T, plus(times(-1.0, Rv), tau0, turn), plus(v, -tau0, turn), times(-1.0, w), w


@compiled
def linear_translation_jacobian(
    theta: FloatArray, tau0: float, R: FloatArray, A: FloatArray, tau1: float, T_w: FloatArray, T_v: FloatArray
) -> None:
    """Fill dT/dw_j = -tau0 [A_j]x R d and dT/dd = tau1 I - tau0 R."""
    Rv = apply(R, (theta[3], theta[4], theta[5]))
    for j in range(3):
        column = cross((A[0, j], A[1, j], A[2, j]), Rv)
        for i in range(3):
            T_w[i, j] = -tau0 * column[i]
            T_v[i, j] = -tau0 * R[i, j]
        T_v[j, j] += tau1


@final
@kernel_for(LinearMotion)
@dataclass(frozen=True)
class LinearKernel(MotionKernel):
    """The paper's motion; v is d."""

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        return linear_move(theta, tau0, tau1, R, A)

    def translation_jacobian(
        self,
        theta: FloatArray,
        tau0: float,
        tau1: float,
        R: FloatArray,
        A: FloatArray,
        T_w: FloatArray,
        T_v: FloatArray,
    ) -> None:
        linear_translation_jacobian(theta, tau0, R, A, tau1, T_w, T_v)


@compiled
def turned(phi: Vector, v: Vector) -> Vector:
    """Return exp([phi]x) v."""
    c0, c1, _, _, _ = coefficients(dot(phi, phi))
    once = cross(phi, v)
    return plus(plus(v, c0, once), c1, cross(phi, once))


@compiled
def inertial_move(theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """Return T = a exp(tau1 w) v, a = tau1 - tau0, and derivatives."""
    w, v = (theta[0], theta[1], theta[2]), (theta[3], theta[4], theta[5])
    a = tau1 - tau0
    rotate(w, a, R, A)
    ahead = turned(times(tau1, w), v)
    back = times(-1.0, ahead)
    return times(a, ahead), back, plus(ahead, a, cross(w, ahead)), times(-1.0, w), w


@compiled
def inertial_translation_jacobian(
    theta: FloatArray, tau0: float, tau1: float, T_w: FloatArray, T_v: FloatArray
) -> None:
    """Fill dT/dw and dT/dv of ``inertial_move``."""
    a, phi = tau1 - tau0, times(tau1, (theta[0], theta[1], theta[2]))
    ahead = turned(phi, (theta[3], theta[4], theta[5]))
    _, c1, c2, _, _ = coefficients(dot(phi, phi))
    for j in range(3):
        e = (1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        once = cross(phi, e)
        spin = plus(plus(e, c1, once), c2, cross(phi, once))  # column j of J(phi)
        by_w, by_v = cross(spin, ahead), turned(phi, e)
        for i in range(3):
            T_w[i, j] = a * tau1 * by_w[i]
            T_v[i, j] = a * by_v[i]


@compiled
def beta(k: float, tau: float) -> tuple[float, float]:
    """Return beta(tau) for constant acceleration k, with beta(1) = 1, and its derivative (Zhuang et al. 2017)."""
    scale = 2.0 / (2.0 + k)
    return scale * (tau + 0.5 * k * tau * tau), scale * (1.0 + k * tau)


@compiled
def accelerated_move(k: float, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """Return ``linear_move`` at the times beta(tau), with derivatives by tau."""
    (beta0, speed0), (beta1, speed1) = beta(k, tau0), beta(k, tau1)
    T, rate0, rate1, spin0, spin1 = linear_move(theta, beta0, beta1, R, A)
    return T, times(speed0, rate0), times(speed1, rate1), times(speed0, spin0), times(speed1, spin1)


@compiled
def twist_move(theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """Return T = a J(a w) v, a = tau1 - tau0, and derivatives."""
    w, v = (theta[0], theta[1], theta[2]), (theta[3], theta[4], theta[5])
    rotate(w, tau1 - tau0, R, A)
    Rv = apply(R, v)
    return apply(A, v), times(-1.0, Rv), Rv, times(-1.0, w), w


@compiled
def twist_translation_jacobian(
    theta: FloatArray, tau0: float, tau1: float, A: FloatArray, T_w: FloatArray, T_v: FloatArray
) -> None:
    """Fill dT/dw and dT/dv of ``twist_move``."""
    a = tau1 - tau0
    twist_by_w(a, times(a, (theta[0], theta[1], theta[2])), (theta[3], theta[4], theta[5]), T_w)
    for i in range(3):
        for j in range(3):
            T_v[i, j] = A[i, j]


@compiled
def twist_by_w(a: float, phi: Vector, v: Vector, T_w: FloatArray) -> None:
    """Fill dT/dw of T = a (v + b phi x v + c phi x (phi x v)), phi = a w."""
    _, b, c, db, dc = coefficients(dot(phi, phi))
    once = cross(phi, v)
    along = plus(times(db, once), dc, cross(phi, once))
    pv = dot(phi, v)
    fill_rotation(v, a * a * c * pv, -a * a * b, 0.0, T_w)
    for i in range(3):
        for j in range(3):
            T_w[i, j] += a * a * (c * (phi[i] * v[j] - 2 * v[i] * phi[j]) + along[i] * phi[j])


@dataclass(frozen=True)
class AnyLaw(MotionKernel):
    """One kernel for all motion models of rsbench, selected by a number, so that code is compiled only once."""

    number: float
    acceleration: float = 0.0

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        if self.number == 0.0:
            return linear_move(theta, tau0, tau1, R, A)
        if self.number == 1.0:
            return twist_move(theta, tau0, tau1, R, A)
        if self.number == 2.0:
            return inertial_move(theta, tau0, tau1, R, A)
        return accelerated_move(self.acceleration, theta, tau0, tau1, R, A)

    def translation_jacobian(
        self,
        theta: FloatArray,
        tau0: float,
        tau1: float,
        R: FloatArray,
        A: FloatArray,
        T_w: FloatArray,
        T_v: FloatArray,
    ) -> None:
        if self.number == 0.0:
            linear_translation_jacobian(theta, tau0, R, A, tau1, T_w, T_v)
        elif self.number == 1.0:
            twist_translation_jacobian(theta, tau0, tau1, A, T_w, T_v)
        elif self.number == 2.0:
            inertial_translation_jacobian(theta, tau0, tau1, T_w, T_v)
        else:
            beta0, beta1 = beta(self.acceleration, tau0)[0], beta(self.acceleration, tau1)[0]
            linear_translation_jacobian(theta, beta0, R, A, beta1, T_w, T_v)


@final
@kernel_for(TwistMotion)
@dataclass(frozen=True)
class TwistKernel(AnyLaw):
    """Constant twist; v is its linear part: T = a J(a w) v, a = tau1 - tau0."""

    number: float = 1.0

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        return np.concatenate([w, np.linalg.solve(so3.left_jacobian(w), d)], dtype=np.float64)

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return theta[:3], so3.left_jacobian(theta[:3]) @ theta[3:]

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        out, step = np.eye(6), 1e-6
        for j in range(3):
            shift = step * np.eye(6)[j]
            out[3:, j] = (self.motion(theta + shift)[1] - self.motion(theta - shift)[1]) / (2 * step)
        out[3:, 3:] = so3.left_jacobian(theta[:3])
        return out


@final
@kernel_for(InertialMotion)
@dataclass(frozen=True)
class InertialKernel(AnyLaw):
    """Constant velocity in the world; v is its velocity in the body at time 0: T = a exp(tau1 w) v."""

    number: float = 2.0

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        return np.concatenate([w, so3.exp(-w) @ d], dtype=np.float64)

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return theta[:3], so3.exp(theta[:3]) @ theta[3:]

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        out, (w, d) = np.eye(6), self.motion(theta)
        out[3:, :3] = -so3.hat(d) @ so3.left_jacobian(w)
        out[3:, 3:] = so3.exp(w)
        return out


@final
@kernel_for(AcceleratedMotion)
@dataclass(frozen=True)
class AcceleratedKernel(AnyLaw):
    """Constant acceleration: the paper's motion at the times beta(tau); v is d."""

    number: float = 3.0


def any_law(kernel: MotionKernel) -> MotionKernel:
    """Convert rsbench's kernels to ``AnyLaw``; return those of other packages unchanged."""
    if isinstance(kernel, LinearKernel):
        return AnyLaw(0.0)
    return AnyLaw(kernel.number, kernel.acceleration) if isinstance(kernel, AnyLaw) else kernel


def quick_law(kernel: MotionKernel) -> MotionKernel:
    """Return the kernel for solvers: ``LinearKernel``, the default, itself; others by ``any_law``."""
    return kernel if isinstance(kernel, LinearKernel) else any_law(kernel)


def load_kernel(motion_name: str, parameters: Mapping[str, Any] | None = None) -> MotionKernel:
    """Return the kernel of a motion model with these parameters.

    Raises:
        RsbenchError: the model does not exist, does not accept the parameters, or has no kernel.
    """
    model = motion_model(motion_name)
    if model not in KERNELS:
        known = ", ".join(sorted(other.name for other in KERNELS))
        raise RsbenchError(
            f"motion model {motion_name!r} has no kernel, so no solver can assume it; these have: {known}"
        )
    motion, kernel = make_motion(motion_name, np.zeros(3), np.zeros(3), parameters), KERNELS[model]
    names = [field.name for field in dataclasses.fields(kernel)]  # pyrefly: ignore[bad-argument-type]
    if issubclass(kernel, AnyLaw):  # some of its fields are not parameters of the model
        names = [name for name in names if hasattr(motion, name)]
    return kernel(**{name: float(getattr(motion, name)) for name in names})


def has_kernel(motion_name: str) -> bool:
    """Return whether solvers can assume a motion model; raise RsbenchError if it does not exist."""
    return motion_model(motion_name) in KERNELS
