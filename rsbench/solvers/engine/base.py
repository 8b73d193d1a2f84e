"""The interface of solvers (from correspondences to one motion estimate, without sampling or files), and loading
solvers by name.

A solver is a final, frozen dataclass derived from ``Solver``. Its fields are the parameters that its card may set,
and its ``spec`` declares its inputs and outputs. The class itself has no name; its card or entry point names it
(``SolverEntry``, see ``rsbench.components.plugins``). A solver that finds no motion returns a ``MotionEstimate``
with ``success = False`` and a reason; it raises no exception and does not return the identity.

The decorator ``solver`` makes such a class from a function that returns w and d.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from types import FunctionType, MappingProxyType
from typing import Any, ClassVar, Literal, TypeVar, get_args, overload

import numpy as np

from rsbench.components import plugins
from rsbench.components.motion_models import check_parameters
from rsbench.components.plugins import MARK, Entry, Kind
from rsbench.core import arguments
from rsbench.core.arguments import name_or_path as name_or_path_of
from rsbench.core.arguments import real_array, shown
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import UNALIGNED
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

MatchSet = Literal["left", "right", "stereo", "tracks", "affine", "gyro", "gravity"]
"""Sets of matches, affine frames of the left matches (one row each), and samples of other sensors. RANSAC does
not draw from the latter: a solver always gets all of them."""
SENSORS: Mapping[MatchSet, str] = {"gyro": "samples of a gyroscope", "gravity": "directions of gravity"}
"""Sets of samples of other sensors."""
Cameras = Literal["ideal", "lens", "any", "rig"]
Robust = Literal["ransac", "own"]
BESIDE: Mapping[MatchSet, str] = {"affine": "affine frames of left matches", **SENSORS}
"""Sets that are not matches."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionEstimate:
    """Motion over one frame period: ``X_body = exp([w]x) X_world + d`` at tau = 1."""

    w: FloatArray
    """(3,) rotation vector, radians; NaN after a failure."""
    d: FloatArray
    """(3,) translation of the solver's reference point; metres when ``metric``, else of arbitrary length."""
    success: bool
    reason: str = ""
    """Why there is no estimate or, after success, what the data do not determine; empty if they determine all."""
    metric: bool = False
    """Whether the length of ``d`` is known, in metres."""
    direction_known: bool = True
    """False when the data do not determine the direction of ``d`` (no parallax)."""
    covariance: FloatArray | None = None
    """(6, 6) of (w, d), rad and metres, from the residuals; None when the solver does not estimate it.

    The length of d from pairs alone is nearly Gaussian in ``1 / |d|`` rather than in ``|d|``.
    """
    noise_px: float | None = None
    """Standard deviation of one pixel coordinate, estimated from the residuals."""
    motion_parameters: Mapping[str, float] = field(default_factory=dict)
    """The motion model's own parameters that the solver estimated; the others are in the spec."""

    def __post_init__(self) -> None:
        for name in ("success", "metric", "direction_known"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise ValueError(f"{name} = {shown(getattr(self, name))}: must be True or False")
        for name in ("w", "d"):
            value = real_array(f"{name} of a motion estimate", getattr(self, name))
            if value.shape != (3,) or (self.success and not np.all(np.isfinite(value))):
                raise ValueError(
                    f"{name} of a motion estimate must be 3 finite numbers, got {shown(value.tolist())}"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def failed(cls, reason: str) -> MotionEstimate:
        """Return a failed estimate with its reason."""
        nowhere = np.full(3, np.nan)
        return cls(w=nowhere, d=nowhere, success=False, reason=reason, direction_known=False)

    @classmethod
    def of_one_camera(cls, w: FloatArray, d: FloatArray, **motion_parameters: float) -> MotionEstimate:
        """Return an estimate from one camera, with d of unknown length; a failed one if w or d is not finite."""
        if not np.all(np.isfinite([*w, *d])):
            return cls.failed("no finite motion fits")
        reason = "the length of d is not determined by one camera"
        return cls(w=w, d=d, success=True, reason=reason, motion_parameters=motion_parameters)


@dataclass(frozen=True, kw_only=True)
class SolverSpec:
    """A solver's declaration of its inputs and outputs, which tables, cards and RANSAC read.

    The constructor raises ValueError for an unknown set, model, shutter or point, so that a typing error cannot
    change scores unnoticed.
    """

    needs: Set[MatchSet]
    """Sets that the solver requires; it may use others if they are given."""
    minimum: Mapping[MatchSet, int]
    """Smallest number of matches in each required set."""
    metric: bool
    """Whether it can give the length of d in metres."""
    motion_model: str
    """Name of the motion model that it assumes between the rows."""
    shutter: Literal["rolling", "global"]
    reference_point: Literal["body", "left"]
    """The point of the rig whose translation is ``d``."""
    reference: str
    """Publication: paper and equations."""
    assumes: str
    """Its assumptions, in words."""
    cameras: Cameras = "ideal"
    """Cameras that it supports. ``ideal``: equal aligned cameras without a lens, which read rows from the top at
    the same times; ``lens``: they may have a lens; ``any``: also other scans and a delayed right camera; ``rig``:
    any rig. Unless ``ideal``, the solver must take times from ``shutter.pixel_time`` alone and rays from
    ``camera.unproject`` or, for ``rig``, from ``rig.eye(side).unproject``. A global-shutter solver gets the
    matches and the rig as an ideal rig would see them, unless it declares ``rig``."""
    motion_parameters: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the motion model that it assumes; absent ones have the model's defaults."""

    def __post_init__(self) -> None:
        if not hasattr(self.needs, "__iter__") or not all(isinstance(each, str) for each in self.needs):
            raise ValueError(f"needs: must be a set of names, got {shown(self.needs)}")
        for name in ("minimum", "motion_parameters"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"{name}: must be a table, got {shown(getattr(self, name))}")
        object.__setattr__(self, "needs", frozenset(self.needs))
        for name in ("minimum", "motion_parameters"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        sets = get_args(MatchSet)
        for name, given in (("needs", self.needs), ("minimum", self.minimum)):
            for value in given:
                if not isinstance(value, str) or value not in sets:
                    raise ValueError(f"{name}: {shown(value)} is no set of matches; there are: {', '.join(sets)}")
        if not self.needs:
            raise ValueError(f"needs: must name at least one of {', '.join(sets)}")
        missing = self.needs - set(self.minimum)
        if missing:
            raise ValueError(f"minimum: says nothing about {', '.join(sorted(missing))}, which needs names")
        self._check_values()

    def _check_values(self) -> None:
        for key, count in self.minimum.items():
            if isinstance(count, bool) or not isinstance(count, int) or count < 1:
                raise ValueError(f"minimum[{key!r}] = {count!r}: must be a whole number above 0")
        for name, allowed in (
            ("shutter", ("rolling", "global")),
            ("reference_point", ("body", "left")),
            ("cameras", get_args(Cameras)),
        ):
            if not isinstance(getattr(self, name), str) or getattr(self, name) not in allowed:
                raise ValueError(f"{name} = {shown(getattr(self, name))}: must be one of {', '.join(allowed)}")
        if not isinstance(self.metric, bool):
            raise ValueError(f"metric = {shown(self.metric)}: must be True or False")
        for name in ("motion_model", "reference", "assumes"):
            if not isinstance(getattr(self, name), str) or not getattr(self, name):
                raise ValueError(f"{name} = {shown(getattr(self, name))}: must be a text")
        try:
            check_parameters(self.motion_model, self.motion_parameters)
        except RsbenchError as error:
            raise ValueError(str(error)) from error

    def refusal(self, rig: StereoRig, shutter: RollingShutter) -> str:
        """Return why the solver does not support these cameras; empty if it does."""
        if self.shutter == "global" or self.cameras == "rig":
            return ""
        if not rig.aligned:
            return f"it takes two equal cameras in perfect alignment, and {UNALIGNED}"
        if self.cameras == "any":
            return ""
        if rig.camera.lens is not None and self.cameras == "ideal":
            return f"it does not take a lens, and the cameras have one ({rig.camera.lens.model})"
        if not shutter.plain:
            return "it takes rows from the top that both cameras read at once, and no other scan or delay"
        return ""

    def shortage(self, counts: Mapping[MatchSet, int]) -> MotionEstimate | None:
        """Return a failed estimate if there are too few matches, else None."""
        for name, least in self.minimum.items():
            if counts.get(name, 0) < least:
                return MotionEstimate.failed(
                    f"{counts.get(name, 0)} {BESIDE.get(name, f'{name} matches')}, need {least}"
                )
        return None


class Solver(ABC):
    """Base class of solvers, which estimate the relative pose of a stereo rig over one frame period."""

    @property
    @abstractmethod
    def spec(self) -> SolverSpec:
        """The solver's declaration; may be a class attribute if it does not depend on the parameters."""

    @property
    def inner_keys(self) -> tuple[str, ...]:
        """Keys (``SolverEntry.key``) of solvers that this one calls; they become part of its own key."""
        return ()

    @abstractmethod
    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        """Estimate the motion from all given matches, which must not contain outliers."""

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        """Return the number of matches of each set in a minimal sample for ``propose``."""
        return self.spec.minimum

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        """Return candidate motions for a minimal sample, or failed estimates with the reason if there are none."""
        return [self.estimate(sample, rig, shutter)]

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        """Call ``propose`` for several samples of equal size; solvers may override it to batch them."""
        return (self.propose(sample, rig, shutter) for sample in samples)

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        """Estimate the motion from inliers, starting from an approximate motion if the solver can use one.

        Args:
            motion: the starting point.
            quick: whether low accuracy suffices, because the result is refined again later in the search.
        """
        return self.estimate(correspondences, rig, shutter)

    def weigh(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        noise_px: float,
    ) -> MotionEstimate | None:
        """Conclude a robust search, if the solver weights matches itself; None leaves it to ``improve``.

        Args:
            motion: the best motion of the search.
            correspondences: all matches with residuals below a much larger threshold, including some outliers.
            noise_px: standard deviation of a coordinate, as estimated by the search.
        """
        return None


class _FunctionSolver(Solver):
    """Solver that calls a function, see ``solver``."""

    function: ClassVar[Callable[..., Any]]
    card_options: ClassVar[SolverOptions]

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        given, spec = correspondences, self.spec
        if not spec.needs & {"tracks", "stereo", "affine"}:  # rows of these sets must keep matching those of left
            pairs = {side: temporal_pairs(given, side) for side in ("left", "right")}
            none = {name: getattr(given, name)[:0] for name in ("tracks", "covariance", "affine")}
            given = replace(given, **pairs, **none)
        counts = {name: len(getattr(given, "stereo_0" if name == "stereo" else name)) for name in spec.minimum}
        if short := spec.shortage(counts):
            return short
        parameters = {each.name: getattr(self, each.name) for each in fields(self)}  # pyrefly: ignore[bad-argument-type]
        try:
            found = type(self).function(given, rig, shutter, **parameters)
        except np.linalg.LinAlgError as error:  # degenerate matches
            return MotionEstimate.failed(f"LinAlgError: {error}")
        return self._estimate_of(found)

    def _estimate_of(self, found: object) -> MotionEstimate:
        """Convert the function's return value to an estimate; raise ValueError if it is not a motion or None."""
        if isinstance(found, MotionEstimate):
            return found
        if found is None:
            return MotionEstimate.failed("it found no motion")
        name = type(self).function.__name__
        if not isinstance(found, Sequence) or len(found) != 2:
            raise ValueError(f"{name} must return w and d, or None; it returned {shown(found)}")
        motion = {"w": real_array("w", found[0]), "d": real_array("d", found[1])}
        for key, value in motion.items():
            if value.size != 3:
                hint = "; of a matrix R: scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec()"
                raise ValueError(
                    f"{name} returned {key} of shape {value.shape}: must be 3 numbers"
                    f"{hint if key == 'w' and value.size == 9 else ''}"
                )
        if not all(np.all(np.isfinite(value)) for value in motion.values()):
            return MotionEstimate.failed("w or d is not finite")
        reason = "" if self.spec.metric else "length of d unknown"
        w, d = (value.ravel() for value in motion.values())
        return MotionEstimate(w=w, d=d, success=True, metric=self.spec.metric, reason=reason)


F = TypeVar("F", bound=Callable[..., Any])


@overload
def solver(
    function: F,
    /,
    *,
    needs: MatchSet | Iterable[MatchSet] = ...,
    minimum: int | Mapping[MatchSet, int] = ...,
    metric: bool = ...,
    motion_model: str = ...,
    shutter: Literal["rolling", "global"] = ...,
    reference_point: Literal["body", "left"] = ...,
    cameras: Cameras = ...,
    reference: str = ...,
    robust: Robust = ...,
    code: str = ...,
    tuned_on: str = ...,
) -> F: ...
@overload
def solver(
    function: None = None,
    /,
    *,
    needs: MatchSet | Iterable[MatchSet] = ...,
    minimum: int | Mapping[MatchSet, int] = ...,
    metric: bool = ...,
    motion_model: str = ...,
    shutter: Literal["rolling", "global"] = ...,
    reference_point: Literal["body", "left"] = ...,
    cameras: Cameras = ...,
    reference: str = ...,
    robust: Robust = ...,
    code: str = ...,
    tuned_on: str = ...,
) -> Callable[[F], F]: ...
def solver(
    function: Any = None,
    /,
    *,
    needs: MatchSet | Iterable[MatchSet] = ("left", "right"),
    minimum: int | Mapping[MatchSet, int] = 9,
    metric: bool = False,
    motion_model: str = "linear",
    shutter: Literal["rolling", "global"] = "rolling",
    reference_point: Literal["body", "left"] = "body",
    cameras: Cameras = "ideal",
    reference: str = "",
    robust: Robust = "ransac",
    code: str = "",
    tuned_on: str = "",
) -> Any:
    """Make a solver from a function ``(correspondences, rig, shutter)`` that returns w and d, or None.

    This can be used as a decorator or called with the function, which stays unchanged. All commands then accept
    ``FILE.py`` as a solver, and ``estimate_motion`` accepts the function. Further parameters of the function must
    have defaults; a card may set them. Unless ``needs`` contains tracks, stereo or affine, points tracked through
    all images are in ``.left`` and ``.right`` like other matches, and ``.tracks`` is empty.

    The function fails if it returns None or a value that is not finite, or raises ``numpy.linalg.LinAlgError``. It
    may also return a ``MotionEstimate``, for example one with a covariance.

    Args:
        function: returns ``w`` (3,), the rotation vector in rad, and ``d`` (3,), the translation of the reference
            point, both over one frame period: ``X_body = exp([w]x) X_world + d``.
        needs: the sets of matches that it uses.
        minimum: smallest number of matches in every set, or by name of the set; RANSAC draws samples of this
            size. If it is one number, it does not apply to samples of sensors, of which two are then needed.
        metric: whether d is in metres.
        motion_model, shutter, reference_point, cameras, reference: see ``SolverSpec``.
        robust, code, tuned_on: see ``SolverOptions``; a card may set them too.

    Raises:
        ValueError: it is not a function of three arguments, or an option has an invalid value.
    """
    options: dict[str, Any] = {
        "metric": metric,
        "motion_model": motion_model,
        "shutter": shutter,
        "reference_point": reference_point,
        "cameras": cameras,
        "assumes": "nothing else is stated",
    }
    sets: frozenset[Any] = frozenset([needs] if isinstance(needs, str) else needs)
    least = {each: 2 if each in SENSORS else minimum for each in sets} if isinstance(minimum, int) else minimum

    card_options = SolverOptions(robust=robust, code=code, tuned_on=tuned_on)

    def mark(function: F) -> F:
        if not isinstance(function, FunctionType):
            raise ValueError(f"solver: must decorate a function, got {shown(function)}")
        name, signature = function.__name__, inspect.signature(function)
        try:
            signature.bind(None, None, None)
        except TypeError as error:
            raise ValueError(
                f"{name}{signature}: a solver has the arguments correspondences, rig and shutter, "
                f"and defaults for all others ({error})"
            ) from error
        doc = inspect.getdoc(function) or ""
        words = reference or " ".join(doc.partition("\n\n")[0].split()) or f"the function {name}"
        spec = SolverSpec(needs=sets, minimum=least, reference=words, **options)
        empty = inspect.Parameter.empty
        own = [
            (each.name, type(each.default) if each.annotation is empty else each.annotation, each.default)
            for each in list(signature.parameters.values())[3:]
            if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
        ]
        for key, _, _ in own:
            if hasattr(_FunctionSolver, key):
                raise ValueError(f"{name}{signature}: rename the parameter {key!r}, which solvers have already")
        cls = make_dataclass(
            name,
            own,
            bases=(_FunctionSolver,),
            frozen=True,
            kw_only=True,
            namespace={"__doc__": doc, "spec": spec, "card_options": card_options},
        )
        cls.function = staticmethod(function)
        cls.__module__, cls.__qualname__ = function.__module__, f"{function.__qualname__}.{MARK}"
        setattr(function, MARK, cls)
        return function

    return mark if function is None else mark(function)


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Keys of a solver's card other than its parameters."""

    robust: Robust = "ransac"
    """``own``: the solver rejects outliers itself and gets all matches; ``ransac``: rsbench's loop does."""
    use: str = ""
    """When to choose this solver, one line for readers; no code uses it."""
    time_limit_s: float = 60.0
    """Wall-clock time limit for one problem; a solver of another package that exceeds it has failed."""
    code: str = ""
    """External code that computes the motion, if any: package, version and licence, for leaderboards."""
    tuned_on: str = ""
    """Data on which parameters of the method were tuned, and when, for leaderboards; empty: not stated."""

    def __post_init__(self) -> None:
        if self.robust not in get_args(Robust):
            raise ValueError(f"robust = {shown(self.robust)}: must be one of {', '.join(get_args(Robust))}")
        for key in ("use", "code", "tuned_on"):
            if not isinstance(value := getattr(self, key), str):
                raise ValueError(f"{key} = {shown(value)}: must be a text")
        if not self.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s = {self.time_limit_s}: must be a positive number of seconds")

    @property
    def deciding(self) -> dict[str, Any]:
        """Options that may change results, by name."""
        return {"robust": self.robust, "time_limit_s": self.time_limit_s}


def _check_spec(solver: Solver) -> None:
    if not isinstance(solver.spec, SolverSpec):
        raise ValueError(f"spec = {solver.spec!r}: must be a SolverSpec")


SOLVERS: Kind[Solver, SolverOptions] = Kind(
    singular="solver",
    cards="solvers",
    base=Solver,
    options=SolverOptions,
    check=_check_spec,
    mark="@rsbench.solver",
)


class SolverEntry(Entry[Solver, SolverOptions]):
    """A solver with the name of its card or entry point, as ranked in tables."""

    @property
    def solver(self) -> Solver:
        """The solver itself."""
        return self.component


def list_solvers() -> list[str]:
    """Return the names of all solvers, sorted."""
    return plugins.list_names(SOLVERS)


def load_solver(name_or_path: str | Path) -> Solver:
    """Load a solver by the name of a card or entry point, by the path of a card, or by ``FILE.py[:NAME]``.

    Raises:
        RsbenchError: the solver does not exist, two solvers have this name, or its card, file or class is invalid.
    """
    return load_solver_entry(name_or_path_of("name_or_path", name_or_path)).solver


def load_solver_entries(names_or_paths: Sequence[str]) -> list[SolverEntry]:
    """Load several solvers for one table.

    Raises:
        RsbenchError: see ``load_solver``; also if two of them have the same name.
    """
    entries: dict[str, SolverEntry] = {}
    given: dict[str, str] = {}
    for text in names_or_paths:
        entry = load_solver_entry(text)
        if entry.name in entries:
            raise RsbenchError(
                f"solver {text!r} and solver {given[entry.name]!r} are both named {entry.name!r}: "
                "leave one out, or rename its card or file"
            )
        entries[entry.name], given[entry.name] = entry, text
    return list(entries.values())


def load_solver_entry(name_or_path: str | Path) -> SolverEntry:
    """Load a solver like ``load_solver``, together with its name, its card's options and its key."""
    return SolverEntry(**vars(plugins.load_entry(SOLVERS, name_or_path)))


def entry_of(solver: str | Path | Solver | Callable[..., Any]) -> SolverEntry:
    """Return the entry of a solver, given its name, the path of its card or file, or the solver itself.

    A solver object, class or decorated function gets the name of its class.

    Raises:
        ValueError: it is none of these.
    """
    if isinstance(solver, str | Path):
        return load_solver_entry(solver)
    if isinstance(cls := plugins.class_of(solver), type) and issubclass(cls, Solver):
        solver = cls()
    if not isinstance(solver, Solver):
        raise ValueError(
            "solver: must be a name, the path of a card or file, an rsbench.Solver or a function below "
            f"@rsbench.solver, got {arguments.shown(solver)}"
        )
    return SolverEntry(**vars(plugins.wrap(SOLVERS, solver)))
