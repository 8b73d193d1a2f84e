"""Scores that are kept, each with the identity of all that it came from, as predictions are.

A score depends on the truth, on the bytes of a prediction, on the metrics, and on the code that scores: while none
of them changes, it is not computed again. A metric of another package that failed is asked again each time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from rsbench.benchmark.metric_plugins import Case, MetricEntry
from rsbench.benchmark.provenance import numeric_version, package_version
from rsbench.components.imports import hash_of_files
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import read_json, sha256, write_bytes
from rsbench.storage.work_folder import HIDDEN

Row = dict[str, Any]
_PACKAGES = ("flip-evaluator", "matplotlib", "OpenEXR")
"""Packages that scores and pictures come from, beside those that predictions come from."""


def kept_scores_file(out: Path, sequence: str) -> Path:
    """Where an evaluation in ``out`` keeps the scores of a sequence."""
    return out / HIDDEN / "scores" / f"{sequence}.json"


@cache
def scoring_version() -> dict[str, str]:
    """What decides a score beside its inputs: all of our source, and the packages below it."""
    package = Path(str(resources.files("rsbench")))
    return {
        **numeric_version(),
        **{name: package_version(name) for name in _PACKAGES},
        "source": hash_of_files(package, sorted(package.rglob("*.py"))),
    }


def metric_keys(metrics: Iterable[MetricEntry], case: type[Case]) -> list[list[str]]:
    """Names and keys of the metrics that read such cases, in their order."""
    return [[metric.name, metric.key] for metric in metrics if metric.component.case is case]


def hash_of_prediction(files: Iterable[Path]) -> str:
    """Of the bytes of a prediction's files; one that is not there counts too."""
    found = [f"{path.name} {sha256(path) if path.is_file() else 'is not there'}" for path in files]
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


@dataclass(frozen=True)
class ScoredPart:
    """The scores of one prediction."""

    rows: list[Row]
    failures: list[Row]
    """What the table of failures gets."""


class KeptScores:
    """Those of one sequence, by the name of the prediction, in one file; None as the file keeps nothing."""

    def __init__(self, path: Path | None = None, forget: bool = False) -> None:
        """
        Args:
            path: of the file; need not exist.
            forget: what it holds is not used.
        """
        self._path = path
        self._before = {} if path is None or forget else _read(path)
        self._now: dict[str, Mapping[str, Any]] = {}

    def find(self, name: str, key: str) -> ScoredPart | None:
        """What is kept of a prediction under this key."""
        found = self._before.get(name)
        if found is None or found["key"] != key:
            return None
        self._now[name] = found
        return ScoredPart(found["rows"], found["failures"])

    def keep(self, name: str, key: str, part: ScoredPart) -> None:
        self._now[name] = {"key": key, "rows": part.rows, "failures": part.failures}

    def save(self) -> None:
        """Write what was found or kept by this object; the rest is of predictions that are gone or stale."""
        if self._path is None or self._now == self._before:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        text = _text(self._now)
        write_bytes(self._path, f'{{"sha256": "{_digest(text)}", "parts": {text}}}\n'.encode())


def _read(path: Path) -> dict[str, Any]:
    """The parts that a file holds; none where it is not there, or not as it was written."""
    try:
        content = read_json(path)
        parts = content["parts"]
        return dict(parts) if _digest(_text(parts)) == content["sha256"] else {}
    except (RsbenchError, KeyError, TypeError, ValueError):
        return {}


def _text(parts: Mapping[str, Any]) -> str:
    return json.dumps(parts)  # with NaN and Infinity, which Python reads again


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
