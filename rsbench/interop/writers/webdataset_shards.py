"""WebDataset: tar files of samples, one sample for each time of each sequence, in order and with fixed bytes.

A sample is all files of one key, what stands before the first point of a name; what stands behind it is a field,
whose last part says how it is decoded (webdataset's ``autodecode``): png, npy, json.
"""

from __future__ import annotations

import io
import json
import os
import tarfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rsbench.core.rig import SIDES
from rsbench.dataset.layout import SHUTTERS, picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import Images, View, first_second
from rsbench.storage.untrusted_files import inside, read_bytes

ABOUT = (
    "shard-NNNNNN.tar: a sample for each time of each sequence, with left and right: SIDE.rs.png, "
    "SIDE.gs.png, SIDE.rs_depth.npy and SIDE.gs_depth.npy (z in the camera of the pixel's own line, metres,"
    " 0 = no surface), SIDE.times.npy (lines, seconds), SIDE.poses.npy (lines, 3, 4: cam_from_world of "
    "every line), and json: camera, rig, shutter and motion. Pixels have (0, 0) in the centre of the first "
    "one."
)
SHARD_BYTES = 256 << 20
"""A shard is closed when it holds more."""
SHARD_SAMPLES = 1000
_COPIED = ("camera", "baseline", "readout_ratio", "frame_period_s", "readout_time_s", "motion", "conventions")


def check(sequence: Sequence, images: Images) -> None:
    """Samples hold every line's pose, whatever the cameras are."""


def write_all(sequences: list[Sequence], root: Path) -> Iterator[dict[str, Any]]:
    """The samples of sequences, in shards below ``root``; yields after each what has to be said of it."""
    shards = _Shards(root)
    try:
        for number, sequence in enumerate(sequences):
            for frame in range(sequence.frames):
                # A point would end the key: names that differ in points alone are told apart by their number.
                key = f"{number:06d}-{sequence.name.replace('.', '_')}-{frame:04d}"
                shards.add({f"{key}.{name}": data for name, data in _fields(sequence, frame).items()})
            yield {"samples": sequence.frames, "told": _told(sequence)}
    finally:
        shards.close()


class _Shards:
    """Tar files, each closed when it is full."""

    def __init__(self, root: Path) -> None:
        self._root, self._count, self._samples, self._bytes = root, 0, 0, 0
        self._open = ExitStack()
        self._shard: tarfile.TarFile | None = None

    def add(self, files: dict[str, bytes]) -> None:
        """One sample, whole in one shard."""
        if self._shard is None or self._samples >= SHARD_SAMPLES or self._bytes > SHARD_BYTES:
            self._shard = self._next()
        for name, data in files.items():
            header = tarfile.TarInfo(name)  # of nobody, in 1970: the same bytes whoever writes it, and when
            header.size = len(data)
            self._shard.addfile(header, io.BytesIO(data))
            self._bytes += len(data)
        self._samples += 1

    def _next(self) -> tarfile.TarFile:
        self.close()
        stream = self._open.enter_context((self._root / f"shard-{self._count:06d}.tar").open("xb"))
        self._open.callback(_sync, stream)
        self._count, self._samples, self._bytes = self._count + 1, 0, 0
        return self._open.enter_context(tarfile.open(fileobj=stream, mode="w"))

    def close(self) -> None:
        self._open.close()


def _sync(stream: BinaryIO) -> None:
    stream.flush()
    os.fsync(stream.fileno())


def _told(sequence: Sequence) -> list[str]:
    left_out = [*sequence.channels, *(["labels of what moves"] if sequence.moving else [])]
    return [f"not in the samples: {', '.join(left_out)}"] if left_out else []


def _fields(sequence: Sequence, frame: int) -> dict[str, bytes]:
    """Files of one sample by what stands behind the first point of their names."""
    fields = dict[str, bytes]()
    for side in SIDES:
        tau, pose = sequence.poses(side, frame)
        arrays = {
            "rs_depth": sequence.depth("rs", side, frame),
            "gs_depth": sequence.depth("gs", side, frame),
            "times": sequence.frame_period_s * tau,
            "poses": np.concatenate([pose.R, pose.t[..., None]], axis=-1),
        }
        for shutter in SHUTTERS:
            file = inside(sequence.folder, picture_file(shutter, side, frame + sequence.first))
            fields[f"{side}.{shutter}.png"] = read_bytes(file)
        fields |= {f"{side}.{name}.npy": _npy(array) for name, array in arrays.items()}
    starts = {side: first_second(sequence, View(side, frame)) for side in SIDES}
    about = {"sequence": sequence.name, "frame": frame, "first_line_s": starts}
    known = {name: sequence.manifest[name] for name in _COPIED}
    scan = asdict(sequence.shutter.scanning)
    return fields | {"json": json.dumps(about | known | scan, sort_keys=True, allow_nan=False).encode()}


def _npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()
