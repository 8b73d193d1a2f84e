"""The channel ``timing``: when each row of each frame is exposed and read, in nanoseconds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, views_of
from rsbench.core.shutter import RollingShutter
from rsbench.renderers.image import Sensor
from rsbench.storage.files import write_bytes, write_json
from rsbench.storage.untrusted_files import naming, read_text

TIMING_MANIFEST = "timing.json"
TIMING_COLUMNS = "row,time_ns,exposure_start_ns,exposure_end_ns"
_NS = 1e9


def table_file(side: str, frame: int) -> str:
    """Below the folder of a sequence."""
    return f"timing/{side}_{frame}.csv"


def timing_files(frames: int) -> tuple[str, ...]:
    """All of them, of a sequence of so many frames."""
    return (TIMING_MANIFEST, *(table_file(*view) for view in views_of(frames)))


def timing_manifest(
    shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, frames: int
) -> dict[str, Any]:
    """Content of timing.json: of each camera what makes its tables; times count from that of row 0 of frame 0."""
    readout_ns = {side: _NS * shutter.ratio_of(side) * frame_period_s for side in SIDES}
    cameras = {
        side: {
            "readout_ns": readout_ns[side],
            "line_delay_ns": readout_ns[side] / shutter.lines(side),
            "exposure_ns": _NS * (sensor.of(side, 0).exposure_s if sensor else 0.0),
            "scan": shutter.scan_of(side),
            "reference_row": shutter.first_line(side),
            "reference_ns": [_NS * frame_period_s * float(shutter.start(frame, side)) for frame in range(frames)],
        }
        for side in SIDES
    }
    common = {"frame_period_ns": _NS * frame_period_s, "time_of_a_row": "middle of its exposure"}
    return common | cameras


def timing_table(
    shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, side: Side, frame: int
) -> NDArray[np.int64]:
    """(H, 4) in the order of ``TIMING_COLUMNS``, whole nanoseconds; of columns where the camera reads those."""
    rows = np.arange(shutter.lines(side))
    middle = _NS * frame_period_s * shutter.line_times(frame, side)
    half = 0.5 * _NS * (sensor.of(side, frame).exposure_s if sensor else 0.0)
    return np.round(np.stack([rows, middle, middle - half, middle + half], axis=1)).astype(np.int64)


def write_timing(
    folder: Path, shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, frames: int
) -> None:
    """All ``timing_files`` below the folder of a sequence."""
    write_json(folder / TIMING_MANIFEST, timing_manifest(shutter, frame_period_s, sensor, frames))
    for side, frame in views_of(frames):
        table = timing_table(shutter, frame_period_s, sensor, side, frame)
        write_rows(folder / table_file(side, frame), TIMING_COLUMNS, table.tolist())


def write_rows(path: Path, columns: str, rows: Iterable[Iterable[float]]) -> None:
    """A CSV file with this header and numbers to their last bit."""
    lines = [",".join(map(repr, row)) for row in rows]
    write_bytes(path, ("\n".join([columns, *lines]) + "\n").encode())


def read_timing_table(path: Path, height: int) -> NDArray[np.int64]:
    """(height, 4) in the order of ``TIMING_COLUMNS``.

    Raises:
        RsbenchError: missing, or not such a table.
    """
    header, *lines = read_text(path).splitlines() or [""]
    with naming(f"{path}: not a table of whole numbers", ValueError, OverflowError):
        table = np.array([[int(cell) for cell in line.split(",")] for line in lines], dtype=np.int64)
    if header != TIMING_COLUMNS or table.shape != (height, 4) or np.any(table[:, 0] != np.arange(height)):
        raise RsbenchError(f"{path}: must have the columns {TIMING_COLUMNS} and rows 0 to {height - 1}")
    return table
