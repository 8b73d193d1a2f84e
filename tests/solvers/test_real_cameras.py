"""Every solver on a camera with a lens and on other scans: it takes them, or says by name that it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.components.cards import list_cards
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import SolverSpec, load_solver, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

LENS = Lens(model="brown-conrady", k1=-0.2, k2=0.04, p1=0.001, p2=-0.0005)
CAMERA = PinholeCamera(width=900, height=700, fx=610.0, fy=580.0, cx=440.0, cy=355.0, lens=LENS)
RIG = StereoRig(camera=CAMERA, baseline=0.5)
SHUTTER = RollingShutter(height=700, readout_ratio=0.8)
LATE = replace(SHUTTER, right_delay=0.2)
ANGLE = 0.04


@pytest.mark.parametrize("name", sorted(list_cards("solvers")))
def test_every_shipped_solver_takes_a_lens_or_says_why_not(name: str) -> None:
    rng = np.random.default_rng(3)
    motion = random_motion(rng, ANGLE, 0.2, "linear")
    s = simulate(
        RIG, SHUTTER, motion, SimulationOptions(tracks=40, pairs=40, noise_px=0.1, gyro_rate=20, gravity=True), rng
    )
    solver = load_solver_entry(name).solver
    options = RobustOptions(max_iterations=20)
    found = estimate_motion(s.correspondences, RIG, SHUTTER, solver, options, np.random.default_rng(0)).estimate
    if solver.spec.refusal(RIG, SHUTTER):
        assert not found.success
        assert found.reason == "it does not take a lens, and the cameras have one (brown-conrady)"
        return
    assert found.success, found.reason
    # Without the lens, whose ends of matches are off by up to 60 px, none comes near.
    exact = isinstance(solver, RefinedSolver) and solver.spec.shutter == "rolling" and "twist" not in name
    assert so3.angle(so3.exp(found.w) @ so3.exp(-motion.w)) < (5e-4 if exact else ANGLE)


def test_those_that_take_no_lens_are_few() -> None:
    refused = {name for name in list_cards("solvers") if load_solver(name).spec.refusal(RIG, SHUTTER)}
    # Their coefficients are of rows of a pinhole camera.
    free = {"rs-12param", "rs-12param-affine", "rs-dai-linear", "rs-dai-uniform"}
    assert refused == free | {"rs-stereo-iterated-metric", "rs-r6p", "rs-r6p-single"}


def test_other_scans_and_delays_are_refused_by_name() -> None:
    takes = {name: load_solver(name).spec.refusal(RIG, LATE) for name in list_cards("solvers")}
    assert not takes["rs-stereo-refined"] and not takes["rs-stereo-linear"] and not takes["gs-8pt"]
    assert takes["gs-stereo-tracks-scaled"] == (
        "it takes rows from the top that both cameras read at once, and no other scan or delay"
    )


def test_a_solver_that_says_nothing_takes_ideal_cameras_alone() -> None:
    spec = SolverSpec(
        needs={"left"},
        minimum={"left": 5},
        metric=False,
        motion_model="linear",
        shutter="rolling",
        reference_point="body",
        reference="none",
        assumes="nothing",
    )
    ideal = RIG.ideal
    assert not spec.refusal(ideal, SHUTTER)
    assert spec.refusal(RIG, SHUTTER) and spec.refusal(ideal, LATE)
    assert not replace(spec, shutter="global").refusal(RIG, LATE)
    with pytest.raises(ValueError, match="cameras = 'all': must be one of ideal, lens, any"):
        replace(spec, cameras="all")  # pyrefly: ignore[bad-argument-type]


def test_matches_where_a_lens_shows_nothing_are_named() -> None:
    rig = replace(RIG, camera=replace(CAMERA, lens=Lens(model="brown-conrady", k1=-0.12)))
    left = np.array([[10.0, 20.0, 30.0, 40.0], [10.0, 20.0, 3000.0, 40.0]])
    matches = Correspondences(left=np.repeat(left, 5, axis=0))
    with pytest.raises(ValueError, match=r"left\[5\] = \[10.0, 20.0, 3000.0, 40.0\]: the lens shows no ray"):
        without_lens(matches, rig.camera)
    found = estimate_motion(
        matches, rig, SHUTTER, load_solver("rs-stereo-refined"), RobustOptions(), np.random.default_rng(0)
    )
    assert "left[5]" in found.estimate.reason and not found.estimate.success
