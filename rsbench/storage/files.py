"""Files of a dataset: exact, deterministic bytes, written so that a killed run leaves no incomplete file.

Hashes of files are stored, so that files with unchanged size and time stamps are not read again.
``background_writer`` writes on other threads.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import stat
import struct
import tempfile
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.storage.untrusted_files import check_image_size, check_size, read_bytes, read_text
from rsbench.storage.untrusted_files import load_arrays as load_arrays
from rsbench.storage.untrusted_files import read_json as read_json
from rsbench.storage.untrusted_files import sha256 as sha256
from rsbench.storage.work_folder import HIDDEN, refuse_url

if TYPE_CHECKING:
    import pandas as pd

MATCH_SETS = ("left", "right", "stereo_0", "stereo_1", "tracks")
_SET = 255
"""The value of set pixels of a mask."""
POSE_COLUMNS = "row,tau,qw,qx,qy,qz,tx,ty,tz"


def write_bytes(path: Path, data: bytes) -> None:
    """Write through a temporary file in the same folder, so that a file is complete or absent.

    Raises:
        RsbenchError: one line with the file, its size, the reason and a remedy.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.unlink(missing_ok=True)  # left by a run that was killed, or a link to elsewhere
        with partial.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room there and run the same command again" if full else "choose another --out"
        raise RsbenchError(f"{path}: cannot be written, {len(data)} bytes: {error.strerror}; {remedy}") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def check_out(out: Path) -> None:
    """Raise RsbenchError if a folder of results cannot be written, before a long computation starts."""
    refuse_url(out)
    try:
        place = next(path for path in (out, *out.absolute().parents) if path.exists() or path.is_symlink())
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another --out") from error


def write_json(path: Path, content: dict[str, Any]) -> None:
    write_bytes(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


_PNG_HEAD = 33
"""Bytes of a PNG file before its second chunk."""


def write_png(path: Path, image: NDArray[np.uint8], orientation: int = 1) -> None:
    """Write an 8-bit image (H, W, 3) RGB or (H, W) with an EXIF orientation."""
    import cv2  # here and below: a solve, which needs no OpenCV, imports this module

    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(".png", pixels)
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    content = data.tobytes()
    if orientation != 1:  # TIFF's header, and a folder of one entry: tag 0x112, a short
        tags = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x112, 3, 1, orientation, 0)
        chunk = struct.pack(">I", len(tags)) + b"eXIf" + tags + struct.pack(">I", zlib.crc32(b"eXIf" + tags))
        content = content[:_PNG_HEAD] + chunk + content[_PNG_HEAD:]
    write_bytes(path, content)


def read_png(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Read an RGB image (H, W, 3) uint8.

    Args:
        path: of an image file.
        size: required width and height; without it, the limit is ``untrusted_files.PIXELS``.

    Raises:
        RsbenchError: missing, not an image or of another size.
    """
    import cv2

    pixels = _decoded(path, size, cv2.IMREAD_COLOR)
    if pixels is None:
        raise RsbenchError(f"{path}: cannot be decoded as an image")
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _decoded(path: Path, size: tuple[int, int] | None, mode: int) -> NDArray[Any] | None:
    import cv2

    data = read_bytes(path)
    check_image_size(data, path, size)
    return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)


def write_png16(path: Path, image: NDArray[np.uint16]) -> None:
    """Write a 16-bit image (H, W)."""
    import cv2

    write_bytes(path, cv2.imencode(".png", image)[1].tobytes())


def read_grey_png(path: Path, size: tuple[int, int] | None = None, bits: Literal[8, 16] = 8) -> NDArray[Any]:
    """Read an image (H, W) uint8 or uint16 of one channel; ``size`` as in ``read_png``.

    Raises:
        RsbenchError: missing, not such an image, or of another size.
    """
    import cv2

    pixels = _decoded(path, size, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.dtype(f"uint{bits}") or pixels.ndim != 2:
        raise RsbenchError(f"{path}: must be a grey image of {bits} bits")
    return np.asarray(pixels)


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Write an 8-bit grey PNG: 255 where the mask (H, W) is set, 0 elsewhere."""
    write_png(path, np.where(mask, np.uint8(_SET), np.uint8(0)))


def read_mask(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """Read a mask (H, W); ``size`` as in ``read_png``.

    Raises:
        RsbenchError: see ``read_grey_png``; or values other than 0 and 255.
    """
    values = read_grey_png(path, size)
    if not np.isin(values, (0, _SET)).all():
        raise RsbenchError(f"{path}: must hold 0 and {_SET} alone")
    return np.asarray(values > 0)


def write_depth(path: Path, depth: NDArray[np.float32], *, quick: bool = False) -> None:
    """Write depth (H, W), metres, 0 = no surface, as float32 channel Z; ``quick`` as in ``write_exr``."""
    write_exr(path, {"Z": depth}, quick=quick)


def write_exr(
    path: Path, channels: Mapping[str, NDArray[np.float32]], half: bool = False, quick: bool = False
) -> None:
    """Write channels (H, W) by name as float32, or float16 if ``half``, without loss.

    ``quick``: RLE instead of ZIP compression, in a fifth of the time: estimated values hardly get smaller by ZIP.
    """
    import OpenEXR

    compression = OpenEXR.RLE_COMPRESSION if quick else OpenEXR.ZIP_COMPRESSION
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    kind = np.float16 if half else np.float32
    pixels = {name: np.ascontiguousarray(each, dtype=kind) for name, each in channels.items()}
    content = io.BytesIO()  # ``write_bytes`` reports a full disk, OpenEXR in several forms
    with OpenEXR.File(header, pixels) as file:
        file.write(content)
    write_bytes(path, content.getvalue())


def read_depth(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
    """Read channel Z (H, W) float32, metres, 0 = no surface; ``size`` as in ``read_png``.

    Raises:
        RsbenchError: see ``read_exr``; or negative or non-finite depth.
    """
    depth = read_exr(path, ("Z",), size)[..., 0]
    if not np.all(np.isfinite(depth)) or np.any(depth < 0):
        raise RsbenchError(f"{path}: depth must be finite and not negative (0 = no surface)")
    return depth


def read_exr(
    path: Path, names: tuple[str, ...], size: tuple[int, int] | None = None, half: bool = False
) -> NDArray[np.float32]:
    """Read channels (H, W, channels) float32 in the order of ``names``; ``size`` as in ``read_png``.

    Raises:
        RsbenchError: missing, damaged, of another size, or with other content than these channels in scanlines of
            float32, or float16 if ``half``.
    """
    import OpenEXR

    data = read_bytes(path)
    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
            _check_exr_header([part.header for part in file.parts], path, names, size)
        with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            pixels = [np.array(file.channels()[name].pixels) for name in names]
    except RsbenchError:
        raise
    except Exception as error:  # OpenEXR raises plain RuntimeError, ValueError and others for damaged files
        raise RsbenchError(f"{path}: damaged or not an EXR file ({str(error).splitlines()[0]})") from error
    for name, each in zip(names, pixels, strict=True):
        if each.dtype != (np.float16 if half else np.float32) or each.ndim != 2:
            raise RsbenchError(f"{path}: must hold a float{16 if half else 32} channel {name}")
    return np.stack(pixels, axis=-1).astype(np.float32, copy=False)


def _check_exr_header(
    headers: list[dict[str, Any]], path: Path, names: tuple[str, ...], size: tuple[int, int] | None
) -> None:
    """Raise an error for unexpected parts, channels or sizes before pixels are decoded."""
    import OpenEXR

    found = sorted(channel.name for header in headers for channel in header["channels"])
    if len(headers) != 1 or headers[0]["type"] != OpenEXR.scanlineimage or found != sorted(names):
        of = "one channel, Z," if names == ("Z",) else f"the channels {', '.join(names)}"
        raise RsbenchError(f"{path}: must hold one part of scanlines with {of} of float32")
    first, last = headers[0]["dataWindow"]
    width, height = (int(end) - int(start) + 1 for start, end in zip(first, last, strict=True))
    check_size(path, (width, height), size)


def write_poses(path: Path, tau: FloatArray, poses: Pose) -> None:
    """Write a line per row: tau and ``cam_from_world`` as unit quaternion and translation, in exact decimals."""
    table = np.concatenate([tau[:, None], so3.quaternion(poses.R), poses.t], axis=1)
    lines = [f"{row}," + ",".join(repr(float(x)) for x in values) for row, values in enumerate(table)]
    write_bytes(path, ("\n".join([POSE_COLUMNS, *lines]) + "\n").encode())


def read_poses(path: Path) -> tuple[FloatArray, Pose]:
    """Read row times (H,) and ``cam_from_world`` of every row.

    Raises:
        RsbenchError: missing or not in the format of ``write_poses``.
    """
    table = read_pose_table(path)
    return table[:, 1], Pose(so3.from_quaternion(table[:, 2:6]), table[:, 6:9])


def read_pose_table(path: Path) -> FloatArray:
    """Read the numbers (H, 9) of a file of poses, in the order of ``POSE_COLUMNS``; errors as ``read_poses``."""
    lines = read_text(path).splitlines()
    with naming(f"{path}: not a table of numbers"):
        table = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    if not lines or lines[0] != POSE_COLUMNS or table.ndim != 2 or table.shape[1] != 9:
        raise RsbenchError(f"{path}: must have the columns {POSE_COLUMNS}")
    if not np.all(np.isfinite(table)) or not np.array_equal(table[:, 0], np.arange(len(table))):
        raise RsbenchError(f"{path}: rows must be numbered 0, 1, ... with finite numbers")
    return table


def save_matches(path: Path, matches: Correspondences) -> None:
    """Write the match sets ``MATCH_SETS``, and lines and affine frames if there are any."""
    rare = {name: rows for name in ("lines", "affine") if len(rows := getattr(matches, name))}
    save_arrays(path, {name: getattr(matches, name) for name in MATCH_SETS} | rare)


def load_matches(path: Path) -> Correspondences:
    """Read matches of ``save_matches``; errors as ``load_arrays``, or RsbenchError if arrays are no matches."""
    with naming(path, TypeError, ValueError):
        return Correspondences(**load_arrays(path))


def save_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write a compressed npz file atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_table(
    path: Path, columns: Iterable[str] = (), numbers: Iterable[str] = (), **options: Any
) -> pd.DataFrame:
    """Read a CSV file; ``options`` are passed to ``pandas.read_csv``.

    Raises:
        RsbenchError: it cannot be read, is not a table, or lacks ``columns`` or numeric columns ``numbers``.
    """
    import pandas as pd

    try:
        table = pd.read_csv(io.StringIO(read_text(path)), **options)
    except ValueError as error:  # pandas raises it for every damaged table
        raise RsbenchError(f"{path}: not a table: {' '.join(str(error).split())}") from error
    for name in (*columns, *numbers):
        if name not in table:
            raise RsbenchError(f"{path}: lacks the column {name!r}")
    for name in numbers if len(table) else ():
        if not pd.api.types.is_numeric_dtype(table[name]) or pd.api.types.is_bool_dtype(table[name]):
            raise RsbenchError(f"{path}: the column {name!r} must hold numbers")
    return table


def write_table(path: Path, frame: pd.DataFrame) -> None:
    """Write a CSV file with six significant digits."""
    write_bytes(path, frame.to_csv(index=False, float_format="%.6g", lineterminator="\n").encode())


# Hashes that are kept


HASHES = f"{HIDDEN}/hashes.jsonl"
"""File of the stored hashes of a folder of results, relative to it."""


class HashedFile(NamedTuple):
    """State of a file when it was hashed."""

    size: int
    modified_ns: int
    changed_ns: int
    """Last change of its content, name, owner or permissions; no tool can set it."""
    sha256: str


class FileHashes:
    """SHA-256 of the files below a folder; ``flush`` appends new ones to a file."""

    def __init__(self, root: Path, store: Path, rehash: bool = False) -> None:
        """
        Args:
            root: the folder.
            store: file of the kept hashes; need not exist.
            rehash: ignore the stored hashes.

        Raises:
            RsbenchError: the store exists and is not a regular file.
        """
        self._root, self._store = root, store
        if os.path.lexists(store) and not stat.S_ISREG(store.lstat().st_mode):
            raise RsbenchError(f"{store}: is not a regular file; remove it")
        if rehash:
            store.unlink(missing_ok=True)
        self._known = dict[str, HashedFile]()
        with contextlib.suppress(OSError), store.open(encoding="utf-8", errors="replace") as stream:
            self._known = _parsed_hashes(stream)
        self._new: list[str] = []

    def of(self, name: str) -> HashedFile | None:
        """Return the state and hash of a file, given its relative path with slashes; None if it is not regular."""
        path = f"{self._root}/{name}"
        try:
            found = os.stat(path)
        except OSError:
            return None
        if not stat.S_ISREG(found.st_mode):
            return None
        state = found.st_size, found.st_mtime_ns, found.st_ctime_ns
        known = self._known.get(name)
        if known is None or known[:3] != state:
            known = self._keep(name, HashedFile(*state, sha256(Path(path))))
        return known

    def sha256(self, path: Path) -> str:
        """Return the hash of a file, given its path below the folder."""
        found = self.of(path.relative_to(self._root).as_posix())
        return sha256(path) if found is None else found.sha256

    def learn(self, name: str, digest: str) -> HashedFile:
        """Store the hash of a file that was just written."""
        found = os.stat(f"{self._root}/{name}")
        return self._keep(name, HashedFile(found.st_size, found.st_mtime_ns, found.st_ctime_ns, digest))

    def flush(self) -> None:
        """Append new hashes to the store."""
        self.append(self.taken())

    def taken(self) -> list[str]:
        """Return the new hashes as lines, for ``append`` in another process, and remove them here."""
        lines = self._new
        self._new = []
        return lines

    def append(self, lines: Sequence[str]) -> None:
        """Append lines from ``taken`` to the store."""
        self._known |= _parsed_hashes(lines)
        if lines:
            with self._store.open("a", encoding="utf-8", newline="\n") as stream:
                stream.write("\n" + "\n".join(lines) + "\n")  # a killed process may have cut the previous line

    def _keep(self, name: str, file: HashedFile) -> HashedFile:
        self._known[name] = file
        self._new.append(json.dumps([name, *file]))
        return file


def _parsed_hashes(lines: Iterable[str]) -> dict[str, HashedFile]:
    known = dict[str, HashedFile]()
    for line in lines:
        with contextlib.suppress(ValueError, TypeError, RecursionError):  # an empty, incomplete or foreign line
            name, size, modified, changed, digest = json.loads(line)
            known[name] = HashedFile(size, modified, changed, digest)
    return known


# On other threads


T = TypeVar("T")
R = TypeVar("R")
Later = Callable[..., "Future[Any]"]
"""Takes a function and its arguments, and calls it on another thread."""
_THREADS = 2
_WAITING = 8
"""Largest number of unfinished jobs: each may hold a frame's arrays, and a disk may be slower than the
renderer."""


@contextmanager
def background_writer() -> Iterator[Later]:
    """Yield a function that runs work on other threads, such as writing files; at the end all work is complete.

    The first error is raised by a later call or at the end. Results are returned by the futures.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        jobs: deque[Future[Any]] = deque()

        def later(work: Callable[..., Any], *given: Any) -> Future[Any]:
            while jobs and (jobs[0].done() or len(jobs) >= _WAITING):
                jobs.popleft().result()
            jobs.append(pool.submit(work, *given))
            return jobs[-1]

        yield later
        while jobs:
            jobs.popleft().result()


def begun(later: Later, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield results of ``work`` for each item, in order; the first jobs start now, others as results are read."""
    rest = iter(items)
    waiting = deque(later(work, item) for item in islice(rest, _THREADS))

    def results() -> Iterator[R]:
        while waiting:
            first = waiting.popleft()
            yield first.result()
            waiting.extend(later(work, item) for item in islice(rest, 1))

    return results()
