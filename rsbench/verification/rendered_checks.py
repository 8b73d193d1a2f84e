"""What is stored of a picture against rows of it that were rendered again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import DepthMap
from rsbench.verification.image_checks import CHANGES, Picture

SAME_DEPTH = 2e-6
"""Relative: rays in float32 on another processor; on the same one they have the same bits."""
_OTHER_CODES, _FAR_CODES, _FAR_ON_GPU = 0.05, 0.005, 0.02
"""Shares of pixels that may differ at all, and by more than ``_NEAR``: rounding on another processor moves a
sample across an edge now and then, and more often on a GPU, which intersects triangles by another rule."""
_NEAR = 2.0
_OTHER_DEPTH = 0.005
_OTHER_LABELS, _FEW_LABELS = 1e-3, 8
"""Share and number of labels that rounding on another processor may change, at edges."""


@dataclass(frozen=True)
class Check:
    """One file against its rows rendered again; ``fault`` is None when they are alike."""

    file: str
    fault: Finding | None
    same_bits: bool


def label_checks(stored: DepthMap, rendered: NDArray[np.uint8], rows: list[int]) -> Iterator[Check]:
    if stored.labels is None:
        return
    wrong, file = stored.labels[rows] != rendered, stored.view.labels
    what = f"{100 * np.mean(wrong):.2g} % of {wrong.size} labels differ from what is rendered again"
    in_rows = np.isin(np.arange(len(stored.labels)), np.asarray(rows)[np.any(wrong, axis=1)])
    bad = np.sum(wrong) > max(_OTHER_LABELS * wrong.size, _FEW_LABELS)
    yield Check(file, Finding(file, what, rows_of(in_rows)) if bad else None, not np.any(wrong))


def depth_check(stored: DepthMap, rendered: NDArray[np.float32], rows: list[int]) -> Check:
    depth, file = stored.depth[rows], stored.view.depth
    wrong = np.abs(depth - rendered) > SAME_DEPTH * np.maximum(depth, rendered)
    share = float(np.mean(wrong))
    if share <= _OTHER_DEPTH:
        return Check(file, None, np.array_equal(depth, rendered))
    both = wrong & (depth > 0) & (rendered > 0)
    ratio = depth[both] / rendered[both] if np.any(both) else np.ones(1)
    middle = float(np.median(ratio))
    scaled = np.median(np.abs(ratio / middle - 1)) < 1e-6 and abs(middle - 1) > SAME_DEPTH
    cause = f"looks scaled by {middle:.7g}" if scaled else ""
    what = f"depth differs from what is rendered again on {100 * share:.3g} % of {wrong.size} pixels"
    if np.any(both):
        what += f", typically by {np.median(np.abs(ratio - 1)):.1e} of itself"
    return Check(file, Finding(file, what, _rows(wrong, rows, len(stored.depth)), cause), False)


def image_check(
    file: str, stored: Picture, rendered: NDArray[np.uint8], rows: list[int], noisy: bool, by_gpu: bool = False
) -> Check:
    """``noisy``: by other random numbers; ``by_gpu``: one was rendered on a GPU and the other was not."""
    truth = rendered.astype(np.float32)
    difference = np.max(np.abs(stored.colours[rows] - truth), axis=-1)
    far = difference > _NEAR + (4 * stored.noise if noisy else 0.0)
    other = far if noisy else difference > 0
    few = _FAR_ON_GPU if by_gpu else _FAR_CODES
    if np.mean(far) <= few and np.mean(other) <= _OTHER_CODES:
        return Check(file, None, not np.any(difference))
    what = (
        f"the image differs from what is rendered again on {100 * np.mean(other):.3g} % of {far.size} pixels, "
        f"by up to {np.max(difference):g} codes"
    )
    y, x = (each.ravel() for each in np.meshgrid(rows, np.arange(truth.shape[1]), indexing="ij"))
    costs = [np.mean(np.abs(change.undone(stored.colours, y, x) - truth.reshape(-1, 3))) for change in CHANGES]
    best = int(np.argmin(costs))
    cause = f"looks {CHANGES[best].words}" if best and costs[best] < 0.5 * costs[0] else ""
    return Check(file, Finding(file, what, _rows(other, rows, len(stored.colours)), cause), False)


def _rows(wrong: NDArray[np.bool_], rows: list[int], height: int) -> str:
    """Words for the rendered rows in which many pixels are wrong."""
    flags = np.zeros(height, dtype=np.bool_)
    flags[np.asarray(rows)[np.mean(wrong, axis=1) > _OTHER_DEPTH]] = True
    return "all rows that were rendered" if np.sum(flags) == len(rows) else rows_of(flags)
