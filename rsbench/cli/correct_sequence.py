"""``rsbench correct`` of footage of a rig or one camera: a killed run goes on after the frames it wrote."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import target_row
from rsbench.cli.correct_output import UNIT, camera_facts, listed, readout_words, say_calibration, write_page_of
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.cli.correct_input import CorrectInput
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.frame_capture import KnownCapture
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.pipeline.sequence_capture import CorrectedMoment, Gyroscope

_PAGE_FRAMES = 6


def correct_sequence_given(given: CorrectInput, target: str, options: CorrectionOptions, close: bool) -> None:
    """Exit 1 where a time is not corrected; ``close``: narrow holes of corrected frames."""
    from rsbench.cli.console import progress_bar
    from rsbench.core.shutter import Scanning
    from rsbench.dataset.corrected_frames import fresh_folder, is_video, video_place, write_record
    from rsbench.interop.writers.rectified_pairs import write_calibration
    from rsbench.pipeline.chain import check_cameras
    from rsbench.pipeline.footage import RigCard
    from rsbench.pipeline.sequence_capture import know_capture

    sources, card, out, lines = given.sources(), given.card, given.out, list[str]()
    video = is_video(out)
    if given.rectify and video:
        raise RsbenchError(f"--rectify: --out {out} is a video; give a folder, for pairs with their calibration")
    gyro = _gyro(given, sources[0], options)
    first = [next(iter(source)) for source in sources]
    options = replace(options, target_row=target_row(target, first[0].shape[0]))
    if isinstance(card, RigCard):
        check_cameras(card.rig_of(*first), card.scanning or Scanning(), options, card.disparity_offset)
    else:
        _say_input(given, sources[0], first[0].shape, options)
    _warn_of_times(sources)
    run = _run_key(given, sources, options, close, gyro)
    with video_place(out, run) if video else fresh_folder(out, run=run) as folder:
        known = know_capture(sources, card, options, gyro, progress_bar)
        record = _record(known, options)
        record["frames"] = _correct_into(folder, sources, known, options, close, given)
        if video:
            others = _write_page(folder, out, sources[0], record, known)
            lines = _write_video(out, folder, sources, record, others)
        else:
            if given.rectify:
                write_calibration(folder, known.rig)
            write_record(folder, record)
            _write_page(folder, out, sources[0], record, known)
    _say(out, known, record, lines)


def _say_input(
    given: CorrectInput, source: FrameSource, shape: tuple[int, ...], options: CorrectionOptions
) -> None:
    """What was assumed of one camera's frames, a line each."""
    from rsbench.pipeline.footage import FORECAST
    from rsbench.storage.videos import ORIENTATIONS, UPRIGHT

    (height, width), timeline = shape[:2], source.timeline
    if given.words:
        echo(given.words)
    if source.orientation != UPRIGHT:
        echo(
            f"shown {ORIENTATIONS[source.orientation]}: rows, --target, --fov and scan refer to frames as they "
            "are stored, and the result is shown alike"
        )
    for line in timeline.words:
        echo(line)
    rate = "" if timeline.period_s is None else f" at {1.0 / timeline.period_s:.4g} frames/s"
    forecast = FORECAST.words(len(timeline.starts), width * height)
    echo(f"{len(timeline.twins)} frames of {width} x {height}{rate}: {forecast}")
    row = "the middle row" if options.target_row == (height - 1) / 2 else f"row {options.target_row:g}"
    echo(f"output: {given.out}, each frame at the time of {row} (--target)")


def _warn_of_times(sources: list[FrameSource]) -> None:
    """Name a rig's videos whose frames repeat others or come at other times: they are taken as they come."""
    for side, source in zip(("left", "right"), sources if len(sources) == 2 else [], strict=False):
        if source.video is None:
            continue
        timeline = source.timeline
        copies = len(timeline.twins) - len(timeline.starts)
        if copies:
            echo(f"rsbench: {side}: {copies} of {len(timeline.twins)} frames repeat the one before", err=True)
        elif not timeline.even:
            echo(
                f"rsbench: {side}: frames do not follow each other evenly, and are taken as if they did", err=True
            )


def _gyro(given: CorrectInput, first: FrameSource, options: CorrectionOptions) -> Gyroscope | None:
    """The log of a gyroscope, where there is one; RsbenchError where nothing takes it."""
    from rsbench.pipeline.sequence_capture import Gyroscope
    from rsbench.pipeline.sequence_correction import takes_gyro

    if given.gyro.file is None:
        return None
    if not given.one_camera and not takes_gyro(first, options):
        raise RsbenchError(
            "--gyro: is used for the trajectory of four frames and more, with the motion model auto; leave it out"
        )
    period = first.timeline.period_s if given.one_camera else None
    rate = None if period is None else 1.0 / period
    samples = given.gyro.samples(first, rate)
    error = given.gyro.farthest(first, rate) if given.one_camera else 0.0
    return None if samples is None else Gyroscope(samples=samples, clock_error=error)


def _run_key(
    given: CorrectInput,
    sources: list[FrameSource],
    options: CorrectionOptions,
    close: bool,
    gyro: Gyroscope | None,
) -> str:
    """Hash of all that decides what is written: a run with another key does not resume this one."""
    import hashlib

    from rsbench.core.version import __version__
    from rsbench.dataset.corrected_frames import is_video

    flags = close, given.row_poses, is_video(given.out), given.rectify
    parts = [__version__, repr(given.card), repr(options), repr(flags)]
    parts += [each for source in sources for each in source.identity()]
    parts += [] if gyro is None else [hashlib.sha256(gyro.samples.tobytes()).hexdigest(), repr(gyro.clock_error)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _record(known: KnownCapture, options: CorrectionOptions) -> dict[str, Any]:
    """What motion.json says of the cameras, as given or estimated, without the frames."""
    from rsbench.dataset.corrected_frames import camera_alone_record, rig_record

    if not known.rig.metric:
        return camera_alone_record(known, options, UNIT)
    rig = rig_record(known.rig, known.shutter, known.capture, options, known.calibration, known.rig_found)
    return {**rig, "camera_note": known.camera_note}


def _correct_into(
    folder: Path,
    sources: list[FrameSource],
    known: KnownCapture,
    options: CorrectionOptions,
    close: bool,
    given: CorrectInput,
) -> list[dict[str, Any]]:
    """Write every frame that is not there yet; returns what motion.json says of each.

    The matches of frames that are there are found again: the trajectory of the others rests on them.
    """
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import written_entries
    from rsbench.pipeline.sequence_correction import correct_sequence

    entries = written_entries(folder)
    twins = sources[0].timeline.twins.tolist() if given.one_camera else []
    with progress_bar("correcting", max(sources[0].count, 1)) as advance:
        for entry in entries:
            advance(f"frame {entry['number']}")

        def copies() -> None:
            while len(entries) < len(twins) and twins[len(entries)] < len(entries):
                entries.append(_write_copy(folder, len(entries), entries[twins[len(entries)]]))
                advance(f"frame {len(entries) - 1}")

        copies()
        there, start = len(entries), time.monotonic()
        for moment in correct_sequence(sources, known, options, there):
            entries.append(_write(folder, moment, close, given, known, sources[0].orientation))
            rate = (len(entries) - there) / max(time.monotonic() - start, 1e-9)
            advance(f"frame {moment.number}, {rate:.2g} frames/s")
            copies()
    return entries


def _write_copy(folder: Path, number: int, twin: dict[str, Any]) -> dict[str, Any]:
    """A frame of one camera that repeats another one, which has its result."""
    from rsbench.dataset.corrected_frames import copy_frame, write_entry

    copy_frame(folder, f"{number:06d}", f"{twin['number']:06d}")
    entry = {**twin, "number": number, "copy_of": twin["number"]}
    write_entry(folder, entry)
    return entry


def _write(
    folder: Path, moment: CorrectedMoment, close: bool, given: CorrectInput, known: KnownCapture, orientation: int
) -> dict[str, Any]:
    """Write a corrected time, and then its record: a time with a record is complete."""
    import numpy as np

    from rsbench.dataset.corrected_frames import is_video, motion_record, write_entry, write_frame, write_poses
    from rsbench.interop.writers.rectified_pairs import write_rectified
    from rsbench.vision.fusion import finished

    entry: dict[str, Any] = {"number": moment.number}
    how: dict[str, Any] = {"whole": not is_video(given.out), "orientation": orientation}
    for side, fused in (moment.shown if given.one_camera else moment.frames).items():
        name, fused = _name(side, moment.number, given.one_camera), finished(fused) if close else fused
        write_frame(folder, name, fused, **how)
        if given.rectify:
            write_rectified(folder, name, fused, known.rig, side)
        entry |= fused.shares() if given.one_camera else {side: fused.shares()}
    if moment.reason:
        entry["skipped" if moment.frames else "reason"] = moment.reason
    if moment.frames and moment.found is not None:
        entry["motion"] = motion_record(moment.found)
    if moment.pose is not None:
        write_poses(folder, "trajectory", moment.number, [float(moment.number)], moment.pose)
    if given.row_poses and moment.line_poses is not None:
        taus = np.sort(known.shutter.line_times(moment.number, "left"))
        write_poses(folder, "row_poses", moment.number, taus, moment.line_poses)
    write_entry(folder, entry)
    return entry


def _name(side: str, number: int, one_camera: bool) -> str:
    return f"{number:06d}" if one_camera else f"{side}_{number:06d}"


def _write_page(
    folder: Path, out: Path, source: FrameSource, record: dict[str, Any], known: KnownCapture
) -> list[Path]:
    """The page, of the frames of the left or only camera that changed most; beside a video, one to compare."""
    from collections import deque

    import numpy as np

    from rsbench.dataset.corrected_frames import (
        DEFAULT_FPS,
        comparison_of_video,
        is_video,
        join_poses,
        page_of_video,
        read_corrected,
        read_fused,
    )
    from rsbench.report.corrected_page import (
        card_of,
        comparison,
        draw_own_motion,
        draw_trajectory,
        most_changed,
    )
    from rsbench.storage.videos import write_frames

    one, changed, frames = not known.rig.metric, list[float](), record["frames"]
    numbers = [each["number"] for each in frames if one or "left" in each]
    names = [_name("left", number, one) for number in numbers]
    pairs = (
        (before, read_corrected(folder, name)) for name, before in zip(names, source.only(numbers), strict=True)
    )
    shown, video = comparison(pairs, source.orientation, changed), folder / comparison_of_video(out).name
    if is_video(out) and numbers:
        write_frames(video, shown, fps=DEFAULT_FPS, times=source.times if one else None)
    else:
        deque(shown, maxlen=0)
    join_poses(folder, "row_poses")
    join_poses(folder, "trajectory")
    facts = [("readout ratio", readout_words(known.shutter, known.capture, known.rig))]
    facts += [*camera_facts(record).items()] if one else []
    corrected = sum("reason" not in each for each in frames)
    facts += [("frames corrected" if one else "times corrected", f"{corrected} of {len(frames)}")]
    if changed:
        facts += [("change of a frame", f"{max(changed):.1f} grey levels at most, mean over its pixels")]
    facts += [("unit of depth", UNIT)] if one else []
    chosen = most_changed(changed, _PAGE_FRAMES) if changed else []
    shown_frames = source.only(numbers[k] for k in chosen) if chosen else ()
    title, unit = ("frame {}", "") if one else ("left, frame {}", " m")
    cards = [
        card_of(title.format(numbers[k]), image, read_fused(folder, names[k]), unit, source.orientation)
        for k, image in zip(chosen, shown_frames, strict=True)
    ]
    trajectory = folder / "trajectory.csv"
    poses = np.loadtxt(trajectory, ndmin=2) if trajectory.is_file() else np.zeros((0, 8))
    drawn = draw_own_motion(frames) if one else draw_trajectory(poses, frames)
    page = folder / (page_of_video(out).name if is_video(out) else "report.html")
    write_page_of(folder, out, facts, None, cards, drawn, page=page, record=record, video=video)
    return [each for each in (video, page) if is_video(out) and each.is_file()]


def _write_video(
    out: Path, folder: Path, sources: list[FrameSource], record: dict[str, Any], others: list[Path]
) -> list[str]:
    """A video, of a rig with both cameras side by side; a time that is not corrected is there as it was read.

    Returns notes on what was written.
    """
    import numpy as np

    from rsbench.core.rig import SIDES
    from rsbench.dataset.corrected_frames import fps_of, read_corrected, write_video
    from rsbench.storage.videos import UPRIGHT, upright

    turn = UPRIGHT if len(sources) == 1 else sources[0].orientation  # of both, so that they stay side by side
    one = len(sources) == 1

    def shown(side: str, number: int, image: Any) -> Any:
        name = _name(side, number, one)
        return read_corrected(folder, name) if (folder / "corrected" / f"{name}.png").is_file() else image

    images = (
        np.hstack([upright(shown(side, number, image), turn) for side, image in zip(SIDES, moment, strict=False)])
        for number, moment in enumerate(zip(*sources, strict=True))
    )
    return write_video(
        out, folder, images, fps_of(sources[0].path), record, sources[0], others, None if one else UPRIGHT
    )


def _say(out: Path, known: KnownCapture, record: dict[str, Any], lines: list[str]) -> None:
    """Exit 1 where a time is not corrected; ``lines``: notes on what was written."""
    from rsbench.dataset.corrected_frames import is_video, page_of_video

    frames, one = record["frames"], not known.rig.metric
    failed, skipped = (
        listed((frame["number"], frame[key]) for frame in frames if key in frame) for key in ("reason", "skipped")
    )
    reasons = {frame.get("reason") for frame in frames}
    if len(reasons) == 1 and None not in reasons:
        failed = f"all {len(frames)} {'frames' if one else 'times'}: {reasons.pop()}"
    remedy = ": --readout-ratio or --shutter gives it" if one and known.capture is not None else ""
    echo(f"readout ratio {readout_words(known.shutter, known.capture, known.rig)}{remedy}")
    if one:
        facts = camera_facts(record)
        remedy = "" if known.focal is None else ": --fov or --camera gives it"
        echo(f"focal length {facts.pop('focal length')}{remedy}")
        for name, words in facts.items():
            echo(f"{name}: {words}")
    else:
        say_calibration(record)
    gyros = [(each["number"], each["motion"]["gyro"]) for each in frames if "gyro" in each.get("motion", {})]
    used = [found for _, found in gyros if not isinstance(found, str)]
    if used:
        off = max(abs(value - (i == j)) for i, row in enumerate(used[-1]["matrix"]) for j, value in enumerate(row))
        echo(f"gyroscope: clock {_late(used[-1]['shift'])}, axes and scales off by {off:.1%}: corrected for")
    elif known.gyro is not None and not one and record["readout_ratio"] == 0.0:
        echo("rsbench: corrected without the gyroscope: the shutter is global", err=True)
    for line in lines:
        echo(line)
    corrected = sum("reason" not in frame for frame in frames)
    echo(f"{corrected} of {len(frames)} {'frames' if one else 'times'} corrected")
    if is_video(out):
        echo(f"video: {out.resolve()}")
    echo(f"report: {(page_of_video(out) if is_video(out) else out / 'report.html').resolve()}")
    if len(used) < len(gyros):
        unlike = listed((number, found) for number, found in gyros if isinstance(found, str))
        echo(f"rsbench: corrected without the gyroscope: {unlike}", err=True)
    if skipped:
        how = "the frame after them" if one else "the motion of the frames around"
        echo(f"rsbench: corrected with {how}: {skipped}", err=True)
    if failed:
        echo(f"rsbench: not corrected: {failed}", err=True)
        raise typer.Exit(1)


def _late(shift: float) -> str:
    """Of a clock whose times are early by so many frame periods."""
    return f"{abs(shift):.3f} frame periods {'behind' if shift > 0.0 else 'ahead'}"
