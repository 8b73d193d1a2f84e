"""Correspondences as the compiled residuals want them: normalised rays, times, cameras, each measured once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from rsbench.core.correspondences import BoolArray, Correspondences, temporal_pairs, unlinked_pairs
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.any_law import quick_law
from rsbench.solvers.engine.kernel_type import MotionKernel, load_kernel
from rsbench.solvers.engine.kernels import BEHIND, count_in_front, pair_terms
from rsbench.solvers.engine.track_kernels import track_terms


@dataclass(frozen=True, kw_only=True, eq=False)
class Packed:
    """Measurements of one problem."""

    pairs: FloatArray
    """(n, 7) or (n, 17), see ``kernels.pair_terms``."""
    tracks: FloatArray
    """(m, 8), see ``track_kernels.track_terms``, or (m, 4, 9), see ``timed_tracks.timed_track_terms``."""
    row_checks: FloatArray
    """(m,) squared row differences within the stereo pairs of the tracks: px^2, chi-squared with 2 degrees; 0 of
    tracks (m, 4, 9), whose errors hold them."""
    focal: FloatArray
    h: float
    baseline: float
    kernel: MotionKernel
    """Of the motion model."""

    @property
    def law(self) -> MotionKernel:
        """The kernel as the compiled residuals take it."""
        return quick_law(self.kernel)

    @property
    def constraints(self) -> int:
        """Number of scalar equations that depend on the motion."""
        return len(self.pairs) + (3 if self.tracks.ndim == 2 else 5) * len(self.tracks)

    @property
    def one_camera(self) -> bool:
        """Whether all are pairs of a camera that stands in the body's origin: they do not feel the length of v."""
        return len(self.tracks) == 0 and not np.any(self.pairs[:, 6])

    @property
    def parameters(self) -> int:
        """Number of unknowns of the motion that the measurements feel."""
        return 5 if self.one_camera else 6

    def held(self, theta: FloatArray, H: FloatArray) -> FloatArray:
        """H (6, 6), made definite along the length of v where nothing is felt there, which changes no step else.

        For kernels whose T is proportional to v, as of all motion models here.
        """
        length = float(np.linalg.norm(theta[3:]))
        if not self.one_camera or length == 0.0:
            return H
        out, u = H.copy(), theta[3:] / length
        out[3:, 3:] += np.trace(H[3:, 3:]) * np.outer(u, u)
        return out

    def pair_counts(self) -> dict[Side, int]:
        """Pairs of either camera."""
        left = int(np.count_nonzero(self.pairs[:, 6] >= 0.0))
        return {"left": left, "right": len(self.pairs) - left}

    def larger_side(self) -> FloatArray:
        """The pairs (n, 7) of the camera that has more of them."""
        left = self.pairs[:, 6] >= 0.0
        return self.pairs[left if 2 * np.count_nonzero(left) >= len(left) else ~left]

    def subset(self, most: int) -> Packed:
        """At most about ``most`` evenly chosen pairs and tracks, for choosing among starts."""
        step_p, step_t = max(1, len(self.pairs) // most), max(1, len(self.tracks) // most)
        return self._of(self.pairs[::step_p], self.tracks[::step_t], self.row_checks[::step_t])

    def tracks_only(self) -> Packed:
        """Without the pairs."""
        return self._of(self.pairs[:0], self.tracks, self.row_checks)

    def only(self, wanted: BoolArray) -> Packed:
        """The pairs and then the tracks of a mask (n + m,)."""
        pairs, tracks = np.split(wanted, [len(self.pairs)])
        return self._of(self.pairs[pairs], self.tracks[tracks], self.row_checks[tracks])

    def _of(self, pairs: FloatArray, tracks: FloatArray, row_checks: FloatArray) -> Packed:
        # In one piece, as they came: of other arrays the kernels would need another compilation.
        return Packed(
            pairs=np.ascontiguousarray(pairs),
            tracks=np.ascontiguousarray(tracks),
            row_checks=row_checks,
            focal=self.focal,
            h=self.h,
            baseline=self.baseline,
            kernel=self.kernel,
        )

    def normal_equations(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Half the sum of squares in px^2, its gradient (6,) and Gauss-Newton Hessian (6, 6)."""
        residuals, squares = np.zeros(len(self.pairs)), np.zeros(len(self.tracks))
        H, gradient = np.zeros((6, 6)), np.zeros(6)
        pair_terms(theta, self.law, self.pairs, self.focal, self.h, residuals, H, gradient, True)
        track_terms(theta, self.law, self.tracks, self.focal, self.h, self.baseline, squares, H, gradient, True)
        return 0.5 * float(residuals @ residuals + np.sum(squares)), gradient, self.held(theta, H)

    def pair_residuals(self, theta: FloatArray) -> FloatArray:
        """Sampson errors (n,) of the pairs, px."""
        residuals = np.zeros(len(self.pairs))
        pair_terms(
            theta, self.law, self.pairs, self.focal, self.h, residuals, np.zeros((6, 6)), np.zeros(6), False
        )
        return residuals

    def track_squares(self, theta: FloatArray) -> FloatArray:
        """Squared whitened errors (m,) of the tracks with their row checks, px^2, 5 degrees of freedom."""
        squares = np.zeros(len(self.tracks))
        track_terms(
            theta,
            self.law,
            self.tracks,
            self.focal,
            self.h,
            self.baseline,
            squares,
            np.zeros((6, 6)),
            np.zeros(6),
            False,
        )
        return np.where(squares >= BEHIND, BEHIND, squares + self.row_checks)

    def pair_costs(self, theta: FloatArray) -> FloatArray:
        """Twice what each of the pairs (n,) adds to the cost, px^2."""
        return self.pair_residuals(theta) ** 2

    def noise_variance(self, cost: float) -> float:
        """Variance (px^2) of a coordinate that the residuals show; 0 without more equations than unknowns."""
        freedom = self.constraints - self.parameters
        return 2.0 * cost / freedom if freedom > 0 else 0.0

    def covariance(self, theta: FloatArray, cost: float, H: FloatArray) -> FloatArray | None:
        """Covariance (6, 6) of theta at the minimum; None when it does not exist."""
        inverse = inverse_definite(H)
        return (
            None if inverse is None or self.constraints <= self.parameters else self.noise_variance(cost) * inverse
        )

    def in_front(self, theta: FloatArray) -> int:
        """Number of pairs whose point lies in front of both cameras."""
        return count_in_front(theta, self.law, self.pairs)

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        """Parameters (6,) of the motion (w, d)."""
        return self.kernel.theta(w, d)

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``(w, d)`` of the parameters."""
        return self.kernel.motion(theta)

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        """Derivative (6, 6) of (w, d) by the parameters."""
        return self.kernel.motion_jacobian(theta)


def inverse_definite(H: FloatArray) -> FloatArray | None:
    """Inverse of a positive definite matrix whose unknowns have different units; None when it is none."""
    scale = np.sqrt(np.maximum(np.diagonal(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    if not values[0] > 1e-12 * values[-1]:
        return None
    half = vectors / scale[:, None] / np.sqrt(values)
    return np.asarray(half @ half.T)


def pack(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    motion_model: str = "linear",
    use_tracks: bool = True,
    *,
    motion_parameters: Mapping[str, Any] | None = None,
) -> Packed:
    """Measurements of a problem.

    Args:
        motion_model: by name; the residuals are those of this model's kernel.
        use_tracks: without it, tracks count as independent left and right pairs.
        motion_parameters: the model's own.

    Raises:
        RsbenchError: no such model, or it has no kernel.
    """
    kernel = load_kernel(motion_model, motion_parameters)
    tracks = correspondences.tracks if use_tracks else correspondences.tracks[:0]
    timed = not _rectified(rig, shutter)
    pairs = [np.zeros((0, 17 if timed else 7))]
    for side in SIDES:
        if use_tracks:
            matches = getattr(correspondences, side)[unlinked_pairs(correspondences, side)]
        else:
            matches = temporal_pairs(correspondences, side)
        if len(matches):
            pairs.append(pack_pairs(matches, side, rig, shutter))
    camera = rig.camera
    checks = 0.5 * ((tracks[:, 1] - tracks[:, 3]) ** 2 + (tracks[:, 5] - tracks[:, 7]) ** 2)
    return Packed(
        pairs=np.concatenate(pairs),
        tracks=_pack_timed_tracks(tracks, rig, shutter) if timed else pack_tracks(tracks, rig, shutter),
        row_checks=np.zeros(len(tracks)) if timed else checks,
        focal=np.array([camera.fx, camera.fy]),
        h=float(shutter.rate("left")[1]),
        baseline=rig.baseline,
        kernel=kernel,
    )


def _rectified(rig: StereoRig, shutter: RollingShutter) -> bool:
    """Whether a left-right match is one row of both images, read at one time."""
    return rig.camera.lens is None and shutter.rows_together


def pack_pairs(matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """(n, 7) or (n, 17) for ``kernels.pair_terms`` from matches (n, 4) of one camera."""
    camera, ends = rig.camera, (matches[:, :2], matches[:, 2:])
    out = np.zeros((len(matches), 7 if _rectified(rig, shutter) else 17))
    out[:, :2], out[:, 2:4] = (camera.unproject(end)[:, :2] for end in ends)
    _check_rays(out[:, :4], rig)
    out[:, 4], out[:, 5] = (shutter.pixel_time(end, frame, side) for frame, end in enumerate(ends))
    out[:, 6] = rig.offset(side)[0]
    if out.shape[1] == 17:
        out[:, 7:11], out[:, 11:15] = (camera.ideal_by_pixel(end).reshape(-1, 4) for end in ends)
        out[:, 15:] = shutter.rate(side)
    return out


def _pack_timed_tracks(tracks: FloatArray, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """(n, 4, 9) for ``timed_tracks.timed_track_terms`` from tracks (n, 8)."""
    _check_origin(tracks, rig)
    out = np.zeros((len(tracks), 4, 9))
    for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
        end = tracks[:, 2 * k : 2 * k + 2]
        out[:, k, :2], out[:, k, 2] = rig.camera.unproject(end)[:, :2], shutter.pixel_time(end, frame, side)
        _check_rays(out[:, k, :2], rig)
        out[:, k, 3:7], out[:, k, 7:] = rig.camera.ideal_by_pixel(end).reshape(-1, 4), shutter.rate(side)
    return out


def _check_rays(rays: FloatArray, rig: StereoRig) -> None:
    if rig.camera.lens is not None and np.any(np.isnan(rays)):
        raise ValueError(
            f"{np.count_nonzero(np.isnan(rays[:, 0]))} matches: the lens shows no ray at their pixels"
        )


def _check_origin(tracks: FloatArray, rig: StereoRig) -> None:
    if len(tracks) and rig.origin != "middle":
        raise ValueError(f"tracks are measured about the middle of the baseline, not the {rig.origin} camera")


def pack_tracks(tracks: FloatArray, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """(n, 8) for ``track_kernels.track_terms`` from tracks (n, 8) of a rig whose rows are read together.

    Raises:
        ValueError: another rig, or one that is not described by its middle.
    """
    _check_origin(tracks, rig)
    if not _rectified(rig, shutter):
        raise ValueError("a lens, columns or a late right camera: the two ends of a stereo match have two times")
    camera = rig.camera
    middle = 0.5 * (tracks[:, [0, 1, 4, 5]] + tracks[:, [2, 3, 6, 7]])
    out = np.zeros((len(tracks), 8))
    out[:, :2] = camera.unproject(middle[:, :2])[:, :2]
    out[:, 2], out[:, 5] = tracks[:, 0] - tracks[:, 2], tracks[:, 4] - tracks[:, 6]
    out[:, 3], out[:, 4] = middle[:, 2] - camera.cx, middle[:, 3] - camera.cy
    out[:, 6], out[:, 7] = (
        shutter.pixel_time(middle[:, 2 * frame : 2 * frame + 2], frame, "left") for frame in FRAMES
    )
    return out
