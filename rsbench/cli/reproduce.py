"""``rsbench reproduce``: the committed results, made again."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

EPILOG = """[bold]Example[/bold]

  rsbench reproduce images --out results --data data       [dim](what results/images holds)[/dim]"""


class Target(StrEnum):
    """What can be reproduced."""

    images = "images"


def reproduce(
    target: Annotated[
        Target, typer.Argument(help="images: the paper's image experiment in the three built-in scenes.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("results"),
    data: Annotated[Path, typer.Option(help="Folder for the rendered data.")] = Path("data"),
) -> None:
    """Make the committed results again: render what is missing, run, score, draw."""
    from rsbench.cli.evaluate import evaluate_dataset
    from rsbench.cli.generate import generate

    generate("paper", data / "paper", None, workers=1)
    command = f"rsbench reproduce {target.value}"
    evaluate_dataset(data / "paper", out / target.value, None, "rs-stereo-refined", 0, command)


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(reproduce)
