"""Memory of ``rsbench generate`` over many sequences: the largest process, each time so many more are done.

    nice python benchmarks/memory.py                          # 500 sequences of 96 x 64 px, some minutes
    nice python benchmarks/memory.py 500 --workers 2 --scene castle --scene room

Each sequence is rendered, as another seed of a card of a few scenes, by processes that live as long as the run,
one scene after the other. Printed are the resident memory of the command and of the largest of its children at
four times in each scene, and slopes by least squares: of the command over the run, of the child over the last
three quarters of each scene. A leak of one float image a sequence would be 0.07 MB here.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

CARD = """
name = "memory"
baseline = 0.3
readout_ratio = 0.8
renderer = "preview"
seeds = [{seeds}]
[camera]
width = 96
height = 64
focal = 80
[motion]
rotation_deg = 1.5
rotation_axis = "random"
translation = 0.1
translation_axis = "random"
"""
EVERY_S = 0.2


def resident_mb(pid: int) -> float:
    """Of a process; 0 of one that is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def children(pid: int) -> list[int]:
    """Of a process, and theirs."""
    found = list[int]()
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that ended meanwhile
            for child in map(int, task.read_text().split()):
                found += [child, *children(child)]
    return found


def watch(command: list[str], out: Path) -> list[tuple[int, float, float]]:
    """Run it: sequences that are done, and MB of the command and of its largest child, again and again."""
    seen = []
    with subprocess.Popen(command) as process:
        while process.poll() is None:
            done = sum(1 for _ in out.glob("*/sequence.json"))
            largest = max((resident_mb(child) for child in children(process.pid)), default=0.0)
            seen.append((done, resident_mb(process.pid), largest))
            time.sleep(EVERY_S)
    if process.returncode:
        raise SystemExit(process.returncode)
    return seen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", type=int, nargs="?", default=500)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--scene", action="append", help="default: room, castle, poles, shelves")
    given = parser.parse_args()
    scenes = given.scene or ["room", "castle", "poles", "shelves"]
    with tempfile.TemporaryDirectory() as folder:
        card, out = Path(folder) / "memory.toml", Path(folder) / "out"
        seeds = ", ".join(map(str, range(-(-given.sequences // len(scenes)))))
        parts = "".join(f'[[sequence]]\nname = "{scene}"\nscene = "{scene}"\n' for scene in scenes)
        card.write_text(CARD.format(seeds=seeds) + parts, "utf-8")
        command = [sys.executable, "-m", "rsbench", "--quiet", "generate", str(card), "--out", str(out)]
        seen = np.array(watch([*command, "--workers", str(given.workers)], out))
    each = seen[-1, 0] / len(scenes)
    for k, scene in enumerate(sorted(scenes)):
        inside = seen[(seen[:, 0] > each * k) & (seen[:, 0] < each * (k + 1)) & (seen[:, 2] > 0.0)]
        for part in (0.25, 0.5, 0.75, 1.0):
            row = inside[np.flatnonzero(inside[:, 0] <= each * (k + part))[-1]]
            sys.stdout.write(f"{scene}, {row[0]:.0f} done: the command {row[1]:.0f} MB, a child {row[2]:.0f} MB\n")
        late = inside[inside[:, 0] > each * (k + 0.25)]
        slope = np.polyfit(late[:, 0], late[:, 2], 1)[0]
        sys.stdout.write(f"{scene}: a child {slope:+.3f} MB a sequence\n")
    slope = np.polyfit(seen[:, 0], seen[:, 1], 1)[0]
    sys.stdout.write(f"the command: {slope:+.3f} MB a sequence\n")


if __name__ == "__main__":
    main()
