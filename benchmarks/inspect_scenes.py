"""What `rsbench inspect` tells of rendered frames of built-in scenes, and of cameras that read otherwise.

Renders small sequences that read rows, columns, and rows in opposite directions. More readings come of them
without rendering: images turned upside down are read from the bottom, mirrored ones from the right, and the
global-shutter twin of a frame is what a camera without rolling shutter shows.

    python benchmarks/inspect_scenes.py --out DIR
    python benchmarks/inspect_scenes.py --out DIR --rotation 1 --scene castle --scene room
    python benchmarks/inspect_scenes.py --data DATASET       (frames that exist and are read from the top)
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.hypotheses import Scans
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.core.rig import SIDES, VIEWS, Side, StereoRig, View
from rsbench.core.shutter import Scanning
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions

SCENES = {
    "castle": 1.0,
    "corridor": 0.5,
    "forest": 0.5,
    "old-town": 1.0,
    "poles": 0.6,
    "room": 0.4,
    "shelves": 0.6,
    "street": 1.0,
    "terrain": 6.0,
}
"""With the scale of their translation, as in the card `standard`."""
RATIO, ALLOWED = 0.8, 0.03
FOCAL = 1384.6 / 900
"""Focal length over the width of the image: the paper's camera."""
COLUMNS = ("sequence", "true", "told", "readout ratio", "matches", "noise (px)", "verdict")
HEADER = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|\n"
SCANS: dict[str, dict[str, Any]] = {
    "rows": {},
    "columns": {"scan": "left"},
    "opposite": {"right_scan": "bottom"},
}
Images = dict[View, NDArray[np.uint8]]
Flip = Literal["", "upside down", "mirrored"]


class Case(NamedTuple):
    """Frames whose reading is known."""

    scans: Scans
    images: Images
    rig: StereoRig


DERIVED: dict[str, tuple[tuple[Scans, tuple[str, str], Flip], ...]] = {
    "rows": (
        (Scans("top", "top"), ("rs", "rs"), ""),
        (Scans("bottom", "bottom"), ("rs", "rs"), "upside down"),
        (Scans("global", "global"), ("gs", "gs"), ""),
        (Scans("top", "global"), ("rs", "gs"), ""),
        (Scans("global", "bottom"), ("gs", "rs"), "upside down"),
    ),
    "columns": (
        (Scans("left", "left"), ("rs", "rs"), ""),
        (Scans("right", "right"), ("rs", "rs"), "mirrored"),
        (Scans("global", "left"), ("gs", "rs"), ""),
    ),
    "opposite": ((Scans("top", "bottom"), ("rs", "rs"), ""),),
}
"""Of each rendered sequence: the reading, which frames the left and the right camera show, how they are turned."""


def card(name: str, rotation: float, size: int, scenes: Sequence[str]) -> DatasetCard:
    motion = MotionCard(rotation_deg=rotation, rotation_axis="random", translation=0.3, translation_axis="random")
    return DatasetCard(
        name=f"inspect-{name}",
        camera=CameraCard(width=size, height=size, focal=FOCAL * size),
        baseline=0.4,
        readout_ratio=RATIO,
        motion=motion,
        seed=3,
        sequence=tuple(SequenceCard(name=scene, scene=scene, scale=SCENES.get(scene, 1.0)) for scene in scenes),
        **SCANS[name],
    ).expanded()


def cases(sequence: Rendered, name: str) -> Iterator[Case]:
    rig, camera = sequence.rig, sequence.rig.camera
    for scans, kinds, flip in DERIVED[name]:
        shown = {
            (side, frame): sequence.image(kind, side, frame)  # pyrefly: ignore[bad-argument-type]
            for side, kind in zip(SIDES, kinds, strict=True)
            for frame in (0, 1)
        }
        other = camera
        if flip == "upside down":
            shown = {view: np.ascontiguousarray(image[::-1]) for view, image in shown.items()}
            other = replace(camera, cy=camera.height - 1 - camera.cy)
        elif flip == "mirrored":
            shown = {
                (_other(side), frame): np.ascontiguousarray(image[:, ::-1])
                for (side, frame), image in shown.items()
            }
            other = replace(camera, cx=camera.width - 1 - camera.cx)
        yield Case(scans, {view: shown[view] for view in VIEWS}, replace(rig, camera=other))


def _other(side: Side) -> Side:
    return "right" if side == "left" else "left"


def row(name: str, case: Case, ratio: float) -> tuple[str, str, float]:
    """A line of the table; how the reading was named; the error of the ratio, NaN where that is not told."""
    options = CorrectionOptions()
    matches = find_matches_of_rig(case.images, case.rig, Scanning(scan="left"), options)
    found = conclude([examine(matches, case.rig)])
    best, true = found.likeliest, ratio if case.scans.rolls else 0.0
    error = abs(best.ratio - true) if found.determined and best is not None else float("nan")
    said = f"{best.scans.left}, {best.scans.right}" if best is not None and found.named else "cannot tell"
    value = "-" if best is None else f"{best.ratio:.3f} +- {best.sigma:.3f}{'' if found.determined else ' (open)'}"
    right = best is not None and best.scans == case.scans
    verdict = ("right" if right else "WRONG") if found.named else "cannot tell"
    truth = f"{case.scans.left}, {case.scans.right}"
    cells = (name, truth, said, value, f"{found.used}/{found.matches}", f"{found.noise_px:.2f}", verdict)
    return f"| {' | '.join(cells)} |", verdict, error


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--out", type=Path, help="folder of the datasets; rendered where they lack")
    where.add_argument("--data", type=Path, help="dataset of rows read from the top instead")
    parser.add_argument("--rotation", type=float, default=2.0, help="degrees per frame period")
    parser.add_argument("--size", type=int, default=900, help="width and height of the images, px")
    parser.add_argument("--scene", action="append", help="repeatable; default: all nine built-in ones")
    parser.add_argument("--only", default="", help="sequences whose name holds this")
    given = parser.parse_args(arguments)
    folders = {"rows": given.data} if given.data else {name: given.out / name for name in SCANS}
    verdicts, errors = list[str](), list[float]()
    sys.stdout.write(HEADER)
    for name, folder in folders.items():
        if given.data is None:
            generate_dataset(card(name, given.rotation, given.size, given.scene or list(SCENES)), folder)
        for sequence in read_dataset(folder):
            if given.only not in sequence.name:
                continue
            for case in cases(sequence, name):
                line, verdict, error = row(sequence.name, case, sequence.shutter.readout_ratio)
                verdicts.append(verdict)
                errors += [error] if case.scans.rolls else []
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
    told = np.array([error for error in errors if np.isfinite(error)])
    sys.stdout.write(
        f"\n{len(verdicts)} cases: named rightly {verdicts.count('right')}, wrongly {verdicts.count('WRONG')}, "
        f"not {verdicts.count('cannot tell')}; readout ratio told of {len(told)} of the {len(errors)} that roll, "
        f"{np.sum(told <= ALLOWED)} of them within {ALLOWED}, worst {np.max(told, initial=0.0):.3f}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
