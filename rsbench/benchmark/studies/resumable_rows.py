"""Rows of a study, kept by sequence, so that a run that was cut off goes on where it stopped."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from rsbench.benchmark.images.store import identity_of
from rsbench.benchmark.provenance import numeric_version
from rsbench.components.imports import hash_of_files
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import sha256, write_json
from rsbench.storage.untrusted_files import read_json

Row = dict[str, Any]
Rows = tuple[list[Row], list[Row], list[Row]]
"""Scores of every method on every view, errors by row band, motion errors."""


@dataclass(frozen=True, kw_only=True)
class ResumableRows:
    """A file for each sequence, current while code, packages, data, seed and solver are what they were."""

    folder: Path
    dataset: Path
    seed: int
    solver: str
    others: tuple[str, ...] = ()
    """Methods beside the published ones."""

    def read(self, name: str) -> Rows | None:
        """What was stored of a sequence; None when there is nothing current."""
        try:
            record = read_json(self._file(name))
        except RsbenchError:
            return None
        if record.get("identity") != self._identity(name):
            return None
        images, bands, motions = ([_with_nan(row) for row in table] for table in record["tables"])
        return images, bands, motions

    def write(self, name: str, rows: Rows) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        tables = [[_without_nan(row) for row in table] for table in rows]
        write_json(self._file(name), {"identity": self._identity(name), "tables": tables})

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def _identity(self, name: str) -> str:
        benchmark = Path(str(resources.files("rsbench"))) / "benchmark"
        return identity_of(
            numeric=numeric_version(),
            studies=hash_of_files(benchmark, sorted(benchmark.rglob("*.py"))),
            sequence=sha256(self.dataset / name / "sequence.json"),
            seed=self.seed,
            solver=self.solver,
            others=self.others,
        )


def _without_nan(row: Row) -> Row:
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}


def _with_nan(row: Row) -> Row:
    return {key: math.nan if value is None else value for key, value in row.items()}
