"""Inverse depth along the border. Truth: that of planes, which is affine in the pixel."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rsbench.vision.border_depth import continued

Y, X = np.mgrid[0:120, 0:160].astype(np.float64)


def band(side: str, width: int) -> np.ndarray:
    unknown = np.zeros(Y.shape, dtype=bool)
    along, at = (unknown.T if side in ("left", "right") else unknown), width
    along[: at if side in ("top", "left") else 0] = True
    along[len(along) - at if side in ("bottom", "right") else len(along) :] = True
    return unknown


@given(
    side=st.sampled_from(["top", "bottom", "left", "right"]),
    width=st.integers(1, 17),
    a=st.floats(-1e-3, 1e-3),
    b=st.floats(-1e-3, 1e-3),
)
def test_a_plane_goes_on(side: str, width: int, a: float, b: float) -> None:
    plane = (0.3 + a * X + b * Y).astype(np.float32)
    unknown = band(side, width)
    found = continued(np.where(unknown, np.float32(np.nan), plane))
    np.testing.assert_array_equal(found[~unknown], plane[~unknown])
    np.testing.assert_allclose(found[unknown], plane[unknown], rtol=1e-5)  # float32


def test_wide_bands_holes_and_what_is_no_plane_stay_unknown() -> None:
    plane = (0.3 + 1e-3 * X).astype(np.float32)
    wide, hole = band("bottom", 30), np.zeros(Y.shape, dtype=bool)
    hole[40:60, 50:70] = True
    steps = np.where(Y % 20 < 10, np.float32(0.2), np.float32(0.6))
    for depth, unknown in ((plane, wide), (plane, hole), (steps, band("bottom", 9))):
        found = continued(np.where(unknown, np.float32(np.nan), depth).astype(np.float32))
        np.testing.assert_array_equal(np.isnan(found), unknown)
    assert np.isnan(continued(np.full((20, 30), np.nan, np.float32))).all()
