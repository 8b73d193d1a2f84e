"""``python -m attack``: run the attacks, print what they counted, and write it into a document."""

from __future__ import annotations

import argparse
import datetime
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from attack.stage import say, stage

if TYPE_CHECKING:
    from attack.arena import Arena
    from attack.cases import Reference, Tally

CASES = ("generate", "evaluate", "simulate", "correct", "reproduce")
HERE = ("kills", "files", "fuzz", "environment")
ATTACKS = (*HERE, "crews", "verify")
"""The last one is ``attack.verifying``, a program of its own."""
HEADING = "| attack | counts | faults | made by |"
SHOWN = 40
"""Faults of an attack that are printed."""
READ = ("evaluate", "simulate", "correct")
"""Commands whose results loaders read."""
BEGIN, END = "<!-- figures of make attack -->", "<!-- end of the figures -->"


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How much of each attack."""

    kills: int
    """Of each command."""
    files: int | None
    """Operations of each command that fail; None: every one."""
    sizes: int
    """Limits of the size of files at which each command writes."""
    inputs: int
    surroundings: int | None
    """Pairs of a surrounding and a command; None: every one."""
    cases: tuple[str, ...] = CASES


LONG = Extent(kills=100, files=None, sizes=10, inputs=10_000, surroundings=None)
SAMPLE = Extent(kills=2, files=0, sizes=1, inputs=300, surroundings=1, cases=("generate", "correct"))


def main() -> int:
    chosen, given = _options(), sys.argv[1:]  # the commands have arguments of their own there
    extent = SAMPLE if chosen.sample else LONG
    if chosen.case:
        extent = replace(extent, cases=tuple(chosen.case))
    limits = {k: getattr(chosen, k) for k in ("kills", "files", "inputs", "surroundings") if getattr(chosen, k)}
    extent = replace(extent, **limits)
    chosen.keep.mkdir(parents=True, exist_ok=True)
    rows, faults = dict[str, str](), 0
    with tempfile.TemporaryDirectory(prefix="attack-") as root, stage(Path(root), extent.cases) as arena:
        wanted = chosen.attack or (HERE if chosen.sample else ATTACKS)
        for name, tally, seconds in _attacks(arena, extent, wanted, chosen.seed, chosen.keep):
            counts = ", ".join(f"{count} {what}" for what, count in tally.counts.items())
            rows[name] = f"{counts} | {len(tally.faults)}"
            say(f"{name}: {counts}; {len(tally.faults)} faults; {seconds:.0f} s")
            for fault in tally.faults[:SHOWN]:
                say(f"  fault: {fault}")
            if len(tally.faults) > SHOWN:
                say(f"  and {len(tally.faults) - SHOWN} more")
            faults += len(tally.faults)
    if chosen.write is not None:
        _write(chosen.write, rows, given, chosen.seed)
    return int(faults > 0)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m attack", description=__doc__)
    parser.add_argument("attack", nargs="*", choices=(*ATTACKS, []), help="which; all by default")
    parser.add_argument("--sample", action="store_true", help="a little of each, in seconds")
    parser.add_argument("--case", action="append", choices=CASES, help="command to kill and starve; repeatable")
    parser.add_argument("--kills", type=int, help="of each command")
    parser.add_argument("--files", type=int, help="operations of each command that fail; default: every one")
    parser.add_argument("--inputs", type=int, help="of all loaders together")
    parser.add_argument("--surroundings", type=int, help="pairs of one and a command, drawn; default: every one")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "attack-inputs")
    parser.add_argument("--write", type=Path, help="document whose rows of figures are replaced")
    return parser.parse_args()


def _attacks(
    arena: Arena, extent: Extent, wanted: Collection[str], seed: int, keep: Path
) -> Iterator[tuple[str, Tally, float]]:
    import numpy as np

    from attack import fuzz, kills
    from attack.cases import cases, undisturbed
    from attack.loaders import loaders

    references: dict[str, Reference] = {}
    results: dict[str, Path] = {}
    known = cases(arena)
    for number, name in enumerate(CASES):
        chosen = {"kills", "files", "environment"} & set(wanted) or ("fuzz" in wanted and name in READ)
        if name not in extent.cases or not chosen:
            continue
        references[name] = undisturbed(arena, known[name])
        results[name] = arena.root.parent / "results" / name
        shutil.copytree(arena.work / "out", results[name])
        given = arena, known[name], references[name], np.random.default_rng([seed, number])
        if "kills" in wanted:
            yield _timed(f"kills of {name}", partial(kills.attack, *given, extent.kills))
        if "files" in wanted:
            yield _timed(
                f"file operations of {name}", partial(kills.attack_files, *given, extent.files, extent.sizes)
            )
    if "fuzz" in wanted:
        every = loaders(arena.inputs, results, arena.root.parent / "fuzz")
        yield _timed(f"inputs of {len(every)} loaders", partial(fuzz.attack, every, extent.inputs, seed, keep))
    if "environment" in wanted:
        yield _timed("surroundings", partial(_surroundings, arena, references, extent, seed))
    if "crews" in wanted:
        yield from _crews(arena, extent, seed)
    if "verify" in wanted:
        yield _timed("verify", partial(_verify, seed))


def _crews(arena: Arena, extent: Extent, seed: int) -> Iterator[tuple[str, Tally, float]]:
    """Kills among processes here, and on a cluster where distributed is installed."""
    import numpy as np

    from attack import crews

    for number, where in enumerate(("workers", "a cluster")):
        if where == "workers" or find_spec("distributed"):
            rng = np.random.default_rng([seed, len(CASES), number])
            yield _timed(f"kills among {where}", partial(crews.attack, arena, rng, extent.kills, bool(number)))


def _verify(seed: int) -> Tally:
    """Planted faults and sound sequences, counted by what ``attack.verifying`` prints."""
    from attack.cases import Tally

    tests = str(Path(__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(tests).parent), tests])}
    command = [sys.executable, "-m", "attack.verifying", "--seed", str(seed)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    tally = Tally()
    for name, count in re.findall(r"^(planted faults|sound sequences): (\d+)", result.stdout, re.MULTILINE):
        tally.count(name, int(count))
    for line in result.stdout.splitlines():
        tally.check(not line.startswith("  "), line)
    tally.check(len(tally.counts) == 2, f"attack.verifying: exit code {result.returncode}: {result.stderr[-300:]}")
    return tally


def _surroundings(arena: Arena, references: dict[str, Reference], extent: Extent, seed: int) -> Tally:
    import numpy as np

    from attack import environment

    commands = [name for name in environment.COMMANDS if name in (*extent.cases, "solve", "verify")]
    pairs = [(surrounding, name) for surrounding in environment.SURROUNDINGS for name in commands]
    if extent.surroundings is not None:
        # One of strange names first, which has ended the process by a signal.
        order = np.random.default_rng([seed, len(pairs)]).permutation(len(pairs)).tolist()
        order.sort(key=lambda k: not (pairs[k][0].folder and pairs[k][1] == "correct"))
        pairs = [pairs[k] for k in order[: extent.surroundings]]
    expected = {name: reference.contents for name, reference in references.items()}
    return environment.attack(arena, expected, pairs)


def _timed(name: str, attack: Callable[[], Tally]) -> tuple[str, Tally, float]:
    start = time.monotonic()
    return name, attack(), time.monotonic() - start


def _write(document: Path, rows: dict[str, str], given: list[str], seed: int) -> None:
    """Replace rows of the table between the marks; those of other runs stay."""
    head, _, rest = document.read_text("utf-8").partition(BEGIN)
    table, _, tail = rest.partition(END)
    old = (line for line in table.splitlines() if line.startswith("| ") and line != HEADING)
    kept = {line.split(" | ")[0].removeprefix("| "): line for line in old}
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    words = [word for word in given if word not in ("--write", str(document))]
    seeded = [] if "--seed" in words else ["--seed", str(seed)]
    command = " ".join(["python -m attack", *words, *seeded])
    made = f"{day}, {os.cpu_count()} cores: `{command}`"
    kept |= {name: f"| {name} | {row} | {made} |" for name, row in rows.items()}
    lines = [BEGIN, HEADING, "|---|---|---|---|", *(kept[name] for name in sorted(kept)), END]
    document.write_text(head + "\n".join(lines) + tail, "utf-8")


if __name__ == "__main__":
    sys.exit(main())
