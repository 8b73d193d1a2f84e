"""``rsbench correct``: rolling-shutter correction of a user's own stereo frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from rsbench.cli.component_kinds import named
from rsbench.cli.correct_input import EPILOG, given_frames, sized, target_row
from rsbench.cli.correct_one_camera import (
    CameraFile,
    Footage,
    Fps,
    GyroFile,
    GyroGiven,
    GyroOffset,
    correct_one_camera,
)

if TYPE_CHECKING:
    from rsbench.capture.estimate import Capture
    from rsbench.cli.correct_input import Given
    from rsbench.core.shutter import RollingShutter
    from rsbench.pipeline.correction_options import CorrectionOptions
    from rsbench.pipeline.footage import FrameSource, RigCard
    from rsbench.pipeline.sequence_correction import CorrectedMoment
    from rsbench.vision.corrector import CorrectorEntry
    from rsbench.vision.fusion import Fused

    Finish: TypeAlias = Callable[[Fused], Fused]

_PAGE_FRAMES = 6
_INPAINT = "Invent all pixels that no frame shows, or none. Default: specks and slits alone"
_ROW_POSES = "Of a sequence, write the pose at every row too: row_poses.csv, in TUM's format."
_SOLVER = "rs-stereo-refined"
_MODEL = "Motion model: auto, which the matches prefer, or a name. Default: auto where the solver takes it"


def correct(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="LEFT_0 RIGHT_0 LEFT_1 RIGHT_1", help="Four images; or the folder of a rendered sequence."
        ),
    ] = None,
    rig: Annotated[Path | None, typer.Option(metavar="RIG.toml", help="Camera, baseline, readout ratio.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the results.")] = None,
    left: Annotated[Path | None, typer.Option(help="Folder of images or video of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(help="The same for the right camera.")] = None,
    target: Annotated[
        str, typer.Option(help="Time of the corrected frame: first, middle or last row, or a row's number.")
    ] = "first",
    inpaint: Annotated[bool | None, typer.Option(help=_INPAINT)] = None,
    sky: Annotated[bool, typer.Option(help="Detect sky, which moves by rotation alone.")] = True,
    fill: Annotated[bool, typer.Option(help="Fill pixels a frame lacks from other frames.")] = True,
    solver: Annotated[str, named("solvers", "Estimates the motion, in metres: name or card.")] = _SOLVER,
    motion_model: Annotated[str | None, typer.Option(metavar="auto|NAME", help=_MODEL)] = None,
    matcher: Annotated[str, named("matchers", "Estimates depth: a name or a card.")] = "sgm",
    features: Annotated[str, named("features", "Matches features: a name or a card.")] = "sift-refined",
    corrector: Annotated[str, named("correctors", "Makes the corrected frames: a name or a card.")] = "fusion",
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    row_poses: Annotated[bool, typer.Option("--row-poses", help=_ROW_POSES)] = False,
    camera: CameraFile = None,
    footage: Footage = None,
    gyro: GyroFile = None,
    fps: Fps = None,
    gyro_offset: GyroOffset = 0.0,
) -> None:
    """Correct your own rolling-shutter frames: of a stereo rig or of one camera, two times or a whole sequence."""
    if camera is not None or footage is not None:
        log = GyroGiven(file=gyro, fps=fps, offset_s=gyro_offset)
        correct_one_camera(frames, footage, camera, out, target, inpaint, seed, log)
        return
    if gyro is not None:
        raise typer.BadParameter("is used with --camera or --frames, of one camera", param_hint="--gyro")
    given = given_frames(frames, rig, out, left, right, row_poses)
    others = {"find_sky": sky, "inpaint": bool(inpaint), "seed": seed, "motion_model": motion_model}
    options = _options(features, solver, matcher, corrector, fill, **others)
    _correct_given(given, target, options, inpaint is None)


def _correct_given(given: Given, target: str, options: CorrectionOptions, close: bool) -> None:
    """Exit 1 where no motion or no correction is found; ``close``: narrow holes of corrected frames."""
    from rsbench.capture.settle import NoMotionError
    from rsbench.pipeline.isolated_parts import Isolation
    from rsbench.vision.closing import close_narrow
    from rsbench.vision.corrector import NotCorrectedError

    finish: Finish = close_narrow if close else lambda fused: fused
    try:
        with Isolation() as isolation:
            options = isolation.chain(options)
            if given.four:
                _correct_four(given.four, given.card, given.out, target, options, finish)
            else:
                _correct_sequence(given, target, options, finish)
    except (NoMotionError, NotCorrectedError) as error:
        typer.echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None


def _options(
    features: str, solver: str, matcher: str, corrector: str, fill: bool, **others: Any
) -> CorrectionOptions:
    from dataclasses import replace

    from rsbench.pipeline.correction_options import CorrectionOptions
    from rsbench.pipeline.frame_motion import model_to_use
    from rsbench.solvers.engine.registry import load_solver_entry
    from rsbench.vision.feature_matcher import load_features
    from rsbench.vision.stereo_matcher import load_matcher

    options = CorrectionOptions(
        features=load_features(features),
        solver=load_solver_entry(solver),
        matcher=load_matcher(matcher),
        corrector=_corrector(corrector, fill),
        **others,
    )
    return replace(options, motion_model=model_to_use(options.motion_model, options.solver))


def _corrector(name: str, fill: bool) -> CorrectorEntry:
    """The corrector; ``--no-fill`` turns the filling of ours off."""
    from dataclasses import replace

    from rsbench.components.plugins import component_key
    from rsbench.core.errors import RsbenchError
    from rsbench.vision.corrector import load_corrector
    from rsbench.vision.correctors import FusionCorrector

    entry = load_corrector(name)
    if fill:
        return entry
    if not isinstance(entry.component, FusionCorrector):
        raise RsbenchError(f"--no-fill: corrector {name!r} fills nothing that could be turned off; leave it out")
    component = replace(entry.component, use_other_views=False)
    return replace(entry, component=component, key=component_key(component, {}))


def _correct_four(
    paths: list[Path], card: RigCard, out: Path, target: str, options: CorrectionOptions, finish: Finish
) -> None:
    from dataclasses import replace

    from rsbench.capture.calibration_errors import NO_ERRORS
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import fresh_folder, motion_record, rig_record, write_frame, write_record
    from rsbench.dataset.corrected_video import refuse_video
    from rsbench.pipeline.chain import correct_four
    from rsbench.pipeline.footage import read_four
    from rsbench.report.corrected_page import card_of
    from rsbench.vision.corrector import demand_corrected

    order = (("left", 0), ("right", 0), ("left", 1), ("right", 1))
    refuse_video(out)
    images = read_four(dict(zip(order, paths, strict=True)))  # pyrefly: ignore[bad-argument-type]
    rig = sized(card, images["left", 0])
    height = rig.camera.height
    options = replace(options, target_row=target_row(target, height))
    with fresh_folder(out) as folder:
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
        frames = {view: finish(fused) for view, fused in result.frames.items()}
        for (side, frame), fused in frames.items():
            write_frame(folder, f"{side}_{frame}", fused)
        calibration = (card.calibration or NO_ERRORS) if result.found is None else result.found.calibration
        record = rig_record(rig, result.shutter, result.capture, options, calibration)
        record["motion"] = None if result.found is None else motion_record(result.found)
        record["frames"] = {f"{side}_{frame}": fused.shares() for (side, frame), fused in frames.items()}
        record["seconds"] = result.seconds
        write_record(folder, record)
        cards = [card_of(f"{s} {f}", images[s, f], fused) for (s, f), fused in frames.items()]
        _page(folder, out, result.shutter, result.capture, record["motion"], cards)
    _say(out, f"readout ratio {_readout(result.shutter, result.capture)}", record)


def _page(
    folder: Path,
    out: Path,
    shutter: RollingShutter,
    capture: Capture | None,
    motion: dict[str, Any] | None,
    cards: list[Any],
    trajectory: dict[str, Any] | None = None,
) -> None:
    from rsbench.report.corrected_page import write_page

    facts = [("readout ratio", _readout(shutter, capture))]
    if motion is not None:
        facts += [("rotation", f"{motion['rotation_deg']:.4f} deg per frame period")]
        facts += [("translation", f"{motion['translation']:.4f} m per frame period")]
        if motion["model_choice"]:
            facts += [("motion model", motion["model_choice"]["text"])]
        facts += [("matches that agree", _agreeing(motion))]
        facts += [("noise of a match", f"{motion['noise_px'] or float('nan'):.2f} px")]
    write_page(
        folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards, trajectory
    )


def _agreeing(motion: dict[str, Any]) -> str:
    """Of each set, such as "312 of 340 tracks"; sets that the solver did not use are left out."""
    sets = ((name, inliers, motion["matches"][name]) for name, inliers in motion["inliers"].items())
    return ", ".join(f"{inliers} of {matches} {name}" for name, inliers, matches in sets if matches)


def _readout(shutter: RollingShutter, capture: Capture | None) -> str:
    best = None if capture is None else capture.likeliest
    if capture is None or best is None:
        return f"{shutter.readout_ratio:.3f} (given)"
    sure = f"{100.0 * best.probability:.0f} % sure" + "".join(f"; else {c.scans}" for c in capture.candidates[1:2])
    text = f"{best.ratio:.3f} +- {best.sigma:.3f}, {best.scans} (found, {sure})"
    if not capture.told and capture.moved_px < 1.0:
        text += f"; matches move by {capture.moved_px:.1f} px, so that it hardly matters"
    if shutter.right_delay:
        text += f"; right camera late by {best.delay:+.3f} +- {best.delay_sigma:.3f} frame periods"
    if capture.offset_sigma > 0.0 and capture.windows == 1:
        text += "; a rig whose calibration errs may err by more than one window says"
    return text


def _say_calibration(record: dict[str, Any]) -> None:
    if record["calibration_note"]:
        typer.echo(f"errors of the calibration, taken from the matches: {record['calibration_note']}")


def _say(out: Path, first: str, record: dict[str, Any]) -> None:
    motion = record["motion"]
    typer.echo(first)
    _say_calibration(record)
    if motion is not None:
        typer.echo(f"motion {motion['rotation_deg']:.4f} deg, {motion['translation']:.4f} m per frame period")
        if motion["model_choice"]:
            typer.echo(f"motion model: {motion['model_choice']['text']}")
        if motion["note"]:
            typer.echo(f"note: {motion['note']}")
    typer.echo(f"report: {(out / 'report.html').resolve()}")


def _correct_sequence(given: Given, target: str, options: CorrectionOptions, finish: Finish) -> None:
    from dataclasses import replace

    from rsbench.capture.calibration_errors import NO_ERRORS
    from rsbench.cli.console import progress_bar
    from rsbench.core.shutter import Scanning
    from rsbench.dataset.corrected_frames import fresh_folder, rig_record
    from rsbench.dataset.corrected_video import is_video, video_place
    from rsbench.pipeline.chain import check_cameras
    from rsbench.pipeline.sequence_correction import WINDOWS, correct_sequence, estimate_sequence_capture
    from rsbench.report.trajectory_picture import draw_trajectory

    (left, right), card, out = given.footage(), given.card, given.out
    rig = sized(card, next(iter(left)))
    options = replace(options, target_row=target_row(target, rig.camera.height))
    ratio, calibration, scanning, capture = card.readout_ratio, card.calibration, card.scanning, None
    check_cameras(rig, scanning or Scanning(), options, card.disparity_offset)
    with video_place(out) if is_video(out) else fresh_folder(out) as folder:
        if ratio is None or calibration is None:
            windows = min(max(left.count - 1, 1), WINDOWS)
            with progress_bar("looking at the shutter", windows) as advance:
                found = estimate_sequence_capture(left, right, rig, options, ratio, scanning, calibration, advance)
            capture, shutter = found
            ratio, scanning = shutter.readout_ratio, shutter.scanning
            calibration = NO_ERRORS if capture is None or not shutter.rows_together else capture.calibration
        shutter = (scanning or Scanning()).shutter_of(rig.camera.width, rig.camera.height, ratio)
        record = rig_record(rig, shutter, capture, options, calibration or NO_ERRORS)
        with progress_bar("correcting", max(left.count, 1)) as advance:
            moments = correct_sequence(left, right, rig, ratio, options, calibration or NO_ERRORS, scanning)
            rows = shutter if given.row_poses else None
            record["frames"], cards, poses = _write_moments(folder, moments, left, advance, finish, rows)
        if is_video(out):
            _write_both(out, folder, (left, right), record)
        else:
            _write_rest(folder, record, poses)
            _page(folder, out, shutter, capture, None, cards, draw_trajectory(poses, record["frames"]))
    _say_sequence(out, f"readout ratio {_readout(shutter, capture)}", record)


def _say_sequence(out: Path, first: str, record: dict[str, Any]) -> None:
    """Exit 1 where a time is not corrected."""
    from rsbench.dataset.corrected_video import is_video

    frames = record["frames"]
    failed, skipped = _told(frames, "reason"), _told(frames, "skipped")
    typer.echo(first)
    _say_calibration(record)
    typer.echo(f"{sum('reason' not in frame for frame in frames)} of {len(frames)} times corrected")
    typer.echo(f"video: {out.resolve()}" if is_video(out) else f"report: {(out / 'report.html').resolve()}")
    if skipped:
        typer.echo(f"rsbench: corrected with the motion of the frames around: {skipped}", err=True)
    if failed:
        typer.echo(f"rsbench: not corrected: {failed}", err=True)
        raise typer.Exit(1)


def _write_rest(folder: Path, record: dict[str, Any], poses: dict[int, Any]) -> None:
    from rsbench.dataset.corrected_frames import write_record, write_trajectory

    if poses:
        write_trajectory(folder / "trajectory.csv", poses)
    write_record(folder, record)


def _write_both(out: Path, folder: Path, sources: tuple[FrameSource, FrameSource], record: dict[str, Any]) -> None:
    """A video of both cameras side by side; a time that is not corrected is there as it was read."""
    import numpy as np

    from rsbench.dataset.corrected_frames import read_corrected
    from rsbench.dataset.corrected_video import fps_of, write_video

    def shown(side: str, number: int, image: Any) -> Any:
        name = f"{side}_{number:06d}"
        return read_corrected(folder, name) if (folder / "corrected" / f"{name}.png").is_file() else image

    both = (
        np.hstack([shown("left", number, left), shown("right", number, right)])
        for number, (left, right) in enumerate(zip(*sources, strict=True))
    )
    write_video(out, folder, both, fps_of(sources[0].path), record)


def _told(frames: list[dict[str, Any]], key: str) -> str:
    """Which frames have a reason under ``key``, with it."""
    return "; ".join(f"frame {frame['number']} ({frame[key]})" for frame in frames if key in frame)


def _write_moments(
    folder: Path, moments: Any, left: FrameSource, advance: Any, finish: Finish, rows: RollingShutter | None
) -> tuple[list[dict[str, Any]], list[Any], dict[int, Any]]:
    """Write every corrected time; returns what motion.json says of each, some for the page, and poses.

    Args:
        rows: the shutter, where the pose at every row is wanted.
    """
    import numpy as np

    from rsbench.dataset.corrected_frames import append_line_poses, motion_record, write_frame
    from rsbench.report.corrected_page import card_of

    every = max(left.count // _PAGE_FRAMES, 1)
    records: list[dict[str, Any]] = []
    cards: list[Any] = []
    poses: dict[int, Any] = {}
    moment: CorrectedMoment
    for moment in moments:
        entry: dict[str, Any] = {"number": moment.number}
        frames = {side: finish(fused) for side, fused in moment.frames.items()}
        for side, fused in frames.items():
            write_frame(folder, f"{side}_{moment.number:06d}", fused)
            entry[side] = fused.shares()
        if not moment.frames:
            entry["reason"] = moment.reason
        else:
            if moment.reason:
                entry["skipped"] = moment.reason
            if moment.found is not None:
                entry["motion"] = motion_record(moment.found)
            if moment.number % every == 0 and len(cards) < _PAGE_FRAMES:
                title = f"left, frame {moment.number}"
                cards.append(card_of(title, moment.images["left"], frames["left"]))
        if moment.pose is not None:
            poses[moment.number] = moment.pose
        if rows is not None and moment.line_poses is not None:
            taus = np.sort(rows.line_times(moment.number, "left"))
            append_line_poses(folder / "row_poses.csv", taus, moment.line_poses)
        records.append(entry)
        advance(f"frame {moment.number}")
    return records, cards, poses


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(correct)
