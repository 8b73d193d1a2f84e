"""``rsbench leaderboard smoke``: what a change of code moved, in a minute."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.console import echo
from rsbench.cli.names import complete

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.smoke import Job

_COMMAND = "rsbench leaderboard smoke --write"
EPILOG = """[bold]Examples[/bold]

  rsbench leaderboard smoke                                [dim](all tracks; a minute on two cores)[/dim]

  rsbench leaderboard smoke --track depth --track correction

  rsbench leaderboard smoke --track points --entry rs-stereo-refined --entry mine.toml --problems 2

  rsbench leaderboard smoke --track pose --write           [dim](its new scores are right: store them)[/dim]

More: [bold]rsbench docs submit[/bold]"""


def smoke(
    stored: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the stored scores.")] = Path(
        "results/leaderboard/smoke"
    ),
    track: Annotated[list[str] | None, typer.Option(help="Only this track; repeatable. Default: all.")] = None,
    entry: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this entry; repeatable. Default: all of our solvers on points, a few of the others.",
            autocompletion=complete("solvers"),
        ),
    ] = None,
    problems: Annotated[
        int | None, typer.Option(min=1, help="Only the first ones; default: 6 of points, all 3 of the others.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The dataset leaderboard-smoke, if you have it. Default: render it."),
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core.")] = None,
    write: Annotated[bool, typer.Option("--write", help="Store the scores instead of comparing.")] = False,
) -> None:
    """Run a few entries of each track on small problems again, and name each score that is not the stored one.

    Exit code 1: there is one.
    """
    from rsbench.benchmark.leaderboard.smoke import hashes_of_frames, read_scores, run_smoke
    from rsbench.cli.console import progress_bar
    from rsbench.storage.files import check_out

    jobs = _jobs(track, entry)
    tracks = list(dict.fromkeys(job.track for job in jobs))
    known: dict[str, Any] = {}
    if write:
        check_out(stored)
    else:
        _check_stored(stored, tracks)
        known = {name: read_scores(stored, name) for name in tracks}
    with _frames(data, tracks, problems) as folder:
        count = workers or min(os.cpu_count() or 1, len(jobs))
        with progress_bar("smoke", len(jobs)) as step:
            found = run_smoke(jobs, folder, problems, count, step)
        frames = {} if folder is None else hashes_of_frames(folder)
    if write:
        _store(stored, found, frames)
    else:
        _compare(stored, found, known, frames)


def _jobs(tracks: Sequence[str] | None, entries: Sequence[str] | None) -> list[Job]:
    """What takes longest first; of points a job for each solver.

    Raises:
        RsbenchError: no such track, or an entry that none of the tracks has.
    """
    from rsbench.benchmark.leaderboard.smoke import ENTRIES, Job
    from rsbench.benchmark.leaderboard.tracks import TRACKS, track_of_name
    from rsbench.core.errors import RsbenchError

    chosen = [track_of_name(track).name for track in dict.fromkeys(tracks or TRACKS)]
    jobs, taken = list[Job](), set[str]()
    for track in (*reversed(ENTRIES), "points"):
        if track not in chosen:
            continue
        known = own_solvers() if track == "points" else list(ENTRIES[track])
        if track == "points" and entries is not None:
            others = {name for names in ENTRIES.values() for name in names} - set(known)
            known = [name for name in entries if name not in others]  # cards of anybody
        names = tuple(name for name in known if entries is None or name in entries)
        taken |= set(names)
        jobs += [Job(track, (name,)) for name in names] if track == "points" else [Job(track, names)][: len(names)]
    if not jobs and entries is None:
        raise RsbenchError(
            f"--track {', '.join(chosen)}: has no smoke run; there are: {', '.join(('points', *ENTRIES))}"
        )
    for name in entries or ():
        if name not in taken:
            raise RsbenchError(f"--entry {name}: is not run on {', '.join(chosen)}")
    return jobs


def _check_stored(stored: Path, tracks: Sequence[str]) -> None:
    from rsbench.benchmark.leaderboard.smoke import file_of
    from rsbench.core.errors import RsbenchError

    for track in tracks:
        if not (stored / file_of(track)).is_file():
            raise RsbenchError(
                f"{stored / file_of(track)}: there are no stored scores; a checkout of rsbench has some (--stored "
                "names their folder), and --write stores those of this code"
            )


@contextmanager
def _frames(data: Path | None, tracks: Sequence[str], problems: int | None) -> Iterator[Path | None]:
    """The dataset of the tracks of frames; rendered for as long as this lasts, unless it is there."""
    from rsbench.benchmark.leaderboard.smoke import CARD
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import generate_dataset, steps_of
    from rsbench.renderers.backend import start_backend

    if data is not None or set(tracks) <= {"points"}:
        yield data
        return
    card = load_dataset_card(CARD)
    card = card.only([sequence.name for sequence in card.sequence[:problems]])
    if (backend := start_backend()).message:
        echo(backend.message, err=True)
    with tempfile.TemporaryDirectory() as folder:
        with progress_bar(f"rendering {card.name}", steps_of(card) * len(card.sequence)) as advance:
            generate_dataset(card, Path(folder) / CARD, progress=advance)
        yield Path(folder) / CARD


def _store(stored: Path, found: dict[str, Any], frames: dict[str, str]) -> None:
    from rsbench.benchmark.leaderboard.smoke import file_of, record_of
    from rsbench.benchmark.provenance import provenance
    from rsbench.storage.files import write_json, write_table

    stored.mkdir(parents=True, exist_ok=True)
    for track, table in found.items():
        inputs = {} if track == "points" else {"frames": frames}
        write_table(stored / file_of(track), table)
        write_json(stored / record_of(track), provenance(_COMMAND, **inputs))
        echo(f"scores: {stored / file_of(track)}")


def _compare(stored: Path, found: dict[str, Any], known: dict[str, Any], frames: dict[str, str]) -> None:
    from rsbench.benchmark.leaderboard.smoke import differences, other_frames

    lines = list[str]()
    for track, table in found.items():
        others = list[str]() if track == "points" else other_frames(stored, track, frames)
        if others:
            echo(f"note: {track}: other frames than those of the stored scores: {', '.join(others)}")
        lines += differences(track, table, known[track], others)
    for line in lines:
        echo(line)
    answers = sum(len(table) for table in found.values())
    entries = sum(table["method"].nunique() for table in found.values())
    echo(f"{answers} answers of {entries} entries of {len(found)} tracks, {len(lines)} differ from {stored}")
    if lines:
        raise typer.Exit(1)


def own_solvers() -> list[str]:
    """Names of the solvers that come with rsbench and need no more than ``points`` gives, each once."""
    from rsbench.components.plugins import offers
    from rsbench.solvers.engine.base import BESIDE, SOLVERS, load_solver_entry

    own = [offer.name for offer in offers(SOLVERS) if offer.origin == "rsbench"]
    return [name for name in own if not BESIDE.keys() & load_solver_entry(name).solver.spec.minimum]
