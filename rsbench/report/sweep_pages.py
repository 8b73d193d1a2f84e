"""The page beside the tables of the simulations that the paper does not have."""

from __future__ import annotations

from rsbench.benchmark.simulated.sweep_card import SweepCard

_INTRODUCTION = """# Simulations beyond the paper

Made by `rsbench reproduce sweeps`. One row per solver and value; `information` says which matches a solver was
given (methods that see pairs and methods that see tracks through all four images are not on a par), `_low` and
`_high` are 95 % bootstrap intervals, failures score 180 degrees, `over_bound` is the root mean square error over
its Cramer-Rao bound for that information, and `unobservable` names what the matches do not determine. Translations
of solvers of the left camera are scored against that camera's own.

| table | what | varies | noise (px) | trials | RANSAC |
|---|---|---|---|---|---|
"""


def sweeps_page(cards: list[SweepCard]) -> str:
    """Markdown that says what each table holds."""
    return _INTRODUCTION + "".join(_row(card) for card in cards)


def _row(card: SweepCard) -> str:
    noises = sorted({cell.setting.noise_px for cell in card.cells()})
    noise = f"{noises[0]:g}" if len(noises) == 1 else f"{noises[0]:g} to {noises[-1]:g}"
    ransac = "yes" if card.robust else "no"
    cells = (f"[{card.name}]({card.name}.csv)", card.description, card.axis, noise, str(card.trials), ransac)
    return f"| {' | '.join(cells)} |\n"
