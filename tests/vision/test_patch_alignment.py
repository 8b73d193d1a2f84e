"""Alignment of patches, against images that are given by a formula, so that every place in them is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences, unlinked_pairs
from rsbench.core.rig import SIDES, View
from rsbench.vision.patch_alignment import aligned, refine_matches, smoothed

_SIZE = 96
_WAVES = np.random.default_rng(5).uniform(-0.55, 0.55, (24, 2))
"""Angular frequencies, per px: waves of 11 px and more, which the smoothing leaves."""
_PHASES = np.random.default_rng(6).uniform(0.0, 2.0 * np.pi, 24)
_PLACES = np.stack(np.meshgrid(np.arange(20.3, 76.0, 9.0), np.arange(20.7, 76.0, 9.0)), axis=-1).reshape(-1, 2)


def _levels(places: np.ndarray) -> np.ndarray:
    """Grey levels (...), 20 to 235, at places (..., 2)."""
    return 127.5 + 8.0 * np.sum(np.cos(places @ _WAVES.T + _PHASES), axis=-1)


def _image(A: np.ndarray, t: np.ndarray, gain: float = 1.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """The scene as a camera sees it in which the point p of the scene lies at A p + t."""
    grid = np.stack(np.meshgrid(np.arange(_SIZE), np.arange(_SIZE)), axis=-1).astype(np.float64)
    levels = gain * (_levels((grid - t) @ np.linalg.inv(A).T) - 127.5) + 127.5
    levels += noise * np.random.default_rng(seed).standard_normal(levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


@settings(max_examples=12)
@given(
    shear=st.lists(st.floats(-0.08, 0.08), min_size=4, max_size=4),
    shift=st.lists(st.floats(-0.45, 0.45), min_size=2, max_size=2),
    gain=st.floats(0.8, 1.0),
)
def test_patches_follow_affine_maps(shear: list[float], shift: list[float], gain: float) -> None:
    """The smoothing does not shear with the map and the cubic kernel is not exact: up to 0.05 px, in the median a
    tenth of it. Rounding to whole levels, 0.29 levels of gradients of some 10 a pixel, leaves as much in weak
    patches."""
    A = np.eye(2) + np.reshape(shear, (2, 2))
    t = np.array(shift) + 48.0 - A @ [48.0, 48.0]
    truth = _PLACES @ A.T + t
    rough = np.rint(truth * 2.0) / 2.0
    found, done = aligned(smoothed(_image(np.eye(2), np.zeros(2))), smoothed(_image(A, t, gain)), _PLACES, rough)
    assert np.mean(done) > 0.9
    assert np.median(np.abs(found - truth)[done]) < 0.015
    assert np.max(np.abs(found - truth)[done]) < 0.12


def test_noise_decides_how_well() -> None:
    """At 1.5 levels of noise in each image, least squares leave 1.5 sqrt(2) over the root of the summed squares of
    the gradients, of which the smoothing and the weights keep a half: some 0.02 px here."""
    shift = np.array([0.3, -0.2])
    a, b = (smoothed(_image(np.eye(2), t, noise=1.5, seed=n)) for n, t in enumerate((np.zeros(2), shift)))
    found, done = aligned(a, b, _PLACES, _PLACES)
    dx, dy = (_levels(_PLACES + step) - _levels(_PLACES - step) for step in ([0.5, 0.0], [0.0, 0.5]))
    bound = 1.5 * np.sqrt(2.0) / np.sqrt(0.5 * 100.0 * np.mean(np.concatenate([dx, dy]) ** 2))
    assert np.all(done)
    assert 0.5 * bound < np.sqrt(np.mean((found - _PLACES - shift) ** 2)) < 2.0 * bound


@pytest.mark.parametrize("levels", [128.0, None])
def test_what_cannot_be_aligned_stays(levels: float | None) -> None:
    """No texture, another scene, and a patch beyond the border."""
    a = smoothed(_image(np.eye(2), np.zeros(2)))
    other = np.random.default_rng(1).integers(0, 255, (_SIZE, _SIZE)).astype(np.uint8)
    b = smoothed(other if levels is None else np.full((_SIZE, _SIZE), levels, dtype=np.uint8))
    places = np.array([[48.0, 48.0], [3.0, 48.0], [48.0, 94.0]])
    found, done = aligned(a, b, places, places)
    assert not np.any(done)
    np.testing.assert_array_equal(found, places)


def test_a_track_stays_one_in_all_sets() -> None:
    images: dict[View, NDArray[np.uint8]] = {
        (side, frame): _image(np.eye(2), np.array([-1.5 * (side == "right") + 0.7 * frame, 0.4 * frame]))
        for side in SIDES
        for frame in (0, 1)
    }
    place = np.array([[40.2, 44.9], [55.1, 51.3], [61.0, 30.5]])
    ends = [np.add(place, (-1.5 * right + 0.7 * frame, 0.4 * frame)) for frame in (0, 1) for right in (0, 1)]
    tracks = np.concatenate([ends[0], *(np.add(end, 0.2) for end in ends[1:])], axis=1)
    matches = Correspondences(
        left=tracks[:, [0, 1, 4, 5]],
        right=tracks[:, [2, 3, 6, 7]],
        stereo_0=tracks[:2, :4],
        stereo_1=tracks[:, 4:],
        tracks=tracks[:2],
    )
    found = refine_matches(images, matches)
    np.testing.assert_allclose(found.tracks, np.concatenate(ends, axis=1)[:2], atol=0.02)
    assert [len(found.left), len(found.right), len(found.stereo_0), len(found.stereo_1)] == [3, 3, 2, 3]
    assert np.count_nonzero(unlinked_pairs(found, "left")) == np.count_nonzero(unlinked_pairs(found, "right")) == 1
