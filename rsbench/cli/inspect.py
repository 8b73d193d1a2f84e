"""``rsbench inspect``: which camera of a rig rolls, from which side and how fast, from matches alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import ReadoutOptions, say_notes
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.capture.two_frame_estimate import Capture, Window
    from rsbench.core.rig import StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.pipeline.footage import FrameSource, RigCard

EPILOG = """[bold]Examples[/bold]

  rsbench inspect problem.json

  rsbench inspect l0.png r0.png l1.png r1.png --rig rig.toml

  rsbench inspect --left left.mp4 --right right.mp4 --rig rig.toml --json

  rsbench inspect data/paper     [dim](each sequence of a dataset; or one sequence's folder)[/dim]

The shutter that a card or problem gives is not used; it is printed beside the estimate.

Exit codes: 0 every rig was estimated, 1 one cannot be determined from its matches, 2 one input is wrong.
More: [bold]rsbench docs inspect[/bold]"""

_MODEL = "Motion model to try; repeatable. Default: all four of rsbench"


class _Case(NamedTuple):
    """One rig to inspect."""

    name: str
    windows: Iterator[Window]
    given: RollingShutter | None
    """What its card, problem or dataset says."""


class _Options(NamedTuple):
    """What holds for all of them."""

    models: tuple[str, ...]
    windows: int
    features: str
    seed: int
    readout: ReadoutOptions
    """What is printed beside the estimate, in place of what a calibration says."""


def inspect(
    given: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="INPUT",
            help="Problems (files, folders, -); or LEFT_0 RIGHT_0 LEFT_1 RIGHT_1; or a dataset or a sequence.",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="RIG|NAME", help="Calibration of both cameras, for frames.")
    ] = None,
    left: Annotated[Path | None, typer.Option(help="Folder of images or video of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(help="Folder of images or video of the right camera.")] = None,
    windows: Annotated[int, typer.Option(min=1, help="Largest number of frame pairs of a sequence to use.")] = 5,
    max_sigma: Annotated[
        float, typer.Option(min=0.0, help="Largest standard deviation of a readout ratio that is reported.")
    ] = 0.015,
    motion_model: Annotated[list[str] | None, typer.Option(metavar="NAME", help=_MODEL)] = None,
    features: Annotated[str, named("features", "Feature matcher for frames: a name or a card.")] = "dense",
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per rig, each on a line.")] = False,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames a second, for a calibration's line delay. Default: what the video says."),
    ] = None,
    readout_ratio: Annotated[
        float | None, typer.Option(help="Readout time over frame period, to compare with, in place of the rig's.")
    ] = None,
    shutter: Annotated[
        str | None, typer.Option(metavar="NAME", help="The same from a mode: rsbench list shutters.")
    ] = None,
) -> None:
    """Estimate scan direction, readout ratio and delay of each camera from matches, where they tell it."""
    from rsbench.capture.hypotheses import MODELS
    from rsbench.capture.two_frame_estimate import conclude
    from rsbench.components.motion_models import load_kernel

    readout = ReadoutOptions(readout_ratio=readout_ratio, shutter=shutter, fps=fps)
    options = _Options(tuple(motion_model or MODELS), windows, features, seed, readout)
    if readout.any and rig is None:
        raise RsbenchError("--readout-ratio, --shutter: need --rig; problems and datasets state their own shutter")
    for model in options.models:
        load_kernel(model)
    answers, wrong, determined = list[dict[str, Any]](), False, True
    for case in _cases(given or [], rig, left, right, options):
        if isinstance(case, RsbenchError):
            wrong = True
            echo(f"rsbench: error: {' '.join(str(case).split())}", err=True)
            continue
        found = conclude(list(case.windows), max_sigma)
        determined = determined and found.determined
        answers.append(_record(case, found))
        if json:
            _print_json(answers[-1])
    if not json:
        _show(answers)
    if wrong or not determined:
        raise typer.Exit(2 if wrong else 1)


def _cases(
    given: list[Path], rig: Path | None, left: Path | None, right: Path | None, options: _Options
) -> Iterator[_Case | RsbenchError]:
    """Raises RsbenchError for another combination of arguments."""
    footage = left is not None and right is not None
    if rig is not None and not given and footage:
        yield _of_footage(left, right, rig, options)
    elif rig is not None and len(given) == 4 and left is None and right is None:
        yield _of_four(given, rig, options)
    elif rig is not None or left is not None or right is not None or not given:
        raise RsbenchError(
            "input: give problems, or a dataset, or with --rig LEFT_0 RIGHT_0 LEFT_1 RIGHT_1 or --left and --right"
        )
    else:
        for path in given:
            rendered = any((path / name).is_file() for name in ("dataset.json", "sequence.json"))
            yield from _of_dataset(path, options) if rendered else _of_problems(path, options)


def _of_problems(path: Path, options: _Options) -> Iterator[_Case | RsbenchError]:
    import sys

    from rsbench.capture.hypotheses import Known
    from rsbench.capture.two_frame_estimate import examine
    from rsbench.pipeline.problem import read_problems

    for problem in read_problems(str(path), sys.stdin):
        if isinstance(problem, RsbenchError):
            yield problem
            continue
        window = examine(problem.correspondences, problem.rig, Known(models=options.models), seed=options.seed)
        yield _Case(problem.name, iter([window]), problem.known_shutter)


def _of_four(paths: list[Path], card: Path, options: _Options) -> _Case:
    from rsbench.pipeline.footage import FrameSource

    left, right = (FrameSource.of_files(paths[k::2]) for k in (0, 1))
    return _framed(card.stem, left, right, card, options)


def _of_footage(left: Path | None, right: Path | None, card: Path, options: _Options) -> _Case:
    from rsbench.pipeline.footage import FrameSource

    assert left is not None and right is not None
    return _framed(card.stem, FrameSource(left), FrameSource(right), card, options)


def _framed(name: str, left: FrameSource, right: FrameSource, card: Path, options: _Options) -> _Case:
    """Frames of a user, whose card says the rig."""
    from rsbench.interop.readers.rig_files import read_rig_file

    first, second = next(iter(left)), next(iter(right))
    readout = options.readout.beside(card, False, left.path)
    given, notes = read_rig_file(card, readout, lambda: (first.shape[1], first.shape[0]))
    say_notes("--rig", notes)
    rig = given.rig_of(first, second)
    ratio, scanning = given.readout_ratio, given.scanning
    try:
        shutter = None if ratio is None or scanning is None else rig.shutter_of(scanning, ratio)
    except ValueError as error:
        raise RsbenchError(f"{card}: {error}") from error
    if given.sigma:
        rig = _with_found_camera(left, right, rig, given, options)
    return _Case(name, _frame_windows(left, right, rig, options), shutter)


def _with_found_camera(
    left: FrameSource, right: FrameSource, rig: StereoRig, given: RigCard, options: _Options
) -> StereoRig:
    """The rig of a card that is not sure of its cameras; what was found goes to stderr."""
    from rsbench.cli.console import progress_bar
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.pipeline.sequence_capture import spread_windows, with_found_camera
    from rsbench.vision.feature_matcher import load_features

    chain = CorrectionOptions(features=load_features(options.features), seed=options.seed)
    shown = spread_windows(left, right)
    rig, words = with_found_camera(rig, given.sigma, shown, chain, given.inputs, progress_bar)
    echo(words, err=True)
    return rig


def _of_dataset(folder: Path, options: _Options) -> Iterator[_Case]:
    from rsbench.core.rig import SIDES
    from rsbench.dataset.layout import picture_file
    from rsbench.dataset.sequence import read_dataset_manifest, read_sequence
    from rsbench.pipeline.footage import FrameSource

    alone = (folder / "sequence.json").is_file()
    folders = [folder] if alone else [folder / name for name in read_dataset_manifest(folder).sequences]
    for each in folders:
        sequence = read_sequence(each)
        left, right = (
            FrameSource.of_files([each / picture_file("rs", side, frame) for frame in range(sequence.frames)])
            for side in SIDES
        )
        yield _Case(sequence.name, _frame_windows(left, right, sequence.rig, options), sequence.shutter)


def _frame_windows(left: FrameSource, right: FrameSource, rig: StereoRig, options: _Options) -> Iterator[Window]:
    """Of successive frames, evenly over the sequence."""
    from itertools import pairwise

    from rsbench.capture.hypotheses import Known
    from rsbench.capture.two_frame_estimate import examine
    from rsbench.core.shutter import Scanning
    from rsbench.pipeline.footage import check_alike
    from rsbench.pipeline.frame_capture import find_matches_of_rig
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.pipeline.isolated_components import Isolation
    from rsbench.vision.feature_matcher import load_features

    unknown = Scanning(scan="left")  # as where columns are read: partners may lie on any row
    every = max((left.count - 1) // options.windows, 1)
    with Isolation() as isolation:
        chain = isolation.chain(CorrectionOptions(features=load_features(options.features), seed=options.seed))
        for number, (first, second) in enumerate(pairwise(zip(left, right, strict=False))):
            if number % every != 0 or number // every >= options.windows:
                continue
            images = {
                (side, frame): pair[k]
                for frame, pair in enumerate((first, second))
                for k, side in enumerate(("left", "right"))
            }
            check_alike({f"{side} frame {number + frame}": image for (side, frame), image in images.items()})
            matches = find_matches_of_rig(images, rig, unknown, chain)  # pyrefly: ignore[bad-argument-type]
            yield examine(matches, rig, Known(models=options.models), seed=options.seed)


def _record(case: _Case, found: Capture) -> dict[str, Any]:
    """The JSON answer for one rig; what is not determined is null."""
    from rsbench.capture.shutter_decision import candidates_of

    named, best = (found.likeliest if known else None for known in (found.named, found.determined))
    return {
        "name": case.name,
        "told": found.determined,
        "left": None if named is None else named.scans.left,
        "right": None if named is None else named.scans.right,
        "readout_ratio": None if best is None else best.ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "right_delay": None if best is None else best.delay,
        "right_delay_sigma": None if best is None else best.delay_sigma,
        "probability": None if named is None else named.probability,
        "reason": found.reason,
        "candidates": candidates_of(found),
        "motion_model": found.motion_model or None,
        "windows": found.windows,
        "matches": found.matches,
        "used": found.used,
        "noise_px": found.noise_px if found.used else None,
        "moved_px": found.moved_px,
        "said": _given_shutter(case.given),
    }


def _given_shutter(shutter: RollingShutter | None) -> dict[str, Any] | None:
    from rsbench.capture.hypotheses import scans_of

    if shutter is None:
        return None
    scans = scans_of(shutter)
    return {"left": scans.left, "right": scans.right, "readout_ratio": shutter.readout_ratio}


def _print_json(answer: dict[str, Any]) -> None:
    import json

    echo(json.dumps(answer, allow_nan=False))


def _show(answers: list[dict[str, Any]]) -> None:
    from rsbench.cli.console import is_quiet, print_rows

    rows = [_row(answer) for answer in answers]
    if is_quiet():
        for row in rows:
            echo("\t".join(row.values()))
    elif rows:
        print_rows("", list(rows[0]), [list(row.values()) for row in rows], right=("matches", "moved (px)"))


def _row(answer: dict[str, Any]) -> dict[str, str]:
    given, determined = answer["said"], answer["told"]
    late = determined and abs(answer["right_delay"]) > max(3.0 * answer["right_delay_sigma"], 0.01)
    note = f"right camera late by {answer['right_delay']:+.3f} frame periods" if late else answer["reason"]
    ratio = "-" if {answer["left"], answer["right"]} == {"global"} else "cannot tell"
    if determined and answer["readout_ratio"] > 0.0:
        ratio = f"{answer['readout_ratio']:.3f} +- {answer['readout_ratio_sigma']:.3f}"
    return {
        "rig": answer["name"],
        "left": answer["left"] or "cannot tell",
        "right": answer["right"] or "cannot tell",
        "readout ratio": ratio,
        "given": "-" if given is None else f"{given['left']}, {given['right']}, {given['readout_ratio']:.2f}",
        "matches": f"{answer['used']}/{answer['matches']}",
        "moved (px)": f"{answer['moved_px']:.1f}",
        "note": note,
    }
