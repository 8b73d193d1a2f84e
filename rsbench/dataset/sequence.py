"""A sequence on disk: its description (sequence.json), and images, depth maps and row poses, read on demand."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import parse_card
from rsbench.components.motion_models import motion_record, read_motion
from rsbench.components.rig_tables import CameraTable, RightFromLeft, Vector, camera_record, tables_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.geometry import MovingObject
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.rig import FRAMES, SIDES, RigCamera, Side, StereoRig, views_of
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import CHANNELS, OBJECTS, ChannelReader, channel_files, check_channels
from rsbench.dataset.clock_channels import Imu
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
from rsbench.dataset.motion_cards import MovingManifest, check_moving
from rsbench.dataset.point_channels import Matching
from rsbench.dataset.views import numbers_of
from rsbench.renderers.image import Sensor, check_brightness
from rsbench.storage.files import read_depth, read_grey_png, read_json, read_mask, read_png, read_poses
from rsbench.storage.untrusted_files import check_name, check_size, inside

FORMAT, OF_RIG = 1, 2
FORMATS = (FORMAT, OF_RIG)
"""Formats of files: 1 for the ideal rig, 2 for cameras that differ or look in different directions."""
CONVENTIONS, WITH_LENS, OF_FRAMES, WITH_MOVING = 1, 2, 3, 4
"""Numbers of conventions of pixels and times: an ideal rig; a lens, another scan or a delayed right camera; more
than two frames; moving objects. Versions without a feature thus refuse such files."""
UNITS = {"length": "m", "angle": "rad", "time": "frame period", "depth": "m, 0 = no surface"}
"""Units in dataset.json, for readers of the folder."""

M = TypeVar("M")


def check_sizes(rig: StereoRig) -> None:
    """Raise ValueError for cameras with more pixels than files may have."""
    for side in SIDES:
        check_size("camera" if rig.aligned else side, (rig.sensor(side).width, rig.sensor(side).height))


def format_of(rig: StereoRig, shutter: RollingShutter) -> int:
    """The format of files for these cameras."""
    return FORMAT if rig.aligned and shutter.right_readout_ratio is None else OF_RIG


def conventions_of(plain: bool, frames: int, moves: bool = False) -> int:
    """Number of conventions; ``plain``: rectified, rows read top down at once; ``moves``: moving objects."""
    if moves:
        return WITH_MOVING
    if frames > len(FRAMES):
        return OF_FRAMES
    return CONVENTIONS if plain else WITH_LENS


@dataclass(frozen=True, kw_only=True)
class MotionManifest:
    """A motion as ``motion_record`` writes it."""

    model: str
    w: Vector
    d: Vector
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CameraManifest(CameraTable):
    """A camera of format 2."""

    rotation_from_body: Vector
    """Rotation vector (rad) from the axes of the body, which are those of the rectified pair, to the camera's."""

    @property
    def own(self) -> RigCamera:
        """The camera of the rig."""
        return RigCamera(camera=self.camera(), rotation=self.rotation_from_body)


@dataclass(frozen=True, kw_only=True)
class CamerasManifest:
    """Both cameras of format 2."""

    left: CameraManifest
    right: CameraManifest


@dataclass(frozen=True, kw_only=True)
class RigManifest:
    """The description of a rig whose cameras differ."""

    cameras: CamerasManifest
    right_from_left: RightFromLeft
    baseline: float

    @property
    def rig(self) -> StereoRig:
        """The rig; ValueError if the extrinsics contradict the cameras."""
        rig = StereoRig.of_body(self.cameras.left.own, self.cameras.right.own, self.baseline)
        R, t = rig.right_from_left
        stated = self.right_from_left.R, np.array(self.right_from_left.translation)
        if not (np.allclose(stated[0], R, atol=_SAME) and np.allclose(stated[1], t, atol=_SAME * self.baseline)):
            raise ValueError("right_from_left contradicts rotation_from_body of the cameras or the baseline")
        return rig


_SAME = 1e-9
"""Largest difference of two records of one rotation, or of directions."""


@dataclass(frozen=True, kw_only=True)
class SequenceManifest(Scanning):
    """The keys of sequence.json that are read; it has more."""

    format: int
    conventions: int
    name: str
    camera: PinholeCamera | None = None
    """Both cameras, in format 1."""
    cameras: CamerasManifest | None = None
    """The cameras in format 2, with ``right_from_left``."""
    right_from_left: RightFromLeft | None = None
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
    """SHA-256 of files by their path below the sequence's folder."""

    def __post_init__(self) -> None:
        check_name(self.name)
        if not len(FRAMES) <= self.frames <= MOST_FRAMES:
            raise ValueError(f"frames = {self.frames}: must lie in [{len(FRAMES)}, {MOST_FRAMES}]")
        moves, rig = bool(self.moving), self.rig
        shutter = rig.shutter_of(self, self.readout_ratio)
        plain = rig.rectified and shutter.plain
        if self.conventions != (needed := conventions_of(plain, self.frames, moves)):
            raise ValueError(
                f"conventions = {self.conventions}: {needed} is needed; this version reads {CONVENTIONS}, and "
                f"{WITH_LENS} with a lens, another scan or a late camera, {OF_FRAMES} with more than two frames, "
                f"{WITH_MOVING} with moving objects"
            )
        check_sizes(rig)
        check_channels(self.channels, not rig.rectified, shutter.plain)
        check_moving(self.moving, self.channels)
        lines = min(shutter.lines(side) for side in SIDES)
        if (
            list(self.twins) != sorted({row for row in self.twins if 0 < row < lines})
            or len(self.twins) > MOST_TWINS
        ):
            raise ValueError(f"twins = {list(self.twins)}: must rise from 1 to {lines - 1}, {MOST_TWINS} at most")
        if self.sensor is not None:
            check_brightness(self.sensor, self.frames)
        if not self.frame_period_s > 0.0:
            raise ValueError(f"frame_period_s = {self.frame_period_s}: must be positive")

    @property
    def rig(self) -> StereoRig:
        """The rig of the sequence.

        Raises:
            ValueError: a key that the format needs is missing, or two contradict each other.
        """
        if self.format == FORMAT:
            if self.camera is None:
                raise ValueError("'camera' is required")
            return StereoRig(camera=self.camera, baseline=self.baseline)
        if self.cameras is None or self.right_from_left is None:
            raise ValueError(f"'{'right_from_left' if self.cameras else 'cameras'}' is required")
        cameras, apart = self.cameras, self.right_from_left
        return RigManifest(cameras=cameras, right_from_left=apart, baseline=self.baseline).rig


@dataclass(frozen=True, kw_only=True)
class FileManifest:
    """One file, as dataset.json lists it."""

    sha256: str
    size: int
    """Bytes."""


@dataclass(frozen=True, kw_only=True)
class DatasetManifest:
    """The keys of dataset.json that are read; it has more."""

    format: int
    sequences: tuple[str, ...]
    files: dict[str, FileManifest]
    """Files by their paths below the dataset's folder."""
    name: str = ""
    license: str = "CC-BY-4.0"
    """SPDX name; data of rsbench 0.1, which lack it, have this licence."""
    card: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.sequences:
            raise ValueError("sequences = []: must name at least one")
        for name, count in Counter(self.sequences).items():
            check_name(name)
            if count > 1:
                raise ValueError(f"sequences: {name!r} is listed twice")


@dataclass(frozen=True, kw_only=True)
class Sequence(ChannelReader):
    """A sequence folder, or two successive frames of one; sides left and right, frames from 0."""

    name: str
    motion: Motion
    frame_period_s: float
    sensor: Sensor | None = None
    """Sensor of the rolling-shutter frames; None: an ideal sensor."""
    imu: Imu | None = None
    """Sensor of the channel ``imu``."""
    matching: Matching | None = None
    """Matcher of the channel ``matches``."""
    twins: tuple[int, ...] = ()
    """Rows, in the order of the readout, at whose poses there are global-shutter twins in addition to row 0."""
    exposed_twins: bool = False
    """Whether it has global-shutter images with the sensor's exposure."""
    moving: tuple[MovingManifest, ...] = ()
    """Moving objects, numbered from 1."""
    objects: tuple[MovingObject, ...] = ()
    """Motions of the moving objects."""
    glossy: bool = False
    """Whether its scene has glossy surfaces, which look different from each viewpoint."""

    def pairs(self) -> list[Sequence]:
        """Pairs of successive frames as sequences of two frames, such as ``castle.3`` for frames 3 and 4.

        The world of a pair is the body at its time 0, its motion is relative to that, and its channels are those
        of one frame or between two. A sequence of two frames is its only pair.
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
        """(H, W, 3) sRGB image; ``gs``: the global-shutter image at the pose of a row, 0 or one of ``twins``."""
        return read_png(
            inside(self.folder, picture_file(shutter, side, frame + self.first, row)), self._size(side)
        )

    def exposed_image(self, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB global-shutter image of the sensor at the pose of a row, without noise.

        Raises:
            RsbenchError: the dataset has a sensor but no ``exposed_twins``.
        """
        if self.sensor is None:
            return self.image("gs", side, frame, row)
        if not self.exposed_twins:
            raise RsbenchError(
                f"{self.folder}: has no global-shutter images of its sensor; render it again with "
                "exposed_twins = true in the dataset card"
            )
        return read_png(inside(self.folder, exposed_file(side, frame + self.first, row)), self._size(side))

    def clean_image(self, side: Side, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB rolling-shutter frame of an ideal sensor, sharp and without noise."""
        if self.sensor is None:
            return self.image("rs", side, frame)
        return read_png(inside(self.folder, clean_file(side, frame + self.first)), self._size(side))

    def images(self, shutter: Shutter = "rs") -> list[NDArray[np.uint8]]:
        """Images left 0, right 0, left 1, right 1, ...: the order of ``rsbench.match`` and ``rsbench.correct``."""
        return [self.image(shutter, side, frame) for frame in range(self.frames) for side in SIDES]

    def depth(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.float32]:
        """(H, W) z in the camera at the time of the pixel's row, m; 0: no surface. For ``row`` see ``image``."""
        file = picture_file(shutter, side, frame + self.first, row, depth=True)
        return read_depth(inside(self.folder, file), self._size(side))

    def labels(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.uint8]:
        """(H, W) labels: number of the moving object at each pixel, 0: none, plus 128 in the shadow of a moving
        object. For ``row`` see ``image``."""
        if not self.moving:
            return np.zeros(self._size(side)[::-1], dtype=np.uint8)
        path = inside(self.folder, moving_file(shutter, side, frame + self.first, row))
        labels = read_grey_png(path, self._size(side))
        if np.max(numbers_of(labels)) > len(self.moving):
            raise RsbenchError(f"{path}: has object {np.max(numbers_of(labels))}: there are {len(self.moving)}")
        return labels

    def gloss(self, shutter: Shutter, side: Side, frame: int, row: int = 0) -> NDArray[np.bool_]:
        """(H, W) whether a pixel's surface is glossy. For ``row`` see ``image``."""
        if not self.glossy:
            return np.zeros(self._size(side)[::-1], dtype=np.bool_)
        path = inside(self.folder, gloss_file(shutter, side, frame + self.first, row))
        return read_mask(path, self._size(side))

    def poses(self, side: Side, frame: int) -> tuple[FloatArray, Pose]:
        """Stored row times (H,) and ``cam_from_world`` (H, 3, 3), (H, 3); for columns if columns are read."""
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
    """The geometric part of sequence.json; key names have a unit unless it is metres or radians."""
    readout_s = shutter.readout_ratio * frame_period_s
    kind = format_of(rig, shutter)
    count = {"frames": frames} if frames > len(FRAMES) else {}
    return {
        "format": kind,
        "conventions": conventions_of(rig.rectified and shutter.plain, frames, moves),
        "name": name,
        **({"camera": camera_record(rig.camera)} if kind == FORMAT else cameras_record(rig)),
        "baseline": rig.baseline,
        "readout_ratio": shutter.readout_ratio,
        "frame_period_s": frame_period_s,
        "readout_time_s": readout_s,
        "row_time_s": readout_s / shutter.lines("left"),
        "motion": motion_record(motion),
        **count,
        **({} if shutter.scanning.plain else shutter.scanning.record),
    }


def cameras_record(rig: StereoRig) -> dict[str, Any]:
    """``cameras`` and ``right_from_left`` of format 2; ``RigManifest`` reads them."""
    tables = tables_of(rig)
    turned = {side: tables.pop(side) | {"rotation_from_body": list(rig.own(side).rotation)} for side in SIDES}
    return {"cameras": turned, **tables}


def read_sequence(folder: Path) -> Sequence:
    """Open a sequence folder.

    Raises:
        RsbenchError: sequence.json is missing, of another version or wrong, or its name is not the folder's.
    """
    return sequence_of(read_json(path := inside(folder, "sequence.json")), path)


def sequence_of(content: dict[str, Any], path: Path) -> Sequence:
    """``read_sequence`` from the content of a sequence.json, without opening a file."""
    folder = path.parent
    manifest = _parsed(SequenceManifest, content, path)
    if manifest.name != (is_named := os.path.basename(os.path.abspath(folder))):
        raise RsbenchError(f"{path}: name = {manifest.name!r}: must be the name of its folder, {is_named!r}")
    with naming(path, ValueError, RsbenchError):
        return Sequence(
            folder=folder,
            name=manifest.name,
            rig=manifest.rig,
            shutter=manifest.rig.shutter_of(manifest, manifest.readout_ratio),
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


def read_dataset(folder: Path) -> list[Sequence]:
    """Read all sequences that dataset.json lists, in its order.

    Raises:
        RsbenchError: the folder is not a finished dataset, or a sequence cannot be read.
    """
    return [read_sequence(inside(folder, name)) for name in read_dataset_manifest(folder).sequences]


def read_pairs(folder: Path) -> list[Sequence]:
    """All pairs of successive frames of a dataset as sequences of two frames, which are scored.

    Raises:
        RsbenchError: as for ``read_dataset``, or two pairs have the same name.
    """
    pairs = [pair for sequence in read_dataset(folder) for pair in sequence.pairs()]
    for name, count in Counter(pair.name for pair in pairs).items():
        if count > 1:
            raise RsbenchError(f"{folder}: {name!r} is a sequence and a pair of frames of another; rename it")
    return pairs


def read_dataset_manifest(folder: Path) -> DatasetManifest:
    """Read the dataset.json of a folder.

    Raises:
        RsbenchError: the folder is not a finished dataset, or dataset.json is of another version or wrong.
    """
    path = inside(folder, "dataset.json")
    if not path.is_file():
        raise RsbenchError(
            f"{folder}: not a dataset (no dataset.json); make one with: rsbench generate CARD --out DIR"
        )
    return _parsed(DatasetManifest, read_json(path), path)


def _parsed(cls: type[M], content: dict[str, Any], path: Path) -> M:
    if content.get("format") not in FORMATS:
        raise RsbenchError(
            f"{path}: format = {content.get('format')!r}; this version reads {' and '.join(map(str, FORMATS))}"
        )
    return parse_card(cls, content, str(path), extra="ignore")


def files_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Paths of the files that a sequence must have according to its sequence.json."""
    frames, rows = frames_of(manifest), twins_of(manifest)
    views = views_of(frames)
    clean = tuple(clean_file(*view) for view in views if manifest.get("sensor"))
    stacks = tuple(stack_file(*view, row) for view in views for row in range(whole_frames(manifest, view[0])))
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
