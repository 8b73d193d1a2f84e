"""Every argument of every public function, given what it cannot be: one short line, or an answer."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

import rsbench

WRONG: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "nothing": lambda: "",
    "an object": object,
    "a generator": lambda: (x for x in range(3)),
    "ragged rows": lambda: [[1], [2, 3]],
    "a long text": lambda: "a" * 100_000,
    "a long path": lambda: "a/" * 50_000,
    "a zero byte": lambda: "a\0b",
    "NaN": lambda: float("nan"),
    "infinity": lambda: float("inf"),
    "a huge whole number": lambda: 10**400,
    "an empty array": lambda: np.zeros(0),
    "an empty image": lambda: np.zeros((0, 0, 3), np.uint8),
    "a span of time": lambda: np.timedelta64(5, "s"),
    "a date": lambda: np.datetime64("2020-01-01"),
    "a complex number": lambda: 1 + 2j,
    "a truth value": lambda: True,
    "an array of texts": lambda: np.array(["a", "b"]),
    "a table": dict,
    "a class": lambda: int,
}
LONGEST = 400
UNCHECKED = {
    "PinholeCamera": {"lens"},
    "RollingShutter": {"right_size"},
    "SplineMotion": {"periods"},
    "StereoRig": {"sides"},
}
"""Parameters whose errors are not one short line yet."""
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


Call = tuple[Callable[..., Any], dict[str, Any]]


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Call]:
    """A small call of each public function and constructor, by its name: what it requires, and a little more."""
    camera = rsbench.PinholeCamera(**CAMERA)
    rig = rsbench.StereoRig(camera=camera, baseline=0.3)
    shutter = rsbench.RollingShutter(height=48, readout_ratio=0.8)
    motion = rsbench.LinearMotion([0.01, -0.02, 0.01], [0.1, 0.0, 0.2])
    moving = {"rig": rig, "shutter": shutter, "motion": motion}
    matches = rsbench.simulate(**moving, pairs=20, tracks=20).correspondences
    image, nowhere = np.zeros((48, 64, 3), np.uint8), str(tmp_path_factory.mktemp("empty"))
    estimated = {"correspondences": matches, "rig": rig, "shutter": shutter, "solver": "gs-8pt"}
    vectors = {"w": [0.0, 0.0, 0.1], "d": [0.0, 0.1, 0.0]}
    spec = {"needs": {"left"}, "minimum": {"left": 5}, "metric": False, "motion_model": "linear"}
    spec |= {"shutter": "rolling", "reference": "none", "reference_point": "body", "assumes": "nothing"}
    given: dict[str, dict[str, Any]] = {
        "PinholeCamera": CAMERA,
        "StereoRig": {"camera": camera, "baseline": 0.3},
        "RollingShutter": {"height": 48, "readout_ratio": 0.8},
        "LinearMotion": vectors,
        "TwistMotion": vectors,
        "AcceleratedMotion": vectors,
        "SplineMotion": {**vectors, "preset": "handheld", "seed": 1},
        "MotionEstimate": {**vectors, "success": True},
        "SolverSpec": spec,
        "Correspondences": {},
        "project": {"points": [[0.0, 0.0, 5.0]], **moving},
        "simulate": {**moving, "pairs": 5, "tracks": 5},
        "estimate_motion": estimated,
        "pose_errors": {"found": rsbench.estimate_motion(**estimated), "motion": motion, "rig": rig},
        "match": {"images": [image] * 4, "features": "sift"},
        "stereo_depth": {"left": image, "right": image, "rig": rig},
        "correct": {
            "images": [image] * 4,
            "rig": rig,
            "readout_ratio": 0.8,
            "solver": "gs-8pt",
            "features": "sift",
        },
        "estimate_trajectory": {"sequence": [matches], "rig": rig, "shutter": shutter},
        "read_dataset": {"folder": nowhere},
        "read_rig": {"path": nowhere, "size": (640, 480), "fps": 20.0},
        "generate": {"card": "nowhere", "out": nowhere},
        "verify": {"folder": nowhere, "rerender": "no"},
        "evaluate": {"folder": nowhere, "out": nowhere, "solvers": ["gs-8pt"], "correct_with": "gs-8pt"},
        "load_solver": {"name_or_path": "gs-8pt"},
    }
    found = {name: (getattr(rsbench, name), arguments) for name, arguments in given.items()}
    one = {"images": [image] * 2, "camera": camera, "readout_ratio": 0.8}
    return {**found, "correct one camera": (rsbench.correct, one)}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_argument_is_one_short_line(wrong: str, calls: dict[str, Call]) -> None:
    bad = []
    for name, (function, arguments) in calls.items():
        for argument in inspect.signature(function).parameters.keys() - UNCHECKED.get(name, set()):
            try:
                function(**{**arguments, argument: WRONG[wrong]()})
            except (rsbench.RsbenchError, ValueError) as error:
                line = str(error)
                if "\n" in line or len(line) > LONGEST or not line:
                    bad.append(f"{name}({argument}): {len(line)} characters: {line[:150]!r}")
            except BaseException as error:
                bad.append(f"{name}({argument}): {type(error).__name__}: {str(error)[:150]!r}")
    assert not bad, "\n" + "\n".join(bad)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.int8, np.int64, np.longdouble])
def test_numbers_of_numpy_are_stored_as_python_s(kind: Any) -> None:
    int16, int32, uint8, float16 = (cast(Any, each) for each in (np.int16, np.int32, np.uint8, np.float16))
    camera = rsbench.PinholeCamera(width=int16(64), height=int32(48), fx=kind(100), fy=kind(100), cx=31.5, cy=23)
    rig = rsbench.StereoRig(camera=camera, baseline=kind(2))
    shutter = rsbench.RollingShutter(height=uint8(48), readout_ratio=float16(0.5))
    numbers = (
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        rig.baseline,
        shutter.height,
        shutter.readout_ratio,
    )
    assert {type(number) for number in numbers} <= {int, float}
    # In float16 the product fx * baseline is infinite from 256 x 256 on; in int8 100 * 2 is -56.
    assert float(rig.depth(2.0)) == 100.0
    large = rsbench.PinholeCamera(**{**CAMERA, "fx": float16(60000.0)})
    assert float(rsbench.StereoRig(camera=large, baseline=float16(500.0)).depth(1.0)) == 60_000.0 * 500.0


def test_depths_that_no_point_can_have_are_the_fault_of_depth(calls: dict[str, Any]) -> None:
    simulate, arguments = calls["simulate"]
    with pytest.raises(ValueError, match="depth = "):
        simulate(**{**arguments, "depth": (0.05, 0.05)})
