"""Run ``rsbench inspect``: estimate the shutter for the rigs of problems, frames and datasets."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from rsbench.capture.hypotheses import Known, scans_of
from rsbench.capture.shutter_decision import candidates_of
from rsbench.capture.two_frame_estimate import Capture, Window, conclude, examine
from rsbench.cli.console import echo, progress_bar
from rsbench.cli.correct_input import ReadoutOptions, frame_source, is_rendered, say_notes, sequence_files
from rsbench.components.motion_models import load_kernel
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.dataset.sequence import read_dataset_manifest, read_sequence
from rsbench.interop.readers.rig_files import read_rig_file
from rsbench.pipeline.footage import FrameSource, check_alike
from rsbench.pipeline.frame_capture import find_matches_of_rig, with_found_camera
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_chain import Isolation
from rsbench.pipeline.problem import read_problems
from rsbench.pipeline.sequence_capture import spread_windows
from rsbench.vision.feature_matcher import load_features


@dataclass(frozen=True, kw_only=True)
class InspectOptions:
    """Options that apply to all rigs."""

    models: tuple[str, ...]
    windows: int
    features: str
    seed: int
    readout: ReadoutOptions
    """Options of the readout, which replace that of the calibration; it is printed beside the estimate."""
    max_sigma: float

    @property
    def chain(self) -> CorrectionOptions:
        """Options with which frames are matched."""
        return CorrectionOptions(features=load_features(self.features), seed=self.seed)


Found = Iterator[dict[str, Any] | RsbenchError]
"""The answer for each rig, or the error if its input is invalid."""


def inspections(
    given: list[Path], rig: Path | None, left: Path | None, right: Path | None, options: InspectOptions
) -> Found:
    """Inspect the rigs of problems, frames or datasets; RsbenchError for an invalid combination of arguments."""
    for model in options.models:
        load_kernel(model)
    if rig is not None and not given and left is not None and right is not None:
        yield _of_frames(FrameSource(left), FrameSource(right), rig, options)
    elif rig is not None and len(given) == 4 and left is None and right is None:
        yield _of_frames(FrameSource.of_files(given[::2]), FrameSource.of_files(given[1::2]), rig, options)
    elif rig is not None or left is not None or right is not None or not given:
        raise RsbenchError(
            "input: give problems, or a dataset, or with --rig LEFT_0 RIGHT_0 LEFT_1 RIGHT_1 or --left and --right"
        )
    else:
        for path in given:
            yield from _of_dataset(path, options) if is_rendered(path) else _of_problems(path, options)


def _of_problems(path: Path, options: InspectOptions) -> Found:
    for problem in read_problems(str(path), sys.stdin):
        if isinstance(problem, RsbenchError):
            yield problem
            continue
        window = examine(problem.correspondences, problem.rig, Known(models=options.models), seed=options.seed)
        yield _record(problem.name, conclude([window], options.max_sigma), problem.known_shutter)


def _of_frames(left: FrameSource, right: FrameSource, card: Path, options: InspectOptions) -> dict[str, Any]:
    """Inspect a user's frames, whose card describes the rig. Uncertain intrinsics are estimated, and printed on
    stderr."""
    first, second = next(iter(left)), next(iter(right))
    readout = options.readout.beside(card, False, left.path)
    given, notes = read_rig_file(card, readout, lambda: (first.shape[1], first.shape[0]))
    say_notes("--rig", notes)
    rig = given.rig_of(first, second)
    ratio, scanning = given.readout_ratio, given.scanning
    with naming(card):
        shutter = None if ratio is None or scanning is None else rig.shutter_of(scanning, ratio)
    if given.inputs.sigma:
        shown = spread_windows(left, right)
        rig, words = with_found_camera(rig, shown, options.chain, given.inputs, progress_bar)
        echo(words, err=True)
    return _of_windows(card.stem, left, right, rig, shutter, options)


def _of_dataset(folder: Path, options: InspectOptions) -> Iterator[dict[str, Any]]:
    alone = (folder / "sequence.json").is_file()
    for each in [folder] if alone else [folder / name for name in read_dataset_manifest(folder).sequences]:
        sequence = read_sequence(each)
        left, right = (frame_source(files) for files in sequence_files(sequence))
        yield _of_windows(sequence.name, left, right, sequence.rig, sequence.shutter, options)


def _of_windows(
    name: str,
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    shutter: RollingShutter | None,
    options: InspectOptions,
) -> dict[str, Any]:
    """Inspect a rig by windows of two successive frames, evenly spaced in the sequence."""
    unknown = Scanning(scan="left")  # as if columns were read, so that matches may be on any rows
    every, windows = max((left.count - 1) // options.windows, 1), list[Window]()
    with Isolation() as isolation:
        chain = isolation.chain(options.chain)
        for number, pairs in enumerate(pairwise(zip(left, right, strict=False))):
            if number % every != 0 or number // every >= options.windows:
                continue
            images = {
                (side, frame): image
                for frame, pair in enumerate(pairs)
                for side, image in zip(SIDES, pair, strict=True)
            }
            check_alike({f"{side} frame {number + frame}": image for (side, frame), image in images.items()})
            matches = find_matches_of_rig(images, rig, unknown, chain)
            windows.append(examine(matches, rig, Known(models=options.models), seed=options.seed))
    return _record(name, conclude(windows, options.max_sigma), shutter)


def _record(name: str, found: Capture, given: RollingShutter | None) -> dict[str, Any]:
    """Return the JSON answer for one rig; undetermined values are null."""
    named, best = (found.likeliest if known else None for known in (found.named, found.determined))
    said = None
    if given is not None:
        scans = scans_of(given)
        said = {"left": scans.left, "right": scans.right, "readout_ratio": given.readout_ratio}
    return {
        "name": name,
        "told": found.determined,
        "left": None if named is None else named.scans.left,
        "right": None if named is None else named.scans.right,
        "readout_ratio": None if best is None else best.ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "right_delay": None if best is None else best.delay,
        "right_delay_sigma": None if best is None else best.delay_sigma,
        "probability": None if named is None else named.probability,
        "reason": found.reason,
        "candidates": candidates_of(found),
        "motion_model": found.motion_model or None,
        "windows": found.windows,
        "matches": found.matches,
        "used": found.used,
        "noise_px": found.noise_px if found.used else None,
        "moved_px": found.moved_px,
        "said": said,
    }


def row_of(answer: dict[str, Any]) -> dict[str, str]:
    """Return the table cells of an answer, by column."""
    given, determined = answer["said"], answer["told"]
    late = determined and abs(answer["right_delay"]) > max(3.0 * answer["right_delay_sigma"], 0.01)
    note = f"right camera late by {answer['right_delay']:+.3f} frame periods" if late else answer["reason"]
    ratio = "-" if {answer["left"], answer["right"]} == {"global"} else "cannot tell"
    if determined and answer["readout_ratio"] > 0.0:
        ratio = f"{answer['readout_ratio']:.3f} +- {answer['readout_ratio_sigma']:.3f}"
    return {
        "rig": answer["name"],
        "left": answer["left"] or "cannot tell",
        "right": answer["right"] or "cannot tell",
        "readout ratio": ratio,
        "given": "-" if given is None else f"{given['left']}, {given['right']}, {given['readout_ratio']:.2f}",
        "matches": f"{answer['used']}/{answer['matches']}",
        "moved (px)": f"{answer['moved_px']:.1f}",
        "note": note,
    }
