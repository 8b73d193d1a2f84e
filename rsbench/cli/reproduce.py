"""``rsbench reproduce``: make the committed results again."""

from __future__ import annotations

import inspect
import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import typer

from rsbench.cli.console import echo, say
from rsbench.storage.work_folder import work_folder

EPILOG = """[bold]Examples[/bold]

  rsbench reproduce images --out results --data data       [dim](what results/images holds)[/dim]

  rsbench reproduce fig3 --out results                     [dim](simulated points: results/fig3)[/dim]

  rsbench reproduce claims --out results                   [dim](results/claims; runs fig3 first)[/dim]

  rsbench reproduce image-claims --out results             [dim](results/claims/images.md)[/dim]

  rsbench reproduce sweeps --out results                   [dim](results/sweeps: limits, degeneracies)[/dim]

  rsbench reproduce fig4 --out results --data data         [dim](renders 63 sequences first: 20 minutes)[/dim]

  rsbench reproduce fig4-literal --out results             [dim](by the paper's own solver: a minute)[/dim]

  rsbench reproduce leaderboard --out results --data data  [dim](our solvers on points: 25 minutes of a core)[/dim]

  rsbench reproduce laws --out results --data data         [dim](five motion models: 180 sequences)[/dim]

  rsbench reproduce boards --out results --data data       [dim](tracks of frames, 216 sequences: 3 hours)[/dim]

  rsbench reproduce handheld --out results --data data     [dim](footage from hands: an hour of a core)[/dim]

  rsbench reproduce footage --out results --data data      [dim](one camera's frames: 2 hours)[/dim]

  rsbench reproduce recorded --out results --data data     [dim](recorded motion: 40 minutes of a core)[/dim]

  rsbench reproduce held-out --out results --data data     [dim](secret splits of points: an hour)[/dim]

  rsbench reproduce everything                             [dim](hours; goes on where it stopped)[/dim]"""


class _Recipe(NamedTuple):
    """The function that makes a target, with its inputs and outputs."""

    maker: str
    """``module:function`` below ``rsbench.cli``; its parameters are any of ``out``, ``data``, ``workers``,
    ``seeds`` and ``width``."""
    minutes: int
    """Time on two cores, measured in November 2026, for estimates of the remaining time."""
    rendered: tuple[str, ...] = ()
    """Folders of datasets below ``--data`` that it reads; missing datasets are rendered first."""
    folders: tuple[str, ...] = ()
    """Folders below ``--out`` that it writes to; by default the one of its name. They are created first."""
    seeds: int = 1
    """Number of runs of each solver in the committed results."""


class Target(StrEnum):
    """A target of the command, with its recipe."""

    recipe: _Recipe

    def __new__(cls, name: str, recipe: _Recipe | None = None) -> Self:
        """Create a target from its name and recipe."""
        made = str.__new__(cls, name)
        made._value_ = name
        made.recipe = recipe or _Recipe("", 0)
        return made

    images = "images", _Recipe("reproduce:images", 3, ("paper",), seeds=20)
    fig3 = "fig3", _Recipe("reproduce_simulated:fig3", 4)
    claims = "claims", _Recipe("reproduce_simulated:claims", 15, folders=("fig3", "claims"))
    image_claims = "image-claims", _Recipe("reproduce_simulated:image_claims", 1, folders=("claims",))
    readings = "readings", _Recipe("reproduce_simulated:readings", 8)
    sweeps = "sweeps", _Recipe("reproduce_simulated:sweeps", 9)
    fig4 = "fig4", _Recipe("reproduce_correction:fig4", 2, ("paper", "moderate", "aggressive"))
    fig4_literal = "fig4-literal", _Recipe("reproduce_correction:fig4_literal", 1, ("paper",), ("fig4",))
    correction = (
        "correction",
        _Recipe("reproduce_correction:correction", 67, ("mild", "moderate", "aggressive", "poles")),
    )
    laws_correction = "laws-correction", _Recipe("reproduce_correction:laws_correction", 30, ("laws-frames",))
    sgm = "sgm", _Recipe("reproduce_correction:sgm", 1, ("mild", "moderate"))
    real = "real", _Recipe("reproduce_correction:real", 19, ("real-ideal", "real"), seeds=10)
    leaderboard = "leaderboard", _Recipe("reproduce_leaderboard:leaderboard", 20)
    laws = "laws", _Recipe("reproduce_leaderboard:laws", 240, ("laws-frames",))
    boards = "boards", _Recipe("reproduce_leaderboard:boards", 180, ("standard",), ("leaderboard",))
    handheld = "handheld", _Recipe("reproduce_leaderboard:handheld", 45, ("handheld",))
    footage = "footage", _Recipe("reproduce_leaderboard:footage", 110, ("footage", "standard"))
    recorded = "recorded", _Recipe("reproduce_leaderboard:recorded", 40)
    held_out = "held-out", _Recipe("reproduce_leaderboard:held_out", 60)
    everything = "everything"


_ORDER = (
    *(each for each in Target if each not in ("fig3", "fig4-literal", "image-claims", "everything")),
    Target.image_claims,
)
"""Targets of ``everything``: ``claims`` includes fig3, ``fig4`` includes fig4-literal; image claims come last, as
they judge the results of the others."""
_KEPT = 0.1
"""If a target takes less than this share of its expected time, its data are assumed to have existed before."""


def reproduce(
    target: Annotated[
        Target | None,
        typer.Argument(
            show_default=False,
            help="Without one, a list with minutes. "
            "images: the paper's image experiment in castle, old-town and room. fig3: its Figure 3 on "
            "simulated points. claims: a verdict on each claim about them, in every reading of the paper's "
            "solver. readings: the claims in settings that it does not state. image-claims: those about images, "
            "from stored results. sweeps: the other simulations. "
            "fig4: its Figure 4 in every scene, for three motions; fig4-literal, part of it: in its scene, by the "
            "paper's own solver, SIFT and a single view. correction: baselines, ours and oracles on "
            "mild, moderate, aggressive and poles. laws-correction: the same under five motion models. "
            "sgm: stereo matching when the cameras read a row at different times. "
            "real: the default pipeline on rendered frames with lens, blur and noise, and with an ideal camera. "
            "leaderboard: our solvers on the public split of points, its site, and the scores of the smoke run. "
            "laws: points and frames under five motion models, with the predictions of solvers. "
            "boards: the same for the tracks of frames, on the dataset standard. "
            "handheld: trajectories of whole hand-held sequences. "
            "footage: correctors of one camera on pairs of frames. "
            "recorded: our solvers on points under recorded motion. "
            "held-out: solvers, also of others, on the announced secret splits of points. "
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
            help="Runs of each solver, with different RANSAC samples; default: 20 for images, 10 for real.",
            show_default=False,
        ),
    ] = None,
    width: Annotated[int | None, typer.Option(help="For real: width of the images; default: the card's.")] = None,
) -> None:
    """Make the committed results again: render or simulate what is missing, run, score, draw."""
    from rsbench.storage.files import check_out

    if target is None:
        for each in Target:
            of = _ORDER if each is Target.everything else (each,)
            needs = [_first(each, data)] if each is not Target.everything else []
            echo(f"{each}: {_about(sum(one.recipe.minutes for one in of))}{''.join(needs)}")
        return
    check_out(out)
    _make(_ORDER if target is Target.everything else (target,), out, data, workers, seeds, width)


def _make(
    targets: Sequence[Target], out: Path, data: Path, workers: int | None, seeds: int | None, width: int | None
) -> None:
    """Make targets one after the other; print the time of each and, for several, the estimated remaining time."""
    begin, paces = time.monotonic(), list[float]()
    for number, each in enumerate(targets):
        start = time.monotonic()
        whole = f"[{number + 1} of {len(targets)}] " if len(targets) > 1 else ""
        say(f"{whole}{each}: {_left(targets[number:], paces)}{_first(each, data)}")
        _reproduce(each, out, data, workers, seeds or each.recipe.seeds, width)
        paces.append((time.monotonic() - start) / 60.0 / each.recipe.minutes)
        echo(f"{each}: {paces[-1] * each.recipe.minutes:.1f} minutes")
    if len(targets) > 1:
        echo(f"{Target.everything}: {(time.monotonic() - begin) / 60.0:.1f} minutes")


def _left(targets: Sequence[Target], paces: Sequence[float]) -> str:
    """Return text with the estimated time of the next target and of all remaining ones, from previous targets."""
    made = [pace for pace in paces if pace > _KEPT]
    minutes = [each.recipe.minutes * (statistics.median(made) if made else 1.0) for each in targets]
    begin = _about(minutes[0])
    return begin if len(targets) == 1 else f"{begin}; with what follows {sum(minutes) / 60.0:.1f} hours"


def _about(minutes: float) -> str:
    return f"about {minutes:.0f} minute{'' if round(minutes) == 1 else 's'} on two cores"


def _first(target: Target, data: Path) -> str:
    """Return text on what is rendered or required before a target is made; empty if nothing is."""
    if target is Target.image_claims:
        return "; judges what the other targets have written: make them first"
    places = [data / name for name in target.recipe.rendered]
    missing = [str(place) for place in places if not (place / "dataset.json").is_file()]
    return f"; renders first what is missing: {', '.join(missing)}" if missing else ""


def _reproduce(target: Target, out: Path, data: Path, workers: int | None, seeds: int, width: int | None) -> None:
    recipe = target.recipe
    module, _, name = recipe.maker.partition(":")
    maker = getattr(import_module(f"rsbench.cli.{module}"), name)
    given = {"out": out, "data": data, "workers": workers, "seeds": seeds, "width": width}
    with ExitStack() as stack:
        for folder in recipe.folders or (target.value,):
            stack.enter_context(work_folder(out / folder))
        maker(**{name: given[name] for name in inspect.signature(maker).parameters})


def images(out: Path, data: Path, seeds: int) -> None:
    """Reproduce the paper's image experiment with every solver."""
    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.cli.evaluate import evaluate_dataset, every_solver
    from rsbench.cli.generate import generate
    from rsbench.report.evaluation_page import publish

    generate("paper", str(data / "paper"), None, workers=1)
    evaluation = data / "paper-evaluation"
    options = EvaluationOptions(solvers=tuple(every_solver()), seeds=seeds)
    evaluate_dataset(data / "paper", evaluation, options, "rsbench reproduce images")
    echo(f"published: {publish(evaluation, out / 'images')}")
