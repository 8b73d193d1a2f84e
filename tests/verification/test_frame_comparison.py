"""Surfaces that verify takes for flat, and depth between pixels, against planes in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from general_rigs import LENSES

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.views import IMAGE_VIEWS
from rsbench.storage.files import read_depth, write_depth
from rsbench.verification import reprojection, verify_sequence
from rsbench.verification.depth_checks import roughly_agree
from rsbench.verification.manifest_checks import Listing
from rsbench.verification.reprojection import DepthMap

PLANE = np.array([0.03, 0.12, 0.2])
"""n / c of n . X = c: the inverse depth of a ray (x, y, 1) is their product."""
RIG = StereoRig(camera=PinholeCamera.centred(64, 48, 60.0), baseline=0.3)
SHUTTER = RollingShutter(height=48, readout_ratio=0.9)
MOTION = LinearMotion([0.02, -0.03, 0.01], [0.1, -0.05, 0.2])


def _plane(lens: Lens | None) -> DepthMap:
    camera = replace(PinholeCamera.centred(64, 48, 60.0), lens=lens)
    depth = (1.0 / (camera.unproject(camera.pixel_grid()) @ PLANE)).astype(np.float32)
    return DepthMap(IMAGE_VIEWS[4], depth, camera)


@pytest.mark.parametrize("lens", [None, *LENSES.values()])
def test_a_plane_is_flat_through_every_lens(lens: Lens | None) -> None:
    seen = _plane(lens)
    # Float32 rounds inverse depth by 6e-8, far below the bend that counts.
    assert np.all(seen.flat[1:-1, 1:-1]) and np.all(seen.flat_blocks)
    bowl = 1 + 0.75 * reprojection.FLATNESS * np.arange(-20, 44) ** 2  # half as much again as counts as flat
    bent = replace(seen, depth=(seen.depth / bowl).astype(np.float32))
    assert not np.any(bent.flat_blocks[:, 10:30])


@pytest.mark.parametrize("lens", [None, *LENSES.values()])
def test_depth_between_pixels_is_that_of_the_plane(lens: Lens | None) -> None:
    seen = _plane(lens)
    rng = np.random.default_rng(1)
    pixels: FloatArray = rng.uniform((1, 1), (61, 45), (200, 2))
    x0, y0 = np.floor(pixels).astype(int).T
    exact = seen.camera.unproject(pixels) @ PLANE
    # Float32, and the slope at a corner of the square instead of in it: 1e-3 of a correction of 1e-4.
    ideal = seen.camera.ideal_pixels(pixels)
    np.testing.assert_allclose(reprojection._interpolated(seen, pixels, ideal, y0, x0), exact, rtol=3e-7)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    write_analytic_dataset(tmp_path, RIG, SHUTTER, MOTION)
    return tmp_path


def test_planes_of_which_no_place_is_flat_are_spoilt(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reprojection, "FLATNESS", -1.0)
    listing = Listing.of(dataset, {"sequences": ["planes"]})
    fault = "rs_depth/left_0.exr: all rows: nothing can be compared with another frame"
    assert fault in verify_sequence(listing, "planes").faults


def test_maps_of_thin_things_are_compared_roughly() -> None:
    still = LinearMotion([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    sequence = FixedGeometry(RIG, SHUTTER, still)
    rng = np.random.default_rng(2)
    leaves = rng.uniform(2.0, 9.0, (48, 64)).astype(np.float32)  # another thing in every pixel
    seen = {view: DepthMap(view, leaves, RIG.camera) for view in IMAGE_VIEWS}
    view = IMAGE_VIEWS[0]
    assert roughly_agree(sequence, seen, view)
    for change in (leaves * 1.05, leaves[:, ::-1], rng.permutation(leaves), leaves + 2.0):
        spoilt = replace(seen[view], depth=np.ascontiguousarray(change, dtype=np.float32))
        assert not roughly_agree(sequence, seen | {view: spoilt}, view)
    smooth = {view: replace(each, depth=np.ones_like(leaves)) for view, each in seen.items()}
    assert not roughly_agree(sequence, smooth, view), "what could be flat is no thin thing"


def test_a_map_that_begins_elsewhere_says_where(dataset: Path) -> None:
    path = dataset / "planes/rs_depth/left_0.exr"
    depth, twin = read_depth(path), read_depth(dataset / "planes/gs_depth/left_0.exr")
    write_depth(path, np.concatenate([depth[:-1] * np.float32(1.001), twin[-1:]]))
    listing = Listing.of(dataset, {"sequences": ["planes"]})
    faults = verify_sequence(listing, "planes").faults
    assert any("row 0 differs" in fault and "looks read from the bottom" in fault for fault in faults)
