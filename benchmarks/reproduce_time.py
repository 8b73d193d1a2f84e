"""How long ``rsbench reproduce everything`` takes, from shares of each target that are run for it.

    python benchmarks/reproduce_time.py [FOLDER]

Simulations run with two small numbers of trials and images with one and two seeds, and a straight line through
both gives the whole. Of the rendered strata three sequences, one per scene, are rendered, drawn and corrected, and
two of the real camera's: what starts with each command is counted for each share, so that these are upper bounds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsbench.benchmark.leaderboard import splits
from rsbench.benchmark.simulated import sweep_card
from rsbench.benchmark.studies import readings
from rsbench.cli import reproduce as command
from rsbench.cli import reproduce_correction
from rsbench.cli.generate import generate
from rsbench.cli.reproduce import Target
from rsbench.dataset import card as dataset_card
from rsbench.dataset.sequence import read_dataset

THREE = ["castle-2", "old-town-2", "room-2"]
TWO_REAL = ["castle-aggressive-2", "room-mild-2"]
SEEDS = 20
RENDERED_FIRST, RENDERED_LATER, CORRECTED, PANELS, MATCHED, REAL = 63, 40, 100, 9, 4, 64
"""Sequences of fig4: rendered first; that correction renders more; that it corrects; drawn in fig4; of sgm; and
of each camera of the real study."""


@contextmanager
def patched(place: Any, **values: Any) -> Iterator[None]:
    before = {name: getattr(place, name) for name in values}
    vars(place).update(values)
    try:
        yield
    finally:
        vars(place).update(before)


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def seconds_of(work: Callable[[], object]) -> float:
    start = time.monotonic()
    work()
    return time.monotonic() - start


def reproduce(target: Target, folder: Path, seeds: int | None = None) -> float:
    return seconds_of(lambda: command.reproduce(target, folder / "results", folder / "data", None, seeds))


def simulated(target: Target, folder: Path, share: float) -> float:
    """Seconds of this share of all trials."""
    load = sweep_card.load_sweep

    def short(name: str) -> sweep_card.SweepCard:
        card = load(name)
        return replace(card, trials=round(card.trials * share))

    with patched(sweep_card, load_sweep=short), patched(readings, GRID_TRIALS=round(100 * share)):
        return reproduce(target, folder / str(share))


def board(folder: Path, problems: int) -> float:
    """Seconds of the leaderboard with so many of its problems."""
    with patched(splits, POINTS_PROBLEMS=problems):
        return reproduce(Target.leaderboard, folder / str(problems))


def line(few: float, more: float, share_few: float, share_more: float) -> float:
    """Seconds of the whole, from those of two shares."""
    return more + (more - few) * (1.0 - share_more) / (share_more - share_few)


def rendered(folder: Path) -> dict[str, float]:
    """Seconds of one sequence: rendered, drawn in Figure 4, corrected by all methods of the study, matched."""
    data = folder / "data"
    found = {"render": seconds_of(lambda: generate("moderate", str(data / "moderate"), THREE))}
    with patched(
        reproduce_correction,
        _generate=lambda card, data: None,  # it is there
        _FIG4=(("moderate", "-2"),),
        STRATA=("moderate",),
        _SGM=(("moderate", "castle-2"),),
    ):
        found["panels"] = reproduce(Target.fig4, folder)
        found["correct"] = reproduce(Target.correction, folder)
        match = reproduce(Target.sgm, folder)
    assert len(read_dataset(data / "moderate")) == len(THREE)
    return {name: seconds / len(THREE) for name, seconds in found.items()} | {"match": match}


def real(folder: Path) -> float:
    """Seconds of one sequence of both cameras."""
    load = dataset_card.load_dataset_card
    with (
        patched(dataset_card, load_dataset_card=lambda name: load(name).only(TWO_REAL)),
        patched(reproduce_correction, _SHOWN=TWO_REAL[0]),
    ):
        return reproduce(Target.real, folder) / len(TWO_REAL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="keeps what is made; default: a temporary folder")
    given = parser.parse_args().folder
    folder = given or Path(tempfile.mkdtemp(prefix="rsbench-time-"))
    whole = {}
    for target in (Target.claims, Target.readings, Target.sweeps):
        few, more = (simulated(target, folder, share) for share in (0.03, 0.06))
        whole[target.value] = line(few, more, 0.03, 0.06)
        say(f"{target}: {few:.0f} and {more:.0f} s of 3 and 6 %")
    few, more = board(folder, 10), board(folder, 20)
    whole["leaderboard"] = line(few, more, 10 / splits.POINTS_PROBLEMS, 20 / splits.POINTS_PROBLEMS)
    say(f"leaderboard: {few:.0f} and {more:.0f} s of 10 and 20 problems")
    one = reproduce(Target.images, folder / "one", 1)
    two = reproduce(Target.images, folder / "two", 2)
    whole["images"] = line(one, two, 1 / SEEDS, 2 / SEEDS)
    say(f"images: {one:.0f} and {two:.0f} s of 1 and 2 seeds")
    each = rendered(folder / "strata")
    say(", ".join(f"{name} {seconds:.0f} s" for name, seconds in each.items()) + " a sequence")
    whole["fig4"] = RENDERED_FIRST * each["render"] + PANELS * each["panels"]
    whole["correction"] = RENDERED_LATER * each["render"] + CORRECTED * each["correct"]
    whole["sgm"] = MATCHED * each["match"]
    whole["real"] = REAL * real(folder / "real")
    for name, seconds in whole.items():
        say(f"{name:12} {seconds / 60:6.1f} min")
    say(f"{'everything':12} {sum(whole.values()) / 3600:6.1f} h")


if __name__ == "__main__":
    main()
