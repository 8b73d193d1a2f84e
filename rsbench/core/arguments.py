"""Checks of the arguments of public constructors and functions: types, finite numbers, sizes, names and paths.

Every message is one line with the name, the value and what is allowed. Numbers are Python's or NumPy's own
integers and floats: no truth values, no complex numbers, no text, no arrays of objects. Checks of rigs and
images are in ``rsbench.core.geometry``.
"""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core.so3 import FloatArray

LARGEST = 1e60
"""Beyond it products of a few numbers overflow: no length, angle or coefficient is as large."""
LARGEST_SIZE = 1_000_000
"""Rows or columns of an image: ten times the largest stitched ones."""
LARGEST_PX = 1e9
"""Focal lengths and principal points, in pixels."""
LARGEST_M = 1e9
"""Lengths, in metres: beyond the moon."""
_REAL = "iuf"


def check_one_of(name: str, value: object, allowed: Collection[object]) -> None:
    """Raises ValueError unless ``value`` is one of ``allowed``."""
    if not isinstance(value, str | int | float | None) or value not in allowed:
        raise ValueError(f"{name} = {shown(value)}: must be one of {', '.join(map(repr, allowed))}")


def check_number(name: str, value: object, least: float = -LARGEST, most: float = LARGEST) -> None:
    """Raises ValueError unless ``value`` is a finite number from ``least`` to ``most``."""
    if not (is_number(value) and least <= _plain(value) <= most):
        if least <= -LARGEST and most >= LARGEST:
            allowed = "that is finite"
        elif most >= LARGEST:
            allowed = f"at least {least:g}"
        else:
            allowed = f"from {least:.10g} to {most:.10g}"
        raise ValueError(f"{name} = {shown(value)}: must be a number {allowed}")


def check_positive(name: str, value: object, most: float, unit: str) -> None:
    """Raises ValueError unless ``value`` is a number above 0 and not above ``most``."""
    if not (is_number(value) and 0.0 < _plain(value) <= most):
        raise ValueError(f"{name} = {shown(value)}: must be a positive number of {unit}, at most {most:g}")


def keep_plain(record: object) -> None:
    """Replace NumPy's scalars in the fields of a checked dataclass by Python's numbers.

    Arithmetic with a short one overflows or rounds: a focal length of float16 times a baseline of float16 does.
    """
    for field in fields(record):  # pyrefly: ignore[bad-argument-type]
        value = getattr(record, field.name)
        if isinstance(value, np.integer | np.floating):
            object.__setattr__(record, field.name, int(value) if isinstance(value, np.integer) else float(value))


def check_whole(name: str, value: object, least: int, most: float = math.inf) -> None:
    """Raises ValueError unless ``value`` is a whole number from ``least`` to ``most``."""
    whole = isinstance(value, int | np.integer) and is_number(value)
    if not whole or not least <= int(value) <= most:
        allowed = f"of at least {least}" if math.isinf(most) else f"from {least} to {most}"
        raise ValueError(f"{name} = {shown(value)}: must be a whole number {allowed}")


def check_type(name: str, value: object, wanted: type) -> None:
    """Raises ValueError unless ``value`` is of the type."""
    if not isinstance(value, wanted):
        raise ValueError(f"{name}: must be an rsbench {wanted.__name__}, got {shown(value)}")


def is_number(value: object) -> TypeGuard[float]:
    """Whether it is one real number, finite or not; NumPy takes spans of time for integers."""
    wrong = isinstance(value, bool | np.timedelta64)
    return isinstance(value, int | float | np.integer | np.floating) and not wrong


def _plain(value: float) -> float:
    """The value as Python's float: NumPy's short floats overflow where they are compared with large numbers."""
    try:
        return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def real_array(name: str, value: ArrayLike) -> FloatArray:
    """A copy as float64; raises ValueError unless it is an array of real numbers, finite or not, none masked."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name} must not be a masked array: give what counts, or NaN where that is allowed")
    if isinstance(value, np.ndarray) and value.dtype == np.float64:
        return np.array(value)
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):  # rows of unequal lengths
        array = np.zeros((), dtype=object)
    if array.dtype.kind not in _REAL and array.size > 0:
        what = shown(value) if array.dtype == object and array.ndim == 0 else f"an array of {array.dtype}"
        raise ValueError(f"{name} must be real numbers, got {what}")
    if isinstance(value, Sequence) and len(value) <= 16 and any(isinstance(v, bool | np.bool_) for v in value):
        raise ValueError(f"{name} must be real numbers, got truth values: {shown(value)}")
    return np.array(array, dtype=np.float64)


def vector(name: str, value: ArrayLike) -> FloatArray:
    """Three finite numbers (3,) as a read-only copy; raises ValueError on anything else."""
    try:
        v = real_array(name, value)
    except ValueError as error:
        raise ValueError(f"{name} must be 3 finite numbers, got {shown(value)}") from error
    if v.shape != (3,) or not np.all(np.abs(v) <= LARGEST):
        raise ValueError(f"{name} must be 3 finite numbers, got {shown(value)}")
    v.setflags(write=False)
    return v


def shown(value: object) -> str:
    """The value in one short line."""
    if isinstance(value, np.ndarray) and value.size > 4:
        return f"an array of {value.dtype} {value.shape}"
    text = _SHORT.repr(value) if not isinstance(value, np.generic) else str(value)
    line = " ".join(text.split())
    return line if len(line) <= _WIDEST else f"{line[:_WIDEST]} ..."


_WIDEST = 120
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60
_LONGEST_PATH = 4096


def check_ranges(component: object, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Raises ValueError unless the numbers of these names lie from the first to the second; None may be."""
    for name, (least, most) in ranges.items():
        value = getattr(component, name)
        if value is not None and not least <= value <= most:
            raise ValueError(f"{name} = {value!r}: must lie in [{least:g}, {most:g}]")


def world_points(points: ArrayLike) -> FloatArray:
    """Points (..., 3) as float64; raises ValueError on another shape, and on numbers that no scene has."""
    array = real_array("points", points)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"points: must have shape (..., 3), got {array.shape}")
    far = np.abs(array) > LARGEST_M  # NaN is no point, and not visible
    if np.any(far):
        raise ValueError(f"points: must lie within {LARGEST_M:g} m, got {array[far][0]:g}")
    return array


def items(name: str, value: Any) -> Any:
    """The value; raises ValueError unless it has a length and can be indexed, and on a text."""
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if not listed and not (isinstance(value, np.ndarray) and value.ndim > 0):
        raise ValueError(f"{name}: must be a list, got {shown(value)}")
    return value


def path(name: str, value: Any) -> Path:
    """A path; raises ValueError on what is none, or is longer than a system takes."""
    return Path(name_or_path(name, value))


def name_or_path(name: str, value: Any) -> str | Path:
    """The name of a component or the path of its card; raises ValueError on what is neither."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str) or "\0" in text or not 0 < len(text) <= _LONGEST_PATH:
        raise ValueError(f"{name} = {shown(value)}: must be a name or a path")
    return value if isinstance(value, str | Path) else text


def names(name: str, value: Any) -> tuple[str, ...]:
    """One name or many; raises ValueError on anything else."""
    found = (value,) if isinstance(value, str) else value
    if not isinstance(found, Iterable) or isinstance(found, Mapping):
        raise ValueError(f"{name}: must be names, got {shown(value)}")
    return tuple(str(name_or_path(name, each)) for each in found)
