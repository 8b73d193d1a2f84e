"""examples/solvers: other people's code behind the decorator finds a motion among wrong matches.

The limits are a tenth and a half of a degree at 0.1 px, several times the errors that these matches allow.
"""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from documents import ROOT
from solver_trials import GLOBAL, RIG, SHUTTER, D, W, errors_deg

import rsbench
from rsbench.components.motion_models import TwistMotion
from rsbench.solvers.engine.base import load_solver_entry

FOLDER = ROOT / "examples" / "solvers"
PACKAGES = {"opencv_usac": "cv2", "poselib_rig": "poselib", "colmap_rig": "pycolmap", "gtsam_stereo": "gtsam"}


def test_every_file_is_tested() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == set(PACKAGES)


@pytest.mark.parametrize("name", PACKAGES)
def test_the_motion_is_found_among_wrong_matches(name: str) -> None:
    pytest.importorskip(PACKAGES[name])
    motion = TwistMotion(W, D)
    for ending, shutter in (("", GLOBAL), ("_scaled", SHUTTER)):
        solver = f"{FOLDER / name}.py:{name}{ending}"
        entry = load_solver_entry(solver)
        spec, options = entry.solver.spec, entry.options
        assert options.robust == "own" and options.code and options.tuned_on and not entry.built_in
        assert spec.shutter == ("global" if ending == "" else "rolling")
        data = rsbench.simulate(RIG, shutter, motion, noise_px=0.1, outlier_ratio=0.3)
        found = rsbench.estimate_motion(data.correspondences, RIG, shutter, solver).estimate
        assert found.success, found.reason
        assert np.all(errors_deg(found, motion, spec.reference_point) < [0.1, 0.5])
        if spec.metric:
            assert abs(np.linalg.norm(found.d) / np.linalg.norm(D) - 1.0) < 0.05


@pytest.mark.skipif(importlib.util.find_spec("gtsam") is not None, reason="gtsam is installed")
def test_a_package_that_is_missing_is_named_in_one_line() -> None:
    words = r"gtsam_stereo\.py: cannot be imported: .*named 'gtsam'; install the package that has it$"
    with pytest.raises(rsbench.RsbenchError, match=words):
        load_solver_entry(FOLDER / "gtsam_stereo.py")
