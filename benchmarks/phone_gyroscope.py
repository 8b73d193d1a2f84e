"""How near the rotations of one camera's corrected video come to a gyroscope that was not used.

The video is of a phone in a car, 103 frames of 800 x 600, with the samples of its gyroscope (MIT licence):

    git clone https://github.com/lhaippp/gyro-video-stabilization
    python benchmarks/phone_gyroscope.py gyro-video-stabilization/20200109_145447

The camera is given, as the repository states it, and its readout lasts the whole frame period. The offset between
the gyroscope's clock and that of the frames, and its bias, are those with which both agree best (least median
difference of the rotations over a frame period). Printed are quantiles over the pairs of corrected frames: the
difference of the rotation over a frame period, and the largest error of a row of the second frame about its middle
row, px at the focal length, beside the rotation itself (``uncorrected``).

With ``--ratio`` the readout ratio is estimated instead, from eight runs of 12 frames, with the camera given and
with nothing given. It is about 0.95: the frames give that without the dashboard, which is a third of the image.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation, Slerp

from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.camera_capture import find_shutter
from rsbench.pipeline.footage import OneCameraCard, read_frame
from rsbench.pipeline.mono_correction import FoundOwnMotion
from rsbench.pipeline.mono_sequence import correct_frames
from rsbench.solvers.engine.robust_motion import RobustOptions

Array = NDArray[np.float64]
CAMERA = PinholeCamera(width=800, height=600, fx=573.85, fy=575.04, cx=406.01, cy=309.01)
FIRST_FRAME, PERIOD_S = 99, 0.0333125
ROWS = 14
"""Of 20 rows per frame, those that show the road and not the dashboard, which moves with the phone."""
_RUN = 12
"""Frames from which a ratio is estimated."""
TAUS = np.linspace(0.0, 2.0, 41)


def estimated(folder: Path) -> dict[int, Rotation]:
    """The rotations body from world at ``TAUS`` of each corrected pair of frames, relative to its start."""
    files = sorted((folder / "reshape").glob("*.jpg"), key=lambda path: int(path.stem.split("-")[-1]))
    frames, shutter = (read_frame(path) for path in files), RollingShutter(height=CAMERA.height, readout_ratio=1.0)
    found = dict[int, Rotation]()
    for moment in correct_frames(frames, CAMERA, shutter):
        if moment.number > 0 and isinstance(moment.found, FoundOwnMotion) and moment.found.own.motion is not None:
            # A frame is corrected along the pair that ends with it.
            found[moment.number - 1] = Rotation.from_matrix(moment.found.own.motion.body_from_world(TAUS).R)
    return found


def print_ratios(folder: Path) -> None:
    """Print the readout ratio and focal length with their deviations, from runs of successive frames."""
    files = sorted((folder / "reshape").glob("*.jpg"), key=lambda path: int(path.stem.split("-")[-1]))
    for first in range(0, len(files) - _RUN + 1, _RUN):
        frames = [read_frame(path) for path in files[first : first + _RUN]]
        row = f"frames {first:3} to {first + _RUN:3}:"
        for name, camera in (("camera given", CAMERA), ("nothing given", None)):
            try:
                found = find_shutter(frames, len(frames), OneCameraCard.of(camera, None), RobustOptions())
            except NoMotionError as error:
                row += f" {name}: refused ({error});"
                continue
            assert found.capture is not None and found.capture.likeliest is not None
            ratio, focal = found.capture.likeliest, found.focal
            row += f" {name}: {ratio.ratio:.3f} +- {ratio.sigma:.3f} ({found.shutter.scan_of('left')})"
            row += ";" if focal is None else f", focal length {focal.focal:.0f} +- {focal.sigma:.0f} px;"
        sys.stdout.write(row + "\n")
        sys.stdout.flush()


def integrated(samples: Array) -> Slerp:
    """Rotations body from world at times in frame periods, from rates (n, 4) time, w of the camera."""
    steps = -0.5 * np.diff(samples[:, 0])[:, None] * (samples[1:, 1:] + samples[:-1, 1:])
    turns = [Rotation.identity()]
    for step in steps:
        turns.append(Rotation.from_rotvec(step) * turns[-1])
    return Slerp(samples[:, 0], Rotation.concatenate(turns))


def measured(samples: Array, pairs: Iterable[int], late: float) -> list[Rotation]:
    """``estimated`` for pairs by a gyroscope whose clock is late by so many frame periods."""
    at = integrated(samples - [late, 0.0, 0.0, 0.0])
    return [at(k + TAUS) * at(float(k)).inv() for k in pairs]


def differences(ours: list[Rotation], theirs: list[Rotation]) -> Array:
    """(n, 3) rotation vectors between the rotations over a frame period."""
    return np.array([(a[20] * b[20].inv()).as_rotvec() for a, b in zip(ours, theirs, strict=True)])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ratio", action="store_true", help="estimate the readout ratio")
    given = parser.parse_args()
    folder = given.folder
    for name in ("framestamp.txt", "gyro.txt", "reshape"):
        if not (folder / name).exists():
            parser.error(f"{folder}: there is no {name}; give the folder 20200109_145447 of the repository")
    if given.ratio:
        print_ratios(folder)
        return
    stamps, gyro = np.loadtxt(folder / "framestamp.txt"), np.loadtxt(folder / "gyro.txt", delimiter=",")
    times = (gyro[:, 3] - stamps[FIRST_FRAME]) / PERIOD_S
    samples = np.column_stack([times, -PERIOD_S * gyro[:, [1, 0, 2]]])[(times > -6.0) & (times < 115.0)]
    found = estimated(folder)
    ours = list(found.values())

    def apart(late: float) -> float:
        off = differences(ours, measured(samples, found, late))
        return float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1)))

    coarse = min(np.arange(-3.0, 3.1, 0.25), key=apart)
    late = float(minimize_scalar(apart, bounds=(coarse - 0.25, coarse + 0.25), method="bounded").x)
    for _ in range(2):  # the bias, in the camera's rotation body from world
        samples[:, 1:] -= np.median(differences(ours, measured(samples, found, late)), axis=0)
    truths = measured(samples, found, late)
    turned = np.rad2deg(np.linalg.norm(differences(ours, truths), axis=1))
    rows, uncorrected = [], []
    for own, truth in zip(ours, truths, strict=True):
        shown = range(20, 20 + ROWS)
        theirs = [truth[i] * truth[30].inv() for i in shown]
        errors = [(own[i] * own[30].inv() * each.inv()).magnitude() for i, each in zip(shown, theirs, strict=True)]
        rows.append(CAMERA.fx * max(errors))
        uncorrected.append(CAMERA.fx * max(each.magnitude() for each in theirs))
    for name, values in (("rotation, deg", turned), ("rows, px", rows), ("uncorrected, px", uncorrected)):
        median, many, most = np.quantile(values, [0.5, 0.9, 1.0])
        sys.stdout.write(f"{name}: median {median:.3f}, 90 % {many:.3f}, worst {most:.3f}\n")
    sys.stdout.write(f"{len(ours)} pairs; clock {late:+.2f} frame periods after the frames' stamps\n")


if __name__ == "__main__":
    main()
