"""Datasets of rigs whose cameras differ and look in different directions, against OpenCV and float64 rays."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from small_scenes import write_box_card
from traced_truth import axis_of, first_hit, grid_of, line_of, line_times, rays

from rsbench.components.cards import load_card
from rsbench.components.rig_tables import load_rig
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, VIEWS, Side
from rsbench.dataset.card import DatasetCard, load_dataset_card, read_dataset_card
from rsbench.dataset.generation import build_scene, generate_dataset, render_view, seen_scene
from rsbench.dataset.layout import SHUTTERS
from rsbench.dataset.sequence import read_dataset, read_dataset_manifest, read_sequence
from rsbench.dataset.views import ImageView
from rsbench.renderers.options import RendererOptions
from rsbench.storage.files import read_png, write_json

Array = NDArray[np.float64]
LEFT: dict[str, Any] = {"width": 96, "height": 72, "fx": 80.0, "fy": 81.0, "cx": 46.0, "cy": 37.0}
LEFT |= {"lens": {"model": "brown-conrady", "k1": -0.2, "k2": 0.03, "p1": 1e-3}}
RIGHT: dict[str, Any] = {"width": 120, "height": 64, "fx": 85.0, "fy": 84.0, "cx": 61.0, "cy": 30.0}
RIGHT |= {"lens": {"model": "kannala-brandt", "k1": 0.02}}
RIGS: dict[str, dict[str, Any]] = {
    "two-sizes": {"right": RIGHT, "w": (0.03, -0.06, 0.05), "t": (-0.3, 0.02, -0.03)},
    "vertical": {"right": LEFT | {"fx": 83.0}, "w": (0.02, 0.01, 0.01), "t": (0.01, -0.25, 0.02)},
    "global-right": {
        "right": {key: RIGHT[key] for key in RIGHT if key != "lens"} | {"readout_ratio": 0.0},
        "w": (0.0, 0.1, 0.0),
        "t": (-0.3, 0.0, 0.0),
    },
    "late-columns": {
        "right": LEFT | {"scan": "right", "delay_s": 0.01},
        "w": (0.0, -0.03, 0.02),
        "t": (-0.3, 0.0, 0.01),
    },
}


def _toml(value: Any) -> str:
    """An inline value: a table of JSON but for its colons."""
    return re.sub(r'"(\w+)":', r"\1 =", json.dumps(value))


def write_card(folder: Path, name: str, more: str = "") -> Path:
    """A dataset card of a rig of ``RIGS`` in a textured box."""
    rig = RIGS[name]
    matrix = Rotation.from_rotvec(rig["w"]).as_matrix().tolist()
    head = f"""
name = "{name}"
readout_ratio = 0.8
renderer = "preview"
left = {_toml(LEFT)}
right = {_toml(rig["right"])}
right_from_left = {_toml({"rotation": matrix, "translation": rig["t"]})}
frame_period_s = 0.1
{more}
"""
    return write_box_card(folder, head)


@pytest.fixture(scope="module", params=RIGS)
def made(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, DatasetCard, Path]:
    folder = tmp_path_factory.mktemp("rigs")
    card = load_dataset_card(write_card(folder, request.param))
    generate_dataset(card, folder / "out")
    return request.param, card, folder / "out"


def camera_in_body(name: str, side: Side) -> Array:
    """Rotation body to camera (3, 3), from the calibration, as documented."""
    R, t = Rotation.from_rotvec(RIGS[name]["w"]).as_matrix(), np.array(RIGS[name]["t"])
    x = -R.T @ t / np.linalg.norm(t)
    z = np.array([0, 0, 1.0]) + R[2]
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    from_body = np.stack([x, np.cross(z, x), z]).T  # to the left camera
    return from_body if side == "left" else np.asarray(R @ from_body)


def triangles_of(card: DatasetCard) -> Array:
    scene = seen_scene(build_scene(card.sequence[0].scene).scene, card.sequence[0])
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in scene.meshes]).astype(np.float64)


def test_manifest_says_what_the_calibration_says(made: tuple[str, DatasetCard, Path]) -> None:
    name, card, folder = made
    (sequence,) = read_dataset(folder)
    assert sequence.rig == card.rig_of(card.sequence[0]) and sequence.shutter == card.shutter_for(card.sequence[0])
    manifest, rig = sequence.manifest, RIGS[name]
    assert manifest["format"] == 2 and read_dataset_manifest(folder).format == 2
    R = Rotation.from_rotvec(rig["w"]).as_matrix()
    np.testing.assert_allclose(manifest["right_from_left"]["rotation"], R, atol=1e-12)
    np.testing.assert_allclose(manifest["right_from_left"]["translation"], rig["t"], atol=1e-12)
    for side in SIDES:
        stored, table = manifest["cameras"][side], LEFT if side == "left" else rig["right"]
        given = Rotation.from_rotvec(stored["rotation_from_body"]).as_matrix()
        np.testing.assert_allclose(given, camera_in_body(name, side), atol=1e-12)
        assert all(stored[key] == table[key] for key in ("width", "height", "fx", "fy", "cx", "cy"))
        lens = table.get("lens", {})
        assert {key: stored.get("lens", {}).get(key) for key in lens} == lens
        assert sequence.shutter.ratio_of(side) == table.get("readout_ratio", 0.8)
    scanning = {"right_scan": rig["right"].get("scan"), "right_delay": rig["right"].get("delay_s", 0.0) / 0.1}
    assert {key: manifest.get(key, default) for key, default in (("right_scan", None), ("right_delay", 0.0))} == (
        pytest.approx(scanning)
    )


def test_depth_is_what_float64_rays_of_the_calibration_meet(made: tuple[str, DatasetCard, Path]) -> None:
    """The test before this one compares the numbers of the sequence with the calibration."""
    _, card, folder = made
    (sequence,) = read_dataset(folder)
    triangles = triangles_of(card)
    for (side, frame), kind in product(VIEWS, SHUTTERS):
        grid = grid_of(sequence, side)
        lines = grid[:, axis_of(sequence, side)]
        lines = lines if kind == "rs" else np.full(len(grid), float(line_of(sequence, side, 0)))
        wanted = first_hit(triangles, *rays(sequence, side, line_times(sequence, side, frame, lines), grid))
        depth = sequence.depth(kind, side, frame).astype(np.float64)
        far = np.abs(depth.ravel() / wanted - 1.0) > 2e-5
        assert np.mean(far) < 2e-3, f"{kind} {side} {frame}: {np.mean(far):.3g}"  # at edges of two walls


@pytest.mark.parametrize("side", SIDES)
def test_rows_have_the_bits_of_global_images_at_their_poses(
    made: tuple[str, DatasetCard, Path], side: Side
) -> None:
    from rsbench.renderers.scene import MitsubaScene

    _, card, folder = made
    (sequence,) = read_dataset(folder)
    scene = MitsubaScene(seen_scene(build_scene(card.sequence[0].scene).scene, card.sequence[0]))
    options = load_card(RendererOptions, "renderers", card.renderer)
    poses = row_poses(sequence.rig, sequence.shutter, sequence.motion, side, 1)
    rolling = render_view(scene, sequence, ImageView("rs", side, 1), poses, options)
    axis, lines = sequence.shutter.axis(side), sequence.shutter.lines(side)
    for read in (0, lines // 3, lines - 1):
        still = render_view(scene, sequence, ImageView("gs", side, 1, read), poses, options)
        line = abs(sequence.shutter.first_line(side) - read)
        place = np.s_[line] if axis == 1 else np.s_[:, line]
        for part in ("image", "depth"):
            np.testing.assert_array_equal(getattr(still, part)[place], getattr(rolling, part)[place])
    assert np.array_equal(rolling.depth, sequence.depth("rs", side, 1))


def test_rigs_of_sequences_and_grids_are_those_that_the_card_names(tmp_path: Path) -> None:
    head = """
name = "many"
readout_ratio = 0.7
scan = "bottom"
rig = "zed2"
[grid.rig.same]
[grid.rig.phone]
rig = "tum-rsvi"
"""
    near = f"""
[[sequence]]
name = "near"
scene = "{tmp_path / "box.toml"}"
scale = 2.0
rig = "euroc"
readout_ratio = 0.4
"""
    path = write_box_card(tmp_path, head, near)
    card = load_dataset_card(path)
    found = {each.name: (card.rig_of(each), card.shutter_for(each), each) for each in card.sequence}
    rig, shutter, _ = found["box-same"]
    assert rig == load_rig("zed2").rig()
    assert shutter.readout_ratio == load_rig("zed2").readout_ratio and shutter.scan == "top"
    rig, shutter, sequence = found["box-phone"]
    assert rig == load_rig("tum-rsvi").rig()
    assert (shutter.ratio_of("left"), card.period_of(sequence)) == (0.0, 0.05)
    assert shutter.ratio_of("right") == load_rig("tum-rsvi").right_readout_ratio
    rig, shutter, sequence = found["near-same"]
    assert shutter.readout_ratio == 0.4  # a sequence's own goes first
    np.testing.assert_allclose(rig.right_from_left.t, 2.0 * load_rig("euroc").rig().right_from_left.t)
    assert np.linalg.norm(card.motion_of(sequence).d) == pytest.approx(0.4)
    assert read_dataset_card(path).rig == load_rig("zed2") and card.manifest_of(sequence)["format"] == 2


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("camera = { width = 64, height = 48, focal = 60.0 }", "rig and camera exclude each other"),
        ('rig = "zed2"', "rig and left exclude each other"),
        ('channels = ["disparity"]', "'disparity' needs"),
        ('twins = ["middle"]', "twins: cameras of which one has more rows"),
    ],
)
def test_cards_that_cannot_be_are_refused(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(RsbenchError, match=message):
        load_dataset_card(write_card(tmp_path, "two-sizes", more))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"right_from_left": None}, "'right_from_left' is required"),
        ({"cameras": None}, "'cameras' is required"),
        ({"baseline": 0.5}, "right_from_left contradicts"),
        ({"format": 3}, "this version reads 1 and 2"),
        ({"format": 1}, "'camera' is required"),
    ],
)
def test_wrong_manifests_are_refused_in_one_line(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    card = load_dataset_card(write_card(tmp_path, "two-sizes"))
    manifest = {**card.manifest_of(card.sequence[0]), **change}
    (tmp_path / "box").mkdir()
    write_json(
        tmp_path / "box/sequence.json", {key: value for key, value in manifest.items() if value is not None}
    )
    with refused(match=message):
        read_sequence(tmp_path / "box")


def test_stitched_frames_have_the_bits_of_the_single_pass_and_keep_a_whole_frame_of_each_row(
    tmp_path: Path,
) -> None:
    sizes = {"left": (20, 12), "right": (16, 18)}
    card = load_dataset_card(write_card(tmp_path, "two-sizes"))
    assert card.rig is not None
    small = {
        side: replace(
            getattr(card.rig, side), width=w, height=h, fx=0.8 * w, fy=0.8 * w, cx=0.5 * w, cy=0.45 * h, lens=None
        )
        for side, (w, h) in sizes.items()
    }
    card = card.with_rig(replace(card.rig, **small))
    generate_dataset(card, tmp_path / "one")
    generate_dataset(card, tmp_path / "whole", full_frames=True)
    one, whole = (read_dataset(tmp_path / name)[0] for name in ("one", "whole"))
    for side, frame in VIEWS:
        assert np.array_equal(one.image("rs", side, frame), whole.image("rs", side, frame))
        assert np.array_equal(one.depth("rs", side, frame), whole.depth("rs", side, frame))
        stack = sorted((whole.folder / "gs_stack" / f"{side}_{frame}").iterdir())
        assert len(stack) == sizes[side][1]
        last = read_png(stack[-1], sizes[side])
        assert np.array_equal(last[-1], whole.image("rs", side, frame)[-1])
