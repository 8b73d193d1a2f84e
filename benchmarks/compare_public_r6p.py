"""The parts ``--r6p`` and ``--claim`` of ``compare_public.py``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from public_answers import CAMERA, HEIGHT, SAME, ask, best, relative, row, timed, unit

from rsbench.core import so3
from rsbench.core.so3 import FloatArray
from rsbench.solvers.r6p import Resection, linear_pose

# R6P


class Resected(NamedTuple):
    """Six points and what a camera shows of them, that moves by its ray's second coordinate y."""

    X: FloatArray
    rays: FloatArray
    R: FloatArray
    C: FloatArray
    w: FloatArray
    t: FloatArray


def resected(rng: np.random.Generator, turn: float, spin: float, noise_px: float, model: str) -> Resected:
    """Of a camera turned by ``turn`` that turns by ``spin`` in a readout (degrees) and moves 0.3 m, at 0.3 m.

    Args:
        model: ``single`` or ``double``, linearised so; ``exact``, rotations.
    """
    v, w = np.radians(turn) * unit(rng), np.radians(spin) / HEIGHT * unit(rng)
    C, t = 0.3 * unit(rng), 0.3 / HEIGHT * unit(rng)
    R = so3.exp(v)
    rays = CAMERA.unproject(rng.uniform(0.0, 900.0, (6, 2)))
    y = rays[:, 1, None]
    seen = rng.uniform(2.0, 10.0, (6, 1)) * rays - C - y * t
    spun = so3.exp(y * w) if model == "exact" else np.eye(3) + y[..., None] * so3.hat(w)
    body = np.linalg.solve(spun, seen[..., None])[..., 0]
    X = np.linalg.solve(np.eye(3) + so3.hat(v) if model == "double" else R, body.T).T
    noisy = rays[:, :2] + noise_px / 810.0 * rng.normal(size=(6, 2))
    return Resected(np.asarray(X, dtype=np.float64), noisy, R, C, w, t)


def ours_r6p(problems: Sequence[Resected], turning: bool) -> FloatArray:
    """Solutions (n, 12), v C w t."""
    rays = np.stack([each.rays for each in problems])
    x = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)[:, None]
    X = np.stack([each.X for each in problems])
    focal = np.array([CAMERA.fx, CAMERA.fy])
    with np.errstate(all="ignore"):
        pose = linear_pose(
            Resection(X, 0.0 * X[..., 0], x, x[..., 1], np.zeros((1, 1, 3)), focal), turning, np.eye(3)
        )
        return np.concatenate([so3.log(pose.R), *pose[1:]], axis=-1)


def r6p_errors(found: FloatArray, true: Resected) -> FloatArray:
    """(count, 2) of R and C."""
    if len(found) == 0:
        return np.zeros((0, 2))
    turned = so3.angle(so3.exp(found[:, :3]) @ true.R.T)
    return np.stack([turned, relative(found[:, 3:6], true.C)], axis=-1)


def r6p(program: str, trials: int) -> Iterator[str]:
    yield "| turn, spin, noise, model | solver | found | e_R (deg) | e_C (relative) | in theirs | ms |"
    cases = [(2.0, spin, 0.0, model) for model in ("single", "double") for spin in (2.0, 10.0, 30.0)]
    cases += [(turn, 10.0, 0.0, "single") for turn in (10.0, 30.0, 90.0)]
    cases += [(2.0, spin, 0.0, "exact") for spin in (0.5, 2.0, 10.0, 30.0)]
    cases += [(2.0, 2.0, noise, "exact") for noise in (0.1, 0.3, 1.0)]
    for case in cases:
        turn, spin, noise, model = case
        problems = [resected(np.random.default_rng([17, k]), turn, spin, noise, model) for k in range(trials)]
        given = [np.hstack([each.X, each.rays]) for each in problems]
        setting = f"{turn:g}, {spin:g}, {noise:g}, {model}"
        pairs = [("1lin", True), ("2lin", False), ("iter5", False)]
        for method, turning in pairs:
            if {"1lin": "double", "2lin": "single", "iter5": "single"}[method] == model:
                continue
            theirs = ask(program, method, given, 1 if method == "1lin" else 5)
            errors = best([r6p_errors(a.solutions, p) for a, p in zip(theirs, problems, strict=True)], 2)
            count = float(np.mean([len(a.solutions) for a in theirs]))
            ms = 1e-3 * float(np.median([a.microseconds for a in theirs]))
            yield row(setting, f"theirs {method}, {count:.2g} solutions", errors, ms)
            if method == "iter5":
                continue
            found = ours_r6p(problems, turning)
            errors = best([r6p_errors(f[None], p) for f, p in zip(found, problems, strict=True)], 2)
            among = [_among(f, a.solutions) for f, a in zip(found, theirs, strict=True)]
            ms = timed(lambda problems=problems, turning=turning: ours_r6p(problems, turning)) / trials
            yield row(setting, f"ours {'single' if turning else 'double'}", errors, ms, among)


def _among(found: FloatArray, solutions: FloatArray) -> bool:
    """Whether v C w t (12,) is one of solutions (count, 12)."""
    scale = np.repeat([np.linalg.norm(part) + 1e-3 for part in found.reshape(4, 3)], 3)
    return bool(np.any(np.all(np.abs(solutions.reshape(-1, 12) - found) < SAME * scale, axis=-1)))


def in_a_cube(rng: np.random.Generator, turn: float, spin: float) -> Resected:
    """Six points in a cube of side 2 m that a camera of 45 degrees sees from 2 to 3.3 m; the rest as ``resected``.

    Exact rotations; it moves by a tenth of that distance in the readout.
    """
    half, distance = np.tan(np.radians(22.5)), rng.uniform(2.0, 3.3)
    R, w = so3.exp(np.radians(turn) * unit(rng)), np.radians(spin) / (2.0 * half) * unit(rng)
    C, t = np.array([0.0, 0.0, distance]), 0.1 * distance / (2.0 * half) * unit(rng)
    points: list[FloatArray] = []
    rays: list[FloatArray] = []
    while len(points) < 6:
        X, P, y = rng.uniform(-1.0, 1.0, 3), C, 0.0
        for _ in range(100):  # the pose depends on the row
            P = so3.exp(y * w) @ R @ X + C + y * t
            y = float(P[1] / P[2])
        if P[2] > 0.0 and np.all(np.abs(P[:2]) < half * P[2]):
            points.append(X)
            rays.append(P[:2] / P[2])
    return Resected(np.array(points), np.array(rays), R, C, w, t)


def claim(_: str, trials: int) -> Iterator[str]:
    """The start is off by up to 6 degrees, which is what the abstract says of P3P at 30 degrees in a frame."""
    yield "| turn, spin | solver | found | e_R (deg) | e_C (relative) | in theirs | ms |"
    for turn, spin in ((0.0, 30.0), (3.0, 10.0), (3.0, 20.0), (3.0, 30.0), (6.0, 10.0), (6.0, 20.0), (6.0, 30.0)):
        problems = [in_a_cube(np.random.default_rng([41, k]), turn, spin) for k in range(trials)]
        for turning in (False, True):
            found = ours_r6p(problems, turning)
            errors = best([r6p_errors(f[None], p) for f, p in zip(found, problems, strict=True)], 2)
            ms = timed(lambda p=problems, turning=turning: ours_r6p(p, turning)) / trials
            yield row(f"{turn:g}, {spin:g}", f"ours {'single' if turning else 'double'}", errors, ms)
