"""Check the channels of points (``tracks``, ``affine``, ``matches``) by depth, row equation, images and rays."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import list_cards, parse_card
from rsbench.components.plugins import wrap
from rsbench.core.camera import inverse_2x2
from rsbench.core.correspondences import repeated
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import RSProjection, back_project, project_at, rs_project
from rsbench.core.rig import VIEWS, View
from rsbench.core.so3 import FloatArray
from rsbench.core.version import __version__
from rsbench.dataset.channels import AFFINE, MATCHER, TRACKS, matches_file
from rsbench.dataset.point_channels import (
    MATCHED,
    AffineFrames,
    Arranged,
    ArrayFile,
    LabelledMatches,
    MatchClass,
    Matching,
    MatchRays,
    PairLabels,
    Tracks,
    arranged,
    at,
    classes_of,
    jacobians_of,
    labelled,
    look_for,
    looks,
    make_affine,
    matched_frames,
    matcher_record,
    points_at,
    seen_near,
    track_views,
)
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, ImageView, PixelClass, Rays
from rsbench.verification.channel_checks import FEW_BENT, LEVEL
from rsbench.verification.compiled_comparison import DEPTH_TOLERANCE
from rsbench.verification.content import Content
from rsbench.verification.findings import Again, Finding, reports_unreadable, skips_unreadable
from rsbench.verification.reprojection import BoolArray, DepthMap, around, relative_depth
from rsbench.vision.feature_matcher import FEATURE_MATCHERS
from rsbench.vision.features import SiftMatcher

if TYPE_CHECKING:
    from rsbench.renderers.visibility import SceneRays

_SAME, _SAME_PX = 1e-9, 1e-6
"""Tolerances for equal points, relative, and equal pixels, px: rounding, and 1e-9 px at a small slope."""
_BEFORE, _BEHIND, _FEW = 1e-2, 1e-2, 0.15
"""Relative distance at which a point is in front of or behind the surfaces of all pixels around it; share of
points that may be so, because of objects thinner than a pixel, such as distant leaves and gaps between them."""
_NEARLY_ALL = 0.8
"""Share among such points with a wrong class that thin objects cannot explain."""
_FEW_AGAIN, _LEAST = 5e-3, 4


@reports_unreadable
def track_faults(content: Content, reported: Collection[str]) -> Iterator[Finding]:
    """Find faults of the tracks in the content's frames that depth maps and motion reveal.

    Files in ``reported`` are ignored.
    """
    sequence, maps = content.sequence, content.maps_without(reported)
    if "tracks" not in sequence.channels or TRACKS in reported:
        return
    tracks = sequence.tracks()
    if len(tracks.points) == 0 and any(np.any(each.depth) for each in content.maps.values()):
        yield Finding(TRACKS, "has no points")
    for k, view in enumerate(track_views(sequence.frames)):
        if view[1] not in content.times:
            continue
        image_view, name = ImageView("rs", *view), f"{view[0]}_{view[1]}"
        found = rs_project(sequence.rig, sequence.shutter, sequence.motion, *view, tracks.points)
        yield from _pixel_faults(sequence, tracks, k, found, name)
        if image_view in maps:
            yield from _source_faults(sequence, tracks, k, maps[image_view], name)
            yield from _hiding_faults(tracks, k, found, maps[image_view], name)


def _source_faults(sequence: Sequence, tracks: Tracks, k: int, depth: DepthMap, name: str) -> Iterator[Finding]:
    """Check that points equal those of the depth map at the whole pixels from which they were drawn."""
    own = tracks.sources == k
    pixels, points = tracks.pixels[own, k], tracks.points[own]
    inside = depth.camera.contains(pixels)[:, None]
    outside = ~np.all((pixels == np.round(pixels)) & inside, axis=1)
    if np.any(outside):
        yield Finding(TRACKS, f"{np.sum(outside)} points were drawn from no pixel of it", part=name)
        return
    X = points_at(sequence, depth.view[1:3], pixels, depth.depth)
    off = np.linalg.norm(points - X, axis=1) / np.maximum(np.linalg.norm(X, axis=1), 1e-9)
    if np.any(off > _SAME):
        ratio = float(np.median(np.linalg.norm(points, axis=1) / np.maximum(np.linalg.norm(X, axis=1), 1e-9)))
        scaled = np.median(np.linalg.norm(points - ratio * X, axis=1)) < 1e-6 and abs(ratio - 1) > _SAME
        cause = f"looks scaled by {ratio:.6g}" if scaled else ""
        what = f"{np.sum(off > _SAME)} of {len(X)} points differ from {depth.view.depth}"
        yield Finding(TRACKS, what, cause=cause, part=name)


def _pixel_faults(sequence: Sequence, tracks: Tracks, k: int, found: RSProjection, name: str) -> Iterator[Finding]:
    """Check that a track has a pixel exactly if a row shows the point, and that it is the pixel in that row."""
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
        ("are not at the pixel in their row", off > _SAME_PX),
    ):
        if np.any(bad):
            size = f", typically by {np.median(off[bad]):.2g} px" if words.startswith("are") else ""
            yield Finding(TRACKS, f"{np.sum(bad)} of {np.sum(known)} points {words}{size}", part=name)


def _hiding_faults(tracks: Tracks, k: int, found: RSProjection, depth: DepthMap, name: str) -> Iterator[Finding]:
    """Check that visible points are not behind all surfaces around them, and hidden ones not in front of all."""
    known = np.isfinite(found.tau) & (tracks.sources != k)
    low, high = depths_around(depth.depth, found.pixels[known])
    z, classes = found.depth[known], tracks.classes[known, k]
    for words, so, wrong in (
        ("are marked visible, but hidden according to", z > high * (1 + _BEHIND), PixelClass.VISIBLE),
        ("are marked hidden, but visible according to", z < low * (1 + _BEFORE), PixelClass.OCCLUDED),
    ):
        bad = int(np.sum(classes[so] == wrong))
        if bad > max(min(_FEW * np.sum(known), _NEARLY_ALL * np.sum(so)), _LEAST):
            yield Finding(TRACKS, f"{bad} of {np.sum(known)} points {words} {depth.view.depth}", part=name)


def depths_around(depth: NDArray[np.float32], pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest depth (n,) of the 4 x 4 pixels around pixels (n, 2); sky is infinitely far."""
    far = np.where(depth > 0, depth.astype(np.float64), np.inf)
    found = around(far, pixels, range(-1, 3))
    return np.min(found, axis=0, initial=np.inf), np.max(found, axis=0, initial=0.0)


def points_again(sequence: Sequence, rays: SceneRays, compared: Callable[[str], bool]) -> Iterator[Again]:
    """``channel_checks.channels_again`` for the channels of points; ``compared``: whether a file is."""
    if "tracks" in sequence.channels and compared(TRACKS):
        yield from _tracks_again(sequence, rays)
    if "affine" in sequence.channels and compared(AFFINE):
        yield from _affine_again(sequence, rays)
    if "matches" in sequence.channels:
        for first in filter(lambda each: compared(matches_file(each)), range(sequence.frames - 1)):
            yield from _matches_again(sequence, rays, first)


@skips_unreadable
def _tracks_again(sequence: Sequence, rays: Rays) -> Iterator[Again]:
    """Compute the visibility of tracks in each frame again by ray casting."""
    tracks = sequence.tracks()
    views = enumerate(track_views(sequence.frames))
    wrong: list[BoolArray] = [_classes_unlike(sequence, tracks, k, view, rays) for k, view in views]
    share = float(np.mean(wrong)) if len(tracks.points) else 0.0
    bad = np.sum(wrong) > max(_FEW_AGAIN * np.size(wrong), _LEAST)
    what = f"{100 * share:.2g} % of {np.size(wrong)} classes differ from ray casting"
    yield Again(TRACKS, Finding(TRACKS, what) if bad else None, not np.any(wrong))


def _classes_unlike(sequence: Sequence, tracks: Tracks, k: int, view: View, rays: Rays) -> BoolArray:
    _, _, classes = look_for(sequence, view, tracks.points, rays.blocked)
    return (classes != tracks.classes[:, k]) & (tracks.sources != k)


_UNIT = 1e-6
"""Tolerance of the length of a normal, as normals are rounded to float32."""
_SAME_DERIVATIVE = 1e-6
"""Tolerance of a derivative, relative to its largest entry: rounding of normals and rows at grazing angles."""
_FEW_WITHOUT_NORMAL = 0.02


@reports_unreadable
def affine_faults(content: Content, reported: Collection[str]) -> Iterator[Finding]:
    """Find faults of affine frames that tracks, depth maps and motion reveal; files in ``reported`` are ignored.

    Derivatives are checked once, with frame 0; normals are checked by the available maps.
    """
    sequence, maps = content.sequence, content.maps_without(reported)
    if "affine" not in sequence.channels or {AFFINE, TRACKS} & set(reported):
        return
    affine, tracks = sequence.affine(), sequence.tracks()
    if affine.jacobians.shape[:2] != tracks.tau.shape:
        shapes = f"{affine.jacobians.shape[:2]} points and views, but tracks.npz {tracks.tau.shape}"
        yield Finding(AFFINE, f"has {shapes}")
        return
    if 0 in content.times:
        yield from _jacobian_faults(sequence, affine, tracks)
    lost = np.all(affine.normals == 0.0, axis=1)
    off = ~lost & (np.abs(np.linalg.norm(affine.normals, axis=1) - 1.0) > _UNIT)
    if np.any(off) or np.sum(lost) > max(_FEW_WITHOUT_NORMAL * len(lost), _LEAST):
        yield Finding(AFFINE, f"{np.sum(off)} normals are not of length 1, and {np.sum(lost)} are 0")
        return
    for k, view in enumerate(track_views(sequence.frames)):
        image_view, own = ImageView("rs", *view), (tracks.sources == k) & ~lost
        if image_view in maps:
            yield from _normal_faults(sequence, maps[image_view], affine.normals[own], tracks.pixels[own, k])


def _jacobian_faults(sequence: Sequence, affine: AffineFrames, tracks: Tracks) -> Iterator[Finding]:
    made = jacobians_of(sequence, tracks, affine.normals)
    for k, (side, frame) in enumerate(track_views(sequence.frames)):
        own, stored = made[:, k], affine.jacobians[:, k]
        name = f"{side}_{frame}"
        empty = np.any(np.isnan(stored), axis=(1, 2)) != np.any(np.isnan(own), axis=(1, 2))
        if np.any(empty):
            yield Finding(
                AFFINE, f"{np.sum(empty)} derivatives are present without a pixel, or missing with one", part=name
            )
            continue
        size = np.maximum(np.max(np.abs(own), axis=(1, 2)), 1.0)[:, None, None]
        wrong = np.any(np.abs(stored - own) > _SAME_DERIVATIVE * size, axis=(1, 2))
        if np.any(wrong):
            what = f"{np.sum(wrong)} of {len(own)} derivatives are not those of plane, motion and row times"
            typical = np.median(np.max(np.abs(stored - own)[wrong], axis=(1, 2)))
            cause = _affine_cause(stored[wrong], own[wrong])
            yield Finding(AFFINE, f"{what}, typically by {typical:.2g}", cause=cause, part=name)


def _affine_cause(stored: FloatArray, made: FloatArray) -> str:
    """Text on the likely error of derivatives (n, 2, 2); "" if none explains most of them."""
    tried = {"transposed": np.swapaxes(stored, 1, 2), "x and y exchanged": stored[:, ::-1, ::-1]}
    tried["inverted"] = inverse_2x2(stored)
    near = {words: np.mean(np.all(np.abs(each - made) < 1e-3, axis=(1, 2))) for words, each in tried.items()}
    best = max(near, key=near.__getitem__)
    return f"looks {best}" if near[best] > 0.8 else ""


def _normal_faults(
    sequence: Sequence, depth: DepthMap, normals: FloatArray, pixels: FloatArray
) -> Iterator[Finding]:
    """Check that normals (n, 3) at whole pixels (n, 2) are perpendicular to flat surfaces."""
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
        what = f"{np.sum(bent)} of {len(x)} normals are not perpendicular to the surface of {depth.view.depth}"
        yield Finding(AFFINE, what, part=f"{depth.view.side}_{depth.view.frame}")


@skips_unreadable
def _affine_again(sequence: Sequence, rays: Rays) -> Iterator[Again]:
    """Compute the normals of affine frames again by ray casting."""
    stored, tracks = sequence.affine(), sequence.tracks()
    made = make_affine(sequence, tracks, rays)
    wrong = np.any(np.abs(made.normals - stored.normals) > 10 * _UNIT, axis=1)
    bad = np.sum(wrong) > max(_FEW_AGAIN * len(wrong), _LEAST)
    what = f"{np.sum(wrong)} of {len(wrong)} normals differ from ray casting"
    yield Again(AFFINE, Finding(AFFINE, what) if bad else None, _same_bits(made, stored, "normals", "jacobians"))


_BESIDE_ALL, _FEW_BESIDE = 1e-2, 0.15
"""Relative distance from the surfaces of all pixels around, and share of points that may lie beyond, because of
objects thinner than a pixel: keypoints are at edges."""
_FEW_OTHERS = 0.02
"""Share of matches that may differ on flat surfaces, if matched again on another processor, and by ray casting."""
_AGREES_PX = 1e-3
"""Tolerance of pixels computed again by ray casting, px, as depth is rounded to float32."""
Report = Callable[..., Finding]
"""Creates a finding for one pair of views from its text."""
_OURS = f"{SiftMatcher.__module__}:{SiftMatcher.__qualname__}"


@reports_unreadable
def match_faults(content: Content, reported: Collection[str]) -> Iterator[Finding]:
    """Find faults in the labels of the content's first frame and the next that depth maps and motion reveal.

    Files in ``reported`` are ignored.
    """
    sequence, maps, first = content.sequence, content.maps_without(reported), content.times[0]
    if "matches" not in sequence.channels:
        return
    matching = sequence.matching or Matching()
    yield from _record_faults(sequence, matching, reported)
    if (stored := matches_file(first)) in reported:
        return
    matches = sequence.matches(first)
    for k, (name, views) in enumerate(MATCHED.items()):
        source, target = (at(view, first) for view in views)
        part, found = matches.of_pair(k), partial(Finding, stored, part=name)
        ends = zip((source, target), np.moveaxis(part.pixels, 1, 0), strict=True)
        outside = ~np.all([sequence.rig.sensor(view[0]).contains(pixels) for view, pixels in ends], axis=0)
        if np.any(outside):
            yield found(f"{np.sum(outside)} matches have a keypoint outside the images")
            continue
        yield from _depth_faults(part, maps.get(ImageView("rs", *source)), found)
        yield from _truth_faults(sequence, part, source, target, found)
        yield from _class_faults(part, matching.bound_px, found)
        if (seen := maps.get(ImageView("rs", *target))) is not None:
            yield from _occlusion_faults(sequence, part, source, seen, found)


@reports_unreadable
def _record_faults(sequence: Sequence, matching: Matching, reported: Collection[str]) -> Iterator[Finding]:
    """Compare matcher.json with sequence.json, and with the card of that name if this version wrote it."""
    if MATCHER in reported:
        return
    record = sequence.matcher()
    own = record.get("versions") == _versions() and matching.features in list_cards("features")
    made = matcher_record(matching) if own else asdict(matching)
    for key, value in made.items():
        if record.get(key) != value:
            yield Finding(MATCHER, f"{key} = {record.get(key)!r}, but {value!r} by sequence.json and its matcher")
    versions = record.get("versions")
    if not isinstance(versions, dict) or not all(isinstance(versions.get(k), str) for k in ("rsbench", "opencv")):
        yield Finding(MATCHER, f"versions = {versions!r}: those of rsbench and opencv are needed")
    if not isinstance(record.get("class"), str) or not isinstance(record.get("parameters"), dict):
        yield Finding(MATCHER, "class and parameters of the matcher are needed")


def _depth_faults(part: PairLabels, seen: DepthMap | None, found: Report) -> Iterator[Finding]:
    """Check that a keypoint's depth is that of a flat surface around it, or between those of pixels around."""
    if seen is None:
        return
    sky = part.depth == 0.0
    ideal = seen.camera.ideal_pixels(part.pixels[:, 0])
    relative = relative_depth(seen, part.pixels[:, 0], part.depth, sky, ideal)
    low, high = depths_around(seen.depth, part.pixels[:, 0])
    z = np.where(sky, np.inf, part.depth)
    with np.errstate(invalid="ignore"):
        flat, beside = np.isfinite(relative), (z < low * (1 - _BESIDE_ALL)) | (z > high * (1 + _BESIDE_ALL))
        off = flat & (np.abs(relative) > DEPTH_TOLERANCE)
    for wrong, among, few in ((off, flat, _FEW_OTHERS), (beside, np.ones_like(flat), _FEW_BESIDE)):
        if np.sum(wrong) > max(few * np.sum(among), _LEAST):
            what = f"the depth of {np.sum(wrong)} of {np.sum(among)} keypoints is not that of {seen.view.depth}"
            ratio = float(np.median(1.0 + relative[off])) if np.any(off) else 1.0
            scaled = np.mean(np.abs(relative[off] + 1.0 - ratio) < DEPTH_TOLERANCE) > 0.5 if np.any(off) else False
            yield found(what, cause=f"looks scaled by {ratio:.6g}" if scaled else "")
            return


def _truth_faults(
    sequence: Sequence, part: PairLabels, source: View, target: View, found: Report
) -> Iterator[Finding]:
    """Check that true pixels satisfy the row equation, and that errors are the distances from them."""
    points = _points(sequence, part, source)
    _, tau, unsolved = seen_near(sequence, target, points, part.pixels[:, 1])
    known = np.all(np.isfinite(part.truth), axis=1)
    wrong = (known != np.isfinite(tau)) & ~unsolved
    if np.any(wrong):
        yield found(f"{np.sum(wrong)} of {len(wrong)} true pixels are wrongly in or out of view")
        return
    times = sequence.shutter.pixel_time(part.truth[known], target[1], target[0])
    exact = project_at(sequence.rig, sequence.motion, target[0], times, points[known])[:, :2]
    off = np.max(np.abs(part.truth[known] - exact), axis=1)
    if np.any(bad := ~(off <= _SAME_PX)):
        what = f"{np.sum(bad)} of {np.sum(known)} true pixels are not those of the point in their row"
        yield found(f"{what}, typically by {np.nanmedian(off[bad]):.2g} px")
    error = np.linalg.norm(part.pixels[:, 1] - part.truth, axis=1)
    if np.any(bad := ~((np.abs(error - part.error) <= _SAME) | (np.isnan(error) & np.isnan(part.error)))):
        yield found(f"{np.sum(bad)} of {len(bad)} errors are not the distance from the true pixel")


def _class_faults(part: PairLabels, bound_px: float, found: Report) -> Iterator[Finding]:
    """Check that classes follow from errors."""
    hidden = part.classes == MatchClass.OCCLUDED
    unsolved = part.classes == MatchClass.UNSOLVED
    made = classes_of(part.pixels, part.depth, part.truth, hidden, unsolved, bound_px)
    if np.any(made != part.classes):
        what = f"{np.sum(made != part.classes)} of {len(made)} classes do not follow from error and depth"
        yield found(f"{what}, with a bound of {bound_px:g} px")


def _occlusion_faults(
    sequence: Sequence, part: PairLabels, source: View, target: DepthMap, found: Report
) -> Iterator[Finding]:
    """Check that only hidden points lie behind the target's surfaces."""
    view, seen = target.view, np.isfinite(part.error) & (part.depth > 0.0)
    hidden = part.classes == MatchClass.OCCLUDED
    points, places = _points(sequence, part, source)[seen], part.truth[seen]
    times = sequence.shutter.pixel_time(places, view.frame, view.side)
    z = project_at(sequence.rig, sequence.motion, view.side, times, points)[:, 2]
    low, high = depths_around(target.depth, places)
    for words, so, wrong in (
        ("are marked visible, but hidden according to", z > high * (1 + _BESIDE_ALL), ~hidden[seen]),
        ("are marked hidden, but visible according to", z < low * (1 + _BESIDE_ALL), hidden[seen]),
    ):
        # If few points are hidden, objects thinner than a pixel may hide all of them.
        if np.sum(so & wrong) > max(_FEW_BESIDE * np.sum(so), _FEW_OTHERS * np.sum(seen), _LEAST):
            yield found(f"{np.sum(so & wrong)} of {np.sum(seen)} points {words} {view.depth}")


def _points(sequence: Sequence, part: PairLabels, source: View) -> FloatArray:
    """World points (n, 3) of the first keypoints; those in the sky are placed at ``FAR``."""
    eyes, ahead = looks(sequence, source, part.pixels[:, 0])
    return eyes + np.where(part.depth > 0.0, part.depth, FAR)[:, None] * (ahead - eyes)


def matched_again(
    sequence: Sequence, reported: Collection[str], first: int = 0
) -> tuple[list[Finding], list[str]]:
    """Match the images again; returns faults of matches that are not found, and a note if this was not possible.

    Only rsbench's own matcher is run, in the recorded versions: a class that a dataset names is never imported.
    """
    images_of, file = [ImageView("rs", *at(view, first)) for view in VIEWS], matches_file(first)
    if "matches" not in sequence.channels or {*(each.image for each in images_of), file, MATCHER} & set(reported):
        return [], []
    try:
        stored, record = sequence.matches(first), sequence.matcher()
        if record.get("class") != _OURS or record.get("versions") != _versions():
            return [], [str(Finding(file, "not matched again: another matcher or version made it"))]
        component = parse_card(SiftMatcher, record["parameters"], f"{MATCHER}: parameters")
        images = {each[1:3]: sequence.image(*each) for each in images_of}
        found = matched_frames(sequence, first, images, wrap(FEATURE_MATCHERS, component))
    except RsbenchError as error:
        return [Finding.of(error)], []
    return list(_unlike_faults(file, stored, arranged(found))), []


def _versions() -> dict[str, str]:
    return {"rsbench": __version__, "opencv": str(cv2.__version__)}


def _unlike_faults(file: str, stored: LabelledMatches, found: Arranged) -> Iterator[Finding]:
    for k, name in enumerate(MATCHED):
        ours, theirs = (each.pixels[each.sets == k].reshape(-1, 4) for each in (found, stored))
        strange, missing = np.sum(~repeated(theirs, ours)), np.sum(~repeated(ours, theirs))
        if strange + missing > max(_FEW_OTHERS * (len(ours) + len(theirs)), _LEAST):
            what = f"{strange} of {len(theirs)} matches are not found in the images, and {missing} others are"
            yield Finding(file, what, part=name)


@skips_unreadable
def _matches_again(sequence: Sequence, rays: MatchRays, first: int) -> Iterator[Again]:
    """Label the matches of frame ``first`` and the next again by ray casting."""
    stored, file = sequence.matches(first), matches_file(first)
    as_given = Arranged(stored.sets, stored.tracks, stored.pixels)
    made = labelled(sequence, first, as_given, (sequence.matching or Matching()).bound_px, rays)
    with np.errstate(invalid="ignore"):
        near = np.abs(made.error - stored.error) <= _AGREES_PX
    alike = (made.classes == stored.classes) & (near | (np.isnan(made.error) & np.isnan(stored.error)))
    wrong = int(np.sum(~alike))
    what = f"{wrong} of {len(alike)} labels differ from ray casting"
    bad = wrong > max(_FEW_OTHERS * len(alike), _LEAST)
    same = _same_bits(made, stored, "depth", "truth", "classes")
    yield Again(file, Finding(file, what) if bad else None, same)


def _same_bits(made: ArrayFile, stored: ArrayFile, *names: str) -> bool:
    return all(np.array_equal(getattr(made, name), getattr(stored, name), equal_nan=True) for name in names)
