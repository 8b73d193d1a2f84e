"""Calibrations of other tools: one rig in all formats gives the same numbers; the rest is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calibration_files import D_LEFT, D_RIGHT, LEFT, RIGHT, SIZE, WRITERS, R, T

from rsbench.core.rig import StereoRig
from rsbench.interop.readers.rig_files import read_rig_file

NO_UNIT = {"opencv of zed"}


def rig_of(path: Path) -> StereoRig:
    card, _ = read_rig_file(path, frame_size=lambda: SIZE)
    return card.rig(SIZE, SIZE)


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in NO_UNIT])
def test_one_rig_in_all_formats_gives_the_same_numbers(name: str, tmp_path: Path) -> None:
    rig = rig_of(WRITERS[name](tmp_path))
    for side, own, d in (("left", LEFT, D_LEFT), ("right", RIGHT, D_RIGHT)):
        camera = rig.sensor(side)
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), own, atol=1e-9)
        assert camera.lens is not None and camera.lens.model == "brown-conrady"
        np.testing.assert_allclose(camera.lens.coefficients, [*d, 0.0], atol=1e-12)
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-9)
    np.testing.assert_allclose(rig.right_from_left.t, T, atol=1e-9)
