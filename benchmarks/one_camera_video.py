"""What the frames around it, and a second camera, are worth to a frame of one camera's video.

PSNR in dB over all pixels of a left frame at the time of its middle row (``twins = ["middle"]``), the mean of the
frames but the first: as it is; by ``mono-fusion`` from it and the frame before alone, under a law of motion; from
the whole video, along one way; and by ``fusion`` from the videos of both cameras. All as ``rsbench correct`` does
by default, narrow holes closed.

    rsbench generate handheld --out data/handheld
    python benchmarks/one_camera_video.py --data data/handheld
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.arrays import options_of
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.mono_sequence import correct_frames, options_of_camera
from rsbench.pipeline.sequence_capture import CorrectedMoment
from rsbench.pipeline.sequence_correction import correct_sequence
from rsbench.vision.fusion import finished

WAYS = ("uncorrected", "two frames", "video", "both cameras")


def psnr(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((image.astype(np.float64) - truth) ** 2)))


def scores(sequence: Sequence, most: int) -> Iterator[list[float]]:
    """Of the WAYS, for every frame but the first."""
    count = min(sequence.frames, most)
    row = sequence.rig.camera.height // 2
    frames = [sequence.image("rs", "left", frame) for frame in range(count)]
    options = options_of_camera(None, 0, float(row))

    def alone(some: list[NDArray[np.uint8]]) -> list[CorrectedMoment]:
        return list(correct_frames(some, sequence.rig.camera, sequence.shutter, options))

    video = alone(frames)
    files = [[sequence.folder / picture_file("rs", side, frame) for frame in range(count)] for side in SIDES]
    chosen = options_of("rs-stereo-refined", "auto", "sgm", "sift-refined", "fusion", target_row=float(row))
    known = KnownCapture(rig=sequence.rig, shutter=sequence.shutter)
    rig = correct_sequence([FrameSource.of_files(each) for each in files], known, chosen)
    for k, moment in enumerate(rig):
        if k == 0:
            continue
        two = alone(frames[k - 1 : k + 1])[1].shown["left"].image
        both = finished(moment.frames["left"]).image if "left" in moment.frames else frames[k]
        truth = sequence.image("gs", "left", k, row)
        yield [psnr(image, truth) for image in (frames[k], two, video[k].shown["left"].image, both)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="sequences in whose name this is")
    parser.add_argument("--frames", type=int, default=10**6, help="of each sequence, at most")
    given = parser.parse_args()
    try:
        chosen = [sequence for sequence in read_dataset(given.data) if given.only in sequence.name]
    except RsbenchError as error:
        parser.error(str(error))
    if not chosen:
        parser.error(f"--only {given.only!r}: is in no sequence's name")
    if given.frames < 4:
        parser.error(f"--frames {given.frames}: must be 4 or more")
    for each in chosen:
        if each.frames < 4 or each.rig.camera.height // 2 not in each.twins:
            parser.error(f"{each.name}: needs 4 frames and more, and their truth at the middle row (twins)")
    sys.stdout.write(f"{'sequence':24} {'frames':>6} " + " ".join(f"{way:>12}" for way in WAYS) + "  least gain\n")
    for sequence in chosen:
        found = np.array(list(scores(sequence, given.frames)))
        least = float(np.min(found[:, 2] - found[:, 0]))
        means = " ".join(f"{each:12.2f}" for each in found.mean(axis=0))
        sys.stdout.write(f"{sequence.name:24} {len(found):6} {means}  {least:10.2f}\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
