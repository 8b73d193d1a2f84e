"""Setting the stage: a tiny checkout, an arena with inputs, and everything imported and compiled once."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from attack.arena import Arena


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


_ONE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def stage(root: Path, cases: Collection[str]) -> Iterator[Arena]:
    """An arena below ``root`` with a rendered dataset, in a process that has not imported rsbench yet.

    ``cases`` names the commands that will be run.
    """
    if "rsbench" in sys.modules:
        raise RuntimeError("rsbench is imported already, and not from the tiny checkout")
    if (
        signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    ):  # started in the background of a shell without job control
        signal.signal(signal.SIGINT, signal.default_int_handler)  # or no command would hear of it
    os.environ |= dict.fromkeys(_ONE, "1")  # a process with threads cannot be forked safely
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(cache) / "rsbench"))  # where rsbench keeps it: homes change
    from attack.tiny import make_checkout, write_inputs

    checkout = make_checkout(root / "checkout")
    sys.path.insert(0, str(checkout))
    os.environ["PYTHONPATH"] = str(checkout)
    import rsbench
    from attack.arena import Arena

    if not Path(rsbench.__file__).is_relative_to(checkout):
        raise RuntimeError(f"{rsbench.__file__} was imported, which has not the tiny cards")

    arena = Arena(root / "arena")
    write_inputs(arena.inputs)
    ending = arena.run(("--quiet", "generate", arena.inputs / "tiny.toml", "--out", arena.inputs / "data"))
    if ending.code:
        raise RuntimeError(f"no data: {ending.err[-2000:]}")
    _warm_up(arena, [name for name in ("evaluate", "correct") if name in cases])
    yield arena


_HARMLESS = "jemalloc_bg_thd\n"
"""Of pyarrow, which datasets brings (make test-extras) and pandas imports: its allocator is made for forks."""


def _warm_up(arena: Arena, names: list[str]) -> None:
    """Run what children will run, so that they need not import and load it."""
    import cv2

    from attack.arena import command
    from attack.cases import cases

    cv2.setNumThreads(1)
    folder, log = os.getcwd(), arena.root / "home" / ".warm-up"
    for name in names:
        arena.clear()
        os.chdir(arena.work)
        with _silence(log):
            code = command(["--quiet", *map(str, cases(arena)[name].arguments)], None)
        if code:
            raise RuntimeError(f"{name} fails: {log.read_text('utf-8', errors='replace')[-2000:]}")
    os.chdir(folder)
    end = time.monotonic() + 10.0
    while (threads := sum(name.read_text() != _HARMLESS for name in Path("/proc/self/task").glob("*/comm"))) > 1:
        if time.monotonic() > end:
            raise RuntimeError(f"{threads} threads: forks may hang")
        time.sleep(0.01)


@contextmanager
def _silence(log: Path) -> Iterator[None]:
    """What is written to standard output and error goes to a file."""
    kept = [os.dup(number) for number in (1, 2)]
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        for number in (1, 2):
            os.dup2(handle, number)
        yield
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        for number, old in zip((1, 2), kept, strict=True):
            os.dup2(old, number)
            os.close(old)
        os.close(handle)
