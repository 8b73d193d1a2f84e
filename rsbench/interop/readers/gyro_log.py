"""Readers of gyroscope logs: gyroflow's text format ``.gcsv``, and the ``.csv`` of the channel ``imu``.

``.gcsv`` (docs.gyroflow.xyz, GCSV format): a line GYROFLOW IMU LOG or CAMERA IMU LOG, lines ``key,value``, a line
of column names that begins with ``t``, and lines of numbers. ``tscale`` and ``gscale`` convert them to seconds and
rad/s; ``orientation`` gives the column and the sign (lower case: minus) of each of gyroflow's axes: x up, y left,
z backwards.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.interop.readers.layouts import numbers
from rsbench.storage.untrusted_files import read_text

_TITLES = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_OURS = ("stamp_ns", "wx", "wy", "wz")
_THEIRS = ("gx", "gy", "gz")
_CAMERA_FROM_THEIRS = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class GyroLog(NamedTuple):
    """Measurements of a gyroscope, in the order of time."""

    times_s: FloatArray
    """(n,) times of the log's own clock, s, increasing."""
    rates: FloatArray
    """(n, 3) angular velocities, rad/s, in the camera axes: x right, y down, z forward."""

    def samples(self, fps: float, offset_s: float) -> FloatArray:
        """Return samples (n, 4), tau and w, for ``Correspondences.gyro``; tau = 0 at the first row of frame 0.

        Args:
            fps: frames per second.
            offset_s: time of the log's clock at tau = 0.
        """
        return np.column_stack([(self.times_s - offset_s) * fps, -self.rates / fps])


def read_gyro_log(path: Path) -> GyroLog:
    """Read a log; the suffix determines its format.

    Raises:
        RsbenchError: the file is missing or malformed, has another suffix, decreasing times, or fewer than two
            samples of different times.
    """
    suffix = path.suffix.lower()
    if suffix not in (".gcsv", ".csv"):
        raise RsbenchError(f"{path}: must end in .gcsv, gyroflow's format, or .csv, with {','.join(_OURS)}")
    text = read_text(path).splitlines()
    read_table = _of_gcsv if suffix == ".gcsv" else _of_csv
    line_numbers, times, rates = read_table(text, path)
    if len(times) < 2:
        raise RsbenchError(f"{path}: must have two samples and more")
    if np.any(np.diff(times) < 0.0):
        number = line_numbers[int(np.argmax(np.diff(times) < 0.0)) + 1]
        raise RsbenchError(
            f"{path}:{number}: its time is before that of the line above: must be in the order of time"
        )
    later = np.concatenate([[True], np.diff(times) > 0.0])
    if np.count_nonzero(later) < 2:
        raise RsbenchError(f"{path}: all samples have one time")
    return GyroLog(times[later], rates[later])


def _of_csv(text: Sequence[str], path: Path) -> tuple[list[int], FloatArray, FloatArray]:
    names = _cells(text[0]) if text else []
    if any(name not in names for name in _OURS):
        raise RsbenchError(f"{path}: must have the columns {','.join(_OURS)}")
    line_numbers, values = _table(text, 0, [names.index(name) for name in _OURS], path)
    return line_numbers, 1e-9 * values[:, 0], values[:, 1:]


def _of_gcsv(text: Sequence[str], path: Path) -> tuple[list[int], FloatArray, FloatArray]:
    """Read gyroflow's format; absent keys have gyroflow's defaults: milliseconds, scale 1, xzY, columns 1 to 3."""
    start = next((k for k, line in enumerate(text) if _cells(line)[0] in ("t", "time")), None)
    if not text or not text[0].strip().startswith(_TITLES) or start is None:
        raise RsbenchError(f"{path}: must begin with {_TITLES[0]} and have a line t,gx,gy,gz")
    pairs = [(number, _cells(line)) for number, line in enumerate(text[1:start], start=2)]
    head = {cells[0]: (number, cells[1]) for number, cells in pairs if len(cells) == 2}
    scales = []
    for key, usual in (("tscale", "0.001"), ("gscale", "1")):
        number, value = head.get(key, (0, usual))
        scales.append(float(numbers(value, f"{path}:{number}: {key}", 1)[0]))
        if not scales[-1] > 0.0:
            raise RsbenchError(f"{path}:{number}: {key} = {scales[-1]:g}: must be positive")
    number, orientation = head.get("orientation", (0, "xzY"))
    if sorted(orientation.upper()) != ["X", "Y", "Z"]:
        raise RsbenchError(
            f"{path}:{number}: orientation = {orientation!r}: must be X, Y and Z in some order, lower case for "
            "minus"
        )
    names = _cells(text[start])
    if len(names) < 4:
        raise RsbenchError(f"{path}:{start + 1}: {text[start].strip()!r}: must be t,gx,gy,gz")
    rates = [names.index(name) for name in _THEIRS] if set(_THEIRS) <= set(names) else [1, 2, 3]
    line_numbers, values = _table(text, start, [0, *rates], path)
    theirs = [(1.0 if each.isupper() else -1.0) * values[:, 1 + "XYZ".index(each.upper())] for each in orientation]
    times = scales[0] * _unrolled(values[:, 0])
    return line_numbers, times, scales[1] * np.stack(theirs, axis=-1) @ _CAMERA_FROM_THEIRS.T


def _cells(line: str) -> list[str]:
    return [each.strip() for each in line.split(",")]


def _table(text: Sequence[str], start: int, columns: Sequence[int], path: Path) -> tuple[list[int], FloatArray]:
    """Read line numbers (n,) and values (n, k) of columns below line ``start``, from lines that have all of them.

    A missed reading leaves a cell empty, and an interrupted log ends with an incomplete line.
    """
    found, width = dict[int, list[str]](), len(_cells(text[start]))
    for number, line in enumerate(text[start + 1 :], start=start + 2):
        cells = _cells(line)
        least = width if number == len(text) else max(columns) + 1
        if len(cells) >= least and all(cells[k] for k in columns):
            found[number] = [cells[k] for k in columns]
    with contextlib.suppress(ValueError):
        values = np.array(list(found.values()), dtype=np.float64).reshape(-1, len(columns))
        if np.all(np.isfinite(values)):
            return list(found), values
    return list(found), np.array([numbers(" ".join(row), f"{path}:{n}") for n, row in found.items()])


def _unrolled(ticks: FloatArray) -> FloatArray:
    """Return continuous times for a counter that overflows after 2^16, 2^24 or 2^32 ticks.

    A negative step is an overflow if the corrected step is at most ten times the median step; others stay.
    """
    steps = np.diff(ticks)
    if not np.any(steps < 0.0):
        return ticks
    usual = float(np.median(np.abs(steps)))
    for size in (2.0**16, 2.0**24, 2.0**32):
        rolled = np.where(steps < 0.0, steps + size, steps)
        if np.all((rolled >= 0.0) & (rolled <= np.maximum(10.0 * usual, steps))):
            return ticks[0] + np.concatenate([[0.0], np.cumsum(rolled)])
    return ticks
