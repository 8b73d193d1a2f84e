"""Corrected frames ranked by where things are, and those of one camera."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from leaderboards import PLANES, entered, jobs_here, leaderboard, lines_of, oracle_scores, run_entries

from rsbench.benchmark.leaderboard import running
from rsbench.benchmark.leaderboard.correction_tracks import TrueFrame, placed, seen_alike
from rsbench.benchmark.leaderboard.picture_track import SharedWork
from rsbench.benchmark.leaderboard.pictures import parts_within
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
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


@cache
def _true() -> TrueFrame:
    image = _u8(_seen(0.0))
    return TrueFrame(name="first", picture=Picture(image), common=ALL, parts=parts_within("rms", image, 0, ALL))


def _one(score: Callable[..., float], image: np.ndarray[Any, Any], drawn: Any = ALL) -> float:
    """``placed`` or ``seen_alike`` of one frame of the scene."""
    return score([_true()], [(_u8(image), drawn)])


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
    assert _one(placed, _seen(off)) == pytest.approx(expected, abs=0.05)


def test_what_is_not_drawn_counts_nothing() -> None:
    drawn = ALL.copy()
    drawn[:, ::2] = False
    assert _one(placed, _seen(0.0), drawn) == pytest.approx(0.5, abs=0.02)
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
    before, seen = _one(placed, frame), ssim(frame, true.picture)
    after = {name: _one(placed, made(frame)) for name, made in FILTERS.items()}
    assert max(after.values()) < before + 0.01, (before, after)
    assert max(ssim(made(frame), true.picture) for made in FILTERS.values()) > seen + 0.05
    assert _one(placed, _seen(0.0)) > before + (0.3 if shear else -0.01)


def test_oracles_have_their_places(planes: Path, tmp_path: Path) -> None:
    split = TRACKS["correction-2"].split(planes)
    found = oracle_scores(split, tmp_path)
    # A picture on itself: the top of an uneven correlation is no more than 0.01 px from the middle.
    assert np.all(found["truth"]["placed"] > 0.995) and np.all(found["truth"]["misplaced"] < 0.005)
    assert np.all(found["fusion-true"]["placed"] > found["uncorrected"]["placed"])
    assert {score.key for score in split.track.scores} <= set(found["truth"]) and "flip_all" not in found["truth"]
    assert lines_of(tmp_path / "truth" / "predictions.jsonl")[0]["protocol"] == "correction-2"


# A second number: how it looks


def _noise(image: Image, sigma: float) -> Image:
    return _u8(image + sigma * np.random.default_rng(2).standard_normal(image.shape))


def _holes(image: Image) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Half of the pixels, at random, in squares of 4 px."""
    coarse = np.random.default_rng(5).random((SHAPE[0] // 4, SHAPE[1] // 4)) < 0.5
    return np.kron(coarse, np.ones((4, 4))).astype(np.bool_)


def test_what_is_no_picture_has_no_score() -> None:
    """What keeps its place and not its looks: each loses most of what ``placed`` alone would leave it."""
    right = _u8(_seen(0.0))
    holes, mean = _holes(right), np.mean(right, axis=(0, 1))
    pale = _u8(mean + 0.1 * (right - mean))
    filled = right.copy()
    filled[holes] = _u8(mean)
    black = right.copy()
    black[holes] = 0
    assert _one(seen_alike, right) == pytest.approx(1.0, abs=1e-12)
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
        where, looks = (_one(score, image, drawn) for score in (placed, seen_alike))
        assert where >= place and where * looks < most, name


def test_filters_gain_next_to_nothing_in_looks() -> None:
    """On the noise of a real sensor, some 10 of 255 levels."""
    true = _true()
    frame = _noise(cv2.GaussianBlur(_u8(_seen(0.0)), (0, 0), 1.0), 10.0)
    before = _one(seen_alike, frame)
    after = {name: _one(seen_alike, made(frame)) for name, made in FILTERS.items()}
    assert before > 0.97 and max(after.values()) < before + 0.02, (before, after)
    assert max(ssim(made(frame), true.picture) for made in FILTERS.values()) > ssim(frame, true.picture) + 0.02


def test_the_score_is_the_product_and_the_truth_has_it_all(planes: Path, tmp_path: Path) -> None:
    split = TRACKS["correction-3"].split(planes)
    found = oracle_scores(split, tmp_path)
    for scores in found.values():
        np.testing.assert_allclose(scores["corrected"], scores["placed"] * scores["picture"], rtol=1e-12)
        np.testing.assert_allclose(scores["shortfall"], 1.0 - scores["corrected"], atol=1e-12)
    assert np.all(found["truth"]["picture"] > 1.0 - 1e-9)
    assert np.all(found["fusion-true"]["corrected"] > found["uncorrected"]["corrected"])


TRACK = TRACKS["correction-mono"]
CARD = """
name = "seen-by-one"
baseline = 0.3
readout_ratio = 0.8
frame_period_s = 0.05
renderer = "preview"
twins = ["middle", "last"]
channels = ["imu"]

[camera]
width = 160
height = 120
focal = 170

[motion]
rotation_deg = 6
rotation_axis = [0.4, 1.0, -0.6]
translation = 0.06
translation_axis = [-0.7, 0.3, -0.6]

[[sequence]]
name = "corridor"
scene = "corridor"
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sequence with a gyroscope, and the truth of three rows."""
    folder = tmp_path_factory.mktemp("rendered")
    (folder / "card.toml").write_text(CARD, encoding="utf-8")
    generate_dataset(load_dataset_card(str(folder / "card.toml")), folder / "data")
    return folder / "data"


@pytest.mark.slow
def test_methods_are_ranked_by_the_cameras_that_they_see(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    where = ("--data", rendered, "--board", tmp_path / "board")
    names = ("mono-fusion", "rotation-only", "gyro", "zhuang", "lao-lines", "fusion")
    run_entries(TRACK.name, names, *where)
    leaderboard("oracles", TRACK.name, *where)
    found = entered(tmp_path / "board", TRACK.split(rendered))
    uses = {name: found[name].header.uses[2:] for name in names}
    assert uses == {
        "mono-fusion": ("time",),
        "rotation-only": ("time",),
        "gyro": ("gyro",),
        "zhuang": ("time",),
        "lao-lines": (),
        "fusion": ("stereo", "time"),
    }
    psnr = {
        name: entry.scores.iloc[0][["psnr_first", "psnr_middle", "psnr_last"]] for name, entry in found.items()
    }
    # What turns alone gains, and what knows depth or flow gains more, at every row.
    for name in ("rotation-only", "gyro"):
        assert np.all(psnr[name] > psnr["uncorrected"] + 1.0)
    for name in ("mono-fusion", "fusion"):
        assert np.all(psnr[name] > psnr["rotation-only"])
    assert np.all(psnr["truth"] == np.inf)


def test_a_gyroscope_is_given_where_there_is_one(rendered: Path, tmp_path: Path) -> None:
    leaderboard("export", TRACK.name, "--data", rendered, "--out", tmp_path)
    (problem,) = lines_of(tmp_path / "problems.jsonl")
    truth = TRACK.split(rendered).truths[0]
    tau, w = np.split(np.array(problem["gyro"]), [1], axis=1)
    assert tau.min() < 0.0 and tau.max() > 1.8
    # The motion turns evenly; 0.02 rad/s of bias on each axis, at 20 frames a second.
    np.testing.assert_allclose(np.mean(w, axis=0), truth.motion.w, atol=4.0 * 0.02 * 0.05)
    assert "imu/measured.csv" in truth.shown.files
    # The tracks that do not give it are as they were.
    other = TRACKS["correction"].split(rendered).truths[0].shown
    assert "imu/measured.csv" not in other.files


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mono-fusion", "flow-scaled", "rotation-only", "zhuang", "vasu-layers"])
def test_nobody_looks_to_the_right(name: str, rendered: Path) -> None:
    """Black images of the right camera give the same frames."""
    split = TRACK.split(rendered)
    (problem,) = TRACK.problems(rendered, None, 1)
    pictures, made = split.truths[0].shown, list[np.ndarray]()
    images = {view: pictures.sequence.image("rs", *view) for view in VIEWS}
    for seen in (images, {view: image * (view[0] == "left") for view, image in images.items()}):
        frames, seconds = TRACK.corrected(  # pyrefly: ignore[missing-attribute]
            SharedWork(problem, seen, pictures.requested),
            TRACK.chain(name).options,  # pyrefly: ignore[missing-attribute]
        )
        assert len(frames) == 3 and seconds > 0.0
        made.append(np.stack([frame["left", 1].image for frame in frames]))
    np.testing.assert_array_equal(made[0], made[1])


def test_rows_are_asked_where_their_truth_is(tmp_path: Path) -> None:
    for twins, rows in (((), [0]), ((40,), [0, 40]), ((40, 79), [0, 40, 79])):
        folder = tmp_path / str(len(twins))
        write_analytic_dataset(folder, *PLANES, twins=twins)
        for track, most in (("correction-mono", 3), ("correction", 2)):
            pictures = TRACKS[track].split(folder).truths[0].shown
            assert [each.row for each in pictures.requested] == rows[:most]
