"""How well readout ratio and motion model are found: on simulated matches beside the bound, and on rendered ones.

python benchmarks/readout_ratio.py
python benchmarks/readout_ratio.py --data data/moderate

Motion, ratio and model are unknown; rows are read from the top. The bound is that of Cramer and Rao for the ratio
with the motion unknown and the model known, without the outliers. Medians and RMS over random motions and ratios.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.capture.calibration import NO_ERRORS
from rsbench.capture.hypotheses import (
    MODELS,
    RATIO,
    UNKNOWNS,
    CaptureCost,
    Hypothesis,
    KnownInputs,
    Likelihood,
    Scans,
    TimedMatches,
)
from rsbench.capture.shutter_decision import known_of
from rsbench.capture.two_frame_estimate import Capture, conclude, examine
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.frame_capture import match_frames
from rsbench.pipeline.frame_depth import CorrectionOptions

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
NOISE_PX, NORMAL = 0.3, 1e6


def found_in(matches: Correspondences, rig: StereoRig, seed: int = 0) -> Capture:
    """With the scan known."""
    given = KnownInputs(scanning=Scanning(), calibration=NO_ERRORS)
    return conclude([examine(matches, rig, known_of(matches, rig, given), seed=seed)])


def bound(data: Simulation, model: str, ratio: float) -> float:
    """Least standard deviation of the ratio, from the right matches."""
    right = {name: ~mask for name, mask in data.outliers.items()}
    c = data.correspondences
    matches = Correspondences(
        left=c.left[right["left"]], right=c.right[right["right"]], tracks=c.tracks[right["tracks"]]
    )
    timed, hypothesis = (
        TimedMatches(matches, RIG, model),
        Hypothesis(scans=Scans("top", "top"), motion_model=model),
    )
    likelihood = Likelihood(nu=NORMAL, scale=NOISE_PX, chosen=np.ones(timed.count, dtype=np.bool_))
    unknowns, prior = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
    unknowns[RATIO], prior[RATIO] = ratio, np.inf
    cost = CaptureCost(timed, hypothesis, likelihood, prior)
    theta = timed.packed(hypothesis.scans, unknowns).theta(data.motion.w, data.motion.d)
    _, _, H = cost.local(theta, unknowns, [RATIO])
    return NOISE_PX * float(np.sqrt(np.linalg.inv(H)[6, 6]))


def simulated(model: str, tracks: int, degrees: float, trials: int) -> str:
    """Errors on random motions and ratios: 0.3 px of noise, a tenth outliers."""
    errors, stated, bounds, right = [], [], [], []
    for trial in range(trials):
        rng = np.random.default_rng([11, trial])
        ratio, drawn = rng.uniform(0.3, 1.0), random_motion(rng, np.radians(degrees), 0.3)
        motion = make_motion(model, drawn.w, drawn.d, {})
        options = SimulationOptions(tracks=tracks, noise_px=NOISE_PX, outlier_ratio=0.1)
        data = simulate(RIG, RollingShutter(height=900, readout_ratio=ratio), motion, options, rng)
        capture = found_in(data.correspondences, RIG, trial)
        best = capture.likeliest
        right.append(capture.motion_model == model)
        bounds.append(bound(data, model, ratio))
        errors.append(1.0 if best is None else best.ratio - ratio)
        stated.append(1.0 if best is None else max(best.sigma, 1e-9))
    scaled = np.array(errors) / np.array(stated)
    return (
        f"{model:9s} {tracks:5d} tracks, {degrees:g} deg: median error {np.median(np.abs(errors)):.4f}; RMS error "
        f"over stated {_rms(scaled):.2f}, over the bound {_rms(np.array(errors) / np.array(bounds)):.2f}; within "
        f"3 stated deviations {np.mean(np.abs(scaled) < 3.0):.0%}; model found {np.mean(right):.0%}"
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def rendered(data: Path) -> list[str]:
    """Errors on the matches of rendered frames."""
    lines = []
    for sequence in read_dataset(data):
        images = {view: sequence.image("rs", *view) for view in VIEWS}
        matches = match_frames(images, sequence.rig, CorrectionOptions())
        best, true = found_in(matches, sequence.rig).likeliest, sequence.shutter.readout_ratio
        error = "none found" if best is None else f"error {best.ratio - true:+.4f}, stated {best.sigma:.4f}"
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
        models = [model for model in MODELS if model != "accelerated"]  # its own parameter is drawn nowhere
        cases = [(model, 1000, degrees) for model in models for degrees in (1.0, 3.0)]
        lines = [simulated(*case, arguments.trials) for case in cases]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
