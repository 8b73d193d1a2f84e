"""The surfaces that the built-in scenes are painted with, by name."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rsbench.scenes import furnishings as f
from rsbench.scenes import surfaces as s
from rsbench.scenes.model import Material
from rsbench.scenes.surfaces import Bytes, Painter, Surface
from rsbench.scenes.textures import Noise


@dataclass(frozen=True)
class Recipe:
    """How a surface is painted."""

    paint: Callable[[Painter], Bytes]
    metres: float | None
    """What one repeat of the texture covers; None: the texture fits its part exactly."""
    pixels: int
    roughness: float | None
    """Of a glossy surface, as ``Material`` has it."""


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
    "ashlar_0": _recipe(s.ashlar, stones=_GREYS),
    "ashlar_1": _recipe(s.ashlar, stones=_WARM, moss=0.25),
    "ashlar_2": _recipe(s.ashlar, stones=_COLD, course=(0.2, 0.34), block=(0.25, 0.6), moss=0.5),
    "ashlar_3": _recipe(s.ashlar, stones=(*_GREYS, *_WARM), course=(0.3, 0.5), block=(0.4, 1.0)),
    "stone": _recipe(s.ashlar, 6.0, stones=_GREYS, course=(0.3, 0.6), block=(0.4, 1.3), moss=0.2),
    "brick": _recipe(s.brick, 6.0, bricks=((0.55, 0.28, 0.2), (0.45, 0.22, 0.17), (0.62, 0.38, 0.27))),
    "cobbles": _recipe(s.cobbles, 14.0, 2048, stones=_SETTS),
    "earth": _recipe(s.speckled, 16.0, 2048, colours=_EARTH, contrast=0.26, grit=0.2),
    "grass": _recipe(s.speckled, 16.0, 2048, colours=_GRASS, contrast=0.3, grit=0.22),
    "needles": _recipe(s.speckled, 16.0, 2048, colours=_NEEDLES, contrast=0.3, grit=0.3),
    "litter": _recipe(s.speckled, 1.0, 512, colours=((0.52, 0.34, 0.17), (0.66, 0.48, 0.24)), contrast=0.3),
    "concrete": _recipe(
        s.speckled, 8.0, 1024, colours=((0.50, 0.49, 0.47), (0.42, 0.41, 0.40)), contrast=0.1, grit=0.06
    ),
    "tiles_0": _recipe(s.roof_tiles, tiles=_RED_TILES),
    "tiles_1": _recipe(s.roof_tiles, tiles=(*_RED_TILES[2:], (0.54, 0.42, 0.33))),
    "tiles_2": _recipe(s.roof_tiles, tiles=_SLATES, course=(0.16, 0.2), width=(0.14, 0.3)),
    "plaster_0": _recipe(s.plaster, wall=(0.84, 0.78, 0.66), under=(0.55, 0.42, 0.32)),
    "plaster_1": _recipe(s.plaster, wall=(0.80, 0.66, 0.46), under=(0.58, 0.36, 0.27), worn=0.3),
    "plaster_2": _recipe(s.plaster, wall=(0.70, 0.50, 0.40), under=(0.56, 0.50, 0.43)),
    "plaster_3": _recipe(s.plaster, wall=(0.66, 0.70, 0.66), under=(0.55, 0.42, 0.34), worn=0.35),
    "plaster_4": _recipe(s.plaster, wall=(0.86, 0.83, 0.77), under=(0.52, 0.38, 0.30), worn=0.32),
    "planks": _recipe(s.planks, 5.0, woods=_OAK),
    "door": _recipe(s.planks, 4.0, woods=((0.36, 0.22, 0.14), (0.28, 0.19, 0.13), (0.20, 0.27, 0.24))),
    "shutter_0": _recipe(s.planks, 4.0, woods=((0.22, 0.36, 0.28), (0.27, 0.40, 0.31)), width=(0.08, 0.11)),
    "shutter_1": _recipe(s.planks, 4.0, woods=((0.45, 0.20, 0.15), (0.38, 0.18, 0.14)), width=(0.08, 0.11)),
    "shutter_2": _recipe(s.planks, 4.0, woods=((0.25, 0.34, 0.46), (0.32, 0.40, 0.48)), width=(0.08, 0.11)),
    "timber": _recipe(s.timber, 4.0, wood=(0.33, 0.23, 0.15)),
    "bark": _recipe(s.timber, 2.5, wood=(0.36, 0.30, 0.23)),
    "iron": _recipe(s.speckled, 3.0, 512, colours=((0.16, 0.16, 0.17), (0.30, 0.22, 0.17)), contrast=0.3),
    "straw": _recipe(s.timber, 3.0, wood=(0.72, 0.60, 0.33)),
    "sack": _recipe(s.cloth, 2.0, stripes=((0.62, 0.53, 0.40), (0.57, 0.48, 0.36)), width=0.2),
    "leaves": _recipe(s.leaves, 6.0, greens=((0.20, 0.33, 0.10), (0.36, 0.46, 0.15), (0.50, 0.54, 0.22))),
    "leaves_dark": _recipe(s.leaves, 6.0, greens=((0.15, 0.27, 0.12), (0.27, 0.38, 0.15), (0.38, 0.42, 0.2))),
    "flowers": _recipe(
        s.leaves, 2.0, 512, greens=((0.75, 0.2, 0.25), (0.35, 0.45, 0.2), (0.9, 0.6, 0.5)), size=0.05
    ),
    "glass": _recipe(s.glass, 4.0),
    "pane": _recipe(
        s.speckled, 4.0, 512, roughness=0.1, colours=((0.07, 0.08, 0.09), (0.17, 0.16, 0.14)), contrast=0.2
    ),
    "water": _recipe(s.speckled, 4.0, 512, colours=((0.16, 0.25, 0.27), (0.40, 0.48, 0.48)), contrast=0.3),
    "cloth_0": _recipe(s.cloth, 4.0, stripes=((0.66, 0.16, 0.14), (0.86, 0.80, 0.66)), width=0.28),
    "cloth_1": _recipe(s.cloth, 4.0, stripes=((0.20, 0.36, 0.50), (0.85, 0.82, 0.74)), width=0.24),
    "cloth_2": _recipe(s.cloth, 4.0, stripes=((0.72, 0.55, 0.20), (0.30, 0.38, 0.22)), width=0.33),
    "fruit_0": _recipe(s.speckled, 1.0, 512, colours=((0.70, 0.16, 0.12), (0.80, 0.45, 0.2)), contrast=0.2),
    "fruit_1": _recipe(s.speckled, 1.0, 512, colours=((0.86, 0.56, 0.14), (0.75, 0.42, 0.12)), contrast=0.2),
    "fruit_2": _recipe(s.speckled, 1.0, 512, colours=((0.42, 0.56, 0.18), (0.62, 0.66, 0.28)), contrast=0.2),
    # From the air a texel is as large as a hand.
    "meadow": _recipe(s.speckled, 60.0, colours=_GRASS, contrast=0.3, grit=0.25),
    "field_wheat": _recipe(
        s.cloth, 60.0, stripes=((0.72, 0.60, 0.34), (0.64, 0.53, 0.29), (0.69, 0.58, 0.36)), width=1.1
    ),
    "field_rows": _recipe(s.cloth, 60.0, stripes=((0.36, 0.43, 0.18), (0.45, 0.38, 0.26)), width=0.9),
    "field_soil": _recipe(s.cloth, 60.0, stripes=((0.43, 0.34, 0.25), (0.36, 0.28, 0.20)), width=0.8),
    "asphalt": _recipe(s.speckled, 12.0, colours=((0.31, 0.31, 0.32), (0.40, 0.39, 0.38)), contrast=0.15),
    "gravel": _recipe(s.speckled, 16.0, 512, colours=_EARTH[:2], contrast=0.25),
    # Indoors everything is nearer: finer textures of the same kinds.
    "floorboards": _recipe(s.planks, 3.4, woods=((0.58, 0.43, 0.28), (0.50, 0.37, 0.24), (0.63, 0.49, 0.34))),
    "oak": _recipe(s.planks, 1.6, woods=((0.64, 0.49, 0.33), (0.56, 0.42, 0.28)), width=(0.1, 0.16)),
    "walnut": _recipe(s.timber, 1.2, wood=(0.47, 0.33, 0.22)),
    "limewash": _recipe(s.plaster, 3.0, wall=(0.80, 0.75, 0.66), under=(0.62, 0.52, 0.42), worn=0.2),
    "wallpaper": _recipe(s.leaves, 2.0, greens=_SAGE, size=0.09, depth=0.85),
    "brick_fine": _recipe(s.brick, 3.0, bricks=((0.60, 0.33, 0.24), (0.50, 0.26, 0.2), (0.66, 0.43, 0.32))),
    "stone_fine": _recipe(s.ashlar, 2.5, stones=_GREYS, course=(0.2, 0.35), block=(0.3, 0.6), moss=-0.4),
    "bark_fine": _recipe(s.timber, 0.8, wood=(0.42, 0.35, 0.28)),
    "iron_fine": _recipe(s.speckled, 0.8, 512, colours=((0.18, 0.18, 0.19), (0.28, 0.24, 0.2)), contrast=0.3),
    "brass": _recipe(s.speckled, 0.8, 512, colours=((0.66, 0.52, 0.26), (0.46, 0.36, 0.2)), contrast=0.25),
    "soot": _recipe(s.speckled, 1.5, 512, colours=((0.16, 0.14, 0.13), (0.34, 0.27, 0.23)), contrast=0.4),
    "ceramic": _recipe(s.leaves, 0.8, 512, greens=_DELFT, size=0.03, depth=0.9),
    "leaves_fine": _recipe(s.speckled, 0.7, 512, colours=((0.24, 0.38, 0.15), (0.42, 0.52, 0.23)), contrast=0.3),
    "wicker": _recipe(s.brick, 0.9, 512, bricks=((0.66, 0.52, 0.32), (0.54, 0.41, 0.25)), mortar=(0.3, 0.2, 0.1)),
    "paper": _recipe(s.speckled, 1.0, 512, colours=((0.84, 0.80, 0.70), (0.76, 0.70, 0.58)), contrast=0.12),
    "fabric_0": _recipe(
        s.cloth, 1.2, stripes=((0.40, 0.48, 0.44), (0.50, 0.56, 0.49), (0.33, 0.40, 0.37)), width=0.05
    ),
    "fabric_1": _recipe(s.leaves, 0.9, greens=((0.62, 0.24, 0.18), (0.80, 0.62, 0.40)), size=0.04, depth=0.7),
    "fabric_2": _recipe(s.cloth, 0.9, stripes=((0.82, 0.74, 0.58), (0.72, 0.62, 0.45)), width=0.025),
    "fabric_3": _recipe(s.leaves, 1.6, greens=((0.56, 0.34, 0.27), (0.78, 0.64, 0.44)), size=0.06, depth=0.7),
    # Weak on purpose: a few grey levels on coats of paint.
    "paint_white": _recipe(s.speckled, 3.0, 512, colours=((0.80, 0.79, 0.74),), contrast=0.03, grit=0.012),
    "paint_sage": _recipe(s.speckled, 3.0, 512, colours=((0.46, 0.56, 0.50),), contrast=0.04, grit=0.015),
    "paint_blue": _recipe(s.speckled, 3.0, 512, colours=((0.26, 0.37, 0.50),), contrast=0.04, grit=0.015),
    "paint_grey": _recipe(s.speckled, 3.0, 512, colours=((0.60, 0.58, 0.54),), contrast=0.04, grit=0.015),
    "paint_red": _recipe(s.speckled, 3.0, 512, colours=((0.70, 0.15, 0.12),), contrast=0.04, grit=0.015),
    "paint_orange": _recipe(s.speckled, 3.0, 512, colours=((0.80, 0.42, 0.12),), contrast=0.04, grit=0.015),
    "enamel": _recipe(s.speckled, 3.0, 512, colours=((0.92, 0.92, 0.90),), contrast=0.015, grit=0.01),
    "steel": _recipe(s.speckled, 3.0, 512, colours=((0.50, 0.51, 0.53),), contrast=0.06, grit=0.03),
    "terrazzo": _recipe(
        s.speckled, 3.0, 1024, colours=((0.58, 0.57, 0.54), (0.52, 0.51, 0.48)), contrast=0.05, grit=0.08
    ),
    "books": _recipe(f.spines, None, 2048),
    "cartons": _recipe(f.cartons, None),
    "pictures": _recipe(f.pictures, None, 2048),
    "rug": _recipe(f.rug, None),
    "globe": _recipe(f.world_map, 0.5, 512),
}
