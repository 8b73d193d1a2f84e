"""rig.toml: two equal aligned cameras, or any two, with sizes, readouts and extrinsics of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline.footage import RigCard, read_rig_card, rig_card_of

LEFT = "[left]\nfx = 520.0\nfy = 521.0\ncx = 319.5\ncy = 239.5\n"
RIGHT = "[right]\nfx = 527.0\nfy = 528.0\ncx = 300.0\ncy = 250.0\n"
APART = "[right_from_left]\ntranslation = [-0.25, 0.01, 0.0]\nrotation_deg = [0.4, 0.8, -0.6]\n"
SIZE = "width = 640\nheight = 480\n"


def _card(folder: Path, text: str) -> RigCard:
    path = folder / "rig.toml"
    path.write_text(text)
    return read_rig_card(path)


def test_two_cameras_with_what_is_their_own(tmp_path: Path) -> None:
    lens = 'lens = { model = "brown-conrady", k1 = -0.2 }\n'
    text = (
        "frame_period_s = 0.03\nreadout_ratio = 0.8\n"
        + LEFT
        + lens
        + RIGHT
        + 'scan = "bottom"\ndelay_s = 0.003\n'
        + APART
    )
    card = _card(tmp_path, text)
    rig = card.rig((640, 480), (1280, 720))
    assert rig.sensor("left") == PinholeCamera(
        width=640, height=480, fx=520.0, fy=521.0, cx=319.5, cy=239.5, lens=Lens(model="brown-conrady", k1=-0.2)
    )
    assert rig.sensor("right") == PinholeCamera(width=1280, height=720, fx=527.0, fy=528.0, cx=300.0, cy=250.0)
    R = Rotation.from_euler("xyz", [0.4, 0.8, -0.6], degrees=True).as_matrix()  # about fixed axes: Rz Ry Rx
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-12)
    np.testing.assert_allclose(rig.right_from_left.t, [-0.25, 0.01, 0.0], atol=1e-12)
    assert card.scanning == Scanning(right_scan="bottom", right_delay=0.1) and card.readout_ratio == 0.8


def test_seconds_become_frame_periods(tmp_path: Path) -> None:
    text = "frame_period_s = 0.05\n" + LEFT + SIZE + "line_delay_s = 6.25e-5\n" + RIGHT + SIZE
    card = _card(tmp_path, text + "readout_ratio = 0.0\ndelay_s = 0.003\n" + APART)
    assert card.readout_ratio == pytest.approx(0.6)
    assert card.scanning is not None and card.scanning.right_readout_ratio == 0.0
    assert card.scanning.right_delay == pytest.approx(0.06)
    card = _card(
        tmp_path,
        "frame_period_s = 0.1\nreadout_ratio = 0.2\n" + LEFT + 'shutter = "gopro-hero6-4k30"\n' + RIGHT + APART,
    )
    assert card.readout_ratio == pytest.approx(0.0834167) and card.right_readout_ratio == 0.2


@pytest.mark.parametrize("baseline", [True, False])
def test_the_card_of_a_known_rig_gives_it_back(baseline: bool) -> None:
    left = PinholeCamera(width=640, height=480, fx=520.0, fy=520.0, cx=310.0, cy=240.0)
    right = PinholeCamera(width=800, height=600, fx=700.0, fy=701.0, cx=400.0, cy=300.0)
    rig = StereoRig(camera=left, baseline=0.2)
    if not baseline:
        rig = StereoRig.of_cameras(
            left, right, Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix(), (-0.2, 0, 0)
        )
    shutter = rig.shutter_of(Scanning(right_readout_ratio=0.1, right_delay=0.2), 0.7)
    card = rig_card_of(rig, shutter)
    made = card.rig(*((each.width, each.height) for each in map(rig.sensor, ("left", "right"))))
    if baseline:
        assert made == rig
    np.testing.assert_allclose(made.right_from_left.R, rig.right_from_left.R, atol=1e-15)
    np.testing.assert_allclose(made.right_from_left.t, rig.right_from_left.t, atol=1e-15)
    assert card.scanning is not None and card.readout_ratio is not None
    assert isinstance(shutter, RollingShutter) and made.shutter_of(card.scanning, card.readout_ratio) == shutter


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LEFT + APART, "both .left. and .right."),
        ("baseline = 0.1\n" + LEFT + RIGHT + APART, "baseline: give it or"),
        (LEFT + RIGHT, "baseline: give it or"),
        (LEFT + RIGHT + APART + "quaternion_wxyz = [1, 0, 0, 0]", "exclude each other"),
        (LEFT + RIGHT + "[right_from_left]\ntranslation = [0.25, 0, 0]", "exchange the cameras"),
        (LEFT + RIGHT + "[right_from_left]\ntranslation = [0, 0, 0]", "one place"),
        (LEFT + RIGHT + "[right_from_left]\ntranslation = [-1, 0, 0]\nquaternion_wxyz = [2, 0, 0, 0]", "length"),
        (LEFT + RIGHT + "[right_from_left]\ntranslation = [-1, 0, 0]\nrotation = [[1, 0, 0]]", "rotation"),
        (LEFT + "width = 640\n" + RIGHT + APART, "width"),
        (LEFT + SIZE + "line_delay_s = 1e-5\n" + RIGHT + APART, "frame_period_s"),
        (LEFT + "delay_s = 1e-5\n" + RIGHT + APART, "frame_period_s"),
        (LEFT + "readout_ratio = 1.5\n" + RIGHT + APART, "readout_ratio = 1.5"),
        (LEFT + SIZE + "line_delay_s = 1e-3\n" + RIGHT + APART, "frame_period_s"),
        (LEFT + "focal = 3\n" + RIGHT + APART, "unknown key 'left.focal'"),
    ],
)
def test_wrong_cards_are_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(RsbenchError, match=words):
        _card(tmp_path, text)


def test_frames_of_other_sizes_are_refused(tmp_path: Path) -> None:
    card = _card(tmp_path, LEFT + SIZE + RIGHT + APART)
    with pytest.raises(ValueError, match="left: width, height = 640, 480"):
        card.rig((320, 240))
    equal = _card(tmp_path, "baseline = 0.1\n" + LEFT.replace("left", "camera"))
    with pytest.raises(ValueError, match=r"needs .left. and .right."):
        equal.rig((640, 480), (320, 240))
