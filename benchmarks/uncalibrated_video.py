"""Hand-held video of a camera that nobody calibrated: what is stated of it, and what its correction gains.

Videos without a renderer: photographs of ``scikit-image`` on a wall, a floor and a board before the wall, warped
row by row as a hand shakes the camera. Neither focal length nor ratio is given. Five scenes, five ratios, three
focal lengths (widths of the image); ``--seed`` draws other hands. Each is corrected to the time of its middle row,
with what is found and with everything known.

    python benchmarks/uncalibrated_video.py --seed 100 --out FILE        # 15 of the 75 cases
    python benchmarks/uncalibrated_video.py --cases 75 --out FILE

A row each: the truth, what is found with its deviation, the errors in deviations; the mean gain, that with
everything known, and the worst frame's, dB. A case that is in the file is not run again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.camera_capture import find_focal, find_shutter
from rsbench.pipeline.footage import OneCameraCard
from rsbench.pipeline.mono_sequence import correct_frames
from rsbench.solvers.engine.robust_motion import RobustOptions

SCENES = (
    ("coffee", "brick"),
    ("astronaut", "gravel"),
    ("chelsea", "grass"),
    ("rocket", "brick"),
    ("motorcycle_left", "gravel"),
)
RATIOS, FOCALS = (0.35, 0.5, 0.65, 0.8, 0.95), (0.75, 1.0, 1.4)
SIZE, SUPERSAMPLED, FRAMES, NOISE = (480, 270), 2, 14, 1.5
WALL_M, FLOOR_M, BOARD_M, WALL_PX_PER_M = 4.0, 1.3, 2.6, 240.0
TREMBLE_DEG, WANDER_M, PAN_DEG, STRONGER = 0.5, 0.012, 0.5, (0.6, 2.0)
"""Root mean square per frame period of turns and translations; and of a steady pan; times a factor of the hand."""
BORDER = 0.06
"""Share of the height along the border that is not scored: no frame shows what comes in there."""

Case = tuple[int, float, float]
"""Scene, ratio, focal length in widths."""


def picture(name: str) -> NDArray[np.float32]:
    """A photograph, tiled by reflection, without the detail that a pixel cannot show."""
    import skimage.data

    if name == "motorcycle_left":
        image = cv2.imread(str(Path(skimage.data.__file__).parent / "motorcycle_left.png"))[..., ::-1]
    else:
        image = np.asarray(getattr(skimage.data, name)())
    image = np.dstack([image] * 3) if image.ndim == 2 else image[..., :3]
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)


def hand(rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Frequencies, phases, amplitudes of the turns and translations (6, 5), and a steady rate (6,)."""
    cycles = np.exp(rng.uniform(np.log(0.02), np.log(0.2), (6, 5)))  # per frame period: 0.6 to 6 Hz of 30 frames/s
    size = np.array([TREMBLE_DEG * np.pi / 180] * 3 + [WANDER_M] * 3)[:, None]
    rates = rng.normal(size=(6, 5)) * size / np.sqrt(5.0) * np.sqrt(2.0)
    steady = np.concatenate(
        [rng.normal(size=3) * np.deg2rad(PAN_DEG) * (0.5, 1.0, 0.2), rng.normal(size=3) * WANDER_M]
    )
    strength = float(np.exp(rng.uniform(*np.log(STRONGER))))
    return (
        cycles,
        rng.uniform(0.0, 2.0 * np.pi, (6, 5)),
        strength * rates / (2.0 * np.pi * cycles),
        strength * steady,
    )


def poses(moves: tuple[FloatArray, ...], tau: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) world_from_camera and places (n, 3) at times (n,)."""
    cycles, phases, sizes, steady = moves
    waves = np.sin(2.0 * np.pi * cycles * tau[:, None, None] + phases) - np.sin(phases)
    values = np.sum(sizes * waves, axis=-1) + (tau - 0.5 * FRAMES)[:, None] * steady
    return so3.exp(values[:, :3]), values[:, 3:]


def view(
    tau: FloatArray, moves: tuple[FloatArray, ...], textures: tuple[NDArray[np.float32], ...], focal: float
) -> NDArray[np.float32]:
    """Image (H, W, 3) whose rows are taken at these times (H,)."""
    k, (width, height) = SUPERSAMPLED, SIZE
    y, x = (np.mgrid[: height * k, : width * k] + 0.5) / k - 0.5
    R, p = poses(moves, np.repeat(tau, k))
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


def video(case: Case, seed: int) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]]]:
    """Frames (H, W, 3) of one hand before one scene, and each at the time of its middle row."""
    scene, ratio, focal = case[0], case[1], case[2] * SIZE[0]
    rng = np.random.default_rng([seed, scene, round(100 * ratio), round(100 * case[2])])
    wall, floor = (picture(name) for name in SCENES[scene])
    textures = wall, floor, picture(SCENES[(scene + 2) % len(SCENES)][0])
    moves, rows = hand(rng), ratio * np.arange(SIZE[1]) / SIZE[1]
    taken = [view(k + rows, moves, textures, focal) for k in range(FRAMES)]
    still = [view(k + np.full_like(rows, np.mean(rows)), moves, textures, focal) for k in range(FRAMES)]
    noisy = [np.clip(each + rng.normal(0.0, NOISE, each.shape) + 0.5, 0, 255).astype(np.uint8) for each in taken]
    return noisy, still


def cases() -> list[Case]:
    """All 75; the first 15 are each ratio with each focal length, and each scene three times."""
    turns = itertools.product(range(len(SCENES)), range(len(FOCALS)), range(len(RATIOS)))
    return [((turn + r + 2 * f) % len(SCENES), RATIOS[r], FOCALS[f]) for turn, f, r in turns]


def psnr(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """dB inside the border."""
    edge = int(BORDER * SIZE[1])
    off = (image.astype(np.float64) - truth)[edge:-edge, edge:-edge]
    return float(10.0 * np.log10(255.0**2 / np.mean(off**2)))


def gains(
    frames: Sequence[NDArray[np.uint8]],
    truths: Sequence[NDArray[np.float32]],
    camera: PinholeCamera,
    shutter: RollingShutter,
) -> tuple[list[float], list[str]]:
    """Gain of each frame, dB, and why it was left as it was, if it was."""
    out, reasons = list[float](), list[str]()
    for moment, frame, truth in zip(correct_frames(frames, camera, shutter), frames, truths, strict=True):
        out.append(round(psnr(moment.shown["left"].image, truth) - psnr(frame, truth), 2))
        reasons.append("" if moment.frames else moment.reason)
    return out, reasons


def measured(case: Case, seed: int) -> dict[str, Any]:
    """What is found of a video and gained on it; a ratio that is not determined leaves frames as they are."""
    (frames, truths), began = video(case, seed), time.process_time()
    card, options, focal = OneCameraCard(), RobustOptions(), case[2] * SIZE[0]
    row: dict[str, Any] = {"scene": case[0], "ratio": case[1], "focal": focal, "seed": seed}
    row["before"] = [round(psnr(*both), 2) for both in zip(frames, truths, strict=True)]
    try:
        found = find_shutter(frames, len(frames), card, options)
        found = found if found.focal is not None else find_focal(frames, len(frames), card, found, options)
    except NoMotionError as error:
        row |= {"refused": str(error), "gains": [0.0] * len(frames)}
    else:
        assert found.capture is not None and found.focal is not None
        best, alone = found.capture.likeliest, found.focal
        assert best is not None
        row |= {
            "found": best.ratio,
            "sigma": best.sigma,
            "p": best.probability,
            "scan": found.shutter.scan_of("left"),
        }
        row |= {"found_focal": alone.focal, "sigma_focal": alone.sigma, "determined": alone.determined}
        row["s"] = round(time.process_time() - began, 1)
        row["gains"], row["left"] = gains(frames, truths, found.rig.camera, found.shutter)
    known = PinholeCamera.centred(*SIZE, focal)
    row["known"], row["known_left"] = gains(
        frames, truths, known, RollingShutter(height=SIZE[1], readout_ratio=case[1])
    )
    return row


def line(row: dict[str, Any]) -> str:
    text = f"{row['scene']} {row['ratio']:.2f} {row['focal']:4.0f}: "
    if "refused" in row:
        text += f"{'refused':<44}"
    else:
        text += f"{row['found']:.3f} +- {row['sigma']:.3f} ({_off(row):+5.1f}) {row['scan']:<6} {row['p']:.2f}"
        text += f"  f {row['found_focal']:4.0f} +- {row['sigma_focal']:3.0f} ({_off(row, '_focal'):+.1f})"
    each, known = np.array(row["gains"]), np.array(row["known"])
    text += f"  gain {each.mean():5.2f} of {known.mean():5.2f}, worst {each.min():+5.2f} of {known.min():+5.2f}"
    return text + f"  left {sum(map(bool, row.get('left', ())))}"


def _off(row: dict[str, Any], which: str = "") -> float:
    truth = row["focal" if which else "ratio"]
    return float((row[f"found{which}"] - truth) / max(row[f"sigma{which}"], 1e-9))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--cases", type=int, default=15, help="of the 75 (default 15)")
    parser.add_argument("--out", type=Path, help="a line of JSON for each case")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    rows = (
        [json.loads(each) for each in given.out.read_text().splitlines()]
        if given.out and given.out.exists()
        else []
    )
    done = {(row["scene"], row["ratio"], row["focal"], row["seed"]): row for row in rows}
    rows = list[dict[str, Any]]()
    for case in cases()[: given.cases]:
        row = done.get((case[0], case[1], case[2] * SIZE[0], given.seed))
        if row is None:
            row = measured(case, given.seed)
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
        rows.append(row)
        sys.stdout.write(line(row) + "\n")
        sys.stdout.flush()
    solved = [row for row in rows if "refused" not in row]
    for which in ("", "_focal"):
        errors = np.array([_off(row, which) for row in solved])
        inside = int(np.sum(np.abs(errors) <= 2.0))
        sys.stdout.write(f"{which[1:] or 'ratio'}: within two deviations {inside} of {len(errors)}; ")
    each, known = (np.array([row[name] for row in rows]) for name in ("gains", "known"))
    sys.stdout.write(f"{len(rows) - len(solved)} refused\nmean gain {each.mean():.2f} dB of {known.mean():.2f} ")
    sys.stdout.write(f"({each.mean() / known.mean():.0%}); {np.sum(each < -0.2)} of {each.size} frames more than ")
    sys.stdout.write(
        f"0.2 dB worse, the worst {each.min():+.2f} (known: {np.sum(known < -0.2)}, {known.min():+.2f})\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
