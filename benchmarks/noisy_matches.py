"""Matches of rendered frames under photon noise, kept on disk: what the robust loop meets on real sensors.

The light that a pixel shows is drawn from a Poisson distribution and quantised again. The number of photons at
full scale is that which gives the first image the PSNR asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence, read_dataset
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
                name = f"{folder.name}/{sequence.name}"
                path = cache / f"{folder.name}-{sequence.name}-{psnr_db:g}dB-{draw}.npz"
                if not path.exists():
                    found = noisy_matches(sequence, psnr_db, draw)
                    np.savez(path, **{each: getattr(found, each) for each in SETS})
                with np.load(path) as stored:
                    yield name, sequence, Correspondences(**{each: stored[each] for each in SETS})
