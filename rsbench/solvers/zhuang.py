"""The solvers of Zhuang et al.: differential ones of one rolling-shutter camera, and flow scaled to a global
shutter.

B. Zhuang, L.-F. Cheong, G. H. Lee, Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017.

A camera whose points move by ``dX/dtau = w x X + v`` shows, to first order in the motion, the flow

    u = beta P(x) (w x x + v / Z),   P(x) = [I | -x] (2, 3),   x the ray of frame 0,

of which ``v . (x x u) + beta x^T s x = 0`` with ``s = (v w^T + w v^T) / 2 - (v . w) I`` is free of the depth:
the differential epipolar constraint (Y. Ma, J. Kosecka, S. Sastry, IJCV 2000), linear in v and s. beta is the
time that the flow took, in frame periods: tau1 - tau0 at constant velocity, and at constant acceleration k

    beta = (alpha + k alpha_k) 2 / (2 + k),   alpha = tau1 - tau0,   alpha_k = (tau1^2 - tau0^2) / 2.

Then Z(k) = Z0 + k Z1 annihilates (v (2 + k) / 2, s), so that k is a generalised eigenvalue of nine matches
(``ZhuangSolver``).

At constant velocity, a match that took ``a = 1 + h (y1 - y0)`` frame periods has moved a times as far as in
one: scaling it by 1 / a makes any global-shutter solver one for a rolling shutter and a constant twist
(``FlowScaledSolver``).
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
"""Accelerations k that are looked for: beyond the first the camera would turn back before the last row."""
_GRID = 29
_K_STEPS = 8


class Flow(NamedTuple):
    """Flows (n, ...) of one camera."""

    x: FloatArray
    """(n, 3) rays of frame 0, z = 1."""
    u: FloatArray
    """(n, 3) what they move by, third 0."""
    alpha: FloatArray
    """(n,) frame periods that they took."""
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
        """(n,) share of the motion of one frame period that each flow shows."""
        return np.asarray((self.alpha + k * self.alpha_k) * (2.0 / (2.0 + k)))

    def system(self) -> tuple[FloatArray, FloatArray]:
        """Z0 and Z1 (n, 9): columns of v and of the six entries of s."""
        x = self.x
        quadratic = [x[:, i] * x[:, j] * (1.0 if i == j else 2.0) for i, j in SYMMETRIC]
        q, c = np.stack(quadratic, axis=-1), so3.cross(x, self.u)
        return np.hstack([c, self.alpha[:, None] * q]), np.hstack([0.0 * c, self.alpha_k[:, None] * q])


class Velocity(NamedTuple):
    """w and v (3,), v of length 1, and k."""

    w: FloatArray
    v: FloatArray
    k: float


def null_vectors(Z: FloatArray) -> FloatArray:
    """(..., 9) null vectors of systems (..., n, 9), n >= 8, in unit columns; NaN where there are more.

    A translation along an axis without rotation leaves that axis's column zero, which is then the null vector.
    """
    norms = np.linalg.norm(Z, axis=-2, keepdims=True)
    norms = np.where(norms > ROUNDING * np.max(norms, axis=-1, keepdims=True), norms, 1.0)
    finite = np.all(np.isfinite(Z), axis=(-2, -1))
    _, s, Vt = np.linalg.svd(np.where(finite[..., None, None], Z, 0.0) / norms, full_matrices=Z.shape[-2] < 9)
    good = s[..., 7] > ROUNDING * s[..., 0]
    return np.where(good[..., None], Vt[..., -1, :] / norms[..., 0, :], np.nan)


def accelerations(Z0: FloatArray, Z1: FloatArray) -> list[float]:
    """Values of k at which Z0 + k Z1 (n, 9) has a null vector; of more than nine rows, nearly."""
    if len(Z0) > 9:
        return _fitting_accelerations(Z0, Z1)
    # v occurs without k: what is orthogonal to its columns leaves a square pencil of s.
    across = np.linalg.svd(Z0[:, :3])[0][:, 3:]
    P, P_k = across.T @ Z0[:, 3:], across.T @ Z1[:, 3:]
    values: Any = scipy.linalg.eig(P, -P_k, right=False)
    real = values[np.isfinite(values) & (np.abs(values.imag) <= 1e-9 * (1.0 + np.abs(values.real)))].real
    return [k for k in sorted(map(float, real), key=abs) if _SLOWEST < k < _FASTEST]


def _fitting_accelerations(Z0: FloatArray, Z1: FloatArray) -> list[float]:
    """The k of the least smallest singular value, from a grid and then by turns for the null vector and for k."""
    norms = np.maximum(np.linalg.norm(Z0, axis=0), 1e-300)
    Z0, Z1, grid = Z0 / norms, Z1 / norms, np.linspace(_SLOWEST, _FASTEST, _GRID)
    M00, M01, M11 = Z0.T @ Z0, Z0.T @ Z1, Z1.T @ Z1
    M = M00 + grid[:, None, None] * (M01 + M01.T) + grid[:, None, None] ** 2 * M11
    size = np.trace(M, axis1=1, axis2=2)
    k = float(grid[np.argmin(np.linalg.eigvalsh(M)[:, 0] / size)])
    for _ in range(_K_STEPS):
        # Gauss and Newton's step: the other singular vectors take up what they can of the change with k.
        U, s, Vt = np.linalg.svd(Z0 + k * Z1, full_matrices=False)
        change = Z1 @ Vt[-1]
        left = change - U[:, :-1] @ (U[:, :-1].T @ change)
        k -= float(s[-1] * (U[:, -1] @ change)) / max(float(left @ left), 1e-300)
        k = float(np.clip(k, _SLOWEST, _FASTEST))
    return [k]


def velocity_of(flow: Flow, e: FloatArray, k: float) -> Velocity | str:
    """Velocity of a null vector (9,), its sign by the points in front; or why there is none."""
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
    """The flow without the rotation's, that of a translation at unit depth, and the rotation's (n, 2), px."""
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
    """Errors (n,), px, of flows whose depths are the best for each, and their derivatives (n, 7) by w, v and k."""
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
    """Least squares of ``reprojection``, the paper's second stage; the start where the descent leaves it."""
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
    """Flow of the left camera as its velocity: eight matches at constant velocity, nine at constant acceleration.

    The flow of a whole frame period counts as instantaneous: the rotation is off by the square of the motion, the
    direction of translation by its first power. w and s are read from the null vector by least squares, which on
    exact flows is what Ma's decomposition gives.
    """

    acceleration: Literal["none", "constant"] = "none"
    """``none``: k is 0; ``constant``: k is estimated."""
    refinement: Literal["none", "reprojection"] = "reprojection"
    """Refinement of the linear solution of more matches than a minimal sample has: least squares of the paper's
    error of the flow, over all depths too."""

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
        """Solutions of the linear system, and why there is none."""
        Z0, Z1 = flow.system()
        if not (np.all(np.isfinite(Z0)) and np.all(np.isfinite(Z1))):
            return [], "matches too far away to compute with"
        # Noise leaves half of the samples of nine no real k: without acceleration they still are near the motion.
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
"""Frame periods; a shorter one means a jump of nearly the whole image upwards, which no flow survives."""


def scale_flow(
    correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, linked: bool = True
) -> Correspondences:
    """Ideal matches whose frame-1 ends are moved to where they are after exactly one frame period.

    Args:
        linked: whether the ends of a left-right match that have two times are brought to the left camera's.
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
    """A global-shutter solver on scaled matches; its motion is that of a constant twist to first order."""

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
        """The spec of the inner solver, on a rolling shutter."""
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
