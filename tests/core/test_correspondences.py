"""Sets of matches, and tracks joined of left-right matches, against the points that they were made from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from differences import derivatives
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import (
    BEYOND_PX,
    JOIN_TOLERANCE_PX,
    Correspondences,
    join_stereo,
    lens_affine,
    nearest_within,
    repeated,
    temporal_pairs,
    unlinked_pairs,
    without_lens,
)
from rsbench.core.rig import StereoRig

COLUMNS = {"left": 4, "right": 4, "stereo_0": 4, "stereo_1": 4, "tracks": 8, "lines": 16}


def test_lists_become_float64_rows_and_absent_sets_are_empty_with_their_columns() -> None:
    nothing = Correspondences()
    for name, columns in COLUMNS.items():
        assert getattr(nothing, name).shape == (0, columns)
        for count in (0, 3):
            given: dict[str, Any] = {name: [list(range(columns))] * count}
            rows = getattr(Correspondences(**given), name)
            assert (rows.shape, rows.dtype) == ((count, columns), np.float64), name


def test_a_number_that_is_not_finite_is_named_by_set_and_match() -> None:
    for (name, columns), bad in zip(COLUMNS.items(), [np.nan, np.inf] * 3, strict=True):
        rows = np.ones((5, columns))
        rows[3, 1] = bad
        with pytest.raises(ValueError, match=rf"{name}\[3\] must be finite numbers, got .*{bad}"):
            Correspondences(**{name: rows})


@pytest.mark.parametrize("shape", [(3, 5), (4,), (2, 2, 4)])
def test_wrong_shapes_are_refused_with_the_right_one(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="left must have 4 numbers per match"):
        Correspondences(left=np.ones(shape))


def test_input_is_copied_and_the_copy_is_read_only() -> None:
    given = np.ones((2, 4))
    matches = Correspondences(left=given)
    given[0, 0] = 7.0
    assert matches.left[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        matches.left[0, 0] = 2.0


def test_gravity_without_a_direction_is_refused_by_its_row() -> None:
    with pytest.raises(ValueError, match=r"gravity\[1\] has no direction: gx, gy, gz are 0"):
        Correspondences(gravity=np.array([[0.0, 0.0, 9.8, 0.0], [1.0, 0.0, 0.0, 0.0]]))


def test_affine_frames_are_as_many_as_left_matches_or_none() -> None:
    frames = Correspondences(left=np.ones((3, 4)), affine=np.ones((3, 4)))
    assert frames.affine.shape == (3, 4) and Correspondences(left=np.ones((3, 4))).affine.shape == (0, 4)
    with pytest.raises(ValueError, match="affine has 2 rows and left 3: one each, or none"):
        Correspondences(left=np.ones((3, 4)), affine=np.ones((2, 4)))
    with pytest.raises(ValueError, match=r"affine\[1\] must be finite numbers"):
        Correspondences(left=np.ones((2, 4)), affine=np.diag([1.0, np.nan, 1.0, 1.0])[:2])


def test_affine_frames_without_the_lens_are_those_of_ideal_pixels() -> None:
    """Of a map of pixels to pixels of the distorted images, by differences between ideal pixels."""
    lens = Lens(model="brown-conrady", k1=-0.2, k2=0.05, p1=1e-3)
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=480.0, cx=320.0, cy=240.0, lens=lens)
    A, first = np.array([[0.9, -0.1], [0.2, 1.1]]), np.array([[120.0, 80.0], [500.0, 400.0]])
    second = first + 7.0
    given = Correspondences(
        left=np.hstack([first, second]), affine=np.tile(A.ravel(), (2, 1)), gyro=np.ones((1, 4))
    )
    ideal = without_lens(given, StereoRig(camera=camera, baseline=1.0))

    def mapped(pixels: np.ndarray) -> np.ndarray:
        return camera.ideal_pixels(second + (camera.lens_pixels(pixels) - first) @ A.T)

    numeric = derivatives(mapped, camera.ideal_pixels(first), 1e-4)
    np.testing.assert_allclose(ideal.affine.reshape(-1, 2, 2), numeric, atol=1e-7)
    np.testing.assert_array_equal(ideal.gyro, given.gyro)
    np.testing.assert_allclose(lens_affine(ideal.affine, given.left, camera), given.affine, atol=1e-12)


def points(count: int, seed: int = 0) -> np.ndarray:
    """Tracks (n, 8) whose ends lie 20 tolerances or more apart in every image, so that joining them is a fact."""
    rng = np.random.default_rng(seed)
    grid = 20 * JOIN_TOLERANCE_PX * rng.permuted(np.tile(np.arange(4 * count), (8, 1)), axis=1)[:, :count].T
    return grid + rng.uniform(0.0, JOIN_TOLERANCE_PX, grid.shape)


def as_sets(tracks: np.ndarray, noise: float, rng: np.random.Generator) -> Correspondences:
    """The tracks as pairwise matches, each set in an order and with an error of its own."""

    def scattered(columns: list[int]) -> np.ndarray:
        rows = tracks[:, columns]
        return rng.permutation(rows + rng.uniform(-noise, noise, rows.shape))

    return Correspondences(
        left=scattered([0, 1, 4, 5]),
        right=scattered([2, 3, 6, 7]),
        stereo_0=scattered([0, 1, 2, 3]),
        stereo_1=scattered([4, 5, 6, 7]),
    )


def in_order(tracks: np.ndarray) -> np.ndarray:
    return tracks[np.argsort(tracks[:, 0])]


@given(count=st.integers(0, 40), seed=st.integers(0, 1000), noise=st.sampled_from([0.0, 1e-9, 1e-6, 4e-3]))
def test_neither_order_nor_rounding_matter(count: int, seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    tracks = points(count, seed)
    joined = join_stereo(as_sets(tracks, noise, rng))
    np.testing.assert_allclose(in_order(joined.correspondences.tracks), in_order(tracks), atol=noise)
    assert joined.alone == {"stereo_0": 0, "stereo_1": 0} and joined.note == ""
    # All of the pairwise matches are now halves of tracks: each is one measurement.
    for side in ("left", "right"):
        assert not np.any(unlinked_pairs(joined.correspondences, side))
        assert len(temporal_pairs(joined.correspondences, side)) == count


@given(seed=st.integers(0, 1000))
def test_shared_ends_join_the_same_matches_in_any_order(seed: int) -> None:
    """Points that several matches claim, up to rounding: each left-right match joins one of them."""
    rng = np.random.default_rng(seed)
    tracks = points(12, 1)
    tracks[3:6, :2] = tracks[2, :2]
    tracks[8:10, 4:6] = tracks[7, 4:6]
    first, second = (join_stereo(as_sets(tracks, noise, rng)) for noise in (0.0, 1e-9))
    a, b = (np.array(sorted(np.round(joined.correspondences.tracks, 6).tolist())) for joined in (first, second))
    np.testing.assert_allclose(a, b, atol=2e-6)
    for rows in (a[:, :4], a[:, 4:]):
        assert len(np.unique(rows, axis=0)) == len(rows)


def test_the_tolerance_is_where_it_is_said_to_be() -> None:
    tracks = points(3)
    near, far = 0.99 * JOIN_TOLERANCE_PX, 1.01 * JOIN_TOLERANCE_PX
    for shift, count in ((near, 3), (-near, 3), (far, 0), (-far, 0)):
        c = Correspondences(
            left=tracks[:, [0, 1, 4, 5]], stereo_0=tracks[:, :4] + [shift, 0, 0, 0], stereo_1=tracks[:, 4:]
        )
        joined = join_stereo(c)
        assert len(joined.correspondences.tracks) == count
        assert joined.alone == {"stereo_0": 3 - count, "stereo_1": 3 - count}


def test_what_joins_nothing_is_counted_and_named() -> None:
    tracks = points(20)
    c = Correspondences(
        left=tracks[:10, [0, 1, 4, 5]],
        right=tracks[8:12, [2, 3, 6, 7]],
        stereo_0=tracks[5:, :4],
        stereo_1=tracks[:15, 4:],
    )
    joined = join_stereo(c)
    np.testing.assert_array_equal(
        joined.correspondences.tracks, tracks[5:12]
    )  # 5-9 by the left, 10-11 by the right
    assert joined.alone == {"stereo_0": 8, "stereo_1": 8}
    assert "8 of 15 stereo_0 and 8 of 15 stereo_1 matches join no match over time" in joined.note


def test_tracks_that_are_given_stay_first_and_take_their_matches() -> None:
    tracks = points(9)
    c = as_sets(tracks, 1e-6, np.random.default_rng(0))
    given_tracks = Correspondences(
        left=c.left, right=c.right, stereo_0=c.stereo_0, stereo_1=c.stereo_1, tracks=tracks[::2]
    )
    joined = join_stereo(given_tracks).correspondences
    np.testing.assert_array_equal(joined.tracks[:5], tracks[::2])
    np.testing.assert_allclose(in_order(joined.tracks), in_order(tracks), atol=1e-6)
    np.testing.assert_array_equal(join_stereo(joined).correspondences.tracks, joined.tracks)


@given(seed=st.integers(0, 1000))
def test_repeats_are_those_of_a_search_over_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Steps of half the tolerance: many coordinates lie just within it, none on it.
    rows, others = (0.5 * JOIN_TOLERANCE_PX * rng.integers(0, 6, (30, 4)).astype(np.float64) for _ in range(2))
    rows += 1e-6
    apart = np.max(np.abs(rows[:, None] - others[None]), axis=-1)
    np.testing.assert_array_equal(repeated(rows, others), np.any(apart <= JOIN_TOLERANCE_PX, axis=1))


@given(seed=st.integers(0, 10_000), columns=st.sampled_from([2, 4, 8]), count=st.sampled_from([1, 3]))
def test_nearest_within_finds_what_a_tree_finds(seed: int, columns: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    others = rng.integers(0, 4, (rng.integers(0, 40), columns)) + rng.uniform(-0.008, 0.008, columns)
    others += rng.uniform(-0.004, 0.004, others.shape)
    points = rng.integers(0, 4, (rng.integers(0, 40), columns)) + rng.uniform(-0.008, 0.008, columns)
    distance, index = nearest_within(points, others, count)
    assert distance.shape == index.shape == (len(points), count)
    if len(others):
        which = np.arange(1, count + 1)
        expected, place = cKDTree(others).query(points, k=which, p=np.inf, distance_upper_bound=BEYOND_PX)
        assert np.array_equal(distance, expected)
        assert np.array_equal(index[np.isfinite(distance)], np.asarray(place)[np.isfinite(expected)])
    else:
        assert np.isinf(distance).all()
