"""Where two frames stop and sequences go on: rows of a shaken rig over shake, frame rate, length and matches.

    python benchmarks/trajectory_sweep.py --out results/trajectory        # an hour of one core
    python benchmarks/trajectory_sweep.py --trials 2 --sweep length       # some minutes, printed alone

A hand walks: 30 deg/s and 1.5 m/s, and about and along each axis three sines of 2 to 12 Hz, of around 0.2 deg and
5 mm each at a shake of 1. Its camera (640 x 480, f = 520 px, baseline 0.2 m) reads for 15 ms. Points lie 2 to 12 m
away; matches err by 0.3 px, and one in five is wrong. Both the law and the projection are written from formulas
(``foreign_motion.py``): no spline of ours made these motions. The shutter is told.

A trial's error is the root mean square, over all rows of all frames, of what a row's pose against the first row of
its frame is off by: what a correction rests on. ``no-motion`` is what a frame that is left as it is errs by, and
``stated`` is what ``rs-trajectory`` says by its covariances that it errs by. Of trials: the median, and its 95 %
interval by bootstrap.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from foreign_motion import SINES, Array, Law, Shaken, direction

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.statistics import format_interval, typical_interval
from rsbench.benchmark.trajectory_scores import METHODS, Estimate, Given, along
from rsbench.capture.trajectory_estimate import Trajectory, estimate_trajectory
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.storage.files import write_json, write_table

WIDTH, HEIGHT, FOCAL, BASELINE = 640, 480, 520.0, 0.2
READOUT_S, NOISE_PX, OUTLIERS = 0.015, 0.3, 0.2
RIG = StereoRig(camera=PinholeCamera.centred(WIDTH, HEIGHT, FOCAL), baseline=BASELINE)
NEAREST_M, FARTHEST_M = 2.0, 12.0
ROWS = np.arange(0.0, HEIGHT, 24.0)
STATED, OURS, WINDOWS, STILL = "stated", "rs-trajectory", ("windows-auto", "windows-linear"), "no-motion"
Pair = tuple[float, float]
"""Rotation, deg, and position, mm."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One cell of a sweep."""

    shake: float = 1.0
    rate: float = 30.0
    """Frames per second."""
    length: int = 8
    """Frames."""
    matches: int = 300
    """Of each two successive frames."""

    @property
    def shutter(self) -> RollingShutter:
        """Of a readout that takes the same time at any frame rate."""
        return RollingShutter(height=HEIGHT, readout_ratio=READOUT_S * self.rate)

    def times(self, frame: int) -> Array:
        """Of the rows of a frame."""
        return frame + self.shutter.readout_ratio * ROWS / HEIGHT


SWEEPS: dict[str, tuple[float, ...]] = {
    "shake": (0.0, 0.03, 0.1, 0.3, 1.0, 3.0),
    "shake of two frames": (0.0, 0.03, 0.1, 0.3, 1.0, 3.0),
    "rate": (7.5, 15.0, 30.0, 60.0),
    "length": (2, 3, 4, 6, 8, 16, 32),
    "matches": (25, 50, 100, 300, 1000),
}


# What is seen


def hand(setting: Setting, rng: np.random.Generator) -> Shaken:
    """A shaken walk, in frame periods."""
    size = np.repeat([np.radians(0.2), 0.005], 3)[:, None] * setting.shake
    return Shaken(
        w=np.radians(30.0) / setting.rate * direction(rng, (0.5, 1.0, 0.4)),
        v=1.5 / setting.rate * direction(rng, (1.0, 0.4, 0.7)),
        amplitudes=size * rng.uniform(0.6, 1.4, (6, SINES)),
        cycles=rng.uniform(2.0, 12.0, (6, SINES)) / setting.rate,
        phases=rng.uniform(0.0, 2.0 * np.pi, (6, SINES)),
    )


def seen(law: Law, shutter: RollingShutter, points: Array, frame: int, side: int) -> Array:
    """Pixels (n, 2) of points (n, 3): the row says when it is read, and the time where the point is."""
    y = np.full(len(points), 0.5 * HEIGHT)
    for _ in range(12):
        R, t = law.body(frame + shutter.readout_ratio * np.clip(y, -HEIGHT, 2.0 * HEIGHT) / HEIGHT)
        x = np.einsum("nij,nj->ni", R, points) + t + [(0.5 - side) * BASELINE, 0.0, 0.0]
        z = np.where(x[:, 2] > 0.1, x[:, 2], np.nan)
        y = np.nan_to_num(FOCAL * x[:, 1] / z + 0.5 * (HEIGHT - 1), nan=-1e3)
    return np.stack([FOCAL * x[:, 0] / z + 0.5 * (WIDTH - 1), y], axis=-1)


def window(law: Law, setting: Setting, frame: int, rng: np.random.Generator) -> Array:
    """Tracks (n, 8) of a frame and the next."""
    shutter, count = setting.shutter, 4 * setting.matches
    ends = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (count, 2))
    z = rng.uniform(NEAREST_M, FARTHEST_M, count)
    R, t = law.body(frame + shutter.readout_ratio * ends[:, 1] / HEIGHT)
    x = (ends - [0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)]) / FOCAL * z[:, None]
    body = np.concatenate([x, z[:, None]], axis=1) - [0.5 * BASELINE, 0.0, 0.0]
    points = np.einsum("nji,nj->ni", R, body - t)
    tracks = np.concatenate([seen(law, shutter, points, frame + i // 2, i % 2) for i in range(4)], axis=1)
    inside = np.all(
        (tracks.reshape(-1, 4, 2) > 0.0) & (tracks.reshape(-1, 4, 2) < [WIDTH - 1, HEIGHT - 1]), (1, 2)
    )
    tracks = tracks[inside][: setting.matches]
    tracks += NOISE_PX * rng.normal(size=tracks.shape)
    for k in np.flatnonzero(rng.random(len(tracks)) < OUTLIERS):
        end = 2 * rng.integers(4)
        tracks[k, end : end + 2] = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT])
    return tracks


# What is found


def error(law: Law, setting: Setting, found: Estimate) -> Pair:
    """Root mean square over the rows of all frames: of rotations, deg, and of positions, mm."""
    turns, shifts = list[Array](), list[Array]()
    for frame in range(setting.length):
        tau = setting.times(frame)
        R, t = found.within(frame, tau)
        true_R, true_t = law.body(tau)
        true_t = true_t - (true_R @ true_R[0].T) @ true_t[0]
        true_R = true_R @ true_R[0].T
        off = np.einsum("nij,nij->n", R, true_R)
        turns.append(np.arccos(np.clip(0.5 * (off - 1.0), -1.0, 1.0)))
        places, true_places = (-np.einsum("nji,nj->ni", *each) for each in ((R, t), (true_R, true_t)))
        shifts.append(np.linalg.norm(places - true_places, axis=1))
    turned, shifted = (float(np.sqrt(np.mean(np.square(each)))) for each in (turns, shifts))
    return np.degrees(turned), 1e3 * shifted


def stated(setting: Setting, found: Trajectory) -> Pair:
    """What an estimate says that it errs by, as of ``error``."""
    sums = list[Array]()
    for frame in range(setting.length):
        covariance = found.covariance_between(float(frame), setting.times(frame))
        sums.append(np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=-1))
    turned, shifted = np.sqrt(np.mean(sums, axis=(0, 1)))
    return float(np.degrees(turned)), float(1e3 * shifted)


def trial(setting: Setting, seed: int) -> dict[str, Pair]:
    """Errors by entry."""
    rng = np.random.default_rng(seed)
    law = hand(setting, rng)
    matches = [Correspondences(tracks=window(law, setting, k, rng)) for k in range(setting.length - 1)]
    given = Given(rig=RIG, shutter=setting.shutter, matches=matches, seed=seed)
    ours = estimate_trajectory(matches, RIG, setting.shutter, seed=seed)
    found = {OURS: along(ours.motion, len(matches))}
    found |= {name: METHODS[name].solve(given) for name in (*WINDOWS, STILL)}
    scores = {name: error(law, setting, each) for name, each in found.items() if each is not None}
    return {STATED: stated(setting, ours), **scores}


# The table


def setting_of(sweep: str, value: float) -> Setting:
    """The cell of a value."""
    if sweep == "shake of two frames":
        return Setting(shake=value, length=2)
    return replace(Setting(), **{sweep: type(getattr(Setting(), sweep))(value)})


def table(sweep: str, trials: int) -> pd.DataFrame:
    """Medians over the trials of a sweep, with intervals."""
    rows = []
    for value in SWEEPS[sweep]:
        began = time.perf_counter()
        setting = setting_of(sweep, value)
        scores = [trial(setting, seed) for seed in range(trials)]
        for name in scores[0]:
            both = np.nan_to_num(np.array([each[name] for each in scores]), nan=np.inf)
            row: dict[str, object] = {"sweep": sweep, "value": value, "entry": name, "trials": trials}
            for unit, errors in zip(("rotation_deg", "position_mm"), both.T, strict=True):
                low, high = typical_interval(errors, 0)
                row |= {unit: float(np.median(errors)), f"{unit}_low": low, f"{unit}_high": high}
            rows.append(row | {"failed": int(np.count_nonzero(np.isinf(both[:, 0])))})
        sys.stderr.write(f"{sweep} {value:g}: {time.perf_counter() - began:.0f} s\n")
    return pd.DataFrame(rows)


def _words(of: pd.Series) -> str:
    value, low, high = (float(each) for each in of)
    return format_interval(value, low, high) if low < high else f"{value:.3g}"


def shown(found: pd.DataFrame) -> list[str]:
    """Markdown: a row of each value, rotation of the rows in degrees."""
    names = [STATED, OURS, *WINDOWS, STILL]
    lines = []
    for (sweep, value), rows in found.groupby(["sweep", "value"], sort=False):
        by = rows.set_index("entry")
        cells = [_words(by.loc[name, ["rotation_deg", "rotation_deg_low", "rotation_deg_high"]]) for name in names]
        lines.append(f"| {sweep} | {value:g} | {' | '.join(cells)} |")
    return ["| varied | value | " + " | ".join(names) + " |", "|---" * (len(names) + 2) + "|", *lines]


def main() -> int:
    """Print the table; with ``--out`` write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of rows.csv and provenance.json")
    parser.add_argument("--sweep", nargs="*", default=list(SWEEPS), choices=list(SWEEPS))
    parser.add_argument("--trials", type=int, default=10)
    options = parser.parse_args()
    if options.trials < 1:
        parser.error(f"--trials {options.trials}: must be 1 or more")
    if options.out:  # before an hour has passed
        try:
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            parser.error(f"--out {options.out}: {error.strerror}; choose another folder")
    found = pd.concat([table(each, options.trials) for each in options.sweep])
    sys.stdout.write("\n".join(shown(found)) + "\n")
    if options.out:
        write_table(options.out / "rows.csv", found)
        command = f"python benchmarks/trajectory_sweep.py --out {options.out.as_posix()}"
        write_json(options.out / "provenance.json", provenance(command, trials=options.trials, seeds="0 and on"))
    return 0


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main())
