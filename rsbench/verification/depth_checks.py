"""Compare depth maps with each other: every pixel's surface must be where the other maps (partners) see it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import Geometry
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView, Times, nearby_views
from rsbench.verification.compiled_comparison import DEPTH_TOLERANCE, Evidence, weigh_rows
from rsbench.verification.findings import DepthAgreement, Finding
from rsbench.verification.reprojection import (
    BoolArray,
    DepthMap,
    Reprojection,
    by_bands,
    reproject,
    seen_in,
    stride_for,
)

Bits = NDArray[np.uint8]

_SPARE_PIXELS, _SPARE_SHARE = 30, 0.3
"""Share and number of pixels of a pair that may disagree, due to things thinner than a pixel in front of flat
ones. A wrong geometry shows in the median too."""
_STRICT_SHARE = 0.01
"""The same, where nearly all pairs of a kind must exceed it."""
_TYPICAL = 5e-6
"""Largest median relative difference of agreeing depths: bilinear interpolation on flat surfaces errs by at most a
quarter of ``FLATNESS``, float32 by 6e-8."""
_BAD_SHARE, _BAD_IN_ROW, _EMPTY_SHARE = 0.2, 0.5, 0.05
"""Shares of the comparable pixels of a map, and of a row, that may be contradicted, due to thin things that only
one map shows."""
_MOST_BEHIND = 0.3
"""Share of a map that may be behind surfaces that two partners see: near objects hide large areas if the rig moves
far."""
_FEW = 6
"""Number of contradicted pixels in one row, or missing ones in a map, that thin things may cause."""
_MANY = 4
"""Number of disagreeing pairs, of 8 between the cameras and 16 others, with which the geometry is wrong, not a
map."""
_OVER_TIME = "motion, readout_ratio and scan"
"""Keys of sequence.json on which pairs of one camera depend; ``_across`` has those of pairs of both."""
_TILE, _BAD_IN_TILE = 5, 12
"""A 5 x 5 square with 12 contradicted pixels, and fewer that agree, is no edge."""
_HOLE, _HITS_IN_HOLE = 7, 8


@dataclass(eq=False)
class DepthEvidence:
    """Evidence of the partners on the pixels of one depth map, collected pair by pair."""

    map: DepthMap
    stride: int
    seen: Evidence = field(init=False)
    holes: Bits = field(init=False)
    """(H, W) a bit for each partner that sees a surface where this map has none."""

    def __post_init__(self) -> None:
        shape = self.map.depth[:: self.stride, :: self.stride].shape
        confirmed, contradicted, hidden = np.zeros((3, *shape), dtype=np.uint8)
        near, difference = np.zeros(shape, dtype=np.bool_), np.full(shape, np.inf, dtype=np.float32)
        self.seen = Evidence(confirmed, contradicted, near, hidden, difference)
        self.holes = np.zeros(self.map.depth.shape, dtype=np.uint8)

    @property
    def surface(self) -> BoolArray:
        return self.map.depth[:: self.stride, :: self.stride] > 0

    def bit(self, partner: ImageView) -> np.uint8:
        """The bit of a partner."""
        return np.uint8(1 << list(self.map.view.partners()).index(partner))


@dataclass(frozen=True, eq=False)
class MapFault:
    """A fault of one map."""

    what: str
    rows: BoolArray
    """(H,) where."""
    share: float
    """Share of the compared pixels that is wrong: the map with the largest share is reported first."""
    uncompared: bool = False
    """Whether it has a surface of which nothing could be compared."""


def compare(source: DepthEvidence, target: DepthEvidence, reprojection: Reprojection) -> DepthAgreement:
    """Add the result of one pair to the evidence of both maps, and count the agreement of their flat surfaces.

    A source pixel must span half a pixel in the target in every direction: a surface that the target sees at a
    grazing angle may lie between two pixels, however flat and large it is in the source. A surface that is not
    flat may lie between the pixels of a partner that sees nothing there.
    """
    apart = np.zeros(reprojection.relative.shape, dtype=np.float32)
    work = partial(
        weigh_rows,
        (reprojection.pixels, reprojection.relative),
        (source.map.flat, source.map.depth, source.stride),
        source.seen,
        (target.holes, target.map.depth),
        (int(source.bit(target.map.view)), int(target.bit(source.map.view))),
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
    """The wrong maps: the worst first, then the others, judged without its evidence.

    Maps known to be ``right`` are not reported.
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
    """Evidence against a map of partners that are not wrong themselves."""
    trusted = np.uint8(sum(int(evidence.bit(each)) for each in evidence.map.view.partners() if each not in wrong))
    height, surface = len(evidence.map.depth), evidence.surface
    holes = np.bitwise_count(evidence.holes & trusted) >= 2
    seen = evidence.map.depth > 0
    # Gaps narrower than a pixel, as between leaves, are single pixels among pixels with a surface.
    holes &= _emptied(holes, seen) | (np.sum(holes) > _EMPTY_SHARE * np.sum(seen))
    if np.sum(holes) > _FEW:
        share = 1.0 + float(np.mean(holes[evidence.holes > 0]))  # first: holes contradict maps that see through
        return MapFault(
            f"{np.sum(holes)} pixels have no depth where others see a surface", np.any(holes, axis=1), share
        )
    good = (evidence.seen.confirmed & trusted != 0) & surface
    bad = (evidence.seen.contradicted & trusted != 0) & ~good & surface
    behind = (np.bitwise_count(evidence.seen.hidden & trusted) >= 2) & ~good & surface
    if np.sum(behind) > _MOST_BEHIND * np.sum(good | bad | behind):
        bad |= behind
    if not np.any(bad | good):
        if wrong and np.any(evidence.seen.confirmed):
            return None
        what = "nothing can be compared with another frame" if np.any(surface) else "there is no surface"
        return MapFault(what, np.full(height, True), 0.0, uncompared=bool(np.any(surface)))
    rows = _bad_rows(bad, good, evidence.seen.near)
    if np.any(rows):
        share = np.sum(bad[rows]) / max(1, np.sum((bad | good)[rows]))
        what = f"depth differs from what others see on {100 * share:.3g} % of the comparable pixels"
        return MapFault(what, np.repeat(rows, evidence.stride)[:height], float(np.sum(bad) / np.sum(bad | good)))
    typical = float(np.median(evidence.seen.difference[good])) if np.any(good) else 0.0
    if typical > _TYPICAL:
        what = (
            f"depth differs typically by {typical:.1e} of itself from what others see, {_TYPICAL:.0e} is allowed"
        )
        return MapFault(what, np.full(height, True), 0.0)
    return None


def _bad_rows(bad: BoolArray, good: BoolArray, near: BoolArray) -> BoolArray:
    """(h,) rows of a map that are wrong: single ones, in a cluster, or all.

    One or two rows may show a thing thinner than the rows of others, unless it is ``near`` what they see.
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
    """(H, W) missing pixels in 7 x 7 squares without any depth, in which partners see a surface at 8 pixels."""
    size = (_HOLE, _HOLE)
    hit = cv2.boxFilter(np.asarray(holes, np.float32), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    empty = cv2.dilate(np.asarray(seen, np.uint8), np.ones(size, np.uint8)) == 0
    spoilt = np.asarray(empty & (hit > _HITS_IN_HOLE - 0.5), np.uint8)
    return np.asarray((cv2.dilate(spoilt, np.ones(size, np.uint8)) > 0) & holes)


def _clusters(bad: BoolArray, good: BoolArray) -> BoolArray:
    """(h, w) contradicted pixels in clusters with fewer agreeing ones."""
    wrong, right = (
        cv2.boxFilter(
            np.asarray(each, np.float32), -1, (_TILE, _TILE), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        for each in (bad, good)
    )
    spoilt = np.asarray((wrong > _BAD_IN_TILE - 0.5) & (wrong > right), np.uint8)
    return np.asarray((cv2.dilate(spoilt, np.ones((_TILE + 1, _TILE + 1), np.uint8)) > 0) & bad)


class GeometryFault(NamedTuple):
    """Evidence of the maps of two frames against the geometry of sequence.json."""

    what: str
    cause: str
    share: float
    """Share of the pixels of the worst pair that agree."""
    over_time: bool
    """Whether it is only the two times that disagree."""


def _across(rig: StereoRig) -> str:
    """Keys of sequence.json on which pairs between the cameras depend."""
    if rig.aligned:
        return "baseline, camera, right_scan and right_delay"
    return "baseline, cameras, right_from_left, right_readout_ratio, right_scan and right_delay"


def geometry_fault(
    pairs: list[tuple[ImageView, ImageView, DepthAgreement]], rig: StereoRig
) -> GeometryFault | None:
    """Evidence against the geometry in sequence.json, if no single map is wrong."""
    wrong = [(source, target) for source, target, each in pairs if not _agree(each, _STRICT_SHARE)]
    across = sum(source.side != target.side for source, target in wrong)
    if not across and len(wrong) >= 2 * _MANY:
        cause = f"the two cameras agree with each other: look at {_OVER_TIME} in sequence.json"
    elif across >= 2 * _MANY - 1:
        cause = f"the two cameras never agree: look at {_across(rig)} in sequence.json, or all depth is scaled"
    else:
        return None
    worst = min((each for _, _, each in pairs), key=lambda each: each.share)
    what = (
        f"{len(wrong)} of {len(pairs)} pairs of depth maps disagree, {worst.source} and {worst.target} on "
        f"{100 * (1 - worst.share):.3g} % of {worst.compared} pixels"
    )
    return GeometryFault(what, cause, worst.share, not across)


def _agree(agreement: DepthAgreement, spare: float = _SPARE_SHARE) -> bool:
    """A pair with nothing to compare is no evidence."""
    wrong = agreement.compared - agreement.agreeing
    few = wrong <= _SPARE_PIXELS + spare * agreement.compared
    return few and not agreement.typical > _TYPICAL


def pair_faults(
    pairs: list[tuple[ImageView, ImageView, DepthAgreement]], wrong: Collection[ImageView], rig: StereoRig
) -> Iterator[Finding]:
    """Pairs that disagree although neither map is contradicted by all partners."""
    for source, target, agreement in pairs:
        if _agree(agreement) or {source, target} & set(wrong):
            continue
        what = (
            f"depth agrees with {target.depth} to {DEPTH_TOLERANCE:g} on only {100 * agreement.share:.2f} % of "
            f"{agreement.compared} visible pixels, and differs typically by {agreement.typical:.1e} of itself"
        )
        keys = _across(rig) if source.side != target.side else _OVER_TIME
        yield Finding(source.depth, what, cause=f"look at {keys} in sequence.json")


_TRIED_PIXELS = 20_000
_EXPLAINED = 0.8
"""Share of the comparable pixels that a candidate must explain, and 0.3 more than the stored map does."""

Depth = NDArray[np.float32]


def likely_cause(sequence: Sequence, maps: Mapping[ImageView, DepthMap], view: ImageView, rows: BoolArray) -> str:
    """The likely cause in words, "" if no candidate explains it. ``rows`` (H,) are the wrong ones."""
    depth = maps[view].depth
    if not np.any(depth[rows]):
        return "zeroed"
    others = [each for each in maps if each != view and maps[each].depth.shape == depth.shape]
    same = [other for other in others if np.array_equal(depth[rows], maps[other].depth[rows])]
    if same:
        return f"the same as {same[0].depth}"
    partners = [maps[partner] for partner in view.partners() if partner in maps]
    if not partners:
        return ""
    best, words = _agreeing(sequence, maps[view], partners, rows) + 0.3, ""
    for name, candidate, geometry in _depth_candidates(sequence, maps, view):
        share = _agreeing(geometry, candidate, partners, rows)
        if share > max(best, _EXPLAINED):
            best, words = share, name
    if words:
        return words
    scale, share, spread = _scale(sequence, maps[view], partners, rows)
    if share > _EXPLAINED and abs(scale - 1) > 1e-6:
        return f"looks scaled by {scale:.7g}"
    return f"looks like noise of {spread:.1e} of the depth" if DEPTH_TOLERANCE / 3 < spread < 0.3 else ""


def _depth_candidates(
    sequence: Sequence, maps: Mapping[ImageView, DepthMap], view: ImageView
) -> Iterator[tuple[str, DepthMap, Sequence]]:
    """Depth maps of other views and sequences with which the stored one may have been exchanged."""
    for words, candidate in _changed_maps(sequence, maps, view):
        yield words, candidate, sequence
    shutter = sequence.shutter
    if view.shutter == "rs" and shutter.ratio_of("left") != shutter.ratio_of("right"):
        ratio = shutter.ratio_of(view.other_side.side)
        other = replace(shutter, readout_ratio=ratio, right_readout_ratio=None)
        words = "looks read at the times of the other camera's lines"
        yield words, maps[view], replace(sequence, shutter=other)


def _changed_maps(
    sequence: Sequence, maps: Mapping[ImageView, DepthMap], view: ImageView
) -> Iterator[tuple[str, DepthMap]]:
    stored = maps[view]
    depth = stored.depth
    for other in nearby_views(view, sequence.frames):
        camera = sequence.rig.sensor(other.side)
        if depth.shape == (camera.height, camera.width):
            yield f"looks like {other.depth}", replace(stored, view=other, camera=camera)
    lines = sequence.shutter.lines(view.side)
    for line in {1, 2, lines // 4, lines // 2, 3 * lines // 4, lines - 1} if view.shutter == "gs" else set():
        words = f"looks like the global shutter at the pose of line {line}"
        yield words, replace(stored, view=view._replace(row=line))
    for by in (-1, 1, -2, 2):
        plural = "s" if abs(by) > 1 else ""
        yield f"looks shifted by {abs(by)} row{plural}", replace(stored, depth=np.roll(depth, -by, axis=0))
        yield f"looks shifted by {abs(by)} column{plural}", replace(stored, depth=np.roll(depth, -by, axis=1))
    yield "looks flipped left to right", replace(stored, depth=np.ascontiguousarray(depth[:, ::-1]))
    yield "looks flipped upside down", replace(stored, depth=np.ascontiguousarray(depth[::-1]))
    rays = np.linalg.norm(stored.camera.unproject(stored.camera.pixel_grid()), axis=-1)
    along = (depth / rays).astype(np.float32)
    yield "looks like the distance along the ray instead of z", replace(stored, depth=along)
    if not sequence.rig.aligned:
        own = sequence.rig.own_depth(view.side, stored.camera.pixel_grid())
        words = "looks like z along the axes of the rig instead of the camera's own"
        yield words, replace(stored, depth=(depth * own).astype(np.float32))


def _relative(sequence: Sequence, source: DepthMap, partner: DepthMap, rows: BoolArray) -> NDArray[np.float32]:
    """(n,) relative differences of pixels in these rows that meet a flat surface of a partner, or -inf."""
    stride = stride_for(np.sum(rows) * source.depth.shape[1], _TRIED_PIXELS)
    if not np.any(rows[::stride]):
        stride = 1
    relative = reproject(sequence, source, partner, stride).relative
    chosen = rows[::stride, None] & (source.depth[::stride, ::stride] > 0) & ~np.isnan(relative)
    return relative[chosen]


def _agreeing(sequence: Sequence, source: DepthMap, partners: list[DepthMap], rows: BoolArray) -> float:
    """Share of these rows that agrees with the middle one of the partners: one may be wrong itself."""
    shares = []
    for partner in partners:
        relative = _relative(sequence, source, partner, rows)
        near = relative[relative < 0.01]
        shares.append(float(np.mean(np.abs(near) <= DEPTH_TOLERANCE)) if len(near) else 0.0)
    return float(np.median(shares)) if shares else 0.0


def _scale(
    sequence: Sequence, source: DepthMap, partners: list[DepthMap], rows: BoolArray
) -> tuple[float, float, float]:
    """Factor by which the depth is too large, the share that agrees without it, and the remaining scatter."""
    scale, share, spread = 1.0, 0.0, 0.0
    for _ in range(5):
        scaled = replace(source, depth=(source.depth / np.float32(scale)).astype(np.float32))
        relative = np.concatenate([_relative(sequence, scaled, partner, rows) for partner in partners])
        near = relative[np.abs(relative) < 0.5]
        if len(near) == 0:
            break
        middle = float(np.median(near))
        spread = 1.4826 * float(np.median(np.abs(near - middle)))
        share = float(np.mean(np.abs(near) <= DEPTH_TOLERANCE))
        if abs(middle) < 1e-6:
            break
        scale *= 1 + middle
    return scale, share, spread


_NEAR_DEPTH = 5e-3
"""Largest relative difference of two depths of one thin thing."""
_JUMP, _JUMPS = 3e-2, 0.5
"""Relative second difference of inverse depth at an edge, and the share of pixels beside one in a picture of thin
things: 0.69 to 0.85 in the scene ``forest`` at 63 to 128 px, 0.35 in ``castle`` at 128 px, 0.05 at 900 px."""
_LIKER, _AWAY = 1.6, 7
"""Least ratio of the pixels that agree with two partners to those that agree after a shift by up to 7 px. Valid
maps of ``forest`` and ``old-town`` at 52 to 96 px: 2.3 and more. Scaled by 1.02, flipped, of the other frame: 0.6
to 1.5 in ``forest``."""


def roughly_agree(geometry: Geometry, maps: Mapping[ImageView, DepthMap], view: ImageView) -> bool:
    """Whether a depth map shows thin things that two partners see at about the same place.

    A map of a flat scene without flat places is damaged. A single partner may be damaged in the same way: rows of
    a frame and of its global-shutter twin are almost equal.
    """
    alike = (_roughly_alike(geometry, maps[view], maps[each]) for each in view.partners() if each in maps)
    return maps[view].share_of_edges(_JUMP) > _JUMPS and sum(alike) >= 2


def _roughly_alike(geometry: Geometry, source: DepthMap, target: DepthMap) -> bool:
    stride = stride_for(source.depth.size, _TRIED_PIXELS)
    pixels, x_in_cam = seen_in(geometry, source, target, range(0, len(source.depth), stride), stride)
    inside = np.isfinite(pixels[..., 0]) & (source.depth[::stride, ::stride] > 0)
    middle, z = np.rint(pixels[inside]).astype(np.int64), x_in_cam[inside][:, 2]
    shares = [_share_of_depth(target, middle + np.array(by) * _AWAY, z) for by in product((0, 1, -1), repeat=2)]
    return shares[0] > _LIKER * max(shares[1:])


def _share_of_depth(target: DepthMap, middle: NDArray[np.int64], depth: FloatArray) -> float:
    """Share of the points (n,) that are as deep as one of the 3 x 3 pixels around ``middle`` (n, 2)."""
    height, width = target.depth.shape
    inside = np.all((middle >= 1) & (middle < np.array([width - 1, height - 1])), axis=1)
    x, y = middle[inside].T
    around = np.stack([target.depth[y + down, x + across] for down, across in product((-1, 0, 1), repeat=2)])
    near = np.any(np.abs(around / depth[inside] - 1.0) < _NEAR_DEPTH, axis=0)
    return float(np.mean(near)) if near.size else 0.0


_AGREE, _LEAST = 0.8, 50
"""Least share of agreeing pixels, and least number of comparable ones, of maps of the stated times."""
_BESIDE = 4
"""Frames before and after with which a frame is compared, the nearest first."""
_FARTHEST = 32


def frames_of_other_times(sequence: Sequence, apart: Collection[Times]) -> list[Finding]:
    """A finding for each of the frames ``apart`` (in disagreement with a neighbour) that shows another time.

    A frame is in order if it agrees with any other one near it.
    """
    maps = _MapsOverTime(sequence)
    suspects = sorted({frame for times in apart for frame in times})
    lost = [frame for frame in suspects if not any(maps.agree(frame, frame, other) for other in maps.near(frame))]
    sound = [frame for frame in range(sequence.frames) if frame not in lost]
    found = {frame: _time_of(maps, frame, sound or maps.near(frame)) for frame in lost}
    return [
        _frame_fault(frame, time)
        for frame, time in found.items()
        if time is not None or (sound and maps.seen(frame))
    ]


def _time_of(maps: _MapsOverTime, frame: int, others: list[int]) -> int | None:
    """The time at which a frame agrees with others, if it does not at its own."""
    beside = sorted(others, key=lambda other: abs(other - frame))[: 2 * _BESIDE]
    times = sorted(range(maps.sequence.frames), key=lambda other: abs(other - frame))[1 : _FARTHEST + 1]
    pairs = ((time, other) for time in times for other in beside if other not in (frame, time))
    return next((time for time, other in pairs if maps.agree(frame, time, other)), None)


def _frame_fault(frame: int, time: int | None) -> Finding:
    what = f"all pictures of frame {frame} disagree with those of other times, and not with each other"
    return Finding(
        ImageView("rs", "left", frame).depth, what, cause="" if time is None else f"looks like frame {time}"
    )


class _MapsOverTime:
    """Depth maps of the left camera, read when needed."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        # Functions, because caches of methods would keep the maps, in a cycle, until a garbage collection.
        self._map = cache(partial(_left_map, sequence))
        self._share = cache(partial(_share_alike, sequence, self._map))

    def near(self, frame: int) -> list[int]:
        """Other frames, the nearest first."""
        others = sorted(range(self.sequence.frames), key=lambda other: abs(other - frame))
        return others[1 : 2 * _BESIDE + 1]

    def agree(self, frame: int, time: int, other: int) -> bool:
        """Whether the map of a frame, placed at a time, agrees with the map of another frame."""
        share, count = self._share(frame, time, other)
        return count >= _LEAST and share > _AGREE

    def seen(self, frame: int) -> bool:
        """Whether it agrees with another frame near it."""
        return any(self._share(frame, frame, other)[1] >= _LEAST for other in self.near(frame))


def _share_alike(
    sequence: Sequence, map_of: Callable[[int], DepthMap | None], frame: int, time: int, other: int
) -> tuple[float, int]:
    """Share of the comparable pixels of two frames that agree, and number of comparable ones."""
    source, target = map_of(frame), map_of(other)
    if source is None or target is None:
        return 0.0, 0
    moved = replace(source, view=source.view._replace(frame=time))
    stride = stride_for(source.depth.size, _TRIED_PIXELS)
    relative = reproject(sequence, moved, target, stride).relative
    near = relative[(source.depth[::stride, ::stride] > 0) & (relative < 0.01)]
    near = near[np.isfinite(near)]
    return (float(np.mean(np.abs(near) <= DEPTH_TOLERANCE)) if near.size else 0.0), near.size


def _left_map(sequence: Sequence, frame: int) -> DepthMap | None:
    view = ImageView("rs", "left", frame)
    try:
        return DepthMap(view, sequence.depth(*view), sequence.rig.sensor("left"))
    except RsbenchError:  # reported already
        return None
