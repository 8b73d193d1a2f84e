"""Submissions of pictures that show how much there is to gain: the truth, and what knows or does next to nothing.

Each is written as anybody's would be: a file of answers, and the folder ``pictures`` beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.leaderboard.picture_files import FOLDER, frame_png
from rsbench.benchmark.leaderboard.protocols import ORACLE, Asks
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import submission_text, template_header, truth_text
from rsbench.benchmark.leaderboard.true_pictures import VIEW, TruePictures
from rsbench.core.rig import VIEWS
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.storage.files import write_bytes, write_depth
from rsbench.storage.untrusted_files import read_bytes

Draw = Callable[[TruePictures, Path], None]
"""Writes the pictures of one problem into a folder."""


def write_truth(split: Split, folder: Path, file: str = "predictions.jsonl") -> Path:
    """The true pictures as a submission; returns its file of answers."""
    return _write(split, folder, truth_text(split), _truth, file)


def write_oracles(split: Split, folder: Path) -> Iterator[Path]:
    """The truth and others, each in a folder below this one; the files of answers."""
    yield write_truth(split, folder / "truth")
    for method, uses, description, draw in _OTHERS[split.protocol.asks]:
        header = {
            "protocol": split.protocol.id,
            "split": split.name,
            "method": method,
            "uses": [uses],
            "description": description,
            "code": "rsbench",
        }
        text = submission_text(header, ({"name": truth.name} for truth in split.truths))
        yield _write(split, folder / method, text, draw)


def write_template(split: Split, folder: Path) -> Path:
    """A submission without a fault: the pictures of one problem, and a failure for every other."""
    first, *rest = split.truths
    failures = ({"name": truth.name, "success": False, "reason": "not tried"} for truth in rest)
    header = {**template_header(split), "uses": ["images"]}
    assert first.pictures is not None
    (folder / FOLDER / first.name).mkdir(parents=True, exist_ok=True)
    draw = _far if split.protocol.asks == "depth" else _uncorrected
    draw(first.pictures, folder / FOLDER / first.name)
    path = folder / "predictions.jsonl"
    write_bytes(path, submission_text(header, iter([{"name": first.name}, *failures])).encode())
    return path


def _write(split: Split, folder: Path, text: str, draw: Draw, file: str = "predictions.jsonl") -> Path:
    for truth in split.truths:
        assert truth.pictures is not None
        place = folder / FOLDER / truth.name
        place.mkdir(parents=True, exist_ok=True)
        draw(truth.pictures, place)
    write_bytes(folder / file, text.encode())
    return folder / file


def _truth(pictures: TruePictures, place: Path) -> None:
    for each in pictures.asked:
        path = pictures.path(each)
        write_bytes(place / f"{each.stem}{path.suffix}", read_bytes(path))


def _constant(pictures: TruePictures, place: Path) -> None:
    depth = pictures.depth()
    surface = depth[depth > 0.0]
    _flat(pictures, place, float(np.median(surface)) if surface.size else 0.0)


def _far(pictures: TruePictures, place: Path) -> None:
    _flat(pictures, place, 10.0)


def _flat(pictures: TruePictures, place: Path, depth_m: float) -> None:
    (each,) = pictures.asked
    write_depth(place / f"{each.stem}.exr", np.full(pictures.size[::-1], depth_m, dtype=np.float32))


def _uncorrected(pictures: TruePictures, place: Path) -> None:
    image = pictures.rolling()
    for each in pictures.asked:
        write_bytes(place / f"{each.stem}.png", frame_png(image, np.ones(image.shape[:2], dtype=np.bool_)))


def _best(pictures: TruePictures, place: Path) -> None:
    """Our default corrector with the true motion and depth."""
    sequence = pictures.sequence
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    given = Given(motion=sequence.motion, pairs=true_pairs(sequence, images))
    for each in pictures.asked:
        options = CorrectionOptions(target_row=each.row)
        ratio = sequence.shutter.readout_ratio
        fused = correct_four(images, sequence.rig, ratio, options, given=given, views=(VIEW,)).frames[VIEW]
        write_bytes(place / f"{each.stem}.png", frame_png(fused.image, fused.origin != 0))


_OTHERS: dict[Asks, tuple[tuple[str, str, str, Draw], ...]] = {
    "depth": (("constant", ORACLE, "The median true depth of each sequence, everywhere", _constant),),
    "frames": (
        ("uncorrected", "images", "The rolling-shutter frame as it is", _uncorrected),
        ("fusion-true", ORACLE, "The corrector fusion with the true motion and depth", _best),
    ),
}
"""Name, what it uses, description, pictures."""
