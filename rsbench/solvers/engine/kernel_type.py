"""What a motion model brings to the compiled residuals: its kernel, as Numba sees it."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
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

from rsbench.components.motion_models import make_motion, motion_model
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.vectors import Vector

Moved = tuple[Vector, Vector, Vector, Vector, Vector]
"""T, dT/dtau0, dT/dtau1, then s0 and s1 with dR/dtau0 = [s0]x R and dR/dtau1 = [s1]x R."""


class MotionKernel(ABC):
    """The motion between two rows as a compiled function of six parameters theta = (w, v).

    A kernel is a frozen dataclass whose fields are numbers: those parameters of its model that it needs, under the
    same names. Its methods ``move`` and ``translation_jacobian`` are compiled into the residuals, one copy for
    each kernel, at no cost per call: they may use numbers, arrays and compiled functions, such as those of
    ``vectors``. They must be the motion of the model's ``body_from_world``: from tau0 to tau1 the body moves by

        R = R(tau1) R(tau0)^T,  T = t(tau1) - R t(tau0)     (the paper's equation (6), not linearised)

    whose NumPy form, for any model, is ``rsbench.core.epipolar.row_pair_pose``.
    """

    @abstractmethod
    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        """Fill R (3, 3), and A (3, 3) with dR = [A dw]x R; R must not depend on v. Returns ``Moved``."""

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
        """Parameters (6,) of the motion (w, d); not compiled."""
        return np.concatenate([w, d])

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``(w, d)`` of the parameters; not compiled."""
        return theta[:3], theta[3:]

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        """Derivative (6, 6) of (w, d) by the parameters; not compiled."""
        return np.eye(6)


Class = TypeVar("Class", bound=type)
_KERNELS: dict[type[Motion], type[MotionKernel]] = {}


def kernel_for(model: type[Motion]) -> Callable[[Class], Class]:
    """Class decorator that gives a motion model its kernel.

    Raises:
        TypeError: the class is no such dataclass, or a compiled method has other arguments than the contract.
    """

    def register(kernel: Class) -> Class:
        found: Any = kernel
        if not (issubclass(found, MotionKernel) and dataclasses.is_dataclass(found)):
            raise TypeError(f"{kernel!r} must be a frozen dataclass below {MotionKernel.__qualname__}")
        for name in ("move", "translation_jacobian"):
            wanted = list(inspect.signature(getattr(MotionKernel, name)).parameters)
            if list(inspect.signature(getattr(kernel, name)).parameters) != wanted:
                raise TypeError(f"{kernel.__qualname__}.{name} must have the arguments {', '.join(wanted)}")
        _KERNELS[model] = kernel
        return kernel

    return register


def load_kernel(motion_name: str, parameters: Mapping[str, Any] | None = None) -> MotionKernel:
    """Kernel of a motion model with such parameters.

    Raises:
        RsbenchError: no such model, it cannot have such parameters, or it has no kernel: one line.
    """
    model = motion_model(motion_name)
    if model not in _KERNELS:
        known = ", ".join(sorted(other.name for other in _KERNELS))
        raise RsbenchError(
            f"motion model {motion_name!r} has no kernel, so no solver can assume it; these have: {known}"
        )
    motion, kernel = make_motion(motion_name, np.zeros(3), np.zeros(3), parameters), _KERNELS[model]
    return kernel(**{field.name: float(getattr(motion, field.name)) for field in dataclasses.fields(kernel)})  # pyrefly: ignore[bad-argument-type]


def has_kernel(motion_name: str) -> bool:
    """Whether solvers can assume a motion model; RsbenchError when it does not exist."""
    return motion_model(motion_name) in _KERNELS


class KernelType(types.Type):
    """Numba's type of a kernel: one per class, whatever the numbers, so that code is compiled once per class."""

    def __init__(self, cls: type[MotionKernel]) -> None:
        self.cls = cls
        self.members = tuple(field.name for field in dataclasses.fields(cls))  # pyrefly: ignore[bad-argument-type]
        super().__init__(name=f"MotionKernel({cls.__module__}.{cls.__qualname__})")

    @property
    def foreign(self) -> bool:
        """Whether another package owns the code, which must then not be kept on disk as ours."""
        return self.cls.__module__.partition(".")[0] != "rsbench"

    @property
    def key(self) -> object:
        return self.cls


_kernel_type = functools.cache(KernelType)
"""Asked at every call of a compiled function: making the type anew would cost more than some of the calls."""


@typeof_impl.register(MotionKernel)
def _typeof(value: MotionKernel, context: object) -> KernelType:
    return _kernel_type(type(value))


@register_model(KernelType)
class _KernelModel(models.StructModel):
    def __init__(self, manager: Any, kind: KernelType) -> None:
        # Never empty: an argument without members confuses the calling convention.
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
    """The function without annotations, which Numba would compare with those of the functions above."""
    return FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )


overload_method(KernelType, "move")(_bare(_move))
overload_method(KernelType, "translation_jacobian")(_bare(_translation_jacobian))
