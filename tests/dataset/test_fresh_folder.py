"""Where ``rsbench correct`` writes: the old or the new, and never anything of others."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from commands import rename_failing

from rsbench.core.errors import RsbenchError
from rsbench.dataset.corrected_frames import fresh_folder, video_place


def write(out: Path, text: str) -> None:
    with fresh_folder(out) as folder:
        (folder / "mask").mkdir()
        (folder / "mask/left_0.png").write_text(text)
        (folder / "motion.json").write_text(text)


def texts(out: Path) -> dict[str, str]:
    paths = (path for path in out.rglob("*") if path.is_file())
    return {path.relative_to(out).as_posix(): path.read_text() for path in paths if path.name != "files.json"}


FIRST = {"mask/left_0.png": "first", "motion.json": "first"}
SECOND = {"mask/left_0.png": "second", "motion.json": "second"}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    write(tmp_path / "out", "first")
    return tmp_path / "out"


def test_the_new_takes_the_place_of_the_old(out: Path) -> None:
    (out / "mask/left_0.png").rename(out / "gone")
    (out / "gone").unlink()
    write(out, "second")
    assert texts(out) == SECOND
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_an_empty_folder_and_one_behind_a_link_are_taken(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write(tmp_path / "link", "first")
    write(tmp_path / "link", "second")
    assert texts(tmp_path / "real") == SECOND and (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("where", ["notes.txt", "mask/notes.txt", "mask/link"])
def test_a_file_of_the_users_beside_ours_is_not_lost(out: Path, tmp_path: Path, where: str) -> None:
    if where == "mask/link":
        (out / where).symlink_to(tmp_path)
    else:
        (out / where).write_text("mine")
    with pytest.raises(RsbenchError, match=f"holds {where}, which 'rsbench correct' did not write; move it away"):
        write(out, "second")
    assert (out / where).exists() and FIRST.items() <= texts(out).items()


def test_a_file_that_comes_meanwhile_is_not_lost(out: Path) -> None:
    with pytest.raises(RsbenchError, match="holds notes"), fresh_folder(out):
        (out / "notes").write_text("mine")
    assert texts(out) == {**FIRST, "notes": "mine"}


def test_a_folder_with_a_motion_file_of_others_is_not_ours(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/motion.json").write_text("{}")
    with pytest.raises(RsbenchError, match="was not written by 'rsbench correct'"):
        write(tmp_path / "out", "first")
    assert texts(tmp_path / "out") == {"motion.json": "{}"}


def test_a_deleted_video_is_written_again_and_files_of_others_stay(tmp_path: Path) -> None:
    video, record = tmp_path / "out.mp4", tmp_path / "out.json"
    record.write_text('{"video": "out.mp4"}')
    with video_place(video):
        pass
    record.write_text("{}")
    with pytest.raises(RsbenchError, match=r"out\.json: exists and is no record of out\.mp4"), video_place(video):
        pass
    record.unlink()
    video.write_text("mine")
    with pytest.raises(RsbenchError, match=r"out\.mp4: exists and was not written by"), video_place(video):
        pass
    assert texts(tmp_path) == {"out.mp4": "mine"}


def test_two_commands_do_not_share_a_folder(out: Path) -> None:
    with fresh_folder(out) as folder:
        (folder / "motion.json").write_text("first of two")
        with pytest.raises(RsbenchError, match=f"process {os.getpid()} on .* is at work there"):
            write(out, "second of two")
    assert texts(out) == {"motion.json": "first of two"}


@pytest.mark.parametrize("name", [".", "..", "../sub"])
def test_the_working_folder_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "sub")
    with pytest.raises(RsbenchError, match="this command runs there"):
        write(Path(name), "first")
    assert (tmp_path / "sub").is_dir()


@pytest.mark.parametrize("failing", [1, 2])
def test_a_failure_between_the_old_and_the_new_leaves_the_old(
    out: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    monkeypatch.setattr(os, "rename", rename_failing(lambda call: call == failing))
    with pytest.raises(OSError, match="Input"):
        write(out, "second")
    assert texts(out) == FIRST


class KilledError(BaseException):
    """What a kill leaves, as after ``os._exit``: nothing is put in order."""


@pytest.mark.parametrize("killed_after", [0, 1, 2])
def test_a_kill_between_the_old_and_the_new_leaves_one_of_them(
    out: Path, monkeypatch: pytest.MonkeyPatch, killed_after: int
) -> None:
    def stop(path: Path) -> None:
        if path.exists():
            raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", rename_failing(lambda call: call > killed_after, KilledError()))
        patch.setattr("rsbench.storage.work_folder._leave", lambda hidden, descriptor, fresh: os.close(descriptor))
        patch.setattr("rsbench.dataset.corrected_frames.remove", stop)
        with pytest.raises(KilledError):
            write(out, "second")
    with pytest.raises(RuntimeError), fresh_folder(out):
        raise RuntimeError
    assert texts(out) == (SECOND if killed_after == 2 else FIRST)
    assert [path.name for path in out.parent.iterdir()] == ["out"]
