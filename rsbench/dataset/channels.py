"""Channels of ground truth besides images, depth and poses: objects that make, write and read their files.

A new channel needs a class here and an entry of ``OBJECTS``. ``rsbench verify`` then looks for its files and
compares some rows with ray casting; additional checks are rows in ``rsbench/verification/checks.py``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import FixedGeometry, Geometry
from rsbench.core.rig import FRAMES, SIDES, VIEWS, Side, StereoRig, View, views_of
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.clock_channels import (
    IMU_FILES,
    IMU_MANIFEST,
    TIMING_MANIFEST,
    Imu,
    ImuSamples,
    draw_samples,
    gravity_of,
    read_imu,
    read_timing_table,
    sample_times_ns,
    table_file,
    timing_files,
    write_imu,
    write_timing,
)
from rsbench.dataset.layout import frames_of
from rsbench.dataset.point_channels import (
    AffineFrames,
    LabelledMatches,
    Matching,
    Tracks,
    make_affine,
    make_matches,
    make_tracks,
    matcher_record,
)
from rsbench.dataset.views import (
    ImageView,
    PixelClass,
    Rays,
    SeenSurfaces,
    carry,
    numbers_of,
    pair_truth,
    surface_truth,
)
from rsbench.storage.files import (
    Later,
    begun,
    read_depth,
    read_exr,
    read_grey_png,
    read_json,
    read_png,
    write_exr,
    write_json,
    write_png,
    write_png16,
)
from rsbench.storage.untrusted_files import inside

if TYPE_CHECKING:
    from rsbench.renderers.image import Sensor
    from rsbench.renderers.render import Frame
    from rsbench.renderers.scene import MitsubaScene
    from rsbench.renderers.visibility import Surfaces

PairChannel = Literal["disparity", "flow", "gs_flow"]
"""Displacement of each pixel of a rolling-shutter frame to another image: of the other camera in the same frame
(disparity), of the same camera in the next frame (flow; from the last frame, to the previous one), or the
global-shutter twin (gs_flow)."""
PAIR_CHANNELS: tuple[PairChannel, ...] = get_args(PairChannel)
INSTANCE_TABLE, TRACKS, AFFINE = "instances.json", "tracks.npz", "affine.npz"
MATCHER = "matches/matcher.json"
STEP_PX = 2.0**-10
"""Values are rounded to multiples of this step, px, which makes the files four times smaller."""
SAME_PX = 1.5 * STEP_PX
"""Tolerance for equal values, px: one step, as both are rounded, plus float32 rounding in images of 4000 px."""
_BRIGHTEST = float(np.finfo(np.float16).max)


class Layer(NamedTuple):
    """A channel of displacements from each frame to one other image."""

    channel: PairChannel
    row: int = 0
    """Row of the target, for a global-shutter twin."""
    back: bool = False
    """Whether a ``flow`` is backward: from the frames between the first and the last to the previous frame."""

    def values(self, side: str, frame: int) -> str:
        """Return the path of the offsets below a sequence's folder; ``mask`` returns that of their classes."""
        return f"{self._folder}{self._row}/{side}_{frame}.exr"

    def mask(self, side: str, frame: int) -> str:
        return f"{self._folder}_mask{self._row}/{side}_{frame}.png"

    @property
    def _folder(self) -> str:
        return "gs_twin_flow" if self.row else f"{self.channel}_back" if self.back else self.channel

    @property
    def _row(self) -> str:
        return f"/{self.row:04d}" if self.row else ""

    def views(self, frames: int) -> tuple[View, ...]:
        """Return the source views in a sequence of ``frames`` frames."""
        return tuple(view for view in views_of(frames) if not self.back or 0 < view[1] < frames - 1)

    def target(self, source: ImageView, frames: int) -> ImageView:
        """Return the target image of a source view in a sequence of ``frames`` frames."""
        twin = source.other_shutter._replace(row=self.row)
        over_time = source.frame_before if self.back else source.next_frame(frames)
        return {"disparity": source.other_side, "flow": over_time, "gs_flow": twin}[self.channel]


def pair_layers(names: Collection[str], twins: Iterable[int], frames: int = len(FRAMES)) -> list[Layer]:
    """The layers of the named channels in a sequence of ``frames`` frames, channel by channel."""
    layers: list[Layer] = []
    for channel in PAIR_CHANNELS:
        if channel in names:
            layers.append(Layer(channel))
            layers += [Layer("flow", back=True)] if channel == "flow" and frames > len(FRAMES) else []
            layers += [Layer("gs_flow", row) for row in twins if channel == "gs_flow"]
    return layers


class FrameTruth:
    """The data from which the channels of one rolling-shutter frame are computed.

    Args:
        geometry: geometry of the sequence.
        view: the frame.
        rendered: radiance and depth of the frame, or of its ``rows``.
        rays: ray casting in the scene; used by this thread only.
        names: names of the channels to compute.
        twins: rows of additional global-shutter twins that are targets of ``gs_flow``.
        rows: rows of the frame to compute; all by default.
        later: starts work in other threads (``background_writer``); by default there are none.
    """

    def __init__(
        self,
        geometry: Geometry,
        view: ImageView,
        rendered: Frame,
        rays: Rays,
        names: Collection[str],
        twins: Iterable[int] = (),
        rows: Sequence[int] | None = None,
        later: Later | None = None,
    ) -> None:
        self.geometry, self.view, self.rendered, self.rays, self._rows = geometry, view, rendered, rays, rows
        frames = geometry.frames
        layers = [each for each in pair_layers(names, twins, frames) if view[1:3] in each.views(frames)]
        self._layers = [(layer, layer.target(view, frames)) for layer in layers]
        targets = [target for _, target in self._layers]
        if later is None or not targets:
            self._carried = (carry(self.seen, target) for target in targets)
        else:
            seen = self.seen  # before threads would make it at the same time
            self._carried = begun(later, lambda target: carry(seen, target), targets)

    @cached_property
    def seen(self) -> SeenSurfaces:
        numbers = numbers_of(self.rendered.labels)
        return SeenSurfaces(self.geometry, self.view, self.rendered.depth, self._rows, numbers)

    @cached_property
    def surfaces(self) -> Surfaces:
        return surface_truth(self.seen, self.rays)

    def pairs(self, channel: str) -> Iterator[tuple[Layer, FloatArray, NDArray[np.uint8]]]:
        """Offsets (H, W, 2), px, and ``PixelClass`` (H, W) of each layer; called in the order of ``OBJECTS``."""
        for layer, target in self._layers:
            if layer.channel == channel:
                truth = pair_truth(self.seen, target, next(self._carried), self.rays.blocked)
                yield layer, truth.offset, truth.classes


@dataclass(frozen=True, kw_only=True)
class SequenceTruth:
    """The data from which the channels of a whole sequence are computed, after its frames were written."""

    folder: Path
    geometry: FixedGeometry
    seed: str
    """Seed of the random draws of its channels."""
    frame_period_s: float
    sensor: Sensor | None
    imu: Imu
    matching: Matching
    scene: MitsubaScene
    record: Mapping[str, Any]
    """The table ``scene`` of sequence.json."""
    rays: Any
    """``SceneRays`` through the scene."""

    @cached_property
    def tracks(self) -> Tracks:
        views = views_of(self.geometry.frames)
        depths = {view: read_depth(self.folder / ImageView("rs", *view).depth) for view in views}
        return make_tracks(self.geometry, depths, self.rays.blocked, self.seed)


class TruthChannel:
    """One channel of ground truth."""

    name: ClassVar[str] = ""
    supports_moving: ClassVar[bool] = True
    """Whether it is correct where objects move."""
    of_pairs: ClassVar[bool] = False
    """Whether a pair of successive frames (``Sequence.pairs``) keeps it."""
    rounding: ClassVar[float | None] = None
    """Largest difference between a stored value of a frame and its recomputation by rays; None: not compared."""

    def refusal(self, names: Collection[str], lens: bool, plain: bool) -> str:
        """Return why the channel is unavailable for cameras with the channels ``names``, or "" if it is available.

        ``lens``: the cameras have lenses; ``plain``: both read rows from the top at the same time.
        """
        return ""

    table: ClassVar[tuple[str, ...]] = ()
    """Files of the whole sequence, below its folder."""

    def files(self, twins: Iterable[int], frames: int) -> Iterable[str]:
        """Paths below the folder of a sequence."""
        return self.table

    def made(self, frame: FrameTruth) -> Iterable[tuple[str, NDArray[Any]]]:
        """Return files and values (H, W, ...) of one frame."""
        return ()

    def write_values(self, path: Path, values: NDArray[Any]) -> None:
        """Write values of ``made``: float32 as EXR with ``components``, whole numbers as PNG."""
        if path.suffix == ".png":
            (write_png16 if values.dtype == np.uint16 else write_png)(path, values)
        else:
            write_exr(path, {name: values[..., k] for k, name in enumerate(self.components)})

    components: ClassVar[tuple[str, ...]] = ()
    """Names of the float32 channels of the EXR files."""

    def read_values(self, path: Path, size: tuple[int, int]) -> NDArray[Any]:
        """Read a file of ``write_values``; ``size`` (width, height) of the camera; RsbenchError for another
        file."""
        return read_exr(path, self.components, size)

    def write_whole(self, whole: SequenceTruth) -> None:
        """Write the files of the whole sequence."""


class _Pairs(TruthChannel):
    of_pairs = True
    rounding = SAME_PX

    def files(self, twins: Iterable[int], frames: int) -> Iterable[str]:
        layers = pair_layers([self.name], twins, frames)
        return (file(*view) for each in layers for file in (each.values, each.mask) for view in each.views(frames))

    def made(self, frame: FrameTruth) -> Iterable[tuple[str, NDArray[Any]]]:
        where = frame.view[1:3]
        for layer, offset, classes in frame.pairs(self.name):
            yield layer.values(*where), pair_values(layer.channel, frame.view, offset)
            yield layer.mask(*where), classes

    def read_values(self, path: Path, size: tuple[int, int]) -> NDArray[Any]:
        if path.suffix == ".exr":
            return read_exr(path, self.components, size)
        classes = read_grey_png(path, size)
        if np.any(classes > max(PixelClass)):
            raise RsbenchError(f"{path}: holds {np.max(classes)}: the classes are 0 to {max(PixelClass)}")
        return classes


class _Disparity(_Pairs):
    name, components = "disparity", ("d",)

    def refusal(self, names: Collection[str], lens: bool, plain: bool) -> str:
        if not plain:
            return "channels: 'disparity' needs cameras that both read rows from the top at the same time"
        return "channels: 'disparity' needs cameras without a lens, whose pairs share their rows" if lens else ""


class _Flow(_Pairs):
    name, components = "flow", ("x", "y")


class _CorrectionFlow(_Pairs):
    name, components = "gs_flow", ("x", "y")


class _Timing(TruthChannel):
    name = "timing"

    def files(self, twins: Iterable[int], frames: int) -> Iterable[str]:
        return timing_files(frames)

    def write_whole(self, whole: SequenceTruth) -> None:
        shutter, frames = whole.geometry.shutter, whole.geometry.frames
        write_timing(whole.folder, shutter, whole.frame_period_s, whole.sensor, frames)


class _Pictures(TruthChannel):
    """One file for each rolling-shutter frame, ``FOLDER/SIDE_FRAME.END``, and perhaps one for all."""

    end: ClassVar[str] = "exr"

    def files(self, twins: Iterable[int], frames: int) -> Iterable[str]:
        return (*self.table, *(self.file(*view) for view in views_of(frames)))

    def file(self, side: str, frame: int) -> str:
        """Path below the folder of a sequence."""
        return f"{self.name}/{side}_{frame}.{self.end}"

    def values(self, frame: FrameTruth) -> NDArray[Any]:
        """(H, W, ...) of one frame."""
        raise NotImplementedError

    def made(self, frame: FrameTruth) -> Iterable[tuple[str, NDArray[Any]]]:
        yield self.file(*frame.view[1:3]), self.values(frame)


class _Normals(_Pictures):
    name, components, rounding = "normals", ("x", "y", "z"), 1e-5

    def values(self, frame: FrameTruth) -> NDArray[Any]:
        return frame.surfaces.normals


class _Instances(_Pictures):
    name, of_pairs, rounding, end, table = "instances", True, 0.0, "png", (INSTANCE_TABLE,)

    def values(self, frame: FrameTruth) -> NDArray[Any]:
        return frame.surfaces.instances

    def read_values(self, path: Path, size: tuple[int, int]) -> NDArray[Any]:
        return read_grey_png(path, size, 16)

    def write_whole(self, whole: SequenceTruth) -> None:
        write_json(whole.folder / INSTANCE_TABLE, {"instances": whole.scene.instances})


class _Inertial(TruthChannel):
    name, table = "imu", IMU_FILES

    def write_whole(self, whole: SequenceTruth) -> None:
        imu, geometry, period = whole.imu, whole.geometry, whole.frame_period_s
        gravity = gravity_of(whole.record)
        times = sample_times_ns(imu, geometry.shutter, period, whole.sensor, geometry.frames)
        samples = draw_samples(imu, geometry.motion, times, period, gravity, whole.seed)
        write_imu(whole.folder, imu, gravity, samples)


class _Tracks(TruthChannel):
    name, supports_moving, table = "tracks", False, (TRACKS,)

    def write_whole(self, whole: SequenceTruth) -> None:
        whole.tracks.save(whole.folder / TRACKS)


class _Affine(TruthChannel):
    name, supports_moving, table = "affine", False, (AFFINE,)

    def refusal(self, names: Collection[str], lens: bool, plain: bool) -> str:
        return "" if "tracks" in names else "channels: 'affine' belongs to the points of 'tracks': add 'tracks'"

    def write_whole(self, whole: SequenceTruth) -> None:
        make_affine(whole.geometry, whole.tracks, whole.rays).save(whole.folder / AFFINE)


class _Radiance(_Pictures):
    name, of_pairs, components = "hdr", True, ("R", "G", "B")

    def values(self, frame: FrameTruth) -> NDArray[Any]:
        return frame.rendered.image

    def write_values(self, path: Path, values: NDArray[Any]) -> None:
        light = {name: values[..., k] for k, name in enumerate(self.components)}
        write_exr(path, {name: np.minimum(each, _BRIGHTEST) for name, each in light.items()}, half=True)

    def read_values(self, path: Path, size: tuple[int, int]) -> NDArray[Any]:
        values = read_exr(path, self.components, size, half=True)
        if not np.all(np.isfinite(values)) or np.any(values < 0):
            raise RsbenchError(f"{path}: radiance must be finite and not negative")
        return values


class _Matches(TruthChannel):
    name, supports_moving, of_pairs = "matches", False, True

    def files(self, twins: Iterable[int], frames: int) -> Iterable[str]:
        return (MATCHER, *map(matches_file, range(frames - 1)))

    def write_whole(self, whole: SequenceTruth) -> None:
        matching, folder = whole.matching, whole.folder
        write_json(folder / MATCHER, matcher_record(matching))
        for first in range(whole.geometry.frames - 1):
            views = [(side, first + frame) for side, frame in VIEWS]
            images = {view: read_png(folder / ImageView("rs", *view).image) for view in views}
            make_matches(whole.geometry, first, images, matching, whole.rays).save(folder / matches_file(first))


NORMALS, INSTANCES, RADIANCE = _Normals(), _Instances(), _Radiance()
OBJECTS: dict[str, TruthChannel] = {
    each.name: each
    for each in (
        _Disparity(),
        _Flow(),
        _CorrectionFlow(),
        _Timing(),
        NORMALS,
        INSTANCES,
        _Inertial(),
        _Tracks(),
        _Affine(),
        RADIANCE,
        _Matches(),
    )
}
"""All channels, by name."""
if TYPE_CHECKING:
    Channel = str
else:
    Channel = Literal[tuple(OBJECTS)]
"""Name of a channel, as cards have it."""
CHANNELS: tuple[Channel, ...] = tuple(OBJECTS)


def known(names: Iterable[str]) -> list[TruthChannel]:
    """Return the channels with these names, in the order of ``OBJECTS``; unknown names are skipped."""
    return [OBJECTS[name] for name in OBJECTS if name in {*names}]


def check_channels(names: Collection[str], lens: bool, plain: bool) -> None:
    """Check whether cameras can have these channels; arguments as for ``TruthChannel.refusal``.

    Raises:
        ValueError: a channel is unavailable; the message is one line.
    """
    for channel in known(names):
        if refusal := channel.refusal(names, lens, plain):
            raise ValueError(refusal)


def channel_files(names: Iterable[str], twins: Iterable[int] = (), frames: int = len(FRAMES)) -> tuple[str, ...]:
    """Return the paths of these channels' files below a sequence's folder; unknown names are skipped."""
    rows = tuple(twins)
    return tuple(file for channel in known(names) for file in channel.files(rows, frames))


def write_channels(
    folder: Path,
    names: Collection[str],
    geometry: Geometry,
    view: ImageView,
    rendered: Frame,
    rays: Rays,
    later: Later,
    twins: Iterable[int] = (),
) -> None:
    """Write the files of channels that belong to one rolling-shutter frame.

    ``folder`` is that of the sequence; ``later`` starts the writing of files; other arguments as for
    ``FrameTruth``.
    """
    frame = FrameTruth(geometry, view, rendered, rays, names, twins, later=later)
    for channel in known(names):
        for file, values in channel.made(frame):
            later(channel.write_values, folder / file, values)


def write_sequence_channels(names: Sequence[Channel], whole: SequenceTruth) -> None:
    """Write the files of the named channels that belong to the whole sequence."""
    for channel in known(names):
        channel.write_whole(whole)


def pair_values(channel: PairChannel, source: ImageView, offset: FloatArray) -> NDArray[np.float32]:
    """Convert offsets (..., 2), px, to stored values (..., components); a disparity is x_left - x_right."""
    if channel == "disparity":
        offset = offset[..., :1] * (1.0 if source.side == "right" else -1.0)
    values = offset / STEP_PX
    np.round(values, out=values)
    values *= STEP_PX
    return (values + 0.0).astype(np.float32)  # no -0


def matches_file(first: int) -> str:
    """Return the path of the matches of frame ``first`` and the next, below the folder of a sequence."""
    return f"matches/{first}.npz"


def named_channels(text: str) -> tuple[Channel, ...]:
    """Parse a list of channels such as "flow,disparity", or "all" or "none".

    Raises:
        RsbenchError: a name is unknown or repeated.
    """
    if text in ("all", "none"):
        return CHANNELS if text == "all" else ()
    found: list[Channel] = []
    for name in text.split(","):
        if name.strip() not in CHANNELS or name.strip() in found:
            raise RsbenchError(
                f"--channels {text}: {name!r}: allowed are {', '.join(CHANNELS)}, each once, or all, or none"
            )
        found.append(name.strip())
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class ChannelReader:
    """Readers of a sequence's channels; each raises RsbenchError if the sequence does not have the channel."""

    folder: Path
    rig: StereoRig
    shutter: RollingShutter
    channels: tuple[str, ...] = ()
    """Names of channels in addition to images, depth and poses; later versions may have more."""
    frames: int = len(FRAMES)
    """Number of frames of each camera."""
    first: int = 0
    """Number in the folder of the frame that is frame 0 here; above 0 only for a pair."""
    manifest: dict[str, Any]
    """Content of sequence.json."""

    def channel_values(self, channel: str, file: str) -> NDArray[Any]:
        """Read values (H, W, ...) from a file of a channel with one file per frame.

        Raises:
            RsbenchError: the sequence does not have this channel, or the file cannot be read.
        """
        side: Side = "left" if PurePosixPath(file).name.startswith("left") else "right"
        return OBJECTS[channel].read_values(self._path(channel, file), self._size(side))

    def offsets(
        self, channel: PairChannel, side: Side, frame: int, row: int = 0, back: bool = False
    ) -> NDArray[np.float32]:
        """Read displacements (H, W, components), px, of a rolling-shutter frame's pixels, see ``PairChannel``.

        ``row`` is that of the target twin of ``gs_flow``: 0, or one of ``twins``. ``back`` selects the ``flow`` to
        the previous frame, which is the only one from the last frame. RsbenchError as for ``channel_values``.
        """
        return self.channel_values(
            channel, self._layer(channel, frame, row, back).values(side, frame + self.first)
        )

    def classes(
        self, channel: PairChannel, side: Side, frame: int, row: int = 0, back: bool = False
    ) -> NDArray[np.uint8]:
        """Read values (H, W) of ``PixelClass``: whether the target image shows the surface of each pixel.

        Arguments and RsbenchError as for ``offsets``.
        """
        return self.channel_values(channel, self._layer(channel, frame, row, back).mask(side, frame + self.first))

    def normals(self, side: Side, frame: int) -> NDArray[np.float32]:
        """Read the unit normals (H, W, 3) of the pixels' surfaces, towards the camera, world frame; 0 in the sky.

        RsbenchError as for ``channel_values``.
        """
        return self.channel_values("normals", NORMALS.file(side, frame + self.first))

    def instances(self, side: Side, frame: int) -> NDArray[np.uint16]:
        """Read the mesh numbers (H, W) of the pixels; 0 = none. RsbenchError as for ``channel_values``."""
        return self.channel_values("instances", INSTANCES.file(side, frame + self.first))

    def instance_table(self) -> list[dict[str, str]]:
        """Read ``name`` and ``material`` of instances 1, 2, ...; RsbenchError as for ``channel_values``, or if the
        content is invalid."""
        path = self._path("instances", INSTANCE_TABLE)
        table = read_json(path).get("instances")
        rows: list[Any] = table if isinstance(table, list) else [None]
        for row in rows:
            if not isinstance(row, dict) or not all(isinstance(row.get(key), str) for key in ("name", "material")):
                raise RsbenchError(f"{path}: instances: must be a list of tables with name and material")
        return rows

    def timing(self) -> dict[str, Any]:
        """Read timing.json; RsbenchError as for ``channel_values``."""
        return read_json(self._path("timing", TIMING_MANIFEST))

    def row_times_ns(self, side: Side, frame: int) -> NDArray[np.int64]:
        """Read a table (H, 4) of row, time, start and end of exposure, ns; RsbenchError as for ``timing``."""
        return read_timing_table(self._path("timing", table_file(side, frame)), self.shutter.lines(side))

    def inertial(self) -> ImuSamples:
        """Read measured and true inertial samples; RsbenchError as for ``channel_values``."""
        self._path("imu", IMU_MANIFEST)
        return read_imu(self.folder)

    def imu_manifest(self) -> dict[str, Any]:
        """Read imu.json; RsbenchError as for ``channel_values``."""
        return read_json(self._path("imu", IMU_MANIFEST))

    def radiance(self, side: Side, frame: int) -> NDArray[np.float32]:
        """Read the linear RGB radiance (H, W, 3) of a rolling-shutter frame, without effects of the sensor.

        White is 1 after multiplication by the renderer's ``exposure``. Files are rounded to float16. RsbenchError
        as for ``channel_values``.
        """
        return self.channel_values("hdr", RADIANCE.file(side, frame + self.first))

    def tracks(self) -> Tracks:
        """Read surface points and their pixels in all frames; RsbenchError as for ``channel_values``."""
        found, views = Tracks.read(path := self._path("tracks", TRACKS)), len(SIDES) * self.frames
        if found.tau.shape[1] != views:
            raise RsbenchError(f"{path}: holds {found.tau.shape[1]} views, but the sequence has {views}")
        return found

    def affine(self) -> AffineFrames:
        """Read the affine frames of the tracks' points; RsbenchError as for ``channel_values``."""
        return AffineFrames.read(self._path("affine", AFFINE))

    def matches(self, first: int = 0) -> LabelledMatches:
        """Read the matches of a feature matcher in frame ``first`` and the next, with true pixels and classes.

        RsbenchError as for ``channel_values``.
        """
        return LabelledMatches.read(self._path("matches", matches_file(first + self.first)))

    def matcher(self) -> dict[str, Any]:
        """Read matches/matcher.json, which describes the matcher; RsbenchError as for ``channel_values``."""
        return read_json(self._path("matches", MATCHER))

    def _layer(self, channel: PairChannel, frame: int, row: int, back: bool) -> Layer:
        """Return the layer from a frame to the next or the previous one."""
        if back and channel in self.channels and (channel != "flow" or frame == 0):
            raise RsbenchError(f"{self.folder}: {channel} of frame {frame} leads to no frame before")
        last = frames_of(self.manifest) - 1
        leads_back = channel == "flow" and (back or frame == self.frames - 1)
        return Layer(channel, row, leads_back and frame + self.first != last)

    def _path(self, channel: str, file: str) -> Path:
        if channel not in self.channels:
            has = ", ".join(self.channels) or "none"
            raise RsbenchError(
                f"{self.folder}: has no channel {channel!r} ({has}); make it with: generate --channels {channel}"
            )
        return inside(self.folder, file)

    def _size(self, side: Side) -> tuple[int, int]:
        """Width and height of a camera's images."""
        camera = self.rig.sensor(side)
        return camera.width, camera.height
