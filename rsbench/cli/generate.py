"""``rsbench generate``: make a dataset from a card."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.kinds import complete

EPILOG = """[bold]Examples[/bold]

  rsbench generate paper --out data/paper

  rsbench generate smoke --out data/smoke --sequence castle

  rsbench generate smoke --out data/stack --full-frames    [dim](keeps every row's whole image)[/dim]"""


def generate(
    card: Annotated[
        str,
        typer.Argument(
            help="Name of a dataset card (see: rsbench list datasets) or path to one.",
            autocompletion=complete("datasets"),
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the dataset; an interrupted run resumes there.")],
    sequence: Annotated[list[str] | None, typer.Option(help="Only this sequence of the card; repeatable.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes; each renders whole sequences.")] = 1,
    full_frames: Annotated[
        bool,
        typer.Option("--full-frames", help="The paper's recipe: render and keep a whole image per row (slow)."),
    ] = False,
    rehash: Annotated[
        bool,
        typer.Option("--rehash", help="Read all that is there again, not only what has another size or time."),
    ] = False,
) -> None:
    """Render a dataset: rolling-shutter stereo frames, exact depth, row poses and global-shutter twins."""
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.files import check_out
    from rsbench.dataset.generation import STEPS, generate_dataset
    from rsbench.renderers.backend import start_backend

    dataset = load_dataset_card(card)
    if sequence:
        dataset = dataset.only(sequence)
    check_out(out)
    backend = start_backend()
    if backend.message:
        typer.echo(backend.message, err=True)
    steps = STEPS * len(dataset.sequence)
    with progress_bar(f"rendering {dataset.name}", steps) as advance:
        rendered = generate_dataset(
            dataset, out, workers=workers, full_frames=full_frames, rehash=rehash, progress=advance
        )
    typer.echo(f"{out}: {len(dataset.sequence)} sequences, {len(rendered)} rendered now")


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(generate)
