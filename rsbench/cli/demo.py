"""``rsbench demo``: the whole chain on one sequence of the paper's size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Folder of the demo's data and report.")] = Path("demo-report"),
    scene: Annotated[str, typer.Option(help="Sequence of the card 'paper': castle, old-town or room.")] = "castle",
) -> None:
    """Render one sequence at the paper's setting, solve, correct and score it, and write a report."""
    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.cli.compile_ahead import compiling_ahead
    from rsbench.cli.evaluate import evaluate_dataset
    from rsbench.cli.generate import generate

    with compiling_ahead():
        generate("paper", str(out / scene), [scene], workers=1)
        options = EvaluationOptions(solvers=("rs-stereo-refined", "rs-stereo-linear", "gs-8pt"))
        evaluate_dataset(out / scene, out / f"{scene}-evaluation", options, "rsbench demo")


def register(app: typer.Typer) -> None:
    app.command(epilog="[bold]Example[/bold]  rsbench demo --scene old-town --out out/demo")(demo)
