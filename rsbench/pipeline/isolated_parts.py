"""Feature matchers, stereo matchers and correctors of other packages, each in a child process of its own.

``Isolation`` gives an entry that looks like the original and answers from the child: whatever goes wrong there is
one ``RsbenchError`` with the entry's name. Our own entries stay as they are.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
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
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.isolated_solver import entrys_own
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
"""Makes a component that answers by the caller, from the original component."""


class Isolation:
    """The children; use as a context manager."""

    def __init__(self, *, time_limit_s: float | None = None, memory_mb: float | None = None) -> None:
        """
        Args:
            time_limit_s: for one call, instead of what each entry's card says.
            memory_mb: what a child may use; see ``IsolatedWorker``.
        """
        self._time_limit_s, self._memory_mb = time_limit_s, memory_mb
        self._stack = ExitStack()

    def chain(self, options: CorrectionOptions) -> CorrectionOptions:
        """The options with all but the solver isolated, which ``find_motion`` runs apart by itself."""
        serve, matcher = (
            (_serve_motion_matcher, _MotionMatcher)
            if needs_motion(options.matcher)
            else (_serve_matcher, _Matcher)
        )
        return replace(
            options,
            features=self.wrap(FEATURE_MATCHERS, options.features, _serve_features, (Correspondences,), _Features),
            matcher=self.wrap(STEREO_MATCHERS, options.matcher, serve, (), matcher),
            corrector=self.wrap(CORRECTORS, options.corrector, _serve_corrector, (Fused,), _Corrector),
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
            kind: of the entry; its options say ``time_limit_s``.
            entry: of any package.
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


def _serve_features(place: str) -> Callable[..., object]:
    with entrys_own():
        entry = load_features(place)

    def answer(images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        with entrys_own():
            return find_correspondences(entry, images)

    return answer


def _serve_matcher(place: str) -> Callable[..., object]:
    with entrys_own():
        entry = load_matcher(place)

    def answer(left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig) -> object:
        with entrys_own():
            return find_disparities(entry, left, right, rig)

    return answer


def _serve_motion_matcher(place: str) -> Callable[..., object]:
    with entrys_own():
        entry = load_matcher(place)

    def answer(
        images: Mapping[View, NDArray[np.uint8]], rig: StereoRig, shutter: RollingShutter, motion: Motion
    ) -> object:
        with entrys_own():
            found = find_depths(entry, images, rig, shutter, motion)
        return {f"{side}_{frame}": depth for (side, frame), depth in found.items()}

    return answer


def _serve_corrector(place: str) -> Callable[..., object]:
    with entrys_own():
        entry = load_corrector(place)

    def answer(problem: CorrectionProblem, views: list[View]) -> dict[str, Fused]:
        with entrys_own():
            found = find_corrected(entry, problem, views)
        return {f"{side}_{frame}": fused for (side, frame), fused in found.items()}

    return answer
