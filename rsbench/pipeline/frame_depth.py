"""Options of the correction of four frames, and the depth of the frames of a rig."""

from __future__ import annotations

import hashlib
import math
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
from rsbench.vision.epipolar_search import depth_from_motion, stereo_contradicts
from rsbench.vision.feature_matcher import FeatureEntry, load_features
from rsbench.vision.fusion import Fused, Origin, inpaint
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
    """The four components of the correction, which may come from other packages, and options between them."""

    features: FeatureEntry = field(default_factory=lambda: load_features("sift-refined"))
    """Finds the matches for the motion; commands use ``dense`` by default, boards and studies this one."""
    solver: SolverEntry = field(default_factory=lambda: load_solver_entry("rs-stereo-refined"))
    """Estimates the motion; its translation must be metric."""
    matcher: MatcherEntry = field(default_factory=lambda: load_matcher("sgm"))
    """Estimates depth."""
    corrector: CorrectorEntry = field(default_factory=lambda: load_corrector("fusion"))
    robust: RobustOptions = field(default_factory=RobustOptions)
    motion_model: str | None = None
    """``auto`` or a model to use instead of the solver's, see ``rsbench.capture.model_choice``."""
    target_row: float = 0.0
    """The row at whose readout time the corrected image is."""
    one_time: bool = False
    """Whether the right camera's image is corrected to the left one's time if their times differ."""
    depth_from_motion: bool = True
    """Estimate depth from optical flow and motion where the other camera gives none."""
    find_sky: bool = True
    """Set the depth of regions that look like the sky to infinity."""
    inpaint: bool = False
    """Fill pixels that no frame shows; they stay marked."""
    seed: int = 0

    def faster(self) -> CorrectionOptions:
        """Faster options: matches and depth at half the size, and no depth from the motion.

        Raises:
            RsbenchError: features or matcher are from another package and cannot work at half the size.
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
        """Hash of all options; options with equal keys give equal frames."""
        values = {name: getattr(self, name) for name in sorted(option.name for option in fields(self))}
        parts = [f"{name}={value.key if isinstance(value, Entry) else value!r}" for name, value in values.items()]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def inpainted(fused: Fused, options: CorrectionOptions) -> Fused:
    """The frame with its holes filled if the options request it."""
    if not (options.inpaint and fused.success):
        return fused
    return replace(fused, image=inpaint(fused.image, fused.origin == Origin.NOBODY))


# Depth of the frames of a rig: from the other camera, sky, from the motion, and guesses for the rest.


Images = Mapping[View, NDArray[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePair:
    """Both images of one frame time, with their depth."""

    images: dict[Side, NDArray[Any]]
    depth: dict[Side, NDArray[np.float32]]
    """(H, W) metres along the camera's axis at each row's time; inf: sky or disparity 0; 0: unknown."""
    guess: dict[Side, NDArray[np.float32]]
    """(H, W) depth guessed from the neighbours where ``depth`` is unknown; 0 elsewhere."""
    with_motion: bool = False
    """Whether depth from the motion is included already."""
    timed: bool = True
    """Whether depth accounts for different readout times of a point in both cameras, which a lens causes."""


Pairs = tuple[FramePair, FramePair]
"""Frame 0 and frame 1."""


def frame_pair(
    left: NDArray[Any],
    right: NDArray[Any],
    rig: StereoRig,
    options: CorrectionOptions,
    disparity_offset: float = 0.0,
) -> FramePair:
    """Depth of both images (H, W[, 3]), uint8 or uint16, of one frame time, at their own pixels.

    ``disparity_offset`` is subtracted from disparities, px.

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
    """Depth from the disparities (H, W), NaN: unknown, of both images (H, W[, 3]) of one frame time.

    With a lens it is valid for a rig at rest; ``timed_pairs`` converts it to that of a moving rig. With
    ``find_sky``, regions that look like the sky are set to infinity.
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

    If the cameras differ, a row may be invisible in the other image; it is then filled across the baseline.
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
    """``frame_pairs`` with a known motion: for cameras that read rows at different times, or by its matcher.

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
    """Disparity (H, W), ideal px, equivalent to depth at each line's time; 0: infinitely far, NaN: unknown.

    ``views`` selects the views; None: all.
    """
    levels = dict(zip(images, eight_bit(list(images.values())), strict=True))
    found = find_depths(entry, levels, rig, shutter, motion, views)
    return {
        view: rig.disparity(body_depth(depth, rig, view[0])).astype(np.float32) for view, depth in found.items()
    }


def pair_with_motion(
    images: Images, both: Sequence[NDArray[np.float32]], frame: int, rig: StereoRig, *, find_sky: bool
) -> FramePair:
    """``depth_of_pair`` for disparities that account for the motion already."""
    pair = depth_of_pair(images["left", frame], images["right", frame], both, rig, find_sky=find_sky)
    return replace(pair, timed=True)


def frame_pairs(
    images: Images, rig: StereoRig, options: CorrectionOptions, disparity_offset: float = 0.0
) -> Pairs:
    """``frame_pair`` for frame 0 and frame 1, in two threads with a built-in matcher."""
    # A matcher of another package may not be thread-safe.
    with ThreadPoolExecutor(len(FRAMES) if options.matcher.built_in else 1) as pool:
        first, second = pool.map(
            lambda frame: frame_pair(
                images["left", frame], images["right", frame], rig, options, disparity_offset
            ),
            FRAMES,
        )
    return first, second


def known_depth(images: Images, depth: Mapping[View, NDArray[np.float32]]) -> Pairs:
    """Frames with a given depth (H, W) for each view: metres, inf: infinitely far, 0: unknown; without guesses."""
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
    """The frames with depth that accounts for the motion between the times of both points of a disparity."""

    def timed(pair: FramePair, frame: int) -> FramePair:
        both = {s: np.where(pair.depth[s] == 0.0, pair.guess[s], pair.depth[s]) for s in SIDES}
        both = {s: timed_depth(both[s], rig, shutter, motion, s, frame) for s in SIDES}
        nothing = np.float32(0.0)
        return replace(
            pair,
            depth={s: np.where(pair.depth[s] == 0.0, nothing, both[s]) for s in SIDES},
            guess={s: np.where(pair.guess[s] == 0.0, nothing, both[s]) for s in SIDES},
            timed=True,
        )

    first, second = (pair if pair.timed else timed(pair, frame) for frame, pair in enumerate(pairs))
    return first, second


def complete_depth(
    pairs: Pairs, rig: StereoRig, shutter: RollingShutter, motion: Motion, frames: tuple[int, ...] = FRAMES
) -> Pairs:
    """The frames with depth from the motion where the other camera gives none, for the given frame indices.

    If the cameras differ and read a point at different times, it also replaces depth that the other frame
    contradicts, unless the other camera contradicts the new one. That gains up to 0.7 dB with one camera above the
    other; if both read a point at one time, it changes a frame by -0.1 to 0.1 dB on average.
    """
    unsure = not (rig.aligned or rig.rows_together(shutter.scanning, shutter.readout_ratio))

    def side_depths(side: Side) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        first, second = eight_bit([pair.images[side] for pair in pairs])
        known = pairs[0].depth[side], pairs[1].depth[side]
        near = _nearest(known)
        found = depth_from_motion((first, second), known, rig, shutter, motion, side, frames, unsure, near)
        for frame in frames if unsure else ():
            pair = eight_bit([pairs[frame].images[each] for each in (side, *(s for s in SIDES if s != side))])
            wrong = stereo_contradicts(
                (pair[0], pair[1]), known[frame], found[frame], rig, shutter, motion, side, frame
            )
            found[frame][wrong] = 0.0
        return found

    with ThreadPoolExecutor(len(SIDES)) as pool:
        found = dict(zip(SIDES, pool.map(side_depths, SIDES), strict=True))
    first, second = (_completed(pair, {side: found[side][k] for side in SIDES}) for k, pair in enumerate(pairs))
    return first, second


_NEAREST, _NEARER = 0.001, 1.25
"""Share of the known depths that may be smaller than the nearest surface; factor of its inverse depth up to which
unknown depth is searched."""


def _nearest(depths: Sequence[NDArray[np.float32]]) -> float:
    """Largest inverse depth to be searched, 1 / m, if these depths (H, W) are known."""
    known = np.concatenate([depth[depth > 0.0] for depth in depths])
    return _NEARER / float(np.quantile(known, _NEAREST, method="lower")) if len(known) else math.inf


def _completed(pair: FramePair, found: dict[Side, NDArray[np.float32]]) -> FramePair:
    depth = {side: np.where(found[side] > 0.0, found[side], pair.depth[side]) for side in SIDES}
    guess = {side: np.where(found[side] > 0.0, np.float32(0.0), pair.guess[side]) for side in SIDES}
    return replace(pair, depth=depth, guess=guess, with_motion=True)


def metres(disparity: NDArray[np.float32], rig: StereoRig, side: Side) -> NDArray[np.float32]:
    """Depth (H, W), metres along the camera's axis: inf where the disparity is 0, 0 where it is unknown."""
    depth = np.where(np.isnan(disparity), 0.0, rig.depth(disparity))
    if not rig.aligned:
        depth = depth * own_depths(rig, side)
    return np.nan_to_num(depth, nan=np.inf, posinf=np.inf).astype(np.float32)
