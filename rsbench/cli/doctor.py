"""``rsbench doctor``: what this machine can run."""

from __future__ import annotations

import typer

from rsbench.cli.console import echo


def doctor() -> None:
    """Try every rendering backend in a child process, list the versions that matter, and say what to do."""
    import pandas as pd

    from rsbench.cli.console import print_table
    from rsbench.renderers.diagnosis import advice, doctor_report

    report = doctor_report()
    rows = [{"component": row.component, "status": row.status, "detail": row.detail} for row in report]
    print_table("rsbench doctor", pd.DataFrame(rows))
    for line in advice(report):
        echo(line)
    if any(row.status == "fail" and row.component != "libLLVM" for row in report):  # without it, others render
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    app.command(epilog="[bold]Example[/bold]  rsbench doctor")(doctor)
