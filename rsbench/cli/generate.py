"""``rsbench generate``: make a dataset from a card."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.cluster_options import Scheduler, chosen_workers, shared_path
from rsbench.cli.console import echo, progress_bar
from rsbench.cli.names import complete
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.dataset.card import DatasetCard

EPILOG = """[bold]Examples[/bold]

  rsbench generate paper --out data/paper

  rsbench generate smoke --out data/smoke --sequence castle

  rsbench generate moderate --out data/moderate --estimate [dim](only say what it will take)[/dim]

  rsbench generate moderate --out data/moderate --shard 2/4 [dim](on the second of four machines; then bring all
  folders into one and run it without --shard: it checks them and writes dataset.json)[/dim]

  rsbench generate paper --out s3://bucket/paper --workers 8 [dim](sequences go there as they become complete:
  rsbench docs cluster)[/dim]

  rsbench generate paper --out data/flow --channels disparity,flow

  rsbench generate smoke --out data/walk --trajectory walk.txt [dim](along your own poses, one pair of frames
  after the other: lines of timestamp tx ty tz qx qy qz qw)[/dim]

  rsbench generate standard --out data/train --split train --sequences 1000 [dim](to train on)[/dim]

  rsbench generate standard --out data/test --seed 20271 [dim](a split of the same card that was never used)[/dim]

  rsbench generate smoke --out data/stack --full-frames    [dim](keeps every row's whole image)[/dim]"""
_Channels = Annotated[
    str | None,
    typer.Option(
        help="Channels of truth in place of the card's, with commas between: disparity, flow, gs_flow, "
        "timing, normals, instances, imu, tracks, affine, hdr, matches; or all; or none."
    ),
]


def generate(
    card: Annotated[
        str,
        typer.Argument(
            help="Name of a dataset card (see: rsbench list datasets) or path to one.",
            autocompletion=complete("datasets"),
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            metavar="DIR",
            help="Folder of the dataset, or a URL such as s3://bucket/folder; an interrupted run resumes there.",
        ),
    ],
    sequence: Annotated[
        list[str] | None, typer.Option("--sequence", "--only", help="Only this sequence of the card; repeatable.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Only the I-th of N parts of the sequences, for one of N machines."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; each renders whole sequences. Default: 1.")
    ] = None,
    scheduler: Scheduler = None,
    full_frames: Annotated[
        bool,
        typer.Option("--full-frames", help="The paper's recipe: render and keep a whole image per row (slow)."),
    ] = False,
    channels: _Channels = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Poses (TUM format) along which the rig moves, in place of the card's motion."
        ),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Seed to use instead of the card's, for other motions and noise; repeatable."),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Another split of the card, such as train: each sequence with a scene, motion and noise of its "
            "own, drawn from this name. Cards of its scenes go to DIR-scenes.",
        ),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=100_000,
            help="With --split: number of sequences. Default: as many as the card has; beyond these, other "
            "scenes are drawn.",
        ),
    ] = None,
    rehash: Annotated[
        bool,
        typer.Option("--rehash", help="Read all existing files again, not only those whose size or time changed."),
    ] = False,
    estimate: Annotated[
        bool,
        typer.Option(
            "--estimate",
            help="Only estimate the number of files, bytes and minutes, by rendering one camera of each scene.",
        ),
    ] = False,
    backend: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="What renders: llvm, cuda or scalar; default: the environment's RSBENCH_VARIANT, else the first "
            "that works. Pixels of two backends differ by rounding.",
        ),
    ] = None,
) -> None:
    """Render a dataset: rolling-shutter stereo frames, exact depth, row poses and global-shutter twins."""
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.destinations import store_for
    from rsbench.dataset.generation import generate_dataset, steps_of
    from rsbench.renderers.backend import ask_for, start_backend
    from rsbench.storage.files import check_out
    from rsbench.storage.object_store import path_or_url, shown

    processes, place = chosen_workers(workers, scheduler), shared_path(path_or_url(out), scheduler)
    whole = load_dataset_card(card, trajectory, tuple(seed or ()))
    if split is not None:
        whole = _split(card, split, place, bool(trajectory or seed), sequences)
    elif sequences is not None:
        raise RsbenchError("--sequences: goes with --split; --sequence and --shard give a part of the card")
    dataset = _chosen(whole, sequence, shard, channels)
    if not estimate:
        _ = check_out(place) if isinstance(place, Path) else store_for(place, processes)
    if backend is not None and scheduler is not None:
        raise RsbenchError("--backend: not with --scheduler: set RSBENCH_VARIANT where its workers start")
    ask_for(backend)  # of this process and of those that it starts, which the workers of a cluster are not
    if (started := start_backend()).message:
        echo(started.message, err=True)
    if estimate:
        echo(_estimated(dataset, full_frames))
        return
    steps = steps_of(dataset) * len(dataset.sequence)
    with progress_bar(f"rendering {dataset.name}", steps) as advance:
        rendered = generate_dataset(
            dataset, place, workers=processes, full_frames=full_frames, rehash=rehash, progress=advance
        )
    echo(f"{shown(str(place))}: {len(dataset.sequence)} sequences, {len(rendered)} rendered now")


def _split(card: str, name: str, place: Path | str, changed: bool, count: int | None) -> DatasetCard:
    """Draw a split of a card, and write the cards of its scenes beside the dataset."""
    from rsbench.dataset.secret_split import open_split, secret_card, write_scenes
    from rsbench.storage.untrusted_files import NAME

    if not NAME.fullmatch(name) or name == "test":
        raise RsbenchError(
            f"--split {name}: must be a name, but not test, which rsbench leaderboard publish draws"
        )
    if changed or not isinstance(place, Path):
        raise RsbenchError("--split: not with --seed, --trajectory or a URL: it draws both, and writes scenes")
    drawn, scenes = open_split(card, name), place.absolute().with_name(f"{place.name}-scenes")
    found = secret_card(card, drawn, scenes, split=name, count=count)
    write_scenes(card, drawn, scenes, count)
    return found


def _chosen(
    dataset: DatasetCard, sequence: list[str] | None, shard: str | None, channels: str | None
) -> DatasetCard:
    """Restrict a dataset to the sequences and channels that the options select."""
    from rsbench.dataset.channels import named_channels

    if sequence:
        dataset = dataset.only(sequence)
    if shard is not None:
        part, slash, parts = shard.partition("/")
        if not (slash and part.isdecimal() and parts.isdecimal()):
            raise RsbenchError(f"--shard {shard}: must be I/N, such as 1/4")
        dataset = dataset.shard(int(part), int(parts))
    return dataset if channels is None else dataset.with_channels(named_channels(channels))


def _estimated(dataset: DatasetCard, full_frames: bool) -> str:
    """Return one line with the estimated files, size and time."""
    from rsbench.dataset.generation import estimate_dataset

    if full_frames:
        raise RsbenchError("--estimate: not with --full-frames, of which one frame takes as long as hundreds")
    scenes = len({sequence.scene for sequence in dataset.sequence})
    with progress_bar("trying each scene", scenes) as advance:
        found = estimate_dataset(dataset, advance)
    size = f"{found.bytes / 1e9:.1f} GB" if found.bytes >= 1e9 else f"{found.bytes / 1e6:.0f} MB"
    minutes = f"{found.seconds / 60:.0f} min" if found.seconds >= 120 else f"{found.seconds:.0f} s"
    return (
        f"{dataset.name}: {found.sequences} sequences, {found.files} files, about {size}, about {minutes} in one "
        "process on this machine"
    )
