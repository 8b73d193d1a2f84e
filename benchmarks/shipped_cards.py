"""Whether ``verify`` passes on what the shipped cards make: sequences of each are rendered and verified.

Of a card with a grid those are taken in which every scene meets every value of every axis, and every two values of
different axes each other; ``--whole`` takes all. ``--data`` names a folder in which datasets lie already, under
the names of their cards: they are verified whole, and nothing is written there. Exits with 1 after any finding.

    python benchmarks/shipped_cards.py                          all cards
    python benchmarks/shipped_cards.py standard --whole --width 320
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain, combinations, product
from pathlib import Path
from typing import TypeVar

from rsbench.components.cards import card_path, read_toml
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.renderers.backend import set_threads, start_backend
from rsbench.verification import SequenceReport, verify_dataset

T = TypeVar("T")
Labels = tuple[str, ...]

ROOT = Path(__file__).resolve().parent.parent
HEADER = (
    "| card | width, px | sequences | of | findings | CPU-s to make | to verify |\n|---|---|---|---|---|---|---|"
)


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def labels_of(name: str) -> dict[str, tuple[Labels, str]]:
    """Of each sequence of a card: its own name and the values that it has of the axes of the grid; its seed."""
    card = read_toml(card_path("datasets", name))
    axes = [list(axis) for axis in card.get("grid", {}).values()]
    seeds = [str(seed) for seed in card.get("seeds", [])] or [""]
    made = {}
    for sequence, seed in product(card["sequence"], seeds):
        for values in product(*axes):
            labels = (sequence["name"], *values)
            made["-".join(filter(None, (*labels, seed)))] = labels, seed
    return made


def share(labels: dict[str, tuple[Labels, str]]) -> list[str]:
    """Few sequences in which every two values of different axes meet; of all seeds alike often."""

    def pairs(name: str) -> set[tuple[tuple[int, str], ...]]:
        values = list(enumerate(labels[name][0]))
        return set(combinations(values, 2)) if len(values) > 1 else {tuple(values)}

    missing = set(chain.from_iterable(map(pairs, labels)))
    used = dict.fromkeys((seed for _, seed in labels.values()), 0)
    taken: list[str] = []
    while missing:
        best = max(labels, key=lambda name: (len(pairs(name) & missing), -used[labels[name][1]]))
        missing -= pairs(best)
        used[labels[best][1]] += 1
        taken.append(best)
    return taken


def resized(card: DatasetCard, width: int) -> DatasetCard:
    """The same card with smaller pictures of the same field of view."""
    by = width / card.camera.width
    camera = replace(card.camera, width=width, height=round(card.camera.height * by), focal=card.camera.focal * by)
    return replace(card, camera=camera)


def seconds(call: Callable[[], T]) -> tuple[T, float]:
    begin = time.process_time()
    result = call()
    return result, time.process_time() - begin


def row(card: str, width: int, of: int, reports: Sequence[SequenceReport], made: float | None, took: float) -> int:
    """Print a row of the table and what was found; returns how much that is."""
    faults = [f"{report.name}: {fault}" for report in reports for fault in report.faults]
    counted = sum(report.name != "dataset.json" for report in reports)
    making = "made before" if made is None else f"{made:.0f}"
    say(f"| `{card}` | {width} | {counted} | {of} | {len(faults)} | {making} | {took:.0f} |")
    for fault in faults:
        say(f"  {fault}")
    return len(faults)


def tried(name: str, chosen: argparse.Namespace) -> int:
    """Make and verify sequences of a card; returns the number of findings."""
    card = load_dataset_card(name)
    total = len(card.sequence)
    if chosen.data is not None and (folder := chosen.data / name / "dataset.json").is_file():
        reports, took = seconds(lambda: verify_dataset(folder.parent, rerender="auto"))
        return row(name, card.camera.width, total, reports, None, took)
    if not chosen.whole:
        card = card.only(share(labels_of(name)))
    if chosen.width:
        card = resized(card, chosen.width)
    with tempfile.TemporaryDirectory(prefix="shipped-", dir=chosen.out) as temporary:
        _, made = seconds(lambda: generate_dataset(card, Path(temporary)))
        reports, took = seconds(lambda: verify_dataset(Path(temporary), rerender="auto"))
    return row(name, card.camera.width, total, reports, made, took)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cards", nargs="*", help="names of dataset cards (default: all)")
    parser.add_argument("--whole", action="store_true", help="all sequences of each card")
    parser.add_argument("--width", type=int, help="of the pictures, px (default: the card's)")
    parser.add_argument("--data", type=Path, help="folder of datasets that were made before")
    parser.add_argument(
        "--out", type=Path, help="folder for what is made, and removed again (default: a temporary one)"
    )
    chosen = parser.parse_args(arguments)
    start_backend()
    set_threads(1)  # so that its seconds are those of one CPU
    say(HEADER)
    names = chosen.cards or sorted(path.stem for path in (ROOT / "cards" / "datasets").glob("*.toml"))
    return int(sum([tried(name, chosen) for name in names]) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
