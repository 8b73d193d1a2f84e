"""Furniture and things that stand about outdoors: trees, barrels, carts, wells, stalls, lamps, benches.

Everything stands on the origin; furniture faces -y.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsbench.scenes.model import FloatArray
from rsbench.scenes.parts import (
    Piece,
    beam,
    block,
    box,
    cushion,
    flat,
    grid,
    leaned,
    lump,
    panel,
    picture,
    placed,
    profile,
    rectangle,
    revolve,
    tube,
    unit,
)
from rsbench.scenes.surfaces import PICTURES, SPINES, cell_uv


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
    direction = unit(rng.normal(size=(count, 3)))
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
    bucket = [(0.0, 0), (0.15, 0), (0.2, 0.34), (0.17, 0.3), (0, 0.3)]
    pieces += placed([revolve("planks", bucket, 14)], (0.1, 0, 0.85))
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
            fruit = revolve(goods, [(0, 0), (0.06, 0.03), (0.06, 0.09), (0, 0.12)], 7)
            basket += placed([fruit], (x, y, 0.12 + 0.06 * rng.random()))
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


def sheet_cell(piece: Piece, uv: FloatArray) -> Piece:
    """A piece whose texture coordinates run from 0 to 1, shown with one cell (low, high) of a sheet."""
    return replace(piece, uv=uv[0] + piece.uv * (uv[1] - uv[0]))


def book(number: int, size: tuple[float, float, float]) -> list[Piece]:
    """A book standing on the origin, its spine towards -y; ``size`` is thickness, depth, height."""
    w, d, h = size
    cell = cell_uv(number, SPINES)
    front = [(-w / 2, 0, 0), (w / 2, 0, 0), (w / 2, 0, h), (-w / 2, 0, h)]
    left = [(-w / 2, d, 0), (-w / 2, 0, 0), (-w / 2, 0, h), (-w / 2, d, h)]
    right = [(w / 2, 0, 0), (w / 2, d, 0), (w / 2, d, h), (w / 2, 0, h)]
    cover = np.stack([cell[0] + (cell[1] - cell[0]) * (0.1, 0.02), cell[0] + (cell[1] - cell[0]) * (0.9, 0.08)])
    pieces = [sheet_cell(picture("books", front), cell)]
    pieces += [sheet_cell(picture("books", corners), cover) for corners in (left, right)]
    return [*pieces, box("paper", (-w / 2 + 0.003, 0.004, 0.003), (w / 2 - 0.003, d - 0.004, h - 0.004))]


def books_in_a_row(rng: np.random.Generator, length: float, height: float, depth: float = 0.2) -> list[Piece]:
    """Books along x that fill most of a shelf, a few leaning, a few lying, and gaps."""
    pieces: list[Piece] = []
    x = -length / 2
    while x < length / 2 - 0.05:
        w = float(rng.uniform(0.018, 0.055))
        h = float(rng.uniform(0.62, 0.93)) * height
        number = int(rng.integers(SPINES[0] * SPINES[1]))
        kind = rng.random()
        if kind < 0.02:
            x += float(rng.uniform(0.03, 0.08))
        elif kind < 0.06 and x + h * 0.75 < length / 2:
            at = 0.0
            for _ in range(int(rng.integers(2, 5))):
                lying = placed(book(int(rng.integers(128)), (w, depth, h * 0.75)), (0, 0, 0))
                pieces += placed(leaned(lying, 0, 90), (x, 0.01 * rng.random(), at + w / 2))
                at += w
            x += h * 0.75 + 0.015
        elif x + w <= length / 2:
            lean = 7.0 * (rng.random() < 0.07)
            d = depth * float(rng.uniform(0.8, 1.0))
            pieces += placed(leaned(book(number, (w, d, h)), 0, lean), (x + w / 2, 0.02 * rng.random(), 0.004))
            x += w + 0.002 + 0.0025 * lean
        else:
            break
    return pieces


def bookcase(rng: np.random.Generator, width: float = 1.3, height: float = 2.2, shelves: int = 6) -> list[Piece]:
    """An open case with a plinth and a cornice, its shelves full of books, a few with other things."""
    d = 0.32
    pieces = [
        box("walnut", (-width / 2, 0, 0), (-width / 2 + 0.035, d, height)),
        box("walnut", (width / 2 - 0.035, 0, 0), (width / 2, d, height)),
        box("walnut", (-width / 2, d - 0.02, 0), (width / 2, d, height)),
        box("walnut", (-width / 2 - 0.03, -0.03, height), (width / 2 + 0.03, d, height + 0.06), turned=True),
        box("walnut", (-width / 2 - 0.02, -0.02, 0), (width / 2 + 0.02, d, 0.09), turned=True),
    ]
    pitch = (height - 0.09) / shelves
    for k in range(shelves):
        z = 0.09 + k * pitch
        pieces.append(box("walnut", (-width / 2, 0.005, z - 0.024), (width / 2, d, z), turned=True))
        full = width - 0.08
        if k in (1, 4):
            things = vase(rng, 0.8 * pitch) if k == 4 else globe(0.36 * pitch)
            side = 1 if k == 4 else -1
            pieces += placed(things, (side * (full / 2 - 0.14), 0.15, z))
            row = books_in_a_row(rng, full - 0.32, pitch - 0.03)
            pieces += placed(row, (-side * 0.16, 0.05, z))
        else:
            pieces += placed(books_in_a_row(rng, full, pitch - 0.03), (0, 0.05, z))
    return pieces


def vase(rng: np.random.Generator, height: float = 0.3, twigs: int = 0) -> list[Piece]:
    """A glazed vase, with leafy twigs where ``twigs`` says so."""
    r = height * 0.36
    line = [
        (r * 0.55, 0),
        (r, height * 0.4),
        (r * 0.75, height * 0.7),
        (r * 0.38, height * 0.88),
        (r * 0.5, height),
    ]
    pieces = [revolve("ceramic", [*line, (r * 0.42, height), (r * 0.3, height * 0.85)], 24)]
    for k in range(twigs):
        angle, reach = 2.4 * k, 0.5 + 0.3 * (k % 2)
        tip = np.array([np.cos(angle) * reach, np.sin(angle) * reach, 1.5 + 0.4 * rng.random()])
        path = np.stack([np.array([0, 0, 0.8]), np.array([0.15, 0.15, 1.0]) * tip, tip]) * height
        pieces.append(tube("oak", path, (0.005, 0.004, 0.003), 5))
        pieces += _leaflets(rng, path[1:], 12, height * 0.2)
    return pieces


def _leaflets(rng: np.random.Generator, path: FloatArray, count: int, size: float) -> list[Piece]:
    """Pointed leaves along a path."""
    t = rng.random((count, 1))
    root = path[0] + (path[-1] - path[0]) * t
    out = unit(rng.normal(size=(count, 3)))
    side = unit(np.cross(out, rng.normal(size=(count, 3))))
    tip, middle, wide = root + out * size, root + out * size * 0.5, side * size * 0.22
    a, b = middle + wide, middle - wide
    return [flat("leaves_fine", np.concatenate([np.stack([root, a, tip], 1), np.stack([root, tip, b], 1)]))]


def pot_plant(rng: np.random.Generator, height: float = 1.3) -> list[Piece]:
    """A leafy plant in a wicker pot."""
    pieces = [revolve("wicker", [(0.15, 0), (0.2, 0.32), (0.18, 0.33), (0.17, 0.28), (0, 0.28)], 24)]
    for k in range(11):
        angle = 2.4 * k + 0.3 * rng.normal()
        reach, top = 0.18 + 0.3 * rng.random(), height * (0.55 + 0.45 * rng.random())
        end = np.array([reach * np.cos(angle), reach * np.sin(angle), top])
        path = np.stack([np.array([0, 0, 0.28]), end * (0.35, 0.35, 0.7), end])
        pieces.append(tube("oak", path, (0.010, 0.008, 0.004), 6))
        pieces += _leaflets(rng, path[1:], 16, 0.17)
    return pieces


def globe(radius: float = 0.16) -> list[Piece]:
    """A terrestrial globe on a turned foot."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 15)
    ball = [(radius * float(np.cos(a)), radius * 1.9 + radius * float(np.sin(a))) for a in t]
    foot = [(radius * 0.7, 0), (radius * 0.65, 0.02), (0.02, 0.05), (0.03, radius * 0.6), (0.015, radius * 0.95)]
    return [revolve("globe", ball, 28), revolve("oak", foot, 20)]


def table(size: tuple[float, float, float] = (1.5, 0.85, 0.76)) -> list[Piece]:
    """A plank table with an apron and turned legs."""
    w, d, h = size
    pieces = [box("oak", (-w / 2, -d / 2, h - 0.04), (w / 2, d / 2, h), turned=True)]
    for y in (0.1 - d / 2, d / 2 - 0.1):
        low, high = (-w / 2 + 0.08, y - 0.012, h - 0.14), (w / 2 - 0.08, y + 0.012, h - 0.04)
        pieces.append(box("walnut", low, high, turned=True))
    leg = [(0.03, 0), (0.035, 0.06), (0.025, 0.1), (0.045, 0.3), (0.028, 0.45), (0.045, 0.52), (0.045, h - 0.04)]
    for x in (-w / 2 + 0.1, w / 2 - 0.1):
        for y in (-d / 2 + 0.1, d / 2 - 0.1):
            pieces += placed([revolve("walnut", leg, 14)], (x, y, 0))
    return pieces


def chair() -> list[Piece]:
    """A ladder-back chair with a woven seat; who sits on it looks towards -y."""
    pieces = [box("wicker", (-0.21, -0.2, 0.43), (0.21, 0.2, 0.47))]
    for x in (-0.2, 0.2):
        pieces.append(beam("walnut", (x, -0.19, 0), (x, -0.19, 0.47), 0.038))
        pieces.append(beam("walnut", (x, 0.19, 0), (x, 0.19, 0.5), 0.038))
        pieces.append(beam("walnut", (x, 0.19, 0.5), (x, 0.27, 1.02), 0.036))
        pieces.append(beam("walnut", (x, -0.19, 0.2), (x, 0.19, 0.2), 0.024))
    for z, y in ((0.6, 0.205), (0.74, 0.225), (0.9, 0.252)):
        pieces.append(box("walnut", (-0.2, y, z), (0.2, y + 0.018, z + 0.075), turned=True))
    return [*pieces, beam("walnut", (-0.2, -0.19, 0.28), (0.2, -0.19, 0.28), 0.026)]


def armchair(fabric: str = "fabric_0", width: float = 0.85) -> list[Piece]:
    """An upholstered seat with arms and back; wide ones are sofas, with a seat cushion for each person."""
    w = width / 2
    pieces = [
        cushion(fabric, (width, 0.85, 0.32), (0, 0, 0.1), 9),
        cushion(fabric, (width, 0.24, 0.62), (0, 0.36, 0.32), 6),
    ]
    for side in (-1, 1):
        pieces.append(cushion(fabric, (0.2, 0.86, 0.5), (side * (w + 0.04), 0, 0.12), 6))
        pieces += placed([revolve("walnut", [(0.02, 0), (0.035, 0.14)], 10)], (side * w, -0.36, 0))
        pieces += placed([revolve("walnut", [(0.02, 0), (0.035, 0.14)], 10)], (side * w, 0.36, 0))
    seats = max(1, round(width / 0.75))
    for k in range(seats):
        x = (k - (seats - 1) / 2) * (width - 0.16) / seats
        pieces.append(cushion(fabric, ((width - 0.18) / seats, 0.66, 0.16), (x, -0.08, 0.38), 5))
    throw = leaned([cushion("fabric_1", (0.42, 0.16, 0.42), power=2.6)], -18, 8)
    return pieces + placed(throw, (-w * 0.45, 0.12, 0.5), 12)


def framed(number: int, width: float, height: float, frame: str = "walnut") -> list[Piece]:
    """A picture in a moulded frame on the wall y = 0, centred on the origin."""
    w, h, m = width / 2, height / 2, 0.06
    shown = picture("pictures", [(-w, -0.012, -h), (w, -0.012, -h), (w, -0.012, h), (-w, -0.012, h)])
    outer, hole = rectangle(0, -h - m, width + 2 * m, height + 2 * m), rectangle(0, -h, width, height)
    edge = panel(frame, outer, 0.045, [hole])
    inner = panel("brass", rectangle(0, -h - 0.02, width + 0.04, height + 0.04), 0.03, [hole])
    return [
        sheet_cell(shown, cell_uv(number, PICTURES)),
        *placed([edge], (0, -0.045, 0)),
        *placed([inner], (0, -0.055, 0)),
    ]


def sheet_of_paper(number: int, width: float = 0.21, height: float = 0.297) -> list[Piece]:
    """A printed page that lies on the origin."""
    w, h = width / 2, height / 2
    page = picture("pictures", [(-w, -h, 0.002), (w, -h, 0.002), (w, h, 0.002), (-w, h, 0.002)])
    return [sheet_cell(page, cell_uv(number, PICTURES))]


def floor_lamp(height: float = 1.6) -> list[Piece]:
    """A standing lamp with a pleated cloth shade."""
    stand = [(0.15, 0), (0.14, 0.03), (0.03, 0.05), (0.018, 0.1), (0.018, height - 0.35), (0.0, height - 0.3)]
    shade = [(0.24, height - 0.38), (0.15, height), (0.14, height)]
    return [revolve("brass", stand, 20), revolve("fabric_2", shade, 32)]


def fireplace(rng: np.random.Generator, width: float = 1.5, height: float = 2.7) -> list[Piece]:
    """A brick hearth with chimney breast, mantelshelf, soot-blackened recess, logs, and things on the shelf."""
    d, w = 0.45, width / 2
    opening = rectangle(0, 0.0, 0.8, 0.75)
    pieces = [panel("brick_fine", rectangle(0, 0, width, 1.15), d, [opening])]
    pieces.append(panel("brick_fine", rectangle(0, 1.15, width - 0.2, height - 1.15), d - 0.1))
    pieces[-1:] = placed(pieces[-1:], (0, 0.1, 0))
    pieces += [
        box("soot", (-0.5, d - 0.06, 0), (0.5, d, 0.9)),
        box("stone_fine", (-w - 0.1, -0.4, 0), (w + 0.1, d, 0.06)),
    ]
    pieces.append(box("oak", (-w - 0.1, -0.12, 1.15), (w + 0.1, 0.3, 1.22), turned=True))
    pieces.append(box("stone_fine", (-0.5, -0.03, 0.75), (0.5, 0.1, 0.92)))
    for k in range(7):
        r = 0.045 + 0.02 * rng.random()
        log = leaned([revolve("bark_fine", [(0, 0), (r, 0), (r, 0.5), (0, 0.5)], 10)], 0, 90)
        pieces += placed(log, (-0.25, 0.16 + 0.1 * (k % 3), 0.12 + 0.11 * (k // 3)), float(rng.uniform(-8, 8)))
    for x in (-0.3, 0.3):
        pieces += [
            beam("iron_fine", (x, 0.05, 0.06), (x, 0.4, 0.06), 0.03),
            beam("iron_fine", (x, 0.04, 0.0), (x, 0.04, 0.36), 0.03),
        ]
    pieces += placed(framed(2, 0.62, 0.82), (0, 0.09, 1.85))
    pieces += placed(vase(rng, 0.26, 5), (-0.6, 0.02, 1.22)) + placed(candlestick(), (0.42, 0.0, 1.22))
    pieces += placed(candlestick(0.2), (0.55, 0.05, 1.22)) + placed(globe(0.07), (0.68, -0.02, 1.22))
    clock = [revolve("walnut", [(0.12, 0), (0.12, 0.07), (0.1, 0.09), (0.1, 0.06)], 24)]
    clock += [
        revolve("paper", [(0.1, 0.06), (0, 0.06)], 24),
        box("iron_fine", (-0.006, 0, 0.065), (0.006, 0.08, 0.07)),
    ]
    clock.append(box("iron_fine", (0, -0.006, 0.065), (0.055, 0.006, 0.07)))
    return pieces + placed(leaned(clock, 90), (-0.33, 0.04, 1.34))


def candlestick(height: float = 0.28) -> list[Piece]:
    """A brass candlestick with a candle."""
    line = [
        (0.05, 0),
        (0.045, 0.015),
        (0.012, 0.03),
        (0.016, height * 0.3),
        (0.01, height * 0.5),
        (0.03, height * 0.55),
    ]
    return [
        revolve("brass", line, 16),
        revolve("paper", [(0.012, height * 0.5), (0.012, height), (0, height)], 10),
    ]


def curtain(width: float, height: float, surface: str = "fabric_3") -> list[Piece]:
    """A hanging curtain in deep folds on the plane y = 0, its top at z = ``height``."""
    x, z = np.meshgrid(np.linspace(-width / 2, width / 2, 61), np.linspace(0, height, 9))
    fold = 0.045 * np.sin(x / width * 2 * np.pi * 6.5) + 0.02 * np.sin(x * 9 + z)
    points = np.stack([x * (1 - 0.1 * np.sin(z / height * np.pi)), fold, z], axis=-1)
    return [grid(surface, points, np.stack([x * 1.6, z], axis=-1))]


def fruit_bowl(rng: np.random.Generator) -> list[Piece]:
    """A glazed bowl of apples and oranges."""
    pieces = [
        revolve("ceramic", [(0.07, 0), (0.06, 0.02), (0.15, 0.09), (0.145, 0.09), (0.05, 0.03), (0, 0.03)], 28)
    ]
    for k in range(8):
        angle, r = 2.4 * k, 0.075 * (k > 1)
        at = (r * float(np.cos(angle)), r * float(np.sin(angle)), 0.075 + 0.05 * (k < 2))
        pieces += placed([lump(f"fruit_{k % 3}", rng, (0.042, 0.042, 0.038), 0.03, 2)], at)
    return pieces
