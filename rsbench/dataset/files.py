"""Files of a dataset: exact, deterministic bytes, written so that a killed run leaves no half file."""

from __future__ import annotations

import hashlib
import io
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.errors import RsbenchError

if TYPE_CHECKING:
    import pandas as pd

MATCH_SETS = ("left", "right", "stereo_0", "stereo_1", "tracks")
POSE_COLUMNS = "row,tau,qw,qx,qy,qz,tx,ty,tz"


def sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_bytes(path: Path, data: bytes) -> None:
    """Write through a temporary file in the same folder, so the name never holds half of it."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    write_bytes(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        RsbenchError: missing, unreadable, or not a JSON object.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RsbenchError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise RsbenchError(f"{path}: must hold a JSON object, holds a {type(content).__name__}")
    return content


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """8-bit image (H, W, 3) RGB or (H, W)."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(".png", pixels)
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    write_bytes(path, data.tobytes())


def read_png(path: Path) -> NDArray[np.uint8]:
    """RGB image (H, W, 3) uint8.

    Raises:
        RsbenchError: missing or not an image.
    """
    if not path.is_file():
        raise RsbenchError(f"{path}: no such image")
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise RsbenchError(f"{path}: cannot be decoded as an image")
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """float32 channel Z (H, W), metres, 0 = no surface; lossless ZIP."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    partial = path.with_name(f".{path.name}.partial")
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, dtype=np.float32)}) as file:
        file.write(str(partial))
    os.replace(partial, path)


def read_depth(path: Path) -> NDArray[np.float32]:
    """Channel Z (H, W) float32, metres, 0 = no surface.

    Raises:
        RsbenchError: missing, damaged, without a float32 channel Z, or with negative or non-finite depth.
    """
    import OpenEXR

    if not path.is_file():
        raise RsbenchError(f"{path}: no such depth file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            pixels = np.array(channels["Z"].pixels) if "Z" in channels else None
    except Exception as error:  # OpenEXR raises plain RuntimeError, ValueError and others for damaged files
        raise RsbenchError(f"{path}: damaged or not an EXR file ({str(error).splitlines()[0]})") from error
    if pixels is None or pixels.dtype != np.float32 or pixels.ndim != 2:
        raise RsbenchError(f"{path}: must hold a float32 channel Z")
    if not np.all(np.isfinite(pixels)) or np.any(pixels < 0):
        raise RsbenchError(f"{path}: depth must be finite and not negative (0 = no surface)")
    return pixels


def write_poses(path: Path, tau: FloatArray, poses: Pose) -> None:
    """One line per row: tau and ``cam_from_world`` as unit quaternion and translation, exact decimal numbers."""
    table = np.concatenate([tau[:, None], so3.quaternion(poses.R), poses.t], axis=1)
    lines = [f"{row}," + ",".join(repr(float(x)) for x in values) for row, values in enumerate(table)]
    write_bytes(path, ("\n".join([POSE_COLUMNS, *lines]) + "\n").encode())


def read_poses(path: Path) -> tuple[FloatArray, Pose]:
    """Row times (H,) and ``cam_from_world`` of every row.

    Raises:
        RsbenchError: missing or not in the format of ``write_poses``.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
        table = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    except OSError as error:
        raise RsbenchError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise RsbenchError(f"{path}: not a table of numbers: {error}") from error
    if not lines or lines[0] != POSE_COLUMNS or table.ndim != 2 or table.shape[1] != 9:
        raise RsbenchError(f"{path}: must have the columns {POSE_COLUMNS}")
    if not np.all(np.isfinite(table)) or not np.array_equal(table[:, 0], np.arange(len(table))):
        raise RsbenchError(f"{path}: rows must be numbered 0, 1, ... with finite numbers")
    return table[:, 1], Pose(so3.from_quaternion(table[:, 2:6]), table[:, 6:9])


def save_matches(path: Path, matches: Correspondences) -> None:
    save_arrays(path, {name: getattr(matches, name) for name in MATCH_SETS})


def load_matches(path: Path) -> Correspondences:
    return Correspondences(**load_arrays(path))


def save_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Compressed npz, written atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def write_table(path: Path, frame: pd.DataFrame) -> None:
    """CSV with enough digits to compare runs and few enough to read."""
    write_bytes(path, frame.to_csv(index=False, float_format="%.6g", lineterminator="\n").encode())
