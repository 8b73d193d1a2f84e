"""All pictures of two successive frames against each other: depth, colours, and the geometry of sequence.json."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from rsbench.verification.content import Comparison
from rsbench.verification.findings import Finding
from rsbench.verification.state import State
from rsbench.verification.swapped_frames import misplaced_frames


def picture_faults(state: State) -> Iterator[Finding]:
    """What depth maps and images of two successive frames show that the others contradict."""
    content, again = state.content, state.again
    comparison = Comparison(content, state.stride)
    for agreement in comparison.pairs():
        if agreement is not None:
            state.agreements.setdefault((agreement.source, agreement.target), agreement)
        state.step(state.sequence.name)
    judges = () if again is None else (partial(again.is_right, content), partial(again.shows, content))
    geometry = comparison.geometry()
    if geometry is None:
        yield from comparison.faults(state.elsewhere, *judges)
    else:
        state.apart[content.times[0], content.times[-1]] = geometry
    state.notes += comparison.notes


def geometry_faults(state: State) -> Iterator[Finding]:
    """What the frames that do not agree show of sequence.json, or of one of them."""
    if not state.apart:
        return
    first = min(state.apart.values(), key=lambda each: (each.over_time, each.share))
    count = state.sequence.frames - 1
    if count > 1 and first.over_time and (found := misplaced_frames(state.sequence, state.apart)):
        yield from found
        return
    where = "" if count == 1 else f", in {len(state.apart)} of {count} pairs of frames"
    yield Finding("sequence.json", first.what + where, cause=first.cause)
