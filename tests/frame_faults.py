"""Faults planted into the channels of a sequence of four frames or more, all of them beyond the first two frames.

Each with the words that must name it. Frame 2 is views 4 and 5 of tracks, frame 3 views 6 and 7.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from channel_faults import affine_of, arrays_of, copied, one_view, table_of, tracks_of
from numpy.typing import NDArray

from rsbench.dataset.channels import AFFINE, TRACKS, matches_file
from rsbench.dataset.imu import MEASURED, TRUE, ImuSamples, gravity_of, write_imu
from rsbench.dataset.sequence import read_sequence

Plant = Callable[[Path], None]
Words = tuple[str, ...]
Array = NDArray[Any]


def matches_of(first: int, name: str, change: Callable[[Array], Array]) -> Plant:
    return arrays_of(matches_file(first), lambda arrays: arrays.update({name: change(arrays[name])}))


def swapped(values: Array) -> Array:
    """What belongs to frames 2 and 3 exchanged."""
    return values[:, [*range(4), 6, 7, 4, 5, *range(8, values.shape[1])]]


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


def late_by_a_sample(samples: ImuSamples, late: Array) -> ImuSamples:
    """Measured is true, bias and noise as before."""
    true = np.where(late[:, None], np.roll(samples.true, 1, axis=0), samples.true)
    return samples._replace(true=true, measured=samples.measured + true - samples.true)


def at_rest(samples: ImuSamples, late: Array) -> ImuSamples:
    """The body no longer turns."""
    true = samples.true.copy()
    true[late, :3] = 0.0
    return samples._replace(true=true, measured=samples.measured + true - samples.true)


def another_bias(samples: ImuSamples, late: Array) -> ImuSamples:
    """It jumps by a hundred of its steps."""
    jump = 100.0 * np.std(np.diff(samples.bias, axis=0), axis=0) * late[:, None]
    return samples._replace(bias=samples.bias + jump, measured=samples.measured + jump)


def stamped_late(samples: ImuSamples, late: Array) -> ImuSamples:
    return samples._replace(stamps_ns=samples.stamps_ns + 1000 * late)


FAULTS: dict[str, tuple[Plant, Words]] = {
    "matches moved by half a pixel": (
        matches_of(2, "pixels", lambda pixels: pixels + 0.5),
        (matches_file(2), "not those of the point in their row"),
    ),
    "matches with a tenth of the error": (
        matches_of(1, "error", lambda error: 0.1 * error),
        (matches_file(1), "not the distance from the true pixel"),
    ),
    "matches that are all hidden": (
        matches_of(2, "classes", lambda classes: np.where(classes == 1, 2, classes).astype(np.uint8)),
        (matches_file(2), "are marked hidden, but visible according to rs_depth/left_3.exr"),
    ),
    "matches of the frames before": (
        copied(matches_file(1), matches_file(2)),
        (matches_file(2), " not "),  # the depth at the keypoints, or else the place
    ),
    "tracks moved by 0.1 px": (
        tracks_of("pixels", one_view(7, lambda pixels: pixels + 0.1)),
        (TRACKS, "right_3", "not at the pixel in their row"),
    ),
    "tracks of another time": (
        tracks_of("tau", one_view(4, lambda tau: tau - 1.0)),
        (TRACKS, "left_2", "another time than their row"),
    ),
    "tracks of frames exchanged": (
        arrays_of(TRACKS, lambda arrays: arrays.update({n: swapped(arrays[n]) for n in ("pixels", "tau")})),
        (TRACKS, "left_2", "points"),
    ),
    "tracks that are all hidden": (
        tracks_of("classes", one_view(5, lambda classes: np.where(classes == 1, 2, classes))),
        (TRACKS, "right_2", "are marked hidden, but visible according to rs_depth/right_2.exr"),
    ),
    "points of the last frame scaled": (
        arrays_of(TRACKS, last_points_scaled),
        (TRACKS, "points are not at the pixel in their row"),
    ),
    "affine frames transposed": (
        affine_of("jacobians", one_view(6, lambda J: np.swapaxes(J, 1, 2))),
        (AFFINE, "left_3", "looks transposed"),
    ),
    "affine frames stretched": (
        affine_of("jacobians", one_view(5, lambda J: J @ np.diag([1.0, 1.01]))),
        (AFFINE, "right_2", "not those of plane, motion and row times"),
    ),
    "affine frames exchanged": (
        affine_of("jacobians", swapped),
        (AFFINE, "left_3", "derivatives"),  # present without a pixel, or of another frame
    ),
    "inertial samples a sample late": (
        samples_of(late_by_a_sample),
        (TRUE, "differs from what the motion makes"),
    ),
    "a body that no longer turns": (samples_of(at_rest), (TRUE, "gyroscope differs from what the motion makes")),
    "twice the noise": (samples_of(shaken), (MEASURED, "noise of the gyroscope is")),
    "a bias that jumps": (samples_of(another_bias), (TRUE, "steps of the bias of the")),
    "stamps that are late": (samples_of(stamped_late), (MEASURED, "stamp_ns differs by up to 1000 ns")),
    "one row timed late": (table_of("left_3", 20, 1, "322500002"), ("timing/left_3.csv", "row 20")),
    "exposure of no length": (table_of("right_2", 7, 3, "1"), ("timing/right_2.csv", "exposure_end_ns")),
    "timing of the frame before": (
        copied("timing/left_2.csv", "timing/left_3.csv"),
        ("timing/left_3.csv", "those of frame 2"),
    ),
}
