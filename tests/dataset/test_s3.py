"""Datasets on a server that speaks S3: processes, a cluster, kills and refusals."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from commands import assert_refused, run_here
from small_scenes import write_box_scene, write_small_card

from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.workplace import HIDDEN

pytestmark = [
    pytest.mark.skipif(
        find_spec("moto") is None or find_spec("s3fs") is None, reason="needs s3fs and moto[server]"
    ),
    pytest.mark.filterwarnings("default"),  # the server is the other side
]
_KILLS = 3


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    yield "http://{}:{}".format(*server.get_host_and_port())
    server.stop()


@pytest.fixture
def bucket(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The file system of the server, where the only bucket, ``data``, is empty."""
    variables = {"ENDPOINT_URL": server, "ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": "secret"}
    for name, value in variables.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    from s3fs import S3FileSystem

    store = S3FileSystem()
    if store.exists("data"):
        store.rm("data", recursive=True)
    store.mkdir("data")
    return store


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("card")
    return write_small_card(folder, [write_box_scene(folder, name) for name in "abc"])


@pytest.fixture(scope="module")
def dataset(card: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a folder."""
    out = tmp_path_factory.mktemp("s3") / "dataset"
    generate_dataset(load_dataset_card(str(card)), out)
    paths = [path for path in out.rglob("*") if path.is_file() and HIDDEN not in path.parts]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in paths}


def stored(bucket: Any, folder: str) -> dict[str, bytes]:
    bucket.invalidate_cache()
    return {path.partition(f"{folder}/")[2]: bucket.cat_file(path) for path in bucket.find(f"data/{folder}")}


def test_processes_send_the_same_bytes(card: Path, dataset: dict[str, bytes], bucket: Any) -> None:
    for name, workers in (("one", 1), ("two", 2)):
        run = run_here("generate", card, "--out", f"s3://data/{name}", "--workers", workers)
        assert run.returncode == 0 and f"s3://data/{name}: 3 sequences, 3 rendered now" in run.stdout, run.stderr
        assert stored(bucket, name) == dataset
        run = run_here("generate", card, "--out", f"s3://data/{name}/", "--workers", workers)
        assert "3 sequences, 0 rendered now" in run.stdout, run.stderr


@pytest.mark.skipif(find_spec("distributed") is None, reason="needs rsbench[cluster]")
def test_a_cluster_sends_the_same_bytes(
    card: Path, dataset: dict[str, bytes], bucket: Any, tmp_path: Path
) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None, host="127.0.0.1") as cluster:
        run = run_here("generate", card, "--out", "s3://data/far", "--scheduler", cluster.scheduler_address)
    assert run.returncode == 0, run.stderr
    assert stored(bucket, "far") == dataset
    assert not [path for path in tmp_path.rglob("*.png")], "workplaces of the cluster's processes are empty"


def test_killed_at_any_time_it_goes_on_to_the_same_bytes(
    card: Path, dataset: dict[str, bytes], bucket: Any, tmp_path: Path
) -> None:
    """While objects arrive: after so many of them."""
    command = [sys.executable, "-m", "rsbench", "-q", "generate", str(card), "--out", "s3://data/killed"]
    draw = random.Random(7)
    for number in sorted(draw.sample(range(1, len(dataset) - 2), _KILLS)):
        with subprocess.Popen(command) as process:
            while process.poll() is None and len(bucket.find("data/killed")) < number:
                bucket.invalidate_cache()
            process.kill()
    there = stored(bucket, "killed")
    for name in "abc":
        if f"{name}/sequence.json" in there:
            assert {path for path in dataset if path.startswith(f"{name}/")} <= set(there)
    assert subprocess.run(command, check=False).returncode == 0
    assert stored(bucket, "killed") == dataset
    assert not list((tmp_path / "cache").rglob("*.png"))


@pytest.mark.usefixtures("bucket")
def test_what_the_server_refuses_is_one_line(card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_here("generate", card, "--out", "s3://none/x")
    assert_refused(run, "s3://none/x: cannot list it", "make the bucket first, or choose another --out")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "nowhere")
    from s3fs import S3FileSystem

    S3FileSystem.clear_instance_cache()
    run = run_here("generate", card, "--out", "s3://data/without")
    assert_refused(run, "s3://data/without: cannot list it", "give its package credentials (for s3: AWS_ACC")
