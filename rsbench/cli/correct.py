"""``rsbench correct``: rolling-shutter correction of a user's own stereo frames."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import (
    EPILOG,
    GyroscopeOptions,
    ReadoutOptions,
    arranged,
    check_out,
    default_out,
    given_camera,
    given_frames,
    target_row,
)
from rsbench.cli.correct_output import readout_words, say_calibration, write_page_of
from rsbench.cli.correct_sequence import correct_sequence_given
from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.cli.correct_input import CorrectInput
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.vision.corrector import CorrectorEntry
    from rsbench.vision.fusion import Fused

    Finish: TypeAlias = Callable[[Fused], Fused]

_OUT = "Folder or .mp4, .mov, .mkv, .avi. Default: NAME-corrected, for one camera's video .mp4."
_SIDES = "Each frame shows both cameras of the rig side by side, the left one on the left."
_FOV = "Horizontal field of view of one camera's frames as stored, degrees."
_TARGET = (
    "Row whose time a corrected frame has: first, middle, last or a number. Default: first; middle for one camera "
    "without --camera and --frames"
)
_INPAINT = "Fill all pixels that no frame shows, or none. Default: only specks and slits"
_FAST = "For a rig: features and depth at half the size, which is faster and nearly as accurate."
_ROW_POSES = "For a sequence, also write the pose at every row: row_poses.csv, in TUM's format."
_RECTIFY = "Also write rectified pairs with P1, P2, Q: rectified/."
_SOLVER = "rs-stereo-refined"
_RIG_ONLY = (
    *("rig", "left", "right", "sky", "fill", "solver", "motion_model", "matcher", "features", "corrector", "fast"),
    *("row_poses", "rectify", "side_by_side"),
)
"""Parameters that have no effect on frames of one camera."""
_MODEL = "Motion model: a name, or auto for the most probable one. Default: auto if the solver supports it"


CameraFile = Annotated[
    Path | None,
    typer.Option(metavar="CAMERA", help="For one camera, in place of --rig: camera.toml or a calibration."),
]
Footage = Annotated[Path | None, typer.Option("--frames", metavar="DIR|VIDEO", help="Frames of one camera.")]
GyroFile = Annotated[
    Path | None,
    typer.Option(
        metavar="LOG.gcsv|LOG.csv",
        help="Samples of a gyroscope; with a rig for four frames or more. Needs --fps or a video.",
    ),
]
Fps = Annotated[
    float | None,
    typer.Option(help="Frames per second, for --gyro, --shutter and a line delay. Default: that of the video."),
]
ReadoutRatio = Annotated[
    float | None, typer.Option(help="Readout time divided by frame period, in place of that in the calibration.")
]
ShutterName = Annotated[
    str | None,
    typer.Option("--shutter", metavar="NAME", help="Readout time of a camera mode, see rsbench list shutters."),
]
GyroOffset = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Time of --gyro's clock at the first row of the first frame. Default: 0; for one camera, estimated "
        "within half a second.",
    ),
]


def correct(
    ctx: typer.Context,
    frames: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="VIDEO|DIR|IMAGES",
            help="Frames of one camera; with --rig two videos or folders, or LEFT_0 RIGHT_0 LEFT_1 RIGHT_1; or a "
            "folder of a rendered sequence.",
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="RIG|NAME", help="Calibration of both cameras: rig.toml, or another tool's."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR|VIDEO", help=_OUT)] = None,
    left: Annotated[Path | None, typer.Option(help="Folder of images or video of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(help="The same for the right camera.")] = None,
    target: Annotated[str | None, typer.Option(metavar="ROW", help=_TARGET)] = None,
    inpaint: Annotated[bool | None, typer.Option(help=_INPAINT)] = None,
    sky: Annotated[bool, typer.Option(help="Detect sky, which moves by rotation alone.")] = True,
    fill: Annotated[bool, typer.Option(help="Fill pixels a frame lacks from other frames.")] = True,
    solver: Annotated[str, named("solvers", "Estimates the motion, in metres: name or card.")] = _SOLVER,
    motion_model: Annotated[str | None, typer.Option(metavar="auto|NAME", help=_MODEL)] = None,
    matcher: Annotated[str, named("matchers", "Estimates depth: a name or a card.")] = "sgm",
    features: Annotated[str, named("features", "Matches features: a name or a card.")] = "dense",
    corrector: Annotated[str, named("correctors", "Makes the corrected frames: a name or a card.")] = "fusion",
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    fast: Annotated[bool, typer.Option("--fast", help=_FAST)] = False,
    row_poses: Annotated[bool, typer.Option("--row-poses", help=_ROW_POSES)] = False,
    rectify: Annotated[bool, typer.Option("--rectify", help=_RECTIFY)] = False,
    side_by_side: Annotated[bool, typer.Option("--side-by-side", help=_SIDES)] = False,
    fov: Annotated[float | None, typer.Option(metavar="DEG", help=_FOV)] = None,
    camera: CameraFile = None,
    footage: Footage = None,
    gyro: GyroFile = None,
    fps: Fps = None,
    gyro_offset: GyroOffset = None,
    readout_ratio: ReadoutRatio = None,
    shutter: ShutterName = None,
) -> None:
    """Correct your own rolling-shutter frames: of a stereo rig or of one camera, two frames or a sequence."""
    log = GyroscopeOptions(file=gyro, fps=fps, offset_s=gyro_offset)
    readout = ReadoutOptions(readout_ratio=readout_ratio, shutter=shutter, fps=fps)
    given = arranged(frames, rig, camera, footage, left, right, side_by_side)
    if out is None and given.one_camera and given.left is not None:
        out = default_out(given.left)
    if out is None:
        raise RsbenchError("--out: is required: a folder for the results")
    check_out(out)
    if given.one_camera:
        _refuse_rig_options(ctx)
        # With inputs that only recent versions accept, the middle row, to whose time rows move least.
        row = target or ("middle" if given.words else "first")
        from rsbench.pipeline.mono_sequence import options_of_camera

        alone = given_camera(given, camera, fov, out, log, readout)
        _correct_given(alone, row, options_of_camera(inpaint, seed, 0.0), inpaint is None)
        return
    if fov is not None:
        raise RsbenchError("--fov: has no effect with --rig, whose calibration gives focal lengths; leave it out")
    both = given_frames(given.frames, rig, out, given.left, given.right, log, readout, row_poses, side_by_side)
    given_rig = replace(both, rectify=rectify)
    others = {"find_sky": sky, "inpaint": bool(inpaint), "seed": seed, "motion_model": motion_model}
    others |= {"one_time": rectify}
    options = _options(features, solver, matcher, corrector, fill, **others)
    _correct_given(given_rig, target or "first", options.faster() if fast else options, inpaint is None)


def _refuse_rig_options(ctx: typer.Context) -> None:
    """Raise RsbenchError if the command line has an option without effect on frames of one camera."""
    for parameter in ctx.command.params:
        source = ctx.get_parameter_source(parameter.name or "")
        if parameter.name in _RIG_ONLY and source is not None and source.name == "COMMANDLINE":
            options = "/".join([*parameter.opts, *parameter.secondary_opts])
            raise RsbenchError(f"{options}: has no effect on frames of one camera; leave it out")


def _correct_given(given: CorrectInput, target: str, options: CorrectionOptions, close: bool) -> None:
    """Correct four frames or a sequence; exit 1 if it fails. ``close``: close narrow holes of corrected frames."""
    from rsbench.capture.shutter_decision import NoMotionError
    from rsbench.cli.compile_ahead import compiling_ahead
    from rsbench.pipeline.isolated_components import Isolation
    from rsbench.vision.corrector import NotCorrectedError
    from rsbench.vision.fusion import finished

    finish: Finish = finished if close else lambda fused: fused
    try:
        with nullcontext() if given.one_camera else compiling_ahead(), Isolation() as isolation:
            options = isolation.chain(options)
            if given.four:
                _correct_four(given, target, options, finish)
            else:
                correct_sequence_given(given, target, options, close)
    except (NoMotionError, NotCorrectedError) as error:
        echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None


def _options(
    features: str, solver: str, matcher: str, corrector: str, fill: bool, **others: Any
) -> CorrectionOptions:
    from rsbench.pipeline.arrays import options_of

    options = options_of(solver, others.pop("motion_model"), matcher, features, corrector, **others)
    return options if fill else replace(options, corrector=_without_filling(options.corrector))


def _without_filling(entry: CorrectorEntry) -> CorrectorEntry:
    """The built-in corrector without filling from other views; RsbenchError for other correctors."""
    from rsbench.components.imports import component_key
    from rsbench.vision.correctors import FusionCorrector

    if not isinstance(entry.component, FusionCorrector):
        raise RsbenchError(f"--no-fill: has no effect on corrector {entry.name!r}; leave it out")
    component = replace(entry.component, use_other_views=False)
    return replace(entry, component=component, key=component_key(component, {}))


def _correct_four(given: CorrectInput, target: str, options: CorrectionOptions, finish: Finish) -> None:
    from rsbench.capture.calibration import NO_ERRORS
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import (
        fresh_folder,
        motion_record,
        refuse_video,
        rig_record,
        write_frame,
        write_record,
    )
    from rsbench.interop.writers.rectified_pairs import write_calibration, write_rectified
    from rsbench.pipeline.chain import correct_four
    from rsbench.pipeline.footage import RigCard, read_four
    from rsbench.pipeline.sequence_capture import with_found_camera
    from rsbench.report.corrected_page import card_of
    from rsbench.vision.corrector import demand_corrected

    card, out, order = given.card, given.out, (("left", 0), ("right", 0), ("left", 1), ("right", 1))
    assert isinstance(card, RigCard)
    refuse_video(out)
    images = read_four(dict(zip(order, given.four, strict=True)))  # pyrefly: ignore[bad-argument-type]
    rig = card.rig_of(images["left", 0], images["right", 0])
    options = replace(options, target_row=target_row(target, images["left", 0].shape[0]))
    with fresh_folder(out) as folder:
        rig, focal = with_found_camera(rig, card.sigma, [images], options, card.inputs, progress_bar)
        with progress_bar("correcting", 4) as advance:
            result = correct_four(
                images,
                rig,
                card.readout_ratio,
                options,
                advance,
                disparity_offset=card.disparity_offset,
                scanning=card.scanning,
            )
        demand_corrected(result.frames, options.corrector.name)
        rig = result.rig
        frames = {view: finish(fused) for view, fused in result.frames.items()}
        for (side, frame), fused in frames.items():
            write_frame(folder, f"{side}_{frame}", fused)
            if given.rectify:
                write_rectified(folder, f"{side}_{frame}", fused, rig, side)
        if given.rectify:
            write_calibration(folder, rig)
        calibration = (card.inputs.calibration or NO_ERRORS) if result.found is None else result.found.calibration
        record = rig_record(rig, result.shutter, result.capture, options, calibration, result.rig_found)
        record["camera_note"] = focal
        record["motion"] = None if result.found is None else motion_record(result.found)
        record["frames"] = {f"{side}_{frame}": fused.shares() for (side, frame), fused in frames.items()}
        record["seconds"] = result.seconds
        write_record(folder, record)
        cards = [card_of(f"{s} {f}", images[s, f], fused) for (s, f), fused in frames.items()]
        read = readout_words(result.shutter, result.capture, rig)
        write_page_of(folder, out, [("readout ratio", read)], record["motion"], cards)
    _say(out, f"readout ratio {read}", record)


def _say(out: Path, first: str, record: dict[str, Any]) -> None:
    motion = record["motion"]
    echo(first)
    say_calibration(record)
    if motion is not None:
        from rsbench.report.motion_figures import sizes

        echo(f"motion in a frame period: {', '.join(sizes(motion))} (+-: one standard deviation)")
        if motion["model_choice"]:
            echo(f"motion model: {motion['model_choice']['text']}")
        if motion["note"]:
            echo(f"note: {motion['note']}")
    echo(f"report: {(out / 'report.html').resolve()}")
