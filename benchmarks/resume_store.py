"""Time and memory of ``rsbench generate --out URL`` on a dataset that is complete: all is seen by a listing.

    python benchmarks/resume_store.py [SEQUENCES] [--server]        # needs fsspec, or s3fs and moto[server]

True manifests and made-up files, in a store in the memory of this process, or on a server of S3 (moto) in another.
Two runs: of a machine that has never seen the dataset, which reads every sequence.json, and one that reads none,
in fresh processes where there is a server. 10,000 sequences must take the second less than 20 s of the processor
and 1 GB, here with the store itself. A page of a listing costs moto more than a real server: it is told apart.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from resume import CARD, resume

SCENE = "0" * 64
"""Hash of it."""
PLACE = "data/many"


def fill(card: Path, put: Callable[[str, bytes], object]) -> None:
    """Put the objects of a complete dataset; no dataset.json, as if the run was killed just before."""
    from rsbench.components.cards import load_card
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.sequence_identity import of_scene, plans_of, wanted_files
    from rsbench.renderers.options import RendererOptions

    dataset, digest = load_dataset_card(str(card)), hashlib.sha256(b"x").hexdigest()
    for name, plan in plans_of(dataset, load_card(RendererOptions, "renderers", dataset.renderer)).items():
        files = dict.fromkeys(wanted_files({}, plan), digest)
        for file in files:
            put(f"{name}/{file}", b"x")
        put(f"{name}/sequence.json", json.dumps(of_scene(plan, SCENE) | {"files": files}, indent=2).encode())


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


def with_server(command: list[str]) -> None:
    """Both runs in fresh processes."""
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, "serve"], stdin=pipe, stdout=pipe, text=True) as server:
        assert server.stdin is not None and server.stdout is not None
        variables = {"ENDPOINT_URL": server.stdout.readline().strip(), "DEFAULT_REGION": "us-east-1"}
        variables |= {"ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": "secret"}
        environment = os.environ | {f"AWS_{name}": value for name, value in variables.items()}
        for _ in range(2):
            subprocess.run([*command, "resume"], check=True, env=environment)
        sys.stdout.write(server.communicate("\n")[0])


def main() -> None:
    """Resume a made-up dataset twice."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("sequences", type=int, nargs="?", default=10_000)
    parser.add_argument("--server", action="store_true", help="a server of S3")
    parser.add_argument("--run", nargs=2, help="the card and what to do, in one process")
    options = parser.parse_args()
    if options.run:
        card, step = options.run
        _ = serve(Path(card)) if step == "serve" else resume(Path(card), f"s3://{PLACE}", rehash=False)
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        card = Path(folder) / "many.toml"
        card.write_text(CARD.format(seeds=", ".join(map(str, range(options.sequences)))))
        if options.server:
            with_server([sys.executable, __file__, "--run", str(card)])
            return
        import fsspec

        store = fsspec.filesystem("memory")
        fill(card, lambda path, data: store.pipe_file(f"/{PLACE}/{path}", data))
        for _ in range(2):
            resume(card, f"memory://{PLACE}", rehash=False)


if __name__ == "__main__":
    main()
