"""Tracks of real rigs: any two cameras, with the true calibration and with an inaccurate ("loose") one.

Each sequence gives two problems with the same frames. In one the given calibration is the true one. In the other
the right camera is rotated, and focal lengths and principal points of both cameras have errors. Their sizes are
fixed; their signs and directions are random, with a seed from the sequence's name. The truth is the motion of the
left camera in its own axes, which do not depend on the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.benchmark.leaderboard.correction_tracks import OF_SENSORS, SensorTrack
from rsbench.benchmark.leaderboard.motion_tracks import MotionTrack, add_area_columns, motion_row, pose_fields
from rsbench.benchmark.leaderboard.splits import Frames
from rsbench.benchmark.leaderboard.track import Answer, Row, Split, Track, Truth
from rsbench.components.seeds import generator
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.dataset.sequence import read_pairs

LOOSE = "-loose"
"""Suffix of the name of a problem whose given calibration is the loose one."""
TURN_DEG = 0.2
"""Angle by which a loose calibration rotates the right camera about a random axis; its position is correct."""
FOCAL = 0.005
"""Relative error of the focal length of each camera."""
CENTRE_PX = 0.5
"""Distance of the principal point of each camera from the true one, in a random direction."""


def loose_rig(rig: StereoRig, rng: np.random.Generator) -> StereoRig:
    """Return the rig of a loose calibration; the positions of both cameras in the left one's axes are correct."""
    left, right = (_loose_camera(rig.sensor(side), rng) for side in SIDES)
    R, t = rig.right_from_left
    axis = rng.standard_normal(3)
    turn = so3.exp(np.radians(TURN_DEG) * axis / np.linalg.norm(axis))
    return replace(StereoRig.of_cameras(left, right, turn @ R, turn @ t), origin=rig.origin)


def _loose_camera(camera: PinholeCamera, rng: np.random.Generator) -> PinholeCamera:
    gain, angle = 1.0 + FOCAL * rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2.0 * np.pi)
    cx, cy = camera.cx + CENTRE_PX * np.cos(angle), camera.cy + CENTRE_PX * np.sin(angle)
    return replace(camera, fx=gain * camera.fx, fy=gain * camera.fy, cx=float(cx), cy=float(cy))


@dataclass(frozen=True)
class RigFrames(Frames):
    """Inputs of the frame pairs of a dataset, each with the true calibration and with a loose one."""

    any_rig: bool = True

    def split(self, track: Track, data: Path | None, seed_file: Path | None, secret: bool) -> Split:
        split = super().split(track, data, seed_file, secret)
        return replace(split, truths=tuple(each for truth in split.truths for each in _both(truth)))

    def given(self, track: Track, folder: Path) -> list[Rendered]:
        pairs = self.pairs(track, folder)
        loose = (replace(each, name=each.name + LOOSE, rig=loose_of(each.name, each.rig)) for each in pairs)
        return [each for both in zip(pairs, loose, strict=True) for each in both]

    def pairs(self, track: Track, folder: Path) -> list[Rendered]:
        """Return the frame pairs; on tracks of pictures, only those whose left camera has a rolling shutter."""
        found = read_pairs(folder)
        return [each for each in found if each.shutter.ratio_of("left") > 0.0] if track.pictures else found


def loose_of(name: str, rig: StereoRig) -> StereoRig:
    """Return the loose calibration of the sequence with this name."""
    return loose_rig(rig, generator(0, "leaderboard", "loose calibration", name))


def _both(truth: Truth) -> tuple[Truth, Truth]:
    name, pictures = truth.name + LOOSE, truth.pictures
    loose = replace(
        truth,
        name=name,
        given_rig=loose_of(truth.name, truth.rig),
        facts=truth.facts | {"calibration": "loose"},
        pictures=None if pictures is None else replace(pictures, sequence=replace(pictures.sequence, name=name)),
    )
    return replace(truth, facts=truth.facts | {"calibration": "true"}), loose


def left_camera_motion(
    w: FloatArray, d: FloatArray, point: str, given: StereoRig, wanted: StereoRig
) -> tuple[FloatArray, FloatArray]:
    """Convert a motion of the left camera from the body's axes of one rig to those of ``wanted``.

    Both rigs have the same left camera, whose own axes do not depend on the calibration.

    Args:
        w: rotation vector (3,) of one frame period.
        d: translation (3,) of ``point``.
        point: ``body`` or ``left``.
        given: the rig in whose axes w and d are.
        wanted: the other rig.
    """
    turn = wanted.own("left").R.T @ given.own("left").R
    left = d if point == "left" else translation_of_offset(w, d, given.offset("left"))
    return turn @ w, turn @ left


@dataclass(frozen=True, kw_only=True, eq=False)
class RigMotionTrack(MotionTrack):
    """A track of motions of rigs of any two cameras, scored as the left camera's motion in its own axes."""

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        w, d = left_camera_motion(truth.motion.w, truth.motion.d, "body", truth.rig, truth.given_rig or truth.rig)
        return {"w": w.tolist(), "d": d.tolist(), "metric": True, "reference_point": "left"}

    def row(self, truth: Truth, answer: Answer | None) -> Row:
        if answer is not None and answer.w is not None and answer.d is not None:
            given, point = truth.given_rig or truth.rig, answer.reference_point
            w, d = left_camera_motion(np.array(answer.w), np.array(answer.d), point, given, truth.rig)
            answer = replace(answer, w=tuple(w), d=tuple(d), reference_point="left", covariance=None)
        return motion_row(truth, answer)


TRACKS: tuple[Track, ...] = (
    RigMotionTrack(
        **pose_fields(RigFrames()) | {"parting": "calibration"},
        name="pose-rigs",
        id="pose-rigs-1",
        title="Motion from given matches of rigs as they are, with true and with loose calibrations",
        more_columns=add_area_columns,
    ),
    SensorTrack(
        **OF_SENSORS
        | {
            "inputs": RigFrames(),
            "parting": "calibration",
            "rows": ("first",),
            "scores": tuple(score for score in OF_SENSORS["scores"] if score.key != "psnr_middle"),
        },
        name="correction-rigs",
        id="correction-rigs-1",
        title="Corrected frames of rigs as they are, with true and with loose calibrations",
    ),
)
