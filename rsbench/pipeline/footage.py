"""A user's own footage: the card of the rig, and frames from files, folders and videos.

Frames are read as the sensor delivered them: an orientation tag is ignored, for turning an image turns its rows
into columns, and rows are what a rolling shutter reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.calibration import CardSigma, of_offset
from rsbench.components.cards import SHUTTER_KEY, card_path, parse_card, read_toml
from rsbench.components.rig_tables import CameraTable, RightFromLeft, Size, rig_of_tables, tables_of, with_readouts
from rsbench.core.arguments import LARGEST_M, LARGEST_SIZE, check_number, check_positive
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning, StatedShutter
from rsbench.storage.untrusted_files import check_image_size, check_size, read_bytes

_SMALLEST = 32
"""Pixels of the shorter side; below that there is nothing to match."""
_LARGEST_OFFSET_PX = 10.0
_MOST_FRAMES = 1e9
_LONGEST_S = 1e4
"""Of a frame period."""
_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm"}
_READ = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION


Progress: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]
"""Opens a display of a step, from its label and its number of parts; what it yields is called after each part."""


def no_progress(label: str, total: int) -> AbstractContextManager[Callable[[str], None]]:
    """A ``Progress`` that shows nothing."""
    return nullcontext(lambda word: None)


@dataclass(frozen=True, kw_only=True)
class CameraCard:
    """Intrinsics of a camera, or of both cameras of a rig, pixels; the centre of the top-left pixel is (0, 0)."""

    fx: float
    """Focal length across, pixels."""
    fy: float
    """Focal length down, pixels."""
    cx: float
    """Column of the principal point, pixels."""
    cy: float
    """Row of the principal point, pixels."""
    lens: Lens | None = None
    """Distortion of the lens. Absent: images without distortion."""
    focal_sigma: float = 0.0
    """Standard deviation of fx, pixels (fx = 520 +- 20): the focal length is then found with the motion. Absent:
    it is exact."""
    k1_sigma: float = 0.0
    """Standard deviation of the lens's k1 (-0.20 +- 0.02), of 0 without a lens: it is then found with the motion.
    Absent: it is exact."""

    def __post_init__(self) -> None:
        check_number("focal_sigma", self.focal_sigma, least=0.0, most=0.3 * abs(self.fx))
        check_number("k1_sigma", self.k1_sigma, least=0.0, most=0.3)

    @property
    def sigma(self) -> CardSigma:
        """How sure the card is of them."""
        return CardSigma(focal=self.focal_sigma, k1=self.k1_sigma)

    def camera(self, size: Size) -> PinholeCamera:
        """The camera of images of this (width, height); ValueError where its lens cannot be one of such images."""
        (width, height), lens = size, self.lens
        return PinholeCamera(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, lens=lens)


@dataclass(frozen=True, kw_only=True)
class RigCard(StatedShutter):
    """What must be known of a rig to correct its frames: of two equal aligned cameras, or of any two.

    Sizes come from the images where the card has none.
    """

    SHORTHANDS: ClassVar = SHUTTER_KEY

    description: str = ""
    """Cameras and mode, in words."""
    source: str = ""
    """Where the calibration comes from."""
    camera: CameraCard | None = None
    """Intrinsics of both cameras, where they are the same and aligned."""
    baseline: float | None = None
    """Full distance between the cameras, metres; with ``left`` and ``right`` of cameras that look the same way."""
    left: CameraTable | None = None
    """The left camera, with ``right`` in place of ``camera``."""
    right: CameraTable | None = None
    """The right camera."""
    right_from_left: RightFromLeft | None = None
    """Where the right camera is, in place of ``baseline``."""
    frame_period_s: float | None = None
    """Seconds from one frame to the next, for what is given in seconds: ``shutter``, ``line_delay_s``,
    ``delay_s``."""
    disparity_offset: float | None = None
    """Pixels by which matched disparities are too large; absent: found, where the matches show errors."""

    def __post_init__(self) -> None:
        two = self.left is not None and self.right is not None
        if (self.left is None) != (self.right is None) or (self.camera is not None) == two:
            raise ValueError("camera: give [camera] for two equal aligned cameras, or both [left] and [right]")
        if (self.baseline is None) == (self.right_from_left is None):
            raise ValueError("baseline: give it or [right_from_left], which says where the right camera is")
        if self.right_from_left is not None and not two:
            raise ValueError("right_from_left: needs [left] and [right] in place of [camera]")
        if self.baseline is not None:
            check_positive("baseline", self.baseline, LARGEST_M, "metres")
        if self.frame_period_s is not None:
            check_positive("frame_period_s", self.frame_period_s, _LONGEST_S, "seconds")
        self.rig(*self._sizes)
        (self.scanning or Scanning()).shutter_of(1, 1, 0.0)
        if self.disparity_offset is not None and not abs(self.disparity_offset) <= _LARGEST_OFFSET_PX:
            raise ValueError(
                f"disparity_offset = {self.disparity_offset}: must lie within {_LARGEST_OFFSET_PX:g} px; "
                "calibrate the rig again"
            )
        if self.readout_ratio is not None and not 0.0 <= self.readout_ratio <= 1.0:
            raise ValueError(f"readout_ratio = {self.readout_ratio}: must lie in [0, 1], or be absent if unknown")

    @property
    def calibration(self) -> tuple[float, ...] | None:
        """What the calibration is wrong by; None where it is looked for."""
        return None if self.disparity_offset is None else of_offset(self.disparity_offset)

    @property
    def sigma(self) -> CardSigma:
        """How sure the card is of the intrinsics."""
        return CardSigma(focal=0.0, k1=0.0) if self.camera is None else self.camera.sigma

    @property
    def _sizes(self) -> tuple[Size, Size]:
        """(width, height) of the left and the right images; of a part of them where the card does not say."""
        if self.left is None or self.right is None:
            return (1, 1), (1, 1)
        left, right = (each.size or (_within(each.cx), _within(each.cy)) for each in (self.left, self.right))
        return left, right

    def rig(self, left: Size, right: Size | None = None) -> StereoRig:
        """The rig with images of these (width, height); those of the right camera are as the left ones if absent.

        Raises:
            ValueError: other sizes than the card's, a lens that cannot be one of such images, or impossible
                extrinsics.
        """
        right = right or left
        if self.camera is not None and self.baseline is not None:
            if left != right:
                raise ValueError(
                    f"right images are {right[0]} x {right[1]} pixels, left ones {left[0]} x {left[1]}: the card "
                    "needs [left] and [right] in place of [camera]"
                )
            return StereoRig(camera=self.camera.camera(left), baseline=self.baseline)
        assert self.left is not None and self.right is not None
        apart = self.right_from_left or RightFromLeft(translation=(-(self.baseline or 0.0), 0.0, 0.0))
        return rig_of_tables(self.left, self.right, apart, {"left": left, "right": right})


def _within(centre: float) -> int:
    """Columns or rows that an image surely has whose principal point lies at this one."""
    return min(max(math.ceil(centre) + 1, 1), LARGEST_SIZE)


def read_rig_card(path: Path) -> RigCard:
    """The card of a rig: ``baseline`` and ``[camera]``, or ``[left]``, ``[right]`` and ``[right_from_left]``.

    ``readout_ratio`` or ``shutter``, ``scan`` are above the tables, or in those of the cameras. A word without an
    ending is the name of a card in ``cards/rigs/``, unless there is such a file.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    path = rig_path(path)
    return parse_card(RigCard, with_readouts(read_toml(path), str(path)), str(path))


def rig_path(path: Path) -> Path:
    """The path, or that of the card in ``cards/rigs/`` that it names; RsbenchError where it names none."""
    named = not path.suffix and path == Path(path.name) and not path.exists()
    return card_path("rigs", path.name) if named else path


def rig_card_of(rig: StereoRig, shutter: RollingShutter) -> RigCard:
    """The card of cameras that are known."""
    readout = {"readout_ratio": shutter.readout_ratio, **asdict(shutter.scanning)}
    if not rig.aligned:
        return parse_card(
            RigCard,
            {**tables_of(rig), **{name: value for name, value in readout.items() if value is not None}},
            "rig",
        )
    c = rig.camera
    camera = CameraCard(fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, lens=c.lens)
    return RigCard(camera=camera, baseline=rig.baseline, **readout)


def read_frame(path: Path) -> NDArray[Any]:
    """Image (H, W) grey or (H, W, 3) RGB, uint8 or uint16; transparency and orientation tags are ignored.

    Raises:
        RsbenchError: missing, not an image, too small, too large, or of another type.
    """
    data = read_bytes(path)
    check_image_size(data, path)
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _READ)
    if pixels is None:
        raise RsbenchError(f"{path}: cannot be decoded as an image")
    return _checked(pixels, str(path))


def _checked(pixels: NDArray[Any], where: str) -> NDArray[Any]:
    """RGB or grey image from OpenCV's BGR or grey."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise RsbenchError(f"{where}: has {pixels.dtype} pixels; 8 and 16 bit are allowed")
    if min(pixels.shape[:2]) < _SMALLEST:
        raise RsbenchError(
            f"{where}: is {pixels.shape[1]} x {pixels.shape[0]} pixels; at least {_SMALLEST} x {_SMALLEST} needed"
        )
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., 0])


def read_four(paths: dict[View, Path]) -> dict[View, NDArray[Any]]:
    """The four frames of one motion; all of one kind, those of a camera of one size.

    Raises:
        RsbenchError: see ``read_frame`` and ``check_alike``.
    """
    frames = {view: read_frame(path) for view, path in paths.items()}
    for side in SIDES:
        check_alike({str(paths[view]): frame for view, frame in frames.items() if view[0] == side})
    check_alike({str(paths[view]): frame for view, frame in frames.items()}, sizes=False)
    return frames


def check_alike(frames: dict[str, NDArray[Any]], *, sizes: bool = True) -> None:
    """All frames must have the channels and depth of the first, and its size unless ``sizes`` may differ.

    Raises:
        RsbenchError: names the frame that differs.
    """
    first_name, first = next(iter(frames.items()))
    for name, frame in frames.items():
        same = frame.shape == first.shape if sizes else frame.shape[2:] == first.shape[2:]
        if not same or frame.dtype != first.dtype:
            raise RsbenchError(
                f"{name}: is {_kind(frame)}, but {first_name} is {_kind(first)}; all frames must be alike"
            )


def _kind(frame: NDArray[Any]) -> str:
    height, width = frame.shape[:2]
    colour = "grey" if frame.ndim == 2 else "colour"
    return f"{width} x {height} {8 * frame.dtype.itemsize}-bit {colour}"


class FrameSource:
    """Frames of one camera, in order, from a folder of images (by name) or a video; can be read repeatedly."""

    def __init__(self, path: Path) -> None:
        """Open a folder or video.

        Raises:
            RsbenchError: missing, no frames, or not a video that OpenCV can read.
        """
        self.path = path
        self._files: list[Path] = []
        if path.is_dir():
            self._files = sorted(file for file in path.iterdir() if file.suffix.lower() in _IMAGE_SUFFIXES)
            if not self._files:
                raise RsbenchError(f"{path}: no images; files may end in {', '.join(sorted(_IMAGE_SUFFIXES))}")
            self.count = len(self._files)
        elif path.is_file():
            video = self._open()
            count = video.get(cv2.CAP_PROP_FRAME_COUNT)  # as the file says: progress alone believes it
            self.count = int(count) if 0.0 <= count < _MOST_FRAMES else 0
            video.release()
        else:
            raise RsbenchError(f"{path}: no such folder or video")

    @classmethod
    def of_files(cls, files: list[Path]) -> FrameSource:
        """Frames of these files, in this order; RsbenchError where there are none."""
        if not files:
            raise RsbenchError("no frames")
        source = cls.__new__(cls)
        source.path, source._files, source.count = files[0].parent, files, len(files)
        return source

    def identity(self) -> list[str]:
        """Of its files: paths, sizes and times of change."""
        files = [(path.resolve(), path.stat()) for path in self._files or [self.path]]
        return [f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in files]

    def _open(self) -> Any:
        video = cv2.VideoCapture(str(self.path))
        if not video.isOpened():
            raise RsbenchError(f"{self.path}: cannot be read as a video")
        width, height = (video.get(what) for what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        check_size(self.path, (int(width), int(height)))
        # Turning frames would turn rows into columns.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return video

    def __iter__(self) -> Iterator[NDArray[Any]]:
        if self._files:
            yield from map(read_frame, self._files)
            return
        video = self._open()
        try:
            number = 0
            while True:
                ok, pixels = video.read()
                if not ok:
                    return
                yield _checked(pixels, f"{self.path}, frame {number}")
                number += 1
        finally:
            video.release()
