"""Sweep cards: one parameter of a simulated experiment varies, all others stay as the card states them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from rsbench.benchmark.simulated.simulation import GYRO_RATE, SceneShape, SimulationOptions, random_direction, unit
from rsbench.components.cards import card_path, load_card, parse_card
from rsbench.components.imports import search
from rsbench.components.motion_models import drawn_parameters, fixed_endpoint, make_motion
from rsbench.components.rig_tables import RigTables, load_rig
from rsbench.core.arguments import check_whole
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import naming
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.storage.untrusted_files import check_name

Axis = Literal[
    "noise_px",
    "rotation_deg",
    "translation",
    "readout_ratio",
    "readout_ratio_error",
    "baseline",
    "points",
    "outlier_ratio",
    "gyro_noise_deg",
    "gyro_bias_deg",
    "gyro_delay",
    "gravity_noise_deg",
    "affine_noise",
]
Vector = tuple[float, float, float]
_IDEAL = ("width", "height", "focal")
"""What ``rig_card`` stands in place of."""
_NOISE = ("noise_px", "gyro_noise_deg", "gyro_bias_deg", "gyro_delay", "gravity_noise_deg", "affine_noise")
"""Errors of what is given, which are options of ``simulate`` of the same names."""


@lru_cache(maxsize=64)
def _rig_tables(name: str) -> RigTables:
    return load_rig(name)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One simulated experiment; the paper leaves depth, points, rotation, translation and baseline open."""

    width: int = None  # pyrefly: ignore[bad-assignment]
    """Width of the images, pixels. Required, unless there is a ``rig_card``, as is all that follows."""
    height: int = None  # pyrefly: ignore[bad-assignment]
    """Height of the images, pixels."""
    focal: float = None  # pyrefly: ignore[bad-assignment]
    """Focal length, pixels; the principal point is centred."""
    baseline: float = None  # pyrefly: ignore[bad-assignment]
    """Full distance between the cameras, metres; beside a ``rig_card``, in place of the calibration's."""
    readout_ratio: float = None  # pyrefly: ignore[bad-assignment]
    """Readout time over frame period of the shutter that makes the images, 0 to 1; beside a ``rig_card``, where
    that does not state it."""
    rig_card: RigTables | str | None = None
    """Name of a rig card (``rsbench list rigs``) or a path to one, or its tables: two calibrated cameras, in place
    of two equal aligned ones."""
    points: int
    """Matches over time per camera, of points of its own; and tracks, for solvers that need all four images."""
    depth: tuple[float, float]
    """Range of depths in frame 0, metres, uniform."""
    rotation_deg: float
    """Angle of the rotation in one frame period, degrees."""
    translation: float
    """Length of the translation in one frame period, metres."""
    noise_px: float
    """Standard deviation of the noise on every pixel coordinate."""
    rotation_axis: Vector | None = None
    """Axis of the rotation, of any length. Absent: drawn uniformly for every trial."""
    translation_axis: Vector | None = None
    """Direction of the translation, of any length. Absent: drawn uniformly for every trial."""
    motion_model: str = "linear"
    """Name of the motion model that makes the matches; solvers assume their own."""
    motion_parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the motion model; absent ones have its defaults, or are drawn for every trial (a shake's
    seed)."""
    shape: SceneShape = "box"
    """``box``: points at random depths; ``plane``: points on one slanted plane in the middle of the range."""
    outlier_ratio: float = 0.0
    """Share of matches whose frame-1 pixels are replaced by others, 0 to below 1."""
    outlier_px: float = 80.0
    """Outliers lie uniformly within this distance, per coordinate, of the truth, px."""
    readout_ratio_error: float = 0.0
    """Readout ratio that the solver is given minus the true one."""
    gyro_noise_deg: float = 0.0
    """Standard deviation of a gyroscope's sample on each axis, degrees per frame period; of solvers that need
    one."""
    gyro_bias_deg: float = 0.0
    """Length of what is added to all gyroscope samples, degrees per frame period."""
    gyro_delay: float = 0.0
    """Frame periods by which gyroscope samples say that they are later than they are."""
    gravity_noise_deg: float = 0.0
    """Standard deviation of the two angles of the direction of gravity, degrees; of solvers that need it."""
    affine_noise: float = 0.0
    """Standard deviation of the noise on every number of an affine frame, as a share of its size; of solvers that
    need them."""

    def __post_init__(self) -> None:
        for name in ("rotation_deg", "translation", "noise_px", "outlier_px"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in ("rotation_axis", "translation_axis"):
            if getattr(self, name) is not None and not any(getattr(self, name)):
                raise ValueError(f"{name} must not be zero")
        check_whole("points", self.points, 1, 100_000)
        if not 0 <= self.outlier_ratio < 1:
            raise ValueError(f"outlier_ratio must lie in [0, 1), got {self.outlier_ratio}")
        if not 0 < self.depth[0] <= self.depth[1]:
            raise ValueError(f"depth must be two positive numbers in order, got {list(self.depth)}")
        if self.rig_card is not None and (given := [name for name in _IDEAL if getattr(self, name) is not None]):
            raise ValueError(f"rig_card and {given[0]} exclude each other")
        tables = self.tables
        needed = (*_IDEAL, "baseline", "readout_ratio") if tables is None else ("readout_ratio",)
        for name in needed if tables is None or tables.readout_ratio is None else ():
            if getattr(self, name) is None:
                raise ValueError(f"{name!r} is required")
        self.rig()
        self.shutter()
        self.given_shutter()
        if fixed_endpoint(self.motion_model, self.motion_parameters) is not None:
            raise ValueError("motion_parameters must leave the motion free: rotation_deg and translation set it")
        self.motion(np.random.default_rng(0))

    @property
    def record(self) -> dict[str, Any]:
        """For JSON, without the keys of another kind of rig."""
        of_rigs = (*_IDEAL, "baseline", "readout_ratio", "rig_card")
        return {name: value for name, value in asdict(self).items() if value is not None or name not in of_rigs}

    @property
    def tables(self) -> RigTables | None:
        """Those of ``rig_card``."""
        return _rig_tables(self.rig_card) if isinstance(self.rig_card, str) else self.rig_card

    def rig(self) -> StereoRig:
        tables = self.tables
        if tables is None:
            camera = PinholeCamera.centred(self.width, self.height, self.focal)
            return StereoRig(camera=camera, baseline=self.baseline)
        return tables.rig() if self.baseline is None else replace(tables.rig(), baseline=self.baseline)

    def shutter(self) -> RollingShutter:
        """The shutter that made the images."""
        tables = self.tables
        if tables is None:
            return RollingShutter(height=self.height, readout_ratio=self.readout_ratio)
        ratio = self.readout_ratio if tables.readout_ratio is None else tables.readout_ratio
        return self.rig().shutter_of(tables.scanning or Scanning(), ratio)

    def given_shutter(self) -> RollingShutter:
        """The shutter that the solver is given."""
        shutter = self.shutter()
        return shutter.with_ratio(shutter.readout_ratio + self.readout_ratio_error)

    def motion(self, rng: np.random.Generator) -> Motion:
        """Motion of one trial; equal generators give equal random directions, whatever the magnitudes."""
        random = (random_direction(rng), random_direction(rng))
        axes = []
        for given, drawn in zip((self.rotation_axis, self.translation_axis), random, strict=True):
            axis = drawn if given is None else np.asarray(given, dtype=np.float64)
            axes.append(unit(axis))
        w, d = np.deg2rad(self.rotation_deg) * axes[0], self.translation * axes[1]
        parameters = drawn_parameters(self.motion_model, self.motion_parameters, rng)
        return make_motion(self.motion_model, w, d, parameters)

    def options(self, tracks: bool) -> SimulationOptions:
        """What ``simulate`` needs; ``tracks`` requests points in all four images besides the pairs."""
        same = (*_NOISE, "outlier_ratio", "outlier_px", "depth", "shape")
        return SimulationOptions(
            pairs=self.points,
            tracks=self.points if tracks else 0,
            gyro_rate=GYRO_RATE,
            gravity=True,
            affine=True,
            **{name: getattr(self, name) for name in same},
        )

    def exact(self) -> Setting:
        """The setting of the same matches without noise and with the truth for the solver."""
        return replace(self, **dict.fromkeys((*_NOISE, "readout_ratio_error"), 0.0))

    def changed(self, changes: Mapping[str, Any], where: str) -> Setting:
        """The setting with some fields replaced.

        Raises:
            RsbenchError: one line beginning with ``where`` if a field does not exist or cannot have its value.
        """
        return parse_card(Setting, self.record | dict(changes), where)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The whole sweep once more, with some fields of the setting replaced."""

    name: str
    """Name of the variant, in files and tables."""
    setting: dict[str, Any] = field(default_factory=dict)
    """Fields of the setting with the values that they have in this variant."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One value of the axis in one variant: the unit of which statistics are taken."""

    index: int
    variant: str
    value: float
    setting: Setting


@dataclass(frozen=True, kw_only=True)
class SweepCard:
    """An experiment on simulated points."""

    name: str
    """Name of the sweep, in files and tables."""
    description: str = ""
    """One line for ``rsbench list sweeps``."""
    axis: Axis
    """The field of the setting that varies."""
    values: tuple[float, ...]
    """Values of the field ``axis``, all different; each is an experiment of its own."""
    solvers: tuple[str, ...]
    """Solver cards, by name or path."""
    trials: int = 300
    """Repetitions per value, each with a scene, a motion and noise of its own."""
    seed: int = 0
    """Seed of every trial's scene, motion and noise."""
    robust: bool = False
    """Whether solvers run inside RANSAC; without it they see all matches, as in the paper."""
    setting: Setting
    """The experiment, but for the field that varies."""
    variant: tuple[Variant, ...] = (Variant(name="all"),)
    """Repeats of the whole sweep with other settings; absent: one, of the setting as it is."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if not self.values or len(set(self.values)) < len(self.values):
            raise ValueError("values must be different numbers, at least one")
        if not self.solvers or len(set(self.solvers)) < len(self.solvers):
            raise ValueError("solvers must be different names, at least one")
        names = [variant.name for variant in self.variant]
        if not names or len(set(names)) < len(names):
            raise ValueError("each [[variant]] needs a name of its own")
        check_whole("trials", self.trials, 1, 1_000_000)
        for cell in self.cells():
            tables = cell.setting.tables
            if self.axis == "readout_ratio" and tables is not None and tables.readout_ratio is not None:
                raise ValueError(f"axis = 'readout_ratio': the rig of variant {cell.variant!r} states its own")

    def cells(self) -> list[Cell]:
        """All cells, variant by variant."""
        cells: list[Cell] = []
        for variant in self.variant:
            base = self.setting.changed(variant.setting, f"variant {variant.name!r}")
            for value in self.values:
                number = int(value) if self.axis == "points" and value == int(value) else value
                setting = base.changed({self.axis: number}, f"variant {variant.name!r}, {self.axis} = {value:g}")
                cells.append(Cell(index=len(cells), variant=variant.name, value=value, setting=setting))
        return cells

    def with_setting(self, **changes: Any) -> SweepCard:
        """The same sweep with fields of its base setting replaced."""
        return replace(self, setting=self.setting.changed(changes, f"sweep {self.name}"))


def load_sweep(name_or_path: str) -> SweepCard:
    """Sweep card by name or path; errors as ``rsbench.components.cards.load_card``."""
    search(card_path("sweeps", name_or_path))
    return load_card(SweepCard, "sweeps", name_or_path)


def with_options(
    card: SweepCard, solvers: list[str] | None, trials: int | None, seed: int | None = None
) -> SweepCard:
    """The card with what the command line replaces.

    Raises:
        RsbenchError: a value that a card could not have either.
    """
    given: dict[str, Any] = {"solvers": tuple(solvers) if solvers else None, "trials": trials, "seed": seed}
    with naming(f"sweep {card.name}"):
        return replace(card, **{name: value for name, value in given.items() if value is not None})
