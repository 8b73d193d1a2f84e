"""Simulated correspondences: random points, seen exactly by a moving rolling-shutter rig, then noise and outliers.

Row times come from the true rows, solved for exactly; a solver only ever sees the noisy ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import MOTION_MODELS, Motion
from rsbench.core.projection import ProjectionStatus, back_project, rs_project
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

SceneShape = Literal["box", "plane"]


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """What to simulate."""

    pairs: int = 0
    """Matches over time per camera, each camera with points of its own."""
    tracks: int = 0
    """Points seen in all four images."""
    noise_px: float = 0.0
    """Standard deviation of the noise on every pixel coordinate."""
    outlier_ratio: float = 0.0
    """Share of matches whose frame-1 pixels are replaced by others."""
    outlier_px: float = 80.0
    """Outliers lie uniformly within this distance, per coordinate, of the truth."""
    depth: tuple[float, float] = (2.0, 10.0)
    """Range of depths in frame 0, metres, uniform."""
    shape: SceneShape = "box"
    """Points at random depths, or on one slanted plane in the middle of the range."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """Correspondences with the truth that made them."""

    correspondences: Correspondences
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    outliers: dict[str, np.ndarray]
    """Per set (``left``, ``right``, ``tracks``), which matches are outliers."""


def random_direction(rng: np.random.Generator) -> FloatArray:
    """Unit vector (3,), uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def random_motion(
    rng: np.random.Generator, angle: float, distance: float, model: Literal["linear", "twist"] = "linear"
) -> Motion:
    """Motion that turns by ``angle`` (radians) and shifts by ``distance`` (metres) per frame period."""
    return MOTION_MODELS[model](angle * random_direction(rng), distance * random_direction(rng))


def simulate(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    options: SimulationOptions,
    rng: np.random.Generator,
) -> Simulation:
    """Matches of points that the moving rig sees in all images that their set needs.

    Raises:
        ValueError: the motion leaves too few points in view.
    """
    left = _exact(rig, shutter, motion, options, rng, options.pairs, ("left",))
    right = _exact(rig, shutter, motion, options, rng, options.pairs, ("right",))
    both = _exact(rig, shutter, motion, options, rng, options.tracks, ("left", "right"))
    # (n, views, frames, 2) -> xl0, yl0, xr0, yr0, xl1, ...
    exact = {
        "left": left.reshape(-1, 4),
        "right": right.reshape(-1, 4),
        "tracks": np.swapaxes(both, 1, 2).reshape(-1, 8),
    }
    noisy, outliers = {}, {}
    for name, matches in exact.items():
        count = round(options.outlier_ratio * len(matches))
        mask = np.zeros(len(matches), dtype=np.bool_)
        mask[rng.permutation(len(matches))[:count]] = True
        shift = rng.uniform(-options.outlier_px, options.outlier_px, (len(matches), 2))
        noisy[name] = matches + options.noise_px * rng.standard_normal(matches.shape)
        half = matches.shape[1] // 2
        for k in range(half, 2 * half, 2):
            noisy[name][mask, k : k + 2] += shift[mask]
        outliers[name] = mask
    return Simulation(
        correspondences=Correspondences(**noisy),
        rig=rig,
        shutter=shutter,
        motion=motion,
        outliers=outliers,
    )


def _exact(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    options: SimulationOptions,
    rng: np.random.Generator,
    count: int,
    sides: tuple[Literal["left", "right"], ...],
) -> FloatArray:
    """Noise-free pixels (count, views, 2 frames, 2) of points that every view sees once."""
    camera = rig.camera
    found = [np.zeros((0, len(sides), 2, 2))]
    total = 0
    for _ in range(60):
        if total >= count:
            break
        size = 2 * (count - total) + 8
        pixels = rng.uniform((0.0, 0.0), (camera.width - 1, camera.height - 1), (size, 2))
        points = back_project(
            rig, shutter, motion, sides[0], 0, pixels, _depths(options, rng, camera.unproject(pixels))
        )
        views = [[rs_project(rig, shutter, motion, side, frame, points) for frame in (0, 1)] for side in sides]
        seen = np.all([view.status == ProjectionStatus.SEEN for row in views for view in row], axis=0)
        stacked = np.stack([np.stack([view.pixels for view in row], axis=1) for row in views], axis=1)
        found.append(stacked[seen])
        total += int(np.count_nonzero(seen))
    if total < count:
        raise ValueError(f"the motion leaves only {total} of {count} points in view; use a slower one")
    return np.concatenate(found)[:count]


def _depths(options: SimulationOptions, rng: np.random.Generator, rays: FloatArray) -> FloatArray:
    """Depth z (n,) of the points on the rays (n, 3)."""
    near, far = options.depth
    if options.shape == "box":
        return rng.uniform(near, far, len(rays))
    # A plane n.X = 1, tilted so that the depth changes over the image.
    middle = 0.5 * (near + far)
    return middle / (1.0 + 0.3 * rays[:, 0] - 0.2 * rays[:, 1])
