"""A storehouse: racks of equal cartons with equal labels on both sides of an aisle; repetition, on purpose.

The aisle runs along y from -9 to 17 m, 4.4 m wide; the floor is z = 0. The default viewpoint looks along +y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from rsbench.scenes.parts import PartsBuilder, Piece, beam, block, box, picture, placed, prism, revolve
from rsbench.scenes.props import sheet_cell
from rsbench.scenes.surfaces import CARTONS, cell_uv

_AISLE = 2.2
"""Half its width, metres."""
_START, _END, _HEIGHT = -9.0, 17.0, 7.0
_BAY, _DEPTH = 2.8, 1.1
_LEVELS = (0.0, 1.75, 3.3)
"""Heights of the beams that carry; the lowest is the floor."""


@dataclass(frozen=True, kw_only=True)
class ShelvesBuilder(PartsBuilder):
    """A storehouse with two rows of racks."""

    RANGES = (("bays", 1, 9), ("disorder", 0, 0.03))

    bays: int = 8
    """Bays of each row."""
    disorder: float = 0.02
    """How far a carton stands from its place, metres (standard deviation); 0 repeats exactly."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_hall(), *_aisle(rng, self.disorder)]
        for heading in (90, -90):
            row: list[Piece] = []
            for k in range(self.bays):
                row += placed(_bay(rng, self.disorder, k), (_BAY * (k - self.bays / 2 + 0.5), 0, 0))
            row += placed(_upright(), (_BAY * self.bays / 2, 0, 0))
            middle = (_START + _END) / 2 - 0.5
            pieces += placed(row, (np.sign(-heading) * _AISLE, middle, 0), heading)
        return pieces


def carton(design: int, size: tuple[float, float, float]) -> list[Piece]:
    """A closed box of ``size`` that stands on the origin; equal designs show equal prints on all sides."""
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    ring = [(-w, -d), (w, -d), (w, d), (-w, d)]
    cell = cell_uv(design, CARTONS)
    sides = [[(*a, 0), (*b, 0), (*b, h), (*a, h)] for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
    # The lid shows the tape and the plain lower part of the print.
    lid = np.stack([cell[0], cell[0] + (cell[1] - cell[0]) * (1.0, 0.3)])
    pieces = [sheet_cell(picture("cartons", side), cell) for side in sides]
    return [*pieces, sheet_cell(picture("cartons", [(*corner, h) for corner in ring]), lid)]


def pallet(width: float, depth: float) -> list[Piece]:
    """Boards on runners, 0.14 m high."""
    pieces = [block("planks", (0.1, depth, 0.115), (x, 0, 0)) for x in (-width / 2 + 0.06, 0, width / 2 - 0.06)]
    for y in np.linspace(-depth / 2 + 0.06, depth / 2 - 0.06, 6):
        pieces.append(block("planks", (width, 0.11, 0.027), (0, float(y), 0.113), turned=True))
    return pieces


def _upright() -> list[Piece]:
    """The frame between two bays: posts, rungs and a brace; the front is y = 0."""
    pieces = [block("paint_blue", (0.09, 0.08, 5.2), (0, y, 0)) for y in (0.04, _DEPTH - 0.04)]
    pieces += [block("steel", (0.16, 0.16, 0.012), (0, y, 0)) for y in (0.04, _DEPTH - 0.04)]
    for z in np.arange(0.4, 5.0, 0.9):
        pieces.append(beam("paint_blue", (0, 0.06, z), (0, _DEPTH - 0.06, z), 0.035))
        pieces.append(beam("paint_blue", (0, 0.06, z + 0.05), (0, _DEPTH - 0.06, z + 0.8), 0.03))
    return pieces


def _bay(rng: np.random.Generator, disorder: float, number: int) -> list[Piece]:
    """One bay: a frame at its left end, beams, and a load on each level; the front is y = 0."""
    pieces = placed(_upright(), (-_BAY / 2, 0, 0))
    for level, z in enumerate(_LEVELS):
        if z > 0:
            for y in (0.035, _DEPTH - 0.035):
                bar = ((-_BAY / 2 + 0.045, y, z - 0.07), (_BAY / 2 - 0.045, y, z - 0.07))
                pieces.append(beam("paint_orange", *bar, 0.12, 0.05))
            pieces += [
                block("steel", (0.05, _DEPTH - 0.14, 0.03), (x, _DEPTH / 2, z - 0.045)) for x in (-0.9, 0, 0.9)
            ]
            plate = picture("cartons", [(-0.3, 0.008, z - 0.12), (-0.1, 0.008, z - 0.12), (-0.1, 0.008, z - 0.03),
                                        (-0.3, 0.008, z - 0.03)])  # fmt: skip
            pieces.append(sheet_cell(plate, cell_uv(3, CARTONS)))
        kind = (number * 2 + level * 3 + int(rng.integers(2))) % 5
        if kind < 3:
            load = _cartons(rng, disorder, (number // 2 + level) % 3, (3, 2, 2) if kind else (4, 3, 2))
        elif kind == 3:
            load = _bins(rng)
        else:
            load = _drums()
        pieces += placed(load, (0, _DEPTH / 2, z - 0.013 if z > 0 else 0.0))
    return pieces


def _cartons(rng: np.random.Generator, disorder: float, design: int, count: tuple[int, int, int]) -> list[Piece]:
    """Pallets with a block of equal cartons, ``count`` along x, up and deep, some of the top layer missing."""
    wide, high, deep = count
    pieces = placed(pallet(1.28, 1.0), (-0.66, 0, 0)) + placed(pallet(1.28, 1.0), (0.66, 0, 0))
    size = (2.56 / wide - 0.03, 0.98 / deep - 0.02, 1.2 / high - 0.06)
    for column in range(wide):
        layers = high - int(rng.random() < 0.25)
        for layer in range(layers):
            for row in range(deep):
                x = (column - (wide - 1) / 2) * 2.58 / wide + _kept_in(rng, disorder)
                y = (row - (deep - 1) / 2) * 0.98 / deep + _kept_in(rng, disorder)
                turn = float(rng.normal()) * 60 * disorder
                pieces += placed(carton(design, size), (x, y, 0.141 + layer * (size[2] + 0.001)), turn)
    return pieces


def _kept_in(rng: np.random.Generator, disorder: float) -> float:
    return float(np.clip(disorder * rng.normal(), -0.012, 0.012))


def _bins(rng: np.random.Generator) -> list[Piece]:
    """Two tiers of open plastic bins with a label each, on a board."""
    pieces = [block("planks", (2.6, 1.0, 0.04), turned=True)]
    colour = str(rng.choice(["paint_red", "paint_blue", "paint_orange"]))
    for tier in range(2):
        for k in range(6):
            x, z = 0.43 * (k - 2.5), 0.041 + 0.46 * tier
            one = [
                box(colour, (-0.2, -0.45, 0), (0.2, -0.43, 0.24)),
                box(colour, (-0.2, 0.43, 0), (0.2, 0.45, 0.4)),
                box(colour, (-0.18, -0.43, 0), (0.18, 0.43, 0.02)),
            ]
            one += [box(colour, (e - 0.01, -0.43, 0), (e + 0.01, 0.43, 0.4)) for e in (-0.19, 0.19)]
            label = picture("cartons", [(-0.12, -0.452, 0.06), (0.12, -0.452, 0.06), (0.12, -0.452, 0.18),
                                        (-0.12, -0.452, 0.18)])  # fmt: skip
            pieces += placed([*one, sheet_cell(label, cell_uv(3, CARTONS))], (x, 0, z))
        pieces += [
            block("steel", (0.03, 0.9, 0.035), (x, 0, 0.446 * (tier + 1))) for x in (-1.25, -0.2, 0.2, 1.25)
        ]
    return pieces


def _drums() -> list[Piece]:
    """Four steel drums on two pallets."""
    outline = [(0.0, 0.0), (0.28, 0.0), (0.28, 0.29), (0.295, 0.3), (0.28, 0.31), (0.28, 0.58), (0.295, 0.59),
               (0.28, 0.6), (0.28, 0.88), (0.265, 0.89), (0.255, 0.87), (0.0, 0.87)]  # fmt: skip
    pieces = placed(pallet(1.28, 1.0), (-0.66, 0, 0)) + placed(pallet(1.28, 1.0), (0.66, 0, 0))
    for x in (-0.98, -0.34, 0.34, 0.98):
        pieces += placed([revolve("paint_sage", outline, 24)], (x, -0.12, 0.141))
    return pieces


def _hall() -> list[Piece]:
    """Floor, walls, and a roof on beams with a strip of openings above the aisle."""
    x, low, high = _AISLE + _DEPTH + 0.5, _START - 0.6, _END + 0.3
    pieces = [box("concrete", (-x - 0.4, low - 0.4, -0.2), (x + 0.4, high + 0.4, 0.0))]
    for side in (-1, 1):
        edges = sorted((side * x, side * (x + 0.3)))
        pieces.append(box("paint_grey", (edges[0], low - 0.3, -0.1), (edges[1], high + 0.3, _HEIGHT + 0.1)))
    pieces.append(box("paint_grey", (-x - 0.1, low - 0.28, -0.1), (x + 0.1, low, _HEIGHT + 0.08)))
    pieces.append(box("paint_grey", (-x - 0.1, high, -0.1), (x + 0.1, high + 0.28, _HEIGHT + 0.08)))
    roof = shapely.box(-x - 0.4, low - 0.4, x + 0.4, high + 0.4)
    for y in np.arange(_START, _END - 2.0, 4.4):
        roof = roof.difference(shapely.box(-1.0, y, 1.0, y + 3.4))
        pieces.append(block("steel", (2 * x + 0.2, 0.18, 0.42), (0, y - 0.5, _HEIGHT - 0.4)))
        for k in np.linspace(-x + 0.4, x - 0.4, 7):
            pieces.append(beam("steel", (k, y - 0.5, _HEIGHT - 0.75), (k + 0.5, y - 0.5, _HEIGHT - 0.3), 0.06))
        pieces.append(beam("steel", (-x, y - 0.5, _HEIGHT - 0.78), (x, y - 0.5, _HEIGHT - 0.78), 0.09))
    return [*pieces, *placed([prism("enamel", roof, 0.25)], (0, 0, _HEIGHT))]


def _aisle(rng: np.random.Generator, disorder: float) -> list[Piece]:
    """The gate at the far end, what waits before it, and lines on the floor."""
    pieces = [block("paint_orange", (3.6, 0.12, 0.2), (0, _END + 0.22, 3.5))]
    for z in np.arange(0.02, 3.4, 0.21):
        pieces.append(block("steel", (3.4, 0.06, 0.2), (0, _END + 0.27, z)))
    pieces += [block("paint_orange", (0.2, 0.14, 3.52), (x, _END + 0.22, 0)) for x in (-1.75, 1.75)]
    for x in (-_AISLE + 0.3, _AISLE - 0.3):
        pieces.append(block("paint_orange", (0.1, 22.0, 0.004), (x, 3.5, 0)))
    for x, y, heading, design in ((-1.0, 12.4, 8, 0), (1.15, 14.6, -5, 1), (-0.9, 15.4, 0, 2), (1.2, 10.2, 12, 0)):
        stack = pallet(1.2, 1.0)
        for k in range(12 - int(rng.integers(3))):
            column, row, layer = k % 2, k // 2 % 2, k // 4
            at = (0.59 * (column - 0.5), 0.48 * (row - 0.5) + _kept_in(rng, disorder), 0.141 + 0.401 * layer)
            stack += placed(carton(design, (0.57, 0.46, 0.4)), at, float(rng.normal()) * 60 * disorder)
        pieces += placed(stack, (x, y, 0), heading)
    return pieces
