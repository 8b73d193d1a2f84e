"""Every solver on every kind of rig: it finds the motion as on the ideal one, or refuses, as the page says."""

from __future__ import annotations

import fnmatch
import functools
import re
from pathlib import Path

import numpy as np
import pytest
from general_rigs import LEFT, RIGS, SCANS

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.correspondences import without_lens
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import list_solvers, load_solver_entry

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "cameras.md"
IDEAL = StereoRig(camera=LEFT.ideal, baseline=0.25)
CASES = {
    "ideal": (IDEAL, Scanning()),
    "lens": (StereoRig(camera=LEFT, baseline=0.25), Scanning()),
    "scan": (IDEAL, Scanning(scan="bottom", right_delay=0.1)),
    **{
        f"{rig}, {scan}": (RIGS[rig], SCANS[scan])
        for rig, scan in (
            ("turned", "rows"),
            ("turned", "late"),
            ("vertical", "columns"),
            ("toed in", "global right"),
        )
    },
}
COLUMNS = {"lens": 1, "scan": 2}
"""Of the table of docs/reference/cameras.md; the fourth is any other rig."""


@functools.cache
def table() -> dict[str, list[str]]:
    """The cells beside each name or pattern of solvers."""
    page = PAGE.read_text("utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in page.splitlines() if "| " in line]
    return {name: row for row in rows for name in re.findall(r"`((?:rs|gs)-[^`]*)`", row[0])}


@functools.cache
def simulated(case: str, model: str, ratio: float, size: float) -> Simulation:
    rig, scanning = CASES[case]
    parameters = {"acceleration": 0.2} if model == "accelerated" else {}
    motion = make_motion(
        model, size * np.array([0.01, 0.03, -0.02]), size * np.array([0.05, -0.1, 0.12]), parameters
    )
    options = SimulationOptions(
        pairs=60, tracks=60, lines=20, depth=(3.0, 8.0), gyro_rate=400, gravity=True, affine=True
    )
    shutter = rig.shutter_of(scanning if ratio else Scanning(), ratio)
    return simulate(rig, shutter, motion, options, np.random.default_rng(3))


def errors(name: str, case: str, size: float) -> FloatArray | None:
    """Of the rotation (rad) and of the translation (its direction alone, of a solver without metres), over the
    size of the motion; None where the solver refuses the rig."""
    solver = load_solver_entry(name).solver
    spec, still = solver.spec, solver.spec.shutter == "global"
    data = simulated(case, spec.motion_model, 0.0 if still else 0.8, size)
    matches, rig, (w, d) = data.correspondences, data.rig, (data.motion.w, data.motion.d)
    if spec.refusal(rig, data.shutter):
        return None
    if still:
        matches, rig = without_lens(matches, rig), rig.ideal
    found = solver.estimate(matches, rig, data.shutter)
    assert found.success, found.reason
    if spec.reference_point == "left":
        d = translation_of_offset(w, d, rig.offset("left"))
    if not found.metric:
        d = d * (np.linalg.norm(found.d) / np.linalg.norm(d))
    return np.array([float(np.linalg.norm(found.w - w)), float(np.linalg.norm(found.d - d))]) / size


@pytest.mark.parametrize("name", list_solvers())
def test_a_solver_finds_the_motion_of_a_rig_or_refuses_it_as_the_page_says(name: str) -> None:
    patterns = [pattern for pattern in table() if fnmatch.fnmatch(name, pattern)]
    assert patterns, f"docs/reference/cameras.md does not name {name}"
    row = table()[max(patterns, key=len)]
    usual = errors(name, "ideal", 1.0)
    assert usual is not None
    for case in list(CASES)[1:]:
        found, cell = errors(name, case, 1.0), row[COLUMNS.get(case, 3)]
        assert (found is None) == ("refused" in cell), f"{name} on {case}: the page says {cell!r}"
        if found is None or np.all(found <= np.maximum(1e-6, 5.0 * usual)):
            continue
        # What is exact to first order leaves a fourth of the error, over the motion, in a fourth of the motion.
        smaller = errors(name, case, 0.25)
        assert smaller is not None and np.all(smaller <= np.maximum(0.5 * found, 5.0 * usual)), (name, case, found)
