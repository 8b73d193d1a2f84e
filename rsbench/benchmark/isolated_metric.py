"""Metrics of other packages in a child process: see ``rsbench.pipeline.isolated_components``."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rsbench.benchmark.metric_plugins import METRICS, Case, Column, Metric, MetricEntry, load_metrics
from rsbench.benchmark.scoring import score
from rsbench.pipeline.isolated_components import Caller, Isolation, entrys_own


def isolated_metrics(isolation: Isolation, metrics: tuple[MetricEntry, ...]) -> tuple[MetricEntry, ...]:
    """The same metrics, those of other packages answering from a child."""
    return tuple(isolation.wrap(METRICS, metric, _serve_metric, (), _Isolated) for metric in metrics)


class _Isolated(Metric):
    def __init__(self, original: Metric, call: Caller) -> None:
        self.case, self._columns, self._call = original.case, original.columns, call

    @property
    def columns(self) -> tuple[Column, ...]:
        return self._columns

    def compute(self, case: Case) -> Mapping[str, float]:
        found: Mapping[str, float] = self._call(case)
        return found


# In the child


def _serve_metric(place: str) -> Callable[..., object]:
    with entrys_own():
        (entry,) = load_metrics([place])

    def answer(case: Case) -> dict[str, float]:
        with entrys_own():
            return score(entry, case)

    return answer
