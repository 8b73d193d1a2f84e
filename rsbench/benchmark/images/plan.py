"""The work of an evaluation, and the identity of every prediction (artefact), current or to be made."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rsbench.benchmark.images.store import Artefact, identity_of, records_below
from rsbench.benchmark.provenance import numeric_version
from rsbench.benchmark.scoring import MetricEntry, load_metrics
from rsbench.components.cards import choices, list_cards
from rsbench.components.plugins import Entry, Kind, is_path
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.solvers.engine.base import SOLVERS, SolverEntry, load_solver_entry
from rsbench.storage.files import sha256
from rsbench.storage.work_folder import listed
from rsbench.vision.corrector import CORRECTORS, load_corrector
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.stereo_matcher import STEREO_MATCHERS, MatcherEntry, load_matcher, needs_motion

Component = TypeVar("Component")
HashOf = Callable[[Path], str]
STANDARD_METRICS = ("pose", "depth", "psnr", "ssim")
TRUE = "true"
"""Name in place of a solver or matcher if an oracle gets the truth instead; no entry may have this name."""
NONE = "none"
"""Name in place of a component that is not used; no entry may have this name."""
SCORED = ("rs", "rs_depth", "gs")
"""Folders of a sequence whose files are used for scores and pictures."""
_SEEDS = "seeds"
"""Folder of the motions with further seeds of the robust loop."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Options of an evaluation, except the dataset; components are given by name or by the path of a card."""

    solvers: tuple[str, ...]
    correction_solver: str = "rs-stereo-refined"
    """Solver whose motion the correction uses; scored like the others."""
    features: str = "sift"
    matcher: str = "sgm"
    corrector: str = "fusion"
    metrics: tuple[str, ...] = ()
    """Metrics that are computed in addition to ``STANDARD_METRICS``."""
    only: tuple[str, ...] = ()
    """Names of solvers and sequences to which predictions are limited; empty: all."""
    force: bool = False
    """Whether current predictions are made again."""
    seeds: int = 1
    """Number of runs of each solver's robust loop, with different samples; the correction uses the first
    motion."""
    seed: int = 0
    rehash: bool = False
    """Whether all files of the dataset are hashed again, even those with unchanged size and times, and all scores
    are computed again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """An evaluation with its components loaded and checked."""

    solvers: tuple[SolverEntry, ...]
    chain: CorrectionOptions
    metrics: tuple[MetricEntry, ...]
    solver_names: frozenset[str]
    """Solvers to be run."""
    sequence_names: frozenset[str]
    """Sequences to be worked on."""
    force: bool
    seeds: int

    @property
    def corrects(self) -> bool:
        """Whether depth and corrected frames are predicted too."""
        return self.chain.solver.name in self.solver_names


def make_plan(options: EvaluationOptions, sequences: list[Sequence]) -> Plan:
    """Load every component.

    Raises:
        RsbenchError: a component does not exist or is wrong; two solvers of one name; a solver that gives no
            metres is to correct; ``only`` names nothing that is there; no seed.
    """
    if options.seeds < 1:
        raise RsbenchError(f"--seeds {options.seeds}: must be at least 1")
    references = dict.fromkeys([*options.solvers, options.correction_solver])
    solvers = _distinct({reference: load_solver_entry(reference) for reference in references})
    chain = CorrectionOptions(
        features=load_features(options.features),
        solver=load_solver_entry(options.correction_solver),
        matcher=load_matcher(options.matcher),
        corrector=load_corrector(options.corrector),
        seed=options.seed,
    )
    for name in (*(entry.name for entry in solvers), chain.matcher.name, chain.corrector.name):
        if name in (TRUE, NONE):
            raise RsbenchError(f"{name!r} is the name of no entry: tables use it for oracles; rename it")
    _check_metres(chain, solvers)
    chosen = _chosen(options.only, {s.name: s.whole for s in sequences}, [s.name for s in solvers])
    return Plan(
        solvers=solvers,
        chain=chain,
        metrics=load_metrics(dict.fromkeys([*STANDARD_METRICS, *options.metrics])),
        sequence_names=chosen[0],
        solver_names=chosen[1],
        force=options.force,
        seeds=options.seeds,
    )


def _distinct(entries: Mapping[str, SolverEntry]) -> tuple[SolverEntry, ...]:
    found: dict[str, tuple[str, SolverEntry]] = {}
    for reference, entry in entries.items():
        other, same = found.setdefault(entry.name, (reference, entry))
        if same is not entry and same.path != entry.path:
            raise RsbenchError(
                f"--solver {other} and --solver {reference}: both have the name {entry.name!r}; rename one"
            )
    return tuple(entry for _, entry in found.values())


def _check_metres(chain: CorrectionOptions, solvers: tuple[SolverEntry, ...]) -> None:
    if "motion" in chain.corrector.component.spec.needs and not chain.solver.solver.spec.metric:
        able = [entry.name for entry in solvers if entry.solver.spec.metric] or ["rs-stereo-refined"]
        raise RsbenchError(
            f"--correct-with {chain.solver.name}: gives no length of d in metres, which a correction needs; "
            f"such as {able[0]} does"
        )


def _chosen(
    only: tuple[str, ...], sequences: Mapping[str, str], solvers: list[str]
) -> tuple[frozenset[str], frozenset[str]]:
    """Return the selected sequences and solvers; the name of a sequence with many frames selects all its pairs."""
    known = [*dict.fromkeys([*sequences.values(), *sequences]), *solvers]
    for name in only:
        if name not in known:
            raise RsbenchError(f"--only {name}: is neither a sequence nor a solver{choices(name, known)}")
    return (
        frozenset(name for name, whole in sequences.items() if {name, whole} & {*only}) or frozenset(sequences),
        frozenset(name for name in solvers if name in only) or frozenset(solvers),
    )


def reference_of(kind: Kind[Any, Any], entry: Entry[Any, Any]) -> str:
    """Return the name or path by which an entry is loaded again."""
    if entry.path is None or kind.cards is None or list_cards(kind.cards).get(entry.name) == entry.path:
        return entry.name
    return os.fspath(entry.path.resolve())


_PARTS: dict[str, tuple[Kind[Any, Any], Callable[[str], Any]]] = {
    "corrector": (CORRECTORS, load_corrector),
    "solver": (SOLVERS, load_solver_entry),
    "matcher": (STEREO_MATCHERS, load_matcher),
}
"""Kinds of the components of a correction, and how they are loaded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recipe:
    """The components of a correction, and the inputs that are replaced by the true ones."""

    chain: CorrectionOptions
    true_motion: bool = False
    true_depth: bool = False

    @property
    def names(self) -> dict[str, str]:
        """Names of corrector, solver and matcher, as in tables."""
        needs = self.chain.corrector.component.spec.needs
        solver = TRUE if self.true_motion else self.chain.solver.name
        matcher = TRUE if self.true_depth else self.chain.matcher.name
        return {
            "corrector": self.chain.corrector.name,
            "solver": solver if "motion" in needs else NONE,
            "matcher": matcher if "depth" in needs else NONE,
        }

    @property
    def references(self) -> dict[str, str]:
        """Names or paths by which its components are loaded again."""
        return {name: reference_of(kind, getattr(self.chain, name)) for name, (kind, _) in _PARTS.items()}

    def variants(self) -> list[Recipe]:
        """This recipe and its oracles, in which the true motion, the true depth or both replace the estimates."""
        needs = self.chain.corrector.component.spec.needs
        motions = (False, True) if "motion" in needs else (False,)
        depths = (False, True) if "depth" in needs else (False,)
        return [replace(self, true_motion=m, true_depth=d) for d in depths for m in motions]


def hash_of_data(sequence: Sequence, folders: tuple[str, ...], hash_of: HashOf) -> str:
    """Return a hash of sequence.json and of the frames in given folders; ``hash_of`` hashes a file."""
    paths = [sequence.folder / "sequence.json", *sequence.frame_files(folders)]
    return hashlib.sha256("".join(map(hash_of, paths)).encode()).hexdigest()


class Places:
    """Paths of the predictions for a sequence, and the identity that each must have to be current.

    Methods take the component in question; all other options come from ``chain``. ``hash_of`` returns the SHA-256
    of a file of the sequence.
    """

    def __init__(
        self, sequence: Sequence, folder: Path, chain: CorrectionOptions, hash_of: HashOf = sha256
    ) -> None:
        self.sequence, self.folder, self.chain, self._file_hash = sequence, folder, chain, hash_of

    @cached_property
    def data(self) -> str:
        """Identity of the inputs of predictions: rig, shutter and rolling-shutter images."""
        return hash_of_data(self.sequence, ("rs",), self._file_hash)

    @cached_property
    def truth(self) -> str:
        """Identity of the inputs of oracles, which include the true depth."""
        return hash_of_data(self.sequence, ("rs", "rs_depth"), self._file_hash)

    @cached_property
    def scored_truth(self) -> str:
        """Identity of the ground truth of depth and images."""
        return hash_of_data(self.sequence, SCORED, self._file_hash)

    def matches(self) -> Artefact:
        return self._artefact("matches", data=self.data, features=self.chain.features.key)

    def motion(self, solver: SolverEntry, seed: int = 0) -> Artefact:
        """Motion with the seed ``seed`` of the robust loop."""
        return self._artefact(
            f"motion/{solver.name}" if seed == 0 else f"{_SEEDS}/{seed}/{solver.name}",
            matches=self.matches().identity,
            solver=solver.key,
            options=solver.options.deciding,
            robust=asdict(self.chain.robust),
            seed=self.chain.seed,
        )

    def depth(self, matcher: MatcherEntry) -> Artefact:
        """Depth, with the motion by the solver of ``chain`` if the matcher needs one."""
        motion = {"motion": self.motion(self.chain.solver).identity} if needs_motion(matcher) else {}
        return self._artefact(f"depth/{matcher.name}", data=self.data, matcher=matcher.key, **motion)

    def corrected(self, recipe: Recipe) -> Artefact:
        chain, needs = recipe.chain, recipe.chain.corrector.component.spec.needs
        motion = self.truth if recipe.true_motion else self.motion(chain.solver).identity
        depth = self.truth if recipe.true_depth else self.depth(chain.matcher).identity
        return self._artefact(
            "corrected/" + "+".join(recipe.names.values()),
            data=self.data,
            corrector=chain.corrector.key,
            motion=motion if "motion" in needs else None,
            depth=depth if "depth" in needs else None,
            matches=self.matches().identity if "matches" in needs else None,
            target_row=chain.target_row,
            steps=[chain.depth_from_motion, chain.find_sky, chain.inpaint],
        )

    def _artefact(self, name: str, **parts: object) -> Artefact:
        identity = identity_of(source=numeric_version(), name=name, **parts)
        return Artefact(folder=self.folder, name=name, identity=identity)


class Stored(NamedTuple):
    """A stored record and the components that made it."""

    record: dict[str, Any]
    made_by: Any
    """A ``SolverEntry``, ``MatcherEntry`` or ``Recipe``; None when the record is not current."""


def stored_motions(places: Places, plan: Plan) -> Iterator[Stored]:
    """Motions of every solver and seed, planned or not."""
    chosen = {solver.name: solver for solver in plan.solvers}
    again = cache(partial(_again, partial(_named, load_solver_entry)))
    names = [path.name for path in listed(places.folder / _SEEDS)]
    numbers = sorted(int(name) for name in names if re.fullmatch("[1-9][0-9]*", name))
    for seed, kind in [(0, "motion"), *((k, f"{_SEEDS}/{k}") for k in numbers)]:
        for name, record in records_below(places.folder, kind):
            entry = chosen.get(name) or again(record.get("entry"))
            yield Stored(record, entry if _current(entry, partial(places.motion, seed=seed), record) else None)


def stored_depths(places: Places) -> Iterator[Stored]:
    """Depths by every stereo matcher."""
    for name, record in records_below(places.folder, "depth"):
        chosen = places.chain.matcher
        entry = chosen if chosen.name == name else _again(partial(_named, load_matcher), record.get("entry"))
        yield Stored(record, entry if _current(entry, places.depth, record) else None)


def stored_corrections(places: Places) -> Iterator[Stored]:
    """Corrections by every recipe."""
    for _, record in records_below(places.folder, "corrected"):
        recipe = _again(partial(_recipe, places.chain), record)
        yield Stored(record, recipe if _current(recipe, places.corrected, record) else None)


def _recipe(chain: CorrectionOptions, record: Mapping[str, Any]) -> Recipe:
    own, entries = Recipe(chain=chain).references, record["entries"]
    others = {part: load for part, (_, load) in _PARTS.items() if entries[part] != own[part]}
    loaded = replace(chain, **{part: _named(load, entries[part]) for part, load in others.items()})
    return Recipe(chain=loaded, true_motion=record["solver"] == TRUE, true_depth=record["matcher"] == TRUE)


def _named(load: Callable[[str], Component], source: str) -> Component:
    """Load the component named in a record. Paths are refused: records are untrusted, and cards run code."""
    if not isinstance(source, str) or is_path(source):
        raise RsbenchError(f"{source!r}: a card that this command does not name")
    return load(source)


def _again(load: Callable[[Any], Component], source: Any) -> Component | None:
    """Return the present version of the component that made a record; None if it no longer exists."""
    try:
        return load(source)
    except (RsbenchError, KeyError, TypeError):
        return None


def _current(made_by: Component | None, place: Callable[[Component], Artefact], record: Mapping[str, Any]) -> bool:
    return made_by is not None and place(made_by).identity == record.get("identity")
