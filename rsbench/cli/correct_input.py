"""The input of ``rsbench correct``: frames of a rig, its card, a gyroscope's log and the target row.

Slow imports are inside functions, so that a wrong command line is refused at once.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rsbench.cli.console import echo
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.rig import SIDES
from rsbench.pipeline.footage import IMAGE_SUFFIXES, FrameSource, OneCameraCard, Part, RigCard, rig_card_of
from rsbench.storage.files import check_out as can_be_written
from rsbench.storage.videos import said_fps, written_as_video

if TYPE_CHECKING:
    from rsbench.dataset.sequence import Sequence
    from rsbench.interop.readers.rig_files import Readout
    from rsbench.pipeline.sequence_capture import Gyroscope

_MOST = 1e9
_SAME_RATE = 0.01
"""Relative difference of frame rates that are taken as equal, such as 29.97 and 30."""


@dataclass(frozen=True, kw_only=True)
class GyroscopeOptions:
    """Options of a gyroscope."""

    file: Path | None
    fps: float | None
    offset_s: float | None

    def __post_init__(self) -> None:
        if self.file is None and self.offset_s is not None:
            raise RsbenchError("--gyro-offset: needs --gyro, a gyroscope's log")

    def read(self, source: FrameSource, one_camera: bool) -> Gyroscope | None:
        """Read the samples, and determine the largest error of their clock; None without a log.

        Raises:
            RsbenchError: the log cannot be read or does not overlap the frames, or the frame rate is unknown.
        """
        if self.file is None:
            return None
        period = source.timeline.period_s if one_camera else None
        fps, offset_s = self._fps(source, None if period is None else 1.0 / period), self.offset_s or 0.0
        if not abs(offset_s) < _MOST:
            raise RsbenchError(f"--gyro-offset {offset_s:g}: must lie within {_MOST:g} seconds")
        from rsbench.interop.readers.gyro_log import read_gyro_log
        from rsbench.pipeline.mono_gyro import FARTHEST_S
        from rsbench.pipeline.sequence_capture import Gyroscope

        samples = read_gyro_log(self.file).samples(fps, offset_s)
        last = max(source.count, 2)
        if samples[-1, 0] <= 0.0 or samples[0, 0] >= last:
            raise RsbenchError(
                f"{self.file}: lasts from {samples[0, 0] / fps:.3g} to {samples[-1, 0] / fps:.3g} s after the "
                f"first frame, and the frames {last / fps:.3g} s: give --gyro-offset"
            )
        unsure = one_camera and self.offset_s is None
        return Gyroscope(samples=samples, clock_error=FARTHEST_S * fps if unsure else 0.0)

    def _fps(self, source: FrameSource, rate: float | None) -> float:
        """Return ``--fps``, or the rate from the frames' times; RsbenchError if there is none."""
        fps = (rate or said_fps(source.path)) if self.fps is None else self.fps
        if fps is None:
            raise RsbenchError("--fps: is required with --gyro and images, which have no frame rate")
        if not 0.0 < fps < _MOST:
            raise RsbenchError(f"--fps {fps:g}: must lie in (0, {_MOST:g})")
        return fps


@dataclass(frozen=True, kw_only=True)
class ReadoutOptions:
    """Options of the readout, which replace values in the file of a rig or camera."""

    readout_ratio: float | None
    shutter: str | None
    fps: float | None

    @property
    def any(self) -> bool:
        """Whether the user gave ``--readout-ratio`` or ``--shutter``."""
        return self.readout_ratio is not None or self.shutter is not None

    def beside(self, path: Path | None, gyro: bool, footage: Path | None) -> Readout:
        """Return the options for reading the file ``path``, with the rate of a video if times in seconds need one.

        Raises:
            RsbenchError: options exclude each other, or ``--fps`` has no effect.
        """
        from rsbench.interop.readers.rig_files import Readout

        tables = path is None or path.suffix == ".toml"
        if tables and not gyro and self.fps is not None and self.shutter is None:
            raise RsbenchError("--fps: needs --gyro or --shutter; a .toml file has frame_period_s instead")
        fps = self.fps if not tables or self.shutter is not None else None
        if fps is None and footage is not None and not tables:
            fps = said_fps(footage)
        return Readout(readout_ratio=self.readout_ratio, shutter=self.shutter, fps=fps)


def size_of(frames: list[Path] | Path, part: Part = "whole") -> Callable[[], tuple[int, int]]:
    """Return a function that returns the (width, height) of the first frame of images, a folder or a video."""

    def size() -> tuple[int, int]:
        height, width = next(iter(frame_source(frames, part))).shape[:2]
        return width, height

    return size


def frame_source(frames: list[Path] | Path, part: Part = "whole") -> FrameSource:
    """Return the frames of a list of images, a folder or a video."""
    return FrameSource.of_files(frames) if isinstance(frames, list) else FrameSource(frames, part)


def say_notes(option: str, notes: tuple[str, ...]) -> None:
    """Print the assumptions about a calibration to stderr, one line each."""
    for note in notes:
        echo(f"rsbench: note: {option}: {note}", err=True)


@dataclass(frozen=True, kw_only=True)
class Arranged:
    """The input files of a command line, of one camera or of a rig."""

    one_camera: bool
    frames: list[Path] | None
    """Images, or the folder of a rendered sequence."""
    left: Path | None
    """Folder or video of the left camera, or of the only one."""
    right: Path | None
    words: str = ""
    """The assumption, and the option that changes it; empty if there is none."""


def is_rendered(folder: Path) -> bool:
    """Return whether a folder is a dataset or one of its sequences."""
    return any((folder / name).is_file() for name in ("dataset.json", "sequence.json"))


def arranged(
    frames: list[Path] | None,
    rig: Path | None,
    camera: Path | None,
    footage: Path | None,
    left: Path | None,
    right: Path | None,
    side_by_side: bool,
) -> Arranged:
    """Determine what the given files are; without a rig, they are frames of one camera.

    Raises:
        RsbenchError: files do not exist or do not belong together.
    """
    files = frames or []
    for path in files:
        if not path.exists():
            raise RsbenchError(f"{path}: does not exist{_nearest(path)}")
    films = [path for path in files if path.is_dir() or not _is_image(path)]
    if camera is not None or footage is not None:
        if (footage is None) == (not files):
            raise RsbenchError("frames: with --camera give FRAME_0 FRAME_1 and so on, or --frames DIR|VIDEO")
        if films and len(files) > 1:
            raise RsbenchError(f"{films[0]}: one camera has one video or folder; give it alone")
        return Arranged(
            one_camera=True, frames=None if films else frames, left=films[0] if films else footage, right=None
        )
    if left is not None or right is not None or (len(files) == 1 and is_rendered(files[0])):
        return Arranged(one_camera=False, frames=frames, left=left, right=right)
    if not files:
        raise RsbenchError("frames: give a video, a folder or images of one camera; or those of a rig, with --rig")
    if films:
        return _arranged_films(films, files, rig, side_by_side)
    return _arranged_images(files, rig)


def _arranged_films(films: list[Path], files: list[Path], rig: Path | None, side_by_side: bool) -> Arranged:
    kind, rigged = "folder" if films[0].is_dir() else "video", rig is not None
    if len(films) < len(files) or len(films) > 2 or (side_by_side and len(films) == 2):
        raise RsbenchError(
            f"frames: {len(files)} inputs; give one {kind} of one camera, or two of a rig with --rig"
        )
    if side_by_side and not rigged:
        raise RsbenchError("--rig: is required with --side-by-side: the calibration of both cameras")
    if len(films) == 1 and rigged and not side_by_side:
        raise RsbenchError(
            f"{films[0]}: one {kind}, but --rig describes two cameras: add --side-by-side if each frame shows "
            "both, or give two; for one camera leave --rig out"
        )
    if len(films) == 2 and not rigged:
        raise RsbenchError(
            f"--rig: is required with two {kind}s, which are taken as the left and the right camera of a rig; "
            "correct those of one camera one by one"
        )
    if rigged:
        right = None if side_by_side else films[1]
        return Arranged(one_camera=False, frames=None, left=films[0], right=right)
    words = f"one {kind}: taken as one camera's (a rig: give two and --rig, or --side-by-side and --rig)"
    return Arranged(one_camera=True, frames=None, left=films[0], right=None, words=words)


def _arranged_images(files: list[Path], rig: Path | None) -> Arranged:
    if len(files) == 1:
        raise RsbenchError(
            f"{files[0]}: one image does not show how its camera moved; give two, a folder or a video"
        )
    if rig is not None:
        return Arranged(one_camera=False, frames=files, left=None, right=None)
    if len(files) == 4:
        raise RsbenchError(
            "--rig: is required with four images, which are taken as LEFT_0 RIGHT_0 LEFT_1 RIGHT_1 of a rig; "
            "of one camera give their folder by --frames, or --camera"
        )
    words = f"{len(files)} images: taken as one camera's, in this order (four of a rig: give --rig)"
    return Arranged(one_camera=True, frames=files, left=None, right=None, words=words)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES


def _nearest(path: Path) -> str:
    """Return similar names in the folder of a path, for a message."""
    folder = path.parent
    names = sorted(each.name for each in folder.iterdir()) if folder.is_dir() else []
    near = difflib.get_close_matches(path.name, names, 3)
    return f"; nearest here: {', '.join(near)}" if near else ""


def default_out(path: Path) -> Path:
    """Return the default output: a video in the current folder for a file, otherwise a folder."""
    return Path(f"{path.stem}-corrected.mp4" if path.is_file() else f"{path.resolve().name}-corrected")


def check_out(out: Path) -> None:
    """Check before the work begins that the results can be written to ``out``.

    Raises:
        RsbenchError: the name is that of an image or an unsupported video, a file is in place of a folder, or the
            folder is not writable.
    """
    video = written_as_video(out)
    if _is_image(out):
        raise RsbenchError(f"--out {out}: several frames are no image; give a folder, or a video (.mp4)")
    place = out.resolve().parent if video else out.resolve()
    there = next(folder for folder in (place, *place.parents) if folder.exists())
    if not there.is_dir():
        raise RsbenchError(f"--out {out}: {there} is a file, not a folder; choose another place")
    can_be_written(place)


@dataclass(frozen=True, kw_only=True)
class CorrectInput:
    """The frames to correct, their calibration, and the place of the results."""

    card: RigCard | OneCameraCard
    out: Path
    four: list[Path] = field(default_factory=list)
    """Images left 0, right 0, left 1, right 1; empty for a sequence."""
    footage: list[list[Path] | Path] = field(default_factory=list)
    """Images, folder or video of the left and the right camera, or of the only camera."""
    words: str = ""
    """The assumption about the files; empty if there is none."""
    gyro: GyroscopeOptions
    side_by_side: bool = False
    """Whether each frame of one video or folder has the images of both cameras side by side."""
    row_poses: bool = False
    """Whether to write the pose at every row of a sequence."""
    rectify: bool = False
    """Whether to write rectified pairs too."""

    @property
    def one_camera(self) -> bool:
        """Whether one camera took all frames."""
        return len(self.footage) == 1

    @property
    def video(self) -> bool:
        """Whether the result is a video."""
        return written_as_video(self.out)

    @property
    def page(self) -> Path:
        """Path of the HTML report."""
        from rsbench.dataset.corrected_frames import page_of_video

        return page_of_video(self.out) if self.video else self.out / "report.html"

    def sources(self) -> list[FrameSource]:
        """Return the frames of each camera."""
        parts: tuple[Part, ...] = SIDES if self.side_by_side else ("whole",) * len(self.footage)
        return [frame_source(each, part) for each, part in zip(self.footage, parts, strict=True)]


def given_camera(
    given: Arranged,
    camera: Path | None,
    fov: float | None,
    out: Path,
    gyro: GyroscopeOptions,
    readout: ReadoutOptions,
) -> CorrectInput:
    """Return the input of one camera; RsbenchError for options that exclude each other."""
    from rsbench.interop.readers.rig_files import read_camera_file

    files: list[Path] | Path = given.frames if given.frames is not None else given.left or Path()
    source = frame_source(files)
    stated = readout.beside(camera, gyro.file is not None, source.path)
    card, notes = read_camera_file(camera, stated, size_of(files))
    say_notes("--camera", notes)
    if fov is not None:
        if not card.focal_unknown:
            raise RsbenchError("--fov: leave it out; the camera's file gives the focal length")
        with naming("--fov"):
            card = replace(card, fov_deg=fov)
    _warn_of_other_rate(card, source, gyro.fps)
    return CorrectInput(card=card, out=out, footage=[files], words=given.words, gyro=gyro)


def _warn_of_other_rate(card: OneCameraCard, source: FrameSource, fps_option: float | None) -> None:
    """Warn if the card's readout ratio assumes another frame rate than the frames have."""
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


def given_frames(
    given: Arranged,
    rig: Path | None,
    out: Path,
    gyro: GyroscopeOptions,
    readout: ReadoutOptions,
    row_poses: bool,
    side_by_side: bool,
) -> CorrectInput:
    """Return the input of a rig; RsbenchError for options that exclude each other or are missing."""
    frames, left, right = given.frames, given.left, given.right
    if frames is not None and len(frames) == 1 and is_rendered(frames[0]):
        if rig or left or right or readout.any:
            raise RsbenchError(f"{frames[0]}: is a sequence with its own frames and rig; leave the others out")
        return _of_sequence(frames[0], out, gyro, row_poses)
    if rig is None:
        raise RsbenchError("--rig: is required")
    for option, wanted in (("--row-poses", row_poses), ("--gyro", gyro.file is not None)):
        if wanted and frames:
            raise RsbenchError(f"{option}: two frames have no trajectory; give four or more by --left and --right")
    from rsbench.interop.readers.rig_files import read_rig_file

    stated = readout.beside(rig, gyro.file is not None, left)
    card, notes = read_rig_file(rig, stated, size_of(frames or left or [], "left" if side_by_side else "whole"))
    say_notes("--rig", notes)
    if frames is not None and len(frames) == 4 and not (left or right):
        return CorrectInput(card=card, out=out, four=frames, gyro=gyro)
    if side_by_side and left and not (frames or right):  # one file with both halves
        return CorrectInput(
            card=card, out=out, footage=[left, left], gyro=gyro, row_poses=row_poses, side_by_side=True
        )
    if frames or not (left and right):
        count = f"{len(frames)} images; " if frames else ""
        raise RsbenchError(
            f"frames: {count}give LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, or --left and --right, or a sequence's folder"
        )
    return CorrectInput(card=card, out=out, footage=[left, right], gyro=gyro, row_poses=row_poses)


def _of_sequence(folder: Path, out: Path, gyro: GyroscopeOptions, row_poses: bool) -> CorrectInput:
    """Return the input for the rolling-shutter frames of a sequence of a dataset."""
    from rsbench.dataset.sequence import read_dataset_manifest, read_sequence

    if not (folder / "sequence.json").is_file():
        names = read_dataset_manifest(folder).sequences
        if len(names) > 1:
            raise RsbenchError(f"{folder}: is a dataset; give one of its sequences: {', '.join(names)}")
        folder = folder / names[0]
    sequence = read_sequence(folder)
    card = rig_card_of(sequence.rig, sequence.shutter)
    if gyro.file is not None and gyro.fps is None:
        gyro = replace(gyro, fps=1.0 / sequence.frame_period_s)
    return CorrectInput(card=card, out=out, footage=sequence_files(sequence), gyro=gyro, row_poses=row_poses)


def sequence_files(sequence: Sequence) -> list[list[Path] | Path]:
    """Return the rolling-shutter frames of the left and the right camera of a rendered sequence."""
    from rsbench.dataset.layout import picture_file

    frames = range(sequence.frames)
    return [[sequence.folder / picture_file("rs", side, frame) for frame in frames] for side in SIDES]


def target_row(target: str, height: int) -> float:
    """Return the row that ``--target`` names; RsbenchError if there is no such row."""
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
