"""Jobs on a Dask cluster of this machine: the same answers, whoever dies."""

from __future__ import annotations

import functools
import gc
import math
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from programs import is_running

from rsbench.core.errors import RsbenchError
from rsbench.jobs.process_jobs import Cluster, run_jobs

pytestmark = [
    pytest.mark.skipif(find_spec("distributed") is None, reason="needs rsbench[cluster]"),
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc"),
]


@pytest.fixture(scope="module")
def one_thread() -> Iterator[Any]:
    """A cluster whose one worker is a thread of this process."""
    from distributed import LocalCluster

    options = {"protocol": "tcp", "host": "127.0.0.1", "dashboard_address": ":0"}
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **options) as cluster:
        yield cluster


def wait_until(condition: Callable[[], bool], limit_s: float = 60.0) -> None:
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "the condition has not come true"
        time.sleep(0.02)


def job_states(cluster: Any) -> list[str]:
    """The states of the scheduler's tasks that are jobs."""
    return [task.state for key, task in list(cluster.scheduler.tasks.items()) if str(key).startswith("_do-")]


def pid_of(cluster: Any, address: str) -> int:
    (pid,) = [nanny.pid for nanny in cluster.workers.values() if nanny.worker_address == address]
    return pid


SQUARES = {float(k * k): float(k) for k in range(6)}


def test_a_worker_of_the_cluster_that_is_killed_loses_nothing(there: Cluster, local: Any, tmp_path: Path) -> None:
    """The first job kills the worker that serves it, the parent of its parent."""
    mark = tmp_path / "mark"
    kill = f"test -e {mark} || {{ touch {mark}; kill -9 $(ps -o ppid= -p $PPID); }}; sleep 0.2"
    jobs = [kill, *(f"sleep 0.0{k}" for k in range(1, 8))]
    done = [job for job, outcome in run_jobs(functools.partial, jobs, there, {}, os.system) if outcome.value == 0]
    assert sorted(done) == sorted(jobs) and mark.exists()


def test_a_job_that_kills_the_workers_of_the_cluster_is_a_failure_with_its_reason(
    there: Cluster, local: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local.scheduler, "allowed_failures", 0)  # else it takes four workers
    job = "kill -9 $(ps -o ppid= -p $PPID); sleep 1000"
    ((_, outcome),) = run_jobs(functools.partial, [job], there, {}, os.system)
    assert outcome.ended and outcome.reason.startswith("workers of the cluster died: tcp://")


def test_results_that_die_with_their_workers_before_they_are_fetched_are_made_again(
    there: Cluster, local: Any
) -> None:
    """All results but one lie in the memory of the workers when these are killed."""
    with closing(run_jobs(functools.partial, list(SQUARES), there, {}, math.sqrt)) as outcomes:
        done = [next(outcomes)]
        wait_until(lambda: job_states(local) == ["memory"] * 5)
        killed = set(local.scheduler.workers)
        for address in killed:
            os.kill(pid_of(local, address), signal.SIGKILL)
        wait_until(lambda: not killed & set(local.scheduler.workers))
        done += list(outcomes)
    assert {job: outcome.value for job, outcome in done} == SQUARES


def test_a_result_that_dies_while_it_is_fetched_is_made_again(
    there: Cluster, local: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worker is killed between the request to the scheduler and that of the scheduler to the worker."""
    gather, killed = local.scheduler.handlers["gather"], list[str]()

    async def kill_and_gather(keys: list[str], **others: Any) -> Any:
        holders = [worker.address for key in keys for worker in local.scheduler.tasks[key].who_has or ()]
        if holders and not killed:
            killed.append(holders[0])
            os.kill(pid_of(local, holders[0]), signal.SIGKILL)
        return await gather(keys=keys, **others)

    monkeypatch.setitem(local.scheduler.handlers, "gather", kill_and_gather)
    done = run_jobs(functools.partial, list(SQUARES), there, {}, math.sqrt)
    assert {job: outcome.value for job, outcome in done} == SQUARES and killed


def looked_at(
    monkeypatch: pytest.MonkeyPatch, look: Callable[[Any, Any], Any], begin: Callable[[], None] = lambda: None
) -> None:
    """Let the watch of a job see ``look(worker, task)`` for the worker's task; ``begin`` precedes each job."""
    from distributed import get_worker

    def watched_worker() -> Any:
        begin()
        worker = get_worker()
        tasks = SimpleNamespace(get=functools.partial(look, worker))
        return SimpleNamespace(get_current_task=worker.get_current_task, state=SimpleNamespace(tasks=tasks))

    monkeypatch.setattr("distributed.get_worker", watched_worker)
    monkeypatch.setattr("rsbench.jobs.process_jobs._WATCH_S", 0.01)


def test_a_watch_that_comes_late_does_not_stop_the_next_job(
    one_thread: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The watch of the first job wakes while that runs, and looks when the second one begins in the same child."""
    late, second_begins, woken = list[threading.Thread](), threading.Event(), tmp_path / "woken"

    def look(worker: Any, task: Any) -> Any:
        if not late:
            late.append(threading.current_thread())
            woken.touch()
            second_begins.wait()
        return worker.state.tasks.get(task)

    def begin() -> None:
        if late:
            second_begins.set()
            late[0].join()

    looked_at(monkeypatch, look, begin)
    jobs = [f"while ! test -e {woken}; do sleep 0.01; done"] * 2
    there = Cluster(address=one_thread.scheduler_address)
    assert [outcome.value for _, outcome in run_jobs(functools.partial, jobs, there, {}, os.system)] == [0, 0]
    assert late


def test_a_job_that_was_stopped_and_is_wanted_is_repeated(
    one_thread: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A worker's task is cancelled where its input is lost, and goes on when that is made again: the watch has
    seen it between.
    """
    cancelled, begun = [SimpleNamespace(state="cancelled")], tmp_path / "begun"

    def look(worker: Any, task: Any) -> Any:
        return cancelled.pop() if cancelled and begun.exists() else worker.state.tasks.get(task)

    looked_at(monkeypatch, look)
    job = f"mkdir {begun} 2>/dev/null && sleep 1000; true"
    there = Cluster(address=one_thread.scheduler_address)
    ((_, outcome),) = run_jobs(functools.partial, [job], there, {}, os.system)
    assert outcome.value == 0 and not cancelled


@pytest.mark.parametrize("interrupt", [False, True], ids=["closed", "Ctrl-C"])
def test_what_is_stopped_ends_there(there: Cluster, local: Any, tmp_path: Path, interrupt: bool) -> None:
    """Jobs that wait are dropped, and the children at work end."""
    command = f"n=$(ls {tmp_path} | wc -l); echo $$ > {tmp_path}/$$; test $n -lt 2 || exec sleep 1000"
    jobs = [f"{command} # {k}" for k in range(8)]  # in any order

    def begun() -> list[int]:
        return [int(path.name) for path in tmp_path.iterdir()]

    def stop() -> None:
        wait_until(lambda: len(begun()) >= 4)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    with closing(run_jobs(functools.partial, jobs, there, {}, os.system)) as outcomes:
        next(outcomes)
        if interrupt:
            with pytest.raises(KeyboardInterrupt):
                threading.Thread(target=stop, daemon=True).start()
                list(outcomes)  # waits for a third outcome
        else:
            wait_until(lambda: len(begun()) >= 3)
    wait_until(lambda: not any(is_running(pid) for pid in begun()))
    wait_until(lambda: not any(worker.processing for worker in local.scheduler.workers.values()))
    assert not job_states(local) and len(begun()) < len(jobs)


def test_a_run_that_is_stopped_waits_for_no_frozen_worker(
    there: Cluster, local: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The limits are far from both: what is frozen goes on after a minute if nobody ends the wait."""
    monkeypatch.setattr("rsbench.jobs.process_jobs._DISMISS_S", 0.2)
    mark = tmp_path / "mark"
    outcomes = run_jobs(functools.partial, [f"touch {mark}; sleep 1000", "true"], there, {}, os.system)
    next(outcomes)
    wait_until(mark.exists)
    (address,) = [worker.address for worker in local.scheduler.workers.values() if worker.processing]
    frozen = pid_of(local, address)
    thaw = threading.Timer(60.0, os.kill, (frozen, signal.SIGCONT))
    os.kill(frozen, signal.SIGSTOP)
    try:
        thaw.start()
        start = time.monotonic()
        outcomes.close()
        assert time.monotonic() - start < 30.0
    finally:
        thaw.cancel()
        os.kill(frozen, signal.SIGCONT)


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.jobs.process_jobs._CONNECT_S", 0.5)
    with pytest.raises(RsbenchError, match=r"^--scheduler tcp://127.0.0.1:1: "):
        list(run_jobs(functools.partial, ["1"], Cluster(address="tcp://127.0.0.1:1"), {}, eval))


@pytest.mark.parametrize("when", ["waiting", "fetching", "restart"])
def test_a_lost_connection_ends_the_run_with_a_line(
    there: Cluster, local: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, when: str
) -> None:
    """The scheduler closes its streams to clients while a job runs or a result is fetched, or forgets all jobs."""
    scheduler, mark = local.scheduler, tmp_path / "mark"

    async def lose_all() -> None:
        if when == "restart":
            await scheduler.restart(stimulus_id="test")
        elif when == "waiting":
            for stream in list(scheduler.client_comms.values()):
                stream.abort()

    async def hang_up(comm: Any, **_: Any) -> None:
        comm.abort()

    async def keep_workers(**_: Any) -> None:
        """In place of their restart, which takes up to 30 s and is not what this is about."""

    def act() -> None:
        wait_until(mark.exists)
        local.sync(lose_all)

    monkeypatch.setattr(scheduler, "restart_workers", keep_workers)
    if when == "fetching":
        monkeypatch.setitem(scheduler.handlers, "gather", hang_up)
    actor = threading.Thread(target=act, daemon=True)
    actor.start()
    job = f"touch {mark}" if when == "fetching" else f"touch {mark}; sleep 1000"
    with pytest.raises(RsbenchError, match=r"^--scheduler tcp://\S+: the connection is lost or .*there$"):
        list(run_jobs(functools.partial, [job], there, {}, os.system))
    actor.join()
    wait_until(lambda: not job_states(local))
    with warnings.catch_warnings():  # distributed drops a socket where its client closes while it connects again
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


CLUSTER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as cluster:
        print(cluster.scheduler_address, flush=True)
        input()
"""


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_with_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.jobs.process_jobs._CONNECT_S", 3)
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    command, mark = [sys.executable, str(script)], tmp_path / "mark"
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()

        def kill() -> None:
            wait_until(mark.exists)
            process.kill()

        threading.Thread(target=kill, daemon=True).start()
        job = f"touch {mark}; sleep 1000"
        with pytest.raises(RsbenchError, match="the connection is lost"):
            list(run_jobs(functools.partial, [job], Cluster(address=address), {}, os.system))
