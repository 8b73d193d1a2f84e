"""Corrected frames ranked by geometry: a known distance scores what it should, and filters gain nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from leaderboards import lines_of

from rsbench.benchmark.leaderboard.correction_tracks import TrueFrame, placed, seen_alike
from rsbench.benchmark.leaderboard.pictures import parts_within
from rsbench.benchmark.leaderboard.submissions import read_submission, write_oracles
from rsbench.benchmark.leaderboard.track import mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.vision.quality import Picture, ssim

Image = np.ndarray[Any, np.dtype[np.uint8]]
SHAPE = (192, 256)
ALL = np.ones(SHAPE, dtype=np.bool_)


def _scene() -> np.ndarray[Any, Any]:
    """Coarse and fine texture (H + 64, W + 64, 3), to be cut out of."""
    rng = np.random.default_rng(3)
    shape = (SHAPE[0] + 64, SHAPE[1] + 64, 3)
    parts = [cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma) * sigma for sigma in (1.5, 4.0, 10.0)]
    total = sum(parts, np.zeros(shape))
    return 120.0 + 45.0 * total / total.std()


def _seen(shift: np.ndarray[Any, Any] | float) -> np.ndarray[Any, Any]:
    """The scene as each row sees it that stands ``shift`` px (H) to the right of its place."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float32)
    x = x + 32.0 + np.broadcast_to(np.asarray(shift, dtype=np.float32).reshape(-1, 1), SHAPE)
    return cv2.remap(_scene().astype(np.float32), x.astype(np.float32), y + 32.0, cv2.INTER_CUBIC)


def _u8(image: np.ndarray[Any, Any]) -> Image:
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _true() -> TrueFrame:
    image = _u8(_seen(0.0))
    return TrueFrame(name="first", picture=Picture(image), common=ALL, parts=parts_within("rms", image, 0, ALL))


def _sharpened(image: Image) -> Image:
    return _u8(2.0 * image.astype(np.float64) - cv2.GaussianBlur(image, (0, 0), 1.5))


FILTERS: dict[str, Callable[[Image], Any]] = {
    "sharpen": _sharpened,
    "median": lambda image: cv2.medianBlur(image, 3),
    "gauss": lambda image: cv2.GaussianBlur(image, (0, 0), 1.0),
    "bilateral": lambda image: cv2.bilateralFilter(image, 7, 40, 3),
    "nlm": lambda image: cv2.fastNlMeansDenoisingColored(image, None, 8, 8, 7, 15),
}


@pytest.mark.parametrize("off", [0.0, 0.5, 1.0, 3.0])
def test_a_known_distance_has_its_score(off: float) -> None:
    # The tops of correlations of blurred windows are parabolas to some hundredths of a pixel.
    expected = max(0.0, 1.0 - off / 2.0)
    assert placed([_true()], [(_u8(_seen(off)), ALL)]) == pytest.approx(expected, abs=0.05)


def test_what_is_not_drawn_counts_nothing() -> None:
    drawn = ALL.copy()
    drawn[:, ::2] = False
    assert placed([_true()], [(_u8(_seen(0.0)), drawn)]) == pytest.approx(0.5, abs=0.02)
    flat = np.full((*SHAPE, 3), 90, dtype=np.uint8)
    plain = TrueFrame(name="first", picture=Picture(flat), common=ALL, parts={})
    assert placed([plain], [(flat, ALL)]) == 1.0  # nothing there tells where it stands


@pytest.mark.parametrize("shear", [0.0, 2.0])
def test_filters_gain_nothing(shear: float) -> None:
    """A noisy, blurred, vignetted frame: SSIM is better by 0.05 after filters, which move nothing."""
    true, height = _true(), SHAPE[0]
    rng = np.random.default_rng(0)
    frame = cv2.GaussianBlur(_seen(shear * np.arange(height) / height), (0, 0), 0.8)
    corner = np.hypot(*np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(-1, 1, height)))[..., None]
    frame = _u8(frame * (1.0 - 0.1 * corner**2) + 10.0 * rng.standard_normal(frame.shape))
    before, seen = placed([true], [(frame, ALL)]), ssim(frame, true.picture)
    after = {name: placed([true], [(made(frame), ALL)]) for name, made in FILTERS.items()}
    assert max(after.values()) < before + 0.01, (before, after)
    assert max(ssim(made(frame), true.picture) for made in FILTERS.values()) > seen + 0.05
    straight = placed([true], [(_u8(_seen(0.0)), ALL)])
    assert straight > before + (0.3 if shear else -0.01)


def test_oracles_have_their_places(planes: Path, tmp_path: Path) -> None:
    split = TRACKS["correction-2"].split(planes)
    found = {
        path.parent.name: mark(read_submission(path, split), split) for path in write_oracles(split, tmp_path)
    }
    # A picture on itself: the top of an uneven correlation is no more than 0.01 px from the middle.
    assert np.all(found["truth"]["placed"] > 0.995) and np.all(found["truth"]["misplaced"] < 0.005)
    assert np.all(found["fusion-true"]["placed"] > found["uncorrected"]["placed"])
    assert {score.key for score in split.track.scores} <= set(found["truth"]) and "flip_all" not in found["truth"]
    assert lines_of(tmp_path / "truth" / "predictions.jsonl")[0]["protocol"] == "correction-2"


def test_correctors_have_the_motion_whose_model_the_matches_prefer() -> None:
    """As ``rsbench correct`` has; of the first protocol it stays that of the solver's own model."""
    first, second = (TRACKS[name].chain("fusion") for name in ("correction", "correction-2"))  # pyrefly: ignore[missing-attribute]
    assert first.options.motion_model is None and second.options.motion_model == "auto"
    assert first.key == CorrectionOptions().key
    assert second.key == CorrectionOptions(motion_model="auto").key != first.key
    assert (second.entry.key, second.uses) == (first.entry.key, first.uses)


# A second number: how it looks


def _noise(image: Image, sigma: float) -> Image:
    return _u8(image + sigma * np.random.default_rng(2).standard_normal(image.shape))


def _holes(image: Image) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Half of the pixels, at random, in squares of 4 px."""
    coarse = np.random.default_rng(5).random((SHAPE[0] // 4, SHAPE[1] // 4)) < 0.5
    return np.kron(coarse, np.ones((4, 4))).astype(np.bool_)


def test_what_is_no_picture_has_no_score() -> None:
    """What keeps its place and not its looks: each loses most of what ``placed`` alone would leave it."""
    true, right = _true(), _u8(_seen(0.0))
    holes, mean = _holes(right), np.mean(right, axis=(0, 1))
    pale = _u8(mean + 0.1 * (right - mean))
    filled = right.copy()
    filled[holes] = _u8(mean)
    black = right.copy()
    black[holes] = 0
    assert seen_alike([true], [(right, ALL)]) == pytest.approx(1.0, abs=1e-12)
    grey = np.repeat(np.mean(right, axis=-1, keepdims=True), 3, axis=-1).astype(np.uint8)
    for name, image, drawn, place, most in (
        ("contrast of a tenth", pale, ALL, 0.95, 0.3),
        ("noise of 60 levels", _noise(right, 60.0), ALL, 0.8, 0.75),
        ("filled holes", filled, ALL, 0.7, 0.5),
        ("filled holes that count as such", filled, ~holes, 0.3, 0.15),
        ("black holes", black, ~holes, 0.0, 0.02),
        ("without colours", grey, ALL, 0.6, 0.35),
        ("red and blue exchanged", right[..., ::-1].copy(), ALL, 0.7, 0.3),
    ):
        where, looks = (score([true], [(image, drawn)]) for score in (placed, seen_alike))
        assert where >= place and where * looks < most, name


def test_filters_gain_next_to_nothing_in_looks() -> None:
    """On the noise of a real sensor, some 10 of 255 levels."""
    true = _true()
    frame = _noise(cv2.GaussianBlur(_u8(_seen(0.0)), (0, 0), 1.0), 10.0)
    before = seen_alike([true], [(frame, ALL)])
    after = {name: seen_alike([true], [(made(frame), ALL)]) for name, made in FILTERS.items()}
    assert before > 0.97 and max(after.values()) < before + 0.02, (before, after)
    assert max(ssim(made(frame), true.picture) for made in FILTERS.values()) > ssim(frame, true.picture) + 0.02


def test_the_score_is_the_product_and_the_truth_has_it_all(planes: Path, tmp_path: Path) -> None:
    split = TRACKS["correction-3"].split(planes)
    found = {
        path.parent.name: mark(read_submission(path, split), split) for path in write_oracles(split, tmp_path)
    }
    for scores in found.values():
        np.testing.assert_allclose(scores["corrected"], scores["placed"] * scores["picture"], rtol=1e-12)
        np.testing.assert_allclose(scores["shortfall"], 1.0 - scores["corrected"], atol=1e-12)
    assert np.all(found["truth"]["picture"] > 1.0 - 1e-9)
    assert np.all(found["fusion-true"]["corrected"] > found["uncorrected"]["corrected"])
