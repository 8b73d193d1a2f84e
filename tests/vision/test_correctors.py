"""Correctors, things that move by themselves, and simpler depths: one plane, flow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
from commands import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.cards import list_cards
from rsbench.components.plugins import wrap
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import back_project, rs_project_near
from rsbench.core.rig import VIEWS, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.vision import correctors
from rsbench.vision.corrector import (
    CORRECTORS,
    CorrectionProblem,
    Corrector,
    CorrectorSpec,
    find_corrected,
    find_corrected_rows,
    load_corrector,
)
from rsbench.vision.correctors import FusionCorrector, PlaneCorrector, RotationCorrector, plane_depth
from rsbench.vision.flow import flow_depth, monocular_depth
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
    with refused("corrector 'Says'", *words):
        find_corrected(wrap(CORRECTORS, Says(answer)), problem, VIEWS)


def test_views_must_be_those_asked_for(world: Build, shapes: Any) -> None:
    problem = problem_of(world((shapes[0]((0.0, 0.0, 1.0), 5.0),)))

    @dataclass(frozen=True)
    class Forgets(Says):
        def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Any]:
            return super().correct(problem, views[1:])

    with pytest.raises(RsbenchError, match="requested views"):
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


SIZE = {"size": (240, 320), "focal": 300.0, "readout_ratio": 1.0, "shortest": 0.5}
VIEW = ("left", 1)
ROW = 120.0


@pytest.fixture(scope="module")
def worlds(world: Build, shapes: Any) -> tuple[Any, Any]:
    """A wall, and a ball that falls 19 px in a frame period as the rig sees it, but is still to the rig."""
    plane, sphere = shapes
    wall = world((plane((0.0, 0.1, 1.0), 7.0),), d=(0.3, 0.0, 0.05), w_deg=(0.2, 0.3, 0.0), **SIZE)
    still = {"w_deg": (0.0, 0.0, 0.0), "seed": 1}
    return wall, world((sphere((0.0, 0.2, 4.0), 0.9),), d=(0.0, 0.25, 0.0), **still, **SIZE)


def _both(worlds: tuple[Any, Any], look: Callable[[Any], Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, depth, and what shows the ball."""
    wall, ball = worlds
    (near, depth), (far, behind) = look(ball), look(wall)
    hit = np.isfinite(depth)
    return np.where(hit[..., None], near, far), np.where(hit, depth, behind), hit


def _problem(worlds: tuple[Any, Any], u8: Any) -> CorrectionProblem:
    seen = {view: _both(worlds, lambda each, view=view: each.rolling(*view)) for view in VIEWS}
    depth = {view: each[1].astype(np.float32) for view, each in seen.items()}
    return CorrectionProblem(
        images={view: u8(each[0]) for view, each in seen.items()},
        rig=worlds[0].rig,
        shutter=worlds[0].shutter,
        target_row=ROW,
        motion=worlds[0].motion,
        depth=depth,
        guess={view: np.zeros_like(each) for view, each in depth.items()},
    )


def _rms(a: Any, b: Any, mask: Any) -> float:
    return float(np.sqrt(np.mean((np.asarray(a, dtype=np.float64) - b)[mask] ** 2)))


@pytest.mark.slow
def test_a_ball_goes_its_own_flow_and_the_wall_is_seen_beside_it(worlds: tuple[Any, Any], u8: Any) -> None:
    problem = _problem(worlds, u8)
    tau = float(problem.shutter.time_after(ROW, 1, "left"))
    true, _, on_ball = _both(worlds, lambda each: each.still("left", tau))
    found = {moving: FusionCorrector(moving=moving).correct(problem, [VIEW])[VIEW] for moving in (False, True)}
    inner = cv2.erode(on_ball.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    rim = cv2.dilate(on_ball.astype(np.uint8), np.ones((31, 31), np.uint8)).astype(bool)
    # Geometry leaves the ball where its rows saw it, up to 0.3 periods of 19 px off. Flow errs by a tenth.
    errors = {moving: _rms(each.image, 255.0 * true, inner) for moving, each in found.items()}
    assert errors[True] < 0.4 * errors[False]
    assert _rms(found[True].image, 255.0 * true, rim) < 0.7 * _rms(found[False].image, 255.0 * true, rim)
    assert np.mean(found[True].origin[inner] == Origin.HERE) > 0.98
    np.testing.assert_array_equal(found[True].image[~rim], found[False].image[~rim])


@pytest.mark.parametrize("period", [24, None])
def test_flow_counts_against_a_motion_only_where_the_images_agree_with_it(period: int | None) -> None:
    """Posts every 24 px that move by 9 px also look as if they moved by -15 px; other texture does not."""
    height, width, right, wrong = 96, 576, 9, -15
    texture = np.random.default_rng(0).integers(0, 255, (height, period or width + 64), dtype=np.uint8)
    wide = np.tile(texture, (1, 30))[:, : width + 64]
    moves = right if period else wrong  # posts move as the motion says, other texture as the flow says
    greys = [wide[:, 32 : 32 + width], wide[:, 32 - moves : 32 - moves + width]]
    flow, place = (np.full((height, width, 2), [each, 0.0], dtype=np.float32) for each in (wrong, right))
    flow[: height // 2, :, 0] = right if period else wrong
    nowhere = np.zeros((height, width), dtype=np.bool_)
    still = correctors._Still(far=place, near=place, hidden=nowhere, unknown=nowhere)
    found = correctors._explained(greys, flow, lambda: -flow, still, 1.0, None)
    assert found > 0.93 if period else found < 0.02


@pytest.mark.slow
def test_the_explained_share_of_the_flow_shows_a_wrong_motion(worlds: tuple[Any, Any], u8: Any) -> None:
    """The right motion explains nearly all flow beside the ball, and a wrong one hardly any."""
    wall = worlds[0]
    seen = {view: wall.rolling(*view) for view in VIEWS}
    problem = _problem(worlds, u8)
    still = replace(
        problem,
        images={view: u8(image) for view, (image, _) in seen.items()},
        depth={view: depth.astype(np.float32) for view, (_, depth) in seen.items()},
    )
    wrong = replace(still, motion=wall.motion.with_endpoint(wall.motion.w, -40.0 * wall.motion.d))
    shares = [FusionCorrector().correct(each, [VIEW])[VIEW].explained for each in (still, problem, wrong)]
    assert min(shares[:2]) > 0.95
    assert shares[2] < 0.2
    assert np.isnan(FusionCorrector(moving=False).correct(wrong, [VIEW])[VIEW].explained)


def test_a_thing_whose_static_place_is_outside_the_frame_goes_its_own_flow(
    world: Build, shapes: Any, u8: Any
) -> None:
    """A ball beside a fast rig keeps its place in the image; if it stood still, it would have left the frame."""
    plane, sphere = shapes
    fast = {"w_deg": (0.0, 0.0, 0.0), "d": (2.4, 0.0, 0.0)}
    wall = world((plane((0.0, 0.0, 1.0), 25.0),), **fast, **SIZE)
    ball = world((sphere((0.4, 0.0, 4.0), 0.8),), w_deg=(0.0, 0.0, 0.0), d=(0.0, 0.04, 0.0), seed=1, **SIZE)
    problem, tau = _problem((wall, ball), u8), 1.5
    true, _, on_ball = _both((wall, ball), lambda each: each.still("left", tau))
    errors = [
        _rms(FusionCorrector(moving=moving).correct(problem, [VIEW])[VIEW].image, 255.0 * true, on_ball)
        for moving in (False, True)
    ]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_what_passes_before_a_plain_wall_does_not_set_it_in_motion(world: Build, shapes: Any, u8: Any) -> None:
    """Flow runs from an edge into what has no texture, and fits there: the edge hides where geometry leads."""
    plane, sphere = shapes
    wall = world((plane((0.0, 0.0, 1.0), 30.0),), d=(0.4, 0.0, 0.0), **SIZE)
    ball = world((sphere((0.0, 0.0, 4.0), 1.3),), d=(0.4, 0.0, 0.0), **SIZE)
    seen = {view: _both((wall, ball), lambda each, view=view: each.rolling(*view)) for view in VIEWS}
    problem = _problem((wall, ball), u8)
    shaded = {
        view: np.where(hit[..., None], problem.images[view], np.uint8(190)) for view, (*_, hit) in seen.items()
    }
    problem = replace(problem, images=shaded)
    images = [FusionCorrector(moving=moving).correct(problem, VIEWS) for moving in (False, True)]
    for view in VIEWS:
        np.testing.assert_array_equal(images[0][view].image, images[1][view].image)


@pytest.mark.slow
def test_columns_have_times_too(worlds: tuple[Any, Any], u8: Any) -> None:
    """The same frames, said to be read by columns: at the time of a column, what it shows of the ball stays."""
    problem = _problem(worlds, u8)
    shutter = RollingShutter(height=240, width=320, readout_ratio=1.0, scan="left")
    by_columns = replace(problem, shutter=shutter, target_row=160.0)
    fused = FusionCorrector().correct(by_columns, [VIEW])[VIEW]
    *_, on_ball = _both(worlds, lambda each: each.rolling(*VIEW))
    column = cv2.erode(on_ball.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)[:, 160]
    assert np.count_nonzero(column) > 30
    assert _rms(fused.image[:, 160], problem.images[VIEW][:, 160], column) < 2.0  # resampled at float32 places


@settings(max_examples=10)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.5, 20.0), st.integers(0, 100))
def test_the_plane_is_found_among_other_surfaces(a: float, b: float, z: float, seed: int) -> None:
    """A fifth of the pixels lies on something else: absolute differences leave the plane where it is."""
    y, x = np.mgrid[:48, :64] / 48.0
    true = z / (1.0 + a * x + b * y)
    rng = np.random.default_rng(seed)
    seen = np.where(rng.random(true.shape) < 0.2, 0.3 * true, true)
    seen[rng.random(true.shape) < 0.1] = 0.0
    found = plane_depth(seen)
    # Float32, and weights that stop at a thousandth of the median inverse depth.
    np.testing.assert_allclose(found, true, rtol=3e-3)


def test_a_plane_of_nothing_is_at_infinity() -> None:
    assert np.all(np.isinf(plane_depth(np.zeros((6, 8)))))


def test_a_plane_seen_edge_on_ends_at_infinity() -> None:
    y = np.linspace(-1.0, 1.0, 40)[:, None]
    depth = np.where(y > 0.1, 1.0 / np.maximum(y, 0.1), np.inf) * np.ones((1, 30))
    assert np.all(plane_depth(np.where(np.isfinite(depth), depth, 0.0))[:15] > 100.0)


def test_one_camera_measures_a_plane_in_the_unit_of_its_translation(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    camera = scene.rig.camera
    flow = np.zeros((camera.height, camera.width, 2), dtype=np.float32)
    flow[..., 0] = camera.fx * 0.3 / 5.0
    for unit in (1.0, 10.0):
        rig = StereoRig(camera=camera, baseline=scene.rig.baseline * unit)
        motion = type(scene.motion)(scene.motion.w, scene.motion.d * unit)
        found = monocular_depth(flow, rig, scene.shutter, motion, "left", 0)
        np.testing.assert_allclose(found, 5.0 * unit, rtol=1e-5)


@pytest.mark.parametrize("frame", [0, 1])
@pytest.mark.parametrize("side", ["left", "right"])
def test_exact_flow_gives_the_exact_depth(world: Build, shapes: Any, side: Any, frame: int) -> None:
    """The flow of every pixel's point by the row equation; every row of either frame has its own pose."""
    scene = world((shapes[0]((0.1, 0.2, 1.0), 5.0),), d=(0.3, -0.1, 0.05))
    _, depth = scene.rolling(side, frame)
    geometry = scene.rig, scene.shutter, scene.motion
    grid = scene.rig.camera.pixel_grid()
    points = back_project(*geometry, side, frame, grid, depth)
    seen = rs_project_near(*geometry, side, 1 - frame, points, grid[..., 1])
    inside = np.isfinite(seen.depth)
    found, error = flow_depth(grid[inside], (seen.pixels - grid)[inside], *geometry, side, frame)
    # rs_project_near stops at 1e-9 px; the parallax is some 15 px. The depth map itself is float32.
    np.testing.assert_allclose(found, depth[inside], rtol=1e-5)
    assert np.max(error) < 1e-4


def test_flow_that_the_motion_forbids_has_its_error(world: Build, shapes: Any) -> None:
    """Sideways motion moves pixels along the rows: 3 px across them are an error; the wrong way is infinite."""
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    geometry = scene.rig, scene.shutter, scene.motion
    pixels = np.array([[40.0, 30.0], [40.0, 30.0], [40.0, 30.0]])
    depth, error = flow_depth(pixels, np.array([[8.0, 0.0], [8.0, 3.0], [-2.0, 0.0]]), *geometry, "left", 0)
    assert np.isfinite(depth[0]) and error[0] < 1e-9
    assert 2.5 < error[1] < 3.5  # the rows are also read at other times
    assert np.isinf(depth[2]) and error[2] == pytest.approx(2.0)
