"""LO-RANSAC for any kind of model: uniform minimal samples, MSAC score, local optimisation, exact stopping rule.

M. Fischler, R. Bolles, CACM 1981; P. Torr, A. Zisserman, MLESAC, CVIU 2000 (MSAC); O. Chum, J. Matas, J.
Kittler, Locally Optimized RANSAC, DAGM 2003.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rsbench.core import arguments
from rsbench.core.so3 import FloatArray

Model = TypeVar("Model")
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
_BATCH = 10
"""Number of samples drawn at a time; for a compiled solver, a batch takes little longer than one sample."""
_MOST_STEPS = 10**9


class Estimator(Protocol[Model]):
    """Interface to a model. Data have indices 0 ... sum(num_data) - 1, in groups that are sampled separately."""

    @property
    def num_data(self) -> tuple[int, ...]:
        """Number of data in each group; a simple problem has one group."""

    @property
    def sample_size(self) -> tuple[int, ...]:
        """Number of data of each group in a minimal sample; 0 if a group is only used for scoring."""

    def generate(self, samples: IntArray) -> Iterable[list[Model]]:
        """Yield a list of models, possibly empty, for each minimal sample of indices (b, sum(sample_size))."""

    def residuals(self, model: Model) -> FloatArray:
        """Return errors of all data, (sum(num_data),), in the unit of the threshold; infinite if undefined."""

    def refine(self, model: Model, inliers: BoolArray) -> Model | None:
        """Refine a model with all its inliers; None if that fails."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options for the length of the search."""

    confidence: float = 0.999
    """Probability, 0 to 1, of having drawn a sample without outliers when RANSAC stops."""
    min_iterations: int = 10
    """Smallest number of samples that RANSAC draws."""
    max_iterations: int = 1000
    """Largest number of samples that RANSAC draws."""
    lo_steps: int = 3
    """Refinements of each new best model, at thresholds that shrink from twice the threshold to it."""
    final_steps: int = 3
    """Largest number of refinements at the end, which stop when the score no longer improves."""


@dataclass(frozen=True, kw_only=True)
class RansacOptions(SearchOptions):
    """Options for the length of the search and for inliers."""

    threshold: float
    """Largest absolute residual of an inlier."""
    chance: float = 0.02
    """Probability that an outlier fits a given model by chance, used to reject a consensus of outliers."""

    def __post_init__(self) -> None:
        arguments.check_positive("threshold", self.threshold, arguments.LARGEST_PX, "pixels")
        for name in ("confidence", "chance"):
            arguments.check_number(name, getattr(self, name), 0.0, 1.0)
        for name in ("min_iterations", "max_iterations", "lo_steps", "final_steps"):
            arguments.check_whole(name, getattr(self, name), 0, _MOST_STEPS)
        arguments.keep_plain(self)
        if not 0.0 < self.confidence < 1.0:
            raise ValueError(f"confidence must lie between 0 and 1, got {self.confidence}")
        if not 0.0 < self.chance < 1.0:
            raise ValueError(f"chance must lie between 0 and 1, got {self.chance}")
        if not 1 <= self.min_iterations <= self.max_iterations:
            raise ValueError(
                "min_iterations must lie between 1 and max_iterations, got "
                f"{self.min_iterations} and {self.max_iterations}"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class RansacReport(Generic[Model]):
    """Result of a search; inliers and score are those of the final model."""

    success: bool
    reason: str
    model: Model | None
    inliers: BoolArray
    """(sum(num_data),); all False after a failure."""
    iterations: int
    score: float
    """MSAC cost in units of the squared threshold, at most 1 per datum; infinite after a failure."""


def msac_score(residuals: FloatArray, threshold: float) -> float:
    """Return the sum over all data of the squared residual divided by the squared threshold, at most 1 each."""
    return float(np.sum(np.minimum((residuals / threshold) ** 2, 1.0)))


def all_inlier_probability(
    inliers: tuple[int, ...], num_data: tuple[int, ...], sample_size: tuple[int, ...]
) -> float:
    """Return the probability that a sample drawn without replacement has inliers only (hypergeometric)."""
    probability = 1.0
    for good, total, size in zip(inliers, num_data, sample_size, strict=True):
        if good < size:
            return 0.0
        probability *= math.comb(good, size) / math.comb(total, size)
    return probability


def required_iterations(probability: float, confidence: float) -> float:
    """Return the number of samples after which, with the given confidence, one had inliers only.

    ``probability`` is that of a single sample; if it is 0, the result is infinite.
    """
    if probability <= 0.0:
        return math.inf
    if probability >= 1.0:
        return 1.0
    return max(1.0, math.log1p(-confidence) / math.log1p(-probability))


def log10_false_alarms(inliers: int, num_data: int, sample_size: int, samples: int, chance: float) -> float:
    """Return log10 of the expected number of models with as many inliers if all data were outliers.

    ``samples`` is the number of samples drawn. If the result is 0 or more, the consensus may be due to chance
    (L. Moisan, B. Stival, A probabilistic criterion to detect rigid point matches, IJCV 2004).
    """
    choices = math.lgamma(num_data + 1) - math.lgamma(inliers + 1) - math.lgamma(num_data - inliers + 1)
    return math.log10(max(samples, 1)) + choices / math.log(10.0) + (inliers - sample_size) * math.log10(chance)


class _Best(Generic[Model]):
    """The best model so far, with its residuals and score."""

    def __init__(self, estimator: Estimator[Model], options: RansacOptions) -> None:
        self.estimator, self.threshold, self.chance = estimator, options.threshold, options.chance
        self.model: Model | None = None
        self.residuals = np.full(sum(estimator.num_data), np.inf)
        self.score = math.inf

    def offer(self, model: Model | None) -> bool:
        """Replace the best model if the given one has a lower cost; return whether it was replaced."""
        if model is None:
            return False
        residuals = np.abs(self.estimator.residuals(model))
        residuals = np.where(np.isnan(residuals), np.inf, residuals)
        score = msac_score(residuals, self.threshold)
        if score >= self.score:
            return False
        self.model, self.residuals, self.score = model, residuals, score
        return True

    def inliers(self, factor: float = 1.0) -> BoolArray:
        return self.residuals <= factor * self.threshold


def ransac(estimator: Estimator[Model], options: RansacOptions, rng: np.random.Generator) -> RansacReport[Model]:
    """Search for the model with the lowest MSAC cost."""
    sizes, counts = estimator.sample_size, estimator.num_data
    best = _Best(estimator, options)
    if any(count < size for count, size in zip(counts, sizes, strict=True)):
        return _report(best, 0, f"{counts} data, a minimal sample needs {sizes}")
    needed: float = options.max_iterations
    iterations = 0
    for models in _proposals(estimator, rng):
        iterations += 1
        if any([best.offer(model) for model in models]):
            _optimise(best, options.lo_steps)
            needed = required_iterations(_sample_probability(best), options.confidence)
        if iterations >= max(min(needed, options.max_iterations), options.min_iterations):
            break
    for _ in range(options.final_steps):
        if not _step(best, 1.0):
            break
    return _report(best, iterations, "")


def _proposals(estimator: Estimator[Model], rng: np.random.Generator) -> Iterator[list[Model]]:
    """Yield the models of random minimal samples, without end."""
    counts, sizes = estimator.num_data, estimator.sample_size
    groups = list(zip(_starts(counts), counts, sizes, strict=True))
    while True:
        samples = [
            np.concatenate([start + rng.choice(count, size, replace=False) for start, count, size in groups])
            for _ in range(_BATCH)
        ]
        yield from estimator.generate(np.array(samples, dtype=np.int64))


def _starts(counts: tuple[int, ...]) -> IntArray:
    """Return the index of the first datum of each group."""
    return np.cumsum([0, *counts[:-1]], dtype=np.int64)


def _sample_probability(best: _Best[Model]) -> float:
    inliers = best.inliers()
    counts, sizes = best.estimator.num_data, best.estimator.sample_size
    good = tuple(int(np.count_nonzero(inliers[s : s + n])) for s, n in zip(_starts(counts), counts, strict=True))
    return all_inlier_probability(good, counts, sizes)


def _optimise(best: _Best[Model], steps: int) -> None:
    """Refine with inliers of a threshold that shrinks from twice the final threshold to the final one."""
    for k in range(steps):
        factor = 2.0 - k / max(steps - 1, 1)
        if not _step(best, factor) and factor <= 1.0:
            break


def _step(best: _Best[Model], factor: float) -> bool:
    if best.model is None:
        return False
    inliers = best.inliers(factor)
    if np.count_nonzero(inliers) < sum(best.estimator.sample_size):
        return False
    return best.offer(best.estimator.refine(best.model, inliers))


def _report(best: _Best[Model], iterations: int, reason: str) -> RansacReport[Model]:
    inliers = best.inliers() if best.model is not None else np.zeros(len(best.residuals), dtype=np.bool_)
    count, total, least = int(np.count_nonzero(inliers)), len(inliers), sum(best.estimator.sample_size)
    if not reason and best.model is None:
        reason = "no sample gave a model"
    elif not reason and log10_false_alarms(count, total, least, iterations, best.chance) >= 0.0:
        reason = f"no consensus: {count} inliers of {total}, as chance would give in {iterations} samples"
    if reason:
        inliers = np.zeros_like(inliers)
    return RansacReport(
        success=not reason,
        reason=reason,
        model=None if reason else best.model,
        inliers=inliers,
        iterations=iterations,
        score=math.inf if reason else best.score,
    )
