"""Folders of work, hashes and locks, and writing on other threads."""

from __future__ import annotations

import gc
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest

from rsbench.core.errors import RsbenchError
from rsbench.storage.files import FileHashes, background_writer, begun, write_bytes
from rsbench.storage.work_folder import HIDDEN, WORK, files_below, listed, remove, unknown_files, work_folder

HOLDS = """
import sys, time
from pathlib import Path
from rsbench.storage.work_folder import work_folder
with work_folder(Path(sys.argv[1])) as hidden:
    (hidden / "work/half").write_text("half")
    print("in", flush=True)
    time.sleep(1000)
"""


def test_it_is_empty_at_first_and_leaves_nothing(tmp_path: Path) -> None:
    with work_folder(tmp_path / "new/out") as hidden:
        assert hidden == tmp_path / "new/out" / HIDDEN and list((hidden / WORK).iterdir()) == []
        (hidden / WORK / "half").write_text("half")
    assert list(tmp_path.iterdir()) == [], "folders that it made are empty"
    (tmp_path / "old").mkdir()
    with work_folder(tmp_path / "old/out"):
        (tmp_path / "old/out/result").write_text("done")
    with work_folder(tmp_path / "old"):
        pass
    assert files_below(tmp_path) == ["old/out/result"]


def test_what_a_later_run_can_use_stays(tmp_path: Path) -> None:
    with work_folder(tmp_path) as hidden:
        (hidden / "hashes.jsonl").write_text("known")
    with work_folder(tmp_path) as hidden:
        assert (hidden / "hashes.jsonl").read_text() == "known" and list((hidden / WORK).iterdir()) == []


def test_a_second_command_is_told_who_is_there(tmp_path: Path) -> None:
    with work_folder(tmp_path), pytest.raises(RsbenchError) as caught, work_folder(tmp_path):
        pass
    message = str(caught.value)
    assert f"process {os.getpid()} on {platform.node()} is at work there since 20" in message
    assert "\n" not in message and "choose another folder" in message
    with work_folder(tmp_path):
        pass


@pytest.mark.skipif(os.name != "posix", reason="locks that end with their process")
def test_the_place_of_a_killed_command_is_taken_at_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDS, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "in\n"
        with pytest.raises(RsbenchError, match=f"process {process.pid} on "), work_folder(tmp_path):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (tmp_path / HIDDEN / WORK / "half").exists()
    with work_folder(tmp_path) as hidden:
        assert list((hidden / WORK).iterdir()) == []


@pytest.mark.parametrize(("age_s", "free"), [(10.0, False), (1000.0, True)])
def test_a_command_on_another_host_counts_while_it_shows_signs_of_life(
    tmp_path: Path, age_s: float, free: bool
) -> None:
    """As a file system shows it that does not pass locks on to other hosts."""
    lock = tmp_path / HIDDEN / "lock"
    lock.parent.mkdir()
    lock.write_text(
        json.dumps({"pid": 17, "host": "elsewhere", "since": "yesterday", "command": "rsbench generate"})
    )
    os.utime(lock, (time.time() - age_s, time.time() - age_s))
    if free:
        with work_folder(tmp_path):
            pass
        assert not lock.exists()
        return
    seen = r"process 17 on elsewhere .* since yesterday, seen there 1\d s ago"
    with pytest.raises(RsbenchError, match=seen), work_folder(tmp_path):
        pass
    assert "elsewhere" in lock.read_text()


def test_no_two_are_in_at_once(tmp_path: Path) -> None:
    """Each leaves by removing the file that the next one has opened perhaps."""
    inside, most, entered = [0], [0], [0]

    def enter() -> None:
        for _ in range(100):
            try:
                with work_folder(tmp_path):
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    entered[0] += 1
                    time.sleep(0.0005)
                    inside[0] -= 1
            except RsbenchError as error:
                assert "is at work there" in str(error)

    threads = [threading.Thread(target=enter) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] and entered[0] > 0


@pytest.mark.parametrize("kind", ["folder", "link", "file"])
def test_a_hidden_folder_of_somebody_else_is_left_alone(tmp_path: Path, kind: str) -> None:
    out, theirs = tmp_path / "out", tmp_path / "theirs"
    out.mkdir()
    theirs.mkdir()
    (theirs / "diary").write_text("dear")
    if kind == "folder":
        theirs.rename(out / HIDDEN)
    elif kind == "link":
        (out / HIDDEN).symlink_to(theirs)
    else:
        (out / HIDDEN).write_text("dear")
    with pytest.raises(RsbenchError, match=r"not a folder that rsbench made|cannot be written"), work_folder(out):
        pass
    found = out / HIDDEN if kind == "file" else out / HIDDEN / "diary"
    assert found.read_text() == "dear"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "link"])
def test_hidden_files_are_regular(tmp_path: Path, kind: str) -> None:
    """A folder of results may be a stranger's: no command waits for a pipe there or writes through a link."""
    hidden, other = tmp_path / HIDDEN, tmp_path / "other"
    hidden.mkdir()
    for store in (hidden / "hashes.jsonl", hidden / "lock"):
        pipe = store if kind == "pipe" else other
        if kind == "link":
            other.write_text("mine")
        else:
            os.mkfifo(pipe)
            threading.Thread(
                target=lambda place=pipe: place.open("wb").close(), daemon=True
            ).start()  # or none ends
        if kind != "pipe":
            store.symlink_to(other)
        with pytest.raises(RsbenchError) as caught:
            if store.name == "lock":
                with work_folder(tmp_path):
                    pass
            else:
                FileHashes(tmp_path, store)
        assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
        if kind == "pipe":
            assert str(caught.value) == f"{store}: is not a regular file; remove it"
        if kind == "link":
            assert other.read_text() == "mine"
        else:
            os.close(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))  # the thread goes
        other.unlink(missing_ok=True)


def test_links_are_removed_and_not_followed(tmp_path: Path) -> None:
    theirs, out = tmp_path / "theirs", tmp_path / "out"
    theirs.mkdir()
    (theirs / "diary").write_text("dear")
    with work_folder(out) as hidden:
        (hidden / "hashes.jsonl").write_text("")
    (out / HIDDEN / WORK).symlink_to(theirs)
    with work_folder(out) as hidden:
        (hidden / WORK / "below").mkdir()
        (hidden / WORK / "below/link").symlink_to(theirs)
        (hidden / WORK / "file").symlink_to(theirs / "diary")
    remove(tmp_path / "nothing")
    assert (theirs / "diary").read_text() == "dear" and not (out / HIDDEN / WORK).exists()


def test_strangers_are_all_that_is_not_a_plain_file_of_ours(tmp_path: Path) -> None:
    ours = {"a", "deep/b", "linked", "folder/c"}
    for name in ("a", "deep/b", "deep/note", "folder/c"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "linked").symlink_to(tmp_path / "a")
    (tmp_path / "away").symlink_to(tmp_path / "deep")
    (tmp_path / "empty").mkdir()
    assert unknown_files(tmp_path, ours.__contains__) == ["away", "deep/note", "linked"]


def test_a_folder_that_cannot_be_listed_is_not_taken_for_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``os.walk`` and ``Path.glob`` pass over it in silence: scores would be made without what lies in it."""

    def broken(path: object) -> None:
        raise OSError(5, "Input/output error", str(path))

    (tmp_path / "mine.txt").write_text("mine")
    monkeypatch.setattr(os, "scandir", broken)
    monkeypatch.setattr(os, "listdir", broken)
    with pytest.raises(OSError, match="Input/output"):
        unknown_files(tmp_path, lambda path: False)
    with pytest.raises(OSError, match="Input/output"):
        files_below(tmp_path)
    with pytest.raises(OSError, match="Input/output"):
        listed(tmp_path, ".txt")
    monkeypatch.undo()
    assert listed(tmp_path, ".txt") == [tmp_path / "mine.txt"]
    assert listed(tmp_path, ".json") == listed(tmp_path / "nothing") == []


def test_the_first_error_is_raised(tmp_path: Path) -> None:
    """A full disk, say: the folder of the second file is missing."""
    with pytest.raises(RsbenchError, match="lost"), background_writer() as later:
        for name in ("a", "lost/b", "c"):
            later(write_bytes, tmp_path / name, b"1")
    assert "a" in {path.name for path in tmp_path.iterdir()} <= {"a", "c"}


def test_an_error_is_raised_when_more_is_handed_over() -> None:
    """Not when hours of rendering have been for nothing."""
    handed: list[int] = []
    with pytest.raises(ValueError, match="invalid literal"), background_writer() as later:
        for k in range(1000):
            later(int, "no number")
            handed.append(k)
    assert len(handed) < 100


def test_results_are_not_kept() -> None:
    """A sequence of 30 frames would hold gigabytes."""
    with background_writer() as later:
        results = [weakref.ref(later(_Large).result()) for _ in range(50)]
        later(int, "1").result()
        gc.collect()
        assert sum(each() is not None for each in results) <= 1


def test_a_slow_disk_holds_the_renderer_up() -> None:
    """What waits has arrays: there must not be more and more of it."""
    go, most = threading.Event(), 0
    done: list[int] = []

    def write(k: int) -> None:
        assert go.wait(10.0)
        done.append(k)

    with background_writer() as later:
        threading.Timer(0.2, go.set).start()
        for k in range(40):
            later(write, k)
            most = max(most, k + 1 - len(done))
    assert len(done) == 40 and most <= 8


class _Large:
    pass


def test_results_come_in_order_and_few_are_ahead() -> None:
    lock, begun_by_now, taken, ahead = threading.Lock(), 0, 0, 0

    def work(k: int) -> int:
        nonlocal begun_by_now, ahead
        with lock:
            begun_by_now += 1
            ahead = max(ahead, begun_by_now - taken)
        return k * k

    with background_writer() as later:
        for k, result in enumerate(begun(later, work, range(20))):
            assert result == k * k
            with lock:
                taken += 1
    assert taken == 20 and ahead <= 3
