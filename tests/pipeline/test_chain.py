"""The chain on users' frames: of every size and kind corrected, or refused with one clear line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
from commands import refused

from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.components.plugins import wrap
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import Given, correct_four, correct_known_rows, uncorrected
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_capture import KnownCapture, match_frames
from rsbench.pipeline.frame_depth import CorrectionOptions, depth_of_pair
from rsbench.pipeline.frame_motion import motion_of, solve_frames
from rsbench.solvers.engine.base import MotionEstimate, load_solver_entry
from rsbench.vision.corrector import CORRECTORS, CorrectionProblem, Corrector, CorrectorSpec, load_corrector
from rsbench.vision.feature_matcher import FEATURE_MATCHERS, FeatureMatcher
from rsbench.vision.features import SiftMatcher
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.images import eight_bit
from rsbench.vision.quality import psnr
from rsbench.vision.stereo_matcher import load_matcher

Images = dict[Any, np.ndarray]
Folders = tuple[FrameSource, FrameSource]


def _frames(sequence: Sequence) -> Images:
    return {view: sequence.image("rs", *view) for view in VIEWS}


def _gain(sequence: Sequence, frames: Any, images: Images, like: Callable[[np.ndarray], np.ndarray]) -> float:
    """Mean gain in PSNR over the uncorrected frame, dB, on what each frame saw itself."""
    gains = []
    for view, fused in frames.items():
        truth = like(sequence.image("gs", *view))
        here = fused.origin == Origin.HERE
        gains.append(psnr(fused.image, truth, here) - psnr(images[view], truth, here))
    return float(np.mean(gains))


KINDS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "colour, 8 bit": lambda image: image,
    "grey, 8 bit": lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
    "colour, 16 bit": lambda image: image.astype(np.uint16) * 257,
    "grey, 12 of 16 bit": lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.uint16) * 16,
}


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_every_kind_are_corrected(castle: Sequence, kind: str) -> None:
    like = KINDS[kind]
    images = {view: like(image) for view, image in _frames(castle).items()}
    result = correct_four(images, castle.rig, KnownInputs.of(castle.shutter), CorrectionOptions())
    for view, fused in result.frames.items():
        assert fused.image.dtype == images[view].dtype and fused.image.shape == images[view].shape
        assert np.mean(fused.origin == Origin.HERE) > 0.8
    # At 128 x 96 px resampling limits the corrected frames to 28 dB; uncorrected ones have 22 dB.
    assert _gain(castle, result.frames, images, like) > 4.0


def test_other_sizes_and_borders(castle: Sequence) -> None:
    """A window of the frames with a black border: another size, another principal point."""
    border, top, left = 6, 8, 10
    images: Images = {}
    for view, image in _frames(castle).items():
        window = image[top:-5, left:-7]
        images[view] = cv2.copyMakeBorder(window, border, border, border, border, cv2.BORDER_CONSTANT, value=0)
    height, width = images["left", 0].shape[:2]
    c = castle.rig.camera
    camera = type(c)(width=width, height=height, fx=c.fx, fy=c.fy, cx=c.cx - left + border, cy=c.cy - top + border)
    # Rows are read at the same speed, so the ratio belongs to the new height.
    inputs = KnownInputs(readout_ratio=castle.shutter.readout_ratio * height / c.height)
    result = correct_four(
        images, StereoRig(camera=camera, baseline=castle.rig.baseline), inputs, CorrectionOptions()
    )
    inner = np.zeros((height, width), dtype=bool)
    inner[2 * border : -2 * border, 2 * border : -2 * border] = True
    for view, fused in result.frames.items():
        shown = (fused.origin == Origin.HERE) & inner
        assert np.count_nonzero(shown) > 0.6 * np.count_nonzero(inner)
        assert not np.any(np.isnan(fused.depth[shown]))
        assert fused.image.shape == images[view].shape


def test_the_last_row_stays_where_it_is_when_it_is_the_target(castle: Sequence) -> None:
    """A row that is read at the target time needs no correction."""
    images = _frames(castle)
    height = castle.rig.camera.height
    for row in (0, height - 1):
        options = CorrectionOptions(target_row=float(row))
        result = correct_four(images, castle.rig, KnownInputs.of(castle.shutter), options)
        for view, fused in result.frames.items():
            seen = fused.origin[row] == Origin.HERE
            assert np.mean(seen) > 0.8
            difference = fused.image[row][seen].astype(int) - images[view][row][seen]
            assert np.quantile(np.abs(difference), 0.95) <= 2


def test_a_global_shutter_leaves_the_frames_as_they_are(castle: Sequence) -> None:
    """At a readout ratio of 0 byte for byte, whatever the motion; next to it nothing jumps.

    1e-5 of a frame period moves a pixel by at most 1e-3 px: a grey level, and no pixel leaves the picture. At
    1e-3 it is 0.1 px, still less than half a pixel.
    """
    images, moved = _frames(castle), Given(motion=castle.motion)
    first = correct_four(images, castle.rig, KnownInputs(readout_ratio=0.0), CorrectionOptions(), given=moved)
    for view in VIEWS:
        assert np.array_equal(first.frames[view].image, images[view])
        assert np.all(first.frames[view].origin == Origin.HERE)
    for ratio in (1e-5, 1e-3):
        given = Given(motion=castle.motion, pairs=first.pairs)
        near = correct_four(images, castle.rig, KnownInputs(readout_ratio=ratio), CorrectionOptions(), given=given)
        for view in VIEWS:
            assert np.all(near.frames[view].origin == Origin.HERE)
            apart = np.abs(near.frames[view].image.astype(int) - images[view])
            assert apart.max() <= (1 if ratio < 1e-4 else 40)  # an edge of 255 levels over 0.1 px and its ringing


def test_inpainting_leaves_no_pixel_empty_and_keeps_the_marks(castle: Sequence) -> None:
    images, inputs = _frames(castle), KnownInputs.of(castle.shutter)
    plain = correct_four(images, castle.rig, inputs, CorrectionOptions()).frames
    painted = correct_four(images, castle.rig, inputs, CorrectionOptions(inpaint=True)).frames
    for view in VIEWS:
        np.testing.assert_array_equal(plain[view].origin, painted[view].origin)
        known = plain[view].origin != Origin.NOBODY
        np.testing.assert_array_equal(plain[view].image[known], painted[view].image[known])


@pytest.mark.parametrize("name", ["gs-stereo-tracks-scaled", "gs-stereo-pnp-scaled"])
def test_any_metric_solver_corrects_in_its_own_model(castle: Sequence, name: str) -> None:
    """Other solvers, of another motion model than the data's; the shutter's direction is still judged by ours."""
    images = _frames(castle)
    entry = load_solver_entry(name)
    result = correct_four(images, castle.rig, KnownInputs.of(castle.shutter), CorrectionOptions(solver=entry))
    assert result.motion is not None and result.motion.name == entry.solver.spec.motion_model
    assert result.found is not None and result.found.solver == name
    # Ours gains 6 dB; theirs are a tenth of a degree off, which is a quarter of a pixel here.
    assert _gain(castle, result.frames, images, lambda image: image) > 3.0


def test_a_left_cameras_metric_answer_is_moved_to_the_body(castle: Sequence) -> None:
    """A solver that answers the true motion of the left camera corrects like the true motion of the body."""
    images, inputs, options = _frames(castle), KnownInputs.of(castle.shutter), CorrectionOptions()
    offset = castle.rig.offset("left")
    w, d = castle.motion.w, castle.motion.d
    of_left = MotionEstimate(w=w, d=d + offset - so3.exp(w) @ offset, success=True, metric=True)
    motion = motion_of(of_left, load_solver_entry("gs-8pt"), castle.rig)
    np.testing.assert_allclose(motion.d, d, atol=1e-15)
    found = correct_four(images, castle.rig, inputs, options, given=Given(motion=motion))
    true = correct_four(images, castle.rig, inputs, options, given=Given(motion=castle.motion))
    for view in VIEWS:
        difference = found.frames[view].image.astype(int) - true.frames[view].image
        assert np.quantile(np.abs(difference), 0.99) <= 1  # the last digit of a motion may round a grey level


def test_what_is_given_is_not_looked_for(castle: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chain from its own results gives the same frames, with no matcher and no solver called."""
    images, inputs, options = _frames(castle), KnownInputs.of(castle.shutter), CorrectionOptions()
    first = correct_four(images, castle.rig, inputs, options)

    def never(*_: object) -> None:
        raise AssertionError("not needed")

    for name in ("chain.know_four", "chain.solve_frames", "frame_motion.estimate_motion", "chain.frame_pairs"):
        monkeypatch.setattr(f"rsbench.pipeline.{name}", never)
    given = Given(matches=first.matches, motion=first.motion, pairs=first.pairs)
    again = correct_four(images, castle.rig, inputs, options, given=given, views=(("right", 1),))
    assert list(again.frames) == [("right", 1)] and again.found is None
    np.testing.assert_array_equal(again.frames["right", 1].image, first.frames["right", 1].image)
    with pytest.raises(ValueError, match="readout_ratio"):
        correct_four(images, castle.rig, KnownInputs(), options, given=given)


def test_a_corrector_gets_what_it_needs_and_no_more(castle: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rotation alone needs no depth; a corrector that needs nothing works where there is no motion to find."""
    images, inputs = _frames(castle), KnownInputs.of(castle.shutter)
    turned = correct_four(images, castle.rig, inputs, CorrectionOptions(corrector=load_corrector("rotation-only")))
    assert turned.motion is not None and turned.pairs is None
    flat = {view: np.full_like(image, 128) for view, image in images.items()}
    options = CorrectionOptions(corrector=wrap(CORRECTORS, Nothing()))
    still = correct_four(flat, castle.rig, inputs, options)
    assert still.motion is None and still.matches is None and still.pairs is None
    for view in VIEWS:
        np.testing.assert_array_equal(still.frames[view].image, flat[view])


@dataclass(frozen=True)
class Nothing(Corrector):
    """The frames as they are."""

    spec = CorrectorSpec(needs=set(), reference="here", assumes="nothing")

    def correct(self, problem: CorrectionProblem, views: Any) -> dict[Any, Fused]:
        assert problem.motion is None and problem.depth is None
        return uncorrected(problem.images, tuple(views))


def test_equal_keys_mean_equal_options() -> None:
    key = CorrectionOptions().key
    assert key == CorrectionOptions().key
    others = [
        CorrectionOptions(inpaint=True),
        CorrectionOptions(seed=1),
        CorrectionOptions(matcher=load_matcher("sgm-plain")),
        CorrectionOptions(solver=load_solver_entry("rs-stereo-refined-twist")),
        CorrectionOptions(corrector=load_corrector("single-view")),
    ]
    assert len({key, *(options.key for options in others)}) == 1 + len(others)


@pytest.mark.slow
def test_an_unknown_readout_ratio_is_estimated_or_declared_open(castle: Sequence) -> None:
    """The small frames do not determine it well: the answer is near the truth by its own uncertainty, or none."""
    try:
        result = correct_four(_frames(castle), castle.rig, KnownInputs(), CorrectionOptions())
    except NoMotionError as refusal:
        assert "readout_ratio" in str(refusal)
    else:
        assert result.capture is not None and result.capture.likeliest is not None
        best = result.capture.likeliest
        assert abs(best.ratio - castle.shutter.readout_ratio) < 4 * best.sigma


OTHER = {"left": "right", "right": "left"}
WRONG: dict[str, Callable[[Images], Images]] = {
    "no texture": lambda images: {view: np.full_like(image, 128) for view, image in images.items()},
    "exchanged": lambda images: {(s, f): images[OTHER[s], f] for s, f in VIEWS},
    "same row": lambda images: {(s, f): np.roll(images[s, f], 30 * (s == "right"), axis=0) for s, f in VIEWS},
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_frames_are_refused(words: str, castle: Sequence) -> None:
    with refused(words):
        correct_four(
            WRONG[words](_frames(castle)), castle.rig, KnownInputs.of(castle.shutter), CorrectionOptions()
        )


@dataclass(frozen=True)
class OverTimeOnly(FeatureMatcher):
    """SIFT without matches between the cameras."""

    def match(self, images: Any) -> Correspondences:
        found = SiftMatcher().match(images)
        return Correspondences(left=found.left, right=found.right)


def test_features_without_stereo_matches_are_no_sign_of_wrong_frames(castle: Sequence) -> None:
    """They go through to the solver, which says what it lacks; exchanged frames are still found out."""
    images = _frames(castle)
    options = CorrectionOptions(features=wrap(FEATURE_MATCHERS, OverTimeOnly()))
    assert len(match_frames(images, castle.rig, options).stereo_0) == 0
    with pytest.raises(RsbenchError, match="exchanged"):
        match_frames(WRONG["exchanged"](images), castle.rig, options)
    few = CorrectionOptions(features=options.features, solver=load_solver_entry("gs-stereo-tracks"))
    with pytest.raises(NoMotionError, match="tracks"):
        correct_four(images, castle.rig, KnownInputs.of(castle.shutter), few)


def test_matches_without_a_motion_say_why(castle: Sequence) -> None:
    rng = np.random.default_rng(0)
    noise = Correspondences(left=rng.uniform(0, 90, (8, 4)), right=rng.uniform(0, 90, (8, 4)))
    with pytest.raises(NoMotionError, match="found no motion: "):
        solve_frames(KnownCapture(rig=castle.rig, shutter=castle.shutter, matches=noise), CorrectionOptions())


def test_sixteen_bits_use_one_factor_for_all() -> None:
    dark, bright = np.full((40, 40), 1000, np.uint16), np.full((40, 40), 4000, np.uint16)
    a, b = eight_bit([dark, bright])
    assert a[0, 0] == 64 and b[0, 0] == 255


@pytest.mark.parametrize("vertical", [False, True])
def test_what_one_camera_alone_shows_is_guessed_as_far_as_what_lies_beside_it(vertical: bool) -> None:
    """Rows at the rim of a camera that sees more; below a vertical rig's lower camera, all along the baseline."""
    camera = PinholeCamera.centred(64, 48, 50.0)
    t = [0.0, -0.2, 0.0] if vertical else [-0.2, 0.0, 0.0]
    rig = StereoRig.of_cameras(camera, replace(camera, fx=55.0, fy=55.0), np.eye(3), t)
    near_and_far = np.where(np.arange(64) < 30, np.float32(8.0), np.float32(2.0))
    disparity = np.tile(near_and_far, (48, 1))
    disparity[:7], disparity[20:23, 28:32] = np.nan, np.nan  # the rim, and a hole across an edge
    grey = np.full((48, 64), 100, np.uint8)
    pair = depth_of_pair(grey, grey, [disparity, disparity], rig, find_sky=False)
    depth, guess = pair.depth["left"], pair.guess["left"]
    np.testing.assert_allclose(guess[:7], np.tile(depth[7], (7, 1)), rtol=0.02)  # depths of rows differ a little
    hole = guess[20:23, 28:32]
    edge = depth[19, 28:32] if vertical else depth[20, [32] * 4]  # along the baseline the farther one
    np.testing.assert_allclose(hole, np.tile(edge, (3, 1)), rtol=0.02)
    assert np.all(guess[np.isfinite(disparity)] == 0.0)


def test_frames_that_the_motion_does_not_explain_are_corrected_by_their_own_camera(castle: Sequence) -> None:
    """None comes out worse than it went in, however wrong the motion is; a given motion is used as it is."""
    images, known = _frames(castle), KnownInputs.of(castle.shutter)
    wrong = castle.motion.with_endpoint(-3.0 * castle.motion.w, -20.0 * castle.motion.d)
    right, given = (
        correct_four(images, castle.rig, known, CorrectionOptions(), given=Given(motion=motion))
        for motion in (castle.motion, wrong)
    )
    estimated = Given(motion=wrong, pairs=given.pairs)
    (other,) = correct_known_rows(
        images, estimated, castle.rig, castle.shutter, CorrectionOptions(), tuple(given.frames), 0.0
    )
    for view, fused in other.items():
        truth = castle.image("gs", *view)
        assert right.frames[view].note == "" and right.frames[view].explained > 0.9
        assert given.frames[view].note == "" and given.frames[view].explained < 0.75
        assert np.any(np.isfinite(given.frames[view].depth))
        assert fused.note and fused.explained < 0.75
        assert psnr(fused.image, truth) > psnr(images[view], truth) - 0.2
        assert np.all(np.isnan(fused.depth))
    assert any(fused.note == "corrected by its own camera" for fused in other.values())
