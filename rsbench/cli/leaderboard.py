"""``rsbench leaderboard``: methods of anybody on the same problems, ranked as far as the data tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.kinds import complete
from rsbench.errors import RsbenchError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rsbench.benchmark.leaderboard.splits import Split
    from rsbench.benchmark.leaderboard.standings import Standing
    from rsbench.pipeline.problem import Problem

EPILOG = """[bold]Examples[/bold]

  rsbench leaderboard export points --out inputs           [dim](CSV, npz and JSON for any language)[/dim]

  rsbench leaderboard template points > mine.jsonl         [dim](an example of what to hand in)[/dim]

  rsbench leaderboard check mine.jsonl

  rsbench leaderboard submit mine.jsonl --board board

  rsbench leaderboard run points --entry rs-stereo --entry gs-8pt --board board

  rsbench leaderboard show --board board

More: [bold]rsbench docs submit[/bold] and [bold]rsbench docs protocols[/bold]"""

board_app = typer.Typer(no_args_is_help=True, rich_markup_mode="rich", epilog=EPILOG)

_Track = Annotated[str, typer.Argument(help="points, pose (given matches), pose-own (own matches) or readout.")]
_Data = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Dataset (a dataset.json) of all tracks but points.")
]
_Secret = Annotated[
    Path | None, typer.Option("--seed-file", metavar="FILE", help="Text from which a secret test split is drawn.")
]
_Hidden = Annotated[
    bool, typer.Option("--secret", help="The dataset's truth is not to be told: not exported, not used by check.")
]
_Board = Annotated[Path, typer.Option(help="Folder of the board.")]
_File = Annotated[Path, typer.Argument(metavar="FILE", help="Predictions: JSON lines.")]


@board_app.command()
def export(
    track: _Track,
    out: Annotated[Path, typer.Option(help="Folder for the inputs.")],
    data: _Data = None,
    seed_file: _Secret = None,
    secret: _Hidden = False,
) -> None:
    """Write the inputs of a track for any language; of a public split the truth too."""
    from rsbench.benchmark.leaderboard.exporting import check_place, write_inputs
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.workplace import workplace

    split = _split(track, data, seed_file, secret)
    check_place(split, out)
    with workplace(out), progress_bar(f"exporting {split.name}", len(split.truths)) as advance:
        if data is not None and "images" in split.protocol.allowed:
            from rsbench.benchmark.leaderboard.frames import write_frames

            write_frames(data, out)
        write_inputs(split, _counted(_problems(split, data, seed_file), advance), out)
    typer.echo(f"{split.protocol.id}, split {split.name}, {len(split.truths)} problems: {out}")
    typer.echo(f"fingerprint: {split.fingerprint}")


@board_app.command()
def template(track: _Track, data: _Data = None, seed_file: _Secret = None) -> None:
    """Print a file of predictions that is in order: fill in your own."""
    from rsbench.benchmark.leaderboard.submissions import template_text

    typer.echo(template_text(_split(track, data, seed_file)), nl=False)


@board_app.command()
def check(file: _File, data: _Data = None, seed_file: _Secret = None, secret: _Hidden = False) -> None:
    """Say all that is wrong with a file of predictions. Exit code 2: it cannot be scored; 1: it can, but look."""
    from rsbench.benchmark.leaderboard.submissions import check_submission

    found = check_submission(file, _split(_track_of(file), data, seed_file, secret))
    for fault in found.faults:
        typer.echo(f"fault: {' '.join(fault.split())}", err=True)
    for note in found.notes:
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"{file}: {len(found.faults)} faults, {len(found.notes)} notes")
    if found.faults or found.notes:
        raise typer.Exit(2 if found.faults else 1)


@board_app.command()
def submit(
    file: _File,
    board: _Board,
    data: _Data = None,
    seed_file: _Secret = None,
    secret: _Hidden = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the entry of that name.")] = False,
) -> None:
    """Score a file of predictions and add it to a board."""
    from rsbench.benchmark.leaderboard.board import add
    from rsbench.benchmark.leaderboard.submissions import check_submission
    from rsbench.benchmark.provenance import provenance

    split = _split(_track_of(file), data, seed_file, secret)
    for note in check_submission(file, split).notes:
        typer.echo(f"note: {note}", err=True)
    scored = add(board, file, split, provenance("rsbench leaderboard submit"), replace=replace)
    _show(board, split.protocol.id, split.name, None, scored.header.method)


@board_app.command()
def run(
    track: _Track,
    entry: Annotated[
        list[str],
        typer.Option(help="Solver to run, a name or a card; repeatable.", autocompletion=complete("solvers")),
    ],
    board: _Board,
    data: _Data = None,
    seed_file: _Secret = None,
    secret: _Hidden = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    time_limit: Annotated[
        float | None, typer.Option(min=0.001, help="Seconds per problem for solvers of other packages.")
    ] = None,
) -> None:
    """Run solvers of cards on a track, keep what they predict, and score it. An interrupted run goes on there."""
    from rsbench.benchmark.leaderboard.board import RUN, add, made_by
    from rsbench.benchmark.leaderboard.running import load_entries, prepare_inputs, run_cards, steps_of
    from rsbench.benchmark.provenance import provenance
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.workplace import workplace

    split = _split(track, data, seed_file, secret)
    if "images" in split.protocol.allowed:
        raise RsbenchError(f"track {track!r}: solvers of cards take given matches; run them on the track 'pose'")
    load_entries(entry, split.protocol)  # before anything is written
    with workplace(board) as hidden, progress_bar(f"running {split.name}", steps_of(entry, split)) as advance:
        place = hidden / "runs" / split.protocol.id / split.name
        place.mkdir(parents=True, exist_ok=True)
        prepare_inputs(split, lambda: _problems(split, data, seed_file), place / "inputs")
        files = run_cards(
            entry, split, place / "inputs", place, workers=workers, time_limit_s=time_limit, step=advance
        )
    for file in files:
        add(board, file, split, provenance(RUN), replace=made_by(board, split, file.parent.name) == RUN)
    _show(board, split.protocol.id, split.name, None)


@board_app.command()
def show(
    board: _Board,
    track: Annotated[str | None, typer.Option(help="Of this track only.")] = None,
    at_most: Annotated[
        str | None, typer.Option("--uses", help="Entries that use no more than these, with commas between.")
    ] = None,
    csv: Annotated[bool, typer.Option("--csv", help="All numbers as CSV.")] = False,
) -> None:
    """Print the tables of a board."""
    from rsbench.benchmark.leaderboard.board import splits_of
    from rsbench.benchmark.leaderboard.protocols import protocol_of_track

    wanted = None if track is None else protocol_of_track(track).id
    for protocol, split in splits_of(board):
        if wanted in (None, protocol):
            _show(board, protocol, split, at_most, csv=csv)


@board_app.command()
def oracles(track: _Track, board: _Board, data: _Data = None, seed_file: _Secret = None) -> None:
    """Add the truth and, on the track points, what the Cramer-Rao bound allows, as rows without a rank."""
    from rsbench.benchmark.leaderboard.board import add_texts
    from rsbench.benchmark.leaderboard.oracles import bound_text
    from rsbench.benchmark.leaderboard.splits import seed_of
    from rsbench.benchmark.leaderboard.submissions import truth_text
    from rsbench.benchmark.provenance import provenance

    split = _split(track, data, seed_file)
    if not split.public:
        raise RsbenchError(f"split {split.name}: its truth is secret, and would be told as an entry of the board")
    texts = [truth_text(split), *([bound_text(split, seed_of(None))] if data is None else [])]
    add_texts(board, texts, split, provenance("rsbench leaderboard oracles"))
    _show(board, split.protocol.id, split.name, "truth")


@board_app.command()
def build(
    board: _Board,
    out: Annotated[Path, typer.Option(help="Folder of the site.")],
    data: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="Dataset whose pictures to show; repeatable.")
    ] = None,
) -> None:
    """Write the board as a static site, with each table as CSV, Markdown and LaTeX."""
    from rsbench.report.board_page import build_site

    typer.echo(f"page: {build_site(board, out, data or ())}")


@board_app.command()
def merge(
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="Board to copy from.")], board: _Board
) -> None:
    """Copy the entries of another board that this one lacks."""
    from rsbench.benchmark.leaderboard.board import merge

    for name in merge(other, board):
        typer.echo(name)


@board_app.command()
def rescore(track: _Track, board: _Board, data: _Data = None, seed_file: _Secret = None) -> None:
    """Score the stored predictions again and say which scores changed; runs no method."""
    from rsbench.benchmark.leaderboard.board import rescore

    changed = rescore(board, _split(track, data, seed_file))
    for method, columns in changed.items():
        typer.echo(f"{method}: other scores: {', '.join(columns)}")
    if changed:
        raise typer.Exit(1)


def _split(track: str, data: Path | None, seed_file: Path | None, secret: bool = False) -> Split:
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


def _problems(split: Split, data: Path | None, secret: Path | None) -> Iterator[Problem]:
    from rsbench.benchmark.leaderboard.splits import seed_of, simulated_problem

    if data is None:
        seed = seed_of(secret)
        return (simulated_problem(seed, number) for number in range(len(split.truths)))
    from rsbench.benchmark.leaderboard.frames import bare_problems, matched_problems

    return bare_problems(data) if "images" in split.protocol.allowed else matched_problems(data)


def _counted(problems: Iterator[Problem], advance: object) -> Iterator[Problem]:
    for problem in problems:
        yield problem
        advance(problem.name)  # type: ignore[operator]


def _track_of(file: Path) -> str:
    from rsbench.benchmark.leaderboard.submissions import track_of

    return track_of(file)


def _show(
    board: Path, protocol: str, split: str, at_most: str | None, method: str | None = None, *, csv: bool = False
) -> None:
    """Print a table; of one method, its line alone."""
    from rsbench.benchmark.leaderboard.board import entries_of
    from rsbench.benchmark.leaderboard.standings import standings, table
    from rsbench.cli.console import print_rows

    wanted = None if at_most is None else [name.strip() for name in at_most.split(",")]
    lines = standings(entries_of(board, protocol, split), wanted)
    if csv:
        typer.echo(table(lines).to_csv(index=False, lineterminator="\n"), nl=False)
        return
    lines = [line for line in lines if method in (None, line.scored.header.method)]
    for uses in dict.fromkeys(line.uses for line in lines):
        rows = [_cells(line) for line in lines if line.uses == uses]
        print_rows(
            f"{protocol}, split {split}, uses {uses}",
            list(rows[0]),
            [list(row.values()) for row in rows],
            ("e_R",),
        )


def _cells(line: Standing) -> dict[str, str]:
    from rsbench.benchmark.statistics import in_words

    primary = line.protocol.primary
    cells = {"method": line.scored.header.method, "rank": line.rank_words}
    cells[primary.title] = in_words(*line.means[primary.key])
    for score in line.protocol.scores:
        if score.key in ("flip", "failure"):
            cells[score.title] = f"{100.0 * line.means[score.key][0]:.1f} %"
        elif score.key in ("e_R_deg", "e_T_deg", "e_readout"):
            cells[score.title.removesuffix(" (deg)")] = _number(line.medians[score.key])
    return cells


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.3g}"


def register(app: typer.Typer) -> None:
    from rsbench.cli.leaderboard_secret import publish, score
    from rsbench.cli.leaderboard_smoke import smoke

    for command in (smoke, publish, score):
        board_app.command()(command)
    app.add_typer(board_app, name="leaderboard", help="Tracks, entries, ranks with intervals; for any language.")
