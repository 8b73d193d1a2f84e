"""``rsbench check-solver``: the contract, for authors of solvers."""

from __future__ import annotations

from typing import Annotated

import typer

from rsbench.cli.component_kinds import complete
from rsbench.cli.console import echo

EPILOG = """[bold]Examples[/bold]

  rsbench check-solver gs-8pt

  rsbench check-solver ./my-solver.toml --json

Other packages' solvers run in a child process. Exit code 1 when a check fails; warnings are yours to judge."""


def check_solver(
    solver: Annotated[
        str,
        typer.Argument(
            metavar="NAME|CARD", help="Name of a solver or path to its card.", autocompletion=complete("solvers")
        ),
    ],
    time_limit: Annotated[
        float | None, typer.Option(min=0.1, help="Seconds for one problem; by default what the card says.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Findings as one JSON object.")] = False,
) -> None:
    """Check the contract of a solver: exact data solved, equal results of equal runs, failures as values."""
    import json as json_module
    from dataclasses import asdict

    import pandas as pd

    from rsbench.benchmark.simulated.contract import check_solver as find
    from rsbench.cli.console import print_table, say
    from rsbench.solvers.engine.registry import load_solver_entry

    entry = load_solver_entry(solver)
    findings = find(entry, time_limit_s=time_limit)
    failed = sum(finding.verdict == "failed" for finding in findings)
    if json:
        content = {"solver": entry.name, "passed": not failed, "checks": [asdict(each) for each in findings]}
        echo(json_module.dumps(content))
    else:
        print_table(f"{entry.name} and the contract of solvers", pd.DataFrame([asdict(each) for each in findings]))
        say(f"{entry.name}: {failed} of {len(findings)} checks failed")
    if failed:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    app.command("check-solver", epilog=EPILOG)(check_solver)
