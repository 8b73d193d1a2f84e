"""Small files that would unfold to more than a machine holds: refused in one line, in little memory, at once."""

from __future__ import annotations

import io
import json
import re
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from programs import run_python

CHILD = """
import json, resource, sys
from pathlib import Path
from rsbench.components.cards import read_toml
from rsbench.storage.files import load_arrays, read_depth, read_json, read_png, read_poses
from rsbench.core.errors import RsbenchError
from rsbench.pipeline.footage import FrameSource, read_frame
from rsbench.pipeline.problem import read_problem
from rsbench.scenes.mesh import MeshBuilder

READERS = {
    ".png": read_png, ".jpg": read_frame, ".tif": read_frame, ".webp": read_frame, ".pgm": read_frame,
    ".exr": read_depth, ".npz": load_arrays, ".json": read_json, ".csv": read_poses, ".toml": read_toml,
    ".avi": lambda path: next(iter(FrameSource(path))), ".problem": read_problem,
    ".glb": lambda path: MeshBuilder(file=path.name).build(0, path.parent),
    ".ply": lambda path: MeshBuilder(file=path.name).build(0, path.parent),
}
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in map(Path, sys.argv[1:]):
    try:
        READERS[path.suffix](path)
        message = "was read"
    except RsbenchError as error:
        message = str(error)
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(json.dumps([path.name, message, more]), flush=True)
"""


def zeros(count: int) -> bytes:
    """A zlib stream of ``count`` times 1 MiB of zeros: one block that stands alone, many times."""
    block = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = block.compress(bytes(1 << 20)) + block.flush(zlib.Z_FULL_FLUSH)
    adler = (count << 20) % 65521 << 16 | 1
    return b"\x78\xda" + data * count + b"\x03\x00" + struct.pack(">I", adler)


def png(path: Path, width: int = 20_000, height: int = 20_000) -> None:
    """A whole grey PNG file of black pixels: 400 MB, 1.2 GB as RGB."""
    data = zeros((width + 1) * height // (1 << 20) + 1)
    chunks = (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")
    content = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)


def patched(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert data.count(old) >= 1
    path.write_bytes(data.replace(old, new))


def jpeg(path: Path) -> None:
    Image.new("L", (40, 30)).save(path)
    patched(path, struct.pack(">BHH", 8, 30, 40), struct.pack(">BHH", 8, 60_000, 60_000))


def tiff(path: Path) -> None:
    Image.new("L", (40, 30)).save(path)
    size = [struct.pack("<HHI", tag, 4, 1) for tag in (256, 257)]
    for tag, value in zip(size, (40, 30), strict=True):
        patched(path, tag + struct.pack("<I", value), tag + struct.pack("<I", 100_000))


def webp(path: Path) -> None:
    Image.new("RGB", (16_000, 600)).save(path, lossless=True, method=0)


def pgm(path: Path) -> None:
    path.write_bytes(b"P5 90000 90000 255\n" + bytes(100))


def exr(path: Path) -> None:
    """Its data window says 100 000 x 100 000 pixels."""
    content = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": np.zeros((30, 40), np.float32)}) as file:
        file.write(content)
    path.write_bytes(content.getvalue())
    patched(path, struct.pack("<4i", 0, 0, 39, 29), struct.pack("<4i", 0, 0, 99_999, 99_999))


def npz(path: Path) -> None:
    """An array of 4 GB of zeros, in 4 MB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": (4000 << 20,)})
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("x.npy", "w") as file,
    ):
        file.write(head.getvalue())
        for _ in range(300):  # already more than may be
            file.write(bytes(1 << 20))


def lying_npz(path: Path) -> None:
    """The directory says 100 bytes, the array's header 4 GB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (500 << 20,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("x.npy", head.getvalue())


def sparse(size: int) -> Callable[[Path], None]:
    """A file of zeros that takes no room."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.truncate(size)

    return write


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def avi(path: Path) -> None:
    """A real video, of frames that are too large."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (4000, 2200))
    writer.write(np.zeros((2200, 4000, 3), np.uint8))
    writer.release()


def glb(path: Path) -> None:
    accessor = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
    content = json.dumps({"asset": {"version": "2.0"}, "accessors": [accessor], "bufferViews": []}).encode()
    content += b" " * (-len(content) % 4)
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(content), len(content), b"JSON") + content)


def ply(path: Path) -> None:
    path.write_text(
        "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n"
    )


GB = 1 << 30
BOMBS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a.png": (png, r"20000 x 20000 pixels: 400000000 is more than \d+; if meant, set RSBENCH_LIMITS=48"),
    "a.jpg": (jpeg, r"60000 x 60000 pixels"),
    "a.tif": (tiff, r"100000 x 100000 pixels"),
    "a.webp": (webp, r"16000 x 600 pixels"),
    "a.pgm": (pgm, r"90000 x 90000 pixels"),
    "a.exr": (exr, r"100000 x 100000 pixels|damaged or not an EXR"),
    "a.npz": (npz, r"bytes of all arrays: \d+ is more than"),
    "b.npz": (lying_npz, r"holds \d+ bytes, not \(524288000,\)"),
    "a.json": (sparse(GB), r"bytes: 1073741824 is more than"),
    "b.json": (text("[" * 100_000), r"nested too deeply"),
    "a.csv": (sparse(GB), r"bytes: 1073741824 is more than"),
    "a.toml": (sparse(GB), r"bytes: 1073741824 is more than"),
    "b.toml": (text("x = " + "[" * 2000), r"nested too deeply"),
    "a.problem": (sparse(GB), r"bytes: 1073741824 is more than"),
    "a.avi": (avi, r"4000 x 2200 pixels"),
    "a.glb": (glb, r"values of all accessors: 3000000000 is more than"),
    "a.ply": (ply, r"states 4000000000 elements"),
}
"""By file name: the function that writes it, and the error."""


@pytest.mark.skipif(sys.platform == "win32", reason="measures with the resource module")
def test_files_that_unfold_are_refused_in_little_memory(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in BOMBS]
    for path in paths:
        BOMBS[path.name][0](path)
    start = time.monotonic()
    result = run_python("-c", CHILD, *paths)
    assert result.returncode == 0, result.stderr
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [name for name, _, _ in found] == list(BOMBS)
    for name, message, more_kb in found:
        assert re.search(BOMBS[name][1], message), (name, message)
        assert str(tmp_path / name) in message and "\n" not in message
        # Opening a video decodes its first frame; nothing else is decoded.
        assert more_kb < 200_000, (name, more_kb)
    assert time.monotonic() - start < 60
