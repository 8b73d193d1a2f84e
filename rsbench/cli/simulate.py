"""``rsbench simulate``: experiments on simulated points."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.cluster_options import Scheduler, chosen_workers, results_at
from rsbench.cli.console import echo, print_rows, progress_bar, say
from rsbench.cli.names import complete, named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    import pandas as pd

    from rsbench.benchmark.simulated.sweep_card import SweepCard
    from rsbench.jobs.process_jobs import Workers

EPILOG = """[bold]Examples[/bold]

  rsbench simulate noise --out out/noise

  rsbench simulate rotation --set points=9 --trials 100 --solver gs-8pt --solver rs-stereo-linear --out out/nine

  rsbench simulate rotation --solver my_solver.py --trials 50 --out out/mine   [dim](a function of yours)[/dim]

DIR gets [bold]summary.csv[/bold] (median, mean, p90 with 95 % bootstrap intervals, success share, failures and
their reasons), [bold]trials/*.npz[/bold] (truth and every prediction) and [bold]sweep.json[/bold] (the card).
Solvers of other packages run in processes of their own: what they do wrong is a failed trial."""


def simulate(
    sweep: Annotated[
        str,
        typer.Argument(
            help="Name of a sweep card (see: rsbench list sweeps) or path to one.",
            autocompletion=complete("sweeps"),
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            metavar="DIR",
            help="Folder of the results, or a URL such as s3://bucket/folder; an interrupted run resumes there.",
        ),
    ],
    trials: Annotated[int | None, typer.Option(min=1, help="Repetitions per value instead of the card's.")] = None,
    solver: Annotated[
        list[str] | None, named("solvers", "Solver instead of the sweep's: name, card or FILE.py; repeatable.")
    ] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="FIELD=VALUE to replace in the card's setting; repeatable.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of every trial instead of the card's.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core.")] = None,
    scheduler: Scheduler = None,
    time_limit: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="Time limit per problem for solvers of other packages, seconds; default: their cards'."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Repeat everything, and replace the results in DIR.")
    ] = False,
) -> None:
    """Simulate points seen by a moving rolling-shutter rig, solve for its motion, and tabulate the errors."""
    from rsbench.benchmark.simulated.sweep_card import load_sweep, with_options
    from rsbench.storage.object_store import name_of

    card = with_options(load_sweep(sweep), solver, trials, seed)
    if change:
        card = card.with_setting(**_changes(change))
    command = f"rsbench simulate {sweep} --out {out}"
    processes = chosen_workers(workers, scheduler, os.cpu_count() or 1)
    with results_at(out, scheduler) as place:
        table = run_and_summarise(card, place, processes, command, time_limit_s=time_limit, force=force)
        show(card, table)
        echo(f"table: {name_of(place / 'summary.csv')}")


def run_and_summarise(
    card: SweepCard,
    out: Path,
    workers: Workers | None,
    command: str,
    *,
    time_limit_s: float | None = None,
    force: bool = False,
) -> pd.DataFrame:
    """Run a sweep with a progress bar, and write its summary and provenance; return the summary."""
    from rsbench.benchmark.provenance import provenance
    from rsbench.benchmark.simulated.run_sweep import run_sweep, summarise_sweep, sweep_steps
    from rsbench.storage.files import write_json

    with progress_bar(f"simulating {card.name}", sweep_steps(card)) as advance:
        run_sweep(
            card,
            out,
            workers=workers or os.cpu_count() or 1,
            progress=advance,
            time_limit_s=time_limit_s,
            force=force,
        )
    table = summarise_sweep(out)
    write_json(out / "provenance.json", provenance(command, sweep=card.name, seed=card.seed, trials=card.trials))
    return table


GIVEN = {
    "left pairs": "matches over time of the left camera",
    "left and right pairs": "matches over time of both cameras",
    "linked pairs": "matches over time of both cameras and between them",
    "tracks": "tracks through all four images",
}


_SMALL = 0.1
"""A column whose medians are all below this, degrees, is shown in thousandths of degrees."""


def show(card: SweepCard, table: pd.DataFrame) -> None:
    """Print the medians of each variant, with their intervals, as terminal tables."""
    from rsbench.benchmark.simulated.run_sweep import SUCCESS_DEG
    from rsbench.benchmark.statistics import format_interval

    def cell(row: dict[Any, Any], name: str, unit: float) -> str:
        ends = [row[f"{name}_median{end}"] for end in ("", "_low", "_high")]
        return (
            "-"
            if any(end is None or end != end for end in ends)
            else format_interval(*(end / unit for end in ends))
        )

    axis = card.axis.replace("_", " ")
    for variant, rows in table.groupby("variant", sort=False):
        records = rows.to_dict("records")
        units = {name: 1e-3 if rows[f"{name}_median"].max() < _SMALL else 1.0 for name in ("e_R", "e_T")}
        errors = {name: f"{name} ({'deg' if unit == 1.0 else 'mdeg'})" for name, unit in units.items()}
        cells = [
            [
                f"{row['value']:g}",
                row["solver"],
                *(cell(row, name, unit) for name, unit in units.items()),
                f"{100 * row['success_share']:.0f} %",
            ]
            for row in records
        ]
        title = f"{card.name}, {variant}: median errors [95 % interval], {card.trials} trials"
        columns = (axis, "solver", *errors.values(), "solved")
        print_rows(title, columns, cells, right=(axis, "solved"), solid=tuple(errors.values()))
        for row in records:
            if row["failures"]:
                say(f"{row['solver']}, {card.axis} = {row['value']:g}, failed: {row['failure_reasons']}")
    rolling = table[table.shutter == "rolling"]  # for a global shutter, the motion between rows has no effect
    for (solver, assumed), rows in rolling.groupby(["solver", "assumed_motion"], sort=False):
        others = sorted(set(rows.motion_model) - {assumed})
        if others:
            say(f"{solver} assumes {assumed} motion; the data are of {' and '.join(others)} motion")
    say("solved: share of trials with e_R below {:g} deg and e_T below {:g} deg".format(*SUCCESS_DEG))
    for given, rows in table.groupby("information", sort=False):
        say(f"given to {', '.join(dict.fromkeys(rows.solver))}: {GIVEN[str(given)]}")


def _changes(assignments: list[str]) -> dict[str, object]:
    """Parse FIELD=VALUE pairs; values are as in a card, but words need no quotes."""
    changes: dict[str, object] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals:
            raise RsbenchError(f"--set {text}: must be FIELD=VALUE, such as points=9")
        try:
            changes[key.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            changes[key.strip()] = value.strip()
        except (ValueError, RecursionError) as error:  # for thousands of digits or brackets
            raise RsbenchError(f"--set {key}: not a value of TOML: {error}") from error
    return changes
