"""Reading the channels of ground truth of a sequence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.channels import (
    AFFINE,
    COMPONENTS,
    INSTANCE_TABLE,
    MATCHER,
    NORMAL_COMPONENTS,
    RADIANCE_COMPONENTS,
    TRACKS,
    Layer,
    PairChannel,
    PixelClass,
    matches_file,
    radiance_file,
    surface_file,
)
from rsbench.dataset.imu import IMU_MANIFEST, ImuSamples, read_imu
from rsbench.dataset.layout import frames_of
from rsbench.dataset.matches import LabelledMatches, read_matches
from rsbench.dataset.timing import TIMING_MANIFEST, read_timing_table, table_file
from rsbench.dataset.tracks import AffineFrames, Tracks, read_affine, read_tracks
from rsbench.storage.files import read_exr, read_grey_png, read_json
from rsbench.storage.untrusted_files import inside


@dataclass(frozen=True, kw_only=True)
class ChannelReader:
    """What a ``Sequence`` reads of its channels; each raises RsbenchError where it does not have them."""

    folder: Path
    rig: StereoRig
    shutter: RollingShutter
    channels: tuple[str, ...]
    frames: int
    first: int
    manifest: dict[str, Any]

    def offsets(
        self, channel: PairChannel, side: Side, frame: int, row: int = 0, back: bool = False
    ) -> NDArray[np.float32]:
        """(H, W, components) px of the pixels of a rolling-shutter frame: see ``channels.PairChannel``.

        ``row``: of ``gs_flow``, that of the twin to which it leads: 0, or one of ``twins``. ``back``: of ``flow``,
        to the frame before, as from the last frame in any case.

        Raises:
            RsbenchError: the sequence does not have this channel, or the file cannot be read.
        """
        self._check_channel(channel)
        layer = self._layer(channel, frame, row, back)
        path = inside(self.folder, layer.values(side, frame + self.first))
        return read_exr(path, COMPONENTS[channel], self._size)

    def classes(
        self, channel: PairChannel, side: Side, frame: int, row: int = 0, back: bool = False
    ) -> NDArray[np.uint8]:
        """(H, W) of ``channels.PixelClass``: what became of each pixel in the picture that the channel looks at.

        Raises:
            RsbenchError: as ``offsets``.
        """
        self._check_channel(channel)
        layer = self._layer(channel, frame, row, back)
        path = inside(self.folder, layer.mask(side, frame + self.first))
        classes = read_grey_png(path, self._size)
        if np.any(classes > max(PixelClass)):
            raise RsbenchError(f"{path}: holds {np.max(classes)}: the classes are 0 to {max(PixelClass)}")
        return classes

    def normals(self, side: Side, frame: int) -> NDArray[np.float32]:
        """(H, W, 3) unit normals of what the pixels see, towards the camera, world frame; 0 where that is nothing.

        RsbenchError as of ``offsets``.
        """
        self._check_channel("normals")
        path = inside(self.folder, surface_file("normals", side, frame + self.first))
        return read_exr(path, NORMAL_COMPONENTS, self._size)

    def instances(self, side: Side, frame: int) -> NDArray[np.uint16]:
        """(H, W) numbers of the meshes that the pixels see; 0 = none. RsbenchError as of ``offsets``."""
        self._check_channel("instances")
        path = inside(self.folder, surface_file("instances", side, frame + self.first))
        return read_grey_png(path, self._size, 16)

    def instance_table(self) -> list[dict[str, str]]:
        """``name`` and ``material`` of instance 1, 2, ...; RsbenchError as of ``offsets``, or another content."""
        self._check_channel("instances")
        path = inside(self.folder, INSTANCE_TABLE)
        table = read_json(path).get("instances")
        rows: list[Any] = table if isinstance(table, list) else [None]
        for row in rows:
            if not isinstance(row, dict) or not all(isinstance(row.get(key), str) for key in ("name", "material")):
                raise RsbenchError(f"{path}: instances: must be a list of tables with name and material")
        return rows

    def timing(self) -> dict[str, Any]:
        """Content of timing.json; RsbenchError as of ``offsets``."""
        self._check_channel("timing")
        return read_json(inside(self.folder, TIMING_MANIFEST))

    def row_times_ns(self, side: Side, frame: int) -> NDArray[np.int64]:
        """(H, 4) of each row: number, time, start and end of its exposure; RsbenchError likewise."""
        self._check_channel("timing")
        return read_timing_table(inside(self.folder, table_file(side, frame)), self.shutter.lines(side))

    def inertial(self) -> ImuSamples:
        """What the inertial sensor measured, and the truth; RsbenchError as of ``offsets``."""
        self._check_channel("imu")
        return read_imu(self.folder)

    def radiance(self, side: Side, frame: int) -> NDArray[np.float32]:
        """(H, W, 3) linear RGB radiance of a rolling-shutter frame without its sensor.

        Times the renderer's ``exposure``, 1 is white. Rounded to float16 on disk. RsbenchError as of ``offsets``.
        """
        self._check_channel("hdr")
        path = inside(self.folder, radiance_file(side, frame + self.first))
        values = read_exr(path, RADIANCE_COMPONENTS, self._size, half=True)
        if not np.all(np.isfinite(values)) or np.any(values < 0):
            raise RsbenchError(f"{path}: radiance must be finite and not negative")
        return values

    def tracks(self) -> Tracks:
        """Surface points and where the frames see them; RsbenchError as of ``offsets``."""
        self._check_channel("tracks")
        return read_tracks(inside(self.folder, TRACKS), self.frames)

    def matches(self, first: int = 0) -> LabelledMatches:
        """What a feature matcher found in frame ``first`` and the next, and what is true.

        RsbenchError as of ``offsets``.
        """
        self._check_channel("matches")
        return read_matches(inside(self.folder, matches_file(first + self.first)))

    def matcher(self) -> dict[str, Any]:
        """Content of matches/matcher.json: who matched; RsbenchError as of ``offsets``."""
        self._check_channel("matches")
        return read_json(inside(self.folder, MATCHER))

    def affine(self) -> AffineFrames:
        """How the surroundings of the tracks' points lie in the frames; RsbenchError as of ``offsets``."""
        self._check_channel("affine")
        return read_affine(inside(self.folder, AFFINE))

    def imu_manifest(self) -> dict[str, Any]:
        """Content of imu.json; RsbenchError as of ``offsets``."""
        self._check_channel("imu")
        return read_json(inside(self.folder, IMU_MANIFEST))

    def _layer(self, channel: PairChannel, frame: int, row: int, back: bool) -> Layer:
        """Which leads from a frame to the next or to the one before."""
        if back and (channel != "flow" or frame == 0):
            raise RsbenchError(f"{self.folder}: {channel} of frame {frame} leads to no frame before")
        last = frames_of(self.manifest) - 1
        leads_back = channel == "flow" and (back or frame == self.frames - 1)
        return Layer(channel, row, leads_back and frame + self.first != last)

    def _check_channel(self, channel: str) -> None:
        if channel not in self.channels:
            has = ", ".join(self.channels) or "none"
            raise RsbenchError(
                f"{self.folder}: has no channel {channel!r} ({has}); make it with: generate --channels {channel}"
            )

    @property
    def _size(self) -> tuple[int, int]:
        return self.rig.camera.width, self.rig.camera.height
