"""Whether others' frames agree with their cameras and poses: points at their pixels, matches on their lines.

Truth: projections written out here, and frames that are drawn row by row (``carla_frames``).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
from carla_frames import skew, write, write_carla, write_image
from commands import run_here
from hypothesis import assume, given
from hypothesis import strategies as st

from rsbench.core.camera import PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.interop.readers.check import epipolar_distance, sights
from rsbench.interop.readers.layouts import read_carla, read_colmap


def write_points(folder: Path, shift: float = 0.0) -> Path:
    """A model of one camera, two images and 40 points, each image ``shift`` m beside where it says."""
    write(folder / "cameras.txt", "1 PINHOLE 640 480 500 510 320 240\n")
    rng = np.random.default_rng(3)
    points = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (40, 3))
    write(
        folder / "points3D.txt", "".join(f"{7 + k} {x} {y} {z} 0 0 0 0.5\n" for k, (x, y, z) in enumerate(points))
    )
    text = ""
    for number, x in enumerate((0.0, 0.3)):
        at = points + np.array([x + shift, 0.0, 0.0])
        seen = at[:, :2] / at[:, 2:] * [500, 510] + [320, 240]
        rest = "".join(f" {u} {v} {7 + k}" for k, (u, v) in enumerate(seen))
        text += f"{number + 1} 1 0 0 0 {x} 0 0 1 {number}.png\n3.5 4.5 -1{rest}\n"
    write(folder / "images.txt", text)
    for number in range(2):
        write_image(folder / "images" / f"{number}.png", np.zeros((480, 640), dtype=np.uint8))
    return folder


def test_colmap_points_are_seen_where_its_poses_say(tmp_path: Path) -> None:
    found = list(sights(read_colmap(write_points(tmp_path))[0]))
    assert [(each.count, each.fault) for each in found] == [(40, ""), (40, "")]
    assert max(each.typical for each in found) < 1e-9  # the half pixel of the corner on both sides


def test_colmap_images_that_stand_elsewhere_are_faults(tmp_path: Path) -> None:
    run = run_here("verify", write_points(tmp_path, shift=0.1), "--from", "colmap")
    assert run.returncode == 1 and run.stderr.count("points of left image") == 2


def test_matches_of_rolling_frames_lie_where_poses_of_their_rows_say(tmp_path: Path) -> None:
    (right,) = sights(read_carla(write_carla(tmp_path / "right"))[0])
    (still,) = sights(read_carla(write_carla(tmp_path / "still", row_ms=0.0))[0])
    assert right.count > 100 and right.share > 0.95 and right.typical < 0.15  # features err by a tenth of a pixel
    assert still.typical > 3.0 * right.typical


seconds, thirds = st.floats(-0.2, 0.2), st.floats(-1.0, 1.0)


@given(w=st.tuples(seconds, seconds, seconds), t=st.tuples(thirds, thirds, thirds), seed=st.integers(0, 100))
def test_exact_matches_are_on_their_half_of_the_line(
    w: tuple[float, float, float], t: tuple[float, float, float], seed: int
) -> None:
    """With the other sign of the translation they are as far from it as they moved since infinity."""
    assume(np.linalg.norm(t) > 0.05)
    camera = PinholeCamera.centred(640, 480, 500.0)
    points = np.random.default_rng(seed).uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 8.0], (20, 3))
    pose = Pose(scipy.linalg.expm(skew(np.array(w))), np.array(t))
    there, far = points @ pose.R.T + pose.t, points @ pose.R.T
    matches = np.concatenate([camera.project(points), camera.project(there)], axis=1)
    # 1e-6: where the epipole is near, both sides of the quotient are rounding of small numbers.
    assert np.max(epipolar_distance(pose, matches, camera, camera)) < 1e-6
    moved = np.linalg.norm(camera.project(there) - camera.project(far), axis=1)
    found = epipolar_distance(Pose(pose.R, -pose.t), matches, camera, camera)
    np.testing.assert_allclose(found, moved, rtol=1e-6, atol=1e-6)
