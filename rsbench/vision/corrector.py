"""The interface of correctors, which convert rolling-shutter frames to global-shutter ones; loading by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.components import plugins
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core import projection
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import check_cameras_of
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig, View
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.fusion import Fused, Origin

Knowledge = Literal["motion", "depth", "matches", "gyro"]
OtherFrames = Literal["stereo", "time"]
Cameras = Literal["ideal", "any", "rig"]
Depths = Mapping[View, NDArray[np.float32]]


@dataclass(frozen=True, kw_only=True)
class CorrectorSpec:
    """Requirements and properties that a corrector declares. Raises ValueError on unknown values."""

    needs: Set[Knowledge]
    """Quantities that the chain must estimate before the correction; others are not estimated. Gyroscope samples
    cannot be estimated: frames without them are refused."""
    reference: str
    """The publication of the method."""
    assumes: str
    """Assumptions of the method, as text."""
    cameras: Cameras = "ideal"
    """Supported cameras; others are refused. ``ideal``: no lens, both cameras read rows from the top at one time.
    ``any``: two equal, aligned cameras with or without lens, any scan. ``rig``: any two cameras."""
    sees: Set[OtherFrames] = frozenset(get_args(OtherFrames))
    """Other frames that are used, directly or by ``needs``: the other camera's (``stereo``), those of the other
    frame time (``time``). Needs other than ``gyro`` require both, as the chain's matches are checked in both."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "needs", frozenset(self.needs))
        object.__setattr__(self, "sees", frozenset(self.sees))
        allowed = get_args(Knowledge)
        for value in self.needs:
            if value not in allowed:
                raise ValueError(f"needs: {value!r} does not exist; there are: {', '.join(allowed)}")
        others = set(get_args(OtherFrames))
        if not self.sees <= others or (self.needs - {"gyro"} and self.sees < others):
            raise ValueError(f"sees = {sorted(self.sees)}: of stereo and time; what the chain finds needs both")
        if self.cameras not in get_args(Cameras):
            raise ValueError(f"cameras = {self.cameras!r}: must be one of {', '.join(get_args(Cameras))}")
        for field in ("reference", "assumes"):
            if not isinstance(getattr(self, field), str) or not getattr(self, field):
                raise ValueError(f"{field} = {getattr(self, field)!r}: must be a text")


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectionProblem:
    """The input of a corrector: four frames, with known or estimated quantities."""

    images: Mapping[View, NDArray[Any]]
    """(H, W) grey or (H, W, 3) RGB of one type, uint8 or uint16, each of its camera's size."""
    rig: StereoRig
    shutter: RollingShutter
    target_row: float
    """A corrected frame shows the scene at the time when its camera has read this many lines. If the cameras
    differ in size or readout ratio, lines of the left camera are counted."""
    motion: Motion | None
    """Motion of the rig's body, metres; None if the corrector does not need it."""
    depth: Depths | None
    """(H, W) metres, in the camera at the time of each row; inf at infinity, 0 unknown. None if the corrector does
    not need it."""
    guess: Depths | None
    """(H, W) metres, guessed from neighbours where ``depth`` is unknown; 0 elsewhere."""
    disparity_offset: float = 0.0
    """px by which disparities in the images are too large, half of it per camera; not contained in ``depth``."""
    matches: Correspondences | None = None
    """Matches of the four frames, with outliers; None if the corrector does not need them."""
    gyro: FloatArray | None = None
    """(n, 4) tau, w: gyroscope samples as in ``Correspondences``; None if the corrector does not need them."""
    one_time: bool = False
    """Whether corrected frames of both cameras show the target time of the left one, if the times differ."""

    def camera(self, side: Side, reference: Side) -> PinholeCamera:
        """Return a camera, with its principal point shifted by the disparity offset unless it is ``reference``."""
        camera = self.rig.sensor(side)
        if side == reference or self.disparity_offset == 0.0:
            return camera
        shift = self.disparity_offset if side == "left" else -self.disparity_offset
        return replace(camera, cx=camera.cx + shift)

    def row_poses(self, view: View) -> Pose:
        """Return ``cam_from_world`` (lines, 3, 3), (lines, 3) of every line (row or column) of a frame.

        Raises ValueError without a motion.
        """
        return projection.row_poses(self.rig, self.shutter, self._motion(), *view)

    def target_pose(self, view: View) -> Pose:
        """Return ``cam_from_world`` of the corrected frame. Raises ValueError without a motion."""
        return self.rig.cam_from_world(self._motion(), self.target_time(view), view[0])

    def target_time(self, view: View) -> FloatArray:
        """Return the time of the corrected frame; see ``target_row`` and ``one_time``."""
        side, frame = ("left" if self.one_time else view[0]), view[1]
        if side == "left" or (self.shutter.right_readout_ratio, self.shutter.right_size) == (None, None):
            return self.shutter.time_after(self.target_row, frame, side)
        return self.shutter.start(frame, side) + self.shutter.time_after(self.target_row, 0, "left")

    def _motion(self) -> Motion:
        if self.motion is None:
            raise ValueError("the motion is not known: 'motion' must be among the needs of the corrector")
        return self.motion


class Corrector(ABC):
    """Four frames to corrected ones; a frozen dataclass, whose fields a card may set."""

    @property
    @abstractmethod
    def spec(self) -> CorrectorSpec:
        """The declared properties; a class attribute if they do not depend on parameters."""

    @abstractmethod
    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        """Return the corrected frames of the requested views, with the origin of each pixel.

        Images keep their shape and type. For a frame that cannot be corrected, return ``Fused.failed`` with the
        reason: do not raise an exception, and do not return the uncorrected frame.
        """

    def correct_rows(
        self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
    ) -> list[dict[View, Fused]]:
        """Call ``correct`` for several target rows in place of that of the problem.

        Override it if the expensive part does not depend on the row. It is not called for correctors of other
        packages, which run in separate processes.
        """
        return [self.correct(replace(problem, target_row=row), views) for row in rows]


CorrectorEntry = Entry[Corrector, RunOptions]


class NotCorrectedError(RsbenchError):
    """Raised if the frames are valid but the corrector cannot correct them; the message gives the reason."""


def _check_spec(corrector: Corrector) -> None:
    if not isinstance(corrector.spec, CorrectorSpec):
        raise ValueError(f"spec = {corrector.spec!r}: must be a CorrectorSpec")


CORRECTORS: Kind[Corrector, RunOptions] = Kind(
    singular="corrector", cards="correctors", base=Corrector, options=RunOptions, check=_check_spec
)


def load_corrector(name_or_path: str | Path) -> CorrectorEntry:
    """Load a corrector by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: the corrector does not exist, two have this name, or its card or class is wrong.
    """
    return plugins.load_entry(CORRECTORS, name_or_path)


def find_corrected(entry: CorrectorEntry, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
    """Correct four frames and check the result; raises as ``find_corrected_rows`` does."""
    return find_corrected_rows(entry, problem, views, (problem.target_row,))[0]


def find_corrected_rows(
    entry: CorrectorEntry, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
) -> list[dict[View, Fused]]:
    """Correct four frames to the times of several target rows and check the results.

    Raises:
        RsbenchError: the cameras are not supported, another package's corrector failed, or a result is wrong.
    """
    where = f"{CORRECTORS.singular} {entry.name!r}"
    check_cameras_of(entry.component.spec.cameras, problem.rig, problem.shutter, where)
    with plugins.blame(CORRECTORS, entry):
        answers = entry.component.correct_rows(problem, views, rows)
    if not isinstance(answers, list) or len(answers) != len(rows):
        raise RsbenchError(f"{where}: correct_rows must return a list of {len(rows)}, one for each row")
    for found in answers:
        if not isinstance(found, dict) or set(found) != set(views):
            raise RsbenchError(f"{where}: must return a dict of the requested views, {', '.join(map(str, views))}")
        for view, fused in found.items():
            _check(fused, problem.images[view], f"{where}: {view[0]} {view[1]}")
    return [{view: found[view] for view in views} for found in answers]


def demand_corrected(frames: Mapping[View, Fused], corrector: str) -> None:
    """Check that all frames were corrected, for callers that need all of them.

    Raises:
        NotCorrectedError: the message names the corrector, the first failed frame and the reason.
    """
    for (side, frame), fused in frames.items():
        if not fused.success:
            raise NotCorrectedError(f"{CORRECTORS.singular} {corrector!r}: {side} {frame}: {fused.reason}")


def _check(fused: object, image: NDArray[Any], where: str) -> None:
    if not isinstance(fused, Fused):
        raise RsbenchError(f"{where}: must be a Fused, got {type(fused).__name__}")
    if not isinstance(fused.reason, str):
        raise RsbenchError(f"{where}: reason must be a text, got {type(fused.reason).__name__}")
    for name, dtype, shape in (
        ("image", image.dtype, image.shape),
        ("origin", np.dtype(np.uint8), image.shape[:2]),
        ("depth", np.dtype(np.float32), image.shape[:2]),
    ):
        value = getattr(fused, name)
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != shape:
            got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise RsbenchError(f"{where}: {name} must be {dtype} {shape}, got {got}")
    if np.any(fused.origin >= len(Origin)):
        raise RsbenchError(
            f"{where}: origin must hold values from 0 to {len(Origin) - 1}, got {fused.origin.max()}"
        )
    if np.any(fused.depth <= 0.0):  # NaN is unknown
        raise RsbenchError(f"{where}: depth must be above 0 or NaN, got {np.nanmin(fused.depth)}")
