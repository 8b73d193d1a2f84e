"""What the commands share: progress bars on stderr, tables on stdout, and silence where it is asked for.

Texts are printed as they are: what looks like rich's markup in them, ``[view]`` say, is no markup."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rsbench.core.errors import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import pandas as pd
    from rich.table import Table

_GAP = 2
"""Cells between columns."""
_quiet = False


def be_quiet(quiet: bool) -> None:
    """``--quiet``: no progress, no tables, no notes; results, their paths and errors stay."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Whether ``--quiet`` was given, for a command whose table is its result."""
    return _quiet


def echo(text: str | None, err: bool = False, nl: bool = True) -> None:
    """Results on stdout, or faults and notes on stderr; control characters of what others wrote are escaped."""
    import typer

    typer.echo(printable(text or ""), err=err, nl=nl)


def say(note: str) -> None:
    """A line on stdout that is no result."""
    if not _quiet:
        echo(note)


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar with time left, on stderr; the yielded function advances it by one step and shows a word."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),  # names of files and sequences may have brackets
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[word]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True), disable=_quiet) as progress:
        task = progress.add_task(label, total=total, word="")

        def advance(word: str) -> None:
            word = printable(word)
            done = progress.tasks[0].completed + 1  # may become more than was expected
            progress.update(task, completed=done, total=max(total, done), word=word)

        yield advance


@contextmanager
def late_progress(label: str) -> Iterator[Callable[[str], None]]:
    """A count of steps on a terminal's stderr, for work of more than two seconds; stdout stays free."""
    import time

    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[word]}", markup=False),
    )
    # Redirected, what a command prints would go where the bar is.
    progress = Progress(
        *columns, console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False
    )
    task = progress.add_task(label, total=None, word="")
    start = time.monotonic()

    def advance(word: str) -> None:
        progress.update(task, advance=1, word=printable(word))
        if not _quiet and progress.console.is_terminal and time.monotonic() - start > 2.0:
            progress.start()

    try:
        yield advance
    finally:
        if progress.live.is_started:
            progress.stop()


def print_table(title: str, frame: pd.DataFrame, digits: dict[str, int] | None = None) -> None:
    """A data frame as a terminal table; ``digits`` gives decimals per column."""
    numeric = {str(column) for column in frame.columns if frame[column].dtype.kind in "fiu"}
    places = [(digits or {}).get(name) for name in frame.columns]
    rows = [
        [_cell(value, place) for value, place in zip(row, places, strict=True)]
        for row in frame.itertuples(index=False)
    ]
    print_rows(title, [str(column) for column in frame.columns], rows, numeric)


def print_rows(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], right: Iterable[str] = ()
) -> None:
    """A table on stdout; the columns in ``right`` are aligned there.

    One that is wider than the terminal goes on below itself, with the columns that tell its rows apart: no word or
    number is broken. Redirected, it takes the room that it needs, unless COLUMNS says otherwise.
    """
    from rich.cells import cell_len
    from rich.console import Console
    from rich.text import Text

    if _quiet:
        return
    console, texts, right = Console(), [[printable(str(value)) for value in row] for row in rows], set(right)
    cells = [[column, *(row[k] for row in texts)] for k, column in enumerate(columns)]
    words = [max((cell_len(word) for cell in each for word in cell.split()), default=0) for each in cells]
    lines = [max(cell_len(line) for cell in each for line in cell.split("\n")) for each in cells]
    if not (console.is_terminal or "COLUMNS" in os.environ):
        console.width = max(80, sum(lines) + _GAP * len(lines) + 1)
    for number, block in enumerate(_blocks(words, _keys(texts), console.width)):
        table = _empty_table(title if number == 0 else "")
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
    """How many of the first columns tell all rows apart; 1 when none do."""
    counts = range(1, len(rows[0]) if rows else 1)
    return next((count for count in counts if len({tuple(row[:count]) for row in rows}) == len(rows)), 1)


def _blocks(widths: Sequence[int], keys: int, room: int) -> list[list[int]]:
    """Columns of the tables into which one is cut, each with the keys; one of all where a word has no room."""
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
    """Widths of columns, which share what their longest words leave; None where these have no room."""
    spare = room - sum(least)
    if spare < 0:
        return [None] * len(least)
    wanted = [high - low for low, high in zip(least, most, strict=True)]
    # What wants little has it before sentences, which can go on in another line.
    level = max(
        range(max(wanted, default=0) + 1), key=lambda k: (sum(min(each, k) for each in wanted) <= spare) * k
    )
    return [low + min(each, level) for low, each in zip(least, wanted, strict=True)]


def _empty_table(title: str) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    return Table(
        title=Text(title, "table.title") if title else None,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:
        return "-"
    if isinstance(value, float):
        return f"{value:.{3 if digits is None else digits}f}"
    return str(value)
