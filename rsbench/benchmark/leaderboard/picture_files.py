"""Pictures that anybody hands in: beside a file of answers, ``pictures/PROBLEM/NAME.png``.

Names are looked up, never taken from what was handed in, and no link is followed. The size of an image is known
from its header, before anything is decoded.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import struct
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.true_pictures import Asked
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import read_exr, write_bytes
from rsbench.storage.untrusted_files import NAME, read_bytes

FOLDER = "pictures"
"""Beside the file of answers."""
FARTHEST = 1e9
"""m: no surface is farther."""
_FILE = re.compile(
    rf"pictures/{NAME.pattern}/left_1(_first|_middle|_last)?\.(exr|png)|matches/(left|right|stereo_[01]|tracks)\.csv"
)
"""Paths of what answers hold, below an entry: nothing else is taken from a board of somebody else."""
_PNG = b"\x89PNG\r\n\x1a\n"
_COLOURS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}
"""Colour types of a PNG header."""
_BYTES_OF_PIXEL = 16
_BYTES = 1 << 16
"""A file has at most so many, and so many for each pixel."""


def find_picture(folder: Path, problem: str, asked: Asked) -> Path:
    """The file of a picture below ``pictures``.

    Raises:
        RsbenchError: there is none, two of different kinds, or something that is no file of its own.
    """
    paths = [folder / problem / f"{asked.stem}{suffix}" for suffix in asked.suffixes]
    found = [path for path in paths if os.path.lexists(path)]
    if len(found) != 1:
        names = " and ".join(path.name for path in paths)
        problem_is = f"{len(found)} of {names} are there; keep one" if found else "is missing"
        raise RsbenchError(f"{paths[0]}: {problem_is}; a problem without an answer says success = false")
    check_own(folder.parent, found[0].relative_to(folder.parent).as_posix())
    return found[0]


def copy_files(folder: Path, names: Iterable[str], target: Path) -> dict[str, str]:
    """Copy what lies beside a file of answers; returns the SHA-256 of each, by its name.

    Args:
        folder: where they are.
        names: such as ``pictures/castle/left_1.exr``.
        target: a folder, made if missing.

    Raises:
        RsbenchError: a name leads elsewhere, a file is missing, a link or too large, or cannot be written.
    """
    copied = {}
    for name in names:
        data = file_bytes(folder, name)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target / name, data)
        copied[name] = hashlib.sha256(data).hexdigest()
    return copied


def file_bytes(folder: Path, name: str) -> bytes:
    """The content of a file such as ``pictures/castle/left_1.exr`` below a folder; errors as ``copy_files``."""
    if not _FILE.fullmatch(name):
        raise RsbenchError(f"{folder}: {name[:100]!r} is no name of a file of an answer")
    check_own(folder, name)
    return read_bytes(folder / name)


def check_own(folder: Path, name: str) -> None:
    """Raises RsbenchError unless a file, and each folder on the way to it, is there and is no link."""
    path = folder
    *folders, file = name.split("/")
    for part, kind, is_kind in (
        *((each, "folder", stat.S_ISDIR) for each in folders),
        (file, "file", stat.S_ISREG),
    ):
        path = path / part
        if not os.path.lexists(path) or not is_kind(path.lstat().st_mode):
            raise RsbenchError(f"{path}: must be a {kind} of its own, no link")


def strange_files(folder: Path, split: Split, answered: Collection[str]) -> Iterator[str]:
    """A line for each thing below ``pictures`` that is no picture of an answer."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for place in sorted(folder.iterdir()):
        truth = split.by_name.get(place.name)
        if truth is None or truth.pictures is None:
            yield f"{place}: is no problem of {split.name}: folders have the names of problems"
            continue
        if place.is_symlink() or not place.is_dir():
            yield f"{place}: must be a folder of its own, no link"
            continue
        if place.name not in answered:
            yield f"{place}: has pictures, but no line in the file of answers says so; add one, or remove them"
        names = {f"{asked.stem}{suffix}" for asked in truth.pictures.asked for suffix in asked.suffixes}
        for path in sorted(place.iterdir()):
            if path.name not in names:
                yield f"{path}: is not asked; there are: {', '.join(sorted(names))}"


def read_depth_map(path: Path, size: tuple[int, int], png_unit_m: float | None) -> NDArray[np.float32]:
    """Depth (H, W), m, 0 unknown, of an EXR file or a PNG of 16 bits.

    Args:
        path: of the file.
        size: width and height of the camera.
        png_unit_m: metres of one step of a PNG.

    Raises:
        RsbenchError: it is no such file, or holds what no depth can be.
    """
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


def read_frame(path: Path, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A frame (H, W, 3) RGB, black where nothing was drawn, and where something was (H, W): alpha above 0.

    Raises:
        RsbenchError: it is no PNG of 8 bits in colour of the camera's size.
    """
    pixels = _read_png(path, size, 8, ("RGB", "RGBA"))
    if pixels.shape[2] == 3:
        return pixels, np.ones(pixels.shape[:2], dtype=np.bool_)
    drawn = pixels[..., 3] > 0
    return np.where(drawn[..., None], pixels[..., :3], np.uint8(0)), drawn


def read_answer_frame(folder: Path, truth: Truth, asked: Asked) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """``read_frame`` of a problem; errors as ``find_picture`` too."""
    assert truth.pictures is not None
    return read_frame(find_picture(folder, truth.name, asked), truth.pictures.size)


def read_answer_depth(folder: Path, truth: Truth, png_unit_m: float | None) -> NDArray[np.float32]:
    """``read_depth_map`` of a problem; errors as ``find_picture`` too."""
    assert truth.pictures is not None
    (asked,) = truth.pictures.asked
    return read_depth_map(find_picture(folder, truth.name, asked), truth.pictures.size, png_unit_m)


def frame_png(image: NDArray[np.uint8], drawn: NDArray[np.bool_]) -> bytes:
    """A file that ``read_frame`` reads: without alpha where all was drawn."""
    alpha = [] if np.all(drawn) else [np.where(drawn, np.uint8(255), np.uint8(0))]
    ok, data = cv2.imencode(".png", np.dstack([image[..., ::-1], *alpha]))
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def _check_bytes(path: Path, size: tuple[int, int]) -> bytes:
    """The content of a file that is no larger than a picture of this size can be."""
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
    except Exception as error:  # Pillow raises what a damaged file makes it stumble over
        raise RsbenchError(f"{path}: is a damaged PNG file: {' '.join(str(error).split())[:100]}") from error
    if pixels.shape[:2] != (height, width) or pixels.ndim != (2 if colours == ("grey",) else 3):
        raise RsbenchError(f"{path}: is {is_now}, and holds something else")
    return pixels
