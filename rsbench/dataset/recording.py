"""A recording read from any layout: images, cameras, and as far as it says, times, poses, depth and disparity.

All in the conventions of rsbench: the centre of the top-left pixel is (0, 0), x right, y down, z forward, depth is
z in the camera of the pixel's own row, poses are ``cam_from_world``. What a layout lacks is None or missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import naming
from rsbench.core.rig import SIDES, Side, StereoRig, View
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray

PoseAt = Callable[[FloatArray], Pose]
"""``cam_from_world`` (..., 3, 3), (..., 3) at times (...), frame periods; NaN where it is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """The images of one or two cameras over time."""

    name: str
    cameras: Mapping[Side, PinholeCamera]
    images: Mapping[View, Path]
    shutters: Mapping[Side, RollingShutter] = field(default_factory=dict)
    """Shutters of the cameras whose readout is known; a global one has the ratio 0."""
    frame_period_s: float | None = None
    right_from_left: Pose | None = None
    """``X_right = R X_left + t`` between the cameras as they are, each in its own axes."""
    poses: Mapping[Side, PoseAt] = field(default_factory=dict)
    depths: Mapping[View, Callable[[], FloatArray]] = field(default_factory=dict)
    """(H, W) z, metres, 0 where there is none; read on demand."""
    disparities: Mapping[View, Callable[[], FloatArray]] = field(default_factory=dict)
    """(H, W) px, such that ``fx baseline / disparity`` is z; NaN where there is none."""
    sightings: Mapping[View, Callable[[], tuple[FloatArray, FloatArray]]] = field(default_factory=dict)
    """Pixels (n, 2) and the points (n, 3) of the world that the layout says are seen there."""
    truths: Mapping[tuple[Side, int, int], Path] = field(default_factory=dict)
    """Images of a global shutter: of a camera, a frame, and the row at whose time it was taken."""
    masks: Mapping[View, Path] = field(default_factory=dict)
    """Images with the weight of each pixel in the layout's own scores of a corrected frame; 0 is none."""
    notes: tuple[str, ...] = ()
    """What the layout leaves open, and how it was taken."""

    @property
    def rig(self) -> StereoRig | None:
        """Both cameras as they are; None of one camera, or where their places are not known.

        Raises:
            RsbenchError: the cameras cannot be a rig, such as two at one place.
        """
        if self.right_from_left is None or set(self.cameras) != set(SIDES):
            return None
        left, right = (self.cameras[side] for side in SIDES)
        with naming(self.name):
            return StereoRig.of_cameras(left, right, *self.right_from_left)

    @property
    def shutter(self) -> RollingShutter | None:
        """The shutter of both cameras of the rig, each with its own ratio; None where a camera's readout is not
        known."""
        if self.rig is None or set(self.shutters) != set(SIDES):
            return None
        left, right = (self.shutters[side].readout_ratio for side in SIDES)
        return self.rig.shutter_of(Scanning(right_readout_ratio=None if left == right else right), left)

    @property
    def frames(self) -> int:
        """Times at which there is an image."""
        return 1 + max((frame for _, frame in self.images), default=-1)
