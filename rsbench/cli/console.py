"""Output of all commands: progress bars on stderr, tables on stdout, and ``--quiet``.

Texts are printed literally: brackets such as ``[view]`` are not taken for rich's markup.
"""

from __future__ import annotations

import json as json_module
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from rsbench.core.errors import RsbenchError, printable

if TYPE_CHECKING:
    import pandas as pd
    from rich.progress import Progress, ProgressColumn

_GAP = 2
"""Character cells between columns."""
_quiet = False


def be_quiet(quiet: bool) -> None:
    """Set whether progress, tables and notes are left out (``--quiet``); results, paths and errors are printed."""
    global _quiet
    _quiet = quiet


def echo(text: str | None, err: bool = False, nl: bool = True) -> None:
    """Print results on stdout, or errors and notes on stderr; control characters are escaped."""
    typer.echo(printable(text or ""), err=err, nl=nl)


def say(note: str) -> None:
    """Print a note on stdout, unless ``--quiet``."""
    if not _quiet:
        echo(note)


def report_faults(faults: Sequence[str], summary: str) -> None:
    """Print each fault on stderr and the summary on stdout; exit code 1 if there is a fault."""
    for fault in faults:
        echo(f"fault: {fault}", err=True)
    echo(summary)
    if faults:
        raise typer.Exit(1)


def print_json(value: object, **options: Any) -> None:
    """Print a value as one line of JSON."""
    echo(json_module.dumps(value, **options))


def print_answers(
    found: Iterable[dict[str, Any] | RsbenchError],
    json: bool,
    good: str,
    show: Callable[[list[dict[str, Any]]], None],
) -> None:
    """Print each answer as JSON when it is ready, or all at the end by ``show``; print errors on stderr.

    The exit code is 2 if an input is invalid, 1 if the value of an answer at the key ``good`` is false.
    """
    answers, code = list[dict[str, Any]](), 0
    for answer in found:
        if isinstance(answer, RsbenchError):
            code = 2
            echo(f"rsbench: error: {' '.join(str(answer).split())}", err=True)
            continue
        code = code or int(not answer[good])
        if json:
            print_json(answer, allow_nan=False)
        else:
            answers.append(answer)
    show(answers)
    if code:
        raise typer.Exit(code)


def _progress(
    before: tuple[ProgressColumn, ...] = (), after: tuple[ProgressColumn, ...] = (), **options: Any
) -> Progress:
    """Create a counter of steps with columns before and after it; brackets in names are not read as markup."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    label, word = (TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[word]}"))
    columns = (label, *before, MofNCompleteColumn(), TimeElapsedColumn(), *after, word)
    return Progress(*columns, console=Console(stderr=True), **options)


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on stderr; the yielded function advances it by one step and shows a word."""
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    left = (TextColumn("left"), TimeRemainingColumn())
    with _progress((BarColumn(),), left, disable=_quiet) as progress:
        task = progress.add_task(label, total=total, word="")

        def advance(word: str) -> None:
            word = printable(word)
            done = progress.tasks[0].completed + 1  # may exceed the expected total
            progress.update(task, completed=done, total=max(total, done), word=word)

        yield advance


@contextmanager
def late_progress(label: str) -> Iterator[Callable[[str], None]]:
    """Show a counter of steps on stderr, if it is a terminal and the work takes more than two seconds."""
    start, steps, progress = time.monotonic(), 0, None

    def advance(word: str) -> None:
        nonlocal steps, progress
        steps += 1
        if _quiet or time.monotonic() - start <= 2.0:
            return
        if progress is None:
            # Without these options, rich would print the command's output to stderr with the bar.
            progress = _progress(transient=True, redirect_stdout=False, redirect_stderr=False)
            progress.add_task(label, total=None, word="")
            progress.tasks[0].start_time = start
            if progress.console.is_terminal:
                progress.start()
        progress.update(progress.task_ids[0], completed=steps, word=printable(word))

    try:
        yield advance
    finally:
        if progress is not None and progress.live.is_started:
            progress.stop()


def print_table(title: str, frame: pd.DataFrame) -> None:
    """Print a data frame as a terminal table."""
    numeric = {str(column) for column in frame.columns if frame[column].dtype.kind in "fiu"}
    rows = [list(map(_cell, row)) for row in frame.itertuples(index=False)]
    print_rows(title, [str(column) for column in frame.columns], rows, numeric)


def print_records(rows: Sequence[dict[str, str]], right: Iterable[str] = ()) -> None:
    """Print a table that is a command's result; with ``--quiet`` only its rows, separated by tabs."""
    if _quiet:
        for row in rows:
            echo("\t".join(row.values()))
    elif rows:
        print_rows("", list(rows[0]), [list(row.values()) for row in rows], right)


def print_rows(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    right: Iterable[str] = (),
    solid: Iterable[str] = (),
) -> None:
    """Print a table on stdout; the columns in ``right`` are aligned to the right.

    If it is wider than the terminal, it is split into several tables that repeat the key columns, so that no word
    or number, and no cell of a column in ``solid``, is broken. Redirected output is as wide as needed, unless
    COLUMNS is set.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if _quiet:
        return
    console, texts, right = Console(), [[printable(str(value)) for value in row] for row in rows], set(right)
    cells = [[column, *(row[k] for row in texts)] for k, column in enumerate(columns)]
    solid = set(solid)
    words = [
        max(
            (cell_len(part) for cell in each for part in ([cell] if each[0] in solid else cell.split())), default=0
        )
        for each in cells
    ]
    lines = [max(cell_len(line) for cell in each for line in cell.split("\n")) for each in cells]
    if not (console.is_terminal or "COLUMNS" in os.environ):
        console.width = max(80, sum(lines) + _GAP * len(lines) + 1)
    for number, block in enumerate(_blocks(words, _keys(texts), console.width)):
        table = Table(
            title=Text(title, "table.title") if title and number == 0 else None,
            title_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
        )
        widths = _shared(
            [words[k] for k in block], [lines[k] for k in block], console.width - _GAP * len(block) - 1
        )
        for k, width in zip(block, widths, strict=True):
            justify = "right" if columns[k] in right else "left"
            table.add_column(Text(columns[k]), justify=justify, overflow="fold", width=width)
        for row in texts:
            table.add_row(*(Text(row[k]) for k in block))
        console.print(table)


def _keys(rows: Sequence[Sequence[str]]) -> int:
    """Return the smallest number of first columns that identify every row; 1 if there is none."""
    counts = range(1, len(rows[0]) if rows else 1)
    return next((count for count in counts if len({tuple(row[:count]) for row in rows}) == len(rows)), 1)


def _blocks(widths: Sequence[int], keys: int, room: int) -> list[list[int]]:
    """Split columns into parts that fit, each with the key columns; a single part if a word would not fit."""
    room -= sum(widths[:keys]) + _GAP * keys + 1
    blocks: list[list[int]] = [[]]
    for k in range(keys, len(widths)):
        if blocks[-1] and sum(widths[j] + _GAP for j in (*blocks[-1], k)) > room:
            blocks.append([])
        blocks[-1].append(k)
    if any(sum(widths[k] + _GAP for k in block) > room for block in blocks):
        return [list(range(len(widths)))]
    return [[*range(min(keys, len(widths))), *block] for block in blocks]


def _shared(least: Sequence[int], most: Sequence[int], room: int) -> Sequence[int | None]:
    """Return the widths of columns: their longest words plus parts of the remaining room; None if words do not
    fit."""
    spare = room - sum(least)
    if spare < 0:
        return [None] * len(least)
    wanted = [high - low for low, high in zip(least, most, strict=True)]
    # The remaining room goes to short cells first, because sentences can be wrapped.
    level = max(
        range(max(wanted, default=0) + 1), key=lambda k: (sum(min(each, k) for each in wanted) <= spare) * k
    )
    return [low + min(each, level) for low, each in zip(least, wanted, strict=True)]


def _cell(value: Any) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
