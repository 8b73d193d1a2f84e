"""Tables over time against the motion: row poses, and the channels ``timing`` and ``imu``."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, views_of
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.clock_channels import (
    IMU_MANIFEST,
    MEASURED,
    TIMING_COLUMNS,
    TIMING_MANIFEST,
    TRUE,
    Imu,
    ImuSamples,
    deviations,
    gravity_of,
    imu_manifest,
    sample_times_ns,
    stamps_of,
    table_file,
    timing_manifest,
    timing_table,
    true_samples,
)
from rsbench.dataset.sequence import Sequence
from rsbench.storage.files import read_pose_table
from rsbench.verification.findings import Finding, cheapest_cause, reports_unreadable, rows_of

_ROUNDING = 1e-12
"""Tolerance of row times (frame periods), quaternions and places (metres): a thousand roundings of numbers near
1."""


def pose_faults(sequence: Sequence) -> Iterator[Finding]:
    """Stored row poses that are not the motion at the row times."""
    for side, frame in views_of(sequence.frames):
        yield from _pose_table_faults(sequence, side, frame)


@reports_unreadable
def _pose_table_faults(sequence: Sequence, side: Side, frame: int) -> Iterator[Finding]:
    file = f"poses/{side}_{frame}.csv"
    table = read_pose_table(sequence.folder / file)
    if len(table) != (lines := sequence.shutter.lines(side)):
        yield Finding(file, f"has {len(table)} rows, the camera has {lines}")
        return
    norm = np.linalg.norm(table[:, 2:6], axis=1)
    zero = norm == 0
    if np.any(zero):
        yield Finding(file, "the quaternion is zero", rows_of(zero))
        return
    unlike_unit = np.abs(norm - 1) > _ROUNDING
    if np.any(unlike_unit):
        worst = norm[np.argmax(np.abs(norm - 1))]
        yield Finding(file, f"quaternion of norm {worst:.9g}, not 1", rows_of(unlike_unit))
    # At w = 0, half a turn, both signs are right.
    negated = table[:, 2] < -_ROUNDING
    if np.any(negated):
        yield Finding(
            file, f"quaternion with w = {table[negated, 2].min():.6g}: w >= 0 is needed", rows_of(negated)
        )
    expected = _pose_table(sequence, side, frame)
    wrong_time, wrong_angle, wrong_place = _differences(table, expected)
    wrong = np.maximum.reduce([wrong_time, wrong_angle, wrong_place]) > _ROUNDING
    if np.any(wrong):
        what = (
            f"differs from the motion by {np.max(wrong_time):.1e} periods, {np.max(wrong_angle):.1e} rad, "
            f"{np.max(wrong_place):.1e} m"
        )
        yield Finding(file, what, rows_of(wrong), _pose_cause(sequence, side, frame, table))


def _pose_table(sequence: Sequence, side: Side, frame: int) -> FloatArray:
    """Row time, rotation matrix and translation (H, 13) that the motion gives."""
    pose = row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame)
    tau = sequence.shutter.line_times(frame, side)
    return np.concatenate([tau[:, None], pose.R.reshape(-1, 9), pose.t], axis=1)


def _differences(table: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences of each row: time (frame periods), angle (rad) and place (m)."""
    R = so3.from_quaternion(table[:, 2:6])
    angle = so3.angle(R @ np.swapaxes(expected[:, 1:10].reshape(-1, 3, 3), -1, -2))
    place = np.max(np.abs(table[:, 6:9] - expected[:, 10:]), axis=1)
    return np.abs(table[:, 1] - expected[:, 0]), np.abs(angle), place


def _pose_cause(sequence: Sequence, side: Side, frame: int, table: FloatArray) -> str:
    """What the poses are instead, where that is plain."""
    own = _pose_table(sequence, side, frame)
    turned = inverse(row_poses(sequence.rig, sequence.shutter, sequence.motion, side, frame))
    back = np.concatenate([own[:, :1], turned.R.reshape(-1, 9), turned.t], axis=1)
    candidates = [("shifted by one row", np.roll(own, rows, axis=0)) for rows in (-1, 1)]
    candidates += [
        (f"the poses of {other}_{number}", _pose_table(sequence, other, number))
        for other, number in views_of(sequence.frames)
        if (other, number) != (side, frame) and sequence.shutter.lines(other) == len(table)
    ]
    candidates.append(("world_from_cam instead of cam_from_world", back))
    return next((f"looks like {words}" for words, each in candidates if _mostly(table, each)), "")


def _mostly(table: FloatArray, expected: FloatArray) -> bool:
    """Whether places and rotations are the expected ones in nearly all rows; times may be those of the file."""
    _, angle, place = _differences(table, expected)
    return bool(np.mean(np.maximum(angle, place) <= 1e-9) > 0.95)


_NEAR_NS = 1.0
"""Both sides were rounded to a nanosecond at most."""


def timing_faults(sequence: Sequence, reported: Collection[str]) -> Iterator[Finding]:
    """Where timing.json and its tables differ from sequence.json and the poses, but for files ``reported``."""
    if "timing" not in sequence.channels:
        return
    if TIMING_MANIFEST not in reported:
        yield from _timing_manifest_faults(sequence)
    for side, frame in views_of(sequence.frames):
        if table_file(side, frame) not in reported:
            yield from _timing_table_faults(sequence, side, frame, reported)


@reports_unreadable
def _timing_manifest_faults(sequence: Sequence) -> Iterator[Finding]:
    stored = sequence.timing()
    expected = timing_manifest(sequence.shutter, sequence.frame_period_s, sequence.sensor, sequence.frames)
    for key, value in expected.items():
        own = stored.get(key)
        if not isinstance(value, dict) or not isinstance(own, dict):
            if own != value:
                yield Finding(TIMING_MANIFEST, f"{key} = {own!r}, sequence.json makes {value!r}")
            continue
        for name, part in value.items():
            if own.get(name) != part:
                yield Finding(TIMING_MANIFEST, f"{key}.{name} = {own.get(name)!r}, sequence.json makes {part!r}")


@reports_unreadable
def _timing_table_faults(
    sequence: Sequence, side: Side, frame: int, reported: Collection[str]
) -> Iterator[Finding]:
    file, poses = table_file(side, frame), f"poses/{side}_{frame}.csv"
    stored = sequence.row_times_ns(side, frame)
    expected = _timing_table(sequence, side, frame)
    for name, own, made in zip(TIMING_COLUMNS.split(","), stored.T, expected.T, strict=True):
        off = own - made
        if np.any(np.abs(off) > _NEAR_NS):
            times = range(sequence.frames)
            like = [each for each in times if np.array_equal(stored, _timing_table(sequence, side, each))]
            cause = f"looks like those of frame {like[0]}" if like else ""
            what = f"{name} differs from what sequence.json makes, by up to {np.max(np.abs(off))} ns"
            yield Finding(file, what, rows_of(np.abs(off) > _NEAR_NS), cause)
            return
    if poses not in reported:
        tau, _ = sequence.poses(side, frame)
        off = np.abs(stored[:, 1] - 1e9 * sequence.frame_period_s * tau)
        if np.any(off > _NEAR_NS):
            yield Finding(
                file, f"time_ns differs from {poses}, by up to {np.max(off):.3g} ns", rows_of(off > _NEAR_NS)
            )


def _timing_table(sequence: Sequence, side: Side, frame: int) -> NDArray[np.int64]:
    return timing_table(sequence.shutter, sequence.frame_period_s, sequence.sensor, side, frame)


_SAME_SAMPLE = 1e-9
"""Relative to 1 + the value: thousands of roundings."""
_SIGMAS = 6.0
"""Beyond which a sum of squares is not of the stated noise: once in 10^9."""
_KINDS = {"gyroscope": slice(0, 3), "accelerometer": slice(3, 6)}


@reports_unreadable
def imu_faults(sequence: Sequence, reported: Collection[str]) -> Iterator[Finding]:
    """What the inertial sensor shows that the motion cannot have made, but for files ``reported``."""
    if "imu" not in sequence.channels:
        return
    scene = sequence.manifest.get("scene")
    gravity = gravity_of(scene if isinstance(scene, dict) else {})
    imu = sequence.imu
    if imu is None:
        yield Finding("sequence.json", "lacks 'imu', the sensor of the channel of this name")
        return
    if IMU_MANIFEST not in reported:
        yield from _imu_manifest_faults(sequence, imu, gravity)
    if not {MEASURED, TRUE} & set(reported):
        yield from _sample_faults(sequence, imu, gravity, sequence.inertial())


def _imu_manifest_faults(sequence: Sequence, imu: Imu, gravity: FloatArray) -> Iterator[Finding]:
    stored = sequence.imu_manifest()
    for key, value in imu_manifest(imu, gravity).items():
        own = stored.get(key)
        same = own == value
        if key == "gravity" and isinstance(own, list) and len(own) == 3 and all(isinstance(x, float) for x in own):
            same = bool(np.max(np.abs(np.array(own) - gravity)) <= _SAME_SAMPLE * np.linalg.norm(gravity))
        if not same:
            yield Finding(IMU_MANIFEST, f"{key} = {own!r}, sequence.json makes {value!r}")


def _sample_faults(sequence: Sequence, imu: Imu, gravity: FloatArray, samples: ImuSamples) -> Iterator[Finding]:
    times = sample_times_ns(imu, sequence.shutter, sequence.frame_period_s, sequence.sensor, sequence.frames)
    if len(times) != len(samples.times_ns) or np.any(np.abs(times - samples.times_ns) > _NEAR_NS):
        covers = f"{len(times)} samples of {imu.rate_hz:g} Hz from {times[0]} to {times[-1]} ns"
        yield Finding(TRUE, f"time_ns is not that of {covers}")
        return
    late = np.abs(samples.stamps_ns - stamps_of(imu, times)) > _NEAR_NS
    if np.any(late):
        off = np.max(np.abs(samples.stamps_ns - stamps_of(imu, times)))
        yield Finding(
            MEASURED, f"stamp_ns differs by up to {off} ns from what offset and drift make", rows_of(late)
        )
    true = true_samples(sequence.motion, times, sequence.frame_period_s, gravity)
    upward = true - true_samples(sequence.motion, times, sequence.frame_period_s, np.zeros(3))
    for name, columns in _KINDS.items():
        off = np.abs(samples.true - true)[:, columns]
        wrong = np.any(~(off <= _SAME_SAMPLE * (1.0 + np.abs(true[:, columns]))), axis=1)
        if np.any(wrong):
            what = f"{name} differs from what the motion makes, by up to {np.max(off):.3g}"
            cause = _imu_cause(samples.true[:, columns], true[:, columns], upward[:, columns])
            yield Finding(TRUE, what, rows_of(wrong), cause)
            return
    yield from _noise_faults(imu, samples, upward)


def _noise_faults(imu: Imu, samples: ImuSamples, upward: FloatArray) -> Iterator[Finding]:
    """Measured less true must be the bias and white noise; and the bias must walk."""
    noise, walk, start = deviations(imu)
    white = samples.measured - samples.true - samples.bias
    steps, first = np.diff(samples.bias, axis=0), samples.bias[:1]
    for name, columns in _KINDS.items():
        for file, words, values, sigma in (
            (TRUE, f"first bias of the {name}", first, start),
            (TRUE, f"steps of the bias of the {name}", steps, walk),
            (MEASURED, f"noise of the {name}", white, noise),
        ):
            unlike = _unlike_noise(values[:, columns], float(sigma[columns][0]))
            if unlike:
                shown = samples.measured[:, columns], samples.true[:, columns], upward[:, columns]
                yield Finding(file, f"{words} {unlike}", cause=_imu_cause(*shown) if file == MEASURED else "")


def _unlike_noise(values: FloatArray, sigma: float) -> str:
    """How values (n, 3) differ from independent normal draws of this deviation; "" where they do not.

    Twice a sum of squares has, under the root, nearly the deviation 1 about that of twice the count less one
    (R. A. Fisher); the product of neighbours has that of the count.
    """
    count = values.size
    if count == 0:
        return ""
    size = float(np.sqrt(np.mean(values**2)))
    if sigma == 0.0:
        return f"is {size:.3g}, stated is none" if size > _SAME_SAMPLE else ""
    share = float(np.sum((values / sigma) ** 2))
    if abs(np.sqrt(2.0 * share) - np.sqrt(2.0 * count - 1.0)) > _SIGMAS:
        return f"is {size:.3g}, stated is {sigma:.3g}"
    neighbours = (values[1:] * values[:-1]) / sigma**2
    if abs(float(np.sum(neighbours))) > _SIGMAS * np.sqrt(max(neighbours.size, 1)):
        return "is not white: neighbours are alike"
    return ""


def _imu_cause(own: FloatArray, true: FloatArray, upward: FloatArray) -> str:
    """What values (n, 3) are instead of the true ones, in words; "" where nothing explains most of it.

    ``upward`` (n, 3) is the part of the true ones that gravity has.
    """
    tried = {
        "negated": -own,
        "in degrees": np.deg2rad(own),
        "x, y and z exchanged": own[:, [1, 2, 0]],
        "y, z and x exchanged": own[:, [2, 0, 1]],
        "shifted by one sample": np.roll(own, -1, axis=0),
        "shifted by one sample back": np.roll(own, 1, axis=0),
        "without gravity": own + upward,
    }
    costs = {words: float(np.median(np.abs(each - true))) for words, each in tried.items()}
    return cheapest_cause(costs, float(np.median(np.abs(own - true))))
