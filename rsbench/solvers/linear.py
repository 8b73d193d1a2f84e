"""The paper's linear solver, a reduced and iterated variant of it, and null vectors.

"Relative Pose Estimation for Stereo Rolling Shutter Cameras", section 2.2: nine left and nine right matches
over time (or more) give a linear system A X = 0 in 19 unknowns (``LinearSolver``).

The 19 unknowns contain the antisymmetric part of E = [d]x[w]x. Its columns are nearly collinear with those of d,
which causes most of the sensitivity to noise. This part is [d x w]x / 2. Given a rotation from the previous pass,
it is linear in d and is added to the columns of d (``IteratedSolver``). The remaining quadratic terms are
symmetric, and exact to second order (the paper's antisymmetric terms in w w cancel against the second-order
rotation that it drops):

    15 unknowns  d1 d2 d3 | w2 w3 | sym(E) (6) | w1w2 w1w3 w2w3 w3w3-w2w2
    11 unknowns  without the products of w;  9 unknowns without w2, w3 too (the baseline is ignored)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np

from rsbench.core import so3
from rsbench.core.arguments import check_whole
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.packed import Packed, pack

ROUNDING = 1e-10
"""A column norm or singular value below this, relative to the largest one, counts as a rounding error. For exact
data of the slowest and flattest scenes they are above 1e-7, for singular configurations below 1e-14."""


def null_vector(A: FloatArray, unit_columns: bool, rounding: float = ROUNDING) -> tuple[FloatArray | None, str]:
    """Return X (columns,) with A X = 0, the right singular vector of the smallest singular value; or None and a
    reason.

    Args:
        A: (equations, columns).
        unit_columns: scale the columns to unit length first, which gives another estimate if A has noise.
        rounding: relative size below which column norms and singular values count as rounding errors.
    """
    columns = A.shape[1]
    if len(A) < columns - 1:
        return None, f"{len(A)} equations for {columns} unknowns"
    norms = np.linalg.norm(A, axis=0)
    if not np.min(norms) > rounding * np.max(norms):
        return None, "an unknown has no influence on any match: the motion or the scene is degenerate"
    _, s, Vt = np.linalg.svd(A / norms, full_matrices=len(A) < columns)
    if not s[columns - 2] > rounding * s[0]:
        return None, "the linear system has more than one solution: degenerate motion, scene or readout ratio"
    if unit_columns:
        return Vt[-1] / norms, ""
    return np.linalg.svd(A, full_matrices=len(A) < columns)[2][-1], ""


SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Indices of the six entries that determine a symmetric matrix."""


def symmetric(entries: FloatArray) -> FloatArray:
    """Return the symmetric matrix (3, 3) with the entries (6,) in the order of ``SYMMETRIC``."""
    out = np.zeros((3, 3))
    for value, (i, j) in zip(entries, SYMMETRIC, strict=True):
        out[i, j] = out[j, i] = value
    return out


def rotation_from_essential(E: FloatArray, d: FloatArray, symmetric: bool) -> FloatArray:
    """Solve E = [d]x[w]x = w d^T - (d.w) I for w (3,) by least squares over all entries or the symmetric part."""
    basis = np.eye(3)
    columns = np.stack([np.outer(e, d) - d[k] * np.eye(3) for k, e in enumerate(basis)])
    if symmetric:
        columns, E = columns + np.swapaxes(columns, 1, 2), E + E.T
    w, *_ = np.linalg.lstsq(columns.reshape(3, 9).T, E.reshape(9), rcond=None)
    return np.asarray(w, np.float64)


def pair_rays(pairs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rays (n, 3), z = 1, of both ends of pairs (n, 7 or 17)."""
    ones = np.ones((len(pairs), 1))
    return np.hstack([pairs[:, :2], ones]), np.hstack([pairs[:, 2:4], ones])


def scaled_translation(pairs: FloatArray, w: FloatArray, limit: float) -> FloatArray | None:
    """Return d (3,) in metres for a known rotation; None if the pairs do not determine a length below ``limit``.

    For a given w, the exact constraint of the paper's motion is linear in d: ``m . d + beta = 0``. The smallest
    singular vector of [m, beta] gives d with its length.
    """
    x, y = pair_rays(pairs)
    R = so3.exp((pairs[:, 5] - pairs[:, 4])[:, None] * w)
    normal = so3.cross((R @ x[:, :, None])[:, :, 0], y)
    back = (np.swapaxes(R, 1, 2) @ normal[:, :, None])[:, :, 0]
    m = pairs[:, 5:6] * normal - pairs[:, 4:5] * back
    beta = pairs[:, 6] * (normal[:, 0] - back[:, 0])
    norms = np.array([np.linalg.norm(m), np.linalg.norm(beta)])
    if not np.all(norms > 0.0):
        return None
    _, _, Vt = np.linalg.svd(np.column_stack([m / norms[0], beta / norms[1]]), full_matrices=len(pairs) < 4)
    d, factor = Vt[-1, :3] / norms[0], Vt[-1, 3] / norms[1]
    if not abs(factor) * limit > np.linalg.norm(d):
        return None
    return d / factor


def system_rows(
    matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter, third_order: bool = False
) -> FloatArray:
    """Return rows (n, 19) of A_1 (left) or A_2 (right), paper eq. 7-10, for matches (n, 4) x0, y0, x1, y1.

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
    x, y = (rig.eye(side).unproject(matches[:, k : k + 2]) for k in (0, 2))
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
    """Select ``count`` of the matches (n, 4) that are far from each other in frame 0, by farthest-point sampling.

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
    """The paper's solver; each choice that the paper does not specify is a parameter.

    The defaults take the paper literally: X is the right singular vector of the smallest singular value of A from
    equations 7 to 10, with normalised rays and a baseline in metres. The paper does not specify how w, d and the
    scale are computed from X.
    Known defects are kept: the rotation is truncated inconsistently (otherwise w2w2 and w3w3 would be
    inseparable); the antisymmetric part of E is nearly collinear with d, so the rotation is sensitive to noise;
    for a global shutter (phi = 0) or a pure translation, the system is singular.
    """

    sampling: Literal["all", "nine-apart"] = "all"
    """Matches that are used: all, or nine of each camera that are far apart in the image."""
    terms: Literal["second", "third"] = "second"
    """Highest order in the motion of the terms in A: 19 unknowns, or 27 with the eight that the paper drops."""
    scaling: Literal["none", "unit-columns"] = "none"
    """Scaling of the columns of A before the singular value decomposition; unit columns are worse with noise."""
    baseline_unit: Literal["metre", "half-baseline"] = "metre"
    """Unit of length in A: metres, or the paper's b."""
    extraction: Literal["full", "symmetric"] = "full"
    """Entries of E = [d]x[w]x that give w: all, or the symmetric part, which is less sensitive to noise."""
    scale: Literal["rotation", "constraint"] = "rotation"
    """Source of the length of d: the entries of X for w2 and w3, or the exact constraint for the estimated w."""
    sign: Literal["cheirality", "scale"] = "cheirality"
    """Source of the sign of d: the points in front of the cameras, or the sign of the scale."""

    @property
    def spec(self) -> SolverSpec:
        least = 9 if self.terms == "second" else 13
        return SolverSpec(
            needs=frozenset({"left", "right"}),
            minimum={"left": least, "right": least},
            metric=True,
            motion_model="linear",
            shutter="rolling",
            cameras="rig",
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
        if short := self.spec.shortage({side: len(matches[side]) for side in SIDES}):
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
        d = d if self.sign == "scale" else packed.signed(w, d)
        return MotionEstimate(w=w, d=d, success=True, metric=True)

    def _translation(self, X: FloatArray, w: FloatArray, unit: float, packed: Packed) -> FloatArray | None:
        """Return d (3,) in metres from X, which is known up to a factor; None if the factor is undetermined."""
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


def reduced_blocks(pairs: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return two blocks (n, 3) for the columns of d, and the other columns (n, 12).

    For a rotation w, the columns of d are ``first + cross(w, second)``.
    """
    x, y = pair_rays(pairs)
    k1, k3, sb = pairs[:, 4], pairs[:, 5], pairs[:, 6]
    a = k3 - k1
    c = so3.cross(x, y)
    M = y[:, :, None] * x[:, None, :]
    M = M + np.swapaxes(M, 1, 2)
    by_w = (a * sb)[:, None] * np.column_stack([c[:, 2], -c[:, 1]])
    by_E = [a**2 * M[:, i, j] * (0.5 if i == j else 1.0) for i, j in SYMMETRIC]
    products = (M[:, 0, 2], -M[:, 0, 1], M[:, 2, 2] - M[:, 1, 1], -M[:, 1, 2])
    by_ww = [a**2 * sb * product / 2 for product in products]
    shifted = (a * (k1 + k3) / 2)[:, None] * c
    return a[:, None] * c, shifted, np.column_stack([by_w, *by_E, *by_ww])


def solve_reduced(pairs: FloatArray, unknowns: int, passes: int) -> tuple[FloatArray, FloatArray] | str:
    """Return ``(w, d)`` from pairs (n, 7), with d of length 1 and any sign; or the reason of a failure."""
    by_d, shifted, rest = reduced_blocks(pairs)
    rest = rest[:, {15: slice(12), 11: slice(8), 9: slice(2, 8)}[unknowns]]
    first_E = 3 + (0 if unknowns == 9 else 2)
    w = d = np.zeros(3)
    for _ in range(passes):
        X, reason = null_vector(np.concatenate([by_d + so3.cross(w, shifted), rest], axis=1), unit_columns=True)
        if X is None:
            return reason
        d = X[:3]
        if not np.linalg.norm(d) > 1e-10 * np.linalg.norm(X):
            return "no translation: its direction and the rotation are not separable"
        w = rotation_from_essential(symmetric(X[first_E : first_E + 6]), d, symmetric=True)
        if not np.linalg.norm(w) < np.pi / 2:
            return "the passes ran away: no small rotation fits"
    return w, d / np.linalg.norm(d)


def length_from_tracks(tracks: FloatArray, packed: Packed, w: FloatArray, u: FloatArray) -> float | None:
    """Return the signed length, metres, of a translation along u (3,) for a known rotation, from tracks; or None.

    A left-right match gives its point's inverse depth rho, so that ``y x (R x + rho s T(u)) = 0`` is linear in the
    length s, and s is a least-squares quotient over all tracks. If each end of a track has its own time (tracks
    (n, 4, 9)), the equations of the four rays are linear in s and the point, which is eliminated.
    """
    if tracks.ndim == 3:
        return _length_from_rays(tracks, packed.baseline, w, u)
    ones = np.ones(len(tracks))
    x = np.column_stack([tracks[:, :2], ones])
    y = np.column_stack([tracks[:, 3:5] / packed.focal, ones])
    rho = tracks[:, 2] / (packed.focal[0] * packed.baseline)
    tau0, tau1 = tracks[:, 6], tracks[:, 7]
    R = so3.exp((tau1 - tau0)[:, None] * w)
    turned = so3.cross(y, (R @ x[:, :, None])[:, :, 0])
    moved = rho[:, None] * so3.cross(y, tau1[:, None] * u - tau0[:, None] * (R @ u))
    squares = float(np.sum(moved * moved))
    return -float(np.sum(moved * turned)) / squares if squares > 0.0 else None


def _length_from_rays(tracks: FloatArray, baseline: float, w: FloatArray, u: FloatArray) -> float | None:
    """Do the same for tracks (n, 4, 9); dividing by the depth from frame 0 makes the residuals errors of rays."""
    rho = np.maximum(tracks[:, 0, 0] - tracks[:, 1, 0], 0.0)[:, None, None] / baseline
    x, tau = tracks[:, :, :2, None], tracks[:, :, 2, None]
    R, o = so3.exp(tau * w), baseline * np.array([[0.5], [-0.5], [0.5], [-0.5]]) * np.array([1.0, 0.0, 0.0])
    by_point, by_length, rest = (
        (rho * (each[:, :, :2] - x * each[:, :, 2:]).reshape(len(tracks), 8, -1))
        for each in (R, (tau * u)[..., None], np.broadcast_to(o[..., None], (len(tracks), 4, 3, 1)))
    )
    found = np.concatenate([by_length, rest], axis=2)
    found = found - by_point @ (np.linalg.pinv(by_point) @ found)
    squares = float(np.sum(found[:, :, 0] ** 2))
    return -float(np.sum(found[:, :, 0] * found[:, :, 1])) / squares if squares > 0.0 else None


@final
@dataclass(frozen=True, kw_only=True)
class IteratedSolver(Solver):
    """The reduced linear system, solved by repeated SVD with the rotation of the previous pass; no descent.

    Columns are scaled to unit length, unlike in the paper. This leaves the median error unchanged and lowers the
    mean error with nine matches or at 0.8 px of noise by a third. The refined solver starts from this solution
    with pairs.
    """

    unknowns: Literal[9, 11, 15] = 15
    """Unknowns of the linear system: 15; 11 without the products of w; 9 without w2 and w3 too."""
    scale: Literal["pairs", "tracks"] = "pairs"
    """Source of the length of d: the exact constraint of the pairs, or left-right matches of tracks."""
    passes: int = 5
    """Number of solutions of the linear system, each with the rotation of the previous one."""
    max_translation_m: float = 50.0
    """Largest length of d per frame period that counts as determined, metres."""

    def __post_init__(self) -> None:
        check_whole("passes", self.passes, 1, 10_000)

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": 7, "right": 7} if self.scale == "pairs" else {"tracks": 7}
        return SolverSpec(
            needs=frozenset(minimum),
            minimum=minimum,
            metric=True,
            motion_model="linear",
            shutter="rolling",
            cameras="rig",
            reference_point="body",
            reference="rsbench; after Wang, Fan, Dai, eq. 7-10, with the antisymmetric part of E folded into d",
            assumes="small rotation, constant velocity, a scene that is not planar, translation",
        )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        packed = pack(correspondences, rig, shutter, use_tracks=False)
        if short := self.spec.shortage({**packed.pair_counts(), "tracks": len(correspondences.tracks)}):
            return short
        solution = solve_reduced(packed.pairs, self.unknowns, self.passes)
        if isinstance(solution, str):
            return MotionEstimate.failed(solution)
        w, d = solution
        if self.scale == "tracks":
            linked = pack(Correspondences(tracks=correspondences.tracks), rig, shutter)
            length = length_from_tracks(linked.tracks, packed, w, d)
            if length is None or not 0.0 < abs(length) <= self.max_translation_m:
                return MotionEstimate.failed("the left-right matches do not determine the length of d")
            return MotionEstimate(w=w, d=length * d, success=True, metric=True)
        return with_scale_and_sign(packed, w, d, self.max_translation_m)


def with_scale_and_sign(packed: Packed, w: FloatArray, d: FloatArray, limit: float) -> MotionEstimate:
    """Return the estimate with the sign of d from cheirality and its length from ``scaled_translation``."""
    scaled = scaled_translation(packed.pairs, w, limit)
    metric = scaled is not None
    if scaled is not None:
        d = d / np.linalg.norm(d) * np.linalg.norm(scaled)
    reason = "" if metric else "the length of d is not determined by these matches"
    return MotionEstimate(w=w, d=packed.signed(w, d), success=True, metric=metric, reason=reason)
