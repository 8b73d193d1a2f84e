"""The contract of solvers as named checks, for ``rsbench check-solver`` and our own tests.

Each check uses simulated data that follow the motion model and shutter of the solver. A solver need not be exact:
the error of a linearised one must decrease as the motion becomes smaller.
"""

from __future__ import annotations

import contextlib
import io
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Literal

import numpy as np

from rsbench.benchmark.simulated.simulation import GYRO_RATE, SceneShape, Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error, translation_of_offset
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.jobs.isolation import EntryFailure, IsolatedWorker, one_line
from rsbench.pipeline.isolated_components import checked_estimate
from rsbench.solvers.engine.base import (
    BESIDE,
    SENSORS,
    MotionEstimate,
    Solver,
    SolverEntry,
    SolverSpec,
    load_solver_entry,
)

_CLOSE = 0.2
"""Tolerance with which a mistake is recognised, as a share of the rotation angle and as an angle of the direction,
radians; the motions of two mistakes differ by more."""


def misreading(
    w: FloatArray, d: FloatArray, true_w: FloatArray, true_d: FloatArray, rig: StereoRig, point: str
) -> str | None:
    """Return the common mistake that explains an estimated motion; None if the motion is right, or none does.

    Args:
        w, d: (3,) estimated motion.
        true_w, true_d: (3,) true motion of the body.
        rig: the cameras.
        point: reference point of the solver.
    """
    # The error of the rotation divided by its angle, and the angle between the translations in radians.
    errors = {
        words: max(
            float(rotation_error(w, wrong_w)) / max(float(np.linalg.norm(true_w)), 1e-12),
            float(translation_error(d, wrong_d)),
        )
        for words, (wrong_w, wrong_d) in _misreadings(true_w, true_d, rig, point).items()
    }
    words = min(errors, key=lambda key: errors[key])
    return words if words and errors[words] < _CLOSE else None


def _misreadings(
    w: FloatArray, d_body: FloatArray, rig: StereoRig, point: str
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the motion that results from each mistake; the empty text is the key of the true motion."""
    points = {"body": d_body} | {side: translation_of_offset(w, d_body, rig.offset(side)) for side in SIDES}
    d = points[point]
    found = {
        "": (w, d),
        "w is inverted: X_body = exp([w]x) X_world + d, with the body that has moved": (-w, d),
        "d is inverted: X_body = exp([w]x) X_world + d, with the body that has moved": (w, -d),
        "w and d both have the opposite sign": (-w, -d),
        "it is the inverse motion: give the pose of the body in frame 1, not of the world in it": (
            -w,
            -so3.exp(-w) @ d,
        ),
        "it has the paper's axes (down, right, forward): swap x and y, and change the sign of w": (
            -w[[1, 0, 2]],
            d[[1, 0, 2]],
        ),
        "x and y are swapped": (w[[1, 0, 2]], d[[1, 0, 2]]),
        "it has axes with y up and z backward: y is down and z forward here": (w * [1, -1, -1], d * [1, -1, -1]),
        "it is mirrored: its axes are left-handed (y up, z forward?)": (w * [-1, 1, -1], d * [1, -1, 1]),
        "w is in degrees: give radians": (np.rad2deg(w), d),
    }
    for other, value in points.items():
        if other != point:
            whose = "body" if other == "body" else f"{other} camera"
            found[f"d is the translation of the {whose}, but the spec says reference_point = {point!r}"] = w, value
    return found


class BrokenContractError(Exception):
    """A violation of the contract, in one line."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """The result and the side effects of one call of ``estimate``."""

    estimate: MotionEstimate
    changed: tuple[str, ...] = ()
    """Names of the sets of matches that the call modified."""
    printed: str = ""


class Subject:
    """A solver whose answers are checked; close it after use.

    An entry of another package runs in a child process, which may hang, exit or crash.
    """

    def __init__(self, entry: SolverEntry, *, isolated: bool, time_limit_s: float) -> None:
        """
        Args:
            entry: the solver.
            isolated: whether it runs in a child process.
            time_limit_s: time limit per problem, in a child process.
        """
        self.entry = entry
        self.spec: SolverSpec = entry.solver.spec
        self.changed: set[str] = set()
        self.printed = ""
        self.hung = False
        """Whether a problem exceeded the time limit."""
        self._time_limit_s = time_limit_s
        self._worker: IsolatedWorker | None = None
        if isolated:
            place = os.fspath(entry.path.resolve()) if entry.path is not None else entry.name
            self._worker = IsolatedWorker(_serve, place, classes=(Answer, MotionEstimate))

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        """Solve a problem, and check the answer.

        Raises:
            BrokenContractError: the solver raised an exception, took too long or ended its process, or its answer
                is invalid.
        """
        if self._worker is None:
            try:
                answer = _looked_at(self.entry.solver, correspondences, rig, shutter)
            except EntryFailure as error:
                raise BrokenContractError(str(error)) from error
        else:
            start = time.monotonic()
            outcome = self._worker.call(correspondences, rig, shutter, limit_s=self._time_limit_s)
            self.printed = self.printed or outcome.output
            if not outcome.success:
                self.hung = time.monotonic() - start >= self._time_limit_s
                raise BrokenContractError(outcome.reason)
            answer = outcome.value
        self.changed |= set(answer.changed)
        self.printed = self.printed or answer.printed
        self._check(answer.estimate)
        return answer.estimate

    def _check(self, estimate: MotionEstimate) -> None:
        """Check what ``checked_estimate`` does not."""
        if not estimate.success and not estimate.reason:
            raise BrokenContractError("returned a failure without a reason")
        if estimate.success and estimate.metric and not self.spec.metric:
            raise BrokenContractError("returned metric = True, but its spec says metric = False")
        if estimate.covariance is not None:
            least = np.linalg.eigvalsh(estimate.covariance).min()
            if least < -1e-12 * np.abs(estimate.covariance).max():
                raise BrokenContractError(f"returned a covariance with the eigenvalue {least:.1e}")

    def close(self) -> None:
        """End the child process, if there is one."""
        if self._worker is not None:
            self._worker.close()


def _serve(place: str) -> Callable[..., object]:
    """Return the function that solves problems in the child process."""
    try:
        solver = load_solver_entry(place).solver
    except BaseException as error:
        raise EntryFailure(one_line(error)) from error
    return partial(_looked_at, solver)


def _looked_at(
    solver: Solver, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
) -> Answer:
    """Call a solver once; return its estimate, its output, and the matches that it modified.

    Raises:
        EntryFailure: the solver raised an exception, or its answer is invalid.
    """
    given = Correspondences(**vars(correspondences))  # copies that are read-only
    before = {field.name: getattr(given, field.name).tobytes() for field in fields(given)}
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            estimate = solver.estimate(given, rig, shutter)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise EntryFailure(f"raised {one_line(error)}") from error
    changed = tuple(name for name, content in before.items() if getattr(given, name).tobytes() != content)
    return Answer(estimate=checked_estimate(estimate), changed=changed, printed=printed.getvalue()[:200])


RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
ROLLING = RollingShutter(height=900, readout_ratio=0.8)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)
W, D = np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18])
"""Motion of 1.6 degrees and 0.3 m per frame, as large as the paper's; w and d are not parallel to an axis."""

Verdict = Literal["passed", "warning", "failed", "skipped"]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of one check."""

    check: str
    verdict: Verdict
    why: str = ""
    """The measured errors, or the fault."""


def check_solver(
    entry: SolverEntry, *, isolated: bool | None = None, time_limit_s: float | None = None
) -> list[Finding]:
    """Run all checks of the contract on a solver.

    Args:
        entry: the solver.
        isolated: whether it runs in a child process; by default only if it is not part of rsbench.
        time_limit_s: time limit per problem; by default that of its card.
    """
    limit = entry.options.time_limit_s if time_limit_s is None else time_limit_s
    findings: list[Finding] = []
    isolated = not entry.built_in if isolated is None else isolated
    with contextlib.closing(Subject(entry, isolated=isolated, time_limit_s=limit)) as subject:
        for name, check in CHECKS.items():
            silent = subject.hung or (findings and findings[0].verdict == "failed")
            try:
                verdict, why = ("skipped", "it does not answer") if silent else check(subject)
            except BrokenContractError as error:
                verdict, why = "failed", str(error)
            findings.append(Finding(check=name, verdict=verdict, why=why))
    return findings


# Data


def own_problem(subject: Subject, size: float = 1.0, seed: int = 5, noise_px: float = 0.0) -> Simulation:
    """Simulate a problem of 60 + 60 matches and 60 tracks that follow the solver's assumptions, under ``size``
    times the motion (W, D)."""
    shutter = ROLLING if subject.spec.shutter == "rolling" else GLOBAL
    try:
        motion = make_motion(subject.spec.motion_model, size * W, size * D, subject.spec.motion_parameters)
    except RsbenchError as error:
        raise BrokenContractError(str(error)) from error
    rate, upright = GYRO_RATE if "gyro" in subject.spec.needs else 0, "gravity" in subject.spec.needs
    options = SimulationOptions(
        pairs=60,
        tracks=60,
        noise_px=noise_px,
        gyro_rate=rate,
        gravity=upright,
        affine="affine" in subject.spec.needs,
    )
    return simulate(RIG, shutter, motion, options, np.random.default_rng(seed))


def given(subject: Subject, simulation: Simulation) -> Correspondences:
    """Return the matches of a simulation, with left-right matches if the solver needs them."""
    c = simulation.correspondences
    if "stereo" not in {*subject.spec.needs, *subject.spec.minimum}:
        return c
    return replace(c, stereo_0=c.tracks[:, :4], stereo_1=c.tracks[:, 4:])


def true_translation(subject: Subject, simulation: Simulation) -> FloatArray:
    """Return the true translation of the solver's reference point."""
    w, d = simulation.motion.w, simulation.motion.d
    return d if subject.spec.reference_point == "body" else translation_of_offset(w, d, RIG.offset("left"))


def _solved(subject: Subject, simulation: Simulation, matches: Correspondences | None = None) -> MotionEstimate:
    """Solve data that a solver must be able to solve; BrokenContractError if it fails."""
    matches = given(subject, simulation) if matches is None else matches
    estimate = subject.estimate(matches, RIG, simulation.shutter)
    if not estimate.success:
        raise BrokenContractError(f"failed on 60 + 60 matches and 60 tracks: {estimate.reason}")
    return estimate


# Checks


def answers(subject: Subject) -> tuple[Verdict, str]:
    """The solver answers easy data with a ``MotionEstimate`` of finite numbers."""
    _solved(subject, own_problem(subject))
    return "passed", ""


_SIZES, _SEEDS = (1.0, 0.5, 0.25), (5, 6, 7)
_EXACT = 1e-6
"""Limits of the errors of an exact solver (share of the angle, direction in radians, logarithm of the length), for
rounding and the last step of an iterative solver."""
_LARGEST, _BIAS = 0.1, (0.02, 0.005, 0.02)
"""Limits of the errors of a linearised solver at the paper's motion, and of errors that remain however small the
motion is. The latter distinguish a bias of the method from a wrong reference point, which errs by 0.03 rad."""


def finds_the_truth(subject: Subject) -> tuple[Verdict, str]:
    """The solver finds the motion of exact data: exactly, or with an error that decreases with the motion."""
    errors = np.array([[_errors(subject, size, seed) for seed in _SEEDS] for size in _SIZES]).max(axis=1)
    names = ("rotation", "direction", "length")
    shown = [f"{name} {full:.0e}" for name, full in zip(names, errors[0], strict=True) if np.isfinite(full)]
    biased = []
    for name, (full, _, quarter), bias in zip(names, errors.T, _BIAS, strict=True):
        if not np.isfinite(full) or max(full, quarter) < _EXACT:
            continue
        if full > _LARGEST or (quarter > 0.5 * full and quarter > bias):
            raise BrokenContractError(_what_is_wrong(subject, name, full, quarter))
        if quarter > 0.5 * full:
            biased.append(f"{name} {quarter:.1e} off however small the motion is")
    if biased:
        return "warning", "; ".join(biased)
    return "passed", f"relative errors on exact data: {', '.join(shown)}"


def _errors(subject: Subject, size: float, seed: int) -> tuple[float, float, float]:
    """Return the errors of rotation (share of its angle), direction (rad) and length (log; NaN if not metric)."""
    simulation = own_problem(subject, size, seed)
    estimate, d = _solved(subject, simulation), true_translation(subject, simulation)
    rotation = rotation_error(estimate.w, simulation.motion.w) / np.linalg.norm(simulation.motion.w)
    length = float(scale_error(estimate.d, d)) if estimate.metric else np.nan
    return float(rotation), float(translation_error(estimate.d, d)), length


def _what_is_wrong(subject: Subject, name: str, full: float, quarter: float) -> str:
    simulation = own_problem(subject)
    estimate, truth = _solved(subject, simulation), simulation.motion
    words = misreading(estimate.w, estimate.d, truth.w, truth.d, RIG, subject.spec.reference_point)
    if words is not None:
        return words
    d = true_translation(subject, simulation)
    if name == "length":
        factor = np.linalg.norm(estimate.d) / np.linalg.norm(d)
        return f"d is {factor:.3g} times as long as it is in metres (its spec says metric = True)"
    return (
        f"{name} is {full:.1e} off on exact data, and {quarter:.1e} at a quarter of the motion: "
        f"w = {_vector(estimate.w)}, d = {_vector(estimate.d)}; the truth is {_vector(truth.w)}, {_vector(d)}"
    )


def _vector(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.4f}" for value in values) + "]"


def ignores_the_order(subject: Subject) -> tuple[Verdict, str]:
    """The same matches in another order give the same motion."""

    def shuffled(c: Correspondences) -> Correspondences:
        # Equal generators give the same order to corresponding rows of different sets.
        orders = {name: np.random.default_rng(1).permutation(len(matches)) for name, matches in vars(c).items()}
        return Correspondences(**{name: matches[orders[name]] for name, matches in vars(c).items()})

    return _agree(subject, shuffled, np.ones(3), np.ones(3), "in another order")


def mirrors(subject: Subject) -> tuple[Verdict, str]:
    """Data with mirrored x give the mirrored motion: left and right are exchanged, and d_x, w_y and w_z change
    sign."""
    alone = subject.spec.needs - BESIDE.keys() == {"left"}
    if not alone and (subject.spec.reference_point == "left" or "affine" in subject.spec.needs):
        return "skipped", "the mirror image of the left camera is the right one"
    last = RIG.camera.width - 1

    def flipped(matches: FloatArray, order: list[int]) -> FloatArray:
        out = matches[:, order]
        out[:, ::2] = last - out[:, ::2]
        return out

    def mirrored(c: Correspondences) -> Correspondences:
        same, swap = [0, 1, 2, 3], [2, 3, 0, 1]
        left, right = flipped(c.left, same), flipped(c.right, same)
        sensed = {"gyro": c.gyro * [1.0, 1.0, -1.0, -1.0], "gravity": c.gravity * [1.0, -1.0, 1.0, 1.0]}
        if alone:  # with tracks, whose left halves are then those of the mirrored left camera
            frames = c.affine * [1.0, -1.0, -1.0, 1.0]
            return Correspondences(
                left=left, right=right, tracks=flipped(c.tracks, [*range(8)]), affine=frames, **sensed
            )
        return Correspondences(
            left=right,
            right=left,
            stereo_0=flipped(c.stereo_0, swap),
            stereo_1=flipped(c.stereo_1, swap),
            tracks=flipped(c.tracks, [2, 3, 0, 1, 6, 7, 4, 5]),
            **sensed,
        )

    return _agree(subject, mirrored, np.array([1, -1, -1]), np.array([-1, 1, 1]), "of the mirrored world")


_SAME_W, _SAME_D = 1e-6, 1e-5
"""Tolerances, radians and share of the length, for iterative solvers that converge on different paths."""


def _agree(
    subject: Subject,
    change: Callable[[Correspondences], Correspondences],
    sign_w: FloatArray,
    sign_d: FloatArray,
    words: str,
) -> tuple[Verdict, str]:
    """Compare the motions from matches and from changed matches: on exact data they must be equal; with 0.3 px of
    noise, a difference is a warning."""
    severity: dict[float, Verdict] = {0.0: "failed", 0.3: "warning"}
    for noise_px, verdict in severity.items():
        simulation = own_problem(subject, noise_px=noise_px)
        c = given(subject, simulation)
        first, second = _solved(subject, simulation, c), _solved(subject, simulation, change(c))
        w_off = np.linalg.norm(second.w * sign_w - first.w)
        d_off = np.linalg.norm(second.d * sign_d - first.d) / np.linalg.norm(first.d)
        if w_off > _SAME_W or d_off > _SAME_D:
            off = f"{np.rad2deg(w_off):.1e} deg and {100 * d_off:.1e} % of d off"
            message = f"with {noise_px} px of noise, matches {words} give another motion: {off}"
            return verdict, message
    return "passed", ""


def is_deterministic(subject: Subject) -> tuple[Verdict, str]:
    """The same matches give the same motion to the last bit."""
    simulation = own_problem(subject, noise_px=0.3)
    first, second = (_solved(subject, simulation) for _ in range(2))
    if first.w.tobytes() != second.w.tobytes() or first.d.tobytes() != second.d.tobytes():
        off = np.rad2deg(np.linalg.norm(first.w - second.w))
        raise BrokenContractError(f"the same matches gave two motions, {off:.1e} deg apart: seed what you draw")
    return "passed", ""


def fails_by_value(subject: Subject) -> tuple[Verdict, str]:
    """Data that determine no motion give a finite motion or a failure with a reason; too few matches give a
    failure."""
    failures = 0
    cases = degenerate_cases()
    for name, (c, shutter) in cases.items():
        sets = {
            "": c,
            "pairs of ": _subset(c, "left", "right", *BESIDE),
            "tracks of ": _subset(c, "tracks", *SENSORS),
        }
        for kind, matches in sets.items():
            try:
                estimate = subject.estimate(matches, RIG, shutter)
            except BrokenContractError as error:
                raise BrokenContractError(f"{kind}{name}: {error}") from error
            failures += not estimate.success
            if estimate.success and name in ("two matches", "no matches"):
                raise BrokenContractError(f"{kind}{name}: gave a motion, which they cannot determine")
    return "passed", f"{failures} of {3 * len(cases)} problems without a motion were refused"


def _subset(c: Correspondences, *names: str) -> Correspondences:
    return Correspondences(**{name: getattr(c, name) for name in names})


def leaves_its_input_alone(subject: Subject) -> tuple[Verdict, str]:
    """No call so far modified the matches."""
    if subject.changed:
        raise BrokenContractError(f"wrote into {', '.join(sorted(subject.changed))}")
    return "passed", ""


def is_quiet(subject: Subject) -> tuple[Verdict, str]:
    """No call so far printed anything."""
    first = subject.printed.strip().partition("\n")[0]
    return ("warning", f"prints: {first!r}") if first else ("passed", "")


CHECKS: Mapping[str, Callable[[Subject], tuple[Verdict, str]]] = {
    "answers": answers,
    "finds the truth": finds_the_truth,
    "ignores the order of matches": ignores_the_order,
    "is deterministic": is_deterministic,
    "mirrors with the world": mirrors,
    "fails by value": fails_by_value,
    "leaves its input alone": leaves_its_input_alone,
    "is quiet": is_quiet,
}
"""Checks in order; if the first fails, the others are skipped."""


def degenerate_cases() -> dict[str, tuple[Correspondences, RollingShutter]]:
    """Return matches that determine no motion, or only a part of it, by the name of the case."""
    rng = np.random.default_rng(2)
    options = SimulationOptions(pairs=30, tracks=30, gyro_rate=GYRO_RATE, gravity=True, affine=True)

    def seen(
        w: FloatArray, d: FloatArray, shutter: RollingShutter = ROLLING, shape: SceneShape = "box"
    ) -> Correspondences:
        chosen, motion = replace(options, shape=shape), make_motion("linear", w, d)
        return simulate(RIG, shutter, motion, chosen, np.random.default_rng(2)).correspondences

    c = seen(W, D)
    line = np.linspace(100.0, 800.0, 20)
    pair = np.column_stack([line, line, line + 9.0, line + 7.0])
    tracks = np.column_stack([line, line, line - 60, line, line + 9, line + 7, line - 51, line + 7])
    wild = {
        name: rng.uniform(0, 899, (30, columns)) for name, columns in (("left", 4), ("right", 4), ("tracks", 8))
    }
    wild["affine"] = wild["right"] / 450.0
    sets = ("left", "right", "tracks", "affine")
    far = {name: 1e7 * getattr(c, name) for name in sets}
    first = {name: getattr(c, name)[[0] * 20] for name in sets}
    two = {name: getattr(c, name)[:2] for name in sets}
    zeros = {name: 0.0 * rows for name, rows in first.items()}
    return {
        "no matches": (Correspondences(), ROLLING),
        "two matches": (Correspondences(**two), ROLLING),
        "pure rotation": (seen(W, 0 * D), ROLLING),
        "pure translation": (seen(0 * W, D), ROLLING),
        "no motion": (seen(0 * W, 0 * D), ROLLING),
        "a global shutter": (seen(W, D, GLOBAL), GLOBAL),
        "a plane": (seen(W, D, shape="plane"), ROLLING),
        "points on a line": (Correspondences(left=pair, right=pair, tracks=tracks), ROLLING),
        "one camera": (Correspondences(left=c.left, affine=c.affine), ROLLING),
        "the same match 20 times": (Correspondences(**first), ROLLING),
        "matches at (0, 0)": (Correspondences(**zeros), ROLLING),
        "negative disparity": (Correspondences(tracks=c.tracks[:, [2, 3, 0, 1, 6, 7, 4, 5]]), ROLLING),
        "random numbers": (Correspondences(**wild), ROLLING),
        "matches far outside": (Correspondences(**far), ROLLING),
    }
