"""Training data: windows of frames as arrays, shards for WebDataset, and a folder for Hugging Face's ``datasets``.

WebDataset: tar files with one sample per frame of each sequence, in order and with reproducible bytes. A sample
consists of all files with the same key, which is the part of the file name before the first dot. The rest of the
name is a field, whose last suffix selects the decoder (webdataset's ``autodecode``): png, npy or json.

Hugging Face: ``datasets.load_dataset("imagefolder", data_dir=OUT)`` reads a folder whose metadata.jsonl has a line
for each frame of each camera, with the columns of ImageFolder: ``file_name`` and ``gs_file_name`` are loaded as
images, all other columns unchanged.
"""

from __future__ import annotations

import io
import json
import os
import tarfile
from bisect import bisect_right
from collections.abc import Iterator
from collections.abc import Sequence as Series
from contextlib import ExitStack
from itertools import accumulate
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_whole
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, views_of
from rsbench.dataset.layout import SHUTTERS, picture_file
from rsbench.dataset.sequence import Sequence, read_dataset, read_dataset_manifest
from rsbench.interop.writers.sequence_views import Format, Images, Note, View, copy_file, first_second, write_lines
from rsbench.storage.untrusted_files import inside, read_bytes

Part = Literal["rs", "gs", "rs_depth", "gs_depth", "poses"]


class FrameSamples:
    """Windows of successive frames of both cameras that share no frame, so that no file is read twice.

    Item k is a dictionary with the name ``sequence``, the first ``frame`` of the window, and arrays for each side
    and part, such as ``left_rs``: images (frames, H, W, 3) uint8 or depth (frames, H, W) float32. The part
    ``poses`` gives ``left_poses`` (frames, lines, 3, 4), ``cam_from_world`` of every line, and ``left_times``
    (frames, lines), frame periods. The world is the body at time 0 of the sequence.

    Args:
        folder: of the dataset; dataset.json and each sequence.json are read here, and not again.
        frames: frames of a window; frames at the end of a sequence that do not fill one are left out.
        parts: the parts to read.

    Raises:
        RsbenchError: the folder is not a dataset, or a sequence has fewer frames than a window.
        ValueError: a part is unknown, or the window has no frames.
    """

    def __init__(
        self,
        folder: str | PathLike[str],
        *,
        frames: int = 1,
        parts: Series[Part] = ("rs", "gs", "rs_depth", "poses"),
    ) -> None:
        check_whole("frames", frames, 1)
        if unknown := [part for part in parts if part not in get_args(Part)]:
            raise ValueError(f"parts: {unknown[0]!r} must be one of {', '.join(get_args(Part))}")
        self.sequences = read_dataset(Path(folder))
        self.frames, self.parts = frames, tuple(parts)
        counts = [sequence.frames // frames for sequence in self.sequences]
        if not all(counts):
            short = self.sequences[counts.index(0)]
            raise RsbenchError(f"{short.folder}: has {short.frames} frames, fewer than frames = {frames}")
        self._ends = list(accumulate(counts))

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index}: there are {len(self)}")
        place = bisect_right(self._ends, index)
        sequence = self.sequences[place]
        first = self.frames * (index - (self._ends[place - 1] if place else 0))
        sample: dict[str, Any] = {"sequence": sequence.name, "frame": first}
        for side in SIDES:
            for part in self.parts:
                read = [_read_part(sequence, side, frame, part) for frame in range(first, first + self.frames)]
                for name in read[0]:
                    sample[f"{side}_{name}"] = np.stack([each[name] for each in read])
        return sample


def _read_part(sequence: Sequence, side: Side, frame: int, part: Part) -> dict[str, NDArray[Any]]:
    if part == "poses":
        tau, pose = sequence.poses(side, frame)
        return {"times": tau, "poses": np.concatenate([pose.R, pose.t[..., None]], axis=-1)}
    if part in ("rs", "gs"):
        return {part: sequence.image("rs" if part == "rs" else "gs", side, frame)}
    return {part: sequence.depth("rs" if part == "rs_depth" else "gs", side, frame)}


_WEBDATASET_ABOUT = (
    "shard-NNNNNN.tar: a sample for each time of each sequence, with left and right: SIDE.rs.png, "
    "SIDE.gs.png, SIDE.rs_depth.npy and SIDE.gs_depth.npy (z in the camera of the pixel's own line, metres,"
    " 0 = no surface), SIDE.times.npy (lines, seconds), SIDE.poses.npy (lines, 3, 4: cam_from_world of "
    "every line), and json: camera, rig, shutter and motion. Pixels have (0, 0) in the centre of the first "
    "one."
)
SHARD_BYTES = 256 << 20
"""Size above which a shard is closed and a new one started."""
SHARD_SAMPLES = 1000
_LINE_FIELDS = (
    *("camera", "cameras", "right_from_left"),  # ideal rigs have the first, other rigs the other two
    *("baseline", "readout_ratio", "frame_period_s", "motion"),
)
_SAMPLE_FIELDS = (*_LINE_FIELDS, "readout_time_s", "conventions")


def _write_shards(sequences: list[Sequence], root: Path, images: Images) -> Iterator[Note]:
    """Write the samples of sequences to shards below ``root``."""
    shards = _Shards(root)
    try:
        for number, sequence in enumerate(sequences):
            for frame in range(sequence.frames):
                # A dot would end the key; the number distinguishes names that differ only in dots.
                key = f"{number:06d}-{sequence.name.replace('.', '_')}-{frame:04d}"
                shards.add({f"{key}.{name}": data for name, data in _sample_files(sequence, frame).items()})
            yield _left_out("samples", sequence, []), {"samples": sequence.frames}
    finally:
        shards.close()


class _Shards:
    """Writer of tar files; a new one is started when the current one is full."""

    def __init__(self, root: Path) -> None:
        self._root, self._count, self._samples, self._bytes = root, 0, 0, 0
        self._open = ExitStack()
        self._shard: tarfile.TarFile | None = None

    def add(self, files: dict[str, bytes]) -> None:
        """Add a sample; all its files are in the same shard."""
        if self._shard is None or self._samples >= SHARD_SAMPLES or self._bytes > SHARD_BYTES:
            self._shard = self._next()
        for name, data in files.items():
            header = tarfile.TarInfo(name)  # without owner and time, so that the bytes are reproducible
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


def _left_out(place: str, sequence: Sequence, more: list[str]) -> list[str]:
    names = [*sequence.channels, *(["labels of what moves"] if sequence.moving else []), *more]
    names += ["twins as the sensor exposes them"] if sequence.exposed_twins and sequence.sensor else []
    return [f"not in the {place}: {', '.join(names)}"] if names else []


def _sample_files(sequence: Sequence, frame: int) -> dict[str, bytes]:
    """Return the files of a sample by the part of their names after the first dot."""
    fields = dict[str, bytes]()
    for side in SIDES:
        parts: tuple[Part, ...] = ("rs_depth", "gs_depth", "poses")
        arrays = {name: array for part in parts for name, array in _read_part(sequence, side, frame, part).items()}
        arrays["times"] = sequence.frame_period_s * arrays["times"]
        for shutter in SHUTTERS:
            file = inside(sequence.folder, picture_file(shutter, side, frame + sequence.first))
            fields[f"{side}.{shutter}.png"] = read_bytes(file)
        fields |= {f"{side}.{name}.npy": _npy(array) for name, array in arrays.items()}
    starts = {side: first_second(sequence, View(side, frame)) for side in SIDES}
    about = {"sequence": sequence.name, "frame": frame, "first_line_s": starts}
    known = {name: sequence.manifest[name] for name in _SAMPLE_FIELDS if name in sequence.manifest}
    scan = sequence.shutter.scanning.record
    return fields | {"json": json.dumps(about | known | scan, sort_keys=True, allow_nan=False).encode()}


def _npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


_HUGGINGFACE_ABOUT = (
    "README.md (a dataset card) and metadata.jsonl: a line for each frame of each camera with file_name, the "
    "rolling-shutter frame; gs_file_name, what a global shutter would have seen at the first row's time; depth "
    "(EXR, metres) and poses (CSV, of every row), which are paths; the two "
    "images are the columns image and gs; camera, baseline, shutter and motion. Then: "
    'datasets.load_dataset("imagefolder", data_dir=OUT, split="train").'
)
_DATASET_CARD = """---
license: {licence}
task_categories: [image-to-image, depth-estimation]
tags: [rolling-shutter, stereo, synthetic]
pretty_name: {name}
---

Rolling-shutter stereo, made by rsbench. {about}"""


def _write_folder(sequences: list[Sequence], root: Path, images: Images) -> Iterator[Note]:
    """Write the files and the metadata lines of sequences below ``root``."""
    lines = list[str]()
    for sequence in sequences:
        known = {name: sequence.manifest[name] for name in _LINE_FIELDS if name in sequence.manifest}
        known |= sequence.shutter.scanning.record
        for side, frame in views_of(sequence.frames):
            own = {
                "file_name": picture_file("rs", side, frame),
                "gs_file_name": picture_file("gs", side, frame),
                "depth": picture_file("rs", side, frame, depth=True),
                "poses": f"poses/{side}_{frame}.csv",
            }
            for file in own.values():
                copy_file(sequence.folder, file, root / sequence.name / file)
            paths = {key: f"{sequence.name}/{file}" for key, file in own.items()}
            about = {"sequence": sequence.name, "side": side, "frame": frame}
            lines.append(json.dumps(paths | about | known, allow_nan=False))
        twins = ["twins of other rows"] if sequence.twins else []
        yield _left_out("folder", sequence, twins), {"lines": 2 * sequence.frames}
    write_lines(root / "metadata.jsonl", lines)
    manifest = read_dataset_manifest(sequences[0].folder.parent)
    licence, name = json.dumps(manifest.license.lower()), json.dumps(manifest.name)
    write_lines(root / "README.md", [_DATASET_CARD.format(licence=licence, name=name, about=_HUGGINGFACE_ABOUT)])


WEBDATASET = Format(_WEBDATASET_ABOUT, (), _write_shards)
HUGGINGFACE = Format(_HUGGINGFACE_ABOUT, (), _write_folder)
