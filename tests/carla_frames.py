"""Two frames in the layout of Carla-RS, drawn row by row, and what writes layouts of others.

Truth: closed forms written with matrix exponentials, not with rsbench's geometry.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[Any]
WIDTH, HEIGHT, FPS = 160, 120, 10
W, V = np.array([0.3, -0.5, 0.4]), np.array([1.6, 0.3, 1.2])
"""rad/s and m/s: 4 deg and 20 cm a frame."""


def skew(w: Array) -> Array:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def write_image(path: Path, pixels: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


WALLS = ((np.array([0.5, 0.1, 1.0]), 6.0), (np.array([-0.6, -0.2, 1.0]), 6.5))
"""n . X = c of two walls that meet in a corner, which is seen from within."""


def see(frame: int) -> tuple[Array, Array, Array]:
    """z, length of the ray and grey of every pixel, each row from its own pose."""
    blots = cv2.GaussianBlur(np.random.default_rng(3).uniform(size=(600, 600)), (0, 0), 2.0)
    blots = (255 * (blots - blots.min()) / np.ptp(blots)).astype(np.uint8)
    z, lengths, grey = np.zeros((3, HEIGHT, WIDTH))
    x = (np.arange(WIDTH) - (WIDTH - 1) / 2) / (WIDTH / 2)
    for row in range(HEIGHT):
        t = (frame + row / HEIGHT) / FPS
        rays = np.stack([x, np.full(WIDTH, (row - (HEIGHT - 1) / 2) / (WIDTH / 2)), np.ones(WIDTH)], axis=1)
        R, place = scipy.linalg.expm(skew(W * t)), V * t
        turned = rays @ R.T
        depths = np.array([(c - n @ place) / (turned @ n) for n, c in WALLS])
        depths[depths <= 0.0] = np.inf
        wall, z[row] = np.argmin(depths, axis=0), np.min(depths, axis=0)
        lengths[row] = z[row] * np.linalg.norm(rays, axis=1)
        points = place + z[row][:, None] * turned
        where = np.stack([40 * points[:, 0] + 300 * wall, 40 * points[:, 1] + 300], axis=1).astype(np.float32)
        grey[row] = cv2.remap(blots, where[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[0]
    return z, lengths, grey


SEEN = [see(frame) for frame in (0, 1)]


def write_carla(
    root: Path, *, sign: float = 1.0, suffix: str = ".depth", row_ms: float = 1e3 / FPS / HEIGHT
) -> Path:
    folder = root / "seq_0"
    values = " ".join(f"{sign * value:f}" for value in (*W, *V))
    write(folder / "gt_vel.log", f"# Ground truth velocity in camera frame\n# wx, wy, wz, x, y, z\n{values}\n")
    write(root / "rs_calib.txt", f"#Rolling shutter\nFPS: {FPS}\nROW_READOUT_TIME(ms): {row_ms:.8f}\n")
    for frame, (_, lengths, grey) in enumerate(SEEN):
        write_image(folder / f"{frame:04d}_rs.png", grey.astype(np.uint8))
        np.savetxt(folder / f"{frame:04d}_rs{suffix}", lengths, fmt="%.6f")
    return root
