"""``python -m attack.verifying``: every planted fault and many sound sequences, and what verify says of them."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from attack.clean_sequences import false_alarms
from attack.planted_cameras import CAMERA_FAULTS, card_of
from attack.planted_faults import FAULTS
from attack.planting import found, planted
from attack.stage import say
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset


def missed_faults(root: Path) -> int:
    """How many planted faults verify does not name, in the smoke dataset and in those of other cameras."""
    bases = {"smoke": (load_dataset_card("smoke"), FAULTS)}
    bases |= {name: (card_of(name), faults) for name, faults in CAMERA_FAULTS.items()}
    start, count, missed = time.perf_counter(), 0, 0
    for name, (card, faults) in bases.items():
        generate_dataset(card, root / name)
        for fault in faults:
            named, lines = found(fault, planted(fault, root / name, root / "planted"))
            count += 1
            if not named:
                missed += 1
                say(f"  missed: {name}: {fault.name}: {lines}")
    say(f"planted faults: {count}, {missed} missed; {time.perf_counter() - start:.0f} s")
    return missed


def alarms(root: Path, count: int, seed: int, scenes: list[str]) -> int:
    """How many findings verify has in ``count`` sound sequences of these scenes; of none: of all."""
    start, made, alarmed, walls = time.perf_counter(), 0, 0, 0
    for name, sequences, refused, faults in false_alarms(count, root, seed, scenes):
        made, alarmed, walls = made + sequences, alarmed + len(faults), walls + refused
        for fault in faults:
            say(f"  false alarm: {name}: {fault}")
    seconds = time.perf_counter() - start
    say(f"sound sequences: {made}, {alarmed} false alarms; {walls} motions refused; {seconds:.0f} s")
    return alarmed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m attack.verifying", description=__doc__)
    parser.add_argument("--clean", type=int, default=200, help="sound sequences")
    parser.add_argument("--seed", type=int, default=0, help="of their cards")
    parser.add_argument("--no-faults", action="store_true", help="only sound sequences")
    parser.add_argument("--scenes", nargs="+", default=[], help="of sound sequences: names of cards")
    parser.add_argument("--keep", type=Path, help="folder for the datasets; those with alarms stay")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="attack-") as temporary:
        root = chosen.keep or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        missed = 0 if chosen.no_faults else missed_faults(root)
        return int(missed + alarms(root, chosen.clean, chosen.seed, chosen.scenes) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
