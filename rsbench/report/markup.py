"""Pages from templates, and tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from rsbench.benchmark.statistics import format_interval

if TYPE_CHECKING:  # it takes half a second to load
    import pandas as pd


def rendered(template: str, *, trim: bool = False, **values: Any) -> str:
    """Text of a template of ``rsbench.report``; a value that the template lacks is an error.

    In HTML what values hold is escaped. ``trim``: lines of instructions alone leave no empty lines.
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
    """The lines of a table in Markdown."""
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (head, *rows)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def frame_text(table: pd.DataFrame) -> str:
    """A data frame, without its index, as a table in Markdown."""
    return "\n".join(table_lines(list(table), table.itertuples(index=False)))


def words_of(row: Mapping[Any, Any], name: str) -> str:
    """The number of the columns of ``with_ends`` with its interval; a dash where there is none."""
    import pandas as pd

    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return "-" if pd.isna(value) else format_interval(value, low, high)
