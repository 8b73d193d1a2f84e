"""Fixtures that several parts share, and how two processes share the tests."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from skips import SkipReport

from rsbench.components.imports import import_untried
from rsbench.storage.work_folder import temporary, user_cache

if TYPE_CHECKING:
    from rsbench.dataset.card import DatasetCard
    from rsbench.dataset.sequence import Sequence
    from rsbench.scenes.model import Scene

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell without job control: the commands that tests interrupt would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Before Numba reads it: tests, and what they start, share compiled code also where they move the user's cache.
os.environ.setdefault("NUMBA_CACHE_DIR", str(user_cache() or temporary()))

# The same examples in every run, so that a change fails by what it broke alone: `--hypothesis-profile=drawn` draws
# others. No deadlines: the first example of a test may compile or import what the others use.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("drawn", deadline=None)
settings.load_profile("same")

# Modules that tests write are not tried in a process of their own first, which takes half a second for each. The
# command line, which tests start as others do, does it.
import_untried()

LARGE_SCENES = (
    "test_installed_wheel.py",
    "test_built_scenes.py",
    "test_paper_sequences.py",
)
"""Files that hold a built-in scene, or start what does, 1 to 2 GB: one process runs them, in this order.

So each scene is built once, and those of child processes do not lie beside its own.
"""


def pytest_configure(config: pytest.Config) -> None:
    """The process that reports tells the skips of all."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(SkipReport())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with many slow tests come first, after large scenes, so that no process works alone at the end."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))

    def place(item: pytest.Item) -> tuple[int, int]:
        name = item.path.name
        return LARGE_SCENES.index(name) if name in LARGE_SCENES else len(LARGE_SCENES), -slow[item.path]

    items.sort(key=place)


def pytest_collection_finish(session: pytest.Session) -> None:
    """What importing and collecting made stays: looking through it for garbage again and again takes long."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 10)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Whole files go to a process, as their fixtures are made once there."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = str(super()._split_scope(nodeid))
            return "large scenes" if file.endswith(LARGE_SCENES) else file

    return Scheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk() -> Iterator[None]:
    """What tests write need not outlive a loss of power: waiting for that takes a tenth of their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session")
def give_back() -> Callable[[], None]:
    """Returns to the system what is free: the allocator keeps up to a GB between the pieces that are in use."""

    def trim() -> None:
        gc.collect()
        if sys.platform == "linux":
            with contextlib.suppress(OSError, AttributeError):  # another C library
                ctypes.CDLL(None).malloc_trim(0)

    return trim


@pytest.fixture(scope="module", autouse=True)
def _give_back_after_large_scenes(request: pytest.FixtureRequest, give_back: Callable[[], None]) -> Iterator[None]:
    yield
    if request.path.name in LARGE_SCENES:
        give_back()


@pytest.fixture(scope="session")
def built_scene() -> Callable[[str], Scene]:
    """``load_scene`` with the last one kept: hundreds of MB."""
    from rsbench.scenes.load import load_scene

    return lru_cache(maxsize=1)(load_scene)


@pytest.fixture(scope="module")
def scenes_once(built_scene: Callable[[str], Scene], give_back: Callable[[], None]) -> Iterator[None]:
    """Sequences of one scene of ours, seen from one place, share it in the renderer: loading it takes seconds."""
    from kept_scenes import kept_scenes

    from rsbench.components.cards import list_cards
    from rsbench.scenes.load import load_scene

    def loaded(card: str | Path) -> Scene:
        ours = list_cards("scenes").get(Path(card).stem)
        return built_scene(ours.stem) if ours and str(card) in (ours.stem, str(ours)) else load_scene(card)

    with kept_scenes(loaded):
        yield
    give_back()


@pytest.fixture(scope="session")
def smoke_dataset(tmp_path_factory: pytest.TempPathFactory, built_scene: Callable[[str], Scene]) -> Path:
    """The dataset of the card ``smoke``, rendered once per test run, by whichever process needs it first."""
    # Imported here, so that a broken part does not stop the tests of the others.
    from rsbench.dataset import generation
    from rsbench.dataset.card import load_dataset_card

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "smoke"
    with _alone(folder.with_suffix(".lock")), pytest.MonkeyPatch.context() as patch:
        if not (folder / "dataset.json").exists():
            patch.setattr(generation, "load_scene", built_scene)
            generation.generate_dataset(load_dataset_card("smoke"), folder)
    return folder


@pytest.fixture(scope="session")
def castle(smoke_dataset: Path) -> Sequence:
    """Its first sequence: 128 x 96 px, 1.5 deg and 0.2 m per frame."""
    from rsbench.dataset.sequence import read_dataset

    return read_dataset(smoke_dataset)[0]


@pytest.fixture(scope="session")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> DatasetCard:
    """Two small sequences, a and b, each of a box."""
    from small_scenes import write_box_scene, write_small_card

    from rsbench.dataset.card import load_dataset_card

    folder = tmp_path_factory.mktemp("card")
    return load_dataset_card(str(write_small_card(folder, [write_box_scene(folder, name) for name in "ab"])))


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An empty store in memory, and no memory of any other."""
    import fsspec

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    store: Any = fsspec.filesystem("memory")

    def empty() -> None:
        store.store.clear()
        store.pseudo_dirs[:] = [""]

    empty()
    yield store
    empty()


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """While this lasts no other process is in here with the same file; the system frees it when a process ends."""
    with path.open("w") as file:
        if os.name == "posix":
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield
