"""Mutated inputs through every loader: each is read, or refused in one line that names the file.

First each loader meets what is no regular file in place of its own, and valid files that hold too much.

Loaders run in forked children of limited memory; one that crashes or hangs is named by the number of its input.
Input ``number`` of a loader is the same in every run with the same seed.
"""

from __future__ import annotations

import contextlib
import math
import os
import resource
import select
import signal
import socket
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import numpy as np
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from attack.cases import Tally
from attack.loaders import Loader, broken

HANG_S = 20.0
MEMORY_MB = 2048
BLOCK = 50
"""Inputs of one child; those of a block are all changed bytes or all broken trees."""

_BESIDE = "a-pipe"


def _bind(path: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as bound:  # a name of 108 bytes at most
        bound.bind(path.name)


def _link_to_pipe(path: Path) -> None:
    os.mkfifo(path.with_name(_BESIDE))
    path.symlink_to(_BESIDE)


STRANGE: tuple[Callable[[Path], object], ...] = (
    os.mkfifo,
    _link_to_pipe,
    _bind,
    Path.mkdir,
    lambda path: path.symlink_to("/dev/zero"),
)
"""What makes something else than a regular file."""


def attack(loaders: list[Loader], count: int, seed: int, keep: Path) -> Tally:
    """``count`` inputs or a few more; those at fault are left in ``keep``."""
    tally = Tally()
    weights = [0.1 if loader.slow else 1.0 for loader in loaders]
    for loader, weight in zip(loaders, weights, strict=True):
        share, special = math.ceil(count * weight / sum(weights)), len(STRANGE) + len(loader.huge)
        _block(loader, -special, special, seed, keep, tally)
        for first in range(0, share, BLOCK):
            _block(loader, first, min(BLOCK, share - first), seed, keep, tally)
    return tally


def _block(loader: Loader, first: int, size: int, seed: int, keep: Path, tally: Tally) -> None:
    """Run one block in children; after a crash or a hang the next child goes on behind it."""
    done = 0
    while done < size:
        before = done
        for word, text in _messages(loader, first, size, done, seed, keep):
            if word == "at":
                done = int(text) + 1
                continue
            tally.count(word)
            tally.count("inputs")
            tally.check(
                word in ("read", "refused"), f"{loader.name}, input {first + done - 1} of seed {seed}: {text}"
            )
        if done == before:  # as where a loader has no seeds
            raise RuntimeError(f"{loader.name}: the child reported nothing about input {first + done}")


def _messages(
    loader: Loader, first: int, size: int, done: int, seed: int, keep: Path
) -> Iterator[tuple[str, str]]:
    """What a child says of the inputs from ``done`` on, up to its end."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _serve(loader, first, size, done, seed, keep, writer)
    os.close(writer)
    pending, closed, reported = b"", False, True
    while not closed:
        ready, _, _ = select.select([reader], (), (), HANG_S)
        if not ready:
            os.kill(pid, signal.SIGKILL)
            yield "hung", f"longer than {HANG_S:g} s"
            reported = True
            break
        part = os.read(reader, 65536)
        closed = not part
        *lines, pending = (pending + part).split(b"\n")
        for line in lines:
            word, _, text = line.decode("utf-8", errors="replace").partition(" ")
            reported = word != "at"
            yield word, text
    os.close(reader)
    _, status = os.waitpid(pid, 0)
    if not reported:
        yield "crashed", f"exit code {os.waitstatus_to_exitcode(status)}"


def _serve(loader: Loader, first: int, size: int, done: int, seed: int, keep: Path, writer: int) -> None:
    """In the child: read every input of the block from ``done`` on, and tell of each."""
    try:
        os.setsid()
        null = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(null, number)
        _limit_memory()
        warnings.simplefilter("ignore")
        for number, data in _inputs(loader, first, size, seed):
            if number < done:
                continue
            os.write(writer, f"at {number}\n".encode())
            word, text = _outcome(loader, data)
            if word not in ("read", "refused") and isinstance(data, bytes):
                name = f"{loader.name.replace(' ', '-')}-{seed}-{first + number}{loader.path.suffix}"
                (keep / name).write_bytes(data)
            os.write(writer, f"{word} {' '.join(text.split())}\n".encode())
    finally:
        os._exit(0)


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_MB * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _inputs(
    loader: Loader, first: int, size: int, seed: int
) -> list[tuple[int, bytes | Callable[[Path], object]]]:
    """The inputs of a block, with their numbers in it; those before the first one are not drawn."""
    if first < 0:
        return list(enumerate((*STRANGE, *loader.huge)))
    rng = np.random.default_rng([seed, zlib.crc32(loader.name.encode()), first])
    if loader.trees and (first // BLOCK) % 2 == 1:
        return list(enumerate(_broken_trees(loader, size, int(rng.integers(2**31)))))
    out: list[tuple[int, bytes | Callable[[Path], object]]] = []
    for number in range(size):
        data = loader.seeds[int(rng.integers(len(loader.seeds)))]
        out.append((number, loader.change(data, loader.seeds, rng)))
    return out


def _broken_trees(loader: Loader, size: int, seed: int) -> list[bytes]:
    found: list[bytes] = []

    @hypothesis.seed(seed)
    @settings(
        max_examples=size,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @given(st.sampled_from(loader.trees).flatmap(broken))
    def collect(tree: object) -> None:
        with contextlib.suppress(ValueError, TypeError):  # surrogates, and what no TOML can say
            found.append(loader.write(tree).encode())

    collect()
    return found


def _put(path: Path, data: bytes | Callable[[Path], object]) -> None:
    """Write a file, or make something else, in place of what lies there."""
    path.with_name(_BESIDE).unlink(missing_ok=True)
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
    if isinstance(data, bytes):
        path.write_bytes(data)
    else:
        data(path)


def _outcome(loader: Loader, data: bytes | Callable[[Path], object]) -> tuple[str, str]:
    """How a loader takes an input: read, refused, or at fault."""
    from rsbench.core.errors import RsbenchError

    _put(loader.path, data)
    start = time.monotonic()
    try:
        loader.load(loader.path)
    except RsbenchError as error:
        text = str(error)
        named = any(name in text for name in (loader.path.name, loader.path.parent.name))
        return ("refused", "") if named else ("nameless", f"does not name the file: {text[:200]}")
    except BaseException as error:
        return "raised", f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.monotonic() - start
    return ("read", "") if seconds < HANG_S else ("slow", f"{seconds:.0f} s")
