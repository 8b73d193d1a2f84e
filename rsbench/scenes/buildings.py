"""Houses and what they are made of: windows, doors, timber frames, roofs, chimneys.

Fronts look towards -y with their middle at x = 0. Surfaces used: plaster_*, brick, stone, timber, planks, glass,
tiles_*, iron, leaves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsbench.scenes.parts import Piece, Point, beam, block, box, lump, panel, placed, profile, revolve


@dataclass(frozen=True, kw_only=True)
class HouseStyle:
    """What a house looks like; lengths in metres."""

    width: float = 6.0
    depth: float = 8.0
    storeys: int = 2
    storey_height: float = 2.7
    wall: str = "plaster_0"
    ground: str = "stone"
    roof: str = "tiles_0"
    shutters: str = "shutter_0"
    framed: bool = True
    gable_front: bool = True
    door: bool = True
    jetty: float = 0.25
    pitch: float = 1.1
    """Rise of the roof over half its span."""


def arch(width: float, height: float, segments: int = 10, base: float = 0.0) -> list[Point]:
    """Outline of a round-arched opening that stands on z = ``base``; ``height`` is that of its crown."""
    angles = np.linspace(0, np.pi, segments + 1)
    spring = base + height - width / 2
    crown = [(width / 2 * float(np.cos(a)), spring + width / 2 * float(np.sin(a))) for a in angles]
    return [(-width / 2, base), (width / 2, base), *crown]


def rectangle(x: float, z: float, width: float, height: float) -> list[Point]:
    """Outline of a rectangle whose bottom edge is centred on (x, z)."""
    return [(x - width / 2, z), (x + width / 2, z), (x + width / 2, z + height), (x - width / 2, z + height)]


def window(
    width: float, height: float, shutters: str | None = None, frame: str = "timber", flowers: int | None = None
) -> list[Piece]:
    """A casement with bars, a sill and open shutters, for an opening that stands on z = 0 in the wall y = 0."""
    w, h = width / 2, height
    pieces = [
        box("glass", (-w, 0.12, 0), (w, 0.16, h)),
        box(frame, (-w - 0.09, -0.05, -0.02), (-w + 0.02, 0.14, h + 0.02)),
        box(frame, (w - 0.02, -0.05, -0.02), (w + 0.09, 0.14, h + 0.02)),
        box(frame, (-w - 0.13, -0.06, h), (w + 0.13, 0.14, h + 0.13), turned=True),
        box(frame, (-w - 0.15, -0.14, -0.09), (w + 0.15, 0.14, 0.0), turned=True),
        box(frame, (-0.035, 0.07, 0), (0.035, 0.13, h)),
        box(frame, (-w, 0.07, h * 0.62), (w, 0.13, h * 0.62 + 0.06), turned=True),
    ]
    if shutters is not None:
        for side in (-1, 1):
            leaf = [block(shutters, (w * 0.95, 0.05, h)), block(frame, (w * 0.95, 0.07, 0.09), (0, 0, h * 0.2)),
                    block(frame, (w * 0.95, 0.07, 0.09), (0, 0, h * 0.75))]  # fmt: skip
            pieces += placed(leaf, (side * (w * 1.5 + 0.1), -0.11, 0), side * 8)
    if flowers is not None:
        rng = np.random.default_rng(flowers)
        pieces.append(box("planks", (-w, -0.34, -0.18), (w, -0.12, 0.02), turned=True))
        for x in np.arange(-w + 0.1, w, 0.16):
            bloom = lump(str(rng.choice(["leaves", "flowers"])), rng, (0.13, 0.12, 0.14), 0.3, 1)
            pieces += placed([bloom], (float(x), -0.23, 0.06 + 0.06 * rng.random()))
    return pieces


def door(width: float, height: float, leaf: str = "door", frame: str = "timber") -> list[Piece]:
    """A boarded door with frame, iron bands and a worn step, for an opening that stands on z = 0."""
    w, h = width / 2, height
    pieces = [
        box(leaf, (-w, 0.14, 0), (w, 0.22, h)),
        box(frame, (-w - 0.12, -0.07, 0), (-w + 0.03, 0.2, h)),
        box(frame, (w - 0.03, -0.07, 0), (w + 0.12, 0.2, h)),
        box(frame, (-w - 0.18, -0.09, h), (w + 0.18, 0.2, h + 0.2), turned=True),
        box("stone", (-w - 0.3, -0.5, -0.3), (w + 0.3, 0.1, 0.14)),
    ]
    pieces += [box("iron", (-w + 0.05, 0.11, h * t), (w * 0.6, 0.15, h * t + 0.07)) for t in (0.15, 0.75)]
    return [*pieces, box("iron", (w * 0.55, 0.07, h * 0.47), (w * 0.7, 0.15, h * 0.53))]


def gable_roof(
    tiles: str, length: float, span: float, eaves: float, rise: float, overhang: float = 0.45, thick: float = 0.16
) -> list[Piece]:
    """Two slopes with their ridge along x, tiles outside and boards at the verges."""
    slope = rise / (span / 2)
    low, out = eaves - overhang * slope, span / 2 + overhang
    top = eaves + rise
    outline = [(-out, low), (0, top), (out, low), (out, low + thick), (0, top + thick * 1.2), (-out, low + thick)]
    full = length + 2 * overhang * 0.7
    pieces = [profile(tiles, outline, full)]
    ridge = [(0.14, 0.0), (0.07, 0.13), (-0.07, 0.13), (-0.14, 0.0)]
    pieces += placed([profile(tiles, ridge, full, turned=True)], (0, 0, top + thick * 0.7))
    for end in (-1, 1):
        for side in (-1, 1):
            x = end * (full / 2 + 0.02)
            pieces.append(beam("timber", (x, side * out, low + 0.02), (x, 0, top + 0.02), 0.22, 0.06))
    for side in (-1, 1):
        pieces.append(beam("timber", (-full / 2, side * out, low), (full / 2, side * out, low), 0.12))
    return pieces


def chimney(rng: np.random.Generator, height: float, width: float = 0.7, wall: str = "brick") -> list[Piece]:
    """A stack with a corbelled head and pots, standing on the origin."""
    pieces = [
        block(wall, (width, width * 0.8, height)),
        block(wall, (width + 0.16, width * 0.8 + 0.16, 0.16), (0, 0, height - 0.3)),
        block("stone", (width + 0.1, width * 0.8 + 0.1, 0.08), (0, 0, height)),
    ]
    for x in (-width / 4, width / 4):
        pot = revolve("brick", [(0.13, 0), (0.1, 0.35 + 0.2 * rng.random()), (0.13, 0.62), (0.0, 0.6)], 10)
        pieces += placed([pot], (x, 0, height + 0.08))
    return pieces


def dormer(tiles: str, wall: str, width: float = 1.3, height: float = 1.2) -> list[Piece]:
    """A small gabled window house that sticks out of a roof; its front stands at y = 0."""
    front = [*rectangle(0, 0, width, height)[:3], (0.0, height + width * 0.55), (-width / 2, height)]
    pieces = [
        panel(wall, front, 0.1, [rectangle(0, 0.25, width * 0.55, height * 0.7)]),
        box(wall, (-width / 2, 0, 0), (-width / 2 + 0.1, 2.2, height)),
        box(wall, (width / 2 - 0.1, 0, 0), (width / 2, 2.2, height)),
    ]
    pieces += placed(window(width * 0.55, height * 0.7), (0, 0, 0.25))
    roof = gable_roof(tiles, 2.4, width, height, width * 0.55, 0.16, 0.1)
    return pieces + placed(roof, (0, 1.1, 0), 90)


def timber_frame(
    rng: np.random.Generator, width: float, height: float, openings: Sequence[tuple[float, float]]
) -> list[Piece]:
    """Posts, rails and braces on a wall y = 0 of one storey; ``openings`` are (middle, width) along x."""
    posts = {-width / 2 + 0.1, width / 2 - 0.1}
    for middle, size in openings:
        posts |= {middle - size / 2 - 0.14, middle + size / 2 + 0.14}
    xs = sorted(posts)
    pieces = [beam("timber", (x, -0.03, 0), (x, -0.03, height), 0.17 + 0.04 * rng.random(), 0.14) for x in xs]
    for z in (0.1, height - 0.1):
        pieces.append(beam("timber", (-width / 2, -0.04, z), (width / 2, -0.04, z), 0.14, 0.2))
    for left, right in itertools.pairwise(xs):
        covered = any(left < middle < right for middle, _ in openings)
        if covered:
            pieces.append(beam("timber", (left, -0.02, 0.8), (right, -0.02, 0.8), 0.14, 0.1))
        elif right - left > 0.35:
            low, high = (left, right) if rng.random() < 0.5 else (right, left)
            pieces.append(beam("timber", (low, -0.015, 0.15), (high, -0.015, height - 0.15), 0.15, 0.1))
            if right - left > 0.9:
                z = height * rng.uniform(0.4, 0.6)
                pieces.append(beam("timber", (left, -0.02, z), (right, -0.02, z), 0.13, 0.1))
    return pieces


def house(rng: np.random.Generator, style: HouseStyle) -> list[Piece]:
    """A town house: ground floor with a door, jettied storeys with windows, a gabled roof with chimney."""
    pieces: list[Piece] = []
    for storey in range(style.storeys):
        front = _storey_front(rng, style, storey)
        pieces += placed(front, (0, -style.jetty * storey, storey * style.storey_height))
    eaves = style.storeys * style.storey_height
    y = -style.jetty * (style.storeys - 1)
    for side in (-1, 1):
        x = side * (style.width / 2 - 0.15)
        for storey in range(style.storeys):
            z = storey * style.storey_height
            wall = style.ground if storey == 0 else style.wall
            low = (x - 0.15, -style.jetty * storey + 0.28, z)
            pieces.append(box(wall, low, (x + 0.15, style.depth, z + style.storey_height)))
    back = rectangle(0, 0, style.width, eaves)
    pieces += placed([panel(style.wall, back, 0.3, [])], (0, style.depth, 0), 180)
    return pieces + _house_roof(rng, style, eaves, y)


def _storey_front(rng: np.random.Generator, style: HouseStyle, storey: int) -> list[Piece]:
    """Front wall of one storey with its openings, from z = 0 to the storey's height."""
    w, h = style.width, style.storey_height
    count = max(1, int((w - 0.8) / 1.75))
    middles = (np.arange(count) - (count - 1) / 2) * (w - 0.6) / count
    wall = style.ground if storey == 0 else style.wall
    door_at = int(rng.integers(count)) if storey == 0 and style.door else -1
    holes, pieces = list[list[tuple[float, float]]](), list[Piece]()
    openings: list[tuple[float, float]] = []
    for k, x in enumerate(middles):
        x = float(x)
        if k == door_at:
            size = (1.05, 2.1)
            pieces += placed(door(*size, leaf=str(rng.choice(["door", "planks"]))), (x, 0, 0))
            holes.append(rectangle(x, 0, *size))
        else:
            size = (0.8 + 0.2 * rng.random(), 1.2)
            flowers = int(rng.integers(1 << 30)) if rng.random() < 0.45 else None
            shutters = style.shutters if rng.random() < 0.8 else None
            pieces += placed(window(*size, shutters, flowers=flowers), (x, 0, 0.9))
            holes.append(rectangle(x, 0.9, *size))
        openings.append((x, size[0]))
    pieces.append(panel(wall, rectangle(0, 0, w, h), 0.3, holes))
    if storey > 0:
        if style.framed:
            pieces += timber_frame(rng, w, h, openings)
        pieces.append(beam("timber", (-w / 2, 0.1, -0.12), (w / 2, 0.1, -0.12), 0.24, 0.5))
        for x in np.arange(-w / 2 + 0.2, w / 2, 0.55):
            pieces.append(box("timber", (x - 0.08, -0.08, -0.2), (x + 0.08, 0.4, -0.02)))
    return pieces


def _house_roof(rng: np.random.Generator, style: HouseStyle, eaves: float, front: float) -> list[Piece]:
    w = style.width
    length = style.depth - front
    middle = (style.depth + front) / 2
    span = w if style.gable_front else length
    rise = span / 2 * style.pitch
    roof = gable_roof(style.roof, length if style.gable_front else w, span, eaves, rise)
    gable = [(-span / 2, 0.0), (span / 2, 0.0), (0.0, rise)]
    pieces: list[Piece] = []
    if style.gable_front:
        pieces += placed(roof, (0, middle, 0), 90)
        attic = [panel(style.wall, gable, 0.25, [rectangle(0, rise * 0.22, 0.7, 0.9)])]
        attic += placed(window(0.7, 0.9, style.shutters), (0, 0, rise * 0.22))
        if style.framed:
            attic += _gable_frame(span, rise)
        pieces += placed(attic, (0, front, eaves))
        pieces += placed([panel(style.wall, gable, 0.25)], (0, style.depth, eaves), 180)
    else:
        pieces += placed(roof, (0, middle, 0))
        for side in (-1, 1):
            pieces += placed([panel(style.wall, gable, 0.25)], (side * w / 2, middle, eaves), 90 * side)
        for x in (-w / 4, w / 4):
            if rng.random() < 0.75:
                pieces += placed(dormer(style.roof, style.wall), (x, front + 0.5, eaves + 0.25))
    stack = chimney(rng, 2.4 + rng.random(), wall=str(rng.choice(["brick", "stone"])))
    x = w * rng.uniform(0.15, 0.3) * rng.choice((-1, 1))
    y = middle + rng.uniform(-0.3, 0.3) * length if style.gable_front else middle - 0.8
    height = eaves + rise * (0.35 if style.gable_front else 0.6)
    return pieces + placed(stack, (float(x), float(y), height))


def _gable_frame(span: float, rise: float) -> list[Piece]:
    pieces = [beam("timber", (-span / 2, -0.04, 0.1), (span / 2, -0.04, 0.1), 0.14, 0.2)]
    for side in (-1, 1):
        pieces.append(beam("timber", (side * 0.5, -0.03, 0.1), (side * 0.5, -0.03, rise * 0.78), 0.16, 0.12))
        pieces.append(
            beam("timber", (side * span * 0.32, -0.02, 0.1), (side * 0.55, -0.02, rise * 0.55), 0.15, 0.1)
        )
    reach = span / 2 * 0.42
    return [*pieces, beam("timber", (-reach, -0.035, rise * 0.58), (reach, -0.035, rise * 0.58), 0.15, 0.12)]
