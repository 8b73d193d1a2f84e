"""The linear solver of the paper "Relative Pose Estimation for Stereo Rolling Shutter Cameras", section 2.2.

Nine left and nine right matches over time (or more) give a linear system A X = 0 in 19 unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.packed import pack

_ROUNDING = 1e-10
"""Below this, relative to the largest, a column norm or singular value of A is rounding. Exact data of the
slowest and flattest scenes stay above 1e-7; singular configurations below 1e-14."""


def system_rows(matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Rows (n, 19) of A_1 (left) or A_2 (right), paper eq. 7-10, of matches (n, 4) x0, y0, x1, y1.

    With x, y the rays of frames 0 and 1, ``a = k3 - k1`` and s b the camera's offset, eq. 7 (s = 1) and 8
    (s = -1) give, without the eight third-order unknowns S,

        y^T E x = a [d]x - a [[w]x sb]x + a^2 [d]x[w]x - a k1 [[w]x d]x - a^2 [[w]x sb]x [w]x   between y^T and x.

    The unknowns, in the axes of this package (baseline on x), are

        d1 d2 d3 | w2 w3 | E11 E12 ... E33 of [d]x[w]x | w1w2 w1w3 w2w2 w2w3 w3w3.

    Two identities turn the terms into these: y^T [v]x x = v . (x cross y), and
    [[w]x d]x = E^T - E with E = [d]x[w]x = w d^T - (d.w) I; likewise [[w]x b]x [w]x = w (w cross b)^T.
    """
    x, y = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
    k1, k3 = shutter.row_time(matches[:, 1], 0), shutter.row_time(matches[:, 3], 1)
    a = (k3 - k1)[:, None]
    sb = rig.offset(side)[0]
    c = np.cross(x, y)
    M = y[:, :, None] * x[:, None, :]
    by_d = a * c
    by_w = a * sb * np.stack([c[:, 2], -c[:, 1]], axis=-1)
    by_E = a[..., None] ** 2 * M - (a * k1[:, None])[..., None] * (np.swapaxes(M, 1, 2) - M)
    products = (M[:, 0, 2], -M[:, 0, 1], M[:, 1, 2], M[:, 2, 2] - M[:, 1, 1], -M[:, 2, 1])
    by_ww = a**2 * sb * np.stack(products, axis=-1)
    return np.concatenate([by_d, by_w, by_E.reshape(-1, 9), by_ww], axis=1)


def null_vector(A: FloatArray) -> tuple[FloatArray | None, str]:
    """X (columns,) with A X = 0, by the SVD of A with unit columns; or None and what makes it ambiguous."""
    columns = A.shape[1]
    if len(A) < columns - 1:
        return None, f"{len(A)} equations for {columns} unknowns"
    norms = np.linalg.norm(A, axis=0)
    if not np.min(norms) > _ROUNDING * np.max(norms):
        return None, "an unknown has no influence on any match: the motion or the scene is degenerate"
    _, s, Vt = np.linalg.svd(A / norms, full_matrices=len(A) < columns)
    if not s[columns - 2] > _ROUNDING * s[0]:
        return None, "the linear system has more than one solution: degenerate motion, scene or readout ratio"
    return Vt[-1] / norms, ""


def rotation_from_essential(E: FloatArray, d: FloatArray, symmetric: bool) -> FloatArray:
    """w (3,) from E = [d]x[w]x = w d^T - (d.w) I, by least squares over all nine entries or the symmetric part."""
    basis = np.eye(3)
    columns = np.stack([np.outer(e, d) - d[k] * np.eye(3) for k, e in enumerate(basis)])
    if symmetric:
        columns, E = columns + np.swapaxes(columns, 1, 2), E + E.T
    w, *_ = np.linalg.lstsq(columns.reshape(3, 9).T, E.reshape(9), rcond=None)
    return w


@final
@dataclass(frozen=True, kw_only=True)
class LinearSolver(Solver):
    """The paper's solver as published.

    The paper leaves open how w, d and the scale come out of X, and how the sign is chosen. Here w is the
    least-squares solution of E = [d]x[w]x, the scale comes from the two entries of X that hold rotation
    alone, and the sign of d from cheirality. Known defects, kept: rotation is truncated inconsistently
    (w2w2 and w3w3 would be inseparable otherwise), antisymmetric E is nearly collinear with d, so noise of 0.1 px
    hides the rotation; without readout (phi = 0) or with pure translation the system is singular.
    """

    extraction: Literal["full", "symmetric"] = "full"
    """Entries of E that give w: all nine, or the symmetric part, which noise reaches less."""

    spec = SolverSpec(
        needs=frozenset({"left", "right"}),
        minimum={"left": 9, "right": 9},
        metric=True,
        motion_model="linear",
        shutter="rolling",
        reference_point="body",
        reference="Wang, Fan, Dai: Relative Pose Estimation for Stereo Rolling Shutter Cameras, eq. 7-10",
        assumes="small rotation, constant velocity, readout ratio above 0, generic motion, very low noise",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = {side: temporal_pairs(correspondences, side) for side in SIDES}
        short = self.spec.shortage({side: len(matches[side]) for side in SIDES})
        if short is not None:
            return short
        A = np.concatenate([system_rows(matches[side], side, rig, shutter) for side in SIDES])
        X, reason = null_vector(A)
        if X is None:
            return MotionEstimate.failed(reason)
        return self._extract(X, correspondences, rig, shutter)

    def _extract(
        self, X: FloatArray, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        """w, d and scale from X, which holds them times an unknown factor."""
        if not np.linalg.norm(X[:3]) > _ROUNDING * np.linalg.norm(X):
            return MotionEstimate.failed("no translation: its direction and the rotation are not separable")
        w = rotation_from_essential(X[5:14].reshape(3, 3), X[:3], self.extraction == "symmetric")
        factor = float(X[3:5] @ w[1:]) / max(float(w[1:] @ w[1:]), 1e-300)
        d = X[:3] / factor if factor != 0.0 else np.full(3, np.inf)
        if not (np.all(np.isfinite(w)) and np.all(np.isfinite(d))):
            return MotionEstimate.failed(
                "no rotation about y or z: the scale of the translation is not determined"
            )
        packed = pack(correspondences, rig, shutter, use_tracks=False)
        front, back = (packed.in_front(packed.theta(w, sign * d)) for sign in (1.0, -1.0))
        return MotionEstimate(w=w, d=d if front >= back else -d, success=True, metric=True)
