"""The layout of Fastec-RS (Liu, Cui, Larsson, Pollefeys, Deep Shutter Unrolling Network, CVPR 2020).

Frames and their truth alone, without calibration, depth or motion, as the loader of DeepUnrollNet
(``dataset_fastec_rs.py``) asks for them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rsbench.core.rig import SIDES
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import Images, refuse, write_lines
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import inside, read_bytes

ABOUT = (
    "SEQUENCE_left and SEQUENCE_right, each with NNN_rolling.png, NNN_global_first.png (the twin of the first "
    "row), NNN_global_middle.png (of row height // 2, where the dataset has that twin) and meta.log, by which "
    "the loader knows the folder of a sequence. There is no calibration, depth or motion: a readout ratio of 1 "
    "is what those who use the layout assume."
)
_NAME = "fastec-rs"
_META = "meta.log"
"""By which the loader knows the folder of a sequence; it does not read it."""
_MOST = 1000
"""Frames that three digits number."""


def check(sequence: Sequence, images: Images) -> None:
    """Raises RsbenchError for a scan or a number of frames that the layout does not know."""
    if {sequence.shutter.scan_of(side) for side in SIDES} != {"top"}:
        refuse(sequence, _NAME, "its rows are read from the top", "choose other sequences")
    if sequence.frames > _MOST:
        refuse(
            sequence, _NAME, f"its frames have three digits, {sequence.frames} are more", "choose other sequences"
        )


def write(sequence: Sequence, root: Path, images: Images) -> dict[str, Any]:
    """The files of one sequence in folders of its name below ``root``; what has to be said of them."""
    shutter = sequence.shutter
    middle = shutter.height // 2
    for side in SIDES:
        place = root / f"{sequence.name}_{side}"
        place.mkdir(parents=True)
        write_lines(place / _META, [f"# {sequence.name}, {side} camera: readout ratio {shutter.readout_ratio:g}"])
        for frame in range(sequence.frames):
            names = {"rolling": picture_file("rs", side, frame), "global_first": picture_file("gs", side, frame)}
            if middle in sequence.twins:
                names["global_middle"] = picture_file("gs", side, frame, middle)
            for name, file in names.items():
                path = place / f"{frame:03d}_{name}.png"
                write_bytes(path, read_bytes(inside(sequence.folder, file)))
    told = []
    if middle not in sequence.twins:
        told.append(f"there is no twin of row {middle}, so no NNN_global_middle.png, which training reads")
    if shutter.readout_ratio != 1.0:
        told.append(f"the readout ratio is {shutter.readout_ratio:g}, where those who use the layout assume 1")
    return {"told": told}
