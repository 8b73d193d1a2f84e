"""Jobs over processes: all are done, each once, and all can be stopped."""

from __future__ import annotations

import functools
import math
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import EntryFailure, IsolatedWorker, receive
from rsbench.jobs.process_jobs import LostJobsError, Workers, finished_jobs, run_jobs

ASK = "__import__('os').getpid()"


def test_all_jobs_are_done(workers: Workers) -> None:
    jobs = [float(k * k) for k in range(20)]
    done = {job: outcome.value for job, outcome in run_jobs(functools.partial, jobs, workers, {}, math.sqrt)}
    assert done == {float(k * k): float(k) for k in range(20)}


def test_a_job_that_always_dies_is_named_when_the_others_are_done(workers: Workers, tmp_path: Path) -> None:
    """Each try appends a letter; the shell's parent is the child that serves the job."""
    note = tmp_path / "tries"
    deadly, done = f"printf x >> {note}; kill -9 $PPID", dict[str, int]()
    with pytest.raises(LostJobsError, match=r"kill -9 \$PPID \(killed by signal 9 \(SIGKILL\), 3 times\)"):
        for job, value in finished_jobs(functools.partial, [deadly, "true", "exit 3"], workers, {}, os.system):
            done[job] = os.waitstatus_to_exitcode(value)
    assert done == {"true": 0, "exit 3": 3} and note.read_text() == "xxx"


def test_a_job_that_takes_too_long_fails_alone(workers: Workers) -> None:
    limits = {"__import__('time').sleep(1000)": 0.3, "7": 60.0}
    jobs = run_jobs(functools.partial, list(limits), workers, {}, eval, seconds_of=limits.__getitem__)
    long, short = map(dict(jobs).__getitem__, limits)
    assert long.reason == "took longer than 0.3 s" and short.value == 7


def test_jobs_are_done_by_few_processes() -> None:
    pids = {outcome.value for _, outcome in run_jobs(functools.partial, [ASK] * 6, 2, {}, eval)}
    assert 1 <= len(pids) <= 2 and os.getpid() not in pids


def test_the_environment_reaches_the_children() -> None:
    given = {"RSBENCH_TEST_WORD": "yes"}
    ((_, outcome),) = run_jobs(functools.partial, ["RSBENCH_TEST_WORD"], 1, given, os.getenv)
    assert outcome.value == "yes" and "RSBENCH_TEST_WORD" not in os.environ


def test_a_job_that_was_killed_once_is_done(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    ((_, outcome),) = run_jobs(
        functools.partial, [f"test -e {mark} || {{ touch {mark}; kill -9 $PPID; }}"], 1, {}, os.system
    )
    assert outcome.success and outcome.value == 0


def kill_and_await(pid: int) -> None:
    """Kill a process; its end stays to be seen by its parent."""
    os.kill(pid, signal.SIGKILL)
    with suppress(ChildProcessError):  # the parent has seen it already
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


@pytest.mark.skipif(not hasattr(os, "waitid"), reason="needs os.waitid")
def test_an_answer_counts_although_its_process_dies_before_it_is_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The thread that reads the answer gets no processor for a while, in which the process is killed.

    The job has a limit, so that it is tried once.
    """
    note = tmp_path / "pids"

    def receive_late(stream: BinaryIO) -> bytes | None:
        answer = receive(stream)
        if answer is not None and note.exists():  # the answer to the job, not that the process has started
            kill_and_await(int(note.read_text()))
            time.sleep(0.5)  # longer than the other thread takes to see that the process has ended
        return answer

    monkeypatch.setattr("rsbench.jobs.isolation.receive", receive_late)
    job = f"echo $PPID >> {note}"
    ((_, outcome),) = run_jobs(functools.partial, [job], 1, {}, os.system, seconds_of=lambda job: 60.0)
    assert outcome.success and outcome.value == 0


@pytest.mark.skipif(not hasattr(os, "waitid"), reason="needs os.waitid")
def test_a_process_that_died_between_two_jobs_costs_the_second_nothing() -> None:
    """Jobs with a limit are tried once."""
    with IsolatedWorker(functools.partial, eval) as worker:
        pid = worker.call(ASK, limit_s=60.0).value
        kill_and_await(pid)
        outcome = worker.call(ASK, limit_s=60.0)
    assert outcome.success and outcome.value != pid


def test_a_job_that_takes_too_much_fails_alone(tmp_path: Path) -> None:
    """Too long, too much memory, and an end of the process, which is not tried again; then one in order."""
    note = tmp_path / "tries"
    long = "__import__('time').sleep(1000)"
    large = "len(b'x' * (900 << 20)) and __import__('time').sleep(1000)"
    deadly = f"__import__('os').system('printf x >> {note}; kill -9 $PPID')"
    limits = {long: 0.3, large: 60.0, deadly: 60.0, "7": 60.0}
    jobs = run_jobs(functools.partial, list(limits), 1, {}, eval, seconds_of=limits.__getitem__, memory_mb=600.0)
    found = {job: outcome for job, outcome in jobs}
    assert found[long].reason == "took longer than 0.3 s"
    assert found[deadly].reason == "killed by signal 9 (SIGKILL)" and note.read_text() == "x"
    assert found["7"].value == 7
    if Path("/proc/self/statm").exists():  # elsewhere memory has no limit
        assert found[large].reason == "used more than 600 MB of memory"


def refuse(job: str) -> None:
    raise EntryFailure(f"{job} is wrong")


def test_a_job_that_fails_ends_all_at_once() -> None:
    with pytest.raises(RsbenchError, match=r"^job of 3 letters: abc is wrong$"):
        list(
            finished_jobs(functools.partial, ["abc"], 1, {}, refuse, name=lambda job: f"job of {len(job)} letters")
        )


def test_leaving_early_ends_everything_at_once() -> None:
    jobs = [0.0, *[1000.0] * 9]
    outcomes = run_jobs(functools.partial, jobs, 2, {}, time.sleep)
    assert next(outcomes)[1].success
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        outcomes.throw(KeyboardInterrupt())
    assert time.monotonic() - start < 30.0  # the jobs would take 1000


def test_our_own_mistake_in_a_child_stops() -> None:
    with pytest.raises(RuntimeError, match="in a child process"):
        list(run_jobs(functools.partial, ["four"], 1, {}, math.sqrt))
