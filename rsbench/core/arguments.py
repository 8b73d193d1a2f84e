"""Checks of the arguments of public constructors and functions: types, finite numbers, sizes, names and paths.

Every message is one line with the name, the value and the allowed values. Numbers are integers and floats of
Python or NumPy; bools, complex numbers, text and object arrays are rejected. Checks of rigs and images are in
``rsbench.core.geometry``.
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
"""Largest accepted number: products of a few larger ones overflow; no length or angle is as large."""
LARGEST_SIZE = 1_000_000
"""Largest number of rows or columns of an image: ten times that of the largest stitched images."""
LARGEST_PX = 1e9
"""Largest focal length or coordinate of a principal point, in pixels."""
LARGEST_M = 1e9
"""Largest length, in metres: more than the distance to the moon."""
_REAL = "iuf"


def check_one_of(name: str, value: object, allowed: Collection[object]) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    if not isinstance(value, str | int | float | None) or value not in allowed:
        raise ValueError(f"{name} = {shown(value)}: must be one of {', '.join(map(repr, allowed))}")


def check_number(name: str, value: object, least: float = -LARGEST, most: float = LARGEST) -> None:
    """Raise ValueError unless ``value`` is a finite number from ``least`` to ``most``."""
    if not (is_number(value) and least <= _plain(value) <= most):
        if least <= -LARGEST and most >= LARGEST:
            allowed = "that is finite"
        elif most >= LARGEST:
            allowed = f"at least {least:g}"
        else:
            allowed = f"from {least:.10g} to {most:.10g}"
        raise ValueError(f"{name} = {shown(value)}: must be a number {allowed}")


def check_positive(name: str, value: object, most: float, unit: str) -> None:
    """Raise ValueError unless ``value`` is a number above 0 and not above ``most``."""
    if not (is_number(value) and 0.0 < _plain(value) <= most):
        raise ValueError(f"{name} = {shown(value)}: must be a positive number of {unit}, at most {most:g}")


def keep_plain(record: object) -> None:
    """Replace NumPy scalars in the fields of a checked dataclass by Python numbers.

    Arithmetic with short NumPy types overflows or rounds, for example a float16 focal length times a float16
    baseline.
    """
    for field in fields(record):  # pyrefly: ignore[bad-argument-type]
        value = getattr(record, field.name)
        if isinstance(value, np.integer | np.floating):
            object.__setattr__(record, field.name, int(value) if isinstance(value, np.integer) else float(value))


def check_whole(name: str, value: object, least: int, most: float = math.inf) -> None:
    """Raise ValueError unless ``value`` is a whole number from ``least`` to ``most``."""
    whole = isinstance(value, int | np.integer) and is_number(value)
    if not whole or not least <= int(value) <= most:
        allowed = f"of at least {least}" if math.isinf(most) else f"from {least} to {most}"
        raise ValueError(f"{name} = {shown(value)}: must be a whole number {allowed}")


def check_type(name: str, value: object, wanted: type) -> None:
    """Raise ValueError unless ``value`` is an instance of ``wanted``."""
    if not isinstance(value, wanted):
        raise ValueError(f"{name}: must be an rsbench {wanted.__name__}, got {shown(value)}")


def is_number(value: object) -> TypeGuard[float]:
    """Return whether the value is a single real number, finite or not.

    ``np.timedelta64`` is excluded explicitly, because NumPy derives it from its integers.
    """
    wrong = isinstance(value, bool | np.timedelta64)
    return isinstance(value, int | float | np.integer | np.floating) and not wrong


def _plain(value: float) -> float:
    """Convert to a Python float, because comparing a short NumPy float with a large number overflows."""
    try:
        return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def real_array(name: str, value: ArrayLike) -> FloatArray:
    """Return a float64 copy; raise ValueError unless it is an unmasked array of real numbers, finite or not."""
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
    """Return a read-only copy of three finite numbers (3,); raise ValueError for anything else."""
    try:
        v = real_array(name, value)
    except ValueError as error:
        raise ValueError(f"{name} must be 3 finite numbers, got {shown(value)}") from error
    if v.shape != (3,) or not np.all(np.abs(v) <= LARGEST):
        raise ValueError(f"{name} must be 3 finite numbers, got {shown(value)}")
    v.setflags(write=False)
    return v


def shown(value: object) -> str:
    """Return the value as one short line of text."""
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
    """Raise ValueError unless each named attribute is within its range (least, most) or is None."""
    for name, (least, most) in ranges.items():
        value = getattr(component, name)
        if value is not None and not least <= value <= most:
            raise ValueError(f"{name} = {value!r}: must lie in [{least:g}, {most:g}]")


def world_points(points: ArrayLike) -> FloatArray:
    """Return points (..., 3) as float64; ValueError for another shape or values beyond ``LARGEST_M``."""
    array = real_array("points", points)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"points: must have shape (..., 3), got {array.shape}")
    far = np.abs(array) > LARGEST_M  # NaN is no point, and not visible
    if np.any(far):
        raise ValueError(f"points: must lie within {LARGEST_M:g} m, got {array[far][0]:g}")
    return array


def items(name: str, value: Any) -> Any:
    """Return the value; raise ValueError unless it is a sequence or an array, but not text."""
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if not listed and not (isinstance(value, np.ndarray) and value.ndim > 0):
        raise ValueError(f"{name}: must be a list, got {shown(value)}")
    return value


def path(name: str, value: Any) -> Path:
    """Return a path; raise ValueError if the value is not one or is too long."""
    return Path(name_or_path(name, value))


def name_or_path(name: str, value: Any) -> str | Path:
    """Return the name of a component or the path of its card; raise ValueError if the value is neither."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str) or "\0" in text or not 0 < len(text) <= _LONGEST_PATH:
        raise ValueError(f"{name} = {shown(value)}: must be a name or a path")
    return value if isinstance(value, str | Path) else text


def names(name: str, value: Any) -> tuple[str, ...]:
    """Return one name or several as a tuple; raise ValueError for anything else."""
    found = (value,) if isinstance(value, str) else value
    if not isinstance(found, Iterable) or isinstance(found, Mapping):
        raise ValueError(f"{name}: must be names, got {shown(value)}")
    return tuple(str(name_or_path(name, each)) for each in found)
