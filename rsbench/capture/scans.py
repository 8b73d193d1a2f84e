"""How two cameras may read their lines, and the times that it gives the ends of matches."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

import numpy as np

from rsbench.capture.calibration_errors import STRETCHING, ray_shifts, ray_stretches
from rsbench.core.correspondences import BoolArray, Correspondences, unlinked_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel, load_kernel
from rsbench.solvers.engine.motion_kernels import AcceleratedKernel
from rsbench.solvers.engine.packed import Packed, pack

Start = Literal["global", "top", "bottom", "left", "right"]
"""The side of the image at which a camera begins to read, or ``global`` for all lines at once."""
_FRAMES = np.array([0.0, 1.0])
_RATIO, _DELAY, _ACCELERATION, _FIRST_ERROR = range(4)
"""Places of the unknowns; after the first error of the calibration come the others."""
STARTS: tuple[Start, ...] = get_args(Start)
_FRAMES_OF_TRACKS, _LATE_OF_TRACKS = np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0])
"""Of the ends of a track: the frame, and 1 of those of the right camera."""


@dataclass(frozen=True, order=True)
class Scans:
    """Where each camera begins to read; those that roll share one readout ratio."""

    left: Start
    right: Start

    @property
    def rolls(self) -> bool:
        """Whether any camera does."""
        return self != GLOBAL

    @property
    def together(self) -> bool:
        """Whether both read alike."""
        return self.left == self.right

    def start(self, side: Side) -> Start:
        """Where one camera begins."""
        return self.left if side == "left" else self.right

    def __str__(self) -> str:
        if self.together:
            return "both cameras global" if self.left == "global" else f"both cameras from the {self.left}"
        words = {
            side: "global" if self.start(side) == "global" else f"from the {self.start(side)}" for side in SIDES
        }
        return f"left camera {words['left']}, right camera {words['right']}"


GLOBAL = Scans("global", "global")
ALL_SCANS = tuple(Scans(*starts) for starts in product(STARTS, STARTS))
"""All 25."""


def scans_of(shutter: RollingShutter) -> Scans:
    """The scans of a known shutter."""
    if shutter.readout_ratio == 0.0:
        return GLOBAL
    return Scans(shutter.scan_of("left"), shutter.scan_of("right"))


def line_of(scans: Scans, side: Side) -> FloatArray:
    """Time (3,) of one camera's pixels per readout ratio: constant, per image width, per image height."""
    return np.array(
        {
            "global": (0.0, 0.0, 0.0),
            "top": (0.0, 0.0, 1.0),
            "bottom": (1.0, 0.0, -1.0),
            "left": (0.0, 1.0, 0.0),
            "right": (1.0, -1.0, 0.0),
        }[scans.start(side)]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lines:
    """Per readout ratio: times of the ends after the start of their frame, and their derivatives by the pixel."""

    pairs: FloatArray
    """(n, 2) of both ends."""
    slopes: FloatArray
    """(n, 2)."""
    tracks: FloatArray
    """(m, 4) of the ends left 0, right 0, left 1, right 1."""
    track_slopes: FloatArray
    """(m, 4, 2)."""

    def only(self, pairs: BoolArray, tracks: BoolArray) -> _Lines:
        """Those of masks (n,), (m,)."""
        return _Lines(
            pairs=self.pairs[pairs],
            slopes=self.slopes[pairs],
            tracks=self.tracks[tracks],
            track_slopes=self.track_slopes[tracks],
        )


class TimedMatches:
    """Matches whose ends can be given the times of any scans.

    Every end has a time of its own here (``timed_tracks``), whatever the scans, so that all scans are judged
    by the same errors.
    """

    def __init__(self, matches: Correspondences, rig: StereoRig, motion_model: str = "linear") -> None:
        packs = {scan: pack(matches, rig, _late(rig, scan), motion_model) for scan in get_args(Scan)}
        self._base = next(iter(packs.values()))
        self.left: BoolArray = self._base.pairs[:, 6] >= 0.0
        """(n,) which pairs are the left camera's."""
        late = np.where(self.left, 0.0, 1.0)
        self._lines: dict[Start, _Lines] = {
            scan: _Lines(
                pairs=packed.pairs[:, 4:6] - (0.0, 1.0) - late[:, None],
                slopes=packed.pairs[:, 15:17],
                tracks=packed.tracks[:, :, 2] - (0.0, 1.0, 1.0, 2.0),
                track_slopes=packed.tracks[:, :, 7:9],
            )
            for scan, packed in packs.items()
        }
        pairs, tracks = len(self._base.pairs), len(self._base.tracks)
        self.count = pairs + tracks
        """Measurements: pairs that no track repeats, then tracks."""
        sets = [getattr(matches, side)[unlinked_pairs(matches, side)] for side in SIDES]
        self.pixels: FloatArray = np.concatenate([*(each[:, :2] for each in sets), matches.tracks[:, :2]])
        """(count, 2) where each is seen in frame 0."""
        self._shifts, self._stretches = self._ray_shifts(rig), self._ray_stretches(rig)
        self._lines["global"] = _Lines(
            pairs=np.zeros((pairs, 2)),
            slopes=np.zeros((pairs, 2)),
            tracks=np.zeros((tracks, 4)),
            track_slopes=np.zeros((tracks, 4, 2)),
        )

    def _ray_shifts(self, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
        """(n, 2, 2, 14) of the pairs' ends and (m, 4, 2, 14) of the tracks': ``ray_shifts``, the errors last."""
        base, optics = self._base, (float(self._base.focal[0]), rig.camera.lens)
        pairs = base.pairs[:, :4].reshape(-1, 2, 2)
        either = [ray_shifts(pairs, side, *optics) for side in SIDES]
        tracks = [ray_shifts(base.tracks[:, k, :2], SIDES[k % 2], *optics) for k in range(4)]
        found = np.where(self.left[:, None, None, None], *either), np.stack(tracks, axis=1)
        return np.ascontiguousarray(found[0].swapaxes(2, 3)), np.ascontiguousarray(found[1].swapaxes(2, 3))

    def _ray_stretches(self, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
        """(n, 2, 2, 2, 2) of the pairs' ends and (m, 4, 2, 2, 2) of the tracks', see ``ray_stretches``."""
        pairs, tracks = self._base.pairs[:, :4].reshape(-1, 2, 2), self._base.tracks[:, :, :2]
        return ray_stretches(pairs, rig.camera.lens), ray_stretches(tracks, rig.camera.lens)

    def under(self, motion_model: str) -> TimedMatches:
        """The same matches under another motion model."""
        other = copy.copy(self)
        other._base = replace(self._base, kernel=load_kernel(motion_model))
        return other

    def subset(self, chosen: BoolArray) -> TimedMatches:
        """Of a mask (count,) over pairs and tracks."""
        other = copy.copy(self)
        other._base = self._base.only(chosen)
        pairs, tracks = np.split(chosen, [len(self._base.pairs)])
        other.left, other.pixels, other.count = (
            self.left[pairs],
            self.pixels[chosen],
            int(np.count_nonzero(chosen)),
        )
        other._shifts = self._shifts[0][pairs], self._shifts[1][tracks]
        other._stretches = self._stretches[0][pairs], self._stretches[1][tracks]
        other._lines = {start: lines.only(pairs, tracks) for start, lines in self._lines.items()}
        return other

    def read(self, scans: Scans, chosen: BoolArray | None = None) -> ReadMatches:
        """Those of a mask (count,) as these scans time them; None: all."""
        chosen = np.ones(self.count, dtype=np.bool_) if chosen is None else chosen
        pairs, tracks = np.split(chosen, [len(self._base.pairs)])
        left, right = (self._lines[scans.start(side)].only(pairs, tracks) for side in SIDES)
        first, of_left = self.left[pairs][:, None], np.array([True, False, True, False])
        lines = _Lines(
            pairs=np.where(first, left.pairs, right.pairs),
            slopes=np.where(first, left.slopes, right.slopes),
            tracks=np.where(of_left, left.tracks, right.tracks),
            track_slopes=np.where(of_left[:, None], left.track_slopes, right.track_slopes),
        )
        shifts, stretches = ((each[0][pairs], each[1][tracks]) for each in (self._shifts, self._stretches))
        return ReadMatches(self._base.only(chosen), self.left[pairs], lines, shifts, stretches)

    def packed(self, scans: Scans, unknowns: FloatArray) -> Packed:
        """The measurements as these scans time them, see ``ReadMatches.packed``."""
        return self.read(scans).packed(unknowns)

    def kernel(self, unknowns: FloatArray) -> MotionKernel:
        """Of the motion model, with the acceleration among some unknowns (17,)."""
        return _accelerated(self._base.kernel, float(unknowns[_ACCELERATION]))


class ReadMatches:
    """Matches as two cameras read them, one scan each, but for the unknowns of their capture."""

    def __init__(
        self,
        base: Packed,
        left: BoolArray,
        lines: _Lines,
        shifts: tuple[FloatArray, FloatArray],
        stretches: tuple[FloatArray, FloatArray],
    ) -> None:
        self._base, self._lines, self._shifts, self._stretches = base, lines, shifts, stretches
        self.count = len(base.pairs) + len(base.tracks)
        self._late = np.where(left, 0.0, 1.0)[:, None]
        """(n, 1) of the pairs, 1 of those of the right camera."""
        self._constant: tuple[list[int], FloatArray, FloatArray] | None = None

    def packed(self, unknowns: FloatArray) -> Packed:
        """The measurements at some unknowns.

        Args:
            unknowns: (17,) readout ratio; frame periods by which the right camera is late; the motion's
                acceleration, 0 of a model without one; what the calibration is wrong by.
        """
        ratio, delay, acceleration, *errors = map(float, unknowns)
        pairs, tracks, lines = self._base.pairs.copy(), self._base.tracks.copy(), self._lines
        pairs[:, 4:6] = _FRAMES + delay * self._late + ratio * lines.pairs
        pairs[:, 15:17] = ratio * lines.slopes
        tracks[:, :, 2] = _FRAMES_OF_TRACKS + delay * _LATE_OF_TRACKS + ratio * lines.tracks
        tracks[:, :, 7:9] = ratio * lines.track_slopes
        if any(errors):
            pairs[:, :4] -= (self._shifts[0] @ errors).reshape(-1, 4)
            tracks[:, :, :2] -= self._shifts[1] @ errors
        if any(stretching := [errors[term] for term in STRETCHING]):
            ends = self._stretched(pairs[:, 7:15].reshape(-1, 2, 4), self._stretches[0], stretching)
            pairs[:, 7:15] = ends.reshape(-1, 8)
            tracks[:, :, 3:7] = self._stretched(tracks[:, :, 3:7], self._stretches[1], stretching)
        kernel = _accelerated(self._base.kernel, acceleration)
        return replace(self._base, pairs=pairs, tracks=tracks, h=0.0, kernel=kernel)

    def _stretched(self, by_pixel: FloatArray, stretches: FloatArray, errors: list[float]) -> FloatArray:
        """Derivatives (n, k, 4) of the ideal pixels by the pixels, of rays that errors shift unevenly."""
        fx, fy = self._base.focal
        by_ray = np.eye(2) - np.einsum("k,...kij->...ij", errors, stretches)
        by_ray = by_ray * [[1.0, fx / fy], [fy / fx, 1.0]]
        return np.asarray((by_ray @ by_pixel.reshape(*by_pixel.shape[:-1], 2, 2)).reshape(by_pixel.shape))

    def derivatives(self, packed: Packed, acceleration: float, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Of the ends' rays and times by k free unknowns: (n, 2, k, 3) of pairs, (m, 4, k, 3) of tracks.

        An acceleration is one of all times: the motion is at beta(tau), see ``AcceleratedKernel``. The next call
        may write into what this one gave.
        """
        if self._constant is None or self._constant[0] != free:
            self._constant = (free, *self._constant_derivatives(free))
        _, pairs, tracks = self._constant
        if _ACCELERATION in free:
            k = free.index(_ACCELERATION)
            for by, tau in ((pairs, packed.pairs[:, 4:6]), (tracks, packed.tracks[:, :, 2])):
                by[:, :, k, 2] = (tau**2 - tau) / ((2.0 + acceleration) * (1.0 + acceleration * tau))
        return pairs, tracks

    def _constant_derivatives(self, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Those by all but an acceleration."""
        pairs = np.zeros((len(self._base.pairs), 2, len(free), 3))
        tracks = np.zeros((len(self._base.tracks), 4, len(free), 3))
        for k, unknown in enumerate(free):
            if unknown >= _FIRST_ERROR:
                pairs[:, :, k, :2] = -self._shifts[0][..., unknown - _FIRST_ERROR]
                tracks[:, :, k, :2] = -self._shifts[1][..., unknown - _FIRST_ERROR]
            elif unknown == _RATIO:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._lines.pairs, self._lines.tracks
            elif unknown == _DELAY:
                pairs[:, :, k, 2], tracks[:, :, k, 2] = self._late, _LATE_OF_TRACKS
        return pairs, tracks


def _accelerated(kernel: MotionKernel, acceleration: float) -> MotionKernel:
    return AcceleratedKernel(acceleration=acceleration) if isinstance(kernel, AcceleratedKernel) else kernel


def _late(rig: StereoRig, scan: Scan) -> RollingShutter:
    """Both cameras read alike, the right one a period late: no two ends of a match are of one time."""
    camera = rig.camera
    return RollingShutter(height=camera.height, width=camera.width, readout_ratio=1.0, scan=scan, right_delay=1.0)
