"""``rsbench evaluate``: run solvers, depth and correction on a dataset and score them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EPILOG = """[bold]Examples[/bold]

  rsbench evaluate data/paper --out results/paper

  rsbench evaluate data/paper --solver rs-stereo-refined --solver gs-8pt --out /tmp/two"""


def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with a dataset.json.")],
    out: Annotated[Path, typer.Option(help="Folder for predictions, scores, pictures and the report.")],
    solver: Annotated[
        list[str] | None,
        typer.Option(help="Solver card to score; repeatable. Default: all that come with rsbench."),
    ] = None,
    correct_with: Annotated[
        str, typer.Option(help="Solver whose motion the correction uses.")
    ] = "rs-stereo-refined",
    matcher: Annotated[str, typer.Option(help="Card of the stereo matcher.")] = "sgm",
    seed: Annotated[int, typer.Option(help="Seed of every random choice.")] = 0,
) -> None:
    """Pose, depth and correction against the truth of a dataset, with a report."""
    evaluate_dataset(folder, out, solver, correct_with, seed, matcher=matcher)


def evaluate_dataset(
    folder: Path,
    out: Path,
    solvers: list[str] | None,
    correct_with: str,
    seed: int,
    command: str | None = None,
    matcher: str = "sgm",
) -> Path:
    """Evaluate with a progress bar, print the tables, and return the path of the report."""
    from rsbench.benchmark.images.evaluation import evaluation_steps, run_evaluation
    from rsbench.benchmark.images.predict import EvaluationOptions
    from rsbench.cli.console import print_table, progress_bar
    from rsbench.report.evaluation_page import summary_tables, write_report
    from rsbench.solvers.engine.registry import list_solvers
    from rsbench.vision.stereo_matcher import load_matcher

    # rs-stereo is another name of rs-stereo-refined: one row of it is enough.
    everything = [name for name in list_solvers() if name != "rs-stereo"]
    chosen = tuple(dict.fromkeys([*(solvers or everything), correct_with]))
    options = EvaluationOptions(
        solvers=chosen, correction_solver=correct_with, seed=seed, sgm=load_matcher(matcher).component
    )
    command = command or f"rsbench evaluate {folder} --out {out}"
    with progress_bar(f"evaluating {folder.name}", evaluation_steps(folder, options)) as advance:
        run_evaluation(folder, out, options, command, advance)
    for table in summary_tables(out):
        print_table(table.title, table.brief)
    page = write_report(folder, out)
    typer.echo(f"report: {page.resolve()}")
    return page


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(evaluate)
