"""The channels ``normals`` and ``instances`` against the depth maps: what bends, and what is one thing."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, SIDES
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channel_truth import Rays, SeenSurfaces, surface_truth
from rsbench.dataset.channels import INSTANCE_TABLE, surface_file
from rsbench.dataset.object_records import numbers_of
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView, points_of, seen_from, times_at
from rsbench.verification.findings import Finding, rows_of
from rsbench.verification.frame_comparison import BoolArray, DepthMap, reproject

if TYPE_CHECKING:
    from rsbench.renderers.render import Frame

_UNIT = 1e-5
"""Of a length: the rounding of float32."""
LEVEL, FEW_BENT = 0.05, 0.02
"""Cosine between a normal and its surface, which bends by less where it counts as flat; and the share of flat
pixels that may be beyond, at creases of less than that."""
_SURFACE, _FEW_OTHERS = 5e-5, 0.02
"""As in ``channel_checks``; what is thinner than a pixel may lie between four that see something else."""
_FEW_AGAIN, _LEAST = 5e-3, 8


def surface_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    times: tuple[int, ...] = FRAMES,
    new: tuple[int, ...] = FRAMES,
) -> Iterator[Finding]:
    """What normals and instances show that the surfaces of the depth maps are not, but for files ``reported``.

    Of frames at these ``times``, and of pairs of them with one that is ``new``.
    """
    instances: dict[ImageView, NDArray[np.uint16]] = {}
    for side, frame in product(SIDES, times):
        view = ImageView("rs", side, frame)
        if view not in maps or view.depth in reported:
            continue
        try:
            file = surface_file("normals", side, frame)
            if "normals" in sequence.channels and file not in reported and frame in new:
                yield from _normal_faults(sequence, maps[view], file, sequence.normals(side, frame))
            file = surface_file("instances", side, frame)
            if "instances" in sequence.channels and not {file, INSTANCE_TABLE} & set(reported):
                instances[view] = sequence.instances(side, frame)
                if frame in new:
                    yield from _number_faults(maps[view], file, instances[view], len(sequence.instance_table()))
        except RsbenchError as error:
            yield Finding.of(error)
    for view in instances:
        for partner in view.partners():
            if partner in instances and {view.frame, partner.frame} & {*new}:
                yield from _agreement_faults(sequence, maps, instances, view, partner)


def _normal_faults(
    sequence: Sequence, depth_map: DepthMap, file: str, normals: NDArray[np.float32]
) -> Iterator[Finding]:
    solid = depth_map.depth > 0
    length = np.linalg.norm(normals, axis=-1)
    wrong = ~(np.abs(length - solid) <= _UNIT)
    if np.sum(wrong) > _LEAST:
        yield Finding(file, f"{np.sum(wrong)} normals are not of length 1, or 0 without a surface", _rows(wrong))
        return
    z = np.where(solid, depth_map.depth, 1.0).astype(np.float64)
    X, ways, normals = _resting(sequence, depth_map, z, normals)
    away = solid & (np.sum(ways * normals, axis=-1) > 0)
    if np.sum(away) > _LEAST:
        yield Finding(file, f"{np.sum(away)} normals point away from the camera", _rows(away))
    bent = np.zeros(solid.shape, dtype=np.bool_)
    for step in (X[1:-1, 2:] - X[1:-1, :-2], X[2:, 1:-1] - X[:-2, 1:-1]):
        cosine = np.sum(step * normals[1:-1, 1:-1], axis=-1) / np.linalg.norm(step, axis=-1)
        bent[1:-1, 1:-1] |= np.abs(cosine) > LEVEL
    flat = depth_map.flat
    if np.sum(bent & flat) > max(FEW_BENT * np.sum(flat), _LEAST):
        share = f"{100 * np.sum(bent & flat) / np.sum(flat):.2g} % of the flat pixels"
        what = f"{share} have a normal that is not upright on the surface of {depth_map.view.depth}"
        yield Finding(file, what, _rows(bent & flat))


def _resting(
    sequence: Sequence, depth_map: DepthMap, z: FloatArray, normals: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray, NDArray[np.float32]]:
    """Points, rays to them and normals, (H, W, 3) each, in the world; of what moves, in its own frame, where it
    rests: the normals of a frame are those of the times of its rows."""
    view, grid, labels = depth_map.view, sequence.rig.camera.pixel_grid(), depth_map.labels

    def of(number: int, chosen: Any) -> tuple[FloatArray, FloatArray]:
        pixels, depth = grid[chosen], z[chosen]
        own = seen_from(sequence, number)
        points = points_of(own, view, pixels, depth)
        return points, points - points_of(own, view, pixels, depth * 0)

    X, ways = of(0, ...)
    for number, thing in enumerate(sequence.objects, start=1):
        chosen = np.zeros(z.shape, np.bool_) if labels is None else numbers_of(labels) == number
        X[chosen], ways[chosen] = of(number, chosen)
        turned = inverse(thing.world_from_object(times_at(sequence, view, grid[chosen]))).R
        normals = normals.copy()
        normals[chosen] = (turned @ normals[chosen][..., None])[..., 0]
    return X, ways, normals


def _number_faults(depth_map: DepthMap, file: str, numbers: NDArray[np.uint16], count: int) -> Iterator[Finding]:
    wrong = (numbers > 0) != (depth_map.depth > 0)
    if np.sum(wrong) > _LEAST:
        yield Finding(
            file, f"{np.sum(wrong)} pixels have an instance and no depth, or depth and none", _rows(wrong)
        )
    if np.any(numbers > count):
        yield Finding(
            file, f"holds instance {np.max(numbers)}, {INSTANCE_TABLE} has {count}", _rows(numbers > count)
        )


def _agreement_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    instances: Mapping[ImageView, NDArray[np.uint16]],
    view: ImageView,
    partner: ImageView,
) -> Iterator[Finding]:
    reprojection = reproject(sequence, maps[view], maps[partner])
    with np.errstate(invalid="ignore"):
        same = np.abs(reprojection.relative) < _SURFACE
    # One of the four pixels around must see the same: between them, things that touch change.
    height, width = same.shape
    x, y = np.floor(reprojection.pixels[same]).astype(int).T
    around = [
        instances[partner][np.clip(y + down, 0, height - 1), np.clip(x + across, 0, width - 1)]
        for down in (0, 1)
        for across in (0, 1)
    ]
    other = np.zeros(same.shape, dtype=np.bool_)
    other[same] = ~np.any(np.equal(around, instances[view][same]), axis=0)
    if np.sum(other) > max(_FEW_OTHERS * np.sum(same), _LEAST):
        file, there = (surface_file("instances", each.side, each.frame) for each in (view, partner))
        share = f"{100 * np.sum(other) / np.sum(same):.2g} % of {np.sum(same)} pixels"
        yield Finding(file, f"{share} see another instance than {there}", _rows(other))


def surfaces_again(
    sequence: Sequence, view: ImageView, rows: list[int], frame: Frame, rays: Rays, reported: Collection[str]
) -> Iterator[tuple[str, Finding | None, bool]]:
    """As ``channel_checks.channels_again``, of normals and instances."""
    names = [name for name in ("normals", "instances") if view.shutter == "rs" and name in sequence.channels]
    seen = SeenSurfaces(sequence, view, frame.depth, rows, numbers_of(frame.labels))
    truth = surface_truth(seen, rays) if names else None
    for name in names:
        file = surface_file("normals" if name == "normals" else "instances", view.side, view.frame)
        if truth is None or file in reported:
            continue
        try:
            stored: NDArray[Any] = getattr(sequence, name)(view.side, view.frame)[rows]
        except RsbenchError:  # reported already
            continue
        made: FloatArray = getattr(truth, name)
        off = np.abs(stored.astype(np.float64) - made).reshape(*frame.depth.shape, -1).max(axis=-1)
        wrong: BoolArray = ~(off <= _UNIT)
        in_rows = np.isin(np.arange(sequence.shutter.height), np.asarray(rows)[np.any(wrong, axis=1)])
        bad = np.sum(wrong) > max(_FEW_AGAIN * wrong.size, _LEAST)
        what = f"{100 * np.mean(wrong):.2g} % of {wrong.size} pixels differ from what is made again"
        yield file, Finding(file, what, rows_of(in_rows)) if bad else None, bool(np.all(off == 0))


def _rows(wrong: BoolArray) -> str:
    """Words for the rows in which many of the wrong pixels lie."""
    share = np.mean(wrong, axis=1)
    return rows_of(share > 0.5 * np.max(share))
