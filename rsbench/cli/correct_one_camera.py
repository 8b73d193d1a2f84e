"""``rsbench correct --camera``: correction of the frames of one camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import GyroscopeOptions, ReadoutOptions, say_notes, size_of, target_row
from rsbench.cli.correct_output import listed

if TYPE_CHECKING:
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_camera import OneCameraCard
    from rsbench.pipeline.mono_sequence import Gyroscope, KnownCamera, MonoMoment, MonoOptions

CameraFile = Annotated[
    Path | None,
    typer.Option(metavar="CAMERA", help="Of one camera, in place of --rig: camera.toml or a calibration."),
]
Footage = Annotated[Path | None, typer.Option("--frames", metavar="DIR|VIDEO", help="Frames of one camera.")]
GyroFile = Annotated[
    Path | None,
    typer.Option(
        metavar="LOG.gcsv|LOG.csv",
        help="What a gyroscope measured; of a rig, over four frames and more. Needs --fps or a video.",
    ),
]
Fps = Annotated[
    float | None,
    typer.Option(help="Frames a second, for --gyro, --shutter and a line delay. Default: what the video says."),
]
ReadoutRatio = Annotated[
    float | None, typer.Option(help="Readout time over frame period, in place of what the calibration says.")
]
ShutterName = Annotated[
    str | None, typer.Option("--shutter", metavar="NAME", help="The same from a mode: rsbench list shutters.")
]
GyroOffset = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="What --gyro's clock shows at the first row of the first frame. Default: 0; of one camera what the "
        "frames show, within half a second.",
    ),
]
_SAME_RATE = 0.01
"""Relative difference of frame rates, up to which they are one, as 29.97 and 30."""
_PAGE_FRAMES = 6
_UNIT = "length of the translation over one frame period"


def correct_one_camera(
    frames: list[Path] | None,
    footage: Path | None,
    camera: Path | None,
    out: Path | None,
    target: str,
    inpaint: bool | None,
    seed: int,
    gyro: GyroscopeOptions,
    readout: ReadoutOptions,
) -> None:
    """Correct images, or a folder or video, of one camera; exit 1 where some of many frames are not corrected.

    Raises:
        RsbenchError: arguments that do not go together, or what ``correct_frames`` refuses.
    """
    from rsbench.core.errors import RsbenchError
    from rsbench.interop.readers.rig_files import read_camera_file
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_sequence import Gyroscope

    if out is None:
        raise RsbenchError("--out: is required")
    if (frames is None) == (footage is None):
        raise RsbenchError("frames: with --camera give FRAME_0 FRAME_1 and so on, or --frames DIR|VIDEO")
    source = FrameSource.of_files(frames) if frames is not None else FrameSource(footage or Path())
    said = readout.beside(camera, gyro.file is not None, source.path)
    card, notes = read_camera_file(camera, said, size_of(frames or source.path))
    say_notes("--camera", notes)
    _warn_of_other_rate(card, source, gyro.fps)
    samples = gyro.samples(source)
    log = None if samples is None else Gyroscope(samples=samples, clock_error=gyro.farthest(source))
    record = _correct(source, card, out, _options(source, target, inpaint, seed), log)
    _say(record, out)


def _warn_of_other_rate(card: OneCameraCard, source: FrameSource, fps_option: float | None) -> None:
    """Warn if the card's readout ratio assumes another frame rate than the frames have."""
    from rsbench.dataset.corrected_frames import said_fps

    fps = said_fps(source.path) if fps_option is None else fps_option
    if card.frame_period_s is None or card.readout_ratio is None or fps is None or not fps > 0.0:
        return
    share = card.frame_period_s * fps
    if abs(share - 1.0) <= _SAME_RATE:
        return
    ratio, other = card.readout_ratio, card.readout_ratio * share
    there = f"at that rate the ratio is {other:.3g}" if other <= 1.0 else "a frame is shorter than that readout"
    echo(
        f"rsbench: camera: readout ratio {ratio:.3g} assumes {1.0 / card.frame_period_s:.4g} frames/s, but the "
        f"frames have {fps:.4g} ({there}): set `frame_period_s = {1.0 / fps:.4g}` beside `shutter`",
        err=True,
    )


def _correct(
    source: FrameSource, card: OneCameraCard, out: Path, options: MonoOptions, gyro: Gyroscope | None
) -> dict[str, Any]:
    """What motion.json holds, once all is written, as a folder or a video."""
    from rsbench.dataset.corrected_frames import (
        fps_of,
        fresh_folder,
        is_video,
        read_corrected,
        video_place,
        write_record,
        write_video,
    )
    from rsbench.report.corrected_page import write_page

    run = _run_key(source, card, options, is_video(out), gyro)
    if is_video(out):
        with video_place(out, run) as folder:
            record = _correct_into(folder, source, card, options, gyro, whole=False)
            images = (read_corrected(folder, f"{each['number']:06d}") for each in record["frames"])
            write_video(out, folder, images, fps_of(source.path), record)
        return record
    with fresh_folder(out, run=run) as folder:
        record = _correct_into(folder, source, card, options, gyro, whole=True)
        write_record(folder, record)
        facts = [("readout ratio", _readout(record)), ("focal length", _focal(record))]
        facts += [("gyroscope's clock", _clock(record))] if "gyro_clock" in record else []
        facts += [("unit of depth", _UNIT)]
        cards = _cards(folder, source, len(record["frames"]))
        write_page(folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards)
    return record


def _run_key(
    source: FrameSource, card: OneCameraCard, options: MonoOptions, video: bool, gyro: Gyroscope | None
) -> str:
    """Of all that decides what is written: a run with another key does not go on with what this one wrote."""
    import hashlib

    from rsbench.core.version import __version__

    parts = [__version__, repr(card), repr(options), repr(video), *source.identity()]
    parts += [] if gyro is None else [hashlib.sha256(gyro.samples.tobytes()).hexdigest(), repr(gyro.clock_error)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _correct_into(
    folder: Path,
    source: FrameSource,
    card: OneCameraCard,
    options: MonoOptions,
    gyro: Gyroscope | None,
    *,
    whole: bool,
) -> dict[str, Any]:
    """Write every frame that is not there yet; exit 1 where the frames do not show how they were read.

    Args:
        whole: whether masks and depth are wanted, not the images alone.
    """
    from rsbench.capture.shutter_decision import NoMotionError
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import written_entries
    from rsbench.pipeline.mono_sequence import correct_frames, know_camera

    try:
        known = know_camera(source, source.count, card, options, gyro, progress_bar)
    except NoMotionError as error:
        echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None
    record = _record(known, options)
    entries = written_entries(folder)
    with progress_bar("correcting", max(source.count, 1)) as advance:
        for entry in entries:
            advance(f"frame {entry['number']}")
        moments = correct_frames(source, known.camera, known.readout.shutter, options, len(entries), known.gyro)
        record["frames"] = entries + _write(folder, moments, advance, whole=whole)
    return record


def _options(source: FrameSource, target: str, inpaint: bool | None, seed: int) -> MonoOptions:
    from rsbench.pipeline.mono_sequence import MonoOptions

    height = next(iter(source)).shape[0]
    return MonoOptions.of(inpaint, seed, None if target == "middle" else target_row(target, height))


def _record(known: KnownCamera, options: MonoOptions) -> dict[str, Any]:
    """What motion.json says of the camera, as given or estimated, without its frames."""
    from rsbench.capture.shutter_decision import record_of
    from rsbench.dataset.corrected_frames import MASK_VALUES

    camera, focal, found = known.camera, known.focal, known.readout
    best = None if found.capture is None else found.capture.likeliest
    return {
        "units": {"length": _UNIT, "angle": "rad", "time": "frame period", "depth": f"{_UNIT}, 0 = unknown"},
        "camera": {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "focal_length_assumed": focal is not None and not focal.determined,
        "focal_length_estimated": focal is not None and focal.determined,
        "focal_length_sigma": None if focal is None else focal.sigma,
        "scan": found.scan,
        "readout_ratio": found.shutter.readout_ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "readout_ratio_estimated": found.capture is not None,
        "capture": None if found.capture is None else record_of(found.capture),
        "corrector": "mono-fusion",
        "target_row": options.target_row,
        "mask_values": {origin.name.lower(): value for origin, value in MASK_VALUES.items()},
        "gyro": known.gyro is not None,
        **({} if known.clock is None else {"gyro_clock": known.clock._asdict()}),
    }


def _readout(record: dict[str, Any]) -> str:
    text = f"{record['readout_ratio']:.3f}"
    if not record["readout_ratio_estimated"]:
        return f"{text} (given)"
    sure = f"{100.0 * record['capture']['probability']:.0f} % sure"
    return f"{text} +- {record['readout_ratio_sigma']:.3f}, from the {record['scan']} (found, {sure})"


def _focal(record: dict[str, Any]) -> str:
    text, sigma = f"{record['camera']['fx']:.1f}", record["focal_length_sigma"]
    if sigma is None:
        return f"{text} px (given)"
    how = (
        "assumed: the width of the image; the frames do not determine it"
        if record["focal_length_assumed"]
        else "found"
    )
    return f"{text} +- {sigma:.1f} px ({how})"


def _clock(record: dict[str, Any]) -> str:
    clock = record["gyro_clock"]
    if not clock["told"]:
        return "the frames do not show its offset; give `--gyro-offset`"
    seen = f"{clock['shift']:+.3f} +- {clock['sigma']:.3f} frame periods off"
    return f"{seen}, and set right" if clock["used"] else f"{seen}, and left as it is"


def _say(record: dict[str, Any], out: Path) -> None:
    """Exit 1 where some frames are not corrected."""
    frames = {
        key: listed((each["number"], each[key]) for each in record["frames"] if key in each)
        for key in ("skipped", "reason")
    }
    motions = ((each["number"], each.get("motion", {})) for each in record["frames"])
    frames["gyro"] = listed((number, motion["gyro"]) for number, motion in motions if "gyro" in motion)
    corrected = sum("reason" not in each for each in record["frames"])
    echo(f"readout ratio {_readout(record)}")
    echo(f"focal length {_focal(record)}")
    if "gyro_clock" in record:
        echo(f"gyroscope's clock: {_clock(record)}")
    echo(f"{corrected} of {len(record['frames'])} frames corrected")
    place = out if out.is_file() else out / "report.html"
    echo(f"{'video' if out.is_file() else 'report'}: {place.resolve()}")
    if frames["gyro"]:
        echo(f"rsbench: corrected without the gyroscope: {frames['gyro']}", err=True)
    if frames["skipped"]:
        echo(f"rsbench: corrected with the frame after them: {frames['skipped']}", err=True)
    if frames["reason"]:
        echo(f"rsbench: not corrected: {frames['reason']}", err=True)
        raise typer.Exit(1)


def _write(folder: Path, moments: Any, advance: Any, *, whole: bool) -> list[dict[str, Any]]:
    """Write every frame, and then what motion.json says of it: a frame that has that is complete."""
    from rsbench.dataset.corrected_frames import write_entry, write_frame
    from rsbench.pipeline.mono_sequence import translation_record

    entries: list[dict[str, Any]] = []
    moment: MonoMoment
    for moment in moments:
        name = f"{moment.number:06d}"
        write_frame(folder, name, moment.fused, whole=whole)
        entry: dict[str, Any] = {"number": moment.number, **moment.fused.shares()}
        for key, words in (("reason", moment.fused.reason), ("skipped", moment.skipped)):
            if words:
                entry[key] = words
        if moment.found is not None:
            entry["motion"] = translation_record(moment.found)
        write_entry(folder, entry)
        entries.append(entry)
        advance(f"frame {moment.number}")
    return entries


def _cards(folder: Path, source: FrameSource, count: int) -> list[dict[str, Any]]:
    """Some frames for the page, from what was written."""
    from rsbench.dataset.corrected_frames import read_fused
    from rsbench.report.corrected_page import card_of

    chosen = range(0, count, max(count // _PAGE_FRAMES, 1))[:_PAGE_FRAMES]
    before = {number: image for number, image in enumerate(source) if number in chosen}
    return [card_of(f"frame {n}", before[n], read_fused(folder, f"{n:06d}"), unit="") for n in chosen]
