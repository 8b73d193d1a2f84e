"""Things that move by themselves before a rig: two closed-form worlds in one, theirs and that of the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.core.rig import VIEWS
from rsbench.core.shutter import RollingShutter
from rsbench.vision.corrector import CorrectionProblem
from rsbench.vision.correctors import FusionCorrector
from rsbench.vision.fusion import Origin

Build = Callable[..., Any]
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


@pytest.mark.slow
def test_where_everything_stands_nothing_changes(
    worlds: tuple[Any, Any], world: Build, shapes: Any, u8: Any
) -> None:
    plane, sphere = shapes
    standing = world((plane((0.0, 0.1, 1.0), 7.0), sphere((0.0, 0.2, 4.0), 0.9)), d=(0.3, 0.0, 0.05), **SIZE)
    nothing = world((sphere((0.0, 50.0, 4.0), 0.9),), d=(0.0, 0.0, 0.0), **SIZE)
    problem = _problem((standing, nothing), u8)
    images = [FusionCorrector(moving=moving).correct(problem, VIEWS) for moving in (False, True)]
    for view in VIEWS:
        np.testing.assert_array_equal(images[0][view].image, images[1][view].image)


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


def test_nothing_is_found_without_depth_or_texture(worlds: tuple[Any, Any], u8: Any) -> None:
    problem = _problem(worlds, u8)
    shape = problem.images[VIEW].shape
    grey = {view: np.full(shape, 90, np.uint8) for view in VIEWS}
    blind = {view: np.zeros(shape[:2], np.float32) for view in VIEWS}
    for given in (replace(problem, images=grey), replace(problem, depth=blind, guess=blind)):
        one, other = (FusionCorrector(moving=moving).correct(given, [VIEW])[VIEW] for moving in (False, True))
        np.testing.assert_array_equal(one.image, other.image)


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
