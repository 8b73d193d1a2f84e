"""The linear solver of the paper "Relative Pose Estimation for Stereo Rolling Shutter Cameras", section 2.2.

Nine left and nine right matches over time (or more) give a linear system A X = 0 in 19 unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.linear_systems import (
    ROUNDING,
    null_vector,
    rotation_from_essential,
    scaled_translation,
)
from rsbench.solvers.engine.packed import Packed, pack


def system_rows(
    matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter, third_order: bool = False
) -> FloatArray:
    """Rows (n, 19) of A_1 (left) or A_2 (right), paper eq. 7-10, of matches (n, 4) x0, y0, x1, y1.

    With x, y the rays of frames 0 and 1, ``a = k3 - k1`` and s b the camera's offset, eq. 7 (s = 1) and 8
    (s = -1) give, without the eight third-order unknowns S,

        y^T E x = a [d]x - a [[w]x sb]x + a^2 [d]x[w]x - a k1 [[w]x d]x - a^2 [[w]x sb]x [w]x   between y^T and x.

    The unknowns, in the axes of this package (baseline on x), are

        d1 d2 d3 | w2 w3 | E11 E12 ... E33 of [d]x[w]x | w1w2 w1w3 w2w2 w2w3 w3w3.

    Two identities turn the terms into these: y^T [v]x x = v . (x cross y), and
    [[w]x d]x = E^T - E with E = [d]x[w]x = w d^T - (d.w) I; likewise [[w]x b]x [w]x = w (w cross b)^T.

    ``third_order`` appends the columns (n, 27) of S: of the matrix w (w cross d)^T, whose trace is zero, all
    entries but the last.
    """
    x, y = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
    k1, k3 = shutter.pixel_time(matches[:, :2], 0, side), shutter.pixel_time(matches[:, 2:], 1, side)
    a = (k3 - k1)[:, None]
    sb = rig.offset(side)[0]
    c = so3.cross(x, y)
    M = y[:, :, None] * x[:, None, :]
    by_d = a * c
    by_w = a * sb * np.stack([c[:, 2], -c[:, 1]], axis=-1)
    by_E = a[..., None] ** 2 * M - (a * k1[:, None])[..., None] * (np.swapaxes(M, 1, 2) - M)
    products = (M[:, 0, 2], -M[:, 0, 1], M[:, 1, 2], M[:, 2, 2] - M[:, 1, 1], -M[:, 2, 1])
    by_ww = a**2 * sb * np.stack(products, axis=-1)
    rows = [by_d, by_w, by_E.reshape(-1, 9), by_ww]
    if third_order:
        traceless = M - M[:, 2:, 2:] * np.eye(3)
        rows.append(-(a**2) * k1[:, None] * traceless.reshape(-1, 9)[:, :8])
    return np.concatenate(rows, axis=1)


def far_apart(matches: FloatArray, count: int) -> FloatArray:
    """``count`` of the matches (n, 4) that stand far from each other in frame 0: each farthest from those before.

    T. Gonzalez, Clustering to minimize the maximum intercluster distance, 1985.
    """
    points = matches[:, :2]
    distances = np.linalg.norm(points - np.mean(points, axis=0), axis=1)
    chosen: list[int] = []
    for _ in range(min(count, len(matches))):
        chosen.append(int(np.argmax(distances)))
        to_last = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distances = to_last if len(chosen) == 1 else np.minimum(distances, to_last)
    return matches[chosen]


@final
@dataclass(frozen=True, kw_only=True)
class LinearSolver(Solver):
    """The paper's solver; each choice that the paper leaves open is a parameter.

    The defaults are the literal reading: X is the right singular vector of the smallest singular value of A as
    equations 7 to 10 make it, of normalised rays and a baseline in metres. The paper does not say how w, d and the
    scale come out of X.
    Known defects, kept: rotation is truncated inconsistently (w2w2 and w3w3 would be inseparable otherwise);
    antisymmetric E is nearly collinear with d, so noise reaches the rotation; without readout (phi = 0) or with
    pure translation the system is singular.
    """

    sampling: Literal["all", "nine-apart"] = "all"
    """Matches that are used: all, or nine of each camera that stand far apart."""
    terms: Literal["second", "third"] = "second"
    """Order of the terms in the motion that A holds: 19 unknowns, or the 27 of which the paper drops eight."""
    scaling: Literal["none", "unit-columns"] = "none"
    """Of the columns of A before the singular value decomposition; unit columns are worse with noise."""
    baseline_unit: Literal["metre", "half-baseline"] = "metre"
    """Unit of length in A: metres, or the paper's b."""
    extraction: Literal["full", "symmetric"] = "full"
    """Entries of E = [d]x[w]x that give w: all nine, or the symmetric part, which noise reaches less."""
    scale: Literal["rotation", "constraint"] = "rotation"
    """What gives the length of d: the two entries of X that hold w alone, or the exact constraint at this w."""
    sign: Literal["cheirality", "scale"] = "cheirality"
    """What gives the sign of d: the points in front of the cameras, or the sign of the scale."""

    @property
    def spec(self) -> SolverSpec:
        least = 9 if self.terms == "second" else 13
        return SolverSpec(
            needs=frozenset({"left", "right"}),
            minimum={"left": least, "right": least},
            metric=True,
            motion_model="linear",
            shutter="rolling",
            cameras="any",
            reference_point="body",
            reference="Wang, Fan, Dai: Relative Pose Estimation for Stereo Rolling Shutter Cameras, eq. 7-10",
            assumes="small rotation, constant velocity, readout ratio above 0, generic motion, very low noise",
        )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = {side: temporal_pairs(correspondences, side) for side in SIDES}
        if self.sampling == "nine-apart":
            matches = {side: far_apart(matches[side], 9) for side in SIDES}
        short = self.spec.shortage({side: len(matches[side]) for side in SIDES})
        if short is not None:
            return short
        unit = 1.0 if self.baseline_unit == "metre" else 0.5 * rig.baseline
        scaled, third = replace(rig, baseline=rig.baseline / unit), self.terms == "third"
        A = np.concatenate([system_rows(matches[side], side, scaled, shutter, third) for side in SIDES])
        X, reason = null_vector(A, unit_columns=self.scaling == "unit-columns")
        if X is None:
            return MotionEstimate.failed(reason)
        if not np.linalg.norm(X[:3]) > ROUNDING * np.linalg.norm(X):
            return MotionEstimate.failed("no translation: its direction and the rotation are not separable")
        w = rotation_from_essential(X[5:14].reshape(3, 3), X[:3], self.extraction == "symmetric")
        packed = pack(Correspondences(**matches), rig, shutter, use_tracks=False)
        d = self._translation(X, w, unit, packed)
        if d is None or not (np.all(np.isfinite(w)) and np.all(np.isfinite(d))):
            return MotionEstimate.failed(
                "no rotation about y or z: the scale of the translation is not determined"
            )
        return MotionEstimate(w=w, d=self._signed(packed, w, d), success=True, metric=True)

    def _translation(self, X: FloatArray, w: FloatArray, unit: float, packed: Packed) -> FloatArray | None:
        """d (3,) in metres from X, which holds it times an unknown factor; None when that cannot be known."""
        factor = float(X[3:5] @ w[1:]) / max(float(w[1:] @ w[1:]), 1e-300)
        if factor == 0.0:
            return None
        d = unit * X[:3] / factor
        if self.scale == "rotation":
            return d
        by_constraint = scaled_translation(packed.pairs, w, np.inf)
        if by_constraint is None:
            return None
        return d * (float(np.linalg.norm(by_constraint)) / float(np.linalg.norm(d)))

    def _signed(self, packed: Packed, w: FloatArray, d: FloatArray) -> FloatArray:
        if self.sign == "scale":
            return d
        front, back = (packed.in_front(packed.theta(w, sign * d)) for sign in (1.0, -1.0))
        return d if front >= back else -d
