"""Correctors that the correction study has on request, beside the others, with and without a translation.

Renders 18 small sequences (320 x 320, benchmarks/correctors.toml), runs the correction study on them with all its
methods, and prints the median of each motion over its scenes: PSNR on the pixels that the published methods cover,
flow error, and views without a correction.

    python benchmarks/correctors.py --out DIR
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from rsbench.benchmark.studies.correction_methods import METHODS, ON_REQUEST
from rsbench.benchmark.studies.correction_study import study_dataset
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.renderers.backend import start_backend

CARD = Path(__file__).with_suffix(".toml")
SHOWN = ("none", "gyro", "rotation", "gs-mono", "mono", *(method.key for method in ON_REQUEST), "ours", "truth")
MOTIONS = ("turn-mild", "turn-moderate", "turn-aggressive", "mild", "moderate", "aggressive")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="of the dataset, and of what is done of the study")
    folder = parser.parse_args(arguments).out
    data = folder / "data"
    if not (data / "dataset.json").exists():
        start_backend()
        generate_dataset(load_dataset_card(str(CARD)), data)
    others = tuple(method.key for method in ON_REQUEST)
    done = folder / "kept"
    views, _, _ = study_dataset(data, lambda name: None, kept=done, others=others)
    for line in table(pd.DataFrame(views)):
        sys.stdout.write(line + "\n")
    return 0


def table(views: pd.DataFrame) -> list[str]:
    """As Markdown: PSNR in dB / median flow error in px, and how many of the views have failed."""
    views["motion"] = views["sequence"].str.extract(r"^(?:castle|old-town|room)-(.*)$")
    titles = {method.key: method.title for method in (*METHODS, *ON_REQUEST)}
    lines = ["| method | " + " | ".join(MOTIONS) + " |", "|" + " --- |" * (1 + len(MOTIONS))]
    for key in SHOWN:
        cells = [_cell(views[(views["method"] == key) & (views["motion"] == motion)]) for motion in MOTIONS]
        lines.append(f"| {titles[key]} | " + " | ".join(cells) + " |")
    return lines


def _cell(own: pd.DataFrame) -> str:
    good = own[own["success"]]
    if not len(good):
        return f"all {len(own)} failed"
    lost = f" ({len(own) - len(good)} of {len(own)} failed)" if len(good) < len(own) else ""
    psnr, flow = (float(np.median(good[name])) for name in ("psnr_covered", "flow_median_px"))
    return f"{psnr:.1f} / {flow:.2f}{lost}"


if __name__ == "__main__":
    sys.exit(main())
