"""Labels of objects that move, against depth: what is labelled must be where its object takes it, and no other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import cv2
import numpy as np

from rsbench.dataset.object_records import numbers_of
from rsbench.dataset.views import ImageView
from rsbench.verification.content import Content, spare_pixels
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, BoolArray, DepthMap, reproject

_LEAST = 8
"""So many labels may be wrong anywhere: at edges thinner than a pixel."""
_TRIED_PIXELS = 60_000


def label_faults(content: Content, fresh: Content, twins: Content) -> Iterator[Finding]:
    """What labels cannot be. Their maps are taken out of all: they would accuse the depth of others.

    Args:
        content: of two successive frames.
        fresh: what was read of them last.
        twins: at other rows than the first, of these last.
    """
    if not content.sequence.moving:
        return
    for part in (content, twins):
        faults = {view: _on_nothing(each) or _misplaced(content, each) for view, each in part.maps.items()}
        yield from _dropped(part, faults)
    for part in (content, twins):
        yield from _dropped(part, {view: _unlike_twin(content, twins, view) for view in part.maps})
    for view in fresh.maps.keys() - content.maps.keys():
        del fresh.maps[view]


def _dropped(content: Content, faults: Mapping[ImageView, Finding | None]) -> Iterator[Finding]:
    for view, fault in faults.items():
        if fault:
            del content.maps[view]
            yield fault


def _on_nothing(each: DepthMap) -> Finding | None:
    labels = np.zeros(each.depth.shape, dtype=np.uint8) if each.labels is None else each.labels
    empty = (labels > 0) & (each.depth == 0)
    if not np.any(empty):
        return None
    return Finding(each.view.labels, f"{np.sum(empty)} labels where there is no surface", _rows(empty))


def _unlike_twin(content: Content, twins: Content, view: ImageView) -> Finding | None:
    """The line of a global shutter that its rolling-shutter frame shares."""
    source = view._replace(shutter="rs", row=0)
    own, other = (twins.maps if view.row else content.maps).get(view), content.maps.get(source)
    if view == source or own is None or other is None or own.labels is None or other.labels is None:
        return None
    shutter = content.sequence.shutter
    axis, line = 1 - shutter.axis(view.side), abs(shutter.first_line(view.side) - view.row)
    unlike = np.take(own.labels, line, axis) != np.take(other.labels, line, axis)
    if np.sum(unlike) <= spare_pixels(axis, unlike.size):
        return None
    words = f"{'row' if axis == 0 else 'column'} {line} differs from {source.labels}"
    return Finding(view.labels, f"{words}: {np.sum(unlike)} labels at the same time")


def _misplaced(content: Content, own: DepthMap) -> Finding | None:
    """Surfaces through which partners see where their labels take them, and which they see where another would."""
    sequence, view = content.sequence, own.view
    stride = max(1, int(np.sqrt(own.depth.size / _TRIED_PIXELS)))
    numbers = np.zeros(own.depth.shape, np.uint8) if own.labels is None else numbers_of(own.labels)
    elsewhere = np.zeros(own.depth[::stride, ::stride].shape, dtype=np.bool_)
    # The other camera sees all of them at about the same time, which tells nothing.
    over_time = view._replace(frame=view.frame + 1, row=0), view.frame_before._replace(row=0)
    for partner in (view.other_shutter._replace(row=0), *over_time):
        if partner not in content.maps:
            continue
        with np.errstate(invalid="ignore"):
            through = reproject(sequence, own, content.maps[partner], stride).relative < -DEPTH_TOLERANCE
            for other in range(len(sequence.moving) + 1) if np.sum(through) > _LEAST else ():
                moved = replace(own, labels=np.full(own.depth.shape, other, dtype=np.uint8))
                seen = (
                    np.abs(reproject(sequence, moved, content.maps[partner], stride).relative) <= DEPTH_TOLERANCE
                )
                elsewhere |= through & seen & (numbers[::stride, ::stride] != other)
    # Along an edge that stands out by a hair, a line of pixels may lie by chance where another label takes it.
    wide = cv2.morphologyEx(elsewhere.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    if np.sum(wide) <= _LEAST:
        return None
    what = f"{np.sum(elsewhere)} pixels are not where their labels take them, but where another would"
    return Finding(view.labels, what, rows_of(np.repeat(np.any(elsewhere, axis=1), stride)[: len(own.depth)]))


def _rows(wrong: BoolArray) -> str:
    return rows_of(np.any(wrong, axis=1))
