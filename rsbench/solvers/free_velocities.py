"""Solvers for two frames of one rolling-shutter camera, with an independent velocity in each frame.

Time s is a ray's second coordinate (rows are read from the top at constant speed) relative to a reference row. The
camera of frame 0 moves as ``(exp(s w0), s v0)``, that of frame 1 as ``(exp(s w1) R, t + s v1)``, both relative to
the camera of frame 0 at s = 0. Between two rows the pose is

    R(s0, s1) = exp(s1 w1) R exp(-s0 w0),   T(s0, s1) = t + s1 v1 - s0 R(s0, s1) v0.

The paper's motion is a special case if s is 0 at the first row; linearisations are best with 0 in the middle. All
solvers end with least squares of the Sampson errors. If the direction of T(s0, s1) and the rotation are the same
for all rows, the length of T relative to that of t is undetermined: any factor 1 + a s1 - b s0 leaves all
constraints unchanged. Constant velocity is such a case up to second-order terms, so that two components of the
velocities are lost in noise of 1e-3 px, and plain least squares lets T vanish in the middle of the image. The
velocities therefore have a prior: their displacement in a whole frame has a standard deviation of |t|. With C the
sum of squares of n matches, the solvers minimise

    C (1 + (|v0|^2 + |v1|^2) (height / fy)^2 / n),

which for exact matches has its minimum at the truth. The solvers differ in their linear part.

``DaiSolver``: Y. Dai, H. Li, L. Kneip, Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry,
CVPR 2016. With the rows s0 and s1 as times, the essential matrix of two rows is a polynomial in them,

    E(s0, s1) = [t + s1 v1]x Q - Q [s0 v0]x,   Q = (I + s1 [w1]x) R (I - s0 [w0]x),

of degree 1 in each if w0 = w1 = 0 (linear), else 2 (uniform); neither depends on the length of the readout.
y^T E x is then a bilinear form of the monomials

    (p s^i, i <= degree; s^j, j <= degree + 1)   of each ray (p, s, 1),

with 5 x 5 or 7 x 7 products, of which the 2 x 2 of the highest degree do not occur: 21 or 45 coefficients, from 20
or 44 matches. Several entries of the E's add up in one coefficient, so the E's cannot be read off; R, t and the
velocities are those whose coefficients are nearest to the null vector. The coefficients are linear in R, in
(t, v0, v1), and of first degree in w0 and in w1.

``TwelveParameterSolver``: one essential matrix for the frame, then twelve velocities by linear least squares. This
is the rolling-shutter baseline of D. Barath (Rolling Shutter Made Practical, ECCV 2026), named there after the
solvers of Dai et al., whose algorithm it is not.

``AffineSolver``: one essential matrix and twelve velocities from seven affine correspondences, i.e. matches p0 to
p1 with A = dp1/dp0. The constraint f(p0, p1) = 0 holds around p0 too, so its total derivative vanishes,

    f_p0 + A^T f_p1 = 0,

where a change of the row is also a change of the time. This gives three equations per match, 21 from seven matches
for 17 unknowns. They are of first order in the velocities, for any R and t, and are solved by Gauss-Newton steps
in all unknowns from the essential matrix of a camera at rest; the error is of second order in the velocities. The
equations, and that seven matches suffice, are those of D. Barath, ECCV 2026, which finds all their solutions
algebraically; this solver finds the one nearest to a camera at rest.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.arguments import check_number
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.epipolar import epipolar_gradient
from rsbench.core.projection import plane_basis
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.free_kernels import (
    descend,
    fill_coefficients,
    free_from_row,
    free_in_front,
    free_proposal,
    free_terms,
)
from rsbench.solvers.essential_matrix import DEGENERATE, eight_point, normalising_transform, null_essential
from rsbench.solvers.linear import null_vector


class FreeMotion(NamedTuple):
    """R (3, 3) and t, v0, v1, w0, w1 (3,), velocities per unit of s; translations in one unknown unit."""

    R: FloatArray
    t: FloatArray
    v0: FloatArray
    v1: FloatArray
    w0: FloatArray
    w1: FloatArray

    def between(self, s0: FloatArray, s1: FloatArray) -> Pose:
        """Pose (..., 3, 3), (..., 3) of row s1 (...) of frame 1 from row s0 (...) of frame 0."""
        s0, s1 = s0[..., None], s1[..., None]
        R = so3.exp(s1 * self.w1) @ self.R @ so3.exp(-s0 * self.w0)
        return Pose(R, self.t + s1 * self.v1 - s0 * (R @ self.v0))

    def moved(self, step: FloatArray) -> FreeMotion:
        """The motion after a step (..., 18) or, without rotations within the frames, (..., 12)."""
        step = np.concatenate([step, np.zeros((*step.shape[:-1], 18 - step.shape[-1]))], axis=-1)
        turn, *rest = np.split(step, 6, axis=-1)
        return FreeMotion(so3.exp(turn) @ self.R, *(a + b for a, b in zip(self[1:], rest, strict=True)))

    def of_unit_length(self) -> FreeMotion:
        """The motion scaled to |t| = 1."""
        length = max(float(np.linalg.norm(self.t)), 1e-300)
        return self._replace(t=self.t / length, v0=self.v0 / length, v1=self.v1 / length)

    def flipped(self) -> FreeMotion:
        """The motion with all translations reversed, which changes the sign of the essential matrices."""
        return self._replace(t=-self.t, v0=-self.v0, v1=-self.v1)

    def twin(self) -> FreeMotion:
        """The motion with frame 1 rotated by 180 deg about t: same constraints for translations along t."""
        return self._replace(R=so3.exp(np.pi * self.t / np.linalg.norm(self.t)) @ self.R)

    def at_rest(self) -> FreeMotion:
        """The motion with velocities of 0."""
        return FreeMotion(self.R, self.t, *np.zeros((4, 3)))


class Rows(NamedTuple):
    """Matches of one camera: rays (n, 3) of frames 0 and 1 with z = 1, and their times s (n,)."""

    x: FloatArray
    y: FloatArray
    s0: FloatArray
    s1: FloatArray
    camera: PinholeCamera
    affine: FloatArray
    """(n, 4) ``Correspondences.affine``, or (n, 0)."""

    @classmethod
    def of(cls, matches: FloatArray, camera: PinholeCamera, first: float) -> Rows:
        """Convert matches (n, 4), or (n, 8) with affine frames, with s = 0 at the row ``first``."""
        x, y = camera.unproject(matches[:, :2]), camera.unproject(matches[:, 2:4])
        s0, s1 = (matches[:, 1] - first) / camera.fy, (matches[:, 3] - first) / camera.fy
        return cls(x, y, s0, s1, camera, matches[:, 4:])

    def packed(self) -> FloatArray:
        """(n, 6) x0, y0, x1, y1, s0, s1 in the form that the compiled functions take."""
        return np.column_stack([self.x[:, :2], self.y[:, :2], self.s0, self.s1])


def errors(motion: FreeMotion, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """Rolling-shutter Sampson errors (n,), px, and derivatives (n, 18) by ``FreeMotion.moved``."""
    r, J = np.zeros(len(rows.x)), np.zeros((len(rows.x), 18))
    focal = np.array([rows.camera.fx, rows.camera.fy])
    free_terms(motion.R, np.stack(motion[1:]), rows.packed(), focal, r, J)
    return r, J


def squares(motion: FreeMotion, rows: Rows) -> float:
    """Sum of the squared Sampson errors, px^2."""
    r, focal = np.zeros(len(rows.x)), np.array([rows.camera.fx, rows.camera.fy])
    free_terms(motion.R, np.stack(motion[1:]), rows.packed(), focal, r, np.zeros((0, 18)))
    total = float(r @ r)
    return total if np.isfinite(total) else np.inf


def signed(motion: FreeMotion, rows: Rows) -> tuple[FreeMotion, int]:
    """Choose the sign of the translations with more points in front of both cameras; and their number.

    The length of T relative to t is the least certain quantity: estimates of it may pass zero in the middle of the
    image, so that half of the points vote for either sign. T is therefore assumed to lie on the side of t.
    """
    front, back = (free_in_front(each.R, np.stack(each[1:]), rows.packed()) for each in (motion, motion.flipped()))
    return (motion, front) if front >= back else (motion.flipped(), back)


def from_row(motion: FreeMotion, s: float) -> FreeMotion:
    """The motion with s = 0 at another row, with the exact pose and the velocities at that row."""
    R, vectors = np.zeros((3, 3)), np.zeros((5, 3))
    free_from_row(motion.R, np.stack(motion[1:]), s, R, vectors)
    return FreeMotion(R, *vectors)


@functools.cache
def places(degree: int) -> NDArray[np.int64]:
    """Return the index of the coefficient of each product of monomials, (m, m) with m = 2 degree + 3; -1: none.

    Rows are the monomials of frame 1, columns those of frame 0.

    Products of the monomials of highest degree of both frames do not occur.
    """
    m = 2 * degree + 3
    highest = np.zeros(m, dtype=np.bool_)
    highest[[degree, m - 1]] = True
    occur = ~np.outer(highest, highest)
    out = np.full((m, m), -1, dtype=np.int64)
    out[occur] = np.arange(np.count_nonzero(occur))
    return out


def coefficients(motion: FreeMotion, degree: int) -> tuple[FloatArray, FloatArray]:
    """The (21,) or (45,) coefficients, and their derivatives (18, 21) or (18, 45) by ``FreeMotion.moved``."""
    place = places(degree)
    out, by = np.zeros(np.max(place) + 1), np.zeros((18, np.max(place) + 1))
    fill_coefficients(motion.R, np.stack(motion[1:]), place, out, by)
    return out, by


_EXACT_PX, _EXACT = 1e-11, 1e-14
"""Root mean square error, px, and misfit of unit coefficients, that are due to rounding alone."""


def refine(start: FreeMotion, rows: Rows, *, turning: bool, most: int) -> tuple[FreeMotion, float]:
    """Minimise the cost from a start; returns the motion and the cost, px^2, or the start if matches are too few.

    Args:
        turning: whether the camera rotates within a frame.
        most: largest number of evaluations.
    """
    unknowns, camera = 17 if turning else 11, rows.camera
    if len(rows.x) < unknowns:
        return start, np.inf
    if not turning:
        start = start._replace(w0=np.zeros(3), w1=np.zeros(3))
    R, vectors, focal = np.array(start.R), np.stack(start[1:]), np.array([camera.fx, camera.fy])
    slowness, exact = (camera.height / camera.fy) ** 2 / len(rows.x), len(rows.x) * _EXACT_PX**2
    target = (rows.packed(), focal, slowness, np.zeros(0), places(1))
    cost = descend(R, vectors, unknowns, most, exact, target)
    return FreeMotion(R, *vectors), cost


def nearest(start: FreeMotion, F: FloatArray, degree: int, most: int) -> tuple[FreeMotion, float]:
    """Find the motion whose unit coefficients are nearest to the line of F, and the squared distance."""
    R, vectors, unknowns = np.array(start.R), np.stack(start[1:]), 11 if degree == 1 else 17
    target = (np.zeros((0, 6)), np.ones(2), 0.0, F / np.linalg.norm(F), places(degree))
    cost = descend(R, vectors, unknowns, most, _EXACT**2, target)
    return FreeMotion(R, *vectors), cost


_MOST_TURN = 1.0
"""Largest rotation within a frame, radians; faster rotations fit almost any matches."""
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_QUICK, _FULL = 8, 100
"""Evaluations of a descent from one of several starts or within a search, and of the final descent."""


@dataclass(frozen=True, kw_only=True)
class FreeVelocitySolver(Solver):
    """Linear solution from the left camera's matches, then least squares of the model's Sampson errors."""

    refinement: Literal["none", "sampson"] = "sampson"
    """``sampson``: final least squares of the Sampson errors of all matches; ``none``: no refinement."""

    @property
    @abstractmethod
    def turning(self) -> bool:
        """Whether the camera rotates within a frame."""

    @property
    @abstractmethod
    def least(self) -> int:
        """Smallest number of matches."""

    @property
    @abstractmethod
    def about(self) -> tuple[str, str]:
        """The texts ``reference`` and ``assumes`` of the spec."""

    @abstractmethod
    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        """Return linear solutions, up to sign, for s = 0 at the principal point; or why there are none."""

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Further motions from which descents start, for the same rows."""
        return []

    def matches_of(self, correspondences: Correspondences) -> FloatArray:
        """The matches (n, 4) that the solver uses, or (n, 8) with affine frames."""
        return temporal_pairs(correspondences, "left")

    @property
    def spec(self) -> SolverSpec:
        reference, assumes = self.about
        return SolverSpec(
            needs=frozenset({"left"}),
            minimum={"left": self.least},
            metric=False,
            motion_model="linear",
            shutter="rolling",
            reference_point="left",
            reference=reference,
            assumes=assumes,
        )

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": self.least}

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        return self._estimated(self.matches_of(correspondences), rig, [])

    def _estimated(self, matches: FloatArray, rig: StereoRig, near: list[FreeMotion]) -> MotionEstimate:
        """Refine from linear solutions, those of smaller models, and start motions ``near``, s = 0 at row 0."""
        found = self.from_equations(matches, rig)
        if self.refinement == "none" or len(matches) < self.least:
            return first_of(found, matches, rig)
        middle = self.starts(Rows.of(matches, rig.camera, rig.camera.cy))
        middle += [] if isinstance(found, str) else found
        if isinstance(found, str) and not (middle or near):
            return MotionEstimate.failed(found)
        begun = [*near, *(_at_first_row(each, rig.camera) for each in middle)]
        rows = Rows.of(matches, rig.camera, 0.0)
        # Noise may dominate a linear solution's velocities, so start a descent with and one without them.
        ends = [self._refined(each, rows, _QUICK) for each in [*begun, *(each.at_rest() for each in begun)]]
        gentle = [end for end in ends if _rotation_within(end[0], rig.camera) < _MOST_TURN] or ends
        best = min(_mostly_in_front([end for end, _ in gentle], rows), key=lambda k: gentle[k][1])
        return _answer(self._refined(gentle[best][0], rows, _FULL)[0], rows)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        matches = self.matches_of(sample)
        return [first_of(self.from_equations(matches, rig), matches, rig)]

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
        matches = self.matches_of(correspondences)
        rows = Rows.of(matches, rig.camera, 0.0)
        least = self.sample_sizes(correspondences)["left"]
        if len(rows.x) < least:
            return MotionEstimate.failed(f"{len(rows.x)} left matches, need {least}")
        rate = float(shutter.rate("left")[1]) * rig.camera.fy  # frame periods per unit of s
        w, d = rate * motion.w, rate * motion.d
        start = FreeMotion(so3.exp(motion.w), np.array(motion.d), d, d, w, w)
        if quick or len(rows.x) < self.least:
            return _answer(self._refined(start, rows, _QUICK)[0], rows)
        return self._estimated(matches, rig, [start])

    def _refined(self, start: FreeMotion, rows: Rows, most: int) -> tuple[FreeMotion, float]:
        return refine(start, rows, turning=self.turning, most=most)

    def from_equations(self, matches: FloatArray, rig: StereoRig) -> list[FreeMotion] | str:
        """The linear solutions with s = 0 at the principal point: those with most points in front first."""
        frames = len(matches) if matches.shape[1] > 4 else 0
        if short := self.spec.shortage({"left": len(matches), "affine": frames}):
            return short.reason
        rows = Rows.of(matches, rig.camera, rig.camera.cy)
        found = self.linear(rows)
        if isinstance(found, str):
            return found
        finite = [each.of_unit_length() for each in found if all(np.all(np.isfinite(part)) for part in each)]
        order = sorted(range(len(finite)), key=lambda k: squares(finite[k], rows))
        front = set(_mostly_in_front(finite, rows))
        return [finite[k] for k in sorted(order, key=lambda k: k not in front)] or "no finite motion fits"


def without_velocities(rows: Rows) -> FreeMotion | None:
    """R and t of one essential matrix for all rows, by the eight-point algorithm; None if it is not unique."""
    E = eight_point(rows.x, rows.y)
    return None if E is None else at_rest_of(E, rows)


def at_rest_of(E: FloatArray, rows: Rows) -> FreeMotion:
    """Decompose an essential matrix (3, 3) into R and t with most points in front; velocities are 0."""
    U, _, Vt = np.linalg.svd(E)
    R = U @ QUARTER @ Vt
    motion = FreeMotion(R * np.sign(np.linalg.det(R)), U[:, 2], *np.zeros((4, 3)))
    return max((signed(each, rows) for each in (motion, motion.twin())), key=lambda found: found[1])[0]


def _mostly_in_front(motions: list[FreeMotion], rows: Rows) -> list[int]:
    """Indices of motions with at least half as many points in front as the best, to exclude wrong twins."""
    fronts = [signed(each, rows)[1] for each in motions]
    return [k for k, front in enumerate(fronts) if 2 * front >= max(fronts)]


def _rotation_within(motion: FreeMotion, camera: PinholeCamera) -> float:
    """Rotation within a frame, radians."""
    return max(float(np.linalg.norm(w)) for w in (motion.w0, motion.w1)) * camera.height / camera.fy


def first_of(found: list[FreeMotion] | str, matches: FloatArray, rig: StereoRig) -> MotionEstimate:
    """The first of the linear solutions, unrefined."""
    if isinstance(found, str):
        return MotionEstimate.failed(found)
    return _answer(_at_first_row(found[0], rig.camera), Rows.of(matches, rig.camera, 0.0))


def _at_first_row(motion: FreeMotion, camera: PinholeCamera) -> FreeMotion:
    return from_row(motion, -camera.cy / camera.fy)


def _answer(motion: FreeMotion, rows: Rows) -> MotionEstimate:
    motion, _ = signed(motion.of_unit_length(), rows)
    return MotionEstimate.of_one_camera(so3.log(motion.R), motion.t)


def velocities(still: FreeMotion, rows: Rows) -> FreeMotion:
    """The motion with the velocities that fit best to first order, for given R and t at the principal point's row.

    y^T E x is linear in small (v0, v1, w0, w1). Each equation is weighted by its Sampson norm.
    """
    r, J = errors(still, rows)
    found = np.asarray(np.linalg.lstsq(J[:, 6:], -r, rcond=None)[0], dtype=np.float64)
    return FreeMotion(still.R, still.t, *found.reshape(4, 3))


@final
@dataclass(frozen=True, kw_only=True)
class TwelveParameterSolver(FreeVelocitySolver):
    """Essential matrix by the eight-point algorithm, then velocities of both frames by linear least squares."""

    turning = True
    least = 20
    about = (
        "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its baseline); Hartley, PAMI 1997",
        "slow motion within the frames; readout ratio above 0; a scene that is not planar; translation",
    )

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        still = without_velocities(rows)
        if still is None:
            return DEGENERATE
        return [velocities(still, rows)]


_MOST = 30
_SAMPLE, _SAMPLE_MOST = 20, (10, 16)
"""Matches per RANSAC sample; evaluations of its descents on coefficients and on Sampson errors."""
_SINGULAR = "the linear system has more than one solution: degenerate motion, scene or readout ratio"
_ROUNDING = 1e-14
"""For slow motion, the singular values that separate the 45 coefficients are at most 1e-10 of the largest one."""


def monomials(x: FloatArray, degree: int) -> FloatArray:
    """(..., 2 degree + 3) monomials of rays (..., 3)."""
    p, s = x[..., 0], x[..., 1]
    return np.stack([*(p * s**i for i in range(degree + 1)), *(s**j for j in range(degree + 2))], axis=-1)


def system(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """(..., 21) or (..., 45) equations of rays x, y (..., 3), z = 1, with s = 0 at the principal point."""
    products = monomials(y, degree)[..., :, None] * monomials(x, degree)[..., None, :]
    return products[..., places(degree) >= 0]


def extract(F: FloatArray, degree: int) -> list[FreeMotion]:
    """Motions whose coefficients are near F, (21,) or (45,) of arbitrary length and sign, sorted from the nearest.

    They are found by least squares over all unknowns, from both rotations of an essential matrix. If all
    velocities are along t, as nearly in slow motion, the twin of each motion has nearly the same coefficients.
    """
    F = F / np.linalg.norm(F)
    begun = [FreeMotion(R, *vectors) for R, vectors in zip(*_starts(F, degree), strict=True)]
    ends = [nearest(each, F, degree, _MOST) for each in begun]
    twin = min(ends, key=lambda end: end[1])[0].twin()
    t, v0, v1 = _translations(F, twin.R, degree)
    ends.append(nearest(twin._replace(t=t, v0=v0, v1=v1), F, degree, _MOST))
    near = [end for end, _ in sorted(ends, key=lambda end: end[1])]
    return [*near, *(end.twin() for end in near)]


def _starts(F: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """R (..., 2, 3, 3) and t, v0, v1, 0, 0 (..., 2, 5, 3) from unit coefficients (..., 21 or 45).

    They are both rotations of the essential matrix of t, to whose entries the velocities contribute too, with the
    translations that fit each.
    """
    block = places(degree)[np.ix_([0, degree + 2, degree + 1], [0, degree + 2, degree + 1])]
    U, _, Vt = np.linalg.svd(F[..., None, block])
    R = U @ np.stack([QUARTER, QUARTER.T]) @ Vt
    R = R * np.sign(np.linalg.det(R))[..., None, None]
    found = _translations(F[..., None, :], R, degree)
    return R, np.concatenate([found, np.zeros((*found.shape[:-2], 2, 3))], axis=-2)


def _translations(F: FloatArray, R: FloatArray, degree: int) -> FloatArray:
    """t, v0 and v1 (..., 3, 3) that best fit coefficients for a rotation (..., 3, 3), without w0 and w1."""
    basis = np.tensordot(R, _translation_basis(degree), axes=2)
    found = np.linalg.solve(basis @ np.swapaxes(basis, -1, -2), basis @ F[..., None])
    return np.asarray(found.reshape(*R.shape[:-2], 3, 3), dtype=np.float64)


@functools.cache
def _translation_basis(degree: int) -> FloatArray:
    """(3, 3, 9, 21 or 45) derivatives of the coefficients by R and by (t, v0, v1), without w0 and w1."""
    units = np.eye(9).reshape(3, 3, 3, 3)
    still = np.zeros((5, 3))
    return np.array([[coefficients(FreeMotion(R, *still), degree)[1][3:12] for R in row] for row in units])


def _sample_motions(matches: FloatArray, camera: PinholeCamera, refined: bool) -> list[MotionEstimate]:
    """Motions of samples (b, n, 4), n >= 20, by the linear model."""
    x, y = camera.unproject(matches[..., :2]), camera.unproject(matches[..., 2:])
    A = system(x, y, 1)
    norms = np.maximum(np.linalg.norm(A, axis=1), 1e-300)
    good = np.all(np.isfinite(A), axis=(1, 2))
    _, sizes, Vt = np.linalg.svd(np.where(good[:, None, None], A / norms[:, None], 0.0))
    good &= sizes[:, 19] > _ROUNDING * sizes[:, 0]
    F = np.where(good[:, None], Vt[:, -1] / norms, 1.0)
    F /= np.linalg.norm(F, axis=-1, keepdims=True)
    data = np.concatenate([x[..., :2], y[..., :2], x[..., 1:2], y[..., 1:2]], axis=-1)
    most = (_SAMPLE_MOST[0], _SAMPLE_MOST[1] if refined else 0)
    focal, slowness = np.array([camera.fx, camera.fy]), (camera.height / camera.fy) ** 2 / matches.shape[1]
    R, vectors, at = np.zeros((len(F), 3, 3)), np.zeros((len(F), 5, 3)), (focal, -camera.cy / camera.fy, slowness)
    for k, (Rs, begun) in enumerate(zip(*_starts(F, 1), strict=True)):
        free_proposal(Rs, begun, F[k], places(1), data[k], *at, most, R[k], vectors[k])
    return [
        MotionEstimate.of_one_camera(*motion) if usable else MotionEstimate.failed(_SINGULAR)
        for motion, usable in zip(zip(so3.log(R), vectors[:, 0], strict=True), good, strict=True)
    ]


@final
@dataclass(frozen=True, kw_only=True)
class DaiSolver(FreeVelocitySolver):
    """The null vector of 21 or 45 coefficients, the motion nearest to it, and a descent on Sampson errors.

    The velocities of both frames are estimated independently and not returned. For a constant velocity these are 6
    or 12 redundant unknowns, which multiply the effect of noise by ten and more. In slow motion s0 and s1 are
    nearly equal, and the 45 coefficients nearly collinear.
    """

    model: Literal["linear", "uniform"] = "linear"
    """``uniform``: with a rotation within a frame; ``linear``: without one."""

    @property
    def turning(self) -> bool:
        return self.model == "uniform"

    @property
    def least(self) -> int:
        return _SAMPLE if self.model == "linear" else 44

    @property
    def about(self) -> tuple[str, str]:
        within = "no rotation within a frame" if self.model == "linear" else "small rotation within a frame"
        return (
            "Dai, Li, Kneip: Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry, CVPR 2016",
            f"{within}; constant velocity in each; readout ratio above 0; a scene that is not planar; translation",
        )

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        degree = 2 if self.turning else 1
        F, reason = null_vector(system(rows.x, rows.y, degree), unit_columns=True, rounding=_ROUNDING)
        return reason if F is None else extract(F, degree)

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Motions of the smaller models, as 45 coefficients are far more sensitive to noise than 21 or 9."""
        F, _ = null_vector(system(rows.x, rows.y, 1), unit_columns=True) if self.turning else (None, "")
        still = without_velocities(rows)
        return [*([] if F is None else extract(F, 1)), *([] if still is None else [still])]

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": _SAMPLE}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return next(iter(self.propose_all([sample], rig, shutter)))

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        """Propose by the linear model: 44 matches are useless at 0.3 px of noise, and rarely all inliers."""
        matches = np.stack([temporal_pairs(sample, "left") for sample in samples])
        if matches.shape[1] < _SAMPLE:
            return [[MotionEstimate.failed(f"{matches.shape[1]} left matches, need {_SAMPLE}")] for _ in matches]
        return [[each] for each in _sample_motions(matches, rig.camera, self.refinement == "sampson")]


_STEPS = 6
"""Gauss-Newton steps: for exact matches at 6 degrees and 1.2 m per frame, the last one changes w by 1e-9 rad."""


def jets(rows: Rows, patch_px: float) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) for each frame: rays, and their changes if frame 0's pixel moves by ``patch_px`` along x, y."""
    focal = np.array([rows.camera.fx, rows.camera.fy])
    x, y = np.zeros((2, len(rows.x), 3, 3))
    x[:, 0], y[:, 0] = rows.x, rows.y
    x[:, [1, 2], [0, 1]] = patch_px / focal
    y[:, 1:, :2] = patch_px * np.swapaxes(rows.affine.reshape(-1, 2, 2), 1, 2) / focal
    return x, y


def _product(of: Callable[[FloatArray, FloatArray], FloatArray], a: FloatArray, b: FloatArray) -> FloatArray:
    """Bilinear product of jets (..., 3, c): its value and first-order changes."""
    moved = [of(a[..., k, :], b[..., 0, :]) + of(a[..., 0, :], b[..., k, :]) for k in (1, 2)]
    return np.stack([of(a[..., 0, :], b[..., 0, :]), *moved], axis=-2)


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], 9)


def essential_of_jets(x: FloatArray, y: FloatArray) -> FloatArray | None:
    """``eight_point`` for jets (n, 3, 3), i.e. rays and their changes."""
    T0, T1 = normalising_transform(x[:, 0, :2]), normalising_transform(y[:, 0, :2])
    E = null_essential(_product(_outer, y @ T1.T, x @ T0.T).reshape(-1, 9))
    return None if E is None else T1.T @ E @ T0


def equations(R: FloatArray, t: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (..., n, 3) of a camera at rest, and their derivatives (..., n, 3, 18) by ``FreeMotion.moved``.

    Derivatives by the velocities are exact; those by R and t are those of a camera at rest.

    Args:
        R, t: pose (..., 3, 3), (..., 3).
        x, y: jets (..., n, 3, 3).
    """
    R, t = R[..., None, :, :], t[..., None, None, :]
    p, s0, s1 = x @ np.swapaxes(R, -1, -2), x[..., 1:2], y[..., 1:2]
    n = _product(so3.cross, p, y)
    by_turn = _product(so3.cross, p, so3.cross(y, t))
    parts = [by_turn, n]
    for each in (n, by_turn):
        parts += [-_product(np.multiply, s0, each @ R), _product(np.multiply, s1, each)]
    return np.sum(n * t, axis=-1), np.concatenate(parts, axis=-1)


def moving(stills: list[FreeMotion], x: FloatArray, y: FloatArray, camera: PinholeCamera) -> list[FreeMotion]:
    """R, t and velocities that best fit the jets (k, n, 3, 3) of k samples, to first order in the velocities."""
    R, t = np.stack([each.R for each in stills]), np.stack([each.t for each in stills])
    v = np.zeros((len(R), 12))
    for _ in range(_STEPS):
        value, J = equations(R, t, x, y)
        E = (hat(t) @ R)[:, None]
        gradient = epipolar_gradient(E, x[..., 0, :], y[..., 0, :], camera)
        weight = 1.0 / np.maximum(np.linalg.norm(gradient, axis=-1), 1e-300)[..., None, None]
        across = plane_basis(t)
        columns = np.concatenate([J[..., :3], J[..., 3:6] @ across[:, None], J[..., 6:]], axis=-1) * weight
        A, b = columns.reshape(len(R), -1, 17), (value[..., None] * weight).reshape(len(R), -1, 1)
        finite = np.all(np.isfinite(A), axis=(1, 2)) & np.all(np.isfinite(b), axis=(1, 2))
        step = np.full((len(R), 17), np.nan)
        step[finite] = -(np.linalg.pinv(A[finite], rcond=_ROUNDING) @ b[finite])[..., 0]
        t = t + (across @ step[:, 3:5, None])[..., 0]
        R, v, length = so3.exp(step[:, :3]) @ R, step[:, 5:], np.linalg.norm(t, axis=1, keepdims=True)
        t = t / length
    return [FreeMotion(*each, *velocities.reshape(4, 3)) for *each, velocities in zip(R, t, v, strict=True)]


@final
@dataclass(frozen=True, kw_only=True)
class AffineSolver(FreeVelocitySolver):
    """An essential matrix from affine correspondences, then all unknowns jointly, then a descent that uses points.

    The descent on Sampson errors needs 17 matches; with fewer, the solution of the equations is returned.
    """

    patch_px: float = 10.0
    """Noise of points divided by that of affine frames, px: the distance at which both weigh the same."""

    turning = True
    least = 7
    about = (
        "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its equations); Hartley, PAMI 1997",
        "affine frames of the left matches; slow motion within the frames; readout ratio above 0; translation",
    )

    def __post_init__(self) -> None:
        check_number("patch_px", self.patch_px, 1e-3, 1e3)

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": self.least, "affine": self.least}
        return replace(super().spec, needs=set(minimum), minimum=minimum)

    def matches_of(self, correspondences: Correspondences) -> FloatArray:
        if len(correspondences.affine) == 0:
            return correspondences.left
        return np.hstack([correspondences.left, correspondences.affine])

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        x, y = jets(rows, self.patch_px)
        E = essential_of_jets(x, y)
        if E is None:
            return DEGENERATE
        still = at_rest_of(E, rows)
        return [*moving([still], x[None], y[None], rows.camera), still]

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self.propose_all([sample], rig, shutter)[0]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> list[list[MotionEstimate]]:
        """Propose each solution with its velocities and at rest, since noise of few matches may dominate them."""
        sets = [self.matches_of(sample) for sample in samples]
        if short := self.spec.shortage({"left": len(sets[0]), "affine": len(samples[0].affine)}):
            return [[short] for _ in samples]
        rows = [Rows.of(matches, rig.camera, rig.camera.cy) for matches in sets]
        x, y = (np.stack(part) for part in zip(*(jets(each, self.patch_px) for each in rows), strict=True))
        found = [essential_of_jets(*each) for each in zip(x, y, strict=True)]
        stills = {k: at_rest_of(E, rows[k]) for k, E in enumerate(found) if E is not None}
        out = [[MotionEstimate.failed(DEGENERATE)] for _ in samples]
        known = [*stills]
        moved = moving([*stills.values()], x[known], y[known], rig.camera) if known else []
        for k, motion in zip(known, moved, strict=True):
            out[k] = [first_of([each], sets[k], rig) for each in (motion, stills[k])]
        return out
