"""Kills and failing file operations: each command dies, or one operation fails, and the same command resumes.

Kills come at random moments and at random file operations. After each death nothing outside the command's folder
has changed, and no process of it is left. After each chain of deaths the same command writes what an undisturbed
one writes, byte for byte. A command that gets SIGTERM or SIGINT prints in one line how to continue.

Each file operation fails once, in a fresh run and in one over finished results: the command reports it in one line
and ends with 1 or 2, or continues. Nothing outside its folder changes, no finished result is lost, and the same
command continues afterwards.
"""

from __future__ import annotations

import errno
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from attack.arena import Arena, Ending, Trap, contents, limit_files
from attack.cases import Case, Reference, Tally, differing, here, operations_of, place, problem_of

CHAIN = 4
"""Deaths after which a command is let alone."""
STOP_S = 3.0
"""Seconds from a request to stop until the end."""


@dataclass(frozen=True, kw_only=True)
class Death:
    """One kind of death."""

    name: str
    before: Callable[[], None] | None = None
    stop: tuple[float, signal.Signals] | None = None


def attack(arena: Arena, case: Case, reference: Reference, rng: np.random.Generator, count: int) -> Tally:
    """Kill a command ``count`` times."""
    tally, kills = Tally(), 0
    while kills < count:
        place(arena)
        before, deaths, whole = arena.outside(arena.work / "out"), list[str](), False
        for _ in range(min(CHAIN, count - kills)):
            death = draw(arena, case, reference, rng)
            ending = arena.run(("--quiet", *case.arguments), before=death.before, stop=death.stop)
            deaths.append(death.name)
            whole = whole or death.stop is not None
            where = f"{case.name}, after {'; '.join(deaths)}"
            if ending.code == 0:
                tally.count("came too late")
                break
            kills += 1
            tally.count(death.name.partition(" ")[0])
            _check_death(tally, death, ending, where)
            now = arena.outside(arena.work / "out")
            lost = {name for name in before if now.get(name) != before[name]}
            tally.check(not lost, f"{where}: changed outside --out: {sorted(lost)[:5]}")
        alone = None if whole else partial(here, arena, case, Trap())  # what it would render is known
        ending = arena.run(("--quiet", *case.arguments), before=alone)
        tally.count("resumed")
        _check_resumed(arena, ending, reference, tally, before, f"{case.name}, after {'; '.join(deaths)}")
    tally.count("kills", kills)
    return tally


def draw(arena: Arena, case: Case, reference: Reference, rng: np.random.Generator) -> Death:
    """A random kind: half of them at a random moment, a third at a file operation, the rest within a file."""
    choice = rng.random()
    if choice < 0.5:
        number = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)[int(rng.integers(3))]
        seconds = float(rng.uniform(0.0, reference.seconds))
        return Death(name=f"{number.name} at {seconds:.3f} s", stop=(seconds, number))
    if choice < 0.85:
        place = int(rng.integers(1, len(reference.operations) + 1))
        trap = Trap(number=place, how="before" if rng.random() < 0.5 else "after")
        text = f"operation {place}, {trap.how}"
        return Death(name=text, before=partial(here, arena, case, trap))
    size = int(rng.integers(1, 10000))
    return Death(name=f"within a file at byte {size}", before=partial(_limit, arena, case, size))


def _limit(arena: Arena, case: Case, size: int) -> None:
    here(arena, case, Trap())
    limit_files(size, True)


def _check_death(tally: Tally, death: Death, ending: Ending, where: str) -> None:
    tally.check(not problem_of(ending), f"{where}: {problem_of(ending)}")
    if death.stop is None or death.stop[1] == signal.SIGKILL:
        return
    number = death.stop[1]
    reported = ending.code == 128 + number and any(word in ending.err for word in ("resumes", "as it was before"))
    # Before there is anything to resume a signal may end it in silence.
    tally.check(reported or ending.code == -number, f"{where}: exit code {ending.code}, {ending.err[-200:]!r}")
    late = ending.seconds - death.stop[0]
    tally.check(late < STOP_S, f"{where}: stopped after {late:.1f} s")


def _check_resumed(
    arena: Arena, ending: Ending, reference: Reference, tally: Tally, before: dict[str, str], where: str
) -> None:
    problem = problem_of(ending)
    tally.check(
        ending.code == 0 and not problem, f"{where}, resumed: exit code {ending.code}, {problem or ending.err}"
    )
    if ending.code == 0:
        found = contents(arena.work / "out")
        tally.check(
            found == reference.contents, f"{where}, resumed: differs in {differing(found, reference.contents)}"
        )
    now = arena.outside(arena.work / "out")
    tally.check(now == before, f"{where}, resumed: outside --out: {differing(now, before)}")


ERRORS = (errno.ENOSPC, errno.EACCES, errno.EIO)


def attack_files(
    arena: Arena, case: Case, reference: Reference, rng: np.random.Generator, count: int | None, sizes: int
) -> Tally:
    """Let every operation of a command fail, or ``count`` of them; and writes, at ``sizes`` random sizes."""
    tally = Tally()
    fresh = _first_of_each(reference.operations, case)
    for number in _some(fresh, rng, count):
        _attempt(arena, case, reference, tally, number, finished=False)
    place(arena)
    _run(arena, case, Trap())
    _run(arena, case, Trap())
    again = _first_of_each(operations_of(arena), case)
    for number in _some(again, rng, count):
        _attempt(arena, case, reference, tally, number, finished=True)
    for size in rng.integers(1, 20000, sizes).tolist():
        place(arena)
        text = f"{case.name}, no file may grow above {size} bytes"
        _check(arena, case, reference, tally, partial(limit_files, size, False), text, finished=False)
    return tally


def _first_of_each(operations: list[str], case: Case) -> list[int]:
    """Numbers of the operations, each kind on each path once; of ``reproduce``, those on its results."""
    first: dict[str, int] = {}
    for number, operation in enumerate(operations, start=1):
        if case.name != "reproduce" or "/results" in operation:
            first.setdefault(operation, number)
    return list(first.values())


def _some(numbers: list[int], rng: np.random.Generator, count: int | None) -> list[int]:
    if count is None or count >= len(numbers):
        return numbers
    return sorted(int(number) for number in rng.choice(numbers, count, replace=False))


def _run(arena: Arena, case: Case, trap: Trap) -> Ending:
    return arena.run(("--quiet", *case.arguments), before=partial(here, arena, case, trap))


def _attempt(arena: Arena, case: Case, reference: Reference, tally: Tally, number: int, *, finished: bool) -> None:
    place(arena)
    if finished:
        _run(arena, case, Trap())
    error = ERRORS[number % len(ERRORS)]
    before = partial(here, arena, case, Trap(number=number, error=error))
    start = "over finished results" if finished else "fresh"
    text = f"{case.name}, {start}, {errno.errorcode[error]} at operation {number}"
    _check(arena, case, reference, tally, before, text, number, finished=finished)


def _check(
    arena: Arena,
    case: Case,
    reference: Reference,
    tally: Tally,
    before: Callable[[], None],
    text: str,
    number: int | None = None,
    *,
    finished: bool,
) -> None:
    outside = arena.outside(arena.work / "out")
    ending = arena.run(("--quiet", *case.arguments), before=before)
    operations = operations_of(arena)
    where = text if number is None else f"{text} ({operations[number - 1].replace(str(arena.root), '')})"
    tally.count("failed operations")
    tally.count(f"exit code {ending.code}")
    tally.check(not problem_of(ending), f"{where}: {problem_of(ending)}")
    tally.check(ending.code in (0, 1, 2), f"{where}: exit code {ending.code}")
    lines = [line for line in ending.err.splitlines() if line.strip()]
    if ending.code and not ending.traceback:
        tally.check(len(lines) == 1 and bool(ending.errors), f"{where}: {len(lines)} lines: {ending.err}")
    found = contents(arena.work / "out")
    if finished or ending.code == 0:
        lost = {name: digest for name, digest in reference.contents.items() if found.get(name) != digest}
        tally.check(not lost, f"{where}, exit code {ending.code}: lost or changed {sorted(lost)[:5]}")
    _check_resumed(arena, _run(arena, case, Trap()), reference, tally, outside, where)
