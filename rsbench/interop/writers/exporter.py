"""Datasets in the layouts of others: which there are, what each holds, and writing all of it or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from rsbench.core.errors import RsbenchError
from rsbench.core.version import __version__
from rsbench.dataset.corrected_frames import fresh_folder
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.interop.writers.corrected_folder import ABOUT as ABOUT_CORRECTED
from rsbench.interop.writers.corrected_folder import check as check_corrected
from rsbench.interop.writers.corrected_folder import export_corrected, is_corrected, read_corrected_folder
from rsbench.interop.writers.image_poses import Images, write_lines
from rsbench.storage.files import check_out, write_json

Progress = Callable[[str], None]
RECORD, README = "export.json", "README.txt"


class Format(NamedTuple):
    """A layout of others."""

    module: str
    """Below ``rsbench.interop.writers``; has ``ABOUT``, ``check`` and ``write``, or ``write_all``."""
    images: tuple[Images, ...]
    """Those of which it can be made, the default first; none: it holds no image, or all."""


FORMATS = {
    "colmap": Format("colmap_text", ("gs", "rs")),
    "tum": Format("tum_text", ()),
    "kalibr": Format("kalibr_yaml", ()),
    "nerfstudio": Format("nerfstudio_json", ("rs", "gs")),
    "gsplat": Format("gsplat_arrays", ("rs", "gs")),
    "kitti": Format("kitti_folders", ("gs", "rs")),
    "carla-rs": Format("carla_folders", ()),
    "fastec-rs": Format("fastec_folders", ()),
    "webdataset": Format("webdataset_shards", ()),
    "huggingface": Format("huggingface_folder", ()),
}


def export_dataset(
    folder: Path,
    name: str,
    out: Path,
    *,
    images: Images | None = None,
    only: tuple[str, ...] = (),
    progress: Progress = lambda word: None,
) -> list[str]:
    """Write a dataset, or corrected frames, in another layout; ``out`` appears when all of it is written.

    Args:
        folder: of the dataset, or of what ``rsbench correct`` made of footage.
        name: of the format.
        out: a folder that is empty, missing, or of an earlier export, which is replaced.
        images: None is what the format holds best.
        only: names of sequences; all when empty.
        progress: called with the name of each sequence that is written.

    Returns:
        What the format cannot hold of these sequences, in sentences; they are in README.txt too.

    Raises:
        RsbenchError: no such format, no dataset, what the format cannot hold, or ``out`` cannot be written.
    """
    if name not in FORMATS:
        raise RsbenchError(f"--to {name}: must be one of {', '.join(FORMATS)}")
    if is_corrected(folder):
        return _export_corrected(folder, name, out, images, only, progress)
    kind = FORMATS[name]
    if images is not None and images not in kind.images:
        one = f"is made of {', '.join(kind.images)}" if kind.images else "takes no choice of images"
        raise RsbenchError(f"--images {images}: {name} {one}")
    chosen: Images = images or (kind.images[0] if kind.images else "rs")
    sequences = chosen_sequences(folder, only)
    module: Any = import_module(f"rsbench.interop.writers.{kind.module}")
    for sequence in sequences:
        module.check(sequence, chosen)
    check_out(out)
    with fresh_folder(out, "rsbench export") as fresh:
        notes = dict[str, dict[str, Any]]()
        for sequence, note in zip(sequences, _written(module, sequences, fresh, chosen), strict=True):
            notes[sequence.name] = note
            progress(sequence.name)
        return _tell(fresh, name, module.ABOUT, notes, {"images": chosen} if kind.images else {})


def _export_corrected(
    folder: Path, name: str, out: Path, images: Images | None, only: tuple[str, ...], progress: Progress
) -> list[str]:
    """``export_dataset`` of what ``rsbench correct`` made of footage."""
    if images is not None or only:
        option = f"--images {images}" if images is not None else f"--sequence {only[0]}"
        raise RsbenchError(f"{option}: {folder} holds one sequence of corrected frames; leave the option out")
    corrected = read_corrected_folder(folder)
    check_corrected(corrected, name)
    check_out(out)
    with fresh_folder(out, "rsbench export") as fresh:
        notes = {corrected.name: export_corrected(corrected, name, fresh)}
        progress(corrected.name)
        return _tell(fresh, name, ABOUT_CORRECTED[name], notes, {})


def _tell(fresh: Path, name: str, about: str, notes: dict[str, dict[str, Any]], more: dict[str, Any]) -> list[str]:
    """Write what is there, for people and programs; returns what had to be said."""
    told = [f"{key}: {sentence}" for key, note in notes.items() for sentence in note["told"]]
    record = {"format": 1, "rsbench": __version__, "to": name, "about": about, **more}
    write_json(fresh / RECORD, {**record, "sequences": notes})
    readme = [f"Written by rsbench {__version__}: rsbench export --to {name}", "", about, *told]
    write_lines(fresh / README, readme)
    return told


def _written(module: Any, sequences: list[Sequence], fresh: Path, images: Images) -> Iterator[dict[str, Any]]:
    if hasattr(module, "write_all"):  # of files that hold several sequences
        yield from module.write_all(sequences, fresh)
        return
    for sequence in sequences:
        yield module.write(sequence, fresh, images)


def chosen_sequences(folder: Path, only: tuple[str, ...]) -> list[Sequence]:
    """Those of a dataset that are named, all without names; RsbenchError for a name that none has."""
    sequences = read_dataset(folder)
    names = [sequence.name for sequence in sequences]
    if unknown := [name for name in only if name not in names]:
        raise RsbenchError(
            f"--sequence {unknown[0]}: there is no such sequence; there are: {', '.join(names[:20])}"
        )
    return [sequence for sequence in sequences if not only or sequence.name in only]
