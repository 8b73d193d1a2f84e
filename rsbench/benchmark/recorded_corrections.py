"""Scores of corrected frames on recordings in layouts of others that have a global shutter's images.

As the published tables are made: each frame but the first is corrected with the frame before it, and compared with
the truth at the time of its first or middle row, over all pixels, those that no frame shows among them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import Side, StereoRig, View
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import check_alike, read_frame
from rsbench.vision.corrector import CorrectionProblem, CorrectorEntry, find_corrected_rows
from rsbench.vision.fusion import Fused
from rsbench.vision.images import eight_bit
from rsbench.vision.quality import Picture, psnr_deepunroll, ssim, ssim_deepunroll

BASELINE = "uncorrected"
_VIEW: View = ("left", 1)
Image = NDArray[Any]


class Pair(NamedTuple):
    """A frame whose truth is known, and the one before it."""

    recording: Recording
    side: Side
    before: int
    frame: int

    @property
    def rows(self) -> list[int]:
        """At whose times the truth of the frame is known."""
        return sorted(
            row for side, frame, row in self.recording.truths if (side, frame) == (self.side, self.frame)
        )


def pairs_with_truth(recordings: Sequence[Recording]) -> list[Pair]:
    """In order of recordings, cameras and frames; those of cameras whose shutter is known."""
    found = list[Pair]()
    for recording in recordings:
        for side in recording.shutters:
            frames = sorted(frame for each, frame in recording.images if each == side)
            pairs = [Pair(recording, side, *two) for two in pairwise(frames) if two[1] == two[0] + 1]
            found += [pair for pair in pairs if pair.rows]
    return found


def check_sees_one_camera(entry: CorrectorEntry) -> None:
    """Raises RsbenchError for a corrector that asks for more than the frames of one camera."""
    spec = entry.component.spec
    needs = [*sorted(spec.needs), *(["the other camera"] if "stereo" in spec.sees else [])]
    if needs:
        raise RsbenchError(
            f"--corrector {entry.name}: needs {', '.join(needs)}; frames of one camera take mono-fusion, "
            "flow-scaled or another that sees the images of one camera alone"
        )


def correction_scores(
    pairs: Sequence[Pair], correctors: Sequence[CorrectorEntry], step: Callable[[str], object] = str
) -> pd.DataFrame:
    """A row for each pair, target and method; a frame that is not corrected counts as it was read.

    Raises:
        RsbenchError: an image that cannot be read, or that is not like the others of its pair.
    """
    rows: list[dict[str, Any]] = []
    for pair in pairs:
        rows += _scores(pair, correctors)
        step(f"{pair.recording.name} {pair.frame}")
    return pd.DataFrame(rows)


def _scores(pair: Pair, correctors: Sequence[CorrectorEntry]) -> Iterator[dict[str, Any]]:
    recording, side, rows = pair.recording, pair.side, pair.rows
    paths = [recording.images[side, pair.before], recording.images[side, pair.frame]]
    paths += [recording.truths[side, pair.frame, row] for row in rows]
    frames = {str(path): read_frame(path) for path in paths}
    check_alike(frames)
    before, image, *truths = eight_bit(list(frames.values()))
    weights = _weights(recording.masks.get((side, pair.frame)), image.shape[:2])
    problem = CorrectionProblem(
        images={("left", 0): before, _VIEW: image},
        rig=StereoRig(camera=recording.cameras[side], baseline=1.0),  # of which one camera sees nothing
        shutter=recording.shutters[side],
        target_row=float(rows[0]),
        motion=None,
        depth=None,
        guess=None,
    )
    untouched = Fused.seen(image, np.ones(image.shape[:2], dtype=np.bool_))
    made = {BASELINE: [untouched for _ in rows]}
    for entry in correctors:
        answers = find_corrected_rows(entry, problem, [_VIEW], [float(row) for row in rows])
        made[entry.name] = [answer[_VIEW] for answer in answers]
    where = {"recording": recording.name, "camera": side, "frame": pair.frame}
    for k, (row, true) in enumerate(zip(rows, map(Picture, truths), strict=True)):
        for method, found in made.items():
            fused = found[k]
            scores = _compared(fused.image if fused.success else image, true, weights)
            yield {
                **where,
                "row": row,
                "method": method,
                "success": fused.success,
                **scores,
                "reason": fused.reason,
            }


def _compared(image: Image, true: Picture, weights: Image | None) -> dict[str, float]:
    made = Picture(image)
    return {
        "psnr": psnr_deepunroll(made, true),
        "ssim": ssim(made, true),
        "psnr_mask": float("nan") if weights is None else psnr_deepunroll(made, true, weights),
        "ssim_deepunroll": ssim_deepunroll(made, true),
    }


def _weights(path: Path | None, shape: tuple[int, ...]) -> Image | None:
    """(H, W) of a mask; RsbenchError where it has another size. None where there is none."""
    if path is None:
        return None
    mask = read_frame(path)
    if mask.shape[:2] != shape:
        raise RsbenchError(
            f"{path}: is {mask.shape[1]} x {mask.shape[0]} pixels, its frame {shape[1]} x {shape[0]}"
        )
    return (mask if mask.ndim == 2 else mask[..., 0]).astype(np.float64)
