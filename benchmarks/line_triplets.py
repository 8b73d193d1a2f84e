"""What straight lines add to points: gs-stereo-triplets-lines on simulated features, and on rendered frames.

    python benchmarks/line_triplets.py                                     # simulated: a minute of a processor
    python benchmarks/line_triplets.py --data DATA --scene corridor        # its global-shutter frames, `gs/`

Simulated: as many points as lines in four images, 30 % wrong, the motions of the paper. On frames: points by SIFT,
lines by ``rsbench.vision.lines``, of the images that a global shutter would have seen, without photon noise. A
matched line is right when nine points on it, from the true depth and motion, are within 1.5 px (their median) of
the line in each of the other three images. Medians with exact 95 % intervals.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.benchmark.statistics import format_interval, median_interval, share_interval
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.solvers.triplets import PATTERNS, Features, LineTripletSolver, newton, usable_lines
from rsbench.vision.features import match_stereo_frames
from rsbench.vision.lines import match_lines

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
COUNTS, NOISE_PX, OUTLIERS = (10, 30, 100), 0.3, 0.3
MOTIONS, FOUND = ((2, 0.3), (5, 0.5), (15, 1.0)), 1e-6
RIGHT_PX = 1.5
_ACROSS, _DOWN = (-2, -1, 0, 1, 2), (-1, 0, 1)
"""Pixels about a point of an edge, of which the nearest surface has the edge."""


def errors(c: Correspondences, rig: StereoRig, motion: Motion) -> dict[str, float]:
    """e_R and e_T, degrees, from points, lines and both; 180 of a failure. Milliseconds of both."""
    given = {"points": Correspondences(tracks=c.tracks), "lines": Correspondences(lines=c.lines), "both": c}
    still, row = RollingShutter(height=rig.camera.height, readout_ratio=0.0), dict[str, float]()
    for kind, features in given.items():
        start = time.process_time()
        found = LineTripletSolver().estimate(features, rig, still)
        row[f"ms_{kind}"] = 1e3 * (time.process_time() - start)
        pair = (180.0, 180.0)
        if found.success:
            radians = rotation_error(found.w, motion.w), translation_error(found.d, motion.d)
            pair = float(np.rad2deg(radians[0])), float(np.rad2deg(radians[1]))
        row[f"e_R_{kind}"], row[f"e_T_{kind}"] = pair
    return row


def simulated(trials: int) -> Iterable[dict[str, object]]:
    """A row for each trial."""
    still = RollingShutter(height=RIG.camera.height, readout_ratio=0.0)
    for count, seed in product(COUNTS, range(trials)):
        motion = random_motion(np.random.default_rng([13, seed]), np.deg2rad(2.0), 0.3)
        options = SimulationOptions(tracks=count, lines=count, noise_px=NOISE_PX, outlier_ratio=OUTLIERS)
        s = simulate(RIG, still, motion, options, np.random.default_rng(seed))
        yield {"of": f"{count} + {count} simulated", **errors(s.correspondences, RIG, motion)}


def minimal(trials: int) -> str:
    """A Markdown table: share of exact samples of points and lines whose motion is found from no motion."""
    still = RollingShutter(height=RIG.camera.height, readout_ratio=0.0)
    kinds = [(3 - lines, lines) for lines in range(4)]
    out = [f"| motion | {' | '.join(f'{p} + {n}' for p, n in kinds)} |", "| --- " * 5 + "|"]
    for degrees, metres in MOTIONS:
        found: dict[tuple[int, int], list[bool]] = {kind: [] for kind in kinds}
        for seed, (points, lines) in product(range(trials), kinds):
            motion = random_motion(np.random.default_rng([13, seed]), np.deg2rad(degrees), metres)
            options = SimulationOptions(tracks=points, lines=20)
            c = simulate(RIG, still, motion, options, np.random.default_rng(seed)).correspondences
            steep = c.lines[usable_lines(c.lines, RIG)][:lines]
            features, true = Features.of(c.tracks, steep, RIG), motion.body_from_world(1.0)
            pose = newton(features.triplets(np.arange(3), PATTERNS[seed % 2], RIG))
            off = max(np.abs(pose.R - true.R).max(), np.abs(pose.t - true.t).max())
            found[points, lines].append(bool(off < FOUND))
        cells = [format_interval(np.mean(each), *share_interval(sum(each), len(each))) for each in found.values()]
        out.append(f"| {degrees} deg, {metres} m | {' | '.join(cells)} |")
    return "\n".join(out)


def right_lines(s: Sequence, lines: FloatArray) -> BoolArray:
    """Mask (n,) of the lines (n, 16) that are one line in space, by the true depth and motion."""
    depth, camera = s.depth("gs", "left", 0), s.rig.camera
    seen = lines.reshape(-1, 4, 2, 2)
    ends = seen[:, 0]
    places = ends[:, :1] + np.linspace(0.1, 0.9, 9)[:, None] * (ends[:, 1:] - ends[:, :1])
    near = np.full(places.shape[:2], np.inf)
    for step in product(_ACROSS, _DOWN):
        x, y = np.moveaxis(np.rint(places + step).astype(int), -1, 0)
        near = np.fmin(near, depth[np.clip(y, 0, camera.height - 1), np.clip(x, 0, camera.width - 1)])
    X = near[..., None] * camera.unproject(places) - s.rig.offset("left")
    R, t = s.motion.body_from_world(1.0)
    good = np.ones(len(lines), dtype=np.bool_)
    for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
        p = camera.project((X @ R.T + t if frame else X) + s.rig.offset(side))
        along = seen[:, k, 1] - seen[:, k, 0]
        normal = along[:, ::-1] * [1.0, -1.0] / np.linalg.norm(along, axis=1, keepdims=True)
        off = np.abs(np.sum((p - seen[:, k, :1]) * normal[:, None], axis=-1))
        good &= np.median(off, axis=1) <= RIGHT_PX
    return good


def rendered(folder: Path, scenes: list[str]) -> Iterable[dict[str, object]]:
    """A row for each sequence of the scenes."""
    for s in read_dataset(folder):
        scene = s.manifest["scene"]["name"]
        if scenes and scene not in scenes:
            continue
        images = [s.image("gs", side, frame) for frame in FRAMES for side in SIDES]
        start = time.process_time()
        lines = match_lines(*images)
        seconds = time.process_time() - start
        c = Correspondences(tracks=match_stereo_frames(*images).tracks, lines=lines)
        counts = {"tracks": len(c.tracks), "lines": len(lines), "right": int(np.sum(right_lines(s, lines)))}
        yield {"of": scene, **counts, "match_lines_s": seconds, **errors(c, s.rig, s.motion)}
        sys.stdout.write(".")
        sys.stdout.flush()


def told(table: pd.DataFrame) -> str:
    """A Markdown table: medians by what the rows are of."""
    kinds = [f"{error}_{kind}" for error in ("e_R", "e_T") for kind in ("points", "lines", "both")]
    lines = [f"| of | trials | tracks, lines | lines right | {' | '.join(kinds)} | ms |", "| --- " * 11 + "|"]
    for name, group in table.groupby("of", sort=False):
        cells = [str(name), str(len(group)), "", ""]
        if "lines" in group and group["lines"].notna().all():
            count, right = int(group["lines"].sum()), int(group["right"].sum())
            cells[2] = f"{group['tracks'].median():.0f}, {group['lines'].median():.0f}"
            cells[3] = format_interval(right / count, *share_interval(right, count))
        for key in kinds:
            values = group[key].to_numpy(float)
            cells.append(format_interval(float(np.median(values)), *median_interval(values)))
        cells.append(f"{group['ms_both'].median():.0f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="dataset whose global-shutter frames to take")
    parser.add_argument("--scene", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--trials", type=int, default=100, help="simulated ones (default 100)")
    options = parser.parse_args()
    rows = simulated(options.trials) if options.data is None else rendered(options.data, options.scene)
    table = pd.DataFrame(list(rows))
    sys.stdout.write(f"\n{told(table)}\n")
    if options.data is None:
        sys.stdout.write(f"\npoints + lines of a sample, found\n\n{minimal(options.trials)}\n")


if __name__ == "__main__":
    main()
