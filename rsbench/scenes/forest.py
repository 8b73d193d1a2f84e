"""A wood: trunks, twigs and leaves in layers from 2.5 to 40 m, each of which hides parts of the next.

The default viewpoint stands near the origin and looks along +y, up a slope. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.model import FloatArray
from rsbench.scenes.parts import PartsBuilder, Piece, flat, grid, lump, placed, tube, unit

_CLEAR = 1.7
"""No trunk stands nearer to the path, which runs along y from -4 to 2 m, so that the rig has room."""
_NEAR = ((-1.15, 3.3, 0.07), (1.25, 3.9, 0.10), (-0.35, 5.2, 0.035), (0.62, 6.1, 0.05))
"""Trunks in the foreground: x, y, radius; metres."""


@dataclass(frozen=True, kw_only=True)
class ForestBuilder(PartsBuilder):
    """A mixed wood with undergrowth."""

    RANGES = (("trees", 10, 150), ("ferns", 0, 200))

    trees: int = 75
    """Number of trees, besides those in the foreground."""
    ferns: int = 60
    """Number of ferns on the ground between the trees."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_ground(rng), *_backdrop(rng), *_foreground(rng)]
        for x, y in _places(rng, self.trees, 5.5, 34.0):
            pieces += placed(_tree(rng, float(np.hypot(x, y))), (x, y, float(_height(x, y))))
        for x, y in _places(rng, self.ferns, 3.2, 22.0):
            pieces += placed(_fern(rng), (x, y, float(_height(x, y))))
        return pieces


def _height(x: FloatArray | float, y: FloatArray | float) -> FloatArray:
    """Height of the ground: a slope that rises beyond 6 m, with humps."""
    rise = 0.10 * np.maximum(np.asarray(y) - 6.0, 0.0)
    return rise + 0.10 * np.sin(1.1 * x + 0.4) * np.cos(0.8 * y) + 0.05 * np.sin(2.9 * x - 1.7 * y) - 0.1


def _places(rng: np.random.Generator, count: int, near: float, far: float) -> list[tuple[float, float]]:
    """Spots in a sector of 50 degrees to each side of +y, denser near the middle, none on the path."""
    found: list[tuple[float, float]] = []
    for k in range(count):
        distance = near + (far - near) * ((k + float(rng.random())) / count) ** 0.8
        angle = np.deg2rad(float(rng.uniform(-50, 50)) * (1 if k % 3 else 0.45))
        x, y = distance * float(np.sin(angle)), distance * float(np.cos(angle))
        if abs(x) > _CLEAR or y > 2 + _CLEAR:
            found.append((x, y))
    return found


def _leaves(rng: np.random.Generator, surface: str, centres: FloatArray, size: float, droop: float = 0.0) -> Piece:
    """One pointed leaf of two triangles at each of the centres (n, 3), folded along its middle."""
    count = len(centres)
    along = unit(rng.normal(size=(count, 3)) - (0, 0, droop))
    side = unit(np.cross(along, rng.normal(size=(count, 3))))
    length = size * rng.uniform(0.7, 1.3, (count, 1))
    fold = np.cross(side, along) * 0.12 * length
    tip, left, right = centres + along * length, side * 0.3 * length, -side * 0.3 * length
    middle = centres + along * 0.45 * length
    corners = [centres, middle + left + fold, tip, centres, tip, middle + right + fold]
    return flat(surface, np.stack(corners, axis=1).reshape(-1, 3, 3))


def _branch(
    rng: np.random.Generator, start: FloatArray, reach: FloatArray, radius: float, leaves: int
) -> tuple[Piece, FloatArray]:
    """A bent branch from ``start`` by ``reach`` (3,), and where leaves sit along its outer two thirds (n, 3)."""
    steps = np.linspace(0.0, 1.0, 5)[:, None]
    length = float(np.linalg.norm(reach))
    bend = np.cumsum(rng.normal(scale=0.06 * length, size=(5, 3)), axis=0)
    path = start + steps * reach + steps * bend - (0, 0, 0.12 * length) * steps**2
    twig = tube("bark_fine", path, radius * np.array([1.0, 0.8, 0.6, 0.4, 0.15]), 5)
    at = rng.uniform(0.3, 1.05, leaves)
    spread = np.stack([np.interp(at, steps[:, 0], path[:, k]) for k in range(3)], axis=1)
    return twig, spread + rng.normal(scale=0.09 * length, size=(leaves, 3)) * (1, 1, 0.5)


def _trunk(
    rng: np.random.Generator, height: float, radius: float, surface: str, segments: int
) -> tuple[Piece, FloatArray]:
    """A trunk that leans and bends a little, from below the ground; and its path (9, 3)."""
    levels = np.linspace(-0.3, height, 9)
    bend = np.cumsum(rng.normal(scale=0.008 * height, size=(9, 2)), axis=0)
    path = np.column_stack([bend - bend[0], levels])
    radii = radius * np.linspace(1.0, 0.45, 9)
    radii[:2] *= (1.6, 1.1)
    return tube(surface, path, radii, segments), path


def _tree(rng: np.random.Generator, distance: float) -> list[Piece]:
    """A tree with branches as high as one sees from the path; the farther it stands, the larger its leaves."""
    height, radius = float(rng.uniform(9, 14)), float(rng.uniform(0.05, 0.19))
    trunk, path = _trunk(rng, height, radius, "bark", 10)
    branches, centres = list[Piece](), list[FloatArray]()
    for level in np.arange(float(rng.uniform(1.2, 3.0)), min(height, 2.5 + 0.45 * distance), 0.8):
        start = np.array([np.interp(level, path[:, 2], path[:, k]) for k in range(3)])
        angle, length = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.7, 2.2)) * (1.15 - level / height)
        reach = length * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.1, 0.5)])
        twig, spots = _branch(rng, start, reach, 0.10 * radius + 0.006, 50)
        branches.append(twig)
        centres.append(spots)
    leaf = ("leaves_fine", "leaves_dark", "leaves")[int(rng.integers(3))]
    foliage = [_leaves(rng, leaf, np.concatenate(centres), 0.05 + 0.006 * distance, 0.5)] if centres else []
    return [trunk, *branches, *foliage]


def _foreground(rng: np.random.Generator) -> list[Piece]:
    """Thin trunks, and bare or leafy twigs that cross the picture 2.5 to 6 m away."""
    branches, centres = list[Piece](), list[FloatArray]()
    for x, y, radius in _NEAR:
        trunk, path = _trunk(rng, 7.0, radius, "bark_fine", 16)
        at = np.array([x, y, float(_height(x, y))])
        branches += placed([trunk], (x, y, float(at[2])))
        for level in np.arange(1.0, 3.4, 0.2):
            start = at + np.array([np.interp(level, path[:, 2], path[:, k]) for k in range(3)])
            angle, length = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.35, 1.0))
            reach = length * np.array([np.cos(angle), 0.5 * np.sin(angle), rng.uniform(0, 0.6)])
            twig, spots = _branch(rng, start, reach, 0.008, 0 if rng.random() < 0.25 else 28)
            branches.append(twig)
            centres.append(spots)
    across = ((-1.3, 3.0, 1.05, 1.0), (1.4, 3.5, 2.35, -1.1), (-1.5, 4.0, 1.9, 1.6))
    for x, y, z, along in across:
        twig, spots = _branch(rng, np.array([x, y, z]), np.array([along, 0.3, 0.25]), 0.011, 70)
        branches.append(twig)
        centres.append(spots)
    return [*branches, _leaves(rng, "leaves_fine", np.concatenate(centres), 0.06, 0.5)]


def _fern(rng: np.random.Generator) -> list[Piece]:
    """Fronds that arch out from a middle, each a row of paired leaflets."""
    pieces: list[Piece] = []
    for angle in np.linspace(0, 2 * np.pi, 8)[:-1] + rng.uniform(0, 1):
        length = float(rng.uniform(0.35, 0.75))
        t = np.linspace(0.0, 1.0, 14)
        out = np.array([np.cos(angle), np.sin(angle)])
        rib = np.column_stack([out * length * t[:, None], length * (1.3 * t - 1.15 * t * t)])
        across = 0.22 * length * np.sin(np.pi * (0.12 + 0.86 * t))[:, None] * np.array([-out[1], out[0], 0.0])
        step = np.array([*(out * length * 0.05), 0.0])
        corners = [[rib, rib + step, rib + sign * across + 2 * step][:: int(sign)] for sign in (1.0, -1.0)]
        pieces.append(flat("leaves_fine", np.concatenate([np.stack(three, axis=1) for three in corners])))
    return pieces


def _ground(rng: np.random.Generator) -> list[Piece]:
    """Needles, with fallen leaves, twigs and stones on them."""
    x, y = np.meshgrid(np.linspace(-42, 42, 113), np.linspace(-16, 50, 89))
    pieces = [grid("needles", np.stack([x, y, _height(x, y)], axis=-1), np.stack([x, y], axis=-1))]
    spots = np.column_stack([rng.uniform(-9, 9, 5000), rng.uniform(2.0, 20.0, 5000)])
    fallen = np.column_stack([spots, _height(spots[:, 0], spots[:, 1]) + rng.uniform(0.0, 0.03, 5000)])
    pieces.append(_leaves(rng, "litter", fallen[:3000], 0.07, -0.2))
    pieces.append(_leaves(rng, "straw", fallen[3000:], 0.05, -0.2))
    for _ in range(90):
        a, b = float(rng.uniform(-6, 6)), float(rng.uniform(2.5, 16))
        ends = np.array([a, b]) + np.linspace(0, 1, 4)[:, None] * rng.uniform(-0.9, 0.9, 2)
        path = np.column_stack([ends, _height(ends[:, 0], ends[:, 1]) + 0.02])
        pieces.append(tube("bark_fine", path, np.full(4, float(rng.uniform(0.006, 0.025))), 6))
    for _ in range(25):
        a, b, size = float(rng.uniform(-7, 7)), float(rng.uniform(3.5, 18)), float(rng.uniform(0.08, 0.35))
        stone = lump("stone", rng, (size * 1.4, size, size * 0.7), 0.2, 2)
        pieces += placed([stone], (a, b, float(_height(a, b))))
    return pieces


def _backdrop(rng: np.random.Generator) -> list[Piece]:
    """Bushes on the slope, and the edge of the wood behind all trunks, which leaves little sky."""
    pieces: list[Piece] = []
    for x, y in _places(rng, 16, 9.0, 26.0):
        leaf = "leaves_dark" if rng.random() < 0.5 else "leaves"
        pieces += placed(props.bush(rng, float(rng.uniform(0.5, 1.1)), leaf), (x, y, float(_height(x, y))))
    for row, level in enumerate((1.5, 5.0, 8.5, 12.0)):
        for k in range(17):
            x, y = 4.0 * (k - 8) + float(rng.uniform(-1, 1)), float(rng.uniform(35, 39)) + row
            radii = np.array([rng.uniform(2.4, 3.4), 1.6, rng.uniform(2.2, 3.0)])
            crown = [lump("leaves_dark" if (k + row) % 2 else "leaves", rng, radii, 0.2, 2)]
            direction = unit(rng.normal(size=(320, 3)))
            crown.append(_leaves(rng, crown[0].surface, direction * radii * rng.uniform(0.95, 1.3, (320, 1)), 0.3))
            pieces += placed(crown, (x, y, float(_height(x, y)) + level))
    return pieces
