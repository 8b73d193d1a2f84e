"""The header of a PNG: what an image claims to be, before it is decoded."""

from __future__ import annotations

import struct
from pathlib import Path

from rsbench.storage.untrusted_files import open_regular
from rsbench.verification.findings import Finding

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey and alpha", 6: "RGBA"}


def png_fault(path: Path, name: str, size: tuple[int, int]) -> Finding | None:
    """What keeps a file from being an 8-bit RGB image of ``size`` (width, height); only its header is read."""
    try:
        with open_regular(path) as stream:
            head = stream.read(26)
    except OSError as error:
        return Finding(name, f"cannot be read: {error.strerror}")
    if len(head) < 26 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
        return Finding(name, "damaged or not a PNG")
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if (width, height) != size:
        return Finding(name, f"is {width} x {height} pixels, the camera {size[0]} x {size[1]}")
    if (bits, colour) != (8, 2):
        kind = _COLOUR_TYPES.get(colour, f"colour type {colour}")
        return Finding(name, f"is {kind} of {bits} bits per channel: 8-bit RGB is needed")
    return None
