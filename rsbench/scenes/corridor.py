"""A corridor of painted walls and doors under roof lights: little texture, on purpose, so that features are few.

It runs along y from -9 to 15 m, 3.2 m wide; the floor is z = 0. The default viewpoint looks along +y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from rsbench.scenes.parts import (
    PartsBuilder,
    Piece,
    Point,
    block,
    box,
    panel,
    placed,
    prism,
    rectangle,
    revolve,
    tube,
)

_HALF, _START, _END, _HEIGHT = 1.6, -9.0, 15.0, 2.8
_TILE, _JOINT = 0.6, 0.004
_DOOR = (1.0, 2.1)
_DADO = 1.1
"""Height of the darker paint on the walls, metres."""
_NICHE = (7.6, 2.2)
"""Middle and width of a waiting corner in the right wall, metres along the corridor."""


@dataclass(frozen=True, kw_only=True)
class CorridorBuilder(PartsBuilder):
    """A corridor with doors on both sides."""

    RANGES = (("doors", 0, 6), ("lights", 1, 8))

    doors: int = 5
    """Number of doors on each side."""
    lights: int = 5
    """Number of openings in the ceiling, the only ones through which the sun enters."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_floor(), *_ceiling(self.lights), *_end_walls(), *_niche()]
        for side in (-1, 1):
            pieces += _side(rng, side, self.doors)
        return pieces


def _floor() -> list[Piece]:
    """Tiles with joints 4 mm wide and 3 mm deep on a dark bed, which goes on below the walls."""
    pieces = [box("soot", (-3.3, _START - 0.4, -0.2), (3.3, _END + 0.4, -0.003))]
    for x in np.arange(-3.3, 3.2, _TILE):
        for y in np.arange(_START - 0.3, _END + 0.3, _TILE):
            low, high = np.array([x, y]) + _JOINT / 2, np.array([x, y]) + _TILE - _JOINT / 2
            pieces.append(box("terrazzo", (*low, -0.1), (*high, 0.0)))
    return pieces


def _ceiling(lights: int) -> list[Piece]:
    """A slab with square openings for the light, framed, and lamps between them."""
    spacing = (_END - _START) / lights
    middles = [_START + (k + 0.5) * spacing for k in range(lights)]
    slab = shapely.box(-3.3, _START - 0.4, 3.3, _END + 0.4)
    pieces: list[Piece] = []
    for y in middles:
        slab = slab.difference(shapely.box(-0.6, y - 0.6, 0.6, y + 0.6))
        for side in (-1, 1):
            pieces.append(block("steel", (0.06, 1.3, 0.4), (side * 0.62, y, _HEIGHT - 0.03)))
            pieces.append(block("steel", (1.19, 0.06, 0.41), (0, y + side * 0.62, _HEIGHT - 0.035)))
    for y in (middle + spacing / 2 for middle in middles[:-1]):
        pieces.append(block("enamel", (0.22, 1.3, 0.07), (0, y, _HEIGHT - 0.07)))
        pieces.append(block("steel", (0.26, 1.36, 0.05), (0, y, _HEIGHT - 0.025)))
    return [*pieces, *placed([prism("paint_white", slab, 0.3)], (0, 0, _HEIGHT))]


def _side(rng: np.random.Generator, side: int, doors: int) -> list[Piece]:
    """The wall to the left (-1) or right (1) with its doors, and with the niche's opening on the right."""
    spacing = (_END - _START) / max(doors, 1)
    places = [_START + (k + 0.5 + 0.12 * side + float(rng.uniform(-0.1, 0.1))) * spacing for k in range(doors)]
    niche = [rectangle(-_NICHE[0], -0.1, _NICHE[1], 2.4)] if side > 0 else []
    if niche:
        places = [y for y in places if abs(y - _NICHE[0]) > _NICHE[1] / 2 + 0.9]
    doorways = [rectangle(-side * y, -0.1, _DOOR[0], _DOOR[1] + 0.1) for y in places]
    left, right = (_START - 0.3, _END + 0.3) if side < 0 else (-_END - 0.3, 0.3 - _START)
    pieces = _wall(left, right, [*doorways, *niche])
    if niche:
        pieces += placed(_frame(_NICHE[1], 2.3), (-_NICHE[0], 0, 0))
    for k, y in enumerate(places):
        pieces += placed(_door(_DOOR[0], "paint_blue" if k % 2 else "paint_grey"), (-side * y, 0, 0))
        pieces.append(block("enamel", (0.2, 0.012, 0.14), (-side * y + _DOOR[0] / 2 + 0.25, -0.002, 1.5)))
    for k in range(1, doors):  # between the doors
        y = _START + (k + 0.12 * side) * spacing
        if side < 0 or abs(y - _NICHE[0]) > _NICHE[1] / 2 + 1:
            thing = _radiator() if side < 0 else _notice_board(rng) if k % 2 == 0 else _extinguisher()
            pieces += placed(thing, (-side * y, 0, 0))
    return placed(placed(pieces, (0, _HALF, 0)), (0, 0, 0), -90 * side)


def _wall(left: float, right: float, doorways: list[list[Point]]) -> list[Piece]:
    """A painted wall whose front is y = 0; each paint lies a little before the one behind it."""

    def strip(surface: str, low: float, high: float, out: float) -> list[Piece]:
        outline = [(left, low), (right, low), (right, high), (left, high)]
        return placed([panel(surface, outline, 0.3 if out == 0 else 0.06, doorways)], (0, -out, 0))

    pieces = strip("paint_white", -0.05, _HEIGHT + 0.05, 0.0) + strip("paint_sage", -0.04, _DADO, 0.004)
    return pieces + strip("steel", -0.03, 0.1, 0.016) + strip("paint_blue", _DADO - 0.02, _DADO + 0.04, 0.024)


def _door(width: float, leaf: str) -> list[Piece]:
    """A flush door with a steel frame, a kick plate and a handle, for an opening that stands on z = 0."""
    w, h = width / 2, _DOOR[1]
    pieces = [
        box(leaf, (-w, 0.1, 0.008), (w, 0.145, h)),
        *_frame(width, h),
        box("steel", (-w + 0.06, 0.096, 0.03), (w - 0.06, 0.12, 0.22)),
        box("steel", (-w + 0.08, 0.095, 0.96), (-w + 0.13, 0.12, 1.16)),
    ]
    handle = [(-w + 0.105, 0.1, 1.07), (-w + 0.105, 0.05, 1.07), (-w + 0.12, 0.04, 1.07), (-w + 0.24, 0.04, 1.07)]
    return [*pieces, tube("steel", handle, np.full(4, 0.011), 8)]


def _frame(width: float, height: float) -> list[Piece]:
    """Steel around an opening of the wall y = 0, over the edges of all its paints."""
    w, h = width / 2, height
    return [
        box("steel", (-w - 0.06, -0.035, -0.02), (-w + 0.03, 0.2, h + 0.06)),
        box("steel", (w - 0.03, -0.035, -0.02), (w + 0.06, 0.2, h + 0.06)),
        box("steel", (-w - 0.05, -0.033, h - 0.03), (w + 0.05, 0.19, h + 0.055)),
    ]


def _end_walls() -> list[Piece]:
    """A glazed double door below a sign at the far end, a plain door behind the default viewpoint."""
    pieces: list[Piece] = []
    for heading, distance in ((0, _END), (180, -_START)):
        doorway = rectangle(0, -0.1, 1.9 if heading == 0 else _DOOR[0], _DOOR[1] + 0.1)
        wall = _wall(-_HALF - 0.2, _HALF + 0.2, [doorway])
        if heading == 0:
            for side in (-1, 1):
                leaf = [box("paint_blue", (-0.47, 0.1, 0.008), (0.47, 0.145, 2.08)),
                        box("glass", (-0.2, 0.09, 0.9), (0.2, 0.12, 1.85)),
                        box("steel", (-0.3, 0.096, 0.98), (-0.22, 0.12, 1.22))]  # fmt: skip
                wall += placed(leaf, (side * 0.475, 0, 0))
                wall.append(box("steel", (side * 0.92, -0.03, -0.02), (side * 1.01, 0.2, 2.15)))
            wall.append(box("steel", (-0.96, -0.028, 2.07), (0.96, 0.19, 2.14)))
            wall.append(block("paint_sage", (0.5, 0.08, 0.2), (0, -0.02, 2.3)))
        else:
            wall += _door(_DOOR[0], "paint_grey")
        pieces += placed(placed(wall, (0, distance, 0)), (0, 0, 0), heading)
    return pieces


def _niche() -> list[Piece]:
    """The walls of the waiting corner, and its bench."""
    middle, half = _NICHE[0], _NICHE[1] / 2 + 0.02
    pieces = [box("paint_white", (3.0, middle - half - 0.3, -0.05), (3.2, middle + half + 0.3, _HEIGHT + 0.05))]
    for side in (-1, 1):
        edges = sorted((middle + side * half, middle + side * (half + 0.25)))
        pieces.append(box("paint_white", (_HALF + 0.15, edges[0], -0.05), (3.1, edges[1], _HEIGHT + 0.04)))
    seat = [
        block("paint_blue", (0.45, 1.7, 0.05), (0, 0, 0.42)),
        block("paint_blue", (0.05, 1.7, 0.4), (0.25, 0, 0.5)),
    ]
    seat += [block("steel", (0.4, 0.05, 0.42), (0, y, 0)) for y in (-0.6, 0.6)]
    return pieces + placed(seat, (2.6, middle, 0))


def _radiator() -> list[Piece]:
    """Standing on the floor in front of the wall y = 0, like the next two."""
    return [block("enamel", (0.055, 0.06, 0.6), (0.07 * (k - 6.5), -0.09, 0.12)) for k in range(14)]


def _extinguisher() -> list[Piece]:
    """Red, with its sign above and a bin beside it."""
    bottle = [(0.075, 0.0), (0.075, 0.4), (0.05, 0.46), (0.02, 0.48), (0.02, 0.53), (0.0, 0.53)]
    bucket = [(0.13, 0.0), (0.16, 0.6), (0.14, 0.6), (0.12, 0.05), (0.0, 0.05)]
    pieces = placed([revolve("paint_red", bottle, 16)], (0.3, -0.12, 0.9))
    pieces += placed([revolve("steel", bucket, 20)], (-0.3, -0.28, 0.0))
    return [*pieces, block("paint_red", (0.2, 0.02, 0.2), (0.3, -0.005, 1.7))]


def _notice_board(rng: np.random.Generator) -> list[Piece]:
    """Sheets without print on a grey board."""
    pieces = [
        box("paint_grey", (-0.7, -0.03, 1.25), (0.7, 0.05, 2.2)),
        box("steel", (-0.74, -0.026, 1.21), (0.74, 0.04, 2.24)),
    ]
    for k in range(6):
        x, z = -0.5 + 0.34 * (k % 3) + float(rng.uniform(0, 0.1)), 1.36 + 0.42 * (k // 3)
        pieces.append(box("enamel", (x - 0.105, -0.033, z), (x + 0.105, -0.02, z + 0.297)))
    return pieces
