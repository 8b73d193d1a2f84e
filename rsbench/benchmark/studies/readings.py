"""The paper's solver in every reading, and the settings that the paper does not state: what a verdict depends on.

The paper does not say how A is scaled, in which unit the baseline enters it, how w, the length of d and its sign
come out of X, or which nine matches are taken where there are more; nor depth, rotation, translation, baseline and
number of matches of its simulation.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from rsbench.benchmark.simulated.sweep_card import SweepCard, Variant
from rsbench.storage.files import write_bytes

SETTINGS: dict[str, tuple[Any, Any]] = {
    "depth": ((2.0, 10.0), (5.0, 50.0)),
    "rotation_deg": (0.5, 5.0),
    "translation": (0.1, 1.0),
    "baseline": (0.2, 0.6),
    "points": (9, 100),
}
"""Settings that the paper leaves open; a sweep's own axis is left out of its grid."""
GRID_NOISE_PX, GRID_TRIALS = 1e-3, 100


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One way to read the paper's solver; the fields are parameters of ``LinearSolver``, by default literal."""

    scaling: str = "none"
    baseline_unit: str = "metre"
    extraction: str = "full"
    sign: str = "cheirality"
    scale: str = "rotation"
    sampling: str = "all"
    terms: str = "second"

    def __str__(self) -> str:
        """What differs from the literal reading."""
        literal = asdict(LITERAL)
        words = [f"{name} by {v}" if name in ("scale", "sign") else v for name, v in asdict(self).items()]
        changed = [word for word, (name, v) in zip(words, asdict(self).items(), strict=True) if v != literal[name]]
        return ", ".join(changed) or "literal"

    @property
    def name(self) -> str:
        """Of its solver card."""
        return f"reading-{str(self).replace(', ', '-').replace(' ', '-')}"

    @property
    def complete(self) -> Reading:
        """The same with all 27 unknowns."""
        return replace(self, terms="third")


LITERAL = Reading()
_A_AND_UNIT = (("none", "metre"), ("none", "half-baseline"), ("unit-columns", "metre"))
"""Columns of unit length undo the unit of the baseline."""
_EXTRACTIONS = ("full", "symmetric")
SOLVER_READINGS = (
    *(Reading(scaling=a, baseline_unit=unit, extraction=e) for (a, unit), e in product(_A_AND_UNIT, _EXTRACTIONS)),
    *(Reading(extraction=extraction, sign="scale") for extraction in _EXTRACTIONS),
)
"""What e_R and e_T feel, given more matches than unknowns; the literal one first."""
NINE_READINGS = tuple(r for r in SOLVER_READINGS if (r.scaling, r.baseline_unit) == _A_AND_UNIT[0])
"""With nine matches per camera A X = 0 has an exact solution, which no scaling changes."""
APART = tuple(Reading(extraction=extraction, sampling="nine-apart") for extraction in _EXTRACTIONS)
"""Nine of a hundred matches, as far apart as can be."""


def readings_of(sweep: str, points: int | None) -> tuple[Reading, ...]:
    """The readings that a sweep is run with; ``points`` per camera, None where the sweep varies them."""
    found = NINE_READINGS if points == 9 else SOLVER_READINGS
    cheirality = [reading for reading in found if reading.sign == "cheirality"]
    if sweep == "noise":
        found += tuple(replace(reading, scale="constraint") for reading in cheirality)
    if sweep == "rotation" and points == 100:
        found += tuple(reading.complete for reading in found)
    return (*found, *APART) if points == 100 else found


def write_cards(folder: Path, readings: tuple[Reading, ...]) -> tuple[str, ...]:
    """Paths of solver cards below ``folder``, one per reading."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for reading in readings:
        path = folder / f"{reading.name}.toml"
        lines = ['class = "rsbench.solvers.linear:LinearSolver"', f'description = "{reading}"', "[parameters]"]
        lines += [f'{name} = "{value}"' for name, value in asdict(reading).items()]
        write_bytes(path, ("\n".join(lines) + "\n").encode())
        paths.append(str(path))
    return tuple(paths)


def settings_card(card: SweepCard, solvers: tuple[str, ...]) -> SweepCard:
    """A sweep once per setting of the grid, at the paper's noise in pixels.

    The grid is half of all corners, such that each two choices meet equally often (a half fraction).
    """
    fields = {name: values for name, values in SETTINGS.items() if name != card.axis}
    variants = []
    for corner in product((0, 1), repeat=len(fields)):
        if sum(corner) % 2:
            continue
        setting = {name: values[k] for (name, values), k in zip(fields.items(), corner, strict=True)}
        name = ", ".join(f"{key} {value}" for key, value in setting.items())
        if card.axis != "noise_px":
            setting["noise_px"] = GRID_NOISE_PX
        variants.append(Variant(name=name, setting=setting))
    values = tuple(v for v in card.values if card.axis != "noise_px" or v <= GRID_NOISE_PX)
    return replace(card, solvers=solvers, variant=tuple(variants), trials=GRID_TRIALS, values=values)
