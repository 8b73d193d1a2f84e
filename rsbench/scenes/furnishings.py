"""Painted things of a room: book spines, pictures, a rug, a map. Each fits its part and does not repeat.

``SPINES`` and ``PICTURES`` are sheets of several: ``cell_uv`` finds one.
"""

from __future__ import annotations

import numpy as np

from rsbench.scenes.model import FloatArray
from rsbench.scenes.surfaces import Bytes, Painter
from rsbench.scenes.textures import Colour, Field, blend, pick, plain, ramp, to_bytes, value_noise

SPINES = (32, 4)
"""Columns and rows of the sheet of book spines."""
PICTURES = (4, 2)
"""Columns and rows of the sheet of pictures; the last two are printed pages."""
CARTONS = (2, 2)
"""Columns and rows of the sheet of cartons; the last cell is a label alone."""

_LEATHERS: tuple[Colour, ...] = (
    (0.42, 0.15, 0.12), (0.16, 0.27, 0.20), (0.18, 0.22, 0.38), (0.52, 0.38, 0.22), (0.30, 0.20, 0.14),
    (0.66, 0.58, 0.42), (0.36, 0.12, 0.22), (0.20, 0.32, 0.36), (0.72, 0.68, 0.58), (0.55, 0.28, 0.12),
)  # fmt: skip
_GOLD: Colour = (0.78, 0.66, 0.36)


def cell_uv(number: int, sheet: tuple[int, int]) -> FloatArray:
    """Lower left and upper right texture coordinates (2, 2) of one cell of a sheet, a little inside its border."""
    column, row = number % sheet[0], number // sheet[0] % sheet[1]
    low = np.array([(column + 0.02) / sheet[0], (row + 0.01) / sheet[1]])
    return np.stack([low, low + np.array([0.96 / sheet[0], 0.98 / sheet[1]])])


def spines(paint: Painter) -> Bytes:
    """A sheet of book spines: worn cloth or leather, raised bands, a label, lines of gilt letters."""
    wide, high = paint.pixels // SPINES[0], paint.pixels // SPINES[1]
    rows = [
        np.concatenate([_spine(paint.rng, wide, high) for _ in range(SPINES[0])], axis=2) for _ in range(SPINES[1])
    ]
    image = np.concatenate(rows, axis=1)
    return to_bytes(image * (1 + 0.12 * paint.broad() + 0.10 * paint.fine()))


def _spine(rng: np.random.Generator, wide: int, high: int) -> Field:
    tone = 0.8 + 0.4 * rng.random()
    round_back: Field = 1 - np.float32(0.35) * np.square(np.linspace(-1, 1, wide, dtype=np.float32))
    image = plain(_LEATHERS[int(rng.integers(len(_LEATHERS)))], np.tile(round_back, (high, 1)))
    image = image * np.float32(tone)
    accent = _GOLD if rng.random() < 0.7 else _LEATHERS[int(rng.integers(len(_LEATHERS)))]
    if rng.random() < 0.6:
        low = int(high * rng.uniform(0.12, 0.3))
        label = plain(_LEATHERS[int(rng.integers(len(_LEATHERS)))], np.ones((high, wide), np.float32))
        inside = _rows(high, low, low + high // 6)[:, None] * np.ones((1, wide), np.float32)
        image = blend(image, label, inside)
    for k in range(int(rng.integers(2, 6))):
        y = int(high * (0.06 + 0.85 * rng.random() if k else 0.06))
        band = _rows(high, y, y + int(rng.integers(2, 6)))[:, None] * np.ones((1, wide), np.float32)
        image = blend(image, accent, 0.8 * band)
    # Letters: random blots in lines across the middle of the spine.
    start, length = int(high * rng.uniform(0.1, 0.35)), int(high * rng.uniform(0.2, 0.45))
    blots = rng.random((high // 3 + 1, wide // 3 + 1)) < 0.5
    letters = np.kron(blots, np.ones((3, 3)))[:high, :wide].astype(np.float32)
    across = ramp(np.abs(np.linspace(-1, 1, wide, dtype=np.float32)), 0.55, 0.45)
    return blend(image, accent, 0.85 * letters * across * _rows(high, start, start + length)[:, None])


def _rows(high: int, start: int, end: int) -> Field:
    rows = np.zeros(high, np.float32)
    rows[start:end] = 1
    return rows


def pictures(paint: Painter) -> Bytes:
    """A sheet of landscapes in oil and, in its last two cells, printed pages."""
    size = (paint.pixels // PICTURES[1], paint.pixels // PICTURES[0])
    cells = [_landscape(paint.rng, size) for _ in range(PICTURES[0] * PICTURES[1] - 2)]
    cells += [_page(paint.rng, size) for _ in range(2)]
    # Row 0 of the image is the top, cell 0 at the bottom.
    rows = [np.concatenate(cells[k * PICTURES[0] : (k + 1) * PICTURES[0]], axis=2) for k in range(PICTURES[1])]
    image = np.concatenate(rows[::-1], axis=1)
    return to_bytes(image * (1 + 0.10 * paint.fine() + 0.08 * paint.broad()))


def _landscape(rng: np.random.Generator, size: tuple[int, int]) -> Field:
    """Sky with clouds, ridges that darken towards the viewer, and a flowering foreground."""
    height = np.linspace(1, 0, size[0], dtype=np.float32)[:, None] * np.ones((1, size[1]), np.float32)
    clouds = value_noise(rng, size, (7, 4)) + 0.6 * value_noise(rng, size, (24, 13))
    image = blend(plain((0.45, 0.58, 0.72), 0.8 + 0.3 * height), (0.92, 0.86, 0.74), ramp(clouds, 0.0, 0.9))
    for k in range(5):
        crest = 0.72 - 0.13 * k + 0.09 * value_noise(rng, (1, size[1]), (1, 4 + 2 * k))
        crest = crest + 0.03 * value_noise(rng, (1, size[1]), (1, 40))
        hues: tuple[Colour, ...] = ((0.45, 0.52, 0.58), (0.30, 0.40, 0.30), (0.48, 0.46, 0.22), (0.22, 0.28, 0.14))
        colour = pick(hues, np.array([(k + rng.random()) / 6], np.float32))[:, 0]
        dabs = 1 + 0.35 * value_noise(rng, size, (60, 40)) + 0.3 * value_noise(rng, size, (160, 110))
        land = plain((float(colour[0]), float(colour[1]), float(colour[2])), dabs)
        image = blend(image, land, ramp(crest - height, -0.004, 0.004))
    flowers = ramp(value_noise(rng, size, (130, 80)), 0.55, 0.7) * ramp(height, 0.3, 0.1)
    return blend(image, (0.80, 0.35, 0.25), flowers)


def _page(rng: np.random.Generator, size: tuple[int, int]) -> Field:
    """Lines of print with a headline and two columns."""
    image = plain((0.86, 0.82, 0.72), 1 + 0.08 * value_noise(rng, size, (6, 6)))
    words = (rng.random((64, size[1] // 4 + 1)) < 0.62).astype(np.float32)
    ink = np.kron(words, np.ones((size[0] // 64, 4), np.float32))[: size[0], : size[1]]
    lines = (np.arange(size[0]) % (size[0] // 64) < size[0] // 128 + 1).astype(np.float32)[:, None]
    x = np.linspace(0, 1, size[1], dtype=np.float32)
    columns = ((x > 0.07) & (x < 0.93) & (np.abs(x - 0.5) > 0.03)).astype(np.float32)
    ink = ink[: len(lines)] * lines * columns
    ink[: size[0] // 12] = 0
    return blend(image, (0.12, 0.11, 0.10), 0.85 * ink)


def cartons(paint: Painter) -> Bytes:
    """A sheet of what is printed on cartons: tape, a mark, signs, a label with a bar code; and the label alone."""
    n = paint.pixels // 2
    browns: tuple[Colour, ...] = ((0.62, 0.47, 0.31), (0.70, 0.56, 0.40), (0.55, 0.43, 0.30))
    inks: tuple[Colour, ...] = ((0.16, 0.20, 0.36), (0.50, 0.14, 0.12), (0.13, 0.12, 0.11))
    cells = [_carton(paint.rng, n, brown, ink) for brown, ink in zip(browns, inks, strict=True)]
    cells.append(_label(paint.rng, n, n))
    image = np.concatenate([np.concatenate(cells[:2], axis=2), np.concatenate(cells[2:], axis=2)][::-1], axis=1)
    return to_bytes(image * (1 + 0.05 * paint.fine() + 0.05 * paint.broad()))


def _carton(rng: np.random.Generator, n: int, brown: Colour, ink: Colour) -> Field:
    """One print (3, n, n): tape across, blocks of letters, three signs, a label."""
    image = plain(brown, np.ones((n, n), np.float32))
    image[:, :, int(0.46 * n) : int(0.54 * n)] *= np.float32(1.15)  # tape
    colour = np.asarray(ink, np.float32)[:, None, None]
    mark = np.kron(rng.random((5, 9)) < 0.55, np.ones((n // 40, n // 40))).astype(bool)
    at = (int(0.12 * n), int(0.08 * n))
    image[:, at[0] : at[0] + mark.shape[0], at[1] : at[1] + mark.shape[1]][:, mark] = colour[:, 0]
    for k in range(3):
        sign = np.kron(rng.random((6, 3)) < 0.5, np.ones((n // 50, n // 50)))
        sign = np.concatenate([sign, sign[:, ::-1]], axis=1).astype(bool)
        x, y = int((0.08 + 0.16 * k) * n), int(0.8 * n)
        image[:, y : y + sign.shape[0], x : x + sign.shape[1]][:, sign] = colour[:, 0]
    high, wide = int(0.24 * n), int(0.34 * n)
    y, x = int(rng.uniform(0.1, 0.45) * n), int(rng.uniform(0.58, 0.62) * n)
    image[:, y : y + high, x : x + wide] = _label(rng, high, wide)
    return image


def _label(rng: np.random.Generator, high: int, wide: int) -> Field:
    """White paper with a bar code below lines of print."""
    image = plain((0.88, 0.87, 0.84), np.ones((high, wide), np.float32))
    dot = max(2, wide // 80)
    bars = np.repeat(rng.random(wide // dot + 1) < 0.5, dot)[: int(0.84 * wide)]
    image[:, int(0.58 * high) : int(0.9 * high), int(0.08 * wide) : int(0.08 * wide) + len(bars)][:, :, bars] = 0.1
    for line in range(4):
        y, long = int((0.1 + 0.11 * line) * high), int(rng.uniform(0.4, 0.84) * wide)
        print_ = np.repeat(rng.random(long // dot + 1) < 0.65, dot)[:long]
        image[:, y : y + int(0.06 * high), int(0.08 * wide) : int(0.08 * wide) + long][:, :, print_] = 0.15
    return image


def rug(paint: Painter) -> Bytes:
    """A knotted carpet: nested borders, and medallions that a weaver drew by hand, each another."""
    n = paint.pixels
    t = np.abs(np.linspace(-1, 1, n, dtype=np.float32))
    bend = 0.012 * paint.broad()
    inset = 1 - np.maximum(t[:, None], t[None, :]) + bend
    colours: tuple[Colour, ...] = ((0.45, 0.13, 0.12), (0.16, 0.20, 0.34), (0.70, 0.58, 0.40), (0.30, 0.34, 0.22))
    image = plain(colours[0], np.ones((n, n), np.float32))
    for k, (start, end) in enumerate(((0.02, 0.06), (0.07, 0.20), (0.215, 0.24))):
        image = blend(
            image,
            colours[(k + 1) % 3 + (k == 2)],
            ramp(inset, start, start + 0.004) * ramp(inset, end + 0.004, end),
        )
    for count, size, colour in ((26, 0.045, 2), (60, 0.03, 1), (70, 0.02, 2), (40, 0.035, 3)):
        image = blend(image, colours[colour], _motifs(paint, count, size))
    pile = 1 + 0.14 * paint.fine() + 0.12 * paint.broad()
    weave = 1 - 0.1 * (np.arange(n) % 4 < 1).astype(np.float32)[:, None]
    return to_bytes(image * pile * weave)


def _motifs(paint: Painter, count: int, size: float) -> Field:
    """Stars, lozenges and hooks with fourfold symmetry, each of a random grid of knots."""
    n = paint.pixels
    sheet = np.zeros((n, n), np.float32)
    for _ in range(count):
        quarter = paint.rng.random((5, 5)) < 0.5
        half = np.concatenate([quarter, quarter[:, ::-1]], axis=1)
        star = np.concatenate([half, half[::-1]])
        cell = max(2, int(n * size * 2 / 10))
        stamp = np.kron(star, np.ones((cell, cell))).astype(np.float32)
        y, x = paint.rng.integers(0, n - len(stamp), 2)
        region = sheet[y : y + len(stamp), x : x + len(stamp)]
        np.maximum(region, stamp, out=region)
    return sheet


def world_map(paint: Painter) -> Bytes:
    """Land and sea for a globe, with ink lines of latitude and longitude."""
    land = paint.smooth() + 0.3 * paint.broad()
    image = plain((0.36, 0.52, 0.56), 1 + 0.1 * paint.fine())
    image = blend(image, (0.72, 0.62, 0.40), ramp(land, 0.05, 0.08))
    image = blend(image, (0.48, 0.46, 0.26), ramp(land, 0.5, 0.9))
    ink = ramp(np.abs(land - 0.065), 0.04, 0.015)
    step = np.arange(paint.pixels) % (paint.pixels // 12) < 3
    return to_bytes(
        blend(image, (0.2, 0.14, 0.1), np.maximum(0.8 * ink, 0.5 * np.maximum(step[:, None], step[None, :])))
    )
