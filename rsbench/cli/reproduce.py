"""``rsbench reproduce``: the committed results, made again."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.console import echo, say

EPILOG = """[bold]Examples[/bold]

  rsbench reproduce images --out results --data data       [dim](what results/images holds)[/dim]

  rsbench reproduce fig3 --out results                     [dim](simulated points: results/fig3)[/dim]

  rsbench reproduce claims --out results                   [dim](results/claims; runs fig3 first)[/dim]

  rsbench reproduce image-claims --out results             [dim](results/claims/images.md)[/dim]

  rsbench reproduce sweeps --out results                   [dim](results/sweeps: limits, degeneracies)[/dim]

  rsbench reproduce fig4 --out results --data data         [dim](renders 63 sequences first: 20 minutes)[/dim]

  rsbench reproduce fig4-literal --out results             [dim](by the paper's own solver: a minute)[/dim]

  rsbench reproduce leaderboard --out results --data data  [dim](our solvers on points: 25 minutes of a core)[/dim]

  rsbench reproduce laws --out results --data data         [dim](five laws: renders 180 sequences first)[/dim]

  rsbench reproduce boards --out results --data data       [dim](tracks of frames, 216 sequences: 3 hours)[/dim]

  rsbench reproduce handheld --out results --data data     [dim](footage from hands: an hour of a core)[/dim]

  rsbench reproduce footage --out results --data data      [dim](one camera's frames: 2 hours)[/dim]

  rsbench reproduce everything                             [dim](hours; goes on where it stopped)[/dim]"""


class Target(StrEnum):
    """What can be reproduced."""

    images = "images"
    fig3 = "fig3"
    claims = "claims"
    image_claims = "image-claims"
    readings = "readings"
    sweeps = "sweeps"
    fig4 = "fig4"
    fig4_literal = "fig4-literal"
    correction = "correction"
    laws_correction = "laws-correction"
    sgm = "sgm"
    real = "real"
    leaderboard = "leaderboard"
    laws = "laws"
    boards = "boards"
    handheld = "handheld"
    footage = "footage"
    everything = "everything"


_ORDER = (
    *(each for each in Target if each not in ("fig3", "fig4-literal", "image-claims", "everything")),
    Target.image_claims,
)
"""Claims make Figure 3 in passing, and fig4 its literal part; those about images judge what is stored."""
_SEEDS = {Target.images: 20, Target.real: 10}
"""Runs of each solver in what is committed."""
_MINUTES = {
    Target.images: 3,
    Target.fig3: 4,
    Target.claims: 15,
    Target.readings: 8,
    Target.sweeps: 9,
    Target.fig4: 9,
    Target.fig4_literal: 1,
    Target.correction: 67,
    Target.laws_correction: 30,
    Target.sgm: 1,
    Target.real: 19,
    Target.leaderboard: 20,
    Target.laws: 240,
    Target.boards: 180,
    Target.handheld: 45,
    Target.footage: 110,
    Target.image_claims: 1,
}
"""Of two cores, as measured in November 2026: for the time that is left of everything, not as a promise."""
_RENDERED: dict[Target, tuple[str, ...]] = {
    Target.images: ("paper",),
    Target.fig4: ("paper", "moderate", "aggressive"),
    Target.fig4_literal: ("paper",),
    Target.correction: ("mild", "moderate", "aggressive", "poles"),
    Target.laws_correction: ("laws-frames",),
    Target.sgm: ("mild", "moderate"),
    Target.real: ("real-ideal", "real"),
    Target.laws: ("laws-frames",),
    Target.boards: ("standard",),
    Target.handheld: ("handheld",),
    Target.footage: ("footage", "standard"),
}
"""Folders of datasets below ``--data`` that a target reads, and renders first where they are missing."""
_KEPT = 0.1
"""Share of its minutes below which a target had been made before."""
_TRACKS = (Target.leaderboard, Target.laws, Target.boards, Target.handheld, Target.footage)
_FOLDERS = {
    Target.fig4_literal: ("fig4",),
    Target.claims: ("fig3", "claims"),
    Target.image_claims: ("claims",),
    Target.boards: ("leaderboard",),
}
"""Where a target writes below ``--out``, if not in the folder of its name."""


def reproduce(
    target: Annotated[
        Target | None,
        typer.Argument(
            show_default=False,
            help="Without one, a list with minutes. "
            "images: the paper's image experiment in castle, old-town and room. fig3: its Figure 3 on "
            "simulated points. claims: what became of each claim about them, in every reading of the paper's "
            "solver. readings: the claims in settings that it does not state. image-claims: those about images, "
            "from stored results. sweeps: the other simulations. "
            "fig4: its Figure 4 in every scene, for three motions; fig4-literal, part of it: in its scene, by the "
            "paper's own solver, SIFT and a single view. correction: baselines, ours and oracles on "
            "mild, moderate, aggressive and poles. laws-correction: the same under five laws of motion. "
            "sgm: stereo matching when the cameras' rows are not in step. "
            "real: the default pipeline on rendered frames with lens, blur and noise, beside an ideal camera's. "
            "leaderboard: our solvers on the public split of points, its site, and the scores of the smoke run. "
            "laws: points and frames under several laws of motion, with the predictions of solvers. "
            "boards: the same of the tracks of frames, on the dataset standard. "
            "handheld: trajectories of whole sequences from hands. "
            "footage: what one camera's correctors make of pairs of frames. "
            "everything: all of these, one after the other, with the time that each took.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("results"),
    data: Annotated[Path, typer.Option(help="Folder for the rendered data and simulated trials.")] = Path("data"),
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes of simulations and corrections; default: one per core.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs of each solver, with other samples; default: 20 of images and 10 of real.",
            show_default=False,
        ),
    ] = None,
    width: Annotated[int | None, typer.Option(help="Of real: width of the images; default: the card's.")] = None,
) -> None:
    """Make the committed results again: render or simulate what is missing, run, score, draw."""
    from rsbench.storage.files import check_out

    if target is None:
        for each in Target:
            of = _ORDER if each is Target.everything else (each,)
            needs = [_first(each, data)] if each is not Target.everything else []
            echo(f"{each}: about {sum(_MINUTES[one] for one in of)} minutes on two cores{''.join(needs)}")
        return
    check_out(out)
    _make(_ORDER if target is Target.everything else (target,), out, data, workers, seeds, width)


def _make(
    targets: Sequence[Target], out: Path, data: Path, workers: int | None, seeds: int | None, width: int | None
) -> None:
    """One after the other, with the time that each took, and of several with what is left."""
    begin, paces = time.monotonic(), list[float]()
    for number, each in enumerate(targets):
        start = time.monotonic()
        whole = f"[{number + 1} of {len(targets)}] " if len(targets) > 1 else ""
        say(f"{whole}{each}: {_left(targets[number:], paces)}{_first(each, data)}")
        _reproduce(each, out, data, workers, seeds or _SEEDS.get(each, 1), width)
        paces.append((time.monotonic() - start) / 60.0 / _MINUTES[each])
        echo(f"{each}: {paces[-1] * _MINUTES[each]:.1f} minutes")
    if len(targets) > 1:
        echo(f"{Target.everything}: {(time.monotonic() - begin) / 60.0:.1f} minutes")


def _left(targets: Sequence[Target], paces: Sequence[float]) -> str:
    """About how long the next target, and all of them, take by the pace of those that were made so far."""
    made = [pace for pace in paces if pace > _KEPT]
    minutes = [_MINUTES[each] * (statistics.median(made) if made else 1.0) for each in targets]
    begin = f"about {minutes[0]:.0f} minutes on two cores"
    return begin if len(targets) == 1 else f"{begin}; with what follows {sum(minutes) / 60.0:.1f} hours"


def _first(target: Target, data: Path) -> str:
    """What is rendered or needed before a target is made."""
    if target is Target.image_claims:
        return "; judges what the other targets have written: make them first"
    places = [data / name for name in _RENDERED.get(target, ())]
    missing = [str(place) for place in places if not (place / "dataset.json").is_file()]
    return f"; renders first what is missing: {', '.join(missing)}" if missing else ""


def _reproduce(target: Target, out: Path, data: Path, workers: int | None, seeds: int, width: int | None) -> None:
    from rsbench.storage.work_folder import work_folder

    with ExitStack() as stack:
        for name in _FOLDERS.get(target, (target.value,)):
            stack.enter_context(work_folder(out / name))
        if target is Target.images:
            _images(out, data, seeds)
        elif target in (Target.correction, Target.laws_correction):
            _correction(target, out, data, workers)
        elif target is Target.real:
            _real(out, data, seeds, width)
        elif target in _TRACKS:
            _leaderboard(target, out, data, workers)
        elif target in (Target.fig4, Target.fig4_literal, Target.sgm):
            _depth(target, out, data)
        else:
            _simulated(target, out, data, workers)


def _correction(target: Target, out: Path, data: Path, workers: int | None) -> None:
    from rsbench.cli.reproduce_correction import correction, laws_correction

    (correction if target is Target.correction else laws_correction)(out, data, workers)


def _leaderboard(target: Target, out: Path, data: Path, workers: int | None) -> None:
    from rsbench.cli import reproduce_leaderboard

    getattr(reproduce_leaderboard, target.value)(out, data, workers)


def _real(out: Path, data: Path, seeds: int, width: int | None) -> None:
    from rsbench.cli.reproduce_correction import real

    real(out, data, seeds, width)


def _depth(target: Target, out: Path, data: Path) -> None:
    from rsbench.cli import reproduce_correction

    getattr(reproduce_correction, target.name)(out, data)


def _simulated(target: Target, out: Path, data: Path, workers: int | None) -> None:
    from rsbench.cli import reproduce_simulated

    if target is Target.image_claims:
        reproduce_simulated.image_claims(out)
    else:
        getattr(reproduce_simulated, target.value)(out, data, workers)


def _images(out: Path, data: Path, seeds: int) -> None:
    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.cli.evaluate import evaluate_dataset, every_solver
    from rsbench.cli.generate import generate
    from rsbench.report.evaluation_page import publish

    generate("paper", str(data / "paper"), None, workers=1)
    evaluation = data / "paper-evaluation"
    options = EvaluationOptions(solvers=tuple(every_solver()), seeds=seeds)
    evaluate_dataset(data / "paper", evaluation, options, "rsbench reproduce images")
    echo(f"published: {publish(evaluation, out / 'images')}")


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(reproduce)
