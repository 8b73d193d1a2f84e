"""The kernels of rsbench's own motion models; see ``kernel_type.MotionKernel``.

Their NumPy forms are the models in ``rsbench.core.motion``, through ``rsbench.core.epipolar.row_pair_pose``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core import so3
from rsbench.core.motion import AcceleratedMotion, InertialMotion, LinearMotion, TwistMotion
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel, Moved, kernel_for
from rsbench.solvers.engine.vectors import (
    Vector,
    apply,
    coefficients,
    cross,
    dot,
    fill_rotation,
    plus,
    times,
)


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
    """T = tau1 d - tau0 R d: the paper's (6) with R exact. NumPy: ``epipolar.row_pair_pose`` of LinearMotion."""
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
    """dT/dw_j = -tau0 [A_j]x R d and dT/dd = tau1 I - tau0 R."""
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
    """exp([phi]x) v."""
    c0, c1, _, _, _ = coefficients(dot(phi, phi))
    once = cross(phi, v)
    return plus(plus(v, c0, once), c1, cross(phi, once))


@compiled
def inertial_move(theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """T = a exp(tau1 w) v, a = tau1 - tau0."""
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
    """Of ``inertial_move``."""
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


@final
@kernel_for(InertialMotion)
@dataclass(frozen=True)
class InertialKernel(MotionKernel):
    """Constant velocity in the world; v is that of the world in the body at time 0: T = a exp(tau1 w) v."""

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        return inertial_move(theta, tau0, tau1, R, A)

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
        inertial_translation_jacobian(theta, tau0, tau1, T_w, T_v)

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        return np.concatenate([w, so3.exp(-w) @ d], dtype=np.float64)

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return theta[:3], so3.exp(theta[:3]) @ theta[3:]

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        out, (w, d) = np.eye(6), self.motion(theta)
        out[3:, :3] = -so3.hat(d) @ so3.left_jacobian(w)
        out[3:, 3:] = so3.exp(w)
        return out


@compiled
def beta(k: float, tau: float) -> tuple[float, float]:
    """beta(tau) of a constant acceleration k (Zhuang et al., ICCV 2017), 1 at tau = 1, and its derivative."""
    scale = 2.0 / (2.0 + k)
    return scale * (tau + 0.5 * k * tau * tau), scale * (1.0 + k * tau)


@compiled
def accelerated_move(k: float, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """``linear_move`` at the times beta(tau)."""
    (beta0, speed0), (beta1, speed1) = beta(k, tau0), beta(k, tau1)
    T, rate0, rate1, spin0, spin1 = linear_move(theta, beta0, beta1, R, A)
    return T, times(speed0, rate0), times(speed1, rate1), times(speed0, spin0), times(speed1, spin1)


@compiled
def accelerated_translation_jacobian(
    k: float,
    theta: FloatArray,
    tau0: float,
    R: FloatArray,
    A: FloatArray,
    tau1: float,
    T_w: FloatArray,
    T_v: FloatArray,
) -> None:
    """Of ``accelerated_move``."""
    beta0, beta1 = beta(k, tau0)[0], beta(k, tau1)[0]
    linear_translation_jacobian(theta, beta0, R, A, beta1, T_w, T_v)


@final
@kernel_for(AcceleratedMotion)
@dataclass(frozen=True)
class AcceleratedKernel(MotionKernel):
    """Constant acceleration: the paper's motion at the times beta(tau); v is d."""

    acceleration: float

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
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
        accelerated_translation_jacobian(self.acceleration, theta, tau0, R, A, tau1, T_w, T_v)


@compiled
def twist_move(theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
    """T = a J(a w) v, a = tau1 - tau0."""
    w, v = (theta[0], theta[1], theta[2]), (theta[3], theta[4], theta[5])
    rotate(w, tau1 - tau0, R, A)
    Rv = apply(R, v)
    return apply(A, v), times(-1.0, Rv), Rv, times(-1.0, w), w


@compiled
def twist_translation_jacobian(
    theta: FloatArray, tau0: float, tau1: float, A: FloatArray, T_w: FloatArray, T_v: FloatArray
) -> None:
    """Of ``twist_move``."""
    a = tau1 - tau0
    twist_by_w(a, times(a, (theta[0], theta[1], theta[2])), (theta[3], theta[4], theta[5]), T_w)
    for i in range(3):
        for j in range(3):
            T_v[i, j] = A[i, j]


@final
@kernel_for(TwistMotion)
@dataclass(frozen=True)
class TwistKernel(MotionKernel):
    """Constant twist; v is its linear part: T = a J(a w) v, a = tau1 - tau0."""

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        return twist_move(theta, tau0, tau1, R, A)

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
        twist_translation_jacobian(theta, tau0, tau1, A, T_w, T_v)

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


@compiled
def twist_by_w(a: float, phi: Vector, v: Vector, T_w: FloatArray) -> None:
    """dT/dw of T = a (v + b phi x v + c phi x (phi x v)), phi = a w."""
    _, b, c, db, dc = coefficients(dot(phi, phi))
    once = cross(phi, v)
    along = plus(times(db, once), dc, cross(phi, once))
    pv = dot(phi, v)
    fill_rotation(v, a * a * c * pv, -a * a * b, 0.0, T_w)
    for i in range(3):
        for j in range(3):
            T_w[i, j] += a * a * (c * (phi[i] * v[j] - 2 * v[i] * phi[j]) + along[i] * phi[j])
