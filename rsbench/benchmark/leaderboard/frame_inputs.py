"""Tracks of rendered frames: what is given of them, matches or the frames themselves."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from rsbench.benchmark.leaderboard.splits import Split, dataset_split
from rsbench.benchmark.leaderboard.track import Track
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.pipeline.problem import Problem
from rsbench.storage.files import read_png, write_bytes
from rsbench.storage.untrusted_files import inside, read_bytes
from rsbench.vision.feature_matcher import load_features

FEATURES = "sift"
"""Whose matches the protocol pose-1 gives."""


class FrameTrack(Track):
    """A track whose problems are the sequences of a dataset."""

    rendered = True

    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        return dataset_split(self, self.source(data, seed_file), public=not secret)

    def source(self, data: Path | None, seed_file: Path | None) -> Path:
        """Folder of the dataset. Raises RsbenchError where the options name none, or another source."""
        if data is None:
            raise RsbenchError(
                f"--data: the track {self.name!r} needs the folder of a dataset; make one with rsbench generate"
            )
        if seed_file is not None:
            raise RsbenchError(
                f"--seed-file {seed_file}: a dataset has its own seed; leave it out, and say --secret"
            )
        return data

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        assert data is not None
        return islice((bare_problems if self.gives_images else matched_problems)(data), count)


def matched_problems(data: Path) -> Iterator[Problem]:
    """Each sequence with its given matches; none where the frames show no texture."""
    options = CorrectionOptions(features=load_features(FEATURES))
    for sequence in read_pairs(data):
        yield matched(sequence, options)


def matched(sequence: Sequence, options: CorrectionOptions) -> Problem:
    """Two frames with their matches."""
    return _problem(sequence, _matches(sequence, options))


def bare_problems(data: Path) -> Iterator[Problem]:
    """Each sequence without matches: its rig and its shutter."""
    for sequence in read_pairs(data):
        yield _problem(sequence, Correspondences())


def write_frames(data: Path, out: Path) -> None:
    """Copy the rolling-shutter frames, as ``frames/<problem>/left_0.png`` to ``right_1.png``.

    Raises:
        RsbenchError: a frame is missing or is no image of the camera's size, or cannot be written.
    """
    for sequence in read_pairs(data):
        folder = out / "frames" / sequence.name
        folder.mkdir(parents=True, exist_ok=True)
        for side, frame in VIEWS:
            sequence.image("rs", side, frame)  # that it can be read
            path = inside(sequence.folder, picture_file("rs", side, frame + sequence.first))
            write_bytes(folder / f"{side}_{frame}.png", read_bytes(path))


def read_frames(inputs: Path, problem: Problem) -> Images:
    """The frames of a problem, as ``write_frames`` wrote them.

    Raises:
        RsbenchError: one is missing, or is no image of the camera's size.
    """
    folder, camera = inputs / "frames" / problem.name, problem.rig.camera
    size = camera.width, camera.height
    return {view: read_png(folder / f"{view[0]}_{view[1]}.png", size) for view in VIEWS}


def _problem(sequence: Sequence, matches: Correspondences) -> Problem:
    return Problem(name=sequence.name, correspondences=matches, rig=sequence.rig, known_shutter=sequence.shutter)


def _matches(sequence: Sequence, options: CorrectionOptions) -> Correspondences:
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    try:
        return find_matches_of_rig(images, sequence.rig, sequence.shutter.scanning, options)
    except RsbenchError:  # frames without texture: an empty problem, which every method fails
        return Correspondences()
