"""What pictures of a sequence are asked, and the truth that they are compared with.

Asked is frame 1 of the left camera, the later one, for which a method may look at the frame before. Pictures of a
split are what its fingerprint is of: a file that has changed since then is refused by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.images.score import visible_pixels
from rsbench.benchmark.leaderboard.track import Track
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_dataset_manifest
from rsbench.storage.files import read_png, sha256
from rsbench.storage.untrusted_files import inside
from rsbench.vision.stereo_depth import seen_by_other

VIEW: View = ("left", 1)
"""Whose depth and corrected frames are asked."""


class Asked(NamedTuple):
    """A picture that an answer holds."""

    stem: str
    """Of its file, such as ``left_1_middle``."""
    row: int
    """At whose time, counted as rows are read; of depth, 0: each pixel is of its own row's time."""
    file: str
    """Of the true picture, below the folder of the sequence."""
    suffixes: tuple[str, ...] = (".png",)
    """Of kinds of files that it may be."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TruePictures:
    """A sequence whose files are those of a split."""

    sequence: Sequence
    asked: tuple[Asked, ...]
    files: Mapping[str, str]
    """SHA-256 by the path below the sequence's folder: of all that methods see, and that scores are of."""

    def check(self) -> None:
        """Raises RsbenchError when a file is not the one of the split."""
        for name, digest in self.files.items():
            path = inside(self.sequence.folder, name)
            if not path.is_file() or sha256(path) != digest:
                raise RsbenchError(f"{path}: is not the file that dataset.json names; rsbench verify says more")

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.sequence.rig.camera.width, self.sequence.rig.camera.height

    def path(self, each: Asked) -> Path:
        """File of the true picture."""
        return inside(self.sequence.folder, each.file)

    def depth(self) -> NDArray[np.float32]:
        """(H, W) true depth, m, 0 where there is no surface."""
        return self.sequence.depth("rs", *VIEW)

    def frame(self, row: int) -> NDArray[np.uint8]:
        """(H, W, 3) what a global shutter sees from the pose of a row that is asked for."""
        (file,) = (each.file for each in self.asked if each.row == row)
        return read_png(inside(self.sequence.folder, file), self.size)

    def rolling(self) -> NDArray[np.uint8]:
        """(H, W, 3) the frame as it is."""
        return self.sequence.image("rs", *VIEW)

    def seen_by_both(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(H, W) pixels of the frame, of that true ``depth`` (H, W), whose point the right camera sees too."""
        return seen_by_other(depth, self.sequence.depth("rs", "right", 1), self.sequence.rig, "left")

    def commons(self) -> list[NDArray[np.bool_]]:
        """(H, W) pixels of each corrected frame whose place the rolling-shutter frame saw, the same for all."""
        images = {view: self.sequence.image("rs", *view) for view in VIEWS}
        pairs = true_pairs(self.sequence, images)
        return [visible_pixels(self.sequence, pairs, (VIEW,), each.row)[VIEW] for each in self.asked]


def true_pictures(folder: Path, sequences: Iterable[Sequence], track: Track) -> dict[str, TruePictures]:
    """Those of a dataset, by the names of its sequences or pairs of frames.

    Raises:
        RsbenchError: dataset.json lists no such file; the cameras have a lens or other scans, or objects move.
    """
    listed = read_dataset_manifest(folder).files
    found = {}
    for sequence in sequences:
        if sequence.rig.camera.lens is not None or not sequence.shutter.plain or sequence.moving:
            raise RsbenchError(
                f"{folder}: {sequence.name}: {track.id} is of cameras without a lens that read rows together "
                "from the top, and of scenes that stand still; choose another dataset"
            )
        pictures = track.asked(sequence)
        files = {}
        for name in (*_files(sequence, pictures), *track.shown(sequence)):
            if (manifest := listed.get(f"{sequence.whole}/{name}")) is None:
                raise RsbenchError(f"{folder / 'dataset.json'}: lists no {sequence.whole}/{name}")
            files[name] = manifest.sha256
        found[sequence.name] = TruePictures(sequence=sequence, asked=pictures, files=files)
    return found


def _files(sequence: Sequence, pictures: Iterable[Asked]) -> list[str]:
    views = [(side, frame + sequence.first) for side, frame in VIEWS]
    seen = [picture_file("rs", *view, depth=depth) for depth in (False, True) for view in views]
    return list(dict.fromkeys([*seen, *(each.file for each in pictures)]))
