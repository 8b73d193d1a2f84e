"""The channel ``timing`` against sequence.json and the times of the poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import Side, views_of
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.timing import COLUMNS, MANIFEST, table_file, timing_manifest, timing_table
from rsbench.verification.findings import Finding, rows_of

_NEAR_NS = 1.0
"""Both sides were rounded to a nanosecond at most."""


def timing_faults(sequence: Sequence, reported: Collection[str]) -> Iterator[Finding]:
    """Where timing.json and its tables differ from sequence.json and the poses, but for files ``reported``."""
    if "timing" not in sequence.channels:
        return
    try:
        if MANIFEST not in reported:
            yield from _manifest_faults(sequence)
    except RsbenchError as error:
        yield Finding.of(error)
    for side, frame in views_of(sequence.frames):
        try:
            if table_file(side, frame) not in reported:
                yield from _table_faults(sequence, side, frame, reported)
        except RsbenchError as error:
            yield Finding.of(error)


def _manifest_faults(sequence: Sequence) -> Iterator[Finding]:
    stored = sequence.timing()
    expected = timing_manifest(sequence.shutter, sequence.frame_period_s, sequence.sensor, sequence.frames)
    for key, value in expected.items():
        own = stored.get(key)
        if not isinstance(value, dict) or not isinstance(own, dict):
            if own != value:
                yield Finding(MANIFEST, f"{key} = {own!r}, sequence.json makes {value!r}")
            continue
        for name, part in value.items():
            if own.get(name) != part:
                yield Finding(MANIFEST, f"{key}.{name} = {own.get(name)!r}, sequence.json makes {part!r}")


def _table_faults(sequence: Sequence, side: Side, frame: int, reported: Collection[str]) -> Iterator[Finding]:
    file, poses = table_file(side, frame), f"poses/{side}_{frame}.csv"
    stored = sequence.row_times_ns(side, frame)
    expected = _table(sequence, side, frame)
    for name, own, made in zip(COLUMNS.split(","), stored.T, expected.T, strict=True):
        off = own - made
        if np.any(np.abs(off) > _NEAR_NS):
            times = range(sequence.frames)
            like = [each for each in times if np.array_equal(stored, _table(sequence, side, each))]
            cause = f"looks like those of frame {like[0]}" if like else ""
            what = f"{name} differs from what sequence.json makes, by up to {np.max(np.abs(off))} ns"
            yield Finding(file, what, rows_of(np.abs(off) > _NEAR_NS), cause)
            return
    if poses not in reported:
        tau, _ = sequence.poses(side, frame)
        off = np.abs(stored[:, 1] - 1e9 * sequence.frame_period_s * tau)
        if np.any(off > _NEAR_NS):
            yield Finding(
                file, f"time_ns differs from {poses}, by up to {np.max(off):.3g} ns", rows_of(off > _NEAR_NS)
            )


def _table(sequence: Sequence, side: Side, frame: int) -> NDArray[np.int64]:
    return timing_table(sequence.shutter, sequence.frame_period_s, sequence.sensor, side, frame)
