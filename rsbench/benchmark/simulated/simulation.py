"""Simulated correspondences: exact images of random points in a moving rolling-shutter rig, then noise and
outliers.

Row times are those of the true rows, computed exactly; solvers only get the noisy ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.arguments import (
    LARGEST_M,
    LARGEST_PX,
    check_number,
    check_one_of,
    check_whole,
    keep_plain,
    shown,
)
from rsbench.core.camera import inverse_2x2
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.projection import (
    ROW_TOLERANCE_PX,
    ProjectionStatus,
    back_project,
    pixel_moves,
    plane_basis,
    project_at,
    rs_project,
)
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

SceneShape = Literal["box", "plane"]
OutlierImages = Literal["frame 1", "all"]
MOST_POINTS = 1_000_000
"""Largest number of matches in each set, which take ten seconds of one core and a gigabyte."""
GYRO_RATE = 20
"""Samples of a gyroscope per frame period, if a solver uses them: 600 Hz at 30 frames/s."""

_MOST_SLANT = np.deg2rad(60.0)
"""Largest angle between the normal of a patch and the ray on which frame 0 sees it."""
_TILT = (0.3, -0.2)
"""Tilt of the plane in the axes of the camera: relative slope of its inverse depth along x and y of the ray."""
_DOWN = np.array([0.2, 0.9, -0.3]) / np.sqrt(0.94)
"""Direction of gravity, in the axes of the body at time 0."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """Options of a simulation."""

    pairs: int = 0
    """Matches over time per camera; each camera has its own points."""
    tracks: int = 0
    """Points seen in all four images."""
    lines: int = 0
    """Straight lines seen in all four images. Each image shows two ends of a line, other points of it in every
    image, each read at the time of its row; a rolling shutter bends the line between them."""
    noise_px: float = 0.0
    """Standard deviation of the noise on every pixel coordinate."""
    outlier_ratio: float = 0.0
    """Share of outliers: matches of which some pixels are displaced."""
    outlier_px: float = 80.0
    """Largest displacement of outliers per coordinate; displacements are uniform."""
    outlier_images: OutlierImages = "frame 1"
    """Displaced pixels of an outlier: those of frame 1, equally in both cameras, or all, independently."""
    depth: tuple[float, float] = (2.0, 10.0)
    """Range of depths in frame 0, metres, uniform."""
    gyro_rate: int = 0
    """Number of samples of a gyroscope per frame period; 0: none."""
    gyro_noise_deg: float = 0.0
    """Standard deviation of the noise of a sample, degrees per frame period, on each axis."""
    gyro_bias_deg: float = 0.0
    """Length of the bias of all samples, in a random direction, degrees per frame period."""
    gyro_delay: float = 0.0
    """Error of the samples' time stamps, frame periods; positive if the stamps are too late."""
    gravity: bool = False
    """Whether the direction of gravity is given, at the start of each frame."""
    gravity_noise_deg: float = 0.0
    """Standard deviation of each of the two angles of the direction of gravity, degrees."""
    affine: bool = False
    """Whether the left matches have affine frames, of patches with slants up to 60 degrees, or of the plane."""
    affine_noise: float = 0.0
    """Standard deviation of the noise on every number of an affine frame, as a share of the frame's size."""
    shape: SceneShape = "box"
    """Whether points have random depths, or lie on one slanted plane in the middle of the range."""

    def __post_init__(self) -> None:
        for name in ("pairs", "tracks", "lines"):
            check_whole(name, getattr(self, name), 0, MOST_POINTS)
        check_number("noise_px", self.noise_px, 0.0, LARGEST_PX)
        check_number("outlier_ratio", self.outlier_ratio, 0.0, 1.0)
        check_number("outlier_px", self.outlier_px, 0.0, LARGEST_PX)
        check_whole("gyro_rate", self.gyro_rate, 0, 100_000)
        check_number("gyro_noise_deg", self.gyro_noise_deg, 0.0)
        check_number("gyro_bias_deg", self.gyro_bias_deg, 0.0)
        check_number("gyro_delay", self.gyro_delay, -10.0, 10.0)
        check_number("gravity_noise_deg", self.gravity_noise_deg, 0.0)
        check_number("affine_noise", self.affine_noise, 0.0)
        check_one_of("shape", self.shape, get_args(SceneShape))
        check_one_of("outlier_images", self.outlier_images, get_args(OutlierImages))
        depth = self.depth
        if not isinstance(depth, (tuple, list, np.ndarray)) or len(depth) != 2:
            raise ValueError(f"depth = {shown(depth)}: must be two distances in metres, the nearer first")
        for distance in depth:
            check_number("depth", distance, 0.0, LARGEST_M)
        if not 0.0 < depth[0] <= depth[1]:
            raise ValueError(f"depth = {depth}: must be two positive distances in metres, the nearer first")
        object.__setattr__(self, "depth", (float(depth[0]), float(depth[1])))
        keep_plain(self)


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """Simulated correspondences with their ground truth."""

    correspondences: Correspondences
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    outliers: dict[str, np.ndarray]
    """Mask of the outliers, by set: ``left``, ``right``, ``tracks``, and ``lines`` if there are any."""


def random_direction(rng: np.random.Generator) -> FloatArray:
    """Return a random unit vector (3,), uniform on the sphere."""
    v = rng.standard_normal(3)
    return unit(v)


def unit(v: FloatArray) -> FloatArray:
    """Return a vector (3,) scaled to length 1, without ``np.linalg.norm``, whose order of sums depends on the
    processor."""
    return v / np.sqrt(np.sum(v * v))


def random_motion(rng: np.random.Generator, angle: float, distance: float, model: str = "linear") -> Motion:
    """Return a random motion that rotates by ``angle`` (radians) and translates by ``distance`` (metres) per frame
    period."""
    return make_motion(model, angle * random_direction(rng), distance * random_direction(rng))


def simulate(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    options: SimulationOptions,
    rng: np.random.Generator,
) -> Simulation:
    """Simulate matches of points that the moving rig sees in all images of their set.

    Equal generators give common random numbers: candidate points, standardised noise and outliers do not depend on
    motion, shutter, rig and noise level, and fewer matches are the first ones of a larger number. ``rng`` must be
    new, because other generators are spawned from it.

    Raises:
        ValueError: too few points are in view under the motion.
    """
    scenes, noises, wrongs = rng.spawn(3), rng.spawn(3), rng.spawn(3)
    counts = {"left": options.pairs, "right": options.pairs, "tracks": options.tracks}
    views: dict[str, tuple[Side, ...]] = {"left": ("left",), "right": ("right",), "tracks": ("left", "right")}
    world = MovingRig(rig, shutter, motion, options)
    noisy, outliers = dict[str, FloatArray](), dict[str, NDArray[np.bool_]]()
    patches = np.zeros((0, 2, 2)), np.zeros((0, 3))
    for (name, count), scene, noise, wrong in zip(counts.items(), scenes, noises, wrongs, strict=True):
        exact, points = world.matches(scene, count, views[name])
        if name == "left":
            patches = exact[:, 0], points
        # (n, views, frames, 2) -> xl0, yl0, xr0, yr0, xl1, ...
        matches = np.swapaxes(exact, 1, 2).reshape(len(exact), 4 * len(views[name]))
        noisy[name] = matches + options.noise_px * noise.standard_normal(matches.shape)
        outliers[name] = _displace(noisy[name], options, wrong)
    noisy["gyro"] = _gyro(motion, options, rng.spawn(1)[0])
    noisy["gravity"] = _gravity(motion, options, rng.spawn(1)[0])
    if options.lines:
        scene, noise, wrong = rng.spawn(3)
        exact = world.lines(scene)
        noisy["lines"] = exact + options.noise_px * noise.standard_normal(exact.shape)
        outliers["lines"] = _displace(noisy["lines"], options, wrong)
    noisy["affine"] = world.affine(*patches, rng.spawn(1)[0])
    correspondences = Correspondences(**noisy)
    return Simulation(correspondences=correspondences, rig=rig, shutter=shutter, motion=motion, outliers=outliers)


def _gyro(motion: Motion, options: SimulationOptions, rng: np.random.Generator) -> FloatArray:
    """Return samples (n, 4), tau and w, for tau from -0.5 to 2.5 frame periods."""
    if options.gyro_rate == 0:
        return np.zeros((0, 4))
    tau = -0.5 + np.arange(3 * options.gyro_rate + 1) / options.gyro_rate
    bias = np.deg2rad(options.gyro_bias_deg) * random_direction(rng)
    noise = np.deg2rad(options.gyro_noise_deg) * rng.standard_normal((len(tau), 3))
    return np.column_stack([tau + options.gyro_delay, motion.velocity(tau)[0] + bias + noise])


def _gravity(motion: Motion, options: SimulationOptions, rng: np.random.Generator) -> FloatArray:
    """Return rows (2, 4), tau and the direction of gravity, for a tilted camera."""
    if not options.gravity:
        return np.zeros((0, 4))
    tau = np.array([0.0, 1.0])
    down = motion.body_from_world(tau).R @ _DOWN
    noise = np.deg2rad(options.gravity_noise_deg) * rng.standard_normal((2, 3))
    across = noise - np.sum(noise * down, axis=1, keepdims=True) * down  # no rotation about gravity itself
    return np.column_stack([tau, (so3.exp(across) @ down[..., None])[..., 0]])


def _slanted(rays: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return unit normals (n, 3) of patches on unit rays (n, 3), slanted in random directions."""
    slant, turn = rng.uniform(size=(2, len(rays))) * [[_MOST_SLANT], [2.0 * np.pi]]
    axis = np.sum(plane_basis(rays) * np.stack([np.cos(turn), np.sin(turn)], axis=1)[:, None], axis=2)
    return (so3.exp(slant[:, None] * axis) @ rays[..., None])[..., 0]


def _displace(matches: FloatArray, options: SimulationOptions, rng: np.random.Generator) -> np.ndarray:
    """Displace pixels of randomly chosen matches, in place; return the mask (n,) of these outliers."""
    draws = rng.uniform(-1.0, 1.0, (len(matches), 3))
    chosen = np.argsort(draws[:, 2], kind="stable")[: round(options.outlier_ratio * len(matches))]
    mask = np.zeros(len(matches), dtype=np.bool_)
    mask[chosen] = True
    half = matches.shape[1] // 2
    moves = np.hstack([np.zeros((len(matches), half)), *half // 2 * [draws[:, :2]]])
    if options.outlier_images == "all":
        moves = rng.uniform(-1.0, 1.0, matches.shape)
    matches[mask] += options.outlier_px * moves[mask]
    return mask


_SLIDE = 0.2
"""Largest shift of an end along its line in an image, as a share of the line's length."""
_SECANT_STEPS = 12


@dataclass(frozen=True, eq=False)
class MovingRig:
    """A rig, its motion and the options of a simulation, from which its images without noise are computed."""

    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    options: SimulationOptions

    def matches(
        self, rng: np.random.Generator, count: int, sides: tuple[Side, ...]
    ) -> tuple[FloatArray, FloatArray]:
        """Return pixels (count, views, 2 frames, 2), and their points (count, 3), which every view sees once."""
        rig, options = self.rig, self.options
        camera = rig.sensor(sides[0])
        found, places = [np.zeros((0, len(sides), 2, 2))], [np.zeros((0, 3))]
        total = 0
        for _ in range(60):
            if total >= count:
                break
            pixels, points = self._points(sides[0], rng.uniform(size=(count - total + count // 4 + 8, 3)))
            views = [[self.seen_once(side, frame, points, pixels[:, 1]) for frame in FRAMES] for side in sides]
            stacked = np.stack([np.stack(row, axis=1) for row in views], axis=1)
            seen = np.all(np.isfinite(stacked), axis=(1, 2, 3))
            found.append(stacked[seen])
            places.append(points[seen])
            total += int(np.count_nonzero(seen))
        if total < count:
            wide = camera.fx * rig.baseline / options.depth[1]
            if len(sides) > 1 and wide >= camera.width:
                raise ValueError(
                    f"depth = {options.depth}: cameras {rig.baseline:g} m apart see no point together that is "
                    f"nearer than {options.depth[1] * wide / camera.width:.3g} m; use larger depths"
                )
            raise ValueError(
                f"the motion leaves only {total} of {count} points in view, {options.depth[0]:g} to "
                f"{options.depth[1]:g} m away; use a slower one or larger depths"
            )
        return np.concatenate(found)[:count], np.concatenate(places)[:count]

    def lines(self, rng: np.random.Generator) -> FloatArray:
        """Return the ends (lines, 16) of lines that all four images see."""
        count = self.options.lines
        found = [np.zeros((0, 16))]
        for _ in range(60):
            total = sum(len(each) for each in found)
            if total >= count:
                return np.concatenate(found)[:count]
            draws = rng.uniform(size=(2 * (count - total) + 8, 14))
            pixels, points = self._points("left", draws[:, :6].reshape(-1, 3))
            ends, rows = points.reshape(-1, 2, 3), pixels[:, 1].reshape(-1, 2)
            seen = list[FloatArray]()
            for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
                share = _SLIDE * draws[:, 6 + 2 * k : 8 + 2 * k]
                # Shift each end towards the other one.
                moved = ends + share[..., None] * (ends[:, ::-1] - ends)
                seen += [self.seen_once(side, frame, moved[:, e], rows[:, e]) for e in (0, 1)]
            stacked = np.concatenate(seen, axis=1)
            found.append(stacked[np.all(np.isfinite(stacked), axis=1)])
        raise ValueError(f"the motion leaves fewer than {count} lines in view; use a slower one")

    def _points(self, side: Side, draws: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (n, 2) of a camera's frame 0 and their points (n, 3), from uniform ``draws`` (n, 3)."""
        camera = self.rig.sensor(side)
        pixels = draws[:, :2] * (camera.width - 1, camera.height - 1)
        depth = _depths(self.options, draws[:, 2], camera.unproject(pixels))
        return pixels, back_project(self.rig, self.shutter, self.motion, side, 0, pixels, depth)

    def affine(self, pixels: FloatArray, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return noisy affine frames (n, 4) of patches at points (n, 3) with left pixels (n, 2 frames, 2).

        An outlier has the affine frame of its match before displacement.
        """
        rig, shutter, motion, options = self.rig, self.shutter, self.motion, self.options
        if not options.affine or len(points) == 0:
            return np.zeros((0, 4))
        tau = [shutter.pixel_time(pixels[:, frame], frame, "left") for frame in FRAMES]
        R, t = rig.cam_from_world(motion, tau[0], "left")
        back = np.swapaxes(R, -1, -2)
        if options.shape == "plane":
            normals = back @ [*_TILT, 1.0]
            normals /= np.sqrt(np.sum(normals**2, axis=1, keepdims=True))
        else:
            rays = points + (back @ t[..., None])[..., 0]
            normals = _slanted(rays / np.sqrt(np.sum(rays**2, axis=1, keepdims=True)), rng)
        along = plane_basis(normals)
        moves = [pixel_moves(rig, shutter, motion, "left", each, points, along) for each in tau]
        A = (moves[1] @ inverse_2x2(moves[0])).reshape(-1, 4)
        size = np.sqrt(0.5 * np.sum(A * A, axis=1, keepdims=True))
        return A + options.affine_noise * size * rng.standard_normal(A.shape)

    def seen_once(self, side: Side, frame: int, points: FloatArray, guess: FloatArray) -> FloatArray:
        """Return the pixels (n, 2) of points (n, 3) that one frame sees exactly once; NaN for the others.

        The result is that of ``rs_project``, which searches all rows, but slow motion takes far less time: an
        image point that is slower than the readout cannot be seen twice, and secant steps from a near row suffice.
        """
        rig, shutter, motion = self.rig, self.shutter, self.motion
        pixels = np.full((len(points), 2), np.nan)
        slow = self._slower_than_readout(side, frame, points)
        X, y0 = points[slow], guess[slow]
        seen = project_at(rig, motion, side, shutter.line_time(y0, frame, side), X)
        f0, y = seen[:, 1] - y0, seen[:, 1]
        for _ in range(_SECANT_STEPS if np.any(np.abs(f0) > ROW_TOLERANCE_PX) else 0):
            seen = project_at(rig, motion, side, shutter.line_time(y, frame, side), X)
            f = seen[:, 1] - y
            if np.all(np.abs(f) <= ROW_TOLERANCE_PX):
                break
            slope = np.where(f != f0, (f - f0) / np.where(y != y0, y - y0, 1.0), -1.0)
            y0, f0, y = y, f, np.where(np.abs(f) <= ROW_TOLERANCE_PX, y, y - f / slope)
        converged = np.abs(seen[:, 1] - y) <= ROW_TOLERANCE_PX
        inside = converged & rig.sensor(side).contains(seen[:, :2])
        pixels[slow] = np.where(inside[:, None], seen[:, :2], np.nan)
        if not np.all(slow):
            rest = rs_project(rig, shutter, motion, side, frame, points[~slow])
            pixels[~slow] = np.where((rest.status == ProjectionStatus.SEEN)[:, None], rest.pixels, np.nan)
        return pixels

    def _slower_than_readout(self, side: Side, frame: int, points: FloatArray) -> NDArray[np.bool_]:
        """Return the mask (n,) of points whose image provably moves at less than half the speed of the readout.

        Then the row equation decreases at every zero, so it has at most one zero. If no bound of the motion's
        speed is known, the mask is False.
        """
        rig, shutter, camera = self.rig, self.shutter, self.rig.camera
        none = np.zeros(len(points), dtype=np.bool_)
        if not (rig.rectified and shutter.plain):
            return none
        rows = (-0.5, 0.5 * shutter.height, shutter.height - 0.5)
        first, middle, last = (float(shutter.row_time(row, frame)) for row in rows)
        if (fastest := self.motion.fastest(first, last)) is None:
            return none
        speed = fastest[0] * np.linalg.norm(points, axis=-1) + fastest[1]
        depth = project_at(rig, self.motion, side, middle, points)[:, 2]
        nearest = depth - 0.5 * speed * shutter.readout_ratio
        steepest = np.hypot(1.0, max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy)
        return (nearest > 0.0) & (shutter.h * camera.fy * speed * steepest < 0.5 * nearest)


def _depths(options: SimulationOptions, draws: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the depths z (n,) of points on rays (n, 3), from uniform random ``draws`` (n,) in [0, 1)."""
    near, far = options.depth
    if options.shape == "box":
        return near + (far - near) * draws
    # A plane n.X = 1, tilted so that the depth changes over the image.
    middle = 0.5 * (near + far)
    return middle / (1.0 + _TILT[0] * rays[:, 0] + _TILT[1] * rays[:, 1])
