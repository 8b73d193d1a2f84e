"""A street canyon: tall facades with rows of equal windows on both sides, shops, balconies, parked cars.

Windows and panes mirror the other side and the sky. It runs along y from -14 to 62 m, 13 m between the facades;
the roadway is z = 0. The default viewpoint looks along +y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.parts import (
    PartsBuilder,
    Piece,
    beam,
    block,
    box,
    chimney,
    joined,
    leaned,
    panel,
    placed,
    profile,
    rectangle,
    revolve,
    tube,
)

_HALF, _START, _END = 6.5, -14.0, 62.0
_KERB = 2.4
"""Width of the pavements, metres."""
_WALLS = ("plaster_0", "brick", "plaster_3", "ashlar_1")
_DEPTH = 9.0


@dataclass(frozen=True, kw_only=True)
class StreetBuilder(PartsBuilder):
    """A street between tall houses."""

    RANGES = (("storeys", 2, 8), ("cars", 0, 16))

    storeys: tuple[int, int] = (4, 6)
    """Least and greatest number of storeys of the houses."""
    cars: int = 12
    """Number of cars parked at the kerbs."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_roadway(), *_closing(rng, self.storeys), *_furniture(rng, self.cars)]
        for side in (-1, 1):
            y, number = _START - float(rng.uniform(0, 3)), 0
            while y < _END:
                width = float(rng.uniform(9.0, 14.0))
                storeys = int(rng.integers(self.storeys[0], self.storeys[1] + 1))
                house = _facade(rng, width - 0.03, storeys, 2 * number + side)
                pieces += placed(house, (side * _HALF, y + width / 2, 0.12), -90 * side)
                y, number = y + width, number + 1
        return pieces


def _facade(rng: np.random.Generator, width: float, storeys: int, number: int) -> list[Piece]:
    """A house whose front is y = 0: shops below, equal windows above, a cornice, a roof with chimneys."""
    wall, floor = _WALLS[number % len(_WALLS)], float(rng.uniform(3.1, 3.5))
    columns = max(2, int(width / 2.3))
    step, w, h = (width - 0.8) / columns, 1.05, float(rng.uniform(1.6, 1.9))
    xs = [(k - (columns - 1) / 2) * step for k in range(columns)]
    top = 4.0 + (storeys - 1) * floor
    holes = [rectangle(x, 4.0 + s * floor + 0.75, w, h) for s in range(storeys - 1) for x in xs]
    pieces = [panel(wall, [(-width / 2, 4.0), (width / 2, 4.0), (width / 2, top), (-width / 2, top)], 0.35, holes)]
    balconies = bool(rng.random() < 0.5)
    opening, balcony = _by_surface(_window(w, h)), _by_surface(_balcony(w + 0.9))
    for s in range(storeys - 1):
        for k, x in enumerate(xs):
            at = (x, 0, 4.0 + s * floor + 0.75)
            pieces += placed(opening, at)
            if balconies and k % 3 == 1:
                pieces += placed(balcony, (x, 0, at[2] - 0.2))
    pieces += _shop(rng, width)
    pieces.append(box("stone", (-width / 2, -0.14, 3.9), (width / 2, 0.2, 4.15), turned=True))
    pieces.append(box("stone", (-width / 2, -0.4, top - 0.05), (width / 2, 0.3, top + 0.3), turned=True))
    roof = [(-0.1, 0.0), (2.6, 2.8), (_DEPTH, 2.8), (_DEPTH, 0.0)]
    pieces += placed([profile("tiles_2", roof, width)], (0, 0, top + 0.3))
    for side in (-1, 1):
        outer, inner = side * (width / 2 - 0.005), side * (width / 2 - 0.3)
        pieces.append(box(wall, (outer, 0.3, -0.2), (inner, _DEPTH, top + 0.28)))
    return pieces + placed(chimney(rng, 2.6), (float(rng.uniform(-0.3, 0.3)) * width, 3.4, top + 2.2))


def _by_surface(pieces: list[Piece]) -> list[Piece]:
    """One piece for each surface: what is placed many times is placed faster."""
    surfaces = dict.fromkeys(piece.surface for piece in pieces)
    return [joined([piece for piece in pieces if piece.surface == surface]) for surface in surfaces]


def _window(width: float, height: float) -> list[Piece]:
    """Two sashes behind the wall's front, a surround and a sill, for an opening that stands on z = 0."""
    w, h = width / 2, height
    pieces = [box("pane", (-w - 0.05, 0.2, -0.05), (w + 0.05, 0.24, h + 0.05))]
    pieces += [box("enamel", (x - 0.04, 0.13, -0.02), (x + 0.04, 0.22, h + 0.02)) for x in (-w, 0.0, w)]
    pieces += [box("enamel", (-w, 0.14, z - 0.04), (w, 0.21, z + 0.04)) for z in (0.0, 0.66 * h, h)]
    pieces += [box("stone", (side * (w + 0.16), -0.05, 0.0), (side * (w - 0.01), 0.12, h)) for side in (-1, 1)]
    pieces.append(box("stone", (-w - 0.2, -0.07, h - 0.01), (w + 0.2, 0.12, h + 0.2), turned=True))
    return [*pieces, box("stone", (-w - 0.2, -0.16, -0.1), (w + 0.2, 0.12, 0.01), turned=True)]


def _balcony(width: float) -> list[Piece]:
    """A slab with iron bars."""
    w = width / 2
    pieces = [box("stone", (-w, -0.9, -0.12), (w, 0.05, 0.03), turned=True)]
    pieces += [beam("iron", (x, -0.86, 0.0), (x, -0.86, 1.0), 0.025) for x in np.arange(-w + 0.05, w, 0.14)]
    pieces += [beam("iron", (x, y, 0.0), (x, y, 1.0), 0.025) for x in (-w + 0.04, w - 0.04) for y in (-0.6, -0.3)]
    pieces.append(beam("iron", (-w, -0.86, 1.0), (w, -0.86, 1.0), 0.05))
    return pieces + [beam("iron", (x, -0.86, 1.0), (x, 0.02, 1.0), 0.045) for x in (-w + 0.03, w - 0.03)]


def _shop(rng: np.random.Generator, width: float) -> list[Piece]:
    """Piers of stone, panes with a low wall, a fascia, an awning or none; 4 m high."""
    bays = max(2, int(width / 3.4))
    step = width / bays
    colour = str(rng.choice(["paint_red", "paint_blue", "paint_sage"]))
    pieces = [box("pane", (-width / 2 + 0.1, 0.42, 0.5), (width / 2 - 0.1, 0.47, 3.2))]
    pieces.append(box("stone", (-width / 2 + 0.1, 0.36, -0.2), (width / 2 - 0.1, 0.6, 0.52), turned=True))
    pieces.append(box(colour, (-width / 2 + 0.02, 0.02, 3.1), (width / 2 - 0.02, 0.6, 3.95), turned=True))
    for k in range(bays + 1):
        x = float(np.clip((k - bays / 2) * step, -width / 2 + 0.26, width / 2 - 0.26))
        pieces.append(box("stone", (x - 0.25, -0.03, -0.2), (x + 0.25, 0.7, 3.98)))
    for k in range(bays):
        x = (k - (bays - 1) / 2) * step
        pieces += [box(colour, (x + e - 0.03, 0.37, 0.5), (x + e + 0.03, 0.44, 3.12)) for e in (-0.5, 0.5)]
        if rng.random() < 0.4:
            slope = [(0.03, 3.1), (-1.3, 2.6), (-1.3, 2.35), (-1.27, 2.35), (-1.27, 2.56), (0.03, 3.05)]
            pieces += placed([profile("cloth_0", slope, step - 0.7)], (x, 0, 0))
    return pieces


def _roadway() -> list[Piece]:
    """Asphalt with a broken line, kerbs of stone, slabs on the pavements."""
    low, high = _START - 6.0, _END + 4.0
    pieces = [box("asphalt", (-_HALF, low, -0.3), (_HALF, high, 0.0))]
    for side in (-1, 1):
        inner = _HALF - _KERB
        pieces.append(box("stone", (side * inner, low, -0.1), (side * (inner + 0.25), high, 0.13), turned=True))
        pieces.append(box("concrete", (side * (inner + 0.24), low, -0.1), (side * (_HALF + 1.0), high, 0.12)))
    for y in np.arange(low + 1, high - 3, 6.0):
        pieces.append(box("enamel", (-0.07, y, -0.05), (0.07, y + 3.0, 0.004)))
    return pieces


def _closing(rng: np.random.Generator, storeys: tuple[int, int]) -> list[Piece]:
    """Houses across both ends."""
    pieces: list[Piece] = []
    for heading, y in ((0, _END + 3.0), (180, _START - 5.0)):
        for k, x in enumerate((-6.5, 6.5)):
            pieces += placed(_facade(rng, 12.96, storeys[1], k), (x, y, 0.05), heading)
    return pieces


def _furniture(rng: np.random.Generator, cars: int) -> list[Piece]:
    """Cars at the kerbs, lamps, trees in the pavement, benches, wires across the street."""
    pieces: list[Piece] = []
    for k in range(cars):
        side = 1 if k % 2 else -1
        at = (side * (_HALF - _KERB - 1.15), 2.0 + 4.2 * k + float(rng.uniform(-0.5, 0.5)), 0)
        pieces += placed(_car(str(rng.choice(["paint_red", "paint_blue", "enamel", "steel"]))), at, 90 * side)
    for k in range(6):
        side = 1 if k % 2 else -1
        pieces += placed(props.lamp_post(4.2), (side * (_HALF - _KERB + 0.6), 3.5 + 8.5 * k, 0.12), 90)
    for k in range(4):
        side = -1 if k % 2 else 1
        pieces += placed(props.tree(rng, 6.0, 1.6, detail=2), (side * (_HALF - _KERB + 0.8), 12.0 + 9.0 * k, 0.1))
        pieces += placed(props.bench(), (side * (_HALF - _KERB + 0.9), 8.0 + 9.0 * k, 0.12), -90 * side)
    for y in np.arange(6.0, 56.0, 11.0):
        x = np.linspace(-_HALF - 0.1, _HALF + 0.1, 9)
        wire = np.column_stack([x, np.full(9, y), 8.4 + 0.5 * (x / _HALF) ** 2])
        pieces.append(tube("iron", wire, np.full(9, 0.012), 6))
        pieces.append(block("iron", (0.5, 0.5, 0.22), (0, y, 8.2)))
    return pieces


def _car(colour: str) -> list[Piece]:
    """A parked car along x, 4.2 m long."""
    side = [(-2.1, 0.35), (2.1, 0.35), (2.1, 0.72), (1.2, 0.86), (-1.95, 0.9), (-2.1, 0.75)]
    cabin = [(-1.8, 0.88), (1.15, 0.84), (0.45, 1.38), (-1.3, 1.4)]
    roof = [(-1.25, 1.37), (0.42, 1.36), (0.4, 1.44), (-1.2, 1.45)]
    pieces: list[Piece] = []
    for surface, outline, width in ((colour, side, 1.75), ("pane", cabin, 1.5), (colour, roof, 1.46)):
        pieces += placed([panel(surface, outline, width)], (0, -width / 2, 0))
    rim = [(0.0, -0.1), (0.31, -0.1), (0.31, 0.1), (0.0, 0.1)]
    for x in (-1.3, 1.3):
        for y in (-0.8, 0.8):
            pieces += placed(leaned([revolve("soot", rim, 18)], 90), (x, y, 0.31))
    return pieces
