"""Focal length and k1 found from frames that other code traced (``foreign_frames.py``), where the rig's card errs.

The card's focal length is made 5 % too long and its k1 too large by 0.03, also of cameras without a lens; it says
that they are known to 10 % and 0.05. A line a case, and how far off, in stated deviations, they all are.

    python benchmarks/wrong_cards.py --data data/foreign --seeds 3 --rows twist lens
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from foreign_frames import ROWS, picture, write_case
from foreign_world import read_photographs

from rsbench.capture.calibration import CardSigma
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.self_calibration import FoundCamera
from rsbench.core.camera import Lens
from rsbench.core.rig import SIDES, StereoRig
from rsbench.pipeline.footage import read_frame, read_rig_card
from rsbench.pipeline.frame_capture import camera_of_frames
from rsbench.pipeline.frame_depth import CorrectionOptions

_LONGER, _LARGER = 1.05, 0.03
_SURE, _SURE_K1 = 0.1, 0.05


def true_and_found(folder: Path) -> tuple[StereoRig, FoundCamera]:
    """The rig of a case, and what was found of it by a card that errs."""
    images = {(side, frame): read_frame(picture(folder, 2, side, frame)) for frame in (0, 1) for side in SIDES}
    height, width = images["left", 0].shape[:2]
    rig = read_rig_card(folder / "untold.toml").rig((width, height))
    camera, lens = rig.camera, rig.camera.lens or Lens(model="brown-conrady")
    wrong = replace(lens, k1=lens.k1 + _LARGER)
    camera = replace(camera, fx=_LONGER * camera.fx, fy=_LONGER * camera.fy, lens=wrong)
    sigma = CardSigma(focal=_SURE * camera.fx, k1=_SURE_K1)
    given = replace(rig, camera=camera)
    found = camera_of_frames([images], given, CorrectionOptions(), KnownInputs(sigma=sigma))
    return rig, found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the cases; missing ones are rendered")
    parser.add_argument("--rows", nargs="+", default=["twist", "lens"], choices=ROWS)
    parser.add_argument("--seeds", type=int, default=3)
    given, deviations = parser.parse_args(), []
    write = sys.stdout.write
    write("case        focal length off by (%)   deviations     k1 off by  deviations\n")
    for row in given.rows:
        for seed in range(given.seeds):
            folder = given.data / f"{row}-{seed}"
            if not (folder / "truth.json").is_file():
                write_case(row, seed, folder, read_photographs(None))
            rig, found = true_and_found(folder)
            camera, lens = found.rig.camera, found.rig.camera.lens
            focal = camera.fx - rig.camera.fx
            k1 = (lens.k1 if lens else 0.0) - (rig.camera.lens.k1 if rig.camera.lens else 0.0)
            off = np.where(found.determined, (focal / found.sigma.focal, k1 / found.sigma.k1), math.nan)
            deviations.append(off)
            percent = 100.0 * focal / rig.camera.fx
            write(f"{row}-{seed:<12} {percent:+18.2f} {off[0]:+12.1f} {k1:+13.4f} {off[1]:+11.1f}\n")
            sys.stdout.flush()
    for name, off in zip(("focal length", "k1"), np.transpose(deviations), strict=True):
        told = np.abs(off[np.isfinite(off)])
        rms = float(np.sqrt(np.mean(told**2))) if len(told) else math.nan
        write(f"{name}: told in {len(told)} of {len(off)}; root mean square of the deviations {rms:.2f}, ")
        write(f"worst {np.max(told, initial=0.0):.1f}\n")


if __name__ == "__main__":
    main()
