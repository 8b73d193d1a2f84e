"""All pictures of two successive frames against each other: depth, colours, and the geometry of sequence.json."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from rsbench.verification.content import Comparison
from rsbench.verification.findings import Finding
from rsbench.verification.state import State
from rsbench.verification.swapped_frames import frames_of_other_times


def picture_faults(state: State) -> Iterator[Finding]:
    """What depth maps and images of two successive frames show that the others contradict."""
    content, again = state.content, state.again
    comparison = Comparison(content, state.stride)
    for agreement in comparison.pairs():
        if agreement is not None:
            state.agreements.setdefault((agreement.source, agreement.target), agreement)
        state.step(state.sequence.name)
    judges = (
        ()
        if again is None
        else (partial(again.depth_is_rendered, content), partial(again.image_is_rendered, content))
    )
    geometry = comparison.geometry()
    if geometry is None:
        yield from comparison.faults(state.other_images, *judges)
    else:
        state.disagreeing[content.times[0], content.times[-1]] = geometry
    state.notes += comparison.notes


def geometry_faults(state: State) -> Iterator[Finding]:
    """What the frames that do not agree show of sequence.json, or of one of them."""
    if not state.disagreeing:
        return
    first = min(state.disagreeing.values(), key=lambda each: (each.over_time, each.share))
    count = state.sequence.frames - 1
    if count > 1 and first.over_time and (found := frames_of_other_times(state.sequence, state.disagreeing)):
        yield from found
        return
    where = "" if count == 1 else f", in {len(state.disagreeing)} of {count} pairs of frames"
    yield Finding("sequence.json", first.what + where, cause=first.cause)
