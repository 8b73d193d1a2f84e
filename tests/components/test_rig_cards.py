"""Cards of real rigs against the figures of their sources, in the forms that those have, through OpenCV."""

from __future__ import annotations

from functools import reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.components.cards import list_cards, read_toml
from rsbench.components.rig_tables import RigTables, load_rig
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import read_rig_card

SOURCES = read_toml(Path(__file__).with_name("published_rigs.toml"))


def pixels(model: str, of: dict[str, Any], X: FloatArray) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in a camera, as OpenCV or the lens's paper has them."""
    fx, fy, cx, cy = of["k"]
    K, d = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(of["d"])
    if model == "brown-conrady":
        return np.asarray(cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, d)[0][:, 0])
    if model == "kannala-brandt":
        return np.asarray(cv2.fisheye.projectPoints(X[:, None], np.zeros(3), np.zeros(3), K, d)[0][:, 0])
    xy, (w,) = X[:, :2] / X[:, 2:], d  # F. Devernay, O. Faugeras, Straight lines have to be straight, 2001, eq. 13
    r = np.linalg.norm(xy, axis=1, keepdims=True)
    return np.asarray(xy / r * np.arctan(2.0 * r * np.tan(w / 2.0)) / w * [fx, fy] + [cx, cy])


def cam_from_body(of: dict[str, Any]) -> FloatArray:
    """Pose (4, 4) of a camera in the axes of its source: an IMU, another camera, a headset."""

    def square(rows: list[float]) -> FloatArray:
        return np.vstack([np.reshape(rows, (3, 4)), [0.0, 0.0, 0.0, 1.0]])

    if "cam_from_body" in of:
        return square(of["cam_from_body"])
    if "body_from_cam" in of:
        return np.array(np.linalg.inv(square(of["body_from_cam"])), dtype=np.float64)
    if "chain" in of:
        return reduce(np.matmul, map(square, of["chain"]), np.eye(4))
    x, y, z, w = of["camera2"][:4]
    q = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R = np.eye(3) + 2.0 * (w * q + q @ q)
    return square(np.column_stack([R, -R @ of["camera2"][4:]]).ravel().tolist())


def shutter_of(card: RigTables) -> RollingShutter:
    assert card.readout_ratio is not None and card.scanning is not None
    return card.rig().shutter_of(card.scanning, card.readout_ratio)


def test_every_card_is_compared_with_its_source() -> None:
    assert sorted(SOURCES) == list(list_cards("rigs"))
    assert len(SOURCES) >= 8


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_cards_see_points_where_the_published_calibration_has_them(name: str) -> None:
    rig, source, rng = load_rig(name).rig(), SOURCES[name], np.random.default_rng(3)
    X = np.append(rng.uniform(-1.5, 1.5, (500, 2)), np.ones((500, 1)), axis=1) * rng.uniform(1.0, 20.0, (500, 1))
    R, t = rig.right_from_left
    in_cam = {"left": X, "right": X @ R.T + t}
    poses = {side: cam_from_body(source[side]) for side in SIDES}
    body = np.linalg.solve(poses["left"], np.append(X, np.ones((500, 1)), axis=1).T)
    centres = [np.linalg.inv(T)[:3, 3] for T in poses.values()]
    assert rig.baseline == pytest.approx(np.linalg.norm(centres[1] - centres[0]), rel=1e-5)
    for side in SIDES:
        seen = rig.sensor(side).project(in_cam[side])
        inside = rig.sensor(side).contains(np.nan_to_num(seen, nan=-9.0))
        published = pixels(source["lens"], source[side], (poses[side] @ body)[:3].T[inside])
        assert inside.sum() > 50
        assert np.max(np.abs(seen[inside] + source.get("window", (0, 0)) - published)) < 0.01


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_cards_have_the_published_readouts_and_name_what_is_assumed(name: str) -> None:
    card, text = load_rig(name), list_cards("rigs")[name].read_text("utf-8")
    assert card.frame_period_s is not None
    shutter, left = shutter_of(card), card.rig().sensor("left")
    assert card.source and "# Measured: " in text and f"{left.width} x {left.height}" in card.description
    for side in SIDES:
        if "readout_unknown" in SOURCES[name][side]:
            assert "Assumed:" in text and "assumed" in card.description and shutter.ratio_of(side) == 0.5
        else:
            lines_s = 1e-6 * SOURCES[name][side].get("line_delay_us", 0.0)
            assert card.frame_period_s * shutter.ratio_of(side) / shutter.lines(side) == pytest.approx(lines_s)


def test_there_are_rigs_of_every_kind() -> None:
    cards = {name: load_rig(name) for name in SOURCES}
    rigs = {name: card.rig() for name, card in cards.items()}

    def of_kind(kind: Any) -> set[str]:
        return {name for name in SOURCES if kind(name)}

    assert of_kind(lambda name: rigs[name].sensor("left").width != rigs[name].sensor("right").width) == {"d435i"}
    assert of_kind(lambda name: abs(rigs[name].own("left").R[1, 0]) > 0.7) == {"shuttum-vertical"}
    rolling = {name: [shutter_of(card).ratio_of(side) > 0 for side in SIDES] for name, card in cards.items()}
    assert of_kind(lambda name: rolling[name] == [True, True]) == {"quest3", "shuttum-rolling", "zed2"}
    assert of_kind(lambda name: any(rolling[name]) and not all(rolling[name])) == {
        *("d435i", "shuttum-vertical", "tum-rsvi")
    }
    lenses = {lens.model for rig in rigs.values() if (lens := rig.sensor("left").lens) is not None}
    assert lenses == {"brown-conrady", "kannala-brandt"}


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_frames_take_a_rig_by_its_name(name: str) -> None:
    card, named = load_rig(name), read_rig_card(Path(name))
    sizes = [(camera.width, camera.height) for camera in map(card.rig().sensor, SIDES)]
    assert named.rig(*sizes) == card.rig()
    assert (named.readout_ratio, named.scanning) == (card.readout_ratio, card.scanning)


def test_a_name_that_is_none_is_answered_with_the_nearest() -> None:
    for load in (load_rig, lambda name: read_rig_card(Path(name))):
        with pytest.raises(RsbenchError, match=r"rigs card 'zed' does not exist \(did you mean 'zed2'\?\)"):
            load("zed")
