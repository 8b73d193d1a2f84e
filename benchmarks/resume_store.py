"""Time and memory of ``rsbench generate --out s3://...`` on a dataset that is complete: all is seen by a listing.

    python benchmarks/resume_store.py [SEQUENCES]        # needs s3fs and moto[server]

A server of objects in memory (moto) in a process of its own holds true manifests and made-up files. Two runs, each
in a fresh process: one of a machine that has never seen the dataset, which reads every sequence.json, and one that
reads none. 10,000 sequences must take the second less than 20 s of the processor and 1 GB; a page of a listing
costs this server much more than a real one, so its own seconds are told apart.
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
from pathlib import Path

from resume import CARD, resume

URL = "s3://data/many"
SCENE = "0" * 64
"""Hash of it."""


def serve(card: Path) -> None:
    """Fill a server, print its address, and serve until standard input ends; then print its seconds."""
    from moto.core import DEFAULT_ACCOUNT_ID
    from moto.s3.models import s3_backends
    from moto.server import ThreadedMotoServer

    from rsbench.cards import load_card
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.plans import of_scene, plans_of, wanted_files
    from rsbench.renderers.options import RendererOptions

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    store = s3_backends[DEFAULT_ACCOUNT_ID]["aws"]
    store.create_bucket("data", "us-east-1")
    dataset, digest = load_dataset_card(str(card)), hashlib.sha256(b"x").hexdigest()
    for name, plan in plans_of(dataset, load_card(RendererOptions, "renderers", dataset.renderer)).items():
        files = dict.fromkeys(wanted_files({}, plan), digest)
        content = json.dumps(of_scene(plan, SCENE) | {"files": files}, indent=2).encode()
        for file in files:
            store.put_object("data", f"many/{name}/{file}", b"x")
        store.put_object("data", f"many/{name}/sequence.json", content)
    sys.stdout.write("http://{}:{}\n".format(*server.get_host_and_port()))
    sys.stdout.flush()
    start = time.process_time()
    sys.stdin.readline()
    sys.stdout.write(f"the server: {time.process_time() - start:.1f} s of the processor\n")


def main() -> None:
    """Resume a made-up dataset twice."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("sequences", type=int, nargs="?", default=10_000)
    parser.add_argument("--run", choices=["serve", "resume"], help="one process")
    parser.add_argument("--card", type=Path)
    options = parser.parse_args()
    if options.run == "serve":
        serve(options.card)
        return
    if options.run == "resume":
        resume(options.card, URL, rehash=False)
        return
    with tempfile.TemporaryDirectory() as folder:
        card = Path(folder) / "many.toml"
        card.write_text(CARD.format(seeds=", ".join(map(str, range(options.sequences)))))
        command = [sys.executable, __file__, "--card", str(card), "--run"]
        pipe = subprocess.PIPE
        with subprocess.Popen([*command, "serve"], stdin=pipe, stdout=pipe, text=True) as server:
            assert server.stdin is not None and server.stdout is not None
            variables = {"ENDPOINT_URL": server.stdout.readline().strip(), "DEFAULT_REGION": "us-east-1"}
            variables |= {"ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": "secret"}
            environment = {f"AWS_{name}": value for name, value in variables.items()}
            for _ in range(2):
                subprocess.run(
                    [*command, "resume"], check=True, env=os.environ | environment | {"XDG_CACHE_HOME": folder}
                )
            sys.stdout.write(server.communicate("\n")[0])


if __name__ == "__main__":
    main()
