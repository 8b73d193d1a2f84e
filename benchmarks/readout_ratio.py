"""How well the readout ratio is recovered: on simulated matches, and on the frames of a rendered dataset.

python benchmarks/readout_ratio.py
python benchmarks/readout_ratio.py --data data/moderate
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from rsbench.capture.readout import estimate_readout_ratio

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import match_frames, referee

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
ALLOWED = 0.02
OPTIONS = CorrectionOptions()
_, JUDGE = referee(OPTIONS.solver)


def simulated(tracks: int, degrees: float, trials: int) -> str:
    """Errors on random motions and ratios: 0.3 px of noise, a tenth outliers."""
    errors, scaled = [], []
    for trial in range(trials):
        rng = np.random.default_rng([11, trial])
        ratio, motion = rng.uniform(0.3, 1.0), random_motion(rng, np.radians(degrees), 0.3)
        options = SimulationOptions(tracks=tracks, noise_px=0.3, outlier_ratio=0.1)
        matches = simulate(
            RIG, RollingShutter(height=900, readout_ratio=ratio), motion, options, rng
        ).correspondences
        found = estimate_readout_ratio(matches, RIG, JUDGE, OPTIONS.robust, trial)
        errors.append(np.inf if found is None else abs(found.readout_ratio - ratio))
        scaled.append(np.inf if found is None else errors[-1] / found.sigma)
    return (
        f"{tracks:6d} tracks, {degrees:g} deg: median error {np.median(errors):.4f}, 95 % below "
        f"{np.percentile(errors, 95):.4f}, within {ALLOWED}: {100 * np.mean(np.array(errors) <= ALLOWED):.0f} %, "
        f"RMS error over stated sigma {np.sqrt(np.mean(np.square(scaled))):.2f}"
    )


def rendered(data: Path) -> list[str]:
    """Errors on the matches of rendered frames."""
    lines = []
    for sequence in read_dataset(data):
        matches = match_frames({view: sequence.image("rs", *view) for view in VIEWS}, sequence.rig, OPTIONS)
        found = estimate_readout_ratio(matches, sequence.rig, JUDGE, OPTIONS.robust)
        true = sequence.shutter.readout_ratio
        error = (
            "none found" if found is None else f"error {found.readout_ratio - true:+.4f}, stated {found.sigma:.4f}"
        )
        lines.append(f"{sequence.name:14s} {len(matches.tracks):5d} tracks: {error}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="rendered dataset instead of simulated matches")
    parser.add_argument("--trials", type=int, default=40)
    arguments = parser.parse_args()
    if arguments.data is not None:
        lines = rendered(arguments.data)
    else:
        cases = [(1000, 1.0), (6000, 1.0), (1000, 2.0), (6000, 2.0)]
        lines = [simulated(tracks, degrees, arguments.trials) for tracks, degrees in cases]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
