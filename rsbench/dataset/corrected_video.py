"""Corrected frames as one video file, in what OpenCV's own encoders write; no codec of the system is asked for."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.dataset.corrected_frames import half_folder
from rsbench.storage.files import read_json, write_json
from rsbench.storage.work_folder import HIDDEN, remove, work_folder
from rsbench.vision.images import eight_bit

_CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}
"""By the file's ending; FFV1 loses nothing."""
DEFAULT_FPS = 30.0
"""Of frames that do not say it."""


def is_video(out: Path) -> bool:
    """Whether a video is asked for, by the ending of its name."""
    return out.suffix.lower() in _CODECS


def refuse_video(out: Path) -> None:
    """Raise RsbenchError for a name that looks like a video where frames are no video."""
    if is_video(out):
        raise RsbenchError(f"--out {out}: four images are no video; give a folder, or --left and --right")


@contextmanager
def video_place(out: Path, run: str = "") -> Iterator[Path]:
    """A folder to work in for a video ``out``, from which ``write_video`` takes its frames; kept after a kill.

    Args:
        out: the file.
        run: key of all that decides what is written, as of ``fresh_folder``; without it nothing is resumed.

    Raises:
        RsbenchError: another file of that name, which this command did not write, or the place cannot be written.
    """
    place = out.resolve()
    with work_folder(place.parent, place.with_name(f".{place.name}{HIDDEN}")) as hidden:
        _refuse_others(out)
        half = half_folder(hidden, run or secrets.token_hex())
        try:
            yield half
        except Exception:
            remove(half.parent)
            raise
        remove(half.parent)


def _refuse_others(out: Path) -> None:
    """What is to be replaced must be a video of this command, which its record lies beside."""
    record = record_of_video(out)
    if not out.exists() and not record.exists():
        return
    ours = out.is_file() and record.is_file() and read_json(record).get("video") == out.name
    if not ours:
        raise RsbenchError(f"{out}: exists and was not written by 'rsbench correct'; choose another --out")


def record_of_video(out: Path) -> Path:
    """The file beside a video that says what ``motion.json`` says of frames."""
    return out.with_suffix(".json")


def write_video(out: Path, half: Path, frames: Iterable[NDArray[Any]], fps: float, record: dict[str, Any]) -> None:
    """Write frames (H, W[, 3]) RGB or grey, uint8 or uint16, and their record beside them.

    Args:
        out: the video.
        half: a folder on the same disk, for what is not complete.
        frames: all of one size.
        fps: frames per second.
        record: what was found, for JSON.

    Raises:
        RsbenchError: OpenCV has no such encoder here, or the file cannot be written.
    """
    part = half.parent / f"part{out.suffix.lower()}"
    writer, count = None, 0
    for frame in frames:
        count += 1
        (level,) = eight_bit([frame])
        height, width = level.shape[:2]
        if writer is None:
            code = cv2.VideoWriter.fourcc(*_CODECS[out.suffix.lower()])
            writer = cv2.VideoWriter(str(part), code, fps, (width, height))
            if not writer.isOpened():
                raise RsbenchError(f"--out {out}: OpenCV cannot write such a video here; give a folder, for PNG")
        writer.write(cv2.cvtColor(level, cv2.COLOR_RGB2BGR if level.ndim == 3 else cv2.COLOR_GRAY2BGR))
    if writer is None:
        raise RsbenchError(f"--out {out}: there are no frames to write")
    writer.release()
    if not part.is_file() or cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT) != count:
        raise RsbenchError(f"--out {out}: the video could not be written; is the disk full?")
    write_json(record_of_video(out), {"video": out.name, **record})
    os.replace(part, out)


def fps_of(path: Path) -> float:
    """Frames per second of a video file; a default for a folder or where the file does not say."""
    return said_fps(path) or DEFAULT_FPS


def said_fps(path: Path) -> float | None:
    """Frames per second of a video file; None for a folder or where the file does not say."""
    if not path.is_file():
        return None
    video = cv2.VideoCapture(str(path))
    fps = float(video.get(cv2.CAP_PROP_FPS))
    video.release()
    return fps if np.isfinite(fps) and 1.0 <= fps <= 1000.0 else None
