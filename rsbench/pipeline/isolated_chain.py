"""Run feature matchers, stereo matchers and correctors of other packages, each in a child process of its own.

``Isolation`` returns an entry that looks like the original and answers from the child. Every fault of the child is
one ``RsbenchError`` with the entry's name. Our own entries are returned unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.components.plugins import Entry, Kind
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.jobs.isolation import IsolatedWorker
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import as_entry_failure
from rsbench.vision.corrector import (
    CORRECTORS,
    CorrectionProblem,
    Corrector,
    CorrectorSpec,
    find_corrected,
    load_corrector,
)
from rsbench.vision.feature_matcher import (
    FEATURE_MATCHERS,
    FeatureMatcher,
    find_correspondences,
    load_features,
)
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import (
    STEREO_MATCHERS,
    Cameras,
    MotionMatcher,
    StereoMatcher,
    find_depths,
    find_disparities,
    load_matcher,
    needs_motion,
)

AnyEntry = TypeVar("AnyEntry", bound=Entry[Any, Any])
Caller = Callable[..., Any]
Proxy = Callable[[Any, Caller], Any]
"""Creates a component that answers by a caller, from the original component and the caller."""


class Isolation:
    """Runs feature matchers, stereo matchers and correctors of other packages in children; a context manager."""

    def __init__(self, *, time_limit_s: float | None = None, memory_mb: float | None = None) -> None:
        """
        Args:
            time_limit_s: time limit for one call, instead of that on each entry's card.
            memory_mb: memory limit of a child, see ``IsolatedWorker``.
        """
        self._time_limit_s, self._memory_mb = time_limit_s, memory_mb
        self._stack = ExitStack()

    def chain(self, options: CorrectionOptions) -> CorrectionOptions:
        """The options with all components isolated except the solver, which ``find_motion`` isolates itself."""
        with_motion = needs_motion(options.matcher)
        find, matcher = (find_depths, _MotionMatcher) if with_motion else (find_disparities, _Matcher)
        features = partial(_serve, load_features, find_correspondences)
        depth, corrected = partial(_serve, load_matcher, find), partial(_serve, load_corrector, find_corrected)
        return replace(
            options,
            features=self.wrap(FEATURE_MATCHERS, options.features, features, (Correspondences,), _Features),
            matcher=self.wrap(STEREO_MATCHERS, options.matcher, depth, (), matcher),
            corrector=self.wrap(CORRECTORS, options.corrector, corrected, (Fused,), _Corrector),
        )

    def wrap(
        self,
        kind: Kind[Any, Any],
        entry: AnyEntry,
        factory: Callable[[str], Callable[..., object]],
        classes: tuple[type, ...],
        proxy: Proxy,
    ) -> AnyEntry:
        """The entry with a component that answers from a child, which starts with the first call.

        Args:
            kind: kind of the entry.
            entry: entry of any package; its options have ``time_limit_s``.
            factory: see ``IsolatedWorker``; called with the entry's name or the path of its card.
            classes: see ``IsolatedWorker``.
            proxy: see ``Proxy``.
        """
        if entry.built_in:
            return entry
        place = os.fspath(entry.path.resolve()) if entry.path is not None else entry.name
        child = IsolatedWorker(factory, place, classes=classes, memory_mb=self._memory_mb)
        worker = self._stack.enter_context(child)
        limit_s = entry.options.time_limit_s if self._time_limit_s is None else self._time_limit_s
        who = f"{kind.singular} {entry.name!r}"

        def call(*arguments: object) -> Any:
            outcome = worker.call(*arguments, limit_s=limit_s)
            if not outcome.success:
                reason = outcome.reason.removeprefix(f"{who}: ")
                raise RsbenchError(f"{who}: {reason}")
            return outcome.value

        return replace(entry, component=proxy(entry.component, call))

    def __enter__(self) -> Isolation:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self._stack.close()


@dataclass(frozen=True)
class _Features(FeatureMatcher):
    original: FeatureMatcher
    call: Caller

    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        found: Correspondences = self.call(dict(images))
        return found


@dataclass(frozen=True)
class _Matcher(StereoMatcher):
    original: StereoMatcher
    call: Caller

    def disparities(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        first, second = self.call(left, right, rig)
        return first, second


@dataclass(frozen=True)
class _MotionMatcher(MotionMatcher):
    original: MotionMatcher
    call: Caller

    @property
    def cameras(self) -> Cameras:
        return self.original.cameras

    def depths(
        self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig, shutter: RollingShutter, motion: Motion
    ) -> dict[View, NDArray[Any]]:
        found = self.call(dict(images), rig, shutter, motion)
        return {view: found[f"{view[0]}_{view[1]}"] for view in images}


@dataclass(frozen=True)
class _Corrector(Corrector):
    original: Corrector
    call: Caller

    @property
    def spec(self) -> CorrectorSpec:
        return self.original.spec

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        found = self.call(problem, list(views))
        return {view: found[f"{view[0]}_{view[1]}"] for view in views}


# In the child


def _serve(load: Callable[[str], Any], find: Callable[..., Any], place: str) -> Callable[..., object]:
    """The function that answers calls in the child: ``find`` with the entry that ``load`` loads."""
    with as_entry_failure():
        entry = load(place)

    def answer(*given: object) -> object:
        with as_entry_failure():
            found = find(entry, *given)
        return {f"{view[0]}_{view[1]}": each for view, each in found.items()} if isinstance(found, dict) else found

    return answer
