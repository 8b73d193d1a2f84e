"""What ``rsbench correct`` is given: frames of a rig, its card, the row at whose time they are wanted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsbench.cli.correct_one_camera import GyroGiven
    from rsbench.core.rig import StereoRig
    from rsbench.pipeline.correction_options import CorrectionOptions
    from rsbench.pipeline.footage import FrameSource, RigCard
    from rsbench.pipeline.frame_depth import Images

EPILOG = """[bold]Examples[/bold]

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected

  rsbench correct --left left.mp4 --right right.mp4 --rig rig.toml --out corrected --target middle

  rsbench correct l0.png r0.png l1.png r1.png --rig rig.toml --out corrected --motion-model twist

  rsbench correct data/footage/castle --out corrected     [dim](a sequence of a dataset, which knows its rig)[/dim]

RIG.toml, for images of cameras side by side (pixels, metres; without readout_ratio and scan both are found):

  baseline = 0.12
  readout_ratio = 0.8        [dim]# readout time / frame period; or shutter = "gopro-hero6-4k30", of a real
                             # camera's mode (rsbench list shutters)[/dim]
  \\[camera]
  fx = 812.3                 [dim]# focal_sigma = 8 beside it: not sure (812 +- 8), so it is found[/dim]
  fy = 812.3
  cx = 479.5
  cy = 269.5
  lens = { model = "brown-conrady", k1 = -0.2 }   [dim]# or kannala-brandt; without it: no distortion[/dim]
  k1_sigma = 0.02            [dim]# k1 = -0.2 +- 0.02, likewise[/dim]

Names: rsbench list solvers, matchers, features or correctors; a card's path ends in .toml.

DIR gets [bold]report.html[/bold] (before and after), [bold]corrected/*.png[/bold], [bold]depth/*.exr[/bold]
(of the corrected frames, metres), [bold]mask/*.png[/bold] (255 seen in the frame, 192 at a guessed depth, 128 from
the other camera, 64 from the other frame, 32 a narrow hole closed from around it, 0 seen by nobody) and
[bold]motion.json[/bold]."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What is to be corrected, and where to."""

    card: RigCard
    out: Path
    four: list[Path]
    """Left 0, right 0, left 1, right 1; or, of footage, nothing."""
    left: list[Path] | Path
    """Its images, or a folder or video."""
    right: list[Path] | Path
    gyro: GyroGiven
    row_poses: bool = False
    """Whether the pose at every row of a sequence is wanted."""

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
    gyro: GyroGiven,
    row_poses: bool = False,
) -> Given:
    """Raises RsbenchError for another combination of arguments."""
    from rsbench.core.errors import RsbenchError
    from rsbench.pipeline.footage import read_rig_card

    rendered = frames is not None and len(frames) == 1 and frames[0].is_dir()
    if out is None or (rig is None and not rendered):
        raise RsbenchError(f"--{'out' if rig is not None or rendered else 'rig'}: is required")
    if frames and rendered:
        if rig or left or right:
            raise RsbenchError(f"{frames[0]}: is a sequence, which knows its frames and rig; leave the others out")
        return _of_sequence(frames[0], out, gyro, row_poses)
    assert rig is not None
    for option, wanted in (("--row-poses", row_poses), ("--gyro", gyro.file is not None)):
        if wanted and frames:
            raise RsbenchError(f"{option}: two times have no trajectory; give --left and --right of four and more")
    card = read_rig_card(rig)
    if frames is not None and len(frames) == 4 and not (left or right):
        return Given(card=card, out=out, four=frames, left=[], right=[], gyro=gyro)
    if frames or not (left and right):
        count = f"{len(frames)} images; " if frames else ""
        raise RsbenchError(
            f"frames: {count}give LEFT_0 RIGHT_0 LEFT_1 RIGHT_1, or --left and --right, or a sequence's folder"
        )
    return Given(card=card, out=out, four=[], left=left, right=right, gyro=gyro, row_poses=row_poses)


def _of_sequence(folder: Path, out: Path, gyro: GyroGiven, row_poses: bool) -> Given:
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
    return Given(card=card, out=out, four=[], left=left, right=right, gyro=gyro, row_poses=row_poses)


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


def sized(card: RigCard, image: Any) -> StereoRig:
    """The rig with images like this one; RsbenchError where its lens cannot be one of such images."""
    from rsbench.core.errors import RsbenchError

    height, width = image.shape[:2]
    try:
        return card.rig(width, height)
    except ValueError as error:
        raise RsbenchError(f"--rig: of images of {width} x {height} pixels: {error}") from error


def with_found_camera(
    card: RigCard, rig: StereoRig, windows: Iterable[Images], options: CorrectionOptions
) -> tuple[StereoRig, str]:
    """The rig with the focal length and k1 that frames show, where its card is not sure; and words, else empty."""
    from rsbench.cli.console import progress_bar
    from rsbench.pipeline.found_camera import camera_of_frames

    sigma = card.camera.sigma
    if not sigma:
        return rig, ""
    with progress_bar("looking at the calibration", 1) as advance:
        found = camera_of_frames(windows, rig, sigma, options, card.readout_ratio, card.scanning)
        advance("")
    return found.rig, found.words(rig, sigma)
