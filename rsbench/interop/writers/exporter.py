"""Export of datasets to the layouts of other projects: the table of formats, and atomic writing of an export."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rsbench.core.errors import RsbenchError
from rsbench.core.version import __version__
from rsbench.dataset.corrected_frames import fresh_folder
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.interop.writers.colmap_and_tum import (
    COLMAP,
    CORRECTED_ABOUT,
    TUM,
    check_corrected,
    export_corrected,
    is_corrected,
    read_corrected_folder,
)
from rsbench.interop.writers.deep_unroll_folders import CARLA_RS, FASTEC_RS
from rsbench.interop.writers.frame_samples import HUGGINGFACE, WEBDATASET
from rsbench.interop.writers.kitti_and_kalibr import KALIBR, KITTI
from rsbench.interop.writers.sequence_views import Images, Note, write_lines
from rsbench.interop.writers.splatting import GSPLAT, NERFSTUDIO
from rsbench.storage.files import check_out, write_json

Progress = Callable[[str], None]
RECORD, README = "export.json", "README.txt"


FORMATS = {
    "colmap": COLMAP,
    "tum": TUM,
    "kalibr": KALIBR,
    "nerfstudio": NERFSTUDIO,
    "gsplat": GSPLAT,
    "kitti": KITTI,
    "carla-rs": CARLA_RS,
    "fastec-rs": FASTEC_RS,
    "webdataset": WEBDATASET,
    "huggingface": HUGGINGFACE,
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
    """Export a dataset or corrected frames in another layout; ``out`` is created when the export is complete.

    Args:
        folder: folder of the dataset, or output folder of ``rsbench correct``.
        name: name of the format.
        out: a missing or empty folder, or an earlier export, which is replaced.
        images: type of images; None: the default of the format.
        only: names of sequences; empty: all.
        progress: called with the name of each sequence.

    Returns:
        Sentences on what the format cannot represent of these sequences; README.txt has them too.

    Raises:
        RsbenchError: the format or the dataset does not exist, the format cannot represent a sequence, or ``out``
            cannot be written.
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
    for sequence in sequences:
        if fault := kind.fault(sequence, chosen):
            raise RsbenchError(f"--to {name}: sequence {sequence.name}: {fault}")
    check_out(out)
    with fresh_folder(out, "rsbench export") as fresh:
        notes = dict[str, Note]()
        for sequence, note in zip(sequences, kind.write(sequences, fresh, chosen), strict=True):
            notes[sequence.name] = note
            progress(sequence.name)
        return _write_record(fresh, name, kind.about, notes, {"images": chosen} if kind.images else {})


def _export_corrected(
    folder: Path, name: str, out: Path, images: Images | None, only: tuple[str, ...], progress: Progress
) -> list[str]:
    """Export an output folder of ``rsbench correct``; see ``export_dataset``."""
    if images is not None or only:
        option = f"--images {images}" if images is not None else f"--sequence {only[0]}"
        raise RsbenchError(f"{option}: {folder} holds one sequence of corrected frames; leave the option out")
    corrected = read_corrected_folder(folder)
    check_corrected(corrected, name)
    check_out(out)
    with fresh_folder(out, "rsbench export") as fresh:
        notes = {corrected.name: export_corrected(corrected, name, fresh)}
        progress(corrected.name)
        return _write_record(fresh, name, CORRECTED_ABOUT[name], notes, {})


def _write_record(fresh: Path, name: str, about: str, notes: dict[str, Note], more: dict[str, Any]) -> list[str]:
    """Write README.txt for people and export.json for programs; return the sentences of all notes."""
    sentences = [f"{key}: {sentence}" for key, (words, _) in notes.items() for sentence in words]
    record = {"format": 1, "rsbench": __version__, "to": name, "about": about, **more}
    sequences = {key: {**fields, "told": words} for key, (words, fields) in notes.items()}
    write_json(fresh / RECORD, {**record, "sequences": sequences})
    readme = [f"Written by rsbench {__version__}: rsbench export --to {name}", "", about, *sentences]
    write_lines(fresh / README, readme)
    return sentences


def chosen_sequences(folder: Path, only: tuple[str, ...]) -> list[Sequence]:
    """Return the sequences with these names, or all without names; RsbenchError for an unknown name."""
    sequences = read_dataset(folder)
    names = [sequence.name for sequence in sequences]
    if unknown := [name for name in only if name not in names]:
        raise RsbenchError(
            f"--sequence {unknown[0]}: there is no such sequence; there are: {', '.join(names[:20])}"
        )
    return [sequence for sequence in sequences if not only or sequence.name in only]
