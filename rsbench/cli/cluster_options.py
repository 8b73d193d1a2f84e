"""Options of commands that can use many machines, or write results to an object store."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.jobs.process_jobs import Workers

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Dask scheduler to use instead of --workers: tcp://host:8786 or a file.json. Its workers "
        "need the same paths (rsbench docs cluster).",
    ),
]


def chosen_workers(workers: int | None, scheduler: str | None, default: int = 1) -> Workers:
    """Return the number of processes on this machine, or the cluster of a scheduler.

    Raises:
        RsbenchError: both are given, distributed is not installed, or the scheduler file is missing.
    """
    if scheduler is None:
        return workers or default
    from rsbench.jobs.process_jobs import Cluster

    if workers is not None:
        raise RsbenchError(
            f"--workers {workers}: the cluster of --scheduler {scheduler} has its own; give one of the two"
        )
    if find_spec("distributed") is None:  # refused before scenes are built
        raise RsbenchError("--scheduler needs distributed: pip install 'rsbench[cluster]'")
    if not scheduler.endswith(".json"):
        return Cluster(address=scheduler)
    if not Path(scheduler).is_file():  # distributed would wait for the file forever
        raise RsbenchError(
            f"--scheduler {scheduler}: no such file; make it with: dask scheduler --scheduler-file {scheduler}"
        )
    return Cluster(address=str(Path(scheduler).resolve()))


_Place = TypeVar("_Place", Path, Path | str)


def shared_path(path: _Place, scheduler: str | None) -> _Place:
    """Return an absolute path for the machines of a cluster, whose working folders differ; URLs stay unchanged."""
    if scheduler is None or isinstance(path, str):
        return path
    from rsbench.storage.work_folder import refuse_url

    refuse_url(path)
    return path.resolve()


@contextmanager
def results_at(out: str, scheduler: str | None) -> Iterator[Path]:
    """Yield the folder into which a command writes: ``out``, or one whose files are copied to the URL ``out``.

    Raises:
        RsbenchError: the URL is not supported, or given with a cluster; see ``mirrored``.
    """
    from rsbench.storage.object_store import path_or_url, shown

    place = path_or_url(out)
    if isinstance(place, Path):
        yield shared_path(place, scheduler)
        return
    if scheduler is not None:
        raise RsbenchError(
            f"{shown(place)}: not with --scheduler, whose jobs write into a folder that all machines see: give a "
            "folder, or --workers"
        )
    from rsbench.storage.object_store import mirrored

    with mirrored(place) as folder:
        yield folder
