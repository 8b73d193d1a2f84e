"""Rigs as tables, against OpenCV and SciPy."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from commands import refused
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsbench.components.cards import parse_card
from rsbench.components.rig_tables import RightFromLeft, RigTables, tables_of, with_readouts

LEFT = {"width": 640, "height": 480, "fx": 520.0, "fy": 521.0, "cx": 315.0, "cy": 242.0}
RIGHT = {"width": 320, "height": 240, "fx": 260.0, "fy": 261.0, "cx": 160.0, "cy": 118.0}
LENS = {"model": "brown-conrady", "k1": -0.2, "p1": 1e-3}
APART = {"translation": [-0.25, 0.01, 0.02], "rotation_deg": [1.0, -2.0, 0.5]}


def rig_of(**other: Any) -> RigTables:
    table = {"left": LEFT | {"lens": LENS}, "right": dict(RIGHT), "right_from_left": APART, **other}
    return parse_card(RigTables, with_readouts(table, "rig.toml"), "rig.toml")


def test_tables_make_the_rig_that_opencv_projects_with_the_same_numbers() -> None:
    rig = rig_of().rig()
    R = Rotation.from_euler("xyz", APART["rotation_deg"], degrees=True).as_matrix()
    X = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 9], (40, 3))
    K = np.array([[RIGHT["fx"], 0, RIGHT["cx"]], [0, RIGHT["fy"], RIGHT["cy"]], [0, 0, 1]])
    seen, _ = cv2.projectPoints(X, cv2.Rodrigues(R)[0], np.array(APART["translation"]), K, np.zeros(5))
    found_R, found_t = rig.right_from_left
    np.testing.assert_allclose(rig.sensor("right").project(X @ found_R.T + found_t), seen[:, 0], atol=1e-9)


@given(st.tuples(*[st.floats(-80.0, 80.0)] * 3))
def test_forms_of_a_rotation_are_one(degrees: tuple[float, float, float]) -> None:
    turn = Rotation.from_euler("xyz", degrees, degrees=True)  # about fixed axes: Rz Ry Rx
    x, y, z, w = turn.as_quat()
    forms: tuple[dict[str, Any], ...] = (
        {"rotation": tuple(map(tuple, turn.as_matrix().tolist()))},
        {"quaternion_wxyz": (w, x, y, z)},
        {"rotation_deg": degrees},
    )
    t: Any = tuple((turn.as_matrix() @ [-1.0, 0.0, 0.0]).tolist())
    for form in forms:
        np.testing.assert_allclose(RightFromLeft(translation=t, **form).R, turn.as_matrix(), atol=1e-12)


def test_tables_of_a_rig_make_it_again() -> None:
    rig = rig_of().rig()
    again = parse_card(RigTables, tables_of(rig), "tables").rig()
    for side in ("left", "right"):
        assert again.sensor(side) == rig.sensor(side)
        np.testing.assert_allclose(again.own(side).rotation, rig.own(side).rotation, atol=1e-14)


def test_each_camera_may_have_a_readout_of_its_own() -> None:
    card = rig_of(
        readout_ratio=0.8,
        frame_period_s=0.05,
        left=LEFT | {"readout_ratio": 0.0},
        right=RIGHT | {"scan": "bottom", "delay_s": 0.002},
    )
    assert card.readout_ratio == 0.0 and card.right_readout_ratio == 0.8
    assert card.scan is None and card.right_scan == "bottom"
    assert card.right_delay == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"right": RIGHT | {"width": 0}}, "right: camera width"),
        ({"right_from_left": {"translation": [0.0, 0.0, 0.0]}}, "right_from_left: translation must not be 0"),
        ({"right_from_left": APART | {"quaternion_wxyz": [1, 0, 0, 0]}}, "exclude each other"),
        ({"right": RIGHT | {"delay_s": 0.001}}, "delay_s: needs frame_period_s"),
        ({"left": {key: LEFT[key] for key in ("fx", "fy", "cx", "cy")}}, "left: width and height are required"),
        ({"left": LEFT | {"ratio": 1}}, "unknown key 'left.ratio'"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with refused(message):
        rig_of(**changes)
