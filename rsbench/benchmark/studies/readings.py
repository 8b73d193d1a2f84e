"""The paper's solver in every reading, in settings that the paper does not state: what a verdict depends on.

The paper does not say how A is scaled, in which unit the baseline enters it, or how w and the sign of d come out
of X; nor depth, rotation, translation, baseline and number of matches of its simulation. A claim is refuted only
where its most favourable reading fails, so every claim is judged in all of them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from rsbench.benchmark.simulated.sweep_card import SweepCard, Variant
from rsbench.benchmark.studies.claims import (
    CLAIMS,
    GLOBAL,
    MEASURES,
    READINGS,
    Centre,
    Claim,
    series,
    verdict,
)
from rsbench.dataset.files import write_bytes

CHOICES: dict[str, tuple[str, ...]] = {
    "scaling": ("none", "unit-columns"),
    "baseline_unit": ("metre", "half-baseline"),
    "extraction": ("full", "symmetric"),
    "sign": ("cheirality", "scale"),
}
"""Choices that the paper leaves open and that e_R or e_T feel; the first of each is the literal one."""
SETTINGS: dict[str, tuple[Any, ...]] = {
    "depth": ((2.0, 10.0), (5.0, 50.0)),
    "rotation_deg": (0.5, 2.0, 5.0),
    "translation": (0.1, 0.3, 1.0),
    "baseline": (0.2, 0.6),
    "points": (9, 20, 100),
}
"""Settings that the paper leaves open; a sweep's own axis is left out of its grid."""
GRID_NOISE_PX, GRID_TRIALS = 1e-3, 100


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One way to read the paper's solver; the fields are parameters of ``LinearSolver``."""

    scaling: str
    baseline_unit: str
    extraction: str
    sign: str

    def __str__(self) -> str:
        """What differs from the literal reading."""
        changed = [value for name, value in asdict(self).items() if value != CHOICES[name][0]]
        return ", ".join(changed) or "literal"


SOLVER_READINGS = tuple(
    Reading(**dict(zip(CHOICES, values, strict=True))) for values in product(*CHOICES.values())
)
"""All readings; the literal one first."""


def write_cards(folder: Path, readings: tuple[Reading, ...]) -> dict[str, Reading]:
    """A solver card per reading below ``folder``; the readings by the paths of their cards."""
    folder.mkdir(parents=True, exist_ok=True)
    cards = {}
    for number, reading in enumerate(readings):
        path = folder / f"reading-{number:02d}.toml"
        lines = ['class = "rsbench.solvers.linear:LinearSolver"', f'description = "{reading}"', "[parameters]"]
        lines += [f'{name} = "{value}"' for name, value in asdict(reading).items()]
        write_bytes(path, ("\n".join(lines) + "\n").encode())
        cards[str(path)] = reading
    return cards


def readings_card(card: SweepCard, cards: dict[str, Reading]) -> SweepCard:
    """A sweep of the paper over all readings beside the global-shutter algorithm."""
    return replace(card, solvers=(*cards, GLOBAL))


def settings_card(card: SweepCard, cards: dict[str, Reading]) -> SweepCard:
    """The same sweep once per setting of the grid, at the paper's noise in pixels."""
    fields = {name: values for name, values in SETTINGS.items() if name != card.axis}
    variants = []
    for values in product(*fields.values()):
        setting = dict(zip(fields, values, strict=True))
        if card.axis != "noise_px":
            setting["noise_px"] = GRID_NOISE_PX
        name = ", ".join(f"{key} {value}" for key, value in setting.items() if key != "noise_px")
        variants.append(Variant(name=name, setting=setting))
    return replace(card, solvers=(*cards, GLOBAL), variant=tuple(variants), trials=GRID_TRIALS)


def judge_readings(tables: dict[str, dict[str, pd.DataFrame]], cards: dict[str, Reading]) -> pd.DataFrame:
    """One row per claim, number of matches, reading of the noise, statistic and reading of the solver.

    Args:
        tables: summaries of ``readings_card`` sweeps, by the matches given ("9 + 9") and the name of the sweep.
        cards: as ``write_cards`` gave them.

    Raises:
        RsbenchError: a summary lacks a solver or a variant.
    """
    rows = []
    for claim, (matches, sweeps), noise in product(CLAIMS, tables.items(), READINGS):
        if claim.sweep not in sweeps:
            continue
        table, variant = sweeps[claim.sweep], noise
        if claim.sweep == "noise":
            table, variant = table[table.value <= READINGS[noise]], str(table.variant.iloc[0])
        for statistic, path in product(_statistics(claim), cards):
            row = {"claim": claim.key, "matches": matches, "noise": noise, "statistic": statistic}
            judged = _judged(claim, table, Path(path).stem, variant, statistic)
            rows.append(row | {"reading": str(cards[path])} | asdict(cards[path]) | judged)
    return pd.DataFrame(rows)


def judge_settings(tables: dict[str, pd.DataFrame], cards: dict[str, Reading]) -> pd.DataFrame:
    """One row per claim, setting of the grid and reading: verdict on the paper's statistic, the mean.

    Args:
        tables: summaries of ``settings_card`` sweeps by the name of the sweep.
        cards: as ``write_cards`` gave them.

    Raises:
        RsbenchError: a summary lacks a solver or a variant.
    """
    rows = []
    for claim in CLAIMS:
        if claim.sweep not in tables:
            continue
        table = tables[claim.sweep]
        for variant, path in product(table.variant.unique(), cards):
            judged = _judged(claim, table, Path(path).stem, variant, "mean")
            rows.append({"claim": claim.key, "setting": variant, "reading": str(cards[path])} | judged)
    return pd.DataFrame(rows)


def _statistics(claim: Claim) -> tuple[Centre, ...]:
    return ("mean", "median") if claim.measures == MEASURES else ("mean",)


def _judged(claim: Claim, table: pd.DataFrame, solver: str, variant: str, statistic: Centre) -> dict[str, Any]:
    figures, other = (series(table, name, variant, statistic) for name in (solver, GLOBAL))
    checks = claim.check(figures, other)
    # With one value below the noise that a reading allows there is nothing to compare.
    share = sum(check.holds for check in checks) / len(checks) if checks else 1.0
    return {"verdict": verdict(checks, claim.axis), "share": share}


def best_readings(judged: pd.DataFrame) -> pd.DataFrame:
    """Per claim, matches and noise: the literal verdict on the mean, and the best over readings and statistics."""
    rows = []
    for keys, group in judged.groupby(["claim", "matches", "noise"], sort=False):
        literal = group[(group.reading == "literal") & (group.statistic == "mean")].iloc[0]
        best = group.sort_values("share", ascending=False, kind="stable").iloc[0]
        rows.append(
            dict(zip(("claim", "matches", "noise"), keys, strict=True))
            | {
                "literal": literal.verdict,
                "best": best.verdict,
                "best_reading": best.reading,
                "best_statistic": best.statistic,
                "holding": int((group[group.statistic == literal.statistic].share == 1.0).sum()),
                "readings": group.reading.nunique(),
            }
        )
    return pd.DataFrame(rows)


def holding_settings(judged: pd.DataFrame) -> pd.DataFrame:
    """Per claim and reading: in how many settings of the grid the claim holds throughout, and how many it has."""
    groups = judged.groupby(["claim", "reading"], sort=False).share
    return groups.agg(holding=lambda share: int((share == 1.0).sum()), settings="size").reset_index()
