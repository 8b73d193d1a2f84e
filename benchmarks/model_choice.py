"""How often the motion model that is chosen is the right one, beside the probability that is stated.

python benchmarks/model_choice.py
python benchmarks/model_choice.py --data data/moderate
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rsbench.capture.model_choice import MODELS, choose_model
from rsbench.capture.model_fit import ACCELERATION_SIGMA

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_direction, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.spline_motion import PRESETS
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import find_motion, match_frames
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
NOISES = (0.2, 1.0, 4.0)
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)


class Trial(NamedTuple):
    model: str
    noise_px: float
    probability: dict[str, float]

    @property
    def stated(self) -> float:
        return max(self.probability.values())

    @property
    def right(self) -> bool:
        return max(self.probability, key=lambda name: self.probability[name]) == self.model


def drawn(model: str, rng: np.random.Generator) -> Motion:
    """0.3 to 2 deg and 0.05 to 0.3 m in any direction; own parameters from the priors of the choice."""
    w, d = (
        np.radians(rng.uniform(0.3, 2.0)) * random_direction(rng),
        rng.uniform(0.05, 0.3) * random_direction(rng),
    )
    own: dict[str, object] = {}
    if model == "accelerated":
        own["acceleration"] = float(np.clip(ACCELERATION_SIGMA * rng.standard_normal(), -0.49, None))
    if model == "spline":
        own = {"preset": sorted(PRESETS)[int(rng.integers(len(PRESETS)))], "seed": int(rng.integers(2**32))}
    return make_motion(model, w, d, own)


def simulated(trials: int, tracks: int, seed: int) -> Iterator[Trial]:
    """Random motions of random models; a tenth of the tracks is wrong."""
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial])
        model, noise = MODELS[int(rng.integers(len(MODELS)))], NOISES[trial % len(NOISES)]
        options = SimulationOptions(tracks=tracks, noise_px=noise, outlier_ratio=0.1)
        motion = drawn(model, rng)
        matches = simulate(RIG, SHUTTER, motion, options, np.random.default_rng([seed, 1, trial])).correspondences
        found = estimate_motion(matches, RIG, SHUTTER, RefinedSolver(), RobustOptions(), rng).estimate
        if not found.success:
            continue
        choice = choose_model(matches, RIG, SHUTTER, make_motion("linear", found.w, found.d))
        yield Trial(model, noise, choice.probability)


def table(trials: list[Trial]) -> Iterator[str]:
    """Stated probability beside the share of right choices, then what each model is taken for."""
    for low, high in itertools.pairwise(BINS):
        own = [trial for trial in trials if low < trial.stated <= high]
        if own:
            stated, right = np.mean([t.stated for t in own]), np.mean([t.right for t in own])
            yield f"stated {low:.2f} to {high:.2f}: {len(own):4d} trials, mean {stated:.3f}, right {right:.3f}"
    shares = [(p, name == t.model) for t in trials for name, p in t.probability.items()]
    for noise in NOISES:
        own = [t for t in trials if t.noise_px == noise]
        stated, right = np.mean([t.stated for t in own]), np.mean([t.right for t in own])
        yield f"noise {noise:g} px: {len(own):4d} trials, mean stated {stated:.3f}, right {right:.3f}"
    error = np.mean([(p - right) ** 2 for p, right in shares])
    expected = np.mean([p * (1 - p) for p, _ in shares])
    yield f"all shares: mean squared error {error:.4f}, expected of stated probabilities {expected:.4f}"
    for model in MODELS:
        own = [t for t in trials if t.model == model]
        taken = ", ".join(f"{name} {np.mean([t.probability[name] for t in own]):.2f}" for name in MODELS)
        yield f"data {model:12s} {len(own):4d} trials, mean probability: {taken}"


def noisy(image: NDArray[np.uint8], psnr_db: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image with photon noise: its variance grows with the light, and is that of the PSNR in the mean."""
    if not np.isfinite(psnr_db):
        return image
    light = (image / 255.0) ** 2.2
    slope = np.maximum((1 / 2.2) * np.maximum(light, 1e-3) ** (1 / 2.2 - 1), 1e-3)
    # A display's level errs by the slope of its curve times the root of the light.
    sigma = slope * np.sqrt(np.maximum(light, 1e-3))
    sigma *= 255.0 * 10 ** (-psnr_db / 20) / np.sqrt(np.mean(sigma**2))
    return np.clip(np.rint(image + sigma * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def rendered(data: Path, asked: str, psnr_db: float) -> Iterator[str]:
    """The choice on the frames of a rendered dataset, and the errors with and without it."""
    for sequence in read_dataset(data):
        rng = np.random.default_rng(0)
        images = {view: noisy(sequence.image("rs", *view), psnr_db, rng) for view in VIEWS}
        matches = match_frames(images, sequence.rig, CorrectionOptions())
        errors = []
        for model in (None, asked):
            found = find_motion(matches, sequence.rig, sequence.shutter, CorrectionOptions(motion_model=model))
            w, d = found.motion.w, found.motion.d
            errors.append(
                f"e_R {np.rad2deg(rotation_error(w, sequence.motion.w)):.3f} "
                f"e_T {np.rad2deg(translation_error(d, sequence.motion.d)):.3f} deg"
            )
        head = f"{sequence.name:18s} {len(matches.tracks)} tracks"
        yield f"{head}: linear {errors[0]}, {asked} {errors[1]}: {found.choice}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="rendered dataset instead of simulated matches")
    parser.add_argument("--motion-model", default="auto")
    parser.add_argument("--psnr", type=float, default=np.inf, help="photon noise of the frames, dB")
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--tracks", type=int, default=60)
    arguments = parser.parse_args()
    if arguments.data is not None:
        lines = rendered(arguments.data, arguments.motion_model, arguments.psnr)
    else:
        lines = table(list(simulated(arguments.trials, arguments.tracks, seed=3)))
    for line in lines:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
