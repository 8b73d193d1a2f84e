"""The courtyard of a castle: curtain walls, towers, keep and gatehouse, and the life between them.

The yard spans x from -17 to 17 and y from -18 to 25; the gate looks north (+y), hills close the view outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.model import FloatArray
from rsbench.scenes.parts import (
    HouseStyle,
    PartsBuilder,
    Piece,
    curtain_wall,
    gatehouse,
    grid,
    house,
    lump,
    placed,
    round_tower,
    square_tower,
    wall_stairs,
)


@dataclass(frozen=True, kw_only=True)
class CastleBuilder(PartsBuilder):
    """The courtyard of a castle; lengths in metres."""

    RANGES = (("wall_height", 3.0, 15.0), ("keep_height", 8.0, 40.0), ("trees", 0, 60))

    wall_height: float = 6.5
    """Height of the walls, metres, 3 to 15."""
    keep_height: float = 15.0
    """Height of the keep, metres, 8 to 40."""
    trees: int = 26
    """Trees on the hills around the castle."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_ground(), *_walls(rng, self), *_buildings(rng, self), *_yard(rng)]
        pieces += _surroundings(rng, self)
        return pieces


def terrain_height(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the land: level inside the walls, with hills around them that hide the horizon."""
    distance = np.hypot(x, y - 3.0)
    rise = np.clip((distance - 34.0) / 45.0, 0.0, 1.0)
    rolling = 1.6 * np.sin(x * 0.11 + 1.0) * np.cos(y * 0.09) + 0.7 * np.sin(x * 0.27 + y * 0.21)
    return 13.0 * rise * rise * (3 - 2 * rise) + np.clip((distance - 32.0) / 12.0, 0.0, 1.0) * rolling


def _ground() -> list[Piece]:
    x, y = np.meshgrid(np.linspace(-85, 85, 86), np.linspace(-82, 88, 86))
    z = terrain_height(x, y)
    inside = (np.abs(x) < 16.5) & (y > -18) & (y < 24.5)
    outside = np.where(inside, -0.3, z)
    hills = grid("grass", np.stack([x, y, outside], axis=-1), np.stack([x, y], axis=-1))
    x, y = np.meshgrid(np.linspace(-17.5, 17.5, 36), np.linspace(-19, 25.5, 46))
    z = 0.06 * np.sin(x * 0.7) * np.cos(y * 0.5) + 0.03 * np.sin(x * 1.9 + y * 1.3) - 0.03
    yard = grid("earth", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1))
    # The paved path from the camera's corner through the gate, worn into a gentle curve.
    t, across = np.meshgrid(np.linspace(-19, 46, 40), np.linspace(-1.9, 1.9, 5), indexing="ij")
    centre = 7.0 * np.clip((t + 8) / 28, 0, 1) ** 2 * (3 - 2 * np.clip((t + 8) / 28, 0, 1))
    x, y = centre + across * (1 + 0.12 * np.sin(t)), t
    z = 0.05 - 0.02 * across**2 + np.maximum(terrain_height(x, y), 0)
    path = grid("cobbles", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1))
    return [hills, yard, path]


def _walls(rng: np.random.Generator, parameters: CastleBuilder) -> list[Piece]:
    h = parameters.wall_height
    pieces: list[Piece] = []
    # Outer faces: north in two parts beside the gate, then west, south, east.
    pieces += placed(curtain_wall(rng, 20.0, h, wall="ashlar_0"), (-7.0, 27.0, 0), 180)
    pieces += placed(curtain_wall(rng, 8.0, h, wall="ashlar_3"), (15.0, 27.0, 0), 180)
    pieces += placed(curtain_wall(rng, 46.0, h, wall="ashlar_2"), (-18.5, 4.0, 0), -90)
    pieces += placed(curtain_wall(rng, 36.0, h, wall="ashlar_3"), (0.0, -20.0, 0), 0)
    pieces += placed(curtain_wall(rng, 46.0, h, wall="ashlar_1"), (18.5, 4.0, 0), 90)
    pieces += placed(round_tower(rng, 3.2, h + 5.5, "ashlar_1", "tiles_0"), (-17.5, 26.0, 0))
    pieces += placed(round_tower(rng, 2.8, h + 4.0, "ashlar_2", "tiles_2"), (18.0, 26.0, 0))
    pieces += placed(square_tower(rng, 5.0, h + 3.5, "ashlar_0", 2), (17.5, -19.0, 0))
    pieces += placed(round_tower(rng, 3.0, h + 3.0, "ashlar_3"), (-17.5, -19.0, 0))
    pieces += placed(square_tower(rng, 5.2, h + 4.0, "ashlar_3", 3), (17.0, 9.0, 0))
    pieces += placed(wall_stairs("stone", h - 0.2), (14.6, 12.6, 0), 90)
    return pieces


def _buildings(rng: np.random.Generator, parameters: CastleBuilder) -> list[Piece]:
    pieces = placed(gatehouse(rng, "ashlar_1", "tiles_1", parameters.wall_height + 2.2), (7.0, 29.0, 0), 180)
    pieces += placed(square_tower(rng, 9.0, parameters.keep_height, "ashlar_2", 4, "tiles_0"), (-5.2, 18.5, 0))
    stair_tower = round_tower(rng, 1.9, parameters.keep_height + 2.5, "ashlar_0", "tiles_2", 2.4)
    pieces += placed(stair_tower, (0.2, 22.4, 0))
    hall = HouseStyle(width=9.0, depth=6.5, storeys=2, wall="plaster_0", roof="tiles_1", gable_front=False)
    pieces += placed(house(rng, hall), (-5.6, 3.6, 0), 90)
    stable = HouseStyle(width=7.0, depth=5.0, storeys=1, storey_height=3.0, ground="planks", wall="plaster_4",
                        roof="tiles_0", shutters="shutter_1", gable_front=False, pitch=0.9)  # fmt: skip
    pieces += placed(house(rng, stable), (7.6, 4.5, 0), -90)
    smithy = HouseStyle(width=4.6, depth=5.0, storeys=2, storey_height=2.5, wall="plaster_1", roof="tiles_2",
                        shutters="shutter_2")  # fmt: skip
    pieces += placed(house(rng, smithy), (9.6, 13.4, 0), -60)
    chapel = HouseStyle(width=6.0, depth=9.0, storeys=1, storey_height=5.0, ground="ashlar_1", wall="ashlar_1",
                        roof="tiles_2", framed=False, pitch=1.4)  # fmt: skip
    return pieces + placed(house(rng, chapel), (-10.0, -13.0, 0), 65)


def _yard(rng: np.random.Generator) -> list[Piece]:
    pieces = placed(props.well(rng), (-0.2, 1.6, 0), 25)
    pieces += placed(props.cart(rng), (3.5, 6.0, 0), 200)
    pieces += placed(props.cart(rng, "sack"), (-3.0, 11.0, 0), -35)
    pieces += placed(props.hay_bales(rng), (4.9, 3.2, 0), 70)
    pieces += placed(props.sacks(rng, 6), (-3.5, 1.6, 0), 20)
    pieces += placed(props.log_pile(rng), (-4.4, 8.9, 0), 75)
    pieces += placed(props.stall(rng, "cloth_1"), (4.9, 10.2, 0), -40)
    pieces += placed(props.bench(), (-4.9, 4.4, 0), 90)
    for x, y in ((-2.9, 0.0), (-2.3, -0.5), (3.5, -0.4), (-4.7, 1.2), (6.6, 8.6), (7.0, 9.3), (2.6, 16.5)):
        pieces += placed(props.barrel(0.85 + 0.2 * rng.random()), (x, y, 0), float(rng.uniform(0, 90)))
    for x, y, size in ((-1.9, 0.4, 0.7), (2.8, -0.3, 0.8), (3.6, 0.5, 0.6), (6.4, 7.6, 0.9), (-3.5, 14.0, 0.9)):
        pieces += placed(props.crate(size), (x, y, 0), float(rng.uniform(0, 90)))
    pieces += placed(props.crate(0.5), (2.85, -0.25, 0.8), 30)
    for x, y, height, crown in (
        (2.0, 13.0, 6.5, 2.0),
        (10.5, 19.5, 7.0, 2.4),
        (-9.8, 11.5, 7.0, 2.2),
        (-12.0, -3.0, 7.0, 2.6),
    ):
        pieces += placed(props.tree(rng, height, crown), (x, y, 0))
    for x, y in ((-0.9, 13.2), (4.6, 17.0), (-5.2, 9.9), (11.0, 16.0), (-9.0, 13.8), (3.2, 12.2), (2.2, 21.0)):
        pieces += placed(props.bush(rng, 0.5 + 0.4 * rng.random(), "leaves_dark"), (x, y, 0))
    for _ in range(40):
        x, y, size = rng.uniform(-12, 12), rng.uniform(-8, 20), rng.uniform(0.06, 0.2)
        pieces += placed([lump("stone", rng, (size, size * 0.8, size * 0.6), 0.15, 1)], (x, y, 0.03))
    return pieces


def _surroundings(rng: np.random.Generator, parameters: CastleBuilder) -> list[Piece]:
    pieces: list[Piece] = []
    for k in range(parameters.trees):
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / parameters.trees
        distance = rng.uniform(38, 60)
        x, y = distance * np.sin(angle), 3 + distance * np.cos(angle)
        if abs(x - 7) < 4:
            continue
        z = float(terrain_height(np.array(x), np.array(y)))
        wood = props.tree(rng, rng.uniform(7, 11), rng.uniform(2.5, 3.5), "leaves_dark" if k % 2 else "leaves", 2)
        pieces += placed(wood, (float(x), float(y), z - 0.2))
    return pieces
