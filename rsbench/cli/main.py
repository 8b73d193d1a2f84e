"""The ``rsbench`` command. Modules of commands import nothing heavy until they run, so that help is instant."""

from __future__ import annotations

import copy
import errno
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer

from rsbench.cli import (
    correct,
    evaluate,
    exits,
    generate,
    inspect,
    leaderboard,
    reproduce,
    rig,
    simulate,
    solve,
    verify,
)
from rsbench.cli.console import be_quiet
from rsbench.cli.export import EXPORT_EPILOG, VIEW_EPILOG, export, view
from rsbench.cli.names import LIST_EPILOG, SHOW_EPILOG, list_, show
from rsbench.cli.small_commands import (
    CHECK_SOLVER_EPILOG,
    COMPILE_EPILOG,
    DOCS_EPILOG,
    check_solver,
    compile_,
    demo,
    docs,
    doctor,
)
from rsbench.core.errors import RsbenchError, printable
from rsbench.core.version import __version__

app = typer.Typer(
    name="rsbench",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Rolling-shutter stereo: render data with exact ground truth, solve, correct and score.",
    epilog="Start with: [bold]rsbench demo[/bold]   Exit codes: 0 done, 1 ran but failed, 2 bad input, "
    "70 a fault of rsbench (the line names its log), 130 interrupted. What unfolds to more than a file should is "
    "refused; RSBENCH_LIMITS=4 in the environment allows four times as much.",
)
_LONGEST = 2000
"""Longest message, characters; longer ones keep their beginning, with the file, and their end, with the remedy."""


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
    # Before OpenCV is imported, here and in child processes: our own message says what is wrong with an image.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    be_quiet(quiet)
    warnings.showwarning = _show_warning


def _show_warning(message: Warning | str, category: type[Warning], *where: object, **more: object) -> None:
    """Print a warning for users (FutureWarning) as one line; other warnings are not shown."""
    if issubclass(category, FutureWarning):
        typer.echo(f"rsbench: note: {printable(str(message))}", err=True)


_COMMANDS = (
    ("demo", demo, "[bold]Example[/bold]  rsbench demo --scene old-town --out out/demo"),
    ("list", list_, LIST_EPILOG),
    ("show", show, SHOW_EPILOG),
    ("doctor", doctor, "[bold]Example[/bold]  rsbench doctor"),
    ("compile", compile_, COMPILE_EPILOG),
    ("generate", generate.generate, generate.EPILOG),
    ("verify", verify.verify, verify.EPILOG),
    ("digest", verify.digest, verify.DIGEST_EPILOG),
    ("view", view, VIEW_EPILOG),
    ("export", export, EXPORT_EPILOG),
    ("solve", solve.solve, solve.EPILOG),
    ("inspect", inspect.inspect, inspect.EPILOG),
    ("rig", rig.rig, rig.EPILOG),
    ("check-solver", check_solver, CHECK_SOLVER_EPILOG),
    ("evaluate", evaluate.evaluate, evaluate.EPILOG),
    ("correct", correct.correct, correct.EPILOG),
    ("simulate", simulate.simulate, simulate.EPILOG),
    ("reproduce", reproduce.reproduce, reproduce.EPILOG),
    ("docs", docs, DOCS_EPILOG),
)
"""Name, function and epilog of each command, in the order of the help."""
for _name, _function, _epilog in _COMMANDS:
    app.command(_name, epilog=_epilog)(_function)
app.add_typer(leaderboard.board_app, name="leaderboard")

_NAMELESS = {
    errno.ENOSPC: "standard output",
    errno.EIO: "standard output",
    errno.EDQUOT: "standard output",
    errno.ENOENT: "the working folder, which must exist",
}
"""Object of a failed system call whose error names no file, by error number."""


def run() -> None:
    """Entry point: every error becomes one line on stderr; exit code 2 for bad input, 70 for unexpected errors."""
    try:
        with exits.stoppable():
            code = _with_one_command(app, sys.argv[1:])(prog_name="rsbench", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except typer.TyperException as error:
        _wrongly_used(error)
    except RsbenchError as error:
        _fail(str(error), error.exit_code)
    except MemoryError:
        _fail("not enough memory; close other programs, or process less at once", 1)
    except Exception as error:
        # System errors such as a folder without permission, or a full disk at stdout, which has no file name.
        if isinstance(error, OSError) and (place := error.filename or _NAMELESS.get(error.errno or 0)):
            _fail(f"{place}: {error.strerror or error}")
        _fail(exits.describe(error), exits.EXIT_CODE)


def _with_one_command(whole: Callable[..., Any], words: Sequence[str]) -> Callable[..., Any]:
    """Return the program with only the command that is called, as creating the options of all takes 30 ms."""
    name = next((word for word in words if not word.startswith("-")), None)
    if not isinstance(whole, typer.Typer):
        return whole
    one = copy.copy(whole)
    one.registered_commands = [each for each in whole.registered_commands if each.name == name]
    one.registered_groups = [each for each in whole.registered_groups if each.name == name]
    return one if one.registered_commands or one.registered_groups else whole


def _wrongly_used(error: typer.TyperException) -> None:
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":  # the help has been printed
        sys.exit(error.exit_code)
    remedy = f"; see {context.command_path} --help" if context is not None else ""
    _fail(error.format_message().rstrip(".") + remedy, error.exit_code)


def _fail(message: str, code: int = 2) -> None:
    words = " ".join(message.split())
    if len(words) > _LONGEST:
        words = f"{words[: _LONGEST // 2]} ... {words[-_LONGEST // 2 :]}"
    sys.stderr.write(f"rsbench: error: {printable(words)}\n")
    sys.exit(code)
