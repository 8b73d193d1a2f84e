"""Compiling ahead: so that no solver's time holds it, and no worker repeats it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.five_point import five_point
from rsbench.solvers.engine.kernel_type import has_kernel
from rsbench.solvers.engine.minimal import solve_triples
from rsbench.solvers.engine.packed import pack, pack_pairs


def warm_up(motion_models: Iterable[str] = ("linear",)) -> None:
    """Compile what the solvers of these motion models call, or load it where it was compiled before.

    Call it before workers start, so that they find the code on disk, and in each of them before a clock starts.

    Raises:
        RsbenchError: a motion model that does not exist. Of one without a kernel there is nothing to compile.
    """
    rig = StereoRig(camera=PinholeCamera.centred(64, 64, 60.0), baseline=1.0)
    shutter = RollingShutter(height=64, readout_ratio=0.5)
    x, y = np.linspace(5.0, 50.0, 8), np.linspace(50.0, 10.0, 8) ** 1.1 / 2.0
    tracks = np.column_stack([x + 4.0, y, x, y, x + 5.0, y + 1.0, x + 0.8, y + 1.0])
    pairs = tracks[:, [0, 1, 4, 5]] + 0.25
    matches = Correspondences(left=pairs, right=pairs, tracks=tracks)
    theta = np.array([0.01, 0.0, 0.0, 0.1, 0.0, 0.0])
    for model in [name for name in motion_models if has_kernel(name)]:
        packed = pack(matches, rig, shutter, model)
        packed.normal_equations(theta)
        packed.in_front(theta)
        solve_triples(packed, np.arange(6).reshape(2, 3))
    five_point(pack_pairs(pairs, "left", rig, shutter)[:5])
