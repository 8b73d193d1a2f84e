"""Times ``rsbench generate`` on a dataset that is complete, and prints seconds and memory of each run.

    python benchmarks/resume.py [SEQUENCES] [--folder FOLDER]       # files of this machine
    python benchmarks/resume.py [SEQUENCES] --store memory          # a store in the memory of the process; fsspec
    python benchmarks/resume.py [SEQUENCES] --store s3              # a server of S3; s3fs and moto[server]

Nothing is rendered: manifests are true, files are of one byte. Two runs, each in a fresh process but for
``memory``. The first has never seen the dataset and reads every file of a folder, every sequence.json of a store;
the second finds the hashes of all files in the cache, and what a store has by a listing. 10,000 sequences must
take the second less than 20 s (in a store: of the processor) and 1 GB. A page of a listing costs moto more than a
real server: what the server takes is printed apart.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

CARD = """
name = "many"
baseline = 0.3
readout_ratio = 0.8
seeds = [{seeds}]
[camera]
width = 96
height = 64
focal = 80
[motion]
rotation_deg = 1.5
rotation_axis = "random"
translation = 0.2
translation_axis = "random"
[[sequence]]
name = "room"
scene = "room"
"""
SCENE = "0" * 64
"""Its hash."""
PLACE = "data/many"


def fill(card: Path, put: Callable[[str, bytes], object]) -> None:
    """Put the files of a complete dataset; no dataset.json, as if the run was killed just before."""
    from rsbench.components.cards import load_card
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.manifest import of_scene, plans_of, wanted_files
    from rsbench.renderers.options import RendererOptions

    dataset, digest = load_dataset_card(str(card)), hashlib.sha256(b"x").hexdigest()
    for name, plan in plans_of(dataset, load_card(RendererOptions, "renderers", dataset.renderer)).items():
        files = dict.fromkeys(wanted_files({}, plan), digest)
        for file in files:
            put(f"{name}/{file}", b"x")
        put(f"{name}/sequence.json", json.dumps(of_scene(plan, SCENE) | {"files": files}, indent=2).encode())


def write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def resume(card: Path, out: Path | str) -> None:
    """Resume in this process, and print seconds and the largest memory, MB."""
    from rsbench.dataset import generation
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import Built

    vars(generation)["build_scene"] = lambda name: Built(None, SCENE)  # pyrefly: ignore[bad-argument-type]
    start, processor = time.perf_counter(), time.process_time()
    assert generation.generate_dataset(load_dataset_card(str(card)), out) == []
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # of Linux, in KB
    sys.stdout.write(f"{seconds:.1f} s ({processor:.1f} s of the processor), {memory:.0f} MB\n")


def serve(card: Path) -> None:
    """Fill a server, print its address, and serve until standard input ends; then print its seconds."""
    from moto.core import DEFAULT_ACCOUNT_ID
    from moto.s3.models import s3_backends
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    store = s3_backends[DEFAULT_ACCOUNT_ID]["aws"]
    bucket, _, folder = PLACE.partition("/")
    store.create_bucket(bucket, "us-east-1")
    fill(card, lambda path, data: store.put_object(bucket, f"{folder}/{path}", data))
    sys.stdout.write("http://{}:{}\n".format(*server.get_host_and_port()))
    sys.stdout.flush()
    start = time.process_time()
    sys.stdin.readline()
    sys.stdout.write(f"the server: {time.process_time() - start:.1f} s of the processor\n")


def step(card: Path, name: str) -> None:
    """One step of a run, in this process."""
    if name == "serve":
        return serve(card)
    folder = card.parent / "dataset"
    if name == "make":
        return fill(card, lambda path, data: write(folder / path, data))
    return resume(card, f"s3://{PLACE}" if name == "s3" else folder)


def with_server(command: list[str]) -> None:
    """Both runs in fresh processes, with a server of S3 in another."""
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, "serve"], stdin=pipe, stdout=pipe, text=True) as server:
        assert server.stdin is not None and server.stdout is not None
        variables = {"ENDPOINT_URL": server.stdout.readline().strip(), "DEFAULT_REGION": "us-east-1"}
        variables |= {"ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": "secret"}
        environment = os.environ | {f"AWS_{name}": value for name, value in variables.items()}
        for _ in range(2):
            subprocess.run([*command, "s3"], check=True, env=environment)
        sys.stdout.write(server.communicate("\n")[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", type=int, nargs="?", default=10_000)
    parser.add_argument("--folder", type=Path, help="of the dataset, kept (default: a temporary one)")
    parser.add_argument("--store", choices=("memory", "s3"), help="where the dataset lies, instead of a folder")
    parser.add_argument("--step", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step:
        return step(Path(options.step[0]), options.step[1])
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["XDG_CACHE_HOME"] = temporary
        card = (options.folder or Path(temporary)) / "many.toml"
        card.parent.mkdir(parents=True, exist_ok=True)
        card.write_text(CARD.format(seeds=", ".join(map(str, range(options.sequences)))))
        command = [sys.executable, __file__, "--step", str(card)]
        if options.store == "s3":
            return with_server(command)
        if options.store == "memory":
            import fsspec

            store = fsspec.filesystem("memory")
            fill(card, lambda path, data: store.pipe_file(f"/{PLACE}/{path}", data))
            for _ in range(2):
                resume(card, f"memory://{PLACE}")
        else:
            for name in ("make", "resume", "resume"):
                subprocess.run([*command, name], check=True)


if __name__ == "__main__":
    main()
