"""Small commands: ``rsbench demo``, ``doctor``, ``docs`` and ``check-solver``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo, print_json, print_table, progress_bar, say
from rsbench.cli.names import complete
from rsbench.core.errors import RsbenchError


def demo(
    out: Annotated[Path, typer.Option(help="Folder of the demo's data and report.")] = Path("demo-report"),
    scene: Annotated[str, typer.Option(help="Sequence of the card 'paper': castle, old-town or room.")] = "castle",
) -> None:
    """Render one sequence at the paper's setting, solve, correct and score it, and write a report."""
    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.cli.compile_ahead import compiling_ahead
    from rsbench.cli.evaluate import evaluate_dataset
    from rsbench.cli.generate import generate

    with compiling_ahead(to_the_end=True):
        generate("paper", str(out / scene), [scene], workers=1)
        options = EvaluationOptions(solvers=("rs-stereo-refined", "rs-stereo-linear", "gs-8pt"))
        evaluate_dataset(out / scene, out / f"{scene}-evaluation", options, "rsbench demo")


COMPILE_EPILOG = """[bold]Examples[/bold]

  rsbench compile                    [dim](after an installation: the first command need not)[/dim]

  rsbench compile --portable         [dim](before a wheel is built: those who install it need not)[/dim]"""


def compile_(
    portable: Annotated[
        bool,
        typer.Option(
            "--portable", help="Compile for all x86-64-v3 processors, into the package, before a wheel is built."
        ),
    ] = False,
) -> None:
    """Compile the numerical code in advance, into a cache on disk; takes a minute."""
    from rsbench.cli.compile_ahead import PARTS, compile_now, compile_portable

    if portable:
        compile_portable()
        return
    with progress_bar("compiling", len(PARTS)) as step:
        folder = compile_now(step)
    echo(f"compiled: {folder}" if folder is not None else "compiled, but no folder can keep it")


def doctor() -> None:
    """Try every rendering backend in a child process, list the versions that matter, and say what to do."""
    import pandas as pd

    from rsbench.renderers.diagnosis import advice, doctor_report

    report = doctor_report()
    rows = [{"component": row.component, "status": row.status, "detail": row.detail} for row in report]
    print_table("rsbench doctor", pd.DataFrame(rows))
    for line in advice(report):
        echo(line)
    if any(row.status == "fail" and row.component != "libLLVM" for row in report):  # without it, others render
        raise typer.Exit(1)


DOCS_EPILOG = """[bold]Examples[/bold]

  rsbench docs                              [dim](what there is)[/dim]

  less "$(rsbench docs conventions)"

  cp "$(rsbench docs tour.ipynb)" . && jupyter lab tour.ipynb"""


def docs(
    name: Annotated[str | None, typer.Argument(help="Document or example whose path is printed.")] = None,
) -> None:
    """List the documents and examples of rsbench, or print the path of one."""
    from rsbench.components.cards import choices

    documents = list_documents()
    if name is not None:
        if name not in documents:
            raise RsbenchError(f"document {name!r} does not exist{choices(name, documents)}")
        echo(str(documents[name]))
        return
    import pandas as pd

    rows = [{"name": known, "about": _title(path)} for known, path in documents.items()]
    print_table("documents and examples", pd.DataFrame(rows))
    echo("rsbench docs NAME prints the path of one")


def list_documents() -> dict[str, Path]:
    """Return paths by name: documents without their suffix, then examples with it, each sorted."""
    from rsbench.components.cards import shipped_folder

    examples = shipped_folder("examples", "_docs/examples")
    pages = shipped_folder("docs", "_docs").rglob("*.md")
    documents = {path.stem: path for path in pages if path.stem != "index" and examples not in path.parents}
    return dict(sorted(documents.items())) | {path.name: path for path in sorted(examples.glob("*.*"))}


def _title(path: Path) -> str:
    """Return the first heading of a document or notebook."""
    for line in path.read_text("utf-8").splitlines():
        text = line.strip().lstrip('"').removesuffix(",").removesuffix('"').removesuffix("\\n")
        if text.startswith("# "):
            return text[2:]
    return ""


CHECK_SOLVER_EPILOG = """[bold]Examples[/bold]

  rsbench check-solver gs-8pt

  rsbench check-solver my_solver.py                  [dim](a function below @rsbench.solver)[/dim]

  rsbench check-solver ./my-solver.toml --json

Other packages' solvers run in a child process. Exit code 1 when a check fails; warnings are yours to judge."""


def check_solver(
    solver: Annotated[
        str,
        typer.Argument(
            metavar="NAME|PATH",
            help="Name of a solver, or path of its card or Python file (FILE.py or FILE.py:NAME).",
            autocompletion=complete("solvers"),
        ),
    ],
    time_limit: Annotated[
        float | None, typer.Option(min=0.1, help="Time limit per problem, seconds; default: the card's.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the findings as one JSON object.")] = False,
) -> None:
    """Check the contract of a solver: exact data solved, equal results of equal runs, failures as values."""
    import pandas as pd

    from rsbench.benchmark.simulated.contract import check_solver as find
    from rsbench.solvers.engine.base import load_solver_entry

    entry = load_solver_entry(solver)
    findings = find(entry, time_limit_s=time_limit)
    checks = [asdict(each) for each in findings]
    failed = sum(finding.verdict == "failed" for finding in findings)
    if json:
        print_json({"solver": entry.name, "passed": not failed, "checks": checks})
    else:
        print_table(f"{entry.name} and the contract of solvers", pd.DataFrame(checks))
        say(f"{entry.name}: {failed} of {len(findings)} checks failed")
    if failed:
        raise typer.Exit(1)
