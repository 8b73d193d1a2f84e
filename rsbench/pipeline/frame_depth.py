"""What decides the correction of four frames, apart from the frames and the rig."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.components.imports import component_key
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.corrector import CorrectorEntry, load_corrector
from rsbench.vision.epipolar_search import depth_from_motion
from rsbench.vision.feature_matcher import FeatureEntry, load_features
from rsbench.vision.images import eight_bit
from rsbench.vision.stereo_depth import SgmMatcher, fill_holes, moving_disparities, sky_mask, timed_depth
from rsbench.vision.stereo_matcher import (
    MatcherEntry,
    body_depth,
    find_depths,
    load_matcher,
    needs_motion,
    own_depths,
    sensor_disparities,
)


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """The four components of the chain, each of which may be anybody's, and what happens between them."""

    features: FeatureEntry = field(default_factory=lambda: load_features("sift-refined"))
    """Finds the matches that the motion is solved from; commands take ``dense``, boards and studies this one."""
    solver: SolverEntry = field(default_factory=lambda: load_solver_entry("rs-stereo-refined"))
    """Any solver that gives the length of d."""
    matcher: MatcherEntry = field(default_factory=lambda: load_matcher("sgm"))
    """Finds depth."""
    corrector: CorrectorEntry = field(default_factory=lambda: load_corrector("fusion"))
    robust: RobustOptions = field(default_factory=RobustOptions)
    motion_model: str | None = None
    """``auto`` or a model to use instead of the solver's, see ``rsbench.capture.model_choice``."""
    target_row: float = 0.0
    """The time of this row of the frame is the time of its corrected image."""
    one_time: bool = False
    """Whether the right camera's corrected image is of the left one's time, where theirs differ."""
    depth_from_motion: bool = True
    """Where the other camera gives no depth, take it from the flow to the other frame and the motion."""
    find_sky: bool = True
    inpaint: bool = False
    """Invent pixels that no frame shows; they stay marked."""
    seed: int = 0

    def faster(self) -> CorrectionOptions:
        """The same sooner: matches and depth at half the size, and no depth from the motion.

        Raises:
            RsbenchError: features or matcher are not ours, which know no other size.
        """
        entries: dict[str, Any] = {"features": self.features, "matcher": self.matcher}
        sgm = self.matcher.component
        faster = {
            "features": self.features.component.faster(),
            "matcher": replace(sgm, half=True) if isinstance(sgm, SgmMatcher) else None,
        }
        for option, component in faster.items():
            entry = entries[option]
            if component is None:
                raise RsbenchError(f"--fast: {option} {entry.name!r} cannot work at half the size; leave one out")
            entries[option] = replace(entry, component=component, key=component_key(component, {}))
        return replace(self, depth_from_motion=False, **entries)

    @property
    def components(self) -> dict[str, Entry[Any, Any]]:
        """The four components by the name of their option."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Entry)}

    @property
    def key(self) -> str:
        """Hash of all that decides a result: options of equal keys give equal frames."""
        values = {name: getattr(self, name) for name in sorted(option.name for option in fields(self))}
        parts = [f"{name}={value.key if isinstance(value, Entry) else value!r}" for name, value in values.items()]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


# Depth of the frames of a rig: from the other camera, sky, from the motion, and guesses for the rest.


Images = Mapping[View, NDArray[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePair:
    """One time of the rig: both images with their depth."""

    images: dict[Side, NDArray[Any]]
    depth: dict[Side, NDArray[np.float32]]
    """(H, W) metres in each row's own camera; inf in the sky and at no disparity, 0 unknown."""
    guess: dict[Side, NDArray[np.float32]]
    """(H, W) the same where ``depth`` is unknown, from the neighbours; 0 elsewhere."""
    with_motion: bool = False
    """Whether the depth that the motion gives is in it already."""
    timed: bool = True
    """Whether the depth counts that both cameras saw a point at two times; only with a lens they differ."""


Pairs = tuple[FramePair, FramePair]
"""Frame 0 and frame 1."""


def frame_pair(
    left: NDArray[Any],
    right: NDArray[Any],
    rig: StereoRig,
    options: CorrectionOptions,
    disparity_offset: float = 0.0,
) -> FramePair:
    """Depth of both images (H, W[, 3]), uint8 or uint16, of one time, on the pixels that they have.

    ``disparity_offset``: what a disparity is too large by, px.

    Raises:
        RsbenchError: another package's matcher failed, see ``find_disparities``.
    """
    levels = eight_bit([left, right])
    both = sensor_disparities(options.matcher, levels[0], levels[1], rig)
    if disparity_offset:
        both = (both[0] - np.float32(disparity_offset), both[1] - np.float32(disparity_offset))
    return depth_of_pair(left, right, both, rig, find_sky=options.find_sky)


def depth_of_pair(
    left: NDArray[Any],
    right: NDArray[Any],
    both: Sequence[NDArray[np.float32]],
    rig: StereoRig,
    *,
    find_sky: bool,
) -> FramePair:
    """Depth from the disparities (H, W), NaN where unknown, of both images (H, W[, 3]) of one time.

    With a lens it is that of a rig at rest: ``timed_pairs`` makes it that of a moving one.

    ``find_sky``: put at infinity what looks like the sky.
    """
    images = dict(zip(SIDES, (left, right), strict=True))
    levels = dict(zip(SIDES, eight_bit([left, right]), strict=True))
    disparities = dict(zip(SIDES, both, strict=True))
    depth, guess = dict[Side, NDArray[np.float32]](), dict[Side, NDArray[np.float32]]()
    for side in SIDES:
        sky = sky_mask(levels[side], disparities[side]) if find_sky else np.zeros(levels[side].shape[:2], np.bool_)
        disparity = np.where(sky, np.float32(0.0), disparities[side])
        depth[side] = metres(disparity, rig, side)
        filled = _without_holes(disparity, rig, side)
        guess[side] = np.where(np.isnan(disparity), metres(filled, rig, side), np.float32(0.0))
    return FramePair(images=images, depth=depth, guess=guess, timed=rig.rectified)


def _without_holes(disparity: NDArray[np.float32], rig: StereoRig, side: Side) -> NDArray[np.float32]:
    """Disparity (H, W) with its holes filled along the baseline by the farther neighbour, see ``fill_holes``.

    Cameras that differ see different rows: one that the other does not show at all is filled by those beside it.
    """
    if rig.aligned:
        return fill_holes(disparity)
    R = rig.own(side).R
    vertical = abs(R[1, 0]) > abs(R[0, 0])
    along = fill_holes(disparity.T if vertical else disparity)
    filled = np.where(np.isnan(along), fill_holes(along.T).T, along)
    return filled.T if vertical else filled


def moving_pairs(
    images: Images, rig: StereoRig, shutter: RollingShutter, motion: Motion, options: CorrectionOptions
) -> Pairs:
    """``frame_pairs`` by a known motion: of cameras that do not read rows together, or a matcher that needs it.

    Raises:
        RsbenchError: see ``find_depths``.
    """
    if needs_motion(options.matcher):
        both = motion_disparities(options.matcher, images, rig, shutter, motion)
    else:
        both = dict[View, NDArray[np.float32]]()
        for frame in FRAMES:
            levels = dict(zip(SIDES, eight_bit([images[side, frame] for side in SIDES]), strict=True))
            found = moving_disparities(options.matcher, levels, rig, shutter, motion, frame)
            both |= {(side, frame): each for side, each in zip(SIDES, found, strict=True)}
    first, second = (
        pair_with_motion(images, [both[side, frame] for side in SIDES], frame, rig, find_sky=options.find_sky)
        for frame in FRAMES
    )
    return first, second


def motion_disparities(
    entry: MatcherEntry,
    images: Images,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    views: Sequence[View] | None = None,
) -> dict[View, NDArray[np.float32]]:
    """Disparity (H, W), ideal px, that depth in each line's own camera means; 0 infinitely far, NaN unknown.

    ``views``: whose is wanted; of all images when None.
    """
    levels = dict(zip(images, eight_bit(list(images.values())), strict=True))
    found = find_depths(entry, levels, rig, shutter, motion, views)
    return {
        view: rig.disparity(body_depth(depth, rig, view[0])).astype(np.float32) for view, depth in found.items()
    }


def pair_with_motion(
    images: Images, both: Sequence[NDArray[np.float32]], frame: int, rig: StereoRig, *, find_sky: bool
) -> FramePair:
    """``depth_of_pair`` of disparities that a motion is in already."""
    pair = depth_of_pair(images["left", frame], images["right", frame], both, rig, find_sky=find_sky)
    return replace(pair, timed=True)


def frame_pairs(
    images: Images, rig: StereoRig, options: CorrectionOptions, disparity_offset: float = 0.0
) -> Pairs:
    """``frame_pair`` of frame 0 and of frame 1; ours side by side, for it keeps one core busy."""
    # Nothing is known of whether another package's matcher may run twice at a time.
    with ThreadPoolExecutor(len(FRAMES) if options.matcher.built_in else 1) as pool:
        first, second = pool.map(
            lambda frame: frame_pair(
                images["left", frame], images["right", frame], rig, options, disparity_offset
            ),
            FRAMES,
        )
    return first, second


def known_depth(images: Images, depth: Mapping[View, NDArray[np.float32]]) -> Pairs:
    """Frames with a given depth (H, W) of every view: metres, inf at infinity, 0 unknown; no guesses."""
    first, second = (
        FramePair(
            images={side: images[side, frame] for side in SIDES},
            depth={side: depth[side, frame] for side in SIDES},
            guess={side: np.zeros_like(depth[side, frame]) for side in SIDES},
        )
        for frame in FRAMES
    )
    return first, second


def timed_pairs(pairs: Pairs, rig: StereoRig, shutter: RollingShutter, motion: Motion) -> Pairs:
    """The same frames with the depth of a rig that moves between the times of both ends of a disparity."""
    first, second = (
        pair
        if pair.timed
        else replace(
            pair,
            depth={s: timed_depth(pair.depth[s], rig, shutter, motion, s, frame) for s in SIDES},
            guess={s: timed_depth(pair.guess[s], rig, shutter, motion, s, frame) for s in SIDES},
            timed=True,
        )
        for frame, pair in enumerate(pairs)
    )
    return first, second


def complete_depth(
    pairs: Pairs, rig: StereoRig, shutter: RollingShutter, motion: Motion, frames: tuple[int, ...] = FRAMES
) -> Pairs:
    """The same frames with depth from the motion where the other camera gave none, in the requested ones."""

    def side_depths(side: Side) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        first, second = eight_bit([pair.images[side] for pair in pairs])
        known = pairs[0].depth[side], pairs[1].depth[side]
        return depth_from_motion((first, second), known, rig, shutter, motion, side, frames)

    with ThreadPoolExecutor(len(SIDES)) as pool:
        found = dict(zip(SIDES, pool.map(side_depths, SIDES), strict=True))
    first, second = (_completed(pair, {side: found[side][k] for side in SIDES}) for k, pair in enumerate(pairs))
    return first, second


def _completed(pair: FramePair, found: dict[Side, NDArray[np.float32]]) -> FramePair:
    depth = {side: np.where(found[side] > 0.0, found[side], pair.depth[side]) for side in SIDES}
    guess = {side: np.where(found[side] > 0.0, np.float32(0.0), pair.guess[side]) for side in SIDES}
    return replace(pair, depth=depth, guess=guess, with_motion=True)


def metres(disparity: NDArray[np.float32], rig: StereoRig, side: Side) -> NDArray[np.float32]:
    """Metres (H, W) along the camera's axis: inf where there is no disparity, 0 where it is unknown."""
    depth = np.where(np.isnan(disparity), 0.0, rig.depth(disparity))
    if not rig.aligned:
        depth = depth * own_depths(rig, side)
    return np.nan_to_num(depth, nan=np.inf, posinf=np.inf).astype(np.float32)
