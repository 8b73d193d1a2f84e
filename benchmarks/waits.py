"""What a person waits for: seconds of the clock, processor seconds and memory of commands, on this machine.

Another program on the machine adds to the seconds, so run it on one that is otherwise idle; quotients that hold on
a busy machine are in ``all.py``. Memory is that of the largest process. Of several runs the median is told, with
the least and the most. With --write the figures go into results/speed, and the table into docs/results-speed.md.

    python benchmarks/waits.py --write
    python benchmarks/waits.py --only correct --runs 5
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from memory import children, resident_mb

from rsbench.benchmark.provenance import provenance
from rsbench.components.compiled import SHIPPED
from rsbench.storage.files import write_bytes, write_json, write_table

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "results/speed", ROOT / "docs/results-speed.md"
START, END = "<!-- The table of benchmarks/waits.py -->\n", "<!-- End of the table of waits -->\n"
COLUMNS = ["command", "seconds", "least", "most", "processor_s", "memory_mb", "runs"]
VIEWS = ("left_0", "right_0", "left_1", "right_1")
SOLVERS = ("--solver", "rs-stereo-refined", "--solver", "gs-8pt", "--solver", "rs-stereo-linear")
EVERY_S = 0.02
SHIPPED_CODE = ROOT / "rsbench" / SHIPPED


@dataclass(frozen=True, kw_only=True)
class Wait:
    """A command, and what stands before it each time."""

    name: str
    words: tuple[str, ...]
    fresh: tuple[Path, ...] = ()
    """Folders that are removed before each run."""
    variables: dict[str, str] = field(default_factory=dict)
    most_runs: int = 100


def run(wait: Wait) -> tuple[float, float, float]:
    """Seconds, processor seconds with children, and MB of the largest process."""
    for each in wait.fresh:
        shutil.rmtree(each, ignore_errors=True)
    before, began, most = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), 0.0
    command = [sys.executable, "-m", "rsbench", "--quiet", *wait.words]
    # Compiled Python is kept, as it is by default: without, each command compiles all that it imports.
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**kept, **wait.variables}) as process:
        while process.poll() is None:
            most = max(most, *map(resident_mb, [process.pid, *children(process.pid)]))
            time.sleep(EVERY_S)
    seconds, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, most


def waits(folder: Path) -> Iterator[Wait]:
    """In the order of the table; what the first ones make the others read."""
    data, out, kernels = folder / "data", folder / "out", folder / "kernels"
    castle = data / "castle"
    yield Wait(
        name="`generate` a sequence of `paper`: 4 frames 900 x 900, their truth",
        words=("generate", "paper", "--sequence", "castle", "--out", str(data)),
        fresh=(data,),
    )
    yield Wait(name="`verify` of it", words=("verify", str(data)))
    yield Wait(name="`verify --fast` of it", words=("verify", str(data), "--fast"))
    evaluated = ("evaluate", str(data), *SOLVERS, "--out", str(out))
    yield Wait(name="`evaluate` of it, three solvers", words=evaluated, fresh=(out,))
    yield Wait(name="the same again, nothing changed", words=evaluated)
    camera = "{fx = 1384.6, fy = 1384.6, cx = 449.5, cy = 449.5}"
    rig = folder / "rig.toml"
    rig.write_text(f"baseline = 0.5\nreadout_ratio = 0.8\ncamera = {camera}\n", "utf-8")
    frames = [str(castle / "rs" / f"{view}.png") for view in VIEWS]
    correct = ("correct", *frames, "--rig", str(rig), "--out", str(folder / "corrected"))
    yield Wait(name="`correct` of its four frames", words=correct)
    # Their readout ratio has a standard deviation of 0.02: by default "cannot tell", and exit code 1.
    yield Wait(name="`inspect` of them", words=("inspect", *frames, "--rig", str(rig), "--max-sigma", "0.05"))
    yield Wait(
        name="`correct` of them, the first command of an installation",
        words=correct,
        fresh=(kernels, SHIPPED_CODE),
        variables={"NUMBA_CACHE_DIR": str(kernels)},
        most_runs=2,
    )
    yield Wait(name="`compile --portable`, before a wheel is built", words=("compile", "--portable"), most_runs=1)
    yield Wait(
        name="`correct` of them, the first command of such a wheel",
        words=correct,
        fresh=(kernels,),
        variables={"NUMBA_CACHE_DIR": str(kernels)},
    )
    problem = ROOT / "examples" / "problem.json"
    yield Wait(name="`solve` of 80 matches", words=("solve", str(problem)))
    yield Wait(name="`solve --help`", words=("solve", "--help"))
    yield Wait(name="`--help`", words=("--help",))
    yield Wait(name="`correct --help`", words=("correct", "--help"))


def measured(wait: Wait, runs: int) -> dict[str, object]:
    """Of the columns."""
    runs = min(runs, wait.most_runs)
    seconds, processor, memory = np.array([run(wait) for _ in range(runs)]).T
    return {
        "command": wait.name,
        "seconds": np.median(seconds),
        "least": seconds.min(),
        "most": seconds.max(),
        "processor_s": np.median(processor),
        "memory_mb": memory.max(),
        "runs": runs,
    }


def for_scale(sequence: Path) -> dict[str, object]:
    """What OpenCV alone takes for features and disparities of four frames, by which other machines can be told."""
    import correct_chain

    from rsbench.dataset.sequence import read_sequence

    work = correct_chain.opencv_alone(read_sequence(sequence))
    work()
    times = []
    for _ in range(3):
        began, processor = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - began, time.process_time() - processor))
    seconds, processor_s = np.array(times).T
    return {
        "command": "for scale: OpenCV's SIFT of the four frames and SGBM of the two pairs, in memory",
        "seconds": np.median(seconds),
        "least": seconds.min(),
        "most": seconds.max(),
        "processor_s": np.median(processor_s),
        "memory_mb": np.nan,
        "runs": 3,
    }


def table(found: pd.DataFrame) -> str:
    """In Markdown."""
    lines = [
        "| command | seconds [least, most] | processor seconds | largest process |",
        "| --- | --- | --- | --- |",
    ]
    for row in found.to_dict("records"):
        spread = f"{row['seconds']:.2f} [{row['least']:.2f}, {row['most']:.2f}]"
        memory = f"{row['memory_mb']:.0f} MB" if np.isfinite(row["memory_mb"]) else "-"
        lines.append(f"| {row['command']} | {spread} | {row['processor_s']:.1f} | {memory} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="of each command (default 3)")
    parser.add_argument(
        "--only", default="", help="commands in whose name this is, and those before the first one"
    )
    parser.add_argument("--write", action="store_true", help="into results/speed and docs/results-speed.md")
    given = parser.parse_args()
    if given.runs < 1:
        parser.error(f"--runs {given.runs}: must be 1 or more")
    if given.only and given.write:
        parser.error("--write: writes the whole table; leave --only out")
    found = list[dict[str, object]]()
    with tempfile.TemporaryDirectory() as folder:
        every = list(waits(Path(folder)))
        if not any(given.only in wait.name for wait in every):
            parser.error(f"--only {given.only!r}: is in no command's name")
        for wait in every:
            needed = given.only in wait.name
            row = measured(wait, given.runs if needed else 1)
            if needed:
                found.append(row)
                sys.stdout.write(f"{table(pd.DataFrame([row])).splitlines()[2]}\n")
                sys.stdout.flush()
        found.append(for_scale(Path(folder) / "data" / "castle"))
    sys.stdout.write(f"{table(pd.DataFrame(found[-1:])).splitlines()[2]}\n")
    if given.write:
        RESULTS.mkdir(parents=True, exist_ok=True)
        write_table(RESULTS / "waits.csv", pd.DataFrame(found, columns=COLUMNS))
        command = f"python benchmarks/waits.py --write --runs {given.runs}"
        write_json(RESULTS / "waits-provenance.json", provenance(command))
        before, _, rest = PAGE.read_text("utf-8").partition(START)
        shown = f"{before}{START}\n{table(pd.read_csv(RESULTS / 'waits.csv'))}\n{END}{rest.partition(END)[2]}"
        write_bytes(PAGE, shown.encode())


if __name__ == "__main__":
    main()
