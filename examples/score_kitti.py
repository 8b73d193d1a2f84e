"""Score the motion that rsbench finds on a folder in the layout of KITTI odometry.

python examples/score_kitti.py FOLDER [--left image_0 --right image_1] [--ratio 0] [--focal 1] [--every 1]

FOLDER holds calib.txt (projection matrices, the first two of the left and the right camera), poses.txt (3 x 4
matrices world_from_left, one line a frame) and two folders of rectified images. Global-shutter footage has the
readout ratio 0; --ratio none has it estimated, with the disparity offset, from windows spread over all. A wrong
--ratio or --focal (a factor) shows what becomes of a wrong card. When every window was solved, the last line tells
the drift. --trajectory fits one trajectory through all windows instead of a motion to each.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, CardSigma, RefusedFramesError, recalibrated
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.trajectory_estimate import stream_trajectory
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import FrameSource, read_frame
from rsbench.pipeline.frame_capture import know_matches, match_frames, with_found_camera
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import solve_frames
from rsbench.pipeline.sequence_capture import estimate_sequence_capture, spread_windows
from rsbench.vision.feature_matcher import load_features

Step = tuple[FloatArray, FloatArray]
"""Rotation (3, 3) and translation (3,), metres, of the body from one frame to the next."""


def read_matrices(path: Path) -> FloatArray:
    """(n, 3, 4) from lines of twelve numbers, with or without a name before them.

    Raises:
        RsbenchError: no such file, or a line of another length.
    """
    if not path.is_file():
        raise RsbenchError(f"{path}: no such file")
    lines = [line.rpartition(":")[2].split() for line in path.read_text("utf-8").splitlines() if line.strip()]
    try:
        matrices = np.array(lines, dtype=np.float64).reshape(-1, 3, 4)
    except ValueError:
        matrices = np.full((1, 3, 4), np.nan)
    if not np.all(np.isfinite(matrices)):
        raise RsbenchError(f"{path}: every line must hold twelve numbers")
    return matrices


def read_rig(folder: Path, image: Path, focal: float = 1.0) -> StereoRig:
    """Rig of a folder whose images are like this one, its focal length wrong by the factor ``focal``."""
    matrices = read_matrices(folder / "calib.txt")
    if len(matrices) < 2:
        raise RsbenchError(f"{folder / 'calib.txt'}: {len(matrices)} matrices; those of both cameras are needed")
    left, right = matrices[:2]
    height, width = read_frame(image).shape[:2]
    fx, fy, cx, cy = left[0, 0], left[1, 1], left[0, 2], left[1, 2]
    try:
        camera = PinholeCamera(width=width, height=height, fx=focal * fx, fy=focal * fy, cx=cx, cy=cy)
        return StereoRig(camera=camera, baseline=float(left[0, 3] - right[0, 3]) / fx)
    except ValueError as error:
        raise RsbenchError(f"{folder / 'calib.txt'}: {error}") from error


def true_motion(before: FloatArray, after: FloatArray, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and the body's translation (3,), metres, between two poses (3, 4) of the left camera."""
    R = after[:, :3].T @ before[:, :3]
    t = after[:, :3].T @ (before[:, 3] - after[:, 3])
    offset = rig.offset("left")
    return R, t - offset + R @ offset


def end_of(steps: Sequence[Step]) -> FloatArray:
    """Where the body is after some motions, (3,), in its first frame."""
    R, t = np.eye(3), np.zeros(3)
    for turn, d in steps:
        R, t = turn @ R, turn @ t + d
    return -R.T @ t


def drift(steps: Sequence[tuple[Step, Step]]) -> str:
    """Line about estimated and true motions of windows that follow each other."""
    found, true = zip(*steps, strict=True)
    path = sum(float(np.linalg.norm(d)) for _, d in true)
    off = float(np.linalg.norm(end_of(found) - end_of(true)))
    return f"drift {off:.2f} m over {path:.0f} m, {off / path:.1%}"


def readout_ratio(word: str) -> float | None:
    """From the command line; None for "none"."""
    try:
        ratio = None if word == "none" else float(word)
    except ValueError:
        ratio = math.nan
    if ratio is None or 0.0 <= ratio <= 1.0:
        return ratio
    raise argparse.ArgumentTypeError(f"{word!r} must be a number from 0 to 1, or none")


def factor(word: str) -> float:
    """Of the focal length, from the command line."""
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0.5 <= value <= 2.0:
        raise argparse.ArgumentTypeError(f"{word!r} must be a number from 0.5 to 2")
    return value


def step(word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word!r} must be a whole number above 0")
    return int(word)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--left", default="image_0")
    parser.add_argument("--right", default="image_1")
    parser.add_argument("--ratio", type=readout_ratio, default=0.0, help="readout ratio from 0 to 1, or none")
    parser.add_argument("--focal", type=factor, default=1.0, help="tried focal length over the card's, 0.5 to 2")
    parser.add_argument("--focal-sigma", type=float, default=0.0, help="px: how sure it is; it is then found")
    parser.add_argument("--k1-sigma", type=float, default=0.0, help="of the lens that undistortion left; likewise")
    parser.add_argument("--every", type=step, default=1, help="score every n-th window")
    parser.add_argument("--features", help="feature matcher, a name or a card; by default that of correct")
    parser.add_argument("--trajectory", action="store_true", help="one trajectory through all windows")
    given = parser.parse_args(arguments)
    try:
        sys.stdout.writelines(f"{line}\n" for line in score(given))
    except RsbenchError as error:
        sys.stderr.write(f"score_kitti: error: {error}\n")
        return 2
    return 0


def _along_one_trajectory(
    files: Sequence[Sequence[Path]],
    poses: FloatArray,
    rig: StereoRig,
    ratio: float,
    calibration: tuple[float, ...],
) -> list[str]:
    """Medians, drift, and the windows that the spline bridges."""
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=ratio)
    windows, options = list[Correspondences](), CorrectionOptions()
    for k in range(len(poses) - 1):
        images = {
            (side, n): read_frame(files[i][k + n]) for n in (0, 1) for i, side in enumerate(("left", "right"))
        }
        windows.append(recalibrated(match_frames(images, rig, options), rig, calibration))
    steps, errors, bridged = [], [], 0
    for window in stream_trajectory(windows, rig, shutter):
        R, d = true_motion(poses[window.number], poses[window.number + 1], rig)
        w_est, d_est = window.motion.w, window.motion.d
        steps.append(((so3.exp(w_est), d_est), (R, d)))
        bridged += not window.supported
        errors.append((rotation_error(w_est, so3.log(R)), translation_error(d_est, d)))
    median = np.rad2deg(np.median(errors, axis=0))
    return [
        "median  e_R {:.3f} deg  e_T {:.2f} deg".format(*median),
        drift(steps),
        f"{bridged} of {len(steps)} windows bridged",
    ]


def score(given: argparse.Namespace) -> list[str]:
    """Lines of the table, one a window, and the summary."""
    sources = [FrameSource(given.folder / name) for name in (given.left, given.right)]
    files = [sorted(path for path in source.path.iterdir() if path.is_file()) for source in sources]
    rig, options = read_rig(given.folder, files[0][0], given.focal), CorrectionOptions()
    if given.features:
        options = replace(options, features=load_features(given.features))
    poses = read_matrices(given.folder / "poses.txt")
    if not len(files[0]) == len(files[1]) == len(poses):
        raise RsbenchError(
            f"{given.folder}: {len(files[0])} left and {len(files[1])} right images, {len(poses)} poses"
        )
    ratio, lines, sigma = given.ratio, list[str](), CardSigma(focal=given.focal_sigma, k1=given.k1_sigma)
    inputs = KnownInputs(readout_ratio=ratio, sigma=sigma)
    rig, words = with_found_camera(rig, spread_windows(*sources), options, inputs)
    lines += [words] if words else []
    capture, calibration = None, NO_ERRORS
    try:
        capture, shutter = estimate_sequence_capture(sources[0], sources[1], rig, options, inputs)
        ratio = shutter.readout_ratio
    except RefusedFramesError:
        if ratio is None:
            raise  # else every window says so
    best = None if capture is None else capture.likeliest
    if capture is not None and best is not None:
        calibration = capture.calibration
        lines.append(f"readout ratio {best.ratio:.3f} +- {best.sigma:.3f}, {best.scans}")
        lines.append(f"disparity offset {capture.offset:+.2f} +- {capture.offset_sigma:.2f} px")
    if given.trajectory:
        return [*lines, *_along_one_trajectory(files, poses, rig, ratio, calibration)]
    rows, steps, refused = [], [], 0
    for k in range(0, len(poses) - 1, given.every):
        images = {
            (side, n): read_frame(files[i][k + n]) for n in (0, 1) for i, side in enumerate(("left", "right"))
        }
        try:
            inputs = KnownInputs(readout_ratio=ratio, calibration=calibration)
            matches = match_frames(images, rig, options)
            motion = solve_frames(know_matches(matches, rig, inputs, options), options)
        except RsbenchError as error:
            refused += 1
            lines.append(f"{k:4d}  {error}")
            continue
        R, d = true_motion(poses[k], poses[k + 1], rig)
        w_est, d_est = motion.motion.w, motion.motion.d
        steps.append(((so3.exp(w_est), d_est), (R, d)))
        rows.append(
            (
                np.rad2deg(rotation_error(w_est, so3.log(R))),
                np.rad2deg(translation_error(d_est, d)),
                np.linalg.norm(d_est) / np.linalg.norm(d) - 1.0,
            )
        )
        lines.append("{:4d}  e_R {:.3f} deg  e_T {:.2f} deg  length {:+.1%}".format(k, *rows[-1]))
    if rows:
        lines.append("median  e_R {:.3f} deg  e_T {:.2f} deg  length {:+.1%}".format(*np.median(rows, axis=0)))
    if len(rows) == len(poses) - 1:
        lines.append(drift(steps))
    return [*lines, f"{refused} of {len(rows) + refused} windows refused"]


if __name__ == "__main__":
    sys.exit(main())
