"""Read and write video files with FFmpeg through PyAV; written files play on phones.

A container states how its frames are rotated for display. Frames are read without this rotation, because a
rotation by 90 degrees would turn the rows that a rolling shutter reads into columns. The orientation is returned
separately, as an EXIF orientation (1 to 8), and is stored in the videos that are written.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.storage.untrusted_files import check_size

if TYPE_CHECKING:
    import av

Image: TypeAlias = NDArray[Any]
UPRIGHT = 1
_MATRICES = {
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}
"""a, b, c, d by EXIF orientation: a stored pixel (x, y) is shown at (a x + c y, b x + d y), up to a shift."""
ORIENTATIONS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by 90 degrees",
    6: "turned by 90 degrees",
    7: "mirrored and turned by 270 degrees",
    8: "turned by 270 degrees",
}
"""Descriptions of the orientations; rotations are clockwise."""
_CODECS = {".mp4": "libx264", ".m4v": "libx264", ".mov": "libx264", ".avi": "mjpeg", ".mkv": "ffv1"}
"""Codec by the file's suffix; FFV1 is lossless."""
_OTHERS = {".webm", ".wmv", ".mpg", ".mpeg", ".flv", ".ogv", ".3gp", ".ts", ".mts", ".gif", ".hevc", ".h264"}
"""Suffixes of video files that cannot be written."""
SUFFIXES = frozenset(_CODECS)
_QUALITY = {"libx264": {"crf": "17", "preset": "fast"}, "mjpeg": {"qmin": "2", "qmax": "2"}}
_TAGS = ("color_range", "colorspace", "color_primaries", "color_trc")
_FULL, _LIMITED = 2, 1
"""FFmpeg's identifiers of the colour ranges."""
_LOSSLESS = {("u1", 2): "gray", ("u1", 3): "bgr0", ("u2", 2): "gray16le", ("u2", 3): "gbrp16le"}
"""Pixel formats of FFV1 by the type and the number of dimensions of an image (H, W[, 3])."""
_BRIGHT = 99.9
"""Percentile of the values of a 16-bit image that is mapped to white in 8 bits."""
_BEFORE = 1.0
"""Seconds by which the sound may be written ahead of the frames."""


SIDEWAYS = tuple(number for number, matrix in _MATRICES.items() if matrix[0] == 0)
"""Orientations in which a stored row is shown as a column."""


def upright(image: Image, orientation: int) -> Image:
    """Return a stored image (H, W[, C]) rotated for display."""
    a, b, c, d = _MATRICES[orientation]
    turned = np.swapaxes(image, 0, 1) if a == 0 else image
    across, down = (c, b) if a == 0 else (a, d)
    return np.ascontiguousarray(turned[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def written_as_video(out: Path) -> bool:
    """Return whether the suffix of a path is one of ``SUFFIXES``.

    Raises:
        RsbenchError: the suffix is that of a video format that cannot be written.
    """
    suffix = out.suffix.lower()
    if suffix in _OTHERS:
        raise RsbenchError(
            f"--out {out}: {suffix} is not written; give .mp4 or .mov (H.264), .mkv (lossless), .avi or a folder"
        )
    return suffix in _CODECS


def said_fps(path: Path) -> float | None:
    """Return the frame rate (1/s) of a video file; None for a folder, or if the file does not state it."""
    return VideoFile.open(path).rate if path.is_file() else None


@dataclass(frozen=True, kw_only=True)
class Times:
    """Time stamps of the frames of a video."""

    seconds: NDArray[np.float64]
    """(n,) time of each frame, s, increasing."""
    stamps: tuple[int, ...]
    """The same times in units of ``base``."""
    base: Fraction
    """Unit of ``stamps``, s."""
    nearly: NDArray[np.float32]
    """(n,) mean absolute difference to the previous frame, 8-bit grey levels; infinite for the first frame."""


@dataclass(frozen=True, kw_only=True)
class VideoFile:
    """A video that can be read repeatedly."""

    path: Path
    width: int
    height: int
    """Height of frames as they are stored, before rotation for display."""
    count: int
    """Number of frames according to the file; 0 if it does not state it."""
    rate: float | None
    """Mean frame rate according to the file, 1/s."""
    orientation: int
    deep: bool
    """Whether it has more than 8 bits for each channel."""
    tags: tuple[int, ...]
    """Colour range and colour space, as FFmpeg's identifiers in the order of ``_TAGS``."""
    sound: str
    """Codec of the sound; empty if there is none."""

    @classmethod
    def open(cls, path: Path) -> VideoFile:
        """Read the metadata of a video file, and its first frame.

        Raises:
            RsbenchError: it cannot be read as a video, or its frames are too large.
        """
        with _opened(path) as container:
            stream = container.streams.video[0]
            context = stream.codec_context
            check_size(path, (context.width, context.height))
            try:
                first = next(container.decode(stream), None)
            except _errors() as error:
                raise RsbenchError(f"{path}: cannot be read as a video: {_words(error)}") from error
            rate = stream.average_rate or stream.guessed_rate
            fps = float(rate) if rate else 0.0
            sound = [each for each in container.streams.audio if each.codec_context is not None]
            return cls(
                path=path,
                width=context.width,
                height=context.height,
                count=max(int(stream.frames), 0),
                rate=fps if 1.0 <= fps <= 1000.0 else None,
                orientation=UPRIGHT if first is None else _orientation(first),
                deep=first is not None and max(each.bits for each in first.format.components) > 8,
                tags=(0, 2, 2, 2) if first is None else tuple(int(getattr(first, each)) for each in _TAGS),
                sound=sound[0].codec_context.name if sound else "",
            )

    def frames(self) -> Iterator[Image]:
        """Yield the images, (H, W, 3) RGB or (H, W) grey; uint16 if the video has more than 8 bits, else uint8.

        Raises:
            RsbenchError: a frame cannot be decoded, or has another size.
        """
        grey: bool | None = None
        for number, frame in enumerate(self._decoded()):
            grey = frame.format.name.startswith("gray") if grey is None else grey
            wanted = ("gray16le" if self.deep else "gray") if grey else ("rgb48le" if self.deep else "rgb24")
            if (frame.width, frame.height) != (self.width, self.height):
                raise RsbenchError(
                    f"{self.path}, frame {number}: is {frame.width} x {frame.height} pixels, those before "
                    f"{self.width} x {self.height}; cut the video there"
                )
            yield frame.reformat(format=wanted, interpolation="BICUBIC").to_ndarray()

    def times(self) -> Times:
        """Return the times of all frames and the difference of each to the previous one; decodes all frames.

        Some cameras write frames without increasing times; all times are then computed from the frame rate.
        """
        stamps, nearly, base, before = list[int | None](), list[float](), Fraction(1), None
        for frame in self._decoded():
            base = frame.time_base or base
            stamps.append(frame.pts)
            luma = _luma(frame)
            nearly.append(np.inf if before is None else float(np.mean(np.abs(luma - before))))
            before = luma
        whole = [each for each in stamps if each is not None]
        if len(whole) < len(stamps) or any(b <= a for a, b in itertools.pairwise(whole)):
            base = 1 / Fraction(self.rate or 30.0).limit_denominator(1001)
            whole = list(range(len(stamps)))
        return Times(
            seconds=np.array([float(each * base) for each in whole]),
            stamps=tuple(whole),
            base=base,
            nearly=np.array(nearly, dtype=np.float32),
        )

    def _decoded(self) -> Iterator[Any]:
        number = 0
        with _opened(self.path) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            try:
                for frame in container.decode(stream):
                    yield frame
                    number += 1
            except _errors() as error:
                raise RsbenchError(
                    f"{self.path}: frame {number} cannot be decoded ({_words(error)}); cut the video before it"
                ) from error


def _luma(frame: Any) -> NDArray[np.float32]:
    """Return every second pixel of the luma of a frame in both directions, 8-bit grey levels."""
    grey = frame.reformat(format="gray").to_ndarray()
    return grey[::2, ::2].astype(np.float32)


def _opened(path: Path) -> av.container.InputContainer:
    import av

    try:
        container = av.open(str(path.resolve()), mode="r", metadata_errors="replace")
    except (*_errors(), OSError, ValueError) as error:
        raise RsbenchError(f"{path}: cannot be read as a video: {_words(error)}") from error
    if not container.streams.video:
        container.close()
        raise RsbenchError(f"{path}: cannot be read as a video: it holds none")
    return container


def _errors() -> tuple[type[Exception], ...]:
    import av

    return (av.FFmpegError,)


def _words(error: Exception) -> str:
    return str(getattr(error, "strerror", "") or error).strip()


def _orientation(frame: Any) -> int:
    """Return the EXIF orientation that is equal to the display matrix of a frame."""
    with suppress(KeyError, ValueError, TypeError):
        matrix = np.frombuffer(bytes(frame.side_data["DISPLAYMATRIX"]), np.int32)[[0, 1, 3, 4]]
        signs = tuple(int(each) for each in np.rint(matrix / 65536.0))
        return next((number for number, each in _MATRICES.items() if each == signs), UPRIGHT)
    return UPRIGHT


def write_frames(
    out: Path,
    frames: Iterable[Image],
    *,
    fps: float,
    times: Times | None = None,
    like: VideoFile | None = None,
    orientation: int = UPRIGHT,
    named: Path | None = None,
) -> tuple[int, list[str]]:
    """Write images (H, W[, 3]) RGB or grey, uint8 or uint16, all of one size; return their number and notes.

    H.264 supports 8 bits and even sizes only: for an odd size the last row or column is repeated. ``.mkv`` stores
    images without loss. ``.avi`` cannot store an orientation, so its frames are rotated.

    Args:
        out: path with one of ``SUFFIXES``.
        fps: frames per second, used if ``times`` is None.
        times: time stamps of the frames.
        like: the source video, whose sound and colour space are used.
        orientation: EXIF orientation that is stored in the container.
        named: the path in errors and notes; ``out`` if None.

    Raises:
        RsbenchError: there are no frames, FFmpeg lacks the encoder, or the file cannot be written.
    """
    import av

    shown, codec, notes = named or out, _CODECS[out.suffix.lower()], list[str]()
    options = {"movflags": "+faststart"} if codec == "libx264" else {}
    times = None if codec == "mjpeg" else times
    base = 1 / Fraction(fps).limit_denominator(1001) if times is None else times.base
    count, stream, sound, white = 0, None, iter(()), 255.0
    try:
        with av.open(str(out), mode="w", options=options) as container:
            for given in frames:
                image = upright(given, orientation) if codec == "mjpeg" else given
                if stream is None:
                    white = _white(image, like)
                    stream = _stream(container, codec, image, fps, base, like, orientation)
                    sound = _sound(container, like, shown, notes)
                    notes += _format_notes(shown, codec, image, stream)
                frame = _frame(image, stream, white)
                frame.pts = times.stamps[count] if times is not None and count < len(times.stamps) else count
                frame.time_base = base
                until = float(frame.pts * base) + _BEFORE
                for packet in stream.encode(frame):
                    container.mux(packet)
                _mux_until(container, sound, until)
                count += 1
            if stream is not None:
                container.mux(stream.encode(None))
                _mux_until(container, sound, np.inf)
    except (av.FFmpegError, ValueError) as error:
        raise RsbenchError(
            f"--out {shown}: the video could not be written: {_words(error)}; is the disk full?"
        ) from error
    if stream is None:
        raise RsbenchError(f"--out {shown}: there are no frames to write")
    return count, notes


def _stream(
    container: Any, codec: str, image: Image, fps: float, base: Fraction, like: VideoFile | None, orientation: int
) -> Any:
    import av

    try:
        stream = container.add_stream(
            codec, rate=Fraction(fps).limit_denominator(1001), options=dict(_QUALITY.get(codec, {}))
        )
    except (av.FFmpegError, ValueError) as error:
        raise RsbenchError(f"--out: this FFmpeg has no encoder {codec}; give a .mkv file or a folder") from error
    height, width = image.shape[:2]
    even = 2 if codec == "libx264" else 1
    stream.width, stream.height = width + width % even, height + height % even
    stream.time_base = stream.codec_context.time_base = base
    formats = {"libx264": "yuv420p", "mjpeg": "yuvj420p"}
    stream.pix_fmt = formats.get(codec) or _LOSSLESS[image.dtype.str[1:], image.ndim]
    if codec == "libx264":
        _tag(stream.codec_context, like)
    if codec == "mjpeg":
        stream.codec_context.color_range = _FULL
    if orientation != UPRIGHT and codec != "mjpeg":
        a, b, c, d = _MATRICES[orientation]
        right = stream.width * (a < 0) + stream.height * (c < 0)
        down = stream.width * (b < 0) + stream.height * (d < 0)
        one = 1 << 16
        stream.set_display_matrix([a * one, b * one, 0, c * one, d * one, 0, right * one, down * one, 1 << 30])
    return stream


def _tag(target: Any, like: VideoFile | None) -> None:
    """Set the colour tags to those of the source video, or for images to BT.601; the range is limited."""
    known = (_LIMITED, 5, 2, 2) if like is None else like.tags
    space = known[1] if known[1] in (1, 5, 6, 9) else 2
    for name, value in zip(_TAGS, (_LIMITED, space, *known[2:]), strict=True):
        setattr(target, name, value)


def _white(image: Image, like: VideoFile | None) -> float:
    """Return the value that is mapped to white in 8 bits: the type's maximum, or the ``_BRIGHT`` percentile of the
    first image if 16-bit images may use only a part of their range."""
    if image.dtype == np.uint8 or (like is not None and like.deep):
        return float(np.iinfo(image.dtype).max)
    return max(float(np.percentile(image, _BRIGHT)), 1.0)


def _frame(image: Image, stream: Any, white: float) -> Any:
    import av

    codec, grey = stream.codec_context.name, image.ndim == 2
    if codec == "ffv1":
        name = {"u1": "gray" if grey else "rgb24", "u2": "gray16le" if grey else "rgb48le"}[image.dtype.str[1:]]
        return av.VideoFrame.from_ndarray(image, format=name).reformat(format=stream.pix_fmt)
    level = image
    if image.dtype != np.uint8:
        level = np.clip(image * np.float32(255.0 / white) + np.float32(0.5), 0.0, 255.0).astype(np.uint8)
    level = np.repeat(level[..., None], 3, axis=2) if grey else level
    height, width = level.shape[:2]
    if (width, height) != (stream.width, stream.height):
        level = np.pad(level, ((0, stream.height - height), (0, stream.width - width), (0, 0)), mode="edge")
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(level), format="rgb24")
    space = stream.codec_context.colorspace if codec == "libx264" else 5
    full = codec == "mjpeg"
    return frame.reformat(
        format=stream.pix_fmt,
        dst_colorspace=space if space != 2 else 5,
        src_color_range=_FULL,
        dst_color_range=_FULL if full else _LIMITED,
        interpolation="BICUBIC",
    )


def _format_notes(out: Path, codec: str, image: Image, stream: Any) -> list[str]:
    height, width = image.shape[:2]
    notes = list[str]()
    if (width, height) != (stream.width, stream.height):
        notes.append(
            f"{out.name}: is {stream.width} x {stream.height}, since H.264 has even sizes alone: "
            f"{width} x {height} with its last row or column twice; .mkv keeps the size"
        )
    if codec != "ffv1" and image.dtype != np.uint8:
        notes.append(f"{out.name}: has 8 bits a channel, the frames more; .mkv or a folder keeps them")
    return notes


def _sound(container: Any, like: VideoFile | None, out: Path, notes: list[str]) -> Iterator[Any]:
    """Return the sound packets of a video, in order; none if the new container does not support the codec."""
    if like is None or not like.sound:
        return iter(())
    source = _opened(like.path)
    stream = source.streams.audio[0]
    try:
        copy = container.add_stream_from_template(stream)
    except (*_errors(), ValueError):
        source.close()
        notes.append(f"{out.name}: has no sound, for {out.suffix} takes no {like.sound}; give a .mov or .mkv file")
        return iter(())

    def packets() -> Iterator[Any]:
        with source:
            for packet in source.demux(stream):
                if packet.dts is not None:
                    at = float((packet.pts if packet.pts is not None else packet.dts) * packet.time_base)
                    packet.stream = copy
                    yield at, packet

    return packets()


def _mux_until(container: Any, sound: Iterator[Any], until: float) -> None:
    for at, packet in sound:
        container.mux(packet)
        if at > until:
            return
