"""Reading untrusted files: sizes are checked before decoding, and paths cannot lead out of a folder.

A small file can decode to more than a machine's memory. The sizes of such files are limited here; the
environment variable ``RSBENCH_LIMITS`` is a factor for all limits. Errors are one line.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import hashlib
import io
import json
import math
import os
import re
import stat
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError

LIMITS = "RSBENCH_LIMITS"
"""Environment variable: factor for all limits."""
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
"""A finite number in text."""
MB = 1 << 20
CARD_BYTES = MB
"""Limit for a TOML card: its reader takes seconds for a MB."""
FILE_BYTES = 256 * MB
"""Limit for any other file that is read at once, and for the arrays of an npz file."""
PIXELS = 1 << 23
"""Limit for one frame, slightly more than 3840 x 2160: correcting four takes 0.5 to 0.7 kB for each pixel."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}")
"""Valid names of sequences, which become names of folders."""
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|.*\.", re.IGNORECASE)
"""Names that are devices on Windows, with any suffix, and names whose last dot it drops."""
_OPEN = re.compile(r"/dev/[^/]+|/dev/fd/\d+|/proc/[^/]+(/task/\d+)?/fd/\d+")
"""Devices and open files of a process, which may be read; not files in folders such as /dev/shm."""
PLAIN_KINDS = "biufU"
"""Kinds of arrays that are plain data: truth values, numbers and text."""
_IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM")


def check_amount(where: object, what: str, amount: int, limit: int) -> None:
    """Raise RsbenchError if an amount exceeds a limit.

    Raises:
        RsbenchError: one line with the amount, the limit and the variable that raises it.
    """
    factor = _factor()
    if amount > limit * factor:
        needed = math.ceil(amount / limit)
        raise RsbenchError(
            f"{where}: {what}: {amount} is more than {round(limit * factor)}; if meant, set {LIMITS}={needed}"
        )


def _factor() -> float:
    return positive_variable(LIMITS, 1.0, ", by which all limits are multiplied")


def positive_variable(name: str, default: float, meaning: str) -> float:
    """Read a positive number from an environment variable; RsbenchError, with its meaning, for other text."""
    text = os.environ.get(name) or str(default)
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(text)) and value > 0.0:
            return value
    raise RsbenchError(f"{name} = {text!r}: must be a positive number{meaning}")


# Names and paths


def check_name(name: str) -> None:
    """Raise ValueError for a name that is not valid for a folder on every system."""
    if not NAME.fullmatch(name):
        raise ValueError(
            f"name = {name!r}: must be a folder's name: a letter or digit, then at most 119 letters, digits, "
            "'.', '_' and '-'"
        )
    if _DEVICE.fullmatch(name):
        raise ValueError(f"name = {name!r}: cannot be a folder's name on Windows: a device, or a dot at its end")


def inside(folder: Path, relative: str) -> Path:
    """Return the file or folder at an untrusted path below ``folder``.

    Raises:
        RsbenchError: the path leads out of the folder, itself or through a link.
    """
    path = folder / relative
    try:
        leads = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # a circle of links, a zero byte
        leads = False
    if not leads or ".." in Path(relative).parts:
        raise RsbenchError(f"{folder}: {relative!r} leads out of the folder; copy the file into it")
    return path


# Content


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file, or an open file of a process (``_OPEN``), for reading bytes.

    Raises:
        OSError: it cannot be opened, or is a named pipe, a socket or a device, where a read may never end.
    """
    file = open(path, "rb", opener=_without_waiting)  # noqa: SIM115  the caller closes it
    mode = os.fstat(file.fileno()).st_mode
    if not stat.S_ISREG(mode):
        if not _OPEN.fullmatch(os.path.abspath(path)):
            file.close()
            raise OSError(errno.EINVAL, f"it is {_kind_of(mode)}; give a regular file")
        os.set_blocking(file.fileno(), True)
    return file


def _without_waiting(name: str, flags: int) -> int:
    return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))


def _kind_of(mode: int) -> str:
    kinds = {stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket", stat.S_IFDIR: "a folder"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def read_bytes(path: Path, limit: int = FILE_BYTES) -> bytes:
    """Read a file of at most ``limit`` bytes.

    Raises:
        RsbenchError: it cannot be read or is larger.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size  # 0 for a pipe
            check_amount(path, "bytes", size, limit)
            data = file.read(size + 1 if size else round(limit * _factor()) + 1)
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror or error}") from error
    check_amount(path, "bytes", len(data), limit)
    return data


def sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()  # pyrefly: ignore[bad-argument-type]


def read_text(path: Path, limit: int = FILE_BYTES) -> str:
    """Read a text file in UTF-8, with or without a byte order mark.

    Raises:
        RsbenchError: as ``read_bytes``, or another encoding, UTF-16 by its name.
    """
    data = read_bytes(path, limit)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise RsbenchError(f"{path}: is UTF-16 text: save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RsbenchError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file.

    Raises:
        RsbenchError: missing, unreadable, or not a JSON object.
    """
    return parse_json(read_text(path), path)


def parse_json(text: str, where: object) -> dict[str, Any]:
    """Parse a JSON object; errors as ``read_json``, beginning with ``where``."""
    try:
        content = json.loads(text, object_pairs_hook=_keyed)
    except json.JSONDecodeError as error:
        raise RsbenchError(
            f"{where}: not valid JSON: {error.msg} at line {error.lineno} column {error.colno}"
        ) from error
    except ValueError as error:  # a number of thousands of digits, a repeated key
        raise RsbenchError(f"{where}: not valid JSON: {error}") from error
    except RecursionError as error:
        raise RsbenchError(f"{where}: not valid JSON: nested too deeply") from error
    if not isinstance(content, dict):
        raise RsbenchError(f"{where}: must hold a JSON object, holds a {type(content).__name__}")
    return content


def _keyed(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; ValueError if a key is repeated."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:100]!r} stands twice in one object")
    return found


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file.

    Raises:
        RsbenchError: it cannot be read, is damaged, holds objects, or more bytes than ``FILE_BYTES``.
    """
    try:
        with open_regular(path) as file:
            return unpack_arrays(file, path)
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror or error}") from error


def unpack_arrays(file: BinaryIO, where: object, limit: int = FILE_BYTES) -> dict[str, NDArray[Any]]:
    """Read an open npz file, ``limit`` bytes at most; errors as ``load_arrays``, beginning with ``where``.

    zipfile reads at most the sizes that the directory of the archive states, whatever the data are.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            check_amount(where, "bytes of all arrays", sum(member.file_size for member in members), limit)
            return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
    except RsbenchError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise various exceptions for damaged bytes
        raise RsbenchError(
            f"{where}: not an npz file of plain arrays: {' '.join(str(error).split()) or type(error).__name__}"
        ) from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    data = archive.read(member)
    # numpy allocates what the array's own header states.
    stream = io.BytesIO(data)
    old = np.lib.format.read_magic(stream) == (1, 0)
    shape, _, dtype = (np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0)(stream)
    if dtype.kind not in PLAIN_KINDS:
        raise ValueError(f"{member.filename} holds {dtype}, not numbers, truth values or text")
    if math.prod(shape) * dtype.itemsize > len(data):
        raise ValueError(f"{member.filename} holds {len(data)} bytes, not {shape} of {dtype}")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


# Images


def check_image_size(data: bytes, where: object, size: tuple[int, int] | None = None, most: int = PIXELS) -> None:
    """Check the image size in the header: ``size`` (width, height), or at most ``most`` pixels if that is None.

    Raises:
        RsbenchError: the size is wrong, or the file is not a PNG, JPEG, TIFF, BMP, WebP or PNM file.
    """
    from PIL import Image

    own, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # the limit here is ``most``
    try:
        with Image.open(io.BytesIO(data), formats=_IMAGE_FORMATS) as image:
            found = image.size
    except Exception as error:  # Pillow raises various exceptions for a damaged file
        raise RsbenchError(f"{where}: cannot be decoded as an image") from error
    finally:
        Image.MAX_IMAGE_PIXELS = own
    check_size(where, found, size, most)


def check_size(
    where: object, found: tuple[int, int], size: tuple[int, int] | None = None, most: int = PIXELS
) -> None:
    """Raise RsbenchError for a size (width, height) other than ``size``, or without it above ``most`` pixels."""
    if size is None:
        check_amount(where, f"{found[0]} x {found[1]} pixels", found[0] * found[1], most)
    elif found != size:
        raise RsbenchError(f"{where}: is {found[0]} x {found[1]} pixels, the camera {size[0]} x {size[1]}")
