"""One sequence on disk: what it is (sequence.json) and its images, depth maps and row poses, read on demand."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.cards import parse_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, VIEWS, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channel_reader import ChannelReader
from rsbench.dataset.channels import CHANNELS, channel_files, check_channels
from rsbench.dataset.files import read_depth, read_json, read_png, read_poses
from rsbench.dataset.imu import Imu
from rsbench.dataset.matches import Matching
from rsbench.errors import RsbenchError
from rsbench.motions import motion_record, read_motion
from rsbench.reading import check_name, check_size, inside
from rsbench.renderers.electrons import Sensor

FORMAT = 1
CONVENTIONS, WITH_LENS = 1, 2
"""Of pixels and times. Those of a lens, another scan or a late right camera are others, which earlier versions of
rsbench, that would take them for ideal, refuse to read."""
UNITS = {"length": "m", "angle": "rad", "time": "frame period", "depth": "m, 0 = no surface"}
"""What dataset.json tells people who find the folder."""
FRAMES = (0, 1)
Shutter = Literal["rs", "gs"]
SHUTTERS: tuple[Shutter, Shutter] = ("rs", "gs")

RELATIVE_FILES = tuple(
    f"{folder}/{side}_{frame}.{suffix}"
    for folder, suffix in (
        ("rs", "png"),
        ("rs_depth", "exr"),
        ("gs", "png"),
        ("gs_depth", "exr"),
        ("poses", "csv"),
    )
    for side in SIDES
    for frame in FRAMES
)
CLEAN_FILES = tuple(f"rs_clean/{side}_{frame}.png" for side in SIDES for frame in FRAMES)
"""Only where a sensor is not ideal: the rolling-shutter frames that an ideal one would have seen."""
_MOST_WHOLE_FRAMES = 1 << 14
"""Of one camera and time: a number in a manifest must not ask for a list of millions."""
_STACK = re.compile(r"gs_stack/(left|right)_[01]/[0-9]{4,}\.png")
_TWIN = re.compile(r"gs_twin(|_depth|_flow|_flow_mask)/[0-9]{4,}/(left|right)_[01]\.(png|exr)")
MOST_TWINS = 64


def is_of_sequence(name: str) -> bool:
    """Whether a path below a sequence's folder is one that rsbench writes."""
    known = ("sequence.json", *RELATIVE_FILES, *CLEAN_FILES, *channel_files(CHANNELS))
    return name in known or any(form.fullmatch(name) for form in (_STACK, _TWIN))


def picture_file(shutter: Shutter, side: str, frame: int, row: int = 0, depth: bool = False) -> str:
    """Below the folder of a sequence; ``row``: of a global-shutter twin, counted as rows are read."""
    folder = f"{'gs_twin' if row else shutter}{'_depth' if depth else ''}"
    return f"{folder}{f'/{row:04d}' if row else ''}/{side}_{frame}.{'exr' if depth else 'png'}"


def twins_of(manifest: Mapping[str, Any]) -> tuple[int, ...]:
    """Rows of the global-shutter twins beside that of row 0, by a sequence.json; none where it lists none."""
    rows = manifest.get("twins")
    listed = rows if isinstance(rows, list) and len(rows) <= MOST_TWINS else []
    return tuple(row for row in listed if isinstance(row, int) and not isinstance(row, bool) and row > 0)


def files_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Paths that a sequence must have, by its sequence.json."""
    clean = CLEAN_FILES if manifest.get("sensor") else ()
    stacks = tuple(
        stack_file(side, frame, row) for side in SIDES for frame in FRAMES for row in range(whole_frames(manifest))
    )
    rows = twins_of(manifest)
    pictures = [("gs", *view, row, depth) for row in rows for depth in (False, True) for view in VIEWS]
    twins = tuple(picture_file(*each) for each in pictures)  # type: ignore[arg-type]
    return RELATIVE_FILES + clean + stacks + twins + channel_files(channels_of(manifest), rows)


def stack_file(side: Side, frame: int, row: int) -> str:
    """The whole global-shutter image at a row's pose, where a dataset keeps those."""
    return f"gs_stack/{side}_{frame}/{row:04d}.png"


def whole_frames(manifest: Mapping[str, Any]) -> int:
    """How many whole frames each camera has at each time, by a sequence.json: one for each row, or none."""
    renderer, camera = manifest.get("renderer"), manifest.get("camera")
    if not (isinstance(renderer, dict) and renderer.get("full_frames") is True and isinstance(camera, dict)):
        return 0
    height = camera.get("height")
    if any(manifest.get(key) in ("left", "right") for key in ("scan", "right_scan")):
        return 0  # its lines are columns
    return height if isinstance(height, int) and 0 < height <= _MOST_WHOLE_FRAMES else 0


def channels_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the channels that a sequence.json lists, unknown ones too; what is no list of names has none."""
    names = manifest.get("channels")
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()


Vector = tuple[float, float, float]
M = TypeVar("M")


def conventions_of(camera: PinholeCamera, plain: bool) -> int:
    """The conventions of such cameras; ``plain``: both read rows from the top at once."""
    return CONVENTIONS if plain and camera.lens is None else WITH_LENS


@dataclass(frozen=True, kw_only=True)
class MotionManifest:
    """A motion as ``motions.motion_record`` writes it."""

    model: str
    w: Vector
    d: Vector
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class SequenceManifest(Scanning):
    """What sequence.json must hold; it holds more."""

    format: int
    conventions: int
    name: str
    camera: PinholeCamera
    baseline: float
    readout_ratio: float
    frame_period_s: float
    readout_time_s: float
    row_time_s: float
    motion: MotionManifest
    sensor: Sensor | None = None
    imu: Imu | None = None
    matches: Matching | None = None
    twins: tuple[int, ...] = ()
    channels: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    """sha256 by the path below the sequence's folder."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if self.conventions != (needed := conventions_of(self.camera, self.plain)):
            raise ValueError(
                f"conventions = {self.conventions}: {needed} is needed; this version reads {CONVENTIONS}, and "
                f"{WITH_LENS} with a lens, another scan or a late camera"
            )
        check_size("camera", (self.camera.width, self.camera.height))
        check_channels(self.channels, self.camera.lens is not None, self.plain)
        lines = self.camera.height if self.scan in ("top", "bottom") else self.camera.width
        if (
            list(self.twins) != sorted({row for row in self.twins if 0 < row < lines})
            or len(self.twins) > MOST_TWINS
        ):
            raise ValueError(f"twins = {list(self.twins)}: must grow from 1 to {lines - 1}, {MOST_TWINS} at most")
        if not self.frame_period_s > 0.0:
            raise ValueError(f"frame_period_s = {self.frame_period_s}: must be positive")


@dataclass(frozen=True, kw_only=True)
class FileManifest:
    """One file, as dataset.json lists it."""

    sha256: str
    size: int
    """Bytes."""


@dataclass(frozen=True, kw_only=True)
class DatasetManifest:
    """What dataset.json must hold; it holds more."""

    format: int
    sequences: tuple[str, ...]
    files: dict[str, FileManifest]
    """By the path below the dataset's folder."""
    name: str = ""
    card: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.sequences:
            raise ValueError("sequences = []: must name one at least")
        for name, count in Counter(self.sequences).items():
            check_name(name)
            if count > 1:
                raise ValueError(f"sequences: {name!r} stands there twice")


@dataclass(frozen=True, kw_only=True)
class Sequence(ChannelReader):
    """A sequence folder of format 1; frames 0 and 1, sides left and right."""

    folder: Path
    name: str
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    frame_period_s: float
    sensor: Sensor | None = None
    """Of the rolling-shutter frames; None: an ideal one's."""
    imu: Imu | None = None
    """Of the channel ``imu``."""
    matching: Matching | None = None
    """Of the channel ``matches``."""
    twins: tuple[int, ...] = ()
    """Rows, counted as they are read, from whose poses there are global-shutter twins beside those of row 0."""
    channels: tuple[str, ...] = ()
    """Names of those that it has beside images, depth and poses; later versions know more."""
    manifest: dict[str, Any]
    """Content of sequence.json."""

    @property
    def uncorrectable(self) -> str:
        """Why stereo matchers and correctors do not take such cameras; empty when they do."""
        if not self.shutter.rows_together:
            return (
                "depth and correction take cameras that read each row at once, from the top or the bottom, and no "
                "other scan yet"
            )
        return ""

    def image(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB; ``gs`` is the global-shutter image at the pose of a row: 0, or one of ``twins``."""
        return read_png(inside(self.folder, picture_file(shutter, side, frame, row)), self._size)

    def clean_image(self, side: Side, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB: the rolling-shutter frame of an ideal sensor, sharp and without noise."""
        kind = "rs" if self.sensor is None else "rs_clean"
        return read_png(inside(self.folder, f"{kind}/{side}_{frame}.png"), self._size)

    def images(self, shutter: Shutter = "rs") -> list[NDArray[np.uint8]]:
        """Left 0, right 0, left 1, right 1: the order of ``rsbench.match`` and ``rsbench.correct``."""
        return [self.image(shutter, side, frame) for frame in FRAMES for side in SIDES]

    def depth(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.float32]:
        """(H, W) z in the camera of the row that saw the pixel, m, 0 = no surface; ``row`` as of ``image``."""
        return read_depth(inside(self.folder, picture_file(shutter, side, frame, row, depth=True)), self._size)

    def poses(self, side: Side, frame: int) -> tuple[FloatArray, Pose]:
        """Row times (H,) and ``cam_from_world`` (H, 3, 3), (H, 3) as stored; of columns, where those are read."""
        path = inside(self.folder, f"poses/{side}_{frame}.csv")
        tau, poses = read_poses(path)
        if len(tau) != (lines := self.shutter.lines(side)):
            raise RsbenchError(f"{path}: has {len(tau)} rows, the camera has {lines}")
        return tau, poses


def sequence_manifest(
    *, name: str, rig: StereoRig, shutter: RollingShutter, motion: Motion, frame_period_s: float
) -> dict[str, Any]:
    """The geometric part of sequence.json, with units in the names where they are not metres and radians."""
    camera = rig.camera
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    readout_s = shutter.readout_ratio * frame_period_s
    lens = {} if camera.lens is None else {"lens": asdict(camera.lens)}
    return {
        "format": FORMAT,
        "conventions": conventions_of(camera, shutter.plain),
        "name": name,
        "camera": {field: getattr(camera, field) for field in fields} | lens,
        "baseline": rig.baseline,
        "readout_ratio": shutter.readout_ratio,
        "frame_period_s": frame_period_s,
        "readout_time_s": readout_s,
        "row_time_s": readout_s / shutter.lines("left"),
        "motion": motion_record(motion),
    } | ({} if shutter.plain else asdict(shutter.scanning))


def read_sequence(folder: Path) -> Sequence:
    """Open a sequence folder.

    Raises:
        RsbenchError: no sequence.json, a format of another version, a field that is missing or wrong, or a name
            that is not the folder's.
    """
    path = inside(folder, "sequence.json")
    content = read_json(path)
    manifest = _parsed(SequenceManifest, content, path)
    if manifest.name != (is_named := os.path.basename(os.path.abspath(folder))):
        raise RsbenchError(f"{path}: name = {manifest.name!r}: must be the name of its folder, {is_named!r}")
    try:
        return Sequence(
            folder=folder,
            name=manifest.name,
            rig=StereoRig(camera=manifest.camera, baseline=manifest.baseline),
            shutter=manifest.shutter_of(manifest.camera.width, manifest.camera.height, manifest.readout_ratio),
            motion=read_motion(content["motion"]),
            frame_period_s=manifest.frame_period_s,
            sensor=manifest.sensor,
            imu=manifest.imu,
            matching=manifest.matches,
            twins=manifest.twins,
            channels=manifest.channels,
            manifest=content,
        )
    except (ValueError, RsbenchError) as error:
        raise RsbenchError(f"{path}: {error}") from error


def read_dataset(folder: Path) -> list[Sequence]:
    """All sequences that dataset.json names, in its order.

    Raises:
        RsbenchError: not a finished dataset, or a sequence that cannot be read.
    """
    return [read_sequence(inside(folder, name)) for name in read_dataset_manifest(folder).sequences]


def read_dataset_manifest(folder: Path) -> DatasetManifest:
    """The dataset.json of a folder.

    Raises:
        RsbenchError: not a finished dataset, a format of another version, or a field that is missing or wrong.
    """
    path = inside(folder, "dataset.json")
    if not path.is_file():
        raise RsbenchError(
            f"{folder}: not a dataset (no dataset.json); make one with: rsbench generate CARD --out DIR"
        )
    return _parsed(DatasetManifest, read_json(path), path)


def _parsed(cls: type[M], content: dict[str, Any], path: Path) -> M:
    if content.get("format") != FORMAT:
        raise RsbenchError(f"{path}: format = {content.get('format')!r}; this version reads {FORMAT}")
    return parse_card(cls, content, str(path), extra="ignore")
