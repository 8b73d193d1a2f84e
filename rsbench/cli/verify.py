"""``rsbench verify``: integrity and geometric consistency of a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EPILOG = """[bold]Examples[/bold]

  rsbench verify data/paper

  rsbench verify data/paper --stride 4      [dim](every 4th pixel in both directions)[/dim]"""


def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    stride: Annotated[int, typer.Option(min=1, help="Compare every n-th pixel in both directions.")] = 1,
) -> None:
    """Check files against checksums, poses against the motion, and all depth maps against each other."""
    import pandas as pd

    from rsbench.cli.console import print_table, progress_bar
    from rsbench.dataset.files import read_json
    from rsbench.dataset.verification import verification_steps, verify_dataset

    with progress_bar("verifying", verification_steps(read_json(folder / "dataset.json"))) as advance:
        reports = verify_dataset(folder, stride, advance)
    rows = [
        {
            "sequence": report.name,
            "depth of": agreement.source,
            "against": agreement.target,
            "pixels": agreement.compared,
            "agree (%)": 100 * agreement.share,
            "p99 difference": f"{agreement.p99:.1e}",
        }
        for report in reports
        for agreement in report.agreements
    ]
    if rows:
        print_table("Depth agreement between frames (relative tolerance 1e-4)", pd.DataFrame(rows))
    faults = [f"{report.name}: {fault}" for report in reports for fault in report.faults]
    for fault in faults:
        typer.echo(f"fault: {fault}", err=True)
    typer.echo(f"{folder}: {len(reports)} sequences, {len(faults)} faults")
    if faults:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(verify)
