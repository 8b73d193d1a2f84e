"""Failing file operations: each one fails once, in a fresh run and in one over finished results.

A full disk, a missing permission, a broken device: the command says so in one line and ends with 1 or 2, or does
without. Nothing outside its folder changes, no finished result is lost, and the same command goes on afterwards.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial

import numpy as np

from attack.arena import Arena, Ending, contents
from attack.cases import Case, Reference, Tally, differing, here, log_of, place, problem_of
from attack.injection import Trap, limit_files, read_log

ERRORS = (errno.ENOSPC, errno.EACCES, errno.EIO)


def attack(
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
    again = _first_of_each(read_log(log_of(arena)), case)
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
    operations = read_log(log_of(arena))
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
    resumed = _run(arena, case, Trap())
    problem = problem_of(resumed) or resumed.err
    tally.check(resumed.code == 0, f"{where}, resumed: exit code {resumed.code}, {problem}")
    if resumed.code == 0:
        found = contents(arena.work / "out")
        tally.check(
            found == reference.contents, f"{where}, resumed: differs in {differing(found, reference.contents)}"
        )
    now = arena.outside(arena.work / "out")
    tally.check(now == outside, f"{where}, resumed: outside --out: {differing(now, outside)}")
