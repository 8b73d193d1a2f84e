"""``rsbench leaderboard``: compare methods of anybody on the same problems, ranked as far as the data allow."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rsbench.cli.cluster_options import Scheduler, chosen_workers, results_at
from rsbench.cli.console import echo, late_progress, print_rows, progress_bar, say
from rsbench.cli.names import complete, named
from rsbench.core.errors import RsbenchError, naming

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from rsbench.benchmark.leaderboard.board import Scored
    from rsbench.benchmark.leaderboard.standings import Standing
    from rsbench.benchmark.leaderboard.track import Split
    from rsbench.pipeline.problem import Problem

EPILOG = """[bold]Examples[/bold]

  rsbench leaderboard export points --out inputs           [dim](CSV, npz and JSON for any language)[/dim]

  rsbench leaderboard template points > mine.jsonl         [dim](an example of what to hand in)[/dim]

  rsbench leaderboard check mine.jsonl

  rsbench leaderboard submit mine.jsonl --board board

  rsbench leaderboard run points --entry rs-stereo-refined --entry my_solver.py --board board

  rsbench leaderboard run points-recorded --data walks --entry rs-stereo-auto --board board

  rsbench leaderboard show --board board

More: [bold]rsbench docs submit[/bold] and [bold]rsbench docs protocols[/bold]"""

SMOKE_EPILOG = """[bold]Examples[/bold]

  rsbench leaderboard smoke                                [dim](all tracks; a minute on two cores)[/dim]

  rsbench leaderboard smoke --track depth --track correction

  rsbench leaderboard smoke --track points --entry rs-stereo-refined --entry mine.toml --problems 2

  rsbench leaderboard smoke --track pose --write           [dim](its new scores are right: store them)[/dim]

More: [bold]rsbench docs submit[/bold]"""

_SHOWN = (
    *("e_R_deg", "e_T_deg", "e_readout", "abs_rel", "psnr", "epe_px"),
    *("way_median_deg", "rows_median_deg", "ate_mm", "jitter_px"),
)
"""Keys of the scores whose medians tables on a terminal have."""

board_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    epilog=EPILOG,
    help="Score predictions on tracks and rank them with intervals; predictions may come from any language.",
)

Track = Annotated[
    str,
    typer.Argument(
        help="A track or its protocol, such as points-2, pose (given matches) or pose-own (own matches)."
    ),
]
Data = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Dataset (a dataset.json) of all tracks but points and points-2; of points-recorded a folder of "
        "recordings, such as hand-mine.txt, in place of ours.",
    ),
]
Secret = Annotated[
    Path | None, typer.Option("--seed-file", metavar="FILE", help="Secret text from which a test split is drawn.")
]
Hidden = Annotated[
    bool, typer.Option("--secret", help="The dataset's truth is secret: not exported, and not used by check.")
]

Workers = Annotated[int, typer.Option(min=1, help="Processes.")]
_Board = Annotated[Path, typer.Option(help="Folder of the board.")]
_File = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="Predictions: JSON lines; the folder 'pictures' beside it is read too."),
]
_Seed = Annotated[
    Path, typer.Option("--seed-file", metavar="FILE", help="Secret text, 16 characters or more, drawn at random.")
]


@board_app.command()
def export(
    track: Track,
    out: Annotated[Path, typer.Option(help="Folder for the inputs.")],
    data: Data = None,
    seed_file: Secret = None,
    secret: Hidden = False,
) -> None:
    """Write the inputs of a track for any language and, for a public split, the truth."""
    from rsbench.benchmark.leaderboard.inputs import check_place, write_frames, write_inputs
    from rsbench.storage.work_folder import work_folder

    split = split_of(track, data, seed_file, secret)
    check_place(split, out)
    with work_folder(out), progress_bar(f"exporting {split.name}", len(split.truths)) as advance:
        if data is not None and split.track.gives_images:
            write_frames(split, out)
        write_inputs(split, _counted(split.track.problems(data, seed_file, len(split.truths)), advance), out)
    echo(f"{split.track.id}, split {split.name}, {len(split.truths)} problems: {out}")
    echo(f"fingerprint: {split.fingerprint}")


@board_app.command()
def template(
    track: Track,
    data: Data = None,
    seed_file: Secret = None,
    out: Annotated[Path | None, typer.Option(help="New folder; needed for tracks of images.")] = None,
) -> None:
    """Print a valid file of predictions, to fill in."""
    from rsbench.benchmark.leaderboard.submissions import write_template

    split = split_of(track, data, seed_file)
    if out is None:
        if split.track.pictures:
            raise RsbenchError(f"--out: the track {track!r} needs pictures; name a new folder for the example")
        with tempfile.TemporaryDirectory() as folder:
            write_template(split, path := Path(folder) / "predictions.jsonl")
            echo(path.read_text("utf-8"), nl=False)
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RsbenchError(f"--out {out}: is there already; choose a new folder")
    out.mkdir(parents=True, exist_ok=True)
    write_template(split, path := out / "predictions.jsonl")
    echo(str(path))


@board_app.command()
def check(file: _File, data: Data = None, seed_file: Secret = None, secret: Hidden = False) -> None:
    """List all faults of a file of predictions. Exit code 2: it cannot be scored; 1: it can, but has notes."""
    from rsbench.benchmark.leaderboard.submissions import check_submission

    found = check_submission(file, split_of(_track_of(file), data, seed_file, secret))
    for fault in found.faults:
        echo(f"fault: {' '.join(fault.split())}", err=True)
    for note in found.notes:
        echo(f"note: {note}", err=True)
    echo(f"{file}: {len(found.faults)} faults, {len(found.notes)} notes")
    if found.faults or found.notes:
        raise typer.Exit(2 if found.faults else 1)


@board_app.command()
def submit(
    file: _File,
    board: _Board,
    data: Data = None,
    seed_file: Secret = None,
    secret: Hidden = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace an entry of the same name.")] = False,
    workers: Workers = 1,
) -> None:
    """Score a file of predictions and add it to a board."""
    split = split_of(_track_of(file), data, seed_file, secret)
    scored = _added(board, file, split, "rsbench leaderboard submit", replace, workers)
    _show(board, split.track.id, split.name, None, scored.header.method)
    _echo_doubt(scored)


@board_app.command()
def run(
    track: Track,
    entry: Annotated[
        list[str],
        named(
            "solvers",
            "Solver, stereo matcher (depth), corrector (correction, -mono), method (trajectory): "
            "name, card or FILE.py; repeatable.",
            "--entry",
            "--solver",
        ),
    ],
    board: Annotated[
        str, typer.Option(metavar="DIR", help="Folder of the board, or a URL such as s3://bucket/folder.")
    ],
    data: Data = None,
    seed_file: Secret = None,
    secret: Hidden = False,
    problems: Annotated[
        int | None, typer.Option(min=1, help="Only the first problems; they are a separate split on the board.")
    ] = None,
    stored: Annotated[
        Path | None,
        typer.Option(
            "--beside",
            metavar="DIR",
            help="Stored predictions to rank beside, not added to the board. "
            "Default: those of this track that come with rsbench.",
        ),
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one per core.")] = None,
    scheduler: Scheduler = None,
    time_limit: Annotated[
        float | None,
        typer.Option(min=0.001, help="Time limit per problem, seconds; beyond it the problem counts as failed."),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            metavar="MB",
            help="Memory limit of a method's process; beyond it the problem counts as failed.",
        ),
    ] = None,
) -> None:
    """Run cards on a track, keep their predictions, and score them. An interrupted run resumes."""
    from rsbench.benchmark.leaderboard.board import RUN, add_all, made_by
    from rsbench.benchmark.leaderboard.inputs import prepare_inputs
    from rsbench.benchmark.leaderboard.running import count_steps, load_cards, run_cards
    from rsbench.benchmark.leaderboard.submissions import failure_reasons
    from rsbench.benchmark.leaderboard.track import Limits
    from rsbench.benchmark.provenance import provenance
    from rsbench.storage.work_folder import work_folder

    processes = chosen_workers(workers, scheduler, os.cpu_count() or 1)
    whole = split_of(track, data, seed_file, secret)
    there = len(whole.truths)
    if problems is not None and problems > there:
        raise RsbenchError(f"--problems {problems}: split {whole.name} has {there}")
    split = whole if problems in (None, there) else replace(whole, truths=whole.truths[:problems])
    others = _stored(whole, split, stored)
    load_cards(split.track, entry)  # before anything is written
    limits = Limits(time_limit, memory)
    with results_at(board, scheduler) as place:
        with (
            work_folder(place) as hidden,
            progress_bar(f"running {split.name}", count_steps(split, entry, limits)) as advance,
        ):
            work = hidden / "runs" / split.track.id / split.name
            work.mkdir(parents=True, exist_ok=True)
            prepare_inputs(split, data, seed_file, work / "inputs")
            files = run_cards(split, entry, work / "inputs", work, workers=processes, limits=limits, step=advance)
        with _scoring(split) as step:
            add_all(
                place,
                files,
                split,
                provenance(RUN),
                replace=lambda method: made_by(place, split, method) == RUN,
                workers=processes,
                step=step,
            )
        _show(place, split.track.id, split.name, None, beside=others)
        for file in files:
            if reasons := failure_reasons(file):
                say(f"{file.parent.name}: {reasons}")


def _stored(whole: Split, split: Split, folder: Path | None) -> list[Scored]:
    """Score stored predictions, those in ``folder`` or those installed with rsbench, on a part of a split."""
    from rsbench.benchmark.leaderboard.board import restore
    from rsbench.components.cards import shipped_folder

    shipped = shipped_folder("results", "_results").glob(f"*/predictions/{split.track.id}")
    found: list[Scored] = []
    with late_progress("scoring stored entries") as step:
        for each in sorted(shipped) if folder is None else [folder]:
            with tempfile.TemporaryDirectory() as board:
                try:
                    found += restore(each, whole, Path(board), split, step)
                except RsbenchError:  # predictions for another split
                    if folder is not None:
                        raise
    return found


@board_app.command()
def show(
    board: _Board,
    track: Annotated[str | None, typer.Option(help="Only this track.")] = None,
    at_most: Annotated[
        str | None,
        typer.Option("--uses", help="Only entries that use no other inputs than these, separated by commas."),
    ] = None,
    csv: Annotated[bool, typer.Option("--csv", help="Print all numbers as CSV.")] = False,
) -> None:
    """Print the tables of a board."""
    from rsbench.benchmark.leaderboard.board import splits_of
    from rsbench.benchmark.leaderboard.tracks import track_of_name

    wanted = None if track is None else track_of_name(track).id
    for protocol, split in splits_of(board):
        if wanted in (None, protocol):
            _show(board, protocol, split, at_most, csv=csv)


@board_app.command()
def oracles(track: Track, board: _Board, data: Data = None, seed_file: Secret = None) -> None:
    """Add the ground truth and methods that use it, without a rank; for correction, the uncorrected frames too."""
    from rsbench.benchmark.leaderboard.board import add_all
    from rsbench.benchmark.leaderboard.submissions import write_oracles
    from rsbench.benchmark.provenance import provenance

    split = split_of(track, data, seed_file)
    if not split.public:
        raise RsbenchError(f"split {split.name}: its truth is secret, and would be shown as an entry of the board")
    made = provenance("rsbench leaderboard oracles")
    with tempfile.TemporaryDirectory() as folder, _scoring(split) as step:
        add_all(board, write_oracles(split, Path(folder)), split, made, step=step)
    _show(board, split.track.id, split.name, "truth")


@board_app.command()
def build(
    board: _Board,
    out: Annotated[Path, typer.Option(help="Folder of the site.")],
    data: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="Dataset whose images are shown; repeatable.")
    ] = None,
) -> None:
    """Write the board as a static site, with each table as CSV, Markdown and LaTeX."""
    from rsbench.report.board_page import build_site

    echo(f"page: {build_site(board, out, data or ())}")


@board_app.command()
def merge(
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="Board to copy from.")], board: _Board
) -> None:
    """Copy missing entries from another board."""
    from rsbench.benchmark.leaderboard.board import merge

    for name in merge(other, board):
        echo(name)


@board_app.command()
def rescore(
    track: Track,
    board: _Board,
    data: Data = None,
    seed_file: Secret = None,
    workers: Workers = 1,
    stored: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Make the board from these predictions, such as results/laws/predictions/pose-2."
        ),
    ] = None,
) -> None:
    """Score the stored predictions again and list the scores that changed; no method is run."""
    from rsbench.benchmark.leaderboard.board import rescore, restore

    split = split_of(track, data, seed_file)
    if stored is not None:
        restore(stored, split, board)
        _show(board, split.track.id, split.name, None)
        return
    with _scoring(split) as step:
        changed = rescore(board, split, workers, step)
    for method, columns in changed.items():
        echo(f"{method}: other scores: {', '.join(columns)}")
    if changed:
        raise typer.Exit(1)


@board_app.command(epilog=SMOKE_EPILOG)
def smoke(
    stored: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the stored scores.")] = Path(
        "results/leaderboard/smoke"
    ),
    track: Annotated[list[str] | None, typer.Option(help="Only this track; repeatable. Default: all.")] = None,
    entry: Annotated[
        list[str] | None,
        named(
            "solvers", "Only this entry; repeatable. Default: all of our solvers on points, a few of the others."
        ),
    ] = None,
    problems: Annotated[
        int | None, typer.Option(min=1, help="Only the first ones; default: 6 of points, all 3 of the others.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The dataset leaderboard-smoke; default: it is rendered."),
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core.")] = None,
    write: Annotated[bool, typer.Option("--write", help="Store the scores instead of comparing.")] = False,
) -> None:
    """Run a few entries of each track on small problems, and list the scores that differ from the stored ones.

    Exit code 1: there is one.
    """
    from rsbench.benchmark.leaderboard import smoke as smoke_run
    from rsbench.storage.files import check_out

    jobs = smoke_run.chosen_jobs(track, entry)
    tracks = list(dict.fromkeys(job.track for job in jobs))
    if write:
        check_out(stored)
    known = {} if write else {name: smoke_run.read_scores(stored, name) for name in tracks}
    with smoke_run.smoke_frames(data, tracks, problems, progress_bar, lambda line: echo(line, err=True)) as folder:
        count = workers or min(os.cpu_count() or 1, len(jobs))
        with progress_bar("smoke", len(jobs)) as step:
            found = smoke_run.run_smoke(jobs, folder, problems, count, step)
        frames = {} if folder is None else smoke_run.hashes_of_frames(folder)
    if write:
        for path in smoke_run.store_scores(stored, found, frames, "rsbench leaderboard smoke --write"):
            echo(f"scores: {path}")
        return
    lines = list[str]()
    for name, scores in found.items():
        others = list[str]() if name == "points" else smoke_run.other_frames(stored, name, frames)
        if others:
            echo(f"note: {name}: other frames than those of the stored scores: {', '.join(others)}")
        lines += smoke_run.differences(name, scores, known[name], others)
    for line in lines:
        echo(line)
    answers = sum(len(scores) for scores in found.values())
    entries = sum(scores["method"].nunique() for scores in found.values())
    echo(f"{answers} answers of {entries} entries of {len(found)} tracks, {len(lines)} differ from {stored}")
    if lines:
        raise typer.Exit(1)


# Commands for those who host a board


@board_app.command()
def publish(
    track: Annotated[str, typer.Argument(help="A track of frames, such as pose or pose-own.")],
    seed_file: _Seed,
    keep: Annotated[Path, typer.Option(metavar="DIR", help="Folder for scenes and truth, to be kept secret.")],
    out: Annotated[Path, typer.Option(help="Folder to publish.")],
    card: Annotated[
        str, typer.Option(metavar="CARD", help="Dataset card of the split.", autocompletion=complete("datasets"))
    ] = "standard",
    workers: Annotated[int, typer.Option(min=1, help="Processes; each renders whole sequences.")] = 1,
) -> None:
    """Render a secret test split and write its inputs without truth. A second run reproduces it."""
    from rsbench.benchmark.leaderboard import publishing
    from rsbench.benchmark.leaderboard.tracks import track_of_name
    from rsbench.dataset.generation import steps_of
    from rsbench.dataset.secret_split import read_secret, secret_card

    of_frames, text = track_of_name(track), read_secret(seed_file)
    if not of_frames.inputs.rendered:
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


@board_app.command()
def score(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions: JSON lines.")],
    seed_file: _Seed,
    published: Annotated[Path, typer.Option(metavar="DIR", help="Folder that publish wrote, --out.")],
    board: Annotated[Path, typer.Option(help="Folder of the board.")],
    card: Annotated[
        str | None, typer.Option(metavar="CARD", help="Dataset card of the split, if it is not rsbench's.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Secret folder of publish, if the truth is depth or frames.")
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace an entry of the same name.")] = False,
    workers: Workers = 1,
) -> None:
    """Draw the truth of a secret split from its text, check that it is the announced one, and score."""
    from rsbench.benchmark.leaderboard.publishing import announced_split, read_announcement
    from rsbench.benchmark.leaderboard.tracks import track_of_id
    from rsbench.dataset.secret_split import read_secret

    announced = read_announcement(published)
    track, text = track_of_id(announced.protocol), read_secret(seed_file)
    split = announced_split(announced, track, card or announced.card, text, keep)
    scored = _added(board, file, split, "rsbench leaderboard score", replace, workers)
    echo(f"entry: {scored.folder}")
    _echo_doubt(scored)


@board_app.command()
def accept(
    method: Annotated[str, typer.Argument(metavar="METHOD", help="Name of the entry.")],
    board: Annotated[Path, typer.Option(help="Folder of the board.")],
    protocol: Annotated[str, typer.Option(metavar="ID", help="Such as points-1.")],
    split: Annotated[str, typer.Option(metavar="NAME", help="Such as dev-f88c896f.")],
    reason: Annotated[
        str, typer.Option(metavar="TEXT", help="Why the entry is accepted; stored in its entry.json.")
    ],
) -> None:
    """Rank an entry whose errors are below what its data allow."""
    from rsbench.benchmark.leaderboard import board as boards

    if not reason.strip():
        raise RsbenchError("--reason '': must say why the entry is believed")
    echo(f"{method}: ranked all the same: {boards.accept(board, protocol, split, method, reason)}")


# Shared


def split_of(track: str, data: Path | None, seed_file: Path | None, secret: bool = False) -> Split:
    from rsbench.benchmark.leaderboard.tracks import track_of_name

    return track_of_name(track).split(data, seed_file, secret)


def _added(board: Path, file: Path, split: Split, command: str, replace: bool, workers: int) -> Scored:
    """Print the notes on a file of predictions, score it and add it to a board."""
    from rsbench.benchmark.leaderboard.board import add
    from rsbench.benchmark.leaderboard.submissions import check_submission
    from rsbench.benchmark.provenance import provenance

    for note in check_submission(file, split).notes:
        echo(f"note: {note}", err=True)
    return add(board, file, split, provenance(command), replace=replace, workers=workers)


def _echo_doubt(scored: Scored) -> None:
    if scored.doubt:
        echo(f"in doubt, and not ranked: {scored.doubt}")


def _scoring(split: Split) -> AbstractContextManager[Callable[[str], None]]:
    """Return a progress bar for scoring the pictures of problems; no bar for tracks without pictures."""
    if not split.track.pictures:  # other scores take no time
        return nullcontext(lambda word: None)
    return progress_bar(f"scoring {split.name}", len(split.truths))


def _counted(problems: Iterator[Problem], advance: object) -> Iterator[Problem]:
    for problem in problems:
        yield problem
        advance(problem.name)  # pyrefly: ignore[not-callable]


def _track_of(file: Path) -> str:
    from rsbench.benchmark.leaderboard.submissions import protocol_of
    from rsbench.benchmark.leaderboard.tracks import track_of_id

    protocol, where = protocol_of(file)
    with naming(where, RsbenchError):
        return track_of_id(protocol).name


def _show(
    board: Path,
    protocol: str,
    split: str,
    at_most: str | None,
    method: str | None = None,
    *,
    csv: bool = False,
    beside: Sequence[Scored] = (),
) -> None:
    """Print a table; for a given method, only its line.

    Entries of ``beside`` are added if their names are not on the board and an entry of the board is compared with
    them.
    """
    from rsbench.benchmark.leaderboard.board import entries_of
    from rsbench.benchmark.leaderboard.standings import standings, table

    wanted = None if at_most is None else [name.strip() for name in at_most.split(",")]
    entries = entries_of(board, protocol, split)
    names = {each.header.method for each in entries}
    lines = standings([*entries, *(each for each in beside if each.header.method not in names)], wanted)
    if csv:
        echo(table(lines).to_csv(index=False, lineterminator="\n"), nl=False)
        return
    if beside:
        most = [set(each.header.uses) for each in entries]
        lines = [
            line
            for line in lines
            if line.rank is None or any(used >= set(line.scored.header.uses) for used in most)
        ]
    lines = [line for line in lines if method in (None, line.scored.header.method)]
    for uses in dict.fromkeys(line.uses for line in lines):
        group = [line for line in lines if line.uses == uses]
        among = next((f", ranked among {each.peers}" for each in group if each.rank and each.peers > 1), "")
        stated = any(line.calibration for line in group if line.scored.header.method in names)
        rows = [_cells(line) | (line.stated_words if stated else {}) for line in group]
        print_rows(
            f"{protocol}, split {split}, uses {uses}{among}",
            list(rows[0]),
            [list(row.values()) for row in rows],
            right=("e_R",),
            solid=list(rows[0]),
        )


def _cells(line: Standing) -> dict[str, str]:
    from rsbench.benchmark.statistics import format_interval

    primary = line.track.primary
    cells = {"method": line.scored.header.method, "rank": line.rank_words.partition(" of ")[0]}
    cells[primary.title] = format_interval(*line.means[primary.key])
    for score in line.track.scores:
        if score.key in ("flip", *line.track.beside):
            cells[score.title] = f"{100.0 * line.means[score.key][0]:.1f} %"
        elif score.key in _SHOWN:
            value = line.medians[score.key]
            cells[score.title.removesuffix(" (deg)")] = "-" if value != value else f"{value:.3g}"
    return cells
