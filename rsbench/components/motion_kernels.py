"""Kernels of motion models, their Numba type, and compiled vector algebra that they may call.

Vectors are tuples, which need no allocation; rotations are (3, 3) arrays. The more readable NumPy versions of the
vector functions are in ``rsbench.core.so3``.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import FunctionType
from typing import Any, TypeVar

import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    overload_method,
    register_model,
    typeof_impl,
    unbox,
)

from rsbench.components.compiled import compiled
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray

Vector = tuple[float, float, float]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def plus(a: Vector, scale: float, b: Vector) -> Vector:
    """Return a + scale b."""
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


@compiled
def times(scale: float, a: Vector) -> Vector:
    return (scale * a[0], scale * a[1], scale * a[2])


@compiled
def apply(R: FloatArray, a: Vector) -> Vector:
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@compiled
def apply_transposed(R: FloatArray, a: Vector) -> Vector:
    return (
        R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
        R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
        R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
    )


@compiled
def coefficients(s: float) -> tuple[float, float, float, float, float]:
    """Return sin t/t, b = (1 - cos t)/t^2, c = (t - sin t)/t^3 for s = t^2, then b'/t and c'/t."""
    if s < 1e-2:  # the closed forms suffer from cancellation
        a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
        b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90)))
        c = 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110)))
        db = -1 / 12 + s / 180 * (1 - s * 3 / 112 * (1 - s / 67.5))
        dc = -1 / 60 + s / 1260 * (1 - s / 48 * (1 - s / 82.5))
        return a, b, c, db, dc
    t = math.sqrt(s)
    a = math.sin(t) / t
    b = 2 * math.sin(t / 2) ** 2 / s
    c = (1 - a) / s
    return a, b, c, (a - 2 * b) / s, (b - 3 * c) / s


@compiled
def fill_rotation(phi: Vector, identity: float, skew: float, outer: float, out: FloatArray) -> None:
    """Fill out = identity I + skew [phi]x + outer phi phi^T."""
    for i in range(3):
        for j in range(i, 3):
            out[i, j] = outer * phi[i] * phi[j]
            out[j, i] = out[i, j]
        out[i, i] += identity
    out[0, 1] -= skew * phi[2]
    out[1, 0] += skew * phi[2]
    out[0, 2] += skew * phi[1]
    out[2, 0] -= skew * phi[1]
    out[1, 2] -= skew * phi[0]
    out[2, 1] += skew * phi[0]


Moved = tuple[Vector, Vector, Vector, Vector, Vector]
"""T, dT/dtau0, dT/dtau1, then s0 and s1 with dR/dtau0 = [s0]x R and dR/dtau1 = [s1]x R."""


class MotionKernel(ABC):
    """The motion between two rows as compiled functions of six parameters theta = (w, v).

    A kernel is a frozen dataclass. Its fields are numbers: the parameters of its model that it needs, with the
    same names. Its methods ``move`` and ``translation_jacobian`` are compiled into the residuals, once for each
    kernel class, without overhead per call. They may use numbers, arrays and compiled functions, such as those of
    this module. They must agree with ``body_from_world`` of the model: from tau0 to tau1 the body moves by

        R = R(tau1) R(tau0)^T,  T = t(tau1) - R t(tau0)     (the paper's equation (6), not linearised)

    The NumPy version for any model is ``rsbench.core.epipolar.row_pair_pose``.
    """

    @abstractmethod
    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        """Fill R (3, 3), and A (3, 3) with dR = [A dw]x R, and return ``Moved``; R must not depend on v."""

    @abstractmethod
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
        """Fill T_w = dT/dw and T_v = dT/dv (3, 3); R and A are those of ``move``."""

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        """Return the parameters (6,) for the motion (w, d); this method is not compiled."""
        return np.concatenate([w, d])

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``(w, d)`` for the parameters; this method is not compiled."""
        return theta[:3], theta[3:]

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivative (6, 6) of (w, d) by the parameters; this method is not compiled."""
        return np.eye(6)


Class = TypeVar("Class", bound=type)
KERNELS: dict[type[Motion], type[MotionKernel]] = {}


def kernel_for(model: type[Motion]) -> Callable[[Class], Class]:
    """Return a class decorator that registers a kernel for a motion model.

    Raises:
        TypeError: the class is not a dataclass derived from ``MotionKernel``, or a compiled method has other
            arguments than that of the base class.
    """

    def register(kernel: Class) -> Class:
        found: Any = kernel
        if not (issubclass(found, MotionKernel) and dataclasses.is_dataclass(found)):
            raise TypeError(f"{kernel!r} must be a frozen dataclass below {MotionKernel.__qualname__}")
        for name in ("move", "translation_jacobian"):
            wanted = list(inspect.signature(getattr(MotionKernel, name)).parameters)
            if list(inspect.signature(getattr(kernel, name)).parameters) != wanted:
                raise TypeError(f"{kernel.__qualname__}.{name} must have the arguments {', '.join(wanted)}")
        KERNELS[model] = kernel
        return kernel

    return register


class KernelType(types.Type):
    """Numba's type of a kernel; one per class, so that other parameters need no compilation."""

    def __init__(self, cls: type[MotionKernel]) -> None:
        self.cls = cls
        self.members = tuple(field.name for field in dataclasses.fields(cls))  # pyrefly: ignore[bad-argument-type]
        super().__init__(name=f"MotionKernel({cls.__module__}.{cls.__qualname__})")

    @property
    def foreign(self) -> bool:
        """Whether the kernel belongs to another package, so that rsbench must not cache its code on disk."""
        return self.cls.__module__.partition(".")[0] != "rsbench"

    @property
    def key(self) -> object:
        return self.cls


_kernel_type = functools.cache(KernelType)
"""Cached because Numba needs it at every call of a compiled function, and making it costs more than some calls."""


@typeof_impl.register(MotionKernel)
def _typeof(value: MotionKernel, context: object) -> KernelType:
    return _kernel_type(type(value))


@register_model(KernelType)
class _KernelModel(models.StructModel):
    def __init__(self, manager: Any, kind: KernelType) -> None:
        # The extra member is needed because Numba's calling convention fails for arguments without members.
        super().__init__(manager, kind, [(name, types.float64) for name in (*kind.members, "_")])


@infer_getattr
class _KernelAttributes(AttributeTemplate):
    key = KernelType

    def generic_resolve(self, kind: KernelType, name: str) -> Any:
        return types.float64 if name in kind.members else None


@lower_getattr_generic(KernelType)
def _getattr(context: Any, builder: Any, kind: KernelType, value: Any, name: str) -> Any:
    return getattr(cgutils.create_struct_proxy(kind)(context, builder, value=value), name)


@unbox(KernelType)
def _unbox(kind: KernelType, value: Any, c: Any) -> NativeValue:
    struct = cgutils.create_struct_proxy(kind)(c.context, c.builder)
    for name in kind.members:
        member = c.pyapi.object_getattr_string(value, name)
        setattr(struct, name, c.unbox(types.float64, member).value)
        c.pyapi.decref(member)
    failed = cgutils.is_not_null(c.builder, c.pyapi.err_occurred())
    return NativeValue(struct._getvalue(), is_error=failed)


def _move(self: KernelType, theta: Any, tau0: Any, tau1: Any, R: Any, A: Any) -> Any:
    return _bare(self.cls.move)


def _translation_jacobian(
    self: KernelType, theta: Any, tau0: Any, tau1: Any, R: Any, A: Any, T_w: Any, T_v: Any
) -> Any:
    return _bare(self.cls.translation_jacobian)


def _bare(function: Any) -> Any:
    """Return the function without annotations, which Numba would compare with those of the functions above."""
    return FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )


overload_method(KernelType, "move")(_bare(_move))


overload_method(KernelType, "translation_jacobian")(_bare(_translation_jacobian))
