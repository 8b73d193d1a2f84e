"""What many machines would reach with ``rsbench generate``, and what bounds it: by a simulated scheduler.

Measured here, one process of one thread as on a cluster: of each scene of the card, building it on a machine that
has never seen it, having it from the machine's cache, and rendering a sequence; of each sequence, what the command
itself does when it is finished, and of all of them the manifest; of a job, what Dask takes to hand it out. Then
jobs are handed out as ``--scheduler`` hands them out, in the order of scenes, to processes that build or load a
scene when it is another one than before; files go through one storage. Nothing else is simulated: machines are
equal, and none dies.

    python benchmarks/cluster_model.py --measure costs.json       # minutes of a processor; needs distributed
    python benchmarks/cluster_model.py --costs costs.json --seeds 50
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import heapq
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

CARD = "standard"
MACHINES = (1, 2, 5, 10, 20, 50, 100)


class Costs(NamedTuple):
    """Seconds of one process, and bytes."""

    built: dict[str, float]
    """Of a scene that the machine has not, by its name."""
    loaded: dict[str, float]
    """Of one that it has."""
    rendered: dict[str, float]
    """Of a sequence, the mean of its sensors."""
    bytes: float
    """Of a sequence."""
    finished: float
    """Of the command, for each sequence."""
    manifest: float
    """Of the command at the end, for each sequence."""
    handed: float
    """Of scheduler and command, for each job that a cluster is given and answers."""


# Measuring


def measure() -> Costs:
    """All costs on this machine."""
    scenes = _scenes()
    with tempfile.TemporaryDirectory() as cache:
        cold = {scene: _in_child("scene", scene, cache) for scene in scenes}
        warm = {scene: _in_child("scene", scene, cache) for scene in scenes}
    sequences = {scene: _in_child("sequence", scene, "") for scene in scenes}
    finished, manifest = _in_child("many", "", "")
    size = sum(each[1] for each in sequences.values()) / len(sequences)
    return Costs(
        {scene: found[0] for scene, found in cold.items()},
        {scene: found[0] for scene, found in warm.items()},
        {scene: found[0] for scene, found in sequences.items()},
        size,
        finished,
        manifest,
        *_in_child("handed", "", ""),
    )


def _scenes() -> list[str]:
    from rsbench.dataset.card import load_dataset_card

    return sorted({sequence.scene for sequence in load_dataset_card(CARD).sequence})


def _in_child(what: str, scene: str, cache: str) -> list[float]:
    own = {"XDG_CACHE_HOME": cache} if cache else {}
    kernels = {"NUMBA_CACHE_DIR": str(Path(tempfile.gettempdir()) / "rsbench-kernels")}
    command = [sys.executable, __file__, "--child", what, "--scene", scene]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, **own, **kernels}
    )
    sys.stderr.write(f"{what} {scene}: {done.stdout}")
    found: list[float] = json.loads(done.stdout)
    return found


def child(what: str, scene: str) -> list[float]:
    """In a process of its own: what one of the measurements found."""
    if what == "many":
        return list(_command_alone())
    if what == "handed":
        return [_handed()]
    from rsbench.renderers.backend import set_threads, start_backend

    start_backend()
    set_threads(1)
    return [_scene_seconds(scene)] if what == "scene" else list(_sequence(scene))


def _scene_seconds(scene: str) -> float:
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import PosedScenes, build_scene

    sequence = next(each for each in load_dataset_card(CARD).sequence if each.scene == scene)
    begun = time.process_time()
    PosedScenes(build_scene).set_for(sequence)
    return time.process_time() - begun


def _sequence(scene: str) -> tuple[float, float]:
    """Seconds of the processor and bytes of a sequence: the mean of an ideal and of a real one, kernels warm."""
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import generate_dataset
    from rsbench.storage.work_folder import files_below

    card = load_dataset_card(CARD)
    names = [each.name for each in card.sequence if each.scene == scene and "moderate-slow-wide" in each.name]
    with tempfile.TemporaryDirectory() as folder:
        out, ends = Path(folder), list[float]()
        generate_dataset(card.only(names), out / "warm")
        generate_dataset(card.only(names), out / "timed", progress=lambda name: ends.append(time.process_time()))
        size = sum((out / "timed" / name).stat().st_size for name in files_below(out / "timed"))
    step = ends[-1] - ends[0]  # from the end of the first step, in which the scene is set, of two sequences
    return step * len(ends) / (len(ends) - 1) / len(names), size / len(names)


def _command_alone() -> tuple[float, float]:
    """Seconds, for each of many made-up sequences of as many files: when it is finished, and in the manifest."""
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.destinations import open_destination
    from rsbench.dataset.sequence import files_of
    from rsbench.storage.files import sha256, write_json

    card = load_dataset_card(CARD)
    with tempfile.TemporaryDirectory() as folder:
        out, made = Path(folder), {}
        for sequence in card.sequence:
            files = files_of(card.manifest_of(sequence))
            for name in files:
                (out / sequence.name / name).parent.mkdir(parents=True, exist_ok=True)
                (out / sequence.name / name).write_text(name)
            listed = {name: sha256(out / sequence.name / name) for name in files}
            write_json(out / sequence.name / "sequence.json", {"files": listed})
        with open_destination(out, 1, rehash=False) as destination:
            begun = time.perf_counter()
            for sequence in card.sequence:
                made[sequence.name] = destination.learned(sequence.name)
            between = time.perf_counter()
            destination.finish(card, made)
            end = time.perf_counter()
    return (between - begun) / len(card.sequence), (end - between) / len(card.sequence)


def _handed(jobs: int = 2000) -> float:
    """Seconds of the processor for a job that does nothing, with distributed; the scheduler is in this process."""
    from distributed import LocalCluster

    from rsbench.jobs.process_jobs import Cluster, run_jobs

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as cluster:
        there = Cluster(address=cluster.scheduler_address)
        for todo in ([0.0], list(map(float, range(jobs)))):  # the first one starts the children
            begun = time.process_time()
            for _ in run_jobs(partial, todo, there, {}, math.sqrt):
                pass
    return (time.process_time() - begun) / jobs


# Simulating


@dataclass
class Process:
    """One of a machine's."""

    machine: int
    scene: str = ""


class Result(NamedTuple):
    """Of a run."""

    hours: float
    building: float
    """Shares of the processes' time: with scenes, waiting for the storage, and without a job at the end."""
    storing: float
    idle: float
    command: float
    """Share of the time in which the command was at work for what is finished."""


def simulate(costs: Costs, jobs: Sequence[str], machines: int, cores: int, bytes_per_s: float) -> Result:
    """A run of jobs, each named by its scene, in this order."""
    free = [(0.0, number, Process(number // cores)) for number in range(machines * cores)]
    known: dict[tuple[int, str], float] = {}
    storage = command = building = storing = rendering = 0.0
    for scene in jobs:
        now, number, process = heapq.heappop(free)
        if process.scene != scene:
            place = process.machine, scene
            # Who finds nothing in the cache builds: processes of a machine do so side by side, each for itself.
            cost = costs.loaded[scene] if known.get(place, now) < now else costs.built[scene]
            known.setdefault(place, now + cost)
            process.scene, now, building = scene, now + cost, building + cost
        now, rendering = now + costs.rendered[scene], rendering + costs.rendered[scene]
        storage = max(storage, now) + costs.bytes / bytes_per_s
        storing, now = storing + storage - now, storage
        command = max(command, now) + costs.finished + costs.handed
        heapq.heappush(free, (now, number, process))
    end = max(command, *(time for time, _, _ in free)) + len(jobs) * costs.manifest
    whole = end * machines * cores
    idle = whole - building - storing - rendering
    busy = len(jobs) * (costs.finished + costs.handed + costs.manifest) / end
    return Result(end / 3600.0, building / whole, storing / whole, idle / whole, busy)


def rows(costs: Costs, seeds: int, cores: int, megabytes_per_s: float) -> Iterator[str]:
    """Of the table."""
    from rsbench.dataset.card import load_dataset_card

    scenes = sorted(sequence.scene for sequence in load_dataset_card(CARD).sequence for _ in range(seeds))
    alone = simulate(costs, scenes, 1, 1, 1e6 * megabytes_per_s).hours
    yield f"{len(scenes)} sequences, {cores} processes a machine, a storage of {megabytes_per_s:g} MB/s\n"
    heads = "machines", "hours", "times one process", "used", "scenes", "storage", "no job left", "the command"
    yield f"| {' | '.join(heads)} |"
    yield f"{'|---' * len(heads)}|"
    for machines in MACHINES:
        found = simulate(costs, scenes, machines, cores, 1e6 * megabytes_per_s)
        times = alone / found.hours
        shares = (times / machines / cores, found.building, found.storing, found.idle, found.command)
        told = " | ".join(f"{100.0 * share:.1f} %" for share in shares)
        yield f"| {machines} | {found.hours:.3g} | {times:.0f} | {told} |"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", type=Path, metavar="FILE", help="measure, and write the costs there")
    parser.add_argument("--costs", type=Path, metavar="FILE", help="simulate with these")
    parser.add_argument("--seeds", type=int, default=50, help="of the card: 216 sequences each (default 50)")
    parser.add_argument("--cores", type=int, default=16, help="processes of a machine (default 16)")
    parser.add_argument("--storage", type=float, default=1000.0, help="MB/s of the shared folder (default 1000)")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--scene", default="", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child:
        sys.stdout.write(json.dumps(child(given.child, given.scene)) + "\n")
    if given.measure:
        given.measure.write_text(json.dumps(measure()._asdict(), indent=2) + "\n")
    if given.costs:
        costs: dict[str, Any] = json.loads(given.costs.read_text())
        sys.stdout.write("\n".join(rows(Costs(**costs), given.seeds, given.cores, given.storage)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
