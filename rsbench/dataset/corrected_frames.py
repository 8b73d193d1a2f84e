"""The files of ``rsbench correct``: corrected frames or a video, masks, depth and the motion."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.capture.calibration import OFFSET, TERMS, describe_errors
from rsbench.capture.shutter_decision import record_of
from rsbench.capture.trajectory_gyro import GyroFound
from rsbench.components.motion_models import AcceleratedMotion
from rsbench.components.rig_tables import camera_record
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import Pose, inverse
from rsbench.dataset.sequence import cameras_record
from rsbench.pipeline.footage import FrameSource, read_frame
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import FoundMotion
from rsbench.pipeline.mono_correction import FoundOwnMotion
from rsbench.pipeline.mono_gyro import CONTRADICTED
from rsbench.storage.files import read_depth, read_json, read_png, write_bytes, write_depth, write_json, write_png
from rsbench.storage.videos import UPRIGHT, VideoFile, said_fps, write_frames, written_as_video
from rsbench.storage.work_folder import (
    HIDDEN,
    WORK,
    files_below,
    listed,
    named,
    remove,
    unknown_files,
    work_folder,
)
from rsbench.vision.fusion import Fused, Origin

_TUM = "# frame periods, metres: the body in the world, which is the body at the start of the first frame\n"
MASK_VALUES = {
    Origin.NOBODY: 0,
    Origin.INVENTED: 32,
    Origin.OTHER_FRAME: 64,
    Origin.OTHER_CAMERA: 128,
    Origin.GUESSED: 192,
    Origin.HERE: 255,
}
"""Grey value of each origin in the mask files, larger for more reliable origins."""
MARKER = "motion.json"
ALONE_UNIT = "length of the translation over one frame period"
"""Unit of the depth of one camera's frames."""
_HALF = "half"
"""Name of the folder, in the hidden one, from which a killed run is resumed."""
_ENTRIES = f"{HIDDEN}/frames"
_LIST = f"{HIDDEN}/files.json"
"""Names of all written files below the folder."""


@contextmanager
def fresh_folder(out: Path, by: str = "rsbench correct", run: str = "") -> Iterator[Path]:
    """Yield a folder that replaces ``out`` when it is complete; it is removed after an error.

    If a run with the key ``run`` is killed or interrupted, the next run with the same key continues in the folder.

    Earlier results of the same command are replaced: they are moved aside, and removed when the new ones are in
    place. If a kill comes in between, the next run moves them back.

    Args:
        out: final folder.
        by: name of the command.
        run: key of everything that affects the output; without it, an interrupted run is not resumed.

    Raises:
        RsbenchError: ``out`` cannot be written, contains other files, is the working folder, or another command
            works there.
    """
    place = out.resolve()
    if Path.cwd().is_relative_to(place):
        raise RsbenchError(f"--out {out}: this command runs there; choose a folder of its own, such as corrected")
    with work_folder(out, place.with_name(f".{place.name}{HIDDEN}")) as hidden:
        old, fresh = hidden / "old", hidden / WORK / "new"
        if old.exists() and not place.exists():
            os.rename(old, place)
        remove(old)
        _refuse_others(out, place, by)
        if run:
            fresh = half_folder(hidden, run)
        else:
            fresh.mkdir()
        try:
            yield fresh
        except Exception:
            remove(hidden / _HALF)
            raise
        remove(fresh / HIDDEN)
        files = files_below(fresh)
        (fresh / _LIST).parent.mkdir()
        write_json(fresh / _LIST, {"by": by, "files": files})
        _refuse_others(out, place, by)  # files may have been added in the meantime
        _exchange(fresh, place, old)
        remove(old)
        remove(hidden / _HALF)


def half_folder(hidden: Path, run: str) -> Path:
    """The folder, in a hidden one, of the unfinished run of this key; emptied if it is of another key."""
    half = hidden / _HALF
    if not (half / "run").is_file() or (half / "run").read_text("utf-8") != run:
        remove(half)
        (half / "new").mkdir(parents=True)
        write_bytes(half / "run", run.encode())
    return half / "new"


def _refuse_others(out: Path, place: Path, by: str) -> None:
    """Check that all files to be replaced are of this command."""
    if not place.exists() or (place.is_dir() and not any(place.iterdir())):
        return
    written = read_json(place / _LIST) if (place / _LIST).is_file() else {"by": None}
    if written.get("by", "rsbench correct") != by:  # lists of the first versions named no command
        raise RsbenchError(f"{out}: exists and was not written by {by!r}; choose another --out")
    files = written.get("files")
    known = {_LIST, *files} if isinstance(files, list) else set()
    if others := unknown_files(place, known.__contains__):
        raise RsbenchError(
            f"{out}: holds {named(others)}, which {by!r} did not write; move it away or choose another --out"
        )


def _exchange(fresh: Path, place: Path, old: Path) -> None:
    try:
        if place.exists():
            os.rename(place, old)
        os.rename(fresh, place)
    except BaseException:  # also for signals
        if old.exists() and not place.exists():
            os.rename(old, place)
        raise


_PARTS = {"corrected": ".png", "mask": ".png", "depth": ".exr"}
"""Which files of a frame are written."""


def copy_frame(folder: Path, name: str, twin: str) -> None:
    """Copy the files of one frame as those of another."""
    for part, suffix in _PARTS.items():
        if (written := folder / part / f"{twin}{suffix}").is_file():
            shutil.copyfile(written, folder / part / f"{name}{suffix}")


def write_frame(folder: Path, name: str, fused: Fused, *, whole: bool = True, orientation: int = UPRIGHT) -> None:
    """Write corrected/NAME.png, mask/NAME.png and, for a ``whole`` frame, depth/NAME.exr below ``folder``.

    The EXIF ``orientation`` is written to the first file; pixels are not rotated.
    """
    for part in _PARTS if whole else list(_PARTS)[:2]:
        (folder / part).mkdir(parents=True, exist_ok=True)
    write_png(folder / "corrected" / f"{name}.png", fused.image, orientation)
    write_origin(folder / "mask" / f"{name}.png", fused.origin)
    if not whole:
        return
    depth = np.where(np.isfinite(fused.depth), fused.depth, np.float32(0.0))
    write_depth(folder / "depth" / f"{name}.exr", depth, quick=True)


def read_corrected(folder: Path, name: str) -> NDArray[Any]:
    """The image of a frame that ``write_frame`` wrote, (H, W) or (H, W, 3), uint8 or uint16."""
    return read_frame(folder / "corrected" / f"{name}.png")


def read_fused(folder: Path, name: str) -> Fused:
    """A frame that ``write_frame`` wrote; NaN where it has no finite depth."""
    image, file = read_corrected(folder, name), folder / "depth" / f"{name}.exr"
    depth = read_depth(file) if file.is_file() else np.zeros(image.shape[:2], np.float32)
    return Fused(
        image=image,
        origin=read_origin(folder / "mask" / f"{name}.png"),
        depth=np.where(depth > 0.0, depth, np.float32(np.nan)),
    )


def write_origin(path: Path, origin: NDArray[np.uint8]) -> None:
    """Image of the origin (H, W) of every pixel, in ``MASK_VALUES``."""
    values = np.zeros(len(Origin), dtype=np.uint8)
    values[list(MASK_VALUES)] = list(MASK_VALUES.values())
    write_png(path, values[origin])


def read_origin(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Origin (H, W) of every pixel, from an image of ``write_origin``; ``size`` as of ``read_png``.

    Raises:
        RsbenchError: missing or not an image.
    """
    origins = np.zeros(256, dtype=np.uint8)
    origins[list(MASK_VALUES.values())] = list(MASK_VALUES)
    return origins[read_png(path, size)[..., 0]]


def motion_record(found: FoundMotion | FoundOwnMotion) -> dict[str, Any]:
    """The body's motion of one window, metres, or one camera's, of length 1, ready for JSON."""
    if isinstance(found, FoundOwnMotion):
        return _own_motion_record(found)
    estimate, motion = found.robust.estimate, found.motion
    # The covariance is that of the solver's reference point.
    known = estimate.covariance is not None and found.reference_point == "body"
    gyro = {} if found.gyro is None else {"gyro": _gyro_record(found.gyro)}
    turned, shifted = found.unevenness
    return {
        "solver": found.solver,
        "model": motion.name,
        "parameters": motion.parameters,
        "model_choice": None if found.choice is None else found.choice.record(),
        "reference_point": "body",
        "w": motion.w.tolist(),
        "d": motion.d.tolist(),
        "rotation_deg": float(np.rad2deg(np.linalg.norm(motion.w))),
        "translation": float(np.linalg.norm(motion.d)),
        "metric": estimate.metric,
        "note": estimate.reason,
        "noise_px": estimate.noise_px,
        "uneven": {"rotation_deg": float(np.rad2deg(turned)), "translation": shifted},
        "covariance_w_d": np.asarray(estimate.covariance).tolist() if known else None,
        "inliers": {str(name): count.inliers for name, count in found.robust.counts.items()},
        "matches": {str(name): count.matches for name, count in found.robust.counts.items()},
        **gyro,
    }


def _own_motion_record(found: FoundOwnMotion) -> dict[str, Any]:
    motion = found.own.motion
    unused = {"gyro": found.unused} if found.unused else {}
    if motion is None:
        return {"reason": found.reason, **unused}
    record = {
        "model": motion.name,
        **({"acceleration": motion.acceleration} if isinstance(motion, AcceleratedMotion) else {}),
        "w": motion.w.tolist(),
        "d": motion.d.tolist(),
        "rotation_deg": float(np.rad2deg(np.linalg.norm(motion.w))),
    }
    if found.robust is not None:
        record |= {
            "noise_px": found.robust.estimate.noise_px,
            "inliers": found.robust.inlier_count,
            "matches": found.robust.match_count,
        }
    return {**record, **unused}


def _gyro_record(gyro: GyroFound) -> Any:
    """The estimates of the gyroscope, or why it is not used."""
    if not gyro.used:
        return CONTRADICTED
    found = {"bias": gyro.bias, "shift": gyro.shift, "matrix": gyro.matrix, "noise": gyro.noise}
    return {name: np.asarray(value).tolist() for name, value in found.items()}


def _ideal_record(camera: PinholeCamera) -> dict[str, Any]:
    known = camera_record(camera)
    lens = known.pop("lens", None)
    return {"camera": known, "lens": lens}


def capture_record(known: KnownCapture, options: CorrectionOptions) -> dict[str, Any]:
    """What the correction of a rig's or of one camera's frames assumed or estimated, ready for JSON."""
    rig, capture, alone = known.rig, known.capture, not known.rig.metric
    best = None if capture is None else capture.likeliest
    unit, unknown = (ALONE_UNIT, "unknown") if alone else ("m", "infinite or unknown")
    record = {
        "units": {"length": unit, "angle": "rad", "time": "frame period", "depth": f"{unit}, 0 = {unknown}"},
        **(_ideal_record(rig.camera) if rig.aligned else cameras_record(rig)),
        "scan": known.shutter.scan_of("left") if alone else known.shutter.scanning.record,
        "readout_ratio": known.shutter.readout_ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "readout_ratio_estimated": capture is not None,
        "capture": None if capture is None else record_of(capture),
        "target_row": options.target_row,
        "mask_values": {origin.name.lower(): value for origin, value in MASK_VALUES.items()},
    }
    return record | (_camera_record(known, options) if alone else _rig_record(known, options))


def _rig_record(known: KnownCapture, options: CorrectionOptions) -> dict[str, Any]:
    errors, found = known.calibration, known.rig_found
    return {
        "baseline": known.rig.baseline,
        "disparity_offset": errors[OFFSET],
        "disparity_offset_sigma": None if known.capture is None else known.capture.offset_sigma,
        "calibration_errors": dict(zip(TERMS, errors, strict=True)) if any(errors) else None,
        "calibration_note": describe_errors(errors, known.rig) if found is None else found.words,
        **({} if found is None else {"rig_errors": found.record}),
        "camera_note": known.camera_note,
        "components": {name: {"name": each.name, "key": each.key} for name, each in options.components.items()},
    }


def _camera_record(known: KnownCapture, options: CorrectionOptions) -> dict[str, Any]:
    focal = known.focal
    return {
        "focal_length_assumed": focal is not None and not focal.determined,
        "focal_length_estimated": focal is not None and focal.determined,
        "focal_length_sigma": None if focal is None else focal.sigma,
        "corrector": options.corrector.name,
        "gyro": known.gyro is not None,
        **({} if known.clock is None else {"gyro_clock": known.clock._asdict()}),
    }


def written_entries(folder: Path) -> list[dict[str, Any]]:
    """The entries of the frames that an earlier run finished."""
    return [read_json(path) for path in listed(folder / _ENTRIES, ".json")]


def write_entry(folder: Path, entry: dict[str, Any]) -> None:
    """Write the entry of a frame in motion.json, after all its files: ``written_entries`` reads it back."""
    (folder / _ENTRIES).mkdir(parents=True, exist_ok=True)
    write_json(folder / _ENTRIES / f"{entry['number']:06d}.json", entry)


def write_poses(folder: Path, name: str, number: int, taus: ArrayLike, poses: Pose) -> None:
    """Write the poses of one frame, for ``join_poses``.

    Args:
        taus: (n,) times of the poses, frame periods.
        poses: body from world, (n, 3, 3), (n, 3) or one.
    """
    R, t = poses.R.reshape(-1, 3, 3), poses.t.reshape(-1, 3)
    lines = [_line(float(tau), Pose(*each)) for tau, *each in zip(np.atleast_1d(taus), R, t, strict=True)]
    place = folder / HIDDEN / name
    place.mkdir(parents=True, exist_ok=True)
    write_bytes(place / f"{number:06d}.csv", "".join(lines).encode())


def join_poses(folder: Path, name: str) -> None:
    """NAME.csv in TUM's format, lines ``tau tx ty tz qx qy qz qw``, from the parts of all frames; no file without
    parts.

    Frame by frame, so that footage may be of any length.
    """
    parts = listed(folder / HIDDEN / name, ".csv")
    if not parts:
        return
    with (folder / f"{name}.csv").open("wb") as file:
        file.write(_TUM.encode())
        for part in parts:
            file.write(part.read_bytes())


def _line(tau: float, pose: Pose) -> str:
    R, position = inverse(pose)
    a, b, c, d = so3.quaternion(R)
    return " ".join(f"{value:.9g}" for value in (tau, *position, b, c, d, a)) + "\n"


def write_record(folder: Path, record: dict[str, Any]) -> None:
    write_json(folder / MARKER, record)


DEFAULT_FPS = 30.0
"""Frame rate, frames/s, of inputs that state none."""


def refuse_video(out: Path) -> None:
    """Raise RsbenchError for the name of a video if the frames are not a video."""
    if written_as_video(out):
        raise RsbenchError(f"--out {out}: four images are no video; give a folder, or --left and --right")


@contextmanager
def video_place(out: Path, run: str = "") -> Iterator[Path]:
    """Yield a work folder for a video ``out`` with the frames for ``write_video``; it is kept after a kill.

    Args:
        out: file of the video.
        run: key of everything that affects the output, as for ``fresh_folder``; without it, nothing is resumed.

    Raises:
        RsbenchError: a file of that name exists that this command did not write, or the folder cannot be written.
    """
    place = out.resolve()
    with work_folder(place.parent, place.with_name(f".{place.name}{HIDDEN}")) as hidden:
        _refuse_other_video(out)
        half = half_folder(hidden, run or secrets.token_hex())
        try:
            yield half
        except Exception:
            remove(half.parent)
            raise
        remove(half.parent)


def _refuse_other_video(out: Path) -> None:
    """Check that the file to be replaced is a video of this command, with its record."""
    record = record_of_video(out)
    ours = record.is_file() and read_json(record).get("video") == out.name
    if out.exists() and not (ours and out.is_file()):
        raise RsbenchError(f"{out}: exists and was not written by 'rsbench correct'; choose another --out")
    if record.exists() and not ours:
        raise RsbenchError(f"{record}: exists and is no record of {out.name}; choose another --out")


def page_of_video(out: Path) -> Path:
    """The report beside a video."""
    return out.with_suffix(".html")


def comparison_of_video(out: Path) -> Path:
    """The video beside a video with the frames before and after."""
    return out.with_name(f"{out.stem}-compare.mp4")


def record_of_video(out: Path) -> Path:
    """The file beside a video with the content of ``motion.json``."""
    return out.with_suffix(".json")


def write_video(
    out: Path,
    half: Path,
    frames: Iterable[NDArray[Any]],
    fps: float,
    record: dict[str, Any],
    source: FrameSource | None = None,
    others: Sequence[Path] = (),
    orientation: int | None = None,
) -> list[str]:
    """Write frames (H, W[, 3]) RGB or grey, uint8 or uint16, and their record beside them; returns notes.

    Args:
        out: the video.
        half: a folder on the same disk, for incomplete files.
        frames: all of one size.
        fps: frames per second of images.
        record: what was found, for JSON.
        source: the frames read, whose times, orientation, colours and sound the video gets.
        orientation: EXIF's number, in place of the source's.
        others: files that are ready in ``half`` and go beside the video, with the video's name in theirs.

    Raises:
        RsbenchError: there is no such encoder here, or the file cannot be written.
    """
    part = half.parent / f"part{out.suffix.lower()}"
    like, times = (None, None) if source is None else (source.video, source.times)
    if orientation is None:
        orientation = UPRIGHT if source is None else source.orientation
    count, notes = write_frames(part, frames, fps=fps, times=times, like=like, orientation=orientation, named=out)
    written = VideoFile.open(part).count
    if written not in (0, count):
        raise RsbenchError(f"--out {out}: the video could not be written; is the disk full?")
    write_json(record_of_video(out), {"video": out.name, **record})
    for each in others:
        os.replace(each, out.with_name(each.name))
    os.replace(part, out)
    return notes


def fps_of(path: Path) -> float:
    """Frames per second of a video file; a default for a folder or if the file does not state it."""
    return said_fps(path) or DEFAULT_FPS
