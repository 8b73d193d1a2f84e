"""What a keeper of a board does: ``publish`` and ``score`` of secret splits, ``accept`` of entries in doubt."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo
from rsbench.cli.leaderboard_tracks import Workers
from rsbench.cli.names import complete
from rsbench.core.errors import RsbenchError

_Seed = Annotated[
    Path, typer.Option("--seed-file", metavar="FILE", help="Secret text, 16 characters or more, drawn at random.")
]
_Card = Annotated[
    str, typer.Option(metavar="CARD", help="Dataset card of the split.", autocompletion=complete("datasets"))
]


def publish(
    track: Annotated[str, typer.Argument(help="A track of frames, such as pose or pose-own.")],
    seed_file: _Seed,
    keep: Annotated[
        Path, typer.Option(metavar="DIR", help="The keeper's folder: scenes and truth, not to be shown.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of what everybody may see.")],
    card: _Card = "standard",
    workers: Annotated[int, typer.Option(min=1, help="Processes; each renders whole sequences.")] = 1,
) -> None:
    """Render a secret test split, and write its inputs without truth. Run again, it proves what was announced."""
    from rsbench.benchmark.leaderboard import publishing
    from rsbench.benchmark.leaderboard.tracks import track_of_name
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.generation import steps_of
    from rsbench.dataset.secret_split import read_secret, secret_card

    of_frames, text = track_of_name(track), read_secret(seed_file)
    if not of_frames.rendered:
        raise RsbenchError(f"track {track!r}: has no frames; export and submit take --seed-file themselves")
    for hidden in (keep, seed_file):
        if hidden.resolve().is_relative_to(out.resolve()):
            raise RsbenchError(f"{hidden}: lies in {out}, which everybody may see; take another place")
    drawn = secret_card(card, text)
    with progress_bar(f"rendering {drawn.name}", steps_of(drawn) * len(drawn.sequence)) as advance:
        made = publishing.publish(of_frames, card, text, keep, out, workers=workers, progress=advance)
    echo(f"{made.protocol}, split {made.split}, {len(drawn.sequence)} sequences: {out}")
    for name in ("commitment", "fingerprint", "truth"):
        echo(f"{name}: {getattr(made, name)}")


def score(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions: JSON lines.")],
    seed_file: _Seed,
    published: Annotated[Path, typer.Option(metavar="DIR", help="Folder that publish wrote for everybody.")],
    board: Annotated[Path, typer.Option(help="Folder of the board.")],
    card: Annotated[str | None, typer.Option(metavar="CARD", help="Where its card is not rsbench's own.")] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="The keeper's folder, where the truth is depth or frames.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the entry of that name.")] = False,
    workers: Workers = 1,
) -> None:
    """Draw the truth of a secret split from its text again, see that it is the announced one, and score."""
    from rsbench.benchmark.leaderboard.board import add
    from rsbench.benchmark.leaderboard.publishing import announced_split, read_announcement
    from rsbench.benchmark.leaderboard.submissions import check_submission
    from rsbench.benchmark.leaderboard.tracks import track_of_id
    from rsbench.benchmark.provenance import provenance
    from rsbench.dataset.secret_split import read_secret

    announced = read_announcement(published)
    track, text = track_of_id(announced.protocol), read_secret(seed_file)
    split = announced_split(announced, track, card or announced.card, text, keep)
    for note in check_submission(file, split).notes:
        echo(f"note: {note}", err=True)
    made = provenance("rsbench leaderboard score")
    scored = add(board, file, split, made, replace=replace, workers=workers)
    echo(f"entry: {scored.folder}")
    if scored.doubt:
        echo(f"in doubt, and not ranked: {scored.doubt}")


def accept(
    method: Annotated[str, typer.Argument(metavar="METHOD", help="Name of the entry.")],
    board: Annotated[Path, typer.Option(help="Folder of the board.")],
    protocol: Annotated[str, typer.Option(metavar="ID", help="Such as points-1.")],
    split: Annotated[str, typer.Option(metavar="NAME", help="Such as dev-f88c896f.")],
    reason: Annotated[str, typer.Option(metavar="TEXT", help="Why it is believed; kept in its entry.json.")],
) -> None:
    """Rank an entry that is in doubt, its errors being below what its data allow."""
    from rsbench.benchmark.leaderboard import board as boards

    if not reason.strip():
        raise RsbenchError("--reason '': must say why the entry is believed")
    echo(f"{method}: ranked all the same: {boards.accept(board, protocol, split, method, reason)}")
