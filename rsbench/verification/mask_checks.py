"""Check masks of glossy surfaces and labels of moving objects against rays, depth and each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.version import __version__
from rsbench.dataset.views import ImageView, numbers_of, view_pairs
from rsbench.verification.compiled_comparison import DEPTH_TOLERANCE
from rsbench.verification.content import Content, shared_line, spare_pixels
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.reprojection import BoolArray, DepthMap, nearest, reproject, stride_for
from rsbench.verification.rerender import Rerenderer

_OTHER, _FEW = 1e-3, 8
"""Share and number of pixels at edges that may differ due to rounding on another processor."""
_LEAST_LEFT = 0.05
"""Smallest share of the pixels with a surface that must remain for comparison if no rays confirm the mask."""
_TRIED_PIXELS = 60_000


def known_gloss(content: Content, again: Rerenderer | None) -> tuple[list[Finding], bool]:
    """Compare masks with traced rays, which then replace them; return faults, and whether rays were available."""
    sequence = content.sequence
    if again is None or not content.maps:
        return [], not content.maps
    try:
        scene, digest = again.scene(sequence)
        if not _is_ours(content, digest):
            return [], False
        if scene.glossy != sequence.glossy:
            stated, made = (str(each).lower() for each in (sequence.glossy, scene.glossy))
            return [Finding("sequence.json", f"glossy = {stated}: its scene, built here, makes {made}")], True
        if not scene.glossy:
            return [], True
        faults = list[Finding]()
        for view, each in content.maps.items():
            gloss = again.whole(content, view)[1].gloss
            faults += _unlike(each, gloss)
            content.maps[view] = replace(each, gloss=gloss)
    except RsbenchError:  # reported where rows are rendered again
        return [], False
    return faults, True


def _is_ours(content: Content, digest: str) -> bool:
    """Return whether a scene built here must be that of the sequence: its hash or its version is the same."""
    scene, made_by = (content.sequence.manifest.get(key) for key in ("scene", "made_by"))
    same = isinstance(scene, dict) and scene.get("sha256") == digest
    return same or (isinstance(made_by, dict) and made_by.get("rsbench") == __version__)


def _unlike(stored: DepthMap, gloss: BoolArray) -> list[Finding]:
    wrong = gloss if stored.gloss is None else gloss != stored.gloss
    if np.sum(wrong) <= max(_OTHER * wrong.size, _FEW):
        return []
    what = f"{np.sum(wrong)} of {wrong.size} pixels of the mask differ from what rays meet"
    return [Finding(stored.view.gloss, what, rows_of(np.any(wrong, axis=1)))]


def gloss_faults(content: Content, fresh: Content, twins: Content) -> Iterator[Finding]:
    """Find impossible masks if there are no rays; maps whose masks contradict others are removed from all three.

    Args:
        content: the last two frames.
        fresh: the frames that were read last.
        twins: their global-shutter twins at rows other than the first.
    """
    if not content.sequence.glossy:
        return
    for each in (*fresh.maps.values(), *twins.maps.values()):
        yield from _gloss_by_itself(each)
    yield from _unlike_twins(content, twins, "gloss", "pixels at the same pose")
    yield from _dropped(content, dict(_contradicted(content)))
    for view in fresh.maps.keys() - content.maps.keys():
        del fresh.maps[view]


def _dropped(content: Content, faults: dict[ImageView, Finding | None]) -> Iterator[Finding]:
    for view, fault in faults.items():
        if fault:
            del content.maps[view]
            yield fault


def _gloss_by_itself(each: DepthMap) -> Iterator[Finding]:
    gloss, solid = _mask_of(each, "gloss") > 0, each.depth > 0
    empty = gloss & ~solid
    if np.any(empty):
        what = f"{np.sum(empty)} pixels of the mask show no surface"
        yield Finding(each.view.gloss, what, rows_of(np.any(empty, axis=1)))
    covered = cv2.dilate(gloss.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    left = float(np.sum(solid & ~covered) / max(np.sum(solid), 1))
    if np.any(solid) and left < _LEAST_LEFT:
        what = f"leaves {100 * left:.2g} % of the surfaces to be compared; its scene was not built (see --scene)"
        yield Finding(each.view.gloss, what)


def _unlike_twins(
    content: Content, twins: Content, kind: Literal["gloss", "labels"], what: str
) -> Iterator[Finding]:
    for part in (content, twins):
        yield from _dropped(
            part, {view: _unlike_twin(content, each, kind, what) for view, each in part.maps.items()}
        )


def _unlike_twin(content: Content, own: DepthMap, kind: Literal["gloss", "labels"], what: str) -> Finding | None:
    """Compare the masks on the line that a global-shutter picture shares with its rolling-shutter frame."""
    source, view = own.view._replace(shutter="rs", row=0), own.view
    if view == source or source not in content.maps:
        return None
    axis, line, name = shared_line(content.sequence, view)
    one, other = (np.take(_mask_of(each, kind), line, axis) for each in (own, content.maps[source]))
    if np.sum(one != other) <= spare_pixels(axis, one.size):
        return None
    return Finding(
        getattr(view, kind), f"{name} differs from {getattr(source, kind)}: {np.sum(one != other)} {what}"
    )


def _mask_of(each: DepthMap, kind: Literal["gloss", "labels"]) -> NDArray[Any]:
    """Return the mask (H, W), all 0 if there is none."""
    mask = getattr(each, kind)
    return np.zeros(each.depth.shape, dtype=np.uint8) if mask is None else mask


def _contradicted(content: Content) -> Iterator[tuple[ImageView, Finding]]:
    """Yield masks that others contradict; the one that explains most of the remaining pairs comes first."""
    pairs = view_pairs((content.times[0], content.times[-1]))
    there = [(one, other) for one, other in pairs if {one, other} <= content.maps.keys()]
    wrong = {pair: _contradiction(content, *pair) for pair in there}
    left = [pair for pair, rows in wrong.items() if np.any(rows)]
    while left:
        counts = Counter(view for pair in left for view in pair)
        worst = max(counts, key=lambda view: (counts[view], sum(np.sum(wrong[p]) for p in left if view in p)))
        own = [pair for pair in left if worst in pair]
        others = sorted({view.gloss for pair in own for view in pair} - {worst.gloss})
        rows = [wrong[pair] for pair in own if pair[0] == worst]
        words = rows_of(np.any(rows, axis=0)) if rows else ""
        yield worst, Finding(worst.gloss, f"marks other surfaces than {', '.join(others)}", words)
        left = [pair for pair in left if worst not in pair]


def _contradiction(content: Content, one: ImageView, other: ImageView) -> BoolArray:
    """Return the rows (H,) of a map in which its mask contradicts that of another map on flat surfaces."""
    source, target = content.maps[one], content.maps[other]
    stride = stride_for(source.depth.size, _TRIED_PIXELS)
    reprojection = reproject(content.sequence, source, target, stride)
    with np.errstate(invalid="ignore"):
        alike = (np.abs(reprojection.relative) <= DEPTH_TOLERANCE) & source.flat[::stride, ::stride]
    least, most = (each[::stride, ::stride] for each in _span(source))
    low, high = (nearest(each, reprojection.pixels) for each in _span(target))
    wrong = alike & ((least & ~high) | (~most & low))
    rows = np.zeros(len(source.depth), dtype=np.bool_)
    if np.sum(wrong) > max(_FEW, _OTHER * np.sum(alike)):
        rows[::stride][np.any(wrong, axis=1)] = True
    return rows


def _span(each: DepthMap) -> tuple[BoolArray, BoolArray]:
    """Return whether all pixels of each 3 x 3 neighbourhood are glossy, and whether any is, (H, W) each."""
    gloss, around = _mask_of(each, "gloss").astype(np.uint8), np.ones((3, 3), np.uint8)
    return cv2.erode(gloss, around) > 0, cv2.dilate(gloss, around) > 0


_FEW_LABELS = 8
"""Number of labels that may be wrong in a picture, at edges thinner than a pixel."""


def label_faults(content: Content, fresh: Content, twins: Content) -> Iterator[Finding]:
    """Find impossible labels; their maps are removed from all three, as they would accuse the depth of others.

    Args:
        content: two successive frames.
        fresh: the frames of these that were read last.
        twins: global-shutter twins of ``fresh`` at rows other than the first.
    """
    if not content.sequence.moving:
        return
    for part in (content, twins):
        faults = {view: _on_nothing(each) or _misplaced(content, each) for view, each in part.maps.items()}
        yield from _dropped(part, faults)
    yield from _unlike_twins(content, twins, "labels", "labels at the same time")
    for view in fresh.maps.keys() - content.maps.keys():
        del fresh.maps[view]


def _on_nothing(each: DepthMap) -> Finding | None:
    empty = (_mask_of(each, "labels") > 0) & (each.depth == 0)
    if not np.any(empty):
        return None
    return Finding(
        each.view.labels, f"{np.sum(empty)} labels where there is no surface", rows_of(np.any(empty, axis=1))
    )


def _misplaced(content: Content, own: DepthMap) -> Finding | None:
    """Find surfaces that partners do not see where their labels place them, but where another label would."""
    sequence, view = content.sequence, own.view
    stride = stride_for(own.depth.size, _TRIED_PIXELS)
    numbers = numbers_of(_mask_of(own, "labels"))
    elsewhere = np.zeros(own.depth[::stride, ::stride].shape, dtype=np.bool_)
    # The other camera is left out: it sees all surfaces at about the same time, so that movement does not show.
    over_time = view._replace(frame=view.frame + 1, row=0), view.frame_before._replace(row=0)
    for partner in (view.other_shutter._replace(row=0), *over_time):
        if partner not in content.maps:
            continue
        with np.errstate(invalid="ignore"):
            through = reproject(sequence, own, content.maps[partner], stride).relative < -DEPTH_TOLERANCE
            for other in range(len(sequence.moving) + 1) if np.sum(through) > _FEW_LABELS else ():
                moved = replace(own, labels=np.full(own.depth.shape, other, dtype=np.uint8))
                seen = (
                    np.abs(reproject(sequence, moved, content.maps[partner], stride).relative) <= DEPTH_TOLERANCE
                )
                elsewhere |= through & seen & (numbers[::stride, ::stride] != other)
    # Along a very low edge, a line of pixels may by chance lie where another label would place it.
    wide = cv2.morphologyEx(elsewhere.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    if np.sum(wide) <= _FEW_LABELS:
        return None
    what = f"{np.sum(elsewhere)} pixels are not where their labels take them, but where another would"
    return Finding(view.labels, what, rows_of(np.repeat(np.any(elsewhere, axis=1), stride)[: len(own.depth)]))
