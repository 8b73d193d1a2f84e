"""What the commands of ``rsbench leaderboard`` share: tracks with their data, as options and as problems."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.track import Split

Track = Annotated[
    str,
    typer.Argument(
        help="A track or its protocol, such as points-2, pose (given matches) or pose-own (own matches)."
    ),
]
Data = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Dataset (a dataset.json) of all tracks but points and points-2."),
]
Secret = Annotated[
    Path | None, typer.Option("--seed-file", metavar="FILE", help="Text from which a secret test split is drawn.")
]
Hidden = Annotated[
    bool, typer.Option("--secret", help="The dataset's truth is not to be told: not exported, not used by check.")
]

Workers = Annotated[int, typer.Option(min=1, help="Processes.")]


def split_of(track: str, data: Path | None, seed_file: Path | None, secret: bool = False) -> Split:
    from rsbench.benchmark.leaderboard.tracks import track_of_name

    return track_of_name(track).split(data, seed_file, secret)


def write_frames_of(split: Split, data: Path, out: Path) -> None:
    from rsbench.benchmark.leaderboard.inputs import write_frames

    for truth in split.truths:
        if truth.pictures is not None:
            truth.pictures.check()
    write_frames(data, out)
