"""``rsbench solve``: solve problems with a user's own correspondences, one or many in one process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.console import echo, late_progress, print_answers, print_records
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.pipeline.answer import Extra
    from rsbench.solvers.engine.base import SolverEntry
    from rsbench.solvers.engine.robust_motion import RobustOptions

EPILOG = """[bold]Examples[/bold]

  rsbench solve --example > problem.json

  rsbench solve problem.json --solver rs-stereo-linear --json

  rsbench solve problem.json --solver rs-stereo-refined --solver gs-8pt

  rsbench solve problem.json --motion-model auto

  cat problems.jsonl | rsbench solve - --json --with covariance,inliers

A problem holds [bold]camera[/bold] (width, height, fx, fy, cx, cy) and [bold]baseline[/bold] (m), or
[bold]cameras[/bold] (left, right) and [bold]right_from_left[/bold] (rotation, translation),
[bold]readout_ratio[/bold] (absent: it is found) and matches in pixels: [bold]left[/bold], [bold]right[/bold]
(x0, y0, x1, y1), [bold]stereo_0[/bold], [bold]stereo_1[/bold] (xl, yl, xr, yr), [bold]tracks[/bold] (xl0, yl0,
xr0, yr0, xl1, yl1, xr1, yr1); absent sets are empty. The centre of the top-left pixel is (0, 0).

Exit codes: 0 all solved, 1 one without a motion, 2 one that is wrong; the others are solved all the same.
More: [bold]rsbench docs problem-format[/bold]"""


_MODEL = "Motion model: a name, or auto for the most probable one. Default: auto if the solver supports it"
_SOLVER = "Solver: name (rsbench list solvers), card or FILE.py; repeatable. Default: rs-stereo-refined"


def solve(
    problems: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PROBLEM",
            help="Files (.json; .jsonl, one problem per line; .npz), folders of them, or - for standard input.",
        ),
    ] = None,
    solver: Annotated[list[str] | None, named("solvers", _SOLVER)] = None,
    threshold_px: Annotated[
        float | None, typer.Option(help="Largest Sampson error of an inlier, px. Default: adapted to the noise.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per answer, each on a line.")
    ] = False,
    extras: Annotated[
        str,
        typer.Option(
            "--with", help="Further fields of each JSON answer: covariance, noise, inliers; separated by commas."
        ),
    ] = "",
    motion_model: Annotated[str | None, typer.Option(metavar="auto|NAME", help=_MODEL)] = None,
    time_limit: Annotated[
        float | None, typer.Option(help="Time limit per problem for solvers of other packages, seconds.")
    ] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a sample problem and exit.")] = False,
) -> None:
    """Estimate the motion of a stereo rig from your own matches."""
    if example:
        from rsbench.pipeline.problem import EXAMPLE

        echo(EXAMPLE.read_text(encoding="utf-8"), nl=False)
        return
    if not problems:
        raise RsbenchError("PROBLEM: none given; give files, folders or -, or have a sample made by --example")
    from rsbench.pipeline.frame_motion import check_model
    from rsbench.solvers.engine.base import load_solver_entries

    wanted, options = _extras(extras, json), _options(threshold_px)
    if time_limit is not None and not time_limit > 0.0:
        raise RsbenchError(f"--time-limit = {time_limit}: must be a positive number of seconds")
    entries = load_solver_entries(solver or ["rs-stereo-refined"])
    if motion_model is not None:
        for entry in entries:
            check_model(motion_model, entry)
    found = _answers(problems, entries, options, seed, wanted, time_limit, motion_model or "auto")
    print_answers(found, json, "success", _show)


def _answers(
    problems: list[str],
    entries: list[SolverEntry],
    options: RobustOptions,
    seed: int,
    extras: list[Extra],
    time_limit: float | None,
    motion_model: str,
) -> Iterator[dict[str, Any] | RsbenchError]:
    """Yield an answer for each problem and solver, or the error of an invalid problem."""
    from rsbench.pipeline.answer import solve_problem
    from rsbench.pipeline.isolated_components import SolverRunner
    from rsbench.pipeline.problem import read_problems

    with SolverRunner(time_limit_s=time_limit) as runner, late_progress("solving") as advance:
        for source in problems:
            for problem in read_problems(source, sys.stdin):
                if isinstance(problem, RsbenchError):
                    yield problem
                    continue
                for entry in entries:
                    yield solve_problem(problem, entry, options, runner, seed, extras, motion_model)
                advance(problem.name)


def _show(answers: list[dict[str, Any]]) -> None:
    if len(answers) == 1:
        _show_one(answers[0])
    else:
        print_records([_row(answer) for answer in answers], right=("rotation", "inliers", "ms"))


def _show_one(answer: dict[str, Any]) -> None:
    if not answer["success"]:
        echo(f"no estimate: {answer['reason']}", err=True)
        return
    whose = {"body": "the middle of the baseline", "left": "the left camera"}[answer["reference_point"]]
    unit = "m per frame" if answer["metric"] else "(direction only)"
    echo(f"w  {_vector(answer['w'])} rad per frame ({_degrees(answer['w']):.4f} deg)")
    echo(f"d  {_vector(answer['d'])} {unit}, of {whose}")
    for side, own in answer.get("cameras", {}).items():
        d = "" if own["d"] is None else f", d {_vector(own['d'])}"
        echo(f"{side} camera, in its own axes: w {_vector(own['w'])}{d}")
    echo(f"inliers: {answer['inliers']} of {answer['matches']} matches")
    echo(f"assumes: {answer['motion_model']} motion, {answer['shutter']} shutter; {answer['assumes']}")
    if "readout" in answer:
        echo(f"readout: {_readout(answer)}")
    if answer.get("model_choice"):
        echo(f"motion model: {answer['model_choice']['text']}")
    if answer["reason"]:
        echo(f"note: {answer['reason']}")


def _readout(answer: dict[str, Any]) -> str:
    """Return text on the estimated shutter and the second most probable one."""
    found = answer["readout"]
    sides = [found["left"]] if found["left"] == found["right"] else [found["left"], found["right"]]
    text = f"ratio {answer['readout_ratio']:.3f} +- {found['readout_ratio_sigma']:.3f} from {' and '.join(sides)}"
    second = next(iter(found["candidates"][1:]), None)
    text += f", found with the motion; probability that the cameras read so {found['probability']:.1%}"
    if second is None:
        return f"{text}, else below 1 %"
    other = f"{second['left']} and {second['right']} {second['readout_ratio']:.2f}"
    return f"{text}, next {other} with {second['probability']:.1%}"


def _row(answer: dict[str, Any]) -> dict[str, str]:
    found, metric = answer["success"], answer["metric"]
    length = " m" if metric else ""
    return {
        "problem": answer["name"],
        "solver": answer["solver"],
        "rotation": f"{_degrees(answer['w']):.3f} deg" if found else "-",
        "d": " ".join(f"{value:.3f}" for value in answer["d"]) + length if found else "-",
        "of the": answer["reference_point"],
        "inliers": f"{answer['inliers']}/{answer['matches']}",
        "ms": f"{1e3 * answer['seconds']:.0f}",
        "note": answer["reason"],
    }


def _extras(text: str, json: bool) -> list[Extra]:
    from rsbench.components.cards import choices
    from rsbench.pipeline.answer import EXTRAS

    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in EXTRAS:
            raise RsbenchError(f"--with {text}: {name!r} is unknown{choices(name, EXTRAS)}")
    if names and not json:
        raise RsbenchError(f"--with {text}: is part of JSON answers only; add --json")
    return [extra for extra in EXTRAS if extra in names]


def _options(threshold_px: float | None) -> RobustOptions:
    from rsbench.solvers.engine.robust_motion import RobustOptions

    if threshold_px is None:
        return RobustOptions()
    if not 0.0 < threshold_px < float("inf"):
        raise RsbenchError(f"--threshold-px = {threshold_px}: must be a positive number of pixels")
    return RobustOptions(threshold_px=threshold_px, adapt_threshold=False)


def _degrees(w: list[float]) -> float:
    import numpy as np

    return float(np.rad2deg(np.linalg.norm(w)))


def _vector(values: list[float]) -> str:
    return "[" + ", ".join(f"{value: .6f}" for value in values) + "]"
