"""Kills: each command dies again and again, at random moments and at random file operations, and is resumed.

After each death: nothing outside its folder has changed, and no process of it lives on. After each chain of deaths
the same command, let alone, makes what an undisturbed one makes, byte for byte, and leaves nothing beside it. One
that is asked to stop, by SIGTERM or SIGINT, says in one line how to go on.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from attack.arena import Arena, Ending, contents
from attack.cases import Case, Reference, Tally, differing, here, place, problem_of
from attack.injection import Trap, limit_files

CHAIN = 4
"""Deaths after which a command is let alone."""
STOP_S = 3.0
"""Seconds from a request to stop until the end."""


@dataclass(frozen=True, kw_only=True)
class Death:
    """One way to die."""

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
        _check_resumed(arena, ending, reference, tally, before, f"{case.name}, after {'; '.join(deaths)}")
    tally.count("kills", kills)
    return tally


def draw(arena: Arena, case: Case, reference: Reference, rng: np.random.Generator) -> Death:
    """A random way: half of them at a random moment, a third at a file operation, the rest within a file."""
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
    told = ending.code == 128 + number and any(word in ending.err for word in ("resumes", "as it was before"))
    # Before there is anything to resume a signal may end it in silence.
    tally.check(told or ending.code == -number, f"{where}: exit code {ending.code}, {ending.err[-200:]!r}")
    late = ending.seconds - death.stop[0]
    tally.check(late < STOP_S, f"{where}: stopped after {late:.1f} s")


def _check_resumed(
    arena: Arena, ending: Ending, reference: Reference, tally: Tally, before: dict[str, str], where: str
) -> None:
    tally.count("resumed")
    problem = problem_of(ending)
    tally.check(
        ending.code == 0 and not problem, f"{where}, resumed: exit code {ending.code}, {problem or ending.err}"
    )
    if ending.code:
        return
    found = contents(arena.work / "out")
    tally.check(
        found == reference.contents, f"{where}, resumed: differs in {differing(found, reference.contents)}"
    )
    now = arena.outside(arena.work / "out")
    tally.check(now == before, f"{where}, resumed: outside --out: {differing(now, before)}")
