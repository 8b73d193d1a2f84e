"""The matches of a sequence as rays with times: tracks over two frames or more, of both cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_kernels import END
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedTracks:
    """Tracks, as ``trajectory_kernels.add_tracks`` takes them."""

    ends: FloatArray
    """(e, 10)."""
    starts: IntArray
    """(n + 1,) first end of each track, and e."""
    window: IntArray
    """(n,) number of the two frames with which a track begins."""
    focal: FloatArray
    """(2,) fx, fy, px."""

    @property
    def freedom(self) -> FloatArray:
        """(n,) degrees of freedom of each track's error."""
        return 2.0 * np.diff(self.starts) - 3.0

    @property
    def span(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,) of the earliest and the latest end of each track."""
        taus = self.ends[:, 2]
        return np.minimum.reduceat(taus, self.starts[:-1]), np.maximum.reduceat(taus, self.starts[:-1])


def pack_windows(windows: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter) -> TimedTracks:
    """The tracks of windows; window k is of the frames k and k + 1."""
    packed = []
    for k, window in enumerate(windows):
        parts = (
            pack_ends(
                window.tracks[:, 2 * i : 2 * i + 2], k + i // 2, "left" if i % 2 == 0 else "right", rig, shutter
            )
            for i in range(4)
        )
        packed.append(np.stack(list(parts), axis=1))
    ends = np.concatenate([each.reshape(-1, END) for each in packed])
    count = len(ends) // 4
    return TimedTracks(
        ends=np.ascontiguousarray(ends),
        starts=4 * np.arange(count + 1, dtype=np.int64),
        window=np.repeat(np.arange(len(packed), dtype=np.int64), [len(each) for each in packed]),
        focal=np.array([rig.camera.fx, rig.camera.fy]),
    )


def pack_ends(pixels: FloatArray, frame: int, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Ends (n, 10) of pixels (n, 2) of one image."""
    out = np.zeros((len(pixels), END))
    out[:, :2], out[:, 2] = rig.camera.unproject(pixels)[:, :2], shutter.pixel_time(pixels, frame, side)
    out[:, 3:7], out[:, 7:9] = rig.camera.ideal_by_pixel(pixels).reshape(-1, 4), shutter.rate(side)
    out[:, 9] = rig.offset(side)[0]
    return out
