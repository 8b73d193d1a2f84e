"""The channel ``imu``: its noise against the model, its integral against the poses, and faults planted into it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from attack.planting import named

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.clock_channels import (
    MARGIN_S,
    MEASURED,
    TRUE,
    Imu,
    ImuSamples,
    draw_samples,
    gravity_of,
    sample_times_ns,
    true_samples,
    write_imu,
)
from rsbench.dataset.sequence import read_sequence, sequence_manifest
from rsbench.renderers.image import Sensor
from rsbench.storage.files import write_json
from rsbench.verification.pose_checks import imu_faults

RIG = StereoRig(camera=PinholeCamera.centred(64, 48, 60.0), baseline=0.3)
SHUTTER = RollingShutter(height=48, readout_ratio=0.9)
MOTION = SplineMotion([0.05, -0.1, 0.08], [0.2, -0.1, 0.3], preset="handheld", seed=4)
IMU = Imu(time_offset_s=0.0031, clock_drift=1e-4)
SCENE = {"eye": [0.0, -4.0, 1.2], "target": [0.2, 3.0, 0.1]}
SENSOR = Sensor(exposure_s=0.004)
TIMES = sample_times_ns(IMU, SHUTTER, 0.1, SENSOR, 2)


def drawn(seed: str, imu: Imu = IMU) -> ImuSamples:
    return draw_samples(imu, MOTION, TIMES, 0.1, gravity_of(SCENE), seed)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A sequence that is nothing but its inertial sensor."""
    folder = tmp_path / "shaken"
    (folder / "imu").mkdir(parents=True)
    manifest = sequence_manifest(name="shaken", rig=RIG, shutter=SHUTTER, motion=MOTION, frame_period_s=0.1)
    own: dict[str, Any] = {
        "scene": SCENE,
        "sensor": asdict(SENSOR),
        "channels": ["imu"],
        "imu": asdict(IMU),
        "files": {},
    }
    write_json(folder / "sequence.json", manifest | own)
    write_imu(folder, IMU, gravity_of(SCENE), drawn("1"))
    return folder


def test_samples_reach_beyond_all_exposures() -> None:
    """Rows are exposed from -2 ms to 100 + 90 * 47 / 48 + 2 ms."""
    assert np.all(np.diff(TIMES) == 5_000_000) and np.all(TIMES % 5_000_000 == 0)
    beyond = 1e9 * MARGIN_S
    assert -5e6 < TIMES[0] - (-2e6 - beyond) <= 0 and 0 <= TIMES[-1] - (1e8 + 90e6 * 47 / 48 + 2e6 + beyond) < 5e6


def test_what_is_written_is_read(folder: Path) -> None:
    written, read = drawn("1"), read_sequence(folder).inertial()
    for one, other in zip(written, read, strict=True):
        np.testing.assert_array_equal(one, other)
    assert read.stamps_ns[0] == round(TIMES[0] * (1 + 1e-4) + 3.1e6)
    header, first, *_ = (folder / MEASURED).read_text().splitlines()
    assert header == "stamp_ns,wx,wy,wz,ax,ay,az" and first.startswith(f"{read.stamps_ns[0]},")


def test_gravity_pulls_down_the_picture() -> None:
    """The view is level but for a look down by atan(1.1 / |(0.2, 7)|)."""
    g, slope = gravity_of(SCENE), 1.1 / np.hypot(0.2, 7.0)
    np.testing.assert_allclose(g / 9.80665, np.array([0.0, 1.0, slope]) / np.hypot(1.0, slope), rtol=0, atol=1e-12)


def test_the_gyroscope_integrates_back_to_the_poses_within_its_noise() -> None:
    """Angles between the stamps 0 and 0.19 s, less the bias: their deviation is density * sqrt(time), by the
    trapezoidal rule half a sample less. 100 draws of 3 angles: 6 sigma of their mean square is 50 %."""
    first, last = np.searchsorted(TIMES, (0, 190_000_000))
    truth = [MOTION.body_from_world(TIMES[k] / 1e8).R for k in (first, last)]
    angles = []
    for seed in range(100):
        samples = drawn(str(seed))
        turn = (samples.measured - samples.bias)[first : last + 1, :3]
        R = np.eye(3)
        for step in so3.exp(0.0025 * (turn[1:] + turn[:-1])):
            R = R @ step
        angles.append(so3.log(R @ truth[1] @ truth[0].T))
    assert np.mean(np.square(angles)) == pytest.approx(IMU.gyroscope_noise_density**2 * 0.1875, rel=0.5)


@pytest.mark.parametrize("kind", [0, 3])
def test_noise_has_the_densities_that_are_stated(kind: int) -> None:
    """At 200 Hz: white noise of sqrt(200) densities a sample, steps of the bias of sqrt(1 / 200) of theirs."""
    imu = Imu(accelerometer_noise_density=0.001, accelerometer_random_walk=0.02)
    draws = [drawn(f"a{seed}", imu) for seed in range(50)]
    white = np.stack([each.measured - each.true - each.bias for each in draws])[..., kind : kind + 3]
    steps = np.diff(np.stack([each.bias for each in draws]), axis=1)[..., kind : kind + 3]
    stated = (imu.gyroscope_noise_density, imu.gyroscope_random_walk) if kind == 0 else (0.001, 0.02)
    # 9000 and more values: 6 sigma of a mean square is 9 %.
    assert np.mean(white**2) == pytest.approx(stated[0] ** 2 * 200, rel=0.09)
    assert np.mean(steps**2) == pytest.approx(stated[1] ** 2 / 200, rel=0.09)


def test_sound_samples_pass(folder: Path) -> None:
    assert list(imu_faults(read_sequence(folder), ())) == []
    for seed in range(12):
        write_imu(folder, IMU, gravity_of(SCENE), drawn(f"sound {seed}"))
        assert list(imu_faults(read_sequence(folder), ())) == []


def samples_of(change: Callable[[ImuSamples], ImuSamples]) -> Callable[[Path], None]:
    def plant(folder: Path) -> None:
        write_imu(folder, IMU, gravity_of(SCENE), change(read_sequence(folder).inertial()))

    return plant


def replaced(**changes: Callable[[ImuSamples], Any]) -> Callable[[Path], None]:
    """Fields of the samples, made of the samples as they are."""
    return samples_of(lambda old: old._replace(**{name: change(old) for name, change in changes.items()}))


def both(columns: slice, change: Callable[[FloatArray], FloatArray]) -> Callable[[Path], None]:
    """Measured and true alike, as whoever errs about the frame would have them."""

    def changed(values: FloatArray) -> FloatArray:
        out = values.copy()
        out[:, columns] = change(out[:, columns])
        return out

    return replaced(measured=lambda old: changed(old.measured), true=lambda old: changed(old.true))


def other_gravity(folder: Path) -> None:
    write_imu(folder, IMU, np.array([0.0, 0.0, -9.80665]), drawn("1"))


UPWARD = (true_samples(MOTION, TIMES, 0.1, gravity_of(SCENE)) - true_samples(MOTION, TIMES, 0.1, np.zeros(3)))[
    :, 3:
]
GYROSCOPE, ACCELEROMETER = slice(0, 3), slice(3, 6)
FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "a turn of the other sign": (both(GYROSCOPE, np.negative), (TRUE, "gyroscope", "looks negated")),
    "degrees": (both(GYROSCOPE, np.rad2deg), (TRUE, "gyroscope", "looks in degrees")),
    "axes of a robot": (both(ACCELEROMETER, lambda a: a[:, [2, 0, 1]]), (TRUE, "x, y and z exchanged")),
    "no gravity": (both(ACCELEROMETER, lambda a: a - UPWARD), (TRUE, "looks without gravity")),
    "one sample late": (both(GYROSCOPE, lambda w: np.roll(w, 1, axis=0)), (TRUE, "shifted by one sample")),
    "twice the noise": (
        replaced(measured=lambda old: 2 * old.measured - old.true - old.bias),
        (MEASURED, "noise of the gyroscope is"),
    ),
    "no noise": (
        replaced(measured=lambda old: old.true + old.bias),
        (MEASURED, "noise of the accelerometer", "stated is 0.0283"),
    ),
    "measured of the other sign": (
        replaced(measured=lambda old: -old.measured),
        (MEASURED, "accelerometer", "looks negated"),
    ),
    "smoothed": (
        replaced(
            measured=lambda old: old.true + old.bias + np.sqrt(0.5) * _pairs(old.measured - old.true - old.bias)
        ),
        (MEASURED, "not white"),
    ),
    "a bias that stays": (
        replaced(
            measured=lambda old: old.measured - old.bias + old.bias[0],
            bias=lambda old: 0 * old.bias + old.bias[0],
        ),
        (TRUE, "steps of the bias"),
    ),
    "no time offset": (replaced(stamps_ns=lambda old: old.times_ns), (MEASURED, "stamp_ns differs")),
    "a sample left out": (
        samples_of(lambda old: ImuSamples._make(np.delete(each, 9, axis=0) for each in old)),
        (TRUE, "is not that of", "200 Hz"),
    ),
    "another gravity": (other_gravity, ("imu/imu.json", "gravity")),
    "a table of words": (lambda folder: write_words(folder / TRUE), (TRUE, "not a table")),
}


def _pairs(noise: FloatArray) -> FloatArray:
    return noise + np.roll(noise, 1, axis=0)


def write_words(path: Path) -> None:
    path.write_text(path.read_text().replace("0.", "zero"))


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_named(folder: Path, name: str) -> None:
    plant, words = FAULTS[name]
    plant(folder)
    faults = list(map(str, imu_faults(read_sequence(folder), ())))
    assert named(faults, words), faults


def test_sensors_that_cannot_be_are_refused() -> None:
    for wrong in (
        {"rate_hz": 0.0},
        {"gyroscope_bias": -1.0},
        {"time_offset_s": 2.0},
        {"clock_drift": float("nan")},
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Imu(**wrong)
