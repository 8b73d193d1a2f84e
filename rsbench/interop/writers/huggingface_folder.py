"""The folder that ``datasets.load_dataset("imagefolder", data_dir=OUT)`` of Hugging Face reads.

metadata.jsonl has a line for each frame of each camera, with the columns of ImageFolder: ``file_name`` and
``gs_file_name`` become images, all else stays what it is.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rsbench.core.rig import views_of
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_dataset_manifest
from rsbench.interop.writers.image_poses import Images, write_lines
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import inside, read_bytes

ABOUT = (
    "README.md (a dataset card) and metadata.jsonl: a line for each frame of each camera with file_name, the "
    "rolling-shutter frame; gs_file_name, what a global shutter would have seen at the first row's time; depth "
    "(EXR, metres) and poses (CSV, of every row), which are paths; the two "
    "images are the columns image and gs; camera, baseline, shutter and motion. Then: "
    'datasets.load_dataset("imagefolder", data_dir=OUT, split="train").'
)
_COPIED = ("camera", "baseline", "readout_ratio", "frame_period_s", "motion")
_CARD = """---
license: {licence}
task_categories: [image-to-image, depth-estimation]
tags: [rolling-shutter, stereo, synthetic]
pretty_name: {name}
---

Rolling-shutter stereo, made by rsbench. {about}"""


def check(sequence: Sequence, images: Images) -> None:
    """Lines hold what cameras there are."""


def write_all(sequences: list[Sequence], root: Path) -> Iterator[dict[str, Any]]:
    """Files and lines of sequences below ``root``; yields after each what has to be said of it."""
    lines = list[str]()
    for sequence in sequences:
        known = {name: sequence.manifest[name] for name in _COPIED}
        known |= asdict(sequence.shutter.scanning)
        for side, frame in views_of(sequence.frames):
            own = {
                "file_name": picture_file("rs", side, frame),
                "gs_file_name": picture_file("gs", side, frame),
                "depth": picture_file("rs", side, frame, depth=True),
                "poses": f"poses/{side}_{frame}.csv",
            }
            for file in own.values():
                path = root / sequence.name / file
                path.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(path, read_bytes(inside(sequence.folder, file)))
            paths = {key: f"{sequence.name}/{file}" for key, file in own.items()}
            about = {"sequence": sequence.name, "side": side, "frame": frame}
            lines.append(json.dumps(paths | about | known, allow_nan=False))
        yield {"lines": 2 * sequence.frames, "told": _told(sequence)}
    write_lines(root / "metadata.jsonl", lines)
    manifest = read_dataset_manifest(sequences[0].folder.parent)
    licence, name = json.dumps(manifest.license.lower()), json.dumps(manifest.name)
    write_lines(root / "README.md", [_CARD.format(licence=licence, name=name, about=ABOUT)])


def _told(sequence: Sequence) -> list[str]:
    left_out = [*sequence.channels, *(["labels of what moves"] if sequence.moving else [])]
    left_out += ["twins of other rows"] if sequence.twins else []
    return [f"not in the folder: {', '.join(left_out)}"] if left_out else []
