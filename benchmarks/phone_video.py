"""A phone's video, made without rsbench's renderer, and how near its correction comes to the truth.

A hand-held camera in a room of five textured walls: each row is cast as rays at its own time and looked up in the
textures. The file is as phones write it: rows stored as the sensor has them with a rotation of 90 degrees beside
them, time stamps of a clock that stops for a frame or two, sound, H.264 or HEVC.

    python benchmarks/phone_video.py DIR --width 960 --seconds 4      # writes DIR/phone.mp4 and DIR/truth/*.png
    rsbench correct DIR/phone.mp4 --out DIR/phone-corrected.mp4
    python benchmarks/phone_video.py DIR --score DIR/phone-corrected.mp4
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

RATIO, FPS, FOV_DEG = 0.72, 30, 62.0
"""Readout over frame period, frames per second, horizontal field of view of the stored frame."""
ROOM = np.array([3.0, 1.6, 6.0])
"""Half width, half height and depth, metres; the camera stands in the middle of the open end."""


def texture(seed: int, size: int = 1024) -> NDArray[np.float32]:
    """(size, size, 3): noise of all scales, with edges of tiles and bricks."""
    rng = np.random.default_rng(seed)
    out = np.zeros((size, size, 3), np.float32)
    for level in range(2, 9):
        noise = rng.uniform(-1.0, 1.0, (1 << level, 1 << level, 3)).astype(np.float32)
        out += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) * 0.82**level
    y, x = np.mgrid[:size, :size]
    out += 0.35 * ((x // 64 + y // 48) % 2)[..., None] - 0.5 * (((x % 128) < 4) | ((y % 96) < 4))[..., None]
    low, high = np.percentile(out, [1, 99])
    return np.clip((out - low) / (high - low) * 235.0 + 10.0, 0.0, 255.0).astype(np.float32)


class Hand:
    """Where a hand holds a camera at a time in seconds: it walks slowly, turns and trembles."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.hertz = rng.uniform(0.3, 4.0, (6, 6))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (6, 6))
        strong = np.array([0.05, 0.07, 0.05, 0.08, 0.06, 0.05])
        self.size = rng.uniform(0.4, 1.0, (6, 6)) * strong[:, None] / self.hertz

    def at(self, seconds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotations (n, 3, 3) and positions (n, 3) of the camera in the room."""
        angle = 2.0 * np.pi * self.hertz * seconds[:, None, None] + self.phase
        six = np.sum(self.size * np.sin(angle), axis=2)
        rotations = np.stack([cv2.Rodrigues(each)[0] for each in six[:, :3]])
        return rotations, six[:, 3:] + [0.0, 0.0, 0.0] + seconds[:, None] * [0.1, 0.0, 0.25]


def view(
    size: tuple[int, int], hand: Hand, seconds: NDArray[np.float64], walls: list[Any], per_metre: float = 220.0
) -> NDArray[np.uint8]:
    """Image (H, W, 3) whose rows are taken at these times (H,); pixels of the textures in a metre."""
    width, height = size
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * FOV_DEG))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack(
        [(x - (width - 1) / 2) / focal, (y - (height - 1) / 2) / focal, np.ones_like(x, float)], axis=-1
    )
    R, c = hand.at(seconds)
    rays, c = np.einsum("hij,hwj->hwi", R, rays), c[:, None, :]
    with np.errstate(divide="ignore"):
        far = np.where(rays > 0.0, (ROOM - c) / rays, (-ROOM * [1, 1, 0.2] - c) / rays)
    which = np.argmin(far, axis=-1)
    points = c + rays * np.min(far, axis=-1)[..., None]
    image = np.zeros((height, width, 3), np.float32)
    for axis in range(3):
        for side in (0, 1):
            mine = (which == axis) & ((points[..., axis] > 0.0) == bool(side))
            u, v = (points[..., k] for k in range(3) if k != axis)
            places = (np.stack([u, v], axis=-1) * per_metre % (len(walls[0]) - 1.0)).astype(np.float32)
            seen = cv2.remap(walls[2 * axis + side], places, None, cv2.INTER_LINEAR)
            image[mine] = seen[mine]
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def sampled(
    size: tuple[int, int], hand: Hand, seconds: NDArray[np.float64], walls: list[Any]
) -> NDArray[np.uint8]:
    """``view`` from twice the size, as a lens and a sensor blur."""
    fine = view((2 * size[0], 2 * size[1]), hand, np.repeat(seconds, 2), walls)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA))


def stamps_of(frames: int, seed: int) -> list[int]:
    """In 1/600 s: 20 apart, 1 off here and there, and a frame missing every second or so."""
    rng = np.random.default_rng(seed)
    gaps = np.where(rng.uniform(size=frames) < 0.03, 40, 20)
    return [int(each) for each in np.concatenate([[0], np.cumsum(gaps[1:])]) + rng.integers(-1, 2, frames) + 1]


def write(folder: Path, size: tuple[int, int], seconds: float, seed: int, codec: str, every: int) -> None:
    """phone.mp4, truth/NUMBER.png of each ``every``-th frame at its middle row, and scene.json."""
    frames, hand = int(seconds * FPS), Hand(seed)
    walls, stamps = [texture(seed + k) for k in range(6)], stamps_of(int(seconds * FPS), seed)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    with av.open(str(folder / "phone.mp4"), mode="w") as file:
        stream = file.add_stream(codec, rate=FPS, options={"crf": "18", "preset": "fast"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        one = 1 << 16
        stream.set_display_matrix([0, one, 0, -one, 0, 0, size[1] * one, 0, 1 << 30])
        sound = file.add_stream("aac", rate=48000)
        for number in range(frames):
            start = stamps[number] / 600.0
            rows = start + RATIO / FPS * np.arange(size[1]) / size[1]
            frame = av.VideoFrame.from_ndarray(sampled(size, hand, rows, walls), format="rgb24")
            frame.pts, frame.time_base = stamps[number], Fraction(1, 600)
            file.mux(stream.encode(frame))
            if number % every == 0:
                middle = np.full(size[1], rows[0] + 0.5 * RATIO / FPS * (size[1] - 1) / size[1])
                truth = sampled(size, hand, middle, walls)
                cv2.imwrite(str(folder / "truth" / f"{number:06d}.png"), truth[..., ::-1])
        file.mux(stream.encode(None))
        for packet in tone(sound, seconds):
            file.mux(packet)
    record = {"frames": frames, "ratio": RATIO, "fov_deg": FOV_DEG, "size": size, "seed": seed}
    (folder / "scene.json").write_text(json.dumps(record))


def tone(sound: Any, seconds: float) -> Iterator[Any]:
    """Packets of a tone of 440 Hz."""
    count = int(48000 * seconds)
    wave = (0.2 * np.sin(2.0 * np.pi * 440.0 * np.arange(count) / 48000.0)).astype(np.float32)[None]
    for begin in range(0, count, 1024):
        frame = av.AudioFrame.from_ndarray(wave[:, begin : begin + 1024], format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 48000, begin, Fraction(1, 48000)
        yield from sound.encode(frame)
    yield from sound.encode(None)


def psnr(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2)))


def score(folder: Path, corrected: Path) -> None:
    """PSNR of frames with truth, before and after, of all pixels."""
    truths = {int(each.stem): cv2.imread(str(each))[..., ::-1] for each in (folder / "truth").glob("*.png")}
    before, after = (
        {n: f.to_ndarray(format="rgb24") for n, f in enumerate(av.open(str(path)).decode(video=0)) if n in truths}
        for path in (folder / "phone.mp4", corrected)
    )
    gains = []
    for number in sorted(truths):
        old, new = (psnr(each[number], truths[number]) for each in (before, after))
        gains.append(new - old)
        sys.stdout.write(f"frame {number:4d}: {old:6.2f} -> {new:6.2f} dB ({new - old:+.2f})\n")
    sys.stdout.write(f"mean gain {np.mean(gains):+.2f} dB, worst {np.min(gains):+.2f} dB of {len(gains)} frames\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--codec", default="libx264", help="libx264 or libx265")
    parser.add_argument("--every", type=int, default=10, help="frames with truth")
    parser.add_argument("--score", type=Path, metavar="VIDEO")
    given = parser.parse_args()
    if given.score:
        score(given.folder, given.score)
    else:
        size = given.width, given.width * 9 // 16 // 2 * 2
        write(given.folder, size, given.seconds, given.seed, given.codec, given.every)
