"""Two frames of one rolling-shutter camera, each with a velocity of its own that nothing ties to the other.

Time s is a ray's second coordinate (of rows read from the top at constant speed) less that of a row to start
from. The camera of frame 0 moves as ``(exp(s w0), s v0)``, that of frame 1 as ``(exp(s w1) R, t + s v1)``, both
relative to the camera of frame 0 at s = 0. Between two rows the pose is

    R(s0, s1) = exp(s1 w1) R exp(-s0 w0),   T(s0, s1) = t + s1 v1 - s0 R(s0, s1) v0.

The paper's motion is one of these when s is 0 at the first row; linearisations hold best with 0 in the middle.
All solvers end with least squares of the Sampson errors. The length of T(s0, s1), beside that of t, is
undetermined where its direction and the rotation are the same for all rows: any factor 1 + a s1 - b s0 leaves
every constraint as it is. A constant velocity is that but for terms of second order, so that two of the
velocities' numbers are lost in noise of 1e-3 px, and least squares alone lets T vanish in the middle of the
image. What is minimised is therefore the most probable motion for velocities that in a whole frame lead as far
as t, within a standard deviation: with C the sum of squares of n matches,

    C (1 + (|v0|^2 + |v1|^2) (height / fy)^2 / n),

which on exact matches has its minimum at the truth. The solvers differ in their linear part.

``DaiSolver``: Y. Dai, H. Li, L. Kneip, Rolling Shutter Camera Relative Pose: Generalized Epipolar Geometry,
CVPR 2016. With the rows s0 and s1 as times, the essential matrix of two rows is a polynomial in them,

    E(s0, s1) = [t + s1 v1]x Q - Q [s0 v0]x,   Q = (I + s1 [w1]x) R (I - s0 [w0]x),

of degree 1 in each where w0 = w1 = 0 (linear), else 2 (uniform); the length of the readout matters to neither.
y^T E x is then a bilinear form of the monomials

    (p s^i, i <= degree; s^j, j <= degree + 1)   of each ray (p, s, 1),

5 x 5 or 7 x 7 of them without the 2 x 2 products of the highest ones, which do not occur: 21 or 45
coefficients, of 20 or 44 matches. Several entries of the E's fall into one coefficient, so that the E's cannot
be read off alone; R, t and the velocities are those whose coefficients come nearest to the null vector. The
coefficients are linear in R, in (t, v0, v1), and of first degree in w0 and in w1.

``TwelveParameterSolver``: one essential matrix for the frame, then twelve velocities by linear least squares,
the rolling-shutter baseline of D. Barath (Rolling Shutter Made Practical, ECCV 2026), named there after the
solvers of Dai et al., whose algorithm it is not.

``AffineSolver``: one essential matrix and twelve velocities from seven affine correspondences, a match p0 to p1
with A = dp1/dp0. The constraint f(p0, p1) = 0 holds for the pixels around p0 too, so that its total derivative

    f_p0 + A^T f_p1 = 0

is zero, in which a row that moves is another time: three equations a match, 21 of seven for 17 unknowns. They
are of first order in the velocities, beside R and t of any size: Gauss-Newton steps in all unknowns from the
essential matrix of a camera at rest. What they leave is of second order in the velocities. The equations, and
that seven matches suffice, are those of D. Barath, ECCV 2026, which finds all their solutions algebraically;
this is the one next to a camera at rest.
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
from rsbench.solvers.essential_matrix import eight_point, normalising_transform, null_essential
from rsbench.solvers.linear import null_vector


class FreeMotion(NamedTuple):
    """R (3, 3) and t, v0, v1, w0, w1 (3,), the velocities by s; all translations have one unknown unit."""

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
        """With a step (..., 18) or, without rotations in the frames, (..., 12)."""
        step = np.concatenate([step, np.zeros((*step.shape[:-1], 18 - step.shape[-1]))], axis=-1)
        turn, *rest = np.split(step, 6, axis=-1)
        return FreeMotion(so3.exp(turn) @ self.R, *(a + b for a, b in zip(self[1:], rest, strict=True)))

    def of_unit_length(self) -> FreeMotion:
        """With |t| = 1."""
        length = max(float(np.linalg.norm(self.t)), 1e-300)
        return self._replace(t=self.t / length, v0=self.v0 / length, v1=self.v1 / length)

    def flipped(self) -> FreeMotion:
        """All translations reversed: the other sign of the essential matrices."""
        return self._replace(t=-self.t, v0=-self.v0, v1=-self.v1)

    def twin(self) -> FreeMotion:
        """Frame 1 turned by half a turn about t: where all translations are along t, the same constraints."""
        return self._replace(R=so3.exp(np.pi * self.t / np.linalg.norm(self.t)) @ self.R)

    def at_rest(self) -> FreeMotion:
        """Without velocities."""
        return FreeMotion(self.R, self.t, *np.zeros((4, 3)))


class Rows(NamedTuple):
    """Matches of one camera: rays (n, 3) of frames 0 and 1, z = 1, and their s (n,)."""

    x: FloatArray
    y: FloatArray
    s0: FloatArray
    s1: FloatArray
    camera: PinholeCamera
    affine: FloatArray
    """(n, 4) of ``Correspondences.affine``, or (n, 0)."""

    @classmethod
    def of(cls, matches: FloatArray, camera: PinholeCamera, first: float) -> Rows:
        """From matches (n, 4), or (n, 8) with affine frames, with s = 0 at the row ``first``."""
        x, y = camera.unproject(matches[:, :2]), camera.unproject(matches[:, 2:4])
        s0, s1 = (matches[:, 1] - first) / camera.fy, (matches[:, 3] - first) / camera.fy
        return cls(x, y, s0, s1, camera, matches[:, 4:])

    def packed(self) -> FloatArray:
        """(n, 6) as the kernels take them."""
        return np.column_stack([self.x[:, :2], self.y[:, :2], self.s0, self.s1])


def errors(motion: FreeMotion, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """Rolling-shutter Sampson errors (n,), px, and (n, 18) by ``FreeMotion.moved``: see ``free_terms``."""
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
    """The sign of the translations that has more points in front of both cameras, and how many.

    The length of T over that of t is the least certain of all: estimates of it pass zero in the middle of the
    image, where then half of the points would vote for either sign of t. T is taken to lie on the side of t.
    """
    front, back = (free_in_front(each.R, np.stack(each[1:]), rows.packed()) for each in (motion, motion.flipped()))
    return (motion, front) if front >= back else (motion.flipped(), back)


def from_row(motion: FreeMotion, s: float) -> FreeMotion:
    """The motion with s = 0 at another row: its pose exactly, its velocities as they are there."""
    R, vectors = np.zeros((3, 3)), np.zeros((5, 3))
    free_from_row(motion.R, np.stack(motion[1:]), s, R, vectors)
    return FreeMotion(R, *vectors)


@functools.cache
def places(degree: int) -> NDArray[np.int64]:
    """(m, m), m = 2 degree + 3: which coefficient a product of monomials has, frame 1 first; -1 of none.

    The products of both frames' highest ones do not occur.
    """
    m = 2 * degree + 3
    highest = np.zeros(m, dtype=np.bool_)
    highest[[degree, m - 1]] = True
    occur = ~np.outer(highest, highest)
    out = np.full((m, m), -1, dtype=np.int64)
    out[occur] = np.arange(np.count_nonzero(occur))
    return out


def coefficients(motion: FreeMotion, degree: int) -> FloatArray:
    """The (21,) or (45,) coefficients of a motion."""
    return with_derivatives(motion, degree)[0]


def with_derivatives(motion: FreeMotion, degree: int) -> tuple[FloatArray, FloatArray]:
    """The (21,) or (45,) coefficients, and what they change by with ``FreeMotion.moved``, (18, 21) or (18, 45)."""
    place = places(degree)
    out, by = np.zeros(np.max(place) + 1), np.zeros((18, np.max(place) + 1))
    fill_coefficients(motion.R, np.stack(motion[1:]), place, out, by)
    return out, by


_EXACT_PX, _EXACT = 1e-11, 1e-14
"""Root mean square errors, and misfit of unit coefficients, that rounding leaves."""


def refine(start: FreeMotion, rows: Rows, *, turning: bool, most: int) -> tuple[FreeMotion, float]:
    """Where a descent from a start ends, and what was minimised, px^2; the start where matches are too few.

    Args:
        turning: whether the camera turns within a frame.
        most: evaluations.
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
    """The motion whose unit coefficients (see ``generalised_essential``) have least across F, and its square."""
    R, vectors, unknowns = np.array(start.R), np.stack(start[1:]), 11 if degree == 1 else 17
    target = (np.zeros((0, 6)), np.ones(2), 0.0, F / np.linalg.norm(F), places(degree))
    cost = descend(R, vectors, unknowns, most, _EXACT**2, target)
    return FreeMotion(R, *vectors), cost


_MOST_TURN = 1.0
"""Radians in a frame; cameras that spin faster pass every match nearly, and fit what there is."""
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_QUICK, _FULL = 8, 100
"""Evaluations of a descent that is one of several or a step of a search, and of the final one."""


@dataclass(frozen=True, kw_only=True)
class FreeVelocitySolver(Solver):
    """Linear on the left camera's matches, then least squares of the Sampson error of the same model."""

    refinement: Literal["none", "sampson"] = "sampson"
    """``sampson``: least squares of the Sampson errors of all matches at the end; ``none``: without."""

    @property
    @abstractmethod
    def turning(self) -> bool:
        """Whether the camera turns within a frame."""

    @property
    @abstractmethod
    def least(self) -> int:
        """Fewest matches."""

    @property
    @abstractmethod
    def about(self) -> tuple[str, str]:
        """``reference`` and ``assumes`` of the spec."""

    @abstractmethod
    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        """Motions of rows whose s = 0 is the principal point's, their signs open, or why there is none."""

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Other motions to descend from, of the same rows."""
        return []

    def matches_of(self, correspondences: Correspondences) -> FloatArray:
        """The matches (n, 4) that it uses, or (n, 8) with their affine frames."""
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
        """From the linear solutions, those of smaller models, and motions from the first row that may be near."""
        found = self.from_equations(matches, rig)
        if self.refinement == "none" or len(matches) < self.least:
            return first_of(found, matches, rig)
        middle = self.starts(Rows.of(matches, rig.camera, rig.camera.cy))
        middle += [] if isinstance(found, str) else found
        if isinstance(found, str) and not (middle or near):
            return MotionEstimate.failed(found)
        begun = [*near, *(_at_first_row(each, rig.camera) for each in middle)]
        rows = Rows.of(matches, rig.camera, 0.0)
        # Noise may dominate a linear solution's velocities: each starts a descent with them and one without.
        ends = [self._refined(each, rows, _QUICK) for each in [*begun, *(each.at_rest() for each in begun)]]
        gentle = [end for end in ends if _turn(end[0], rig.camera) < _MOST_TURN] or ends
        best = min(_in_front([end for end, _ in gentle], rows), key=lambda k: gentle[k][1])
        return _reported(self._refined(gentle[best][0], rows, _FULL)[0], rows)

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
        rate = float(shutter.rate("left")[1]) * rig.camera.fy  # frame periods in a unit of s
        w, d = rate * motion.w, rate * motion.d
        start = FreeMotion(so3.exp(motion.w), np.array(motion.d), d, d, w, w)
        if quick or len(rows.x) < self.least:
            return _reported(self._refined(start, rows, _QUICK)[0], rows)
        return self._estimated(matches, rig, [start])

    def _refined(self, start: FreeMotion, rows: Rows, most: int) -> tuple[FreeMotion, float]:
        return refine(start, rows, turning=self.turning, most=most)

    def from_equations(self, matches: FloatArray, rig: StereoRig) -> list[FreeMotion] | str:
        """The linear solutions, s = 0 at the principal point: with most points in front first, by their errors."""
        frames = len(matches) if matches.shape[1] > 4 else 0
        short = self.spec.shortage({"left": len(matches), "affine": frames})
        if short is not None:
            return short.reason
        rows = Rows.of(matches, rig.camera, rig.camera.cy)
        found = self.linear(rows)
        if isinstance(found, str):
            return found
        finite = [each.of_unit_length() for each in found if all(np.all(np.isfinite(part)) for part in each)]
        order = sorted(range(len(finite)), key=lambda k: squares(finite[k], rows))
        front = set(_in_front(finite, rows))
        return [finite[k] for k in sorted(order, key=lambda k: k not in front)] or "no finite motion fits"


def without_velocities(rows: Rows) -> FreeMotion | None:
    """R and t of one essential matrix for all rows, of the eight-point algorithm; None where there are more."""
    E = eight_point(rows.x, rows.y)
    return None if E is None else at_rest_of(E, rows)


def at_rest_of(E: FloatArray, rows: Rows) -> FreeMotion:
    """R and t of an essential matrix (3, 3), those with more points in front; no velocities."""
    U, _, Vt = np.linalg.svd(E)
    R = U @ QUARTER @ Vt
    motion = FreeMotion(R * np.sign(np.linalg.det(R)), U[:, 2], *np.zeros((4, 3)))
    return max((signed(each, rows) for each in (motion, motion.twin())), key=lambda found: found[1])[0]


def _in_front(motions: list[FreeMotion], rows: Rows) -> list[int]:
    """Which have more than half as many points in front as any has: the twins of right motions have not."""
    fronts = [signed(each, rows)[1] for each in motions]
    return [k for k, front in enumerate(fronts) if 2 * front >= max(fronts)]


def _turn(motion: FreeMotion, camera: PinholeCamera) -> float:
    """Radians within a frame."""
    return max(float(np.linalg.norm(w)) for w in (motion.w0, motion.w1)) * camera.height / camera.fy


def first_of(found: list[FreeMotion] | str, matches: FloatArray, rig: StereoRig) -> MotionEstimate:
    """The first of linear solutions, as it is."""
    if isinstance(found, str):
        return MotionEstimate.failed(found)
    return _reported(_at_first_row(found[0], rig.camera), Rows.of(matches, rig.camera, 0.0))


def _at_first_row(motion: FreeMotion, camera: PinholeCamera) -> FreeMotion:
    return from_row(motion, -camera.cy / camera.fy)


def _reported(motion: FreeMotion, rows: Rows) -> MotionEstimate:
    motion, _ = signed(motion.of_unit_length(), rows)
    return motion_of(so3.log(motion.R), motion.t)


def motion_of(w: FloatArray, d: FloatArray) -> MotionEstimate:
    """w and d (3,) as an answer."""
    if not np.all(np.isfinite([*w, *d])):
        return MotionEstimate.failed("no finite motion fits")
    reason = "the length of d is not determined by one camera"
    return MotionEstimate(w=w, d=d, success=True, reason=reason)


def velocities(still: FreeMotion, rows: Rows) -> FreeMotion:
    """The velocities that fit best to first order beside an R and t that keep the rows of the principal point.

    y^T E x is linear in (v0, v1, w0, w1) where these are small. Each row is weighed by its Sampson norm.
    """
    r, J = errors(still, rows)
    found = np.asarray(np.linalg.lstsq(J[:, 6:], -r, rcond=None)[0], dtype=np.float64)
    return FreeMotion(still.R, still.t, *found.reshape(4, 3))


@final
@dataclass(frozen=True, kw_only=True)
class TwelveParameterSolver(FreeVelocitySolver):
    """The eight-point algorithm, then a linear correction by the velocities of both frames."""

    @property
    def turning(self) -> bool:
        return True

    @property
    def least(self) -> int:
        return 20

    @property
    def about(self) -> tuple[str, str]:
        return (
            "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its baseline); Hartley, PAMI 1997",
            "slow motion within the frames; readout ratio above 0; a scene that is not planar; translation",
        )

    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        still = without_velocities(rows)
        if still is None:
            return "the matches fit more than one essential matrix: degenerate scene or motion"
        return [velocities(still, rows)]


_MOST = 30
_SAMPLE, _SAMPLE_MOST = 20, (10, 16)
"""Matches of a sample of the robust search; evaluations of its descents to coefficients and of Sampson errors."""
_SINGULAR = "the linear system has more than one solution: degenerate motion, scene or readout ratio"
_ROUNDING = 1e-14
"""The 45 coefficients of slow motion are separate by 1e-10 of the largest singular value and less."""


def monomials(x: FloatArray, degree: int) -> FloatArray:
    """(..., 2 degree + 3) of rays (..., 3)."""
    p, s = x[..., 0], x[..., 1]
    return np.stack([*(p * s**i for i in range(degree + 1)), *(s**j for j in range(degree + 2))], axis=-1)


def system(x: FloatArray, y: FloatArray, degree: int) -> FloatArray:
    """(..., 21) or (..., 45) of rays (..., 3) of frames 0 and 1, z = 1: s = 0 is the principal point's row."""
    products = monomials(y, degree)[..., :, None] * monomials(x, degree)[..., None, :]
    return products[..., places(degree) >= 0]


def extract(F: FloatArray, degree: int) -> list[FreeMotion]:
    """Motions whose coefficients are near to F, (21,) or (45,) of arbitrary length and sign; the nearest first.

    Least squares over all unknowns, from either rotation of an essential matrix. Where all velocities are along t,
    as in slow motion nearly, the twin of each has nearly the same coefficients.
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
    """R (..., 2, 3, 3) and t, v0, v1, 0, 0 (..., 2, 5, 3) of unit coefficients (..., 21 or 45).

    Either rotation of t's essential matrix, whose entries the velocities share, with the translations that fit it.
    """
    block = places(degree)[np.ix_([0, degree + 2, degree + 1], [0, degree + 2, degree + 1])]
    U, _, Vt = np.linalg.svd(F[..., None, block])
    R = U @ np.stack([QUARTER, QUARTER.T]) @ Vt
    R = R * np.sign(np.linalg.det(R))[..., None, None]
    found = _translations(F[..., None, :], R, degree)
    return R, np.concatenate([found, np.zeros((*found.shape[:-2], 2, 3))], axis=-2)


def _translations(F: FloatArray, R: FloatArray, degree: int) -> FloatArray:
    """t, v0 and v1 (..., 3, 3) that fit best to coefficients and a rotation (..., 3, 3), without w0 and w1."""
    basis = np.tensordot(R, _translating(degree), axes=2)
    found = np.linalg.solve(basis @ np.swapaxes(basis, -1, -2), basis @ F[..., None])
    return np.asarray(found.reshape(*R.shape[:-2], 3, 3), dtype=np.float64)


@functools.cache
def _translating(degree: int) -> FloatArray:
    """(3, 3, 9, 21 or 45): coefficients by R and by (t, v0, v1), without rotations in the frames."""
    units = np.eye(9).reshape(3, 3, 3, 3)
    still = np.zeros((5, 3))
    return np.array([[with_derivatives(FreeMotion(R, *still), degree)[1][3:12] for R in row] for row in units])


def _sampled(matches: FloatArray, camera: PinholeCamera, refined: bool) -> list[MotionEstimate]:
    """Motions by the linear model of samples (b, n, 4), n >= 20."""
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
    first, place, R, vectors = (
        -camera.cy / camera.fy,
        places(1),
        np.zeros((len(F), 3, 3)),
        np.zeros((len(F), 5, 3)),
    )
    for k, (Rs, begun) in enumerate(zip(*_starts(F, 1), strict=True)):
        free_proposal(Rs, begun, F[k], place, data[k], focal, first, slowness, most, R[k], vectors[k])
    return [
        motion_of(*motion) if usable else MotionEstimate.failed(_SINGULAR)
        for motion, usable in zip(zip(so3.log(R), vectors[:, 0], strict=True), good, strict=True)
    ]


@final
@dataclass(frozen=True, kw_only=True)
class DaiSolver(FreeVelocitySolver):
    """The null vector of 21 or 45 coefficients, the motion nearest to it, and a descent on Sampson errors.

    The velocities of both frames are free and are not returned: on data that have one velocity, 6 or 12 unknowns
    are estimated for nothing, and what noise does grows by a factor of ten and more. In slow motion s0 and s1 are
    nearly equal, and the 45 coefficients nearly collinear.
    """

    model: Literal["linear", "uniform"] = "linear"
    """Whether the camera turns within a frame; the linear one leaves that out and is biased where it does."""

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
        """Motions of the smaller models: noise spoils 45 coefficients long before it spoils 21 or 9."""
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
        """By the linear model: noise of 0.3 px leaves nothing of 44 matches, and few 44 are free of outliers."""
        matches = np.stack([temporal_pairs(sample, "left") for sample in samples])
        if matches.shape[1] < _SAMPLE:
            return [[MotionEstimate.failed(f"{matches.shape[1]} left matches, need {_SAMPLE}")] for _ in matches]
        return [[each] for each in _sampled(matches, rig.camera, self.refinement == "sampson")]


_STEPS = 6
"""Gauss-Newton steps: on exact matches at 6 degrees and 1.2 m a frame the last changes w by 1e-9 rad."""
_ROUNDING = 1e-14
"""Smallest singular value relative to the largest."""
_DEGENERATE = "the matches fit more than one essential matrix: degenerate scene or motion"


def jets(rows: Rows, patch_px: float) -> tuple[FloatArray, FloatArray]:
    """Rays of both frames (n, 3, 3): the ray, and what it changes by where frame 0's pixel moves along x and y.

    By as many px as ``patch_px``, to first order.
    """
    focal = np.array([rows.camera.fx, rows.camera.fy])
    x, y = np.zeros((2, len(rows.x), 3, 3))
    x[:, 0], y[:, 0] = rows.x, rows.y
    x[:, [1, 2], [0, 1]] = patch_px / focal
    y[:, 1:, :2] = patch_px * np.swapaxes(rows.affine.reshape(-1, 2, 2), 1, 2) / focal
    return x, y


def _product(of: Callable[[FloatArray, FloatArray], FloatArray], a: FloatArray, b: FloatArray) -> FloatArray:
    """A bilinear product of jets (..., 3, c), to first order."""
    moved = [of(a[..., k, :], b[..., 0, :]) + of(a[..., 0, :], b[..., k, :]) for k in (1, 2)]
    return np.stack([of(a[..., 0, :], b[..., 0, :]), *moved], axis=-2)


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], 9)


def essential_of_jets(x: FloatArray, y: FloatArray) -> FloatArray | None:
    """Like ``eight_point``, from the rays and their changes (n, 3, 3)."""
    T0, T1 = normalising_transform(x[:, 0, :2]), normalising_transform(y[:, 0, :2])
    E = null_essential(_product(_outer, y @ T1.T, x @ T0.T).reshape(-1, 9))
    return None if E is None else T1.T @ E @ T0


def equations(R: FloatArray, t: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values (..., n, 3) of a camera at rest, and their derivatives (..., n, 3, 18) by ``FreeMotion.moved``.

    Those by the velocities are exact; those by R and t are the ones of a camera at rest.

    Args:
        R, t: (..., 3, 3), (..., 3).
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
    """R, t and velocities that fit the jets (k, n, 3, 3) of k samples best, to first order in the velocities."""
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
    """An essential matrix of affine correspondences, then all unknowns together; points alone in the descent.

    The descent on Sampson errors needs 17 matches; of fewer the answer is what the equations give.
    """

    patch_px: float = 10.0
    """Noise of points over that of affine frames, px: as far from its point a frame is as uncertain as that."""

    def __post_init__(self) -> None:
        check_number("patch_px", self.patch_px, 1e-3, 1e3)

    @property
    def turning(self) -> bool:
        return True

    @property
    def least(self) -> int:
        return 7

    @property
    def about(self) -> tuple[str, str]:
        return (
            "D. Barath: Rolling Shutter Made Practical, ECCV 2026 (its equations); Hartley, PAMI 1997",
            "affine frames of the left matches; slow motion within the frames; readout ratio above 0; translation",
        )

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
            return _DEGENERATE
        still = at_rest_of(E, rows)
        return [*moving([still], x[None], y[None], rows.camera), still]

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self.propose_all([sample], rig, shutter)[0]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> list[list[MotionEstimate]]:
        """With the velocities, and at rest: noise of a few matches may dominate them."""
        sets = [self.matches_of(sample) for sample in samples]
        short = self.spec.shortage({"left": len(sets[0]), "affine": len(samples[0].affine)})
        if short is not None:
            return [[short] for _ in samples]
        rows = [Rows.of(matches, rig.camera, rig.camera.cy) for matches in sets]
        x, y = (np.stack(part) for part in zip(*(jets(each, self.patch_px) for each in rows), strict=True))
        found = [essential_of_jets(*each) for each in zip(x, y, strict=True)]
        stills = {k: at_rest_of(E, rows[k]) for k, E in enumerate(found) if E is not None}
        out = [[MotionEstimate.failed(_DEGENERATE)] for _ in samples]
        known = [*stills]
        moved = moving([*stills.values()], x[known], y[known], rig.camera) if known else []
        for k, motion in zip(known, moved, strict=True):
            out[k] = [first_of([each], sets[k], rig) for each in (motion, stills[k])]
        return out
