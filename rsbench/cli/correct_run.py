"""Run ``rsbench correct`` on four frames or a sequence; an interrupted run resumes after the frames it wrote."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import typer

from rsbench.capture.shutter_decision import NoMotionError
from rsbench.cli.compile_ahead import compiling_ahead
from rsbench.cli.console import echo, progress_bar
from rsbench.cli.correct_input import CorrectInput, target_row
from rsbench.components.imports import component_key
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, View
from rsbench.core.version import __version__
from rsbench.dataset import corrected_frames as results
from rsbench.interop.writers.rectified_pairs import write_calibration, write_rectified
from rsbench.pipeline.chain import check_cameras, correct_four
from rsbench.pipeline.footage import FORECAST, FrameSource, RigCard, read_four
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_chain import Isolation
from rsbench.pipeline.sequence_capture import CorrectedMoment, Gyroscope, know_capture
from rsbench.pipeline.sequence_correction import correct_sequence, takes_gyro
from rsbench.report.corrected_page import (
    card_of,
    comparison,
    draw_own_motion,
    draw_trajectory,
    most_changed,
    ranges,
    sizes,
    write_page,
)
from rsbench.storage.videos import ORIENTATIONS, UPRIGHT, upright, write_frames
from rsbench.vision.corrector import CorrectorEntry, NotCorrectedError, demand_corrected
from rsbench.vision.correctors import FusionCorrector
from rsbench.vision.fusion import Fused, finished
from rsbench.vision.images import ahead, single_opencv

_MOST_LISTED = 8
SUBTITLE = "Rolling shutter to global shutter"


def motion_facts(motion: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Return names and values that describe the motion, for the report on four frames."""
    if motion is None:
        return []
    names = "rotation in a frame period", "translation in a frame period"
    facts = [*zip(names, sizes(motion), strict=True)]
    if motion["model_choice"]:
        facts += [("motion model", motion["model_choice"]["text"])]
    # Sets of matches that the solver did not use are left out.
    sets = ((name, inliers, motion["matches"][name]) for name, inliers in motion["inliers"].items())
    agreeing = ", ".join(f"{inliers} of {matches} {name}" for name, inliers, matches in sets if matches)
    noise = f"{motion['noise_px'] or float('nan'):.2f} px"
    return [*facts, ("matches that agree", agreeing), ("noise of a match", noise)]


def camera_facts(record: dict[str, Any]) -> dict[str, str]:
    """Return text on the focal length and the gyroscope's clock, from the record of one camera."""
    focal, sigma = f"{record['camera']['fx']:.1f}", record["focal_length_sigma"]
    how = "found"
    if record["focal_length_assumed"]:
        how = "assumed: the width of the image; the frames do not determine it"
    facts = {"focal length": f"{focal} px (given)" if sigma is None else f"{focal} +- {sigma:.1f} px ({how})"}
    clock = record.get("gyro_clock")
    if clock is None:
        return facts
    words = f"{clock['shift']:+.3f} +- {clock['sigma']:.3f} frame periods off, and "
    words += "set right" if clock["used"] else "left as it is"
    if not clock["told"]:
        words = "the frames do not show its offset; give `--gyro-offset`"
    return {**facts, "gyroscope's clock": words}


def readout_words(known: KnownCapture) -> str:
    shutter, capture = known.shutter, known.capture
    best = None if capture is None else capture.likeliest
    if capture is None or best is None:
        return f"{shutter.readout_ratio:.3f} (given)"
    if not known.rig.metric:
        side = f"from the {shutter.scan_of('left')}, which is the right side with a probability of"
        return f"{best.ratio:.3f} +- {best.sigma:.3f} (found), {side} {best.probability:.0%}"
    odds = f"probability that the cameras read so {best.probability:.0%}"
    odds += "".join(f"; else {each.scans}" for each in capture.candidates[1:2])
    text = f"{best.ratio:.3f} +- {best.sigma:.3f}, {best.scans} (found, {odds})"
    if not capture.determined and capture.moved_px < 1.0:
        text += f"; matches move by {capture.moved_px:.1f} px, so that it hardly matters"
    if shutter.right_delay:
        text += f"; right camera late by {best.delay:+.3f} +- {best.delay_sigma:.3f} frame periods"
    if capture.offset_sigma > 0.0 and capture.windows == 1:
        text += "; a rig whose calibration errs may err by more than one window says"
    return text


def say_calibration(record: dict[str, Any]) -> None:
    if record["camera_note"]:
        echo(record["camera_note"])
    if record["calibration_note"]:
        echo(f"errors of the calibration, taken from the matches: {record['calibration_note']}")


def listed(frames: Iterable[tuple[int, str]]) -> str:
    """Return text with frame numbers and reasons, at most ``_MOST_LISTED`` of them."""
    words = [f"frame {number} ({why})" for number, why in frames]
    more = [f"and {len(words) - _MOST_LISTED} more, see motion.json"] if len(words) > _MOST_LISTED else []
    return "; ".join(words[:_MOST_LISTED] + more)


def alone_of(frames: Mapping[Any, Fused]) -> dict[str, Any]:
    """Return, for motion.json, how frames that the rig's motion does not explain were corrected; empty if none."""
    names = {view: view if isinstance(view, str) else "{}_{}".format(*view) for view in frames}
    notes = {names[view]: each.note for view, each in frames.items() if each.note}
    return notes and {"explained": min(each.explained for each in frames.values()), **notes}


def _say_alone(alone: Mapping[Any, Mapping[str, Any]]) -> None:
    """Print which frames (number or view) were corrected by each camera alone."""
    if not alone:
        return
    least = min(each["explained"] for each in alone.values())
    names = [each for each in alone if isinstance(each, str)]
    frames = "frame" if len(alone) == 1 else "frames"
    echo(
        f"rsbench: corrected by each camera alone: {frames} {', '.join(names) or ranges(list(alone))}: "
        f"the motion of the rig explains only {100.0 * least:.0f} % of what moves in the images; "
        "unless objects fill them, check the calibration and readout_ratio",
        err=True,
    )


_PAGE_FRAMES, _AHEAD = 6, 4
"""Number of frames in the report; number of frames that are read ahead while others are encoded."""


def correct_given(given: CorrectInput, target: str, options: CorrectionOptions, close: bool) -> None:
    """Correct four frames or a sequence; exit code 1 if it fails. ``close``: whether to close narrow holes."""
    try:
        with nullcontext() if given.one_camera else compiling_ahead(), Isolation() as isolation:
            options = isolation.chain(options)
            if given.four:
                _correct_four(given, target, options, close)
            else:
                _correct_sequence(given, target, options, close)
    except (NoMotionError, NotCorrectedError) as error:
        echo(f"rsbench: not corrected: {error}", err=True)
        raise typer.Exit(1) from None


def without_filling(entry: CorrectorEntry) -> CorrectorEntry:
    """Return the built-in corrector without filling from other views; RsbenchError for other correctors."""
    if not isinstance(entry.component, FusionCorrector):
        raise RsbenchError(f"--no-fill: has no effect on corrector {entry.name!r}; leave it out")
    component = replace(entry.component, use_other_views=False)
    return replace(entry, component=component, key=component_key(component, {}))


def _correct_four(given: CorrectInput, target: str, options: CorrectionOptions, close: bool) -> None:
    card, out, order = given.card, given.out, (("left", 0), ("right", 0), ("left", 1), ("right", 1))
    assert isinstance(card, RigCard)
    results.refuse_video(out)
    images = read_four(dict(zip(order, given.four, strict=True)))  # pyrefly: ignore[bad-argument-type]
    rig = card.rig_of(images["left", 0], images["right", 0])
    options = replace(options, target_row=target_row(target, images["left", 0].shape[0]))
    with results.fresh_folder(out) as folder:
        with progress_bar("correcting", 4) as advance:
            result = correct_four(images, rig, card.inputs, options, advance)
        demand_corrected(result.frames, options.corrector.name)
        known, rig = result.known, result.rig

        def written(view: View) -> tuple[Fused, dict[str, Any]]:
            """Write a corrected frame; return it with its entry on the page."""
            fused, name = finished(result.frames[view]) if close else result.frames[view], "{}_{}".format(*view)
            results.write_frame(folder, name, fused)
            if given.rectify:
                write_rectified(folder, name, fused, rig, view[0])
            return fused, card_of("{} {}".format(*view), images[view], fused)

        with ThreadPoolExecutor(2) as threads:
            frames = dict(zip(result.frames, threads.map(written, result.frames), strict=True))
        if given.rectify:
            write_calibration(folder, rig)
        record = results.capture_record(known, options)
        record["motion"] = None if result.found is None else results.motion_record(result.found)
        record["frames"] = {"{}_{}".format(*view): fused.shares() for view, (fused, _) in frames.items()}
        record["alone"] = alone_of(result.frames)
        record["seconds"] = result.seconds
        results.write_record(folder, record)
        read = readout_words(known)
        facts = [("readout ratio", read), *motion_facts(record["motion"])]
        write_page(folder, f"rsbench correct: {out.name}", SUBTITLE, facts, [card for _, card in frames.values()])
    _say_four(out, f"readout ratio {read}", record)


def _say_four(out: Path, first: str, record: dict[str, Any]) -> None:
    motion = record["motion"]
    echo(first)
    say_calibration(record)
    if motion is not None:
        words = ", ".join(sizes(motion))
        echo(f"motion in a frame period: {words}{' (+-: one standard deviation)' if '+-' in words else ''}")
        if motion["model_choice"]:
            echo(f"motion model: {motion['model_choice']['text']}")
        if motion["note"]:
            echo(f"note: {motion['note']}")
    echo(f"report: {(out / 'report.html').resolve()}")
    _say_alone({name.replace("_", " "): record["alone"] for name in record["alone"] if name != "explained"})


def _correct_sequence(given: CorrectInput, target: str, options: CorrectionOptions, close: bool) -> None:
    """Correct a sequence; exit code 1 if any frame time is not corrected. ``close``: close narrow holes."""
    sources, card, out, lines = given.sources(), given.card, given.out, list[str]()
    if given.rectify and given.video:
        raise RsbenchError(f"--rectify: --out {out} is a video; give a folder, for pairs with their calibration")
    for option, wanted in (("--gyro", given.gyro.file is not None), ("--row-poses", given.row_poses)):
        if wanted and not given.one_camera and not takes_gyro(sources[0], options):
            raise RsbenchError(
                f"{option}: needs the trajectory of four frames and more, with the motion model auto; leave it out"
            )
    gyro = given.gyro.read(sources[0], given.one_camera)
    first = [next(iter(source)) for source in sources]
    options = replace(options, target_row=target_row(target, first[0].shape[0]))
    if isinstance(card, RigCard):
        check_cameras(card.rig_of(*first), card.inputs.reading, options, card.disparity_offset or 0.0)
        _warn_of_times(sources)
    else:
        _say_input(given, sources[0], first[0].shape, options)
    run = _run_key(given, sources, options, close, gyro)
    place = results.video_place(out, run) if given.video else results.fresh_folder(out, run=run)
    with single_opencv(), place as folder:
        known = know_capture(sources, card, options, gyro, progress_bar)
        record = results.capture_record(known, options)
        record["frames"] = _correct_into(folder, sources, known, options, close, given)
        if given.video:
            others = _write_page(folder, given, sources[0], record, known)
            lines = _write_video(given, folder, sources, record, others)
        else:
            if given.rectify:
                write_calibration(folder, known.rig)
            results.write_record(folder, record)
            _write_page(folder, given, sources[0], record, known)
    _say(given, known, record, lines)


def _say_input(
    given: CorrectInput, source: FrameSource, shape: tuple[int, ...], options: CorrectionOptions
) -> None:
    """Print the assumptions about one camera's frames, a line each."""
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
    """Warn if a video of a rig has repeated or unevenly spaced frames, which are treated as evenly spaced."""
    for side, source in zip(SIDES, sources, strict=True):
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


def _run_key(
    given: CorrectInput,
    sources: list[FrameSource],
    options: CorrectionOptions,
    close: bool,
    gyro: Gyroscope | None,
) -> str:
    """Return a hash of all inputs that affect the results; only a run with the same key resumes this one."""
    flags = close, given.row_poses, given.video, given.rectify
    parts = [__version__, repr(given.card), repr(options), repr(flags)]
    parts += [each for source in sources for each in source.identity()]
    parts += [] if gyro is None else [hashlib.sha256(gyro.samples.tobytes()).hexdigest(), repr(gyro.clock_error)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _correct_into(
    folder: Path,
    sources: list[FrameSource],
    known: KnownCapture,
    options: CorrectionOptions,
    close: bool,
    given: CorrectInput,
) -> list[dict[str, Any]]:
    """Write every frame that does not exist yet; returns the entries of all frames in motion.json.

    Existing frames are matched again, as the trajectory of the others depends on their matches.
    """
    entries = results.written_entries(folder)
    twins = sources[0].timeline.twins.tolist() if given.one_camera else []
    with progress_bar("correcting", max(sources[0].count, 1)) as advance:
        for entry in entries:
            advance(f"frame {entry['number']}")

        def copies() -> None:
            while len(entries) < len(twins) and twins[len(entries)] < len(entries):
                number, twin = len(entries), twins[len(entries)]
                results.copy_frame(folder, f"{number:06d}", f"{twin:06d}")
                entries.append({**entries[twin], "number": number, "copy_of": twin})
                results.write_entry(folder, entries[-1])
                advance(f"frame {number}")

        copies()
        there, start = len(entries), time.monotonic()
        for moment in correct_sequence(sources, known, options, there):
            entries.append(_write(folder, moment, close, given, known, sources[0].orientation))
            rate = (len(entries) - there) / max(time.monotonic() - start, 1e-9)
            advance(f"frame {moment.number}, {rate:.2g} frames/s")
            copies()
    return entries


def _write(
    folder: Path, moment: CorrectedMoment, close: bool, given: CorrectInput, known: KnownCapture, orientation: int
) -> dict[str, Any]:
    """Write the images of a frame time, then its record, which marks them as complete; returns the record."""
    entry: dict[str, Any] = {"number": moment.number}
    how: dict[str, Any] = {"whole": not given.video, "orientation": orientation}
    for side, fused in (moment.shown if given.one_camera else moment.frames).items():
        name, fused = _name(side, moment.number, given.one_camera), finished(fused) if close else fused
        results.write_frame(folder, name, fused, **how)
        if given.rectify:
            write_rectified(folder, name, fused, known.rig, side)
        entry |= fused.shares() if given.one_camera else {side: fused.shares()}
    if alone := alone_of(moment.frames):
        entry["alone"] = alone
    if moment.reason:
        entry["skipped" if moment.frames else "reason"] = moment.reason
    if moment.frames and moment.found is not None:
        entry["motion"] = results.motion_record(moment.found)
    if moment.pose is not None:
        results.write_poses(folder, "trajectory", moment.number, [float(moment.number)], moment.pose)
    if given.row_poses and moment.line_poses is not None:
        taus = np.sort(known.shutter.line_times(moment.number, "left"))
        results.write_poses(folder, "row_poses", moment.number, taus, moment.line_poses)
    results.write_entry(folder, entry)
    return entry


def _name(side: str, number: int, one_camera: bool) -> str:
    return f"{number:06d}" if one_camera else f"{side}_{number:06d}"


def _write_page(
    folder: Path, given: CorrectInput, source: FrameSource, record: dict[str, Any], known: KnownCapture
) -> list[Path]:
    """Write the page with the most changed frames of the left or only camera. For ``--out`` a video, also write a
    video that compares frames before and after, and return both files."""
    one, out, changed, frames = given.one_camera, given.out, list[float](), record["frames"]
    numbers = [each["number"] for each in frames if one or "left" in each]
    names = [_name("left", number, one) for number in numbers]
    pairs = (
        (before, results.read_corrected(folder, name))
        for name, before in zip(names, source.only(numbers), strict=True)
    )
    shown, video = comparison(pairs, source.orientation, changed), folder / results.comparison_of_video(out).name
    if given.video and numbers:
        write_frames(video, ahead(shown, _AHEAD), fps=results.DEFAULT_FPS, times=source.times if one else None)
    else:
        deque(shown, maxlen=0)
    results.join_poses(folder, "row_poses")
    results.join_poses(folder, "trajectory")
    facts = [("readout ratio", readout_words(known))]
    facts += [*camera_facts(record).items()] if one else []
    corrected = sum("reason" not in each for each in frames)
    facts += [("frames corrected" if one else "times corrected", f"{corrected} of {len(frames)}")]
    if changed:
        facts += [("change of a frame", f"{max(changed):.1f} grey levels at most, mean over its pixels")]
    facts += [("unit of depth", record["units"]["length"])] if one else []
    chosen = most_changed(changed, _PAGE_FRAMES) if changed else []
    shown_frames = source.only(numbers[k] for k in chosen) if chosen else ()
    title, unit = ("frame {}", "") if one else ("left, frame {}", " m")
    cards = [
        card_of(title.format(numbers[k]), image, results.read_fused(folder, names[k]), unit, source.orientation)
        for k, image in zip(chosen, shown_frames, strict=True)
    ]
    trajectory = folder / "trajectory.csv"
    poses = np.loadtxt(trajectory, ndmin=2) if trajectory.is_file() else np.zeros((0, 8))
    drawn = draw_own_motion(frames) if one else draw_trajectory(poses, frames)
    page = folder / given.page.name
    title, subtitle = f"rsbench correct: {out.name}", f"{SUBTITLE}; the frames that changed most"
    beside = video.name if video.is_file() else ""
    write_page(folder, title, subtitle, facts, cards, drawn, page=page, record=record, video=beside)
    return [each for each in (video, page) if given.video and each.is_file()]


def _write_video(
    given: CorrectInput, folder: Path, sources: list[FrameSource], record: dict[str, Any], others: list[Path]
) -> list[str]:
    """Write a video, for a rig with both cameras side by side; frames that were not corrected are kept as read.

    Returns notes about the written video.
    """
    one, first = given.one_camera, sources[0]
    turn = UPRIGHT if one else first.orientation  # applied to both images, so that they stay side by side

    def shown(side: str, number: int, image: Any) -> Any:
        name = _name(side, number, one)
        corrected = (folder / "corrected" / f"{name}.png").is_file()
        return upright(results.read_corrected(folder, name) if corrected else image, turn)

    images = (
        np.hstack([shown(side, number, image) for side, image in zip(SIDES, moment, strict=False)])
        for number, moment in enumerate(zip(*sources, strict=True))
    )
    fps, orientation = results.fps_of(first.path), None if one else UPRIGHT
    return results.write_video(given.out, folder, ahead(images, _AHEAD), fps, record, first, others, orientation)


def _say(given: CorrectInput, known: KnownCapture, record: dict[str, Any], lines: list[str]) -> None:
    """Print a summary, with ``lines`` on what was written; exit code 1 if a frame time was not corrected."""
    frames, one = record["frames"], given.one_camera
    failed, skipped = (
        listed((frame["number"], frame[key]) for frame in frames if key in frame) for key in ("reason", "skipped")
    )
    reasons = {frame.get("reason") for frame in frames}
    if len(reasons) == 1 and None not in reasons:
        failed = f"all {len(frames)} {'frames' if one else 'times'}: {reasons.pop()}"
    remedy = ": --readout-ratio or --shutter gives it" if one and known.capture is not None else ""
    echo(f"readout ratio {readout_words(known)}{remedy}")
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
        shift = used[-1]["shift"]  # positive: its times are early
        clock = f"{abs(shift):.3f} frame periods {'behind' if shift > 0.0 else 'ahead'}"
        echo(f"gyroscope: clock {clock}, axes and scales off by {off:.1%}: corrected for")
    elif known.gyro is not None and not one and record["readout_ratio"] == 0.0:
        echo("rsbench: corrected without the gyroscope: the shutter is global", err=True)
    for line in lines:
        echo(line)
    corrected = sum("reason" not in frame for frame in frames)
    echo(f"{corrected} of {len(frames)} {'frames' if one else 'times'} corrected")
    if given.video:
        echo(f"video: {given.out.resolve()}")
    echo(f"report: {given.page.resolve()}")
    if len(used) < len(gyros):
        unlike = listed((number, found) for number, found in gyros if isinstance(found, str))
        echo(f"rsbench: corrected without the gyroscope: {unlike}", err=True)
    _say_alone({frame["number"]: frame["alone"] for frame in frames if "alone" in frame})
    if skipped:
        how = "the frame after them" if one else "the motion of the frames around"
        echo(f"rsbench: corrected with {how}: {skipped}", err=True)
    if failed:
        echo(f"rsbench: not corrected: {failed}", err=True)
        raise typer.Exit(1)
