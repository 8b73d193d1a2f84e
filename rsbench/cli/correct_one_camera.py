"""``rsbench correct --camera``: correction of the frames of one camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import (
    Arranged,
    GyroscopeOptions,
    ReadoutOptions,
    say_notes,
    size_of,
    target_row,
)
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
    given: Arranged,
    camera: Path | None,
    fov: float | None,
    out: Path,
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
    from rsbench.interop.readers.rig_files import read_camera_file
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_sequence import Gyroscope

    source = FrameSource.of_files(given.frames) if given.frames is not None else FrameSource(given.left or Path())
    stated = readout.beside(camera, gyro.file is not None, source.path)
    card, notes = read_camera_file(camera, stated, size_of(given.frames or source.path))
    say_notes("--camera", notes)
    card = _with_fov(card, fov)
    _warn_of_other_rate(card, source, gyro.fps)
    options = _options(source, target, inpaint, seed)
    _say_input(given, source, options, out)
    period = source.timeline.period_s
    rate = None if period is None else 1.0 / period
    samples = gyro.samples(source, rate)
    log = None if samples is None else Gyroscope(samples=samples, clock_error=gyro.farthest(source, rate))
    record, lines = _correct(source, card, out, options, log)
    _say(record, out, lines)


def _with_fov(card: OneCameraCard, fov: float | None) -> OneCameraCard:
    """The card with the field of view of ``--fov``."""
    from dataclasses import replace

    from rsbench.core.errors import RsbenchError

    if fov is None:
        return card
    if not card.focal_unknown:
        raise RsbenchError("--fov: leave it out; the camera's file says the focal length")
    try:
        return replace(card, fov_deg=fov)
    except ValueError as error:
        raise RsbenchError(f"--fov: {error}") from error


def _say_input(given: Arranged, source: FrameSource, options: MonoOptions, out: Path) -> None:
    """What was assumed of the frames, a line each."""
    from rsbench.pipeline.footage import FORECAST
    from rsbench.storage.videos import ORIENTATIONS, UPRIGHT

    height, width = next(iter(source)).shape[:2]
    timeline = source.timeline
    if given.words:
        echo(given.words)
    if source.orientation != UPRIGHT:
        echo(
            f"shown {ORIENTATIONS[source.orientation]}: rows, --target, --fov and scan are of frames as they are "
            "stored, and the result is shown alike"
        )
    for line in timeline.words:
        echo(line)
    rate = "" if timeline.period_s is None else f" at {1.0 / timeline.period_s:.4g} frames/s"
    forecast = FORECAST.words(len(timeline.starts), width * height)
    echo(f"{len(timeline.twins)} frames of {width} x {height}{rate}: {forecast}")
    row = "the middle row" if options.target_row is None else f"row {options.target_row:g}"
    echo(f"output: {out}, each frame at the time of {row} (--target)")


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
) -> tuple[dict[str, Any], list[str]]:
    """What motion.json holds, once all is written, as a folder or a video; and lines about what was written."""
    from rsbench.dataset.corrected_frames import (
        comparison_of_video,
        fps_of,
        fresh_folder,
        is_video,
        page_of_video,
        read_corrected,
        video_place,
        write_record,
        write_video,
    )

    run = _run_key(source, card, options, is_video(out), gyro)
    if is_video(out):
        with video_place(out, run) as folder:
            record = _correct_into(folder, source, card, options, gyro, whole=False)
            changed = _compare(folder, source, record, comparison_of_video(out).name)
            _write_page(folder, out, source, record, changed, page_of_video(out).name)
            images = (read_corrected(folder, f"{each['number']:06d}") for each in record["frames"])
            others = [folder / each(out).name for each in (comparison_of_video, page_of_video)]
            lines = write_video(out, folder, images, fps_of(source.path), record, source, others)
        return record, lines
    with fresh_folder(out, run=run) as folder:
        record = _correct_into(folder, source, card, options, gyro, whole=True)
        write_record(folder, record)
        _write_page(folder, out, source, record, _compare(folder, source, record, ""), "report.html")
    return record, []


def _compare(folder: Path, source: FrameSource, record: dict[str, Any], video: str) -> list[float]:
    """How much each frame changed, grey levels; writes a video of this name of frames before and after."""
    from collections import deque

    from rsbench.dataset.corrected_frames import DEFAULT_FPS, read_corrected
    from rsbench.report.corrected_page import comparison
    from rsbench.storage.videos import write_frames

    changed = list[float]()
    numbers = (each["number"] for each in record["frames"])
    pairs = (
        (before, read_corrected(folder, f"{number:06d}")) for number, before in zip(numbers, source, strict=True)
    )
    shown = comparison(pairs, source.orientation, changed)
    if video:
        write_frames(folder / video, shown, fps=DEFAULT_FPS, times=source.times)
    else:
        deque(shown, maxlen=0)
    return changed


def _write_page(
    folder: Path, out: Path, source: FrameSource, record: dict[str, Any], changed: list[float], page: str
) -> None:
    from rsbench.dataset.corrected_frames import comparison_of_video, read_fused
    from rsbench.report.corrected_page import card_of, most_changed, write_page

    facts = [("readout ratio", _readout(record)), ("focal length", _focal(record))]
    facts += [("gyroscope's clock", _clock(record))] if "gyro_clock" in record else []
    alone = sum("reason" in each for each in record["frames"])
    facts += [("frames corrected", f"{len(changed) - alone} of {len(changed)}")]
    facts += [("change of a frame", f"{max(changed):.1f} grey levels at most, mean over its pixels")]
    facts += [("unit of depth", _UNIT)]
    chosen = most_changed(changed, _PAGE_FRAMES)
    before = dict(zip(chosen, source.only(chosen), strict=True))
    cards = [
        card_of(f"frame {n}", before[n], read_fused(folder, f"{n:06d}"), unit="", orientation=source.orientation)
        for n in chosen
    ]
    write_page(
        folder,
        f"rsbench correct: {out.name}",
        "Rolling shutter to global shutter; the frames that changed most",
        facts,
        cards,
        page=folder / page,
        record=record,
        video=comparison_of_video(out).name if (folder / comparison_of_video(out).name).is_file() else "",
    )


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

    timeline = source.timeline
    originals, run = timeline.originals, timeline.even_run()
    taken = source if len(originals) == len(timeline.twins) else source.only(originals)
    looked = taken if timeline.even else source.only(originals[run])
    starts = None if timeline.even else timeline.starts
    try:
        begins = None if starts is None else starts[run]
        known = know_camera(looked, looked.count, card, options, gyro, progress_bar, begins)
    except NoMotionError as error:
        echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None
    record = _record(known, options)
    entries = written_entries(folder)
    with progress_bar("correcting", max(source.count, 1)) as advance:
        for entry in entries:
            advance(f"frame {entry['number']}")
        done, shutter = sum("copy_of" not in each for each in entries), known.readout.shutter
        moments = correct_frames(taken, known.camera, shutter, options, done, known.gyro, starts)
        record["frames"] = _write(folder, moments, entries, timeline.twins.tolist(), advance, whole=whole)
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
    odds = f"probability that the camera reads so {record['capture']['probability']:.0%}"
    return f"{text} +- {record['readout_ratio_sigma']:.3f}, from the {record['scan']} (found, {odds})"


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


def _say(record: dict[str, Any], out: Path, lines: list[str]) -> None:
    """Exit 1 where some frames are not corrected."""
    from rsbench.dataset.corrected_frames import page_of_video

    frames = {
        key: listed((each["number"], each[key]) for each in record["frames"] if key in each)
        for key in ("skipped", "reason")
    }
    reasons = {each.get("reason") for each in record["frames"]}
    if len(reasons) == 1 and None not in reasons:
        frames["reason"] = f"all {len(record['frames'])} frames: {reasons.pop()}"
    motions = ((each["number"], each.get("motion", {})) for each in record["frames"])
    frames["gyro"] = listed((number, motion["gyro"]) for number, motion in motions if "gyro" in motion)
    corrected = sum("reason" not in each for each in record["frames"])
    improve = "" if not record["readout_ratio_estimated"] else ": --readout-ratio or --shutter gives it"
    echo(f"readout ratio {_readout(record)}{improve}")
    improve = "" if record["focal_length_sigma"] is None else ": --fov or --camera gives it"
    echo(f"focal length {_focal(record)}{improve}")
    if "gyro_clock" in record:
        echo(f"gyroscope's clock: {_clock(record)}")
    for line in lines:
        echo(line)
    echo(f"{corrected} of {len(record['frames'])} frames corrected")
    if out.is_file():
        echo(f"video: {out.resolve()}")
    echo(f"report: {(page_of_video(out) if out.is_file() else out / 'report.html').resolve()}")
    if frames["gyro"]:
        echo(f"rsbench: corrected without the gyroscope: {frames['gyro']}", err=True)
    if frames["skipped"]:
        echo(f"rsbench: corrected with the frame after them: {frames['skipped']}", err=True)
    if frames["reason"]:
        echo(f"rsbench: not corrected: {frames['reason']}", err=True)
        raise typer.Exit(1)


def _write(
    folder: Path, moments: Any, entries: list[dict[str, Any]], twins: list[int], advance: Any, *, whole: bool
) -> list[dict[str, Any]]:
    """Write every frame, and then what motion.json says of it: a frame that has that is complete.

    Args:
        moments: of frames that are no copies, from those of ``entries`` on.
        entries: of frames that are complete.
        twins: for each frame the number of the one that it repeats, or its own.
    """
    from rsbench.dataset.corrected_frames import copy_frame, write_entry, write_frame
    from rsbench.pipeline.mono_sequence import translation_record

    def copies() -> None:
        while len(entries) < len(twins) and twins[len(entries)] < len(entries):
            number, twin = len(entries), twins[len(entries)]
            copy_frame(folder, f"{number:06d}", f"{twin:06d}")
            entries.append({**entries[twin], "number": number, "copy_of": twin})
            write_entry(folder, entries[-1])
            advance(f"frame {number}")

    moment: MonoMoment
    copies()
    for moment in moments:
        number = len(entries)
        write_frame(folder, f"{number:06d}", moment.fused, whole=whole)
        entry: dict[str, Any] = {"number": number, **moment.fused.shares()}
        for key, words in (("reason", moment.fused.reason), ("skipped", moment.skipped)):
            if words:
                entry[key] = words
        if moment.found is not None:
            entry["motion"] = translation_record(moment.found)
        write_entry(folder, entry)
        entries.append(entry)
        advance(f"frame {number}")
        copies()
    return entries
