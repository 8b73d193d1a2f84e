"""``rsbench correct`` and ``rsbench.correct`` find the same from the same inputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import run_here
from small_scenes import write_rig

import rsbench
from rsbench.dataset.sequence import Sequence
from rsbench.interop.readers.gyro_log import read_gyro_log
from rsbench.storage.files import read_png, write_png

ORDER = ("left_0", "right_0", "left_1", "right_1")
SIZE, FPS = (96, 128), 30.0


def _run(out: Path, *arguments: Any) -> dict[str, Any]:
    result = run_here("correct", *arguments, "--out", out)
    assert result.returncode == 0, result.stderr
    record: dict[str, Any] = json.loads((out / "motion.json").read_text("utf-8"))
    return record


UNSURE = {"focal_sigma": 20.0, "k1_sigma": 0.02}


@pytest.mark.parametrize(
    ("known", "sigmas"), [(True, {}), (True, UNSURE), pytest.param(False, {}, marks=pytest.mark.slow)]
)
def test_of_a_rig(known: bool, sigmas: dict[str, Any], castle: Sequence, tmp_path: Path) -> None:
    ratio, rig = castle.shutter.readout_ratio, tmp_path / "rig.toml"
    write_rig(rig, castle.rig, ratio if known else None, "".join(f"{name} = {x}\n" for name, x in sigmas.items()))
    paths = [castle.folder / "rs" / f"{name}.png" for name in ORDER]
    images = [read_png(path) for path in paths]
    if not known:  # these frames do not determine it, and both refuse for the same reason
        result = run_here("correct", *paths, "--rig", rig, "--out", tmp_path / "out")
        with pytest.raises(rsbench.RsbenchError, match="cannot tell the readout ratio") as refused:
            rsbench.correct(images, castle.rig, None, **sigmas)
        assert result.returncode == 1 and str(refused.value) in result.stderr
        assert not (tmp_path / "out").exists()
        return
    record = _run(tmp_path / "out", *paths, "--rig", rig)
    found = rsbench.correct(images, castle.rig, ratio, **sigmas)
    assert found.motion is not None
    # JSON keeps every digit of a number: the same steps on the same inputs leave no difference.
    assert record["readout_ratio"] == found.shutter.readout_ratio
    assert record["camera"]["fx"] == found.rig.camera.fx
    assert bool(record["camera_note"]) == bool(sigmas)
    assert record["motion"]["w"] == found.motion.w.tolist() and record["motion"]["d"] == found.motion.d.tolist()
    for (side, frame), fused in found.frames.items():
        assert np.array_equal(read_png(tmp_path / "out" / "corrected" / f"{side}_{frame}.png"), fused.image)


def test_a_deviation_may_be_a_scalar_of_numpy(castle: Sequence) -> None:
    blank = [np.zeros((96, 128, 3), dtype=np.uint8)] * 4
    with pytest.raises(rsbench.RsbenchError, match="matches"):
        rsbench.correct(blank, castle.rig, 0.8, focal_sigma=np.float16(20.0))  # pyrefly: ignore[bad-argument-type]


def _angle(tau: np.ndarray) -> np.ndarray:
    """Rotation about the optical axis, rad, at times in frame periods."""
    return 0.02 * np.sin(1.9 * tau) + 0.015 * np.sin(0.8 * tau)


def _video(count: int) -> list[np.ndarray]:
    """Frames of a camera that shakes about its axis and moves to the right past a wall, read from the top."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (256, 384, 3)), (0, 0), 2.0)
    wall = cv2.normalize(noise, np.zeros_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.float32)
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]].astype(np.float64)
    frames = list[np.ndarray]()
    for number in range(count):
        tau = number + 0.8 * y / SIZE[0]
        a, u, v = _angle(tau), x - (SIZE[1] - 1) / 2, y - (SIZE[0] - 1) / 2
        at = (np.cos(a) * u - np.sin(a) * v + 140.0 + 4.0 * tau, np.sin(a) * u + np.cos(a) * v + 128.0)
        seen = cv2.remap(wall, at[0].astype(np.float32), at[1].astype(np.float32), cv2.INTER_CUBIC)
        frames.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
    return frames


def _samples(count: int) -> np.ndarray:
    tau = np.arange(-2.0, count + 2.0, 1.0 / 8)
    rate = (_angle(tau + 1e-4) - _angle(tau - 1e-4)) / 2e-4
    return np.column_stack([tau, np.zeros((len(tau), 2)), -rate])


@pytest.mark.parametrize(
    ("known", "gyro"), [(True, None), (True, "exact"), pytest.param(False, "late", marks=pytest.mark.slow)]
)
def test_of_one_camera(known: bool, gyro: str | None, tmp_path: Path) -> None:
    images = _video(3 if known else 9)
    (tmp_path / "frames").mkdir()
    for number, image in enumerate(images):
        write_png(tmp_path / "frames" / f"{number}.png", image)
    (tmp_path / "camera.toml").write_text("readout_ratio = 0.8\nfov_deg = 60.0\n" if known else "")
    arguments: list[Any] = ["--frames", tmp_path / "frames", "--camera", tmp_path / "camera.toml"]
    python: dict[str, Any] = {}
    if gyro is not None:
        samples = _samples(len(images))
        # A log holds a gyroscope's rates, whose sign is opposite, at nanoseconds.
        stamps = np.rint(1e9 * (samples[:, 0] / FPS + (0.02 if gyro == "late" else 0.0))).astype(int)
        rows = zip(stamps.tolist(), *(-FPS * samples[:, 1:]).T.tolist(), strict=True)
        lines = ["stamp_ns,wx,wy,wz", *(",".join(map(repr, row)) for row in rows)]
        (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
        arguments += ["--gyro", tmp_path / "log.csv", "--fps", FPS]
        arguments += ["--gyro-offset", 0] if gyro == "exact" else []
        python["gyro"] = read_gyro_log(tmp_path / "log.csv").samples(FPS, 0.0)
        python |= {} if gyro == "exact" else {"gyro_clock_error": 0.5 * FPS}
    record = _run(tmp_path / "out", *arguments)
    assert ("gyro_clock" in record) == (gyro == "late")
    camera, ratio = (60.0, 0.8) if known else ("unknown", None)
    frames = rsbench.correct(images, camera=camera, readout_ratio=ratio, **python)
    assert [entry.get("reason", "") for entry in record["frames"]] == [fused.reason for fused in frames]
    for number, fused in enumerate(frames):
        assert np.array_equal(read_png(tmp_path / "out" / "corrected" / f"{number:06d}.png"), fused.image)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"rig": True, "gyro_clock_error": 1.0}, "gyro_clock_error: is estimated for one camera"),
        ({"rig": True, "focal_sigma": 1e3}, "focal_sigma = 1000.0: must be a number from 0"),
        ({"camera": 60.0, "k1_sigma": 0.1}, "k1_sigma: is estimated for a stereo rig"),
        ({"camera": 60.0, "gyro_clock_error": 1.0}, "gyro_clock_error: has no effect without gyro"),
    ],
)
def test_what_has_no_effect_is_refused(wrong: dict[str, Any], words: str, castle: Sequence) -> None:
    given: dict[str, Any] = {**wrong, "rig": castle.rig} if "rig" in wrong else wrong
    with pytest.raises(ValueError, match=words):
        rsbench.correct([np.zeros((96, 128), np.uint8)] * 4, **given)
