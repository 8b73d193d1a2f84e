"""Correct a rig's calibration by its frames: rotation of the right camera, baseline direction, focal lengths.

A slightly wrong calibration moves left-right matches off the epipolar lines. In ideal pixels these lines are rows,
and a small rotation (x, y, z) of the right camera and a ratio of focal lengths move rows of rays (u, v, 1) by

    -(1 + v^2) x + u v y + u z + v log(f_right / f_left).

``rotation_of_rows`` fits this to matches with outliers, without a motion or a shutter, which suffices to search
for matches along the epipolar lines. ``refine_rig`` then estimates all ``ERRORS`` jointly with the motion: as the
motion determines depth, tracks through four images also show the convergence of the cameras and their focal
lengths. It minimises whitened reprojection errors with heavy tails (``residuals.add_tracks``). A parameter that
the tracks do not determine stays at its prior mean, with the prior's standard deviation.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads scipy.special at its first use

from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences, without_lens
from rsbench.core.epipolar import ray_depths
from rsbench.core.rig import FRAMES, SIDES, RigCamera, StereoRig
from rsbench.core.se3 import compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import clustered, larger, variance_factor
from rsbench.solvers.engine.levenberg_marquardt import Damping, descend
from rsbench.solvers.engine.packed import Packed, each_term, heavy_tailed, inverse_definite, pack
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
"""Errors that are added to the calibration: rotation of the right camera about the body's axes, rad; rotation of
both cameras against the baseline, rad; logarithms of the focal lengths; the right camera's delay, periods."""
_CONVERGENCE, _DELAY = 1, len(ERRORS) - 1
_STEP = 1e-6
_SAMPLES, _ROUNDS, _REFITS = 2000, 8, 3
_ROW_PX = 1.0
"""Largest row difference of an inlier in the search, px."""
_FEWEST, _LEAST_SHARE = 30, 0.15
"""Fewest inliers of a rotation, and their least share: a random rotation has fewer."""
_WIDE = np.array([np.deg2rad(6.0), np.deg2rad(1.0), np.deg2rad(6.0), 0.08])
"""Prior standard deviations of x, y, z and log(f_right / f_left) in the search by rows (hardly depends on y)."""
_LEAST = np.array([np.deg2rad(0.2)] * 5 + [0.005, 0.005])
"""Smallest prior standard deviations of ``ERRORS``: the errors of an ordinary calibration."""
_PRIOR_FACTOR = 1.5
"""Prior standard deviations of all errors, divided by those found from rows, as they have the same cause."""
_ITERATIONS, _STILL = 15, 1e-4
_DAMPING = Damping(least=1e-8, first=1e-7, largest=1e6)
_MOST_TRACKS = 400
"""Most tracks per window: further ones would not improve the estimate."""
_LEAST_NOISE_PX = 0.3
_CHANCE = 0.001
"""Probability of significant errors of a calibration that is right."""
_SHARED_PX = 0.03
"""Error, px, that all matches of an image pair have in common."""
_LINE_STEPS = 5
_BEYOND, _TRACK_FREEDOM = 10.0, 5.0
"""Standard deviations beyond which errors are equally bad; degrees of freedom of a track."""
_LINE_NU, _CONVERGENCES, _SPEEDS = 3.0, np.linspace(-3.0, 3.0, 121), np.geomspace(1e-3, 10.0, 121)
"""Degrees of freedom of the errors in the comparison of disparities with parallax; convergences, in prior standard
deviations, and translations, in baselines per pixel of the focal length, that are compared."""
_APART, _CLEARLY = 0.5, 8.0
"""Least error of the convergence, prior standard deviations, and least difference of log-likelihoods, with which
parallax over time contradicts a calibration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundRig:
    """A rig whose calibration was corrected by its frames."""

    rig: StereoRig
    shutter: RollingShutter
    errors: FloatArray
    """(8,) values of ``ERRORS`` that were added to the calibration."""
    covariance: FloatArray
    """(8, 8) of the errors; 0: not estimated."""
    tracks: int
    """Number of tracks that were used."""

    @property
    def sigma(self) -> FloatArray:
        """(8,) standard deviations of the errors; 0: not estimated."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def significant(self) -> bool:
        """Whether the errors contradict the calibration, see ``contradict``."""
        return contradict(self.errors, self.covariance)

    @property
    def record(self) -> dict[str, Any]:
        """Values and standard deviations by name, for JSON; angles in rad."""
        pairs = zip(ERRORS, self.errors.tolist(), self.sigma.tolist(), strict=True)
        return {name: {"value": value, "sigma": sigma} for name, value, sigma in pairs if sigma > 0.0}

    @property
    def words(self) -> str:
        """Such as "right camera turned by 0.21, -0.10, 0.35 +- 0.01, 0.05, 0.01 deg; focal lengths ..."."""
        turn, turn_sigma = np.rad2deg(self.errors[:3]), np.rad2deg(self.sigma[:3])
        text = "right camera turned by {:.3f}, {:.3f}, {:.3f}".format(*turn)
        text += " +- {:.3f}, {:.3f}, {:.3f} deg".format(*turn_sigma)
        longer, sigma = 100.0 * np.expm1(self.errors[5:7]), 100.0 * self.sigma[5:7]
        text += f"; focal lengths {longer[0]:+.2f} +- {sigma[0]:.2f} % and {longer[1]:+.2f} +- {sigma[1]:.2f} %"
        late = f"; right camera later by {self.errors[_DELAY]:.4f} +- {self.sigma[_DELAY]:.4f} frame periods"
        return text + (late if self.sigma[_DELAY] > 0.0 else "")


def contradict(errors: FloatArray, covariance: FloatArray) -> bool:
    """Whether errors (8,) as a whole contradict a calibration: a chi-squared test at 0.1 %.

    Of seven errors one exceeds three deviations in every fiftieth rig by chance, and a needless correction costs
    accuracy. Errors with a covariance (8, 8) of 0 are not estimated.
    """
    free = np.flatnonzero(np.diagonal(covariance) > 0.0)
    inverse = np.linalg.pinv(covariance[np.ix_(free, free)], hermitian=True)
    return float(errors[free] @ inverse @ errors[free]) > float(scipy.special.chdtri(len(free), _CHANCE))


def with_errors(rig: StereoRig, errors: FloatArray) -> StereoRig:
    """The rig after ``ERRORS`` (8,) are added to its calibration; the body has the axes of ``of_cameras``."""
    both = np.array([0.0, errors[3], errors[4]])
    turned = [rig.own(side).R @ so3.exp(turn) for side, turn in zip(SIDES, (both, both + errors[:3]), strict=True)]
    _, y, z = turned[0][2] + turned[1][2]
    level = so3.exp(np.array([np.arctan2(y, z), 0.0, 0.0]))  # the mean viewing direction has no y
    cameras = []
    for side, R, log_focal in zip(SIDES, turned, errors[5:7], strict=True):
        own, longer = rig.own(side), float(np.exp(log_focal))
        camera = replace(own.camera, fx=own.camera.fx * longer, fy=own.camera.fy * longer)
        cameras.append(RigCamera(camera=camera, rotation=tuple(so3.log(R @ level.T))))
    return replace(rig, camera=rig.camera.ideal, left=cameras[0], right=cameras[1])


def _row_columns(rays: FloatArray) -> FloatArray:
    """(n, 4) derivatives of the rows v of right rays (n, 2) by x, y, z and log(f_right / f_left)."""
    u, v = rays[:, 0], rays[:, 1]
    return np.stack([-(1.0 + v * v), u * v, u, v], axis=-1)


def rotation_of_rows(stereo: FloatArray, rig: StereoRig, seed: int = 0) -> tuple[FloatArray, BoolArray] | None:
    """Estimate ``ERRORS`` from the rows of left-right matches (n, 4), ideal px, with many outliers.

    Returns:
        The errors (8,) that put the matches on the same rows, and the mask (n,) of inliers; None: too few inliers.
    """
    focal, camera = rig.camera.fx, rig.camera
    centre = np.array([camera.cx, camera.cy])
    left, right = ((stereo[:, k : k + 2] - centre) / focal for k in (0, 2))
    if len(stereo) < _FEWEST:
        return None
    rng, found, inside = np.random.default_rng(seed), np.zeros(4), np.zeros(len(stereo), dtype=np.bool_)
    for refit in range(_REFITS):
        turned = _rotated(right, found)
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
    # If the rays must be rotated by +x, the camera is rotated by -x.
    errors[:3], errors[5:7] = -found[:3], [0.5 * found[3], -0.5 * found[3]]
    return errors, inside


def _rotated(rays: FloatArray, found: FloatArray) -> FloatArray:
    """Rays (n, 2) of the right camera, scaled by exp of the fourth value and then rotated by x, y, z."""
    xyz = np.concatenate([rays * np.exp(found[3]), np.ones((len(rays), 1))], axis=1) @ so3.exp(found[:3]).T
    return xyz[:, :2] / xyz[:, 2:]


def prior_of(errors: FloatArray, delay_sigma: float = 0.0) -> FloatArray:
    """(8,) prior standard deviations of ``ERRORS`` if ``rotation_of_rows`` found ``errors`` (8,)."""
    turn = _PRIOR_FACTOR * float(np.max(np.abs(errors[[0, 2]])))
    focal = _PRIOR_FACTOR * float(np.max(np.abs(errors[5:7])))
    sizes = np.array([turn] * 3 + [0.5 * turn] * 2 + [focal] * 2)
    return np.append(np.maximum(_LEAST, sizes), delay_sigma)


@dataclass(frozen=True, eq=False)
class _Window:
    """Tracks of one pair of frame times, and the distribution of their errors."""

    tracks: FloatArray
    every: FloatArray
    """(n, 8) all tracks, with outliers."""
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
    """Estimate the calibration errors of a rig from tracks, jointly with a motion for each window.

    With several windows, standard deviations include the scatter between windows: motion that no model describes,
    and moving objects, change the convergence by several standard deviations of the noise.

    Args:
        windows: matches of pairs of frame times, with tracks, in pixels of the images.
        rig: the rig as calibrated.
        shutter: the known shutter.
        start: (8,) errors near the true ones, such as those of ``rotation_of_rows``.
        prior: (8,) standard deviations of the errors about 0; 0: exact.

    Returns:
        The corrected rig; None if no motion explains the tracks.
    """
    search = _Search(windows, rig, shutter, robust or RobustOptions(), seed, motion_model)
    # Rows hardly determine the convergence; if it is wrong, moving objects may give the motion of most inliers.
    by_parallax = search.convergence(start, float(prior[_CONVERGENCE]))[0]
    convergences = sorted({float(start[_CONVERGENCE]), 0.0, by_parallax})
    tried = list[tuple[float, _Problem, _Place]]()
    for each in convergences:
        begin = np.where(np.arange(len(ERRORS)) == _CONVERGENCE, each, start)
        found, thetas = search.find_motions(begin)
        with suppress(ValueError):  # there are no windows, or a lens shows no ray at a match
            problem = _Problem(found, search, prior)
            end = descend(problem, problem.place(begin, thetas), _ITERATIONS, _DAMPING)
            tried.append((problem.unlikely(end), problem, end))
    if not tried:
        return None
    _, problem, end = min(tried, key=lambda each: each[0])
    errors = end.errors
    covariance = problem.covariance(end.H, problem.window_gradients(errors, end.thetas))
    if covariance is None:
        return None
    count = sum(len(each.tracks) for each in problem.windows)
    return FoundRig(
        rig=with_errors(rig, errors),
        shutter=_delayed(shutter, errors),
        errors=errors,
        covariance=covariance,
        tracks=count,
    )


def spread_of_motion(
    found: FoundRig, matches: Correspondences, w: FloatArray, d: FloatArray, noise_px: float, motion_model: str
) -> FloatArray:
    """Covariance (6, 6) of a motion (w, d) between two times that comes from the errors of a corrected rig.

    The motion minimises the cost of the tracks for the corrected rig; the second derivatives of that cost show how
    it moves with each error. Zero if there are too few tracks.

    Args:
        matches: those from which the motion was estimated, with tracks, in pixels of the images.
        noise_px: standard deviation of their errors.
        motion_model: its model.
    """
    search = _Search([matches], found.rig, found.shutter, RobustOptions(), 0, motion_model)
    tracks = Correspondences(tracks=matches.tracks)
    packed = pack(tracks, found.rig, found.shutter, motion_model)
    theta = packed.theta(w, d)
    window = search.window(matches.tracks, found.rig, found.shutter, theta, noise_px)
    if window is None:
        return np.zeros((6, 6))
    problem = _Problem([window], search, found.sigma)
    (_, by_errors), free = problem.place(np.zeros(len(ERRORS)), [theta]).backs[0], problem.free
    by_errors = packed.motion_jacobian(theta) @ by_errors
    return by_errors @ found.covariance[np.ix_(free, free)] @ by_errors.T


def agrees(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    prior: FloatArray,
    robust: RobustOptions | None = None,
    seed: int = 0,
    motion_model: str = "linear",
) -> bool:
    """Whether one step of ``refine_rig`` from errors of 0 does not ``contradict`` the calibration.

    This takes a fifth of the time. One step suffices for errors that move rows by a fraction of a pixel: the
    neglected terms are quadratic in them. It does not for a convergence at which disparities change their sign, so
    these are compared with parallax first.
    """
    if parallax_contradicts(windows, rig, shutter, prior, robust, seed, motion_model):
        return False
    search = _Search(windows, rig, shutter, robust or RobustOptions(), seed, motion_model)
    found, thetas = search.find_motions(np.zeros(len(ERRORS)))
    if not found:
        return False
    problem = _Problem(found, search, prior)
    here = problem.place(np.zeros(len(ERRORS)), thetas)
    covariance = problem.covariance(here.H)
    if covariance is None:
        return False
    errors = np.zeros(len(ERRORS))
    errors[problem.free] = -np.linalg.solve(here.H, here.g)
    return not contradict(errors, covariance)


def parallax_contradicts(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    prior: FloatArray,
    robust: RobustOptions | None = None,
    seed: int = 0,
    motion_model: str = "linear",
) -> bool:
    """Whether disparities are clearly not proportional to parallax over time, so that the convergence is wrong.

    Rows hardly show it. The arguments are those of ``agrees``.
    """
    search = _Search(windows, rig, shutter, robust or RobustOptions(), seed, motion_model)
    sigma = float(prior[_CONVERGENCE])
    convergence, gain = search.convergence(np.zeros(len(ERRORS)), sigma)
    return abs(convergence) > _APART * sigma and gain > _CLEARLY


def rows_moved(errors: FloatArray, rig: StereoRig) -> float:
    """Root mean square over the image, px, of the row differences that ``ERRORS`` (8,) cause."""
    camera = rig.camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5))
    rays = camera.ideal.unproject(np.stack([x, y], axis=-1).reshape(-1, 2))[:, :2]
    moved = _row_columns(rays) @ np.append(errors[:3], errors[5] - errors[6])
    return camera.fx * float(np.sqrt(np.mean(moved**2)))


Line = tuple[FloatArray, FloatArray, FloatArray]
"""Inverse depths (n,) of points, their standard deviations (n,), and disparities (n,), px."""


def _line_loss(line: Line, slope: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Negative log-likelihoods (m,) of lines through points, and slopes (m,) that are more likely.

    Args:
        slope, offset: (m,) of the disparities by the inverse depths.
    """
    x, error, y = (each[:, None] for each in line)
    variance = 2.0 * _LEAST_NOISE_PX**2 + (slope * error) ** 2
    square = (y - slope * x - offset) ** 2 / (_LINE_NU * variance)
    weight = 1.0 / (variance * (1.0 + square))
    better = np.sum(weight * x * (y - offset), axis=0) / np.maximum(np.sum(weight * x * x, axis=0), 1e-300)
    return 0.5 * (_LINE_NU + 1.0) * np.sum(np.log1p(square), axis=0), np.maximum(better, 1e-9)


class _Search(NamedTuple):
    """The windows of a rig whose calibration is estimated, and the settings of the search for their motions."""

    windows: Sequence[Correspondences]
    rig: StereoRig
    shutter: RollingShutter
    robust: RobustOptions
    seed: int
    motion_model: str

    def find_motions(self, start: FloatArray) -> tuple[list[_Window], list[FloatArray]]:
        """The windows for which a motion is found with given errors (8,), and their motions."""
        solver = RefinedSolver(motion_model=self.motion_model, use_pairs=False)
        found, thetas = list[_Window](), list[FloatArray]()
        first, read = with_errors(self.rig, start), _delayed(self.shutter, start)
        for matches in self.windows:
            tracks, rng = Correspondences(tracks=matches.tracks), np.random.default_rng(self.seed)
            result = estimate_motion(tracks, first, read, solver, self.robust, rng)
            if not result.estimate.success:
                continue
            packed = pack(tracks, first, read, self.motion_model)
            theta = packed.theta(result.estimate.w, result.estimate.d)
            chosen = matches.tracks[result.inliers["tracks"]]
            window = self.window(chosen, first, read, theta, result.estimate.noise_px or 0.0)
            if window is None:
                continue
            found.append(replace(window, every=matches.tracks))
            thetas.append(theta)
        return found, thetas

    def convergence(self, start: FloatArray, sigma: float) -> tuple[float, float]:
        """Error of the convergence, rad, that makes disparities proportional to parallax over time, and by how
        much its log-likelihood exceeds that of 0; both 0 if ``sigma``, of its prior, is 0 or nothing moves.

        The left camera alone gives the inverse depth of each track up to a factor, the window's speed. A wrong
        convergence adds one disparity to all tracks, so that these lie on a line that misses the origin. A grid of
        all lines is compared, as local steps do not pass a disparity of 0.

        Args:
            start: the other errors (8,).
        """
        total = np.zeros(len(_CONVERGENCES))
        rig = with_errors(self.rig, np.where(np.arange(len(ERRORS)) == _CONVERGENCE, 0.0, start))
        offsets = -rig.camera.fx * sigma * _CONVERGENCES
        for matches in self.windows if sigma > 0.0 else ():
            line = self._parallax(matches, rig)
            if line is None:
                continue
            slopes = np.broadcast_to(rig.camera.fx * rig.baseline / _SPEEDS[:, None], (len(_SPEEDS), len(offsets)))
            losses = [_line_loss(line, slope, offsets)[0] for slope in slopes]
            slope = slopes[np.argmin(losses, axis=0), 0]
            for _ in range(_LINE_STEPS):
                slope = _line_loss(line, slope, offsets)[1]
            total += np.minimum(np.min(losses, axis=0), _line_loss(line, slope, offsets)[0])
        total += 0.5 * _CONVERGENCES**2
        found = int(np.argmin(total))
        return float(sigma * _CONVERGENCES[found]), float(total[len(total) // 2] - total[found])

    def _parallax(self, matches: Correspondences, rig: StereoRig) -> Line | None:
        """Inverse depth (n,) of tracks in units of one over the translation, its standard deviation (n,), and
        disparity (n,), px, by the left camera's motion; None if it has none."""
        tracks, own = matches.tracks[:: max(len(matches.tracks) // _MOST_TRACKS, 1)], rig.about("left")
        pairs, eye = tracks[:, [0, 1, 4, 5]], rig.sensor("left")
        solver = RefinedSolver(motion_model=self.motion_model, one_camera=True)
        rng = np.random.default_rng(self.seed)
        found = estimate_motion(Correspondences(left=pairs), own, self.shutter, solver, self.robust, rng)
        estimate, length = found.estimate, float(np.linalg.norm(found.estimate.d))
        if not (estimate.success and length > 0.0):
            return None
        motion = make_motion(self.motion_model, estimate.w, estimate.d / length)
        ends = pairs[:, :2], pairs[:, 2:]
        first, second = (
            own.cam_from_world(motion, self.shutter.pixel_time(end, frame, "left"), "left")
            for frame, end in zip(FRAMES, ends, strict=True)
        )
        pose, x = compose(second, inverse(first)), eye.unproject(ends[0])
        depth = ray_depths(pose, x, eye.unproject(ends[1]))
        ahead = np.all(np.where(np.isfinite(depth), depth, -1.0) > 0.0, axis=-1) & found.inliers["left"]
        rho = 1.0 / depth[ahead, 0]
        turned, step = (pose.R[ahead] @ x[ahead][..., None])[..., 0], pose.t[ahead]
        there = turned + rho[:, None] * step
        speed = rig.camera.fx * np.linalg.norm(step[:, :2] - step[:, 2:] * there[:, :2] / there[:, 2:], axis=1)
        error = _LEAST_NOISE_PX * np.sqrt(2.0) * np.abs(there[:, 2]) / np.maximum(speed, 1e-9)
        straight = without_lens(Correspondences(tracks=tracks[ahead]), rig).tracks
        return rho, error, straight[:, 0] - straight[:, 2]

    def window(
        self, tracks: FloatArray, rig: StereoRig, shutter: RollingShutter, theta: FloatArray, noise_px: float
    ) -> _Window | None:
        """Some of the tracks (n, 8), and the distribution of their errors about a motion; None: too few agree."""
        some = Correspondences(tracks=tracks[:: max(len(tracks) // _MOST_TRACKS, 1)])
        packed = pack(some, rig, shutter, self.motion_model)
        tailed = heavy_tailed(packed, theta, max(noise_px, _LEAST_NOISE_PX))
        if tailed is None:
            return None
        return _Window(some.tracks, tracks, tailed.nu, tailed.scale)


def _delayed(shutter: RollingShutter, errors: FloatArray) -> RollingShutter:
    late = shutter.right_delay + float(errors[_DELAY])
    return shutter if errors[_DELAY] == 0.0 else replace(shutter, right_delay=float(np.clip(late, -1.0, 1.0)))


def _unlikely(squares: FloatArray, freedom: FloatArray) -> float:
    """Negative log-likelihood of squared errors (n,), px^2 per degree of freedom (n,), with heavy tails."""
    q = squares * freedom / (_LINE_NU * _LEAST_NOISE_PX**2)
    return 0.5 * float((_LINE_NU + freedom) @ np.log1p(q))


class _Place(NamedTuple):
    """A point of the descent: errors (8,), motions of the windows, and the cost with its derivatives."""

    errors: FloatArray
    thetas: list[FloatArray]
    cost: float
    g: FloatArray
    """(k,) gradient by the free errors after elimination of the motions; H (k, k) likewise."""
    H: FloatArray
    backs: list[tuple[FloatArray, FloatArray]]
    """For each window a (6,) and B (6, k): the step of its motion is -a - B step of the errors."""


class _Problem:
    """The cost of all windows by errors and motions, for ``descend``; the motions are eliminated in each step."""

    def __init__(self, windows: Sequence[_Window], search: _Search, prior: FloatArray) -> None:
        self.windows, self.search = windows, search
        self.prior, self.free = prior, np.flatnonzero(prior > 0.0)
        ends = np.cumsum([0, *(len(each.tracks) for each in windows)])
        self._parts = [slice(*each) for each in itertools.pairwise(ends)]
        self._tracks = Correspondences(tracks=np.concatenate([each.tracks for each in windows]))

    def window_gradients(self, errors: FloatArray, thetas: Sequence[FloatArray]) -> FloatArray:
        """(windows, k) gradient of each window's cost by the free errors, with its motion fitted."""
        weight = self.prior[self.free] ** -2.0
        pairs = zip(self.windows, thetas, strict=True)
        places = [_Problem([window], self.search, self.prior).place(errors, [theta]) for window, theta in pairs]
        return np.array([place.g - weight * errors[self.free] for place in places])

    def unlikely(self, place: _Place) -> float:
        """Negative logarithm, up to a constant, of the probability of a place by all tracks of all windows, since
        which of them are outliers depends on the place; those of a window without a motion are."""
        beyond = _BEYOND * _LEAST_NOISE_PX
        total = 0.5 * float(np.sum((place.errors[self.free] / self.prior[self.free]) ** 2))
        windows = self.search.windows
        count = sum(len(each.tracks) for each in windows) - sum(len(each.every) for each in self.windows)
        for window, theta in zip(self.windows, place.thetas, strict=True):
            packed = self._packed(place.errors, Correspondences(tracks=window.every))
            squares = np.minimum(each_term(packed, theta).squares / packed.freedom, beyond**2)
            total += _unlikely(squares, packed.freedom)
        return total + count * _unlikely(np.array([beyond**2]), np.array([_TRACK_FREEDOM]))

    def covariance(self, H: FloatArray, window_gradients: FloatArray | None = None) -> FloatArray | None:
        """(8, 8) of the errors from the Hessian of the free ones, 0 of the others; None if it is singular."""
        inverse, covariance = inverse_definite(H), np.zeros((len(ERRORS), len(ERRORS)))
        if inverse is None:
            return None
        if window_gradients is not None and len(window_gradients) > 1:
            scatter = clustered(window_gradients @ inverse, np.arange(len(window_gradients)))
            inverse = larger(scatter * variance_factor(len(window_gradients) - 1.0, 1), inverse)
        # Errors that all matches have in common do not average out, however many matches there are.
        inverse = inverse + (_SHARED_PX / self.search.rig.camera.fx) ** 2 * np.eye(len(inverse))
        known_before = np.minimum(self.prior[self.free] / np.sqrt(np.diagonal(inverse)), 1.0)
        covariance[np.ix_(self.free, self.free)] = inverse * np.outer(known_before, known_before)
        return covariance

    def _packed(self, errors: FloatArray, tracks: Correspondences | None = None) -> Packed:
        rig, shutter = with_errors(self.search.rig, errors), _delayed(self.search.shutter, errors)
        return pack(tracks or self._tracks, rig, shutter, self.search.motion_model)

    def place(self, errors: FloatArray, thetas: list[FloatArray]) -> _Place:
        """Negative log-likelihood at errors (8,) and motions, its gradient and Hessian.

        The Hessian uses derivatives of rays and times. The gradient is a central difference of the cost, because
        noisy rays in those derivatives would bias the focal lengths, by five standard deviations for 1200 tracks.
        """
        k, packed = len(self.free), self._packed(errors)
        cost, g, H, backs = 0.0, np.zeros(k), np.zeros((k, k)), list[tuple[FloatArray, FloatArray]]()
        weight, steps = self.prior[self.free] ** -2.0, _STEP * np.eye(len(ERRORS))[self.free]
        both = [[self._packed(errors + each).tracks for each in (step, -step)] for step in steps]
        derivatives = [(ahead[:, :, :3] - behind[:, :, :3]) / (2.0 * _STEP) for ahead, behind in both]
        all_by = np.stack(derivatives, axis=2)
        for part, window, theta in zip(self._parts, self.windows, thetas, strict=True):
            tracks, by, size = packed.tracks[part], all_by[part], 6 + k
            rest = packed.focal, packed.baseline, np.array([window.nu, window.scale]), np.ones(len(tracks))
            unused = np.zeros(size), np.zeros((size, size))
            gradient, whole = np.zeros(size), np.zeros((size, size))
            for j, ends in enumerate(both):
                costs = [add_tracks(theta, packed.law, each[part], by, *rest, *unused) for each in ends]
                gradient[6 + j] = (costs[0] - costs[1]) / (2.0 * _STEP)
            for j in range(6):
                step = _STEP * np.eye(6)[j]
                costs = [
                    add_tracks(theta + each, packed.law, tracks, by, *rest, *unused) for each in (step, -step)
                ]
                gradient[j] = (costs[0] - costs[1]) / (2.0 * _STEP)
            here = add_tracks(theta, packed.law, tracks, by, *rest, np.zeros(size), whole)
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
