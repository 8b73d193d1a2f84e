"""``rsbench solve``: one problem, for people with their own correspondences."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rsbench.errors import RsbenchError

EPILOG = """[bold]Examples[/bold]

  rsbench solve problem.json

  rsbench solve problem.json --solver rs-stereo-linear --json

PROBLEM.json holds [bold]camera[/bold] (width, height, fx, fy, cx, cy), [bold]baseline[/bold] (m),
[bold]readout_ratio[/bold] and matches in pixels: [bold]left[/bold] and [bold]right[/bold] (x0, y0, x1, y1),
[bold]stereo_0[/bold] and [bold]stereo_1[/bold] (xl, yl, xr, yr), [bold]tracks[/bold] (xl0, yl0, xr0, yr0,
xl1, yl1, xr1, yr1); absent sets are empty. The centre of the top-left pixel is (0, 0)."""


def solve(
    problem: Annotated[Path, typer.Argument(metavar="PROBLEM.json", help="Camera, rig, shutter and matches.")],
    solver: Annotated[
        str, typer.Option(help="Name of a solver card (rsbench list solvers) or path.")
    ] = "rs-stereo",
    threshold_px: Annotated[
        float | None, typer.Option(help="Largest Sampson error of an inlier, px. Default: follows the noise.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Answer as one JSON object.")] = False,
) -> None:
    """Estimate the motion of a stereo rig from your own matches."""
    import json as json_module

    import numpy as np

    from rsbench.pipeline.problem import read_problem, solve_problem
    from rsbench.pipeline.robust_motion import RobustOptions
    from rsbench.solvers.engine.registry import load_solver_entry

    chosen = load_solver_entry(solver)
    options = RobustOptions()
    if threshold_px is not None:
        if not threshold_px > 0.0:
            raise RsbenchError(f"--threshold-px = {threshold_px}: must be a positive number of pixels")
        options = RobustOptions(threshold_px=threshold_px, adapt_threshold=False)
    answer = solve_problem(read_problem(problem), chosen, options, seed)
    if json:
        typer.echo(json_module.dumps(answer, allow_nan=False))
    elif answer["success"]:
        angle = np.rad2deg(np.linalg.norm(answer["w"]))
        unit = "m" if answer["metric"] else "(length unknown)"
        typer.echo(f"w  {_vector(answer['w'])} rad per frame ({angle:.4f} deg)")
        typer.echo(f"d  {_vector(answer['d'])} {unit} per frame")
        typer.echo(f"inliers: {answer['inliers_left']} left, {answer['inliers_right']} right")
        if answer["reason"]:
            typer.echo(f"note: {answer['reason']}")
    else:
        typer.echo(f"no estimate: {answer['reason']}", err=True)
    if not answer["success"]:
        raise typer.Exit(1)


def _vector(values: list[float]) -> str:
    return "[" + ", ".join(f"{value: .6f}" for value in values) + "]"


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(solve)
