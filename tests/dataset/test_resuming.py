"""What a second run keeps, reads and replaces; nothing that is not rsbench's own is lost."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from commands import rename_failing, run_here

from rsbench.core.errors import RsbenchError
from rsbench.dataset import generation
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.manifest import SceneHashes, scene_key
from rsbench.jobs.process_jobs import LostJobsError
from rsbench.storage import files
from rsbench.storage.files import FileHashes, sha256
from rsbench.storage.work_folder import work_folder


@pytest.fixture(scope="module")
def dataset(boxes: DatasetCard, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("resuming") / "dataset"
    generate_dataset(boxes, out)
    return out


@pytest.fixture
def copy(dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are hashed from now on."""
    names: list[str] = []

    def counted(path: Path) -> str:
        names.append(path.name)
        return sha256(path)

    monkeypatch.setattr(files, "sha256", counted)
    return names


# What is read


def test_only_what_changed_is_read_again(boxes: DatasetCard, copy: Path, read: list[str]) -> None:
    manifest = (copy / "dataset.json").read_bytes()
    assert generate_dataset(boxes, copy) == []
    assert len(read) == 2 * 21  # a copy has other times: each file once, not twice
    read.clear()
    assert generate_dataset(boxes, copy) == []
    assert read == []
    os.utime(copy / "a/rs/left_0.png")
    assert generate_dataset(boxes, copy) == []
    assert read == ["left_0.png"]
    read.clear()
    assert generate_dataset(boxes, copy, rehash=True) == []
    assert len(read) == 2 * 21 and (copy / "dataset.json").read_bytes() == manifest


def test_what_was_rendered_is_not_read_to_resume(boxes: DatasetCard, tmp_path: Path, read: list[str]) -> None:
    generate_dataset(boxes.only(["a"]), tmp_path)
    assert generate_dataset(boxes.only(["a"]), tmp_path) == []
    assert read == []


def test_a_change_that_keeps_size_and_time_is_seen(boxes: DatasetCard, copy: Path) -> None:
    """By the time of the change itself, which no tool can set."""
    generate_dataset(boxes, copy)
    file = copy / "a/rs/left_0.png"
    found, content = file.stat(), bytearray(file.read_bytes())
    content[-20] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(found.st_atime_ns, found.st_mtime_ns))
    assert generate_dataset(boxes, copy) == ["a"]


def test_a_cut_line_of_the_kept_hashes_costs_one_reading(tmp_path: Path, read: list[str]) -> None:
    (tmp_path / "x").write_text("x")
    (tmp_path / "y").write_text("y")
    kept = FileHashes(tmp_path, tmp_path / "file_hashes.jsonl")
    first = [kept.of("x"), kept.of("y")]
    kept.flush()
    whole = (tmp_path / "file_hashes.jsonl").read_bytes()
    (tmp_path / "file_hashes.jsonl").write_bytes(whole[:-9])
    read.clear()
    again = FileHashes(tmp_path, tmp_path / "file_hashes.jsonl")
    assert [again.of("x"), again.of("y")] == first and read == ["y"]
    again.flush()
    read.clear()
    last = FileHashes(tmp_path, tmp_path / "file_hashes.jsonl")
    assert [last.of("x"), last.of("y"), last.of("none")] == [*first, None] and read == []


# Scenes


def test_a_built_in_scene_is_not_built_again_to_know_it(tmp_path: Path) -> None:
    built: list[str] = []

    def build(name: str) -> str:
        built.append(name)
        return f"hash of {name}"

    for _ in range(2):
        known = SceneHashes(tmp_path / "scenes.json", build)
        for name in ("castle", "room", "castle"):
            assert known.of(name) == f"hash of {name}"
    assert built == ["castle", "room"]


def test_a_scene_of_files_or_of_others_is_built_again(boxes: DatasetCard, tmp_path: Path) -> None:
    assert scene_key(boxes.sequence[0].scene) is None
    (tmp_path / "heap.py").write_text(
        "from dataclasses import dataclass\nfrom rsbench.scenes.model import SceneBuilder\n"
        "@dataclass(frozen=True)\nclass Heap(SceneBuilder):\n    def build(self, seed, folder): ..."
    )
    theirs = tmp_path / "heap.toml"
    theirs.write_text(
        'name = "heap"\nbuilder = "heap:Heap"\n'
        "[viewpoints.default]\neye = [0.0, 0.0, 1.0]\ntarget = [0.0, 9.0, 1.0]"
    )
    assert scene_key(str(theirs)) is None
    assert scene_key("castle") == scene_key("castle") != scene_key("room")


def test_a_changed_card_is_another_scene(tmp_path: Path) -> None:
    from rsbench.components.cards import card_path

    text = card_path("scenes", "room").read_text()
    same, other = tmp_path / "same.toml", tmp_path / "other.toml"
    same.write_text(text)
    other.write_text(text.replace("seed = ", "seed = 1", 1) if "seed = " in text else "seed = 5\n" + text)
    assert scene_key(str(same)) == scene_key("room") != scene_key(str(other))


# What is removed


def test_a_file_of_the_users_in_a_damaged_sequence_is_not_lost(boxes: DatasetCard, copy: Path) -> None:
    (copy / "a/rs/left_0.png").write_bytes(b"damaged")
    (copy / "a/notes.txt").write_text("mine")
    with pytest.raises(RsbenchError, match=r"a: rs/left_0.png differs .* but notes.txt is not rsbench's: move it"):
        generate_dataset(boxes, copy)
    assert (copy / "a/notes.txt").read_text() == "mine" and (copy / "a/rs/left_0.png").read_bytes() == b"damaged"
    (copy / "a/notes.txt").unlink()
    assert generate_dataset(boxes, copy) == ["a"]


def test_a_file_that_comes_while_rendering_is_not_lost(boxes: DatasetCard, copy: Path) -> None:
    (copy / "a/rs/left_0.png").write_bytes(b"damaged")

    def write(name: str) -> None:
        (copy / "a/notes.txt").write_text("mine")

    with pytest.raises(RsbenchError, match=r"it is to be replaced, but notes\.txt is not rsbench's"):
        generate_dataset(boxes, copy, progress=write)
    assert (copy / "a/notes.txt").read_text() == "mine"


def test_folders_that_rsbench_did_not_make_stay(boxes: DatasetCard, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a/thesis.tex").write_text("mine")
    (tmp_path / ".b.partial").mkdir()
    (tmp_path / ".b.partial/thesis.tex").write_text("mine")
    with pytest.raises(RsbenchError, match=r"a: holds no sequence.json, so rsbench did not make it; move it away"):
        generate_dataset(boxes, tmp_path)
    assert (tmp_path / "a/thesis.tex").exists() and (tmp_path / ".b.partial/thesis.tex").exists()


def test_a_damaged_sequence_behind_a_link_stays(boxes: DatasetCard, copy: Path, tmp_path: Path) -> None:
    (copy / "a").rename(tmp_path / "elsewhere")
    (copy / "a").symlink_to(tmp_path / "elsewhere")
    assert generate_dataset(boxes, copy) == []
    (tmp_path / "elsewhere/rs/left_0.png").write_bytes(b"damaged")
    with pytest.raises(RsbenchError, match="and it is a link: move it away"):
        generate_dataset(boxes, copy)
    assert len(list((tmp_path / "elsewhere").rglob("*.png"))) == 8


def test_stopped_between_the_old_and_the_new_it_goes_on(
    boxes: DatasetCard, copy: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (copy / "a/rs/left_0.png").write_bytes(b"damaged")
    monkeypatch.setattr(os, "rename", rename_failing(lambda call: call == 2))
    with pytest.raises(OSError):
        generate_dataset(boxes, copy)
    monkeypatch.undo()
    assert not (copy / "a").exists()
    assert generate_dataset(boxes, copy) == ["a"]
    assert (copy / "dataset.json").read_bytes() == (dataset / "dataset.json").read_bytes()


# Together with others


def test_two_commands_do_not_share_a_folder(boxes: DatasetCard, copy: Path) -> None:
    with work_folder(copy), pytest.raises(RsbenchError, match=f"process {os.getpid()} on .* is at work there"):
        generate_dataset(boxes, copy)


def test_lost_jobs_end_a_command_with_code_1(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def lose(*arguments: object, **options: object) -> None:
        raise LostJobsError("not done: sequence a (killed by signal 9 (SIGKILL), 3 times)")

    monkeypatch.setattr(generation, "generate_dataset", lose)
    result = run_here("generate", "smoke", "--out", tmp_path)
    assert result.returncode == 1 and "sequence a (killed by signal 9 (SIGKILL), 3 times)" in result.stderr
