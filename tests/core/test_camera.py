"""The camera, the pixel convention, and lenses against OpenCV's, finite differences and their own inverse."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from differences import derivatives
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.camera import WIDEST, Lens, PinholeCamera

CAMERA = PinholeCamera(width=640, height=480, fx=500.0, fy=510.0, cx=310.0, cy=250.0)


@settings(max_examples=40)
@given(st.floats(-100, 800), st.floats(-100, 800), st.floats(0.01, 1000))
def test_project_inverts_unproject(x: float, y: float, depth: float) -> None:
    ray = CAMERA.unproject([x, y])
    assert ray[2] == 1.0
    np.testing.assert_allclose(CAMERA.project(depth * ray), [x, y], rtol=0, atol=1e-12)  # rounding at 1000 px


def test_project_is_the_homogeneous_product_with_K() -> None:
    x = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 5], size=(7, 3))
    homogeneous = x @ CAMERA.K.T
    np.testing.assert_allclose(CAMERA.project(x), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-14)


def test_axes_are_right_down_forward() -> None:
    centre = CAMERA.project([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(centre, [310.0, 250.0])
    assert CAMERA.project([0.1, 0.0, 1.0])[0] > centre[0]
    assert CAMERA.project([0.0, 0.1, 1.0])[1] > centre[1]


def test_centre_of_the_top_left_pixel_is_zero() -> None:
    camera = PinholeCamera.centred(900, 900, 1384.6)
    assert (camera.cx, camera.cy) == (449.5, 449.5)
    grid = camera.pixel_grid()
    assert grid.shape == (900, 900, 2)
    np.testing.assert_array_equal(grid[0, 0], [0.0, 0.0])
    np.testing.assert_array_equal(grid[3, 7], [7.0, 3.0])  # (x, y) at [row, column]
    # The optical axis meets the image in the middle of all pixel centres.
    np.testing.assert_array_equal(grid.mean(axis=(0, 1)), [camera.cx, camera.cy])


@pytest.mark.parametrize("z", [0.0, -1e-9, -3.0])
def test_points_not_in_front_have_no_pixel(z: float) -> None:
    assert np.all(np.isnan(CAMERA.project([0.1, 0.2, z])))


def test_the_image_area_reaches_half_a_pixel_beyond_the_outermost_centres() -> None:
    pixels = [[-0.5, -0.5], [639.5, 479.5], [-0.51, 0], [0, -0.51], [639.51, 0], [0, 479.51], [np.nan, 3]]
    np.testing.assert_array_equal(CAMERA.contains(pixels), [True, True, False, False, False, False, False])


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", 0), ("height", -1), ("fx", 0.0), ("fy", float("nan")), ("cx", float("inf")), ("cy", float("nan"))],
)
def test_bad_intrinsics_are_refused_by_name(field: str, value: float) -> None:
    good = {"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    with pytest.raises(ValueError, match=f"camera {field} = "):
        PinholeCamera(**{**good, field: value})  # pyrefly: ignore[bad-argument-type]


PLAIN = PinholeCamera(width=640, height=480, fx=420.0, fy=430.0, cx=310.0, cy=250.0)
PHONE = Lens(model="brown-conrady", k1=0.12, k2=-0.35, p1=0.0011, p2=-0.0007, k3=0.28)
ACTION = Lens(model="brown-conrady", k1=-0.26, k2=0.05, p1=0.0004, p2=0.0002, k3=-0.003)
FISHEYE = Lens(model="kannala-brandt", k1=-0.02, k2=0.006, k3=-0.004, k4=0.0006)
# Figures of a depth camera, and of a 100 degree lens, whose radii bend both ways.
DEPTH = Lens(model="rational", k1=0.6, k2=-2.6, p1=0.0007, p2=-0.0003, k3=1.5, k4=0.48, k5=-2.4, k6=1.43)
WIDE = Lens(model="rational", k1=0.9, k2=0.06, p1=-0.0004, p2=0.0002, k3=0.001, k4=1.25, k5=0.22, k6=0.006)
SPHERES = Lens(model="double-sphere", xi=-0.18, alpha=0.59)
BALL = Lens(model="double-sphere", xi=0.4, alpha=0.3)
LENSES = [PHONE, ACTION, FISHEYE, DEPTH, WIDE, SPHERES, BALL]
IDS = ["phone", "action", "fisheye", "depth", "wide", "spheres", "ball"]


def _opencv(lens: Lens, X: np.ndarray) -> np.ndarray:
    """OpenCV's pixels of points (n, 3)."""
    still = np.zeros(3)
    if lens.model == "double-sphere":
        return _two_spheres(lens, X)
    k = np.array(lens.coefficients)
    if lens.model == "kannala-brandt":
        return cv2.fisheye.projectPoints(X[:, None], still, still, PLAIN.K, k)[0][:, 0]
    return cv2.projectPoints(X[:, None], still, still, PLAIN.K, k)[0][:, 0]


def _two_spheres(lens: Lens, X: np.ndarray) -> np.ndarray:
    """The construction, angle by angle: onto a unit sphere, onto a second one whose centre is at -xi, and through
    a pinhole alpha / (1 - alpha) behind that on a plane scaled by 1 / (1 - alpha)."""
    angle = np.arctan2(np.hypot(X[:, 0], X[:, 1]), X[:, 2])
    second = np.arctan2(np.sin(angle), np.cos(angle) + lens.xi)
    radius = np.sin(second) / (lens.alpha + (1.0 - lens.alpha) * np.cos(second))
    around = np.arctan2(X[:, 1], X[:, 0])
    xy = radius[:, None] * np.stack([np.cos(around), np.sin(around)], axis=-1)
    return xy * (PLAIN.fx, PLAIN.fy) + (PLAIN.cx, PLAIN.cy)


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_pixels_are_opencvs_or_the_papers(lens: Lens) -> None:
    camera = replace(PLAIN, lens=lens)
    pixels = np.random.default_rng(0).uniform([-0.5, -0.5], [639.5, 479.5], size=(500, 2))
    X = camera.unproject(pixels) * np.random.default_rng(1).uniform(0.1, 50, size=(500, 1))
    # Two implementations of polynomials of order 9 in numbers near 1, times 420 px.
    np.testing.assert_allclose(_opencv(lens, X), pixels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(camera.project(X), pixels, rtol=0, atol=1e-10)


@pytest.mark.parametrize("brown", [PHONE, ACTION])
def test_a_rational_lens_without_a_denominator_is_brown_and_conradys(brown: Lens) -> None:
    xy = np.random.default_rng(3).uniform(-0.7, 0.7, (200, 2))
    rational = Lens(model="rational", **{name: getattr(brown, name) for name in ("k1", "k2", "p1", "p2", "k3")})
    assert rational.reach == pytest.approx(min(brown.reach, np.tan(WIDEST)), rel=1e-12)
    for found, expected in zip(rational.distort(xy), brown.distort(xy), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


@settings(max_examples=40)
@given(st.floats(-0.9, 1.5), st.floats(0.0, 1.0), st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2))
def test_two_spheres_are_inverted_up_to_where_they_fold(xi: float, alpha: float, direction: list[float]) -> None:
    lens = Lens(model="double-sphere", xi=xi, alpha=alpha)
    # The distorted radius grows with the angle up to the reach, and no further if that is nearer than WIDEST.
    at = np.linspace(0.0, np.arctan(lens.reach) - 1e-6, 2001)
    X = np.stack([np.sin(at), 0.0 * at, np.cos(at)], axis=-1)
    assert np.all(np.diff(_two_spheres(lens, X)[:, 0]) > 0.0)
    assert np.all(np.isfinite(lens.distort(X[:, :2] / X[:, 2:]).xy))
    if lens.reach < 0.999 * np.tan(WIDEST):
        after = np.arctan(lens.reach) + np.array([1e-4, 1.1e-4])
        ends = _two_spheres(lens, np.stack([np.sin(after), 0.0 * after, np.cos(after)], axis=-1))[:, 0]
        assert ends[1] < ends[0] or ends[0] < PLAIN.cx or abs(ends[0]) > 1e5
    ideal = np.array(direction) * min(1.0, 0.3 * lens.reach)
    np.testing.assert_allclose(lens.undistort(lens.distort(ideal).xy), ideal, rtol=1e-9, atol=1e-12)


@settings(max_examples=40)
@given(
    st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6), st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2)
)
def test_a_rational_lens_is_inverted_up_to_where_it_folds(k: list[float], direction: list[float]) -> None:
    lens = Lens(model="rational", **dict(zip(("k1", "k2", "k3", "k4", "k5", "k6"), k, strict=True)))
    at = np.linspace(0.0, min(lens.reach, 20.0), 4001)[:-1]
    seen = lens.distort(np.stack([at, 0.0 * at], axis=-1)).xy[:, 0]
    assert np.all(np.diff(seen) > -1e-12 * np.max(np.abs(seen)))
    ideal = 1.3 * np.array(direction) * min(lens.reach, 5.0)
    found, J = lens.distort(ideal)
    if np.linalg.det(J) > 1e-3:
        np.testing.assert_allclose(lens.undistort(found), ideal, rtol=1e-9, atol=1e-11)


@settings(max_examples=40)
@given(
    st.sampled_from(["brown-conrady", "kannala-brandt"]),
    st.lists(st.floats(-0.25, 0.25), min_size=4, max_size=4),
    st.lists(st.floats(-0.003, 0.003), min_size=2, max_size=2),
    st.floats(300, 900),
)
def test_a_lens_is_inverted_over_the_whole_image_or_refused(
    model: str, k: list[float], p: list[float], focal: float
) -> None:
    radial = dict(zip(("k1", "k2", "k3", "k4"), k, strict=True))
    if model == "brown-conrady":
        radial = {**radial, "p1": p[0], "p2": p[1]}
        del radial["k4"]
    try:
        camera = replace(PLAIN, fx=focal, fy=focal, lens=Lens(model=model, **radial))  # pyrefly: ignore[bad-argument-type]
    except ValueError as error:
        assert "folds inside the image" in str(error)
        return
    grid = np.linspace([-0.5, -0.5], [639.5, 479.5], 21)
    pixels = np.stack(np.meshgrid(grid[:, 0], grid[:, 1]), axis=-1)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(camera.project(3.0 * rays), pixels, rtol=0, atol=1e-9)
    # Neighbours stay neighbours: an image that folded would swap some.
    ideal = camera.ideal_pixels(pixels)
    across, down = np.diff(ideal, axis=1)[:-1], np.diff(ideal, axis=0)[:, :-1]
    assert np.all(across[..., 0] * down[..., 1] > across[..., 1] * down[..., 0])


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_derivatives_are_those_of_differences(lens: Lens) -> None:
    camera = replace(PLAIN, lens=lens)
    pixels = np.random.default_rng(2).uniform([5, 5], [634, 474], size=(50, 2))
    # Third derivatives times step^2 / 6, and rounding of 1e3 px over the step.
    numeric = derivatives(camera.ideal_pixels, pixels, 1e-3)
    np.testing.assert_allclose(camera.ideal_by_pixel(pixels), numeric, rtol=0, atol=1e-8)
    x, rate = camera.unproject(pixels) * 2.0, np.array([0.3, -0.2, 0.5])
    numeric = (camera.project(x + 1e-5 * rate) - camera.project(x - 1e-5 * rate)) / 2e-5
    np.testing.assert_allclose(camera.velocity(x, rate), numeric, rtol=0, atol=1e-5)


def test_the_middle_of_a_lens_is_ideal() -> None:
    near = np.array([[0.0, 0.0], [1e-9, 0.0], [3e-7, -2e-7], [1e-5, 1e-5]])
    for lens in LENSES:
        found, J = lens.distort(near)
        focal = 1.0 / (1.0 + lens.xi)
        assert replace(PLAIN, lens=lens).central_focal == (focal * PLAIN.fx, focal * PLAIN.fy)
        np.testing.assert_allclose(found, focal * near, rtol=1e-5, atol=1e-11)
        np.testing.assert_allclose(J, np.broadcast_to(focal * np.eye(2), J.shape), atol=3e-4)
        np.testing.assert_allclose(lens.undistort(found), near, rtol=1e-12, atol=1e-20)


@pytest.mark.parametrize("k1", [-0.6, -2.0])
def test_a_lens_that_folds_inside_the_image_is_refused_by_name(k1: float) -> None:
    # r (1 + k1 r^2) turns at r = 1 / sqrt(-3 k1): 0.75 and 0.41; the corners need more than 0.9.
    with pytest.raises(ValueError, match="brown-conrady polynomial folds inside the image"):
        replace(PLAIN, lens=Lens(model="brown-conrady", k1=k1))


def test_beyond_the_fold_there_is_no_pixel_instead_of_a_wrong_one() -> None:
    lens = Lens(model="brown-conrady", k1=-0.3)
    turn = 1.0 / np.sqrt(0.9)
    assert lens.reach == pytest.approx(turn, rel=1e-12)
    # 1.6 (1 - 0.3 * 1.6^2) = 0.37: the polynomial alone would show this point in the image.
    seen = lens.distort([[1.6, 0.0], [0.999 * turn, 0.0]]).xy
    assert np.all(np.isnan(seen[0])) and np.all(np.isfinite(seen[1]))
    # No ideal point is distorted further out than the turn.
    most = turn * (1 - 0.3 * turn**2)
    found = lens.undistort([[1.001 * most, 0.0], [0.999 * most, 0.0]])
    assert np.all(np.isnan(found[0])) and np.all(np.isfinite(found[1]))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"model": "pinhole"}, "lens model = 'pinhole'"),
        ({"model": "brown-conrady", "k4": 0.1}, "k4 = 0.1: brown-conrady has no"),
        ({"model": "kannala-brandt", "p1": 0.1}, "p1 = 0.1: kannala-brandt has no"),
        ({"model": "brown-conrady", "k5": 0.1}, "k5 = 0.1: brown-conrady has no"),
        ({"model": "double-sphere", "k1": 0.1}, "k1 = 0.1: double-sphere has no"),
        ({"model": "double-sphere", "xi": -1.0, "alpha": 0.5}, "xi = -1.0: must be above -1"),
        ({"model": "double-sphere", "alpha": 1.5}, "alpha = 1.5: must lie in"),
        ({"model": "brown-conrady", "k1": float("nan")}, "k1 = nan: must be a number that is finite"),
    ],
)
def test_wrong_lenses_are_refused_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Lens(**values)  # pyrefly: ignore[bad-argument-type]
