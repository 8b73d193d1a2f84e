"""One sequence on disk: what it is (sequence.json) and its images, depth maps and row poses, read on demand."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import parse_card
from rsbench.components.motion_models import motion_record, read_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import MovingObject
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig, views_of
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import CHANNELS, OBJECTS, ChannelReader, channel_files, check_channels
from rsbench.dataset.imu import Imu
from rsbench.dataset.layout import (
    MOST_FRAMES,
    MOST_TWINS,
    SHUTTERS,
    Shutter,
    channels_of,
    clean_file,
    exposed_file,
    frames_of,
    gloss_file,
    moving_file,
    picture_file,
    relative_files,
    stack_file,
    twins_of,
    whole_frames,
)
from rsbench.dataset.matches import Matching
from rsbench.dataset.motion_cards import MovingManifest, check_moving
from rsbench.dataset.views import numbers_of
from rsbench.renderers.image import Sensor, check_brightness
from rsbench.storage.files import read_depth, read_grey_png, read_json, read_mask, read_png, read_poses
from rsbench.storage.untrusted_files import check_name, check_size, inside

FORMAT = 1
CONVENTIONS, WITH_LENS, OF_FRAMES, WITH_MOVING = 1, 2, 3, 4
"""Of pixels and times. Those of a lens, another scan or a late right camera are others, and so are those of more
than two frames, and of objects that move, whatever the cameras: earlier versions of rsbench, that would take them
for ideal, for two or for still, refuse to read them."""
UNITS = {"length": "m", "angle": "rad", "time": "frame period", "depth": "m, 0 = no surface"}
"""What dataset.json tells people who find the folder."""

Vector = tuple[float, float, float]
M = TypeVar("M")


def conventions_of(camera: PinholeCamera, plain: bool, frames: int, moves: bool = False) -> int:
    """The conventions of such cameras; ``plain``: both read rows from the top at once; ``moves``: objects do."""
    if moves:
        return WITH_MOVING
    if frames > len(FRAMES):
        return OF_FRAMES
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
    frames: int = len(FRAMES)
    readout_time_s: float
    row_time_s: float
    motion: MotionManifest
    sensor: Sensor | None = None
    imu: Imu | None = None
    matches: Matching | None = None
    twins: tuple[int, ...] = ()
    exposed_twins: bool = False
    channels: tuple[str, ...] = ()
    moving: tuple[MovingManifest, ...] = ()
    glossy: bool = False
    files: dict[str, str] = field(default_factory=dict)
    """sha256 by the path below the sequence's folder."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if not len(FRAMES) <= self.frames <= MOST_FRAMES:
            raise ValueError(f"frames = {self.frames}: must lie in [{len(FRAMES)}, {MOST_FRAMES}]")
        moves = bool(self.moving)
        if self.conventions != (needed := conventions_of(self.camera, self.plain, self.frames, moves)):
            raise ValueError(
                f"conventions = {self.conventions}: {needed} is needed; this version reads {CONVENTIONS}, and "
                f"{WITH_LENS} with a lens, another scan or a late camera, {OF_FRAMES} with more than two frames, "
                f"{WITH_MOVING} with moving objects"
            )
        check_size("camera", (self.camera.width, self.camera.height))
        check_channels(self.channels, self.camera.lens is not None, self.plain)
        check_moving(self.moving, self.channels)
        lines = self.camera.height if self.scan in ("top", "bottom") else self.camera.width
        if (
            list(self.twins) != sorted({row for row in self.twins if 0 < row < lines})
            or len(self.twins) > MOST_TWINS
        ):
            raise ValueError(f"twins = {list(self.twins)}: must grow from 1 to {lines - 1}, {MOST_TWINS} at most")
        if self.sensor is not None:
            check_brightness(self.sensor, self.frames)
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
    license: str = "CC-BY-4.0"
    """SPDX name; data of rsbench 0.1 do not say it, and are under this one."""
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
    """A sequence folder of format 1, or two successive frames of one; sides left and right, frames from 0."""

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
    exposed_twins: bool = False
    """Whether it has the global-shutter images as the sensor exposes them."""
    channels: tuple[str, ...] = ()
    """Names of those that it has beside images, depth and poses; later versions know more."""
    frames: int = len(FRAMES)
    """How many each camera has."""
    first: int = 0
    """Of a pair: frame 0 of it is this one of the folder."""
    moving: tuple[MovingManifest, ...] = ()
    """Objects that move by themselves, numbered from 1."""
    objects: tuple[MovingObject, ...] = ()
    """How they do."""
    glossy: bool = False
    """Whether its scene has glossy surfaces, which look otherwise from each place."""
    manifest: dict[str, Any]
    """Content of sequence.json."""

    def pairs(self) -> list[Sequence]:
        """Each two successive frames as a sequence of their own, such as ``castle.3`` of frames 3 and 4.

        Its world is the body at its own time 0, and its motion is the rest of it, seen from there. Of the
        channels it has those that tell of one frame or lead to another. Of two frames there is one: the sequence.
        """
        if self.frames == len(FRAMES):
            return [self]
        channels = tuple(name for name in self.channels if name in OBJECTS and OBJECTS[name].of_pairs)
        return [
            replace(
                self,
                name=f"{self.name}.{first}",
                motion=self.motion.from_time(first),
                frames=len(FRAMES),
                first=first,
                channels=channels,
                objects=self._objects_from(first),
            )
            for first in range(self.frames - 1)
        ]

    def _objects_from(self, first: int) -> tuple[MovingObject, ...]:
        body = self.motion.body_from_world(float(first))
        return tuple(each.from_time(float(first), body) for each in self.objects)

    @property
    def whole(self) -> str:
        """Name of the sequence to which a pair belongs."""
        return os.path.basename(os.path.abspath(self.folder))

    @property
    def data_model(self) -> str:
        """Name of the motion model of the whole sequence."""
        return (self.motion.motion if isinstance(self.motion, LaterMotion) else self.motion).name

    def frame_files(self, folders: Collection[str]) -> list[Path]:
        """All files of its frames in these folders, sorted."""
        ends = tuple(f"{side}_{frame + self.first}" for side, frame in views_of(self.frames))
        return sorted(path for name in folders for path in (self.folder / name).iterdir() if path.stem in ends)

    def image(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB; ``gs`` is the global-shutter image at the pose of a row: 0, or one of ``twins``."""
        return read_png(inside(self.folder, picture_file(shutter, side, frame + self.first, row)), self._size)

    def exposed_image(self, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB: what the sensor expects under a global shutter at the pose of a row, without noise.

        Raises:
            RsbenchError: the dataset has a sensor, and was made without ``exposed_twins``.
        """
        if self.sensor is None:
            return self.image("gs", side, frame, row)
        if not self.exposed_twins:
            raise RsbenchError(
                f"{self.folder}: has no global-shutter images of its sensor; render it again with "
                "exposed_twins = true in the dataset card"
            )
        return read_png(inside(self.folder, exposed_file(side, frame + self.first, row)), self._size)

    def clean_image(self, side: Side, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB: the rolling-shutter frame of an ideal sensor, sharp and without noise."""
        if self.sensor is None:
            return self.image("rs", side, frame)
        return read_png(inside(self.folder, clean_file(side, frame + self.first)), self._size)

    def images(self, shutter: Shutter = "rs") -> list[NDArray[np.uint8]]:
        """Left 0, right 0, left 1, right 1, and so on: the order of ``rsbench.match`` and ``rsbench.correct``."""
        return [self.image(shutter, side, frame) for frame in range(self.frames) for side in SIDES]

    def depth(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.float32]:
        """(H, W) z in the camera of the row that saw the pixel, m, 0 = no surface; ``row`` as of ``image``."""
        file = picture_file(shutter, side, frame + self.first, row, depth=True)
        return read_depth(inside(self.folder, file), self._size)

    def labels(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W) what moves at each pixel of a picture: the number of an object, 0 = none, and 128 more where an
        object hides the sun from what is seen; all 0 where none moves. ``row`` as of ``image``."""
        if not self.moving:
            return np.zeros(self._size[::-1], dtype=np.uint8)
        path = inside(self.folder, moving_file(shutter, side, frame + self.first, row))
        labels = read_grey_png(path, self._size)
        if np.max(numbers_of(labels)) > len(self.moving):
            raise RsbenchError(f"{path}: holds object {np.max(numbers_of(labels))}: there are {len(self.moving)}")
        return labels

    def gloss(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.bool_]:
        """(H, W) whether a pixel's surface is glossy; ``row`` as of ``image``."""
        if not self.glossy:
            return np.zeros(self._size[::-1], dtype=np.bool_)
        path = inside(self.folder, gloss_file(shutter, side, frame + self.first, row))
        return read_mask(path, self._size)

    def poses(self, side: Side, frame: int) -> tuple[FloatArray, Pose]:
        """Row times (H,) and ``cam_from_world`` (H, 3, 3), (H, 3) as stored; of columns, where those are read."""
        path = inside(self.folder, f"poses/{side}_{frame + self.first}.csv")
        tau, poses = read_poses(path)
        if len(tau) != (lines := self.shutter.lines(side)):
            raise RsbenchError(f"{path}: has {len(tau)} rows, the camera has {lines}")
        if self.first:
            whole = read_motion(self.manifest["motion"])
            poses = compose(poses, inverse(whole.body_from_world(self.first)))
        return tau - self.first, poses


def sequence_manifest(
    *,
    name: str,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    frame_period_s: float,
    frames: int = len(FRAMES),
    moves: bool = False,
) -> dict[str, Any]:
    """The geometric part of sequence.json, with units in the names where they are not metres and radians."""
    camera = rig.camera
    fields = ("width", "height", "fx", "fy", "cx", "cy")
    readout_s = shutter.readout_ratio * frame_period_s
    lens: dict[str, Any] = {} if camera.lens is None else {"lens": camera.lens.record()}
    count = {"frames": frames} if frames > len(FRAMES) else {}
    return {
        "format": FORMAT,
        "conventions": conventions_of(camera, shutter.plain, frames, moves),
        "name": name,
        "camera": {field: getattr(camera, field) for field in fields} | lens,
        "baseline": rig.baseline,
        "readout_ratio": shutter.readout_ratio,
        "frame_period_s": frame_period_s,
        "readout_time_s": readout_s,
        "row_time_s": readout_s / shutter.lines("left"),
        "motion": motion_record(motion),
        **count,
        **({} if shutter.plain else asdict(shutter.scanning)),
    }


def read_sequence(folder: Path) -> Sequence:
    """Open a sequence folder.

    Raises:
        RsbenchError: no sequence.json, a format of another version, a field that is missing or wrong, or a name
            that is not the folder's.
    """
    return sequence_of(read_json(path := inside(folder, "sequence.json")), path)


def sequence_of(content: dict[str, Any], path: Path) -> Sequence:
    """The sequence of which a sequence.json holds this; the rest as of ``read_sequence``. Opens no file."""
    folder = path.parent
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
            exposed_twins=manifest.exposed_twins,
            frames=manifest.frames,
            channels=manifest.channels,
            moving=manifest.moving,
            objects=tuple(each.thing for each in manifest.moving),
            glossy=manifest.glossy,
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


def read_pairs(folder: Path) -> list[Sequence]:
    """All pairs of successive frames of a dataset, each a sequence of two: what is scored.

    Raises:
        RsbenchError: as ``read_dataset``, or two of these have one name.
    """
    pairs = [pair for sequence in read_dataset(folder) for pair in sequence.pairs()]
    for name, count in Counter(pair.name for pair in pairs).items():
        if count > 1:
            raise RsbenchError(f"{folder}: {name!r} is a sequence and a pair of frames of another; rename it")
    return pairs


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


def files_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Paths that a sequence must have, by its sequence.json."""
    frames, rows = frames_of(manifest), twins_of(manifest)
    views = views_of(frames)
    clean = tuple(clean_file(*view) for view in views if manifest.get("sensor"))
    stacks = tuple(stack_file(*view, row) for view in views for row in range(whole_frames(manifest)))
    pictures = [("gs", *view, row, depth) for row in rows for depth in (False, True) for view in views]
    twins = tuple(picture_file(*each) for each in pictures)  # pyrefly: ignore[bad-argument-type]
    every = [("rs", *view, 0) for view in views] + [("gs", *view, row) for row in (0, *rows) for view in views]
    labels = tuple(moving_file(*each) for each in every if manifest.get("moving"))  # pyrefly: ignore[bad-argument-type]
    gloss = tuple(gloss_file(*each) for each in every if manifest.get("glossy"))  # pyrefly: ignore[bad-argument-type]
    shown = manifest.get("sensor") and manifest.get("exposed_twins") is True
    exposed = tuple(exposed_file(*view, row) for row in (0, *rows) for view in views if shown)
    own = relative_files(frames) + clean + stacks + twins + exposed + labels + gloss
    return own + channel_files(channels_of(manifest), rows, frames)


def is_of_sequence(name: str) -> bool:
    """Whether a path below a sequence's folder is one that rsbench writes."""
    first = _VIEW.sub("left_0", name)
    return first in _KNOWN or any(form.fullmatch(first) for form in (_STACK, _TWIN, _MATCHES))


_VIEW = re.compile(r"(left|right)_(0|[1-9][0-9]*)(?=[./])")
_STACK = re.compile(r"gs_stack/left_0/[0-9]{4,}\.png")
_MATCHES = re.compile(r"matches/(0|[1-9][0-9]*)\.npz")
_TWIN = re.compile(r"gs_twin(|_depth|_exposed|_flow|_flow_mask|_moving|_gloss)/[0-9]{4,}/left_0\.(png|exr)")
_KNOWN = {"sequence.json"} | {
    _VIEW.sub("left_0", name)
    for name in (
        *relative_files(1),
        clean_file("left", 0),
        exposed_file("left", 0),
        *(file(shutter, "left", 0) for file in (moving_file, gloss_file) for shutter in SHUTTERS),
        *channel_files(CHANNELS, frames=len(FRAMES) + 1),
    )
}
