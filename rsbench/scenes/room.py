"""A living room: fireplace between bookcases, a table, armchairs on a rug, and sun through the windows.

The room spans x from -2.7 to 2.7 and y from -2.9 to 2.9; the floor is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.parts import (
    PartsBuilder,
    Piece,
    Point,
    beam,
    box,
    door,
    grid,
    leaned,
    panel,
    picture,
    placed,
    rectangle,
    window,
)

_HALF_X, _HALF_Y = 2.7, 2.9


@dataclass(frozen=True, kw_only=True)
class RoomBuilder(PartsBuilder):
    """A living room, furnished."""

    RANGES = (("ceiling_height", 2.5, 4.0), ("chairs", 0, 4))

    ceiling_height: float = 2.7
    """Metres."""
    chairs: int = 3
    """Around the table."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_shell(self.ceiling_height), *_back_wall(rng, self.ceiling_height)]
        pieces += [*_seats(), *_table(rng, self.chairs), *_sides(rng), *_garden(rng)]
        return pieces


def _shell(height: float) -> list[Piece]:
    """Floor, walls 0.3 m thick with two windows on the left and a door behind, ceiling with beams."""
    x, y = _HALF_X, _HALF_Y
    pieces = [box("floorboards", (-x - 0.3, -y - 0.3, -0.1), (x + 0.3, y + 0.3, 0))]
    pieces.append(box("limewash", (-x - 0.3, -y - 0.3, height), (x + 0.3, y + 0.3, height + 0.15)))
    for beam_y in np.linspace(-y + 0.4, y - 0.4, 6):
        b = float(beam_y)
        pieces.append(beam("walnut", (-x, b, height - 0.08), (x, b, height - 0.08), 0.14, 0.18))
    windows = [rectangle(s, 0.75, 1.3, 1.6) for s in (-1.25, 1.05)]
    doorway = [rectangle(1.2, 0, 0.95, 2.1)]
    faces: list[tuple[float, float, float, str, list[list[Point]]]] = [
        (0, y, x, "wallpaper", []),
        (-90, x, y, "limewash", []),
        (180, y, x, "wallpaper", doorway),
        (90, x, y, "limewash", windows),
    ]
    for heading, distance, half, surface, holes in faces:
        wall = [panel(surface, rectangle(0, 0, 2 * half, height), 0.3, holes)]
        for left, right in _between(half, holes):
            middle = (left + right) / 2
            wall.append(box("oak", (left, -0.02, 0), (right, 0, 0.85)))
            wall.append(box("walnut", (left, -0.045, 0.85), (right, 0, 0.9), turned=True))
            wall.append(box("walnut", (left, -0.035, 0), (right, 0, 0.12), turned=True))
            for stile in np.arange(left + 0.04, right, 0.45):
                wall.append(box("walnut", (float(stile) - 0.03, -0.032, 0.12), (float(stile) + 0.03, 0, 0.85)))
            wall.append(box("walnut", (middle - 0.01, -0.03, height - 0.08), (middle + 0.01, 0, height - 0.06)))
        wall.append(box("walnut", (-half, -0.05, height - 0.09), (half, 0, height), turned=True))
        pieces += placed(placed(wall, (0, distance, 0)), (0, 0, 0), heading)
    return pieces


def _between(half: float, holes: list[list[tuple[float, float]]]) -> list[tuple[float, float]]:
    """Stretches of a wall of half-length ``half`` that have no opening below 0.9 m."""
    cuts = sorted((min(p[0] for p in hole) - 0.1, max(p[0] for p in hole) + 0.1) for hole in holes)
    ends = [-half, *(value for cut in cuts for value in cut), half]
    return list(zip(ends[::2], ends[1::2], strict=True))


def _back_wall(rng: np.random.Generator, height: float) -> list[Piece]:
    y = _HALF_Y
    pieces = placed(props.fireplace(rng, 1.5, height), (0.55, y - 0.45, 0))
    pieces += placed(props.bookcase(rng, 1.35, min(2.3, height - 0.3)), (-0.98, y - 0.34, 0))
    pieces += placed(props.bookcase(rng, 1.2, min(2.3, height - 0.3)), (2.03, y - 0.34, 0))
    pieces += placed(props.framed(0, 0.55, 0.7), (-2.15, y - 0.02, 1.6))
    return pieces + placed(props.framed(5, 0.4, 0.5), (-2.2, y - 0.02, 0.95))


def _seats() -> list[Piece]:
    corners = [(-1.1, -0.35, 0.012), (1.75, -0.05, 0.012), (1.55, 1.75, 0.012), (-1.3, 1.45, 0.012)]
    pieces = [picture("rug", corners)]
    pieces += placed(props.armchair(), (1.5, 1.15, 0), -50)
    pieces += placed(props.armchair("fabric_3"), (-0.75, 1.25, 0), 40)
    pieces += placed(props.armchair("fabric_0", 1.7), (2.1, -1.0, 0), -90)
    pieces += placed(props.floor_lamp(), (1.32, 1.98, 0)) + placed(props.floor_lamp(1.5), (-1.75, 2.0, 0))
    stool = props.table((0.5, 0.5, 0.42))
    return pieces + placed(stool, (0.45, 1.0, 0), 20) + placed(props.candlestick(), (0.52, 1.05, 0.42))


def _table(rng: np.random.Generator, chairs: int) -> list[Piece]:
    """The table in the foreground and what lies on it."""
    pieces = placed(props.table(), (0, 0, 0))
    places = ((0.0, 0.62, 4), (0.95, 0.05, -95), (-0.98, 0.0, 88), (0.35, -0.75, 176))
    for x, y, heading in places[:chairs]:
        pieces += placed(props.chair(), (x, y, 0), heading)
    top = placed(props.vase(rng, 0.26, 9), (0.32, 0.16, 0)) + placed(props.fruit_bowl(rng), (-0.18, 0.14, 0))
    top += placed(props.candlestick(), (0.58, -0.08, 0)) + placed(props.globe(0.11), (-0.58, 0.2, 0))
    sheets = ((-0.35, -0.18, 12), (-0.12, -0.24, -20), (0.33, -0.2, 35), (0.1, -0.08, 64))
    for k, (x, y, heading) in enumerate(sheets):
        top += placed(props.sheet_of_paper(6 + k % 2), (x, y, 0.003 * k), heading)
    for k in range(4):
        size = (0.035 + 0.008 * (k % 3), 0.17, 0.24 - 0.015 * k)
        lying = leaned(props.book(17 * k + 5, size), 0, 90)
        top += placed(lying, (0.42 + 0.02 * k, -0.3 + 0.01 * k, 0.022 + 0.042 * k), 8 * k - 10)
    return placed([*pieces, *placed(top, (0, 0, 0.76))], (0.1, 0.15, 0), 6)


def _sides(rng: np.random.Generator) -> list[Piece]:
    """Right wall, window bays on the left, and what stands behind the default viewpoint."""
    x, y = _HALF_X, _HALF_Y
    pieces: list[Piece] = []
    for k, (at, w, h) in enumerate(((1.2, 0.5, 0.65), (0.4, 0.62, 0.5), (-0.5, 0.75, 0.55), (-1.4, 0.5, 0.65))):
        pieces += placed(props.framed(k + 1, w, h), (x - 0.02, at, 1.65), -90)
    for middle in (-1.25, 1.05):
        bars = [piece for piece in window(1.3, 1.6, None, "walnut") if piece.surface != "glass"]
        pieces += placed(bars, (-x - 0.28, middle, 0.75), -90)
        for side in (-0.82, 0.82):
            pieces += placed(props.curtain(0.45, 2.25), (-x + 0.1, middle + side, 0.15), 90)
        rod = ((-x + 0.1, middle - 1.1, 2.42), (-x + 0.1, middle + 1.1, 2.42))
        pieces.append(beam("brass", *rod, 0.03))
        pieces += placed(props.pot_plant(rng, 0.8), (-x + 0.22, middle + 0.1, 0.0)) if middle > 0 else []
    pieces += placed(props.pot_plant(rng), (-2.3, 2.15, 0)) + placed(props.pot_plant(rng, 1.1), (2.35, 0.35, 0))
    pieces += placed(props.bookcase(rng, 1.3), (0.4, -y + 0.34, 0), 180)
    pieces += placed(door(0.95, 2.1, "oak", "walnut")[:4], (-1.2, -y, 0), 180)
    pieces += placed(props.table((1.1, 0.45, 0.82)), (1.7, -y + 0.35, 0), 180)
    pieces += placed(props.vase(rng, 0.34, 8), (1.9, -y + 0.33, 0.82))
    pieces += placed(props.globe(0.14), (1.4, -y + 0.35, 0.82))
    return pieces + placed(props.framed(4, 0.8, 0.6), (1.7, -y + 0.02, 1.7), 180)


def _garden(rng: np.random.Generator) -> list[Piece]:
    """What the windows look out on: a lawn that rises to a hedge, low enough to let the sun in."""
    x, y = np.meshgrid(np.linspace(-30, 30, 31), np.linspace(-30, 30, 31))
    z = -0.4 + 0.004 * (x * x + y * y)
    pieces = [grid("grass", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1))]
    for k in range(9):
        bush = props.bush(rng, 1.0, "leaves_dark" if k % 2 else "leaves")
        pieces += placed(bush, (-9.0 - 0.4 * (k % 3), 1.7 * k - 7, -0.2))
    return pieces
