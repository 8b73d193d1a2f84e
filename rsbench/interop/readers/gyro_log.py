"""Logs of a gyroscope: gyroflow's text format ``.gcsv``, and ``.csv`` as the channel ``imu`` has it.

``.gcsv`` (docs.gyroflow.xyz, GCSV format): a line GYROFLOW IMU LOG or CAMERA IMU LOG, lines ``key,value``, the
names of the columns from ``t`` on, numbers. ``tscale`` and ``gscale`` make seconds and rad/s of them;
``orientation`` gives the column and the sign (lower case: minus) of each of gyroflow's axes: x up, y left, z
backwards.
"""

from __future__ import annotations

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
_THEIRS = ("t", "gx", "gy", "gz")
_CAMERA_FROM_THEIRS = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class GyroLog(NamedTuple):
    """Measurements of a gyroscope, in the order of time."""

    times_s: FloatArray
    """(n,) by its own clock, increasing."""
    rates: FloatArray
    """(n, 3) rad/s, in the axes of the camera: x right, y down, z forward."""

    def samples(self, fps: float, offset_s: float) -> FloatArray:
        """(n, 4) tau, w of ``Correspondences.gyro``, tau 0 the first row of the first frame.

        Args:
            fps: frames per second.
            offset_s: time of the log's clock at tau 0.
        """
        return np.column_stack([(self.times_s - offset_s) * fps, -self.rates / fps])


def read_gyro_log(path: Path) -> GyroLog:
    """Read a log, whose format is known by its suffix.

    Raises:
        RsbenchError: missing, another suffix, malformed, times that do not increase, or fewer than two samples.
    """
    suffix = path.suffix.lower()
    if suffix not in (".gcsv", ".csv"):
        raise RsbenchError(f"{path}: must end in .gcsv, gyroflow's format, or .csv, with {','.join(_OURS)}")
    text = read_text(path).splitlines()
    times, rates = _of_gcsv(text, path) if suffix == ".gcsv" else _of_csv(text, path)
    if len(times) < 2 or np.any(np.diff(times) < 0.0):
        raise RsbenchError(f"{path}: must have two samples and more, in the order of time")
    later = np.concatenate([[True], np.diff(times) > 0.0])
    if np.count_nonzero(later) < 2:
        raise RsbenchError(f"{path}: all samples have one time")
    return GyroLog(times[later], rates[later])


def _of_csv(text: Sequence[str], path: Path) -> tuple[FloatArray, FloatArray]:
    values = _table(text, 0, _OURS, path)
    return 1e-9 * values[:, 0], values[:, 1:]


def _of_gcsv(text: Sequence[str], path: Path) -> tuple[FloatArray, FloatArray]:
    start = next((k for k, line in enumerate(text) if line.split(",")[0].strip() == "t"), None)
    if not text or text[0].strip() not in _TITLES or start is None:
        raise RsbenchError(f"{path}: must begin with {_TITLES[0]} and have a line t,gx,gy,gz")
    head = dict(line.split(",", 1) for line in text[1:start] if "," in line)
    scales = []
    for key in ("tscale", "gscale"):
        if key not in head:
            raise RsbenchError(f"{path}: has no {key}, by which its numbers are multiplied")
        scales.append(float(numbers(head[key], f"{path}: {key}", 1)[0]))
        if not scales[-1] > 0.0:
            raise RsbenchError(f"{path}: {key} = {scales[-1]:g}: must be positive")
    orientation = head.get("orientation", "XYZ").strip()
    if sorted(orientation.upper()) != ["X", "Y", "Z"]:
        raise RsbenchError(
            f"{path}: orientation = {orientation!r}: must be X, Y and Z in some order, lower case for minus"
        )
    values = _table(text, start, _THEIRS, path)
    theirs = [(1.0 if each.isupper() else -1.0) * values[:, 1 + "XYZ".index(each.upper())] for each in orientation]
    return scales[0] * values[:, 0], scales[1] * np.stack(theirs, axis=-1) @ _CAMERA_FROM_THEIRS.T


def _table(text: Sequence[str], start: int, names: Sequence[str], path: Path) -> FloatArray:
    """Columns (n, k) by their names in the line ``start``; an incomplete last line is ignored."""
    columns = [each.strip() for each in text[start].split(",")] if text else []
    if any(name not in columns for name in names):
        raise RsbenchError(f"{path}: must have the columns {','.join(names)}")
    rows = [line for line in text[start + 1 :] if line.strip()]
    if rows and rows[-1].count(",") < len(columns) - 1:
        rows.pop()
    chosen = [columns.index(name) for name in names]
    try:
        values = (
            np.loadtxt(rows, delimiter=",", usecols=chosen, ndmin=2, comments=None) if rows else np.zeros((0, 4))
        )
    except ValueError as error:
        raise RsbenchError(f"{path}: not a table of numbers: {str(error)[:120]}") from None
    if not np.all(np.isfinite(values)):
        raise RsbenchError(f"{path}: numbers must be finite")
    return values
