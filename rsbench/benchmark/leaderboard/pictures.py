"""Pictures of a submission: which ones are requested, their ground truth, and safe reading of untrusted files.

They show frame 1 of the left camera, so that a method can use the previous frame. They are stored next to the file
of answers as ``pictures/PROBLEM/NAME.png``. File names are never taken from a submission, and links are not
followed. The size of an image is read from its header before decoding.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import re
import stat
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.images.score import visible_pixels
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.storage.files import read_exr, read_png, sha256, write_bytes
from rsbench.storage.untrusted_files import NAME, inside, read_bytes
from rsbench.vision.stereo_depth import seen_by_other

VIEW: View = ("left", 1)
"""View whose depth and corrected frames are requested."""


class RequestedPicture(NamedTuple):
    """A picture that an answer must contain."""

    stem: str
    """Name of its file without suffix, such as ``left_1_middle``."""
    row: int
    """Row to whose time it is corrected, in order of readout; 0 for depth, where each row has its own time."""
    file: str
    """Path of the true picture below the folder of the sequence."""
    suffixes: tuple[str, ...] = (".png",)
    """Allowed suffixes of its file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TruePictures:
    """True pictures of a problem, from its sequence; the fingerprint of the split covers its files."""

    sequence: Sequence
    requested: tuple[RequestedPicture, ...]
    files: Mapping[str, str]
    """SHA-256 of the inputs of methods and of the ground truth, by path relative to the sequence's folder."""

    def check(self) -> None:
        """Raise RsbenchError if a file differs from that of the split."""
        for name, digest in self.files.items():
            path = inside(self.sequence.folder, name)
            if not path.is_file() or sha256(path) != digest:
                raise RsbenchError(f"{path}: is not the file that dataset.json names; rsbench verify says more")

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        camera = self.sequence.rig.sensor(VIEW[0])
        return camera.width, camera.height

    def path(self, each: RequestedPicture) -> Path:
        """Return the file of the true picture."""
        return inside(self.sequence.folder, each.file)

    def depth(self) -> NDArray[np.float32]:
        """Return the true depth (H, W), metres, 0 where there is no surface."""
        return self.sequence.depth("rs", *VIEW)

    def frame(self, row: int) -> NDArray[np.uint8]:
        """Return the global-shutter image (H, W, 3) at the pose of a requested row."""
        (file,) = (each.file for each in self.requested if each.row == row)
        return read_png(inside(self.sequence.folder, file), self.size)

    def rolling(self) -> NDArray[np.uint8]:
        """Return the rolling-shutter frame (H, W, 3)."""
        return self.sequence.image("rs", *VIEW)

    def seen_by_both(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return the mask (H, W) of pixels whose scene point, by true ``depth`` (H, W), the right camera sees."""
        return seen_by_other(depth, self.sequence.depth("rs", "right", 1), self.sequence.rig, "left")

    def commons(self) -> list[NDArray[np.bool_]]:
        """Return a mask (H, W) for each corrected frame: pixels whose scene point the original frame shows."""
        images = {view: self.sequence.image("rs", *view) for view in VIEWS}
        pairs = true_pairs(self.sequence, images)
        return [visible_pixels(self.sequence, pairs, (VIEW,), each.row)[VIEW] for each in self.requested]


# Files of answers

PICTURES = "pictures"
"""Folder of pictures, beside the file of answers."""
FARTHEST = 1e9
"""Largest valid depth, m."""
_FILE = re.compile(
    rf"pictures/{NAME.pattern}/left_1(_first|_middle|_last)?\.(exr|png)|matches/(left|right|stereo_[01]|tracks)\.csv"
)
"""Paths of pictures and matches relative to an entry; other files are not copied."""
_PNG = b"\x89PNG\r\n\x1a\n"
_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}
"""Colour types of a PNG header."""
_BYTES_OF_PIXEL = 16
_BYTES = 1 << 16
"""Limit of the size of a file: this number of bytes plus ``_BYTES_OF_PIXEL`` for each pixel."""


def find_picture(folder: Path, problem: str, picture: RequestedPicture) -> Path:
    """Find the file of a picture in the folder ``pictures``.

    Raises:
        RsbenchError: it is missing, there are two of different formats, or it is a link or no file.
    """
    paths = [folder / problem / f"{picture.stem}{suffix}" for suffix in picture.suffixes]
    found = [path for path in paths if os.path.lexists(path)]
    if len(found) != 1:
        names = " and ".join(path.name for path in paths)
        problem_is = f"{len(found)} of {names} are there; keep one" if found else "is missing"
        raise RsbenchError(f"{paths[0]}: {problem_is}; a problem without an answer has success = false")
    check_own(folder.parent, found[0].relative_to(folder.parent).as_posix())
    return found[0]


def copy_files(folder: Path, names: Iterable[str], target: Path) -> dict[str, str]:
    """Copy the files beside a file of answers; returns the SHA-256 of each, by its name.

    Args:
        folder: folder of the file of answers.
        names: relative paths such as ``pictures/castle/left_1.exr``.
        target: folder of the copies, created if missing.

    Raises:
        RsbenchError: a name is not that of a picture or of matches; a file is missing, a link or too large, or
            cannot be written.
    """
    copied = {}
    for name in names:
        data = file_bytes(folder, name)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target / name, data)
        copied[name] = hashlib.sha256(data).hexdigest()
    return copied


def file_bytes(folder: Path, name: str) -> bytes:
    """Read a file such as ``pictures/castle/left_1.exr`` below a folder; errors are those of ``copy_files``."""
    if not _FILE.fullmatch(name):
        raise RsbenchError(f"{folder}: {name[:100]!r} is no name of a file of an answer")
    check_own(folder, name)
    return read_bytes(folder / name)


def check_own(folder: Path, name: str) -> None:
    """Raise RsbenchError unless a file and the folders on the path to it exist and are not links."""
    path = folder
    *folders, file = name.split("/")
    for part, kind, is_kind in (
        *((each, "folder", stat.S_ISDIR) for each in folders),
        (file, "file", stat.S_ISREG),
    ):
        path = path / part
        if not os.path.lexists(path) or not is_kind(path.lstat().st_mode):
            raise RsbenchError(f"{path}: must be a {kind} of its own, no link")


def read_answer_depth(folder: Path, pictures: TruePictures, png_unit_m: float | None) -> NDArray[np.float32]:
    """Read the depth map (H, W) of an answer, metres, 0 where unknown, from an EXR file or a PNG of 16 bits.

    Args:
        folder: folder ``pictures`` beside the file of answers.
        pictures: true pictures of the problem.
        png_unit_m: depth in metres of one grey level of a PNG.

    Raises:
        RsbenchError: the file has another format or invalid values of depth; see also ``find_picture``.
    """
    (picture,) = pictures.requested
    path, size = find_picture(folder, pictures.sequence.name, picture), pictures.size
    if path.suffix == ".exr":
        _check_bytes(path, size)
        depth = read_exr(path, ("Z",), size)[..., 0]
    else:
        if png_unit_m is None:
            raise RsbenchError(f"{path}: the header must say png_unit_m, the metres of one step, such as 0.001")
        depth = _read_png(path, size, 16, ("grey",)).astype(np.float32) * np.float32(png_unit_m)
    for what, wrong in (
        ("are NaN", np.isnan(depth)),
        ("are infinite", np.isinf(depth)),
        ("are negative", depth < 0.0),
        (f"are above {FARTHEST:g} m", depth > FARTHEST),
    ):
        if np.any(wrong):
            raise RsbenchError(f"{path}: {np.count_nonzero(wrong)} pixels {what}; unknown depth and sky are 0")
    return depth


def read_answer_frame(
    folder: Path, pictures: TruePictures, picture: RequestedPicture
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Read a frame (H, W, 3) of an answer, RGB, and the mask (H, W) of drawn pixels, whose alpha is above 0; other
    pixels are black.

    Raises:
        RsbenchError: the file is no colour PNG of 8 bits and of the camera's size; see also ``find_picture``.
    """
    pixels = _read_png(find_picture(folder, pictures.sequence.name, picture), pictures.size, 8, ("RGB", "RGBA"))
    if pixels.shape[2] == 3:
        return pixels, np.ones(pixels.shape[:2], dtype=np.bool_)
    drawn = pixels[..., 3] > 0
    return np.where(drawn[..., None], pixels[..., :3], np.uint8(0)), drawn


def frame_png(image: NDArray[np.uint8], drawn: NDArray[np.bool_]) -> bytes:
    """Encode a frame as PNG for ``read_answer_frame``, without alpha if all pixels are drawn."""
    alpha = [] if np.all(drawn) else [np.where(drawn, np.uint8(255), np.uint8(0))]
    ok, data = cv2.imencode(".png", np.dstack([image[..., ::-1], *alpha]))
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def _check_bytes(path: Path, size: tuple[int, int]) -> bytes:
    """Read a file; RsbenchError if it is larger than a picture of this size can be."""
    return read_bytes(path, _BYTES + _BYTES_OF_PIXEL * size[0] * size[1])


def _read_png(path: Path, size: tuple[int, int], bits: int, colours: tuple[str, ...]) -> NDArray[np.uint8]:
    from PIL import Image

    data = _check_bytes(path, size)
    if data[:8] != _PNG or data[12:16] != b"IHDR" or len(data) < 33:
        raise RsbenchError(f"{path}: is no PNG file")
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    if (width, height) != size:
        raise RsbenchError(f"{path}: is {width} x {height} pixels, the camera {size[0]} x {size[1]}")
    is_now = f"{_COLOURS.get(colour, 'unknown')} of {depth} bits"
    if depth != bits or _COLOURS.get(colour) not in colours:
        raise RsbenchError(f"{path}: is {is_now}: must be {' or '.join(colours)} of {bits} bits")
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            if image.size != size:  # a second header
                raise ValueError(f"its headers differ: {image.size[0]} x {image.size[1]} pixels")
            pixels = np.asarray(image)
    except Exception as error:  # Pillow raises various exceptions for damaged files
        raise RsbenchError(f"{path}: is a damaged PNG file: {' '.join(str(error).split())[:100]}") from error
    if pixels.shape[:2] != (height, width) or pixels.ndim != (2 if colours == ("grey",) else 3):
        raise RsbenchError(f"{path}: is {is_now}, and holds something else")
    return pixels


# Scores of pictures by parts of their pixels: by distance from the reference row, and by texture.
#
# The parts depend on the ground truth only, so that all entries are scored on the same pixels.

WINDOW = 9
"""Side of the square window over which texture is measured, px."""
_MOST = 255.0
BoolArray = NDArray[np.bool_]


class Parting(NamedTuple):
    """A division of the pixels into parts by a value of each pixel."""

    name: str
    title: str
    starts: tuple[float, ...]
    """Lower limit of each part, which is its label in figures."""


PARTINGS = (
    Parting(
        name="rows",
        title="rows from the reference row, as a share of all (0.2: from there to 0.4)",
        starts=(0.0, 0.2, 0.4, 0.6, 0.8),
    ),
    Parting(
        name="texture",
        title=f"texture: deviation of grey levels within {WINDOW} px (2: from there to 5)",
        starts=(0.0, 2.0, 5.0, 10.0, 20.0),
    ),
)


def columns(score: str, parting: Parting) -> list[str]:
    """Return the columns of scores.csv, such as ``bad_1_rows_1``, in the order of the parts."""
    return [f"{score}_{parting.name}_{number}" for number in range(1, len(parting.starts) + 1)]


def texture(image: NDArray[np.uint8]) -> FloatArray:
    """Return the standard deviation (H, W) of the grey level in a window around each pixel, 8-bit levels."""
    grey = _mean(image.astype(np.float64))
    mean, square = (
        cv2.blur(each, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT_101) for each in (grey, grey * grey)
    )
    return np.sqrt(np.maximum(square - mean * mean, 0.0))


Parts = dict[str, BoolArray]
"""Masks (H, W) of the parts, by column."""


def parts_within(score: str, image: NDArray[np.uint8], row: int, counted: BoolArray) -> Parts:
    """Divide the ``counted`` pixels of a picture (H, W, 3) with reference row ``row``; masks by score column."""
    height, width = image.shape[:2]
    away = np.broadcast_to(np.abs(np.arange(height) - row)[:, None] / height, (height, width))
    found = Parts()
    for parting, value in zip(PARTINGS, (away, texture(image)), strict=True):
        part = np.searchsorted(parting.starts, value, side="right") - 1
        found |= {name: (part == number) & counted for number, name in enumerate(columns(score, parting))}
    return found


def rms_by_part(
    score: str, frames: Iterable[tuple[NDArray[np.uint8] | None, NDArray[np.uint8], Parts]]
) -> dict[str, float]:
    """Return root mean squared errors of frames, by the columns of a ``score``; NaN for a part without pixels.

    ``frames``: for each frame its image (H, W, 3), or None for a failure, whose error is 255 everywhere; the true
    image; and its ``parts_within``.
    """
    sums = {name: np.zeros(2) for parting in PARTINGS for name in columns(score, parting)}
    for image, truth, parts in frames:
        off = np.full(truth.shape, _MOST) if image is None else image.astype(np.float64) - truth
        squares = _mean(off * off)
        for name, part in parts.items():
            sums[name] += np.array([np.sum(squares[part]), np.count_nonzero(part)])
    return {name: math.sqrt(total / count) if count else math.nan for name, (total, count) in sums.items()}


def shares(parts: Parts, wrong: BoolArray) -> dict[str, float]:
    """Return the share of ``wrong`` (H, W) pixels in each part, by column; NaN for a part without pixels."""
    return {name: float(np.mean(wrong[part])) if np.any(part) else math.nan for name, part in parts.items()}


def _mean(image: FloatArray) -> FloatArray:
    """Return the mean (H, W) over the colours of an image (H, W, 3); np.mean is much slower for three values."""
    return (image[..., 0] + image[..., 1] + image[..., 2]) / 3.0
