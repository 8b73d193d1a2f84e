"""The commands under attack, each with the smallest input that uses all of it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from attack.arena import Arena, Ending, Trap, contents, set_trap


def keep_frames(folder: Path) -> None:
    """From now on this process keeps what it renders in ``folder``."""
    from rsbench.renderers import backend, render

    rendered = render.render
    folder.mkdir(exist_ok=True)

    def keep(scene: Any, camera: Any, poses: Any, options: Any, **more: Any) -> Any:
        frame = rendered(scene, camera, poses, options, **more)
        np.savez(_path(folder, camera, poses, options), **vars(frame))
        (folder / "variant").write_text(backend.start_backend().variant)
        return frame

    setattr(render, "render", keep)  # noqa: B010  an assignment has the wrong type


def show_frames(folder: Path) -> None:
    """From now on this process renders nothing: it takes what ``keep_frames`` left.

    A frame that was not kept raises ``FileNotFoundError``.
    """
    from rsbench.renderers import backend, render, scene, visibility

    def show(_: Any, camera: Any, poses: Any, options: Any, **more: Any) -> Any:
        with np.load(_path(folder, camera, poses, options)) as kept:
            return render.Frame(**kept)

    started = backend.Backend(variant=(folder / "variant").read_text())
    backend.start_backend = lambda *_, **__: started
    visibility.obstacle = lambda *_, **__: ""  # it was looked for when the frames were rendered
    scene.MitsubaScene = lambda built, *_: SimpleNamespace(glossy=built.glossy)  # pyrefly: ignore[bad-assignment]
    setattr(render, "render", show)  # noqa: B010  an assignment has the wrong type


def _path(folder: Path, camera: Any, poses: Any, options: Any) -> Path:
    digest = hashlib.sha256(f"{camera} {options}".encode())
    for values in (poses.R, poses.t):
        digest.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return folder / f"{digest.hexdigest()}.npz"


FRAMES = tuple(f"one/rs/{side}_{frame}.png" for frame in (0, 1) for side in ("left", "right"))


@dataclass(frozen=True, kw_only=True)
class Case:
    """A command whose results lie in work/out."""

    name: str
    arguments: tuple[object, ...]
    children: bool = False
    """Whether its work is done in child processes; ``here`` then takes it into its own, where operations count."""


@dataclass
class Reference:
    """What a command does undisturbed."""

    seconds: float
    contents: dict[str, str]
    operations: list[str]
    """File operations, in their order."""


@dataclass
class Tally:
    """Counts of an attack, and what went wrong, each with what repeats it."""

    counts: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    def count(self, name: str, by: int = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + by

    def check(self, passed: bool, fault: str) -> None:
        if not passed:
            self.faults.append(" ".join(fault.split())[:400])


def commands(inputs: Path, data: Path, out: object) -> dict[str, tuple[object, ...]]:
    """The arguments of commands whose results lie in ``out``."""
    frames = [data / frame for frame in FRAMES]
    return {
        "generate": ("generate", inputs / "tiny.toml", "--out", out),
        "evaluate": ("evaluate", data, "--out", out, "--solver", "gs-8pt"),
        "simulate": ("simulate", inputs / "sweep.toml", "--out", out, "--workers", 2),
        "correct": ("correct", *frames, "--rig", inputs / "rig.toml", "--out", out),
        "reproduce": ("reproduce", "images", "--out", f"{out}/results", "--data", f"{out}/data", "--seeds", 1),
    }


def cases(arena: Arena) -> dict[str, Case]:
    known = commands(arena.inputs, arena.inputs / "data", "out")
    return {name: Case(name=name, arguments=each, children=name == "simulate") for name, each in known.items()}


def undisturbed(arena: Arena, case: Case) -> Reference:
    """Run a command twice, whole and with its work in one process, and keep what it makes.

    Raises:
        RuntimeError: it fails, or the two differ.
    """
    results = []
    for prepare in (partial(keep_frames, frames_of(arena)), partial(here, arena, case, Trap())):
        place(arena)
        start = time.monotonic()
        ending = arena.run(("--quiet", *case.arguments), before=prepare)
        if ending.code or ending.orphans:
            raise RuntimeError(f"{case.name} undisturbed: exit code {ending.code}, {ending.err[-2000:]}")
        results.append((time.monotonic() - start, contents(arena.work / "out")))
    if results[0][1] != results[1][1]:
        raise RuntimeError(f"{case.name}: two runs differ in {differing(results[0][1], results[1][1])}")
    return Reference(seconds=results[0][0], contents=results[0][1], operations=operations_of(arena))


def place(arena: Arena) -> None:
    """A fresh start: nothing but files of somebody else beside the results."""
    arena.clear()
    mine = arena.work / "precious"
    mine.mkdir()
    (mine / "motion.json").write_text("{}")
    (mine / "notes.txt").write_text("not to be lost")
    (arena.work / ".hidden").write_text("nor this")


def frames_of(arena: Arena) -> Path:
    return arena.root / "home" / ".frames"


def log_of(arena: Arena) -> Path:
    return arena.root / "home" / ".operations"


def operations_of(arena: Arena) -> list[str]:
    """The operations that were counted."""
    return log_of(arena).read_text("utf-8").splitlines()


def here(arena: Arena, case: Case, trap: Trap) -> None:
    """In the child of the arena: count operations, with all work in this process and nothing rendered."""
    if case.children:
        work_here()
    if case.name in ("generate", "reproduce"):
        show_frames(frames_of(arena))
    set_trap((arena.inputs, arena.work, arena.root / "tmp"), log_of(arena), trap)


def work_here() -> None:
    """Let sweeps run in this process, not in children."""
    from rsbench.benchmark.simulated import run_sweep
    from rsbench.pipeline.isolated_components import SolverRunner

    def run_all(todo: Any, workers: int, limit: float | None) -> Iterator[Any]:
        with SolverRunner() as runner:
            for job in todo:
                run_sweep.run_job(job, runner)
                yield job.part

    setattr(run_sweep, "_run_all", run_all)  # noqa: B010  an assignment has the wrong type


def problem_of(ending: Ending) -> str:
    """What no ending may be, in words; empty for none."""
    words = []
    if ending.traceback:
        words.append(f"traceback: {ending.err[-300:]}")
    if ending.hung:
        words.append("hung")
    if ending.orphans:
        words.append(f"{ending.orphans} orphans")
    if ending.peak_mb > 2048:
        words.append(f"{ending.peak_mb:.0f} MB")
    return "; ".join(words)


def differing(one: dict[str, str], other: dict[str, str]) -> str:
    """Names of what differs between two folders."""
    names = sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
