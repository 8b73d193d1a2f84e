"""Pages from templates."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def markdown(template: str, **values: Any) -> str:
    """Text of a Markdown template of ``rsbench.report``; a value that the template lacks is an error."""
    environment = Environment(
        loader=PackageLoader("rsbench.report"), undefined=StrictUndefined, keep_trailing_newline=True
    )
    return environment.get_template(template).render(**values)
