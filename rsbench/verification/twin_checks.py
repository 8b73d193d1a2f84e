"""Global-shutter twins at the poses of other rows than the first against the rolling-shutter frames."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import product

import numpy as np

from rsbench.core.rig import SIDES
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView
from rsbench.verification.content import Content, clean_picture, read_view, spare_pixels
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, BoolArray, reproject

_NEAR, _LEAST = 0.05, 100
"""Relative distance within which surfaces are one and the same, badly placed; beyond, one hides the other. And the
pixels that tell."""
_MOST_WRONG = 0.1
"""Share of them: what is thinner than a pixel, and edges that are nearly flat."""


def read_twins(sequence: Sequence, missing: Collection[str], times: tuple[int, ...]) -> Content:
    """As ``content.read_content``, of the twins at other rows than the first."""
    content = Content(sequence, times=times)
    for row in sequence.twins:
        for side, frame in product(SIDES, times):
            read_view(content, ImageView("gs", side, frame, row), missing)
    return content


def other_twin_faults(content: Content, twins: Content, stride: int = 1) -> Iterator[Finding]:
    """A twin shares a row with its rolling-shutter frame, bit for bit; it sees the surfaces that this one sees."""
    sequence = content.sequence
    for row in sequence.twins:
        for side, frame in product(SIDES, content.times):
            twin, source = ImageView("gs", side, frame, row), ImageView("rs", side, frame)
            yield from _shared_line_faults(content, twins, source, twin)
            if source in content.maps and twin in twins.maps:
                yield from _depth_faults(content, twins, source, twin, stride)


def _shared_line_faults(content: Content, twins: Content, source: ImageView, twin: ImageView) -> Iterator[Finding]:
    shutter = content.sequence.shutter
    axis, line = 1 - shutter.axis(twin.side), abs(shutter.first_line(twin.side) - twin.row)
    words = f"{'row' if axis == 0 else 'column'} {line} differs from"
    if source in content.pictures and twin in twins.pictures:
        own, other = (
            np.take(each.colours, line, axis) for each in (twins.pictures[twin], content.pictures[source])
        )
        unlike = np.any(own != other, axis=-1)
        if np.sum(unlike) > spare_pixels(axis, unlike.size):
            of = clean_picture(content.sequence, source)
            yield Finding(twin.image, f"{words} {of}: {np.sum(unlike)} pixels at the same pose")
    if source in content.maps and twin in twins.maps:
        own, other = (np.take(each.depth, line, axis) for each in (twins.maps[twin], content.maps[source]))
        if np.sum(own != other) > spare_pixels(axis, own.size):
            far = np.max(np.abs(own - other))
            yield Finding(twin.depth, f"{words} {source.depth}: by up to {far:.3g} m at the same pose")


def _depth_faults(
    content: Content, twins: Content, source: ImageView, twin: ImageView, stride: int
) -> Iterator[Finding]:
    relative = reproject(content.sequence, twins.maps[twin], content.maps[source], stride).relative
    with np.errstate(invalid="ignore"):
        near = (np.abs(relative) < _NEAR) & (twins.maps[twin].depth[::stride, ::stride] > 0)
        wrong: BoolArray = near & ~(np.abs(relative) < DEPTH_TOLERANCE)
    if np.sum(near) >= _LEAST and np.sum(wrong) > _MOST_WRONG * np.sum(near):
        middle = float(np.median(relative[near]))
        cause = f"looks scaled by {1 + middle:.5g}" if abs(middle) > DEPTH_TOLERANCE else ""
        share = f"{100 * np.sum(wrong) / np.sum(near):.0f} % of {np.sum(near)} pixels"
        rows = np.repeat(np.sum(wrong, axis=1) > _MOST_WRONG * np.maximum(np.sum(near, axis=1), 1), stride)
        what = f"{share} differ from the surface of {source.depth}"
        yield Finding(twin.depth, what, rows_of(rows[: len(twins.maps[twin].depth)]), cause)


def with_twins(content: Content, twins: Content) -> Content:
    """Both, for checks of channels and of rows rendered again."""
    maps, pictures = content.maps | twins.maps, content.pictures | twins.pictures
    return Content(content.sequence, maps, pictures, times=content.times)
