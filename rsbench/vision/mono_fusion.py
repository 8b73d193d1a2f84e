"""The image at one time from two rolling-shutter frames of one camera: by geometry where it holds, else by flow.

A static pixel has one unknown, its inverse depth. It is searched along the pixel's epipolar curve
(``epipolar_search``) and used if the other frame confirms it; else it follows from the dense flow, if that is
consistent (returns to its start) and ends on the curve; in a band along the border, from the surface beside it
(``continued``); else it is that of the farther neighbour in the row. Pixels whose consistent flow ends off the
curve move independently, along their flow, scaled by the row times. Both displacements are weighted by their
variances; if consistent flow in general ends off the curves, the motion model does not hold, and all pixels move
along their flow. Each frame is drawn at the target time, nearer surfaces in front; holes are filled from the other
frame, moved to the same time, where its pixels were measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import FRAMES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.correction import (
    BELOW,
    RIGHT,
    LineMap,
    WarpOptions,
    draw_joined,
    joined_inside,
    joined_within,
    line_map,
    line_maps,
    move_by,
)
from rsbench.vision.epipolar_search import (
    SweepOptions,
    Swept,
    largest_seen,
    line_poses,
    reduction,
    search_size,
    sweep_frames,
)
from rsbench.vision.flow import ON_CURVE_PX, RETURNS_PX, dense_flow, flow_share, leaves, returns_px
from rsbench.vision.fusion import Fused, Origin, inpaint
from rsbench.vision.images import grey_u8, map_frames, resample
from rsbench.vision.reprojection import LineMaps, Reprojection, look, look_between, parallax_gain, reprojection_of
from rsbench.vision.stereo_depth import fill_holes

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
_FITTED, _WIDEST = 0.125, 0.15
"""Shares of the image's height or width: length beside a band to which a line is fitted, and widest band."""
_BESIDE = 1 / 16
"""Columns on either side whose slopes are used, as a share of the width."""
_ON_LINE = 0.05
"""Largest root mean square deviation from the line, relative to the inverse depth."""
_MOST = 1.5
"""Largest extended inverse depth over the largest known one."""
_START = 5
"""Number of pixels through whose median, in their middle, the line passes."""


def continued(rho: F32) -> F32:
    """Inverse depth (h, w), NaN where unknown, after unknown bands along the border were filled."""
    if not np.any(np.isfinite(rho)):
        return rho
    most = _MOST * float(np.nanmax(rho))
    for _ in range(2):  # lower and upper ends of columns, then, turned, the ends of rows
        rho = _below(_below(rho, most)[::-1], most)[::-1].T
    return rho


def _below(rho: F32, most: float) -> F32:
    """``rho`` (h, w) with the unknown lower ends of columns filled, if the values above are on a line."""
    height, width = rho.shape
    known = np.isfinite(rho)
    last = np.where(known.any(axis=0), height - 1 - np.argmax(known[::-1], axis=0), -1)
    away = (np.arange(height)[:, None] - last).astype(np.float64)
    reach = max(int(_FITTED * height), 4)
    used = known & (away > -reach) & (away <= 0.0)
    count = np.maximum(used.sum(axis=0), 1)
    t, r = np.where(used, away, 0.0), np.where(used, rho, 0.0)
    mean_t, mean_r = t.sum(axis=0) / count, r.sum(axis=0) / count
    spread = np.maximum((t * t).sum(axis=0) / count - mean_t**2, 1e-9)
    slope = ((t * r).sum(axis=0) / count - mean_t * mean_r) / spread
    off = np.where(used, rho - (mean_r + slope * (away - mean_t)), 0.0)
    error = np.sqrt((off * off).sum(axis=0) / count)
    line = (count >= reach // 2) & (error < _ON_LINE * (mean_r - slope * mean_t)) & (last < height - 1)
    line &= height - 1 - last < _WIDEST * height
    if not np.any(line):
        return rho
    beside = int(_BESIDE * width)
    slopes = np.pad(np.where(line, slope, np.nan), beside, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(slopes, 2 * beside + 1)[line]
    start = np.nanmedian(np.where(used & (away > -_START), rho, np.nan)[:, line], axis=0)
    out = rho.copy()
    values = np.clip(start + np.nanmedian(windows, axis=1) * (away[:, line] + _START // 2), 0.0, most)
    out[:, line] = np.where(away[:, line] > 0.0, values, rho[:, line])
    return out


_RANGE_QUANTILE, _RANGE_MARGIN, _RANGE_PX = 0.999, 1.5, 2.0
"""Range of the search along the curves around the inverse depths of consistent flow: a factor, and px of
parallax."""
_SAME_PX = 2.0
"""Largest difference of parallax, px, between a confirmed search and consistent flow at which the depth of the
flow is used, which is finer than the planes."""
_CONFIRMED = 16.0
"""Factor on the variance of flow where the other frame confirms the search."""
_LAWFUL, _DISTRUST = 2.0, 50.0
"""Largest ratio of the flow's median distance from the curve to its median inconsistency with which the motion
model holds: 0.6 to 1.5 on published pairs that a motion model describes, also with sensor noise and blur, and 6.5
on one that none describes. And variance of the geometry over the square of the excess, px."""
_STRETCH = 2.5
"""Distance, px, of neighbours at the target above which the area between them is uncovered by an edge. Between 2
and 3: on rendered frames 2 gained 0.05 dB over 3, on real ones it lost as much."""
_BEHIND = 1.02
_FLOW_BYTES = 100.0
_BLOCK, _BLOCKS_AROUND = 8, 4
"""Side, px, of blocks of pixels that are moved only if their middle comes near a hole; and the largest distance to
the hole, in blocks, which exceeds the extent of a block that is stretched by ``_STRETCH``."""


class Flows(NamedTuple):
    """Dense flow of both frames (H, W) of one camera, in pixels of the size (h, w) at which it was estimated.

    Large frames are shrunk for it by ``reduction``.
    """

    flow: tuple[F32, F32]
    """(h, w, 2) px, of each frame to the other."""
    returns: tuple[F32, F32]
    """(h, w) result of ``returns_px``, px."""
    scale: tuple[float, float] = (1.0, 1.0)
    """W / w and H / h."""

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        height, width = self.returns[0].shape
        return height, width

    def in_frame(self, places: FloatArray) -> FloatArray:
        """Places (n, 2) in the frames, px of the frames, for places in images of the flow's size."""
        return places if self.scale == (1.0, 1.0) else (places + 0.5) * self.scale - 0.5

    def of_frame(self, number: int, shape: tuple[int, ...]) -> F32:
        """Flow (H, W, 2) of a frame of a ``shape`` (H, W[, C]), px of the frames."""
        if self.scale == (1.0, 1.0):
            return self.flow[number]
        whole = cv2.resize(self.flow[number], (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.multiply(whole, np.array(self.scale, np.float32), out=whole))


@dataclass(frozen=True, kw_only=True)
class MonoFusionOptions:
    """Options of the correction."""

    sweep: SweepOptions = field(default_factory=SweepOptions)
    """The search along the epipolar curves."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """Resampling of the source image; ``tear_px`` is not used."""
    fill: bool = True
    """Whether the other frame fills holes."""
    inpaint: bool = True
    """Whether to inpaint pixels that no frame shows; the mask still marks them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnMotion:
    """The camera and its motion over two frames."""

    rig: StereoRig
    """A rig whose body is at that camera."""
    shutter: RollingShutter
    """Its lines are rows."""
    side: Side
    motion: Motion | None
    """Motion, in its own unit of length; None: unknown, and every pixel moves along its flow."""
    far: bool = False
    """Whether to treat everything as infinitely far, whatever the flow."""


def find_flows(images: Sequence[NDArray[Any]]) -> Flows:
    """Flow of two frames to each other (H, W[, 3]), uint8 or uint16; found at a size of ``reduction``."""
    height, width = images[0].shape[:2]
    size = max(width // reduction(images[0].shape), 1), max(height // reduction(images[0].shape), 1)
    is_shrunk = size != (width, height)
    if is_shrunk:
        images = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    both = map_frames(
        lambda i: dense_flow(images[i], images[1 - i], fine=is_shrunk), FRAMES, size[0] * size[1], _FLOW_BYTES
    )
    returns = returns_px(*both), returns_px(*both[::-1])
    return Flows((both[0], both[1]), returns, (width / size[0], height / size[1]))


class _Layer(NamedTuple):
    """Depth and weights of the pixels of one frame, for all target times."""

    rho: F32
    """(H, W) inverse depth in each row's own camera."""
    flow_share: F32
    """(H, W) weight of the scaled flow beside that of the geometry, 0 to 1."""
    measured: Mask
    """(H, W) whether the depth of the pixel was measured by search or flow, not taken from neighbours."""


class Beyond(NamedTuple):
    """A pair of frames by which a hole of one of them may be filled."""

    pair: MonoFusion
    frame: int
    """Index of the frame with the hole; the other frame fills it."""
    target_tau: float
    """In frame periods of this pair."""


class MonoFusion:
    """Two frames of one camera, ready to be corrected to any time."""

    def __init__(
        self,
        images: Sequence[NDArray[Any]],
        own: OwnMotion,
        flows: Flows,
        options: MonoFusionOptions | None = None,
    ) -> None:
        """Find the depth of both frames (H, W[, 3]), uint8 or uint16, by the motion ``own``."""
        self.images, self.own, self.flows, self.options = images, own, flows, options or MonoFusionOptions()
        self._layers = self._find_layers()

    def corrected(
        self, frame: int, target_tau: float, beyond: Beyond | None = None, places: FloatArray | None = None
    ) -> Fused:
        """The frame corrected to a time, in frame periods; its depth is in the motion's unit.

        Args:
            beyond: another pair that contains the frame, whose other frame may fill the remaining holes.
            places: ``places`` of the frame at that time if they are known.
        """
        places = self.places(frame, target_tau) if places is None else places
        image, buffer, origin = self._drawn(frame, places)
        others = [Beyond(self, frame, target_tau)] + ([] if beyond is None else [beyond])
        for pair, same, tau in others if self.options.fill else []:
            empty, stretched = origin == Origin.NOBODY, (origin == Origin.GUESSED) & (pair is self)
            if not np.any(empty | stretched):
                continue
            wanted = empty | stretched
            other, behind, how = pair._drawn(1 - same, pair.places(1 - same, tau, wanted), wanted)
            behind *= _unit(self._layers[frame].rho, pair._layers[same].rho)
            # An edge uncovers a farther surface.
            take = (how == Origin.HERE) & (empty | (stretched & (behind <= _BEHIND * buffer)))
            image[take], buffer[take], origin[take] = other[take], behind[take], Origin.OTHER_FRAME
        empty = origin == Origin.NOBODY
        if self.options.inpaint:
            image = inpaint(image, empty)
        with np.errstate(divide="ignore"):  # at infinity
            depth = np.where(empty, np.float32(np.nan), np.float32(1.0) / np.maximum(buffer, np.float32(0.0)))
        if self.own.motion is None:
            depth = np.full_like(depth, np.nan)
        return Fused(image=image, origin=origin, depth=depth.astype(np.float32))

    def _find_layers(self) -> list[_Layer]:
        own, shape = self.own, self.images[0].shape[:2]
        known = np.ones(shape, dtype=np.bool_)
        if own.motion is None:
            return [_Layer(np.zeros(shape, np.float32), np.ones(shape, np.float32), known) for _ in FRAMES]
        if own.far:
            return [_Layer(np.zeros(shape, np.float32), np.zeros(shape, np.float32), known) for _ in FRAMES]
        size = self.flows.shape
        camera = own.rig.sensor(own.side).resized(*size[::-1])
        poses = [line_poses(own.rig, own.shutter, own.motion, own.side, frame, size[0]) for frame in FRAMES]
        maps = [reprojection_of(camera, poses[frame], poses[1 - frame]) for frame in FRAMES]
        pick = _picked(size, search_size(shape, self.options.sweep))
        met = [_triangulated(self.flows.flow[frame], maps[frame], pick) for frame in FRAMES]
        offs = [off[np.ix_(*pick)] for off in self.flows.returns]
        greys = [grey_u8(image) for image in self.images]
        known, options = (greys, own.rig, own.shutter, own.motion, own.side), self.options.sweep
        gain = parallax_gain(camera, *maps)
        most = max(_range(offs, met, gain), largest_seen(*known, options))
        swept, same = sweep_frames(*known, most, options), _SAME_PX / max(gain, 1e-9)
        ends_outside = [leaves(flow)[np.ix_(*pick)] for flow in self.flows.flow]
        return [
            _layer(swept[frame], offs[frame], *met[frame], ends_outside[frame], shape, same) for frame in FRAMES
        ]

    def _drawn(
        self, frame: int, moved: FloatArray, wanted: Mask | None = None
    ) -> tuple[NDArray[Any], F32, NDArray[np.uint8]]:
        """Draw a frame with its pixels at ``moved``: image (H, W[, C]), inverse depth (H, W) and origin (H, W).

        The origin is HERE, GUESSED where the frame is stretched over an edge, or NOBODY (inverse depth -1).

        Args:
            moved: (H, W, 3) see ``places``.
            wanted: (H, W) pixels that must be drawn, without stretching; None: all.
        """
        tears = self.own.motion is not None
        joined = joined_within(moved, _STRETCH if tears else np.inf)
        if wanted is not None and tears:
            joined &= joined_inside(_reaching(moved, wanted))
        source_map, buffer = draw_joined(moved, joined)
        origin = np.where(buffer >= 0.0, np.uint8(Origin.HERE), np.uint8(Origin.NOBODY))
        if tears and wanted is None:
            whole, behind = draw_joined(moved, joined_inside(_beside_tears(joined)))
            stretched = (buffer < 0.0) & (behind >= 0.0)
            source_map[stretched], buffer[stretched] = whole[stretched], behind[stretched]
            origin[stretched] = Origin.GUESSED
        return resample(self.images[frame], source_map, self.options.warp.interpolation), buffer, origin

    def places(self, frame: int, target_tau: float, wanted: Mask | None = None) -> FloatArray:
        """(H, W, 3) target x, y, px, and inverse depth there, of every pixel of a frame.

        ``wanted`` (H, W): only the ``measured`` pixels in blocks that may reach these pixels are moved; the others
        are NaN.
        """
        own, layer = self.own, self._layers[frame]
        flow = self.flows.of_frame(frame, self.images[frame].shape)
        height, width = flow.shape[:2]
        rows = np.stack([np.zeros(height), np.arange(height)], axis=-1)
        here, rate = own.shutter.pixel_time(rows, frame, own.side), float(own.shutter.rate(own.side)[1])
        maps = None
        if own.motion is not None:
            target = own.rig.cam_from_world(own.motion, target_tau, own.side)
            poses = row_poses(own.rig, own.shutter, own.motion, own.side, frame)
            maps = line_maps(own.rig.sensor(own.side), poses, target)
        given = flow, layer.rho, layer.flow_share, maps, target_tau - here, float(1 - 2 * frame), rate
        places = np.full((height, width, 3), np.nan, dtype=np.float32)
        drawn = np.ones((height, width), np.bool_) if wanted is None else layer.measured
        if wanted is not None and maps is not None:
            near = _blocks_near(wanted)
            chosen = np.zeros_like(near)
            _mark_blocks(*given, near, chosen)
            drawn = drawn & np.repeat(np.repeat(chosen, _BLOCK, axis=0), _BLOCK, axis=1)[:height, :width]
        _fill_places(*given, drawn, places)
        return places


@compiled(error_model="numpy", inline="always")
def _place(
    x: int,
    y: int,
    flow: F32,
    rho: F32,
    weight: F32,
    maps: LineMaps | None,
    line: LineMap | None,
    ahead: float,
    period: float,
    rate: float,
) -> tuple[float, float, float]:
    """Target x, y, px, and inverse depth there, of a pixel: the mean of its places by scaled flow, with ``weight``
    (H, W), and by the map of its line; scaled flow alone if there is no map.

    ``ahead`` is the time from the pixel's row to the target. Each row takes the time ``rate``, so the time that
    passes along the flow is linear in the flow; if none passes, there is no speed, and the pixel stays.
    """
    passed = period + flow[y, x, 1] * rate
    share = ahead / passed if abs(passed) > 1e-3 else 0.0
    u, v, s = x + share * flow[y, x, 0], y + share * flow[y, x, 1], float(rho[y, x])
    if maps is not None:
        of_flow = float(weight[y, x])
        moved = move_by(line, maps, x, y, rho[y, x])  # pyrefly: ignore[bad-argument-type]
        u = of_flow * u + (1.0 - of_flow) * moved[0]
        v = of_flow * v + (1.0 - of_flow) * moved[1]
        s = of_flow * s + (1.0 - of_flow) * moved[2]
    return u, v, s


@compiled(error_model="numpy")
def _row_map(maps: LineMaps | None, y: int) -> LineMap | None:
    """The map of a row."""
    return None if maps is None else line_map(maps, y)


@compiled(error_model="numpy")
def _fill_places(
    flow: F32,
    rho: F32,
    weight: F32,
    maps: LineMaps | None,
    ahead: FloatArray,
    period: float,
    rate: float,
    drawn: Mask,
    places: FloatArray,
) -> None:
    """Fill ``places`` (H, W, 3) of the pixels in ``drawn`` (H, W); ``ahead`` (H,) is the time from each row."""
    height, width = rho.shape
    row = np.zeros((3, width), dtype=np.float32)
    for y in range(height):
        line, time = _row_map(maps, y), ahead[y]
        for x in range(width):
            row[0, x], row[1, x], row[2, x] = _place(x, y, flow, rho, weight, maps, line, time, period, rate)
        for x in range(width):
            if drawn[y, x]:
                places[y, x, 0], places[y, x, 1], places[y, x, 2] = row[0, x], row[1, x], row[2, x]


@compiled(error_model="numpy")
def _mark_blocks(
    flow: F32,
    rho: F32,
    weight: F32,
    maps: LineMaps | None,
    ahead: FloatArray,
    period: float,
    rate: float,
    near: Mask,
    chosen: Mask,
) -> None:
    """Mark blocks of pixels whose middle moves into one of the blocks ``near``."""
    height, width = rho.shape
    rows, columns = near.shape
    for i in range(rows):
        for j in range(columns):
            y, x = min(i * _BLOCK + _BLOCK // 2, height - 1), min(j * _BLOCK + _BLOCK // 2, width - 1)
            u, v, _ = _place(x, y, flow, rho, weight, maps, _row_map(maps, y), ahead[y], period, rate)
            if abs(u) < 1e9 and abs(v) < 1e9:
                column = min(max(int(u) // _BLOCK, 0), columns - 1)
                chosen[i, j] = near[min(max(int(v) // _BLOCK, 0), rows - 1), column]


def _blocks_near(wanted: Mask) -> Mask:
    """Blocks of pixels with a ``wanted`` one (H, W) at most ``_BLOCKS_AROUND`` blocks away."""
    height, width = wanted.shape
    padded = np.pad(wanted, ((0, -height % _BLOCK), (0, -width % _BLOCK)))
    blocks = padded.reshape(-(-height // _BLOCK), _BLOCK, -(-width // _BLOCK), _BLOCK).any(axis=(1, 3))
    side = 2 * _BLOCKS_AROUND + 1
    return np.asarray(cv2.dilate(blocks.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _reaching(moved: FloatArray, wanted: Mask) -> Mask:
    """(H, W) the corners of all quads of ``moved`` (H, W, 3) that may cover ``wanted`` pixels (H, W)."""
    side = 2 * math.ceil(2.0 * _STRETCH) + 1
    near = cv2.dilate(wanted.astype(np.uint8), np.ones((side, side), np.uint8))
    reaching = np.zeros(wanted.shape, np.uint8)
    _fill_reaching(moved, near, reaching)
    return np.asarray(cv2.dilate(reaching, np.ones((3, 3), np.uint8)) > 0)


@compiled(error_model="numpy")
def _fill_reaching(moved: FloatArray, near: NDArray[np.uint8], reaching: NDArray[np.uint8]) -> None:
    height, width = near.shape
    for y in range(reaching.shape[0]):
        for x in range(reaching.shape[1]):
            u, v = moved[y, x, 0], moved[y, x, 1]
            if abs(u) < 1e9 and abs(v) < 1e9:
                i, j = min(max(int(u), 0), width - 1), min(max(int(v), 0), height - 1)
                reaching[y, x] = near[j, i]


def _beside_tears(joined: NDArray[np.uint8]) -> Mask:
    """(H, W) the corners of all quads of which a side is not joined, for bits (H, W) of ``connect``."""
    beside = np.zeros(joined.shape, np.uint8)
    along, down = joined[:, :-1] & RIGHT == 0, joined[:-1] & BELOW == 0
    beside[:, :-1] |= along
    beside[:, 1:] |= along
    beside[:-1] |= down
    beside[1:] |= down
    return np.asarray(cv2.dilate(beside, np.ones((3, 3), np.uint8)) > 0)


def _unit(rho: F32, other: F32) -> np.float32:
    """Median ratio of inverse depths (H, W) of one frame in the units of two pairs; 1 if all are at infinity."""
    both = (rho > 0.0) & (other > 0.0)
    return np.median(rho[both] / other[both]) if np.any(both) else np.float32(1.0)


def _picked(shape: tuple[int, ...], size: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Choose evenly spaced rows and columns of an image (H, W); ``size`` gives their numbers."""
    rows, columns = (np.arange(few) * many // few for many, few in zip(shape, size, strict=True))
    return rows, columns


def _range(offs: Sequence[F32], met: Sequence[tuple[F32, F32]], gain: float) -> float:
    """Largest inverse depth that is searched."""
    believed = [rho[(off < RETURNS_PX) & (miss < ON_CURVE_PX)] for off, (rho, miss) in zip(offs, met, strict=True)]
    known = np.concatenate(believed)
    largest = float(np.quantile(known, _RANGE_QUANTILE)) if known.size else 0.0
    return largest * _RANGE_MARGIN + _RANGE_PX / max(gain, 1e-9)


def _layer(
    swept: Swept, off: F32, rho: F32, miss: F32, ends_outside: Mask, shape: tuple[int, ...], same: float
) -> _Layer:
    """Depth and weights (H, W) of a frame.

    ``off`` (h, w) is the inconsistency of its flow, ``rho`` and ``miss`` (h, w) are those of ``_triangulated``,
    and ``same`` is a difference of inverse depth.
    """
    full = shape[1::-1]
    still = (off < RETURNS_PX) & (miss < ON_CURVE_PX)
    searched = swept.agrees & ~(still & (np.abs(rho - swept.rho) < same))
    found = continued(np.where(searched, swept.rho, np.where(still, rho, np.float32(np.nan))))
    filled = cv2.resize(cv2.medianBlur(_filled(found), 5), full, interpolation=cv2.INTER_LINEAR)
    medians = np.median([miss[still], off[still]], axis=1) if np.any(still) else np.zeros(2)
    unexplained = max(float(medians[0] - _LAWFUL * medians[1]), 0.0)
    confirmed = np.where(swept.agrees, np.float32(_CONFIRMED), np.float32(1.0))
    share = flow_share(miss, off, confirmed, _DISTRUST * unexplained**2)
    measured = (np.isfinite(found) | (off < RETURNS_PX) | ends_outside).astype(np.uint8)
    return _Layer(
        rho=np.asarray(filled),
        flow_share=np.asarray(cv2.resize(share, full, interpolation=cv2.INTER_LINEAR)),
        measured=np.asarray(cv2.resize(measured, full, interpolation=cv2.INTER_NEAREST)) > 0,
    )


def _filled(rho: NDArray[Any]) -> F32:
    """Inverse depth (h, w) with that of the farther neighbour in the row where it is NaN; then in the column."""
    rows = fill_holes(rho.astype(np.float32))
    return np.nan_to_num(fill_holes(rows.T).T, nan=0.0).astype(np.float32)


def _triangulated(
    flow: F32, maps: Reprojection, pick: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> tuple[F32, F32]:
    """Inverse depth (h, w), at least 0, that fits a flow (H, W, 2) best, and px that the flow ends off it.

    ``pick``: rows (h,) and columns (w,) of the pixels.
    """
    size = len(pick[0]), len(pick[1])
    rho, miss = np.zeros(size, np.float32), np.zeros(size, np.float32)
    _triangulate(flow, *pick, maps, rho, miss)
    return np.nan_to_num(rho), np.nan_to_num(miss, nan=np.inf, posinf=np.inf)


@compiled(error_model="numpy")
def _triangulate(
    flow: F32, rows: NDArray[np.intp], columns: NDArray[np.intp], maps: Reprojection, rho: F32, miss: F32
) -> None:
    """Fill ``rho`` and ``miss`` (h, w): least squares of ``(a + rho T)_xy - end (a + rho T)_z``, in ideal pixels.

    NaN where the lens shows no ray.
    """
    G, c, A, B = maps.G, maps.c, maps.A, maps.B
    last = len(A) - 1
    a, T = np.zeros(3), np.zeros(3)
    for row, y in enumerate(rows):
        for column, x in enumerate(columns):
            u, v = x + flow[y, x, 0], y + flow[y, x, 1]
            line = min(max(int(np.floor(v)), 0), max(last - 1, 0))
            beside, part = min(line + 1, last), v - line
            gx, gy = look(maps.ideal, x, y)
            u, v = look_between(maps.ideal, u, v)
            for i in range(3):
                a[i], T[i] = 0.0, (1.0 - part) * B[line, i] + part * B[beside, i]
                for j in range(3):
                    m = (1.0 - part) * A[line, i, j] + part * A[beside, i, j]
                    a[i] += m * (G[y, j, 0] * gx + G[y, j, 1] * gy + G[y, j, 2])
                    T[i] += m * c[y, j]
            px, py = a[0] - u * a[2], a[1] - v * a[2]
            qx, qy = T[0] - u * T[2], T[1] - v * T[2]
            found = max(-(px * qx + py * qy) / max(qx * qx + qy * qy, 1e-12), 0.0)
            z = a[2] + found * T[2]
            rho[row, column] = found
            miss[row, column] = np.hypot(px + found * qx, py + found * qy) / z if z > 1e-3 else np.inf
