"""The channel ``tracks`` against the depth maps, the row equation and rays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.projection import RSProjection, project_at, rs_project
from rsbench.core.rig import FRAMES, View
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channel_truth import Rays
from rsbench.dataset.channels import TRACKS, PixelClass
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.tracks import Tracks, look_for, points_at, track_views
from rsbench.dataset.views import ImageView
from rsbench.verification.findings import Finding
from rsbench.verification.frame_comparison import BoolArray, DepthMap

_SAME, _SAME_PX = 1e-9, 1e-6
"""Relative distance of points, and px: roundings, and the 1e-9 px to which rows are solved over a small slope."""
_BEFORE, _BEHIND, _FEW = 1e-2, 1e-2, 0.15
"""Relative distance beyond which a point is before or behind all that the pixels around it see; the share that may
be, by what is thinner than a pixel: leaves far away, and gaps between them."""
_NEARLY_ALL = 0.8
"""Of the points that lie so, the share whose class cannot be such leaves' and gaps' doing."""
_FEW_AGAIN, _LEAST = 5e-3, 4


def track_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    times: tuple[int, ...] = FRAMES,
) -> Iterator[Finding]:
    """What the tracks show in frames at these times that depth maps and motion cannot have made.

    But for files ``reported``.
    """
    if "tracks" not in sequence.channels or TRACKS in reported:
        return
    try:
        tracks = sequence.tracks()
    except RsbenchError as error:
        yield Finding.of(error)
        return
    if len(tracks.points) == 0 and any(np.any(each.depth) for each in maps.values()):
        yield Finding(TRACKS, "has no points")
    for k, view in enumerate(track_views(sequence.frames)):
        if view[1] not in times:
            continue
        image_view, name = ImageView("rs", *view), f"{view[0]}_{view[1]}"
        found = rs_project(sequence.rig, sequence.shutter, sequence.motion, *view, tracks.points)
        yield from _pixel_faults(sequence, tracks, k, found, name)
        if image_view in maps and image_view.depth not in reported:
            yield from _source_faults(sequence, tracks, k, maps[image_view], name)
            yield from _hiding_faults(tracks, k, found, maps[image_view], name)


def _source_faults(sequence: Sequence, tracks: Tracks, k: int, depth: DepthMap, name: str) -> Iterator[Finding]:
    """Points are those of the depth map at the whole pixels from which they were drawn."""
    own = tracks.sources == k
    pixels, points = tracks.pixels[own, k], tracks.points[own]
    outside = ~np.all((pixels == np.round(pixels)) & sequence.rig.camera.contains(pixels)[:, None], axis=1)
    if np.any(outside):
        yield Finding(TRACKS, f"{np.sum(outside)} points were drawn from no pixel of it", part=name)
        return
    X = points_at(sequence, depth.view[1:3], pixels, depth.depth)
    off = np.linalg.norm(points - X, axis=1) / np.maximum(np.linalg.norm(X, axis=1), 1e-9)
    if np.any(off > _SAME):
        ratio = float(np.median(np.linalg.norm(points, axis=1) / np.maximum(np.linalg.norm(X, axis=1), 1e-9)))
        scaled = np.median(np.linalg.norm(points - ratio * X, axis=1)) < 1e-6 and abs(ratio - 1) > _SAME
        cause = f"looks scaled by {ratio:.6g}" if scaled else ""
        what = f"{np.sum(off > _SAME)} of {len(X)} points are not what {depth.view.depth} sees"
        yield Finding(TRACKS, what, cause=cause, part=name)


def _pixel_faults(sequence: Sequence, tracks: Tracks, k: int, found: RSProjection, name: str) -> Iterator[Finding]:
    """Known where and only where a row sees the point; and where that row sees it."""
    pixels, tau, classes = tracks.pixels[:, k], tracks.tau[:, k], tracks.classes[:, k]
    view = track_views(sequence.frames)[k]
    known, own = np.isin(classes, (PixelClass.VISIBLE, PixelClass.OCCLUDED)), tracks.sources == k
    seen = np.isfinite(found.tau)
    wrong = (known != np.all(np.isfinite(pixels), axis=1)) | (known != (seen | own)) | (known != np.isfinite(tau))
    if np.any(wrong):
        yield Finding(TRACKS, f"{np.sum(wrong)} points are wrongly in or out of view", part=name)
        return
    late = np.abs(tau[known] - sequence.shutter.pixel_time(pixels[known], view[1], view[0])) > _SAME
    exact = project_at(sequence.rig, sequence.motion, view[0], tau[known], tracks.points[known])[:, :2]
    off = np.max(np.abs(pixels[known] - exact), axis=1)
    for words, bad in (
        ("have another time than their row", late),
        ("are not where their row sees them", off > _SAME_PX),
    ):
        if np.any(bad):
            size = f", typically by {np.median(off[bad]):.2g} px" if words.startswith("are") else ""
            yield Finding(TRACKS, f"{np.sum(bad)} of {np.sum(known)} points {words}{size}", part=name)


def _hiding_faults(tracks: Tracks, k: int, found: RSProjection, depth: DepthMap, name: str) -> Iterator[Finding]:
    """Visible points are not far behind the pixels around them, hidden ones not before all of them."""
    known = np.isfinite(found.tau) & (tracks.sources != k)
    low, high = depths_around(depth.depth, found.pixels[known])
    z, classes = found.depth[known], tracks.classes[known, k]
    for words, so, wrong in (
        ("are visible, but hidden by", z > high * (1 + _BEHIND), PixelClass.VISIBLE),
        ("are hidden, but visible by", z < low * (1 + _BEFORE), PixelClass.OCCLUDED),
    ):
        bad = int(np.sum(classes[so] == wrong))
        if bad > max(min(_FEW * np.sum(known), _NEARLY_ALL * np.sum(so)), _LEAST):
            yield Finding(TRACKS, f"{bad} of {np.sum(known)} points {words} {depth.view.depth}", part=name)


def depths_around(depth: NDArray[np.float32], pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and largest depth (n,) of the 4 x 4 pixels around pixels (n, 2); sky is infinitely far."""
    far = np.where(depth > 0, depth.astype(np.float64), np.inf)
    x, y = np.floor(pixels).astype(np.int64).T
    height, width = depth.shape
    steps = range(-1, 3)
    around = [
        far[np.clip(y + down, 0, height - 1), np.clip(x + across, 0, width - 1)]
        for down in steps
        for across in steps
    ]
    return np.min(around, axis=0, initial=np.inf), np.max(around, axis=0, initial=0.0)


def tracks_again(
    sequence: Sequence, rays: Rays, reported: Collection[str]
) -> Iterator[tuple[str, Finding | None, bool]]:
    """As ``channel_checks.channels_again``, of tracks: what rays say of each frame."""
    if "tracks" not in sequence.channels or TRACKS in reported:
        return
    try:
        tracks = sequence.tracks()
    except RsbenchError:  # reported already
        return
    views = enumerate(track_views(sequence.frames))
    wrong: list[BoolArray] = [_unlike(sequence, tracks, k, view, rays) for k, view in views]
    share = float(np.mean(wrong)) if len(tracks.points) else 0.0
    bad = np.sum(wrong) > max(_FEW_AGAIN * np.size(wrong), _LEAST)
    what = f"{100 * share:.2g} % of {np.size(wrong)} classes differ from what rays say"
    yield TRACKS, Finding(TRACKS, what) if bad else None, not np.any(wrong)


def _unlike(sequence: Sequence, tracks: Tracks, k: int, view: View, rays: Rays) -> BoolArray:
    _, _, classes = look_for(sequence, view, tracks.points, rays.blocked)
    return (classes != tracks.classes[:, k]) & (tracks.sources != k)
