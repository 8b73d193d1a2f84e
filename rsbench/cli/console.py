"""What the commands share: progress bars on stderr, tables on stdout, and silence where it is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import pandas as pd

_quiet = False


def be_quiet(quiet: bool) -> None:
    """``--quiet``: no progress, no tables, no notes; results, their paths and errors stay."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Whether ``--quiet`` was given, for a command whose table is its result."""
    return _quiet


def say(note: str) -> None:
    """A line on stdout that is no result."""
    import typer

    if not _quiet:
        typer.echo(note)


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
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[word]}"),
    )
    with Progress(*columns, console=Console(stderr=True), disable=_quiet) as progress:
        task = progress.add_task(label, total=total, word="")

        def advance(word: str) -> None:
            progress.update(task, advance=1, word=word)

        yield advance


@contextmanager
def late_progress(label: str) -> Iterator[Callable[[str], None]]:
    """A count of steps on a terminal's stderr, for work of more than two seconds; stdout stays free."""
    import time

    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[word]}"),
    )
    # Redirected, what a command prints would go where the bar is.
    progress = Progress(
        *columns, console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False
    )
    task = progress.add_task(label, total=None, word="")
    start = time.monotonic()

    def advance(word: str) -> None:
        progress.update(task, advance=1, word=word)
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
    """A terminal table; the columns in ``right`` are aligned there."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if _quiet:
        return
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    right = set(right)
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(value)) for value in row))
    Console().print(table)


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:
        return "-"
    if isinstance(value, float):
        return f"{value:.{3 if digits is None else digits}f}"
    return str(value)
