"""What the channels of ground truth cost beside the images: a sequence's frames with all of them, and without.

Both are rendered and written in turn, so that a busy machine disturbs them alike. The ratio of the clock's times
is the cost; that of CPU times tells what a machine with other work would show.

    python benchmarks/channels.py --scene castle --runs 3 --twins middle,last
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from rsbench.components.cards import load_card
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.channels import CHANNELS, write_sequence_channels
from rsbench.dataset.generation import build_scene, render_camera, sequence_truth
from rsbench.dataset.sequence import files_of
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Viewpoint
from rsbench.storage.files import background_writer

Times = tuple[float, float]


def seconds(card: DatasetCard, options: RendererOptions, scene: MitsubaScene, viewpoint: Viewpoint) -> Times:
    """Of the clock and of all threads, for the four frames and what belongs to no one frame."""
    (sequence,) = card.sequence
    with tempfile.TemporaryDirectory() as folder:
        for parent in {Path(name).parent for name in files_of(card.manifest_of(sequence))}:
            (Path(folder) / parent).mkdir(parents=True, exist_ok=True)
        begun, used = time.perf_counter(), time.process_time()
        with background_writer() as later:
            for view in VIEWS:
                for _ in render_camera(card, sequence, options, scene, *view, Path(folder), later):
                    pass
            truth = sequence_truth(Path(folder), card, sequence, scene, asdict(viewpoint))
            write_sequence_channels(card.channels, truth)
        return time.perf_counter() - begun, time.process_time() - used


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="paper", help="whose camera, motion and renderer (default paper)")
    parser.add_argument("--scene", default="castle", help="sequence of it (default castle)")
    parser.add_argument("--channels", default=",".join(CHANNELS), help="with commas between (default all)")
    parser.add_argument("--twins", default="", help="more global-shutter frames, as middle,last")
    parser.add_argument("--runs", type=int, default=3, help="runs of each (default 3)")
    parser.add_argument("--limit", type=float, default=1.5, help="exit with 1 above this ratio (default 1.5)")
    given = parser.parse_args(arguments)
    plain = load_dataset_card(given.dataset).only([given.scene])
    if given.twins:
        plain = replace(plain, twins=tuple(given.twins.split(",")))
    full = replace(plain, channels=tuple(given.channels.split(",")))
    options = load_card(RendererOptions, "renderers", plain.renderer)
    built = build_scene(plain.sequence[0].scene).scene
    viewpoint = built.viewpoints[plain.sequence[0].viewpoint]
    scene = MitsubaScene(built.seen_from(viewpoint))
    seconds(full, options, scene, viewpoint)  # compiles
    runs = [tuple(seconds(card, options, scene, viewpoint) for card in (plain, full)) for _ in range(given.runs)]
    clock, cpu = (statistics.median(with_[k] / without[k] for without, with_ in runs) for k in (0, 1))
    size = f"{plain.camera.width} x {plain.camera.height}, {options.samples} samples"
    twins = ", ".join(("first", *map(str, plain.twins)))
    rows = [f"{given.dataset}, {given.scene}: {size}, twins {twins}, {given.runs} runs of each; {given.channels}"]
    for name, place in (("images and depth alone", 0), ("with channels", 1)):
        times = [statistics.median(run[place][k] for run in runs) for k in (0, 1)]
        rows.append(f"{name:24}{times[0]:7.2f} s of the clock {times[1]:7.2f} s of CPU")
    rows.append(f"ratio                   {clock:7.2f}              {cpu:7.2f}   (limit {given.limit})")
    sys.stdout.write("\n".join(rows) + "\n")
    return 0 if clock <= given.limit else 1


if __name__ == "__main__":
    sys.exit(main())
