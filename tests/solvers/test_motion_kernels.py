"""A model of somebody else's: refused by name without a kernel, solved as what it is with one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from differences import derivatives
from numpy.typing import ArrayLike

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components import motion_kernels, motion_models
from rsbench.components.motion_kernels import MotionKernel, Moved, kernel_for, times
from rsbench.components.motion_models import (
    AnyLaw,
    any_law,
    linear_move,
    linear_translation_jacobian,
    load_kernel,
    quick_law,
)
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import row_pair_pose, rs_constraint
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import pack
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

RIG = StereoRig(camera=PinholeCamera(width=900, height=700, fx=810.0, fy=760.0, cx=440.0, cy=355.0), baseline=0.5)
SHUTTER = RollingShutter(height=700, readout_ratio=0.8)
W, D = np.array([0.02, -0.03, 0.025]), np.array([0.25, 0.1, -0.15])


@dataclass(frozen=True, eq=False, init=False)
class CubicMotion(Motion):
    """The paper's path at the time beta = (1 - c) tau + c tau^3: nothing that rsbench has."""

    name = "cubic"
    c: float = 0.4

    def __init__(self, w: ArrayLike, d: ArrayLike, c: float = 0.4) -> None:
        super().__init__(w, d)
        object.__setattr__(self, "c", c)

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        beta = (1 - self.c) * tau + self.c * tau**3
        return Pose(so3.exp(beta * self.w), beta * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        speed = 1 - self.c + 3 * self.c * tau**2
        return speed * self.w, speed * self.d


class DullMotion(CubicMotion):
    """The same without a kernel."""

    name = "dull"


@kernel_for(CubicMotion)
@dataclass(frozen=True)
class CubicKernel(MotionKernel):
    c: float

    def move(self, theta: FloatArray, tau0: float, tau1: float, R: FloatArray, A: FloatArray) -> Moved:
        c = self.c
        beta0, beta1 = (1.0 - c) * tau0 + c * tau0**3, (1.0 - c) * tau1 + c * tau1**3
        speed0, speed1 = 1.0 - c + 3.0 * c * tau0**2, 1.0 - c + 3.0 * c * tau1**2
        T, rate0, rate1, spin0, spin1 = linear_move(theta, beta0, beta1, R, A)
        return T, times(speed0, rate0), times(speed1, rate1), times(speed0, spin0), times(speed1, spin1)

    def translation_jacobian(
        self,
        theta: FloatArray,
        tau0: float,
        tau1: float,
        R: FloatArray,
        A: FloatArray,
        T_w: FloatArray,
        T_v: FloatArray,
    ) -> None:
        c = self.c
        linear_translation_jacobian(
            theta, (1.0 - c) * tau0 + c * tau0**3, R, A, (1.0 - c) * tau1 + c * tau1**3, T_w, T_v
        )


CUBIC, DULL = f"{__name__}:CubicMotion", f"{__name__}:DullMotion"


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(motion_models.MOTIONS.built_in, "cubic", CUBIC)
    monkeypatch.setitem(motion_models.MOTIONS.built_in, "dull", DULL)
    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or __import__(__name__))
    motion_models._built_in.cache_clear()


def matches(motion: Motion, noise_px: float) -> Correspondences:
    options = SimulationOptions(pairs=60, tracks=60, noise_px=noise_px)
    return simulate(RIG, SHUTTER, motion, options, np.random.default_rng(1)).correspondences


@pytest.mark.parametrize("name", ["dull", "spline"])
def test_a_model_without_a_kernel_is_refused_by_name(name: str) -> None:
    words = rf"motion model '{name}' has no kernel.*: accelerated, cubic, inertial, linear, twist$"
    with pytest.raises(RsbenchError, match=words):
        RefinedSolver(motion_model=name)
    with pytest.raises(RsbenchError, match=words):
        pack(Correspondences(), RIG, SHUTTER, name)
    with pytest.raises(RsbenchError, match=r"'foo' does not exist.*accelerated.*spline"):
        RefinedSolver(motion_model="foo")


def test_a_model_with_a_kernel_is_solved_as_what_it_is() -> None:
    motion = CubicMotion(W, D)
    c = matches(motion, noise_px=0.0)
    for part in (c, Correspondences(left=c.left, right=c.right)):
        estimate = RefinedSolver(motion_model="cubic").estimate(part, RIG, SHUTTER)
        np.testing.assert_allclose(np.concatenate([estimate.w, estimate.d]), [*W, *D], atol=1e-6)
    robust = estimate_motion(
        c, RIG, SHUTTER, RefinedSolver(motion_model="cubic"), RobustOptions(), np.random.default_rng(0)
    )
    np.testing.assert_allclose(robust.estimate.w, W, atol=1e-6)
    # As the paper's motion it would be wrong by a hundred thousand times that.
    wrong = RefinedSolver().estimate(c, RIG, SHUTTER)
    assert rotation_error(wrong.w, W) > 1e-3
    other = RefinedSolver(motion_model="cubic", motion_parameters={"c": 0.1}).estimate(c, RIG, SHUTTER)
    assert rotation_error(other.w, W) > 1e-3


def test_the_bound_and_the_simulation_take_any_model() -> None:
    """A speed that is not known must not be taken for a small one: all rows are searched."""
    motion = CubicMotion(30 * W, 3 * D, c=0.9)
    assert motion.fastest(0.0, 1.0) is None
    left = matches(motion, noise_px=0.0).tracks[:, [0, 1, 4, 5]]
    assert np.max(np.abs(rs_constraint(RIG, SHUTTER, motion, "left", left)[0])) < 1e-8
    bound = motion_bound(matches(CubicMotion(W, D), 0.0), RIG, SHUTTER, CubicMotion(W, D), 1.0)
    packed = pack(matches(CubicMotion(W, D), 0.0), RIG, SHUTTER, "cubic")
    # The solver's Gauss-Newton Hessian is the information, on exact data.
    H = packed.normal_equations(packed.theta(W, D))[2]
    np.testing.assert_allclose(bound.information, H, rtol=1e-4, atol=1e-6 * np.max(H))


def test_a_kernel_that_breaks_the_contract_is_refused_when_it_is_made() -> None:
    class Plain(MotionKernel):
        move = CubicKernel.move
        translation_jacobian = CubicKernel.translation_jacobian

    with pytest.raises(TypeError, match="must be a frozen dataclass below MotionKernel"):
        kernel_for(DullMotion)(Plain)

    @dataclass(frozen=True)
    class Renamed(CubicKernel):
        # pyrefly: ignore[bad-override-param-name]
        def move(self, theta: FloatArray, t0: float, t1: float, R: FloatArray, A: FloatArray) -> Moved:
            raise NotImplementedError

    with pytest.raises(TypeError, match=r"Renamed\.move must have the arguments self, theta, tau0, tau1, R, A"):
        kernel_for(DullMotion)(Renamed)
    assert DullMotion not in motion_kernels.KERNELS


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("linear", {}),
        ("twist", {}),
        ("inertial", {}),
        ("accelerated", {}),
        ("accelerated", {"acceleration": 1.5}),
        ("cubic", {}),
    ],
)
def test_moves_and_their_derivatives_are_those_of_the_model(name: str, parameters: dict[str, float]) -> None:
    """In plain Python, where a kernel is an ordinary class: T, R, their rates, and their derivatives by theta."""
    kernel = load_kernel(name, parameters)
    motion = motion_models.make_motion(name, W, D, parameters)
    theta, tau = kernel.theta(W, D), (0.37, 1.61)

    def pose(theta: FloatArray, tau: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        w, d = kernel.motion(theta)
        still = RollingShutter(height=1, readout_ratio=1.0)
        shown = row_pair_pose(RIG, still, motion.with_endpoint(w, d), "left", tau[0], tau[1] - 1.0)
        # Of the body: the left camera's T is T + o - R o.
        offset = RIG.offset("left")
        return shown.R, shown.t - offset + shown.R @ offset

    R, A, T_w, T_v = (np.zeros((3, 3)) for _ in range(4))
    T, rate0, rate1, spin0, spin1 = kernel.move(theta, *tau, R, A)
    kernel.translation_jacobian(theta, *tau, R, A, T_w, T_v)
    expected = pose(theta, tau)
    np.testing.assert_allclose(R, expected[0], atol=1e-14)
    np.testing.assert_allclose(T, expected[1], atol=1e-14)
    step = 1e-6
    for k, (rate, spin) in enumerate(((rate0, spin0), (rate1, spin1))):
        shift = np.eye(2)[k] * step
        (R1, T1), (R0, T0) = (pose(theta, (tau[0] + s * shift[0], tau[1] + s * shift[1])) for s in (1, -1))
        np.testing.assert_allclose((T1 - T0) / (2 * step), rate, atol=1e-8)
        np.testing.assert_allclose(so3.log(R1 @ R0.T) / (2 * step), spin, atol=1e-8)
    for k in range(6):
        shift = np.eye(6)[k] * step
        (R1, T1), (R0, T0) = pose(theta + shift, tau), pose(theta - shift, tau)
        by_R, by_T = (A[:, k], T_w[:, k]) if k < 3 else (np.zeros(3), T_v[:, k - 3])
        np.testing.assert_allclose(so3.log(R1 @ R0.T) / (2 * step), by_R, atol=1e-8)
        np.testing.assert_allclose((T1 - T0) / (2 * step), by_T, atol=1e-8)
    np.testing.assert_allclose(kernel.motion(theta), (W, D), atol=1e-15)
    J = derivatives(lambda theta: np.concatenate(kernel.motion(theta)), theta, step)
    np.testing.assert_allclose(J, kernel.motion_jacobian(theta), atol=1e-8)


@pytest.mark.parametrize("name", ["linear", "twist", "inertial", "accelerated"])
def test_any_law_is_each_law_to_the_last_digit(name: str) -> None:
    own = load_kernel(name, {"acceleration": 0.3} if name == "accelerated" else None)
    both = any_law(own)
    assert isinstance(both, AnyLaw)
    assert (quick_law(own) is own) == (name == "linear")
    theta, found = np.concatenate([W, D]), list[FloatArray]()
    for kernel in (own, both):
        R, A, T_w, T_v = np.zeros((4, 3, 3))
        moved = kernel.move(theta, 0.3, 1.6, R, A)
        kernel.translation_jacobian(theta, 0.3, 1.6, R, A, T_w, T_v)
        found.append(np.concatenate([np.ravel(moved), *(np.ravel(each) for each in (R, A, T_w, T_v))]))
    np.testing.assert_array_equal(found[0], found[1])


def test_a_foreign_law_keeps_its_kernel() -> None:
    kernel = CubicKernel(0.4)
    assert any_law(kernel) is kernel
    assert quick_law(kernel) is kernel
