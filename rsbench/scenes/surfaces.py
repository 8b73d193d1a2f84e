"""Painted surfaces: stone, brick, cobbles, tiles, wood, plaster, ground, leaves, cloth, books and pictures.

Every painter returns sRGB bytes (h, w, 3) that repeat in both directions unless it says otherwise. Colours vary
from stone to stone and stain at several scales, so that a feature detector finds something of its own everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.scenes.model import Material
from rsbench.scenes.textures import (
    Cells,
    Colour,
    Field,
    Noise,
    blend,
    cut_courses,
    pick,
    plain,
    ramp,
    to_bytes,
)

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
        image = blend(
            image, colour, ramp(patches * paint.smooth() + 0.6 * paint.broad() + 0.3 * paint.fine(), -0.2, 0.8)
        )
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
        tones = pick(greens, paint.rng.random(cells.count, dtype=np.float32)) * np.float32(
            depth + (1.0 - depth) * (layer + 1) / 4
        )
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
