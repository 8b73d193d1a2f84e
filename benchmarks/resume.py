"""Time and memory of ``rsbench generate`` on a dataset that is complete: nothing is rendered, all is checked.

    python benchmarks/resume.py [SEQUENCES] [FOLDER]

Sequences are of tiny made-up files beside true manifests. Three runs, each in a fresh process: one that finds
the hashes of all files kept, one that reads every file (--rehash), one more that finds them. 10,000 sequences must
take less than 20 s and 1 GB where hashes are kept.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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


def make_up(card: Path, out: Path) -> None:
    """A dataset whose images, depths and poses are a few bytes each."""
    from rsbench.dataset import generation
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.layout import RELATIVE_FILES
    from rsbench.dataset.posed_scenes import Built
    from rsbench.renderers import clearance, scene

    def render(*arguments: Any) -> Iterator[None]:
        side, frame, folder = arguments[4:7]
        for name in RELATIVE_FILES:
            if Path(name).stem == f"{side}_{frame}":
                (folder / name).write_text(f"{folder.name}/{name}")
        yield
        yield

    nothing = SimpleNamespace(viewpoints={"default": None}, seen_from=lambda *place: place)
    vars(generation)["build_scene"] = lambda name: Built(nothing, "0" * 64)  # pyrefly: ignore[bad-argument-type]
    vars(generation)["render_camera"] = render
    vars(clearance)["obstacle"] = lambda *moving: ""
    vars(scene)["MitsubaScene"] = lambda scene: SimpleNamespace(glossy=False)
    generation.generate_dataset(load_dataset_card(str(card)), out)


def resume(card: Path, out: Path | str, rehash: bool) -> None:
    """In a process of its own: resume, and print seconds and the largest memory, MB."""
    from rsbench.dataset import generation
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.posed_scenes import Built

    vars(generation)["build_scene"] = lambda name: Built(None, "0" * 64)  # pyrefly: ignore[bad-argument-type]
    start, processor = time.perf_counter(), time.process_time()
    assert generation.generate_dataset(load_dataset_card(str(card)), out, rehash=rehash) == []
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # of Linux, in KB
    what = "all read" if rehash else "kept hashes"
    sys.stdout.write(f"{what}: {seconds:.1f} s ({processor:.1f} s of the processor), {memory:.0f} MB\n")


def main() -> None:
    """Make the dataset, unless it is there, and resume it three times."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("sequences", type=int, nargs="?", default=10_000)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(tempfile.gettempdir()) / "rsbench-many")
    parser.add_argument("--run", choices=["make", "resume", "rehash"], help="one step, in this process")
    options = parser.parse_args()
    card, out = options.folder / "many.toml", options.folder / f"dataset-{options.sequences}"
    if options.run == "make":
        make_up(card, out)
    elif options.run:
        resume(card, out, options.run == "rehash")
    else:
        options.folder.mkdir(parents=True, exist_ok=True)
        card.write_text(CARD.format(seeds=", ".join(map(str, range(options.sequences)))))
        for step in ("make", "resume", "rehash", "resume"):
            command = [sys.executable, __file__, str(options.sequences), str(options.folder), "--run", step]
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
