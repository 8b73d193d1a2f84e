"""Channels of ground truth that a card may ask for beside images, depth and poses: names, files and values."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from enum import IntEnum
from typing import Literal, NamedTuple, get_args

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, View, views_of
from rsbench.dataset.imu import IMU_FILES
from rsbench.dataset.timing import timing_files

PairChannel = Literal["disparity", "flow", "gs_flow"]
"""Where each pixel of a rolling-shutter frame lies in another picture: of the other camera at the same time
(disparity), of the same camera at the next time (flow; of the last frame, at the time before), and of its
global-shutter twin (gs_flow)."""
Channel = Literal[
    "disparity", "flow", "gs_flow", "timing", "normals", "instances", "imu", "tracks", "affine", "hdr", "matches"
]

INSTANCE_TABLE, TRACKS, AFFINE = "instances.json", "tracks.npz", "affine.npz"
MATCHER = "matches/matcher.json"
PAIR_CHANNELS: tuple[PairChannel, ...] = get_args(PairChannel)
CHANNELS: tuple[Channel, ...] = get_args(Channel)
COMPONENTS: dict[PairChannel, tuple[str, ...]] = {"disparity": ("d",), "flow": ("x", "y"), "gs_flow": ("x", "y")}
"""Names of the float32 channels of the EXR files."""

NORMAL_COMPONENTS = ("x", "y", "z")
RADIANCE_COMPONENTS = ("R", "G", "B")
STEP_PX = 2.0**-10
"""Values are rounded to multiples of it, which makes the files four times smaller."""


class PixelClass(IntEnum):
    """What became of a pixel's surface in the other picture: the values of a mask."""

    UNSOLVED = 0
    """The row that sees it could not be found; no value."""
    VISIBLE = 1
    OCCLUDED = 2
    """In view, but something nearer hides it."""
    OUT_OF_VIEW = 3
    """Beside the picture or behind the camera, sky too."""
    SKY = 4
    """No surface here, and none there: the value is that of the direction."""
    SKY_OCCLUDED = 5
    """No surface here, but one there."""


def check_channels(names: Collection[str], lens: bool, plain: bool) -> None:
    """Whether cameras can have these channels: with a lens or not, reading rows from the top together or not.

    Raises:
        ValueError: one line with the channel.
    """
    if "affine" in names and "tracks" not in names:
        raise ValueError("channels: 'affine' is of the points of 'tracks': ask for both")
    if "disparity" not in names:
        return
    if not plain:
        raise ValueError(
            "channels: 'disparity' is made of cameras that read rows from the top at once, and no other"
        )
    if lens:
        raise ValueError("channels: 'disparity' is made of cameras without a lens, whose pairs share their rows")


class Layer(NamedTuple):
    """A channel that leads from frames to one picture each."""

    channel: PairChannel
    row: int = 0
    """Of the global-shutter twin to which it leads."""
    back: bool = False
    """Of ``flow``: from the frames between the first and the last to the one before."""

    def values(self, side: str, frame: int) -> str:
        """File below the folder of a sequence, as ``mask`` is."""
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
        """Of a sequence of so many frames those that it leads from."""
        return tuple(view for view in views_of(frames) if not self.back or 0 < view[1] < frames - 1)


def pair_layers(names: Collection[str], twins: Iterable[int], frames: int = len(FRAMES)) -> list[Layer]:
    """Of the channels of these names in a sequence of so many frames."""
    layers = [Layer(channel) for channel in PAIR_CHANNELS if channel in names]
    back = [Layer("flow", back=True)] if "flow" in names and frames > len(FRAMES) else []
    return [*layers, *back, *(Layer("gs_flow", row) for row in twins if "gs_flow" in names)]


def surface_file(channel: Literal["normals", "instances"], side: str, frame: int) -> str:
    return f"{channel}/{side}_{frame}.{'exr' if channel == 'normals' else 'png'}"


def matches_file(first: int) -> str:
    """Of frame ``first`` and the next."""
    return f"matches/{first}.npz"


def radiance_file(side: str, frame: int) -> str:
    return f"hdr/{side}_{frame}.exr"


def channel_files(names: Iterable[str], twins: Iterable[int] = (), frames: int = len(FRAMES)) -> tuple[str, ...]:
    """Paths below a sequence's folder of the channels of these names; those of later versions are nobody's."""
    given, views = set(names), views_of(frames)
    layers = pair_layers(given, twins, frames)
    pairs = (file(*view) for each in layers for file in (each.values, each.mask) for view in each.views(frames))
    timing = timing_files(frames) if "timing" in given else ()
    normals = (surface_file("normals", *view) for view in views if "normals" in given)
    instances = (INSTANCE_TABLE, *(surface_file("instances", *view) for view in views))
    hdr = (radiance_file(*view) for view in views if "hdr" in given)
    whole: dict[str, tuple[str, ...]] = {
        "imu": IMU_FILES,
        "tracks": (TRACKS,),
        "affine": (AFFINE,),
        "matches": (MATCHER, *map(matches_file, range(frames - 1))),
    }
    of_sequence = (file for name, files in whole.items() if name in given for file in files)
    return (*pairs, *timing, *normals, *(instances if "instances" in given else ()), *of_sequence, *hdr)


def named_channels(text: str) -> tuple[Channel, ...]:
    """Channels of a text like "flow,disparity"; "all" and "none" are what they say.

    Raises:
        RsbenchError: a name that no channel has, or one twice.
    """
    if text in ("all", "none"):
        return CHANNELS if text == "all" else ()
    found: list[Channel] = []
    for name in text.split(","):
        matching = [channel for channel in CHANNELS if channel == name.strip()]
        if not matching or matching[0] in found:
            raise RsbenchError(
                f"--channels {text}: {name!r}: allowed are {', '.join(CHANNELS)}, each once, or all, or none"
            )
        found += matching
    return tuple(found)
