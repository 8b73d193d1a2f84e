"""The input of ``rsbench correct``: frames of a rig, its card, a gyroscope's log and the target row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsbench.core.rig import StereoRig
    from rsbench.core.so3 import FloatArray
    from rsbench.interop.readers.rig_files import Readout
    from rsbench.pipeline.footage import FrameSource, RigCard

_MOST = 1e9

EPILOG = """[bold]Examples[/bold]

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected

  rsbench correct --left left.mp4 --right right.mp4 --rig rig.toml --out corrected --target middle

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected --motion-model twist

  rsbench correct data/footage/castle --out corrected     [dim](a sequence of a dataset, which knows its rig)[/dim]

RIG is a calibration of Kalibr, OpenCV, ROS, ZED, DepthAI, RealSense, COLMAP, Basalt or OpenVINS as it is, a file
or a folder of files that belong together ([bold]rsbench rig RIG[/bold] shows what is understood), or rig.toml,
here of two equal aligned cameras (pixels, metres; without readout_ratio and scan both are found):

  baseline = 0.12
  readout_ratio = 0.8        [dim]# readout time / frame period; or shutter = "gopro-hero6-4k30", of a real
                             # camera's mode (rsbench list shutters)[/dim]
  \\[camera]
  fx = 812.3                 [dim]# focal_sigma = 8 beside it: not sure (812 +- 8), so it is found[/dim]
  fy = 812.3
  cx = 479.5
  cy = 269.5
  lens = { model = "brown-conrady", k1 = -0.2 }   [dim]# or kannala-brandt, rational, double-sphere[/dim]
  k1_sigma = 0.02            [dim]# k1 = -0.2 +- 0.02, likewise[/dim]

Names: rsbench list solvers, matchers, features or correctors; a card's path ends in .toml.

DIR gets [bold]report.html[/bold] (before and after), [bold]corrected/*.png[/bold], [bold]depth/*.exr[/bold]
(of the corrected frames, metres), [bold]mask/*.png[/bold] (255 seen in the frame, 192 at a guessed depth, 128 from
the other camera, 64 from the other frame, 32 a narrow hole closed from around it, 0 seen by nobody) and
[bold]motion.json[/bold]."""


@dataclass(frozen=True, kw_only=True)
class GyroscopeOptions:
    """The options of a gyroscope."""

    file: Path | None
    fps: float | None
    offset_s: float | None

    def __post_init__(self) -> None:
        from rsbench.core.errors import RsbenchError

        if self.file is None and self.offset_s is not None:
            raise RsbenchError("--gyro-offset: needs --gyro, a gyroscope's log")

    def samples(self, source: FrameSource) -> FloatArray | None:
        """(n, 4) tau, w; None without a log.

        Raises:
            RsbenchError: a log that cannot be read, is of another time, or frames without a known rate.
        """
        from rsbench.core.errors import RsbenchError
        from rsbench.interop.readers.gyro_log import read_gyro_log

        if self.file is None:
            return None
        fps, offset_s = self._fps(source), self.offset_s or 0.0
        if not abs(offset_s) < _MOST:
            raise RsbenchError(f"--gyro-offset {offset_s:g}: must lie within {_MOST:g} seconds")
        samples = read_gyro_log(self.file).samples(fps, offset_s)
        last = max(source.count, 2)
        if samples[-1, 0] <= 0.0 or samples[0, 0] >= last:
            raise RsbenchError(
                f"{self.file}: lasts from {samples[0, 0] / fps:.3g} to {samples[-1, 0] / fps:.3g} s after the "
                f"first frame, and the frames {last / fps:.3g} s: give --gyro-offset"
            )
        return samples

    def farthest(self, source: FrameSource) -> float:
        """Frame periods within which its clock may be off; 0 where the offset is given."""
        from rsbench.pipeline.mono_gyro import FARTHEST_S

        return FARTHEST_S * self._fps(source) if self.offset_s is None else 0.0

    def _fps(self, source: FrameSource) -> float:
        """Raises RsbenchError where neither `--fps` nor the video gives it."""
        from rsbench.core.errors import RsbenchError
        from rsbench.dataset.corrected_frames import said_fps

        fps = said_fps(source.path) if self.fps is None else self.fps
        if fps is None:
            raise RsbenchError("--fps: is required with --gyro and images, which have no frame rate")
        if not 0.0 < fps < _MOST:
            raise RsbenchError(f"--fps {fps:g}: must lie in (0, {_MOST:g})")
        return fps


@dataclass(frozen=True, kw_only=True)
class ReadoutOptions:
    """The options of a readout, in place of what the file of a rig or camera says."""

    readout_ratio: float | None
    shutter: str | None
    fps: float | None

    @property
    def any(self) -> bool:
        """Whether the user gave one that is about the readout alone."""
        return self.readout_ratio is not None or self.shutter is not None

    def beside(self, path: Path | None, gyro: bool, footage: Path | None) -> Readout:
        """What they say beside this file, with the rate of a video where seconds need one.

        Raises:
            RsbenchError: options that exclude each other, or ``--fps`` that nothing needs.
        """
        from rsbench.core.errors import RsbenchError
        from rsbench.dataset.corrected_frames import said_fps
        from rsbench.interop.readers.rig_files import Readout

        tables = path is None or path.suffix == ".toml"
        if tables and not gyro and self.fps is not None and self.shutter is None:
            raise RsbenchError("--fps: needs --gyro or --shutter; a .toml file says its own seconds")
        fps = self.fps if not tables or self.shutter is not None else None
        if fps is None and footage is not None and not tables:
            fps = said_fps(footage)
        return Readout(readout_ratio=self.readout_ratio, shutter=self.shutter, fps=fps)


def size_of(frames: list[Path] | Path) -> Callable[[], tuple[int, int]]:
    """A function that gives the (width, height) of the first of some frames, a folder's or a video's."""

    def size() -> tuple[int, int]:
        from rsbench.pipeline.footage import FrameSource

        source = FrameSource.of_files(frames) if isinstance(frames, list) else FrameSource(frames)
        height, width = next(iter(source)).shape[:2]
        return width, height

    return size


def say_notes(option: str, notes: tuple[str, ...]) -> None:
    """What was assumed of a calibration, a line each, on stderr."""
    from rsbench.cli.console import echo

    for note in notes:
        echo(f"rsbench: note: {option}: {note}", err=True)


@dataclass(frozen=True, kw_only=True)
class RigInput:
    """What is to be corrected, and where to."""

    card: RigCard
    out: Path
    four: list[Path]
    """Left 0, right 0, left 1, right 1; or, of footage, nothing."""
    left: list[Path] | Path
    """Its images, or a folder or video."""
    right: list[Path] | Path
    gyro: GyroscopeOptions
    row_poses: bool = False
    """Whether the pose at every row of a sequence is wanted."""
    rectify: bool = False
    """Whether rectified pairs are wanted too."""

    def footage(self) -> tuple[FrameSource, FrameSource]:
        """Of the left and the right camera."""
        from rsbench.pipeline.footage import FrameSource

        left, right = (
            FrameSource.of_files(each) if isinstance(each, list) else FrameSource(each)
            for each in (self.left, self.right)
        )
        return left, right


def given_frames(
    frames: list[Path] | None,
    rig: Path | None,
    out: Path | None,
    left: Path | None,
    right: Path | None,
    gyro: GyroscopeOptions,
    readout: ReadoutOptions,
    row_poses: bool = False,
) -> RigInput:
    """Raises RsbenchError for another combination of arguments."""
    from rsbench.core.errors import RsbenchError
    from rsbench.interop.readers.rig_files import read_rig_file

    rendered = frames is not None and len(frames) == 1 and frames[0].is_dir()
    if out is None or (rig is None and not rendered):
        raise RsbenchError(f"--{'out' if rig is not None or rendered else 'rig'}: is required")
    if frames and rendered:
        if rig or left or right or readout.any:
            raise RsbenchError(f"{frames[0]}: is a sequence, which knows its frames and rig; leave the others out")
        return _of_sequence(frames[0], out, gyro, row_poses)
    assert rig is not None
    for option, wanted in (("--row-poses", row_poses), ("--gyro", gyro.file is not None)):
        if wanted and frames:
            raise RsbenchError(f"{option}: two times have no trajectory; give --left and --right of four and more")
    said = readout.beside(rig, gyro.file is not None, left)
    card, notes = read_rig_file(rig, said, size_of(frames or left or []))
    say_notes("--rig", notes)
    if frames is not None and len(frames) == 4 and not (left or right):
        return RigInput(card=card, out=out, four=frames, left=[], right=[], gyro=gyro)
    if frames or not (left and right):
        count = f"{len(frames)} images; " if frames else ""
        raise RsbenchError(
            f"frames: {count}give LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, or --left and --right, or a sequence's folder"
        )
    return RigInput(card=card, out=out, four=[], left=left, right=right, gyro=gyro, row_poses=row_poses)


def _of_sequence(folder: Path, out: Path, gyro: GyroscopeOptions, row_poses: bool) -> RigInput:
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
    if gyro.file is not None and gyro.fps is None:
        gyro = replace(gyro, fps=1.0 / sequence.frame_period_s)
    return RigInput(card=card, out=out, four=[], left=left, right=right, gyro=gyro, row_poses=row_poses)


def target_row(target: str, height: int) -> float:
    """The row that ``--target`` names; RsbenchError where there is none."""
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


def sized(card: RigCard, left: Any, right: Any) -> StereoRig:
    """The rig with images like these two; RsbenchError where its cameras cannot be of such images."""
    from rsbench.core.errors import RsbenchError

    sizes = [(image.shape[1], image.shape[0]) for image in (left, right)]
    try:
        return card.rig(*sizes)
    except ValueError as error:
        words = " and ".join(dict.fromkeys(f"{width} x {height}" for width, height in sizes))
        raise RsbenchError(f"--rig: of images of {words} pixels: {error}") from error
