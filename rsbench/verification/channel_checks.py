"""Check channels with a value for each pixel against depth, motion and each other: each value is derived again."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import (
    INSTANCE_TABLE,
    INSTANCES,
    NORMALS,
    PAIR_CHANNELS,
    RADIANCE,
    SAME_PX,
    FrameTruth,
    Layer,
    known,
    pair_layers,
    pair_values,
)
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, ImageView, PixelClass, Rays, SeenSurfaces, numbers_of, times_at
from rsbench.renderers.image import linear_of_codes, to_srgb8
from rsbench.verification.content import Content, clean_picture
from rsbench.verification.findings import Again, Finding, cheapest_cause, rows_of, rows_with_most
from rsbench.verification.image_checks import Picture
from rsbench.verification.reprojection import BoolArray, DepthMap, around, reproject

if TYPE_CHECKING:
    from rsbench.renderers.render import Frame

Float32Array = NDArray[np.float32]
_FEW, _OF_A_ROW = 1e-3, 0.25
"""Shares of pixels that may differ, in the image and in a row: rounding moves pixels across the image border."""
_SURFACE, _BEHIND = 5e-5, 3e-4
"""Relative depth difference below which a point lies on the target's surface, and above which that hides it."""
_FEW_THIN, _FEW_GAPS, _FEW_SHOWN = 0.01, 0.3, 3e-3
"""Largest shares of wrong pixels among those on flat surfaces of the target, behind them, and in view. Structures
thinner than a pixel hide points between the target's pixels, and thin gaps reveal them; where little is hidden,
such gaps, for instance the joints between tiles, may be most of it."""
_OF_A_THIN_ROW, _OF_ITS_WIDTH = 0.5, 0.125
"""The same in one row, along which a thin structure may lie: of its pixels of that kind, and of its width."""
_FEW_AGAIN = 5e-3
"""Share of pixels that may differ in rows that are computed again: on another processor, the rounding of depth
sometimes moves points across edges."""
_LEAST = 8
"""Number of pixels that may always differ."""
_EXPLAINS = 0.8
_NO_VALUE = (PixelClass.UNSOLVED, PixelClass.OUT_OF_VIEW)
_OF_SKY = (PixelClass.SKY, PixelClass.SKY_OCCLUDED)
_HIDDEN = (PixelClass.OCCLUDED, PixelClass.SKY_OCCLUDED)


class _Stored(NamedTuple):
    values: Float32Array
    """(H, W, components)"""
    classes: NDArray[np.uint8]


class _Derived(NamedTuple):
    """A channel computed from depth and motion, at every ``stride``-th pixel."""

    values: Float32Array
    """(h, w, components) px, NaN out of view."""
    hidden: Float32Array
    """(h, w) 1 where a flat surface of the target hides the point, 0 where it contains it, NaN if unclear."""


def channel_faults(
    content: Content, reported: Collection[str], new: tuple[int, ...], stride: int = 1
) -> Iterator[Finding]:
    """Find values of the channels between two pictures that do not follow from the depth maps and the motion.

    Missing or wrong files that are ``reported`` already are left out, as a wrong depth map would accuse others.
    Only channels whose frames are all in the content, and at least one of them ``new``, are checked.
    """
    sequence, maps, times = content.sequence, content.maps_without(reported), content.times
    for layer in pair_layers(sequence.channels, sequence.twins, sequence.frames):
        stored: dict[ImageView, _Stored] = {}
        for side, frame in layer.views(sequence.frames):
            files, view = (layer.values(side, frame), layer.mask(side, frame)), ImageView("rs", side, frame)
            both = {frame, layer.target(view, sequence.frames).frame}
            try:
                if both <= {*times} and both & {*new} and not set(files) & set(reported):
                    stored[view] = _stored(sequence, layer, view)
            except RsbenchError as error:
                yield Finding.of(error)
        for view in stored:
            if {view, layer.target(view, sequence.frames)} <= maps.keys():
                yield from _pair_faults(content, layer, view, stored, stride)


def _stored(sequence: Sequence, layer: Layer, view: ImageView) -> _Stored:
    """Read the values and classes of a view; RsbenchError if a file cannot be read."""
    channel, row, back = layer
    where = channel, view.side, view.frame, row, back
    return _Stored(sequence.offsets(*where), sequence.classes(*where))


def channels_again(
    sequence: Sequence, view: ImageView, rows: list[int], frame: Frame, rays: Rays, reported: Collection[str]
) -> Iterator[Again]:
    """Compute rows of the channels of a frame again, and compare them with each file.

    Args:
        sequence: the sequence with the stored channels.
        view: the frame; a global-shutter frame has no channels.
        rows: numbers of the rows.
        frame: these rows, rendered again.
        rays: ray casting in the scene.
        reported: files that are not compared.
    """
    if view.shutter != "rs":
        return
    truth = FrameTruth(sequence, view, frame, rays, sequence.channels, sequence.twins, rows)
    for channel in known(sequence.channels):
        if channel.rounding is None:
            continue
        for file, made in channel.made(truth):
            if file in reported:
                continue
            try:
                stored = sequence.channel_values(channel.name, file)[rows]
            except RsbenchError:  # reported already
                continue
            off = np.abs(stored.astype(np.float64) - made)
            alike = (off <= channel.rounding) | (np.isnan(stored) & np.isnan(made))
            wrong = ~np.all(alike.reshape(*alike.shape[:2], -1), axis=-1)
            everywhere = np.ones(wrong.shape, dtype=np.bool_)
            of_a_row = _OF_A_ROW if channel.name in PAIR_CHANNELS else 1.0
            bad = _many(wrong, everywhere, _FEW_AGAIN, of_a_row)
            what = f"{_percent(wrong, everywhere)} differ from a new computation"
            in_rows = np.isin(
                np.arange(sequence.rig.sensor(view.side).height), np.asarray(rows)[np.any(wrong, axis=1)]
            )
            same = np.array_equal(stored, made.astype(stored.dtype), equal_nan=stored.dtype.kind == "f")
            yield Again(file, Finding(file, what, rows_of(in_rows)) if bad else None, same)


def _pair_faults(
    content: Content, layer: Layer, view: ImageView, stored: Mapping[ImageView, _Stored], stride: int
) -> Iterator[Finding]:
    derived = _derived(content, layer, view, stride)
    values, classes = stored[view].values[::stride, ::stride], stored[view].classes[::stride, ::stride]
    file = layer.values(view.side, view.frame)
    known = ~np.isin(classes, _NO_VALUE)
    both = known & np.isfinite(derived.values[..., 0])
    wrong = np.any(~(np.abs(values - derived.values) <= SAME_PX), axis=-1)
    if _many(wrong & both, both):
        size = np.median(np.max(np.abs(values - derived.values), axis=-1)[wrong & both])
        what = f"{_percent(wrong & both, both)} differ from what depth and motion make, typically by {size:.2g} px"
        cause = _pair_cause(layer, view, stored, derived, stride)
        yield Finding(file, what, rows_with_most(wrong & both, stride, len(stored[view].classes)), cause)
    empty = np.isnan(values).any(axis=-1)
    if np.any(empty == known):
        what = f"{np.sum(empty & known)} pixels without a value and {np.sum(~empty & ~known)} with one too many"
        yield Finding(file, f"{what}, by {layer.mask(view.side, view.frame)}")
    there, sky = layer.target(view, content.sequence.frames), content.maps[view].depth[::stride, ::stride] == 0
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
    reference = f"according to {there.depth}"
    surface, behind = ~empty & (derived.hidden == 0), derived.hidden == 1
    for words, wrong, among, many in (
        ("not solved", unsolved, everywhere, _many),
        ("wrongly in or out of view", ~unsolved & (empty != lost), everywhere, _many),
        (f"wrongly sky or surface by {view.depth}", ~empty & (of_sky != sky), everywhere, _many),
        (f"marked hidden, but visible {reference}", hidden, surface, _many_thin),
        (f"marked visible, but hidden {reference}", ~empty & ~hidden, behind, partial(_many_gaps, ~empty)),
    ):
        if many(wrong & among, among):
            rows = rows_with_most(wrong & among, stride, height)
            yield Finding(file, f"{_percent(wrong & among, among)} are {words}", rows)


def _derived(content: Content, layer: Layer, view: ImageView, stride: int) -> _Derived:
    """Derive a channel from depth and motion; sky counts as a surface at ``FAR``, hidden by any other."""
    sequence, maps = content.sequence, content.maps
    depth = maps[view].depth
    filled = replace(maps[view], depth=np.where(depth > 0, depth, np.float32(FAR)))
    reprojection = reproject(sequence, filled, maps[layer.target(view, sequence.frames)], stride)
    grid = maps[view].camera.pixel_grid()[::stride, ::stride]
    values = pair_values(layer.channel, view, reprojection.pixels - grid)
    sky, relative = depth[::stride, ::stride] == 0, reprojection.relative
    free = np.where(sky, np.isneginf(relative), np.abs(relative) < _SURFACE)
    hidden = np.where(relative > _BEHIND, 1.0, np.where(free, 0.0, np.nan))
    return _Derived(values, hidden.astype(np.float32))


def _many(
    wrong: BoolArray, among: BoolArray, few: float = _FEW, of_a_row: float = _OF_A_ROW, of_its_width: float = 0.0
) -> bool:
    """Return whether too many of the pixels ``among`` (H, W) are wrong, in the image or in one of its rows."""
    in_row, of_row = np.sum(wrong, axis=1), np.sum(among, axis=1)
    rows = np.any(in_row > np.maximum(of_a_row * of_row, max(_LEAST, of_its_width * wrong.shape[1])))
    return bool(np.sum(wrong) > max(few * np.sum(among), _LEAST) or rows)


def _many_thin(wrong: BoolArray, among: BoolArray) -> bool:
    return _many(wrong, among, _or_a_line(_FEW_THIN, among), _OF_A_THIN_ROW, _OF_ITS_WIDTH)


def _many_gaps(in_view: BoolArray, wrong: BoolArray, behind: BoolArray) -> bool:
    """Return whether too many pixels are wrong, both of those ``behind`` and of those ``in_view`` (H, W)."""
    of_hidden = _many(wrong, behind, _FEW_GAPS, _OF_A_THIN_ROW, _OF_ITS_WIDTH)
    few = _or_a_line(_FEW_SHOWN, in_view)
    return of_hidden and _many(wrong, in_view, few, _OF_A_THIN_ROW, _OF_ITS_WIDTH)


def _or_a_line(few: float, among: BoolArray) -> float:
    """Return ``few``, or, if larger, the share of these pixels that one joint across the whole picture has."""
    return max(few, max(among.shape) / max(1, int(np.sum(among))))


def _percent(wrong: BoolArray, among: BoolArray) -> str:
    count = int(np.sum(among))
    share = 100 * np.sum(wrong) / max(count, 1)
    return f"{share:.0f} % of {count} pixels" if share >= 10 else f"{share:.2g} % of {count} pixels"


def _pair_cause(
    layer: Layer, view: ImageView, stored: Mapping[ImageView, _Stored], derived: _Derived, stride: int
) -> str:
    """Describe how the stored values seem to have been changed; "" if no change explains most of them."""
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
    for other, kept in stored.items():
        if other != view and np.array_equal(kept.values, values, equal_nan=True):
            return f"the same as {layer.values(other.side, other.frame)}"
    ratio = float(np.nanmedian(sampled / np.where(np.abs(derived.values) < 1, np.nan, derived.values)))
    spread = np.nanmedian(np.abs(sampled - ratio * derived.values))
    return f"looks scaled by {ratio:.5g}" if abs(ratio - 1) > 1e-4 and spread < 2 * SAME_PX else ""


def _explains(candidate: Float32Array, derived: _Derived) -> bool:
    both = np.isfinite(candidate[..., 0]) & np.isfinite(derived.values[..., 0])
    near = np.all(np.abs(candidate - derived.values) <= SAME_PX, axis=-1)
    return bool(np.any(both) and np.mean(near[both]) > _EXPLAINS)


_UNIT = 1e-5
"""Tolerance of the length of a normal: the rounding of float32."""
LEVEL, FEW_BENT = 0.05, 0.02
"""Largest cosine between a normal and a step along its surface, as flat surfaces bend by less; share of flat
pixels that may exceed it, at shallow creases."""
_FEW_OTHERS = 0.02
"""Share of the pixels of one surface that may show another instance: an object thinner than a pixel may lie
between four pixels that see something else."""


def surface_faults(content: Content, reported: Collection[str], new: tuple[int, ...]) -> Iterator[Finding]:
    """Find normals and instances that contradict the surfaces of the depth maps, except in ``reported`` files.

    Only ``new`` frames are checked, and pairs of frames of which at least one is new.
    """
    sequence, maps = content.sequence, content.maps_without(reported)
    instances: dict[ImageView, NDArray[np.uint16]] = {}
    for side, frame in product(SIDES, content.times):
        view = ImageView("rs", side, frame)
        if view not in maps:
            continue
        try:
            file = NORMALS.file(side, frame)
            if "normals" in sequence.channels and file not in reported and frame in new:
                yield from _normal_faults(sequence, maps[view], file, sequence.normals(side, frame))
            file = INSTANCES.file(side, frame)
            if "instances" in sequence.channels and not {file, INSTANCE_TABLE} & set(reported):
                instances[view] = sequence.instances(side, frame)
                if frame in new:
                    yield from _number_faults(maps[view], file, instances[view], len(sequence.instance_table()))
        except RsbenchError as error:
            yield Finding.of(error)
    for view in instances:
        for partner in view.partners():
            if partner in instances and {view.frame, partner.frame} & {*new}:
                yield from _agreement_faults(content, instances, view, partner)


def _normal_faults(
    sequence: Sequence, depth_map: DepthMap, file: str, normals: NDArray[np.float32]
) -> Iterator[Finding]:
    solid = depth_map.depth > 0
    length = np.linalg.norm(normals, axis=-1)
    wrong = ~(np.abs(length - solid) <= _UNIT)
    if np.sum(wrong) > _LEAST:
        yield Finding(
            file, f"{np.sum(wrong)} normals are not of length 1, or 0 without a surface", rows_with_most(wrong)
        )
        return
    X, rays, normals = _resting(sequence, depth_map, normals)
    away = solid & (np.sum(rays * normals, axis=-1) > 0)
    if np.sum(away) > _LEAST:
        yield Finding(file, f"{np.sum(away)} normals point away from the camera", rows_with_most(away))
    bent = np.zeros(solid.shape, dtype=np.bool_)
    for step in (X[1:-1, 2:] - X[1:-1, :-2], X[2:, 1:-1] - X[:-2, 1:-1]):
        cosine = np.sum(step * normals[1:-1, 1:-1], axis=-1) / np.linalg.norm(step, axis=-1)
        bent[1:-1, 1:-1] |= np.abs(cosine) > LEVEL
    flat = depth_map.flat
    if np.sum(bent & flat) > max(FEW_BENT * np.sum(flat), _LEAST):
        share = f"{100 * np.sum(bent & flat) / np.sum(flat):.2g} % of the flat pixels"
        what = f"{share} have a normal that is not upright on the surface of {depth_map.view.depth}"
        yield Finding(file, what, rows_with_most(bent & flat))


def _resting(
    sequence: Sequence, depth_map: DepthMap, normals: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray, NDArray[np.float32]]:
    """Return points, rays to them and normals, (H, W, 3) each, in the world frame; those of a moving object in its
    own frame, in which it is at rest, as the normals of a picture belong to the times of its rows."""
    surfaces = SeenSurfaces(sequence, depth_map.view, depth_map.depth)
    X, rays, labels = surfaces.points, surfaces.points - surfaces.eyes, depth_map.labels
    for number, thing in enumerate(sequence.objects, start=1):
        chosen = np.zeros(X.shape[:2], np.bool_) if labels is None else numbers_of(labels) == number
        pose = inverse(thing.world_from_object(times_at(sequence, depth_map.view, surfaces.grid[chosen])))
        X, normals = X.copy(), normals.copy()
        X[chosen] = transform(pose, X[chosen])
        for vectors in (rays, normals):
            vectors[chosen] = (pose.R @ vectors[chosen][..., None])[..., 0]
    return X, rays, normals


def _number_faults(depth_map: DepthMap, file: str, numbers: NDArray[np.uint16], count: int) -> Iterator[Finding]:
    wrong = (numbers > 0) != (depth_map.depth > 0)
    if np.sum(wrong) > _LEAST:
        yield Finding(
            file, f"{np.sum(wrong)} pixels have an instance and no depth, or depth and none", rows_with_most(wrong)
        )
    if np.any(numbers > count):
        yield Finding(
            file,
            f"holds instance {np.max(numbers)}, {INSTANCE_TABLE} has {count}",
            rows_with_most(numbers > count),
        )


def _agreement_faults(
    content: Content, instances: Mapping[ImageView, NDArray[np.uint16]], view: ImageView, partner: ImageView
) -> Iterator[Finding]:
    reprojection = reproject(content.sequence, content.maps[view], content.maps[partner])
    with np.errstate(invalid="ignore"):
        same = np.abs(reprojection.relative) < _SURFACE
    # One of the four surrounding pixels must show the same instance: touching objects may meet between them.
    there = around(instances[partner], reprojection.pixels[same], (0, 1))
    other = np.zeros(same.shape, dtype=np.bool_)
    other[same] = ~np.any(there == instances[view][same], axis=0)
    if np.sum(other) > max(_FEW_OTHERS * np.sum(same), _LEAST):
        file, other_file = (INSTANCES.file(each.side, each.frame) for each in (view, partner))
        share = f"{100 * np.sum(other) / np.sum(same):.2g} % of {np.sum(same)} pixels"
        yield Finding(file, f"{share} see another instance than {other_file}", rows_with_most(other))


_CODE = 0.54
"""Tolerance of linear light in codes: the rounding of the codes, and that of half floats, 2^-12 of a value."""


def hdr_faults(content: Content, reported: Collection[str]) -> Iterator[Finding]:
    """Find linear images that do not match the clean images, except in ``reported`` files."""
    sequence = content.sequence
    renderer = sequence.manifest.get("renderer")
    exposure = renderer.get("exposure") if isinstance(renderer, dict) else None
    if "hdr" not in sequence.channels or not isinstance(exposure, float):
        return
    for view, picture in content.pictures.items():
        file, image = RADIANCE.file(view.side, view.frame), clean_picture(sequence, view)
        if view.shutter != "rs" or {file, image} & set(reported):
            continue
        try:
            radiance = sequence.radiance(view.side, view.frame)
        except RsbenchError as error:
            yield Finding.of(error)
            continue
        light, codes = radiance * exposure, picture.colours
        dark = (codes > 0) & (light < linear_of_codes(codes - _CODE))
        wrong = np.any(dark | ((codes < 255) & (light > linear_of_codes(codes + _CODE))), axis=-1)
        if np.sum(wrong) > max(_FEW * wrong.size, _LEAST):
            off = np.max(np.abs(to_srgb8(radiance, exposure) - codes))
            what = f"{100 * np.mean(wrong):.3g} % of {wrong.size} pixels are not {image} before its rounding"
            cause = _radiance_cause(light, picture)
            yield Finding(file, f"{what}, by up to {off:g} codes", rows_with_most(wrong), cause)


def _radiance_cause(light: NDArray[np.float32], picture: Picture) -> str:
    """Describe how linear values (H, W, 3) seem to have been changed; "" if no change explains most of them."""
    wanted = linear_of_codes(picture.colours)
    open_ = (wanted > 0.02) & (wanted < 0.98)
    if not np.any(light):
        return "looks zeroed"
    ratio = float(np.median(light[open_] / wanted[open_])) if np.any(open_) else 1.0
    tried = {
        f"scaled by {ratio:.3g}": light / max(ratio, 1e-9),
        "red and blue exchanged": light[..., ::-1],
        "upside down": light[::-1],
        "encoded as sRGB": linear_of_codes(255.0 * light),
    }
    costs = {words: float(np.mean(np.abs(each - wanted)[open_])) for words, each in tried.items()}
    return cheapest_cause(costs, float(np.mean(np.abs(light - wanted)[open_])))
