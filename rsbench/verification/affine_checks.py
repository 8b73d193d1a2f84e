"""The channel ``affine`` against tracks, depth maps, the row equation and rays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from rsbench.core.camera import inverse_2x2
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import back_project
from rsbench.core.rig import FRAMES
from rsbench.core.so3 import FloatArray
from rsbench.dataset.affine import AffineFrames, Meets, jacobians_of, make_affine
from rsbench.dataset.channels import AFFINE, TRACKS
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.tracks import Tracks, track_views
from rsbench.dataset.views import ImageView
from rsbench.verification.findings import Finding
from rsbench.verification.frame_comparison import DepthMap
from rsbench.verification.surface_checks import FEW_BENT, LEVEL

_UNIT = 1e-6
"""Of a length: normals are rounded to float32."""
_SAME = 1e-6
"""Of a derivative, relative to its largest entry: what rounding of normals and rows leaves at a grazing view."""
_FEW_AGAIN, _FEW_LOST, _LEAST = 5e-3, 0.02, 4


def affine_faults(
    sequence: Sequence,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    times: tuple[int, ...] = FRAMES,
) -> Iterator[Finding]:
    """What affine frames show that tracks, depth maps and motion cannot have made, but for files ``reported``.

    Derivatives are looked at once, with frame 0 among these ``times``; normals with the maps that there are.
    """
    if "affine" not in sequence.channels or {AFFINE, TRACKS} & set(reported):
        return
    try:
        affine, tracks = sequence.affine(), sequence.tracks()
    except RsbenchError as error:
        yield Finding.of(error)
        return
    if affine.jacobians.shape[:2] != tracks.tau.shape:
        yield Finding(AFFINE, f"is of {affine.jacobians.shape[:2]} points and views, tracks of {tracks.tau.shape}")
        return
    if 0 in times:
        yield from _jacobian_faults(sequence, affine, tracks)
    lost = np.all(affine.normals == 0.0, axis=1)
    off = ~lost & (np.abs(np.linalg.norm(affine.normals, axis=1) - 1.0) > _UNIT)
    if np.any(off) or np.sum(lost) > max(_FEW_LOST * len(lost), _LEAST):
        yield Finding(AFFINE, f"{np.sum(off)} normals are not of length 1, and {np.sum(lost)} are 0")
        return
    for k, view in enumerate(track_views(sequence.frames)):
        image_view, own = ImageView("rs", *view), (tracks.sources == k) & ~lost
        if image_view in maps and image_view.depth not in reported:
            yield from _normal_faults(sequence, maps[image_view], affine.normals[own], tracks.pixels[own, k])


def _jacobian_faults(sequence: Sequence, affine: AffineFrames, tracks: Tracks) -> Iterator[Finding]:
    made = jacobians_of(sequence, tracks, affine.normals)
    for k, (side, frame) in enumerate(track_views(sequence.frames)):
        own, stored = made[:, k], affine.jacobians[:, k]
        name = f"{side}_{frame}"
        empty = np.any(np.isnan(stored), axis=(1, 2)) != np.any(np.isnan(own), axis=(1, 2))
        if np.any(empty):
            yield Finding(
                AFFINE, f"{np.sum(empty)} derivatives are there without a pixel, or lack with one", part=name
            )
            continue
        size = np.maximum(np.max(np.abs(own), axis=(1, 2)), 1.0)[:, None, None]
        wrong = np.any(np.abs(stored - own) > _SAME * size, axis=(1, 2))
        if np.any(wrong):
            what = f"{np.sum(wrong)} of {len(own)} derivatives are not those of plane, motion and row times"
            typical = np.median(np.max(np.abs(stored - own)[wrong], axis=(1, 2)))
            cause = _cause(stored[wrong], own[wrong])
            yield Finding(AFFINE, f"{what}, typically by {typical:.2g}", cause=cause, part=name)


def _cause(stored: FloatArray, made: FloatArray) -> str:
    """What derivatives (n, 2, 2) are instead, in words; "" where nothing explains most of them."""
    tried = {"transposed": np.swapaxes(stored, 1, 2), "x and y exchanged": stored[:, ::-1, ::-1]}
    tried["inverted"] = inverse_2x2(stored)
    near = {words: np.mean(np.all(np.abs(each - made) < 1e-3, axis=(1, 2))) for words, each in tried.items()}
    best = max(near, key=near.__getitem__)
    return f"looks {best}" if near[best] > 0.8 else ""


def _normal_faults(
    sequence: Sequence, depth: DepthMap, normals: FloatArray, pixels: FloatArray
) -> Iterator[Finding]:
    """Normals (n, 3) at whole pixels (n, 2) stand upright on the surface around them, where it is flat."""
    x, y = pixels.astype(np.int64).T
    flat = depth.flat[y, x]
    x, y, normals = x[flat], y[flat], normals[flat]

    def seen(across: int, down: int) -> FloatArray:
        place, z = np.stack([x + across, y + down], axis=-1), depth.depth[y + down, x + across]
        args = sequence.rig, sequence.shutter, sequence.motion, depth.view.side, depth.view.frame
        return back_project(*args, place, z)

    bent = np.zeros(len(x), dtype=np.bool_)
    for step in (seen(1, 0) - seen(-1, 0), seen(0, 1) - seen(0, -1)):
        bent |= np.abs(np.sum(step * normals, axis=-1)) > LEVEL * np.linalg.norm(step, axis=-1)
    if np.sum(bent) > max(FEW_BENT * len(x), _LEAST):
        what = f"{np.sum(bent)} of {len(x)} normals are not upright on the surface of {depth.view.depth}"
        yield Finding(AFFINE, what, part=f"{depth.view.side}_{depth.view.frame}")


def affine_again(
    sequence: Sequence, rays: Meets, reported: Collection[str]
) -> Iterator[tuple[str, Finding | None, bool]]:
    """As ``channel_checks.channels_again``, of affine frames: what rays meet at the points of the tracks."""
    if "affine" not in sequence.channels or {AFFINE, TRACKS} & set(reported):
        return
    try:
        stored, tracks = sequence.affine(), sequence.tracks()
    except RsbenchError:  # reported already
        return
    made = make_affine(sequence, tracks, rays)
    wrong = np.any(np.abs(made.normals - stored.normals) > 10 * _UNIT, axis=1)
    bad = np.sum(wrong) > max(_FEW_AGAIN * len(wrong), _LEAST)
    what = f"{np.sum(wrong)} of {len(wrong)} normals differ from what rays meet"
    names = ("normals", "jacobians")
    same = all(np.array_equal(getattr(made, k), getattr(stored, k), equal_nan=True) for k in names)
    yield AFFINE, Finding(AFFINE, what) if bad else None, same
