"""Whether results made again are those that are committed: the tables of two folders, number by number.

    rsbench reproduce everything --out again
    python benchmarks/compare_results.py results again

Another processor rounds otherwise, and a descent may then take another way, so numbers are equal within a relative
difference. Times are not compared. Exits with 1 where a table is missing, has another shape, other words, or a
number that differs by more.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

TIMES = {"seconds", "milliseconds"}


def differences(first: pd.DataFrame, second: pd.DataFrame, tolerance: float) -> Iterator[str]:
    """What differs between tables, a column each."""
    if list(first) != list(second) or len(first) != len(second):
        yield f"{first.shape} and {second.shape} cells, or other columns"
        return
    for name in first:
        if name in TIMES:
            continue
        a, b = first[name], second[name]
        both_empty = (a.isna() & b.isna()).to_numpy()
        if a.dtype.kind in "fi" and b.dtype.kind in "fi":
            x, y = a.to_numpy(float), b.to_numpy(float)
            with np.errstate(invalid="ignore"):
                apart = np.abs(x - y) / np.maximum(np.maximum(np.abs(x), np.abs(y)), np.finfo(float).tiny)
            apart[both_empty | (x == y)] = 0.0
            apart[a.isna() != b.isna()] = np.inf
            if np.any(other := ~(apart <= tolerance)):
                worst = int(np.argmax(np.where(other, np.nan_to_num(apart, nan=np.inf), 0.0)))
                yield f"{name}: {np.sum(other)} of {len(x)}, to {apart[worst]:.1e} ({x[worst]} and {y[worst]})"
        elif np.any(other := (a.astype(str) != b.astype(str)).to_numpy() & ~both_empty):
            at = int(np.argmax(other))
            yield f"{name}: {np.sum(other)} of {len(a)} ({a.iloc[at]!r} and {b.iloc[at]!r})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("committed", type=Path)
    parser.add_argument("again", type=Path)
    parser.add_argument("--tolerance", type=float, default=1e-4, help="relative difference (default 1e-4)")
    given = parser.parse_args()
    files = sorted(path.relative_to(given.committed) for path in given.committed.rglob("*.csv"))
    same, close, other = 0, 0, 0
    for path in files:
        first, second = given.committed / path, given.again / path
        if not second.is_file():
            found = ["missing"]
        elif first.read_bytes() == second.read_bytes():
            same += 1
            continue
        else:
            found = list(differences(pd.read_csv(first), pd.read_csv(second), given.tolerance))
        close, other = close + (not found), other + bool(found)
        sys.stdout.writelines(f"{path}: {line}\n" for line in found)
    sys.stdout.write(f"{len(files)} tables: {same} the same bytes, {close} within the tolerance, {other} others\n")
    return int(other > 0)


if __name__ == "__main__":
    raise SystemExit(main())
