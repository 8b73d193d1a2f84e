"""Frames of one camera, any number of them, corrected in order, each with the frame before it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import parse_card, read_toml
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.footage import CameraCard, check_alike
from rsbench.pipeline.mono_correction import FoundOwnMotion, MonoFusionCorrector, find_own_motion, refusal
from rsbench.vision.fusion import Fused
from rsbench.vision.mono_fusion import MonoFusion, MonoFusionOptions, find_flows

DEFAULT_FOCAL = 1.0
"""Focal length in widths of the image where nothing is said: a horizontal field of view of 53 degrees. On frames
of a high-speed camera, from 0.8 to 2.5 widths moved the corrected pixels by less than 0.05 px."""
_WIDEST_DEG = 170.0


@dataclass(frozen=True, kw_only=True)
class OneCameraCard:
    """What is known of a camera whose frames are corrected alone; the size comes from the images."""

    readout_ratio: float | None = None
    """Readout time over frame period, 0 to 1."""
    fov_deg: float | None = None
    """Horizontal field of view, degrees, in place of ``camera``. Absent both: a focal length of the width."""
    camera: CameraCard | None = None
    """Intrinsics."""

    def __post_init__(self) -> None:
        if self.readout_ratio is not None and not 0.0 <= self.readout_ratio <= 1.0:
            raise ValueError(f"readout_ratio = {self.readout_ratio}: must lie in [0, 1]")
        if self.fov_deg is not None and not 0.0 < self.fov_deg <= _WIDEST_DEG:
            raise ValueError(f"fov_deg = {self.fov_deg}: must lie in (0, {_WIDEST_DEG:g}]")
        if self.fov_deg is not None and self.camera is not None:
            raise ValueError("fov_deg: leave it out beside [camera], which says the focal length")
        if self.camera is not None and self.camera.lens is not None:
            raise ValueError("camera.lens: leave it out; undistort frames of one camera first")

    def camera_of(self, width: int, height: int) -> PinholeCamera:
        """The camera of images of this size."""
        if self.camera is not None:
            c = self.camera
            return PinholeCamera(width=width, height=height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy)
        if self.fov_deg is not None:
            focal = 0.5 * width / math.tan(math.radians(0.5 * self.fov_deg))
            return PinholeCamera.centred(width, height, focal)
        return PinholeCamera.centred(width, height, DEFAULT_FOCAL * width)


@dataclass(frozen=True, kw_only=True, eq=False)
class MonoMoment:
    """One frame of a camera, corrected."""

    number: int
    image: NDArray[Any]
    """As it was read."""
    fused: Fused
    """``fused.reason`` says why it is not corrected."""
    found: FoundOwnMotion | None
    """The motion, of length 1, over the frame and the one before (of the first frame: after); None without one."""
    camera: PinholeCamera
    readout_ratio: float


@dataclass(frozen=True, kw_only=True)
class MonoOptions:
    """How frames of one camera are corrected."""

    corrector: MonoFusionCorrector = field(default_factory=MonoFusionCorrector)
    target_row: float | None = None
    """The time of this row of a frame is that of its corrected image; None: of the middle one."""


def read_one_camera(path: Path) -> OneCameraCard:
    """Card of one camera: ``readout_ratio``, and ``[camera]`` (fx, fy, cx, cy), ``fov_deg``, or neither.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    return parse_card(OneCameraCard, read_toml(path), str(path))


def correct_frames(
    frames: Iterable[NDArray[Any]], card: OneCameraCard, options: MonoOptions | None = None
) -> Iterator[MonoMoment]:
    """Every frame (H, W[, 3]), uint8 or uint16, of one camera at the time of its target row, in order.

    Raises:
        RsbenchError: fewer than two frames, frames of two sizes, no readout ratio, or two frames alone that
            show no texture or no motion. Of more frames such a pair is a failure by value.
    """
    options = options or MonoOptions()
    if card.readout_ratio is None:
        raise RsbenchError("readout_ratio: must be given for one camera")
    before: NDArray[Any] | None = None
    first: list[MonoMoment] = []
    number = -1
    for number, image in enumerate(frames):
        if before is not None:
            check_alike({f"frame {number - 1}": before, f"frame {number}": image})
            moments = _corrected((before, image), card, card.readout_ratio, options, number, first=number == 1)
            if number == 1:
                first = moments  # held until it is known whether they are all
            else:
                yield from first
                yield from moments
                first = []
        before = image
    if number < 1:
        raise RsbenchError(f"frames: {number + 1} given; one camera shows its motion in at least two")
    if first and first[0].fused.reason:
        raise RsbenchError(f"frames: {first[0].fused.reason}")
    yield from first


def correct_all(
    frames: Iterable[NDArray[Any]],
    camera: PinholeCamera | float | None,
    readout_ratio: float | None,
    target_row: float | None = None,
    *,
    inpaint: bool = True,
    seed: int = 0,
) -> list[Fused]:
    """``correct_frames`` of a camera, a horizontal field of view in degrees, or None; its errors."""
    known: dict[str, Any] = {}
    if isinstance(camera, PinholeCamera):
        known["camera"] = CameraCard(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, lens=camera.lens)
    elif camera is not None:
        known["fov_deg"] = camera
    try:
        card = OneCameraCard(readout_ratio=readout_ratio, **known)
    except ValueError as error:
        raise RsbenchError(str(error)) from error
    corrector = MonoFusionCorrector(fusion=MonoFusionOptions(inpaint=inpaint), seed=seed)
    moments = correct_frames(frames, card, MonoOptions(corrector=corrector, target_row=target_row))
    return [moment.fused for moment in moments]


def _corrected(
    pair: tuple[NDArray[Any], NDArray[Any]],
    card: OneCameraCard,
    readout_ratio: float,
    options: MonoOptions,
    number: int,
    *,
    first: bool,
) -> list[MonoMoment]:
    """The second frame of a pair, of this number, and before it the ``first`` one where it is wanted."""
    height, width = pair[0].shape[:2]
    camera = card.camera_of(width, height)
    rig, shutter = (
        StereoRig(camera=camera, baseline=1.0),
        RollingShutter(height=height, readout_ratio=readout_ratio),
    )
    row = (height - 1) / 2 if options.target_row is None else options.target_row
    flows = find_flows(pair)
    found, fusion, reason = None, None, refusal(pair, flows)
    if not reason:
        corrector = options.corrector
        found = find_own_motion(flows, rig, shutter, "left", corrector.robust, corrector.seed)
        fusion = MonoFusion(pair, found.own, flows, corrector.fusion)
    moments = []
    for frame in (0, 1) if first else (1,):
        fused = Fused.failed(pair[frame], reason)
        if fusion is None:
            fused = replace(fused, image=pair[frame].copy())
        else:
            fused = fusion.corrected(frame, float(shutter.time_after(row, frame, "left")))
        at = number - 1 + frame
        moments.append(
            MonoMoment(
                number=at, image=pair[frame], fused=fused, found=found, camera=camera, readout_ratio=readout_ratio
            )
        )
    return moments


def translation_record(found: FoundOwnMotion) -> dict[str, Any]:
    """The motion of a camera over one frame period, ready for JSON; its unit of length is the translation's."""
    motion = found.own.motion
    if motion is None or found.robust is None:
        return {"reason": found.reason}
    estimate = found.robust.estimate
    return {
        "model": motion.name,
        "w": motion.w.tolist(),
        "d": motion.d.tolist(),
        "rotation_deg": float(np.rad2deg(np.linalg.norm(motion.w))),
        "noise_px": estimate.noise_px,
        "inliers": found.robust.inlier_count,
        "matches": found.robust.match_count,
    }
