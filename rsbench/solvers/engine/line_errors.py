"""Errors of straight lines in the four images of a global shutter, and their normal equations.

A 3-D line has four unknowns. Here they are where it passes the two ends that the left camera saw at time 0, in
that image across the line that was seen, and the inverse depths there: its images are nearly linear in them at any
distance. An error is the distance of an observed end from the line's image. For a given
motion the four are eliminated by Gauss-Newton steps, each line alone; what is left of its eight errors has four
degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import BoolArray
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.so3 import FloatArray, cross

FREEDOM = 4
LEAST_SLOPE = np.sin(np.radians(10.0))
"""Sine of the least angle to the baseline, below which a line's left and right planes are nearly one."""
_HELD = 1e-12
"""Share of the diagonal that keeps a line without depth from failing the others."""


def line_rays(lines: FloatArray, rig: StereoRig) -> FloatArray:
    """Rays (..., 4, 2, 3) of the ends of lines (..., 16): images left 0, right 0, left 1, right 1."""
    return rig.camera.unproject(lines.reshape(*lines.shape[:-1], 4, 2, 2))


def line_normals(rays: FloatArray) -> FloatArray:
    """Normals (..., 4, 3) of the planes of image lines, (a, b, c) with a^2 + b^2 = 1: a ray's product with it is
    its distance from the line, in units of the focal length; NaN where both ends are one."""
    n = cross(rays[..., 0, :], rays[..., 1, :])
    with np.errstate(invalid="ignore"):
        return np.asarray(n / np.hypot(n[..., 0], n[..., 1])[..., None])


def inverse_depths(rays: FloatArray, rig: StereoRig) -> FloatArray:
    """Inverse depths (..., 2, 2) by frame and end, 1 / m, of the ends that the left camera saw in either frame."""
    normals = line_normals(rays)[..., 1::2, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.sum(normals[..., None, :] * rays[..., ::2, :, :], axis=-1)
        return np.asarray(along / (normals[..., None, 0] * rig.baseline))


def usable_lines(lines: FloatArray, rig: StereoRig) -> BoolArray:
    """Mask (n,) of the lines whose stereo is no degenerate one, and in front of the cameras at both times."""
    rays = line_rays(lines, rig)
    steep = np.all(np.abs(line_normals(rays)[..., 0]) >= LEAST_SLOPE, axis=-1)
    return np.asarray(steep & np.all(inverse_depths(rays, rig) > 0.0, axis=(-2, -1)))


def stereo_ends(rays: FloatArray, rig: StereoRig) -> FloatArray:
    """Points (..., 2, 2, 3) of lines by frame, two each, metres, in the body as it is then."""
    near = inverse_depths(rays, rig)
    return np.asarray(rays[..., ::2, :, :] / near[..., None] - rig.offset("left"))


class _State(NamedTuple):
    """Errors (n, 8), px, with their derivatives by the line (n, 8, 4) and the motion (n, 8, 6), by a turn from
    the left and a shift; ``front``, whether the line is in front of all cameras."""

    r: FloatArray
    by_line: FloatArray
    by_motion: FloatArray
    front: BoolArray


@dataclass(frozen=True, kw_only=True, eq=False)
class LineErrors:
    """Lines of one problem."""

    rays: FloatArray
    """(n, 4, 2, 3)"""
    across: FloatArray
    """(n, 3) direction in the left image of frame 0 across the line."""
    start: FloatArray
    """(n, 4): shifts across, 0, then inverse depths of both ends, 1 / m."""
    rig: StereoRig

    @classmethod
    def of(cls, lines: FloatArray, rig: StereoRig) -> LineErrors:
        """Of lines (n, 16) that are usable."""
        rays = line_rays(lines, rig)
        across = line_normals(rays)[:, 0] * [1.0, 1.0, 0.0]
        near = inverse_depths(rays, rig)[:, 0]
        return cls(rays=rays, across=across, start=np.concatenate([0.0 * near, near], axis=1), rig=rig)

    def only(self, wanted: BoolArray) -> LineErrors:
        """Those of a mask (n,)."""
        return LineErrors(
            rays=self.rays[wanted], across=self.across[wanted], start=self.start[wanted], rig=self.rig
        )

    def squares(self, w: FloatArray, d: FloatArray, steps: int = 1) -> FloatArray:
        """Sums (n,) of squared errors, px^2, after so many steps of each line; infinite behind a camera."""
        state = self._settled(so3.exp(w), d, steps)
        squares = np.sum(state.r**2, axis=1)
        return np.where(state.front & (squares >= 0.0), squares, np.inf)

    def normal_equations(
        self, w: FloatArray, d: FloatArray, steps: int = 3
    ) -> tuple[float, FloatArray, FloatArray]:
        """Half the sum of squares in px^2, its gradient (6,) and Gauss-Newton Hessian (6, 6) by (w, d)."""
        state = self._settled(so3.exp(w), d, steps)
        A = state.by_line
        J = state.by_motion.copy()
        J[..., :3] = J[..., :3] @ so3.left_jacobian(w)
        rest = J - A @ _solve(A, J)
        gradient, H = np.einsum("nij,ni->j", rest, state.r), np.einsum("nij,nik->jk", rest, J)
        return 0.5 * float(np.sum(state.r**2)), gradient, 0.5 * (H + H.T)

    def _settled(self, R: FloatArray, d: FloatArray, steps: int) -> _State:
        """At the lines that fit all images best."""
        unknowns = self.start
        for _ in range(steps):
            state = self._state(R, d, unknowns)
            unknowns = unknowns - _solve(state.by_line, state.r[..., None])[..., 0]
        return self._state(R, d, unknowns)

    def _state(self, R: FloatArray, d: FloatArray, unknowns: FloatArray) -> _State:
        n, focal = len(self.rays), np.array([self.rig.camera.fx, self.rig.camera.fy, np.inf])
        left, shift, near = self.rig.offset("left"), unknowns[:, :2], unknowns[:, 2:]
        at = self.rays[:, 0] + shift[..., None] * self.across[:, None]
        r, by_line, by_motion = np.zeros((n, 4, 2)), np.zeros((n, 4, 2, 4)), np.zeros((n, 4, 2, 6))
        front = np.all(near > 0.0, axis=1)
        for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
            Q, T = (R, d + self.rig.offset(side)) if frame else (np.eye(3), self.rig.offset(side))
            turned = (at - near[..., None] * left) @ Q.T
            ends = turned + near[..., None] * T
            front &= np.all(ends[..., 2] > 0.0, axis=1)
            m = cross(ends[:, 0], ends[:, 1])
            slope = m / focal
            h = np.sqrt(np.sum(slope**2, axis=-1))[:, None, None]
            seen = self.rays[:, k] / h
            r[:, k] = np.sum(seen * m[:, None], axis=-1)
            g = seen - r[:, k, :, None] * (slope / focal)[:, None] / h**2
            # By the points a and b (n, ends, 3) whose plane it is.
            by = (cross(ends[:, None, 1], g), cross(g, ends[:, None, 0]))
            for p in (0, 1):
                by_line[:, k, :, p] = np.sum(by[p] * (self.across @ Q.T)[:, None], axis=-1)
                by_line[:, k, :, 2 + p] = by[p] @ (T - Q @ left)
                if frame:
                    by_motion[:, k, :, :3] += cross(turned[:, None, p], by[p])
                    by_motion[:, k, :, 3:] += near[:, p, None, None] * by[p]
        return _State(r.reshape(n, 8), by_line.reshape(n, 8, 4), by_motion.reshape(n, 8, 6), front)


def _solve(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least squares (n, 4, k) of A (n, 8, 4) x = b (n, 8, k)."""
    At = np.swapaxes(A, -1, -2)
    N = At @ A
    diagonal = np.arange(N.shape[-1])
    N[:, diagonal, diagonal] *= 1.0 + _HELD
    N[:, diagonal, diagonal] += 1e-300
    return np.linalg.solve(N, At @ b).astype(np.float64)
