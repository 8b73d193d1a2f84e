"""Results on a store in memory: the bytes of a folder, whatever is stopped, lost, refused or changed by others."""

from __future__ import annotations

import itertools
import os
import queue
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from commands import assert_refused, run_here, sweep_card
from evaluations import MACHINE, contents
from leaderboards import jobs_here, small_split
from small_scenes import write_box_scene, write_small_card

from rsbench.benchmark.leaderboard import running
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.storage import object_store
from rsbench.storage.files import write_bytes
from rsbench.storage.object_store import mirrored, name_of
from rsbench.storage.work_folder import WORK, work_folder

fsspec = pytest.importorskip("fsspec", reason="needs rsbench[cloud]")
URL = "memory://bucket/mine"
SWEEP = sweep_card(["gs-8pt"], noise_px=[0.0, 0.5], trials=3)


@pytest.fixture
def open_mirrors(monkeypatch: pytest.MonkeyPatch) -> queue.Queue[Any]:
    """Mirrors that upload only on request."""
    found: queue.Queue[Any] = queue.Queue()
    monkeypatch.setattr(object_store._Mirror, "keep_sending", lambda self, done: found.put(self))
    return found


def stored(memory: Any) -> dict[str, bytes]:
    return {path.removeprefix("/bucket/mine/"): memory.cat(path) for path in memory.find("/bucket/mine")}


def without_times(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """What no two runs agree on is left out, and the lock; and the command, which names --out."""
    return {
        path: re.sub(rb"&#34;command&#34;: .*", b"", data) if path == "report.html" else data
        for path, data in files.items()
        if Path(path).name not in MACHINE and not path.startswith("seconds/") and path != ".rsbench/lock"
    }


# Commands


@pytest.mark.slow
def test_a_sweep_goes_to_a_store(memory: Any, tmp_path: Path) -> None:
    card = tmp_path / "mine.toml"
    card.write_text(SWEEP, "utf-8")
    assert run_here("simulate", card, "--out", tmp_path / "out", "--workers", 1).returncode == 0
    run = run_here("simulate", card, "--out", f"{URL}/", "--workers", 2)
    assert run.returncode == 0, run.stderr
    assert f"table: {URL}/summary.csv" in run.stdout
    assert without_times(stored(memory)) == without_times(contents(tmp_path / "out"))
    assert {"seconds/000.npz", "provenance.json"} <= stored(memory).keys()
    assert URL.encode() in stored(memory)["provenance.json"] and b"cache" not in stored(memory)["provenance.json"]
    other = run_here("simulate", card, "--out", URL, "--trials", 4)
    assert_refused(other, f"{URL}: holds another sweep (differs in trials); choose another --out")


@pytest.mark.slow
def test_an_evaluation_goes_to_a_store(memory: Any, tmp_path: Path) -> None:
    card = load_dataset_card(str(write_small_card(tmp_path, [write_box_scene(tmp_path, "a")])))
    generate_dataset(card, tmp_path / "data")
    command = ("evaluate", tmp_path / "data", "--solver", "gs-8pt", "--out")
    assert run_here(*command, tmp_path / "out").returncode == 0
    run = run_here(*command, URL)
    assert run.returncode == 0, run.stderr
    assert f"report: {URL}/report.html" in run.stdout
    there, here = without_times(stored(memory)), without_times(contents(tmp_path / "out"))
    assert there == here and len(there) > 50 and stored(memory)[".rsbench/lock"] == b""
    shutil.rmtree(tmp_path / "cache")  # as on another machine
    before = {path: memory.info(f"/bucket/mine/{path}")["created"] for path in there if "predictions" in path}
    assert run_here(*command, URL).returncode == 0
    assert before == {path: memory.info(f"/bucket/mine/{path}")["created"] for path in before}, "made again"


@pytest.mark.slow
def test_a_board_goes_to_a_store(memory: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    monkeypatch.setattr("rsbench.cli.leaderboard.split_of", lambda *options: small_split(3))
    command = ("leaderboard", "run", "points", "--entry", "gs-8pt", "--board")
    assert run_here(*command, tmp_path / "board").returncode == 0
    run = run_here(*command, URL)
    assert run.returncode == 0, run.stderr
    assert stored(memory)[".rsbench/lock"] == b""
    for path, data in stored(memory).items():  # bring it down: it is a board as any
        (tmp_path / "copy" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "copy" / path).write_bytes(data)
    here, there = (
        pd.read_csv(next((tmp_path / name).rglob("entries/gs-8pt/scores.csv"))) for name in ("board", "copy")
    )
    pd.testing.assert_frame_equal(there.drop(columns="seconds"), here.drop(columns="seconds"))
    assert run_here(*command, tmp_path / "copy").returncode == 0


@pytest.mark.parametrize("command", [("simulate", "noise", "--out"), ("evaluate", "data", "--out")])
def test_what_cannot_be_taken_is_one_line(command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsbench.cli.cluster_options.find_spec", lambda name: True)
    cluster = run_here(*command, "s3://bucket/x", "--scheduler", "tcp://host:1")
    assert_refused(
        cluster, "s3://bucket/x: not with --scheduler, whose jobs write into a folder that all machines"
    )
    assert_refused(run_here(*command, "nothing://bucket/x"), "nothing://bucket/x: cannot open it", "another URL")
    assert_refused(run_here(*command, "file://x"), "file://x: must be an absolute path")


# What is stopped


class _Stop(BaseException):
    """As ``kill -9``: nothing is done on the store after it."""


_RESULTS = {
    "plan.json": b"plan",
    **{f"data/{number}.bin": b"%d" % number * 9 for number in range(4)},
    "end.json": b"end",
}


def _command(send: Callable[[], object], folder: Path) -> list[str]:
    """As the sweeps do it: chunks are kept hidden, and collected when all are there; returns what it makes."""
    made = []
    with work_folder(folder) as hidden:
        write_bytes(folder / "plan.json", _RESULTS["plan.json"])
        for name in (name for name in _RESULTS if name.startswith("data/")):
            chunk = hidden / "chunks" / Path(name).name
            if not (folder / name).is_file() and not chunk.is_file():
                chunk.parent.mkdir(exist_ok=True)
                write_bytes(chunk, _RESULTS[name])
                made.append(name)
            send()
        (folder / "data").mkdir(exist_ok=True)
        for name in (name for name in _RESULTS if name.startswith("data/")):
            if not (folder / name).is_file():
                write_bytes(folder / name, (hidden / "chunks" / Path(name).name).read_bytes())
        shutil.rmtree(hidden / "chunks", ignore_errors=True)
        write_bytes(folder / "end.json", _RESULTS["end.json"])
    return made


@contextmanager
def _stopped(number: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Before this operation on the store or on files here; nothing more happens on either."""
    left = itertools.count(number - 1, -1)

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*arguments: Any, **options: Any) -> Any:
            if next(left) <= 0:
                raise _Stop
            return real(*arguments, **options)

        return operation

    kind = fsspec.filesystem("memory").__class__
    operations = [(kind, name) for name in ("put_file", "get_file", "find", "rm_file")]
    with monkeypatch.context() as patch:
        for owner, name in [*operations, (os, "replace"), (object_store._Mirror, "_drop")]:
            patch.setattr(owner, name, counted(getattr(owner, name)))
        yield


def _others(memory: Any, cache: Path) -> dict[str, bytes]:
    """They changed the store after a command here, whose next one was killed before it sent anything."""
    (folder,) = cache.rglob("results")
    (folder / "stray").write_bytes(b"not sent")
    memory.rm("/bucket/mine/end.json")
    theirs = {"data/0.bin": b"theirs", "more/1": b"theirs", "more/2": b"theirs"}
    for path, data in theirs.items():
        memory.pipe(f"/bucket/mine/{path}", data)
    return theirs


@pytest.mark.slow
@pytest.mark.parametrize("where", ["here", "elsewhere", "overtaken"])
def test_stopped_before_any_operation_it_goes_on_to_the_same_bytes(
    where: str, memory: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, open_mirrors: queue.Queue[Any]
) -> None:
    """On the machine of the one that was stopped, and on another one; where the end is, all of it is."""

    def run() -> list[str]:
        open_mirrors.queue.clear()
        with mirrored(URL) as folder:
            return _command(open_mirrors.get().send, folder)

    sent = set[str]()
    for number in itertools.count(1):
        memory.store.clear()
        shutil.rmtree(tmp_path / "cache", ignore_errors=True)
        memory.pipe("/bucket/mine/notes.txt", b"not ours")
        expected = {**_RESULTS, "notes.txt": b"not ours"}
        if where == "overtaken":
            run()
            expected |= _others(memory, tmp_path / "cache")
        try:
            with _stopped(number, monkeypatch):
                run()
        except _Stop:
            there = stored(memory)
            assert "end.json" not in there or expected.items() <= there.items()
            assert "plan.json" in there or not any(path.endswith(".bin") for path in there)
        else:
            break
        if where == "elsewhere":
            shutil.rmtree(tmp_path / "cache")
        before, sent = sent, {f"data/{Path(path).name}" for path in there if path.endswith(".bin")}
        assert before <= sent and not sent.intersection(run())
        assert stored(memory) == expected
    assert number > 15


# What is there, and what others do there


def test_half_files_locks_and_odd_names_stay_where_they_are(memory: Any, open_mirrors: queue.Queue[Any]) -> None:
    odd = ("/bucket/mine/C:/x", "/bucket/mine/a\\b", "/bucket/mine/.x.partial", "/bucket/mine/.rsbench/work/x")
    for path in odd:
        memory.pipe(path, b"odd")
    with mirrored(URL) as folder, work_folder(folder) as hidden:
        assert not list(folder.rglob("x")) and not list(folder.rglob("*.partial"))
        (hidden / WORK / "0.png").write_bytes(b"half")
        (hidden / "hashes.jsonl").write_bytes(b"of this machine")
        (folder / ".a.png.partial").write_bytes(b"half")
        (folder / "link").symlink_to(__file__)
        (folder / "whole").write_bytes(b"whole")
        open_mirrors.get().send()
        assert memory.cat("/bucket/mine/.rsbench/lock") == b""
    assert stored(memory).keys() - {path.removeprefix("/bucket/mine/") for path in odd} == {"whole"}
    assert (
        not object_store._travels("../x") and not object_store._travels("a//x") and not object_store._travels("/x")
    )
    assert not object_store._travels("a/../x") and object_store._travels("a/..x")


@pytest.mark.usefixtures("open_mirrors")
def test_what_others_change_is_brought_and_nothing_else(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with mirrored(URL) as folder:
        for name in "abc":
            (folder / name).mkdir()
            (folder / name / "x").write_text("old")
    brought = list[str]()
    real = object_store.Store.download
    monkeypatch.setattr(
        object_store.Store, "download", lambda self, files: (brought.extend(files), real(self, files))
    )
    with mirrored(URL):
        assert brought == []
    memory.pipe("/bucket/mine/a/x", b"new")
    memory.rm("/bucket/mine/b/x")
    memory.pipe("/bucket/mine/d/x", b"new")
    with mirrored(URL) as folder:
        assert brought == ["a/x", "d/x"] and not (folder / "b").exists()
        assert {name: (folder / name / "x").read_text() for name in "acd"} == {"a": "new", "c": "old", "d": "new"}
    assert stored(memory) == {"a/x": b"new", "c/x": b"old", "d/x": b"new"}
    times = {path: memory.info(path)["created"] for path in memory.find("/bucket/mine")}
    with mirrored(URL):
        assert brought == ["a/x", "d/x"]
    assert times == {path: memory.info(path)["created"] for path in memory.find("/bucket/mine")}


def test_what_a_command_removes_while_it_is_sent_is_no_fault(
    memory: Any, monkeypatch: pytest.MonkeyPatch, open_mirrors: queue.Queue[Any]
) -> None:
    with mirrored(URL) as folder:
        (folder / "a").write_text("a")
        (folder / "b").write_text("b")
        real = object_store.Store.upload
        with monkeypatch.context() as patch:
            patch.setattr(
                object_store.Store,
                "upload",
                lambda self, files: ((folder / "a").unlink(missing_ok=True), real(self, files)),
            )
            open_mirrors.get().send()
        assert stored(memory).keys() == {"b", ".rsbench/lock"}
    assert stored(memory) == {"b": b"b"}


@pytest.mark.usefixtures("open_mirrors")
def test_what_is_cleaned_away_here_stays_there(memory: Any) -> None:
    """Only what goes while a command works is removed from the store."""
    with mirrored(URL) as folder:
        (folder / "a").write_text("a")
        (folder / "b").write_text("b")
    (folder / "a").unlink()
    with mirrored(URL) as folder:
        assert (folder / "a").read_text() == "a"
        (folder / "b").unlink()
    assert stored(memory) == {"a": b"a"}


@pytest.mark.usefixtures("open_mirrors")
def test_results_of_a_run_that_others_overtook_are_not_mixed_with_theirs(memory: Any, tmp_path: Path) -> None:
    with mirrored(URL) as folder:
        (folder / "plan.json").write_text("mine")
    (folder / "result").write_text("mine")  # by a command that was killed before it was sent
    memory.pipe("/bucket/mine/plan.json", b"theirs")
    with mirrored(URL) as folder:
        assert [path.name for path in folder.iterdir()] == ["plan.json"]
    assert stored(memory) == {"plan.json": b"theirs"}


# What fails


def _refuse(*arguments: Any, **options: Any) -> None:
    raise PermissionError("denied")


def test_a_store_that_refuses_is_told_before_the_work(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(memory), "put_file", _refuse)
    run = run_here("simulate", "noise", "--out", URL)
    assert_refused(run, f"{URL}: cannot write .rsbench/lock: denied; ask for the right to list, read and write")


def test_a_store_that_fails_later_loses_nothing(
    memory: Any, monkeypatch: pytest.MonkeyPatch, open_mirrors: queue.Queue[Any]
) -> None:
    with mirrored(URL) as folder:
        write_bytes(folder / "plan.json", b"old")
    real = type(memory).put_file

    def refuse(self: Any, here: str, there: str, **more: Any) -> None:
        (real if there.endswith("plan.json") else _refuse)(self, here, there, **more)

    words = r"^memory://bucket/mine: cannot write data/0\.bin: denied; .*cache/rsbench/stores/.*: the same command"
    with monkeypatch.context() as patch, pytest.raises(RsbenchError, match=words), mirrored(URL) as folder:
        patch.setattr(type(memory), "put_file", refuse)
        assert len(_command(lambda: None, folder)) == 4
    assert stored(memory).items() == {"plan.json": b"plan", ".rsbench/lock": b""}.items()
    open_mirrors.queue.clear()
    with mirrored(URL) as folder:
        assert _command(lambda: None, folder) == []
    assert stored(memory) == _RESULTS


def test_what_was_made_until_an_error_is_sent(memory: Any) -> None:
    with pytest.raises(RsbenchError, match=rf"^{URL}/a: damaged$"), mirrored(URL) as folder:
        assert name_of(folder / "a") == f"{URL}/a"
        (folder / "a").write_text("a")
        raise RsbenchError(f"{folder / 'a'}: damaged")
    assert stored(memory) == {"a": b"a"}


@pytest.mark.usefixtures("memory")
def test_two_commands_do_not_write_to_one_url() -> None:
    with mirrored(URL):
        assert_refused(run_here("simulate", "noise", "--out", URL), f"{URL}: process", "is at work there since")
