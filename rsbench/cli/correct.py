"""``rsbench correct``: rolling-shutter correction of a user's own stereo frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rsbench.cli.names import named
from rsbench.core.errors import RsbenchError

EPILOG = """[bold]Examples[/bold]

  rsbench correct video.mp4     [dim](of one camera; writes video-corrected.mp4 and a report)[/dim]

  rsbench correct a.png b.png c.png --shutter gopro-hero6-4k30 --out corrected

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected

  rsbench correct --left left.mp4 --right right.mp4 --rig rig.toml --out corrected --target middle

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected --motion-model twist

  rsbench correct data/footage/castle --out corrected     [dim](a sequence of a dataset, with its rig)[/dim]

RIG is a calibration of Kalibr, OpenCV, ROS, ZED, DepthAI, RealSense, COLMAP, Basalt or OpenVINS as it is, a file
or a folder of files that belong together ([bold]rsbench rig RIG[/bold] shows what is understood), or rig.toml,
here of two equal aligned cameras (pixels, metres; readout_ratio and scan are estimated if missing):

  baseline = 0.12
  readout_ratio = 0.8        [dim]# readout time / frame period; or shutter = "gopro-hero6-4k30", of a real
                             # camera's mode (rsbench list shutters)[/dim]
  \\[camera]
  fx = 812.3                 [dim]# with focal_sigma = 8 (812 +- 8) it is estimated[/dim]
  fy = 812.3
  cx = 479.5
  cy = 269.5
  lens = { model = "brown-conrady", k1 = -0.2 }   [dim]# or kannala-brandt, rational, double-sphere[/dim]
  k1_sigma = 0.02            [dim]# k1 = -0.2 +- 0.02 is estimated, too[/dim]

Names: rsbench list solvers, matchers, features or correctors; a card's path ends in .toml.

DIR gets [bold]report.html[/bold] (before and after), [bold]corrected/*.png[/bold], [bold]depth/*.exr[/bold]
(of the corrected frames, metres), [bold]mask/*.png[/bold] (255 visible in the frame, 192 at a guessed depth, 128
from the other camera, 64 from the other frame, 32 a narrow hole filled from its surroundings, 0 visible in no
frame) and [bold]motion.json[/bold]."""

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
    camera: Annotated[
        Path | None,
        typer.Option(metavar="CAMERA", help="For one camera, in place of --rig: camera.toml or a calibration."),
    ] = None,
    footage: Annotated[
        Path | None, typer.Option("--frames", metavar="DIR|VIDEO", help="Frames of one camera.")
    ] = None,
    gyro: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG.gcsv|LOG.csv",
            help="Samples of a gyroscope; with a rig for four frames or more. Needs --fps or a video.",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            help="Frames per second, for --gyro, --shutter and a line delay. Default: that of the video."
        ),
    ] = None,
    gyro_offset: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Time of --gyro's clock at the first row of the first frame. Default: 0; for one camera, "
            "estimated within half a second.",
        ),
    ] = None,
    readout_ratio: Annotated[
        float | None,
        typer.Option(help="Readout time divided by frame period, instead of the calibration's."),
    ] = None,
    shutter: Annotated[
        str | None,
        typer.Option(
            "--shutter", metavar="NAME", help="Readout time of a camera mode, see rsbench list shutters."
        ),
    ] = None,
) -> None:
    """Correct your own rolling-shutter frames: of a stereo rig or of one camera, two frames or a sequence."""
    from rsbench.cli.correct_input import (
        GyroscopeOptions,
        ReadoutOptions,
        arranged,
        check_out,
        default_out,
        given_camera,
        given_frames,
    )

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
        alone = given_camera(given, camera, fov, out, log, readout)

        from rsbench.cli.correct_run import correct_given
        from rsbench.pipeline.mono_sequence import options_of_camera

        correct_given(alone, row, options_of_camera(inpaint, seed, 0.0), inpaint is None)
        return
    if fov is not None:
        raise RsbenchError("--fov: has no effect with --rig, whose calibration gives focal lengths; leave it out")
    both = given_frames(given, rig, out, log, readout, row_poses, side_by_side)

    from rsbench.cli.correct_run import correct_given, without_filling
    from rsbench.pipeline.arrays import options_of

    others = {"find_sky": sky, "inpaint": bool(inpaint), "seed": seed, "one_time": rectify}
    options = options_of(solver, motion_model, matcher, features, corrector, **others)
    options = options if fill else replace(options, corrector=without_filling(options.corrector))
    options = options.faster() if fast else options
    correct_given(replace(both, rectify=rectify), target or "first", options, inpaint is None)


def _refuse_rig_options(ctx: typer.Context) -> None:
    """Raise RsbenchError if the command line has an option without effect on frames of one camera."""
    for parameter in ctx.command.params:
        source = ctx.get_parameter_source(parameter.name or "")
        if parameter.name in _RIG_ONLY and source is not None and source.name == "COMMANDLINE":
            options = "/".join([*parameter.opts, *parameter.secondary_opts])
            raise RsbenchError(f"{options}: has no effect on frames of one camera; leave it out")
