"""``rsbench correct`` of the footage of a rig: each frame is written once, and a killed run goes on after them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rsbench.cli.console import echo
from rsbench.cli.correct_input import sized, target_row
from rsbench.cli.correct_output import listed, readout_words, say_calibration, write_page_of
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.capture.two_frame_estimate import Capture
    from rsbench.cli.correct_input import RigInput
    from rsbench.core.rig import StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.core.so3 import FloatArray
    from rsbench.pipeline.footage import FrameSource, RigCard
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.pipeline.sequence_correction import CorrectedMoment
    from rsbench.vision.fusion import Fused

    Sources = tuple[FrameSource, FrameSource]
    Found = tuple[RollingShutter, tuple[float, ...], Capture | None]

_PAGE_FRAMES = 6


def correct_sequence_given(given: RigInput, target: str, options: CorrectionOptions, close: bool) -> None:
    """Exit 1 where a time is not corrected; ``close``: narrow holes of corrected frames."""
    from dataclasses import replace

    from rsbench.cli.console import progress_bar
    from rsbench.core.shutter import Scanning
    from rsbench.dataset.corrected_frames import fresh_folder, is_video, rig_record, video_place
    from rsbench.interop.writers.rectified_pairs import write_calibration
    from rsbench.pipeline.chain import check_cameras
    from rsbench.pipeline.sequence_capture import spread_windows, with_found_camera, with_found_rig

    sources, card, out = given.footage(), given.card, given.out
    if given.rectify and is_video(out):
        raise RsbenchError(f"--rectify: --out {out} is a video; give a folder, for pairs with their calibration")
    gyro = _gyro(given, sources[0], options)
    rig = sized(card, *(next(iter(source)) for source in sources))
    options = replace(options, target_row=target_row(target, rig.camera.height))
    check_cameras(rig, card.scanning or Scanning(), options, card.disparity_offset)
    run = _run_key(given, sources, options, close, gyro)
    with video_place(out, run) if is_video(out) else fresh_folder(out, run=run) as folder:
        rig, focal = with_found_camera(
            rig,
            card.sigma,
            spread_windows(*sources),
            options,
            card.readout_ratio,
            card.scanning,
            progress_bar,
        )
        turned = with_found_rig(rig, *sources, options, card.readout_ratio, card.scanning)
        rig = rig if turned is None else turned.rig
        shutter, calibration, capture = found = _look(sources, rig, card, options)
        record = {**rig_record(rig, shutter, capture, options, calibration, turned), "camera_note": focal}
        record["frames"] = _correct_into(folder, sources, rig, found, options, close, given, gyro)
        if is_video(out):
            _write_both(out, folder, sources, record)
        else:
            if given.rectify:
                write_calibration(folder, rig)
            _write_rest(folder, out, sources[0], record, found)
    _say(out, f"readout ratio {readout_words(shutter, capture)}", record, gyro is not None)


def _gyro(given: RigInput, left: FrameSource, options: CorrectionOptions) -> FloatArray | None:
    """Samples of a gyroscope, where there is one; RsbenchError where nothing takes them."""
    from rsbench.pipeline.sequence_correction import takes_gyro

    if given.gyro.file is not None and not takes_gyro(left, options):
        raise RsbenchError(
            "--gyro: is taken for the trajectory of four frames and more, with the motion model auto; leave it out"
        )
    return given.gyro.samples(left)


def _run_key(
    given: RigInput, sources: Sources, options: CorrectionOptions, close: bool, gyro: FloatArray | None
) -> str:
    """Of all that decides what is written: a run with another key does not go on with what this one wrote."""
    import hashlib

    from rsbench.core.version import __version__
    from rsbench.dataset.corrected_frames import is_video

    flags = close, given.row_poses, is_video(given.out), given.rectify
    parts = [__version__, repr(given.card), repr(options), repr(flags)]
    parts += [each for source in sources for each in source.identity()]
    parts += [] if gyro is None else [hashlib.sha256(gyro.tobytes()).hexdigest()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _look(sources: Sources, rig: StereoRig, card: RigCard, options: CorrectionOptions) -> Found:
    """The shutter, what the calibration is wrong by, and how both were found; None where they are given."""
    from rsbench.capture.calibration import NO_ERRORS
    from rsbench.cli.console import progress_bar
    from rsbench.core.shutter import Scanning
    from rsbench.pipeline.sequence_capture import WINDOWS, estimate_sequence_capture

    ratio, calibration, scanning = card.readout_ratio, card.calibration, card.scanning
    calibration = calibration if rig.aligned else calibration or NO_ERRORS  # found as errors of the rig
    if ratio is not None and calibration is not None:
        return rig.shutter_of(scanning or Scanning(), ratio), calibration, None
    with progress_bar("looking at the shutter", min(max(sources[0].count - 1, 1), WINDOWS)) as advance:
        capture, shutter = estimate_sequence_capture(*sources, rig, options, ratio, scanning, calibration, advance)
    nothing = capture is None or not rig.rows_together(shutter.scanning)
    return shutter, NO_ERRORS if nothing else capture.calibration, capture


def _correct_into(
    folder: Path,
    sources: Sources,
    rig: StereoRig,
    found: Found,
    options: CorrectionOptions,
    close: bool,
    given: RigInput,
    gyro: FloatArray | None,
) -> list[dict[str, Any]]:
    """Write every frame that is not there yet; returns what motion.json says of each.

    The matches of frames that are there are found again: the trajectory of the others rests on them.
    """
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import written_entries
    from rsbench.pipeline.sequence_correction import correct_sequence

    shutter, calibration, _ = found
    entries, taken = written_entries(folder), (shutter.readout_ratio, options, calibration, shutter.scanning)
    with progress_bar("correcting", max(sources[0].count, 1)) as advance:
        for entry in entries:
            advance(f"frame {entry['number']}")
        for moment in correct_sequence(*sources, rig, *taken, first=len(entries), gyro=gyro):
            rows, rectified = shutter if given.row_poses else None, rig if given.rectify else None
            entries.append(_write(folder, moment, close, rows, rectified))
            advance(f"frame {moment.number}")
    return entries


def _write(
    folder: Path,
    moment: CorrectedMoment,
    close: bool,
    rows: RollingShutter | None,
    rectified: StereoRig | None,
) -> dict[str, Any]:
    """Write a corrected time, and then its record: a time with a record is complete.

    Args:
        rows: the shutter, where the pose at every row is wanted.
        rectified: the rig, where rectified pairs are.
    """
    import numpy as np

    from rsbench.dataset.corrected_frames import motion_record, write_entry, write_frame, write_poses
    from rsbench.interop.writers.rectified_pairs import write_rectified
    from rsbench.vision.fusion import finished

    finish: Callable[[Fused], Fused] = finished if close else lambda fused: fused
    entry: dict[str, Any] = {"number": moment.number}
    for side, fused in moment.frames.items():
        finished = finish(fused)
        write_frame(folder, f"{side}_{moment.number:06d}", finished)
        if rectified is not None:
            write_rectified(folder, f"{side}_{moment.number:06d}", finished, rectified, side)
        entry[side] = finished.shares()
    if not moment.frames:
        entry["reason"] = moment.reason
    elif moment.reason:
        entry["skipped"] = moment.reason
    if moment.frames and moment.found is not None:
        entry["motion"] = motion_record(moment.found)
    if moment.pose is not None:
        write_poses(folder, "trajectory", moment.number, [float(moment.number)], moment.pose)
    if rows is not None and moment.line_poses is not None:
        taus = np.sort(rows.line_times(moment.number, "left"))
        write_poses(folder, "row_poses", moment.number, taus, moment.line_poses)
    write_entry(folder, entry)
    return entry


def _write_rest(folder: Path, out: Path, left: FrameSource, record: dict[str, Any], found: Found) -> None:
    import numpy as np

    from rsbench.dataset.corrected_frames import join_poses, write_record
    from rsbench.report.corrected_page import draw_trajectory

    join_poses(folder, "row_poses")
    join_poses(folder, "trajectory")
    trajectory = folder / "trajectory.csv"
    poses = np.loadtxt(trajectory, ndmin=2) if trajectory.is_file() else np.zeros((0, 8))
    write_record(folder, record)
    shutter, _, capture = found
    cards = _cards(folder, left, record["frames"])
    write_page_of(folder, out, shutter, capture, None, cards, draw_trajectory(poses, record["frames"]))


def _cards(folder: Path, left: FrameSource, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Some frames for the page, from what was written."""
    from rsbench.dataset.corrected_frames import read_fused
    from rsbench.report.corrected_page import card_of

    chosen = [each["number"] for each in frames[:: max(len(frames) // _PAGE_FRAMES, 1)] if "left" in each]
    before = {number: image for number, image in enumerate(left) if number in chosen[:_PAGE_FRAMES]}
    fused = {number: read_fused(folder, f"left_{number:06d}") for number in before}
    return [card_of(f"left, frame {number}", image, fused[number]) for number, image in before.items()]


def _write_both(out: Path, folder: Path, sources: Sources, record: dict[str, Any]) -> None:
    """A video of both cameras side by side; a time that is not corrected is there as it was read."""
    import numpy as np

    from rsbench.dataset.corrected_frames import fps_of, read_corrected, write_video

    def shown(side: str, number: int, image: Any) -> Any:
        name = f"{side}_{number:06d}"
        return read_corrected(folder, name) if (folder / "corrected" / f"{name}.png").is_file() else image

    both = (
        np.hstack([shown("left", number, left), shown("right", number, right)])
        for number, (left, right) in enumerate(zip(*sources, strict=True))
    )
    write_video(out, folder, both, fps_of(sources[0].path), record)


def _say(out: Path, first: str, record: dict[str, Any], given_gyro: bool) -> None:
    """Exit 1 where a time is not corrected."""
    from rsbench.dataset.corrected_frames import is_video

    frames = record["frames"]
    failed, skipped = (
        listed((frame["number"], frame[key]) for frame in frames if key in frame) for key in ("reason", "skipped")
    )
    echo(first)
    say_calibration(record)
    gyros = [(each["number"], each["motion"]["gyro"]) for each in frames if "gyro" in each.get("motion", {})]
    used = [found for _, found in gyros if not isinstance(found, str)]
    if used:
        off = max(abs(value - (i == j)) for i, row in enumerate(used[-1]["matrix"]) for j, value in enumerate(row))
        echo(f"gyroscope: clock {_late(used[-1]['shift'])}, axes and scales off by {off:.1%}: allowed for")
    elif given_gyro and record["readout_ratio"] == 0.0:
        echo("rsbench: corrected without the gyroscope: the shutter is global", err=True)
    echo(f"{sum('reason' not in frame for frame in frames)} of {len(frames)} times corrected")
    echo(f"video: {out.resolve()}" if is_video(out) else f"report: {(out / 'report.html').resolve()}")
    if len(used) < len(gyros):
        unlike = listed((number, found) for number, found in gyros if isinstance(found, str))
        echo(f"rsbench: corrected without the gyroscope: {unlike}", err=True)
    if skipped:
        echo(f"rsbench: corrected with the motion of the frames around: {skipped}", err=True)
    if failed:
        echo(f"rsbench: not corrected: {failed}", err=True)
        raise typer.Exit(1)


def _late(shift: float) -> str:
    """Of a clock whose times are early by so many frame periods."""
    return f"{abs(shift):.3f} frame periods {'behind' if shift > 0.0 else 'ahead'}"
