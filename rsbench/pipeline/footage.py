"""A user's own footage: the card of its rig or camera, and frames from files, folders and videos.

Frames are read as the sensor delivered them, and orientation tags are ignored: rotating an image would turn its
rows, which a rolling shutter reads one after the other, into columns.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.calibration import CardSigma, offset_error
from rsbench.components.cards import SHUTTER_KEY, card_path, parse_card, read_toml
from rsbench.components.rig_tables import CameraTable, RightFromLeft, Size, rig_of_tables, tables_of, with_readouts
from rsbench.core.arguments import LARGEST_M, LARGEST_SIZE, check_number, check_positive
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scan, Scanning, StatedShutter
from rsbench.core.so3 import FloatArray
from rsbench.storage.untrusted_files import check_image_size, read_bytes
from rsbench.storage.videos import ORIENTATIONS, UPRIGHT, Times, VideoFile

if TYPE_CHECKING:
    from rsbench.capture.hypotheses import KnownInputs

_SMALLEST = 32
"""Least length of the shorter side, pixels; smaller images have too little to match."""
_LARGEST_OFFSET_PX = 10.0
_WIDEST_DEG = 170.0
DEFAULT_FOCAL = 1.0
"""Focal length in widths of the image if none is given: a horizontal field of view of 53 degrees."""
_LONGEST_S = 1e4
"""Longest frame period, seconds."""
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm"}


Progress: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]
"""Opens a progress display from a label and a number of parts; the yielded function is called after each part."""


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
    """Standard deviation of fx, pixels (fx = 520 +- 20); it is then estimated with the motion. Absent: exact."""
    k1_sigma: float = 0.0
    """Standard deviation of the lens's k1 (-0.20 +- 0.02; without a lens, of a k1 of 0), which is then estimated
    with the motion. Absent: k1 is exact."""

    def __post_init__(self) -> None:
        check_number("focal_sigma", self.focal_sigma, least=0.0, most=0.3 * abs(self.fx))
        check_number("k1_sigma", self.k1_sigma, least=0.0, most=0.3)

    @property
    def sigma(self) -> CardSigma:
        """Standard deviations of the intrinsics."""
        return CardSigma(focal=self.focal_sigma, k1=self.k1_sigma)

    def camera(self, size: Size) -> PinholeCamera:
        """The camera for images of this (width, height); ValueError if its lens is impossible for such images."""
        (width, height), lens = size, self.lens
        return PinholeCamera(width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, lens=lens)


@dataclass(frozen=True, kw_only=True)
class RigCard(StatedShutter):
    """Calibration and shutter of a rig: of two equal aligned cameras, or of any two.

    If the card gives no sizes, those of the images are used.
    """

    SHORTHANDS: ClassVar = SHUTTER_KEY

    description: str = ""
    """Cameras and mode, in words."""
    source: str = ""
    """Where the calibration comes from."""
    camera: CameraCard | None = None
    """Intrinsics of both cameras, if they are equal and aligned."""
    baseline: float | None = None
    """Distance between the cameras, metres; with ``left`` and ``right``, both must look in the same direction."""
    left: CameraTable | None = None
    """The left camera, with ``right`` in place of ``camera``."""
    right: CameraTable | None = None
    """The right camera."""
    right_from_left: RightFromLeft | None = None
    """Pose of the right camera relative to the left one, in place of ``baseline``."""
    frame_period_s: float | None = None
    """Time between frames, seconds; needed for values in seconds: ``shutter``, ``line_delay_s``, ``delay_s``."""
    disparity_offset: float | None = None
    """Error by which matched disparities are too large, pixels; absent: estimated if the matches show errors."""

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
    def inputs(self) -> KnownInputs:
        """The values that the card gives to the estimation of a capture."""
        from rsbench.capture.hypotheses import KnownInputs  # slow to load, for a card that may be refused

        errors = None if self.disparity_offset is None else offset_error(self.disparity_offset)
        sigma = CardSigma() if self.camera is None else self.camera.sigma
        ratio, scanning = self.readout_ratio, self.scanning
        return KnownInputs(readout_ratio=ratio, scanning=scanning, calibration=errors, sigma=sigma)

    @property
    def _sizes(self) -> tuple[Size, Size]:
        """(width, height) of the left and the right images; a lower bound if the card does not give them."""
        if self.left is None or self.right is None:
            return (1, 1), (1, 1)
        left, right = (each.size or (_within(each.cx), _within(each.cy)) for each in (self.left, self.right))
        return left, right

    def rig(self, left: Size, right: Size | None = None) -> StereoRig:
        """The rig for images of these (width, height); ``right`` is the same as ``left`` if absent.

        Raises:
            ValueError: the sizes differ from the card's, or a lens or the extrinsics are impossible for such
                images.
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

    def rig_of(self, left: NDArray[Any], right: NDArray[Any]) -> StereoRig:
        """The rig for a left and a right image; RsbenchError if the card contradicts their sizes."""
        sizes = [(image.shape[1], image.shape[0]) for image in (left, right)]
        try:
            return self.rig(*sizes)
        except ValueError as error:
            words = " and ".join(dict.fromkeys(f"{width} x {height}" for width, height in sizes))
            raise RsbenchError(f"--rig: for images of {words} pixels: {error}") from error


@dataclass(frozen=True, kw_only=True)
class OneCameraCard:
    """Calibration and shutter of a camera whose frames are corrected alone; its size comes from the images."""

    SHORTHANDS: ClassVar = SHUTTER_KEY

    readout_ratio: float | None = None
    """Readout time divided by frame period, 0 to 1. Absent: estimated from the frames."""
    frame_period_s: float | None = None
    """Time between frames, seconds, if it is not that of the mode that ``shutter`` names. A video with another
    frame rate is recognised."""
    scan: Scan | None = None
    """Side of the image at which the readout begins. Absent: estimated with the readout ratio, else ``top``."""
    fov_deg: float | None = None
    """Horizontal field of view, degrees, in place of ``camera``. Without both, the focal length is estimated from
    the frames; if they do not determine it, the width of the image is used."""
    camera: CameraCard | None = None
    """Intrinsics."""

    def __post_init__(self) -> None:
        if self.readout_ratio is not None and not 0.0 <= self.readout_ratio <= 1.0:
            raise ValueError(f"readout_ratio = {self.readout_ratio}: must lie in [0, 1]")
        if self.frame_period_s is not None and not self.frame_period_s > 0.0:
            raise ValueError(f"frame_period_s = {self.frame_period_s}: must be positive")
        if self.fov_deg is not None and not 0.0 < self.fov_deg <= _WIDEST_DEG:
            raise ValueError(f"fov_deg = {self.fov_deg}: must lie in (0, {_WIDEST_DEG:g}]")
        if self.fov_deg is not None and self.camera is not None:
            raise ValueError("fov_deg: leave it out, since [camera] gives the focal length")
        if self.camera is not None and self.camera.sigma:
            raise ValueError("camera.focal_sigma, k1_sigma: leave them out; neither is estimated for one camera")

    @classmethod
    def of(cls, camera: PinholeCamera | float | None, readout_ratio: float | None) -> OneCameraCard:
        """The card for intrinsics, a field of view in degrees, or neither; RsbenchError if impossible."""
        known: dict[str, Any] = {} if camera is None else {"fov_deg": camera}
        if isinstance(camera, PinholeCamera):
            c = camera
            known = {"camera": CameraCard(fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, lens=c.lens)}
        try:
            return cls(readout_ratio=readout_ratio, **known)
        except ValueError as error:
            raise RsbenchError(str(error)) from error

    @property
    def focal_unknown(self) -> bool:
        """Whether no focal length is given."""
        return self.camera is None and self.fov_deg is None

    def camera_of(self, width: int, height: int) -> PinholeCamera:
        """The camera for images of this size, with ``DEFAULT_FOCAL`` if no focal length is given."""
        if self.camera is not None:
            try:
                return self.camera.camera((width, height))
            except ValueError as error:
                raise RsbenchError(f"--camera: for images of {width} x {height} pixels: {error}") from error
        if self.fov_deg is not None:
            focal = 0.5 * width / math.tan(math.radians(0.5 * self.fov_deg))
            return PinholeCamera.centred(width, height, focal)
        return PinholeCamera.centred(width, height, DEFAULT_FOCAL * width)


def _within(centre: float) -> int:
    """Least number of columns or rows of an image with its principal point at this one."""
    return min(max(math.ceil(centre) + 1, 1), LARGEST_SIZE)


def read_rig_card(path: Path) -> RigCard:
    """The card of a rig: ``baseline`` and ``[camera]``, or ``[left]``, ``[right]`` and ``[right_from_left]``.

    ``readout_ratio`` or ``shutter``, and ``scan``, stand above the tables or in those of the cameras. A path
    without a folder and suffix is the name of a card in ``cards/rigs/``, unless such a file exists.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    path = rig_path(path)
    return parse_card(RigCard, with_readouts(read_toml(path), str(path)), str(path))


def rig_path(path: Path) -> Path:
    """The path, or that of the card in ``cards/rigs/`` with this name; RsbenchError if there is none."""
    named = not path.suffix and path == Path(path.name) and not path.exists()
    return card_path("rigs", path.name) if named else path


def rig_card_of(rig: StereoRig, shutter: RollingShutter) -> RigCard:
    """The card of a given rig and shutter."""
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
    """Read an image as (H, W) grey or (H, W, 3) RGB, uint8 or uint16, without transparency and orientation tags.

    Raises:
        RsbenchError: the file is missing, not an image, too small, too large, or of another type.
    """
    import cv2

    data = read_bytes(path)
    check_image_size(data, path)
    how = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how)
    if pixels is None:
        raise RsbenchError(f"{path}: cannot be decoded as an image")
    return _checked(pixels, str(path))


def _checked(pixels: NDArray[Any], where: str) -> NDArray[Any]:
    """Check an image of OpenCV, BGR or grey, and convert it to RGB or grey."""
    import cv2

    if pixels.dtype not in (np.uint8, np.uint16):
        raise RsbenchError(f"{where}: has {pixels.dtype} pixels; 8 and 16 bit are allowed")
    _checked_size(pixels, where)
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., 0])


def _checked_size(pixels: NDArray[Any], where: str) -> NDArray[Any]:
    if min(pixels.shape[:2]) < _SMALLEST:
        raise RsbenchError(
            f"{where}: is {pixels.shape[1]} x {pixels.shape[0]} pixels; at least {_SMALLEST} x {_SMALLEST} needed"
        )
    return pixels


def read_four(paths: dict[View, Path]) -> dict[View, NDArray[Any]]:
    """Read the four frames of one motion: all of one type, and those of a camera of one size.

    Raises:
        RsbenchError: see ``read_frame`` and ``check_alike``.
    """
    frames = {view: read_frame(path) for view, path in paths.items()}
    for side in SIDES:
        check_alike({str(paths[view]): frame for view, frame in frames.items() if view[0] == side})
    check_alike({str(paths[view]): frame for view, frame in frames.items()}, sizes=False)
    return frames


def check_alike(frames: dict[str, NDArray[Any]], *, sizes: bool = True) -> None:
    """Check that all frames have the channels and depth of the first, and with ``sizes`` its size.

    Raises:
        RsbenchError: a frame differs; the message names it.
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


_ABOUT = 0.15


def about_one(periods: Any) -> Any:
    """Mask (...) of intervals that a trajectory may treat as one frame period."""
    return np.abs(np.asarray(periods) - 1.0) <= _ABOUT


@dataclass(frozen=True, kw_only=True, eq=False)
class Timeline:
    """The times of a camera's frames, and which frames are copies of earlier ones."""

    twins: NDArray[np.intp]
    """(n,) for each frame the number of the frame that it repeats, or its own number."""
    starts: FloatArray
    """(m,) times of the first rows of ``originals``, frame periods since that of the first."""
    period_s: float | None
    """Median interval between originals, seconds; None for images."""
    first_s: float
    """Time of the first frame in the container, seconds."""

    @property
    def originals(self) -> NDArray[np.intp]:
        """(m,) numbers of the frames that are no copies."""
        return np.flatnonzero(self.twins == np.arange(len(self.twins)))

    @property
    def even(self) -> bool:
        """Whether all originals are one frame period apart."""
        return bool(np.all(np.diff(self.starts) == 1.0))

    def even_run(self) -> slice:
        """The longest run of originals about one period apart, or all if no run has ``_LEAST_RUN`` frames."""
        breaks = np.flatnonzero(~about_one(np.diff(self.starts))) + 1
        edges = np.concatenate([[0], breaks, [len(self.starts)]])
        longest = int(np.argmax(np.diff(edges)))
        low, high = int(edges[longest]), int(edges[longest + 1])
        return slice(low, high) if high - low >= _LEAST_RUN else slice(0, len(self.starts))

    @property
    def words(self) -> list[str]:
        """One line of text for copies, and one for uneven intervals, if there are any."""
        lines, copies = list[str](), len(self.twins) - len(self.starts)
        if copies:
            lines.append(f"{copies} of {len(self.twins)} frames repeat the previous one and get its result")
        uneven = np.diff(self.starts)
        if not self.even:
            lines.append(
                f"{np.count_nonzero(uneven != 1.0)} of {len(uneven)} intervals between frames are not the usual "
                f"{1000.0 * (self.period_s or 0.0):.1f} ms ({uneven.min():.2g} to {uneven.max():.3g} times that): "
                "the time stamps are used"
            )
        return lines


_LEAST_RUN = 12
"""With this many frames the shutter is estimated nearly as well as with more."""
_NEARLY, _SHARE, _NEIGHBOURS = 0.5, 0.1, 3
"""A frame is a copy if it differs from the previous one by fewer grey levels than the first value, and by less
than the second times the largest difference among this many neighbours on either side."""
_COPIES, _EVENLY, _SPREAD = 3, 1.05, 1.0
"""Fewest regularly spaced copies, least periods per original, and largest deviation, periods, for which originals
are taken to be evenly spaced in time (a video converted from a lower frame rate)."""
_JITTER = 0.01
"""Error of time stamps in addition to their rounding, frame periods."""


def _twins_of(difference: NDArray[np.float32]) -> NDArray[np.intp]:
    """``Timeline.twins`` (n,) from the difference of each frame to the previous one, grey levels."""
    count = len(difference)
    finite = np.where(np.isfinite(difference), difference, 0.0)
    padded = np.pad(finite, _NEIGHBOURS)
    around = np.max(np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1), axis=1)
    copies = (difference == 0.0) | ((difference < _NEARLY) & (difference < _SHARE * around))
    if np.count_nonzero(~copies) < 2:  # a still scene
        return np.arange(count)
    return np.maximum.accumulate(np.where(copies, 0, np.arange(count)))


def _even_spacing(originals: NDArray[np.intp], count: int) -> float | None:
    """Container periods per original frame if regular copies fill up a higher frame rate; else None."""
    copies = np.setdiff1d(np.arange(count), originals)
    if len(copies) < _COPIES or len(originals) < 2 or np.ptp(np.diff(copies)) > 1:
        return None
    between = np.count_nonzero((originals > copies[0]) & (originals < copies[-1]))
    slope = (copies[-1] - copies[0]) / max(between, 1)
    off = originals - slope * np.arange(len(originals))
    off = np.abs(off - np.median(off))
    return float(slope) if slope > _EVENLY and np.max(off) < _SPREAD else None


def _timeline(twins: NDArray[np.intp], times: Times | None) -> Timeline:
    """The timeline of frames with given twins (n,), from the time stamps of a video if there are some."""
    count = len(twins)
    originals = np.flatnonzero(twins == np.arange(count))
    seconds = None if times is None else times.seconds
    if len(originals) < 2:
        return Timeline(twins=twins, starts=np.arange(float(len(originals))), period_s=None, first_s=0.0)
    spread = _even_spacing(originals, count)
    if seconds is None or times is None:
        starts = np.arange(float(len(originals))) if spread else originals - float(originals[0])
        return Timeline(twins=twins, starts=starts.astype(np.float64), period_s=None, first_s=0.0)
    period = float(np.quantile(np.diff(seconds[originals]), 0.5, method="lower"))  # an interval that occurs
    first = float(seconds[0])
    if spread:
        period = spread * float(seconds[-1] - first) / (count - 1)
        return Timeline(twins=twins, starts=np.arange(float(len(originals))), period_s=period, first_s=first)
    steps = np.diff(seconds[originals]) / period
    rounded = np.maximum(np.rint(steps), 1.0)
    exact = np.abs(steps - rounded) <= 2.0 * float(times.base) / period + _JITTER
    starts = np.concatenate([[0.0], np.cumsum(np.where(exact, rounded, steps))])
    if bool(np.all(exact)):
        period = float((seconds[originals][-1] - seconds[originals][0]) / starts[-1])
    return Timeline(twins=twins, starts=starts, period_s=period, first_s=first)


def _natural(file: Path) -> tuple[list[tuple[int, str]], str]:
    """Sort key by which 2 comes before 10."""
    parts = re.split(r"(\d+)", file.stem)
    return [(int(each), "") if k % 2 else (0, each) for k, each in enumerate(parts)], file.name


def _orientation_of(file: Path) -> int:
    """EXIF orientation of an image file; ``UPRIGHT`` if it has none."""
    from PIL import Image

    with suppress(Exception), Image.open(file) as image:  # Pillow raises various exceptions for a damaged file
        number = int(image.getexif().get(_EXIF_ORIENTATION, UPRIGHT))
        return number if number in ORIENTATIONS else UPRIGHT
    return UPRIGHT


_EXIF_ORIENTATION = 0x0112
Part: TypeAlias = Literal["whole", "left", "right"]


class FrameSource:
    """Frames of one camera, in order, from a folder of images (by name) or a video; can be read repeatedly."""

    _part: Part = "whole"
    _files: Sequence[Path] = ()
    _video: VideoFile | None = None
    _kept: frozenset[int] | None = None

    def __init__(self, path: Path, part: Part = "whole") -> None:
        """Open a folder or video; ``part`` selects a half of frames that show two cameras side by side.

        Raises:
            RsbenchError: the path is missing, has no frames, or is not a readable video.
        """
        self.path, self._part = path, part
        if path.is_dir():
            images = (file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
            self._files = sorted((file for file in images if not file.name.startswith(".")), key=_natural)
            if not self._files:
                raise RsbenchError(f"{path}: no images; files may end in {', '.join(sorted(IMAGE_SUFFIXES))}")
            self.count = len(self._files)
        elif path.is_file():
            self._video = VideoFile.open(path)
            self.count = self._video.count  # from the header, which may be wrong: used for progress only
        else:
            raise RsbenchError(f"{path}: no such folder or video")

    @classmethod
    def of_files(cls, files: list[Path]) -> FrameSource:
        """Frames of these files, in this order; RsbenchError if there are none."""
        if not files:
            raise RsbenchError("no frames")
        source = cls.__new__(cls)
        source.path, source._files, source.count = files[0].parent, files, len(files)
        return source

    @property
    def video(self) -> VideoFile | None:
        """The video file; None for images."""
        return self._video

    @cached_property
    def orientation(self) -> int:
        """EXIF orientation with which the frames, which are read as stored, should be displayed."""
        return self._video.orientation if self._video is not None else _orientation_of(self._files[0])

    @cached_property
    def times(self) -> Times | None:
        """Time stamps of a video's frames; None for images."""
        return None if self._video is None else self._video.times()

    @cached_property
    def timeline(self) -> Timeline:
        """The times of the frames, and which are copies; this reads all frames."""
        if self.times is not None:
            self.count = len(self.times.seconds)
            return _timeline(_twins_of(self.times.nearly), self.times)
        digests = [hashlib.sha256(read_bytes(file)).digest() for file in self._files]
        same = [0.0 if a == b else np.inf for a, b in itertools.pairwise(digests)]
        return _timeline(_twins_of(np.array([np.inf, *same], dtype=np.float32)), None)

    def only(self, numbers: Iterable[int]) -> FrameSource:
        """The source restricted to frames of these numbers."""
        source = copy.copy(self)
        source._kept = frozenset(int(each) for each in numbers)
        source.count = len(source._kept)
        return source

    def identity(self) -> list[str]:
        """Text that identifies the frames: paths, sizes and modification times of the files, and the part."""
        files = [(path.resolve(), path.stat()) for path in self._files or [self.path]]
        part = [] if self._part == "whole" else [self._part]
        return part + [f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in files]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        kept = self._kept
        if self._files:
            files = enumerate(self._files)
            frames = (read_frame(file) for number, file in files if kept is None or number in kept)
        else:
            assert self._video is not None
            decoded = enumerate(self._video.frames())
            last = None if kept is None else max(kept) + 1
            frames = (
                _checked_size(frame, f"{self.path}, frame {number}")
                for number, frame in itertools.islice(decoded, last)
                if kept is None or number in kept
            )
        for frame in frames:
            yield self._part_of(frame)

    def _part_of(self, frame: NDArray[Any]) -> NDArray[Any]:
        if self._part == "whole":
            return frame
        half = frame.shape[1] // 2
        return np.ascontiguousarray(frame[:, :half] if self._part == "left" else frame[:, half : 2 * half])


class ImageSource(FrameSource):
    """Frames in memory, one per frame period."""

    def __init__(self, images: Iterable[NDArray[Any]]) -> None:
        """Images (H, W[, 3]) in order."""
        self.path, self._images = Path("images"), list(images)
        self.count = len(self._images)

    @cached_property
    def orientation(self) -> int:
        """1: the images are displayed as they are."""
        return 1

    def identity(self) -> list[str]:
        """Digests of the images."""
        return [hashlib.sha256(image.tobytes()).hexdigest() for image in self._images]

    @cached_property
    def timeline(self) -> Timeline:
        """Evenly spaced frames without copies."""
        return _timeline(np.arange(self.count), None)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return iter([each for k, each in enumerate(self._images) if self._kept is None or k in self._kept])


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """Time and memory to correct frames of one camera, measured on two cores (``benchmarks/phone_video.py``)."""

    seconds: float
    """Seconds per frame and million pixels."""
    frame_s: float
    """Seconds per frame of any size."""
    start_s: float
    memory: tuple[tuple[float, ...], tuple[float, ...]]
    """Million pixels of a frame, and GB for such frames, of which larger ones are shrunk for their flow."""

    def words(self, frames: int, pixels: int) -> str:
        """Text with the time and memory for a number of frames with a number of pixels each."""
        seconds = self.start_s + frames * (self.frame_s + self.seconds * pixels / 1e6)
        gigabytes = float(np.interp(pixels / 1e6, *self.memory))
        time = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
        return f"about {time} on two cores, {gigabytes:.1f} GB of memory"


FORECAST = Forecast(
    seconds=0.5, frame_s=0.25, start_s=16.0, memory=((0.0, 0.23, 2.07, 8.29), (0.5, 0.65, 1.95, 3.1))
)
