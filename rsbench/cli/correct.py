"""``rsbench correct``: rolling-shutter correction of a user's own stereo frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.component_kinds import named
from rsbench.cli.correct_one_camera import CameraFile, Footage, correct_one_camera

if TYPE_CHECKING:
    from rsbench.capture.readout import ReadoutEstimate
    from rsbench.core.rig import StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.pipeline.correction_options import CorrectionOptions
    from rsbench.pipeline.footage import FrameSource, RigCard
    from rsbench.pipeline.sequence_correction import CorrectedMoment
    from rsbench.vision.corrector import CorrectorEntry

EPILOG = """[bold]Examples[/bold]

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected

  rsbench correct --left left.mp4 --right right.mp4 --rig rig.toml --out corrected --target middle

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected --motion-model auto

  rsbench correct data/footage/castle --out corrected     [dim](a sequence of a dataset, which knows its rig)[/dim]

RIG.toml, for images of cameras side by side (pixels, metres; without readout_ratio it is estimated):

  baseline = 0.12
  readout_ratio = 0.8        [dim]# readout time / frame period; or shutter = "gopro-hero6-4k30", of a real
                             # camera's mode (rsbench list shutters)[/dim]
  \\[camera]
  fx = 812.3
  fy = 812.3
  cx = 479.5
  cy = 269.5
  lens = { model = "brown-conrady", k1 = -0.2 }   [dim]# or kannala-brandt; without it: no distortion[/dim]

Names: rsbench list solvers, matchers, features or correctors; a card's path ends in .toml.

DIR gets [bold]report.html[/bold] (before and after), [bold]corrected/*.png[/bold], [bold]depth/*.exr[/bold]
(of the corrected frames, metres), [bold]mask/*.png[/bold] (255 seen in the frame, 192 at a guessed depth, 128 from
the other camera, 64 from the other frame, 0 seen by nobody) and [bold]motion.json[/bold]."""

_PAGE_FRAMES = 6
_SOLVER = "rs-stereo-refined"
_MODEL = "Motion model: auto, which the matches prefer, or a name. Default: the solver's"


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
    inpaint: Annotated[bool, typer.Option("--inpaint", help="Invent pixels that no frame shows.")] = False,
    sky: Annotated[bool, typer.Option(help="Detect sky, which moves by rotation alone.")] = True,
    fill: Annotated[bool, typer.Option(help="Fill pixels a frame lacks from other frames.")] = True,
    solver: Annotated[str, named("solvers", "Estimates the motion, in metres: name or card.")] = _SOLVER,
    motion_model: Annotated[str | None, typer.Option(metavar="auto|NAME", help=_MODEL)] = None,
    matcher: Annotated[str, named("matchers", "Estimates depth: a name or a card.")] = "sgm",
    features: Annotated[str, named("features", "Matches features: a name or a card.")] = "sift",
    corrector: Annotated[str, named("correctors", "Makes the corrected frames: a name or a card.")] = "fusion",
    seed: Annotated[int, typer.Option(help="Seed of RANSAC's sampling.")] = 0,
    camera: CameraFile = None,
    footage: Footage = None,
) -> None:
    """Correct your own rolling-shutter stereo frames: two times of a rig, or a whole sequence."""
    from rsbench.pipeline.frame_motion import NoMotionError
    from rsbench.pipeline.isolated_parts import Isolation
    from rsbench.vision.corrector import NotCorrectedError

    if camera is not None:
        correct_one_camera(frames, footage, camera, out, target, inpaint=True)
        return
    given = _given(frames, rig, out, left, right)
    others = {"find_sky": sky, "inpaint": inpaint, "seed": seed, "motion_model": motion_model}
    options = _options(features, solver, matcher, corrector, fill, **others)
    try:
        with Isolation() as isolation:
            options = isolation.chain(options)
            if given.four:
                _correct_four(given.four, given.card, given.out, target, options)
            else:
                _correct_sequence(*given.footage(), given.card, given.out, target, options)
    except (NoMotionError, NotCorrectedError) as error:
        typer.echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None


@dataclass(frozen=True, kw_only=True)
class _Given:
    """What is to be corrected, and where to."""

    card: RigCard
    out: Path
    four: list[Path]
    """Left 0, right 0, left 1, right 1; or, of footage, nothing."""
    left: list[Path] | Path
    """Its images, or a folder or video."""
    right: list[Path] | Path

    def footage(self) -> tuple[FrameSource, FrameSource]:
        """Of the left and the right camera."""
        from rsbench.pipeline.footage import FrameSource

        left, right = (
            FrameSource.of_files(each) if isinstance(each, list) else FrameSource(each)
            for each in (self.left, self.right)
        )
        return left, right


def _given(
    frames: list[Path] | None, rig: Path | None, out: Path | None, left: Path | None, right: Path | None
) -> _Given:
    """Raises RsbenchError for another combination of arguments."""
    from rsbench.core.errors import RsbenchError
    from rsbench.pipeline.footage import read_rig_card

    rendered = frames is not None and len(frames) == 1 and frames[0].is_dir()
    if out is None or (rig is None and not rendered):
        raise RsbenchError(f"--{'out' if rig is not None or rendered else 'rig'}: is required")
    if frames and rendered:
        if rig or left or right:
            raise RsbenchError(f"{frames[0]}: is a sequence, which knows its frames and rig; leave the others out")
        return _of_sequence(frames[0], out)
    assert rig is not None
    card = read_rig_card(rig)
    if frames is not None and len(frames) == 4 and not (left or right):
        return _Given(card=card, out=out, four=frames, left=[], right=[])
    if frames or not (left and right):
        count = f"{len(frames)} images; " if frames else ""
        raise RsbenchError(
            f"frames: {count}give LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, or --left and --right, or a sequence's folder"
        )
    return _Given(card=card, out=out, four=[], left=left, right=right)


def _of_sequence(folder: Path, out: Path) -> _Given:
    """The rolling-shutter frames of a sequence of a dataset."""
    from rsbench.core.errors import RsbenchError
    from rsbench.core.rig import SIDES
    from rsbench.dataset.layout import picture_file
    from rsbench.dataset.sequence import read_dataset_manifest, read_sequence
    from rsbench.pipeline.footage import rig_card_of

    if not (folder / "sequence.json").is_file():
        names = read_dataset_manifest(folder).sequences
        if len(names) > 1:
            raise RsbenchError(f"{folder}: is a dataset; give one of its sequences: {', '.join(names)}")
        folder = folder / names[0]
    sequence = read_sequence(folder)
    left, right = (
        [folder / picture_file("rs", side, frame) for frame in range(sequence.frames)] for side in SIDES
    )
    card = rig_card_of(sequence.rig, sequence.shutter)
    return _Given(card=card, out=out, four=[], left=left, right=right)


def _options(
    features: str, solver: str, matcher: str, corrector: str, fill: bool, **others: Any
) -> CorrectionOptions:
    from rsbench.capture.model_choice import check_asked
    from rsbench.pipeline.correction_options import CorrectionOptions
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
    if options.motion_model is not None:
        check_asked(options.motion_model, options.solver)
    return options


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


def target_row(target: str, height: int) -> float:
    from rsbench.core.errors import RsbenchError

    named = {"first": 0.0, "middle": (height - 1) / 2, "last": height - 1.0}
    if target in named:
        return named[target]
    try:
        row = float(target)
    except ValueError:
        row = -1.0
    if not 0.0 <= row <= height - 1:
        raise RsbenchError(f"--target {target}: must be first, middle, last or a row from 0 to {height - 1}")
    return row


def _correct_four(paths: list[Path], card: RigCard, out: Path, target: str, options: CorrectionOptions) -> None:
    from dataclasses import replace

    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import fresh_folder, motion_record, rig_record, write_frame, write_record
    from rsbench.pipeline.chain import correct_four
    from rsbench.pipeline.footage import read_four
    from rsbench.report.corrected_page import card_of
    from rsbench.vision.corrector import demand_corrected

    order = (("left", 0), ("right", 0), ("left", 1), ("right", 1))
    images = read_four(dict(zip(order, paths, strict=True)))  # pyrefly: ignore[bad-argument-type]
    rig = _sized(card, images["left", 0])
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
        for (side, frame), fused in result.frames.items():
            write_frame(folder, f"{side}_{frame}", fused)
        record = rig_record(rig, result.shutter, result.readout, options, card.disparity_offset)
        record["motion"] = None if result.found is None else motion_record(result.found)
        record["frames"] = {f"{side}_{frame}": fused.shares() for (side, frame), fused in result.frames.items()}
        record["seconds"] = result.seconds
        write_record(folder, record)
        cards = [card_of(f"{s} {f}", images[s, f], fused) for (s, f), fused in result.frames.items()]
        _page(folder, out, result.shutter, result.readout, record["motion"], cards)
    _say(out, result.shutter, result.readout, record["motion"])


def _sized(card: RigCard, image: Any) -> StereoRig:
    from rsbench.core.errors import RsbenchError

    height, width = image.shape[:2]
    try:
        return card.rig(width, height)
    except ValueError as error:
        raise RsbenchError(f"--rig: of images of {width} x {height} pixels: {error}") from error


def _page(
    folder: Path,
    out: Path,
    shutter: RollingShutter,
    readout: ReadoutEstimate | None,
    motion: dict[str, Any] | None,
    cards: list[Any],
) -> None:
    from rsbench.report.corrected_page import write_page

    facts = [("readout ratio", _readout(shutter, readout))]
    if motion is not None:
        facts += [("rotation", f"{motion['rotation_deg']:.4f} deg per frame period")]
        facts += [("translation", f"{motion['translation']:.4f} m per frame period")]
        if motion["model_choice"]:
            facts += [("motion model", motion["model_choice"]["text"])]
        facts += [("matches that agree", _agreeing(motion))]
        facts += [("noise of a match", f"{motion['noise_px'] or float('nan'):.2f} px")]
    write_page(folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards)


def _agreeing(motion: dict[str, Any]) -> str:
    """Of each set, such as "312 of 340 tracks"; sets that the solver did not use are left out."""
    sets = ((name, inliers, motion["matches"][name]) for name, inliers in motion["inliers"].items())
    return ", ".join(f"{inliers} of {matches} {name}" for name, inliers, matches in sets if matches)


def _readout(shutter: RollingShutter, readout: ReadoutEstimate | None) -> str:
    if readout is None:
        return f"{shutter.readout_ratio:.3f} (given)"
    text = f"{readout} (estimated)"
    if readout.signed_ratio < 0.0:
        text += ", corrected as 0"
    if readout.offset_sigma > 0.0:
        text += f"; disparity offset {readout.disparity_offset:+.2f} +- {readout.offset_sigma:.2f} px (estimated)"
        if readout.windows == 1:
            text += "; a rig like this errs by twice the deviations of one window"
    return text


def _say(
    out: Path, shutter: RollingShutter, readout: ReadoutEstimate | None, motion: dict[str, Any] | None
) -> None:
    typer.echo(f"readout ratio {_readout(shutter, readout)}")
    if motion is not None:
        typer.echo(f"motion {motion['rotation_deg']:.4f} deg, {motion['translation']:.4f} m per frame period")
        if motion["model_choice"]:
            typer.echo(f"motion model: {motion['model_choice']['text']}")
        if motion["note"]:
            typer.echo(f"note: {motion['note']}")
    typer.echo(f"report: {(out / 'report.html').resolve()}")


def _correct_sequence(
    left: FrameSource, right: FrameSource, card: RigCard, out: Path, target: str, options: CorrectionOptions
) -> None:
    from dataclasses import replace

    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import fresh_folder, rig_record, write_record
    from rsbench.pipeline.chain import check_cameras
    from rsbench.pipeline.sequence_correction import correct_sequence, estimate_sequence_readout

    rig = _sized(card, next(iter(left)))
    options = replace(options, target_row=target_row(target, rig.camera.height))
    ratio, offset, readout = card.readout_ratio, card.disparity_offset, None
    check_cameras(rig, card.scanning, options, ratio, offset)
    with fresh_folder(out) as folder:
        if ratio is None:
            readout = estimate_sequence_readout(left, right, rig, options, offset)
            ratio, offset = readout.readout_ratio, readout.disparity_offset
        shutter = card.shutter_of(rig.camera.width, rig.camera.height, ratio)
        record = rig_record(rig, shutter, readout, options, offset)
        with progress_bar("correcting", max(left.count, 1)) as advance:
            moments = correct_sequence(left, right, rig, ratio, options, offset or 0.0, card.scanning)
            record["frames"], cards = _write_moments(folder, moments, left, advance)
        write_record(folder, record)
        _page(folder, out, shutter, readout, None, cards)
    failed = _told(record["frames"], "reason")
    skipped = _told(record["frames"], "skipped")
    typer.echo(f"readout ratio {_readout(shutter, readout)}")
    corrected = [frame for frame in record["frames"] if "reason" not in frame]
    typer.echo(f"{len(corrected)} of {len(record['frames'])} times corrected")
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    if skipped:
        typer.echo(f"rsbench: corrected with the motion from the frame before: {skipped}", err=True)
    if failed:
        typer.echo(f"rsbench: not corrected: {failed}", err=True)
        raise typer.Exit(1)


def _told(frames: list[dict[str, Any]], key: str) -> str:
    """Which frames have a reason under ``key``, with it."""
    return "; ".join(f"frame {frame['number']} ({frame[key]})" for frame in frames if key in frame)


def _write_moments(
    folder: Path, moments: Any, left: FrameSource, advance: Any
) -> tuple[list[dict[str, Any]], list[Any]]:
    """Write every corrected time; returns what motion.json says of each, and some for the page."""
    from rsbench.dataset.corrected_frames import motion_record, write_frame
    from rsbench.report.corrected_page import card_of

    every = max(left.count // _PAGE_FRAMES, 1)
    records: list[dict[str, Any]] = []
    cards: list[Any] = []
    moment: CorrectedMoment
    for moment in moments:
        entry: dict[str, Any] = {"number": moment.number}
        for side, fused in moment.frames.items():
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
                cards.append(card_of(title, moment.images["left"], moment.frames["left"]))
        records.append(entry)
        advance(f"frame {moment.number}")
    return records, cards


def register(app: typer.Typer) -> None:
    app.command(epilog=EPILOG)(correct)
