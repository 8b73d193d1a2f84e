"""Solvers of Zhuang et al.: differential motion of one rolling-shutter camera, and flow scaled to a global
shutter.

B. Zhuang, L.-F. Cheong, G. H. Lee, Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017.

A camera whose points move by ``dX/dtau = w x X + v`` shows, to first order in the motion, the flow

    u = beta P(x) (w x x + v / Z),   P(x) = [I | -x] (2, 3),   x the ray of frame 0,

Eliminating the depth gives ``v . (x x u) + beta x^T s x = 0`` with ``s = (v w^T + w v^T) / 2 - (v . w) I``, the
differential epipolar constraint (Y. Ma, J. Kosecka, S. Sastry, IJCV 2000), which is linear in v and s. beta is the
duration of the flow in frame periods: tau1 - tau0 at constant velocity, and at constant acceleration k

    beta = (alpha + k alpha_k) 2 / (2 + k),   alpha = tau1 - tau0,   alpha_k = (tau1^2 - tau0^2) / 2.

Then (v (2 + k) / 2, s) is a null vector of Z(k) = Z0 + k Z1, so that for nine matches k is a generalised
eigenvalue (``ZhuangSolver``).

At constant velocity, the flow of a match with a duration of ``a = 1 + h (y1 - y0)`` frame periods is a times as
long as the flow in one period. If flows are scaled by 1 / a, any global-shutter solver can be used for a rolling
shutter and a constant twist (``FlowScaledSolver``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, final

import numpy as np
import scipy

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs, track_pairs, without_lens
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import (
    MatchSet,
    MotionEstimate,
    Solver,
    SolverEntry,
    SolverSpec,
    load_solver_entry,
)
from rsbench.solvers.linear import ROUNDING, SYMMETRIC, rotation_from_essential, symmetric

_SLOWEST, _FASTEST = -0.49, 3.0
"""Range of accelerations k; with k at or below -0.5, the camera would stop and reverse before the last row."""
_GRID = 29
_K_STEPS = 8


class Flow(NamedTuple):
    """Optical flow of n matches of one camera."""

    x: FloatArray
    """(n, 3) rays of frame 0, z = 1."""
    u: FloatArray
    """(n, 3) changes of these rays from frame 0 to frame 1; the third component is 0."""
    alpha: FloatArray
    """(n,) durations tau1 - tau0, frame periods."""
    alpha_k: FloatArray
    """(n,) half the difference of the squared times."""
    focal: FloatArray
    """(2,) px."""

    @classmethod
    def of(cls, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter) -> Flow:
        matches = temporal_pairs(correspondences, "left")
        x, y = (rig.eye("left").unproject(matches[:, k : k + 2]) for k in (0, 2))
        tau0 = shutter.pixel_time(matches[:, :2], 0, "left")
        tau1 = shutter.pixel_time(matches[:, 2:], 1, "left")
        focal = np.array([rig.camera.fx, rig.camera.fy])
        return cls(x, y - x, tau1 - tau0, 0.5 * (tau1**2 - tau0**2), focal)

    def beta(self, k: float) -> FloatArray:
        """Return the fraction (n,) of the motion of one frame period that occurs during each flow."""
        return np.asarray((self.alpha + k * self.alpha_k) * (2.0 / (2.0 + k)))

    def system(self) -> tuple[FloatArray, FloatArray]:
        """Return Z0 and Z1 (n, 9), with columns for v and for the six entries of s."""
        x = self.x
        quadratic = [x[:, i] * x[:, j] * (1.0 if i == j else 2.0) for i, j in SYMMETRIC]
        q, c = np.stack(quadratic, axis=-1), so3.cross(x, self.u)
        return np.hstack([c, self.alpha[:, None] * q]), np.hstack([0.0 * c, self.alpha_k[:, None] * q])


class Velocity(NamedTuple):
    """Angular velocity w (3,), linear velocity v (3,) of length 1, and acceleration k."""

    w: FloatArray
    v: FloatArray
    k: float


def null_vectors(Z: FloatArray) -> FloatArray:
    """Return null vectors (..., 9) of systems (..., n, 9), n >= 8, scaled to unit columns; NaN if not unique.

    For a translation along an axis without rotation, the column of that axis is zero, and the null vector is that
    axis.
    """
    norms = np.linalg.norm(Z, axis=-2, keepdims=True)
    norms = np.where(norms > ROUNDING * np.max(norms, axis=-1, keepdims=True), norms, 1.0)
    finite = np.all(np.isfinite(Z), axis=(-2, -1))
    _, s, Vt = np.linalg.svd(np.where(finite[..., None, None], Z, 0.0) / norms, full_matrices=Z.shape[-2] < 9)
    good = s[..., 7] > ROUNDING * s[..., 0]
    return np.where(good[..., None], Vt[..., -1, :] / norms[..., 0, :], np.nan)


def accelerations(Z0: FloatArray, Z1: FloatArray) -> list[float]:
    """Return values of k for which Z0 + k Z1 (n, 9) has a null vector (nearly, if n > 9)."""
    if len(Z0) > 9:
        return _fitting_accelerations(Z0, Z1)
    # The columns of v do not depend on k. Projecting orthogonally to them leaves a square pencil for s.
    across = np.linalg.svd(Z0[:, :3])[0][:, 3:]
    P, P_k = across.T @ Z0[:, 3:], across.T @ Z1[:, 3:]
    values: Any = scipy.linalg.eig(P, -P_k, right=False)
    real = values[np.isfinite(values) & (np.abs(values.imag) <= 1e-9 * (1.0 + np.abs(values.real)))].real
    return [k for k in sorted(map(float, real), key=abs) if _SLOWEST < k < _FASTEST]


def _fitting_accelerations(Z0: FloatArray, Z1: FloatArray) -> list[float]:
    """Return the k that minimises the smallest singular value, from a grid search and Gauss-Newton steps."""
    norms = np.maximum(np.linalg.norm(Z0, axis=0), 1e-300)
    Z0, Z1, grid = Z0 / norms, Z1 / norms, np.linspace(_SLOWEST, _FASTEST, _GRID)
    M00, M01, M11 = Z0.T @ Z0, Z0.T @ Z1, Z1.T @ Z1
    M = M00 + grid[:, None, None] * (M01 + M01.T) + grid[:, None, None] ** 2 * M11
    size = np.trace(M, axis1=1, axis2=2)
    k = float(grid[np.argmin(np.linalg.eigvalsh(M)[:, 0] / size)])
    for _ in range(_K_STEPS):
        # Gauss-Newton step, in which the other singular vectors absorb as much as possible of the change with k.
        U, s, Vt = np.linalg.svd(Z0 + k * Z1, full_matrices=False)
        change = Z1 @ Vt[-1]
        left = change - U[:, :-1] @ (U[:, :-1].T @ change)
        k -= float(s[-1] * (U[:, -1] @ change)) / max(float(left @ left), 1e-300)
        k = float(np.clip(k, _SLOWEST, _FASTEST))
    return [k]


def velocity_of(flow: Flow, e: FloatArray, k: float) -> Velocity | str:
    """Return the velocity from a null vector (9,), the sign of v by cheirality; or the reason of a failure."""
    if not np.all(np.isfinite(e)):
        return "the linear system has more than one solution: degenerate motion or scene"
    v = e[:3] * (2.0 / (2.0 + k))
    if not np.linalg.norm(v) > ROUNDING * np.linalg.norm(e):
        return "no translation: its direction and the rotation are not separable"
    w = rotation_from_essential(symmetric(e[3:]), v, symmetric=True)
    if not np.linalg.norm(w) < np.pi / 2:
        return "no small rotation fits"
    return _in_front(flow, Velocity(w, v / np.linalg.norm(v), k))


def _fields(flow: Flow, found: Velocity) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the derotated flow, the flow of the translation at unit depth, and the flow of the rotation.

    They are (n, 2), px; the latter two are for one frame period.
    """
    x = flow.x

    def seen(rate: FloatArray) -> FloatArray:
        return flow.focal * (rate[:, :2] - x[:, :2] * rate[:, 2:])

    turned = seen(so3.cross(found.w, x))
    return flow.focal * flow.u[:, :2] - flow.beta(found.k)[:, None] * turned, seen(found.v[None]), turned


def _in_front(flow: Flow, found: Velocity) -> Velocity:
    rest, moved, _ = _fields(flow, found)
    votes = np.sum(np.sign(np.sum(rest * moved, axis=1) * flow.beta(found.k)))
    return found if votes >= 0 else found._replace(v=-found.v)


def reprojection(flow: Flow, found: Velocity) -> tuple[FloatArray, FloatArray]:
    """Return errors (n,), px, of flows at their best depths, and derivatives (n, 7) by w, v and k."""
    rest, moved, turned = _fields(flow, found)
    length = np.maximum(np.linalg.norm(moved, axis=1), 1e-300)[:, None]
    along = moved / length
    across = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    residuals = np.sum(rest * across, axis=1)
    rate = np.zeros((len(flow.x), 2, 3))  # of P(x) V in px by V
    rate[:, 0, 0], rate[:, 1, 1], rate[:, :, 2] = flow.focal[0], flow.focal[1], -flow.focal * flow.x[:, :2]
    J = np.zeros((len(flow.x), 7))
    sideways = np.einsum("ni,nij->nj", across, rate)
    J[:, :3] = -flow.beta(found.k)[:, None] * so3.cross(flow.x, sideways)
    J[:, 3:6] = -(np.sum(rest * along, axis=1) / length[:, 0])[:, None] * sideways
    scale = 2.0 / (2.0 + found.k)
    by_k = scale * flow.alpha_k - flow.beta(found.k) / (2.0 + found.k)
    J[:, 6] = -by_k * np.sum(turned * across, axis=1)
    return residuals, J


def refine(flow: Flow, start: Velocity, accelerated: bool) -> Velocity:
    """Minimise ``reprojection`` by least squares, the paper's second stage.

    Return the start if there are too few matches, or the result is not finite or has k out of range.
    """
    columns = 7 if accelerated else 6

    def velocity(p: FloatArray) -> Velocity:
        return Velocity(p[:3], p[3:6] / np.linalg.norm(p[3:6]), float(p[6]) if accelerated else start.k)

    def jacobian(p: FloatArray) -> FloatArray:
        found = velocity(p)
        J = reprojection(flow, found)[1][:, :columns]
        J[:, 3:6] = (J[:, 3:6] - np.outer(J[:, 3:6] @ found.v, found.v)) / np.linalg.norm(p[3:6])
        return J

    p = np.concatenate([start.w, start.v, [start.k]])[:columns]
    if len(flow.x) < columns:
        return start

    def residuals(p: FloatArray) -> FloatArray:
        return reprojection(flow, velocity(p))[0]

    end = scipy.optimize.least_squares(residuals, p, jacobian, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    if not (np.all(np.isfinite(end.x)) and (not accelerated or _SLOWEST <= end.x[6] <= _FASTEST)):
        return start
    return _in_front(flow, velocity(end.x))


@final
@dataclass(frozen=True, kw_only=True)
class ZhuangSolver(Solver):
    """Differential motion of the left camera from eight matches (constant velocity) or nine (constant
    acceleration).

    The flow during a whole frame period is treated as instantaneous; the resulting error of the rotation is of
    second order in the motion, that of the direction of translation of first order. w is computed from v and s by
    least squares, which for exact flows gives the same as Ma's decomposition.
    """

    acceleration: Literal["none", "constant"] = "none"
    """``none``: k is 0; ``constant``: k is estimated."""
    refinement: Literal["none", "reprojection"] = "reprojection"
    """``reprojection``: refine the linear solution by least squares of the paper's flow error, minimised over all
    depths too; not used for minimal samples of RANSAC."""

    @property
    def spec(self) -> SolverSpec:
        return SolverSpec(
            needs=frozenset({"left"}),
            minimum={"left": self._least},
            metric=False,
            motion_model="twist" if self._least == 8 else "accelerated",
            shutter="rolling",
            cameras="rig",
            reference_point="left",
            reference="Zhuang, Cheong, Lee: Rolling-Shutter-Aware Differential SfM, ICCV 2017",
            assumes="small motion; a scene that is not planar; translation; "
            + ("constant velocity" if self._least == 8 else "constant acceleration along the path"),
        )

    @property
    def _least(self) -> int:
        return 8 if self.acceleration == "none" else 9

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        flow = Flow.of(correspondences, rig, shutter)
        if short := self.spec.shortage({"left": len(flow.x)}):
            return short
        found, reason = self._linear(flow)
        if not found:
            return MotionEstimate.failed(reason)
        if self.refinement == "reprojection":
            found = [refine(flow, start, self._least == 9) for start in found]
        return self._reported(min(found, key=lambda each: float(np.sum(reprojection(flow, each)[0] ** 2))))

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        found, reason = self._linear(Flow.of(sample, rig, shutter))
        return [self._reported(each) for each in found] or [MotionEstimate.failed(reason)]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        if self._least == 9:
            return (self.propose(sample, rig, shutter) for sample in samples)
        flows = [Flow.of(sample, rig, shutter) for sample in samples]
        vectors = null_vectors(np.stack([flow.system()[0] for flow in flows]))
        found = (velocity_of(flow, e, 0.0) for flow, e in zip(flows, vectors, strict=True))
        return ([self._reported(each)] for each in found)

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        if self.refinement == "none":
            return self.estimate(correspondences, rig, shutter)
        flow = Flow.of(correspondences, rig, shutter)
        v: FloatArray = motion.d
        if self._least == 8:
            v = np.linalg.solve(so3.left_jacobian(motion.w), v).astype(np.float64)
        length = float(np.linalg.norm(v))
        if length == 0.0:
            return self.estimate(correspondences, rig, shutter)
        k = float(motion.motion_parameters.get("acceleration", 0.0))
        return self._reported(refine(flow, Velocity(motion.w, v / length, k), self._least == 9))

    def _linear(self, flow: Flow) -> tuple[list[Velocity], str]:
        """Return solutions of the linear system, and the reason if there are none."""
        Z0, Z1 = flow.system()
        if not (np.all(np.isfinite(Z0)) and np.all(np.isfinite(Z1))):
            return [], "matches too far away to compute with"
        # With noise, half of the samples of nine have no real k; their solution without acceleration is still
        # useful.
        values = [0.0] if self._least == 8 else accelerations(Z0, Z1) or [0.0]
        found = [velocity_of(flow, null_vectors(Z0 + k * Z1), k) for k in values]
        good = [each for each in found if not isinstance(each, str)]
        failures = [each for each in found if isinstance(each, str)]
        return good, next(iter(failures), "")

    def _reported(self, found: Velocity | str) -> MotionEstimate:
        if isinstance(found, str):
            return MotionEstimate.failed(found)
        constant = self._least == 8
        d = so3.left_jacobian(found.w) @ found.v if constant else found.v
        parameters = {} if constant else {"acceleration": found.k}
        return MotionEstimate.of_one_camera(found.w, d / np.linalg.norm(d), **parameters)


_LEAST_DURATION = 0.05
"""Smallest duration of a flow, frame periods; less means a jump upwards by nearly the whole image height."""


def scale_flow(
    correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, linked: bool = True
) -> Correspondences:
    """Return matches in ideal pixels with the ends of frame 1 moved to where they are after exactly one frame
    period.

    Args:
        linked: whether ends of tracks in the right camera are moved to the time of the left camera's, if these
            differ.
    """
    ideal = without_lens(correspondences, rig)
    halves = [
        _scaled(track_pairs(correspondences.tracks, side), track_pairs(ideal.tracks, side), side, shutter)
        for side in SIDES
    ]
    if linked and not (rig.aligned and shutter.rows_together):
        left, right = (
            shutter.pixel_time(track_pairs(correspondences.tracks, side)[:, :2], 0, side) for side in SIDES
        )
        moved = (left - right)[:, None] * (halves[1][:, 2:] - halves[1][:, :2])
        halves[1] = halves[1] + np.tile(moved, 2)
    return Correspondences(
        left=_scaled(correspondences.left, ideal.left, "left", shutter),
        right=_scaled(correspondences.right, ideal.right, "right", shutter),
        tracks=np.concatenate([each[:, ends] for ends in (slice(2), slice(2, 4)) for each in halves], axis=1),
    )


def _scaled(pixels: FloatArray, matches: FloatArray, side: Side, shutter: RollingShutter) -> FloatArray:
    duration = shutter.pixel_time(pixels[:, 2:], 1, side) - shutter.pixel_time(pixels[:, :2], 0, side)
    duration = np.maximum(duration, _LEAST_DURATION)[:, None]
    return np.concatenate([matches[:, :2], matches[:, :2] + (matches[:, 2:] - matches[:, :2]) / duration], axis=1)


@final
@dataclass(frozen=True, kw_only=True)
class FlowScaledSolver(Solver):
    """A global-shutter solver applied to scaled matches, which is correct for a constant twist to first order."""

    solver: str
    """Name or card of the global-shutter solver."""

    def __post_init__(self) -> None:
        if self._entry.solver.spec.shutter != "global":
            raise RsbenchError(f"solver = {self.solver!r}: must be a global-shutter solver")
        if "stereo" in self._entry.solver.spec.needs:
            raise RsbenchError(
                f"solver = {self.solver!r}: needs left-right matches, which take no time that could be scaled; "
                "must be one of matches over time or tracks"
            )

    @cached_property
    def _entry(self) -> SolverEntry:
        try:
            return load_solver_entry(self.solver)
        except RecursionError:
            raise RsbenchError(f"solver = {self.solver!r}: refers to this card itself") from None

    @property
    def inner(self) -> Solver:
        """The global-shutter solver."""
        return self._entry.solver

    @property
    def inner_keys(self) -> tuple[str, ...]:
        return (self._entry.key,)

    @property
    def spec(self) -> SolverSpec:
        """The spec of the inner solver, changed to a rolling shutter and a constant twist."""
        inner = self.inner.spec
        return replace(
            inner,
            motion_model="twist",
            shutter="rolling",
            cameras="rig",
            reference=f"Zhuang, Cheong, Lee, ICCV 2017, eq. 8-9; {inner.reference}",
            assumes=f"constant twist, small motion; {inner.assumes}",
        )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        return self.inner.estimate(self._scaled(correspondences, rig, shutter), rig.ideal, shutter)

    def _scaled(self, matches: Correspondences, rig: StereoRig, shutter: RollingShutter) -> Correspondences:
        return scale_flow(matches, rig, shutter, linked="tracks" in self.inner.spec.needs)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return self.inner.sample_sizes(correspondences)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self.inner.propose(self._scaled(sample, rig, shutter), rig.ideal, shutter)

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        return self.inner.propose_all(
            [self._scaled(sample, rig, shutter) for sample in samples], rig.ideal, shutter
        )

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        return self.inner.improve(motion, self._scaled(correspondences, rig, shutter), rig.ideal, shutter, quick)
