"""Where jobs run: in processes of this machine, and on a Dask cluster of it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import pytest

from rsbench.jobs.process_jobs import Cluster, Workers


@pytest.fixture(scope="package")
def local() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs rsbench[cluster]")
    if sys.platform != "linux":
        pytest.skip("reads /proc")
    options = {"dashboard_address": ":0", "host": "127.0.0.1"}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as cluster:
        yield cluster


@pytest.fixture
def there(local: Any) -> Cluster:
    return Cluster(address=local.scheduler_address)


@pytest.fixture(params=["here", "there"])
def workers(request: pytest.FixtureRequest) -> Workers:
    """Two processes of this machine, or of a cluster."""
    return 2 if request.param == "here" else request.getfixturevalue("there")
