"""Recorded trajectories as poses of a camera, for the track points-recorded: what cards/recordings holds.

    python benchmarks/recorded_motion.py --hand-rig dataset-room1_512_16.csv --car-phone gyro.txt \\
        --hand-kinect freiburg1_xyz-groundtruth.txt --out cards/recordings --write
    python benchmarks/recorded_motion.py --drone-mav data.csv --out data/euroc --write

Each option names the user's own copy of a recording; cards/recordings/README.md has sources and licences. Of each,
a part without gaps becomes OUT/NAME.txt in TUM's format: uniform poses, at the knots of the cubic spline that fits
positions and quaternions in the least-squares sense. The interval of the knots is a low-pass filter against the
noise of motion capture. Printed, and with --write put into results/recorded/resampling.csv, are

    left_out    rms error of the spline through every second sample at the others, which includes their own noise
    noise       standard deviation of one sample (all axes together) from the residuals of the fit
    path        rms error of the fitted path that this noise causes: noise times the root of knots per sample
    bend        median over windows of WINDOW_S of the largest angle between the path and an even turn
    noise_bend  the same of a path fitted to noise alone: what of ``bend`` may be the measurement's

in degrees and millimetres. Where samples are noisy, the interval is the longest whose left_out angle is within 3 %
of the least (--scan prints it for others). A gyroscope has no positions: the phone's axes are turned into those of
its camera, the rates are integrated, and the car drives along the optical axis at SPEED, which is a choice.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import make_lsq_spline
from scipy.spatial.transform import Rotation

from rsbench.benchmark.provenance import provenance
from rsbench.core.so3 import FloatArray
from rsbench.dataset.motion_cards import Trajectory, read_trajectory
from rsbench.storage.files import write_bytes, write_json, write_table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results/recorded"
SPEED = 10.0
"""Forward speed of the car, m/s."""
WINDOW_S = 1.75 / 30.0
"""From the first row of frame 0 to the last of frame 1 at 30 frames per second and a readout ratio of 0.75."""
# Of the left cameras, the published calibrations; of the phone, whose top is on the left, from Android's axes.
TUM_VI = np.array(
    [
        [-0.9995250378696743, 0.029615343885863205, -0.008522328211654736, 0.04727988224914392],
        [0.0075019185074052044, -0.03439736061393144, -0.9993800792498829, -0.047443232143367084],
        [-0.02989013031643309, -0.998969345370175, 0.03415885127385616, -0.0681999605066297],
    ]
)
EUROC_IMU_FROM_CAMERA = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
    ]
)
CAMERA_FROM_PHONE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def read_euroc(path: Path) -> Trajectory:
    """Poses of EuRoC's or TUM VI's ground truth: columns ns, x, y, z, qw, qx, qy, qz."""
    table = pd.read_csv(path, comment="#", header=None, dtype={0: np.int64})
    stamps = table[0].to_numpy()
    return Trajectory(1e-9 * (stamps - stamps[0]), table[[1, 2, 3, 5, 6, 7, 4]].to_numpy(dtype=np.float64))


def of_camera(imu: Trajectory, imu_from_camera: FloatArray) -> Trajectory:
    """Poses of a camera from those of the IMU and (3, 4) its pose in the IMU's axes."""
    R, turned = Rotation.from_quat(imu.poses[:, 3:]), Rotation.from_matrix(imu_from_camera[:, :3])
    places = imu.poses[:, :3] + R.apply(imu_from_camera[:, 3])
    return Trajectory(imu.seconds, np.concatenate([places, (R * turned).as_quat()], axis=1))


def inverse(pose: FloatArray) -> FloatArray:
    return np.concatenate([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3:]], axis=1)


def integrated(seconds: FloatArray, rates: FloatArray, speed: float) -> Trajectory:
    """Poses at times (n,) of a body that turns at rates (n, 3), rad/s in its axes, and moves along z at ``speed``.

    Rates are those of the mean of two successive samples, which errs by the third power of the time between them.
    """
    steps = np.diff(seconds)[:, None]
    turn = Rotation.identity()
    turns = [turn]
    for step in 0.5 * (rates[1:] + rates[:-1]) * steps:
        turn = turn * Rotation.from_rotvec(step)
        turns.append(turn)
    R = Rotation.concatenate(turns)
    ahead = R.apply([0.0, 0.0, speed])
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (ahead[1:] + ahead[:-1]) * steps, axis=0)])
    return Trajectory(seconds, np.concatenate([places, R.as_quat()], axis=1))


def read_phone(path: Path) -> Trajectory:
    """Poses from a phone's gyroscope: lines wx, wy, wz (rad/s, Android's axes), seconds."""
    samples = np.loadtxt(path, delimiter=",")
    return integrated(samples[:, 3] - samples[0, 3], samples[:, :3] @ CAMERA_FROM_PHONE.T, SPEED)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What is taken of a recording, and how."""

    read: Callable[[Path], Trajectory]
    start_s: float
    end_s: float
    interval_s: float
    """Time between knots."""
    source: str


RECORDINGS = {
    "hand-rig": Recording(
        read=lambda path: of_camera(read_euroc(path), inverse(TUM_VI)),
        start_s=5.0,
        end_s=40.0,
        interval_s=0.06,
        source="TUM VI benchmark, room1, ground truth (motion capture, 120 Hz), CC BY 4.0",
    ),
    "hand-kinect": Recording(
        read=lambda path: read_trajectory(path, 1.0),
        start_s=10.3,
        end_s=30.0,
        interval_s=0.04,
        source="TUM RGB-D benchmark, freiburg1_xyz, ground truth (motion capture, 100 Hz), CC BY 4.0",
    ),
    "car-phone": Recording(
        read=read_phone,
        start_s=20.0,
        end_s=50.0,
        interval_s=0.01,
        source="lhaippp/gyro-video-stabilization, 20200109_145447, gyroscope, 412 Hz, MIT; "
        f"speed {SPEED:g} m/s chosen",
    ),
    "drone-mav": Recording(
        read=lambda path: of_camera(read_euroc(path), EUROC_IMU_FROM_CAMERA),
        start_s=5.0,
        end_s=80.0,
        interval_s=0.0125,
        source="EuRoC MAV, V1_02_medium, state estimate (Vicon and IMU, 200 Hz), non-commercial use, not shipped",
    ),
}


def part_of(whole: Trajectory, start_s: float, end_s: float) -> Trajectory:
    """The samples from ``start_s`` to ``end_s``, with quaternions of like signs and without repeated times."""
    kept = (whole.seconds >= start_s) & (whole.seconds <= end_s)
    kept[1:] &= np.diff(whole.seconds) > 1e-4
    poses = whole.poses[kept].copy()
    flips = np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0.0
    poses[1:, 3:] *= np.cumprod(np.where(flips, -1.0, 1.0))[:, None]
    return Trajectory(whole.seconds[kept], poses)


def fitted(samples: Trajectory, interval_s: float, times: FloatArray) -> FloatArray:
    """Poses (n, 7) at times of the least-squares cubic spline with uniform knots about ``interval_s`` apart."""
    first, last = float(samples.seconds[0]), float(samples.seconds[-1])
    knots = np.linspace(first, last, round((last - first) / interval_s) + 1)
    padded = np.concatenate([[first] * 3, knots, [last] * 3])
    poses = make_lsq_spline(samples.seconds, samples.poses, padded, 3)(times)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


def differences(found: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles (n,), degrees, and distances (n,), mm, between poses (n, 7)."""
    turn = Rotation.from_quat(found[:, 3:]).inv() * Rotation.from_quat(poses[:, 3:])
    return np.rad2deg(turn.magnitude()), 1e3 * np.linalg.norm(found[:, :3] - poses[:, :3], axis=1)


def left_out(samples: Trajectory, interval_s: float) -> tuple[float, float]:
    """RMS error, degrees and mm, at every second sample of the spline through the others, without the ends."""
    even, odd = (Trajectory(samples.seconds[k::2], samples.poses[k::2]) for k in (0, 1))
    inner = (odd.seconds > even.seconds[0] + 5 * interval_s) & (odd.seconds < even.seconds[-1] - 5 * interval_s)
    errors = differences(fitted(even, interval_s, odd.seconds[inner]), odd.poses[inner])
    deg, mm = (float(np.sqrt(np.mean(each**2))) for each in errors)
    return deg, mm


def bend(samples: Trajectory, interval_s: float) -> float:
    """Median over successive windows of the largest angle, degrees, between the path and an even turn."""
    starts = np.arange(samples.seconds[0], samples.seconds[-1] - WINDOW_S, WINDOW_S)
    tau = np.linspace(0.0, 1.75, 33)
    times = starts[:, None] + tau / 30.0
    frame = np.concatenate([times, starts[:, None] + 1.0 / 30.0], axis=1)
    R = (
        Rotation.from_quat(fitted(samples, interval_s, frame.ravel())[:, 3:])
        .as_matrix()
        .reshape(*frame.shape, 3, 3)
    )
    turned = R @ np.swapaxes(R[:, :1], -1, -2)
    w = Rotation.from_matrix(turned[:, -1]).as_rotvec()
    even = Rotation.from_rotvec((tau[:, None] * w[:, None, :]).reshape(-1, 3))
    apart = (even.inv() * Rotation.from_matrix(turned[:, :-1].reshape(-1, 3, 3))).magnitude().reshape(-1, len(tau))
    return float(np.rad2deg(np.median(np.max(apart, axis=1))))


def noise_alone(samples: Trajectory, deg: float) -> Trajectory:
    """A body at rest, measured at the same times with a noise of ``deg`` degrees, all axes together."""
    turns = np.random.default_rng(0).normal(0.0, np.deg2rad(deg) / np.sqrt(3.0), (len(samples.seconds), 3))
    poses = np.concatenate([np.zeros((len(turns), 3)), Rotation.from_rotvec(turns).as_quat()], axis=1)
    return Trajectory(samples.seconds, poses)


def measured(name: str, recording: Recording, samples: Trajectory) -> dict[str, object]:
    """A row of resampling.csv."""
    deg, mm = left_out(samples, recording.interval_s)
    count, span = len(samples.seconds), float(samples.seconds[-1] - samples.seconds[0])
    knots = span / recording.interval_s + 3.0
    residuals = differences(fitted(samples, recording.interval_s, samples.seconds), samples.poses)
    noise_deg, noise_mm = (float(np.sqrt(np.sum(each**2) / (count - knots))) for each in residuals)
    share = np.sqrt(knots / count)
    return {
        "recording": name,
        "samples": count,
        "seconds": span,
        "rate_hz": (count - 1) / span,
        "interval_ms": 1e3 * recording.interval_s,
        "left_out_deg": deg,
        "left_out_mm": mm,
        "noise_deg": noise_deg,
        "noise_mm": noise_mm,
        "path_deg": noise_deg * share,
        "path_mm": noise_mm * share,
        "bend_deg": bend(samples, recording.interval_s),
        "noise_bend_deg": bend(noise_alone(samples, noise_deg), recording.interval_s),
        "source": recording.source,
    }


def text_of(recording: Recording, samples: Trajectory) -> str:
    """A file in TUM's format, poses of the camera; the first is the origin of the world."""
    span = float(samples.seconds[-1] - samples.seconds[0])
    times = np.arange(0.0, span, recording.interval_s)
    poses = fitted(samples, recording.interval_s, samples.seconds[0] + times)
    R = Rotation.from_quat(poses[:, 3:])
    places = R[0].inv().apply(poses[:, :3] - poses[0, :3])
    rows = np.concatenate([times[:, None], places, (R[0].inv() * R).as_quat()], axis=1)
    lines = [
        f"# {recording.source}",
        f"# {recording.start_s:g} to {recording.end_s:g} s, cubic spline with knots every "
        f"{1e3 * recording.interval_s:g} ms, by benchmarks/recorded_motion.py",
        "# world_from_camera (x right, y down, z forward): seconds x y z (m) qx qy qz qw",
    ]
    lines += [f"{row[0]:.4f} " + " ".join(f"{value:.6f}" for value in row[1:]) for row in rows]
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, recording in RECORDINGS.items():
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help=recording.source)
    parser.add_argument("--out", type=Path, required=True, help="folder of the files of poses")
    parser.add_argument("--scan", action="store_true", help="print the error of other intervals too")
    parser.add_argument("--write", action="store_true", help="the rows into results/recorded/resampling.csv")
    given = vars(parser.parse_args())
    rows = list[dict[str, object]]()
    for name, recording in RECORDINGS.items():
        if (path := given[name.replace("-", "_")]) is None:
            continue
        samples = part_of(recording.read(path), recording.start_s, recording.end_s)
        given["out"].mkdir(parents=True, exist_ok=True)
        write_bytes(given["out"] / f"{name}.txt", text_of(recording, samples).encode())
        rows.append(measured(name, recording, samples))
        sys.stdout.write(
            ", ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                for key, value in rows[-1].items()
            )
            + "\n"
        )
        for interval_s in (
            (0.0075, 0.01, 0.0125, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06) if given["scan"] else ()
        ):
            if interval_s > 2.4 * float(np.median(np.diff(samples.seconds))):
                deg, mm = left_out(samples, interval_s)
                sys.stdout.write(f"    knots every {1e3 * interval_s:g} ms: {deg:.4f} deg, {mm:.4f} mm\n")
    if given["write"] and rows:
        path = RESULTS / "resampling.csv"
        former = pd.read_csv(path) if path.is_file() else pd.DataFrame(columns=["recording"])
        kept = former[~former["recording"].isin([row["recording"] for row in rows])]
        table = pd.concat([kept, pd.DataFrame(rows)]) if len(kept) else pd.DataFrame(rows)
        RESULTS.mkdir(parents=True, exist_ok=True)
        write_table(path, table.sort_values("recording"))
        write_json(
            RESULTS / "resampling-provenance.json", provenance("python benchmarks/recorded_motion.py --write")
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
