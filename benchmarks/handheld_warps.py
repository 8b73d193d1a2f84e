"""Whether the stated deviations of a hand-held camera's readout ratio and focal length cover the truth.

Videos without a renderer: photographs of ``scikit-image`` on a wall, a floor and a board before the wall, warped
row by row as a hand shakes the camera. Neither focal length nor ratio is given. Five scenes, five ratios, three
focal lengths, in width of the image; ``--seed`` draws other hands.

    python benchmarks/handheld_warps.py --seed 100

A row each: the truth, what is found with its deviation, and the error in deviations; at the end the shares within
two deviations of all that is stated.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core import so3
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_camera import OneCameraCard, find_camera_alone, find_shutter
from rsbench.solvers.engine.robust_motion import RobustOptions

SCENES = (
    ("coffee", "brick"),
    ("astronaut", "gravel"),
    ("chelsea", "grass"),
    ("rocket", "brick"),
    ("motorcycle_left", "gravel"),
)
RATIOS, FOCALS = (0.35, 0.5, 0.65, 0.8, 0.95), (0.75, 1.0, 1.4)
SIZE, SUPERSAMPLED, FRAMES, NOISE = (320, 240), 2, 14, 1.5
WALL_M, FLOOR_M, BOARD_M, WALL_PX_PER_M = 4.0, 1.3, 2.6, 160.0
TREMBLE_DEG, WANDER_M, PAN_DEG = 0.5, 0.012, 0.5
"""Root mean square per frame period of turns and translations; and of a steady pan."""


def picture(name: str) -> NDArray[np.float32]:
    """A photograph, tiled by reflection, without the detail that a pixel cannot show."""
    import skimage.data

    image = np.asarray(getattr(skimage.data, name)() if name != "motorcycle_left" else _stereo_left())
    image = np.dstack([image] * 3) if image.ndim == 2 else image[..., :3]
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)


def _stereo_left() -> NDArray[np.uint8]:
    import skimage.data

    return np.asarray(cv2.imread(str(Path(skimage.data.__file__).parent / "motorcycle_left.png"))[..., ::-1])


def hand(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Frequencies, phases, amplitudes of the turns and translations (6, 5), and a steady rate (6,)."""
    cycles = np.exp(rng.uniform(np.log(0.02), np.log(0.2), (6, 5)))  # per frame period: 0.6 to 6 Hz of 30 frames/s
    size = np.array([TREMBLE_DEG * np.pi / 180] * 3 + [WANDER_M] * 3)[:, None]
    rates = rng.normal(size=(6, 5)) * size / np.sqrt(5.0) * np.sqrt(2.0)
    steady = np.concatenate(
        [rng.normal(size=3) * np.deg2rad(PAN_DEG) * (0.5, 1.0, 0.2), rng.normal(size=3) * WANDER_M]
    )
    return cycles, rng.uniform(0.0, 2.0 * np.pi, (6, 5)), rates / (2.0 * np.pi * cycles), steady


def poses(moves: tuple[FloatArray, ...], tau: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) world_from_camera and places (n, 3) at times (n,)."""
    cycles, phases, sizes, steady = moves
    waves = np.sin(2.0 * np.pi * cycles * tau[:, None, None] + phases) - np.sin(phases)
    values = np.sum(sizes * waves, axis=-1) + (tau - 0.5 * FRAMES)[:, None] * steady
    return so3.exp(values[:, :3]), values[:, 3:]


def frame(
    number: int,
    moves: tuple[FloatArray, ...],
    textures: tuple[NDArray[np.float32], ...],
    focal: float,
    ratio: float,
) -> NDArray[np.float32]:
    """One frame (H, W, 3), each row at its own time."""
    k, (width, height) = SUPERSAMPLED, SIZE
    y, x = (np.mgrid[: height * k, : width * k] + 0.5) / k - 0.5
    R, p = poses(moves, number + ratio * np.floor(y[:, 0] + 0.5) / height)
    rays = np.stack([(x - (width - 1) / 2) / focal, (y - (height - 1) / 2) / focal, np.ones_like(x)], axis=-1)
    d = np.einsum("yij,yxj->yxi", R, rays)
    # A wall that leans, a floor, and a board before the wall.
    planes = (
        (np.array([0.15, -0.1, 1.0]), WALL_M),
        (np.array([0.0, 1.0, 0.0]), FLOOR_M),
        (np.array([-0.2, 0.1, 1.0]), BOARD_M),
    )
    out, nearest = np.zeros((*x.shape, 3), np.float32), np.full(x.shape, np.inf)
    for which, (normal, distance) in enumerate(planes):
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (distance - p @ normal)[:, None] / (d @ normal)
        X = p[:, None] + reach[..., None] * d
        u, v = X[..., 0], X[..., 2] if which == 1 else X[..., 1]
        shown = (reach > 0.05) & (reach < np.minimum(nearest, 60.0))
        if which == 2:
            shown &= (np.abs(u + 0.55) < 0.45) & (np.abs(v - 0.15) < 0.5)
        texture = textures[which]
        at = np.stack([u, v], axis=-1).astype(np.float32) * WALL_PX_PER_M * (1.0 if which < 2 else 1.6)
        at += np.array([texture.shape[1], texture.shape[0]], np.float32) / 2
        sampled = cv2.remap(texture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        out[shown], nearest[shown] = sampled[shown], reach[shown]
    return cv2.resize(out, SIZE, interpolation=cv2.INTER_AREA)


def video(scene: int, ratio: float, focal: float, seed: int) -> list[NDArray[np.uint8]]:
    """Frames (H, W, 3) of one hand before one scene; focal length in px."""
    rng = np.random.default_rng([seed, scene, round(100 * ratio), round(focal)])
    wall, floor = (picture(name) for name in SCENES[scene])
    board = picture(SCENES[(scene + 2) % len(SCENES)][0])
    moves = hand(rng)
    frames = [frame(k, moves, (wall, floor, board), focal, ratio) for k in range(FRAMES)]
    return [np.clip(each + rng.normal(0.0, NOISE, each.shape), 0, 255).astype(np.uint8) for each in frames]


def cases(every: int) -> Iterator[tuple[int, float, float]]:
    """Scene, ratio, focal length in widths."""
    return itertools.islice(itertools.product(range(len(SCENES)), RATIOS, FOCALS), 0, None, every)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--every", type=int, default=1, help="of the 75 cases")
    parser.add_argument("--first", type=int, default=0, help="case to begin with")
    parser.add_argument("--out", type=Path, help="a line of JSON for each case")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    errors: dict[str, list[float]] = {"ratio": [], "focal": []}
    refused, card, options = 0, OneCameraCard(), RobustOptions()
    for scene, ratio, widths in itertools.islice(cases(given.every), given.first, None):
        focal, began = widths * SIZE[0], time.process_time()
        row: dict[str, object] = {"scene": scene, "ratio": ratio, "focal": focal, "seed": given.seed}
        frames = video(scene, ratio, focal, given.seed)
        try:
            found = find_shutter(frames, len(frames), card, options)
            alone = find_camera_alone(frames, len(frames), card, found.shutter, options)[1]
        except NoMotionError as error:
            refused += 1
            text, row["refused"] = f"refused: {error}", str(error)
        else:
            assert found.capture is not None
            best = found.capture.likeliest
            assert best is not None
            assert alone is not None
            off = (best.ratio - ratio) / max(best.sigma, 1e-9)
            far = (alone.focal - focal) / alone.sigma
            errors["ratio"].append(off)
            errors["focal"].append(far)
            row |= {"found": best.ratio, "sigma": best.sigma, "p": best.probability, "scan": best.scans.left}
            row |= {"found_focal": alone.focal, "sigma_focal": alone.sigma}
            row |= {"determined": alone.determined, "noise": found.capture.noise_px}
            text = (
                f"{best.ratio:.3f} +- {best.sigma:.3f} ({off:+5.1f})  P({best.scans.left}) {best.probability:.3f}"
            )
            text += f"  f {alone.focal:.0f} +- {alone.sigma:.0f} ({far:+.1f})"
        row["s"] = time.process_time() - began
        sys.stdout.write(f"{scene} {ratio:.2f} {focal:.0f}: {text}  {row['s']:.0f} s\n")
        sys.stdout.flush()
        if given.out:
            with given.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    for name, each in errors.items():
        inside = np.abs(each) <= 2.0
        sys.stdout.write(f"{name}: within two deviations {inside.sum()} of {len(each)} ({inside.mean():.0%}), ")
        sys.stdout.write(f"root mean square {np.sqrt(np.mean(np.square(each))):.2f} deviations, ")
        sys.stdout.write(f"median absolute {np.median(np.abs(each)):.2f}; {refused} refused\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
