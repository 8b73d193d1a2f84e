"""benchmarks/recorded_motion.py: what its figures state about paths that are known, and what is committed."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from documents import ROOT, results
from scipy.spatial.transform import Rotation

from rsbench.core.spline_motion import world_from_body
from rsbench.dataset.motion_cards import Trajectory, read_trajectory


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("recorded_motion")


def swaying(seconds: np.ndarray) -> np.ndarray:
    """Poses (n, 7) of a body that sways at 2 Hz by 5 deg and 10 mm."""
    wave = np.sin(2 * np.pi * 2.0 * seconds[:, None] + [0.0, 1.0, 2.0])
    return np.concatenate([0.01 * wave, Rotation.from_rotvec(np.deg2rad(5.0) * wave).as_quat()], axis=1)


def test_noise_and_errors_of_the_path_are_those_that_were_added(program: ModuleType) -> None:
    rng, seconds = np.random.default_rng(0), np.arange(0.0, 40.0, 0.01)
    poses = swaying(seconds)
    turns = Rotation.from_rotvec(np.deg2rad(0.05) * rng.standard_normal((len(seconds), 3)))
    poses[:, 3:] = (Rotation.from_quat(poses[:, 3:]) * turns).as_quat()
    poses[:, :3] += 1e-4 * rng.standard_normal((len(seconds), 3))
    samples = program.part_of(Trajectory(seconds, poses), 0.0, 40.0)
    recording = program.Recording(read=lambda path: samples, start_s=0, end_s=40, interval_s=0.04, source="made")
    row = program.measured("made", recording, samples)
    assert row["noise_deg"] == pytest.approx(0.05 * 3**0.5, rel=0.05)
    assert row["noise_mm"] == pytest.approx(0.1 * 3**0.5, rel=0.05)
    errors = program.differences(program.fitted(samples, 0.04, seconds), swaying(seconds))
    for found, key in zip(errors, ("path_deg", "path_mm"), strict=True):
        assert row[key] == pytest.approx(np.sqrt(np.mean(found**2)), rel=0.1), key
    # Half of the samples, and the noise of those that are left out.
    assert row["left_out_deg"] == pytest.approx(row["noise_deg"] * np.sqrt(1.0 + 2 * 0.01 / 0.04), rel=0.05)
    assert row["noise_bend_deg"] < 0.2 * row["bend_deg"]


def test_an_even_turn_has_no_bend_and_a_swaying_one_that_of_its_acceleration(program: ModuleType) -> None:
    seconds = np.arange(0.0, 20.0, 0.005)
    even = Rotation.from_rotvec(seconds[:, None] * np.deg2rad([10.0, 20.0, -5.0])).as_quat()
    samples = program.part_of(Trajectory(seconds, np.concatenate([0.0 * even[:, :3], even], axis=1)), 0.0, 20.0)
    assert program.bend(samples, 0.02) < 1e-4
    # One axis, phi = a sin(w t): over 1.75 frames of 1/30 s the largest departure, by the median over phases.
    size, w = 5.0, 2 * np.pi * 2.0
    turns = Rotation.from_rotvec(np.deg2rad(size) * np.sin(w * seconds)[:, None] * [1.0, 0.0, 0.0]).as_quat()
    samples = program.part_of(Trajectory(seconds, np.concatenate([0.0 * turns[:, :3], turns], axis=1)), 0.0, 20.0)
    starts, tau = np.arange(0.0, 19.9, 1.75 / 30)[:, None], np.linspace(0.0, 1.75, 200)
    phi = size * (np.sin(w * (starts + tau / 30)) - np.sin(w * starts))
    frame = size * (np.sin(w * (starts + 1 / 30)) - np.sin(w * starts))
    expected = np.median(np.max(np.abs(phi - tau * frame), axis=1))
    assert program.bend(samples, 0.02) == pytest.approx(expected, rel=0.02)


def test_a_gyroscope_at_constant_rate_drives_on_a_circle(program: ModuleType) -> None:
    seconds, rate, speed = np.linspace(0.0, 2.0, 801), 0.5, 10.0
    rates = np.tile([0.0, rate, 0.0], (801, 1))  # yaw to the right: y is down
    driven = program.integrated(seconds, rates, speed)
    turn = Rotation.from_quat(driven.poses[-1, 3:]).as_rotvec()
    assert np.allclose(turn, [0.0, rate * 2.0, 0.0], atol=1e-12)
    radius = speed / rate
    assert np.allclose(driven.poses[-1, :3], [radius * (1 - np.cos(1.0)), 0.0, radius * np.sin(1.0)], atol=1e-4)


def test_axes_are_those_of_cameras(program: ModuleType) -> None:
    """Rotations; the phone lies on its side, its camera looks away from the screen."""
    for R in (program.TUM_VI[:, :3], program.EUROC_IMU_FROM_CAMERA[:, :3], program.CAMERA_FROM_PHONE):
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) == pytest.approx(1.0)
    assert list(program.CAMERA_FROM_PHONE @ [0.0, 0.0, 1.0]) == [0.0, 0.0, -1.0]
    assert list(program.CAMERA_FROM_PHONE @ [1.0, 0.0, 0.0]) == [0.0, -1.0, 0.0]  # its right side is up


def test_eurocs_files_are_read_with_their_order_of_quaternions(program: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text(
        "#timestamp, p, q\n1403715524907143168,1,2,3,0.8,0.6,0,0,9\n1403715524912143104,1,2,4,1,0,0,0,9\n"
    )
    read = program.read_euroc(file)
    assert np.allclose(read.seconds, [0.0, 0.004999936], atol=1e-12)
    assert read.poses[0].tolist() == [1.0, 2.0, 3.0, 0.6, 0.0, 0.0, 0.8]


def bend(poses: Trajectory, start: float) -> float:
    """Largest angle, degrees, between an even turn by that of one frame and the path that datasets have."""
    tau = np.linspace(0.0, 1.75, 20)
    rows = np.concatenate([poses.seconds[:, None], poses.poses], axis=1)
    near = np.abs(rows[:, 0] - start) < 1.0
    R = Rotation.from_matrix(world_from_body(rows[near], start + np.append(tau, 1.0) / 30).R)
    turned = R * R[0].inv()
    even = Rotation.from_rotvec(tau[:, None] * turned[-1].as_rotvec())
    return float(np.rad2deg(np.max((turned[:-1] * even.inv()).magnitude())))


def test_the_committed_recordings_are_what_the_table_describes(program: ModuleType) -> None:
    table = {row["recording"]: row for row in results("recorded/resampling.csv")}
    folder = ROOT / "cards/recordings"
    names = sorted(path.stem for path in folder.glob("*.txt"))
    assert names == ["car-phone", "hand-kinect", "hand-rig"] and table.keys() == {*names, "drone-mav"}
    readme = (folder / "README.md").read_text("utf-8")
    for name in names:
        row, recording = table[name], program.RECORDINGS[name]
        assert f"`{name}.txt`" in readme and row["source"] == recording.source
        poses = read_trajectory(folder / f"{name}.txt", 1.0)
        assert np.allclose(np.diff(poses.seconds), recording.interval_s, atol=1e-9)
        assert poses.seconds[-1] == pytest.approx(float(row["seconds"]), abs=recording.interval_s)
        bends = [bend(poses, start) for start in np.arange(0.0, poses.seconds[-1] - program.WINDOW_S, 0.05)]
        assert np.median(bends) == pytest.approx(float(row["bend_deg"]), rel=0.1), name
    assert sum(path.stat().st_size for path in folder.iterdir()) < 500_000
