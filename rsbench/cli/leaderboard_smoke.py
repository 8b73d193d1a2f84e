"""``rsbench leaderboard smoke``: what a change of code moved, in a minute."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.kinds import complete

_COMMAND = "rsbench leaderboard smoke --write"


def smoke(
    stored: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the stored scores.")] = Path(
        "results/leaderboard/smoke"
    ),
    entry: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this solver; repeatable. Default: all of ours.", autocompletion=complete("solvers")
        ),
    ] = None,
    problems: Annotated[int | None, typer.Option(min=1, help="Only the first ones; default: 6.")] = None,
    write: Annotated[bool, typer.Option("--write", help="Store the scores instead of comparing.")] = False,
) -> None:
    """Run our solvers on the first problems of points again, and name each score that is not the stored one.

    Exit code 1: there is one.
    """
    from rsbench.benchmark.leaderboard.smoke import FILE, PROBLEMS, differences, read_scores, run_smoke
    from rsbench.benchmark.provenance import provenance
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.files import check_out, write_json, write_table
    from rsbench.errors import RsbenchError

    if write:
        check_out(stored)
    elif not (stored / FILE).is_file():
        raise RsbenchError(
            f"{stored / FILE}: there are no stored scores; a checkout of rsbench has some (--stored names their "
            "folder), and --write stores those of this code"
        )
    known = None if write else read_scores(stored)
    cards = entry or own_solvers()
    with progress_bar("smoke", len(cards)) as step:
        found = run_smoke(cards, problems or PROBLEMS, step)
    if known is None:
        stored.mkdir(parents=True, exist_ok=True)
        write_table(stored / FILE, found)
        write_json(stored / "provenance.json", provenance(_COMMAND))
        typer.echo(f"scores: {stored / FILE}")
        return
    lines = list(differences(found, known))
    for line in lines:
        typer.echo(line)
    typer.echo(f"{len(found)} answers of {len(cards)} solvers, {len(lines)} differ from {stored / FILE}")
    if lines:
        raise typer.Exit(1)


def own_solvers() -> list[str]:
    """Names of the solvers that come with rsbench and need no more than ``points`` gives, each once."""
    from rsbench.plugins import offers
    from rsbench.solvers.engine.base import SENSORS
    from rsbench.solvers.engine.registry import SOLVERS, load_solver_entry

    # rs-stereo is another name of rs-stereo-refined.
    own = [offer.name for offer in offers(SOLVERS) if offer.origin == "rsbench" and offer.name != "rs-stereo"]
    return [name for name in own if not SENSORS.keys() & load_solver_entry(name).solver.spec.minimum]
