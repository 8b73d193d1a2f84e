"""A solver under the contract: each answer is looked at where it is made, in this process or in a child's."""

from __future__ import annotations

import contextlib
import io
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from types import TracebackType
from typing import Any

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.jobs.isolation import EntryFailure, IsolatedWorker, one_line
from rsbench.pipeline.isolated_components import checked_estimate
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverEntry, SolverSpec, load_solver_entry


class BrokenContractError(Exception):
    """What a solver did that it must not do, in one line."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """What one call of ``estimate`` gave and did."""

    estimate: MotionEstimate
    changed: tuple[str, ...] = ()
    """Sets of matches that it wrote into."""
    printed: str = ""


class Subject:
    """A solver whose answers are checked; use as a context manager.

    An entry of another package runs in a child process, so that it may hang, exit or crash.
    """

    def __init__(self, entry: SolverEntry, *, isolated: bool, time_limit_s: float) -> None:
        """
        Args:
            entry: the solver.
            isolated: whether it runs in a child process.
            time_limit_s: for one problem, in a child process.
        """
        self.entry = entry
        self.spec: SolverSpec = entry.solver.spec
        self.changed: set[str] = set()
        self.printed = ""
        self.hung = False
        """Whether a problem took longer than the limit."""
        self._time_limit_s = time_limit_s
        self._worker: IsolatedWorker | None = None
        if isolated:
            place = os.fspath(entry.path.resolve()) if entry.path is not None else entry.name
            self._worker = IsolatedWorker(_serve, place, classes=(Answer, MotionEstimate))

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        """A valid answer.

        Raises:
            BrokenContractError: it raised, took too long, ended its process, or the answer is not valid.
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
        """What ``checked_estimate`` leaves open."""
        if not estimate.success and not estimate.reason:
            raise BrokenContractError("returned a failure without a reason")
        if estimate.success and estimate.metric and not self.spec.metric:
            raise BrokenContractError("returned metric = True, but its spec says metric = False")
        if estimate.covariance is not None:
            least = np.linalg.eigvalsh(estimate.covariance).min()
            if least < -1e-12 * np.abs(estimate.covariance).max():
                raise BrokenContractError(f"returned a covariance with the eigenvalue {least:.1e}")

    def __enter__(self) -> Subject:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        if self._worker is not None:
            self._worker.close()


def _serve(place: str) -> Callable[..., object]:
    """What answers in the child."""
    try:
        solver = load_solver_entry(place).solver
    except BaseException as error:
        raise EntryFailure(one_line(error)) from error

    def answer(*arguments: Any) -> Answer:
        return _looked_at(solver, *arguments)

    return answer


def _looked_at(
    solver: Solver, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
) -> Answer:
    """One answer, and what the call printed and changed.

    Raises:
        EntryFailure: it raised, or its answer is no valid one.
    """
    given = Correspondences(**vars(correspondences))  # arrays of its own, which refuse to be written
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
