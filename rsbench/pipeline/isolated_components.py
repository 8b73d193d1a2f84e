"""Run solvers: rsbench's own in this process, those of other packages each in a separate child process.

Any fault of another package's solver becomes a failed estimate with the reason. Errors of rsbench's own code are
raised, in either process.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.jobs.isolation import (
    NO_ANSWER,
    THREAD_VARIABLES,
    EntryFailure,
    IsolatedWorker,
    Outcome,
    one_line,
    use_one_thread,
)
from rsbench.pipeline.problem import EXAMPLE, read_problem
from rsbench.solvers.engine.base import (
    MatchSet,
    MotionEstimate,
    Solver,
    SolverEntry,
    SolverSpec,
    load_solver_entry,
)
from rsbench.solvers.engine.robust_motion import (
    MatchCount,
    RobustEstimate,
    RobustOptions,
    estimate_motion,
    inputs_of,
)
from rsbench.solvers.refined import warm_up

if TYPE_CHECKING:
    from collections.abc import Iterator


_MASKS: tuple[MatchSet, ...] = ("left", "right", "tracks")


class SolverRunner:
    """Runs solvers, with a time limit for those of other packages; use it as a context manager."""

    def __init__(
        self,
        *,
        time_limit_s: float | None = None,
        single_thread: bool = False,
        memory_mb: float | None = None,
    ) -> None:
        """
        Args:
            time_limit_s: time limit for one problem, instead of that on each solver's card.
            single_thread: whether children use one thread, so that results do not depend on the machine.
            memory_mb: memory limit of a child, see ``IsolatedWorker``.
        """
        self._memory_mb = memory_mb
        self._time_limit_s, self._single_thread = time_limit_s, single_thread
        self._workers: dict[tuple[str, str], IsolatedWorker] = {}
        self._stack = ExitStack()
        self._warm: set[str] = set()

    def robust(
        self,
        entry: SolverEntry,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        options: RobustOptions,
        rng: np.random.Generator,
    ) -> RobustEstimate:
        """``estimate_motion``; in the child for another package's solver, and ``rng`` is not advanced."""
        loop = entry.options.robust
        if entry.built_in:
            if entry.key not in self._warm:
                self._warm.add(entry.key)
                _compile(entry.solver)  # so that the first problem's time does not include it
            return estimate_motion(correspondences, rig, shutter, entry.solver, options, rng, loop)
        start = time.perf_counter()
        outcome = self._call(entry, "robust", correspondences, rig, shutter, options, rng, loop)
        if outcome.success and _fits(outcome.value, correspondences):
            return outcome.value
        return RobustEstimate(
            estimate=MotionEstimate.failed(outcome.reason or NO_ANSWER),
            inliers={name: np.zeros(len(getattr(correspondences, name)), dtype=np.bool_) for name in _MASKS},
            iterations=0,
            seconds=time.perf_counter() - start,
            threshold_px=options.threshold_px,
        )

    def bare(
        self, entry: SolverEntry, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> tuple[MotionEstimate, float]:
        """``Solver.estimate`` from all matches, and its processor time, seconds; NaN if its process ended."""
        try:
            correspondences, rig, shutter = inputs_of(entry.solver.spec, correspondences, rig, shutter)
        except ValueError as error:
            return MotionEstimate.failed(str(error)), 0.0
        if entry.built_in:
            return _timed(entry.solver, correspondences, rig, shutter)
        outcome = self._call(entry, "bare", correspondences, rig, shutter)
        match outcome.value:
            case (MotionEstimate() as estimate, float() as seconds):
                return estimate, seconds
        return MotionEstimate.failed(outcome.reason or NO_ANSWER), float("nan")

    def _call(self, entry: SolverEntry, *arguments: object) -> Outcome:
        place = os.fspath(entry.path.resolve()) if entry.path is not None else entry.name
        known = (place, entry.key)  # the key changes if the card is edited meanwhile
        if known not in self._workers:
            with suppress(RsbenchError):  # for an unknown motion model, which the child reports
                warm_up([entry.solver.spec.motion_model])  # compile here, where a progress line announces it
            worker = IsolatedWorker(
                _serve_solver,
                place,
                self._single_thread,
                classes=(MotionEstimate, RobustEstimate, MatchCount),
                environment=dict.fromkeys(THREAD_VARIABLES, "1") if self._single_thread else None,
                memory_mb=self._memory_mb,
            )
            self._workers[known] = self._stack.enter_context(worker)
        limit_s = entry.options.time_limit_s if self._time_limit_s is None else self._time_limit_s
        return self._workers[known].call(*arguments, limit_s=limit_s)

    def close(self) -> None:
        """End all children."""
        self._workers.clear()
        self._stack.close()

    def __enter__(self) -> SolverRunner:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def _fits(answer: object, correspondences: Correspondences) -> bool:
    """Whether an answer is a ``RobustEstimate`` with masks over these matches."""
    return isinstance(answer, RobustEstimate) and all(
        mask.dtype == np.bool_ and mask.shape == (len(getattr(correspondences, name, ())),)
        for name, mask in answer.inliers.items()
    )


def _timed(
    solver: Solver, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
) -> tuple[MotionEstimate, float]:
    start = time.process_time()
    estimate = solver.estimate(correspondences, rig, shutter)
    return estimate, time.process_time() - start


# In the child


def _serve_solver(place: str, single_thread: bool) -> Callable[..., object]:
    """The function that answers calls to a solver in the child."""
    if single_thread:
        use_one_thread()
    with as_entry_failure():
        solver = GuardedSolver(load_solver_entry(place).solver)
    if not isinstance(solver.spec, SolverSpec):
        raise EntryFailure(f"declares a {type(solver.spec).__name__}, not a SolverSpec")
    try:
        warm_up([solver.spec.motion_model])  # before the entry's time is measured
    except RsbenchError as error:  # unknown motion model
        raise EntryFailure(str(error)) from error

    def answer(what: str, *arguments: Any) -> object:
        if what == "bare":
            return _timed(solver, *arguments)
        correspondences, rig, shutter, options, rng, loop = arguments
        return estimate_motion(correspondences, rig, shutter, solver, options, rng, loop)

    return answer


def _compile(solver: Solver) -> None:
    """Run a small problem, so that all code of a built-in solver is compiled and loaded."""
    problem, options = read_problem(EXAMPLE), RobustOptions(max_iterations=10)
    given = problem.correspondences
    estimate_motion(given, problem.rig, problem.shutter, solver, options, np.random.default_rng(0))


class GuardedSolver(Solver):
    """Another package's solver, checked against the contract: each violation raises an ``EntryFailure``.

    Methods that it does not override run here, with the guarded ``estimate``.
    """

    def __init__(self, solver: Solver) -> None:
        self._solver = solver

    def _leaves(self, method: str) -> bool:
        return getattr(type(self._solver), method) is getattr(Solver, method)

    @cached_property
    def spec(self) -> SolverSpec:
        with as_entry_failure():
            return self._solver.spec

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        with as_entry_failure():
            estimate = self._solver.estimate(correspondences, rig, shutter)
        return checked_estimate(estimate)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        with as_entry_failure():
            sizes = dict(self._solver.sample_sizes(correspondences))
        if any(isinstance(n, bool) or not isinstance(n, int) or n < 0 for n in sizes.values()):
            raise EntryFailure(f"returned sample sizes {sizes}")
        return sizes

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        if self._leaves("propose"):
            return super().propose(sample, rig, shutter)
        with as_entry_failure():
            models = list(self._solver.propose(sample, rig, shutter))
        return [checked_estimate(model) for model in models]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        if self._leaves("propose_all"):
            yield from super().propose_all(samples, rig, shutter)
            return
        with as_entry_failure():
            proposals = iter(self._solver.propose_all(samples, rig, shutter))
        for _ in samples:
            with as_entry_failure():
                models = list(next(proposals, ()))
            yield [checked_estimate(model) for model in models]

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        if self._leaves("improve"):
            return super().improve(motion, correspondences, rig, shutter, quick)
        with as_entry_failure():
            estimate = self._solver.improve(motion, correspondences, rig, shutter, quick=quick)
        return checked_estimate(estimate)


@contextmanager
def as_entry_failure() -> Iterator[None]:
    """Convert anything raised inside, including an exit or an interrupt, to an ``EntryFailure``."""
    try:
        yield
    except EntryFailure:
        raise
    except RsbenchError as error:
        raise EntryFailure(str(error)) from error
    except BaseException as error:
        raise EntryFailure(f"raised {one_line(error)}") from error


_FIELD_TYPES: dict[str, tuple[type, ...]] = {
    "success": (bool, np.bool_),
    "reason": (str,),
    "metric": (bool, np.bool_),
    "direction_known": (bool, np.bool_),
    "noise_px": (float, int, np.floating, type(None)),
}


def checked_estimate(estimate: object) -> MotionEstimate:
    """Copy an estimate after a check that its fields have the right types and shapes, and finite numbers.

    Raises:
        EntryFailure: the check failed.
    """
    if not isinstance(estimate, MotionEstimate):
        raise EntryFailure(f"returned a {type(estimate).__name__}, not a MotionEstimate")
    given: dict[str, Any] = {}
    for field in dataclasses.fields(MotionEstimate):
        value = getattr(estimate, field.name, None)
        if field.name in _FIELD_TYPES and not isinstance(value, _FIELD_TYPES[field.name]):
            raise EntryFailure(f"returned {field.name} = {value!r}")
        given[field.name] = value.item() if isinstance(value, np.generic) else value
    if given["covariance"] is not None:
        covariance = np.asarray(given["covariance"])
        if covariance.dtype.kind not in "fiu" or covariance.shape != (6, 6) or not np.all(np.isfinite(covariance)):
            raise EntryFailure("returned a covariance that is not 6 x 6 finite numbers")
        given["covariance"] = covariance.astype(np.float64)
    if given["noise_px"] is not None and not np.isfinite(given["noise_px"]):
        raise EntryFailure(f"returned noise_px = {given['noise_px']}")
    try:
        return MotionEstimate(**given)
    except (TypeError, ValueError) as error:
        raise EntryFailure(f"returned {error}") from error
