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
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """A small call of each public function and constructor, by its name."""
    camera = rsbench.PinholeCamera(**CAMERA)
    rig = rsbench.StereoRig(camera=camera, baseline=0.3)
    shutter = rsbench.RollingShutter(height=48, readout_ratio=0.8)
    motion = rsbench.LinearMotion([0.01, -0.02, 0.01], [0.1, 0.0, 0.2])
    matches = rsbench.simulate(rig, shutter, motion, pairs=20, tracks=20).correspondences
    image, nowhere = np.zeros((48, 64, 3), np.uint8), str(tmp_path_factory.mktemp("empty"))
    moving = {"rig": rig, "shutter": shutter, "motion": motion}
    given = {"correspondences": matches, "rig": rig, "shutter": shutter}
    estimate = rsbench.estimate_motion(matches, rig, shutter)
    vectors = {"w": [0.0, 0.0, 0.1], "d": [0.0, 0.1, 0.0]}
    return {
        "PinholeCamera": (rsbench.PinholeCamera, CAMERA),
        "StereoRig": (rsbench.StereoRig, {"camera": camera, "baseline": 0.3, "origin": "middle"}),
        "RollingShutter": (rsbench.RollingShutter, {"height": 48, "readout_ratio": 0.8, "scan": "top"}),
        "LinearMotion": (rsbench.LinearMotion, vectors),
        "TwistMotion": (rsbench.TwistMotion, vectors),
        "AcceleratedMotion": (rsbench.AcceleratedMotion, {**vectors, "acceleration": 0.1}),
        "SplineMotion": (rsbench.SplineMotion, {**vectors, "preset": "handheld", "seed": 1, "interval": None}),
        "MotionEstimate": (rsbench.MotionEstimate, {**vectors, "success": True, "metric": True}),
        "SolverSpec": (
            rsbench.SolverSpec,
            {
                "needs": {"left"},
                "minimum": {"left": 5},
                "metric": False,
                "motion_model": "linear",
                "shutter": "rolling",
            }
            | {"reference": "none", "reference_point": "body", "assumes": "nothing", "motion_parameters": {}},
        ),
        "Correspondences": (rsbench.Correspondences, {"left": np.zeros((0, 4)), "tracks": np.zeros((0, 8))}),
        "project": (rsbench.project, {"points": [[0.0, 0.0, 5.0]], **moving, "side": "left", "frame": 0}),
        "simulate": (
            rsbench.simulate,
            {**moving, "pairs": 5, "tracks": 5, "noise_px": 0.3, "outlier_ratio": 0.0, "depth": (2.0, 9.0)}
            | {"shape": "box", "seed": 0},
        ),
        "estimate_motion": (
            rsbench.estimate_motion,
            {**given, "solver": "gs-8pt", "motion_model": None, "threshold_px": None, "seed": 0},
        ),
        "pose_errors": (
            rsbench.pose_errors,
            {"found": estimate, "motion": motion, "rig": rig, "reference_point": "body"},
        ),
        "match": (rsbench.match, {"images": [image] * 4, "features": "sift"}),
        "stereo_depth": (
            rsbench.stereo_depth,
            {"left": image, "right": image, "rig": rig, "side": "left", "matcher": "sgm"},
        ),
        "correct": (
            rsbench.correct,
            {"images": [image] * 4, "rig": rig, "readout_ratio": 0.8, "camera": None, "solver": "gs-8pt"}
            | {
                "motion_model": None,
                "matcher": "sgm",
                "features": "sift",
                "corrector": "fusion",
                "target_row": 0.0,
            }
            | {"inpaint": None, "seed": 0, "gyro": None, "focal_sigma": 0.0, "k1_sigma": 0.0},
        ),
        "correct one camera": (
            rsbench.correct,
            {"images": [image] * 2, "camera": camera, "readout_ratio": 0.8, "target_row": 0.0, "inpaint": None}
            | {"seed": 0, "gyro": None, "solver": "rs-stereo-refined", "corrector": "fusion"}
            | {"gyro_clock_error": 0.0},
        ),
        "estimate_trajectory": (
            rsbench.estimate_trajectory,
            {"sequence": [matches], "rig": rig, "shutter": shutter, "features": "sift", "seed": 0, "gyro": None},
        ),
        "read_dataset": (rsbench.read_dataset, {"folder": nowhere}),
        "read_rig": (rsbench.read_rig, {"path": nowhere, "size": (640, 480), "fps": 20.0}),
        "generate": (rsbench.generate, {"card": "nowhere", "out": nowhere, "sequences": None, "workers": 1}),
        "verify": (rsbench.verify, {"folder": nowhere, "stride": 1, "rerender": "no", "scenes": ()}),
        "evaluate": (
            rsbench.evaluate,
            {"folder": nowhere, "out": nowhere, "solvers": ["gs-8pt"], "correct_with": "gs-8pt", "matcher": "sgm"}
            | {"features": "sift", "corrector": "fusion", "metrics": (), "only": (), "seeds": 1, "seed": 0},
        ),
        "load_solver": (rsbench.load_solver, {"name_or_path": "gs-8pt"}),
    }


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_argument_is_one_short_line(wrong: str, calls: dict[str, Any]) -> None:
    bad = []
    for name, (function, arguments) in calls.items():
        assert set(arguments) <= set(inspect.signature(function).parameters) or name == "load_solver", name
        for argument in arguments:
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
