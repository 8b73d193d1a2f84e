"""Rolling-shutter stereo frames from a ray tracer that shares no code with rsbench.

Textured quads, each pixel seen at the time of its own line, a lens of one coefficient, grey-level noise. The
conventions are those of docs/explanation/conventions.md, written again from their text: what rsbench makes of
such frames cannot be right by a mistake that both share.

    python benchmarks/foreign_frames.py --out data/foreign --rows twist lens --seeds 5

Each case gets a folder ROW-SEED: left_0.png, right_0.png ... of two times, or left/ and right/ of more; the same
below gs/, at the time of each frame's first line, without noise; told.toml and untold.toml, rigs for ``rsbench
correct`` with and without what the shutter does; and truth.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import foreign_motion as motion
import numpy as np
from foreign_motion import Array, Law
from foreign_world import Image, Quad, World, random_world, read_photographs
from scipy.spatial.transform import Rotation

SIDES = ("left", "right")
_FAR = 1e-6
"""Inverse metres from which on something is seen."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Two cameras and how they read their lines."""

    ratio: float
    scans: tuple[str, str] = ("top", "top")
    """Of the left and the right camera: where reading begins."""
    k1: float = 0.0
    """Brown and Conrady's first coefficient."""
    width: int = 640
    height: int = 480
    focal: float = 520.0
    baseline: float = 0.2

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def scan(self, side: str) -> str:
        return self.scans[SIDES.index(side)]

    def rows(self, side: str) -> bool:
        """Whether a camera reads rows, not columns."""
        return self.scan(side) in ("top", "bottom")

    def times(self, side: str, frame: int) -> Array:
        """Times (lines,) of the lines from the top or the left."""
        lines = self.height if self.rows(side) else self.width
        order = np.arange(lines) if self.scan(side) in ("top", "left") else np.arange(lines)[::-1]
        return frame + self.ratio * order / lines

    def camera(self, law: Law, side: str, tau: Array) -> tuple[Array, Array]:
        """Poses (n, 3, 3), (n, 3) of a camera: half the baseline left or right of the body's centre."""
        R, t = law.body(tau)
        return R, t + np.array([self.baseline / 2 if side == "left" else -self.baseline / 2, 0.0, 0.0])


@dataclass(frozen=True)
class Rays:
    """Of the samples of an image: x / z (rows or 1, columns) and y / z (rows, columns or 1)."""

    x: Image
    y: Image


@lru_cache(maxsize=4)
def rays(rig: Rig, samples: int) -> Rays:
    """Of ``samples`` by ``samples`` points of every pixel, spread evenly over it."""
    column, row = (
        ((np.arange(size * samples) + 0.5) / samples - 0.5 - middle) / rig.focal
        for size, middle in zip((rig.width, rig.height), rig.centre, strict=True)
    )
    x, y = column[None, :], row[:, None]
    if rig.k1 == 0.0:
        return Rays(x.astype(np.float32), y.astype(np.float32))
    distorted = np.hypot(x, y)
    radius = distorted.copy()
    for _ in range(30):
        radius -= (radius + rig.k1 * radius**3 - distorted) / (1.0 + 3.0 * rig.k1 * radius**2)
    gain = radius / np.maximum(distorted, 1e-12)
    return Rays((x * gain).astype(np.float32), (y * gain).astype(np.float32))


def trace(world: World, rig: Rig, poses: tuple[Array, Array], rows: bool = True, samples: int = 2) -> Image:
    """The image (height, width), grey values from 0 to 255, black where nothing is.

    Args:
        poses: of the camera, one for each line, or one for all.
        rows: whether lines are rows.
        samples: points of a pixel in each direction.
    """
    ray = rays(rig, samples)
    shape = rig.height * samples, rig.width * samples
    near = np.full(shape, _FAR, dtype=np.float32)
    texels = np.zeros((3, *shape), dtype=np.float32)
    for quad, place in zip(world.quads, world.places, strict=True):
        _draw(quad, place, rig, poses, rows, ray, near, texels)
    values = _sample(world.atlas, texels[0], texels[1], texels[2] - 1.5 * np.log2(near))
    values[near <= _FAR] = 0.0
    mean = values.reshape(rig.height, samples, rig.width, samples).mean(axis=(1, 3), dtype=np.float64)
    return np.asarray(mean, dtype=np.float32)


def _draw(
    quad: Quad,
    place: tuple[int, int, int, int],
    rig: Rig,
    poses: tuple[Array, Array],
    rows: bool,
    ray: Rays,
    near: Image,
    texels: Image,
) -> None:
    """Where the quad is nearer than what is there: its inverse depth, texel and level of detail at depth 1.

    With the quad's edges A, B and corner C in the camera, (A u + B v + C) = z ray, so that the inverse of
    [A B C] times the ray is (u, v, 1) / z.
    """
    R, t = poses
    frame = np.stack([R @ quad.across, R @ quad.down, R @ quad.corner + t], axis=-1)
    box = _box(frame, rig, near.shape)
    if box is None:
        return
    samples = near.shape[0] // rig.height
    normal = np.cross(frame[:, :, 0], frame[:, :, 1])
    area = np.linalg.norm(normal, axis=-1)
    distance = np.abs(np.sum(normal * frame[:, :, 2], axis=-1)) / area
    # A pixel at depth z covers z^3 / (focal^2 distance) of the plane.
    detail = 0.5 * np.log2(place[2] * place[3] / area / np.maximum(distance, 1e-9)) - np.log2(rig.focal * samples)
    lines = np.concatenate([np.linalg.inv(frame).reshape(-1, 9), detail[:, None]], axis=1).astype(np.float32)
    down, over = box
    if len(lines) > 1:
        lines = np.repeat(lines, samples, axis=0)[down if rows else over]
    m = [line[:, None] if rows else line[None, :] for line in lines.T]
    x = ray.x[down if len(ray.x) > 1 else slice(None), over]
    y = ray.y[down, over if ray.y.shape[1] > 1 else slice(None)]
    u, v, inverse = (m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] for i in range(3))
    seen = (inverse > near[box]) & (u >= 0) & (v >= 0) & (u <= inverse) & (v <= inverse)
    np.copyto(near[box], inverse, where=seen)
    inverse = np.where(seen, inverse, np.float32(1.0))
    np.copyto(texels[0][box], u / inverse * np.float32(place[2]) + np.float32(place[0] - 0.5), where=seen)
    np.copyto(texels[1][box], v / inverse * np.float32(place[3]) + np.float32(place[1] - 0.5), where=seen)
    np.copyto(texels[2][box], m[9], where=seen)


def _box(frame: Array, rig: Rig, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Rows and columns of samples that may show a quad; None when none does."""
    edges = np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]])
    corners = frame @ edges
    if np.all(corners[:, 2] <= 0.0):
        return None
    if np.any(corners[:, 2] < 0.01):
        return slice(0, shape[0]), slice(0, shape[1])
    points = (corners[:, :2] / corners[:, 2:]).transpose(0, 2, 1).reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    if rig.k1 != 0.0:
        share = np.linspace(0.0, 1.0, 65)
        rim = [
            np.where(k, side, low + share[:, None] * (high - low)) for side in (low, high) for k in np.eye(2) > 0
        ]
        ideal = np.concatenate(rim)
        largest = 1e9 if rig.k1 > 0.0 else np.sqrt(-1.0 / (3.0 * rig.k1))
        radius = np.minimum(np.linalg.norm(ideal, axis=-1, keepdims=True), largest)
        points = (
            ideal
            / np.maximum(np.linalg.norm(ideal, axis=-1, keepdims=True), 1e-12)
            * (radius + rig.k1 * radius**3)
        )
        low, high = points.min(axis=0), points.max(axis=0)
    samples = shape[0] // rig.height
    first = np.floor((low * rig.focal + rig.centre - 1.0) * samples)
    last = np.ceil((high * rig.focal + rig.centre + 2.0) * samples)
    (left, top), (right, bottom) = (np.clip(ends, 0, shape[::-1]).astype(int) for ends in (first, last))
    return None if left >= right or top >= bottom else (slice(top, bottom), slice(left, right))


def _sample(atlas: list[Image], x: Image, y: Image, level: Image) -> Image:
    """Bilinear in the two nearest levels of detail, weighted by how near they are."""
    out = np.zeros(x.shape, dtype=np.float32)
    level = np.clip(level, 0.0, len(atlas) - 1.0)
    for number, image in enumerate(atlas):
        weight = np.maximum(1.0 - np.abs(level - np.float32(number)), 0.0)
        if np.any(weight):
            scale = np.float32(0.5**number)
            at = [(axis + np.float32(0.5)) * scale - np.float32(0.5) for axis in (x, y)]
            out += weight * cv2.remap(image, at[0], at[1], cv2.INTER_LINEAR)
    return out


@dataclass(frozen=True, kw_only=True)
class Case:
    """A motion as a rig sees it."""

    law: Law
    rig: Rig
    model: str | None = None
    """rsbench's name of the law; None for laws that it does not know."""
    frames: int = 2


def _vectors(rng: np.random.Generator, degrees: float, metres: tuple[float, float]) -> tuple[Array, Array]:
    """A rotation of so many degrees and a translation of a random length, in random directions."""
    w = np.radians(degrees) * motion.direction(rng, (1.0, 1.0, 0.6))
    return w, rng.uniform(*metres) * motion.direction(rng, (1.0, 0.7, 1.0))


def _linear(degrees: float, **rig: Any) -> Callable[[np.random.Generator], Case]:
    """Cases of the linear law."""
    return lambda rng: Case(
        law=motion.Linear(*_vectors(rng, degrees, (0.1, 0.25))), rig=Rig(**rig), model="linear"
    )


def _twist(rng: np.random.Generator) -> Case:
    return Case(law=motion.Twist(*_vectors(rng, 4.0, (0.1, 0.25))), rig=Rig(ratio=0.8), model="twist")


def _inertial(rng: np.random.Generator) -> Case:
    return Case(law=motion.Inertial(*_vectors(rng, 3.0, (0.15, 0.3))), rig=Rig(ratio=0.8), model="inertial")


def _accelerated(rng: np.random.Generator) -> Case:
    law = motion.Accelerated(*_vectors(rng, 2.0, (0.1, 0.25)), k=rng.uniform(0.1, 0.5))
    return Case(law=law, rig=Rig(ratio=0.7), model="accelerated")


def _forward(rng: np.random.Generator) -> Case:
    w = np.radians(0.5) * motion.direction(rng, (1.0, 1.0, 0.6))
    d = np.array([*rng.normal(0.0, 0.01, 2), -rng.uniform(0.2, 0.35)])  # forward, what stands still comes nearer
    return Case(law=motion.Linear(w, d), rig=Rig(ratio=0.9), model="linear")


def _drive(rng: np.random.Generator) -> Case:
    """Eight frames from a vehicle that brakes or speeds up on a wide bend."""
    w = np.radians(0.5) * motion.direction(rng, (0.1, 1.0, 0.1))
    d = np.array([*rng.normal(0.0, 0.01, 2), -rng.uniform(0.15, 0.25)])  # as in _forward
    return Case(law=motion.Accelerated(w, d, k=rng.uniform(-0.08, 0.1)), rig=Rig(ratio=0.8), frames=8)


def _shaken(strength: float, slowest: float, fastest: float, frames: int = 8) -> Callable[..., Case]:
    """Sequences from a hand."""

    def case(rng: np.random.Generator) -> Case:
        return Case(law=motion.shaken(rng, strength, slowest, fastest), rig=Rig(ratio=0.8), frames=frames)

    return case


ROWS: dict[str, Callable[[np.random.Generator], Case]] = {
    "twist": _twist,
    "lens": _linear(2.0, ratio=0.7, k1=-0.25, focal=560.0),  # with 520 px the corners lie where the lens folds
    "bottom": _linear(2.0, ratio=0.8, scans=("bottom", "bottom")),
    "apart": _linear(2.0, ratio=0.6, scans=("top", "bottom")),
    "inertial": _inertial,
    "forward": _forward,
    "accelerated": _accelerated,
    "drive": _drive,
    "strong": _shaken(1.0, 0.15, 0.45),
    "tremor": _shaken(0.25, 0.15, 0.45),
    "walk": _shaken(1.0, 0.06, 0.18),
    "pair-strong": _shaken(1.0, 0.15, 0.45, frames=2),
    "pair-tremor": _shaken(0.25, 0.15, 0.45, frames=2),
    "pair-walk": _shaken(1.0, 0.06, 0.18, frames=2),
    "long-strong": _shaken(1.0, 0.15, 0.45, frames=60),
    "long-tremor": _shaken(0.25, 0.15, 0.45, frames=60),
    "long-walk": _shaken(1.0, 0.06, 0.18, frames=60),
}


def draw_case(row: str, seed: int) -> tuple[Case, np.random.Generator]:
    """The case of a row and seed, and the generator for what surrounds it."""
    rng = np.random.default_rng([seed, *row.encode()])
    return ROWS[row](rng), rng


def write_case(row: str, seed: int, folder: Path, photographs: list[Image]) -> float:
    """Everything of one case; truth.json comes last. Returns the seconds of a traced frame."""
    case, rng = draw_case(row, seed)
    rig = case.rig
    path = motion.centres(case.law, np.linspace(0.0, case.frames, 20 * case.frames))
    world = random_world(rng, path, rig.focal, photographs)
    noise = float(rng.uniform(1.0, 2.0))
    begin = time.perf_counter()
    for frame in range(case.frames):
        for side in SIDES:
            tau = rig.times(side, frame)
            rolling = trace(world, rig, rig.camera(case.law, side, tau), rig.rows(side))
            rolling += rng.normal(0.0, noise, rolling.shape).astype(np.float32)
            start = np.array([float(frame)])
            _write(picture(folder, case.frames, side, frame), rolling)
            _write(
                picture(folder / "gs", case.frames, side, frame),
                trace(world, rig, rig.camera(case.law, side, start)),
            )
    seconds = (time.perf_counter() - begin) / (4 * case.frames)
    for name, told in (("told", True), ("untold", False)):
        (folder / f"{name}.toml").write_text(rig_card(rig, told), "utf-8")
    truth = {"row": row, "seed": seed, "noise": noise, "quads": len(world.quads), **_truth(case)}
    (folder / "truth.json").write_text(json.dumps(truth), "utf-8")
    return seconds


def picture(folder: Path, frames: int, side: str, frame: int) -> Path:
    """Where an image lies: side by side for two times, else in a folder of each camera."""
    return folder / f"{side}_{frame}.png" if frames == 2 else folder / side / f"{frame:03d}.png"


def _write(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.clip(np.rint(image), 0, 255).astype(np.uint8))


def rig_card(rig: Rig, told: bool) -> str:
    """The rig as ``rsbench correct --rig`` takes it."""
    shutter = f'readout_ratio = {rig.ratio}\nscan = "{rig.scans[0]}"\nright_scan = "{rig.scans[1]}"\n'
    lens = f'lens = {{ model = "brown-conrady", k1 = {rig.k1} }}\n' if rig.k1 else ""
    camera = f"fx = {rig.focal}\nfy = {rig.focal}\ncx = {rig.centre[0]}\ncy = {rig.centre[1]}\n"
    return f"baseline = {rig.baseline}\n{shutter if told else ''}[camera]\n{camera}{lens}"


def _truth(case: Case) -> dict[str, Any]:
    """What was true, as JSON holds it."""
    rig = case.rig
    motions = [motion.between(case.law, frame, frame + 1.0) for frame in range(case.frames - 1)]
    poses: dict[str, Any] = {side: [] for side in SIDES}
    for frame in range(case.frames):
        for side in SIDES:
            R, t = case.law.body(rig.times(side, frame))
            vectors = Rotation.from_matrix(R).as_rotvec()
            poses[side].append(np.round(np.concatenate([vectors, t], axis=1), 12).tolist())
    return {
        "law": type(case.law).__name__.lower(),
        "law_parameters": {name: np.asarray(value).tolist() for name, value in vars(case.law).items()},
        "motion_model": case.model,
        "frames": case.frames,
        "ratio": rig.ratio,
        "scans": dict(zip(SIDES, rig.scans, strict=True)),
        "k1": rig.k1,
        "w": motions[0][0].tolist(),
        "d": motions[0][1].tolist(),
        "motions": [{"w": w.tolist(), "d": d.tolist()} for w, d in motions],
        "poses_are": "per side, frame and line from the top or the left: rotation vector and t of body_from_world",
        "poses": poses,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("data/foreign"))
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--photographs", type=Path, help="folder (default: those of scikit-image, if installed)")
    arguments = parser.parse_args()
    photographs = read_photographs(arguments.photographs)
    for row in arguments.rows:
        for seed in range(arguments.seeds):
            seconds = write_case(row, seed, arguments.out / f"{row}-{seed}", photographs)
            sys.stdout.write(f"{row}-{seed}: {seconds:.2f} s a frame\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
