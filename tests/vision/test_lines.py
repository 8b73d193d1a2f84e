"""Straight edges against edges that are drawn where they are known to be."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.triplets import LineTripletSolver
from rsbench.storage.files import load_matches, save_matches
from rsbench.vision.feature_matcher import find_correspondences, load_features
from rsbench.vision.lines import LineOptions, detect_lines, match_lines

RIG = StereoRig(camera=PinholeCamera.centred(480, 480, 480.0), baseline=0.3)
MOTION = LinearMotion(w=np.deg2rad([0.6, -0.8, 1.2]), d=np.array([0.15, -0.08, 0.2]))
PX_PER_M, MIDDLE = 400.0, 900.0


def half_plane(x0: float, y0: float, angle: float, size: int = 160, parts: int = 12) -> NDArray[np.uint8]:
    """Bright beyond a line through (x0, y0) with that normal: mean over each pixel, the first centred at 0."""
    places = (np.arange(size)[:, None] + (np.arange(parts) + 0.5) / parts - 0.5).ravel()
    bright = (places - x0) * np.cos(angle) + (places[:, None] - y0) * np.sin(angle) > 0.0
    share = bright.reshape(size, parts, size, parts).mean(axis=(1, 3))
    return np.round(50.0 + 150.0 * share).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0, 30, 45, -40, 150, 180, 225])
def test_segments_lie_where_edges_do(degrees: int) -> None:
    """The centre of the top-left pixel is (0, 0); a shift of 1/8 px, OpenCV's at its own scale, would be seen."""
    angle = np.radians(degrees)
    for x0, y0 in ((79.5, 79.5), (80.0, 79.3), (79.75, 80.1)):
        ends = detect_lines(half_plane(x0, y0, angle))
        assert len(ends) == 1
        normal = np.array([np.cos(angle), np.sin(angle)])
        off = (ends.reshape(2, 2) - [x0, y0]) @ normal
        assert np.abs(off).max() < 0.06
        # The same side is the brighter one, whichever way the edge runs.
        along = ends[0, 2:] - ends[0, :2]
        assert along[0] * normal[1] - along[1] * normal[0] < 0.0


def wall(seed: int) -> NDArray[np.uint8]:
    """A picture of grey quadrilaterals, 1800 px wide: a wall at 4 m."""
    rng, picture = np.random.default_rng(seed), np.full((1800, 1800), 128, dtype=np.uint8)
    for _ in range(60):
        centre, turn = rng.uniform(100, 1700, 2), rng.uniform(0.0, np.pi)
        angles = turn + np.array([0.2, 1.4, 3.3, 4.6])
        corners = centre + rng.uniform(60, 220) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        cv2.fillConvexPoly(picture, np.rint(corners).astype(np.int32), float(rng.integers(20, 236)))
    return cv2.GaussianBlur(picture, (0, 0), 1.5)


def homographies() -> list[FloatArray]:
    """From pixels of the wall to those of left 0, right 0, left 1, right 1."""
    pose, out = MOTION.body_from_world(1.0), list[FloatArray]()
    to_wall = np.array([[1 / PX_PER_M, 0, -MIDDLE / PX_PER_M], [0, 1 / PX_PER_M, -MIDDLE / PX_PER_M], [0, 0, 1.0]])
    lean = np.array([[1.0, 0, 0], [0, 1.0, 0], [0.15, -0.1, 4.0]])  # a plane that leans, x and y as they are
    for frame, side in itertools.product((0, 1), SIDES):
        R, t = (pose.R, pose.t) if frame else (np.eye(3), np.zeros(3))
        shift = np.zeros((3, 3))
        shift[:, 2] = t + RIG.offset(side)
        out.append(RIG.camera.K @ (R @ lean + shift) @ to_wall)
    return out


def test_matched_lines_are_one_line_and_give_the_motion() -> None:
    picture, H = wall(1), homographies()
    images = [cv2.warpPerspective(picture, h, (480, 480), flags=cv2.INTER_AREA) for h in H]
    l0, r0, l1, r1 = (np.asarray(image, dtype=np.uint8) for image in images)
    lines = match_lines(l0, r0, l1, r1)
    assert len(lines) >= 15
    seen, off = lines.reshape(-1, 4, 2, 2), list[FloatArray]()
    back = cv2.perspectiveTransform(seen[:, 0], np.linalg.inv(H[0]))
    for k in (1, 2, 3):
        p = cv2.perspectiveTransform(back, H[k])
        along = seen[:, k, 1] - seen[:, k, 0]
        normal = along[:, ::-1] * [1.0, -1.0] / np.linalg.norm(along, axis=1, keepdims=True)
        off.append(np.abs(np.sum((p - seen[:, k, :1]) * normal[:, None], axis=-1)).max(axis=1))
    assert np.mean(np.max(off, axis=0) < 1.5) >= 0.9
    still = RollingShutter(height=480, readout_ratio=0.0)
    found = LineTripletSolver().estimate(Correspondences(lines=lines), RIG, still)
    assert np.degrees(rotation_error(found.w, MOTION.w)) < 0.1
    assert np.degrees(translation_error(found.d, MOTION.d)) < 4.0


def test_images_without_edges_have_no_lines() -> None:
    blank = np.full((120, 160), 90, dtype=np.uint8)
    assert detect_lines(blank).shape == (0, 4) and match_lines(blank, blank, blank, blank).shape == (0, 16)
    edge = half_plane(80.0, 80.0, 0.1)
    other = np.full_like(edge, 9)
    assert match_lines(edge, other, other, other).shape == (0, 16)
    # No disparity: no line in front of the rig.
    assert match_lines(edge, edge, edge, edge).shape == (0, 16)


def test_wrong_arguments_are_refused() -> None:
    blank = np.zeros((40, 40), dtype=np.uint8)
    with pytest.raises(ValueError, match=r"right_1 must have the size of left_0, \(40, 40\), got \(40, 41\)"):
        match_lines(blank, blank, blank, np.zeros((40, 41), dtype=np.uint8))
    with pytest.raises(ValueError, match="min_length"):
        LineOptions(min_length=0.0)


def test_a_matcher_finds_lines_beside_points_and_they_are_stored(tmp_path: Path) -> None:
    picture = wall(2)
    shown = [cv2.warpPerspective(picture, h, (480, 480), flags=cv2.INTER_AREA) for h in homographies()]
    l0, r0, l1, r1 = (np.asarray(image, dtype=np.uint8) for image in shown)
    images = {("left", 0): l0, ("right", 0): r0, ("left", 1): l1, ("right", 1): r1}
    found = find_correspondences(load_features("sift-lines"), images)  # pyrefly: ignore[bad-argument-type]
    assert len(found.tracks) > 20 and len(found.lines) > 10
    np.testing.assert_array_equal(found.lines, match_lines(l0, r0, l1, r1))
    save_matches(tmp_path / "matches.npz", found)
    np.testing.assert_array_equal(load_matches(tmp_path / "matches.npz").lines, found.lines)
