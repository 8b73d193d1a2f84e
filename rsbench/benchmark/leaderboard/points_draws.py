"""What the simulated problems of a protocol are drawn from: cameras, sizes, laws of motion, outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulated.simulation import OutlierImages
from rsbench.benchmark.simulated.sweep_card import Setting
from rsbench.core.motion import Motion

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Draws:
    """The problems of a protocol, by a seed and their numbers."""

    scope: tuple[str, ...]
    """Names of its generators: no two protocols share a draw."""
    problems: int
    setting: Callable[[int, int], Setting]
    """Of a seed and a number."""
    outlier_images: OutlierImages
    kinds: Callable[[int, int], dict[str, float | str]] = lambda seed, number: {}
    """What else scores may be drawn against, beside the sizes."""

    def rng(self, seed: int, what: str, number: int) -> np.random.Generator:
        return generator(seed, *self.scope, what, number)

    def motion(self, seed: int, number: int) -> Motion:
        """Of a problem."""
        return _motion(self, seed, number)


@lru_cache(maxsize=512)  # a shaken one takes a tenth of a second
def _motion(draws: Draws, seed: int, number: int) -> Motion:
    return draws.setting(seed, number).motion(draws.rng(seed, "motion", number))


def _between(rng: np.random.Generator, sizes: Range) -> float:
    """As often in each factor."""
    return float(np.exp(rng.uniform(*np.log(sizes))))


# points-1


def points_setting(seed: int, number: int) -> Setting:
    """Every size at random, chosen by us; the camera is the paper's."""
    rng = generator(seed, "leaderboard", "setting", number)
    return Setting(
        width=900,
        height=900,
        focal=810.0,
        depth=(2.0, 10.0),
        rotation_deg=_between(rng, (0.2, 8.0)),
        translation=_between(rng, (0.05, 0.5)),
        baseline=_between(rng, (0.1, 0.6)),
        noise_px=_between(rng, (0.05, 1.0)),
        readout_ratio=float(rng.uniform(0.1, 1.0)),
        points=int(rng.integers(40, 201)),
        outlier_ratio=float(rng.choice([0.0, 0.1, 0.3, 0.5])),
        shape="plane" if rng.random() < 0.2 else "box",
    )


POINTS_1 = Draws(scope=("leaderboard",), problems=250, setting=points_setting, outlier_images="frame 1")


# points-2


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Sizes of a kind of rig; docs/reference/protocols.md has the sources."""

    width: int
    height: int
    focal: float
    baseline: Range
    depth: Range
    rotation_deg: Range
    """In a frame period."""
    translation: Range
    """Metres in a frame period."""
    readout_ratio: Range
    shake: str
    """Preset of its hand-held motion."""
    drives: bool = False
    """Whether it moves forward and turns about the vertical, but for a few degrees."""


KINDS = {
    "phone": Kind(
        width=1280,
        height=720,
        focal=925.0,
        baseline=(0.01, 0.02),
        depth=(0.5, 8.0),
        rotation_deg=(0.05, 3.0),
        translation=(0.003, 0.05),
        readout_ratio=(0.1, 0.95),
        shake="handheld",
    ),
    "headset": Kind(
        width=640,
        height=480,
        focal=370.0,
        baseline=(0.06, 0.14),
        depth=(0.5, 8.0),
        rotation_deg=(0.1, 6.0),
        translation=(0.003, 0.05),
        readout_ratio=(0.1, 0.95),
        shake="steady",
    ),
    "car": Kind(
        width=1242,
        height=375,
        focal=721.0,
        baseline=(0.12, 0.54),
        depth=(4.0, 40.0),
        rotation_deg=(0.02, 1.0),
        translation=(0.1, 0.9),
        readout_ratio=(0.1, 0.95),
        shake="driving",
        drives=True,
    ),
    "drone": Kind(
        width=752,
        height=480,
        focal=458.0,
        baseline=(0.06, 0.2),
        depth=(2.0, 20.0),
        rotation_deg=(0.2, 8.0),
        translation=(0.02, 0.5),
        readout_ratio=(0.1, 0.95),
        shake="drone",
    ),
}
LAWS = ("linear", "twist", "inertial", "accelerated", "spline")
"""Motion models, each of a fifth of the problems of each kind."""
_CELLS = tuple((kind, law) for kind in KINDS for law in LAWS)
_OF_A_CELL = 12
_ACCELERATION = 0.4
"""k of ``accelerated`` lies evenly within this distance of 0."""
_SLANT = 0.1
"""Standard deviation of what a car's way and axis leave forward and vertical by, in shares of their length."""
_SCOPE = ("leaderboard", "points-2")


@lru_cache(maxsize=8)
def _order(seed: int) -> NDArray[Any]:
    """Which cell each problem is of: no name tells its law."""
    return generator(seed, *_SCOPE, "order").permutation(len(_CELLS) * _OF_A_CELL) % len(_CELLS)


def _cell(seed: int, number: int) -> tuple[str, str]:
    return _CELLS[int(_order(seed)[number])]


@lru_cache(maxsize=512)
def setting_by_kind(seed: int, number: int) -> Setting:
    """Of a kind of rig under a law of motion: as many problems of each pair."""
    name, law = _cell(seed, number)
    kind, rng = KINDS[name], generator(seed, *_SCOPE, "setting", number)
    ahead = np.array([0.0, 0.0, 1.0]) + _SLANT * rng.standard_normal(3)
    about = np.array([0.0, float(rng.choice([-1.0, 1.0])), 0.0]) + _SLANT * rng.standard_normal(3)
    k = float(rng.uniform(-_ACCELERATION, _ACCELERATION))
    parameters: dict[str, dict[str, Any]] = {"accelerated": {"acceleration": k}, "spline": {"preset": kind.shake}}
    return Setting(
        width=kind.width,
        height=kind.height,
        focal=kind.focal,
        depth=kind.depth,
        rotation_deg=_between(rng, kind.rotation_deg),
        translation=_between(rng, kind.translation),
        rotation_axis=tuple(about.tolist()) if kind.drives else None,
        translation_axis=tuple(ahead.tolist()) if kind.drives else None,
        motion_model=law,
        motion_parameters=parameters.get(law, {}),
        baseline=_between(rng, kind.baseline),
        noise_px=_between(rng, (0.05, 1.0)),
        readout_ratio=float(rng.uniform(*kind.readout_ratio)),
        points=int(rng.integers(40, 201)),
        outlier_ratio=float(rng.choice([0.0, 0.1, 0.3, 0.5])),
        shape="plane" if rng.random() < 0.2 else "box",
    )


def _kinds(seed: int, number: int) -> dict[str, float | str]:
    kind, law = _cell(seed, number)
    return {"motion": law, "rig": kind}


POINTS_2 = Draws(
    scope=_SCOPE,
    problems=len(_CELLS) * _OF_A_CELL,
    setting=setting_by_kind,
    outlier_images="all",
    kinds=_kinds,
)
