"""``rsbench inspect``: which camera of a rig rolls, from which side and how fast, from matches alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rsbench.cli.console import print_answers, print_records
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

EPILOG = """[bold]Examples[/bold]

  rsbench inspect problem.json

  rsbench inspect l0.png r0.png l1.png r1.png --rig rig.toml

  rsbench inspect --left left.mp4 --right right.mp4 --rig rig.toml --json

  rsbench inspect data/paper     [dim](each sequence of a dataset; or one sequence's folder)[/dim]

The shutter that a card or problem gives is not used; it is printed beside the estimate.

Exit codes: 0 every rig was estimated, 1 one cannot be determined from its matches, 2 one input is wrong.
More: [bold]rsbench docs inspect[/bold]"""

_MODEL = "Motion model to try; repeatable. Default: all four of rsbench"


def inspect(
    given: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="INPUT",
            help="Problems (files, folders, -); or LEFT_0 RIGHT_0 LEFT_1 RIGHT_1; or a dataset or a sequence.",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="RIG|NAME", help="Calibration of both cameras, for frames.")
    ] = None,
    left: Annotated[Path | None, typer.Option(help="Folder of images or video of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(help="Folder of images or video of the right camera.")] = None,
    windows: Annotated[int, typer.Option(min=1, help="Largest number of frame pairs of a sequence to use.")] = 5,
    max_sigma: Annotated[
        float, typer.Option(min=0.0, help="Largest standard deviation of a readout ratio that is reported.")
    ] = 0.015,
    motion_model: Annotated[list[str] | None, typer.Option(metavar="NAME", help=_MODEL)] = None,
    features: Annotated[str, named("features", "Feature matcher for frames: a name or a card.")] = "dense",
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per rig, each on a line.")] = False,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames per second, for a calibration's line delay. Default: that of the video."),
    ] = None,
    readout_ratio: Annotated[
        float | None,
        typer.Option(help="Readout time divided by frame period, to compare with, instead of the rig's."),
    ] = None,
    shutter: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The same, by the name of a camera mode (rsbench list shutters)."),
    ] = None,
) -> None:
    """Estimate scan direction, readout ratio and delay of each camera from matches, where they tell it."""
    from rsbench.capture.hypotheses import MODELS
    from rsbench.cli.correct_input import ReadoutOptions
    from rsbench.cli.inspect_run import InspectOptions, inspections, row_of

    readout = ReadoutOptions(readout_ratio=readout_ratio, shutter=shutter, fps=fps)
    if readout.any and rig is None:
        raise RsbenchError("--readout-ratio, --shutter: need --rig; problems and datasets state their own shutter")
    models = tuple(motion_model or MODELS)
    options = InspectOptions(
        models=models, windows=windows, features=features, seed=seed, readout=readout, max_sigma=max_sigma
    )

    def show(answers: list[dict[str, Any]]) -> None:
        print_records([row_of(answer) for answer in answers], right=("matches", "moved (px)"))

    print_answers(inspections(given or [], rig, left, right, options), json, "told", show)
