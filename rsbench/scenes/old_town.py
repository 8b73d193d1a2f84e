"""A street of gabled houses that opens into a market square with a fountain, a town hall and a church.

The street runs along y from -26 (a town gate) to 14, the square spans x from -13 to 13 and y from 14 to 27.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.parts import (
    HouseStyle,
    PartsBuilder,
    Piece,
    arch,
    beam,
    box,
    gatehouse,
    grid,
    house,
    leaned,
    loop_window,
    lump,
    panel,
    placed,
    profile,
    rectangle,
    revolve,
    square_tower,
)

_WALLS = ("plaster_0", "plaster_1", "plaster_2", "plaster_3", "plaster_4", "brick")
_GROUNDS = ("stone", "ashlar_1", "ashlar_3", "brick")


@dataclass(frozen=True, kw_only=True)
class OldTownBuilder(PartsBuilder):
    """A street and a market square; lengths in metres."""

    RANGES = (("street_width", 6.0, 14.0), ("storeys", 1, 5), ("stalls", 0, 7))

    street_width: float = 9.0
    """Width of the street, metres, 6 to 14."""
    storeys: tuple[int, int] = (2, 3)
    """Least and greatest number of storeys of the houses."""
    stalls: int = 5
    """Market stalls on the square."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        pieces = [*_ground(self), *_street(rng, self), *_square(rng, self)]
        pieces += [*_street_life(rng, self), *_market(rng, self), *_surroundings(rng)]
        return pieces


def _ground(parameters: OldTownBuilder) -> list[Piece]:
    half = parameters.street_width / 2
    x, y = np.meshgrid(np.linspace(-80, 80, 81), np.linspace(-80, 100, 91))
    rise = np.clip((np.hypot(x, y - 5) - 46) / 30, 0, 1)
    z = -0.25 + 12 * rise * rise * (3 - 2 * rise) + rise * np.sin(0.2 * x) * np.cos(0.17 * y)
    pieces = [grid("grass", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1))]
    x, y = np.meshgrid(np.linspace(-16, 16, 65), np.linspace(-34, 34, 137))
    camber = 0.12 * np.clip(1 - (x / half) ** 2, -0.5, 1) * (y < 12)
    z = camber + 0.025 * np.sin(1.3 * x + 0.4 * y) * np.cos(0.9 * y) - 0.08
    pieces.append(grid("cobbles", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1)))
    kerb = [(0.0, -0.3), (0.95, -0.3), (0.95, 0.14), (0.04, 0.14), (0.0, 0.1)]
    for side in (-1, 1):
        pieces += placed([profile("ashlar_3", kerb, 40.0)], (side * (half - 0.95), -6.0, 0), -90 * side)
    return pieces


def _style(rng: np.random.Generator, parameters: OldTownBuilder, width: float, number: int) -> HouseStyle:
    """Neighbours differ in colour, roof and height; three houses of four are timber-framed."""
    framed = bool(rng.random() < 0.7)
    low, high = parameters.storeys
    return HouseStyle(
        width=width,
        depth=float(rng.uniform(7.0, 9.0)),
        storeys=int(rng.integers(low, high + 1)),
        storey_height=float(rng.uniform(2.55, 2.9)),
        wall=_WALLS[number % (5 if framed else 6)],
        ground=_GROUNDS[(number * 3 + 1) % len(_GROUNDS)],
        roof=f"tiles_{number % 3}",
        shutters=f"shutter_{int(rng.integers(3))}",
        framed=framed,
        gable_front=bool(rng.random() < 0.65),
        jetty=float(rng.uniform(0.15, 0.35)) if framed else 0.0,
        pitch=float(rng.uniform(0.95, 1.3)),
    )


def _row(
    rng: np.random.Generator,
    parameters: OldTownBuilder,
    start: tuple[float, float],
    heading: float,
    widths: list[float],
    first: int,
) -> list[Piece]:
    """Make adjoining houses; ``start`` is the left end of the front, seen from the street."""
    pieces: list[Piece] = []
    along = np.array([np.cos(np.deg2rad(heading)), np.sin(np.deg2rad(heading))])
    position = np.asarray(start, dtype=np.float64)
    for k, width in enumerate(widths):
        x, y = position + along * width / 2
        style = _style(rng, parameters, width - 0.06, first + k)
        pieces += placed(house(rng, style), (float(x), float(y), 0.05), heading)
        if rng.random() < 0.5:
            x, y = position + along * 0.5
            pieces += placed(props.sign(f"shutter_{k % 3}"), (float(x), float(y), 2.75), heading)
        position = position + along * width
    return pieces


def _street(rng: np.random.Generator, parameters: OldTownBuilder) -> list[Piece]:
    half = parameters.street_width / 2
    pieces = _row(rng, parameters, (-half, -26.0), 90, [6.2, 5.4, 6.8, 5.6, 6.0, 5.2, 6.4], 0)
    pieces += _row(rng, parameters, (half, 13.0), -90, [5.6, 6.4, 5.8, 6.6, 5.2, 6.2, 4.6], 3)
    pieces += placed(gatehouse(rng, "ashlar_2", "tiles_2", 7.5), (0, -31.0, 0), 0)
    return pieces


def _square(rng: np.random.Generator, parameters: OldTownBuilder) -> list[Piece]:
    pieces = _row(rng, parameters, (-13.0, 16.0), 90, [5.8, 6.0], 2)
    pieces += _row(rng, parameters, (13.0, 27.0), -90, [6.0, 5.6], 4)
    pieces += _row(rng, parameters, (-13.0, 28.0), 0, [6.0, 5.4], 6)
    pieces += placed(town_hall(rng), (2.6, 27.0, 0), 0)
    pieces += placed(house(rng, _style(rng, parameters, 5.0, 9)), (10.6, 28.0, 0), 0)
    return pieces + placed(church(rng), (-2.0, 36.5, 0))


def town_hall(rng: np.random.Generator) -> list[Piece]:
    """A hall on an arcade, with two framed storeys, a steep roof and a clock turret."""
    arcade = [[(x + a, z) for a, z in arch(2.3, 3.3)] for x in (-3.3, 0.0, 3.3)]
    base = [panel("ashlar_1", rectangle(0, 0, 10.4, 4.0), 0.7, arcade)]
    base += [box("ashlar_3", (-5.2, 2.6, 0), (5.2, 2.9, 4.0)), box("planks", (-5.2, 0, 3.95), (5.2, 2.8, 4.05))]
    for x in (-4.95, -1.65, 1.65, 4.95):
        base += [
            box("stone", (x - 0.4, -0.15, 0), (x + 0.4, 0.3, 0.6)),
            box("stone", (x - 0.35, -0.12, 2.1), (x + 0.35, 0.3, 2.3)),
        ]
    base.append(box("stone", (-5.3, -0.18, 3.7), (5.3, 0.2, 4.0)))
    style = HouseStyle(
        width=10.4,
        storey_height=2.9,
        wall="plaster_4",
        ground="plaster_4",
        roof="tiles_1",
        shutters="shutter_1",
        gable_front=False,
        door=False,
        jetty=0.3,
        pitch=1.25,
    )
    pieces = base + placed(house(rng, style), (0, 0.05, 4.0))
    turret = [box("planks", (-0.9, -0.9, 0), (0.9, 0.9, 2.6))]
    turret += [revolve("tiles_2", [(0, 2.6), (1.55, 2.55), (0.6, 3.7), (0.0, 6.0)], 8)]
    face = [revolve("plaster_0", [(0, 0.06), (0.62, 0.05), (0.68, 0.1), (0.75, 0.1), (0.75, 0.0)], 24)]
    for heading in (0, 90, 180, 270):
        turret += placed(_upright(face), (0, 0, 0), heading)
    return pieces + placed(turret, (0, 4.4, 13.0))


def _upright(face: list[Piece]) -> list[Piece]:
    """A clock face with hands, turned from the ground to the wall y = -0.9."""
    clock = placed(leaned(face, 90), (0, -0.86, 1.5))
    clock.append(beam("iron", (0, -0.98, 1.5), (0.0, -0.98, 2.05), 0.07, 0.03))
    return [*clock, beam("iron", (0, -0.98, 1.5), (0.32, -0.98, 1.36), 0.08, 0.03)]


def church(rng: np.random.Generator) -> list[Piece]:
    """A tower with an octagonal spire on the street's axis and a long nave behind it."""
    pieces = placed(square_tower(rng, 6.4, 22.0, "ashlar_0", 4), (0, 0, 0))
    spire = [(0, 22.0), (3.5, 22.0), (2.2, 25.0), (0.0, 36.0)]
    pieces += placed([revolve("tiles_2", spire, 8)], (0, 0, 0), 22.5)
    nave = HouseStyle(width=11.0, depth=18.0, storeys=1, storey_height=8.5, ground="ashlar_2", wall="ashlar_2",
                      roof="tiles_0", framed=False, jetty=0.0, pitch=1.2, door=False)  # fmt: skip
    pieces += placed(house(rng, nave), (0, 3.0, 0))
    for side in (-1, 1):
        pieces += placed(loop_window(1.4, 4.0), (side * 3.9, 3.0, 2.2))
    return pieces


def _street_life(rng: np.random.Generator, parameters: OldTownBuilder) -> list[Piece]:
    half = parameters.street_width / 2
    pieces: list[Piece] = []
    for side, y in ((-1, 3.4), (1, 9.5), (-1, -9.0), (1, -15.0), (-1, 13.6), (1, 16.5)):
        pieces += placed(props.lamp_post(), (side * (half - 1.15), y, 0), 90)
    for x, y in ((half - 0.7, 1.0), (half - 1.3, 1.5), (half - 0.6, 2.0), (0.9 - half, 8.2), (0.7 - half, -6.0)):
        pieces += placed(props.barrel(0.8 + 0.2 * rng.random()), (x, y, 0.13), float(rng.uniform(0, 90)))
    for x, y, size in (
        (half - 0.8, 3.0, 0.7),
        (1.0 - half, 1.3, 0.8),
        (1.7 - half, 0.4, 0.55),
        (half - 0.9, 6.4, 0.8),
    ):
        pieces += placed(props.crate(size), (x, y, 0.12), float(rng.uniform(-25, 25)))
    pieces += placed(props.cart(rng, "sack"), (2.3, 4.9, 0), 100)
    pieces += placed(props.bench(), (0.55 - half, 5.8, 0.13), 90)
    pieces += placed(props.sacks(rng, 5), (1.1 - half, 10.4, 0.12), 100)
    pieces += placed(props.log_pile(rng, 3), (half - 0.2, 11.6, 0.12), -90)
    for x, y in (
        (-half + 0.5, 6.9),
        (-half + 0.5, 4.6),
        (half - 0.5, 8.3),
        (half - 0.5, 4.0),
        (-half + 0.5, 12.2),
    ):
        pot = [revolve("brick", [(0.2, 0), (0.3, 0.42), (0.26, 0.42), (0.0, 0.36)], 16)]
        shrub = placed(props.bush(rng, 0.38, str(rng.choice(["leaves", "flowers"]))), (0, 0, 0.36))
        pieces += placed([*pot, *shrub], (x, y, 0.13))
    return pieces


def _market(rng: np.random.Generator, parameters: OldTownBuilder) -> list[Piece]:
    pieces = placed(props.fountain(rng), (-0.9, 13.2, 0), 10)
    places = (
        (3.6, 17.6, -25),
        (-4.6, 18.4, 20),
        (0.4, 20.8, 5),
        (-8.2, 20.5, 60),
        (7.6, 20.0, -60),
        (5.6, 23.6, -8),
        (-4.2, 24.4, 10),
    )
    for k, (x, y, heading) in enumerate(places[: parameters.stalls]):
        pieces += placed(props.stall(rng, f"cloth_{k % 3}"), (x, y, 0), heading)
    pieces += placed(props.cart(rng), (-6.9, 15.8, 0), 30)
    pieces += placed(props.hay_bales(rng, 4), (8.6, 16.6, 0), 20)
    for x, y, height, crown in (
        (-4.4, 22.8, 7.2, 2.4),
        (6.9, 26.0, 6.4, 1.9),
        (-10.4, 24.8, 7.5, 2.6),
        (9.8, 22.6, 7.0, 2.3),
    ):
        pieces += placed(props.tree(rng, height, crown), (x, y, 0))
        rim = [(1.0, 0), (0.95, 0.45), (0.7, 0.45), (0.7, 0.3), (0, 0.3)]
        pieces += placed([revolve("stone", rim, 12)], (x, y, 0))
    for x, y in ((1.9, 16.2), (2.2, 16.9), (-3.2, 16.8), (4.9, 19.2), (-6.4, 18.0), (1.9, 22.2)):
        thing = props.barrel() if rng.random() < 0.5 else props.crate(0.6 + 0.3 * rng.random())
        pieces += placed(thing, (x, y, 0), float(rng.uniform(0, 90)))
    return pieces


def _surroundings(rng: np.random.Generator) -> list[Piece]:
    pieces: list[Piece] = []
    for k in range(22):
        angle = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / 22
        distance = rng.uniform(50, 62)
        x, y = distance * float(np.sin(angle)), 5 + distance * float(np.cos(angle))
        leaf = "leaves_dark" if k % 2 else "leaves"
        pieces += placed(props.tree(rng, rng.uniform(8, 12), rng.uniform(2.8, 4.0), leaf, 2), (x, y, 0.0))
    for _ in range(30):
        x, y, size = float(rng.uniform(-3.4, 3.4)), float(rng.uniform(-24, 12)), float(rng.uniform(0.03, 0.08))
        pieces += placed([lump("straw", rng, (size * 1.6, size, size * 0.5), 0.2, 1)], (x, y, 0.05))
    return pieces
