"""Things that stand about outdoors: trees, barrels, crates, carts, wells, fountains, stalls, lamps, benches.

Everything stands on the origin. Surfaces used: bark, leaves, leaves_dark, timber, planks, iron, stone, straw,
cloth_*, water, sack, fruit_*.
"""

from __future__ import annotations

import numpy as np

from rsbench.scenes.model import FloatArray
from rsbench.scenes.parts import (
    Piece,
    beam,
    block,
    box,
    flat,
    grid,
    leaned,
    lump,
    panel,
    placed,
    profile,
    revolve,
    tube,
)


def tree(
    rng: np.random.Generator, height: float = 6.0, crown: float = 2.2, leaf: str = "leaves", detail: int = 3
) -> list[Piece]:
    """A broad-leaved tree: bent trunk, branches, a crown of lumps with loose sprays of leaves around them."""
    bend = np.cumsum(rng.normal(scale=0.07, size=(6, 2)), axis=0) * height / 6
    levels = np.linspace(0, height * 0.62, 6)
    trunk = np.column_stack([bend - bend[0], levels])
    radius = height * 0.032
    pieces = [tube("bark", trunk, radius * np.array([1.5, 1.0, 0.9, 0.8, 0.65, 0.5]), 10)]
    for k in range(9):
        angle = k * 2.4 + rng.uniform(-0.4, 0.4)
        reach = crown * (0.30 + 0.35 * rng.random()) * (k > 0)
        top = height * (0.62 + 0.26 * rng.random() * (1.4 - reach / crown))
        centre = trunk[-1] * (1, 1, 0) + (reach * np.cos(angle), reach * np.sin(angle), top)
        start = trunk[2 + k % 4]
        middle = (start + centre) / 2 + (0, 0, -0.1 * height * 0.3)
        pieces.append(tube("bark", [start, middle, centre], radius * np.array([0.5, 0.35, 0.15]), 6))
        radii = crown * rng.uniform(0.38, 0.55) * np.array([1, 1, 0.8])
        blob = lump(leaf, rng, radii, 0.16, detail)
        pieces += placed([blob, *_sprays(rng, leaf, radii, 60 if detail > 2 else 25)], tuple(centre))
    return pieces


def bush(rng: np.random.Generator, size: float = 0.8, leaf: str = "leaves") -> list[Piece]:
    """A low shrub."""
    radii = size * np.array([1.0, 0.8, 0.7])
    return placed([lump(leaf, rng, radii, 0.18, 3), *_sprays(rng, leaf, radii, 70)], (0, 0, size * 0.4))


def _sprays(rng: np.random.Generator, leaf: str, radii: FloatArray, count: int) -> list[Piece]:
    """Small leafy flaps around an ellipsoid, which give a crown a broken outline."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = direction * radii * rng.uniform(0.9, 1.2, (count, 1))
    a = rng.normal(size=(count, 3)) * 0.08
    b = np.cross(a, rng.normal(size=(count, 3)))
    b *= 0.12 / np.linalg.norm(b, axis=1, keepdims=True)
    quads = np.stack([centre - a, centre + b, centre + a, centre - a, centre + a, centre - b], axis=1)
    return [flat(leaf, quads.reshape(-1, 3, 3))]


def barrel(height: float = 0.95, radius: float = 0.34) -> list[Piece]:
    """Staves, three pairs of hoops and a lid."""
    bulge = [(radius * (0.82 + 0.18 * float(np.sin(np.pi * t))), height * t) for t in np.linspace(0, 1, 9)]
    pieces = [
        revolve("planks", bulge, 24),
        revolve("planks", [(radius * 0.82, height - 0.04), (0, height - 0.04)], 24),
    ]
    for t in (0.06, 0.3, 0.66, 0.9):
        r = radius * (0.82 + 0.18 * float(np.sin(np.pi * (t + 0.02)))) + 0.012
        hoop = [(r - 0.03, height * t), (r, height * t), (r, height * t + 0.05), (r - 0.03, height * t + 0.05)]
        pieces.append(revolve("iron", hoop, 24))
    return pieces


def crate(size: float = 0.8, height: float | None = None) -> list[Piece]:
    """A boarded box with battens on its edges and a brace on each side."""
    h = size if height is None else height
    pieces = [block("planks", (size, size, h))]
    for side in (-1, 1):
        e = side * (size / 2)
        for z in (0.06, h - 0.06):
            pieces.append(beam("timber", (-size / 2, e, z), (size / 2, e, z), 0.1, 0.05))
            pieces.append(beam("timber", (e, -size / 2, z), (e, size / 2, z), 0.05, 0.1))
        for other in (-1, 1):
            pieces.append(block("timber", (0.1, 0.1, h), (e * 0.98, other * size * 0.49, 0)))
        pieces.append(beam("timber", (-size / 2, e, 0.1), (size / 2, e, h - 0.1), 0.09, 0.04))
    return pieces


def sacks(rng: np.random.Generator, count: int = 4) -> list[Piece]:
    """A heap of filled sacks."""
    pieces: list[Piece] = []
    for k in range(count):
        sack = leaned([lump("sack", rng, (0.28, 0.24, 0.42), 0.1)], float(rng.uniform(-15, 15)))
        pieces += placed(sack, (0.5 * (k % 3) - 0.5, 0.35 * (k // 3), 0.36), float(rng.uniform(0, 360)))
    return pieces


def hay_bales(rng: np.random.Generator, count: int = 5) -> list[Piece]:
    """Bales stacked two deep with loose straw at their foot."""
    pieces = placed([lump("straw", rng, (1.5, 1.1, 0.28), 0.12)], (0, 0, 0))
    for k in range(count):
        level, column = divmod(k, 3)
        at = (1.05 * (column - 1) + 0.5 * level, 0.1 * rng.normal(), 0.5 * level)
        pieces += placed([block("straw", (0.98, 0.55, 0.5))], at, float(rng.uniform(-8, 8)))
    return pieces


def wheel(radius: float = 0.55) -> list[Piece]:
    """A spoked wheel that stands in the plane y = 0."""
    rim = [(radius - 0.1, -0.05), (radius, -0.05), (radius, 0.05), (radius - 0.1, 0.05), (radius - 0.1, -0.05)]
    hub = [(0.0, -0.13), (0.11, -0.13), (0.11, 0.13), (0.0, 0.13)]
    pieces = leaned([revolve("timber", rim, 28), revolve("timber", hub, 12)], 90)
    for k in range(10):
        angle = 2 * np.pi * k / 10
        end = (float(np.cos(angle)) * (radius - 0.05), 0.0, float(np.sin(angle)) * (radius - 0.05))
        pieces.append(beam("timber", (0, 0, 0), end, 0.055))
    return placed(pieces, (0, 0, radius))


def cart(rng: np.random.Generator, load: str = "straw") -> list[Piece]:
    """A two-wheeled cart along x, loaded, its shafts resting on the ground."""
    bed = [box("planks", (-1.2, -0.6, 0.62), (1.2, 0.6, 0.7), turned=True)]
    for side in (-0.62, 0.62):
        for z in (0.78, 0.98, 1.18):
            bed.append(box("planks", (-1.2, side - 0.025, z), (1.2, side + 0.025, z + 0.15), turned=True))
        bed += [beam("timber", (x, side * 1.05, 0.6), (x, side * 1.12, 1.42), 0.08) for x in (-1.1, 0.0, 1.1)]
        bed.append(beam("timber", (-1.2, side * 0.8, 0.6), (3.0, side * 0.62, 0.42), 0.09))
    bed.append(block("planks", (0.05, 1.2, 0.6), (-1.2, 0, 0.75)))
    bed += placed([lump(load, rng, (0.95, 0.5, 0.5), 0.1)], (0, 0, 1.0))
    pieces = placed(leaned(bed, 0, 4), (0, 0, 0.08))
    for side in (-0.78, 0.78):
        pieces += placed(wheel(0.62), (-0.1, side, 0))
    return [*pieces, beam("iron", (-0.1, -0.85, 0.62), (-0.1, 0.85, 0.62), 0.07)]


def well(rng: np.random.Generator) -> list[Piece]:
    """A round stone well with a tiled roof on posts, windlass, rope and bucket."""
    ring = [(1.0, 0), (0.95, 0.85), (1.02, 0.86), (1.02, 1.0), (0.68, 1.0), (0.68, -0.6), (0.0, -0.6)]
    pieces = [revolve("stone", ring, 28), revolve("stone", [(1.5, 0), (1.45, 0.12), (0.9, 0.12)], 28)]
    for side in (-0.85, 0.85):
        pieces.append(beam("timber", (side, 0, 0.9), (side, 0, 2.5), 0.16))
        pieces.append(beam("timber", (side, 0, 2.0), (side, 0.6, 2.45), 0.09))
        pieces.append(beam("timber", (side, 0, 2.0), (side, -0.6, 2.45), 0.09))
    roof = [(-1.1, 2.3), (0, 3.2), (1.1, 2.3), (1.1, 2.42), (0, 3.34), (-1.1, 2.42)]
    pieces += [profile("tiles_0", roof, 2.3)]
    pieces += [tube("timber", [(-1.0, 0, 1.7), (0, 0, 1.7), (1.0, 0, 1.7)], (0.1, 0.1, 0.1), 12)]
    pieces += [tube("timber", [(0.1, 0, 1.7), (0.1, 0, 1.3), (0.1, 0, 1.15)], (0.02, 0.02, 0.02), 5)]
    pieces += placed(
        [revolve("planks", [(0.0, 0), (0.15, 0), (0.2, 0.34), (0.17, 0.3), (0, 0.3)], 14)], (0.1, 0, 0.85)
    )
    return pieces + placed(barrel(0.5, 0.26), (1.5, -0.4, 0), float(rng.uniform(0, 90)))


def fountain(rng: np.random.Generator, radius: float = 2.2) -> list[Piece]:
    """An octagonal basin with steps, a column, an upper bowl and a finial."""
    step = [
        (radius + 0.75, 0),
        (radius + 0.75, 0.18),
        (radius + 0.35, 0.18),
        (radius + 0.35, 0.34),
        (radius, 0.34),
    ]
    basin = [(radius, 0.3), (radius - 0.08, 0.9), (radius + 0.1, 0.98), (radius + 0.1, 1.12)]
    basin += [(radius - 0.25, 1.12), (radius - 0.3, 0.5), (0.0, 0.5)]
    column = [(0.55, 0.5), (0.5, 0.9), (0.3, 1.05), (0.24, 1.9), (0.34, 2.05), (0.9, 2.35), (0.95, 2.5)]
    column += [(0.85, 2.5), (0.3, 2.3), (0.2, 2.7), (0.26, 2.95), (0.12, 3.2), (0.2, 3.4), (0.0, 3.7)]
    pieces = [revolve("stone", step, 8), revolve("stone", basin, 8), revolve("stone", column, 24)]
    pieces.append(revolve("water", [(radius - 0.2, 0.93), (0.0, 0.93)], 24))
    for k in range(4):
        angle = np.pi / 2 * k + 0.3
        out = np.array([np.cos(angle), np.sin(angle)])
        path = [(*(out * r), z) for r, z in ((0.25, 1.72), (0.42, 1.78), (0.52, 1.7))]
        pieces.append(tube("iron", path, (0.05, 0.045, 0.04), 8))
    for k in range(8):
        post = placed([block("stone", (0.28, 0.28, 1.2))], (radius + 0.02, 0, 0.0))
        pieces += placed(post, (0, 0, 0), 45.0 * k + float(rng.uniform(-1, 1)))
    return pieces


def stall(rng: np.random.Generator, awning: str = "cloth_0") -> list[Piece]:
    """A market stall 2.6 m wide: trestle, sloping awning with a scalloped edge, baskets and crates of goods."""
    pieces = [box("planks", (-1.3, -0.5, 0.85), (1.3, 0.5, 0.92), turned=True)]
    pieces += [box("planks", (-1.28, -0.47, 0.1), (1.28, -0.43, 0.85))]
    for x in (-1.25, 1.25):
        pieces += [
            beam("timber", (x, -0.75, 0), (x, -0.75, 2.03), 0.09),
            beam("timber", (x, 0.75, 0), (x, 0.75, 2.62), 0.09),
        ]
    rows, columns = np.meshgrid(np.linspace(0, 1, 7), np.linspace(-1.5, 1.5, 13), indexing="ij")
    sag = 0.09 * np.sin(np.pi * rows) * (1 + np.cos(columns * 2.4))
    sheet = np.stack([columns, 0.9 - 1.95 * rows, 2.8 - 0.68 * rows - sag], axis=-1)
    pieces.append(grid(awning, sheet, np.stack([columns, 2.1 * rows], axis=-1)))
    scallops = [(-1.5, 0.3), (1.5, 0.3)]
    for k in range(10):
        x = 1.5 - 0.3 * k
        scallops += [(x, 0.12), (x - 0.075, 0.02), (x - 0.225, 0.02)]
    pieces += placed([panel(awning, scallops, 0.012)], (0, -1.06, 1.82))
    for k in range(5):
        basket = [revolve("straw", [(0.17, 0), (0.24, 0.2), (0.22, 0.2), (0.0, 0.13)], 14)]
        goods = str(rng.choice(["fruit_0", "fruit_1", "fruit_2"]))
        for _ in range(9):
            x, y = rng.uniform(-0.13, 0.13, 2)
            basket += placed(
                [revolve(goods, [(0, 0), (0.06, 0.03), (0.06, 0.09), (0, 0.12)], 7)],
                (x, y, 0.12 + 0.06 * rng.random()),
            )
        pieces += placed(basket, (-1.0 + 0.5 * k, -0.15 + 0.12 * (k % 2), 0.92))
    return pieces + placed(crate(0.5), (0.8, -0.85, 0), float(rng.uniform(-20, 20)))


def lamp_post(height: float = 3.6) -> list[Piece]:
    """A cast-iron street lamp with a glazed lantern."""
    post = [
        (0.2, 0),
        (0.2, 0.3),
        (0.13, 0.45),
        (0.09, 0.5),
        (0.065, height - 0.7),
        (0.12, height - 0.6),
        (0.05, height - 0.55),
    ]
    lantern = [(0.1, height - 0.55), (0.22, height - 0.05), (0.0, height - 0.05)]
    cap = [(0.27, height - 0.05), (0.1, height + 0.16), (0.04, height + 0.2), (0.0, height + 0.34)]
    arm = beam("iron", (-0.35, 0, height - 0.85), (0.35, 0, height - 0.85), 0.05)
    return [revolve("iron", post, 12), revolve("glass", lantern, 6), revolve("iron", cap, 6), arm]


def bench(width: float = 1.7) -> list[Piece]:
    """A wooden bench with a back; who sits on it looks towards -y."""
    pieces = [
        box("planks", (-width / 2, -0.25 + 0.17 * k, 0.42), (width / 2, -0.11 + 0.17 * k, 0.47), turned=True)
        for k in range(3)
    ]
    pieces += [
        box("planks", (-width / 2, 0.26, 0.6 + 0.18 * k), (width / 2, 0.3, 0.74 + 0.18 * k), turned=True)
        for k in range(2)
    ]
    for x in (-width / 2 + 0.15, width / 2 - 0.15):
        pieces += [block("iron", (0.07, 0.5, 0.42), (x, 0, 0)), block("iron", (0.06, 0.06, 0.95), (x, 0.28, 0))]
    return pieces


def sign(board: str = "door", reach: float = 0.9) -> list[Piece]:
    """A board that hangs from an iron arm on a wall y = 0, 0.9 m below the arm's height z = 0."""
    pieces = [
        beam("iron", (0, 0, 0), (0, -reach - 0.15, 0), 0.05),
        beam("iron", (0, 0, -0.45), (0, -reach * 0.6, -0.02), 0.035),
    ]
    outline = [(-0.36, -0.8), (0.36, -0.8), (0.42, -0.2), (0.0, -0.1), (-0.42, -0.2)]
    return pieces + placed([panel(board, outline, 0.06)], (0.03, -reach * 0.62, 0), 90)


def log_pile(rng: np.random.Generator, rows: int = 4, length: float = 1.2) -> list[Piece]:
    """Stacked logs, ends towards -y."""
    pieces: list[Piece] = []
    for row in range(rows):
        for k in range(8 - row):
            r = 0.1 + 0.03 * rng.random()
            log = [revolve("bark", [(r, 0), (r, length)], 10), revolve("timber", [(r, length), (0, length)], 10)]
            at = (0.24 * (k - (7 - row) / 2), length / 2 + 0.06 * rng.normal(), 0.12 + 0.21 * row)
            pieces += placed(leaned(log, 90), at)
    return pieces
