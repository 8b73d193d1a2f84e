"""Fortifications: curtain walls, round and square towers, keep and gatehouse.

Outer faces look towards -y. Surfaces used: ashlar_*, stone, tiles_*, timber, planks, iron, glass, cloth_0.
"""

from __future__ import annotations

import numpy as np

from rsbench.scenes.buildings import arch, gable_roof, rectangle
from rsbench.scenes.parts import Piece, Point, beam, block, box, grid, joined, panel, placed, profile, revolve


def battlement(rng: np.random.Generator, length: float, wall: str, height: float = 1.0) -> list[Piece]:
    """A parapet along x on z = 0, its outer face at y = 0, with merlons, capstones and loops."""
    count = max(1, round(length / 1.75))
    pitch = length / count
    pieces = [box(wall, (-length / 2, 0, 0), (length / 2, 0.45, height))]
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        wide, high = pitch * 0.58, 0.85 + 0.06 * rng.normal()
        if rng.random() < 0.06:  # a merlon that fell, as one or two always have
            high *= 0.45
        loop = [rectangle(0, high * 0.25, 0.12, high * 0.5)] if k % 2 else []
        pieces += placed([panel(wall, rectangle(0, 0, wide, high), 0.45, loop)], (x, 0, height))
        cap = [(-0.06, 0.0), (0.51, 0.0), (0.45, 0.1), (0.22, 0.2), (0.0, 0.1)]
        pieces += placed([profile("stone", cap, wide + 0.1)], (x, 0, height + high))
    return pieces


def corbels(length: float, wall: str, step: float = 0.8) -> list[Piece]:
    """A row of brackets and the ledge on them along x, below z = 0, sticking out to y = -0.35."""
    shape = [(0.0, -0.75), (0.0, 0.0), (-0.35, 0.0), (-0.35, -0.22), (-0.2, -0.4)]
    pieces = [box("stone", (-length / 2, -0.38, -0.02), (length / 2, 0.1, 0.14))]
    for x in np.arange(-length / 2 + step / 2, length / 2, step):
        pieces += placed([profile(wall, shape[::-1], 0.26)], (float(x), 0, 0))
    return pieces


def curtain_wall(
    rng: np.random.Generator, length: float, height: float = 6.0, thickness: float = 1.8, wall: str = "ashlar_0"
) -> list[Piece]:
    """A wall along x with a battered foot outside, a battlemented walk, and blind arches and a railing inside."""
    section = [(-0.7, 0.0), (thickness, 0.0), (thickness, height), (0.0, height), (0.0, 1.8)]
    pieces = [profile(wall, section, length)]
    pieces += placed(corbels(length, wall), (0, 0, height - 0.14))
    pieces += placed(battlement(rng, length, wall), (0, -0.33, height))
    count = max(1, round(length / 3.4))
    pitch = length / count
    arches: list[list[Point]] = []
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        arches.append([(x + a, b) for a, b in arch(pitch * 0.66, height * 0.68, base=0.25)])
    inner = [panel(wall, rectangle(0, 0, length, height - 0.35), 0.4, arches)]
    for k in range(count):
        x = (k + 0.5) * pitch - length / 2
        inner += placed(_voussoirs(pitch * 0.66, height * 0.68 + 0.25), (x, 0, 0))
    inner += [box("planks", (-length / 2, -0.9, height - 0.12), (length / 2, 0.5, height), turned=True)]
    for x in np.arange(-length / 2 + 0.5, length / 2, 1.3):
        x = float(x)
        inner.append(beam("timber", (x, -0.9, height - 0.22), (x, 0.4, height - 0.22), 0.16))
        inner.append(beam("timber", (x, -0.8, height - 0.3), (x, 0.0, height - 1.1), 0.13))
        inner.append(beam("timber", (x, -0.85, height), (x, -0.85, height + 1.0), 0.1))
    for z in (0.5, 0.95):
        inner.append(beam("timber", (-length / 2, -0.85, height + z), (length / 2, -0.85, height + z), 0.08))
    return pieces + placed(inner, (0, thickness + 0.4, 0), 180)


def _voussoirs(width: float, crown: float) -> list[Piece]:
    """The ring of wedge stones around a round arch in the wall y = 0."""
    pieces: list[Piece] = []
    spring = crown - width / 2
    for a in np.linspace(0, np.pi, 12)[:-1] + np.pi / 22:
        inner, outer = width / 2, width / 2 + 0.34
        half = np.pi / 23
        points = [(inner, a - half), (outer, a - half), (outer, a + half), (inner, a + half)]
        outline = [(r * float(np.cos(t)), spring + r * float(np.sin(t))) for r, t in points]
        pieces += placed([panel("stone", outline, 0.16)], (0, -0.07, 0))
    return pieces


def loop_window(width: float = 0.7, height: float = 1.5) -> list[Piece]:
    """A narrow arched window with a stone surround on the wall y = 0."""
    outer = arch(width + 0.5, height + 0.3, base=-0.15)
    pieces = [panel("stone", outer, 0.3, [arch(width, height)])]
    pieces.append(panel("glass", arch(width * 1.02, height), 0.05))
    pieces.append(beam("iron", (0, 0.0, 0), (0, 0.0, height), 0.05))
    return [*placed(pieces, (0, -0.14, 0)), box("stone", (-width, -0.25, -0.28), (width, 0.1, -0.13))]


def round_tower(
    rng: np.random.Generator, radius: float, height: float, wall: str, roof: str | None = None, rise: float = 1.9
) -> list[Piece]:
    """A round tower: battered foot, windows, corbelled parapet, and a conical roof or open battlements."""
    top = height
    shaft = [(radius * 1.15, 0), (radius, 2.2), (radius, top - 1.2), (radius + 0.32, top - 0.4)]
    crown = [(radius + 0.32, top + 0.9), (radius - 0.1, top + 0.9), (radius - 0.1, top), (0, top)]
    pieces = [revolve(wall, shaft + crown, 40)]
    for z in (height * 0.36, height * 0.68):
        ring = [(radius, z - 0.12), (radius + 0.1, z - 0.1), (radius + 0.1, z + 0.1), (radius, z + 0.12)]
        pieces.append(revolve("stone", ring, 40))
    count = int(2 * np.pi * radius / 0.85)
    for k in range(count):
        bracket = [box(wall, (-0.14, -0.36, top - 1.35), (0.14, 0.1, top - 0.4))]
        pieces += placed(placed(bracket, (0, -radius, 0)), (0, 0, 0), 360 * k / count)
    for k in range(10):
        heading = 36.0 * k + 6
        level = height * (0.2 + 0.28 * (k % 3))
        if level < height * 0.72:
            pieces += placed(placed(loop_window(0.5, 1.2), (0, -radius, level)), (0, 0, 0), heading)
    merlons = int(2 * np.pi * (radius + 0.3) / 1.5)
    for k in range(merlons if roof is None else 0):
        merlon = [
            box(wall, (-0.42, 0, 0), (0.42, 0.42, 0.85 + 0.05 * rng.normal())),
            box("stone", (-0.46, -0.05, 0.85), (0.46, 0.47, 0.98)),
        ]
        pieces += placed(placed(merlon, (0, -radius - 0.32, top + 0.9)), (0, 0, 0), 360 * k / merlons)
    if roof is not None:
        pieces += placed(_cone_roof(roof, radius, rise), (0, 0, top))
        pieces += placed(banner(1.3, 0.6), (0.03, 0, top + 1.55 + radius * rise), float(rng.uniform(-40, 40)))
    return pieces


def _cone_roof(tiles: str, radius: float, rise: float) -> list[Piece]:
    """A bell-cast cone over a tower that ends at z = 0, with an iron finial."""
    apex, eave = 0.8 + radius * rise, radius + 0.75
    cone = [(0, 0.7), (eave, 0.7), (eave * 0.62, 0.95 + radius * rise * 0.36), (0.0, apex)]
    knob = [(0.14, -0.35), (0.1, 0.1), (0.2, 0.3), (0.04, 0.5), (0.03, 1.4), (0.0, 1.4)]
    return [revolve(tiles, cone, 40), revolve("iron", [(r, apex + z) for r, z in knob], 8)]


def banner(length: float, height: float, surface: str = "cloth_0") -> list[Piece]:
    """A flag in a light wind, flying towards +x from its pole at x = 0."""
    t = np.linspace(0, 1, 14)
    wave = 0.12 * np.sin(t * 9) * t
    x, z = np.meshgrid(t * length, np.array([0.0, height]))
    points = np.stack([x, np.broadcast_to(wave * length, x.shape), z - 0.1 * x * x], axis=-1)
    return [grid(surface, points, np.stack([z, x], axis=-1))]


def square_tower(
    rng: np.random.Generator, width: float, height: float, wall: str, floors: int = 3, roof: str | None = None
) -> list[Piece]:
    """A square tower or keep centred on the origin: windows on each floor, corner buttresses, battlements."""
    half = width / 2
    pieces: list[Piece] = [box(wall, (-half + 0.4, -half + 0.4, height - 0.3), (half - 0.4, half - 0.4, height))]
    section = [(-0.5, 0.0), (0.1, 0.0), (0.1, 2.2), (0.0, 2.0)]
    for heading in (0, 90, 180, 270):
        holes, face = list[list[tuple[float, float]]](), list[Piece]()
        for floor in range(floors):
            z = 1.6 + (height - 3.2) * (floor + 0.35) / floors
            count = 1 if width < 6 else 2
            for k in range(count):
                x = (k - (count - 1) / 2) * width * 0.42 + 0.3 * rng.normal() * (width > 6)
                holes.append([(x + a, b) for a, b in arch(0.8, 1.7, base=z)])
                face += placed(loop_window(0.8, 1.7), (x, 0.0, z))
            ledge = [(-0.12, -0.1), (0.05, -0.1), (0.05, 0.1), (-0.06, 0.1)]
            face += placed([profile("stone", ledge, width)], (0, 0, z - 0.75))
        face.append(panel(wall, rectangle(0, 0, width, height), 0.7, holes))
        face.append(profile(wall, section, width + 1.0))
        for side in (-1, 1):
            face.append(box(wall, (side * half - 0.55, -0.22, 0), (side * half + 0.55, 0.3, height - 0.9)))
        face += placed(corbels(width + 0.7, wall), (0, 0, height))
        face += placed(battlement(rng, width + 0.66, wall), (0, -0.33, height))
        pieces += placed(placed(face, (0, -half, 0)), (0, 0, 0), heading)
    return pieces if roof is None else pieces + placed(_saddle_roof(wall, roof, width), (0, 0, height))


def _saddle_roof(wall: str, tiles: str, width: float) -> list[Piece]:
    """A gabled roof with a chimney inside the battlements of a tower that ends at z = 0."""
    half = width / 2
    pieces = placed(gable_roof(tiles, width - 1.6, width - 1.4, 1.3, width * 0.42), (0, 0, 0), 90)
    inner = half - 0.8
    gable = [(-inner, 0.0), (inner, 0.0), (inner, 1.4), (0.0, 1.2 + width * 0.4), (-inner, 1.4)]
    for heading in (0, 180):
        attic = placed(loop_window(0.9, 1.6), (0, 0, 1.0))
        attic.append(panel(wall, gable, 0.3, [arch(0.9, 1.6, base=1.0)]))
        pieces += placed(placed(attic, (0, -inner, 0)), (0, 0, 0), heading)
    stack = [block("stone", (0.9, 0.7, 4.2)), block("stone", (1.1, 0.9, 0.2), (0, 0, 4.0))]
    return pieces + placed(stack, (half * 0.35, 0.8, 1.2))


def gatehouse(rng: np.random.Generator, wall: str, roof: str, height: float = 8.5) -> list[Piece]:
    """An arched passage along y between two round towers, with portcullis, open doors and a shield of arms."""
    depth, wide = 5.0, 3.0
    pieces: list[Piece] = []
    for side in (-1, 1):
        pieces += placed(round_tower(rng, 2.1, height + 1.5, wall, roof), (side * 4.3, 1.6, 0))
    passage = arch(wide, 4.3)
    pieces.append(panel(wall, rectangle(0, 0, 8.4, height), depth, [passage]))
    for heading, y in ((0, 0.0), (180, depth)):
        face = (
            _voussoirs(wide, 4.3)
            + placed(loop_window(0.7, 1.5), (-1.6, 0, 5.3))
            + placed(loop_window(0.7, 1.5), (1.6, 0, 5.3))
        )
        face += placed(
            [panel("cloth_0", [(-0.7, 0.35), (0.0, 0.0), (0.7, 0.35), (0.7, 2.3), (-0.7, 2.3)], 0.06)],
            (0, -0.16, 4.9),
        )
        face.append(box("stone", (-4.2, -0.12, 4.55), (4.2, 0.1, 4.75)))
        face += placed(corbels(8.4, wall), (0, 0, height))
        face += placed(battlement(rng, 8.4, wall), (0, -0.33, height))
        pieces += placed(face, (0, y, 0), heading)
        leaves = [
            block("planks", (1.5, 0.12, 3.6)),
            *[block("iron", (1.4, 0.16, 0.1), (0, 0, z)) for z in (0.5, 1.8, 3.0)],
        ]
        if heading == 180:
            for side in (-1, 1):
                pieces += placed(leaves, (side * 1.75, y + 0.65, 0), 70 * -side)
    for x in np.linspace(-1.4, 1.4, 8):
        pieces.append(beam("iron", (float(x), 1.0, 2.5), (float(x), 1.0, 4.3), 0.07))
    for z in (2.7, 3.1, 3.5, 3.9):
        pieces.append(beam("iron", (-1.5, 1.0, z), (1.5, 1.0, z), 0.07))
    return pieces


def wall_stairs(surface: str, height: float, width: float = 1.3) -> list[Piece]:
    """Stone stairs along x that climb to a wall walk, with a solid flank, from x = 0 upward to +x."""
    steps = round(height / 0.2)
    treads = [
        box(surface, (0.3 * k, 0, 0), (0.3 * (k + 1), width, height * (k + 1) / steps)) for k in range(steps)
    ]
    return [joined(treads)]
