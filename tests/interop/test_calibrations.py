"""Calibrations of other tools: one rig in all formats gives the same numbers; the rest is refused by name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import calibration_files as made
import cv2
import numpy as np
import pytest
from calibration_files import D_LEFT, D_RIGHT, FOUR, KB, LEFT, RIGHT, SIZE, WRITERS, R, T
from commands import assert_refused, refused, run_here
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import rsbench
from rsbench.components.rig_tables import tables_of
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, StereoRig
from rsbench.interop.readers.calibration_parts import Assumptions, Calibration, resized, with_size
from rsbench.interop.readers.calibrations import read_calibration
from rsbench.interop.readers.rig_files import Readout, calibration_of, read_camera_file, read_rig_file
from rsbench.interop.writers.calibrations import rig_of, write_calibration

NO_UNIT = "opencv of zed"
OPENCV = {"M1": made.matrix(LEFT), "D1": made.five(D_LEFT), "M2": made.matrix(RIGHT), "D2": made.five(D_RIGHT)}
FISHEYE = Lens(model="kannala-brandt", k1=KB[0], k2=KB[1], k3=KB[2], k4=KB[3])
RATIONAL = Lens(model="rational", k1=0.7, k2=0.1, p1=1e-4, k3=0.01, k4=1.06, k5=0.3, k6=0.02)
SPHERES = Lens(model="double-sphere", xi=-0.2, alpha=0.57)


def same_numbers(rig: StereoRig) -> None:
    for side, own, d in (("left", LEFT, D_LEFT), ("right", RIGHT, D_RIGHT)):
        camera = rig.sensor(side)
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), own, atol=1e-9)
        assert (camera.width, camera.height) == SIZE
        assert camera.lens is not None and camera.lens.model == "brown-conrady"
        np.testing.assert_allclose(camera.lens.coefficients, [*d, 0.0], atol=1e-12)
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-9)
    np.testing.assert_allclose(rig.right_from_left.t, T, atol=1e-9)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != NO_UNIT])
def test_one_rig_in_all_formats_gives_the_same_numbers(name: str, tmp_path: Path) -> None:
    path = WRITERS[name](tmp_path)
    same_numbers(rsbench.read_rig(path, SIZE).rig)
    if path.is_file():  # the folder instead of the file
        name = path.name
        if path.suffix != ".toml":
            same_numbers(rsbench.read_rig(tmp_path, SIZE).rig)


def test_a_unit_that_is_not_metres_is_asked_for_and_taken(tmp_path: Path) -> None:
    path = WRITERS[NO_UNIT](tmp_path)
    with pytest.raises(RsbenchError, match=r"119\.8 m apart.*--unit mm -o rig\.toml"):
        rsbench.read_rig(path)
    out = tmp_path / "out" / "rig.toml"
    out.parent.mkdir()
    assert run_here("rig", path, "--unit", "mm", "-o", out).returncode == 0
    same_numbers(rsbench.read_rig(out).rig)
    found = read_calibration(path, Assumptions(unit=0.001))
    assert not found.notes


PLACES = {"rig.toml": "again.toml", "kalibr": "c.yaml", "opencv": "c.yml", "ros": "pair", "colmap": "c.json"}


@pytest.mark.parametrize("kind", PLACES)
def test_what_is_converted_reads_back(kind: str, tmp_path: Path) -> None:
    out = tmp_path / "to" / PLACES[kind]
    result = run_here("rig", WRITERS["kalibr"](tmp_path), "--to", kind, "-o", out)
    assert result.returncode == 0, result.stderr
    same_numbers(rsbench.read_rig(out, SIZE).rig)


lenses = st.sampled_from(
    [
        None,
        Lens(model="brown-conrady", k1=-0.2, k2=0.03, p1=1e-4, p2=-2e-4),
        Lens(model="brown-conrady", k1=-0.2, k2=0.03, k3=1e-5),
        Lens(model="kannala-brandt", k1=-0.01, k2=0.02, k3=-0.01, k4=0.002),
        RATIONAL,
        SPHERES,
    ]
)
COVERS = {
    "rig.toml": set(SIDES),
    "kalibr": {"brown-conrady", "kannala-brandt", "double-sphere"},
    "opencv": {"brown-conrady", "kannala-brandt", "rational"},
    "ros": {"brown-conrady", "kannala-brandt", "rational"},
    "colmap": {"brown-conrady", "kannala-brandt", "rational"},
}


STRAIGHT = (0.0, 0.0, 0.0), (0.0, 0.0), True


@settings(max_examples=40, deadline=None)
@example("kalibr", RATIONAL, None, *STRAIGHT)
@example("opencv", SPHERES, SPHERES, *STRAIGHT)
@example("opencv", FISHEYE, None, *STRAIGHT)
@given(
    st.sampled_from(sorted(COVERS)),
    lenses,
    lenses,
    st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    st.tuples(*[st.floats(-0.1, 0.1)] * 2),
    st.booleans(),
)
def test_any_rig_that_a_format_holds_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    left_lens: Lens | None,
    right_lens: Lens | None,
    turn: tuple[float, float, float],
    aside: tuple[float, float],
    one_size: bool,
) -> None:
    folder = tmp_path_factory.mktemp("rig")
    left = PinholeCamera(width=640, height=480, fx=520.0, fy=521.5, cx=310.25, cy=245.5, lens=left_lens)
    right = replace(left, fx=600.0, cx=333.0, lens=right_lens)
    right = right if one_size else replace(right, width=1280, height=720, fx=900.0, fy=900.0, cx=650.0, cy=350.0)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    rig = StereoRig.of_cameras(left, right, rotation, rotation @ [-0.2, *aside])
    toml, tables = folder / "rig.toml", tables_of(rig)
    given = Calibration(
        format="made", left=tables["left"], right=tables["right"], right_from_left=rig.right_from_left
    )
    write_calibration(given, "rig.toml", toml)
    found, out = calibration_of(toml, Assumptions()), folder / PLACES[kind]
    try:
        write_calibration(found, kind, out)
    except RsbenchError as error:
        both = [lens for lens in (left_lens, right_lens) if lens is not None]
        third = kind == "kalibr" and any(lens.k3 and lens.model == "brown-conrady" for lens in both)
        fisheye = [lens.model == "kannala-brandt" for lens in both]
        mixed = kind == "opencv" and any(fisheye) and not (all(fisheye) and len(both) == 2)
        assert not {lens.model for lens in both} <= COVERS[kind] or third or mixed, error
        return
    again = rsbench.read_rig(out, ((left.width, left.height), (right.width, right.height))).rig
    for side in SIDES:
        pixels = np.random.default_rng(0).uniform(0, 470, (30, 2))
        found_rays, true_rays = (each.sensor(side).unproject(pixels) for each in (again, rig))
        np.testing.assert_allclose(found_rays, true_rays, atol=1e-9)
    np.testing.assert_allclose(again.right_from_left.R, rotation, atol=1e-9)
    np.testing.assert_allclose(again.right_from_left.t, rig.right_from_left.t, atol=1e-9)


# Kalibr.


def chain(folder: Path, first: str, second: str = "", apart: np.ndarray | None = FOUR) -> Path:
    path = folder / "camchain.yaml"
    transform = "" if apart is None else made.four_by_four("T_cn_cnm1", apart)
    path.write_text(f"cam0:\n{first}" + (f"cam1:\n{second}{transform}" if second else ""))
    return path


CAMERA = made.kalibr_camera(LEFT, D_LEFT)


def test_a_right_camera_that_comes_first_is_the_right_one(tmp_path: Path) -> None:
    path = chain(tmp_path, made.kalibr_camera(RIGHT, D_RIGHT), CAMERA, np.linalg.inv(FOUR))
    found = rsbench.read_rig(path)
    same_numbers(found.rig)
    assert "taken as the left camera" in found.notes[0]


def test_kalibr_says_readout_and_clocks(tmp_path: Path) -> None:
    path = made.openvins(tmp_path)
    found = rsbench.read_rig(path, fps=20.0)
    assert found.scanning is not None and found.scanning.right_delay == pytest.approx(0.003 * 20.0)
    (tmp_path / "k").mkdir()
    path = made.kalibr(tmp_path / "k")
    assert rsbench.read_rig(path, fps=30.0).readout_ratio == pytest.approx(720 * 25.6e-6 * 30.0)
    unknown = rsbench.read_rig(path)
    assert unknown.readout_ratio is None and "(--fps)" in unknown.notes[0]
    card, _ = read_rig_file(path, Readout(readout_ratio=0.3))
    assert card.readout_ratio == 0.3
    text = path.read_text()
    path.write_text(text.replace("line_delay: 2.56e-05", "line_delay: 0.0", 1))
    found = rsbench.read_rig(path, fps=30.0)
    assert found.readout_ratio == 0.0 and found.scanning is not None
    assert found.scanning.right_readout_ratio == pytest.approx(720 * 25.6e-6 * 30.0)


@pytest.mark.parametrize(
    ("intrinsics", "names", "lens"),
    [
        (LEFT, ("pinhole", "equidistant", list(KB)), FISHEYE),
        ((-0.2, 0.57, *LEFT), ("ds", "none", []), SPHERES),
        (LEFT, ("pinhole", "none", []), None),
    ],
)
def test_lenses_of_kalibr(tmp_path: Path, intrinsics: Any, names: tuple[str, str, Any], lens: Lens | None) -> None:
    model, distortion, d = names
    text = CAMERA.replace("pinhole", model).replace("radtan", distortion).replace(str(list(D_LEFT)), str(d))
    found = read_calibration(chain(tmp_path, text.replace(str(list(LEFT)), str(list(intrinsics)))))
    assert found.left.get("lens") == (None if lens is None else lens.record())


@pytest.mark.parametrize(
    ("model", "own", "distortion", "d"),
    [
        ("omni", (1.4,), "radtan", (-0.1, 0.02, 0.0, 0.0)),
        ("eucm", (0.6, 1.1), "none", ()),
        ("pinhole", (), "fov", (0.9,)),
    ],
)
def test_symmetric_models_become_the_nearest_kannala_brandt(
    tmp_path: Path, model: str, own: Any, distortion: str, d: Any
) -> None:
    text = CAMERA.replace("pinhole", model).replace("radtan", distortion).replace(str(list(D_LEFT)), str(list(d)))
    gain = 2.4 if model == "omni" else 1.0
    path = chain(tmp_path, text.replace(str(list(LEFT)), str([*own, gain * LEFT[0], gain * LEFT[1], *LEFT[2:]])))
    found = read_calibration(path)
    assert found.left["lens"]["model"] == "kannala-brandt"
    assert re.search(r"nearest kannala-brandt, within 0?\.?\d+", found.notes[0])
    # Against the model's own formula (paraxial focal lengths: f / (1 + xi), f, f 2 tan(w / 2) / w).
    paraxial = {"omni": 1.0, "eucm": 1.0, "pinhole": 2 * np.tan(0.45) / 0.9}[model]
    assert found.left["fx"] == pytest.approx(paraxial * LEFT[0], rel=2e-3)


@pytest.mark.parametrize(
    ("make", "changes", "words"),
    [
        (made.kalibr, {"pinhole": "omni", str(list(LEFT)): str([1.4, *LEFT])}, "tangential.*omni"),
        (made.kalibr, {"radtan": "thin_prism"}, "lens model 'thin_prism'"),
        (made.kalibr, {"pinhole": "scara"}, "camera_model = 'scara': must be one of pinhole, omni"),
        (made.kalibr, {"[1280, 720]": "[1280]"}, "resolution"),
        (made.kalibr, {"701.2": "nan"}, "intrinsics"),
        (made.kalibr, {"  resolution: [1280, 720]\n": ""}, "resolution: is missing"),
        (made.ros, {"camera_name": "binning_x: 2\nbinning_y: 2\ncamera_name"}, "binning_x = 2"),
        (made.ros, {"701.2": "0.0"}, "not calibrated"),
        (made.basalt, {"pinhole-radtan8": "fov"}, "camera_type = 'fov': must be one of"),
        (made.realsense, {"brown_conrady": "inverse_brown_conrady"}, "model = inverse_brown_conrady"),
        (made.depthai, {'"toCameraSocket": 0': '"toCameraSocket": 0, "lengthUnit": 9'}, "lengthUnit = 9"),
    ],
)
def test_what_others_have_and_we_have_not_is_refused_by_name(
    tmp_path: Path, make: Callable[[Path], Path], changes: dict[str, str], words: str
) -> None:
    path = make(tmp_path)
    text = path.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    with refused(match=words):
        rsbench.read_rig(path)


def test_a_chain_without_transforms_is_refused(tmp_path: Path) -> None:
    with refused("T_cn_cnm1: is missing"):
        rsbench.read_rig(chain(tmp_path, CAMERA, CAMERA, None))


# OpenCV and ROS.


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"R": R.T, "T": -R.T @ T}, "left of the left one.*--exchange.*--invert"),
        ({"D1": np.array([D_LEFT])}, "four coefficients.*--lens brown-conrady"),
        ({"D1": np.array([[*D_LEFT, 0, 0, 0, 0, 0.01, 0, 0, 0]])}, "thin prisms"),
        ({"R": np.diag([1.0, 1.0, 0.5])}, "R: is not a rotation"),
        ({"R": None}, "R and T are missing"),
        ({"M1": np.array([[700.0, 3.0, 640.0], [0, 700, 360], [0, 0, 1]])}, "skew"),
    ],
)
def test_wrong_files_of_opencv_are_refused_with_a_remedy(tmp_path: Path, changes: Any, words: str) -> None:
    values = {k: v for k, v in (OPENCV | {"R": R, "T": T} | changes).items() if v is not None}
    path = made.opencv(tmp_path / "stereo.yml", **values)
    with pytest.raises(RsbenchError, match=words):
        rsbench.read_rig(path, SIZE)


def test_an_inverted_or_exchanged_file_is_put_right(tmp_path: Path) -> None:
    inverted = made.opencv(tmp_path / "inverted.yml", **OPENCV, R=R.T, T=-R.T @ T)
    swapped = {f"{k[0]}{3 - int(k[1])}": v for k, v in OPENCV.items()}
    exchanged = made.opencv(tmp_path / "exchanged.yml", **swapped, R=R.T, T=-R.T @ T)
    for path, option in ((inverted, "--invert"), (exchanged, "--exchange")):
        out = tmp_path / f"{path.stem}.toml"
        assert run_here("rig", path, option, "-o", out).returncode == 0
        same_numbers(rsbench.read_rig(out, SIZE).rig)


def test_a_fisheye_of_opencv_is_told_by_its_key_or_the_option(tmp_path: Path) -> None:
    values = OPENCV | dict.fromkeys(("D1", "D2"), np.array(KB)[:, None])
    path = made.opencv(tmp_path / "stereo.yml", **values, R=R, T=T[:, None])
    assert read_calibration(path, Assumptions(fisheye=True)).left["lens"] == FISHEYE.record()
    path = made.opencv(tmp_path / "said.yml", fisheye=1, **values, R=R, T=T[:, None])
    assert rsbench.read_rig(path, SIZE).rig.sensor("left").lens == FISHEYE
    path = made.opencv(tmp_path / "not.yml", **values, R=R, T=T[:, None])
    assert read_calibration(path, Assumptions(fisheye=False)).left["lens"]["model"] == "brown-conrady"


def test_the_calibration_that_opencv_finds_is_read_as_it_writes_it(tmp_path: Path) -> None:
    """cv2.stereoCalibrate on exact views of a board: its own vectors of coefficients and shapes."""
    rng = np.random.default_rng(0)
    board = np.stack([*np.meshgrid(np.arange(8), np.arange(6)), np.zeros((6, 8))], axis=-1).reshape(-1, 3) * 0.05
    left, right = list[Any](), list[Any]()
    for _ in range(12):
        turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
        X = board @ turn.T + [*rng.uniform(-0.3, 0.1, 2), rng.uniform(0.7, 1.2)]
        for points, where, own, d in ((left, X, LEFT, D_LEFT), (right, X @ R.T + T, RIGHT, D_RIGHT)):
            seen, _ = cv2.projectPoints(where, np.zeros(3), np.zeros(3), made.matrix(own), np.array([*d, 0.0]))
            points.append(seen.astype(np.float32))
    boards = [board.astype(np.float32)] * len(left)
    _, M1, D1, M2, D2, turn, shift, *_ = cv2.stereoCalibrate(
        boards, left, right, *OPENCV.values(), SIZE, flags=cv2.CALIB_FIX_INTRINSIC
    )
    rig = rsbench.read_rig(made.opencv(tmp_path / "s.xml", M1=M1, D1=D1, M2=M2, D2=D2, R=turn, T=shift), SIZE).rig
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-5)
    np.testing.assert_allclose(rig.right_from_left.t, T, atol=1e-5)


def test_camera_info_of_single_cameras_has_no_extrinsics(tmp_path: Path) -> None:
    P = np.column_stack([made.matrix(LEFT), np.zeros(3)])
    for side in SIDES:
        (tmp_path / f"{side}.yaml").write_text(made.ros_text(LEFT, D_LEFT, np.eye(3), P))
    with pytest.raises(RsbenchError, match=r"P\[0, 3\] = 0.*calibrate them as a pair"):
        rsbench.read_rig(tmp_path / "left.yaml")
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(RsbenchError, match="describes only one camera: give the folder"):
        rsbench.read_rig(tmp_path / "left.yaml")


# Others.


def test_a_zed_needs_the_size_of_frames(tmp_path: Path) -> None:
    path = made.zed(tmp_path)
    with pytest.raises(RsbenchError, match=r"672 x 376, 1280 x 720.*--size 1280x720"):
        rsbench.read_rig(path)
    with pytest.raises(RsbenchError, match=r"no calibration of frames of 640 x 480.*side by side"):
        rsbench.read_rig(path, (640, 480))
    assert rsbench.read_rig(path, (672, 376)).rig.sensor("left").fx == 350.0


def test_a_zed_with_distortion_in_its_own_section(tmp_path: Path) -> None:
    path = made.zed(tmp_path)
    text = re.sub(r"(k|p)\d=[^\n]*\n", "", path.read_text()).replace("=", " = ")
    extra = "".join(f"{key} = {value}\n" for key, value in RATIONAL.record().items() if key != "model")
    path.write_text(f"{text}[LEFT_DISTO]\n{extra}[RIGHT_DISTO]\n{extra}")
    rig = rsbench.read_rig(path, SIZE).rig
    assert all(rig.sensor(side).lens == RATIONAL for side in SIDES)
    np.testing.assert_allclose(rig.right_from_left.R, R, atol=1e-9)


def test_a_polynomial_that_folds_at_the_corners_is_continued(tmp_path: Path) -> None:
    """A ZED 2 as it is calibrated in the factory: k3 bends its outermost 20 px back."""
    d = (-0.0592102, 0.0358082, -0.000315399, -8.94399e-05, -0.0144553)
    own = (534.25, 534.065, 639.57, 368.0055)
    path = made.zed(tmp_path)
    text = re.sub(r"(k|p)\d=[^\n]*\n", "", path.read_text())
    keys = ("k1", "k2", "p1", "p2", "k3", "fx", "fy", "cx", "cy")
    section = "".join(f"{key}={value}\n" for key, value in zip(keys, (*d, *own), strict=True))
    path.write_text(re.sub(r"(_CAM_HD\]\n)(f[^\n]*\n|c[xy][^\n]*\n)*", lambda found: found[1] + section, text))
    found = rsbench.read_rig(path, SIZE)
    words = re.search(r"continued from ([\d.]+) on, ([\d.]+) px off", found.notes[0])
    assert words is not None and float(words[2]) < 0.5
    camera = found.rig.sensor("left")
    X = np.random.default_rng(0).uniform([-1.5, -1, 1], [1.5, 1, 1], (4000, 3))
    seen, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), made.matrix(own), np.array(d))
    radius = np.linalg.norm((seen[:, 0] - own[2:]) / own[:2], axis=-1)
    inside = (radius < float(words[1])) & (np.linalg.norm(X[:, :2], axis=-1) < 1.5)
    off = np.linalg.norm(camera.project(X) - seen[:, 0], axis=-1)[inside]
    assert np.max(off) < float(words[2]) + 0.05 and np.median(off) < 0.06


def test_a_fisheye_that_sees_behind_itself_needs_a_crop(tmp_path: Path) -> None:
    text = CAMERA.replace("radtan", "equidistant").replace(str(list(D_LEFT)), str(list(KB)))
    text = text.replace(str(list(LEFT)), str([286.6, 286.5, 640.8, 358.1]))
    path = chain(tmp_path, text, text)
    with pytest.raises(RsbenchError, match=r"shows no ray.*--crop \d+x\d+\+\d+\+\d+") as refused:
        rsbench.read_rig(path)
    words = re.search(r"--crop (\S+)", str(refused.value))
    assert words is not None
    width, height, x, y = map(int, re.split(r"[x+]", words[1]))
    out = tmp_path / "rig.toml"
    assert run_here("rig", path, "--crop", words[1], "-o", out).returncode == 0
    camera = rsbench.read_rig(out).rig.sensor("left")
    assert (camera.width, camera.height, camera.cx, camera.cy) == (width, height, 640.8 - x, 358.1 - y)
    assert_refused(run_here("rig", path, "--crop", "2000x20+0+0"), "--crop 2000x20+0+0: must lie inside")


def test_an_inverse_lens_of_realsense_without_coefficients_is_none(tmp_path: Path) -> None:
    path = made.realsense(tmp_path)
    text = path.read_text().replace("brown_conrady", "inverse_brown_conrady")
    path.write_text(re.sub(r'"coeffs": \[[^\]]*\]', '"coeffs": [0, 0, 0, 0, 0]', text))
    assert rsbench.read_rig(path).rig.sensor("right").lens is None


def test_units_of_depthai(tmp_path: Path) -> None:
    path = made.depthai(tmp_path)
    text = path.read_text()
    path.write_text(text.replace('"toCameraSocket": 0', '"toCameraSocket": 0, "lengthUnit": 1'))
    same_numbers(rsbench.read_rig(path).rig)


def test_lenses_of_basalt(tmp_path: Path) -> None:
    path = made.basalt(tmp_path)
    tree = json.loads(path.read_text())
    own = dict(zip(("fx", "fy", "cx", "cy"), LEFT, strict=True))
    tree["value0"]["intrinsics"] = [
        {"camera_type": "ds", "intrinsics": own | {"xi": -0.2, "alpha": 0.57}},
        {"camera_type": "kb4", "intrinsics": own | dict(zip(("k1", "k2", "k3", "k4"), KB, strict=True))},
    ]
    path.write_text(json.dumps(tree))
    rig = rsbench.read_rig(path).rig
    assert rig.sensor("left").lens == SPHERES
    assert rig.sensor("right").lens == FISHEYE


def test_pixels_of_colmap_begin_at_the_corner(tmp_path: Path) -> None:
    """Against pycolmap's own projection, where it is installed."""
    pycolmap = pytest.importorskip("pycolmap")
    rig = rsbench.read_rig(made.colmap(tmp_path)).rig
    camera = pycolmap.Camera(model="OPENCV", width=1280, height=720, params=made.half(LEFT, D_LEFT))
    X = np.random.default_rng(0).uniform([-1, -0.5, 2], [1, 0.5, 4], (50, 3))
    np.testing.assert_allclose(rig.sensor("left").project(X) + 0.5, camera.img_from_cam(X), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not a calibration of a supported format"),
        ("a: [1, 2", "neither YAML, JSON, XML nor an INI file"),
        ("{", "not valid JSON"),
        ("<a>", "not valid XML"),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><x/>", "DOCTYPE"),
        ("a: &x [1]\nb: *x\n", "aliases"),
        ("[LEFT_CAM_HD]\nfx=1\n", "RIGHT_CAM_HD|STEREO|is missing"),
        ("M1: {rows: 3, cols: 3, data: [1, 2]}\n", "matrix of 3 x 3"),
        ("[" * 2000, "nested too deeply"),
        ("cam0: 3\n", "is not a calibration"),
        ('{"cameraData": 3}', "DepthAI"),
        ('{"value0": {"intrinsics": [3]}}', "intrinsics"),
        ('[{"cameras": [3, 4]}]', "must be a table"),
        ("1 OPENCV 1280 720 1 2\n", "params"),
    ],
)
def test_broken_files_are_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text)
    with refused(str(path), match=words):
        rsbench.read_rig(path, SIZE)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path, rng = WRITERS[name](tmp_path), np.random.default_rng(0)
    files = [each for each in sorted(tmp_path.rglob("*")) if each.is_file()]
    numbers = [b"0", b"-1", b"1e30", b"nan", b"99999999999", b"x", b"[]", b"null"]
    for _ in range(12):
        file = files[rng.integers(len(files))]
        whole = file.read_bytes()
        found = list(re.finditer(rb"-?\d+\.?\d*", whole))
        where = found[rng.integers(len(found))]
        start = int(rng.integers(len(whole)))
        damaged = (
            whole[: where.start()] + numbers[rng.integers(8)] + whole[where.end() :],
            whole[:start] + whole[start + 9 :],
            whole[:start] + bytes([rng.integers(256)]) + whole[start:],
        )[rng.integers(3)]
        file.write_bytes(damaged)
        try:
            rsbench.read_rig(path, SIZE, fps=20.0)
        except RsbenchError as error:
            assert "\n" not in str(error)
        file.write_bytes(whole)


def test_folders_of_two_tools_or_of_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="holds no calibration"):
        rsbench.read_rig(tmp_path)
    made.kalibr(tmp_path), made.basalt(tmp_path)
    with pytest.raises(RsbenchError, match=r"camchain\.yaml of Kalibr; calib\.json of Basalt; give one file"):
        rsbench.read_rig(tmp_path)


def test_one_camera_is_taken_from_any_file(tmp_path: Path) -> None:
    text = CAMERA.replace("radtan", "none").replace(str(list(D_LEFT)), "[]")
    card, notes = read_camera_file(chain(tmp_path, text + "  line_delay: 2.56e-05\n"), Readout(fps=30.0))
    assert card.camera is not None and card.camera.fx == LEFT[0] and not notes
    assert card.readout_ratio == pytest.approx(720 * 25.6e-6 * 30.0)
    with_lens = read_camera_file(made.kalibr(_sub(tmp_path)))[0].camera
    assert with_lens is not None and with_lens.lens is not None and with_lens.lens.model == "brown-conrady"
    with pytest.raises(RsbenchError, match="640 x 480"):
        read_camera_file(tmp_path / "camchain.yaml", frame_size=lambda: (640, 480))


def _sub(folder: Path) -> Path:
    (folder / "sub").mkdir()
    return folder / "sub"


def test_a_scaled_camera_sees_the_same_rays(tmp_path: Path) -> None:
    found = read_calibration(made.kalibr(tmp_path))
    whole, half = rig_of(found), rig_of(resized(found, (640, 360)))
    assert whole is not None and half is not None
    pixels = np.random.default_rng(0).uniform([0, 0], [630, 350], (40, 2))
    # A pixel of the half image covers four of the whole one.
    expected = whole.sensor("left").unproject(2 * pixels + 0.5)
    np.testing.assert_allclose(half.sensor("left").unproject(pixels), expected, atol=1e-9)
    with pytest.raises(RsbenchError, match="other proportions"):
        resized(found, (640, 480))
    with pytest.raises(RsbenchError, match=r"1280 x 720.*--resize"):
        with_size(found, (640, 480))


# The command.


def test_the_command_shows_what_was_understood(tmp_path: Path) -> None:
    path = made.kalibr(tmp_path)
    picture = tmp_path / "rig.svg"
    shown = run_here("rig", path, "--picture", picture)
    assert shown.returncode == 0
    for words in ("Kalibr (camchain.yaml)", "119.81 mm", "25.6 us a line", "0.641 deg in all", "--fps"):
        assert words in shown.stdout
    assert picture.read_text().lstrip().startswith("<?xml")
    refused = run_here("rig", path, "--picture", tmp_path / "rig.bmp")
    assert refused.returncode == 2 and "must end in .svg, .png or .pdf" in refused.stderr
    assert not (tmp_path / "rig.bmp").exists()
    record = json.loads(run_here("rig", path, "--json").stdout)
    assert record["baseline_m"] == pytest.approx(float(np.linalg.norm(T)))
    camera = rsbench.read_rig(path).rig.sensor("left")
    rays = camera.unproject([[-0.5, camera.cy], [1279.5, camera.cy]])
    cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
    assert record["left"]["view_deg"][0] == pytest.approx(np.degrees(np.arccos(cosine)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--size", "12"), "--size '12': must be width x height"),
        (("--unit", "parsec"), "--unit 'parsec'"),
        (("--lens", "wide"), "--lens 'wide'"),
        (("--to", "kalibr"), "--to: needs -o PATH"),
        (("--to", "kalib", "-o", "x.yaml"), "did you mean 'kalibr'"),
        (("-o", "x.yaml"), "give --to FORMAT"),
        (("--fps", "0"), "--fps 0"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, arguments: Any, words: str) -> None:
    assert_refused(run_here("rig", made.kalibr(tmp_path), *arguments), words)


def test_readouts_survive_a_conversion(tmp_path: Path) -> None:
    text = made.toml(tmp_path).read_text()
    (tmp_path / "rig.toml").write_text(
        f"readout_ratio = 0.6\nright_readout_ratio = 0.0\nframe_period_s = 0.05\n{text}"
    )
    out = tmp_path / "chain.yaml"
    assert run_here("rig", tmp_path / "rig.toml", "--to", "kalibr", "-o", out).returncode == 0
    found = rsbench.read_rig(out, fps=20.0)
    assert found.readout_ratio == pytest.approx(0.6)
    assert found.scanning is not None and found.scanning.right_readout_ratio == 0.0
    back = tmp_path / "back.toml"
    assert run_here("rig", out, "--fps", "20", "-o", back).returncode == 0
    again = rsbench.read_rig(back)
    assert again.readout_ratio == pytest.approx(0.6) and again.scanning == found.scanning
