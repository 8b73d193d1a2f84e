"""Datasets on a store in memory: the bytes of a folder, whatever is stopped, lost or refused there."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import assert_refused, bytes_below, run_here

from rsbench.core.errors import RsbenchError
from rsbench.dataset import generation
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.destinations import open_destination
from rsbench.dataset.generation import Built, generate_dataset
from rsbench.renderers import scene, visibility
from rsbench.storage.object_store import Store, path_or_url
from rsbench.storage.work_folder import HIDDEN

fsspec = pytest.importorskip("fsspec", reason="needs rsbench[cloud]")
URL = "memory://bucket/small"


@pytest.fixture(scope="module")
def dataset(boxes: DatasetCard, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a dataset that was rendered to a folder."""
    out = tmp_path_factory.mktemp("stores") / "dataset"
    generate_dataset(boxes, out)
    return bytes_below(out, HIDDEN)


@pytest.fixture
def quick(dataset: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are those of the folder, and are not rendered again."""

    def render(*arguments: Any) -> Iterator[None]:
        side, frame, folder = arguments[4:7]
        for path, data in dataset.items():
            name, _, file = path.partition("/")
            if folder.name.startswith(f"{name}.") and Path(file).stem == f"{side}_{frame}":
                (folder / file).write_bytes(data)
        yield
        yield

    hashes = {name: json.loads(dataset[f"{name}/sequence.json"])["scene"]["sha256"] for name in "ab"}
    nothing: Any = SimpleNamespace(viewpoints={"default": None}, seen_from=lambda *place: None)
    monkeypatch.setattr(generation, "build_scene", lambda name: Built(nothing, hashes[Path(name).stem]))
    monkeypatch.setattr(generation, "render_camera", render)
    monkeypatch.setattr(visibility, "obstacle", lambda *moving: "")
    monkeypatch.setattr(scene, "MitsubaScene", lambda scene: SimpleNamespace(glossy=False))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the objects that are read from now on."""
    paths: list[str] = []
    real = Store.read

    def noted(self: Store, some: Iterable[str], *more: int, **options: int) -> Iterator[tuple[str, bytes]]:
        some = list(some)
        paths.extend(some)
        return real(self, some, *more, **options)

    monkeypatch.setattr(Store, "read", noted)
    return paths


def stored(memory: Any) -> dict[str, bytes]:
    return {path.removeprefix("/bucket/small/"): memory.cat(path) for path in memory.find("/bucket/small")}


# What is there, and what is read


def test_a_store_gets_the_bytes_of_a_folder(boxes: DatasetCard, dataset: dict[str, bytes], memory: Any) -> None:
    assert generate_dataset(boxes, URL) == ["a", "b"]
    assert len(dataset) == 44 and stored(memory) == dataset


@pytest.mark.usefixtures("quick")
def test_a_second_run_lists_and_reads_one_object(boxes: DatasetCard, memory: Any, read: list[str]) -> None:
    generate_dataset(boxes, URL)
    read.clear()
    assert generate_dataset(boxes, URL) == [] and read == ["dataset.json"]
    assert generate_dataset(boxes, URL, rehash=True) == [] and len(set(read)) == 43


@pytest.mark.usefixtures("quick")
def test_another_machine_reads_each_sequence_once(
    boxes: DatasetCard, dataset: dict[str, bytes], memory: Any, read: list[str], tmp_path: Path
) -> None:
    generate_dataset(boxes, URL)
    shutil.rmtree(tmp_path / "cache")
    read.clear()
    assert generate_dataset(boxes, URL) == []
    assert sorted(read) == ["a/sequence.json", "b/sequence.json", "dataset.json", "dataset.json"]
    shutil.rmtree(tmp_path / "cache")
    memory.pipe("/bucket/small/a/rs/left_0.png", b"half")  # dataset.json knows its size
    assert generate_dataset(boxes, URL) == ["a"] and stored(memory) == dataset


@pytest.mark.usefixtures("quick", "memory")
def test_nothing_but_what_a_later_run_can_use_stays_here(boxes: DatasetCard, tmp_path: Path) -> None:
    generate_dataset(boxes, URL)
    kept = [path.name for path in (tmp_path / "cache/rsbench/stores").rglob("*") if path.is_file()]
    assert sorted(kept) == ["lock", "objects.jsonl"]


# What is stopped


class _Stop(BaseException):
    """As Ctrl-C: no handler of errors takes it for one."""


@pytest.mark.usefixtures("quick")
def test_stopped_before_any_operation_it_goes_on_to_the_same_bytes(
    boxes: DatasetCard, dataset: dict[str, bytes], memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each operation of a run that also mends a sequence; where a sequence.json is, all of its files are."""
    kind, left = type(memory), [0]

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] == 0:
                raise _Stop
            return real(*arguments, **options)

        return operation

    for name in ("put_file", "cat_file", "find", "rm_file"):
        monkeypatch.setattr(kind, name, counted(getattr(kind, name)))
    for stop in itertools.count(1):
        memory.store.clear()
        generate_dataset(boxes.only(["a"]), URL)
        memory.pipe("/bucket/small/a/rs/left_0.png", b"half")
        left[0] = stop
        try:
            assert generate_dataset(boxes, URL) == ["a", "b"]
        except _Stop:
            there = stored(memory)
            for name in "ab":
                if f"{name}/sequence.json" in there and there.get("a/rs/left_0.png") != b"half":
                    assert {path for path in dataset if path.startswith(name)} <= set(there)
        else:
            break
        generate_dataset(boxes, URL)
        assert stored(memory) == dataset
    assert stop > 40


@pytest.mark.usefixtures("quick")
def test_two_commands_do_not_send_to_one_store(boxes: DatasetCard, memory: Any) -> None:
    with (
        open_destination(URL, 1, False),
        pytest.raises(RsbenchError, match=f"process {os.getpid()} on .* is at work"),
    ):
        generate_dataset(boxes, URL)


# What is damaged, or of others


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("what", ["gone", "cut", "changed"])
def test_what_is_damaged_is_made_again(
    what: str, boxes: DatasetCard, dataset: dict[str, bytes], memory: Any
) -> None:
    generate_dataset(boxes, URL)
    path = "/bucket/small/b/poses/right_1.csv"
    data = memory.cat(path)
    memory.rm(path)
    if what != "gone":
        memory.pipe(path, data[:-7] if what == "cut" else data.replace(b"1", b"2"))
    assert generate_dataset(boxes, URL, rehash=what == "changed") == ["b"]
    assert stored(memory) == dataset


@pytest.mark.usefixtures("quick")
def test_a_dataset_of_another_card_is_refused(boxes: DatasetCard, memory: Any) -> None:
    generate_dataset(boxes, URL)
    before = stored(memory)
    with pytest.raises(
        RsbenchError, match=r"^memory://bucket/small/a: holds a sequence of another card \(differs in"
    ):
        generate_dataset(replace(boxes, baseline=0.4), URL)
    assert stored(memory) == before


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("whole", [True, False])
def test_objects_of_others_are_not_written_over(whole: bool, boxes: DatasetCard, memory: Any) -> None:
    if whole:
        generate_dataset(boxes, URL)
    memory.pipe("/bucket/small/a/thesis.tex", b"mine")
    memory.pipe("/bucket/small/a/rs/left_0.png", b"mine")
    before = stored(memory)
    with pytest.raises(RsbenchError, match=r"small/a: .*thesis\.tex"):
        generate_dataset(boxes, URL)
    assert stored(memory) == before


@pytest.mark.usefixtures("quick")
def test_a_manifest_that_cannot_be_read_is_named(boxes: DatasetCard, memory: Any) -> None:
    memory.pipe("/bucket/small/a/sequence.json", b'{"files": [')
    with pytest.raises(RsbenchError, match=r"small/a/sequence\.json: damaged, or not rsbench's: remove it"):
        generate_dataset(boxes, URL)


# What is no store


def test_a_file_url_is_a_folder(tmp_path: Path) -> None:
    assert path_or_url(f"file://{tmp_path}/x") == tmp_path / "x" and path_or_url("data/x") == Path("data/x")
    assert path_or_url("s3://bucket/x/") == "s3://bucket/x"


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("file://data/x", "must be an absolute path, such as file:///data/x"),
        ("nothing://bucket/x", "nothing://bucket/x: cannot open it: Protocol not known: nothing; choose another"),
        ("simplecache::s3://bucket/x", "must be a plain URL, such as s3://bucket/folder"),
        ("s3://", "must be a plain URL, such as s3://bucket/folder"),
        ("s3://bucket/[x]", "must be a plain URL, such as s3://bucket/folder"),
        ("ftp://me:secret@host::s3://x", "error: ftp://host::s3://x: must be"),
    ],
)
def test_urls_that_cannot_be_taken_are_one_line(out: str, words: str) -> None:
    result = run_here("generate", "smoke", "--out", out)
    assert_refused(result, words)
    assert "secret" not in result.stderr


def test_other_commands_name_the_url_that_they_do_not_take() -> None:
    for command in (("reproduce", "fig3"), ("leaderboard", "export", "points")):
        assert_refused(run_here(*command, "--out", "s3://bucket/x"), "s3://bucket/x: is a URL, which this command")
    assert not Path("s3:").exists()


def test_without_its_packages_a_store_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    assert_refused(run_here("generate", "smoke", "--out", "gs://bucket/x"), "gcsfs", "install the package of this")
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    result = run_here("generate", "smoke", "--out", "s3://bucket/other")
    assert_refused(result, "s3://bucket/other: needs fsspec: pip install 'rsbench[cloud]'")


def test_a_store_in_memory_is_of_one_process(boxes: DatasetCard) -> None:
    with pytest.raises(RsbenchError, match="lives in one process: without --workers and --scheduler"):
        generate_dataset(boxes, URL, workers=2)
