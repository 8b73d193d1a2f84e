"""A yard behind thin posts: near things that are narrow or at the border, which stereo finds hardest.

The default viewpoint stands at the origin and looks along +y; the posts stand 2 to 5 m before it, the walls at 8
to 13 m. Some posts are so near the border that only one camera of a rig sees them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.scenes import props
from rsbench.scenes.parts import PartsBuilder, Piece, box, grid, panel, placed, rectangle, tube, window

_BORDER = ((-0.72, 2.2, 0.035), (0.74, 2.25, 0.05), (-1.16, 3.6, 0.06), (1.24, 3.8, 0.045))
"""Posts at the border of the default view: x, y, radius; metres."""
_HEIGHT = 3.2


@dataclass(frozen=True, kw_only=True)
class PolesBuilder(PartsBuilder):
    """A yard seen past posts, rails and a street lamp."""

    RANGES = (("posts", 0, 40), ("thinnest", 0.002, 0.05))

    posts: int = 9
    """Thin ones in the middle of the picture."""
    thinnest: float = 0.008
    """Least radius of a post, metres: 5 px across at 4 m in the paper's camera."""

    def pieces(self, rng: np.random.Generator) -> list[Piece]:
        return [*_yard(rng), *_posts(rng, self.posts, self.thinnest)]


def _post(surface: str, x: float, y: float, radius: float, lean: tuple[float, float] = (0.0, 0.0)) -> Piece:
    foot, top = np.array([x, y, 0.0]), np.array([x + lean[0], y + lean[1], _HEIGHT])
    return tube(surface, np.linspace(foot, top, 4), np.full(4, radius), 12)


def _posts(rng: np.random.Generator, count: int, thinnest: float) -> list[Piece]:
    """Posts at the border and in the middle, two rails across, a lamp."""
    pieces = [_post("bark_fine", *place) for place in _BORDER]
    for k in range(count):
        y = float(rng.uniform(2.4, 5.0))
        x = y * 0.5 * ((k + float(rng.uniform(0.2, 0.8))) / max(count, 1) - 0.5)
        radius = thinnest * float(rng.uniform(1.0, 3.5))
        lean = (float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.1, 0.1)))
        pieces.append(_post(("walnut", "iron_fine", "brass")[k % 3], x, y, radius, lean))
    for z, y in ((1.25, 4.4), (2.05, 3.2)):
        ends = np.linspace((-2.5, y, z), (2.5, y + 0.4, z + 0.1), 3)
        pieces.append(tube("iron_fine", ends, np.full(3, 1.5 * thinnest), 10))
    return pieces + placed(props.lamp_post(3.0), (0.95, 4.6, 0))


def _yard(rng: np.random.Generator) -> list[Piece]:
    """Walls with windows at three distances, the ground, and what stands about."""
    x, y = np.meshgrid(np.linspace(-25, 25, 51), np.linspace(-20, 30, 51))
    z = 0.03 * np.sin(1.3 * x) * np.cos(0.9 * y) - 0.05
    pieces = [grid("cobbles", np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1))]
    walls = (("brick", -3.0, 10.0, 5.0), ("ashlar_1", 1.8, 12.5, 6.0), ("plaster_2", 6.0, 9.0, 5.0))
    for surface, middle, distance, width in walls:
        opening = rectangle(0.3, 0.9, 1.0, 1.4)
        wall = [panel(surface, rectangle(0, 0, width, 6.5), 0.4, [opening])]
        wall += placed(window(1.0, 1.4, "shutter_0", "timber"), (0.3, 0, 0.9))
        wall.append(box("stone", (-width / 2 - 0.1, -0.2, 0), (width / 2 + 0.1, 0, 0.5)))
        wall.append(box("timber", (-width / 2, -0.15, 2.9), (width / 2, 0, 3.1), turned=True))
        pieces += placed(wall, (middle, distance, 0))
    pieces += placed(props.cart(rng), (-1.6, 8.0, 0), 30) + placed(props.barrel(), (0.3, 7.2, 0))
    pieces += placed(props.crate(), (1.5, 7.8, 0), 15) + placed(props.bush(rng, 0.7), (2.4, 8.2, 0))
    pieces += placed(props.bench(), (-0.3, 9.4, 0)) + placed(props.tree(rng, 4.5, 1.6), (3.6, 10.5, 0))
    return [*pieces, box("ashlar_2", (-20, 16, 0), (20, 16.5, 9))]
