"""Faults planted into the channels of a sequence of four frames or more, all of them beyond the first two frames.

Each with the words that must name it. Frame 2 is views 4 and 5 of tracks, frame 3 views 6 and 7.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from attack.planting import Plant, cell
from channel_faults import Fault, array, classes, copy_of, fault, one_view
from numpy.typing import NDArray

from rsbench.dataset.channels import AFFINE, TRACKS, matches_file
from rsbench.dataset.clock_channels import MEASURED, TRUE, ImuSamples, gravity_of, write_imu
from rsbench.dataset.sequence import read_sequence

Array = NDArray[Any]


def swapped(values: Array) -> Array:
    """What belongs to frames 2 and 3 exchanged."""
    return values[:, [*range(4), 6, 7, 4, 5, *range(8, values.shape[1])]]


def swapped_frames(arrays: dict[str, Array]) -> None:
    arrays.update({name: swapped(arrays[name]) for name in ("pixels", "tau")})


def last_points_scaled(arrays: dict[str, Array]) -> None:
    """Those that were drawn from left 3."""
    arrays["points"][arrays["sources"] == 6] *= 1.001


def samples_of(change: Callable[[ImuSamples, Array], ImuSamples]) -> Plant:
    """``change`` gets the samples that lie beyond row 0 of frame 2."""

    def plant(folder: Path) -> None:
        sequence = read_sequence(folder)
        samples, imu, scene = sequence.inertial(), sequence.imu, sequence.manifest["scene"]
        late = samples.times_ns >= 2e9 * sequence.frame_period_s
        assert imu is not None and 20 < np.sum(late) < len(late) - 20
        write_imu(folder, imu, gravity_of(scene), change(samples, late))

    return plant


def shaken(samples: ImuSamples, late: Array) -> ImuSamples:
    """Twice the white noise."""
    white = samples.measured - samples.true - samples.bias
    return samples._replace(measured=samples.measured + white * late[:, None])


def _with_true(samples: ImuSamples, true: Array) -> ImuSamples:
    """Measured is true, bias and noise as before."""
    return samples._replace(true=true, measured=samples.measured + true - samples.true)


def late_by_a_sample(samples: ImuSamples, late: Array) -> ImuSamples:
    return _with_true(samples, np.where(late[:, None], np.roll(samples.true, 1, axis=0), samples.true))


def at_rest(samples: ImuSamples, late: Array) -> ImuSamples:
    """The body no longer turns."""
    true = samples.true.copy()
    true[late, :3] = 0.0
    return _with_true(samples, true)


def another_bias(samples: ImuSamples, late: Array) -> ImuSamples:
    """It jumps by a hundred of its steps."""
    jump = 100.0 * np.std(np.diff(samples.bias, axis=0), axis=0) * late[:, None]
    return samples._replace(bias=samples.bias + jump, measured=samples.measured + jump)


def stamped_late(samples: ImuSamples, late: Array) -> ImuSamples:
    return samples._replace(stamps_ns=samples.stamps_ns + 1000 * late)


FAULTS: dict[str, Fault] = {
    "matches moved by half a pixel": fault(
        matches_file(2), array("pixels", lambda pixels: pixels + 0.5), "not those of the point in their row"
    ),
    "matches with a tenth of the error": fault(
        matches_file(1), array("error", lambda error: 0.1 * error), "not the distance from the true pixel"
    ),
    "matches that are all hidden": fault(
        matches_file(2),
        array("classes", classes(1, 2)),
        "are marked hidden, but visible according to rs_depth/left_3.exr",
    ),
    # Of the depth at the keypoints, or else of the place.
    "matches of the frames before": copy_of(matches_file(1), matches_file(2), " not "),
    "tracks moved by 0.1 px": fault(
        TRACKS,
        array("pixels", one_view(7, lambda pixels: pixels + 0.1)),
        *("right_3", "not at the pixel in their row"),
    ),
    "tracks of another time": fault(
        TRACKS, array("tau", one_view(4, lambda tau: tau - 1.0)), "left_2", "another time than their row"
    ),
    "tracks of frames exchanged": fault(TRACKS, swapped_frames, "left_2", "points"),
    "tracks that are all hidden": fault(
        TRACKS,
        array("classes", one_view(5, classes(1, 2))),
        *("right_2", "are marked hidden, but visible according to rs_depth/right_2.exr"),
    ),
    "points of the last frame scaled": fault(
        TRACKS, last_points_scaled, "points are not at the pixel in their row"
    ),
    "affine frames transposed": fault(
        AFFINE, array("jacobians", one_view(6, lambda J: np.swapaxes(J, 1, 2))), "left_3", "looks transposed"
    ),
    "affine frames stretched": fault(
        AFFINE,
        array("jacobians", one_view(5, lambda J: J @ np.diag([1.0, 1.01]))),
        *("right_2", "not those of plane, motion and row times"),
    ),
    "affine frames exchanged": fault(
        AFFINE, array("jacobians", swapped), "left_3", "derivatives"
    ),  # present without a pixel, or of another frame
    "inertial samples a sample late": (
        samples_of(late_by_a_sample),
        (TRUE, "differs from what the motion makes"),
    ),
    "a body that no longer turns": (samples_of(at_rest), (TRUE, "gyroscope differs from what the motion makes")),
    "twice the noise": (samples_of(shaken), (MEASURED, "noise of the gyroscope is")),
    "a bias that jumps": (samples_of(another_bias), (TRUE, "steps of the bias of the")),
    "stamps that are late": (samples_of(stamped_late), (MEASURED, "stamp_ns differs by up to 1000 ns")),
    "one row timed late": fault("timing/left_3.csv", cell(21, 1, "322500002"), "row 20"),
    "exposure of no length": fault("timing/right_2.csv", cell(8, 3, "1"), "exposure_end_ns"),
    "timing of the frame before": copy_of("timing/left_2.csv", "timing/left_3.csv", "those of frame 2"),
}
