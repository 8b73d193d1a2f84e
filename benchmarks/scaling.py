"""What two processes gain over one in ``rsbench generate``, each with one thread of the renderer.

    python benchmarks/scaling.py                   # processes of this machine; needs two idle cores
    python benchmarks/scaling.py --cluster         # workers of a Dask LocalCluster

Sequences of the card `standard`, some of each of three scenes, are rendered into fresh folders by one and by two
children in turn; scenes are built and code is compiled before. Starting processes and the manifest count. Beside
them stands how much slower one process alone becomes when another computes: what the machine itself lacks of 2.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load; children have it from here

import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.dataset import generation
from rsbench.dataset.card import load_dataset_card
from rsbench.jobs.process_jobs import Cluster, Workers, finished_jobs

SCENES = ("castle", "poles", "room")


@contextmanager
def children(count: int, cluster: bool) -> Iterator[Workers]:
    """So many, of one thread each; of this process, or of workers of a cluster."""
    if cluster:
        from distributed import LocalCluster

        with LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0") as started:
            yield Cluster(address=started.scheduler_address)
        return

    def jobs(
        factory: Callable[..., Any], todo: Sequence[Any], _: int, environment: Any, *given: Any, **how: Any
    ) -> Any:
        return finished_jobs(factory, todo, count, environment, *given[:-1], 1, **how)

    vars(generation)["finished_jobs"] = jobs  # one worker would be this process, with all its threads
    yield 2


def seconds(names: list[str], count: int, cluster: bool) -> float:
    """Of a run by so many children."""
    card = load_dataset_card("standard").only(names)
    with tempfile.TemporaryDirectory() as folder, children(count, cluster) as workers:
        start = time.perf_counter()
        generation.generate_dataset(card, Path(folder), workers=workers)
        return time.perf_counter() - start


def compute(_: int) -> float:
    """Seconds of some seconds of work of one thread."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(300, 300))
    start = time.perf_counter()
    for _ in range(300):
        np.linalg.svd(A)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cluster", action="store_true", help="workers of a LocalCluster")
    parser.add_argument("--each", type=int, default=4, help="sequences of each scene (default 4)")
    parser.add_argument("--runs", type=int, default=2)
    given = parser.parse_args()
    card = load_dataset_card("standard")
    of_scene = {scene: [each.name for each in card.sequence if each.scene == scene] for scene in SCENES}
    names = [name for scene in SCENES for name in of_scene[scene][: given.each]]
    seconds([of_scene[scene][0] for scene in SCENES], 2, given.cluster)  # builds, compiles
    with multiprocessing.Pool(2) as pool:
        alone = pool.map(compute, [0])[0]
        together = max(pool.map(compute, [0, 1], chunksize=1))
    sys.stdout.write(f"{len(names)} sequences; the machine itself: {2.0 * alone / together:.2f} of 2\n")
    found = {1: list[float](), 2: list[float]()}
    for _ in range(given.runs):
        for count, taken in found.items():
            taken.append(seconds(names, count, given.cluster))
            sys.stdout.write(f"{count}: {taken[-1]:.1f} s\n")
            sys.stdout.flush()
    ratios = [one / two for one, two in zip(found[1], found[2], strict=True)]
    sys.stdout.write(f"two over one: {', '.join(f'{ratio:.2f}' for ratio in ratios)} times as fast\n")


if __name__ == "__main__":
    main()
