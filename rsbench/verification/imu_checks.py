"""The channel ``imu`` against the motion, gravity and the sensor's own statistics."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.dataset.imu import (
    IMU_MANIFEST,
    MEASURED,
    TRUE,
    Imu,
    ImuSamples,
    deviations,
    gravity_of,
    imu_manifest,
    sample_times_ns,
    stamps_of,
    true_samples,
)
from rsbench.dataset.sequence import Sequence
from rsbench.verification.findings import Finding, rows_of

_SAME = 1e-9
"""Relative to 1 + the value: thousands of roundings."""
_NEAR_NS = 1.0
_SIGMAS = 6.0
"""Beyond which a sum of squares is not of the stated noise: once in 10^9."""
_KINDS = {"gyroscope": slice(0, 3), "accelerometer": slice(3, 6)}


def imu_faults(sequence: Sequence, reported: Collection[str]) -> Iterator[Finding]:
    """What the inertial sensor shows that the motion cannot have made, but for files ``reported``."""
    if "imu" not in sequence.channels:
        return
    try:
        scene = sequence.manifest.get("scene")
        gravity = gravity_of(scene if isinstance(scene, dict) else {})
        imu = sequence.imu
        if imu is None:
            yield Finding("sequence.json", "lacks 'imu', the sensor of the channel of this name")
            return
        if IMU_MANIFEST not in reported:
            yield from _manifest_faults(sequence, imu, gravity)
        if not {MEASURED, TRUE} & set(reported):
            yield from _sample_faults(sequence, imu, gravity, sequence.inertial())
    except RsbenchError as error:
        yield Finding.of(error)


def _manifest_faults(sequence: Sequence, imu: Imu, gravity: FloatArray) -> Iterator[Finding]:
    stored = sequence.imu_manifest()
    for key, value in imu_manifest(imu, gravity).items():
        own = stored.get(key)
        same = own == value
        if key == "gravity" and isinstance(own, list) and len(own) == 3 and all(isinstance(x, float) for x in own):
            same = bool(np.max(np.abs(np.array(own) - gravity)) <= _SAME * np.linalg.norm(gravity))
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
        wrong = np.any(~(off <= _SAME * (1.0 + np.abs(true[:, columns]))), axis=1)
        if np.any(wrong):
            what = f"{name} differs from what the motion makes, by up to {np.max(off):.3g}"
            cause = _cause(samples.true[:, columns], true[:, columns], upward[:, columns])
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
            unlike = _unlike(values[:, columns], float(sigma[columns][0]))
            if unlike:
                shown = samples.measured[:, columns], samples.true[:, columns], upward[:, columns]
                yield Finding(file, f"{words} {unlike}", cause=_cause(*shown) if file == MEASURED else "")


def _unlike(values: FloatArray, sigma: float) -> str:
    """How values (n, 3) differ from independent normal draws of this deviation; "" where they do not.

    Twice a sum of squares has, under the root, nearly the deviation 1 about that of twice the count less one
    (R. A. Fisher); the product of neighbours has that of the count.
    """
    count = values.size
    if count == 0:
        return ""
    size = float(np.sqrt(np.mean(values**2)))
    if sigma == 0.0:
        return f"is {size:.3g}, stated is none" if size > _SAME else ""
    share = float(np.sum((values / sigma) ** 2))
    if abs(np.sqrt(2.0 * share) - np.sqrt(2.0 * count - 1.0)) > _SIGMAS:
        return f"is {size:.3g}, stated is {sigma:.3g}"
    neighbours = (values[1:] * values[:-1]) / sigma**2
    if abs(float(np.sum(neighbours))) > _SIGMAS * np.sqrt(max(neighbours.size, 1)):
        return "is not white: neighbours are alike"
    return ""


def _cause(own: FloatArray, true: FloatArray, upward: FloatArray) -> str:
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
    best = min(costs, key=costs.__getitem__)
    return f"looks {best}" if costs[best] < 0.2 * float(np.median(np.abs(own - true))) else ""
