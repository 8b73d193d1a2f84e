"""Matches of a sequence for a viewer, as lines whose colours show whether they are correct."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.rig import VIEWS
from rsbench.core.so3 import FloatArray
from rsbench.dataset.point_channels import MATCHED, MatchClass
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.sequence_views import View
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.vision.feature_matcher import load_features

_UNJUDGED, _RIGHT, _WRONG = (86, 180, 233), (0, 158, 115), (213, 94, 0)
"""Colours that colour-blind readers can distinguish."""
_NAMES = {"left": "matches", "right": "matches", "stereo_0": "stereo", "stereo_1": "stereo"}


class Strips(NamedTuple):
    """Matches drawn on one image."""

    name: str
    """``matches`` over time, ``stereo`` from left to right."""
    view: View
    pixels: FloatArray
    """(n, 2, 2) px of both ends."""
    colours: NDArray[np.uint8]
    """(n, 3) sRGB."""


class Scene(NamedTuple):
    """A sequence and the parts of it that the viewer shows."""

    sequence: Sequence
    strips: tuple[Strips, ...]
    points: int
    """Most points of each depth map."""


def labelled_strips(sequence: Sequence) -> Iterator[Strips]:
    """Yield the channel ``matches``, correct ones green and others orange, up to the last frame.

    Raises:
        RsbenchError: the sequence has no such channel, or it cannot be read.
    """
    for first in range(sequence.frames - 1):
        found = sequence.matches(first)
        for number, (set_name, (start, _)) in enumerate(MATCHED.items()):
            if set_name == "stereo_1" and first + 2 < sequence.frames:
                continue  # it is ``stereo_0`` of the next two frames
            own = found.of_pair(number)
            right = own.classes[:, None] == MatchClass.RIGHT
            colours = np.where(right, _RIGHT, _WRONG).astype(np.uint8)
            yield Strips(_NAMES[set_name], View(start[0], first + start[1]), own.pixels, colours)


def found_strips(sequence: Sequence, features: str) -> Iterator[Strips]:
    """Find matches in the first two frames with a feature matcher, without ground truth.

    Raises:
        RsbenchError: no such feature matcher.
    """
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    options = CorrectionOptions(features=load_features(features))
    found = find_matches_of_rig(images, sequence.rig, sequence.shutter.scanning, options)
    for set_name, (start, _) in MATCHED.items():
        pixels: FloatArray = getattr(found, set_name).reshape(-1, 2, 2)
        colours = np.broadcast_to(np.array(_UNJUDGED, dtype=np.uint8), (len(pixels), 3))
        yield Strips(_NAMES[set_name], View(*start), pixels, colours)


def line_seconds(sequence: Sequence, view: View) -> FloatArray:
    """Return the times (lines,) of an image's lines, s, in the order of the image."""
    return sequence.frame_period_s * sequence.shutter.line_times(view.frame, view.side)
