"""Our solvers beside the public implementations of the same papers, on the same numbers.

python benchmarks/compare_public.py --r6p PROGRAM --zhuang PROGRAM --velocities PROGRAM --triplets PROGRAM

Each part runs if its program is named. A program is yours to write and build, outside of this repository: a main
of some lines around a function of a public repository. It is called as ``PROGRAM METHOD REPEAT``, reads problems,
each as ``rows columns`` and then the numbers, until the end of its input, solves each REPEAT times, and writes a
line for each: microseconds of the processor for one time, how many solutions, then all their numbers.

r6p         CenekAlbl/RnP, methods 1lin, 2lin (R6P1Lin, R6P2Lin with direction 1, r0 0, maxpow 2) and iter5
            (iterativeRnP of R6PIter, five steps); rows X Y Z x y, six; a solution is v C w t.
zhuang      ThomasZiegler/RS-aware-differential-SfM, calculateVelocities without and with alpha_k: velocity,
            acceleration; rows x y ux uy alpha alpha_k, nine; w v k.
velocities  danini/rolling_shutter_made_practical, Dai20ptSolver and Dai44ptSolver: 20, 44;
            rows x0 y0 x1 y1 tau0 tau1; R, t, w0, v0, w1, v1, row by row.
triplets    alexandervakhitov/sego, sego_solver with is_det_check, the second camera on the right: all;
            rows of four x y, of the left and right camera of frame 0 and 1, and the number of the one unseen; R t.

--claim needs no program: what the abstract of R6P (CVPR 2015) says of its accuracy, on a scene of ours.

Where a method has several solutions the one next to the truth counts, theirs and ours. "Found" is the share of
samples with a solution within 1e-6 of the truth: relative, of rotations in radians; "in theirs" that of samples
whose solution is, so near, one of theirs. Medians with exact 95 % intervals of order statistics. Times are of the
processor: of ours a sample of all in one batch where batches are what the solver takes.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
from collections.abc import Iterator, Sequence

import numpy as np
from compare_public_r6p import claim, r6p
from public_answers import CAMERA, FREE, HEIGHT, SAME, ask, best, relative, row, timed, unit

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_descent import refine
from rsbench.solvers.engine.free_solver import without_velocities
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows
from rsbench.solvers.triplets import Triplets, newton
from rsbench.solvers.twelve_parameters import velocities
from rsbench.solvers.zhuang import Flow, accelerations, null_vectors, velocity_of

# Zhuang et al.

Flowing = tuple[Flow, FloatArray, FloatArray]
"""And the true w and v."""


def flow(rng: np.random.Generator, turn: float, noise_px: float, k: float) -> Flowing:
    """Nine flows of the paper's own model, exact but for noise, and the true w and v; readout ratio 0.8."""
    w, v = np.radians(turn) * unit(rng), 0.3 * unit(rng)
    x = CAMERA.unproject(rng.uniform(0.0, 900.0, (9, 2)))
    rate = so3.cross(w, x) + v / rng.uniform(2.0, 10.0, (9, 1))
    rate = rate - x * rate[:, 2:]
    tau = 0.8 * (x[:, 1] / HEIGHT + 0.5)
    per_v = 0.8 / HEIGHT
    u, beta = rate, np.ones(9)
    for _ in range(60):  # the time of the end depends on where it is
        end = 1.0 + tau + per_v * u[:, 1]
        beta = ((end - tau) + k * 0.5 * (end**2 - tau**2)) * (2.0 / (2.0 + k))
        u = beta[:, None] * rate
    shift = noise_px / 810.0 * rng.normal(size=(2, 9, 2))
    x = x + np.pad(shift[0], ((0, 0), (0, 1)))
    u = u + np.pad(shift[1] - shift[0], ((0, 0), (0, 1)))
    tau = 0.8 * (x[:, 1] / HEIGHT + 0.5)
    end = 1.0 + tau + per_v * u[:, 1]
    return Flow(x, u, end - tau, 0.5 * (end**2 - tau**2), np.array([810.0, 810.0])), w, v


def zhuang(program: str, trials: int) -> Iterator[str]:
    yield "| turn (deg), noise (px), k | solver | found | e_w (deg) | e_v (rad) | in theirs | ms |"
    cases = [(2.0, noise, k) for k in (0.0, 0.3) for noise in (0.0, 0.01, 0.1)]
    for turn, noise, k in [*cases, (10.0, 0.0, 0.0), (10.0, 0.0, 0.3)]:
        problems = [flow(np.random.default_rng([23, seed]), turn, noise, k) for seed in range(trials)]
        given = [np.column_stack([f.x[:, :2], f.u[:, :2], f.alpha, f.alpha_k]) for f, *_ in problems]
        theirs = ask(program, "acceleration" if k else "velocity", given, 20)
        # Theirs leaves the sign of v open.
        parts = [a.solutions * [1, 1, 1, s, s, s, 1] for a in theirs for s in (1.0, -1.0)]
        answers = [np.concatenate(parts[2 * n : 2 * n + 2]) for n in range(trials)]
        ms = 1e-3 * float(np.median([a.microseconds for a in theirs]))
        setting = f"{turn:g}, {noise:g}, {k:g}"
        yield row(setting, "theirs", _flow_errors(answers, problems), ms)
        for name, most in (("ours", 1), ("ours, all k", 6))[: 2 if k else 1]:
            found = [ours_flow(f, bool(k), most) for f, *_ in problems]
            ms = timed(lambda p=problems, k=k, most=most: [ours_flow(f, bool(k), most) for f, *_ in p]) / trials
            among = [_flow_among(f, a) for f, a in zip(found, answers, strict=True)]
            yield row(setting, name, _flow_errors(found, problems), ms, among)


def ours_flow(given: Flow, accelerated: bool, most: int) -> FloatArray:
    """Solutions (count, 7), w v k, of the ``most`` smallest accelerations."""
    Z0, Z1 = given.system()
    values = (accelerations(Z0, Z1) or [0.0])[:most] if accelerated else [0.0]
    found = [velocity_of(given, null_vectors(Z0 + k * Z1), k) for k in values]
    return np.array([[*f.w, *f.v, f.k] for f in found if not isinstance(f, str)]).reshape(-1, 7)


def _flow_errors(
    answers: Sequence[FloatArray], problems: Sequence[tuple[Flow, FloatArray, FloatArray]]
) -> FloatArray:
    errors = []
    for found, (_, w, v) in zip(answers, problems, strict=True):
        unit_v = found[:, 3:6] / np.linalg.norm(found[:, 3:6], axis=1, keepdims=True)
        along = v / np.linalg.norm(v)
        errors.append(
            np.stack([np.linalg.norm(found[:, :3] - w, axis=1), np.linalg.norm(unit_v - along, axis=1)], -1)
        )
    return best(errors, 2)


def _flow_among(found: FloatArray, theirs: FloatArray) -> bool:
    return len(found) > 0 and bool(np.any(np.all(np.abs(theirs - found[0]) < SAME, axis=-1)))


# One essential matrix and velocities


def two_frames(rng: np.random.Generator, scale: float, noise_px: float, count: int) -> tuple[Rows, FreeMotion]:
    """Matches of the synthetic benchmark of that repository, and the motion of its middle rows.

    640 x 480 px, focal length 500; points within 1.5 m of the axis, 3 to 8 m away; frame 1 one unit away,
    turned by normal angles of 0.1, 0.1 and 0.05; velocities ``scale`` times fixed ones, by readout.
    """
    camera = PinholeCamera.centred(640, 480, 500.0)
    R = so3.exp(rng.normal(size=3) * [0.1, 0.1, 0.05])
    t = np.array([0.3, -0.1, 0.9]) + 0.1 * rng.normal(size=3)
    t = t / np.linalg.norm(t)
    w0, v0, w1, v1 = scale * np.array(
        [[0.02, -0.01, 0.015], [0.1, -0.05, 0.2], [-0.01, 0.02, -0.005], [-0.08, 0.15, -0.1]]
    )
    kept: list[FloatArray] = []
    while len(kept) < count:
        X = np.array([*rng.uniform(-1.5, 1.5, 2), rng.uniform(3.0, 8.0)])
        pixels = [_seen(camera, *frame, X) for frame in ((np.eye(3), np.zeros(3), w0, v0), (R, t, w1, v1))]
        match = np.concatenate(pixels)
        if np.all(match >= 0.0) and np.all(match < [640.0, 480.0] * 2):
            kept.append(match)
    matches = np.array(kept) + noise_px * rng.normal(size=(count, 4))
    return Rows.of(matches, camera, camera.cy), FreeMotion(R, t, v0, v1, w0, w1)


def _seen(
    camera: PinholeCamera, R: FloatArray, t: FloatArray, w: FloatArray, v: FloatArray, X: FloatArray
) -> FloatArray:
    tau, pixel = 0.0, np.zeros(2)
    for _ in range(20):
        pixel = camera.project((np.eye(3) + tau * so3.hat(w)) @ R @ X + t + tau * v)
        tau = (pixel[1] - camera.cy) / camera.height
    return pixel


def frame_errors(found: Sequence[Pose], true: Sequence[FreeMotion]) -> FloatArray:
    """(n, 2): of R, and of the direction of t, radians."""
    errors = []
    for pose, truth in zip(found, true, strict=True):
        along = pose.t / np.linalg.norm(pose.t)
        errors.append(
            [float(so3.angle(pose.R @ truth.R.T)), 2.0 * np.arcsin(np.linalg.norm(along - truth.t) / 2.0)]
        )
    return np.array(errors)


def apart(program: str, trials: int) -> Iterator[str]:
    yield "| velocities, noise (px), matches | solver | found | e_R (deg) | e_T (rad) | in theirs | ms |"
    for scale, noise, count in ((0.0, 0.0, 20), (0.5, 0.0, 100), (0.5, 0.5, 44), (0.5, 0.5, 100), (1.0, 0.5, 100)):
        drawn = [two_frames(np.random.default_rng([29, k]), scale, noise, count) for k in range(trials)]
        rows, true = [each for each, _ in drawn], [truth for _, truth in drawn]
        given = [_as_theirs(each) for each in rows]
        setting = f"{scale:g}, {noise:g}, {count}"
        for method in ("20", "44"):
            theirs = ask(program, method, given, 5)
            poses = [Pose(a.solutions[0, :9].reshape(3, 3), a.solutions[0, 9:12]) for a in theirs]
            ms = 1e-3 * float(np.median([a.microseconds for a in theirs]))
            yield row(setting, f"theirs, {method}", frame_errors(poses, true), ms)
        for name, solve in (("ours, linear", _linear), ("ours, Sampson", _descended)):
            found = [solve(each) for each in rows]
            ms = timed(lambda solve=solve, rows=rows: [solve(each) for each in rows]) / trials
            yield row(setting, name, frame_errors([Pose(f.R, f.t) for f in found], true), ms)


def _as_theirs(rows: Rows) -> FloatArray:
    packed = rows.packed()
    return np.hstack([packed[:, :4], packed[:, 4:] * rows.camera.fy / rows.camera.height])


def _linear(rows: Rows) -> FreeMotion:
    still = without_velocities(rows)
    if still is None:
        raise ValueError("matches of more than one essential matrix")
    return velocities(still, rows)


def _descended(rows: Rows) -> FreeMotion:
    start = _linear(rows)
    ends = [refine(each, rows, turning=True, most=100) for each in (start, start.at_rest())]
    return min(ends, key=lambda end: end[1])[0].of_unit_length()


# Triplets

MISSING = (3, 2, 1)
"""Of frame 0 left, right, frame 1 left, right: which image a sample's points are not seen in."""


def triplets(program: str, trials: int) -> Iterator[str]:
    yield "| motion, noise (px) | solver | found | e_R (deg) | e_d (relative) | in theirs | ms |"
    rig = StereoRig(camera=CAMERA, baseline=0.6)
    for degrees, metres, noise in ((2.0, 0.3, 0.0), (5.0, 0.5, 0.0), (15.0, 1.0, 0.0), (2.0, 0.3, 0.3)):
        tracks: list[FloatArray] = []
        true: list[Pose] = []
        for k in range(trials):
            rng = np.random.default_rng([31, k])
            motion = random_motion(rng, np.radians(degrees), metres)
            options = SimulationOptions(tracks=3, noise_px=noise)
            tracks.append(simulate(rig, FREE, motion, options, rng).correspondences.tracks)
            true.append(Pose(so3.exp(motion.w), np.array(motion.d)))
        setting = f"{degrees:g} deg, {metres:g} m, {noise:g}"
        missing = np.array(MISSING, dtype=np.float64)[:, None]
        given = [np.hstack([CAMERA.unproject(t.reshape(3, 4, 2))[..., :2].reshape(3, 8), missing]) for t in tracks]
        answers = ask(program, "all", given, 3)
        theirs = [_of_body(a.solutions, rig) for a in answers]
        count = float(np.mean([len(a.solutions) for a in answers]))
        ms = 1e-3 * float(np.median([a.microseconds for a in answers]))
        errors = best([_pose_errors(a, p) for a, p in zip(theirs, true, strict=True)], 2)
        yield row(setting, f"theirs, {count:.2g} solutions", errors, ms)
        found = ours_triplets(np.stack(tracks), rig)
        errors = best([_pose_errors(f[None], p) for f, p in zip(found, true, strict=True)], 2)
        ms = timed(lambda tracks=tracks: ours_triplets(np.stack(tracks), rig)) / trials
        among = [bool(np.any(np.all(np.abs(a - f) < SAME, axis=-1))) for f, a in zip(found, theirs, strict=True)]
        yield row(setting, "ours", errors, ms, among)


def ours_triplets(tracks: FloatArray, rig: StereoRig) -> FloatArray:
    """(n, 12) R and d, of tracks (n, 3, 8)."""
    with np.errstate(all="ignore"):
        pose = newton(Triplets.of(tracks, ((1, "left"), (1, "right"), (0, "left")), rig))
    return np.concatenate([pose.R.reshape(-1, 9), pose.t], axis=-1)


def _of_body(solutions: FloatArray, rig: StereoRig) -> FloatArray:
    """R and d (count, 12) of the left camera, in baselines, as of the body."""
    solutions = solutions.reshape(-1, 12)
    R, o = solutions[:, :9].reshape(-1, 3, 3), rig.offset("left")
    return np.hstack([solutions[:, :9], rig.baseline * solutions[:, 9:] + R @ o - o])


def _pose_errors(found: FloatArray, true: Pose) -> FloatArray:
    R = found[:, :9].reshape(-1, 3, 3)
    return np.stack([so3.angle(R @ true.R.T), relative(found[:, 9:], true.t)], axis=-1)


PARTS = {"claim": claim, "r6p": r6p, "zhuang": zhuang, "velocities": apart, "triplets": triplets}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--claim", action="store_true")
    for part in list(PARTS)[1:]:
        parser.add_argument(f"--{part}", metavar="PROGRAM")
    parser.add_argument("--trials", type=int, default=100)
    options = vars(parser.parse_args())
    for part, compare in PARTS.items():
        if options[part]:
            for line in compare(options[part], options["trials"]):
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
