"""Correctors: ours against the closed-form world of conftest, and what others' may answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from rsbench.components.cards import list_cards
from rsbench.components.plugins import wrap
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.vision.corrector import (
    CORRECTORS,
    CorrectionProblem,
    Corrector,
    CorrectorSpec,
    find_corrected,
    find_corrected_rows,
    load_corrector,
)
from rsbench.vision.correctors import FusionCorrector, PlaneCorrector, RotationCorrector
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.quality import psnr

Build = Callable[..., Any]


def problem_of(scene: Any, target_row: float = 0.0) -> CorrectionProblem:
    """All that is true of a world, in 8 bits and float32."""
    seen = {view: scene.rolling(*view) for view in VIEWS}
    return CorrectionProblem(
        images={view: np.rint(255.0 * image).astype(np.uint8) for view, (image, _) in seen.items()},
        rig=scene.rig,
        shutter=scene.shutter,
        target_row=target_row,
        motion=scene.motion,
        depth={view: depth.astype(np.float32) for view, (_, depth) in seen.items()},
        guess={view: np.zeros(depth.shape, np.float32) for view, (_, depth) in seen.items()},
    )


def _gain(scene: Any, problem: CorrectionProblem, corrector: Corrector, view: View) -> float:
    """dB over the frame as it is, against the closed-form image, on what the frame saw."""
    fused = find_corrected(wrap(CORRECTORS, corrector), problem, [view])[view]
    here = fused.origin == Origin.HERE
    assert np.mean(here) > 0.8
    tau = scene.shutter.row_time(problem.target_row, view[1])
    truth = np.rint(255.0 * scene.still(view[0], tau)[0]).astype(np.uint8)
    return psnr(fused.image, truth, here) - psnr(problem.images[view], truth, here)


@pytest.mark.slow
@pytest.mark.parametrize(("view", "row"), [(("left", 0), 0.0), (("right", 1), 100.0)])
def test_each_is_right_in_the_scene_that_it_assumes(world: Build, shapes: Any, view: View, row: float) -> None:
    """A world at infinity, one plane, and a plane with a ball before it; each sees 10 dB and more beyond."""
    sky = world((), sky=True)
    plane = shapes[0]((0.1, 0.1, 1.0), 5.0)
    scenes = {
        RotationCorrector(): sky,
        PlaneCorrector(): world((plane,)),
        FusionCorrector(): world((plane, shapes[1]((0.3, 0.2, 3.0), 0.4))),
    }
    for corrector, scene in scenes.items():
        # 8 bits and cubic interpolation leave more than 40 dB; the frames as they are have 15 to 20.
        assert _gain(scene, problem_of(scene, row), corrector, view) > 10.0, corrector


def _moved(array: np.ndarray, pixels: int) -> np.ndarray:
    """What a camera sees whose principal point lies so many pixels to the left; the border is repeated."""
    return np.concatenate([array[:, pixels:], np.repeat(array[:, -1:], pixels, axis=1)], axis=1)


def test_what_the_other_camera_fills_counts_the_disparity_offset(world: Build, shapes: Any) -> None:
    """The right images 4 px to the left give the same left frames, once the problem says so, and others unless."""
    plane = shapes[0]
    card = plane((0.0, 0.0, 1.0), 3.0, lambda X: (np.abs(X[..., 0]) < 0.5) & (np.abs(X[..., 1]) < 0.6))
    problem = problem_of(world((plane((0.05, 0.1, 1.0), 7.0), card), d=(0.25, -0.1, 0.1), baseline=0.4))
    assert problem.depth is not None
    right = [view for view in VIEWS if view[0] == "right"]
    apart = replace(
        problem,
        images={**problem.images, **{view: _moved(problem.images[view], 4) for view in right}},
        depth={**problem.depth, **{view: _moved(problem.depth[view], 4) for view in right}},
    )
    view: View = ("left", 0)
    expected, told, untold = (
        FusionCorrector().correct(each, [view])[view]
        for each in (problem, replace(apart, disparity_offset=4.0), apart)
    )
    filled = (expected.origin == Origin.OTHER_CAMERA) & (told.origin == Origin.OTHER_CAMERA)
    assert filled.sum() > 200
    # The same arithmetic but for the rounding of an offset: a grey level at most.
    assert np.max(np.abs(told.image[filled].astype(int) - expected.image[filled])) <= 1
    both = filled & (untold.origin == Origin.OTHER_CAMERA)
    assert psnr(untold.image, expected.image, both) < 30.0


@pytest.mark.slow
def test_each_is_wrong_in_the_scene_of_the_next(world: Build, shapes: Any) -> None:
    plane = shapes[0]((0.1, 0.1, 1.0), 5.0)
    near = world((plane, shapes[1]((0.3, 0.2, 2.0), 0.4)))
    problem = problem_of(near)
    gains = [_gain(near, problem, each, ("left", 0)) for each in (RotationCorrector(), PlaneCorrector())]
    best = _gain(near, problem, FusionCorrector(), ("left", 0))
    assert gains[0] < gains[1] < best - 3.0


@pytest.mark.slow
def test_the_single_view_is_the_fusion_without_what_it_fills(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.1, 0.1, 1.0), 5.0), shapes[1]((0.3, 0.2, 2.0), 0.4)))
    problem = problem_of(scene)
    single, fusion = (find_corrected(load_corrector(name), problem, VIEWS) for name in ("single-view", "fusion"))
    for view in VIEWS:
        here = fusion[view].origin == Origin.HERE
        np.testing.assert_array_equal(single[view].origin, np.where(here, Origin.HERE, Origin.NOBODY))
        np.testing.assert_array_equal(single[view].image, np.where(here[..., None], fusion[view].image, 0))
        assert np.any((fusion[view].origin != Origin.HERE) & (fusion[view].origin != Origin.NOBODY))


@pytest.mark.parametrize("name", list_cards("correctors"))
def test_cards_load_and_say_what_they_assume(name: str) -> None:
    entry = load_corrector(name)
    assert entry.description and entry.component.spec.assumes


def test_the_default_card_states_the_defaults() -> None:
    assert load_corrector("fusion").component == FusionCorrector()


@pytest.mark.slow
@pytest.mark.parametrize("field", ["motion", "depth"])
def test_what_is_not_known_is_not_guessed(world: Build, shapes: Any, field: str) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),))
    missing: Any = {field: None}
    with pytest.raises(ValueError, match=f"'{field}' must be among the needs"):
        FusionCorrector().correct(replace(problem_of(scene), **missing), VIEWS)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"needs": {"sky"}}, "'sky'"),
        ({"reference": ""}, "reference"),
        ({"assumes": None}, "assumes"),
        ({"sees": {"space"}}, "sees"),
        ({"sees": {"time"}}, "sees"),  # motion is found in the frames of both cameras
    ],
)
def test_a_spec_is_checked(changes: dict[str, Any], word: str) -> None:
    spec: dict[str, Any] = {"needs": {"motion"}, "reference": "r", "assumes": "a"}
    with pytest.raises(ValueError, match=word):
        CorrectorSpec(**spec | changes)


# What others' correctors may answer. This module is not rsbench's, so they count as such.


@dataclass(frozen=True)
class Says(Corrector):
    answer: Callable[[View, np.ndarray], Any]
    spec = CorrectorSpec(needs=set(), reference="here", assumes="nothing")

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Any]:
        return {view: self.answer(view, problem.images[view]) for view in views}


def _changed(**changes: Any) -> Callable[[View, np.ndarray], Any]:
    return lambda view, image: replace(Fused.seen(image, np.ones(image.shape[:2], np.bool_)), **changes)


def _raise(view: View, image: np.ndarray) -> Any:
    raise MemoryError("no weights")


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda view, image: image, ("left 0", "Fused", "ndarray")),
        (_changed(image=np.zeros((4, 5, 3), np.uint8)), ("image", "(160, 200, 3)", "(4, 5, 3)")),
        (_changed(image=np.zeros((160, 200, 3), np.float32)), ("image", "uint8", "float32")),
        (_changed(origin=None), ("origin", "NoneType")),
        (_changed(origin=np.full((160, 200), 9, np.uint8)), ("origin", "0 to 5", "9")),
        (_changed(depth=np.zeros((160, 200), np.float32)), ("depth", "above 0")),
        (_changed(depth=np.ones((160, 200))), ("depth", "float64")),
        (_changed(reason=None), ("reason", "NoneType")),
        (_raise, ("failed", "MemoryError: no weights")),
    ],
)
def test_wrong_answers_are_refused_in_one_line(
    world: Build, shapes: Any, answer: Any, words: tuple[str, ...]
) -> None:
    problem = problem_of(world((shapes[0]((0.0, 0.0, 1.0), 5.0),)))
    with pytest.raises(RsbenchError) as caught:
        find_corrected(wrap(CORRECTORS, Says(answer)), problem, VIEWS)
    text = str(caught.value)
    assert "corrector 'Says'" in text and "\n" not in text
    assert all(word in text for word in words), text


def test_views_must_be_those_asked_for(world: Build, shapes: Any) -> None:
    problem = problem_of(world((shapes[0]((0.0, 0.0, 1.0), 5.0),)))

    @dataclass(frozen=True)
    class Forgets(Says):
        def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Any]:
            return super().correct(problem, views[1:])

    with pytest.raises(RsbenchError, match="views asked for"):
        find_corrected(wrap(CORRECTORS, Forgets(_changed())), problem, VIEWS)


def test_rows_must_be_as_many_as_were_asked_for(world: Build, shapes: Any) -> None:
    problem = problem_of(world((shapes[0]((0.0, 0.0, 1.0), 5.0),)))

    @dataclass(frozen=True)
    class Forgets(Says):
        def correct_rows(
            self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
        ) -> list[dict[View, Any]]:
            return super().correct_rows(problem, views, rows[1:])

    with pytest.raises(RsbenchError, match="must return a list of 2"):
        find_corrected_rows(wrap(CORRECTORS, Forgets(_changed())), problem, VIEWS, (0.0, 80.0))
    assert len(find_corrected_rows(wrap(CORRECTORS, Says(_changed())), problem, VIEWS, (0.0, 80.0))) == 2
