"""The cost of matches as a function of the readout ratio and of a disparity offset, the motion fitted to each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.levenberg_marquardt import Minimum, levenberg_marquardt
from rsbench.solvers.engine.packed import Packed, pack
from rsbench.solvers.refined import RefinedSolver

LEAST_NOISE_PX = 0.02
"""What exact matches are taken for: those of equal images leave no errors, and tell nothing."""
_REACH = 0.3
_STEPS = np.array([0.02, 0.05])
_ITERATIONS = 30
_LONGEST = np.array([0.2, 0.5])
_CLOSE = np.array([1e-4, 1e-3])
_FREEDOM = 8
_TILES = (6, 4)
"""Columns and rows of tiles in which matches may err together."""


class Profile:
    """Half the squared errors of matches as a function of readout ratio and offset, the motion fitted to each."""

    def __init__(
        self,
        inliers: Correspondences,
        rig: StereoRig,
        solver: RefinedSolver,
        motion: tuple[FloatArray, FloatArray],
        weight: float,
    ) -> None:
        """``weight``: of the squared offset, px^2, as its prior has it; infinite keeps the offset."""
        self.rig, self.solver, self.motion, self.weight = rig, solver, motion, weight
        shutter = RollingShutter(height=rig.camera.height, readout_ratio=1.0)
        orders = (inliers, reversed_in_time(inliers))
        self._bases = [measurements(order, rig, shutter, solver) for order in orders]
        packed = self._bases[0]
        self.matches = len(packed.pairs) + len(packed.tracks)
        self._tiles = _tiles(np.concatenate([packed.pairs[:, :2], packed.tracks[:, :2]]))
        self._freedom = packed.constraints - _FREEDOM

    def _packed(self, ratio: float, offset: float) -> Packed:
        """The matches at a signed ratio, with ``offset`` px less disparity."""
        base = self._bases[int(ratio < 0.0)]
        pairs, tracks = base.pairs.copy(), base.tracks.copy()
        for columns, frame in ((4, 0.0), (5, 1.0)):
            pairs[:, columns] = frame + abs(ratio) * (pairs[:, columns] - frame)
            tracks[:, columns + 2] = frame + abs(ratio) * (tracks[:, columns + 2] - frame)
        # As in ``without_offset``: the left camera's points lose half of it, the right one's gain as much.
        pairs[:, [0, 2]] -= 0.5 * offset / self.rig.camera.fx * np.sign(pairs[:, 6:7])
        tracks[:, [2, 5]] -= offset
        return replace(base, pairs=pairs, tracks=tracks, h=abs(ratio) * base.h)

    def _fitted(self, ratio: float, offset: float) -> tuple[Packed, Minimum]:
        packed = self._packed(ratio, offset)
        theta = packed.theta(*in_order(*self.motion, ratio))
        most = self.solver.max_translation_m
        return packed, levenberg_marquardt(packed.normal_equations, theta, _ITERATIONS, most)

    def _cost(self, ratio: float, offset: float) -> float:
        return self._fitted(ratio, offset)[1].cost + (0.5 * self.weight * offset**2 if self._free else 0.0)

    @property
    def _free(self) -> bool:
        return bool(np.isfinite(self.weight))

    def minimum(self, ratio: float, offset: float) -> tuple[float, float]:
        """Ratio and offset of the smallest cost near these."""
        bounds = (max(ratio - _REACH, -1.0), min(ratio + _REACH, 1.0))
        if not self._free:
            found = scipy.optimize.minimize_scalar(
                self._cost, bounds=bounds, method="bounded", options={"xatol": 1e-5}, args=(offset,)
            )
            return float(found.x), offset
        at = np.array([ratio, offset])
        for _ in range(_ITERATIONS):
            gradient, H = self._quadratic(at, 2)
            values, vectors = np.linalg.eigh(H)
            values = np.maximum(np.abs(values), 1e-6 * np.abs(values).max())  # downhill, whatever the curvature
            step = np.clip(-vectors @ (vectors.T @ gradient / values), -_LONGEST, _LONGEST)
            trial = at + step
            trial[0] = np.clip(trial[0], *bounds)
            if self._cost(*trial) >= self._cost(*at) or np.all(np.abs(trial - at) < _CLOSE):
                break
            at = trial
        return float(at[0]), float(at[1])

    def covariance(self, ratio: float, offset: float) -> FloatArray:
        """(2, 2) of ratio and offset: the larger of what noise gives, and of what tiles that err together give."""
        nothing = np.diag([np.inf, 0.0])
        at = np.array([np.clip(ratio, -1.0 + _STEPS[0], 1.0 - _STEPS[0]), offset])
        used = 2 if self._free else 1
        _, H = self._quadratic(at, used)
        if self._freedom <= 0 or not np.all(np.linalg.eigvalsh(H) > 0.0):
            return nothing
        inverse = np.linalg.inv(H)
        noise = inverse * max(2.0 * self._cost(*at) / self._freedom, LEAST_NOISE_PX**2)
        scores = self._tile_scores(at, used)
        tiles = len(scores) / max(len(scores) - 1.0, 1.0)
        together = inverse @ (tiles * scores.T @ scores) @ inverse
        out = np.zeros((2, 2))
        out[:used, :used] = together if together[0, 0] > noise[0, 0] else noise
        return out

    def _quadratic(self, at: FloatArray, used: int) -> tuple[FloatArray, FloatArray]:
        """Gradient (used,) and Hessian (used, used) of the cost, by central differences."""
        steps = np.diag(_STEPS)[:used]
        below, above = (np.array([self._cost(*(at + sign * step)) for step in steps]) for sign in (-1.0, 1.0))
        H = np.diag((below - 2.0 * self._cost(*at) + above) / _STEPS[:used] ** 2)
        if used == 2:
            corners = [s * t * self._cost(*(at + s * steps[0] + t * steps[1])) for s in (-1, 1) for t in (-1, 1)]
            H[0, 1] = H[1, 0] = sum(corners) / (4.0 * _STEPS[0] * _STEPS[1])
        return (above - below) / (2.0 * _STEPS[:used]), H

    def _tile_scores(self, at: FloatArray, used: int) -> FloatArray:
        """Gradient (tiles, used) of the cost of every tile of the image, the motion fitted to all."""
        slopes = []
        for step, size in zip(np.diag(_STEPS)[:used], _STEPS, strict=False):
            below, above = (_losses(*self._fitted(*(at + sign * step))) for sign in (-1.0, 1.0))
            slopes.append((above - below) / (2.0 * size))
        stacked = np.stack(slopes, axis=1)
        return np.array([stacked[self._tiles == tile].sum(axis=0) for tile in np.unique(self._tiles)])


def _losses(packed: Packed, fitted: Minimum) -> FloatArray:
    """Half the squared error of every pair and track, px^2."""
    return 0.5 * np.concatenate([packed.pair_residuals(fitted.theta) ** 2, packed.track_squares(fitted.theta)])


def _tiles(points: FloatArray) -> NDArray[np.int64]:
    """Number (n,) of the tile of the image that a point (n, 2) lies in: about as many points in every column."""
    tile = np.zeros(len(points), dtype=np.int64)
    for axis, count in enumerate(_TILES):
        edges = np.quantile(points[:, axis], np.arange(1, count) / count) if len(points) else np.zeros(0)
        tile = tile * count + np.searchsorted(edges, points[:, axis])
    return tile


def in_order(w: FloatArray, d: FloatArray, ratio: float) -> tuple[FloatArray, FloatArray]:
    """The motion from frame 1 to frame 0 for a negative ratio; else as it is. Its own inverse."""
    return (w, d) if ratio >= 0.0 else (-w, -so3.exp(-w) @ d)


def ordered(correspondences: Correspondences, ratio: float) -> Correspondences:
    """The matches in the order of time in which a signed readout ratio is positive."""
    return correspondences if ratio >= 0.0 else reversed_in_time(correspondences)


def reversed_in_time(correspondences: Correspondences) -> Correspondences:
    """The matches with frame 0 and frame 1 exchanged."""
    return Correspondences(
        left=_swapped(correspondences.left),
        right=_swapped(correspondences.right),
        stereo_0=correspondences.stereo_1,
        stereo_1=correspondences.stereo_0,
        tracks=_swapped(correspondences.tracks),
    )


def _swapped(matches: FloatArray) -> FloatArray:
    half = matches.shape[1] // 2
    return np.concatenate([matches[:, half:], matches[:, :half]], axis=1)


def measurements(
    correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, solver: RefinedSolver
) -> Packed:
    """All matches, of few tracks too, under the solver's motion model."""
    model, parameters = solver.motion_model, solver.motion_parameters
    return pack(correspondences, rig, shutter, model, solver.use_tracks, motion_parameters=parameters)
