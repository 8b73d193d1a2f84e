"""``rsbench export``: a dataset in the layout of another program."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo

EPILOG = """[bold]Examples[/bold]

  rsbench export data/paper --to colmap --out out/colmap    [dim](global-shutter twins)[/dim]

  rsbench export data/paper --to colmap --images rs --out out/rolling

  rsbench export data/paper --to tum --out out/tum    [dim](then: evo_traj tum out/tum/*/left_rows.txt)[/dim]

  rsbench export data/paper --to gsplat --out out/gsplat --sequence castle

  rsbench export data/paper --to webdataset --out out/shards

  rsbench export corrected --to colmap --out out/map    [dim](what rsbench correct made of footage)[/dim]"""


class Target(StrEnum):
    """Formats; tests hold them equal to ``rsbench.interop.writers.exporter.FORMATS``."""

    COLMAP = "colmap"
    TUM = "tum"
    KALIBR = "kalibr"
    NERFSTUDIO = "nerfstudio"
    GSPLAT = "gsplat"
    KITTI = "kitti"
    CARLA_RS = "carla-rs"
    FASTEC_RS = "fastec-rs"
    WEBDATASET = "webdataset"
    HUGGINGFACE = "huggingface"


class Pictures(StrEnum):
    """Which images are written."""

    RS = "rs"
    GS = "gs"


def export(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder with a dataset.json, or of corrected footage (motion.json)."),
    ],
    to: Annotated[Target, typer.Option(help="Format; the document 'export' says what each holds.")],
    out: Annotated[Path, typer.Option(help="Folder that appears when all is written.")],
    images: Annotated[
        Pictures | None,
        typer.Option(help="Rolling-shutter frames or global-shutter twins, where a format takes either."),
    ] = None,
    sequence: Annotated[
        list[str] | None, typer.Option("--sequence", "--only", help="Only this sequence; repeatable.")
    ] = None,
) -> None:
    """Write a dataset, or corrected footage, in the layout of COLMAP, evo and others.

    What a format cannot hold is said or refused.
    """
    from rsbench.cli.console import late_progress, say
    from rsbench.interop.writers.exporter import export_dataset

    with late_progress(f"exporting to {to}") as advance:
        told = export_dataset(
            folder,
            to.value,
            out,
            images=None if images is None else images.value,
            only=tuple(sequence or ()),
            progress=advance,
        )
    for sentence in told:
        say(f"note: {sentence}")
    echo(f"{out}: {to}; README.txt says what it holds")


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(export)
