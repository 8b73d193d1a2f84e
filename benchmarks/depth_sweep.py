"""Depth from stereo, from time and from both, with and without knowledge of the rolling shutter, in one table.

Renders three scenes with the motions of the card ``moderate`` (2 degrees and 0.3 m in a random direction)
at 320 x 320 px, and compares the depth of all four frames with the true one, as the track ``depth`` of the
leaderboard does: a pixel without a depth is bad. Matchers that need a motion get the true one and that
which a solver estimates from matches: one that knows the rolling shutter, or one that does not for the
sweep that does not either.

    python benchmarks/depth_sweep.py --data DIR --out results/depth      # 8 minutes of a processor
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.picture_marking import part_scores
from rsbench.benchmark.provenance import provenance
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, VIEWS, View
from rsbench.dataset.card import CameraCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import find_matches, solve_frames
from rsbench.solvers.engine.registry import load_solver_entry
from rsbench.storage.files import write_bytes, write_json, write_table
from rsbench.vision.plane_sweep import SweepMatcher, sweep_depths
from rsbench.vision.stereo_matcher import find_disparities, load_matcher

ROLLING, GLOBAL = "rs-stereo-refined", "gs-stereo-tracks"
SWEEPS: dict[str, tuple[SweepMatcher, str]] = {
    "sweep, stereo": (SweepMatcher(sources="stereo"), ""),
    "sweep-time-gs": (SweepMatcher(sources="time", rolling=False), GLOBAL),
    "sweep-time": (SweepMatcher(sources="time"), ROLLING),
    "sweep": (SweepMatcher(), ROLLING),
}
"""Matcher, and the solver of its estimated motion; that of stereo alone is not used."""
COLUMNS = ("abs_rel", "bad_1", "bad_2", "bad_3", "coverage", "seconds")
PAGE = """# Depth from stereo, from time, and from both

Made by `python benchmarks/depth_sweep.py`; each sequence is in [depth.csv](depth.csv). Three scenes,
{count} sequences, 320 x 320 px, 2 deg and 0.3 m per frame, readout ratio 0.8; means over the four frames
and all sequences. `AbsRel` is of pixels with a depth; in `> 1 px` and so on, of disparity, a pixel without
one is bad, as in the track `depth`. Seconds are the processor's, for all four frames.

`sgm` and `sweep, stereo` see the two images of one time, in which the shutter does no harm. `sweep-time`
sees the two frames of one camera, `sweep-time-gs` too, but believes that all rows of a frame have one pose;
`sweep` sees all. Estimated motions are those of `{ROLLING}`, and of `{GLOBAL}` for `sweep-time-gs`: a whole
chain that knows of no rolling shutter.

{table}
"""


def motions(sequence: Sequence, matches: Correspondences, solver: str) -> Iterator[tuple[str, Motion]]:
    """The true one and the estimated one, with their names; of what needs none the true one alone."""
    if not solver:
        yield "none", sequence.motion
        return
    yield "true", sequence.motion
    options = CorrectionOptions(solver=load_solver_entry(solver))
    found, _, _ = solve_frames(matches, sequence.rig, sequence.shutter.readout_ratio, options)
    yield solver, found.motion


def answers(sequence: Sequence) -> Iterator[tuple[str, str, Mapping[View, NDArray[np.float32]], float]]:
    """Matcher, motion, depth of every view, and seconds."""
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    start, entry, found = time.process_time(), load_matcher("sgm"), dict[View, Any]()
    for frame in FRAMES:
        both = find_disparities(entry, images["left", frame], images["right", frame], sequence.rig)
        found |= {("left", frame): sequence.rig.depth(both[0]), ("right", frame): sequence.rig.depth(both[1])}
    yield "sgm", "none", found, time.process_time() - start
    matches = find_matches(images, CorrectionOptions())
    for name, (matcher, solver) in SWEEPS.items():
        for motion_name, motion in motions(sequence, matches, solver):
            start = time.process_time()
            found = sweep_depths(images, sequence.rig, sequence.shutter, motion, matcher)
            yield name, motion_name, found, time.process_time() - start


def rows(sequence: Sequence) -> Iterator[dict[str, Any]]:
    for matcher, motion, found, seconds in answers(sequence):
        scores = []
        for view in VIEWS:
            truth = sequence.depth("rs", *view)
            depth = np.nan_to_num(found[view], nan=0.0, posinf=0.0).astype(np.float32)
            scores.append(part_scores(depth, truth, sequence.rig, np.ones(truth.shape, np.bool_)))
        means = {name: float(np.mean([each[name] for each in scores])) for name in COLUMNS[:-1]}
        yield {"sequence": sequence.name, "matcher": matcher, "motion": motion, **means, "seconds": seconds}


def page(table: pd.DataFrame) -> str:
    means = table.groupby(["matcher", "motion"], sort=False)[list(COLUMNS)].mean()
    heads = ("matcher", "motion", "AbsRel", "> 1 px", "> 2 px", "> 3 px", "coverage", "s")
    lines = ["| " + " | ".join(heads) + " |", "| --- " * len(heads) + "|"]
    for (matcher, motion), row in means.iterrows():
        values = [f"{row[name]:.3f}" for name in COLUMNS[:-1]] + [f"{row['seconds']:.1f}"]
        lines.append("| " + " | ".join([matcher, motion, *values]) + " |")
    count = table["sequence"].nunique()
    return PAGE.format(count=count, ROLLING=ROLLING, GLOBAL=GLOBAL, table="\n".join(lines))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the dataset; rendered where it lacks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the tables")
    given = parser.parse_args()
    camera = CameraCard(width=320, height=320, focal=492.3)
    generate_dataset(replace(load_dataset_card("moderate", seeds=(2, 3, 5)), camera=camera), given.data)
    sequences = read_dataset(given.data)
    list(answers(sequences[0]))  # what is compiled is not timed
    found = []
    for sequence in sequences:
        found += rows(sequence)
        sys.stdout.write(f"{sequence.name}\n")
        sys.stdout.flush()
    table = pd.DataFrame(found)
    given.out.mkdir(parents=True, exist_ok=True)
    write_table(given.out / "depth.csv", table)
    write_bytes(given.out / "README.md", page(table).encode())
    write_json(given.out / "provenance.json", provenance("python benchmarks/depth_sweep.py", card="moderate"))
    sys.stdout.write(page(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
