"""Render templates, and format tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from rsbench.benchmark.statistics import format_interval

if TYPE_CHECKING:  # loading it takes half a second
    import pandas as pd


def rendered(template: str, *, trim: bool = False, **values: Any) -> str:
    """Render a template of ``rsbench.report``; a variable of the template without a value is an error.

    Values are escaped in HTML. ``trim``: remove the line break after a template tag.
    """
    html = template.endswith(".html.j2")
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=trim,
        keep_trailing_newline=not html,
    )
    return environment.get_template(template).render(**values)


def table_lines(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (head, *rows)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def frame_text(table: pd.DataFrame) -> str:
    """Format a data frame, without its index, as a table in Markdown."""
    return "\n".join(table_lines(list(table), table.itertuples(index=False)))


def words_of(row: Mapping[Any, Any], name: str) -> str:
    """Format a number and its interval from the columns that ``with_ends`` names; a dash for NaN."""
    import pandas as pd

    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return "-" if pd.isna(value) else format_interval(value, low, high)
