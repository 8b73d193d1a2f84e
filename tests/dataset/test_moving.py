"""Sequences in which objects move, against triangles traced at each ray's own time, and faults planted in them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from attack.planting import spoilt
from channel_faults import mask_of, other_object
from commands import bytes_below
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from traced_truth import Array, Thing, World, agreement, axis_of, first_hit, grid_of, line_times, rays
from yard_dataset import boxes_card, write_boxes

from rsbench.components.cards import parse_card
from rsbench.components.motion_models import LinearMotion
from rsbench.components.rig_tables import RigTables
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import poses_of
from rsbench.core.projection import row_poses
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.channels import PAIR_CHANNELS, PairChannel
from rsbench.dataset.generation import estimate_dataset, generate_dataset, seen_scene
from rsbench.dataset.motion_cards import TAKEN, MovingCard
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.dataset.views import NUMBER, SHADED
from rsbench.renderers.image import Sensor
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.visibility import obstacle
from rsbench.scenes.load import load_scene
from rsbench.storage.work_folder import HIDDEN
from rsbench.verification import verify_dataset
from rsbench.verification.content import read_content, read_twins
from rsbench.verification.mask_checks import label_faults

LIGHT = """
[light]
sun_azimuth_deg = 300
sun_elevation_deg = 50
"""
CART = MovingCard(
    instance="cart",
    position=(-0.6, 0.6, 4.5),
    motion=MotionCard(
        rotation_deg=15.0, rotation_axis=(0.1, 1.0, 0.2), translation=0.5, translation_axis=(1, 0, 0.2)
    ),
)
BOX = MovingCard(
    box=(0.7, 0.5, 0.4),
    position=(0.9, -0.3, 3.5),
    attitude_deg=(10.0, 30.0, 0.0),
    texture_seed=2,
    motion=MotionCard(rotation_deg=25.0, rotation_axis="random", translation=0.4, translation_axis=(-1, 0.4, 0)),
)


def write_lot(folder: Path) -> Path:
    """Ground, a wall, and a cart that will move."""
    ground, wall = ((14.0, 12.0, 0.1), (0.0, 3.0, -0.05)), ((7.0, 0.3, 2.2), (2.0, 6.0, 1.1))
    boxes = {"ground": ground, "wall": wall, "cart": ((0.9, 0.7, 1.0), (-0.6, 0.5, 0.55))}
    return write_boxes(folder, "lot", boxes, LIGHT)


def lot_card(folder: Path, **fields: object) -> DatasetCard:
    kept = {
        "camera": CameraCard(width=80, height=60, focal=75.0),
        "channels": TAKEN,
        "twins": (24,),
        "sensor": Sensor(exposure_s=0.02, full_well=6000, photon_noise=True, read_noise=2.5),
        "sequence": (SequenceCard(name="lot", scene=str(folder / "lot.toml"), moving=(CART, BOX)),),
    }
    return boxes_card(folder / "lot.toml", **(kept | fields)).expanded()


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lot")
    write_lot(folder)
    generate_dataset(lot_card(folder), folder / "data")
    assert generate_dataset(lot_card(folder), folder / "data") == [], "a second run has nothing to do"
    assert estimate_dataset(lot_card(folder), lambda scene: None).files == len(
        bytes_below(folder / "data", HIDDEN)
    )
    return folder / "data"


@pytest.fixture(scope="module")
def sequence(lot: Path) -> Sequence:
    return read_dataset(lot)[0]


@pytest.fixture(scope="module")
def world(lot: Path, sequence: Sequence) -> World:
    return world_of(lot.parent, sequence)


def world_of(folder: Path, sequence: Sequence) -> World:
    """Triangles of the still meshes, the cart's by its name, and those of a box of trimesh."""
    scene = load_scene(folder / "lot.toml")
    meshes = {mesh.name: mesh.vertices[mesh.faces] for mesh in scene.seen_from(scene.viewpoints["default"]).meshes}
    box = trimesh.creation.box((0.7, 0.5, 0.4))
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(np.hypot(10.0, 30.0)), (10.0, 30.0, 0.0))
    box.apply_transform(turn)
    box.apply_translation((0.9, -0.3, 3.5))
    own = (meshes.pop("cart"), np.asarray(box.triangles))
    records = [record["motion"] for record in sequence.manifest["moving"]]
    things = [
        Thing(triangles, np.array(card.position), np.array(record["w"]), np.array(record["d"]))
        for triangles, card, record in zip(own, (CART, BOX), records, strict=True)
    ]
    return World(partial(first_hit, np.concatenate(list(meshes.values()))), tuple(things))


@pytest.mark.parametrize(("channel", "row"), [*((name, 0) for name in PAIR_CHANNELS), ("gs_flow", 24)])
def test_every_pixel_lies_where_rays_say(sequence: Sequence, world: World, channel: PairChannel, row: int) -> None:
    """99.9 % of the visible pixels within 0.01 px, no other class on 99.9 %; of the objects by themselves too."""
    _check_pairs(sequence, world, channel, row)


def _check_pairs(sequence: Sequence, world: World, channel: PairChannel, row: int) -> None:
    views = [agreement(sequence, world, channel, *view, row) for view in VIEWS]
    _, close, alike, owner = (np.concatenate(each) for each in zip(*views, strict=True))
    assert np.mean(close) >= 0.999 and np.mean(alike) >= 0.999
    for number in (1, 2):
        # At least 900 pixels each: two at edges may round to the other side.
        assert np.sum(owner == number) > 900 and np.mean((close & alike)[owner == number]) >= 0.998


def test_depth_labels_normals_and_instances_are_those_of_the_triangles(sequence: Sequence, world: World) -> None:
    _check_surfaces(sequence, world)


def _check_surfaces(sequence: Sequence, world: World) -> None:
    names = [row["name"] for row in sequence.instance_table()]
    sun = np.array(_sun(sequence))
    for side, frame in VIEWS:
        grid = grid_of(sequence, side)
        tau = line_times(sequence, side, frame, grid[:, axis_of(sequence, side)])
        origins, ways = rays(sequence, side, tau, grid)
        depth, owner = world.hit(origins, ways, tau)
        seen = np.isfinite(depth)
        X = origins + ways * np.where(seen, depth, 1.0)[:, None]
        dark = np.zeros(len(X), dtype=bool)
        for number in (1, 2):
            # From a little above the surface: a millimetre along the way back.
            above = X - 1e-3 * ways / np.linalg.norm(ways, axis=1, keepdims=True)
            only = World(partial(first_hit, np.zeros((0, 3, 3))), (world.things[number - 1],))
            dark |= np.isfinite(only.hit(above, np.broadcast_to(sun, X.shape), tau)[0])
        labels = sequence.labels("rs", side, frame).ravel()
        assert np.mean((labels & NUMBER) == np.where(seen, owner, 0)) >= 0.999
        assert np.mean(((labels & SHADED) > 0) == (dark & seen)) >= 0.995  # edges of shadows lie at grazing angles
        assert np.sum(labels == SHADED) > 20, "the ground is in the shadow of what moves"
        stored = sequence.depth("rs", side, frame).ravel()
        assert np.mean(np.isclose(stored, np.where(seen, depth, 0.0), rtol=1e-5)) >= 0.999
        numbers = sequence.instances(side, frame).ravel()
        for number, name in ((1, "cart"), (2, "moving_2")):
            assert np.mean((numbers == names.index(name) + 1) == (owner == number)) >= 0.999
        _check_normals(sequence, world, side, frame, owner, tau, ways)


RIGS: dict[str, tuple[dict[str, Any], tuple[float, ...], dict[str, Any]]] = {
    "sizes": (
        {"width": 96, "height": 54, "fx": 85.0, "fy": 84.0, "cx": 49.0, "cy": 25.0},
        (0.03, -0.05, 0.06),
        {},
    ),
    "vertical": (
        {"width": 80, "height": 60, "fx": 77.0, "fy": 77.0, "cx": 39.0, "cy": 31.0},
        (0.02, 0.01, -0.02),
        {"right_scan": "left", "right_delay": 0.1, "right_readout_ratio": 0.5},
    ),
}
"""Right camera, its rotation vector and readout."""


@pytest.mark.parametrize("name", RIGS)
def test_any_rig_has_the_truth_of_what_moves(tmp_path: Path, name: str) -> None:
    right, turn, readout = RIGS[name]
    left = {"width": 80, "height": 60, "fx": 75.0, "fy": 76.0, "cx": 38.0, "cy": 30.0}
    tables = {
        "left": left | {"lens": {"model": "brown-conrady", "k1": -0.2, "k2": 0.03, "p1": 1e-3}},
        "right": right | {"lens": {"model": "kannala-brandt", "k1": 0.02}},
        "right_from_left": {
            "rotation": Rotation.from_rotvec(turn).as_matrix().tolist(),
            "translation": [-0.3, 0.02, -0.03] if name == "sizes" else [0.02, -0.3, 0.01],
        },
    }
    write_lot(tmp_path)
    rig = parse_card(RigTables, tables | readout, "rig")
    channels = tuple(each for each in TAKEN if each != "disparity")
    generate_dataset(lot_card(tmp_path, channels=channels, twins=()).with_rig(rig), tmp_path / "data")
    (sequence,) = read_dataset(tmp_path / "data")
    world = world_of(tmp_path, sequence)
    for channel in ("flow", "gs_flow"):
        _check_pairs(sequence, world, channel, 0)
    _check_surfaces(sequence, world)


def _check_normals(
    sequence: Sequence, world: World, side: str, frame: int, owner: NDArray[np.int64], tau: Array, ways: Array
) -> None:
    """Upright on a triangle of the object where it is then, and towards the camera."""
    normals = sequence.normals(side, frame).reshape(-1, 3)  # pyrefly: ignore[bad-argument-type]
    for number, thing in enumerate(world.things, start=1):
        own = np.flatnonzero(owner == number)
        corners = [
            thing.moved(np.tile(thing.triangles[:, k], (len(own), 1)), np.repeat(tau[own], 12)) for k in range(3)
        ]
        upright = np.cross(corners[1] - corners[0], corners[2] - corners[0]).reshape(len(own), 12, 3)
        upright /= np.linalg.norm(upright, axis=2, keepdims=True)
        most = np.max(np.abs(np.einsum("nkj,nj->nk", upright, normals[own])), axis=1)
        assert np.mean(np.abs(most - 1.0) < 1e-5) >= 0.995
        assert np.mean(np.sum(normals[own] * ways[own], axis=1) < 0) >= 0.995


def _sun(sequence: Sequence) -> Array:
    scene = load_scene(sequence.folder.parents[1] / "lot.toml")
    return np.array(scene.seen_from(scene.viewpoints["default"]).light.sun_direction)


def test_a_row_is_that_of_the_global_shutter_at_its_time(sequence: Sequence) -> None:
    """Bit for bit: images, depth and labels of rows 0 and 24."""
    for side, frame in VIEWS:
        for row in (0, 24):
            clean = sequence.clean_image(side, frame)[row]
            assert np.array_equal(clean, sequence.image("gs", side, frame, row)[row])
            for read in (sequence.depth, sequence.labels):
                rolling, still = read("rs", side, frame), read("gs", side, frame, row)
                assert np.array_equal(rolling[row], still[row]) and not np.array_equal(rolling, still)


def test_single_pass_and_stitching_agree_and_objects_that_rest_are_still_ones(
    lot: Path, sequence: Sequence
) -> None:
    """Blurred too, bit for bit; and a scene with the boxes where they are at a time, but for rounding."""
    card = lot_card(lot.parent)
    seen = seen_scene(load_scene(lot.parent / "lot.toml"), card.sequence[0])
    rig, shutter, motion, _, things = card.geometry_of(card.sequence[0])
    tau, rows = shutter.line_times(1, "left"), [3, 41]
    blur = tau + 0.1 * np.arange(4)[:, None]
    poses, options = row_poses(rig, shutter, motion, "left", 1), RendererOptions(samples=4, seed=3)
    scene = MitsubaScene(seen)
    lines = LinePoses(*poses, poses_of(things, tau))
    exposed = LinePoses(*rig.cam_from_world(motion, blur, "left"), poses_of(things, blur))
    blurred = partial(render, scene, rig.camera, lines, exposed=exposed)
    whole = blurred(options)
    stitched = blurred(replace(options, method="stitched"), rows=rows)
    for name in ("image", "depth", "labels"):
        assert np.array_equal(getattr(whole, name)[rows], getattr(stitched, name))
    at = poses_of(things, np.full(tau.shape, 0.7))
    assert at is not None
    placed = tuple(
        replace(mesh, mover=0, vertices=mesh.vertices @ at.R[mesh.mover - 1, 0].T + at.t[mesh.mover - 1, 0])
        if mesh.mover
        else mesh
        for mesh in seen.meshes
    )
    moving = render(scene, rig.camera, LinePoses(*poses, objects=at), options)
    still = render(MitsubaScene(replace(seen, meshes=placed)), rig.camera, LinePoses(*poses), options)
    np.testing.assert_allclose(moving.depth, still.depth, rtol=1e-5)
    # A sample may round to the other side of an edge.
    assert np.mean(np.abs(moving.image - still.image) > 1e-3) < 2e-3


def test_verify_finds_nothing_in_a_sound_one(lot: Path) -> None:
    (report,) = verify_dataset(lot, rerender="auto", scenes=[lot.parent / "lot.toml"])
    assert report.faults == () and "the same bits" in report.notes[-1]


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("rs_moving/left_0.png", np.zeros_like),
        ("gs_moving/right_1.png", other_object),
        ("rs_moving/right_0.png", lambda labels: np.maximum(labels, 1)),
        ("gs_twin_moving/0024/left_1.png", lambda labels: labels[::-1]),
    ],
)
def test_labels_that_contradict_depth_are_named(
    lot: Path, tmp_path: Path, file: str, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
) -> None:
    (sequence,) = read_dataset(spoilt(lot, tmp_path / "data", mask_of(file, change), sequence="lot"))
    content, twins = read_content(sequence), read_twins(sequence, (), (0, 1))
    (fault,) = label_faults(content, content, twins)
    assert fault.file == file
    assert len(content.maps) + len(twins.maps) == 11, "its depth map accuses no other"


def test_labels_that_depth_does_not_tell_are_made_again(lot: Path, tmp_path: Path) -> None:
    """No shadows, and all one pixel beside, with hashes made to fit."""
    unlit = mask_of("rs_moving/left_1.png", lambda labels: labels & np.uint8(NUMBER))
    beside = mask_of("gs_moving/left_0.png", lambda labels: np.roll(labels, 1, axis=1))
    data = spoilt(lot, tmp_path / "data", unlit, beside, sequence="lot")
    (report,) = verify_dataset(data, rerender="auto", scenes=[lot.parent / "lot.toml"])
    for file in ("rs_moving/left_1.png", "gs_moving/left_0.png"):
        assert any(fault.startswith(file) for fault in report.faults), report.faults


def test_what_knows_nothing_of_moving_objects_is_refused(lot: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'tracks' does not support moving objects"):
        lot_card(lot.parent, channels=("flow", "tracks"))
    with pytest.raises(RsbenchError, match="moving objects are not for the integrator 'path'"):
        generate_dataset(lot_card(lot.parent, renderer="path"), tmp_path)
    unknown = replace(CART, instance="card")
    sequence = lot_card(lot.parent).sequence[0]
    with pytest.raises(RsbenchError, match=r"no mesh 'card' \(did you mean 'cart'"):
        seen_scene(load_scene(lot.parent / "lot.toml"), replace(sequence, moving=(unknown,)))
    with pytest.raises(RsbenchError, match="'cart' moves twice"):
        seen_scene(load_scene(lot.parent / "lot.toml"), replace(sequence, moving=(CART, CART)))
    content = json.loads(json.dumps(asdict(lot_card(lot.parent))))
    for wrong, words in (
        ({"box": [1, 1, 1]}, "one of 'instance', 'box' and 'mesh'"),
        ({"instance": "", "box": [1, 0, 1]}, "edges must be positive"),
        ({"attitude_deg": [1, 0, 0]}, "attitude_deg is of a box"),
    ):
        content["sequence"][0]["moving"][0] = asdict(CART) | wrong
        with pytest.raises(RsbenchError, match=words):
            parse_card(DatasetCard, content, "card.toml")


def test_a_camera_that_meets_an_object_is_refused(lot: Path) -> None:
    """A box comes from the front, and is at the rig at time 0.9."""
    at_rig = replace(
        BOX,
        position=(0.0, 0.0, 3.6),
        motion=replace(
            BOX.motion, translation=4.0, rotation_deg=0.0, rotation_axis=(0, 1, 0), translation_axis=(0, 0, -1)
        ),
    )
    card = lot_card(lot.parent)
    sequence = replace(card.sequence[0], moving=(at_rig,))
    scene = MitsubaScene(seen_scene(load_scene(lot.parent / "lot.toml"), sequence))
    words = obstacle(scene, *card.geometry_of(sequence)._replace(motion=LinearMotion([0, 0, 0], [0, 0, 0])))
    assert "camera and moving object 1 meet at time 0." in words
