"""Noise and cell patterns that textures are painted from: seeded, periodic in both directions, float32.

Everything is built from additions, products and table look-ups, whose results IEEE 754 fixes, so that the same
seed gives the same bytes on every machine. Row 0 is the top of a texture. Images are
float32, channels first (3, h, w), because that is twice as fast to paint; ``to_bytes`` turns them around.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
    """Number of the interval, counted through all lists of cuts, at quarter pixels: (lists, 4 pixels + 1)."""
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
