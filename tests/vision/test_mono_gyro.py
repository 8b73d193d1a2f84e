"""Frames of one camera corrected with a gyroscope: shaken closed-form worlds, and logs as others write them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import assert_refused, run_here

import rsbench
from rsbench.core.errors import RsbenchError
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.spline_motion import SplineMotion
from rsbench.interop.readers.gyro_log import read_gyro_log
from rsbench.pipeline.mono_gyro import CONTRADICTED, NOT_COVERED
from rsbench.pipeline.mono_sequence import MonoMoment, MonoOptions, correct_frames
from rsbench.storage.files import read_json, read_png, write_png

Array = np.ndarray
TAU = np.arange(-5, 41) / 16.0
"""Sixteen samples a frame period, as 500 Hz at 30 frames a second."""


def shaken(world: Callable[..., Any], shapes: Any, preset: str, seed: int = 0, scan: Scan = "top") -> Any:
    """A leaning wall and a ball, seen by a hand-held left camera."""
    plane, sphere = shapes
    size = {"size": (144, 192), "focal": 180.0, "readout_ratio": 1.0, "shortest": 0.5}
    made = world((plane((0.3, 0.2, 1.0), 7.0), sphere((0.4, 0.3, 4.0), 0.8)), **size)
    motion = SplineMotion(np.deg2rad([0.6, 1.0, -0.5]), np.array([0.15, -0.1, 0.2]), preset=preset, seed=seed)
    shutter = RollingShutter(height=144, width=192, readout_ratio=1.0, scan=scan)
    return replace(made, motion=motion, shutter=shutter, rig=made.rig.about("left"))


def measured(scene: Any, seed: int = 0) -> Array:
    """Samples (n, 4) with a bias of 0.02 rad/s and noise of 0.003 rad/s at 30 frames a second."""
    rng = np.random.default_rng(seed)
    bias, noise = 6e-4 * rng.normal(size=3), 1e-4 * rng.normal(size=(len(TAU), 3))
    return np.column_stack([TAU, scene.motion.velocity(TAU)[0] + bias + noise])


def corrected(scene: Any, u8: Any, gyro: Array | None) -> MonoMoment:
    """Its second frame at the time of its middle line."""
    frames = [u8(scene.rolling("left", frame)[0]) for frame in (0, 1)]
    options = MonoOptions.of(None, 0, None)
    return list(correct_frames(frames, scene.rig.camera, scene.shutter, options, gyro=gyro))[1]


def psnr(moment: MonoMoment, scene: Any, truth: Any) -> float:
    """dB of what the frame saw, 4 px away from what it did not."""
    lines = scene.shutter.lines("left")
    true = truth(scene, "left", 1, float(scene.shutter.time_after((lines - 1) / 2, 1, "left")))
    seen = cv2.erode(true.visible.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    error = (moment.fused.image.astype(float) - 255.0 * true.image)[seen]
    return float(10.0 * np.log10(255.0**2 / np.mean(error**2)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "seed", "scan", "gain"),
    [
        # What two frames cannot show: the rate of turn changes between the rows.
        ("handheld", 0, "top", 4.0),
        ("handheld", 1, "right", 4.0),
        ("driving", 0, "bottom", 4.0),
        # A constant rate fits: noise of the samples may cost a little, of more than 35 dB.
        ("steady", 0, "top", -0.5),
    ],
)
def test_a_gyroscope_tells_what_two_frames_do_not(
    world: Any, shapes: Any, u8: Any, truth: Any, preset: str, seed: int, scan: Scan, gain: float
) -> None:
    scene = shaken(world, shapes, preset, seed, scan)
    without, given = corrected(scene, u8, None), corrected(scene, u8, measured(scene))
    assert given.found is not None and not given.found.unused
    assert psnr(given, scene, truth) > psnr(without, scene, truth) + gain
    motion = given.found.own.motion
    assert motion is not None and motion.name == "gyro"
    # The motion is that of the real camera, whatever side its lines are read from: 0.1 px of flow are 0.03 deg.
    assert np.rad2deg(np.linalg.norm(motion.w - scene.motion.w)) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("factor", [-1.0, 50.0])
def test_a_gyroscope_of_another_sign_or_unit_is_not_believed(
    world: Any, shapes: Any, u8: Any, factor: float
) -> None:
    scene = shaken(world, shapes, "handheld")
    wrong = measured(scene) * [1.0, factor, factor, factor]
    without, given = corrected(scene, u8, None), corrected(scene, u8, wrong)
    assert given.found is not None and given.found.unused == CONTRADICTED
    np.testing.assert_array_equal(given.fused.image, without.fused.image)


def test_samples_of_another_time_are_not_used(world: Any, shapes: Any, u8: Any) -> None:
    scene = shaken(world, shapes, "steady")
    given = corrected(scene, u8, measured(scene)[:20])
    assert given.found is not None and given.found.unused == NOT_COVERED


def test_frames_without_texture_are_corrected_by_rotation_alone(world: Any, shapes: Any, u8: Any) -> None:
    """A far light in the dark: refused without a gyroscope, in place with it."""
    plane, _ = shapes
    scene = shaken(world, shapes, "handheld")

    class Light:
        shortest = 1.0

        def __call__(self, X: Array) -> Array:
            apart = np.sum((X[..., :2] - [3.0, 20.0]) ** 2, axis=-1, keepdims=True)
            return np.repeat(0.1 + 0.6 * np.exp(-apart / 0.5), 3, axis=-1)

    def place(image: Array) -> Array:
        """Its middle, px."""
        bright = np.maximum(image[..., 0].astype(float) - 40.0, 0.0)
        y, x = np.indices(bright.shape)
        return np.array([np.sum(bright * x), np.sum(bright * y)]) / np.sum(bright)

    scene = replace(scene, surfaces=(plane((0.0, 0.0, 1.0), 60.0),), texture=Light())
    frames = [u8(scene.rolling("left", frame)[0]) for frame in (0, 1)]
    with pytest.raises(RsbenchError, match="no texture"):
        rsbench.correct(frames, camera=scene.rig.camera, readout_ratio=1.0)
    fused = rsbench.correct(frames, camera=scene.rig.camera, readout_ratio=1.0, gyro=measured(scene))[1]
    true = place(u8(scene.still("left", 1.0)[0]))
    before, after = (float(np.linalg.norm(place(image) - true)) for image in (frames[1], fused.image))
    # The way of 0.25 m moves what is 60 m away by 0.7 px at most, the gyroscope's bias by 0.1 px.
    assert before > 2.5 and after < 0.8
    assert np.all(np.isinf(fused.depth[fused.origin == 1]))


# Logs


def written(path: Path, title: str = "GYROFLOW IMU LOG", **keys: str) -> tuple[Path, Array, Array]:
    """A .gcsv of random rates; times in s, and rates in the camera's axes, rad/s."""
    rng = np.random.default_rng(1)
    raw = rng.integers(-3000, 3000, (30, 3))
    head = {"version": "1.3", "id": "logger", "orientation": "YxZ", "tscale": "0.002", "gscale": "0.001", **keys}
    head = {key: value for key, value in head.items() if value}
    rows = [f"{k},{a},{b},{c},0,0,16384" for k, (a, b, c) in enumerate(raw.tolist())]
    text = [title, *(f"{key},{value}" for key, value in head.items()), "t,gx,gy,gz,ax,ay,az", *rows, "30,17"]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    # YxZ: up is their second column, left minus their first, backwards their third.
    up, left, back = raw[:, 1], -raw[:, 0], raw[:, 2]
    return path, 0.002 * np.arange(30), 0.001 * np.stack([-left, -up, -back], axis=-1)


def test_a_log_of_gyroflow(tmp_path: Path) -> None:
    path, times, rates = written(tmp_path / "log.gcsv", note="a, b")
    log = read_gyro_log(path)
    np.testing.assert_allclose(log.times_s, times, atol=1e-12)
    np.testing.assert_allclose(log.rates, rates, atol=1e-12)
    samples = log.samples(25.0, 0.004)
    np.testing.assert_allclose(samples[:, 0], (times - 0.004) * 25.0, atol=1e-12)
    # What carries points into the camera turns the other way.
    np.testing.assert_allclose(samples[:, 1:], -rates / 25.0, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"title": "BLACKBOX"}, "must begin with GYROFLOW IMU LOG"),
        ({"gscale": ""}, "has no gscale"),
        ({"tscale": "fast"}, "tscale: 'fast': must be numbers"),
        ({"tscale": "-1"}, "tscale = -1: must be positive"),
        ({"orientation": "XYx"}, "orientation = 'XYx'"),
    ],
)
def test_logs_that_are_none_are_refused(tmp_path: Path, keys: dict[str, str], words: str) -> None:
    path, _, _ = written(tmp_path / "log.gcsv", **keys)
    with pytest.raises(RsbenchError, match=words):
        read_gyro_log(path)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["t,wx,wy,wz", "0,1,2,3"], "must have the columns stamp_ns,wx,wy,wz"),
        (["stamp_ns,wx,wy,wz", "0,1,2,x", "1,1,2,3"], "not a table of numbers"),
        (["stamp_ns,wx,wy,wz", "0,1,2,nan", "1,1,2,3"], "finite"),
        (["stamp_ns,wx,wy,wz", "5,1,2,3", "1,1,2,3"], "in the order of time"),
        (["stamp_ns,wx,wy,wz", "5,1,2,3", "5,1,2,3"], "one time"),
        (["stamp_ns,wx,wy,wz"], "two samples"),
        ([], "must have the columns"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path: Path, rows: list[str], words: str) -> None:
    (tmp_path / "log.csv").write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(RsbenchError, match=words):
        read_gyro_log(tmp_path / "log.csv")


@pytest.mark.slow
def test_the_command_takes_a_log(tmp_path: Path, world: Any, shapes: Any, u8: Any) -> None:
    scene = shaken(world, shapes, "handheld")
    for frame in (0, 1):
        write_png(tmp_path / f"{frame}.png", u8(scene.rolling("left", frame)[0]))
    (tmp_path / "camera.toml").write_text(
        "readout_ratio = 1.0\n[camera]\nfx = 180\nfy = 180\ncx = 95.5\ncy = 71.5\n"
    )
    samples, period = measured(scene), 1.0 / 20.0
    rows = [
        f"{round(1e9 * (1.5 + tau * period))},{','.join(map(repr, (-w / period).tolist()))}"
        for tau, w in zip(samples[:, 0], samples[:, 1:], strict=True)
    ]
    (tmp_path / "log.csv").write_text("stamp_ns,wx,wy,wz\n" + "\n".join(rows), encoding="utf-8")

    def run(*more: Any) -> Any:
        files = [tmp_path / "0.png", tmp_path / "1.png", "--camera", tmp_path / "camera.toml"]
        return run_here("correct", *files, "--target", "middle", "--out", tmp_path / "out", *more)

    assert_refused(run("--gyro", tmp_path / "log.csv"), "--fps")
    assert_refused(run("--gyro", tmp_path / "log.csv", "--fps", 20), "--gyro-offset")
    assert_refused(run("--gyro", tmp_path / "log.txt", "--fps", 20), ".gcsv")
    assert_refused(run("--fps", 20), "--gyro")
    done = run("--gyro", tmp_path / "log.csv", "--fps", 20, "--gyro-offset", 1.5)
    assert done.returncode == 0 and "clock" not in done.stdout, done.stderr
    record = read_json(tmp_path / "out" / "motion.json")
    assert [each["motion"]["model"] for each in record["frames"]] == ["gyro", "gyro"]
    image = read_png(tmp_path / "out" / "corrected" / "000001.png").astype(int)
    assert np.max(np.abs(image - corrected(scene, u8, samples).fused.image)) <= 1  # times in whole nanoseconds
    early = [f"{int(row.split(',')[0]) - 1_500_000_000},{row.partition(',')[2]}" for row in rows]
    (tmp_path / "early.csv").write_text("stamp_ns,wx,wy,wz\n" + "\n".join(early), encoding="utf-8")
    shown = run("--gyro", tmp_path / "early.csv", "--fps", 20)
    assert "gyroscope's clock: the frames do not tell" in shown.stdout  # two of them
    assert read_json(tmp_path / "out" / "motion.json")["gyro_clock"]["used"] is False
