"""Frames that stand at another's place in a sequence: their pictures agree, but with those of no other time."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView, Times
from rsbench.verification.findings import Finding
from rsbench.verification.frame_comparison import DEPTH_TOLERANCE, DepthMap, reproject

_TRIED_PIXELS = 20_000
_AGREE, _LEAST = 0.8, 50
"""Share of the comparable pixels that agree where both maps are at their places, and how many there must be."""
_NEAR = 4
"""Frames before and after with which a frame is compared, the nearest first."""
_FARTHEST = 32


def frames_of_other_times(sequence: Sequence, apart: Collection[Times]) -> list[Finding]:
    """A finding for each frame, of those ``apart`` from one beside it, that is that of another time.

    A frame is in order if it agrees with any other one near it, but for those that it is said not to.
    """
    maps = _Maps(sequence)
    suspects = sorted({frame for times in apart for frame in times})
    lost = [frame for frame in suspects if not any(maps.agree(frame, frame, other) for other in maps.near(frame))]
    sound = [frame for frame in range(sequence.frames) if frame not in lost]
    found = {frame: _time_of(maps, frame, sound or maps.near(frame)) for frame in lost}
    return [
        _finding(frame, time) for frame, time in found.items() if time is not None or (sound and maps.seen(frame))
    ]


def _time_of(maps: _Maps, frame: int, others: list[int]) -> int | None:
    """The time at which a frame that agrees with none at its own does."""
    beside = sorted(others, key=lambda other: abs(other - frame))[: 2 * _NEAR]
    times = sorted(range(maps.sequence.frames), key=lambda other: abs(other - frame))[1 : _FARTHEST + 1]
    pairs = ((time, other) for time in times for other in beside if other not in (frame, time))
    return next((time for time, other in pairs if maps.agree(frame, time, other)), None)


def _finding(frame: int, time: int | None) -> Finding:
    what = f"all pictures of frame {frame} disagree with those of other times, and not with each other"
    return Finding(
        ImageView("rs", "left", frame).depth, what, cause="" if time is None else f"looks like frame {time}"
    )


class _Maps:
    """Depth maps of the left camera, read when needed."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self._read: dict[int, DepthMap | None] = {}
        self._found: dict[tuple[int, int, int], tuple[float, int]] = {}

    def near(self, frame: int) -> list[int]:
        """Other frames, the nearest first."""
        others = sorted(range(self.sequence.frames), key=lambda other: abs(other - frame))
        return others[1 : 2 * _NEAR + 1]

    def agree(self, frame: int, time: int, other: int) -> bool:
        """Whether the map of a frame, as if it were that of a time, agrees with the map of another frame."""
        share, count = self._share(frame, time, other)
        return count >= _LEAST and share > _AGREE

    def seen(self, frame: int) -> bool:
        """Whether another one near it sees what it sees."""
        return any(self._share(frame, frame, other)[1] >= _LEAST for other in self.near(frame))

    def _share(self, frame: int, time: int, other: int) -> tuple[float, int]:
        key = frame, time, other
        if key not in self._found:
            self._found[key] = self._compare(*key)
        return self._found[key]

    def _compare(self, frame: int, time: int, other: int) -> tuple[float, int]:
        source, target = self._map(frame), self._map(other)
        if source is None or target is None:
            return 0.0, 0
        moved = replace(source, view=source.view._replace(frame=time))
        stride = max(1, int(np.sqrt(source.depth.size / _TRIED_PIXELS)))
        relative = reproject(self.sequence, moved, target, stride).relative
        near = relative[(source.depth[::stride, ::stride] > 0) & (relative < 0.01)]
        near = near[np.isfinite(near)]
        return (float(np.mean(np.abs(near) <= DEPTH_TOLERANCE)) if near.size else 0.0), near.size

    def _map(self, frame: int) -> DepthMap | None:
        if frame not in self._read:
            view = ImageView("rs", "left", frame)
            try:
                self._read[frame] = DepthMap(view, self.sequence.depth(*view), self.sequence.rig.camera)
            except RsbenchError:  # reported already
                self._read[frame] = None
        return self._read[frame]
