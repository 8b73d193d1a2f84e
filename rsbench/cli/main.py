"""The ``rsbench`` command. Modules of commands import nothing heavy until they run, so that help is instant."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from rsbench import __version__
from rsbench.cli import (
    check_solver,
    correct,
    demo,
    docs,
    doctor,
    evaluate,
    generate,
    reproduce,
    show,
    simulate,
    solve,
    verify,
)
from rsbench.cli import list_cards as cards
from rsbench.cli.stopping import stoppable
from rsbench.errors import RsbenchError

app = typer.Typer(
    name="rsbench",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Rolling-shutter stereo: render data with exact ground truth, solve, correct and score.",
    epilog="Start with: [bold]rsbench demo[/bold]   Exit codes: 0 done, 1 ran but failed, 2 bad input, "
    "130 interrupted.",
)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"rsbench {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option("--quiet", "-q", help="Before a command: no progress, no tables; results and errors only."),
    ] = False,
) -> None:
    from rsbench.cli.console import be_quiet

    be_quiet(quiet)


for module in (
    demo,
    cards,
    show,
    doctor,
    generate,
    verify,
    solve,
    check_solver,
    evaluate,
    correct,
    simulate,
    reproduce,
    docs,
):
    module.register(app)


def run() -> None:
    """Entry point: known errors become one line on stderr and exit code 2."""
    try:
        with stoppable():
            app(prog_name="rsbench")
    except RsbenchError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:  # a full disk or a folder without permission, wherever it is met
        _fail(f"{error.filename or 'file system'}: {error.strerror or error}")


def _fail(message: str, code: int = 2) -> None:
    sys.stderr.write(f"rsbench: error: {' '.join(message.split())}\n")
    sys.exit(code)
