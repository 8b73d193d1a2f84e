"""Frames a second on a GPU and on this machine's processor, rolling over global shutter, and what bounds them.

A process renders with one backend, so each has its own. For each size and integrator: the median time of a
rolling-shutter frame, image and depth in host memory; its ratio to a global-shutter frame, run in turn; how much
of it Dr.Jit's kernels take by their own clock (the rest is Python, launches and copies to the host); how long a
copy of the frame's arrays to the host takes alone; and how long writing its files takes, PNG and EXR.

    python benchmarks/gpu_rendering.py --backends cuda llvm --out results/speed/gpu
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.provenance import provenance
from rsbench.storage.files import write_depth, write_json, write_png, write_table

SIZES, INTEGRATORS, SAMPLES = ((900, 900), (1920, 1080)), ("sunsky", "path"), 16
Row = dict[str, object]


def milliseconds(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - begin)


def kernel_milliseconds(call: Callable[[], object]) -> float:
    """Of all kernels that a call runs, by Dr.Jit's clock."""
    import drjit as dr

    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        call()
        return sum(entry["execution_time"] for entry in dr.kernel_history() if "execution_time" in entry)


def copy_milliseconds(pixels: int, runs: int) -> float:
    """Of a frame's arrays: three channels of colour and the depth, float32."""
    import drjit as dr
    import mitsuba as mi

    found = []
    for number in range(runs):
        channels = [dr.full(mi.Float, number + part, pixels) for part in range(4)]
        dr.eval(channels)
        dr.sync_thread()
        found.append(milliseconds(lambda channels=channels: [np.array(each) for each in channels]))
    return statistics.median(found)


def writing_milliseconds(image: NDArray[np.uint8], depth: NDArray[np.float32]) -> Row:
    """Of the files of a frame."""
    with tempfile.TemporaryDirectory() as folder:
        png = [milliseconds(lambda: write_png(Path(folder, "a.png"), image)) for _ in range(3)]
        exr = [milliseconds(lambda: write_depth(Path(folder, "a.exr"), depth)) for _ in range(3)]
    return {"png_ms": statistics.median(png), "exr_ms": statistics.median(exr)}


def rows_of(name: str, runs: int) -> Iterator[Row]:
    """What this process's backend does."""
    import render_rs_vs_gs as scenes

    from rsbench.core.camera import PinholeCamera
    from rsbench.core.shutter import RollingShutter
    from rsbench.renderers.backend import start_backend
    from rsbench.renderers.image import to_srgb8
    from rsbench.renderers.options import RendererOptions

    started, scene = start_backend(), scenes.boxes()
    if name not in started.variant:
        raise SystemExit(f"--backends {name}: {started.message}")
    for width, height in SIZES:
        for integrator in INTEGRATORS:
            options = RendererOptions(samples=SAMPLES, integrator=integrator)
            camera = PinholeCamera.centred(width, height, 0.9 * width)
            calls = scenes.kinds(scene, camera, RollingShutter(height=height, readout_ratio=0.8), options)
            rolling, still = calls[scenes.ROLLING], calls[scenes.GLOBAL]
            frame = rolling()
            still(), rolling()
            pairs = [(milliseconds(rolling), milliseconds(still)) for _ in range(runs)]
            kernels = statistics.median(kernel_milliseconds(rolling) for _ in range(runs))
            yield {
                "backend": started.variant,
                "width": width,
                "height": height,
                "integrator": integrator,
                "samples": SAMPLES,
                "frame_ms": statistics.median(pair[0] for pair in pairs),
                "rolling_over_global": statistics.median(pair[0] / pair[1] for pair in pairs),
                "kernels_ms": kernels,
                "copy_ms": copy_milliseconds(width * height, runs),
                **writing_milliseconds(to_srgb8(frame.image, 1.0), frame.depth),
                "runs": runs,
            }


def line(row: Row) -> str:
    size = f"{row['backend']} {row['integrator']} {row['width']} x {row['height']}"
    parts = ", ".join(f"{name.removesuffix('_ms')} {row[name]:.2f}" for name in row if name.endswith("_ms"))
    per_second = 1e3 / float(str(row["frame_ms"]))
    return f"{size}: {per_second:.1f} frames/s, RS/GS {row['rolling_over_global']:.3f}; ms: {parts}"


def device() -> str:
    """The GPU and its driver, as nvidia-smi names them."""
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "none"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs="+", default=["cuda", "llvm"], choices=("cuda", "llvm"))
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--out", type=Path, help="folder for frames.csv and provenance.json")
    parser.add_argument("--child", choices=("cuda", "llvm"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.runs < 1:
        parser.error(f"--runs {given.runs}: at least 1")
    if given.child:
        for row in rows_of(given.child, given.runs):
            sys.stdout.write(json.dumps(row) + "\n")
            sys.stdout.flush()
        return 0
    found = list[Row]()
    for name in given.backends:
        command = [sys.executable, __file__, "--child", name, "--runs", str(given.runs)]
        environ = {**os.environ, "RSBENCH_VARIANT": name}
        with subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, text=True) as child:
            for text in child.stdout or ():
                found.append(json.loads(text))
                sys.stdout.write(line(found[-1]) + "\n")
                sys.stdout.flush()
        if child.returncode:
            return child.returncode
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        write_table(given.out / "frames.csv", pd.DataFrame(found))
        command_line = (
            f"python benchmarks/gpu_rendering.py --backends {' '.join(given.backends)} --runs {given.runs}"
        )
        write_json(given.out / "provenance.json", {**provenance(command_line), "gpu": device()})
    return 0


if __name__ == "__main__":
    sys.exit(main())
