"""The channels ``timing`` and ``imu``, with times in nanoseconds since row 0 of frame 0.

``timing`` holds the exposure times of each row of each frame. ``imu`` holds measured and true samples of a
gyroscope and an accelerometer at the rig's body. The noise model is that of IEEE Std 952, parametrised as in
Kalibr: white noise and a random walk of the bias, each given by its density.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import parse_card
from rsbench.components.seeds import generator
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.imu import STANDARD_GRAVITY, inertial
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, views_of
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.renderers.image import Sensor
from rsbench.scenes.model import Start, Viewpoint
from rsbench.storage.files import write_bytes, write_json
from rsbench.storage.untrusted_files import inside, read_text

TIMING_MANIFEST = "timing.json"
TIMING_COLUMNS = "row,time_ns,exposure_start_ns,exposure_end_ns"
_NS = 1e9


def table_file(side: str, frame: int) -> str:
    """Return the path of the row times of one frame, below the folder of a sequence."""
    return f"timing/{side}_{frame}.csv"


def timing_files(frames: int) -> tuple[str, ...]:
    """Return the paths of all files of the channel ``timing`` for a sequence of ``frames`` frames."""
    return (TIMING_MANIFEST, *(table_file(*view) for view in views_of(frames)))


def timing_manifest(
    shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, frames: int
) -> dict[str, Any]:
    """Return the content of timing.json: the readout parameters of each camera, from which its tables follow."""
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
    """Return a table (lines, 4) of row (or column) times; columns as in ``TIMING_COLUMNS``, whole nanoseconds."""
    rows = np.arange(shutter.lines(side))
    middle = _NS * frame_period_s * shutter.line_times(frame, side)
    half = 0.5 * _NS * (sensor.of(side, frame).exposure_s if sensor else 0.0)
    return np.round(np.stack([rows, middle, middle - half, middle + half], axis=1)).astype(np.int64)


def write_timing(
    folder: Path, shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, frames: int
) -> None:
    """Write all ``timing_files`` below the folder of a sequence."""
    write_json(folder / TIMING_MANIFEST, timing_manifest(shutter, frame_period_s, sensor, frames))
    for side, frame in views_of(frames):
        table = timing_table(shutter, frame_period_s, sensor, side, frame)
        write_rows(folder / table_file(side, frame), TIMING_COLUMNS, table.tolist())


def write_rows(path: Path, columns: str, rows: Iterable[Iterable[float]]) -> None:
    """Write a CSV file with this header and numbers in full precision."""
    lines = [",".join(map(repr, row)) for row in rows]
    write_bytes(path, ("\n".join([columns, *lines]) + "\n").encode())


def read_timing_table(path: Path, height: int) -> NDArray[np.int64]:
    """Read a table (height, 4) with columns as in ``TIMING_COLUMNS``.

    Raises:
        RsbenchError: the file is missing or not such a table.
    """
    header, *lines = read_text(path).splitlines() or [""]
    with naming(f"{path}: not a table of whole numbers", ValueError, OverflowError):
        table = np.array([[int(cell) for cell in line.split(",")] for line in lines], dtype=np.int64)
    if header != TIMING_COLUMNS or table.shape != (height, 4) or np.any(table[:, 0] != np.arange(height)):
        raise RsbenchError(f"{path}: must have the columns {TIMING_COLUMNS} and rows 0 to {height - 1}")
    return table


IMU_MANIFEST, MEASURED, TRUE = "imu/imu.json", "imu/measured.csv", "imu/true.csv"
IMU_FILES = (IMU_MANIFEST, MEASURED, TRUE)
MEASURED_COLUMNS = "stamp_ns,wx,wy,wz,ax,ay,az"
TRUE_COLUMNS = "time_ns,wx,wy,wz,ax,ay,az,bwx,bwy,bwz,bax,bay,baz"
MARGIN_S = 0.05
"""Time for which the IMU also measures before the first exposure and after the last one, seconds."""
_FASTEST_HZ, _LONGEST_OFFSET_S, _WORST_DRIFT = 1e4, 1.0, 1e-2


@dataclass(frozen=True, kw_only=True)
class Imu:
    """An inertial measurement unit at the rig's body; its axes are the body's.

    The defaults are the noise of the ADIS16448 of the EuRoC data set (Burri et al., IJRR 2016, imu0/sensor.yaml),
    and biases of the size that its sequences show.
    """

    rate_hz: float = 200.0
    """Samples per second."""
    gyroscope_noise_density: float = 1.6968e-4
    """White noise of the gyroscope, rad/s/sqrt(Hz); a sample's standard deviation is this times sqrt(rate)."""
    gyroscope_random_walk: float = 1.9393e-5
    """Random walk of the gyroscope's bias, rad/s^2/sqrt(Hz); the standard deviation of a step between samples is
    this times sqrt(1 / rate)."""
    gyroscope_bias: float = 0.02
    """Standard deviation of the gyroscope's bias at the first sample, rad/s."""
    accelerometer_noise_density: float = 2.0e-3
    """White noise of the accelerometer, m/s^2/sqrt(Hz)."""
    accelerometer_random_walk: float = 3.0e-3
    """Random walk of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    accelerometer_bias: float = 0.1
    """Standard deviation of the accelerometer's bias at the first sample, m/s^2."""
    time_offset_s: float = 0.0
    """Seconds by which the IMU's clock is ahead of the camera's at the time of row 0 of frame 0."""
    clock_drift: float = 0.0
    """Seconds that the IMU's clock gains on the camera's per second."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise ValueError(f"imu {field.name} = {value}: must be finite")
            if value < 0 and field.name not in ("time_offset_s", "clock_drift"):
                raise ValueError(f"imu {field.name} = {value}: must not be negative")
        if not 1.0 <= self.rate_hz <= _FASTEST_HZ:
            raise ValueError(f"imu rate_hz = {self.rate_hz}: must lie in [1, {_FASTEST_HZ:g}]")
        for name, most in (("time_offset_s", _LONGEST_OFFSET_S), ("clock_drift", _WORST_DRIFT)):
            if abs(getattr(self, name)) > most:
                raise ValueError(f"imu {name} = {getattr(self, name)}: must lie in [-{most:g}, {most:g}]")


class ImuSamples(NamedTuple):
    """Inertial samples (n) in order of time."""

    stamps_ns: NDArray[np.int64]
    """(n,) time stamps by the IMU's clock."""
    measured: FloatArray
    """(n, 6) measured angular velocity, rad/s, and specific force, m/s^2, in the axes of the body."""
    times_ns: NDArray[np.int64]
    """(n,) true times since row 0 of frame 0, as in the channel ``timing``."""
    true: FloatArray
    """(n, 6) true values of the same quantities."""
    bias: FloatArray
    """(n, 6) true bias: ``measured - true`` without the white noise."""


def sample_times_ns(
    imu: Imu, shutter: RollingShutter, frame_period_s: float, sensor: Sensor | None, frames: int
) -> NDArray[np.int64]:
    """Return the true times (n,) of the samples, from ``MARGIN_S`` before to ``MARGIN_S`` after all exposures.

    They are multiples of the IMU's period.
    """
    lines = [shutter.line_times(frame, side) for side, frame in views_of(frames)]
    first, last = (frame_period_s * reach(np.concatenate(lines)) for reach in (np.min, np.max))
    beyond = MARGIN_S + 0.5 * (sensor.longest_s if sensor else 0.0)
    counts = np.arange(
        math.floor((first - beyond) * imu.rate_hz), math.ceil((last + beyond) * imu.rate_hz) + 1, dtype=np.int64
    )
    return np.round(counts * (_NS / imu.rate_hz)).astype(np.int64)


def true_samples(
    motion: Motion, times_ns: NDArray[np.int64], frame_period_s: float, gravity: FloatArray
) -> FloatArray:
    """Return ``ImuSamples.true`` (n, 6) at times (n,); ``gravity`` (3,) is in the world frame, m/s^2."""
    felt = inertial(motion, times_ns / (_NS * frame_period_s), frame_period_s, gravity)
    return np.concatenate([felt.turn, felt.force], axis=1)


def stamps_of(imu: Imu, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert true times (n,) to time stamps of the IMU's clock."""
    gained = np.round(_NS * imu.time_offset_s + imu.clock_drift * times_ns).astype(np.int64)
    return np.asarray(times_ns + gained)


def deviations(imu: Imu) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the standard deviations (6,) of a sample's white noise, a bias step, and the initial bias."""
    root = math.sqrt(imu.rate_hz)
    per_kind = (
        (imu.gyroscope_noise_density * root, imu.accelerometer_noise_density * root),
        (imu.gyroscope_random_walk / root, imu.accelerometer_random_walk / root),
        (imu.gyroscope_bias, imu.accelerometer_bias),
    )
    noise, walk, start = (np.repeat(pair, 3) for pair in per_kind)
    return noise, walk, start


def draw_samples(
    imu: Imu, motion: Motion, times_ns: NDArray[np.int64], frame_period_s: float, gravity: FloatArray, seed: str
) -> ImuSamples:
    """Simulate the measurement of a motion; the noise depends on the seed, but not on the motion."""
    rng = generator(f"{seed}/imu")
    noise, walk, start = deviations(imu)
    steps = rng.standard_normal((len(times_ns), 6)) * np.where(np.arange(len(times_ns))[:, None] > 0, walk, start)
    bias = np.cumsum(steps, axis=0)
    true = true_samples(motion, times_ns, frame_period_s, gravity)
    measured = true + bias + noise * rng.standard_normal(true.shape)
    return ImuSamples(stamps_of(imu, times_ns), measured, times_ns, true, bias)


def gyro_samples(samples: ImuSamples, frame_period_s: float) -> FloatArray:
    """Return (n, 4) tau, w for ``Correspondences.gyro``: measured values at the uncorrected stamps of the IMU.

    The motion maps the world to the body, so w is the negative of the measured rate.
    """
    tau = samples.stamps_ns / (_NS * frame_period_s)
    return np.column_stack([tau, -frame_period_s * samples.measured[:, :3]])


def gravity_of(scene: Mapping[str, Any]) -> FloatArray:
    """Return gravity (3,), m/s^2, in the world frame, from the key ``scene`` of sequence.json; scenes have z up.

    Raises:
        RsbenchError: the viewpoint is missing or wrong.
    """
    place = parse_card(Viewpoint, {key: scene.get(key) for key in ("eye", "target")}, "sequence.json: scene")
    if "start" in scene:
        start = parse_card(Start, scene["start"], "sequence.json: scene.start")
        return -STANDARD_GRAVITY * start.world_from_scene(place)[0][:, 2]
    return -STANDARD_GRAVITY * place.world_from_scene()[0][:, 2]


def imu_manifest(imu: Imu, gravity: FloatArray) -> dict[str, Any]:
    """Return the content of imu.json."""
    axes = "of the rig's body: x right, y down, z forward; the sensor is in its origin"
    return {"axes": axes, "gravity": gravity.tolist(), **asdict(imu)}


def write_imu(folder: Path, imu: Imu, gravity: FloatArray, samples: ImuSamples) -> None:
    """Write all ``IMU_FILES`` below the folder of a sequence."""
    write_json(folder / IMU_MANIFEST, imu_manifest(imu, gravity))
    for file, columns, times, values in (
        (MEASURED, MEASURED_COLUMNS, samples.stamps_ns, samples.measured),
        (TRUE, TRUE_COLUMNS, samples.times_ns, np.concatenate([samples.true, samples.bias], axis=1)),
    ):
        rows = zip(times.tolist(), values.tolist(), strict=True)
        write_rows(folder / file, columns, ([time, *row] for time, row in rows))


def read_imu(folder: Path) -> ImuSamples:
    """Read the samples below the folder of a sequence.

    Raises:
        RsbenchError: a table is missing or invalid, or the two tables have different numbers of rows.
    """
    stamps, measured = _read_table(inside(folder, MEASURED), MEASURED_COLUMNS)
    times, values = _read_table(inside(folder, TRUE), TRUE_COLUMNS)
    if len(stamps) != len(times):
        raise RsbenchError(f"{folder / TRUE}: has {len(times)} rows, {MEASURED} has {len(stamps)}")
    return ImuSamples(stamps, measured, times, values[:, :6], values[:, 6:])


def _read_table(path: Path, columns: str) -> tuple[NDArray[np.int64], FloatArray]:
    """Read times (n,), ns, and values (n, columns - 1).

    Raises:
        RsbenchError: the file is missing or not such a table.
    """
    header, *lines = read_text(path).splitlines() or [""]
    with naming(f"{path}: not a table of numbers", ValueError, OverflowError):
        cells = [line.split(",") for line in lines]
        times = np.array([int(row[0]) for row in cells], dtype=np.int64)
        values = np.array([[float(cell) for cell in row[1:]] for row in cells])
    if header != columns or values.shape != (len(lines), columns.count(",")) or not len(lines):
        raise RsbenchError(f"{path}: must have the columns {columns}")
    if not np.all(np.isfinite(values)) or np.any(np.diff(times) <= 0):
        raise RsbenchError(f"{path}: numbers must be finite and times must grow")
    return times, values
