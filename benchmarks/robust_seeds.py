"""How far the robust loop is off on noisy frames, how far its seeds spread, and whether its stated errors say so.

python benchmarks/robust_seeds.py DATASET... [--seeds 12] [--draws 1] [--cache FOLDER] [--solver rs-stereo-refined]

Frames of rendered datasets get photon noise: the light that a pixel shows is drawn from a Poisson distribution
and quantised again. The number of photons at full scale is that which gives the first image the PSNR asked for.
The default matcher's matches are kept in the cache. NEES is the squared error over the stated covariance,
chi-squared with 6 degrees of freedom when that is right. Processor times are of one
thread, PoseLib's on the same matches.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import SIDES, VIEWS
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.vision.feature_matcher import find_correspondences, load_features

Image = NDArray[np.uint8]
SETS = ("left", "right", "stereo_0", "stereo_1", "tracks")
_LEVELS = np.arange(256) / 255.0
_LIGHT = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)
"""Linear light of an sRGB level (IEC 61966-2-1)."""


def with_photon_noise(image: Image, photons: float, rng: np.random.Generator) -> Image:
    """An sRGB image (H, W, 3) as a sensor sees it that counts ``photons`` at full scale."""
    light = rng.poisson(photons * _LIGHT[image]) / photons
    levels = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * np.clip(levels, 0.0, 1.0)).astype(np.uint8)


def photons_for(image: Image, psnr_db: float) -> float:
    """Photons at full scale that give an image this PSNR, by bisection of one draw's."""
    low, high = 1.0, 7.0  # decimal exponents
    for _ in range(20):
        middle = 0.5 * (low + high)
        noisy = with_photon_noise(image, 10.0**middle, np.random.default_rng(0))
        error = np.mean((noisy.astype(np.float64) - image) ** 2)
        low, high = (middle, high) if 10.0 * np.log10(255.0**2 / max(error, 1e-9)) < psnr_db else (low, middle)
    return 10.0**high


def noisy_matches(sequence: Sequence, psnr_db: float, draw: int) -> Correspondences:
    """What the default matcher finds in a sequence's four frames under noise."""
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    photons = photons_for(images["left", 0], psnr_db)
    rng = np.random.default_rng([27, draw])
    noisy = {view: with_photon_noise(image, photons, rng) for view, image in images.items()}
    return find_correspondences(load_features("sift"), noisy)


def cached_matches(
    folders: list[Path], psnr_db: float, draws: int, cache: Path
) -> Iterator[tuple[str, Sequence, Correspondences]]:
    """Name, sequence and matches of every draw of noise; made once."""
    cache.mkdir(parents=True, exist_ok=True)
    for draw in range(draws):
        for folder in folders:
            for sequence in read_dataset(folder):
                path = cache / f"{folder.name}-{sequence.name}-{psnr_db:g}dB-{draw}.npz"
                if not path.exists():
                    found = noisy_matches(sequence, psnr_db, draw)
                    np.savez(path, **{each: getattr(found, each) for each in SETS})
                with np.load(path) as stored:
                    matches = Correspondences(**{each: stored[each] for each in SETS})
                yield f"{folder.name}/{sequence.name}/{draw}", sequence, matches


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeds:
    """One draw of noise, solved with several seeds."""

    rotation_deg: FloatArray
    translation_deg: FloatArray
    nees: FloatArray
    sigmas: FloatArray
    """Largest error of a parameter over its stated standard deviation."""
    spread: float
    """Largest standard deviation over the seeds, over the stated one."""
    milliseconds: float
    poselib: float
    """Milliseconds of PoseLib's robust loop."""


def solve(sequence: Sequence, matches: Correspondences, solver_name: str, seeds: int) -> Seeds:
    """The default loop with several seeds on the same matches."""
    solver, truth = load_solver(solver_name), sequence.motion
    values, covariances, times = [], [], []
    for seed in range(seeds):
        start = time.process_time()
        rng = np.random.default_rng(seed)
        found = estimate_motion(matches, sequence.rig, sequence.shutter, solver, RobustOptions(), rng).estimate
        times.append(1e3 * (time.process_time() - start))
        values.append(np.concatenate([found.w, found.d]))
        covariances.append(np.full((6, 6), np.nan) if found.covariance is None else found.covariance)
    theta, C = np.array(values), np.array(covariances)
    error, sigma = theta - np.concatenate([truth.w, truth.d]), np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    return Seeds(
        rotation_deg=np.degrees(rotation_error(theta[:, :3], truth.w)),
        translation_deg=np.degrees(translation_error(theta[:, 3:], truth.d)),
        nees=np.einsum("ni,nij,nj->n", error, np.linalg.inv(C), error),
        sigmas=np.max(np.abs(error) / sigma, axis=1),
        spread=float(np.max(np.std(theta, axis=0) / np.median(sigma, axis=0))),
        milliseconds=float(np.median(times)),
        poselib=poselib_time(sequence, matches),
    )


def poselib_time(sequence: Sequence, matches: Correspondences) -> float:
    """Median of three runs on the rig's matches over time, with our threshold and confidence."""
    import poselib

    camera, rig = sequence.rig.camera, sequence.rig
    pairs, places = [], [poselib.CameraPose(), poselib.CameraPose()]
    for number, side in enumerate(SIDES):
        rows, pair = getattr(matches, side), poselib.PairwiseMatches()
        pair.cam_id1 = pair.cam_id2 = number
        pair.x1, pair.x2 = list(rows[:, :2]), list(rows[:, 2:])
        pairs.append(pair)
        places[number].t = rig.offset(side)
    parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
    model = {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": parameters}
    options = RobustOptions()
    wanted = {"max_error": options.threshold_px, "max_epipolar_error": options.threshold_px}
    wanted |= {"success_prob": options.confidence, "seed": 0}
    times = []
    for _ in range(3):
        start = time.process_time()
        poselib.estimate_generalized_relative_pose(
            pairs, places, [model, model], places, [model, model], wanted, {}
        )
        times.append(1e3 * (time.process_time() - start))
    return float(np.median(times))


def line(name: str, found: Seeds) -> str:
    return (
        f"{name:26s}{np.sqrt(np.mean(found.rotation_deg**2)):9.4f}{np.sqrt(np.mean(found.translation_deg**2)):9.3f}"
        f"{np.max(found.translation_deg):9.3f}{np.max(found.sigmas):8.1f}{np.mean(found.nees):8.1f}{found.spread:8.2f}"
        f"{found.milliseconds:8.0f}{found.milliseconds / found.poselib:8.2f}"
    )


def summary(results: list[Seeds]) -> list[str]:
    nees, sigmas = (np.concatenate([getattr(each, name) for each in results]) for name in ("nees", "sigmas"))
    e_R, e_T = (
        np.concatenate([getattr(each, name) for each in results]) for name in ("rotation_deg", "translation_deg")
    )
    inside = [f"{100 * np.mean(nees < chi2.ppf(p, 6)):.0f} % of {100 * p:.0f} %" for p in (0.5, 0.9, 0.95)]
    ratios = [each.milliseconds / each.poselib for each in results]
    return [
        f"{len(results)} draws of noise, {len(nees)} solutions",
        f"e_R {np.sqrt(np.mean(e_R**2)):.4f} deg RMS, {np.median(e_R):.4f} median; "
        f"e_T {np.sqrt(np.mean(e_T**2)):.3f} RMS, {np.median(e_T):.3f} median",
        f"NEES {np.mean(nees):.1f} mean, {np.median(nees):.1f} median (6 and 5.3); inside: {', '.join(inside)}",
        f"largest error {np.max(sigmas):.1f} stated sigmas; within 4: {100 * np.mean(sigmas <= 4.0):.1f} %",
        f"spread over seeds {np.max([each.spread for each in results]):.2f} stated sigmas at most",
        f"time over PoseLib's: {np.median(ratios):.2f} median, {np.max(ratios):.2f} at most",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs="+", help="folders that rsbench generate made")
    parser.add_argument("--seeds", type=int, default=12, help="of the search, per draw of noise")
    parser.add_argument("--draws", type=int, default=1, help="of the noise, per sequence")
    parser.add_argument("--psnr", type=float, default=27.0, help="dB")
    parser.add_argument("--cache", type=Path, default=Path("build/noisy"))
    parser.add_argument("--solver", default="rs-stereo-refined")
    arguments = parser.parse_args()
    heads = ("e_R", "e_T deg", "worst e_T", "sigmas", "NEES", "spread", "ms", "PoseLib")
    widths = (9, 9, 9, 8, 8, 8, 8, 8)
    sys.stdout.write(" " * 26 + "".join(f"{h:>{w}s}" for h, w in zip(heads, widths, strict=True)) + "\n")
    results = []
    for name, sequence, matches in cached_matches(
        arguments.datasets, arguments.psnr, arguments.draws, arguments.cache
    ):
        results.append(solve(sequence, matches, arguments.solver, arguments.seeds))
        sys.stdout.write(line(name, results[-1]) + "\n")
    sys.stdout.write("\n".join(summary(results)) + "\n")


if __name__ == "__main__":
    main()
