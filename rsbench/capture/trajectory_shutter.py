"""How the cameras of a rig read that shakes: a capture as the motion models give it of one that does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace

import numpy as np

from rsbench.capture.estimate import CERTAIN, MAX_SIGMA, Candidate, Capture, nearly_global
from rsbench.capture.scans import scans_of
from rsbench.capture.settle import shutter_found
from rsbench.capture.trajectory_data import is_of_one_camera
from rsbench.capture.trajectory_ratio import SequenceRatio, ratio_of_sequence
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning

LONGEST = 12
"""Successive windows that are looked at, at most: what is left open then is less than what noise leaves."""
_TOGETHER = tuple(Scanning(scan=scan) for scan in ("top", "bottom", "left", "right"))


def capture_of_sequence(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    scannings: Sequence[Scanning] | None = None,
    seed: int = 0,
) -> Capture:
    """The shutter from one trajectory through successive windows; motion models then have no part in it.

    Args:
        capture: what the motion models say, which is kept where no trajectory explains the tracks.
        windows: of the frames 0 and 1, 1 and 2, ...
        scannings: how the cameras may read; None: both alike, at once, from one of four sides, or as the motion
            models have it.
    """
    found = ratio_of_sequence(windows, rig, scannings or _scannings(capture), seed)
    if found is None:
        return capture
    candidate = _candidate(found, rig)
    # Nearly without a readout it is all the same where it begins.
    near = nearly_global(replace(capture, candidates=(replace(candidate, probability=1.0),)))
    candidate = candidate if near is None else near[0]
    doubt = ""
    if candidate.probability < CERTAIN or candidate.sigma > MAX_SIGMA:
        text = f"{candidate.ratio:.2f} +- {candidate.sigma:.2f}"
        doubt = f"{len(windows) + 1} frames in a row do not determine how fast: {text}"
    return replace(
        capture,
        candidates=(candidate,),
        models={},
        peaks={},
        reason=doubt,
        named=candidate.probability >= CERTAIN,
        windows=len(windows),
        matches=_matches(windows),
        used=found.used if is_of_one_camera(windows) else 2 * found.used,
        noise_px=found.noise_px,
    )


def shutter_of_sequence(windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> RollingShutter:
    """The shutter of cameras that read alike, from successive windows of any motion, of which some are looked at.

    Raises:
        NoMotionError: the matches do not tell it.
    """
    return shutter_found(capture_of_sequence(nothing_of(windows), windows[:LONGEST], rig, None, seed), rig)


def nothing_of(windows: Sequence[Correspondences]) -> Capture:
    """What is known of a shutter before anything is looked at."""
    pairs = [each.left if len(each.left) else each.tracks[:, [0, 1, 4, 5]] for each in windows]
    every = np.concatenate([*pairs, np.zeros((0, 4))])
    moved = float(np.median(np.linalg.norm(every[:, 2:] - every[:, :2], axis=1))) if len(every) else 0.0
    return Capture(
        candidates=(),
        models={},
        peaks={},
        reason="too few matches agree with any motion",
        named=False,
        windows=0,
        matches=0,
        used=0,
        noise_px=float("nan"),
        moved_px=moved,
    )


def _matches(windows: Sequence[Correspondences]) -> int:
    return sum(len(each.left) if is_of_one_camera(windows) else 2 * len(each.tracks) for each in windows)


def _scannings(capture: Capture) -> tuple[Scanning, ...]:
    best = capture.likeliest
    if best is None or best.scans.together or "global" in astuple(best.scans):
        return _TOGETHER
    return *_TOGETHER, Scanning(scan=best.scans.left, right_scan=best.scans.right)  # pyrefly: ignore[bad-argument-type]


def _candidate(found: SequenceRatio, rig: StereoRig) -> Candidate:
    shutter = found.scanning.shutter_of(rig.camera.width, rig.camera.height, 1.0)
    return Candidate(
        scans=scans_of(shutter),
        probability=found.probability,
        ratio=found.ratio,
        sigma=found.sigma,
        delay=found.scanning.right_delay,
        delay_sigma=0.0,
    )
