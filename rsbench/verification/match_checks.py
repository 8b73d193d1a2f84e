"""The channel ``matches`` against depth maps, the row equation, the pictures and rays."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict
from functools import partial

import cv2
import numpy as np

from rsbench.components.cards import list_cards, parse_card
from rsbench.components.plugins import wrap
from rsbench.core.correspondences import repeated
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import project_at
from rsbench.core.rig import VIEWS, View
from rsbench.core.so3 import FloatArray
from rsbench.core.version import __version__
from rsbench.dataset.channels import MATCHER, matches_file
from rsbench.dataset.match_truth import (
    Arranged,
    Meets,
    arranged,
    at,
    classes_of,
    labelled,
    looks,
    matched_frames,
    matcher_record,
    seen_near,
)
from rsbench.dataset.matches import MATCHED, LabelledMatches, MatchClass, Matching, PairLabels
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, ImageView
from rsbench.verification.findings import Finding
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, DepthMap, relative_depth
from rsbench.verification.track_checks import depths_around
from rsbench.vision.feature_matcher import FEATURE_MATCHERS
from rsbench.vision.features import SiftMatcher

_SAME, _SAME_PX = 1e-9, 1e-6
"""Of distances, and px: roundings, and the 1e-9 px to which rows are solved over a small slope."""
_BESIDE, _FEW_BESIDE = 1e-2, 0.15
"""Relative distance from all that the pixels around see, and the share of what may lie beyond, by things thinner
than a pixel: keypoints sit at edges."""
_FEW_OTHERS, _LEAST = 0.02, 4
"""Of what is compared on flat surfaces, with what is matched again on another processor, and with other rays."""
_AGREES_PX = 1e-3
"""Of places made again by rays: depth is rounded to float32."""
Report = Callable[..., Finding]
"""Makes findings of one pair of views, from their words."""
_OURS = f"{SiftMatcher.__module__}:{SiftMatcher.__qualname__}"


def match_faults(
    sequence: Sequence, maps: Mapping[ImageView, DepthMap], reported: Collection[str], first: int = 0
) -> Iterator[Finding]:
    """What the labels of frame ``first`` and the next show that depth maps and motion cannot have made.

    But for files ``reported``.
    """
    if "matches" not in sequence.channels:
        return
    matching = sequence.matching or Matching()
    yield from _record_faults(sequence, matching, reported)
    if (stored := matches_file(first)) in reported:
        return
    try:
        matches = sequence.matches(first)
    except RsbenchError as error:
        yield Finding.of(error)
        return
    for k, (name, views) in enumerate(MATCHED.items()):
        source, target = (at(view, first) for view in views)
        part, found = matches.of_pair(k), partial(Finding, stored, part=name)
        outside = ~sequence.rig.camera.contains(part.pixels).all(axis=1)
        if np.any(outside):
            yield found(f"{np.sum(outside)} matches have a keypoint beside the images")
            continue
        yield from _depth_faults(sequence, part, source, maps, reported, found)
        yield from _truth_faults(sequence, part, source, target, found)
        yield from _class_faults(sequence, part, source, target, maps, reported, matching.bound_px, found)


def _record_faults(sequence: Sequence, matching: Matching, reported: Collection[str]) -> Iterator[Finding]:
    """matcher.json against sequence.json, and against the card of the same name where this version wrote it."""
    if MATCHER in reported:
        return
    try:
        record = sequence.matcher()
    except RsbenchError as error:
        yield Finding.of(error)
        return
    own = record.get("versions") == _versions() and matching.features in list_cards("features")
    made = matcher_record(matching) if own else asdict(matching)
    for key, value in made.items():
        if record.get(key) != value:
            yield Finding(MATCHER, f"{key} = {record.get(key)!r}, sequence.json and its matcher say {value!r}")
    versions = record.get("versions")
    if not isinstance(versions, dict) or not all(isinstance(versions.get(k), str) for k in ("rsbench", "opencv")):
        yield Finding(MATCHER, f"versions = {versions!r}: those of rsbench and opencv are needed")
    if not isinstance(record.get("class"), str) or not isinstance(record.get("parameters"), dict):
        yield Finding(MATCHER, "class and parameters of the matcher are needed")


def _depth_faults(
    sequence: Sequence,
    part: PairLabels,
    source: View,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    found: Report,
) -> Iterator[Finding]:
    """The depth of keypoints is that of the flat surface around them, or between those of the pixels around."""
    view = ImageView("rs", *source)
    if view not in maps or view.depth in reported:
        return
    sky = part.depth == 0.0
    relative = relative_depth(maps[view], part.pixels[:, 0], part.depth, sky)
    low, high = depths_around(maps[view].depth, part.pixels[:, 0])
    z = np.where(sky, np.inf, part.depth)
    with np.errstate(invalid="ignore"):
        flat, beside = np.isfinite(relative), (z < low * (1 - _BESIDE)) | (z > high * (1 + _BESIDE))
        off = flat & (np.abs(relative) > DEPTH_TOLERANCE)
    for wrong, among, few in ((off, flat, _FEW_OTHERS), (beside, np.ones_like(flat), _FEW_BESIDE)):
        if np.sum(wrong) > max(few * np.sum(among), _LEAST):
            what = f"the depth of {np.sum(wrong)} of {np.sum(among)} keypoints is not that of {view.depth}"
            ratio = float(np.median(1.0 + relative[off])) if np.any(off) else 1.0
            scaled = np.mean(np.abs(relative[off] + 1.0 - ratio) < DEPTH_TOLERANCE) > 0.5 if np.any(off) else False
            yield found(what, cause=f"looks scaled by {ratio:.6g}" if scaled else "")
            return


def _truth_faults(
    sequence: Sequence, part: PairLabels, source: View, target: View, found: Report
) -> Iterator[Finding]:
    """True places are those where a row sees the point at its own time, and errors the distances from them."""
    points = _points(sequence, part, source)
    _, tau, unsolved = seen_near(sequence, target, points, part.pixels[:, 1])
    known = np.all(np.isfinite(part.truth), axis=1)
    wrong = (known != np.isfinite(tau)) & ~unsolved
    if np.any(wrong):
        yield found(f"{np.sum(wrong)} of {len(wrong)} true places are wrongly in or out of view")
        return
    times = sequence.shutter.pixel_time(part.truth[known], target[1], target[0])
    exact = project_at(sequence.rig, sequence.motion, target[0], times, points[known])[:, :2]
    off = np.max(np.abs(part.truth[known] - exact), axis=1)
    if np.any(~(off <= _SAME_PX)):
        what = (
            f"{np.sum(~(off <= _SAME_PX))} of {np.sum(known)} true places are not where their row sees the point"
        )
        yield found(f"{what}, typically by {np.nanmedian(off[~(off <= _SAME_PX)]):.2g} px")
    error = np.linalg.norm(part.pixels[:, 1] - part.truth, axis=1)
    if np.any(bad := ~((np.abs(error - part.error) <= _SAME) | (np.isnan(error) & np.isnan(part.error)))):
        yield found(f"{np.sum(bad)} of {len(bad)} errors are not the distance from the true place")


def _class_faults(
    sequence: Sequence,
    part: PairLabels,
    source: View,
    target: View,
    maps: Mapping[ImageView, DepthMap],
    reported: Collection[str],
    bound_px: float,
    found: Report,
) -> Iterator[Finding]:
    """Classes are those of the errors; hidden points lie behind what the target sees, others do not."""
    hidden = part.classes == MatchClass.OCCLUDED
    unsolved = part.classes == MatchClass.UNSOLVED
    made = classes_of(part.pixels, part.depth, part.truth, hidden, unsolved, bound_px)
    if np.any(made != part.classes):
        what = f"{np.sum(made != part.classes)} of {len(made)} classes are not what error and depth make"
        yield found(f"{what}, within {bound_px:g} px")
    view, seen = ImageView("rs", *target), np.isfinite(part.error) & (part.depth > 0.0)
    if view not in maps or view.depth in reported:
        return
    points, places = _points(sequence, part, source)[seen], part.truth[seen]
    times = sequence.shutter.pixel_time(places, target[1], target[0])
    z = project_at(sequence.rig, sequence.motion, target[0], times, points)[:, 2]
    low, high = depths_around(maps[view].depth, places)
    for words, so, wrong in (
        ("are in sight, but hidden by", z > high * (1 + _BESIDE), ~hidden[seen]),
        ("are hidden, but in sight by", z < low * (1 + _BESIDE), hidden[seen]),
    ):
        # Where few points are hidden, all of them may be by things thinner than a pixel.
        if np.sum(so & wrong) > max(_FEW_BESIDE * np.sum(so), _FEW_OTHERS * np.sum(seen), _LEAST):
            yield found(f"{np.sum(so & wrong)} of {np.sum(seen)} points {words} {view.depth}")


def _points(sequence: Sequence, part: PairLabels, source: View) -> FloatArray:
    """World points (n, 3) that the first keypoints see; those in the sky far away."""
    eyes, ahead = looks(sequence, source, part.pixels[:, 0])
    return eyes + np.where(part.depth > 0.0, part.depth, FAR)[:, None] * (ahead - eyes)


def matched_again(
    sequence: Sequence, reported: Collection[str], first: int = 0
) -> tuple[list[Finding], list[str]]:
    """Faults of matches that the stated matcher does not find in the pictures, and notes where it was not asked.

    Only rsbench's own matcher is asked, in the versions that made them: what a dataset names is never imported.
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


def matches_again(
    sequence: Sequence, first: int, rays: Meets, reported: Collection[str]
) -> Iterator[tuple[str, Finding | None, bool]]:
    """As ``channel_checks.channels_again``, of matches of frame ``first`` and the next: what rays say of each."""
    if "matches" not in sequence.channels or (file := matches_file(first)) in reported:
        return
    try:
        stored = sequence.matches(first)
    except RsbenchError:  # reported already
        return
    as_given = Arranged(stored.sets, stored.tracks, stored.pixels)
    made = labelled(sequence, first, as_given, (sequence.matching or Matching()).bound_px, rays)
    with np.errstate(invalid="ignore"):
        near = np.abs(made.error - stored.error) <= _AGREES_PX
    alike = (made.classes == stored.classes) & (near | (np.isnan(made.error) & np.isnan(stored.error)))
    wrong = int(np.sum(~alike))
    what = f"{wrong} of {len(alike)} labels differ from what rays say"
    names = ("depth", "truth", "classes")
    same = all(np.array_equal(getattr(made, k), getattr(stored, k), equal_nan=True) for k in names)
    yield file, Finding(file, what) if wrong > max(_FEW_OTHERS * len(alike), _LEAST) else None, same
