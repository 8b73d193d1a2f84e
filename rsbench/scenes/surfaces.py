"""Painted surfaces: stone, brick, tiles, wood, plaster, ground, leaves, cloth, books and pictures, by name.

Textures are painted from noise and cell patterns: seeded, periodic in both directions, float32. Everything is
built from additions, products and table look-ups, whose results IEEE 754 fixes, so that the same seed gives the
same bytes on every machine. Row 0 is the top of a texture. Images are float32, channels first (3, h, w), because
that is twice as fast to paint; ``to_bytes`` turns them around.

Every painter returns sRGB bytes (h, w, 3) that repeat in both directions unless its docstring says otherwise;
painters of book spines, pictures, a rug or a map fit their part and do not repeat. ``SPINES`` and ``PICTURES`` are
sheets of several: ``cell_uv`` finds one. Colours vary from stone to stone and stain at several scales, so that a
feature detector finds distinct points everywhere. ``paint_palette`` paints surfaces by name.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rsbench.scenes.model import FloatArray, Material

Field = NDArray[np.floating]  # float32, which NumPy's annotations of + and * do not tell
_FINENESS = 4  # steps per pixel of the look-up tables of borders

Colour = tuple[float, float, float]
NoiseKind = Literal["broad", "smooth", "fine", "grain"]


def value_noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]) -> Field:
    """Smoothly interpolated random lattice, (h, w) in [-1, 1], periodic, with ``cells`` lattice cells (y, x)."""
    lattice: Field = rng.random(cells, dtype=np.float32) * np.float32(2) - np.float32(1)
    rows, row_weight = _lattice_positions(shape[0], cells[0])
    columns, column_weight = _lattice_positions(shape[1], cells[1])
    below = lattice[(rows + 1) % cells[0]]
    strip = lattice[rows] + (below - lattice[rows]) * row_weight[:, None]
    left = strip.take(columns, axis=1)
    right = strip.take((columns + 1) % cells[1], axis=1)
    blended: Field = left + (right - left) * column_weight
    return blended


def fractal_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int], octaves: int, gain: float
) -> Field:
    """Octaves of value noise from ``cells`` upward, each twice as fine and ``gain`` times as strong.

    The sum is scaled to a standard deviation near 0.5, whatever the number of octaves.
    """
    total = np.zeros(shape, dtype=np.float32)
    for octave in range(octaves):
        fineness = (min(cells[0] << octave, shape[0]), min(cells[1] << octave, shape[1]))
        total += value_noise(rng, shape, fineness) * np.float32(gain**octave)
    # One octave's standard deviation: a uniform variable's 1/sqrt(3), times the smoothing of the interpolation.
    norm = 0.43 * sum(gain ** (2 * octave) for octave in range(octaves)) ** 0.5
    return total * np.float32(0.5 / norm)


class Noise:
    """Four noise fields made once and drawn again at random offsets, because noise is most of a texture's cost.

    ``broad`` has detail at every scale, ``smooth`` are patches, ``fine`` is grit, ``grain`` runs along columns.
    """

    def __init__(self, seed: Sequence[int], pixels: int = 1024) -> None:
        rng = np.random.default_rng(seed)
        shape = (pixels, pixels)
        self.pixels = pixels
        self._fields: dict[NoiseKind, Field] = {
            "broad": fractal_noise(rng, shape, (5, 5), 8, 0.72),
            "smooth": fractal_noise(rng, shape, (3, 3), 5, 0.55),
            "fine": fractal_noise(rng, shape, (pixels // 16, pixels // 16), 4, 0.85),
            "grain": fractal_noise(rng, shape, (6, pixels // 16), 4, 0.8),
        }

    def draw(self, rng: np.random.Generator, kind: NoiseKind, pixels: int | None = None) -> Field:
        """A field at a random offset and mirroring, (pixels, pixels), a multiple or part of the stored size."""
        field = self._fields[kind]
        if rng.random() < 0.5:
            field = field[:, ::-1]
        if rng.random() < 0.5:
            field = field[::-1]
        shift_y, shift_x = rng.integers(0, self.pixels, 2)
        field = np.roll(field, (int(shift_y), int(shift_x)), (0, 1))
        pixels = self.pixels if pixels is None else pixels
        step, repeats = max(1, self.pixels // pixels), max(1, pixels // self.pixels)
        return np.tile(field[::step, ::step], (repeats, repeats))


@dataclass(frozen=True, kw_only=True)
class Cells:
    """A texture cut into courses of blocks; all fields (h, w)."""

    index: NDArray[np.intp]
    """Which block."""
    course: NDArray[np.intp]
    """Which course, from the top."""
    edge: Field
    """Distance to the block's border, metres."""
    across: Field
    """Position in the course from its top to its bottom, 0 to 1."""
    count: int


def cut_courses(
    rng: np.random.Generator,
    pixels: int,
    metres: float,
    course: tuple[float, float],
    block: tuple[float, float],
    *,
    corner: float = 0.0,
    wobble: tuple[Field, Field] | None = None,
) -> Cells:
    """Courses of blocks as masons, tilers and joiners lay them, periodic in both directions.

    Args:
        rng: draws the sizes.
        pixels: side of the square texture.
        metres: length of its side.
        course: least and greatest height of a course, metres.
        block: least and greatest length of a block, metres.
        corner: radius of the rounding of the blocks, metres.
        wobble: displacements (y, x) of the borders in metres, each (pixels, pixels).
    """
    scale = pixels / metres
    grid = np.arange(pixels, dtype=np.float32)
    dy, dx = (0.0, 0.0) if wobble is None else (wobble[0] * np.float32(scale), wobble[1] * np.float32(scale))
    y = _wrapped(grid[:, None] + dy + np.zeros((1, pixels), np.float32), pixels)
    tops = _cuts(rng, metres, course) * np.float32(scale)
    row = _lookup([tops], pixels)[0][(y * _FINENESS).astype(np.intp)]

    cuts = [_cuts(rng, metres, block) * np.float32(scale) for _ in range(len(tops) - 1)]
    start = rng.random(len(cuts), dtype=np.float32) * np.float32(pixels)
    x = _wrapped(grid[None, :] + dx - start[row], pixels)
    index = _lookup(cuts, pixels).ravel()[row * (_FINENESS * pixels + 1) + (x * _FINENESS).astype(np.intp)]
    left = np.concatenate([cut[:-1] for cut in cuts])
    right = np.concatenate([cut[1:] for cut in cuts])
    from_left, to_right = x - left[index], right[index] - x
    from_top, to_bottom = y - tops[row], tops[row + 1] - y
    edge = _rounded(np.minimum(from_left, to_right), np.minimum(from_top, to_bottom), corner * scale)
    return Cells(
        index=index,
        course=row,
        edge=np.maximum(edge, 0) * np.float32(1 / scale),  # the look-up puts borders up to a quarter pixel off
        across=from_top / (from_top + to_bottom),
        count=len(left),
    )


def plain(colour: Colour, weight: Field) -> Field:
    """One colour brightened by ``weight`` (h, w), as an image."""
    return np.asarray(colour, dtype=np.float32)[:, None, None] * weight


def blend(image: Field, over: Colour | Field, weight: Field) -> Field:
    """Image (3, h, w) with a colour or image laid on it at ``weight`` (h, w) in [0, 1]."""
    top = np.asarray(over, dtype=np.float32)
    top = top[:, None, None] if top.ndim == 1 else top
    change: Field = top - image
    change *= weight  # in place: fresh memory costs more than arithmetic
    change += image
    return change


def ramp(value: Field, start: float, end: float) -> Field:
    """0 below ``start``, 1 above ``end``, smooth between (a falling ramp when ``end < start``)."""
    t: Field = value - np.float32(start)
    t *= np.float32(1 / (end - start))
    np.clip(t, 0, 1, out=t)
    slope = np.float32(3) - np.float32(2) * t
    t *= t
    t *= slope
    return t


def pick(colours: Sequence[Colour], tone: Field) -> Field:
    """Colours (3, n) of a list at ``tone`` (n,) in [0, 1], mixed from the two neighbours of that place in it."""
    table = np.asarray(colours, dtype=np.float32)
    position = tone * np.float32(len(table) - 1)
    low = np.minimum(position.astype(np.intp), len(table) - 1)
    high = np.minimum(low + 1, len(table) - 1)
    return (table[low] + (table[high] - table[low]) * (position - low.astype(np.float32))[:, None]).T


def to_bytes(image: Field) -> NDArray[np.uint8]:
    """sRGB image (3, h, w) in [0, 1] as bytes (h, w, 3), kept off black and white, which nothing outdoors is."""
    levels = np.clip(image, 0.03, 0.95)
    levels *= np.float32(255)
    levels += np.float32(0.5)
    return np.ascontiguousarray(levels.astype(np.uint8).transpose(1, 2, 0))


def _lattice_positions(size: int, cells: int) -> tuple[NDArray[np.intp], Field]:
    position = (np.arange(size, dtype=np.float32) + np.float32(0.5)) * np.float32(cells / size)
    index = position.astype(np.intp)
    t = position - index.astype(np.float32)
    return index % cells, (t * t * (np.float32(3) - np.float32(2) * t)).astype(np.float32)


def _wrapped(position: Field, size: int) -> Field:
    """Positions brought into [0, size] by whole periods."""
    wrapped: Field = position - np.floor(position * np.float32(1 / size)) * np.float32(size)
    return np.clip(wrapped, 0, size)


def _lookup(cuts: Sequence[Field], pixels: int) -> NDArray[np.intp]:
    """Return the interval number, counted over all lists of cuts, at quarter pixels: (lists, 4 pixels + 1)."""
    positions = np.arange(_FINENESS * pixels + 1) / _FINENESS
    first = np.cumsum([0, *(len(cut) - 1 for cut in cuts[:-1])])
    inside = [np.searchsorted(cut[1:-1], positions, side="right") for cut in cuts]
    return np.stack(inside) + first[:, None]


def _cuts(rng: np.random.Generator, length: float, step: tuple[float, float]) -> Field:
    """Positions from 0 to ``length`` whose spacings are drawn from ``step`` and then fitted to the length."""
    count = max(2, round(2 * length / (step[0] + step[1])))
    spacing = rng.uniform(step[0], step[1], count)
    cuts = np.concatenate([[0.0], np.cumsum(spacing)])
    return (cuts * (length / cuts[-1])).astype(np.float32)


def _rounded(dx: Field, dy: Field, radius: float) -> Field:
    if radius <= 0:
        return np.minimum(dx, dy)
    r = np.float32(radius)
    corner = np.sqrt(np.square(np.maximum(r - dx, 0)) + np.square(np.maximum(r - dy, 0)))
    return np.where((dx < r) | (dy < r), r - corner, np.minimum(dx, dy)).astype(np.float32)


Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Surface:
    """A material and the width and height in metres that one repeat of its texture covers.

    ``repeat`` None: the texture fits its part exactly, whose coordinates already run from 0 to 1.
    """

    material: Material
    repeat: tuple[float, float] | None


@dataclass(frozen=True)
class Painter:
    """A random stream, the shared noise, and the size of the textures to paint."""

    rng: np.random.Generator
    noise: Noise
    metres: float
    pixels: int = 1024

    def broad(self) -> Field:
        return self.noise.draw(self.rng, "broad", self.pixels)

    def smooth(self) -> Field:
        return self.noise.draw(self.rng, "smooth", self.pixels)

    def fine(self) -> Field:
        return self.noise.draw(self.rng, "fine", self.pixels)

    def grain(self) -> Field:
        return self.noise.draw(self.rng, "grain", self.pixels)

    def per_cell(self, cells: Cells) -> Field:
        """One uniform number in [0, 1] for each cell, looked up at every pixel."""
        return self.rng.random(cells.count, dtype=np.float32)[cells.index]


def ashlar(
    paint: Painter,
    stones: Sequence[Colour],
    mortar: Colour = (0.50, 0.47, 0.42),
    course: tuple[float, float] = (0.24, 0.42),
    block: tuple[float, float] = (0.35, 0.85),
    moss: float = 0.35,
) -> Bytes:
    """Dressed stone in courses of uneven height, weathered, with streaks and moss."""
    wobble = (paint.broad() * 0.008, paint.broad() * 0.012)
    cells = cut_courses(paint.rng, paint.pixels, paint.metres, course, block, corner=0.05, wobble=wobble)
    image = _stone_colours(paint, cells, stones)
    image = image * (1 + 0.17 * paint.broad() + 0.10 * paint.fine() + 0.10 * (0.5 - cells.across))
    image = image * (0.62 + 0.38 * ramp(cells.edge, 0.0, 0.035))
    image = blend(image, mortar, ramp(cells.edge + 0.006 * paint.fine(), 0.014, 0.004) * 0.85)
    image = blend(image, (0.30, 0.36, 0.20), ramp(paint.broad() - 0.3 * cells.edge, 1 - moss, 1.6 - moss) * 0.7)
    return to_bytes(image * (1 - 0.22 * ramp(paint.grain() + paint.smooth(), 0.2, 1.4)))


def brick(paint: Painter, bricks: Sequence[Colour], mortar: Colour = (0.62, 0.58, 0.52)) -> Bytes:
    """Fired bricks in running bond with patches of soot and lime."""
    wobble = (paint.broad() * 0.004, paint.broad() * 0.006)
    cells = cut_courses(
        paint.rng, paint.pixels, paint.metres, (0.075, 0.085), (0.2, 0.26), corner=0.012, wobble=wobble
    )
    image = _stone_colours(paint, cells, bricks)
    image = image * (1 + 0.16 * paint.broad() + 0.12 * paint.fine())
    image = blend(image, mortar, ramp(cells.edge, 0.011, 0.004) * 0.8)
    image = blend(image, (0.75, 0.72, 0.66), ramp(paint.broad(), 0.75, 1.5) * 0.6)
    return to_bytes(blend(image, (0.16, 0.13, 0.12), ramp(paint.smooth() + 0.3 * paint.broad(), 0.5, 1.4) * 0.5))


def cobbles(paint: Painter, stones: Sequence[Colour], joint: Colour = (0.20, 0.18, 0.15)) -> Bytes:
    """Rounded setts in wavering rows, with sand and moss in the joints and worn, stained patches."""
    wobble = (paint.smooth() * 0.12 + paint.broad() * 0.012, paint.broad() * 0.02)
    cells = cut_courses(
        paint.rng, paint.pixels, paint.metres, (0.13, 0.2), (0.13, 0.28), corner=0.06, wobble=wobble
    )
    image = _stone_colours(paint, cells, stones)
    image = image * (1 + 0.16 * paint.broad() + 0.10 * paint.fine())
    image = image * (0.55 + 0.45 * ramp(cells.edge, 0.0, 0.05))
    image = blend(image, joint, ramp(cells.edge + 0.006 * paint.fine(), 0.018, 0.004))
    image = blend(image, (0.31, 0.35, 0.18), ramp(paint.broad() - 12 * cells.edge, 0.1, 0.9) * 0.7)
    image = blend(image, (0.42, 0.36, 0.28), ramp(paint.smooth() + 0.5 * paint.broad(), 0.55, 1.4) * 0.65)
    return to_bytes(image * (1 + 0.16 * paint.smooth()))


def roof_tiles(
    paint: Painter,
    tiles: Sequence[Colour],
    course: tuple[float, float] = (0.20, 0.22),
    width: tuple[float, float] = (0.17, 0.21),
) -> Bytes:
    """Overlapping tiles or slates: each row casts a shadow on the next; lichen, replaced tiles and streaks."""
    wobble = (paint.broad() * 0.008, paint.broad() * 0.006)
    cells = cut_courses(paint.rng, paint.pixels, paint.metres, course, width, corner=0.03, wobble=wobble)
    image = _stone_colours(paint, cells, tiles)
    image = image * (1 + 0.14 * paint.broad() + 0.10 * paint.fine())
    image = image * ((0.6 + 0.4 * ramp(cells.across, 0.0, 0.3)) * (0.7 + 0.3 * ramp(cells.edge, 0.0, 0.02)))
    lichen = ramp(paint.broad() + 0.3 * paint.fine(), 0.65, 1.3) * 0.75
    image = blend(image, (0.62, 0.60, 0.42), lichen)
    return to_bytes(blend(image, (0.16, 0.15, 0.13), ramp(paint.smooth() + paint.grain(), 0.5, 1.6) * 0.5))


def planks(paint: Painter, woods: Sequence[Colour], width: tuple[float, float] = (0.12, 0.2)) -> Bytes:
    """Boards that run up the texture, with grain, knots, gaps and wear."""
    wobble = (paint.broad().T * 0.004, paint.grain().T * 0.002)
    cells = cut_courses(paint.rng, paint.pixels, paint.metres, width, (1.2, 2.6), wobble=wobble)
    image = _stone_colours(paint, cells, woods).swapaxes(1, 2)
    edge = cells.edge.T
    grain = paint.grain()
    image = image * (1 + 0.26 * grain + 0.13 * paint.broad() + 0.07 * paint.fine())
    image = blend(image, (0.16, 0.11, 0.07), ramp(paint.broad() + 0.4 * grain, 0.85, 1.25) * 0.8)
    image = image * (0.25 + 0.75 * ramp(edge, 0.0, 0.010))
    return to_bytes(image * (1 - 0.2 * ramp(paint.smooth(), 0.1, 1.0)))


def timber(paint: Painter, wood: Colour) -> Bytes:
    """Solid wood whose grain runs up the texture, with cracks."""
    grain = paint.grain()
    image = plain(wood, 1 + 0.3 * grain + 0.2 * paint.broad())
    image = blend(image, (0.07, 0.05, 0.04), ramp(paint.grain() + 0.5 * paint.fine(), 0.9, 1.5))
    return to_bytes(image * (1 + 0.12 * paint.fine()))


def plaster(paint: Painter, wall: Colour, under: Colour, worn: float = 0.25) -> Bytes:
    """Lime plaster: trowel marks, rain streaks, dirt, hair cracks, and patches where it fell off the wall."""
    broad, smooth = paint.broad(), paint.smooth()
    image = plain(wall, 1 + 0.10 * broad + 0.07 * paint.fine())
    image = image * (1 - 0.2 * ramp(paint.grain() + 0.6 * paint.smooth(), 0.1, 1.3))
    image = blend(image, (0.38, 0.33, 0.27), ramp(paint.broad() + smooth, 0.7, 1.9) * 0.55)
    for _ in range(2):
        crack = np.abs(paint.smooth() + 0.12 * paint.broad())
        image = image * (1 - 0.5 * ramp(crack, 0.012, 0.004) * ramp(paint.smooth(), 0.0, 0.4))
    fallen = ramp(smooth + 0.25 * paint.broad(), 1.25 - worn, 1.32 - worn)
    rough = plain(under, 0.95 + 0.3 * paint.broad() + 0.15 * paint.fine())
    rim = ramp(smooth + 0.25 * broad, 1.12 - worn, 1.25 - worn)
    return to_bytes(blend(image * (1 - 0.12 * rim), rough, fallen))


def speckled(
    paint: Painter, colours: Sequence[Colour], contrast: float = 0.3, grit: float = 0.2, patches: float = 1.0
) -> Bytes:
    """Ground, grass, hay, soil or rough stone: colours mixed in patches at several scales."""
    image = plain(colours[0], np.ones((paint.pixels, paint.pixels), np.float32))
    for colour in colours[1:]:
        patchy = patches * paint.smooth() + 0.6 * paint.broad() + 0.3 * paint.fine()
        image = blend(image, colour, ramp(patchy, -0.2, 0.8))
    return to_bytes(image * (1 + contrast * paint.broad() + grit * paint.fine()))


def leaves(paint: Painter, greens: Sequence[Colour], size: float = 0.11, depth: float = 0.35) -> Bytes:
    """Foliage or a printed pattern: layers of leaf-sized patches, the lowest at ``depth`` of their brightness."""
    image = plain(greens[0], np.full((paint.pixels, paint.pixels), depth, np.float32))
    for layer in range(4):
        wobble = (paint.broad() * size * 0.35, paint.broad() * size * 0.35)
        cells = cut_courses(
            paint.rng, paint.pixels, paint.metres, (size * 0.6, size * 1.2), (size * 0.7, size * 1.9),
            corner=size * 0.45, wobble=wobble,
        )  # fmt: skip
        tones = pick(greens, paint.rng.random(cells.count, dtype=np.float32))
        tones = tones * np.float32(depth + (1.0 - depth) * (layer + 1) / 4)
        colour = tones[:, cells.index] * (0.7 + 0.5 * cells.across + 0.2 * paint.fine())
        shown = ramp(cells.edge, 0.004, 0.012) * (paint.per_cell(cells) < 0.5)
        image = blend(image, colour, shown)
    return to_bytes(image)


def cloth(paint: Painter, stripes: Sequence[Colour], width: float = 0.3) -> Bytes:
    """Woven cloth with stripes up the texture, folds and stains."""
    cells = cut_courses(paint.rng, paint.pixels, paint.metres, (width * 0.8, width * 1.2), (90.0, 100.0))
    image = np.asarray(stripes, dtype=np.float32).T[:, cells.course.T % len(stripes)]
    image = image * (1 + 0.13 * paint.grain() + 0.10 * paint.fine() + 0.10 * paint.broad())
    return to_bytes(blend(image, (0.3, 0.25, 0.2), ramp(paint.smooth() + paint.broad(), 0.8, 2.0) * 0.6))


def glass(paint: Painter) -> Bytes:
    """Small panes seen from outside: dark, with mirrored sky and curtains, divided by thin bars."""
    cells = cut_courses(paint.rng, paint.pixels, paint.metres, (0.22, 0.26), (0.17, 0.2))
    tone = paint.per_cell(cells) * 0.5 + ramp(paint.smooth() + 0.4 * paint.broad(), -0.3, 0.8) * 0.8
    image = plain((0.09, 0.11, 0.13), np.ones_like(tone))
    image = blend(image, (0.50, 0.58, 0.64), np.clip(tone * 0.7, 0, 1))
    image = image * (1 + 0.25 * paint.broad() + 0.10 * paint.fine())
    return to_bytes(blend(image, (0.24, 0.20, 0.15), ramp(cells.edge, 0.014, 0.008)))


def _stone_colours(paint: Painter, cells: Cells, stones: Sequence[Colour]) -> Field:
    """Image of the cells, each of a colour between two neighbours of the list and of a brightness of its own."""
    tone, brightness = paint.rng.random((2, cells.count), dtype=np.float32)
    return (pick(stones, tone) * (np.float32(0.78) + np.float32(0.44) * brightness))[:, cells.index]


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
        border = ramp(inset, start, start + 0.004) * ramp(inset, end + 0.004, end)
        image = blend(image, colours[(k + 1) % 3 + (k == 2)], border)
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
    lines = np.maximum(step[:, None], step[None, :])
    return to_bytes(blend(image, (0.2, 0.14, 0.1), np.maximum(0.8 * ink, 0.5 * lines)))


@dataclass(frozen=True)
class Recipe:
    """How a surface is painted."""

    paint: Callable[[Painter], Bytes]
    metres: float | None
    """Length that one repeat of the texture covers; None: the texture fits its part exactly."""
    pixels: int
    roughness: float | None
    """Roughness of a glossy surface, as in ``Material``."""


def _recipe(
    paint: Callable[..., Bytes],
    metres: float | None = 8.0,
    pixels: int = 1024,
    roughness: float | None = None,
    **settings: Any,
) -> Recipe:
    return Recipe(partial(paint, **settings), metres, pixels, roughness)


def paint_palette(names: Iterable[str], seed: int) -> dict[str, Surface]:
    """The named surfaces, painted; the texture of a name depends on the seed alone, not on the other names."""
    noise = Noise((seed, zlib.crc32(b"noise")))

    def paint(name: str) -> Surface:
        recipe = RECIPES[name]
        rng = np.random.default_rng((seed, zlib.crc32(name.encode())))
        texture = recipe.paint(Painter(rng, noise, recipe.metres or 1.0, recipe.pixels))
        repeat = None if recipe.metres is None else (recipe.metres, recipe.metres)
        return Surface(Material(name=name, texture=texture, roughness=recipe.roughness), repeat)

    chosen = sorted(set(names))
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        return dict(zip(chosen, pool.map(paint, chosen), strict=True))


_GREYS = ((0.56, 0.53, 0.47), (0.68, 0.63, 0.54), (0.52, 0.51, 0.49), (0.62, 0.55, 0.45))
_WARM = ((0.70, 0.60, 0.45), (0.60, 0.50, 0.38), (0.74, 0.67, 0.54), (0.55, 0.49, 0.42))
_COLD = ((0.46, 0.47, 0.49), (0.58, 0.57, 0.55), (0.40, 0.41, 0.42), (0.52, 0.49, 0.46))
_SETTS = ((0.47, 0.45, 0.43), (0.56, 0.51, 0.46), (0.40, 0.40, 0.42), (0.50, 0.44, 0.40))
_RED_TILES = ((0.58, 0.30, 0.19), (0.48, 0.24, 0.17), (0.66, 0.40, 0.27), (0.42, 0.24, 0.19))
_SLATES = ((0.33, 0.36, 0.41), (0.42, 0.43, 0.45), (0.27, 0.29, 0.34), (0.40, 0.38, 0.38))
_OAK = ((0.46, 0.34, 0.22), (0.55, 0.43, 0.29), (0.39, 0.31, 0.23), (0.50, 0.45, 0.38))


_SAGE = ((0.42, 0.50, 0.44), (0.74, 0.72, 0.58), (0.84, 0.78, 0.64), (0.60, 0.62, 0.52))
_DELFT = ((0.80, 0.81, 0.79), (0.30, 0.40, 0.60), (0.82, 0.82, 0.80))
_GRASS = ((0.24, 0.31, 0.12), (0.38, 0.41, 0.19), (0.46, 0.41, 0.25))
_EARTH = ((0.40, 0.33, 0.24), (0.50, 0.43, 0.32), (0.34, 0.33, 0.18), (0.56, 0.51, 0.43))
_NEEDLES = ((0.33, 0.24, 0.15), (0.44, 0.33, 0.21), (0.26, 0.24, 0.12), (0.48, 0.40, 0.28))

RECIPES: dict[str, Recipe] = {
    "ashlar_0": _recipe(ashlar, stones=_GREYS),
    "ashlar_1": _recipe(ashlar, stones=_WARM, moss=0.25),
    "ashlar_2": _recipe(ashlar, stones=_COLD, course=(0.2, 0.34), block=(0.25, 0.6), moss=0.5),
    "ashlar_3": _recipe(ashlar, stones=(*_GREYS, *_WARM), course=(0.3, 0.5), block=(0.4, 1.0)),
    "stone": _recipe(ashlar, 6.0, stones=_GREYS, course=(0.3, 0.6), block=(0.4, 1.3), moss=0.2),
    "brick": _recipe(brick, 6.0, bricks=((0.55, 0.28, 0.2), (0.45, 0.22, 0.17), (0.62, 0.38, 0.27))),
    "cobbles": _recipe(cobbles, 14.0, 2048, stones=_SETTS),
    "earth": _recipe(speckled, 16.0, 2048, colours=_EARTH, contrast=0.26, grit=0.2),
    "grass": _recipe(speckled, 16.0, 2048, colours=_GRASS, contrast=0.3, grit=0.22),
    "needles": _recipe(speckled, 16.0, 2048, colours=_NEEDLES, contrast=0.3, grit=0.3),
    "litter": _recipe(speckled, 1.0, 512, colours=((0.52, 0.34, 0.17), (0.66, 0.48, 0.24)), contrast=0.3),
    "concrete": _recipe(
        speckled, 8.0, 1024, colours=((0.50, 0.49, 0.47), (0.42, 0.41, 0.40)), contrast=0.1, grit=0.06
    ),
    "tiles_0": _recipe(roof_tiles, tiles=_RED_TILES),
    "tiles_1": _recipe(roof_tiles, tiles=(*_RED_TILES[2:], (0.54, 0.42, 0.33))),
    "tiles_2": _recipe(roof_tiles, tiles=_SLATES, course=(0.16, 0.2), width=(0.14, 0.3)),
    "plaster_0": _recipe(plaster, wall=(0.84, 0.78, 0.66), under=(0.55, 0.42, 0.32)),
    "plaster_1": _recipe(plaster, wall=(0.80, 0.66, 0.46), under=(0.58, 0.36, 0.27), worn=0.3),
    "plaster_2": _recipe(plaster, wall=(0.70, 0.50, 0.40), under=(0.56, 0.50, 0.43)),
    "plaster_3": _recipe(plaster, wall=(0.66, 0.70, 0.66), under=(0.55, 0.42, 0.34), worn=0.35),
    "plaster_4": _recipe(plaster, wall=(0.86, 0.83, 0.77), under=(0.52, 0.38, 0.30), worn=0.32),
    "planks": _recipe(planks, 5.0, woods=_OAK),
    "door": _recipe(planks, 4.0, woods=((0.36, 0.22, 0.14), (0.28, 0.19, 0.13), (0.20, 0.27, 0.24))),
    "shutter_0": _recipe(planks, 4.0, woods=((0.22, 0.36, 0.28), (0.27, 0.40, 0.31)), width=(0.08, 0.11)),
    "shutter_1": _recipe(planks, 4.0, woods=((0.45, 0.20, 0.15), (0.38, 0.18, 0.14)), width=(0.08, 0.11)),
    "shutter_2": _recipe(planks, 4.0, woods=((0.25, 0.34, 0.46), (0.32, 0.40, 0.48)), width=(0.08, 0.11)),
    "timber": _recipe(timber, 4.0, wood=(0.33, 0.23, 0.15)),
    "bark": _recipe(timber, 2.5, wood=(0.36, 0.30, 0.23)),
    "iron": _recipe(speckled, 3.0, 512, colours=((0.16, 0.16, 0.17), (0.30, 0.22, 0.17)), contrast=0.3),
    "straw": _recipe(timber, 3.0, wood=(0.72, 0.60, 0.33)),
    "sack": _recipe(cloth, 2.0, stripes=((0.62, 0.53, 0.40), (0.57, 0.48, 0.36)), width=0.2),
    "leaves": _recipe(leaves, 6.0, greens=((0.20, 0.33, 0.10), (0.36, 0.46, 0.15), (0.50, 0.54, 0.22))),
    "leaves_dark": _recipe(leaves, 6.0, greens=((0.15, 0.27, 0.12), (0.27, 0.38, 0.15), (0.38, 0.42, 0.2))),
    "flowers": _recipe(
        leaves, 2.0, 512, greens=((0.75, 0.2, 0.25), (0.35, 0.45, 0.2), (0.9, 0.6, 0.5)), size=0.05
    ),
    "glass": _recipe(glass, 4.0),
    "pane": _recipe(
        speckled, 4.0, 512, roughness=0.1, colours=((0.07, 0.08, 0.09), (0.17, 0.16, 0.14)), contrast=0.2
    ),
    "water": _recipe(speckled, 4.0, 512, colours=((0.16, 0.25, 0.27), (0.40, 0.48, 0.48)), contrast=0.3),
    "cloth_0": _recipe(cloth, 4.0, stripes=((0.66, 0.16, 0.14), (0.86, 0.80, 0.66)), width=0.28),
    "cloth_1": _recipe(cloth, 4.0, stripes=((0.20, 0.36, 0.50), (0.85, 0.82, 0.74)), width=0.24),
    "cloth_2": _recipe(cloth, 4.0, stripes=((0.72, 0.55, 0.20), (0.30, 0.38, 0.22)), width=0.33),
    "fruit_0": _recipe(speckled, 1.0, 512, colours=((0.70, 0.16, 0.12), (0.80, 0.45, 0.2)), contrast=0.2),
    "fruit_1": _recipe(speckled, 1.0, 512, colours=((0.86, 0.56, 0.14), (0.75, 0.42, 0.12)), contrast=0.2),
    "fruit_2": _recipe(speckled, 1.0, 512, colours=((0.42, 0.56, 0.18), (0.62, 0.66, 0.28)), contrast=0.2),
    # From the air a texel is as large as a hand.
    "meadow": _recipe(speckled, 60.0, colours=_GRASS, contrast=0.3, grit=0.25),
    "field_wheat": _recipe(
        cloth, 60.0, stripes=((0.72, 0.60, 0.34), (0.64, 0.53, 0.29), (0.69, 0.58, 0.36)), width=1.1
    ),
    "field_rows": _recipe(cloth, 60.0, stripes=((0.36, 0.43, 0.18), (0.45, 0.38, 0.26)), width=0.9),
    "field_soil": _recipe(cloth, 60.0, stripes=((0.43, 0.34, 0.25), (0.36, 0.28, 0.20)), width=0.8),
    "asphalt": _recipe(speckled, 12.0, colours=((0.31, 0.31, 0.32), (0.40, 0.39, 0.38)), contrast=0.15),
    "gravel": _recipe(speckled, 16.0, 512, colours=_EARTH[:2], contrast=0.25),
    # Indoors everything is nearer: finer textures of the same kinds.
    "floorboards": _recipe(planks, 3.4, woods=((0.58, 0.43, 0.28), (0.50, 0.37, 0.24), (0.63, 0.49, 0.34))),
    "oak": _recipe(planks, 1.6, woods=((0.64, 0.49, 0.33), (0.56, 0.42, 0.28)), width=(0.1, 0.16)),
    "walnut": _recipe(timber, 1.2, wood=(0.47, 0.33, 0.22)),
    "limewash": _recipe(plaster, 3.0, wall=(0.80, 0.75, 0.66), under=(0.62, 0.52, 0.42), worn=0.2),
    "wallpaper": _recipe(leaves, 2.0, greens=_SAGE, size=0.09, depth=0.85),
    "brick_fine": _recipe(brick, 3.0, bricks=((0.60, 0.33, 0.24), (0.50, 0.26, 0.2), (0.66, 0.43, 0.32))),
    "stone_fine": _recipe(ashlar, 2.5, stones=_GREYS, course=(0.2, 0.35), block=(0.3, 0.6), moss=-0.4),
    "bark_fine": _recipe(timber, 0.8, wood=(0.42, 0.35, 0.28)),
    "iron_fine": _recipe(speckled, 0.8, 512, colours=((0.18, 0.18, 0.19), (0.28, 0.24, 0.2)), contrast=0.3),
    "brass": _recipe(speckled, 0.8, 512, colours=((0.66, 0.52, 0.26), (0.46, 0.36, 0.2)), contrast=0.25),
    "soot": _recipe(speckled, 1.5, 512, colours=((0.16, 0.14, 0.13), (0.34, 0.27, 0.23)), contrast=0.4),
    "ceramic": _recipe(leaves, 0.8, 512, greens=_DELFT, size=0.03, depth=0.9),
    "leaves_fine": _recipe(speckled, 0.7, 512, colours=((0.24, 0.38, 0.15), (0.42, 0.52, 0.23)), contrast=0.3),
    "wicker": _recipe(brick, 0.9, 512, bricks=((0.66, 0.52, 0.32), (0.54, 0.41, 0.25)), mortar=(0.3, 0.2, 0.1)),
    "paper": _recipe(speckled, 1.0, 512, colours=((0.84, 0.80, 0.70), (0.76, 0.70, 0.58)), contrast=0.12),
    "fabric_0": _recipe(
        cloth, 1.2, stripes=((0.40, 0.48, 0.44), (0.50, 0.56, 0.49), (0.33, 0.40, 0.37)), width=0.05
    ),
    "fabric_1": _recipe(leaves, 0.9, greens=((0.62, 0.24, 0.18), (0.80, 0.62, 0.40)), size=0.04, depth=0.7),
    "fabric_2": _recipe(cloth, 0.9, stripes=((0.82, 0.74, 0.58), (0.72, 0.62, 0.45)), width=0.025),
    "fabric_3": _recipe(leaves, 1.6, greens=((0.56, 0.34, 0.27), (0.78, 0.64, 0.44)), size=0.06, depth=0.7),
    # Weak on purpose: a few grey levels on coats of paint.
    "paint_white": _recipe(speckled, 3.0, 512, colours=((0.80, 0.79, 0.74),), contrast=0.03, grit=0.012),
    "paint_sage": _recipe(speckled, 3.0, 512, colours=((0.46, 0.56, 0.50),), contrast=0.04, grit=0.015),
    "paint_blue": _recipe(speckled, 3.0, 512, colours=((0.26, 0.37, 0.50),), contrast=0.04, grit=0.015),
    "paint_grey": _recipe(speckled, 3.0, 512, colours=((0.60, 0.58, 0.54),), contrast=0.04, grit=0.015),
    "paint_red": _recipe(speckled, 3.0, 512, colours=((0.70, 0.15, 0.12),), contrast=0.04, grit=0.015),
    "paint_orange": _recipe(speckled, 3.0, 512, colours=((0.80, 0.42, 0.12),), contrast=0.04, grit=0.015),
    "enamel": _recipe(speckled, 3.0, 512, colours=((0.92, 0.92, 0.90),), contrast=0.015, grit=0.01),
    "steel": _recipe(speckled, 3.0, 512, colours=((0.50, 0.51, 0.53),), contrast=0.06, grit=0.03),
    "terrazzo": _recipe(
        speckled, 3.0, 1024, colours=((0.58, 0.57, 0.54), (0.52, 0.51, 0.48)), contrast=0.05, grit=0.08
    ),
    "books": _recipe(spines, None, 2048),
    "cartons": _recipe(cartons, None),
    "pictures": _recipe(pictures, None, 2048),
    "rug": _recipe(rug, None),
    "globe": _recipe(world_map, 0.5, 512),
}
