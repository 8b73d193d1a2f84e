"""One kernel for all laws of motion, so that what is compiled with it is compiled once.

Compiling residuals takes seconds for each kernel, and whoever asks which law a motion followed asks all of them.
The law is then a number that the compiled code looks at: some 15 % slower, to the same last digit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel, Moved
from rsbench.solvers.engine.motion_kernels import (
    AcceleratedKernel,
    InertialKernel,
    LinearKernel,
    TwistKernel,
    accelerated_move,
    accelerated_translation_jacobian,
    inertial_move,
    inertial_translation_jacobian,
    linear_move,
    linear_translation_jacobian,
    twist_move,
    twist_translation_jacobian,
)

_NUMBERS: dict[type[MotionKernel], float] = {LinearKernel: 0.0, TwistKernel: 1.0, InertialKernel: 2.0}
"""Of the laws without parameters; an accelerated one has 3."""


@final
@dataclass(frozen=True)
class AnyLaw(MotionKernel):
    """Any of the laws of motion of this package."""

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
            accelerated_translation_jacobian(self.acceleration, theta, tau0, R, A, tau1, T_w, T_v)


def any_law(kernel: MotionKernel) -> MotionKernel:
    """The kernel as ``AnyLaw``; that of another package as it is."""
    if isinstance(kernel, AcceleratedKernel):
        return AnyLaw(3.0, kernel.acceleration)
    number = _NUMBERS.get(type(kernel))
    return kernel if number is None else AnyLaw(number)


def quick_law(kernel: MotionKernel) -> MotionKernel:
    """The kernel as solvers use it: that of the paper's law, which they assume by default, has code of its own."""
    return kernel if isinstance(kernel, LinearKernel) else any_law(kernel)
