"""A recording read from any layout: images, cameras and, if available, times, poses, depth and disparity.

The conventions are those of rsbench: the centre of the top-left pixel is (0, 0), x right, y down, z forward, depth
is z in the camera frame of the pixel's row, poses are ``cam_from_world``. Data that a layout lacks are None or
missing.
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
"""Returns ``cam_from_world`` (..., 3, 3), (..., 3) at times (...), frame periods; NaN if unknown."""


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
    """``X_right = R X_left + t`` between the unrectified cameras, each in its own axes."""
    poses: Mapping[Side, PoseAt] = field(default_factory=dict)
    depths: Mapping[View, Callable[[], FloatArray]] = field(default_factory=dict)
    """Read depth maps (H, W) on demand: z, metres, 0 if unknown."""
    disparities: Mapping[View, Callable[[], FloatArray]] = field(default_factory=dict)
    """Read disparities (H, W) on demand, px: z is ``fx baseline / disparity``; NaN if unknown."""
    sightings: Mapping[View, Callable[[], tuple[FloatArray, FloatArray]]] = field(default_factory=dict)
    """Read pixels (n, 2) and the world points (n, 3) observed there, according to the layout."""
    truths: Mapping[tuple[Side, int, int], Path] = field(default_factory=dict)
    """Global-shutter images by camera, frame, and the row at whose time the image was taken."""
    masks: Mapping[View, Path] = field(default_factory=dict)
    """Images with the weight of each pixel in the layout's own scores of a corrected frame; 0: ignored."""
    notes: tuple[str, ...] = ()
    """Assumptions made where the layout is ambiguous."""

    @property
    def rig(self) -> StereoRig | None:
        """The rig of both unrectified cameras; None for one camera or unknown extrinsics.

        Raises:
            RsbenchError: the cameras cannot form a rig, for instance because their centres coincide.
        """
        if self.right_from_left is None or set(self.cameras) != set(SIDES):
            return None
        left, right = (self.cameras[side] for side in SIDES)
        with naming(self.name):
            return StereoRig.of_cameras(left, right, *self.right_from_left)

    @property
    def shutter(self) -> RollingShutter | None:
        """The shutter of both cameras of the rig, each with its own readout ratio; None if one is unknown."""
        if self.rig is None or set(self.shutters) != set(SIDES):
            return None
        left, right = (self.shutters[side].readout_ratio for side in SIDES)
        return self.rig.shutter_of(Scanning(right_readout_ratio=None if left == right else right), left)

    @property
    def frames(self) -> int:
        """Number of frames: one more than the largest frame number of the images."""
        return 1 + max((frame for _, frame in self.images), default=-1)
