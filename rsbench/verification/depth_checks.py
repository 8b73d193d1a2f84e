"""Depth maps against each other: every pixel's surface must lie where its partners see it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.dataset.views import ImageView
from rsbench.verification.compiled_comparison import Evidence, Limits, weigh_rows
from rsbench.verification.findings import DepthAgreement, Finding
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, BoolArray, DepthMap, Reprojection
from rsbench.verification.row_bands import by_bands

Bits = NDArray[np.uint8]

NEAR_MISS = 1e-3
"""A surface hidden by less than this is a disagreement, not an occlusion; shallow reliefs hide by little more."""
_SPARE_PIXELS, _SPARE_SHARE = 30, 0.3
"""Pixels of a pair that may disagree: what is thinner than a pixel lies before what is flat. A wrong geometry
shows in the median too."""
_STRICT_SHARE = 0.01
"""The same, where nearly all pairs of a kind must exceed it."""
_TYPICAL = 5e-6
"""Largest typical relative difference of agreeing depths: bilinear interpolation on what counts as flat errs by a
quarter of ``FLATNESS`` at most, float32 by 6e-8."""
_BAD_SHARE, _BAD_IN_ROW, _EMPTY_SHARE = 0.2, 0.5, 0.05
"""Shares of the comparable pixels of a map, a row, that thin things may contradict: they are seen by one alone."""
_MOST_BEHIND = 0.3
"""Share of a map that may lie behind what two partners see: near things hide much of it when the rig moves far."""
_FEW = 6
"""Contradicted pixels in one row, or missing ones in a map, that thin things may leave."""
_MANY = 4
"""Pairs, of 8 between the cameras and 16 others, that say that the geometry is wrong and not a map."""
_ACROSS, _OVER_TIME = "baseline, camera, right_scan and right_delay", "motion, readout_ratio and scan"
"""Keys of sequence.json on which pairs between the cameras depend, and those of one camera."""
_TILE, _BAD_IN_TILE = 5, 12
"""A square of 5 x 5 pixels in which 12 are contradicted, and more than agree, is no edge."""
_LEAST_WIDTH = 0.5
_HOLE, _HITS_IN_HOLE = 7, 8
_CENTRED = 0.3
"""Pixels from a pixel's centre within which a surface that spans its neighbours must be met by its ray."""


@dataclass(eq=False)
class DepthEvidence:
    """What the partners of one depth map say of its pixels, gathered pair by pair: one bit for each partner."""

    map: DepthMap
    stride: int
    confirmed: Bits = field(init=False)
    """(h, w) the partner sees the same surface there, or the same sky."""
    contradicted: Bits = field(init=False)
    """(h, w) the partner sees through it, or sees a surface hardly before it."""
    near: BoolArray = field(init=False)
    """(h, w) some partner contradicts it by less than ``NEAR_MISS``."""
    hidden: Bits = field(init=False)
    """(h, w) the partner sees a surface well before it: an occlusion, unless another says so too."""
    holes: Bits = field(init=False)
    """(H, W) the partner sees a surface where this map says that there is none."""
    difference: NDArray[np.float32] = field(init=False)
    """(h, w) smallest relative difference from a partner; infinite where nothing was compared."""

    def __post_init__(self) -> None:
        shape = self.map.depth[:: self.stride, :: self.stride].shape
        self.confirmed, self.contradicted, self.hidden = np.zeros((3, *shape), dtype=np.uint8)
        self.holes = np.zeros(self.map.depth.shape, dtype=np.uint8)
        self.near = np.zeros(shape, dtype=np.bool_)
        self.difference = np.full(shape, np.inf, dtype=np.float32)

    @property
    def surface(self) -> BoolArray:
        return self.map.depth[:: self.stride, :: self.stride] > 0

    def bit(self, partner: ImageView) -> np.uint8:
        """That of a partner."""
        return np.uint8(1 << list(self.map.view.partners()).index(partner))


@dataclass(frozen=True, eq=False)
class MapFault:
    """What is wrong with one map."""

    what: str
    rows: BoolArray
    """(H,) where."""
    share: float
    """Of what could be compared: the map with the largest is wrong first."""
    uncompared: bool = False
    """Whether it has a surface, and nothing of it could be compared."""


def compare(source: DepthEvidence, target: DepthEvidence, reprojection: Reprojection) -> DepthAgreement:
    """Add what one pair shows to the evidence of both, and count how the flat surfaces of both agree.

    What one source pixel spans must be half a pixel wide in the target in every direction: a surface seen at a
    grazing angle there may slip between two pixels, however flat and large the source sees it. What is not flat
    may slip between the pixels of a partner that sees nothing there.
    """
    apart = np.zeros(reprojection.relative.shape, dtype=np.float32)
    work = partial(
        weigh_rows,
        (reprojection.pixels, reprojection.relative),
        (source.map.flat, source.map.depth, source.stride),
        Evidence(source.confirmed, source.contradicted, source.near, source.hidden, source.difference),
        (target.holes, target.map.depth),
        (int(source.bit(target.map.view)), int(target.bit(source.map.view))),
        Limits(DEPTH_TOLERANCE, NEAR_MISS, _LEAST_WIDTH, _CENTRED),
        apart,
    )
    by_bands(work, len(apart))
    near = apart[apart >= 0.0]
    near_and_seen = near[np.isfinite(near)]
    return DepthAgreement(
        source=source.map.view.depth,
        target=target.map.view.depth,
        compared=near.size,
        agreeing=int(np.sum(near <= DEPTH_TOLERANCE)),
        typical=float(np.median(near_and_seen)) if near_and_seen.size else float("nan"),
        p99=float(np.percentile(near_and_seen, 99)) if near_and_seen.size else float("nan"),
    )


def map_faults(
    evidence: Mapping[ImageView, DepthEvidence], right: Collection[ImageView] = ()
) -> dict[ImageView, MapFault]:
    """The maps that are wrong: the worst first, and then the others without what it says of them.

    Those that are known to be ``right`` are none of them.
    """
    found: dict[ImageView, MapFault] = {}
    while True:
        left = {
            view: fault
            for view in evidence.keys() - found.keys() - {*right}
            if (fault := _fault(evidence[view], found))
        }
        if not left:
            return {view: found[view] for view in evidence if view in found}
        worst = max(sorted(left), key=lambda view: left[view].share)
        found[worst] = left[worst]


def _fault(evidence: DepthEvidence, wrong: Collection[ImageView]) -> MapFault | None:
    """What the partners that are not wrong themselves say against a map."""
    trusted = np.uint8(sum(int(evidence.bit(each)) for each in evidence.map.view.partners() if each not in wrong))
    height, surface = len(evidence.map.depth), evidence.surface
    holes = np.bitwise_count(evidence.holes & trusted) >= 2
    seen = evidence.map.depth > 0
    # Gaps narrower than a pixel, between battlements or leaves, lie one by one among pixels that see a surface.
    holes &= _emptied(holes, seen) | (np.sum(holes) > _EMPTY_SHARE * np.sum(seen))
    if np.sum(holes) > _FEW:
        share = 1.0 + float(np.mean(holes[evidence.holes > 0]))  # before all others: holes accuse who sees through
        return MapFault(
            f"{np.sum(holes)} pixels have no depth where others see a surface", np.any(holes, axis=1), share
        )
    good = (evidence.confirmed & trusted != 0) & surface
    bad = (evidence.contradicted & trusted != 0) & ~good & surface
    behind = (np.bitwise_count(evidence.hidden & trusted) >= 2) & ~good & surface
    if np.sum(behind) > _MOST_BEHIND * np.sum(good | bad | behind):
        bad |= behind
    if not np.any(bad | good):
        if wrong and np.any(evidence.confirmed):
            return None
        what = "nothing can be compared with another frame" if np.any(surface) else "there is no surface"
        return MapFault(what, np.full(height, True), 0.0, uncompared=bool(np.any(surface)))
    rows = _bad_rows(bad, good, evidence.near)
    if np.any(rows):
        share = np.sum(bad[rows]) / max(1, np.sum((bad | good)[rows]))
        what = f"depth differs from what others see on {100 * share:.3g} % of the comparable pixels"
        return MapFault(what, np.repeat(rows, evidence.stride)[:height], float(np.sum(bad) / np.sum(bad | good)))
    typical = float(np.median(evidence.difference[good])) if np.any(good) else 0.0
    if typical > _TYPICAL:
        what = (
            f"depth differs typically by {typical:.1e} of itself from what others see, {_TYPICAL:.0e} is allowed"
        )
        return MapFault(what, np.full(height, True), 0.0)
    return None


def _bad_rows(bad: BoolArray, good: BoolArray, near: BoolArray) -> BoolArray:
    """(h,) rows of a map that are wrong: by themselves, in a cluster, or because all of it is.

    A row or two may be a thing thinner than the rows of others, unless it is ``near`` what they see.
    """
    count, comparable = np.sum(bad, axis=1), np.sum(bad | good, axis=1)
    rows = (count >= _FEW) & (count > _BAD_IN_ROW * comparable)
    rows = _runs(rows) | (rows & (np.sum(bad & near, axis=1) > _BAD_IN_ROW * comparable))
    rows |= np.any(_clusters(bad & near, good), axis=1)
    if np.sum(count[~rows]) > max(4 * _FEW, _BAD_SHARE * np.sum(comparable[~rows])):
        rows |= count > _BAD_SHARE * comparable
    return np.asarray(rows)


def _runs(rows: BoolArray) -> BoolArray:
    """(h,) those of at least three rows in a row."""
    flags = np.asarray(rows, np.uint8)[:, None]
    return np.asarray(cv2.morphologyEx(flags, cv2.MORPH_OPEN, np.ones((3, 1), np.uint8))[:, 0] > 0)


def _emptied(holes: BoolArray, seen: BoolArray) -> BoolArray:
    """(H, W) missing pixels in squares of 7 x 7 that see nothing at all, 8 of which others see covered."""
    size = (_HOLE, _HOLE)
    hit = cv2.boxFilter(np.asarray(holes, np.float32), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    empty = cv2.dilate(np.asarray(seen, np.uint8), np.ones(size, np.uint8)) == 0
    spoilt = np.asarray(empty & (hit > _HITS_IN_HOLE - 0.5), np.uint8)
    return np.asarray((cv2.dilate(spoilt, np.ones(size, np.uint8)) > 0) & holes)


def _clusters(bad: BoolArray, good: BoolArray) -> BoolArray:
    """(h, w) contradicted pixels that lie together, more than agree there."""
    wrong, right = (
        cv2.boxFilter(
            np.asarray(each, np.float32), -1, (_TILE, _TILE), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        for each in (bad, good)
    )
    spoilt = np.asarray((wrong > _BAD_IN_TILE - 0.5) & (wrong > right), np.uint8)
    return np.asarray((cv2.dilate(spoilt, np.ones((_TILE + 1, _TILE + 1), np.uint8)) > 0) & bad)


class GeometryFault(NamedTuple):
    """What the maps of two frames say against the geometry of sequence.json."""

    what: str
    cause: str
    share: float
    """Of the pixels of the worst pair that agree."""
    over_time: bool
    """Whether it is only the two times that disagree."""


def geometry_fault(pairs: Sequence[tuple[ImageView, ImageView, DepthAgreement]]) -> GeometryFault | None:
    """What the maps say against the geometry that sequence.json states, where none of them is wrong by itself."""
    wrong = [(source, target) for source, target, each in pairs if not _agree(each, _STRICT_SHARE)]
    across = sum(source.side != target.side for source, target in wrong)
    if not across and len(wrong) >= 2 * _MANY:
        cause = f"the two cameras agree with each other: look at {_OVER_TIME} in sequence.json"
    elif across >= 2 * _MANY - 1:
        cause = f"the two cameras never agree: look at {_ACROSS} in sequence.json, or all depth is scaled"
    else:
        return None
    worst = min((each for _, _, each in pairs), key=lambda each: each.share)
    what = (
        f"{len(wrong)} of {len(pairs)} pairs of depth maps disagree, {worst.source} and {worst.target} on "
        f"{100 * (1 - worst.share):.3g} % of {worst.compared} pixels"
    )
    return GeometryFault(what, cause, worst.share, not across)


def _agree(agreement: DepthAgreement, spare: float = _SPARE_SHARE) -> bool:
    """A pair with nothing to compare says nothing."""
    wrong = agreement.compared - agreement.agreeing
    few = wrong <= _SPARE_PIXELS + spare * agreement.compared
    return few and not agreement.typical > _TYPICAL


def pair_faults(
    pairs: Sequence[tuple[ImageView, ImageView, DepthAgreement]], wrong: Collection[ImageView]
) -> Iterator[Finding]:
    """Pairs that disagree though neither map is contradicted by all who see it."""
    for source, target, agreement in pairs:
        if _agree(agreement) or {source, target} & set(wrong):
            continue
        what = (
            f"depth agrees with {target.depth} to {DEPTH_TOLERANCE:g} on only {100 * agreement.share:.2f} % of "
            f"{agreement.compared} visible pixels, and differs typically by {agreement.typical:.1e} of itself"
        )
        keys = _ACROSS if source.side != target.side else _OVER_TIME
        yield Finding(source.depth, what, cause=f"look at {keys} in sequence.json")
