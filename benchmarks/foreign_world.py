"""Worlds of textured quads for ``foreign_frames.py``: no code of rsbench.

World axes are those of the body at time 0: x right, y down, z forward, metres. All textures lie in one atlas,
beside copies of a half, a quarter ... of its size, so that what is seen from afar is sampled without aliasing.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.float32]

LEVELS = 5
_CELL = 2 ** (LEVELS - 1)
_MARGIN = 2 * _CELL
"""Texels around a texture that repeat its rim: two of the smallest copy."""
_ATLAS_WIDTH = 4096
_LARGEST = 1600
"""Texels along a texture's side."""
_CLEAR = 1.4
"""Metres that boards and posts keep from the path of the rig."""
_LONG, _APART = 3.0, 0.4
"""Metres of a path that boards in front of its start are enough for, and a further board for so many more."""
_ROOM = np.array([2.0, 0.5, 2.0])
"""Metres between the path and the right wall, the ground and the front, at least."""
_PHOTOGRAPHS = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "gravel", "motorcycle_left")


@dataclass(frozen=True)
class Quad:
    """A parallelogram: corner + u across + v down, u and v from 0 to 1."""

    corner: Array
    across: Array
    down: Array

    def grid(self, steps: int = 9) -> Array:
        """Points (n, 3) spread over it, corners included."""
        u, v = (axis.reshape(-1, 1) for axis in np.meshgrid(*[np.linspace(0.0, 1.0, steps)] * 2))
        return np.asarray(self.corner + u * self.across + v * self.down)

    def corners(self) -> Array:
        """(4, 3)."""
        return self.grid(2)

    def texels(self, focal: float, distance: float) -> tuple[int, int]:
        """Height and width of a texture with a texel per pixel at that distance, where it is not too large."""
        sizes = [float(np.linalg.norm(edge)) for edge in (self.down, self.across)]
        density = min(focal / distance, _LARGEST / max(sizes))
        return max(int(sizes[0] * density), 4), max(int(sizes[1] * density), 4)


@dataclass(frozen=True)
class World:
    """Quads, where their textures lie in the atlas, and the atlas at ``LEVELS`` sizes."""

    quads: list[Quad]
    places: list[tuple[int, int, int, int]]
    """x, y, width, height, texels of the largest size."""
    atlas: list[Image]


def assemble(quads: list[Quad], textures: list[Image]) -> World:
    """A world of quads that show these textures, grey values from 0 to 255."""
    places: list[tuple[int, int, int, int]] = []
    x = y = shelf = 0
    for texture in textures:
        height, width = texture.shape
        taken = [-(-(size + 2 * _MARGIN) // _CELL) * _CELL for size in (height, width)]
        if x + taken[1] > _ATLAS_WIDTH:
            x, y, shelf = 0, y + shelf, 0
        places.append((x + _MARGIN, y + _MARGIN, width, height))
        x, shelf = x + taken[1], max(shelf, taken[0])
    atlas = np.zeros((y + shelf, _ATLAS_WIDTH), dtype=np.float32)
    for (left, top, width, height), texture in zip(places, textures, strict=True):
        rows, columns = (slice(at - _MARGIN, at + size + _MARGIN) for at, size in ((top, height), (left, width)))
        atlas[rows, columns] = np.pad(texture, _MARGIN, mode="edge")
    levels = [atlas]
    while len(levels) < LEVELS:
        half = levels[-1].shape[1] // 2, levels[-1].shape[0] // 2
        levels.append(np.asarray(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA)))
    return World(quads, places, levels)


def random_world(
    rng: np.random.Generator, path: Array, focal: float, photographs: list[Image] | None = None
) -> World:
    """A closed room with boards and posts that keep clear of the rig's path (n, 3); more along a long one."""
    beyond = max(float(np.linalg.norm(path[-1] - path[0])) - _LONG, 0.0)
    quads = _room(rng, path if beyond else path[:1])
    walls = len(quads)
    wanted = walls + int(rng.integers(9, 19))
    posts = walls + int(rng.integers(2, 6))
    all_along = wanted + int(beyond / _APART)
    while len(quads) < all_along:
        quad = _post(rng) if len(quads) < posts else _board(rng)
        if len(quads) >= wanted:
            quad = Quad(quad.corner + path[rng.integers(len(path))], quad.across, quad.down)
        gaps = np.linalg.norm(quad.grid()[:, None] - path, axis=-1)
        if np.min(gaps) > _CLEAR:
            quads.append(quad)
    textures: list[Image] = []
    for quad in quads:
        distance = np.min(np.linalg.norm(quad.grid()[:, None] - path, axis=-1))
        size = quad.texels(focal, float(distance))
        photographed = photographs and rng.random() < 0.6
        textures.append(_mosaic(rng, size, photographs) if photographed and photographs else _painted(rng, size))
    return assemble(quads, textures)


def turned_world(world: World, R: Array) -> World:
    """All of it turned about the origin by R (3, 3)."""
    quads = [Quad(R @ quad.corner, R @ quad.across, R @ quad.down) for quad in world.quads]
    return World(quads, world.places, world.atlas)


def _room(rng: np.random.Generator, path: Array) -> list[Quad]:
    """Front, back, ground, ceiling, left and right, around a path (n, 3)."""
    front, back = rng.uniform(8.0, 15.0), -4.0
    ground, ceiling = rng.uniform(1.3, 1.9), -rng.uniform(2.0, 4.0)
    left, right = -rng.uniform(4.0, 7.0), rng.uniform(4.0, 7.0)
    low, high = path.min(axis=0), path.max(axis=0)
    left, ceiling, back = (min(a, float(b) - 2.0) for a, b in zip((left, ceiling, back), low, strict=True))
    right, ground, front = (max(a, float(b)) for a, b in zip((right, ground, front), high + _ROOM, strict=True))
    wide, tall, deep = (
        np.array([right - left, 0, 0]),
        np.array([0, ground - ceiling, 0]),
        np.array([0, 0, front - back]),
    )
    start = np.array([left, ceiling, front])
    near = np.array([left, ceiling, back])
    return [
        Quad(start, wide, tall),
        Quad(near, wide, tall),
        Quad(start + tall, wide, -deep),
        Quad(near, wide, deep),
        Quad(near, deep, tall),
        Quad(near + wide, deep, tall),
    ]


def _board(rng: np.random.Generator) -> Quad:
    """Somewhere in view, turned by up to 50 deg, larger where it is farther away."""
    depth = float(np.exp(rng.uniform(np.log(1.6), np.log(8.0))))
    middle = depth * np.array([rng.uniform(-0.65, 0.65), rng.uniform(-0.5, 0.45), 1.0])
    size = depth * rng.uniform(0.12, 0.45, 2)
    turn = cv2.Rodrigues(np.radians(rng.uniform(-50.0, 50.0, 3) * [0.6, 1.0, 0.4]))[0]
    across, down = turn[:, 0] * size[0], turn[:, 1] * size[1]
    return Quad(middle - across / 2 - down / 2, across, down)


def _post(rng: np.random.Generator) -> Quad:
    """Thin and upright, somewhat inclined."""
    depth = rng.uniform(1.8, 7.0)
    foot = np.array([depth * rng.uniform(-0.6, 0.6), 1.9, depth])
    across = rng.uniform(0.06, 0.2) * np.array([1.0, 0.0, rng.uniform(-0.3, 0.3)])
    return Quad(foot, across, np.array([rng.uniform(-0.3, 0.3), -rng.uniform(2.0, 5.0), rng.uniform(-0.3, 0.3)]))


def _painted(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Shapes of all sizes over noise of all scales, without detail finer than a texel can show."""
    height, width = size
    out = np.full(size, rng.uniform(80.0, 170.0), dtype=np.float32)
    largest = 0.25 * max(min(size), 40)
    for _ in range(min(40 + height * width // 1500, 900)):
        middle, grey = rng.uniform((0, 0), (width, height)), float(rng.uniform(15.0, 240.0))
        radius = float(np.exp(rng.uniform(np.log(2.0), np.log(largest))))
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(3, 8))))
        points = middle + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        cv2.fillPoly(out, [np.rint(points * 16).astype(np.int32)], grey, cv2.LINE_8, 4)
    cells, strength = 1.5, 9.0
    while cells < max(size):
        few = max(int(height / cells), 2), max(int(width / cells), 2)
        noise = rng.normal(size=few).astype(np.float32)
        out += strength * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, strength = 2.0 * cells, min(1.1 * strength, 12.0)
    return np.clip(cv2.GaussianBlur(out, (0, 0), 0.8), 4.0, 250.0)


def _mosaic(rng: np.random.Generator, size: tuple[int, int], photographs: list[Image]) -> Image:
    """Pieces of photographs side by side, some of them mirrored, smaller or somewhat larger than they are."""
    height, width = size
    out = np.zeros(size, dtype=np.float32)
    y = 0
    while y < height:
        tall, x = int(rng.integers(150, 320)), 0
        while x < width:
            wide = int(rng.integers(150, 320))
            piece = _piece(rng, (min(tall, height - y), min(wide, width - x)), photographs)
            out[y : y + tall, x : x + wide] = piece
            x += wide
        y += tall
    return np.clip(cv2.GaussianBlur(out, (0, 0), 0.6), 4.0, 250.0)


def _piece(rng: np.random.Generator, size: tuple[int, int], photographs: list[Image]) -> Image:
    photograph = photographs[int(rng.integers(len(photographs)))]
    zoom = max(rng.uniform(0.6, 1.2), *(want / has for want, has in zip(size, photograph.shape, strict=True)))
    few = [min(int(np.ceil(want / zoom)), has) for want, has in zip(size, photograph.shape, strict=True)]
    y, x = (int(rng.integers(has - want + 1)) for want, has in zip(few, photograph.shape, strict=True))
    part = photograph[y : y + few[0], x : x + few[1]]
    part = part[:, ::-1] if rng.random() < 0.5 else part
    return np.asarray(cv2.resize(np.ascontiguousarray(part), size[::-1], interpolation=cv2.INTER_CUBIC))


def read_photographs(folder: Path | None) -> list[Image]:
    """Grey photographs of a folder; without one, those that scikit-image is installed with, or none."""
    if folder is not None:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in (".png", ".jpg", ".jpeg"))
    else:
        found = importlib.util.find_spec("skimage")
        places = [] if found is None else list(found.submodule_search_locations or [])
        files = [Path(place) / "data" / f"{name}.png" for place in places for name in _PHOTOGRAPHS]
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    return [image.astype(np.float32) for image in images if image is not None and min(image.shape) >= 200]
