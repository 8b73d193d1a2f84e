"""A shaken rolling-shutter rig that sees points: rows at their times, by laws that are not ours."""

from collections.abc import Callable

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from rsbench.capture.trajectory_estimate import Trajectory
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, Prior, evaluate, make_curve
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

FOCAL, BASELINE, HEIGHT, RATIO = 520.0, 0.2, 480, 0.8
RIG = StereoRig(camera=PinholeCamera.centred(640, HEIGHT, FOCAL), baseline=BASELINE)
SHUTTER = RollingShutter(height=HEIGHT, readout_ratio=RATIO)
Law = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Rotations body_from_world (n, 3, 3) and positions of the body (n, 3) at times (n,)."""


def sines(rng: np.random.Generator, size: float, slowest: float, fastest: float) -> Law:
    """Three sines about and along each axis, on top of 1.5 degrees and 0.15 m per frame."""
    turn = np.radians(0.2) * size * rng.uniform(0.5, 1.5, (3, 3))
    shift = 0.005 * size * rng.uniform(0.5, 1.5, (3, 3))
    rates, phases = rng.uniform(slowest, fastest, (2, 3, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3, 3))
    w, v = (
        scale * each / np.linalg.norm(each)
        for scale, each in ((0.02618, rng.normal(size=3)), (0.15, rng.normal(size=3)))
    )

    def law(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        angles, places = (
            np.sum(size * np.sin(2.0 * np.pi * f * tau[:, None, None] + p), axis=-1)
            for size, f, p in ((turn, rates[0], phases[0]), (shift, rates[1], phases[1]))
        )
        R = Rotation.from_rotvec(angles) * Rotation.from_rotvec(tau[:, None] * w)
        return R.as_matrix(), tau[:, None] * v + places

    return law


def times(y: FloatArray, frame: int) -> FloatArray:
    """The rule of the conventions, written once more."""
    return frame + RATIO * y / HEIGHT


def seen(law: Law, points: FloatArray, frame: int, side: int) -> FloatArray:
    """Pixels (n, 2) of points of the world (n, 3): the row decides the time, and the time the row."""
    y = np.full(len(points), 0.5 * HEIGHT)
    for _ in range(12):
        R, p = law(times(y, frame))
        x = np.einsum("nij,nj->ni", R, points - p) + np.array([(0.5 - side) * BASELINE, 0.0, 0.0])
        before, y = y, FOCAL * x[:, 1] / x[:, 2] + 239.5
        if np.all((np.abs(y - before) < 1e-9) | (np.abs(y - 239.5) > HEIGHT)):  # or far beside the image
            break
    pixels = np.stack([FOCAL * x[:, 0] / x[:, 2] + 319.5, y], axis=-1)
    return np.where(x[:, 2:] > 0.1, pixels, np.nan)


NEAR = (2.0, 12.0)


def scattered(
    law: Law, frame: int, count: int, rng: np.random.Generator, depths: tuple[float, float] = NEAR
) -> FloatArray:
    """Points (n, 3) at depths, metres, in front of the left camera."""
    pixels, z = rng.uniform([0.0, 0.0], [640.0, HEIGHT], (count, 2)), rng.uniform(*depths, count)
    R, p = law(times(pixels[:, 1], frame))
    rays = np.concatenate([(pixels - [319.5, 239.5]) / FOCAL, np.ones((count, 1))], axis=1) * z[:, None]
    rays[:, 0] -= 0.5 * BASELINE
    return np.einsum("nji,nj->ni", R, rays) + p


def inside(pixels: FloatArray) -> BoolArray:
    x, y = pixels[:, 0::2], pixels[:, 1::2]
    return np.all((x > 0.0) & (x < 639.0) & (y > 0.0) & (y < 479.0), axis=1)


def matches(
    law: Law,
    frames: int,
    rng: np.random.Generator,
    outliers: float = 0.2,
    count: int = 300,
    noise: float = 0.3,
    depths: tuple[float, float] = NEAR,
) -> tuple[list[Correspondences], list[BoolArray]]:
    """For each two frames, tracks (count, 8) and which of them are right."""
    windows, right = list[Correspondences](), list[BoolArray]()
    for k in range(frames - 1):
        points = scattered(law, k, 3 * count, rng, depths)
        tracks = np.concatenate([seen(law, points, k + i // 2, i % 2) for i in range(4)], axis=1)
        tracks = tracks[inside(tracks)][:count]
        tracks = tracks + noise * rng.normal(size=tracks.shape)
        wrong = rng.random(len(tracks)) < outliers
        for j in np.flatnonzero(wrong):
            end = rng.integers(4)
            tracks[j, 2 * end : 2 * end + 2] = rng.uniform([0.0, 0.0], [640.0, 480.0])
        windows.append(Correspondences(tracks=tracks))
        right.append(~wrong)
    return windows, right


def row_errors_deg(found: Trajectory, law: Law, frames: int) -> FloatArray:
    """Errors of the rotations of all rows against the first row of their frame."""
    rows, out = np.arange(0.0, HEIGHT, 12.0), list[FloatArray]()
    for k in range(frames):
        tau = times(rows, k)
        ours, truth = found.motion.body_from_world(tau).R, law(tau)[0]
        ours, truth = ours @ ours[0].T, truth @ truth[0].T
        out.append(np.asarray(Rotation.from_matrix(ours @ np.swapaxes(truth, 1, 2)).magnitude())[1:])
    return np.rad2deg(np.array(out))


SHAKES = {"strong": (1.0, 0.15, 0.45), "tremor": (0.25, 0.15, 0.45), "walk": (1.0, 0.06, 0.18)}


def drawn(prior: Prior, rng: np.random.Generator, frames: int, interval: float) -> Curve:
    """A spline whose control poses the prior draws: accelerations by brute force from their covariance."""
    count = int(np.ceil((frames - 1 + RATIO) / interval)) + 3
    rho, m = np.exp(-interval / prior.memory), prior.smooth
    push = np.zeros(2000)
    push[0] = 1.0
    answer = scipy.signal.lfilter([1.0], np.poly([rho] * m), push)
    lags = np.array([answer[: 2000 - k] @ answer[k:] for k in range(count - 2)])
    root = np.linalg.cholesky(scipy.linalg.toeplitz(lags / lags[0]))
    turns, shifts = (np.sqrt(s) * interval**2 * root @ rng.normal(size=(count - 2, 3)) for s in prior[2:])
    w, v = (
        scale * each / np.linalg.norm(each)
        for scale, each in ((0.02618, rng.normal(size=3)), (0.15, rng.normal(size=3)))
    )
    steps, along = (
        np.concatenate([[interval * a], interval * a + np.cumsum(b, axis=0)]) for a, b in ((w, turns), (v, shifts))
    )
    R = [np.eye(3)]
    for step in steps:
        R.append(Rotation.from_rotvec(step).as_matrix() @ R[-1])
    p = np.concatenate([np.zeros((1, 3)), np.cumsum(along, axis=0)])
    return ContinuousMotion.of(make_curve(0.0, interval, np.array(R), p)).curve


def law_of(curve: Curve) -> Law:
    def law(tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        R, t = evaluate(curve, tau)[0]
        return R, -np.einsum("nji,nj->ni", R, t)

    return law
