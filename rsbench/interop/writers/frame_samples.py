"""Training samples: windows of frames of a dataset as arrays, each file of them read once."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence as Series
from itertools import accumulate
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.given import check_whole
from rsbench.core.rig import SIDES, Side
from rsbench.dataset.sequence import Sequence, read_dataset

Part = Literal["rs", "gs", "rs_depth", "gs_depth", "poses"]


class FrameSamples:
    """Windows of successive frames of both cameras that share no frame, so that no file is read twice.

    Item k is a dictionary: ``sequence``, a name; ``frame``, the first of the window; and for each side and part
    ``left_rs`` and so on: images (frames, H, W, 3) uint8, depth (frames, H, W) float32, and of ``poses``
    ``left_poses`` (frames, lines, 3, 4), ``cam_from_world`` of every line, and ``left_times`` (frames, lines),
    frame periods. Times and poses are those of the sequence, whose world is the body at time 0.

    Args:
        folder: of the dataset; dataset.json and each sequence.json are read here, and not again.
        frames: of a window; frames at the end of a sequence that fill none are left out.
        parts: what is read.

    Raises:
        RsbenchError: not a dataset, or sequences with fewer frames than a window.
        ValueError: no such part, or a window of no frames.
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
                read = [_read(sequence, side, frame, part) for frame in range(first, first + self.frames)]
                for name in read[0]:
                    sample[f"{side}_{name}"] = np.stack([each[name] for each in read])
        return sample


def _read(sequence: Sequence, side: Side, frame: int, part: Part) -> dict[str, NDArray[Any]]:
    if part == "poses":
        tau, pose = sequence.poses(side, frame)
        return {"times": tau, "poses": np.concatenate([pose.R, pose.t[..., None]], axis=-1)}
    if part in ("rs", "gs"):
        return {part: sequence.image("rs" if part == "rs" else "gs", side, frame)}
    return {part: sequence.depth("rs" if part == "rs_depth" else "gs", side, frame)}
