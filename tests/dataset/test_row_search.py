"""The compiled search of rows against ``rs_project``, which brackets every crossing at exact poses.

Global shutters, and motions that no table of poses follows: tests/verification/test_compiled_reprojection.py.
"""

from __future__ import annotations

import numpy as np
from general_rigs import LENSES
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.geometry import FixedGeometry
from rsbench.core.motion import Motion
from rsbench.core.projection import ProjectionStatus, back_project, project_at, rs_project
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.views import ImageView, find

MODELS = (LinearMotion, TwistMotion, AcceleratedMotion, lambda w, d: SplineMotion(w, d, preset="drone", seed=3))
NEAR_PX = 5e-6
"""The residual at which the search stops, 1e-8 px, and where a spline ends between two rows, the table's error of
1e-8 of a focal length, over a slope of the row equation above 0.2."""


def _geometry(lens: Lens | None, motion: Motion, **scan: object) -> FixedGeometry:
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=62.0, cx=30.0, cy=25.0, lens=lens)
    shutter = RollingShutter(height=48, width=64, readout_ratio=0.9, **scan)  # pyrefly: ignore[bad-argument-type]
    return FixedGeometry(StereoRig(camera=camera, baseline=0.3), shutter, motion)


def _points(geometry: FixedGeometry, source: ImageView, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """What pixels (4, 64) of the source see at random depths, and the lines where the search starts."""
    rows = np.sort(rng.choice(48, 4, replace=False))
    grid = geometry.rig.camera.pixel_grid()[rows]
    depth = np.where(rng.random((4, 64)) < 0.2, 1e7, np.exp(rng.uniform(-0.5, 3.0, (4, 64))))
    return back_project(*geometry[:3], source.side, source.frame, grid, depth), grid


@settings(max_examples=15)
@given(
    lens=st.sampled_from((None, *LENSES.values())),
    model=st.sampled_from(MODELS),
    scan=st.sampled_from(("top", "bottom", "left", "right")),
    right=st.sampled_from((None, "top", "right")),
    delay=st.sampled_from((0.0, 0.2)),
    target=st.sampled_from([ImageView("rs", "right", 0), ImageView("rs", "left", 1), ImageView("rs", "right", 1)]),
    speed=st.floats(0.0, 1.0),
    seed=st.integers(0, 2**20),
)
def test_it_finds_the_pixels_that_bracketing_finds(
    lens: Lens | None,
    model: type[Motion],
    scan: str,
    right: str | None,
    delay: float,
    target: ImageView,
    speed: float,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    w, d = speed * 0.15 * rng.standard_normal(3), speed * 0.4 * rng.standard_normal(3)
    geometry = _geometry(lens, model(w, d), scan=scan, right_scan=right, right_delay=delay)
    X, grid = _points(geometry, ImageView("rs", "left", 0), rng)
    landed = find(geometry, target, X, grid[..., geometry.shutter.axis(target.side)])
    truth = rs_project(*geometry[:3], target.side, target.frame, X)
    once, never = truth.status == ProjectionStatus.SEEN, truth.status == ProjectionStatus.NEVER
    assert not np.any(landed.unsolved)
    np.testing.assert_allclose(landed.pixels[once], truth.pixels[once], rtol=0, atol=NEAR_PX)
    assert np.all(np.isnan(landed.pixels[never]))
    seen = np.isfinite(landed.pixels[..., 0])
    assert np.all(seen[truth.status == ProjectionStatus.TWICE])
    tau = geometry.shutter.pixel_time(landed.pixels[seen], target.frame, target.side)
    exact = project_at(geometry.rig, geometry.motion, target.side, tau, X[seen])[:, :2]
    np.testing.assert_allclose(landed.pixels[seen], exact, rtol=0, atol=NEAR_PX)
    eyes = inverse(geometry.rig.cam_from_world(geometry.motion, tau, target.side)).t
    np.testing.assert_allclose(landed.eyes[seen], eyes, rtol=0, atol=1e-9)
