"""A village and its fields from the air: plots, orchards, hedges, houses and two roads, 60 to 135 m away.

The land is one warped grid, cut into plots that share their borders. The roads cross near the origin. Metres;
x right, y away, z up.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rsbench.scenes.model import FloatArray
from rsbench.scenes.parts import (
    PartsBuilder,
    Piece,
    block,
    box,
    chimney,
    gable_roof,
    grid,
    joined,
    leaned,
    lump,
    panel,
    placed,
    revolve,
    tube,
)

_CUTS_X = (-110.0, -72.0, -36.0, -12.0, -8.0, 17.0, 42.0, 68.0, 105.0)
_CUTS_Y = (-60.0, -32.0, -14.0, 6.0, 11.0, 31.0, 52.0, 76.0, 110.0, 160.0)
_LANE, _ROAD = (-12.0, -8.0), (6.0, 11.0)
_SURFACES = {
    "road": "asphalt",
    "lane": "gravel",
    "wheat": "field_wheat",
    "rows": "field_rows",
    "soil": "field_soil",
}
"""Surfaces of kinds of plots; all others are meadows."""
_STEP = 3.0
"""Spacing of the grid, metres."""

Place = Callable[[float, float], tuple[float, float, float]]
"""The point of the land at a place of the map."""


class _Plot(NamedTuple):
    """A plot by its borders before the warp, and what is on it."""

    left: float
    right: float
    near: float
    far: float
    kind: str


@dataclass(frozen=True, kw_only=True)
class TerrainBuilder(PartsBuilder):
    """Land with a village at a crossing."""

    RANGES = (("relief", 0, 8), ("houses", 0, 2))

    relief: float = 2.5
    """Height of the swells of the land, metres."""
    houses: int = 2
    """Number of houses on each of the four plots at the crossing."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:

        def at(x: float, y: float) -> tuple[float, float, float]:
            ground = self.ground(np.array(x), np.array(y))
            return float(ground[0]), float(ground[1]), float(ground[2])

        pieces: list[Piece] = []
        plots = _plots(rng)
        crowns = [_crown(rng, leaf) for leaf in ("leaves", "leaves_dark") for _ in range(3)]
        bushes = [lump(leaf, rng, (1.0, 0.8, 0.9), 0.3, 1) for leaf in ("leaves", "leaves_dark") for _ in range(3)]
        for plot in plots:
            pieces.append(self._sheet(rng, plot))
            pieces += _planted(rng, plot, at, crowns, bushes)
            if plot.kind == "garden":
                pieces += _yard(rng, plot, at, self.houses)
        pieces += _traffic(rng, at)
        return pieces

    def ground(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Points (..., 3) of the land at places of the map before the warp, which bends the borders."""
        height = np.sin(x / 31) * np.cos(y / 43) + 0.5 * np.sin(x / 17 + y / 23)
        across, along = x + 5 * np.sin(y / 37) + 2 * np.sin(x / 19), y + 4 * np.sin(x / 41) + 1.5 * np.sin(y / 15)
        return np.stack([across, along, self.relief * height], axis=-1)

    def _sheet(self, rng: np.random.Generator, plot: _Plot) -> Piece:
        x, y = np.meshgrid(_steps(plot.left, plot.right), _steps(plot.near, plot.far))
        angle = float(rng.choice((0.0, 0.5))) * np.pi + float(rng.uniform(-0.15, 0.15))
        u, v = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
        surface = _SURFACES.get(plot.kind, "meadow")
        return grid(surface, self.ground(x, y), np.stack([u, v], axis=-1))


def _steps(start: float, end: float) -> FloatArray:
    return np.linspace(start, end, int(np.ceil((end - start) / _STEP)) + 1)


def _plots(rng: np.random.Generator) -> list[_Plot]:
    """The roads, gardens around their crossing, and plots whose neighbours grow something else."""
    plots: list[_Plot] = []
    below: dict[float, str] = {}
    for near, far in itertools.pairwise(_CUTS_Y):
        last = ""
        for left, right in itertools.pairwise(_CUTS_X):
            beside_lane = left == _LANE[1] or right == _LANE[0]
            if (near, far) == _ROAD:
                kind = "road"
            elif (left, right) == _LANE:
                kind = "lane"
            elif beside_lane and (near == _ROAD[1] or far == _ROAD[0]):
                kind = "garden"
            else:
                kinds = ("wheat", "rows", "soil", "orchard", "wood", "pasture")
                kind = str(rng.choice([each for each in kinds if each not in (last, below.get(left))]))
            plots.append(_Plot(left, right, near, far, kind))
            last = below[left] = kind
    return plots


def _crown(rng: np.random.Generator, leaf: str) -> list[Piece]:
    """A tree of height 1, without much below its crown, which is all that is seen from the air."""
    lumps: list[Piece] = []
    for k in range(2):
        angle = 3.1 * k + float(rng.uniform(0, 1))
        radii = rng.uniform(0.28, 0.36) * np.array([1.0, 1.0, 0.85])
        centre = (0.16 * float(np.cos(angle)), 0.16 * float(np.sin(angle)), float(rng.uniform(0.58, 0.72)))
        lumps += placed([lump(leaf, rng, radii, 0.22, 2)], centre)
    trunk = tube("bark", [(0, 0, -0.15), (0.01, 0, 0.2), (0, 0.01, 0.55)], [0.05, 0.035, 0.03], 7)
    return [joined(lumps), trunk]


def _planted(
    rng: np.random.Generator, plot: _Plot, at: Place, crowns: list[list[Piece]], bushes: list[Piece]
) -> list[Piece]:
    """Trees of orchards, woods and pastures, bales on stubble, hedges along some borders."""
    pieces: list[Piece] = []

    def tree(x: float, y: float, height: float) -> None:
        crown = crowns[int(rng.integers(len(crowns)))]
        pieces.extend(placed(crown, at(x, y), float(rng.uniform(0, 360)), height))

    wide, deep = plot.right - plot.left, plot.far - plot.near
    if plot.kind == "orchard":
        for x in np.arange(plot.left + 3.5, plot.right - 2.5, 7.0):
            for y in np.arange(plot.near + 3.5, plot.far - 2.5, 7.0):
                tree(x + float(rng.normal()) * 0.3, y + float(rng.normal()) * 0.3, float(rng.uniform(3.2, 4.4)))
    for _ in range({"wood": int(wide * deep / 60), "pasture": 3}.get(plot.kind, 0)):
        place = (plot.left + wide * rng.uniform(0.1, 0.9), plot.near + deep * rng.uniform(0.1, 0.9))
        tree(*place, float(rng.uniform(6, 11)))
    for _ in range(7 if plot.kind == "wheat" else 0):
        place = (plot.left + wide * rng.uniform(0.1, 0.9), plot.near + deep * rng.uniform(0.1, 0.9))
        outline = [(0, -0.6), (0.75, -0.6), (0.75, 0.6), (0, 0.6)]
        bale = placed(leaned([revolve("straw", outline, 14)], 90), (0, 0, 0.7))
        pieces += placed(bale, at(*place), float(rng.uniform(0, 180)))
    if plot.kind not in ("road", "lane") and rng.random() < 0.45:
        row = [(x, plot.near + 0.9) for x in np.arange(plot.left + 1.0, plot.right - 1.0, 1.5)]
        row += [(plot.left + 0.9, y) for y in np.arange(plot.near + 2.2, plot.far - 1.0, 1.5)]
        for x, y in row:
            bush = bushes[int(rng.integers(len(bushes)))]
            pieces += placed([bush], at(x, y), float(rng.uniform(0, 360)), float(rng.uniform(0.8, 1.2)))
    return pieces


def _yard(rng: np.random.Generator, plot: _Plot, at: Place, houses: int) -> list[Piece]:
    """Houses along the road, a shed and a paved path."""
    pieces: list[Piece] = []
    behind = 1 if plot.near == _ROAD[1] else -1
    edge = plot.near if behind > 0 else plot.far
    for k in range(houses):
        x = plot.left + (plot.right - plot.left) * (0.27 + 0.46 * k)
        heading = float(rng.uniform(-6, 6)) + (0 if behind > 0 else 180)
        pieces += placed(_house(rng, k), at(x, edge + behind * (7.5 + float(rng.uniform(-1, 1)))), heading)
        pieces += placed(_shed(rng), at(x + 3.0, edge + behind * 16.0), float(rng.uniform(-20, 20)))
    return pieces


def _house(rng: np.random.Generator, number: int) -> list[Piece]:
    """Walls with windows and a door, a gabled roof and a chimney; it stands 1.5 m in the ground."""
    w, d, eaves = float(rng.uniform(8.0, 9.5)), float(rng.uniform(6.6, 7.6)), float(rng.uniform(3.2, 5.4))
    wall, tiles = ("plaster_0", "brick")[number % 2], ("tiles_0", "tiles_2")[int(rng.random() < 0.4)]
    rise = 0.45 * d
    pieces = [box(wall, (-w / 2, -d / 2, -1.5), (w / 2, d / 2, eaves)), *gable_roof(tiles, w, d, eaves, rise)]
    gable = [(-d / 2, 0.0), (d / 2, 0.0), (0.0, rise)]
    for side in (-1, 1):
        pieces += placed([panel(wall, gable, 0.25)], (side * w / 2, 0, eaves), 90 * side)
        front: list[Piece] = []
        for k, x in enumerate(np.linspace(-w / 2 + 1.3, w / 2 - 1.3, 4)):
            door = side < 0 and k == 1
            front.append(block("timber", (1.24, 0.1, 2.3 if door else 1.54), (x, 0, 0.0 if door else 0.83)))
            surface, height, foot = ("timber", 2.1, 0.0) if door else ("glass", 1.3, 0.95)
            front.append(block(surface, (1.0, 0.16, height), (x, 0, foot)))
        pieces += placed(front, (0, side * d / 2, 0))
    stack = chimney(rng, 2.2, 0.8)
    return pieces + placed(stack, (float(rng.uniform(-0.3, 0.3)) * w, 0.6, eaves + rise - 1.2))


def _shed(rng: np.random.Generator) -> list[Piece]:
    """A wooden hut with a low roof."""
    w, d = float(rng.uniform(2.6, 4.2)), float(rng.uniform(2.4, 3.2))
    return [
        box("timber", (-w / 2, -d / 2, -1.0), (w / 2, d / 2, 2.0)),
        *gable_roof("tiles_2", w, d, 2.0, 0.9, 0.25, 0.08),
    ]


def _traffic(rng: np.random.Generator, at: Place) -> list[Piece]:
    """Cars on both roads, and lamps beside the larger."""
    pieces: list[Piece] = []
    places = (
        [(x, 7.2, 4) for x in (-41, -3, 26)]
        + [(x, 9.8, 184) for x in (-24, 12, 37)]
        + [(-10.0, y, 95) for y in (-22, 27)]
    )
    for x, y, heading in places:
        colour = str(rng.choice(["paint_red", "paint_blue", "enamel", "steel"]))
        car = [block(colour, (4.2, 1.75, 0.62), (0, 0, 0.3)), block("glass", (2.2, 1.5, 0.5), (-0.2, 0, 0.9)),
               block(colour, (1.9, 1.45, 0.06), (-0.2, 0, 1.4))]  # fmt: skip
        car += [block("soot", (0.6, 1.85, 0.6), (e, 0, 0.0)) for e in (-1.3, 1.3)]
        pieces += placed(car, at(x + float(rng.uniform(-2, 2)), y), heading)
    for x in np.arange(-68.0, 70.0, 17.0):
        post = [(0, 0, -0.5), (0, 0, 6.0), (0, -0.5, 6.6), (0, -1.4, 6.7)]
        lamp = [tube("steel", post, [0.1, 0.08, 0.07, 0.06], 8), block("enamel", (0.3, 0.7, 0.12), (0, -1.5, 6.6))]
        pieces += placed(lamp, at(x, 11.7))
    return pieces
