"""What several processes, here or on a cluster, make: the same bytes as one."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from commands import bytes_below, run_here
from small_scenes import write_box_scene, write_small_card

MACHINE = {"seconds.json", "seconds.csv", "provenance.json", "hashes.jsonl", "report.html", "seconds"}
"""Files that hold times, the date and the machine."""
NEEDS_DASK = pytest.mark.skipif(
    find_spec("distributed") is None or sys.platform != "linux", reason="needs rsbench[cluster]"
)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from distributed import LocalCluster

    options: Any = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "host": "127.0.0.1"}
    with LocalCluster(**options) as cluster:
        yield cluster.scheduler_address


def evaluated(folder: Path, out: Path, *options: object) -> dict[str, bytes]:
    run = run_here("-q", "evaluate", folder, "--out", out, "--solver", "rs-stereo-linear", *options)
    assert run.returncode == 0, run.stderr
    return bytes_below(out, *MACHINE)


@pytest.mark.slow
def test_two_processes_evaluate_to_the_same_bytes(smoke_dataset: Path, tmp_path: Path) -> None:
    """With repeats: tests/benchmark/images/test_sequence_jobs.py."""
    one = evaluated(smoke_dataset, tmp_path / "one")
    two = evaluated(smoke_dataset, tmp_path / "two", "--workers", 2)
    assert {f"scores/{name}.csv" for name in ("pose", "depth", "correction", "failures")} <= one.keys()
    assert len(one) > 20 and one == two


@pytest.mark.slow
@NEEDS_DASK
def test_a_cluster_generates_evaluates_and_simulates_the_same_bytes(
    smoke_dataset: Path, tmp_path: Path, address: str
) -> None:
    card = write_small_card(tmp_path, [write_box_scene(tmp_path, "a"), write_box_scene(tmp_path, "b", (50, 70))])
    generated = []
    for name, how in (("rendered", ()), ("sent", ("--scheduler", address))):
        run = run_here("-q", "generate", card, "--out", tmp_path / name, *how)
        assert run.returncode == 0, run.stderr
        generated.append(bytes_below(tmp_path / name, *MACHINE))
    assert len(generated[0]) > 20 and generated[0] == generated[1]
    one = evaluated(smoke_dataset, tmp_path / "one")
    assert one == evaluated(smoke_dataset, tmp_path / "there", "--scheduler", address)
    made = []
    for name, how in (("here", ("--workers", 1)), ("far", ("--scheduler", address))):
        trials = ("--trials", 2, "--solver", "gs-8pt")
        run = run_here("-q", "simulate", "noise", "--out", tmp_path / name, *trials, *how)
        assert run.returncode == 0, run.stderr
        made.append(bytes_below(tmp_path / name, *MACHINE))
    assert made[0] == made[1]
