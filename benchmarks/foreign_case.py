"""A row of ``foreign_frames.py`` in memory, as ``rsbench.correct`` takes it.

from foreign_case import case  # with benchmarks/ on the path
seen = case("printed", 0)
rsbench.correct(seen.images, seen.rig, seen.shutter.readout_ratio)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import foreign_frames as frames
import foreign_motion as motion
import numpy as np
from foreign_rig import NAMES, Camera, Rig
from foreign_world import Image, read_photographs
from numpy.typing import NDArray

import rsbench
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions, known_depth
from rsbench.vision.fusion import Fused


@dataclass(frozen=True)
class Seen:
    """Of left 0, right 0, left 1, right 1."""

    images: list[NDArray[np.uint8]]
    still: list[NDArray[np.uint8]]
    """At the time of each frame's first line, without noise."""
    depth: list[Image]
    """Metres along each camera's axis, of the images."""
    rig: StereoRig
    shutter: RollingShutter
    motion: LinearMotion
    """Of the body over one frame period; the law that was traced in the rows of rigs."""


def our_camera(c: Camera) -> PinholeCamera:
    """The same intrinsics in rsbench."""
    named: dict[str, Any] = dict(zip(NAMES[c.lens], c.coefficients, strict=False))
    lens = Lens(model=c.lens, **named) if any(c.coefficients) else None  # type: ignore[arg-type]
    cx, cy = c.centre
    return PinholeCamera(width=c.width, height=c.height, fx=c.fx, fy=c.fy, cx=cx, cy=cy, lens=lens)


def ours(rig: Rig) -> tuple[StereoRig, RollingShutter]:
    """The same rig and shutter in rsbench."""
    left, right = rig.left, rig.right
    scanning = Scanning(
        scan=left.scan,  # type: ignore[arg-type]
        right_scan=None if right.scan == left.scan else right.scan,  # type: ignore[arg-type]
        right_delay=right.delay - left.delay,
        right_readout_ratio=None if right.ratio == left.ratio else right.ratio,
    )
    made = StereoRig.of_cameras(our_camera(left), our_camera(right), rig.R, rig.t)
    return made, made.shutter_of(scanning, left.ratio)


@cache
def case(row: str, seed: int = 0) -> Seen:
    """A row and seed, as ``foreign_frames.py`` writes them."""
    return seen(*frames.draw_case(row, seed))


def seen(drawn: frames.Case, rng: np.random.Generator) -> Seen:
    """What both cameras see of a world that the generator makes."""
    traced = frames.trace_case(drawn, rng, _photographs())
    views = [(side, frame) for frame in FRAMES for side in SIDES]
    rolling, still = ([frames.grey(images[view]) for view in views] for images in (traced.rolling, traced.still))
    depth = [traced.depth[view] for view in views]
    return Seen(rolling, still, depth, *ours(drawn.rig), LinearMotion(*motion.between(drawn.law, 0.0, 1.0)))


def corrected(images: list[NDArray[np.uint8]], rig: StereoRig, shutter: RollingShutter) -> Any:
    """What ``rsbench.correct`` makes of them where the shutter and the law are given."""
    return rsbench.correct(images, rig, shutter.readout_ratio, scanning=shutter.scanning, motion_model="linear")


def truth_fed(
    images: list[NDArray[np.uint8]], depth: list[Image], rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> dict[View, Fused]:
    """What the same corrector makes of them with true depth (H, W) and motion: the most that a view allows."""
    views = [(side, frame) for frame in FRAMES for side in SIDES]
    seen = dict(zip(views, images, strict=True))
    given = Given(motion=motion, pairs=known_depth(seen, dict(zip(views, depth, strict=True))))
    options = CorrectionOptions(depth_from_motion=False)
    return correct_four(seen, rig, KnownInputs.of(shutter), options, given=given).frames


@cache
def _photographs() -> list[Image]:
    return read_photographs(None)
