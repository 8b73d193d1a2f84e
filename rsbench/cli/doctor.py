"""``rsbench doctor``: what this machine can run."""

from __future__ import annotations

import typer


def doctor() -> None:
    """Try every rendering backend in a child process and list the versions that matter."""
    import pandas as pd

    from rsbench.cli.console import print_table
    from rsbench.renderers.diagnosis import doctor_report

    rows = [{"component": row.component, "status": row.status, "detail": row.detail} for row in doctor_report()]
    print_table("rsbench doctor", pd.DataFrame(rows))


def register(app: typer.Typer) -> None:
    app.command(epilog="[bold]Example[/bold]  rsbench doctor")(doctor)
