"""Jobs on a Dask cluster of this machine: the same answers, whoever dies."""

from __future__ import annotations

import functools
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.jobs.process_jobs import LostJobsError, finished_jobs, run_jobs
from rsbench.jobs.workers import Cluster

pytestmark = [
    pytest.mark.skipif(find_spec("distributed") is None, reason="needs rsbench[cluster]"),
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as cluster:
        yield cluster


@pytest.fixture
def there(local: Any) -> Cluster:
    return Cluster(address=local.scheduler_address)


def test_all_jobs_are_done(there: Cluster) -> None:
    jobs = [float(k * k) for k in range(20)]
    done = {job: outcome.value for job, outcome in run_jobs(functools.partial, jobs, there, {}, math.sqrt)}
    assert done == {float(k * k): float(k) for k in range(20)}


def test_a_job_that_always_dies_is_named_when_the_others_are_done(there: Cluster, tmp_path: Path) -> None:
    note = tmp_path / "tries"
    deadly, done = f"printf x >> {note}; kill -9 $PPID", list[str]()
    with pytest.raises(LostJobsError, match="3 times"):
        for job, _ in finished_jobs(functools.partial, [deadly, "true", "exit 3"], there, {}, os.system):
            done.append(job)
    assert sorted(done) == ["exit 3", "true"] and note.read_text() == "xxx"


def test_limits_hold_there_too(there: Cluster) -> None:
    jobs = run_jobs(
        functools.partial, ["__import__('time').sleep(1000)"], there, {}, eval, seconds_of=lambda job: 0.3
    )
    ((_, outcome),) = jobs
    assert outcome.reason == "took longer than 0.3 s"


def test_a_worker_of_the_cluster_that_is_killed_loses_nothing(there: Cluster, local: Any, tmp_path: Path) -> None:
    """The first job kills the worker that serves it, the parent of its parent."""
    mark = tmp_path / "mark"
    kill = f"test -e {mark} || {{ touch {mark}; kill -9 $(ps -o ppid= -p $PPID); }}; sleep 0.2"
    jobs = [kill, *(f"sleep 0.0{k}" for k in range(1, 8))]
    done = [job for job, outcome in run_jobs(functools.partial, jobs, there, {}, os.system) if outcome.value == 0]
    assert sorted(done) == sorted(jobs) and mark.exists()


def test_what_is_stopped_ends_there(there: Cluster, tmp_path: Path) -> None:
    """Jobs that wait are dropped, and the children at work end."""
    command = f"n=$(ls {tmp_path} | wc -l); echo $$ > {tmp_path}/$$; test $n -lt 2 || exec sleep 1000"
    jobs = [f"{command} # {k}" for k in range(8)]  # in any order
    with closing(run_jobs(functools.partial, jobs, there, {}, os.system)) as outcomes:
        next(outcomes)
        while len(found := list(tmp_path.iterdir())) < 3:
            time.sleep(0.05)
    start = time.monotonic()
    while any(_alive(int(path.name)) for path in found):
        assert time.monotonic() - start < 5.0
        time.sleep(0.05)
    begun = len(list(tmp_path.iterdir()))
    time.sleep(1.0)
    assert len(list(tmp_path.iterdir())) == begun < len(jobs)


def _alive(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for its parent."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.jobs.dask_jobs._CONNECT_S", 0.5)
    with pytest.raises(RsbenchError, match=r"^--scheduler tcp://127.0.0.1:1: "):
        list(run_jobs(functools.partial, ["1"], Cluster(address="tcp://127.0.0.1:1"), {}, eval))


CLUSTER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as cluster:
        print(cluster.scheduler_address, flush=True)
        input()
"""


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_with_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.jobs.dask_jobs._CONNECT_S", 3)
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    command = [sys.executable, str(script)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        threading.Timer(3.0, process.kill).start()
        with pytest.raises(RsbenchError, match="the connection is lost"):
            list(run_jobs(functools.partial, ["sleep 1000"], Cluster(address=address), {}, os.system))
