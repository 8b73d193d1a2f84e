"""What frames show of a rig's calibration: the right camera's rotation, the baseline's direction, focal lengths.

A calibration that is a little wrong moves the left-right matches off the epipolar lines. In ideal pixels of the
rig these lines are rows, and to first order a rotation (x, y, z) of the right camera and a ratio of focal lengths
move the rows of its rays (u, v, 1) by

    -(1 + v^2) x + u v y + u z + v log(f_right / f_left).

``rotation_of_rows`` fits that to matches with outliers, without a motion or a shutter: enough to look for matches
along the lines. ``refine_rig`` then estimates all of it with the motion: tracks of four images also show, by the
depth that the motion gives them, how far the cameras converge and how long their focal lengths are. Its errors
are whitened reprojection errors with heavy tails, as everywhere (``residuals.add_tracks``); what the tracks do not
show stays at the prior, and its deviation says so.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.rig import RigCamera, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import clustered, larger, variance_factor
from rsbench.solvers.engine.levenberg_marquardt import Damping, descend
from rsbench.solvers.engine.packed import Packed, heavy_tailed, inverse_definite, pack
from rsbench.solvers.engine.residuals import add_tracks
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

ERRORS = (
    "right_x",
    "right_y",
    "right_z",
    "baseline_y",
    "baseline_z",
    "focal_left",
    "focal_right",
    "right_delay",
)
"""Rotation of the right camera about the body's axes, rad; of both cameras against the baseline, rad; logarithms
of the focal lengths; frame periods by which the right camera is later: added to what the calibration says."""
_CONVERGENCE, _DELAY = 1, len(ERRORS) - 1
_STEP = 1e-6
_SAMPLES, _ROUNDS, _REFITS = 2000, 8, 3
_ROW_PX = 1.0
"""Row difference of a match that counts for a rotation in the search, px."""
_FEWEST, _LEAST_SHARE = 30, 0.15
"""Matches that must agree on a rotation, and their share: matches of other scenes agree by chance on less."""
_WIDE = np.array([np.deg2rad(6.0), np.deg2rad(1.0), np.deg2rad(6.0), 0.08])
"""Prior standard deviations of x, y, z and log(f_right / f_left) in the search by rows, which hardly show y."""
_LEAST = np.array([np.deg2rad(0.2)] * 5 + [0.005, 0.005])
"""Prior standard deviations of ``ERRORS``, at least: what an ordinary calibration has wrong."""
_TIMES_FOUND = 1.5
"""Prior standard deviations of what rows do not show, over what they do: both come from one calibration."""
_ITERATIONS, _STILL = 15, 1e-4
_DAMPING = Damping(least=1e-8, first=1e-7, largest=1e6)
_MOST = 400
"""Tracks of a window: more would not be what limits the estimate."""
_LEAST_NOISE_PX = 0.3
_SHARED_PX = 0.03
"""Error, px, that matches of one pair of images have in common."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundRig:
    """A rig whose calibration was corrected by its own frames."""

    rig: StereoRig
    shutter: RollingShutter
    errors: FloatArray
    """(8,) of ``ERRORS`` that were added to the calibration."""
    sigma: FloatArray
    """(8,) their standard deviations; 0: not estimated."""
    tracks: int
    """That they are estimated from."""

    @property
    def record(self) -> dict[str, Any]:
        """Values and deviations by name, ready for JSON; angles in rad."""
        pairs = zip(ERRORS, self.errors.tolist(), self.sigma.tolist(), strict=True)
        return {name: {"value": value, "sigma": sigma} for name, value, sigma in pairs if sigma > 0.0}

    @property
    def words(self) -> str:
        """Such as "right camera turned by 0.21, -0.10, 0.35 deg (+- 0.01, 0.05, 0.01); focal lengths ..."."""
        turn, turn_sigma = np.rad2deg(self.errors[:3]), np.rad2deg(self.sigma[:3])
        text = "right camera turned by {:.3f}, {:.3f}, {:.3f}".format(*turn)
        text += " +- {:.3f}, {:.3f}, {:.3f} deg".format(*turn_sigma)
        longer, sigma = 100.0 * np.expm1(self.errors[5:7]), 100.0 * self.sigma[5:7]
        text += f"; focal lengths {longer[0]:+.2f} +- {sigma[0]:.2f} % and {longer[1]:+.2f} +- {sigma[1]:.2f} %"
        late = f"; right camera later by {self.errors[_DELAY]:.4f} +- {self.sigma[_DELAY]:.4f} frame periods"
        return text + (late if self.sigma[_DELAY] > 0.0 else "")


def with_errors(rig: StereoRig, errors: FloatArray) -> StereoRig:
    """The rig after ``ERRORS`` (8,) are added to its calibration; its body's axes stay on the baseline."""
    both = np.array([0.0, errors[3], errors[4]])
    turns = both, both + errors[:3]
    cameras = []
    for side, turn, log_focal in zip(("left", "right"), turns, errors[5:7], strict=True):
        own = rig.own(side)  # pyrefly: ignore[bad-argument-type]
        longer = float(np.exp(log_focal))
        camera = replace(own.camera, fx=own.camera.fx * longer, fy=own.camera.fy * longer)
        cameras.append(RigCamera(camera=camera, rotation=tuple(so3.log(own.R @ so3.exp(turn)))))
    return replace(rig, camera=rig.camera.ideal, left=cameras[0], right=cameras[1])


def _row_columns(rays: FloatArray) -> FloatArray:
    """(n, 4) by which rows (v) of right rays (n, 2) move with x, y, z and log(f_right / f_left)."""
    u, v = rays[:, 0], rays[:, 1]
    return np.stack([-(1.0 + v * v), u * v, u, v], axis=-1)


def rotation_of_rows(stereo: FloatArray, rig: StereoRig, seed: int = 0) -> tuple[FloatArray, BoolArray] | None:
    """Errors (8,) of a calibration from left-right matches (n, 4), ideal px, of whole images, with many outliers.

    Returns:
        The errors that put the matches on one row, and the mask (n,) of those; None where too few agree.
    """
    focal, camera = rig.camera.fx, rig.camera
    centre = np.array([camera.cx, camera.cy])
    left, right = ((stereo[:, k : k + 2] - centre) / focal for k in (0, 2))
    if len(stereo) < _FEWEST:
        return None
    rng, found, inside = np.random.default_rng(seed), np.zeros(4), np.zeros(len(stereo), dtype=np.bool_)
    for refit in range(_REFITS):
        turned = _turned(right, found)
        A, off = _row_columns(turned), left[:, 1] - turned[:, 1]
        prior = np.diag((_ROW_PX / focal / _WIDE) ** 2)
        if refit == 0:
            chosen = rng.integers(0, len(stereo), (_SAMPLES, 4))
            normal = np.swapaxes(A[chosen], 1, 2) @ A[chosen] + prior
            lines = np.linalg.solve(normal, np.swapaxes(A[chosen], 1, 2) @ off[chosen][..., None])[..., 0]
            scores = [np.count_nonzero(np.abs(off - A @ line) * focal < _ROW_PX) for line in lines]
            step = lines[int(np.argmax(scores))]
        else:
            step = np.zeros(4)
        for _ in range(_ROUNDS):
            inside = np.abs(off - A @ step) * focal < _ROW_PX
            step = np.linalg.solve(A[inside].T @ A[inside] + prior, A[inside].T @ off[inside])
        found = found + step
    if np.count_nonzero(inside) < max(_FEWEST, _LEAST_SHARE * len(stereo)):
        return None
    errors = np.zeros(len(ERRORS))
    # Rays that have to turn by +x are those of a camera that is turned by -x.
    errors[:3], errors[5:7] = -found[:3], [0.5 * found[3], -0.5 * found[3]]
    return errors, inside


def _turned(rays: FloatArray, found: FloatArray) -> FloatArray:
    """Rays (n, 2) of the right camera turned by x, y, z, and longer by the fourth's exponential."""
    xyz = np.concatenate([rays * np.exp(found[3]), np.ones((len(rays), 1))], axis=1) @ so3.exp(found[:3]).T
    return xyz[:, :2] / xyz[:, 2:]


def prior_of(errors: FloatArray, delay_sigma: float = 0.0) -> FloatArray:
    """(8,) standard deviations of the errors of a calibration whose rows show ``errors`` (8,)."""
    turn = _TIMES_FOUND * float(np.max(np.abs(errors[[0, 2]])))
    focal = _TIMES_FOUND * float(np.max(np.abs(errors[5:7])))
    sizes = np.array([turn] * 3 + [0.5 * turn] * 2 + [focal] * 2)
    return np.append(np.maximum(_LEAST, sizes), delay_sigma)


@dataclass(frozen=True, eq=False)
class _Window:
    """Tracks of one pair of times, and their motion."""

    tracks: FloatArray
    trust: FloatArray
    nu: float
    scale: float


def refine_rig(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    start: FloatArray,
    prior: FloatArray,
    robust: RobustOptions | None = None,
    seed: int = 0,
    motion_model: str = "linear",
) -> FoundRig | None:
    """The rig with the errors of its calibration that tracks show, jointly with a motion of each window.

    Args:
        windows: matches of pairs of times, with tracks, in pixels of the images.
        rig: as calibrated.
        shutter: known.
        start: (8,) errors near the right ones, such as ``rotation_of_rows`` gives.
        prior: (8,) standard deviations of the errors about 0; 0 is exact.

    Of several windows, errors count as they scatter from window to window: motion that no law describes, and
    things that move by themselves, pull the convergence by several deviations of the noise.

    Returns:
        None where no motion explains the tracks.
    """
    starts = [start]
    if start[_CONVERGENCE] != 0.0:
        starts.append(np.where(np.arange(len(ERRORS)) == _CONVERGENCE, 0.0, start))
    search = _Search(windows, rig, shutter, robust or RobustOptions(), seed, motion_model)
    tried = [search.moving(each) for each in starts]
    # Rows hardly show the convergence: under a wrong one, what moves in the scene may agree on a motion.
    best = int(np.argmax([agreeing for *_, agreeing in tried]))
    start, (found, thetas, _) = starts[best], tried[best]
    if not found:
        return None
    problem = _Problem(found, search, prior)
    end = descend(problem, problem.place(start, thetas), _ITERATIONS, _DAMPING)
    errors, sigma = end.errors, problem.sigma(end.H, problem.pulls(end.errors, end.thetas))
    if sigma is None:
        return None
    count = sum(len(each.tracks) for each in found)
    return FoundRig(
        rig=with_errors(rig, errors), shutter=_read(shutter, errors), errors=errors, sigma=sigma, tracks=count
    )


def agrees(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    prior: FloatArray,
    deviations: float,
    robust: RobustOptions | None = None,
    seed: int = 0,
    motion_model: str = "linear",
) -> bool:
    """Whether the first step of ``refine_rig`` from a calibration without errors finds none beyond the deviations.

    It is a fifth of the work. One step is enough of errors that move rows by a fraction of a pixel: what it leaves
    out is their square.
    """
    search = _Search(windows, rig, shutter, robust or RobustOptions(), seed, motion_model)
    found, thetas, _ = search.moving(np.zeros(len(ERRORS)))
    if not found:
        return False
    problem = _Problem(found, search, prior)
    here = problem.place(np.zeros(len(ERRORS)), thetas)
    sigma = problem.sigma(here.H)
    if sigma is None:
        return False
    return bool(np.all(np.abs(np.linalg.solve(here.H, here.g)) <= deviations * sigma[problem.free]))


def rows_moved(errors: FloatArray, rig: StereoRig) -> float:
    """Root mean square, px, over the image by which ``ERRORS`` (8,) move the rows of the right camera's rays."""
    camera = rig.camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5))
    rays = camera.ideal.unproject(np.stack([x, y], axis=-1).reshape(-1, 2))[:, :2]
    moved = _row_columns(rays) @ np.append(errors[:3], errors[5] - errors[6])
    return camera.fx * float(np.sqrt(np.mean(moved**2)))


class _Search(NamedTuple):
    """Windows of cameras whose calibration is in question, and how their motions are searched for."""

    windows: Sequence[Correspondences]
    rig: StereoRig
    shutter: RollingShutter
    robust: RobustOptions
    seed: int
    motion_model: str

    def moving(self, start: FloatArray) -> tuple[list[_Window], list[FloatArray], int]:
        """Windows that have a motion under errors (8,), their motions, and how many tracks agree with them."""
        solver, agreeing = RefinedSolver(motion_model=self.motion_model, use_pairs=False), 0
        found, thetas = list[_Window](), list[FloatArray]()
        first, read = with_errors(self.rig, start), _read(self.shutter, start)
        for matches in self.windows:
            tracks, rng = Correspondences(tracks=matches.tracks), np.random.default_rng(self.seed)
            result = estimate_motion(tracks, first, read, solver, self.robust, rng)
            if not result.estimate.success:
                continue
            packed = pack(tracks, first, read, self.motion_model)
            theta = packed.theta(result.estimate.w, result.estimate.d)
            chosen = matches.tracks[result.inliers["tracks"]]
            some = Correspondences(tracks=chosen[:: max(len(chosen) // _MOST, 1)])
            noise = max(result.estimate.noise_px or 0.0, _LEAST_NOISE_PX)
            tailed = heavy_tailed(pack(some, first, read, self.motion_model), theta, noise)
            if tailed is None:
                continue
            found.append(_Window(some.tracks, np.ones(len(some.tracks)), tailed.nu, tailed.scale))
            thetas.append(theta)
            agreeing += len(chosen)
        return found, thetas, agreeing


def _read(shutter: RollingShutter, errors: FloatArray) -> RollingShutter:
    late = shutter.right_delay + float(errors[_DELAY])
    return shutter if errors[_DELAY] == 0.0 else replace(shutter, right_delay=float(np.clip(late, -1.0, 1.0)))


class _Place(NamedTuple):
    """Where the descent is: errors (8,), motions of the windows, and the cost with its derivatives."""

    errors: FloatArray
    thetas: list[FloatArray]
    cost: float
    g: FloatArray
    """(k,) gradient by the free errors, the motions left out; H (k, k) likewise."""
    H: FloatArray
    backs: list[tuple[FloatArray, FloatArray]]
    """What gives the motions' steps."""


class _Problem:
    """Tracks of all windows as a function of the errors and of the windows' motions; the motions are left out."""

    def __init__(self, windows: Sequence[_Window], search: _Search, prior: FloatArray) -> None:
        self.windows, self.rig, self.shutter, self.model = windows, search.rig, search.shutter, search.motion_model
        self.prior, self.free = prior, np.flatnonzero(prior > 0.0)

    def pulls(self, errors: FloatArray, thetas: Sequence[FloatArray]) -> FloatArray:
        """(windows, k) gradient of each window's cost by the free errors, its motion fitted."""
        out, weight = list[FloatArray](), self.prior[self.free] ** -2.0
        for window, theta in zip(self.windows, thetas, strict=True):
            alone = copy.copy(self)
            alone.windows = [window]
            out.append(alone.place(errors, [theta]).g - weight * errors[self.free])
        return np.array(out)

    def sigma(self, H: FloatArray, pulls: FloatArray | None = None) -> FloatArray | None:
        """(8,) standard deviations of the errors by the Hessian of the free ones; None where it is singular."""
        inverse, sigma = inverse_definite(H), np.zeros(len(ERRORS))
        if inverse is None:
            return None
        if pulls is not None and len(pulls) > 1:
            scatter = clustered(pulls @ inverse, np.arange(len(pulls)))
            inverse = larger(scatter * variance_factor(len(pulls) - 1.0, 1), inverse)
        # Errors that matches share move all of them alike: no number of matches averages them away.
        shared = _SHARED_PX / self.rig.camera.fx
        each = np.hypot(np.sqrt(np.diagonal(inverse)), shared)
        sigma[self.free] = np.minimum(each, self.prior[self.free])
        return sigma

    def _packed(self, window: _Window, errors: FloatArray) -> Packed:
        matches = Correspondences(tracks=window.tracks)
        return pack(matches, with_errors(self.rig, errors), _read(self.shutter, errors), self.model)

    def place(self, errors: FloatArray, thetas: list[FloatArray]) -> _Place:
        """Negative log-likelihood at errors (8,) and motions, its gradient and Hessian.

        The Hessian has the derivatives of rays and times; the gradient is the cost's own central difference: noisy
        rays in the derivatives would pull the focal lengths to smaller values, five deviations of 1200 tracks.
        """
        k = len(self.free)
        cost, g, H, backs = 0.0, np.zeros(k), np.zeros((k, k)), list[tuple[FloatArray, FloatArray]]()
        weight = self.prior[self.free] ** -2.0
        for window, theta in zip(self.windows, thetas, strict=True):
            packed, size = self._packed(window, errors), 6 + k
            by = np.zeros((len(packed.tracks), 4, k, 3))
            rest = packed.focal, packed.baseline, np.array([window.nu, window.scale]), window.trust
            unused = np.zeros(size), np.zeros((size, size))
            gradient, whole = np.zeros(size), np.zeros((size, size))
            for j, index in enumerate(self.free):
                step = _STEP * np.eye(len(ERRORS))[index]
                ahead, behind = (self._packed(window, errors + each).tracks for each in (step, -step))
                by[:, :, j] = (ahead[:, :, :3] - behind[:, :, :3]) / (2.0 * _STEP)
                costs = [add_tracks(theta, packed.law, each, by, *rest, *unused) for each in (ahead, behind)]
                gradient[6 + j] = (costs[0] - costs[1]) / (2.0 * _STEP)
            for j in range(6):
                step = _STEP * np.eye(6)[j]
                costs = [
                    add_tracks(theta + each, packed.law, packed.tracks, by, *rest, *unused)
                    for each in (step, -step)
                ]
                gradient[j] = (costs[0] - costs[1]) / (2.0 * _STEP)
            here = add_tracks(theta, packed.law, packed.tracks, by, *rest, np.zeros(size), whole)
            cost += here / window.scale**2
            gradient, whole = gradient / window.scale**2, whole / window.scale**2
            back = np.linalg.pinv(whole[:6, :6], hermitian=True)
            g += gradient[6:] - whole[6:, :6] @ back @ gradient[:6]
            H += whole[6:, 6:] - whole[6:, :6] @ back @ whole[:6, 6:]
            backs.append((back @ gradient[:6], back @ whole[:6, 6:]))
        values = errors[self.free]
        cost += 0.5 * float(weight @ values**2)
        return _Place(errors, thetas, cost, g + weight * values, H + np.diag(weight), backs)

    def stepped(self, here: _Place, damping: float) -> _Place | None:
        step = np.linalg.solve(here.H + damping * np.diag(np.diagonal(here.H)), -here.g)
        errors = here.errors.copy()
        errors[self.free] += step
        moved = [theta - a - B @ step for theta, (a, B) in zip(here.thetas, here.backs, strict=True)]
        there = self.place(errors, moved)
        return there if there.cost <= here.cost else None

    def settled(self, before: _Place, after: _Place) -> bool:
        return before.cost - after.cost < _STILL
