"""What public constructors refuse: everything that is no finite number of its kind, in one line, at once."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

import rsbench
from rsbench.benchmark.simulated.simulation import SimulationOptions
from rsbench.components.motion_models import InertialMotion
from rsbench.core.camera import Lens

ANY: Any = rsbench  # what is refused here a type checker would refuse before
CAMERA = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
MODELS = [
    ANY.LinearMotion,
    ANY.TwistMotion,
    InertialMotion,
    ANY.AcceleratedMotion,
    ANY.SplineMotion,
]
NO_NUMBERS: list[Any] = [
    *(None, "1", b"1", True, np.True_, 1j, np.complex128(1.0), Decimal(1), Fraction(1, 2), object(), [()], {1}),
    *(np.array([1.0]), np.nan, np.inf, -np.inf, np.float32("nan"), 1e300, -1e300, 10**400),
]
no_numbers = st.sampled_from(NO_NUMBERS)
no_sizes = st.one_of(
    no_numbers, st.floats(), st.integers(max_value=-1), st.integers(min_value=10**8), st.sampled_from([2.5, 3.0])
)
few = settings(max_examples=40)


def refused(make: Callable[[], object]) -> None:
    """One line, a ValueError, without a traceback of NumPy's or a warning."""
    with pytest.raises(ValueError) as caught:
        make()
    text = str(caught.value)
    assert "\n" not in text and 0 < len(text) < 300, text


def camera(**values: Any) -> Any:
    return ANY.PinholeCamera(**{**CAMERA, **values})


@few
@drawn(no_numbers, no_sizes)
def test_cameras_rigs_and_shutters_refuse_what_is_no_number_or_size(value: Any, size: Any) -> None:
    for name in ("fx", "fy", "cx", "cy"):
        refused(lambda name=name: camera(**{name: value}))
    for name in ("width", "height"):
        refused(lambda name=name: camera(**{name: size}))
    refused(lambda: Lens(model="brown-conrady", k1=value))
    refused(lambda: ANY.StereoRig(camera=camera(), baseline=value))
    refused(lambda: ANY.StereoRig(camera=value, baseline=0.1))
    refused(lambda: ANY.RollingShutter(height=size, readout_ratio=0.5))
    refused(lambda: ANY.RollingShutter(height=10, readout_ratio=value))
    refused(lambda: ANY.RollingShutter(height=10, readout_ratio=0.5, right_delay=value))
    if size is not None:
        refused(lambda: ANY.RollingShutter(height=10, readout_ratio=0.5, width=size))
    refused(lambda: ANY.RollingShutter(height=10, readout_ratio=0.5, scan=value))


@few
@drawn(st.sampled_from(MODELS), no_numbers, st.integers(0, 2))
def test_motions_refuse_what_are_no_three_finite_numbers(model: Any, value: Any, place: int) -> None:
    rows: list[Any] = [0.01, 0.02, 0.03]
    rows[place] = value
    for wrong in (rows, value, [0.1, 0.2], [[0.1, 0.2, 0.3]], np.array([True] * 3), np.ones(3) * 1j, ["1"] * 3):
        refused(lambda wrong=wrong: model(wrong, [0.0, 0.0, 0.1]))
        refused(lambda wrong=wrong: model([0.0, 0.0, 0.1], wrong))
    if value is not None:
        refused(lambda: ANY.AcceleratedMotion(np.zeros(3), np.zeros(3), acceleration=value))
        refused(lambda: ANY.SplineMotion(np.zeros(3), np.zeros(3), interval=0.5, shake=[[value] * 6] * 7))


@few
@drawn(st.sampled_from(["left", "right", "stereo_0", "tracks", "gyro", "affine"]), no_numbers)
def test_matches_refuse_what_are_no_rows_of_finite_numbers(name: str, value: Any) -> None:
    columns = 8 if name == "tracks" else 4
    row = [1.0 if isinstance(value, list) else value] * columns
    for wrong in (
        [row, row[1:]],
        [row[:-1]],
        np.full((1, columns), True),
        np.full((2, columns), 1j),
        [[1.0] * 3, [1.0]],
    ):
        refused(lambda wrong=wrong: ANY.Correspondences(**{name: wrong}))
    if not isinstance(value, list):
        refused(lambda: ANY.Correspondences(**{name: [row]}))


def test_functions_refuse_what_is_no_rig_shutter_or_motion() -> None:
    rig, shutter = (
        ANY.StereoRig(camera=camera(), baseline=0.1),
        ANY.RollingShutter(height=24, readout_ratio=1),
    )
    motion = ANY.LinearMotion([0, 0, 0.01], [0, 0, 0.1])
    for wrong in ("x", None, motion):
        refused(lambda wrong=wrong: ANY.simulate(wrong, shutter, motion))
    refused(lambda: ANY.simulate(rig, rig, motion))
    refused(lambda: ANY.simulate(rig, shutter, [0.1, 0.2, 0.3]))
    refused(lambda: SimulationOptions(gyro_noise_deg=-1.0))
    for points in (
        ["a", "b", "c"],
        [0.0, 1e300, 1.0],
        [np.inf, 0.0, 1.0],
        np.ma.masked_array(np.ones(3), [False, True, False]),
    ):
        refused(lambda points=points: ANY.project(points, rig, shutter, motion))
    for size in (("32", 24), (None, 24), (32.5, 24), (32, True)):
        refused(lambda size=size: ANY.PinholeCamera.centred(*size, 30.0))
    refused(lambda: ANY.estimate_motion(ANY.Correspondences(), rig, shutter, threshold_px=True))


@pytest.mark.parametrize("kind", [int, float, np.int64, np.int8, np.float32, np.float64])
def test_numbers_of_every_real_type_are_taken(kind: Any) -> None:
    one = kind(1)
    assert ANY.StereoRig(camera=camera(fx=one), baseline=one).disparity(2.0) == 0.5
    assert ANY.RollingShutter(height=8, readout_ratio=one).readout_ratio == 1.0
    np.testing.assert_array_equal(ANY.LinearMotion([one] * 3, np.array([one] * 3)).w, np.ones(3))
    assert ANY.Correspondences(left=[[one] * 4]).left.dtype == np.float64
