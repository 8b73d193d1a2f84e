"""Rolling-shutter stereo frames from a ray tracer that shares no code with rsbench.

Textured quads, each pixel seen at the time of its own line, a lens of one coefficient, grey-level noise. The
conventions are those of docs/explanation/conventions.md, written again from their text: what rsbench makes of
such frames cannot be right by a mistake that both share.

    python benchmarks/foreign_frames.py --out data/foreign --rows twist lens --seeds 5

Each case gets a folder ROW-SEED: left_0.png, right_0.png ... of two times, or left/ and right/ of more; the same
below gs/, at the time of each frame's first line, without noise; told.toml and untold.toml, rigs for ``rsbench
correct`` with and without what the shutter does; of the rows of general rigs camchain.yaml, the same as Kalibr
writes it, and near.npz, the true inverse depth of each pixel; and truth.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import foreign_motion as motion
import numpy as np
from foreign_motion import Array, Law
from foreign_rig import (
    FRAME_SECONDS,
    KANNALA,
    SIDES,
    Camera,
    Rays,
    Rig,
    camchain,
    card,
    equal,
    rays,
    short_card,
    turned,
)
from foreign_world import Image, Quad, World, random_world, read_photographs, turned_world
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_RIM = 1e-6
"""Of a ray, which has few digits."""
_FAR = 1e-6
"""Inverse metres from which on something is seen."""


def trace(world: World, camera: Camera, poses: tuple[Array, Array], samples: int = 2) -> Image:
    """The image (height, width), grey values from 0 to 255, black where nothing is.

    Args:
        poses: of the camera, one for each line, or one for all.
        samples: points of a pixel in each direction.
    """
    near, texels = _drawn(world, camera, poses, samples)
    blur = rays(camera, samples).blur - 1.5 * np.log2(near)
    values = _sample(world.atlas, texels[0], texels[1], texels[2] + blur)
    values[near <= _FAR] = 0.0
    mean = values.reshape(camera.height, samples, camera.width, samples).mean(axis=(1, 3), dtype=np.float64)
    return np.asarray(mean, dtype=np.float32)


def trace_depth(world: World, camera: Camera, poses: tuple[Array, Array]) -> Image:
    """Depth (height, width), metres along the camera's axis, in the middle of each pixel; infinite of nothing."""
    near, _ = _drawn(world, camera, poses, 1)
    return np.where(near > _FAR, np.float32(1.0) / near, np.float32(np.inf))


def _drawn(world: World, camera: Camera, poses: tuple[Array, Array], samples: int) -> tuple[Image, Image]:
    """Inverse depth of all samples, and (3, ...) their texels and levels of detail at depth 1."""
    ray, shape = rays(camera, samples), (camera.height * samples, camera.width * samples)
    near = np.full(shape, _FAR, dtype=np.float32)
    texels = np.zeros((3, *shape), dtype=np.float32)
    for quad, place in zip(world.quads, world.places, strict=True):
        _draw(quad, place, camera, poses, ray, near, texels)
    return near, texels


def _draw(
    quad: Quad,
    place: tuple[int, int, int, int],
    camera: Camera,
    poses: tuple[Array, Array],
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
    box = _box(frame, ray, near.shape)
    if box is None:
        return
    rows, samples = camera.rows, near.shape[0] // camera.height
    normal = np.cross(frame[:, :, 0], frame[:, :, 1])
    area = np.linalg.norm(normal, axis=-1)
    distance = np.abs(np.sum(normal * frame[:, :, 2], axis=-1)) / area
    # A pixel at depth z covers z^3 / (focal^2 distance) of the plane.
    detail = 0.5 * np.log2(place[2] * place[3] / area / np.maximum(distance, 1e-9)) - np.log2(
        camera.focal * samples
    )
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


def _box(frame: Array, ray: Rays, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Rows and columns of samples that may show a quad; None when none does."""
    edges = np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]])
    corners = frame @ edges
    if np.all(corners[:, 2] <= 0.0):
        return None
    if np.any(corners[:, 2] < 0.01):
        return slice(0, shape[0]), slice(0, shape[1])
    points = (corners[:, :2] / corners[:, 2:]).transpose(0, 2, 1).reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    within = [(low[k] - _RIM <= axis) & (axis <= high[k] + _RIM) for k, axis in enumerate((ray.x, ray.y))]
    if len(ray.x) == 1:
        taken = within[1][:, 0], within[0][0]
    else:
        both = within[0] & within[1]
        taken = both.any(axis=1), both.any(axis=0)
    if not (np.any(taken[0]) and np.any(taken[1])):
        return None
    first, last = ([axis.argmax() for axis in taken], [len(axis) - axis[::-1].argmax() for axis in taken])
    return slice(first[0], last[0]), slice(first[1], last[1])


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
    noise: float | None = None
    """Grey levels; None: drawn."""
    focal: float | None = None
    """Pixels, that textures are fine enough for; None: the left camera's."""
    upright: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3), from axes in which the ground lies below to the world's."""


def _vectors(rng: np.random.Generator, degrees: float, metres: tuple[float, float]) -> tuple[Array, Array]:
    """A rotation of so many degrees and a translation of a random length, in random directions."""
    w = np.radians(degrees) * motion.direction(rng, (1.0, 1.0, 0.6))
    return w, rng.uniform(*metres) * motion.direction(rng, (1.0, 0.7, 1.0))


def _linear(degrees: float, **rig: Any) -> Callable[[np.random.Generator], Case]:
    """Cases of the linear law."""
    return lambda rng: Case(
        law=motion.Linear(*_vectors(rng, degrees, (0.1, 0.25))), rig=equal(**rig), model="linear"
    )


def _twist(rng: np.random.Generator) -> Case:
    return Case(law=motion.Twist(*_vectors(rng, 4.0, (0.1, 0.25))), rig=equal(ratio=0.8), model="twist")


def _inertial(rng: np.random.Generator) -> Case:
    return Case(law=motion.Inertial(*_vectors(rng, 3.0, (0.15, 0.3))), rig=equal(ratio=0.8), model="inertial")


def _accelerated(rng: np.random.Generator) -> Case:
    law = motion.Accelerated(*_vectors(rng, 2.0, (0.1, 0.25)), k=rng.uniform(0.1, 0.5))
    return Case(law=law, rig=equal(ratio=0.7), model="accelerated")


def _forward(rng: np.random.Generator) -> Case:
    w = np.radians(0.5) * motion.direction(rng, (1.0, 1.0, 0.6))
    d = np.array([*rng.normal(0.0, 0.01, 2), -rng.uniform(0.2, 0.35)])  # forward, what stands still comes nearer
    return Case(law=motion.Linear(w, d), rig=equal(ratio=0.9), model="linear")


def _drive(rng: np.random.Generator) -> Case:
    """Eight frames from a vehicle that brakes or speeds up on a wide bend."""
    w = np.radians(0.5) * motion.direction(rng, (0.1, 1.0, 0.1))
    d = np.array([*rng.normal(0.0, 0.01, 2), -rng.uniform(0.15, 0.25)])  # as in _forward
    return Case(law=motion.Accelerated(w, d, k=rng.uniform(-0.08, 0.1)), rig=equal(ratio=0.8), frames=8)


def _shaken(strength: float, slowest: float, fastest: float, frames: int = 8) -> Callable[..., Case]:
    """Sequences from a hand."""

    def case(rng: np.random.Generator) -> Case:
        return Case(law=motion.shaken(rng, strength, slowest, fastest), rig=equal(ratio=0.8), frames=frames)

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


def _two(R: Array | None = None, t: tuple[float, float, float] = (-0.2, 0.0, 0.0), **sides: dict[str, Any]) -> Rig:
    """A rig whose cameras differ from the ideal ones by what is given."""
    left, right = (Camera(**sides.get(side, {})) for side in SIDES)
    return Rig(left=left, right=right, R=np.eye(3) if R is None else R, t=np.array(t))


RIGS = {
    "ideal": _two(),
    "turned": _two(turned(0.3, 0.3, 0.26)),  # 0.5 deg
    "focal": _two(right={"fx": 532.0, "fy": 532.0}),
    "printed": _two(
        turned(0.4, 0.8, -0.6),
        (-0.2, 0.001, -0.002),
        left={"coefficients": (-0.22,), "shift": (3.2, -4.1)},
        right={"fx": 527.0, "fy": 527.0, "coefficients": (-0.20,), "shift": (-5.3, 2.4)},
    ),
    "toed-in": _two(turned(0.0, 3.0, 1.0)),
    "vertical": _two(turned(0.3, -0.2, 0.4), (0.0, -0.2, 0.0)),
    "sizes": _two(turned(0.2, 0.3, -0.2), right={"width": 1280, "height": 720, "fx": 1010.0, "fy": 1010.0}),
    "narrow": _two(right={"height": 370}),
    "global-left": _two(turned(0.2, -0.3, 0.1), left={"ratio": 0.0}),
    "global-right": _two(turned(0.2, -0.3, 0.1), right={"ratio": 0.0}),
    "fisheye": _two(
        turned(-0.3, 0.4, 0.2),
        left={"lens": KANNALA, "fx": 420.0, "fy": 421.0, "coefficients": (0.02, -0.012, 0.004, -0.001)},
        right={"fx": 515.0, "fy": 516.0, "coefficients": (-0.2, 0.03, 0.0005, -0.0004)},
    ),
    "late": _two(turned(0.1, 0.2, -0.2), right={"delay": 0.003 / FRAME_SECONDS}),
}
"""Rigs as calibrations give them. A seed has the same world, motion and noise for all of them."""


def usual_law(rng: np.random.Generator, speed: float = 1.0) -> motion.Linear:
    """The linear law of 2 deg and 0.25 m, in axes in which the ground lies below, so many times as fast."""
    w, d = _vectors(rng, 2.0, (0.25, 0.25))
    return motion.Linear(speed * w, speed * d)


def usual_case(law: motion.Linear, rig: Rig) -> Case:
    """What a rig sees of it."""
    upright = np.rint(rig.body_from_left())  # of a vertical rig a quarter turn
    focal = 1010.0 if rig.right.width > 640 else 520.0
    law = motion.Linear(upright @ law.w, upright @ law.d)
    return Case(law=law, rig=rig, model="linear", noise=1.5, focal=focal, upright=upright)


ROWS |= {name: lambda rng, rig=rig: usual_case(usual_law(rng), rig) for name, rig in RIGS.items()}


def draw_case(row: str, seed: int) -> tuple[Case, np.random.Generator]:
    """The case of a row and seed, and the generator for what surrounds it."""
    rng = np.random.default_rng([seed, *("rig" if row in RIGS else row).encode()])
    return ROWS[row](rng), rng


@dataclass(frozen=True)
class Traced:
    """Images (height, width), grey values, of each side and frame."""

    rolling: dict[tuple[str, int], Image]
    still: dict[tuple[str, int], Image]
    """At the time of the frame's first line, without noise."""
    depth: dict[tuple[str, int], Image]
    """Metres, of the rolling images; of two frames alone."""
    noise: float
    world: World


def trace_case(case: Case, rng: np.random.Generator, photographs: list[Image]) -> Traced:
    """What both cameras see of a world that the generator makes."""
    rig, rolling, still, depth = case.rig, {}, {}, {}
    path = motion.centres(case.law, np.linspace(0.0, case.frames, 20 * case.frames)) @ case.upright
    focal = case.focal or rig.left.focal
    world = turned_world(random_world(rng, path, focal, photographs), case.upright)
    noise = float(rng.uniform(1.0, 2.0)) if case.noise is None else case.noise
    for view in ((side, frame) for frame in range(case.frames) for side in SIDES):
        camera = rig.camera(view[0])
        poses = rig.poses(case.law, view[0], camera.times(view[1]))
        seen = trace(world, camera, poses)
        if case.frames == 2:
            depth[view] = trace_depth(world, camera, poses)
        rolling[view] = seen + rng.normal(0.0, noise, seen.shape).astype(np.float32)
        still[view] = trace(world, camera, rig.poses(case.law, view[0], camera.start(view[1])))
    return Traced(rolling, still, depth, noise, world)


def write_case(row: str, seed: int, folder: Path, photographs: list[Image]) -> float:
    """Everything of one case; truth.json comes last. Returns the seconds of a traced frame."""
    case, rng = draw_case(row, seed)
    begin = time.perf_counter()
    traced = trace_case(case, rng, photographs)
    seconds = (time.perf_counter() - begin) / (4 * case.frames)
    for (side, frame), image in traced.rolling.items():
        _write(picture(folder, case.frames, side, frame), image)
        _write(picture(folder / "gs", case.frames, side, frame), traced.still[side, frame])
    for name, told in (("told", True), ("untold", False)):
        text = (card if row in RIGS else short_card)(case.rig, told)
        (folder / f"{name}.toml").write_text(text, "utf-8")
    if row in RIGS:
        near = {picture(Path(), 2, *view).stem: np.float32(1.0) / depth for view, depth in traced.depth.items()}
        np.savez_compressed(folder / "near.npz", **near)
        (folder / "camchain.yaml").write_text(camchain(case.rig), "utf-8")
    truth = {
        "row": row,
        "seed": seed,
        "noise": traced.noise,
        "quads": len(traced.world.quads),
        **_truth(case),
    }
    (folder / "truth.json").write_text(json.dumps(truth), "utf-8")
    return seconds


def picture(folder: Path, frames: int, side: str, frame: int) -> Path:
    """Where an image lies: side by side for two times, else in a folder of each camera."""
    return folder / f"{side}_{frame}.png" if frames == 2 else folder / side / f"{frame:03d}.png"


def grey(image: Image) -> NDArray[np.uint8]:
    """As a file has it."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _write(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), grey(image))


def _truth(case: Case) -> dict[str, Any]:
    """What was true, as JSON holds it."""
    rig = case.rig
    motions = [motion.between(case.law, frame, frame + 1.0) for frame in range(case.frames - 1)]
    poses: dict[str, Any] = {side: [] for side in SIDES}
    for frame in range(case.frames):
        for side in SIDES:
            R, t = case.law.body(rig.camera(side).times(frame))
            vectors = Rotation.from_matrix(R).as_rotvec()
            poses[side].append(np.round(np.concatenate([vectors, t], axis=1), 12).tolist())
    return {
        "law": type(case.law).__name__.lower(),
        "law_parameters": {name: np.asarray(value).tolist() for name, value in vars(case.law).items()},
        "motion_model": case.model,
        "frames": case.frames,
        "ratio": max(rig.camera(side).ratio for side in SIDES),
        "cameras": {side: asdict(rig.camera(side)) for side in SIDES},
        "right_from_left": {"R": rig.R.tolist(), "t": rig.t.tolist()},
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
