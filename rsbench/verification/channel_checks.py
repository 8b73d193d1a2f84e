"""Channels of ground truth against depth, motion and each other: every value is derived again."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.dataset.channel_truth import Rays, SeenSurfaces, carry, pair_truth, target_of
from rsbench.dataset.channel_writer import pair_values
from rsbench.dataset.channels import STEP_PX, Layer, PixelClass, pair_layers
from rsbench.dataset.object_records import numbers_of
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, ImageView
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import BoolArray, DepthMap, reproject

if TYPE_CHECKING:
    from rsbench.renderers.render import Frame

Float32Array = NDArray[np.float32]
_SAME_PX = 1.5 * STEP_PX
"""A step, where both were rounded, and what rounding of depth and pixels to float32 adds in images of 4000 px."""
_FEW, _OF_A_ROW = 1e-3, 0.25
"""Shares of pixels that may differ: in the image, those at its borders that rounding moves across; in a row."""
_SURFACE, _BEHIND = 5e-5, 3e-4
"""Relative distance below which a pixel sees the target's surface, and beyond which it is behind it."""
_FEW_THIN, _FEW_GAPS, _FEW_SHOWN = 0.01, 0.3, 3e-3
"""Of the pixels on flat surfaces of the target, of those behind them, and of all in view: what is thinner than a
pixel hides points between the target's pixels, or shows them. Where little is hidden, such as joints between tiles
may be most of it."""
_OF_A_THIN_ROW, _OF_ITS_WIDTH = 0.5, 0.125
"""Such things may lie along a row: shares of its pixels that are reported, and of all its pixels."""
_FEW_AGAIN = 5e-3
"""Of rows made again: on another processor, rounding of depth moves points across edges now and then."""
_LEAST = 8
"""So many pixels may always differ."""
_EXPLAINS = 0.8
_NO_VALUE = (PixelClass.UNSOLVED, PixelClass.OUT_OF_VIEW)
_OF_SKY = (PixelClass.SKY, PixelClass.SKY_OCCLUDED)
_HIDDEN = (PixelClass.OCCLUDED, PixelClass.SKY_OCCLUDED)


class _Stored(NamedTuple):
    values: Float32Array
    """(H, W, components)"""
    classes: NDArray[np.uint8]


class _Derived(NamedTuple):
    """A channel as depth and motion make it, every ``stride``-th pixel."""

    values: Float32Array
    """(h, w, components) px, NaN out of view."""
    hidden: Float32Array
    """(h, w) 1 where a flat surface of the target hides it, 0 where it is that surface, NaN where it is unsure."""


def channel_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    stride: int = 1,
    times: tuple[int, ...] = FRAMES,
    new: tuple[int, ...] = FRAMES,
) -> Iterator[Finding]:
    """What the channels of a sequence show that its depth maps and motion cannot have made.

    Files that are ``reported`` already, missing or wrong, are left out; a wrong depth map would accuse others. Of
    channels between two frames of these ``times``, or within one, at least one of which is ``new``.
    """
    for layer in pair_layers(sequence.channels, sequence.twins, sequence.frames):
        stored: dict[ImageView, _Stored] = {}
        for side, frame in layer.views(sequence.frames):
            files, view = (layer.values(side, frame), layer.mask(side, frame)), ImageView("rs", side, frame)
            both = {frame, target_of(layer, view, sequence.frames).frame}
            try:
                if both <= {*times} and both & {*new} and not set(files) & set(reported):
                    stored[view] = _stored(sequence, layer, view)
            except RsbenchError as error:
                yield Finding.of(error)
        for view in stored:
            there = target_of(layer, view, sequence.frames)
            used = {each for each in (view, there) if each in maps and each.depth not in reported}
            if len(used) == 2:
                yield from _pair_faults(sequence, maps, layer, view, stored, stride)


def _stored(sequence: Sequence, layer: Layer, view: ImageView) -> _Stored:
    """Raises RsbenchError where a file cannot be read."""
    channel, row, back = layer
    where = channel, view.side, view.frame, row, back
    return _Stored(sequence.offsets(*where), sequence.classes(*where))


def channels_again(
    sequence: Sequence, view: ImageView, rows: list[int], frame: Frame, rays: Rays, reported: Collection[str]
) -> Iterator[tuple[str, Finding | None, bool]]:
    """Rows of the channels of a frame made again: of each file its name, fault or None, and whether all is same.

    Args:
        sequence: holds them.
        view: the frame; of a global shutter there are none.
        rows: of the frame.
        frame: these rows rendered again.
        rays: through the scene.
        reported: files that are not looked at.
    """
    frames = sequence.frames
    for layer in pair_layers(sequence.channels, sequence.twins, frames) if view.shutter == "rs" else ():
        files = layer.values(view.side, view.frame), layer.mask(view.side, view.frame)
        if set(files) & set(reported) or view[1:3] not in layer.views(frames):
            continue
        try:
            values, classes = (each[rows] for each in _stored(sequence, layer, view))
        except RsbenchError:  # reported already
            continue
        seen = SeenSurfaces(sequence, view, frame.depth, rows, numbers_of(frame.labels))
        target = target_of(layer, view, frames)
        truth = pair_truth(seen, target, carry(seen, target), rays.blocked)
        made = pair_values(layer.channel, view, truth.offset)
        far = np.any(~((np.abs(values - made) <= _SAME_PX) | (np.isnan(values) & np.isnan(made))), axis=-1)
        unlike = classes != truth.classes
        everywhere = np.ones(far.shape, dtype=np.bool_)
        for file, wrong, same in (
            (files[0], far, np.array_equal(values, made, equal_nan=True)),
            (files[1], unlike, not np.any(unlike)),
        ):
            what = f"{_percent(wrong, everywhere)} differ from what is made again"
            bad = _many(wrong, everywhere, _FEW_AGAIN)
            in_rows = np.isin(np.arange(sequence.shutter.height), np.asarray(rows)[np.any(wrong, axis=1)])
            yield file, Finding(file, what, rows_of(in_rows)) if bad else None, same


def _pair_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    layer: Layer,
    view: ImageView,
    stored: Mapping[ImageView, _Stored],
    stride: int,
) -> Iterator[Finding]:
    derived = _derived(sequence, maps, layer, view, stride)
    values, classes = stored[view].values[::stride, ::stride], stored[view].classes[::stride, ::stride]
    file = layer.values(view.side, view.frame)
    known = ~np.isin(classes, _NO_VALUE)
    both = known & np.isfinite(derived.values[..., 0])
    wrong = np.any(~(np.abs(values - derived.values) <= _SAME_PX), axis=-1)
    if _many(wrong & both, both):
        size = np.median(np.max(np.abs(values - derived.values), axis=-1)[wrong & both])
        what = f"{_percent(wrong & both, both)} differ from what depth and motion make, typically by {size:.2g} px"
        cause = _cause(layer, view, stored, derived, stride)
        yield Finding(file, what, _rows(wrong & both, stride, len(stored[view].classes)), cause)
    empty = np.isnan(values).any(axis=-1)
    if np.any(empty == known):
        what = f"{np.sum(empty & known)} pixels without a value and {np.sum(~empty & ~known)} with one too many"
        yield Finding(file, f"{what}, by {layer.mask(view.side, view.frame)}")
    there, sky = target_of(layer, view, sequence.frames), maps[view].depth[::stride, ::stride] == 0
    yield from _mask_faults(layer, view, there, classes, sky, derived, stride)


def _mask_faults(
    layer: Layer,
    view: ImageView,
    there: ImageView,
    classes: NDArray[np.uint8],
    sky: BoolArray,
    derived: _Derived,
    stride: int,
) -> Iterator[Finding]:
    file, height = layer.mask(view.side, view.frame), len(classes) * stride
    lost = np.isnan(derived.values[..., 0])
    everywhere = np.ones(classes.shape, dtype=np.bool_)
    unsolved, empty = classes == PixelClass.UNSOLVED, np.isin(classes, _NO_VALUE)
    hidden, of_sky = np.isin(classes, _HIDDEN), np.isin(classes, _OF_SKY)
    surface, behind = ~empty & (derived.hidden == 0), derived.hidden == 1
    for words, wrong, among, many in (
        ("not solved", unsolved, everywhere, _many),
        ("wrongly in or out of view", ~unsolved & (empty != lost), everywhere, _many),
        (f"wrongly sky or surface by {view.depth}", ~empty & (of_sky != sky), everywhere, _many),
        (f"hidden, but visible by {there.depth}", hidden, surface, _many_thin),
        (f"visible, but hidden by {there.depth}", ~empty & ~hidden, behind, partial(_many_gaps, ~empty)),
    ):
        if many(wrong & among, among):
            rows = _rows(wrong & among, stride, height)
            yield Finding(file, f"{_percent(wrong & among, among)} are {words}", rows)


def _derived(
    sequence: Sequence, maps: Mapping[ImageView, DepthMap], layer: Layer, view: ImageView, stride: int
) -> _Derived:
    """Sky is a surface at ``FAR``; what has none in the target is before it nowhere."""
    depth = maps[view].depth
    filled = replace(maps[view], depth=np.where(depth > 0, depth, np.float32(FAR)))
    reprojection = reproject(sequence, filled, maps[target_of(layer, view, sequence.frames)], stride)
    grid = sequence.rig.camera.pixel_grid()[::stride, ::stride]
    values = pair_values(layer.channel, view, reprojection.pixels - grid)
    sky, relative = depth[::stride, ::stride] == 0, reprojection.relative
    free = np.where(sky, np.isneginf(relative), np.abs(relative) < _SURFACE)
    hidden = np.where(relative > _BEHIND, 1.0, np.where(free, 0.0, np.nan))
    return _Derived(values, hidden.astype(np.float32))


def _many(
    wrong: BoolArray, among: BoolArray, few: float = _FEW, of_a_row: float = _OF_A_ROW, of_its_width: float = 0.0
) -> bool:
    """Whether too many pixels (H, W) are wrong among these, in the image or in one of its rows."""
    in_row, of_row = np.sum(wrong, axis=1), np.sum(among, axis=1)
    rows = np.any(in_row > np.maximum(of_a_row * of_row, max(_LEAST, of_its_width * wrong.shape[1])))
    return bool(np.sum(wrong) > max(few * np.sum(among), _LEAST) or rows)


def _many_thin(wrong: BoolArray, among: BoolArray) -> bool:
    return _many(wrong, among, _or_a_line(_FEW_THIN, among), _OF_A_THIN_ROW, _OF_ITS_WIDTH)


def _many_gaps(in_view: BoolArray, wrong: BoolArray, behind: BoolArray) -> bool:
    """Too many for what is hidden, and for what is ``in_view`` (H, W)."""
    of_hidden = _many(wrong, behind, _FEW_GAPS, _OF_A_THIN_ROW, _OF_ITS_WIDTH)
    few = _or_a_line(_FEW_SHOWN, in_view)
    return of_hidden and _many(wrong, in_view, few, _OF_A_THIN_ROW, _OF_ITS_WIDTH)


def _or_a_line(few: float, among: BoolArray) -> float:
    """A share of these pixels, at least that of one joint from end to end of the picture."""
    return max(few, max(among.shape) / max(1, int(np.sum(among))))


def _percent(wrong: BoolArray, among: BoolArray) -> str:
    count = int(np.sum(among))
    share = 100 * np.sum(wrong) / max(count, 1)
    return f"{share:.0f} % of {count} pixels" if share >= 10 else f"{share:.2g} % of {count} pixels"


def _rows(wrong: BoolArray, stride: int, height: int) -> str:
    """Words for the rows in which many of the wrong pixels lie."""
    share = np.mean(wrong, axis=1)
    return rows_of(np.repeat(share > 0.5 * np.max(share), stride)[:height])


def _cause(
    layer: Layer, view: ImageView, stored: Mapping[ImageView, _Stored], derived: _Derived, stride: int
) -> str:
    """What the stored values are instead, in words; "" where nothing explains most of them."""
    values = stored[view].values
    sampled = values[::stride, ::stride]
    tried = {
        "zeroed": values * 0 if not np.any(np.nan_to_num(values)) else None,
        "negated": -values,
        "x and y exchanged": values[..., ::-1] if layer.channel != "disparity" else None,
        "shifted by one row": np.roll(values, -1, axis=0),
        "shifted by one column": np.roll(values, -1, axis=1),
        "flipped left to right": values[:, ::-1],
        "flipped upside down": values[::-1],
    }
    for words, candidate in tried.items():
        if candidate is not None and (words == "zeroed" or _explains(candidate[::stride, ::stride], derived)):
            return f"looks {words}"
    for other, held in stored.items():
        if other != view and np.array_equal(held.values, values, equal_nan=True):
            return f"the same as {layer.values(other.side, other.frame)}"
    ratio = float(np.nanmedian(sampled / np.where(np.abs(derived.values) < 1, np.nan, derived.values)))
    spread = np.nanmedian(np.abs(sampled - ratio * derived.values))
    return f"looks scaled by {ratio:.5g}" if abs(ratio - 1) > 1e-4 and spread < 2 * _SAME_PX else ""


def _explains(candidate: Float32Array, derived: _Derived) -> bool:
    both = np.isfinite(candidate[..., 0]) & np.isfinite(derived.values[..., 0])
    near = np.all(np.abs(candidate - derived.values) <= _SAME_PX, axis=-1)
    return bool(np.any(both) and np.mean(near[both]) > _EXPLAINS)
