"""Datasets and results on a server that speaks S3: processes, a cluster, kills and refusals."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import assert_refused, bytes_below, run_here, sweep_card
from evaluations import contents
from small_scenes import write_box_scene, write_small_card

from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.storage.work_folder import HIDDEN

pytestmark = [
    pytest.mark.skipif(
        find_spec("moto") is None or find_spec("s3fs") is None, reason="needs s3fs and moto[server]"
    ),
    pytest.mark.filterwarnings("default"),  # the server is the other side
]
_KILLS = 1


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
    return bytes_below(out, HIDDEN)


def stored(bucket: Any, folder: str) -> dict[str, bytes]:
    bucket.invalidate_cache()
    return {path.partition(f"{folder}/")[2]: bucket.cat_file(path) for path in bucket.find(f"data/{folder}")}


@pytest.mark.slow
def test_processes_send_the_same_bytes(card: Path, dataset: dict[str, bytes], bucket: Any) -> None:
    run = run_here("generate", card, "--out", "s3://data/two", "--workers", 2)
    assert run.returncode == 0 and "s3://data/two: 3 sequences, 3 rendered now" in run.stdout, run.stderr
    assert stored(bucket, "two") == dataset
    run = run_here("generate", card, "--out", "s3://data/two/", "--workers", 1)
    assert "3 sequences, 0 rendered now" in run.stdout, run.stderr


@pytest.mark.slow
@pytest.mark.skipif(find_spec("distributed") is None, reason="needs rsbench[cluster]")
def test_a_cluster_sends_the_same_bytes(
    card: Path, dataset: dict[str, bytes], bucket: Any, tmp_path: Path
) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=":0", host="127.0.0.1") as cluster:
        run = run_here("generate", card, "--out", "s3://data/far", "--scheduler", cluster.scheduler_address)
    assert run.returncode == 0, run.stderr
    assert stored(bucket, "far") == dataset
    assert not [path for path in tmp_path.rglob("*.png")], "workplaces of the cluster's processes are empty"


@pytest.mark.slow
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


_EAGER = """from rsbench.cli.main import run
from rsbench.storage import object_store
object_store._BEAT_S = 0.02
run()
"""
"""``rsbench`` that sends what there is at once."""


@pytest.mark.slow
def test_a_sweep_that_is_killed_goes_on_elsewhere(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was done and sent is not done again: no two runs agree on the seconds that it took."""
    card = tmp_path / "mine.toml"
    card.write_text(sweep_card(["rs-stereo-refined"], noise_px=[0.0, 0.5], trials=100), "utf-8")
    words = ["simulate", str(card), "--workers", "1", "--out"]
    assert run_here(*words, tmp_path / "out").returncode == 0
    url, chunks = "s3://data/sweep", "data/sweep/.rsbench/chunks"
    with subprocess.Popen([sys.executable, "-c", _EAGER, "-q", *words, url]) as process:
        while process.poll() is None and len(bucket.find(chunks)) < 2:
            bucket.invalidate_cache()
        process.kill()
    bucket.invalidate_cache()
    bucket.pipe_file("data/sweep/notes.txt", b"not ours")
    kept = {Path(path).name: np.load(BytesIO(bucket.cat_file(path)))["seconds"] for path in bucket.find(chunks)}
    assert kept and not bucket.exists("data/sweep/summary.csv")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    run = run_here(*words, url)
    assert run.returncode == 0 and f"table: {url}/summary.csv" in run.stdout, run.stderr
    there = stored(bucket, "sweep")
    for name, seconds in kept.items():
        _, cell, first = Path(name).stem.split("-")
        whole = np.load(BytesIO(there[f"seconds/{cell}.npz"]))["seconds"]
        assert np.array_equal(whole[int(first) : int(first) + len(seconds)], seconds)
    here = {path: data for path, data in contents(tmp_path / "out").items() if not path.startswith("seconds/")}
    assert there.pop("notes.txt") == b"not ours" and there.pop("provenance.json")
    assert {path: data for path, data in there.items() if not path.startswith("seconds/")} == here


@pytest.mark.usefixtures("bucket")
def test_what_the_server_refuses_is_one_line(card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_here("generate", card, "--out", "s3://none/x")
    assert_refused(run, "s3://none/x: cannot list it", "make the bucket first, or choose another URL")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "nowhere")
    from s3fs import S3FileSystem

    S3FileSystem.clear_instance_cache()
    run = run_here("generate", card, "--out", "s3://data/without")
    assert_refused(run, "s3://data/without: cannot list it", "give its package credentials (for s3: AWS_ACC")
