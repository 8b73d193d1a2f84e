"""The quick benchmarks, each beside its anchor in the same run; writes results/speed and the table of speed.

Each row is a quotient of processor times: of our work over an anchor, run in turn, so that another program on the
machine slows both alike. Printed are the median, the lowest and the highest of the runs, and the limit: what the
code of today keeps with room for a busy machine. The program exits with 1 where a median is above its limit. With
--write the figures go into results/speed, with their provenance, and the table into docs/results-speed.md.

    python benchmarks/all.py --write
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy loads

import numpy as np
import pandas as pd

from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.benchmark.provenance import provenance
from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.rig import VIEWS
from rsbench.storage.files import write_bytes, write_json, write_table

if TYPE_CHECKING:
    from rsbench.pipeline.frame_depth import CorrectionOptions

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "results/speed", ROOT / "docs/results-speed.md"
START, END = "<!-- The table of benchmarks/all.py -->\n", "<!-- End of the table -->\n"
COLUMNS = ["row", "anchor", "median", "lowest", "highest", "runs", "limit"]
Work = Callable[[], object]
SOLVERS = ("--solver", "rs-stereo-refined", "--solver", "gs-8pt", "--solver", "rs-stereo-linear")
OPTIONS = EvaluationOptions(solvers=SOLVERS[1::2])


@dataclass(frozen=True, kw_only=True)
class Row:
    """One quotient."""

    name: str
    anchor: str
    limit: float
    runs: int
    prepare: Callable[[], tuple[Work, Work]]
    """Makes our work and that of the anchor, both warm."""


def cpu(work: Work) -> float:
    """Processor seconds, of all threads and of the processes that end meanwhile."""
    begin = time.process_time(), sum(os.times()[2:4])
    work()
    return time.process_time() - begin[0] + sum(os.times()[2:4]) - begin[1]


def rolling_over_global() -> tuple[Work, Work]:
    """A frame 900 x 900 of 16 samples."""
    import render_rs_vs_gs

    from rsbench.core.camera import PinholeCamera
    from rsbench.core.shutter import RollingShutter
    from rsbench.renderers.options import RendererOptions

    camera, shutter = PinholeCamera.centred(900, 900, 810.0), RollingShutter(height=900, readout_ratio=0.8)
    calls = render_rs_vs_gs.kinds(render_rs_vs_gs.boxes(), camera, shutter, RendererOptions(samples=16))
    ours, anchor = calls[render_rs_vs_gs.ROLLING], calls[render_rs_vs_gs.GLOBAL]
    ours(), anchor()
    return ours, anchor


def chain_over_opencv(data: Path) -> tuple[Work, Work]:
    """Four frames 900 x 900 corrected as by default, over the features and disparities that any chain needs."""
    import correct_chain

    from rsbench.dataset.sequence import read_dataset

    sequence, options = next(iter(read_dataset(data))), default_options()
    anchor = correct_chain.opencv_alone(sequence)
    correct_chain.run(sequence, options)
    anchor()
    return lambda: correct_chain.run(sequence, options), anchor


def warp_over_remap() -> tuple[Work, Work]:
    """A float32 frame 900 x 900 with its depth, one core."""
    import warp

    return warp.both(900)


def motion_over_poselib(solver: str) -> Callable[[], tuple[Work, Work]]:
    """1000 matches, 50 % outliers, 0.3 px, to 99 %, five problems."""

    def prepare() -> tuple[Work, Work]:
        import solve_speed

        options = solve_speed.SimulationOptions(tracks=1000, noise_px=0.3, outlier_ratio=0.5)
        cases = [case.correspondences for case in solve_speed.problems(options, 5)]
        solve = solve_speed.ours(solver)
        solve(cases[0]), solve_speed.poselib_stereo(cases[0])
        return lambda: list(map(solve, cases)), lambda: list(map(solve_speed.poselib_stereo, cases))

    return prepare


def again_over_first(folder: Path) -> tuple[Work, Work]:
    """``evaluate`` of the card smoke with three solvers."""
    from rsbench.benchmark.images.evaluation import open_evaluation
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import generate_dataset
    from rsbench.report.evaluation_page import write_report
    from rsbench.vision.dense_matcher import forget_matches

    generate_dataset(load_dataset_card("smoke"), folder / "smoke")

    def evaluate(out: Path) -> None:
        open_evaluation(folder / "smoke", out, OPTIONS).run("benchmark", lambda word: None)
        write_report(folder / "smoke", out)

    def first() -> None:
        forget_matches()
        evaluate(Path(tempfile.mkdtemp(dir=folder)))

    evaluate(folder / "kept")
    return lambda: evaluate(folder / "kept"), first


def command_over_generate(folder: Path, *words: str) -> tuple[Work, Work]:
    """A command on the sequence castle of the card paper, and ``generate`` of it."""
    number = count()

    def run(*command: str) -> None:
        quiet = subprocess.DEVNULL
        subprocess.run([sys.executable, "-m", "rsbench", *command], stdout=quiet, stderr=quiet, check=True)

    def make() -> Path:
        place = folder / f"castle{next(number)}"
        run("generate", "paper", "--sequence", "castle", "--out", str(place))
        return place

    made = make()
    return lambda: run(
        words[0], str(made), *(each.format(folder / f"out{next(number)}") for each in words[1:])
    ), make


def default_options() -> CorrectionOptions:
    """The options of ``rsbench correct``."""
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.vision.feature_matcher import load_features

    return CorrectionOptions(features=load_features("dense"), motion_model="auto")


def inspect_over_opencv(data: Path) -> tuple[Work, Work]:
    """``inspect`` of four frames 900 x 900 of which nothing is known, in memory."""
    import correct_chain

    from rsbench.capture.shutter_decision import known_of
    from rsbench.capture.two_frame_estimate import conclude, examine
    from rsbench.dataset.sequence import read_dataset
    from rsbench.pipeline.frame_capture import match_given
    from rsbench.vision.dense_matcher import forget_matches

    sequence, options = next(iter(read_dataset(data))), default_options()
    images, anchor = {view: sequence.image("rs", *view) for view in VIEWS}, correct_chain.opencv_alone(sequence)

    def inspect() -> None:
        forget_matches()
        matches = match_given(images, sequence.rig, options, KnownInputs())[0]
        conclude(
            [examine(matches, sequence.rig, known_of(matches, sequence.rig, KnownInputs()), options.robust, 0)]
        )

    inspect(), anchor()
    return inspect, anchor


def rows(data: Path, folder: Path) -> Iterator[Row]:
    """In the order of the table; ``data`` has a sequence of frames 900 x 900."""
    yield Row(
        name="rolling-shutter frame, 900 x 900, 16 samples",
        anchor="global-shutter frame",
        limit=1.1,
        runs=7,
        prepare=rolling_over_global,
    )
    yield Row(
        name="four frames 900 x 900 corrected, in memory",
        anchor="OpenCV: SIFT of four, SGBM of two pairs",
        limit=6.0,
        runs=3,
        prepare=lambda: chain_over_opencv(data),
    )
    yield Row(
        name="one float32 frame 900 x 900 warped with its depth",
        anchor="OpenCV: cubic remap",
        limit=6.0,
        runs=9,
        prepare=warp_over_remap,
    )
    for solver, limit in (("rs-stereo-refined", 2.0), ("rs-stereo-refined-pairs", 10.0)):
        yield Row(
            name=f"robust motion, 1000 matches, 50 % outliers: `{solver}`",
            anchor="PoseLib: generalised RANSAC",
            limit=limit,
            runs=5,
            prepare=motion_over_poselib(solver),
        )
    yield Row(
        name="`inspect`, four frames 900 x 900, nothing known",
        anchor="OpenCV: SIFT of four, SGBM of two pairs",
        limit=5.0,
        runs=3,
        prepare=lambda: inspect_over_opencv(data),
    )
    yield Row(
        name="`verify` of a sequence of `paper`",
        anchor="`generate` of it",
        limit=1.0,
        runs=3,
        prepare=lambda: command_over_generate(folder, "verify"),
    )
    yield Row(
        name="`evaluate` of a sequence of `paper`, three solvers",
        anchor="`generate` of it",
        limit=2.0,
        runs=3,
        prepare=lambda: command_over_generate(folder, "evaluate", *SOLVERS, "--out", "{}"),
    )
    yield Row(
        name="`evaluate` of `smoke` again, nothing changed",
        anchor="the first time",
        limit=0.25,
        runs=3,
        prepare=lambda: again_over_first(folder),
    )


def measured(row: Row) -> dict[str, object]:
    """Of the columns."""
    ours, anchor = row.prepare()
    found = [cpu(ours) / cpu(anchor) for _ in range(row.runs)]
    numbers = {"median": np.median(found), "lowest": min(found), "highest": max(found)}
    return {"row": row.name, "anchor": row.anchor, **numbers, "runs": row.runs, "limit": row.limit}


def line(row: dict[str, object]) -> str:
    held = "holds" if float(str(row["median"])) <= float(str(row["limit"])) else "FAILS"
    spread = f"{row['median']:.2f} [{row['lowest']:.2f}, {row['highest']:.2f}]"
    return f"{row['row']}: {spread} times {row['anchor']} (limit {row['limit']:g}: {held})"


def table(found: pd.DataFrame) -> str:
    """In Markdown."""
    lines = ["| what | over | times [lowest, highest] | limit |", "| --- | --- | --- | --- |"]
    for row in found.to_dict("records"):
        spread = f"{row['median']:.2f} [{row['lowest']:.2f}, {row['highest']:.2f}]"
        lines.append(f"| {row['row']} | {row['anchor']} | {spread} | {row['limit']:g} |")
    return "\n".join(lines) + "\n"


def with_table(page: str, found: pd.DataFrame) -> str:
    """A page with the table between ``START`` and ``END``."""
    before, _, rest = page.partition(START)
    return f"{before}{START}\n{table(found)}\n{END}{rest.partition(END)[2]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/paper"), help="dataset; rendered when missing")
    parser.add_argument("--write", action="store_true", help="into results/speed and docs/results-speed.md")
    given = parser.parse_args()
    if not (given.data / "dataset.json").is_file():
        from rsbench.cli.generate import generate

        generate("paper", str(given.data), None, workers=1)
    found = list[dict[str, object]]()
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(given.data, Path(folder)):
            found.append(measured(row))
            sys.stdout.write(line(found[-1]) + "\n")
            sys.stdout.flush()
    if given.write:
        RESULTS.mkdir(parents=True, exist_ok=True)
        write_table(RESULTS / "speed.csv", pd.DataFrame(found, columns=COLUMNS))
        write_json(RESULTS / "provenance.json", provenance("python benchmarks/all.py --write"))
        read = pd.read_csv(RESULTS / "speed.csv")
        write_bytes(PAGE, with_table(PAGE.read_text("utf-8"), read).encode())
    return int(any("FAILS" in line(row) for row in found))


if __name__ == "__main__":
    sys.exit(main())
