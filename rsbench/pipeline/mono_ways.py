"""One way of a camera through neighbouring pairs of frames, in place of a law of motion for each.

Two frames do not show what both shake alike; several do, for each frame is in two pairs. Pairs are worked on in
groups with some on both sides that help: what is found of a pair does not depend on where a run began, and memory
does not grow with the number of frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from rsbench.capture.two_frame_spline import camera_trajectory
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_correction import FoundOwnMotion, on_way
from rsbench.pipeline.mono_law import error_px

_TOLD, _BESIDE = 10, 2
"""Pairs of a group, and those on either side that help."""
_FEWEST = 3
"""Pairs in a row, from which on they show a way."""
PIXELS = 300
"""As of ``way_matches``: fewer than of two frames alone do, for each frame is in two pairs."""
_LEAST = 50
"""Matches."""
_FLOW_PX = 0.15
"""Root mean square of what dense flow errs by: up to here a way explains a pair, and where it explains it as well
as a motion of its own."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPair:
    """Two successive frames."""

    found: FoundOwnMotion | None
    """None where they show none at all."""
    matches: FloatArray
    """(n, 4) x0, y0, x1, y1, px, see ``way_matches``."""

    @property
    def motion(self) -> Motion | None:
        return None if self.found is None or self.found.own.far else self.found.own.motion


def group_of(pair: int) -> tuple[int, int]:
    """First pair that decides what is found of a pair, and the one after the last."""
    return max(_next_group(pair) - _TOLD - _BESIDE, 0), _next_group(pair) + _BESIDE


def on_ways(pairs: Iterable[SeenPair], begin: int = 0, first: int = 0) -> Iterator[FoundOwnMotion | None]:
    """What is found of pairs, in order: by the way through their neighbours, where it explains them as well.

    Args:
        pairs: in order, from number ``begin`` on: ``group_of(first)[0]`` at the latest.
        first: number of the first pair that is asked for.
    """
    held, told, number = dict[int, SeenPair](), first, begin - 1
    for number, pair in enumerate(pairs, start=begin):
        held[number] = pair
        if number + 1 == group_of(told)[1]:
            yield from _told(held, told)
            told = _next_group(told)
            held = {k: each for k, each in held.items() if k >= group_of(told)[0]}
    while told <= number:
        yield from _told(held, told)
        told = _next_group(told)


def _next_group(pair: int) -> int:
    return pair // _TOLD * _TOLD + _TOLD


def _told(held: dict[int, SeenPair], first: int) -> list[FoundOwnMotion | None]:
    """Of the group of one pair, from that pair on."""
    low, high = group_of(first)
    numbers = [k for k in range(low, high) if k in held]
    found = {k: held[k].found for k in numbers}
    for shows, run in itertools.groupby(numbers, lambda k: _shows(held[k])):
        found |= _along([(k, held[k]) for k in run]) if shows else {}
    return [found[k] for k in range(first, _next_group(first)) if k in found]


def _shows(pair: SeenPair) -> bool:
    return pair.motion is not None and len(pair.matches) >= _LEAST


def _along(run: Sequence[tuple[int, SeenPair]]) -> dict[int, FoundOwnMotion]:
    """Of pairs in a row that show motions: those that go the way which all show together."""
    motions = [pair.motion for _, pair in run if pair.motion is not None]
    owns = [pair.found.own for _, pair in run if pair.found is not None]
    if len(run) < _FEWEST or owns[0].shutter.readout_ratio == 0.0:
        return {}
    ways = camera_trajectory(
        [pair.matches for _, pair in run], motions, owns[0].rig.about("left"), owns[0].shutter
    )
    out = dict[int, FoundOwnMotion]()
    for (number, pair), own, steady, way in zip(run, owns, motions, ways or [], strict=False):
        errors = [error_px(each, pair.matches, own.rig, own.shutter, own.side) for each in (way, steady)]
        if pair.found is not None and errors[0] <= max(errors[1], _FLOW_PX):
            out[number] = on_way(pair.found, way)
    return out
