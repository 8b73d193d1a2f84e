"""What the commands of ``rsbench leaderboard`` share: tracks with their data, as options and as problems."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.splits import Split
    from rsbench.pipeline.problem import Problem

Track = Annotated[
    str,
    typer.Argument(help="points, pose (given matches), pose-own (own matches), readout, depth or correction."),
]
Data = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Dataset (a dataset.json) of all tracks but points.")
]
Secret = Annotated[
    Path | None, typer.Option("--seed-file", metavar="FILE", help="Text from which a secret test split is drawn.")
]
Hidden = Annotated[
    bool, typer.Option("--secret", help="The dataset's truth is not to be told: not exported, not used by check.")
]

Workers = Annotated[int, typer.Option(min=1, help="Processes.")]


def split_of(track: str, data: Path | None, seed_file: Path | None, secret: bool = False) -> Split:
    from rsbench.benchmark.leaderboard.protocols import protocol_of_track
    from rsbench.benchmark.leaderboard.splits import dataset_split, points_split

    protocol = protocol_of_track(track)
    if track == "points":
        if data is not None:
            raise RsbenchError(f"--data {data}: the problems of points are simulated; leave it out")
        if secret and seed_file is None:
            raise RsbenchError("--secret: of the track 'points' a --seed-file makes a secret split; leave it out")
        return points_split(protocol, seed_file)
    if data is None:
        raise RsbenchError(
            f"--data: the track {track!r} needs the folder of a dataset; make one with rsbench generate"
        )
    if seed_file is not None:
        raise RsbenchError(f"--seed-file {seed_file}: a dataset has its own seed; leave it out, and say --secret")
    return dataset_split(protocol, data, public=not secret)


def problems_of(split: Split, data: Path | None, secret: Path | None) -> Iterator[Problem]:
    from rsbench.benchmark.leaderboard.splits import seed_of, simulated_problem

    if data is None:
        seed = seed_of(secret)
        return (simulated_problem(seed, number) for number in range(len(split.truths)))
    from rsbench.benchmark.leaderboard.frames import bare_problems, matched_problems

    return bare_problems(data) if "images" in split.protocol.allowed else matched_problems(data)


def write_frames_of(split: Split, data: Path, out: Path) -> None:
    from rsbench.benchmark.leaderboard.frames import write_frames

    for truth in split.truths:
        if truth.pictures is not None:
            truth.pictures.check()
    write_frames(data, out)
