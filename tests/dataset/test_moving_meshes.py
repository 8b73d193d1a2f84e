"""Mesh files of the user that move over three frames, against triangles traced at each ray's own time."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from attack.planting import copied, spoilt
from channel_faults import mask_of, other_object, values_of
from scipy.spatial.transform import Rotation
from small_scenes import write_box_scene
from traced_truth import Array, Thing, World, agreement, first_hit, line_times, rays

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import views_of
from rsbench.core.se3 import inverse, transform
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.channels import PairChannel
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.layout import SHUTTERS
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.dataset.views import NUMBER
from rsbench.scenes.load import load_scene
from rsbench.verification import verify_dataset
from rsbench.verification.rerender import Rerenderer

CARD = """
name = "fair"
baseline = 0.3
readout_ratio = 0.9
renderer = "preview"
frames = 3
channels = ["disparity", "flow", "gs_flow", "instances", "normals", "timing"]
twins = [24]
[camera]
width = 80
height = 60
focal = 75
[motion]
rotation_deg = 2
rotation_axis = [0.5, 1, -0.6]
translation = 0.2
translation_axis = [-0.7, 0.3, -0.6]
[[sequence]]
name = "fair"
scene = "SCENE"
[[sequence.moving]]
mesh = { file = "meshes/kite.glb", size = 1.1 }
position = [-0.3, 0.1, 2.6]
attitude_deg = [20, -40, 10]
motion = { rotation_deg = 15, rotation_axis = [0.1, 1, 0.2], translation = 0.2, translation_axis = [1, 0, 0.2] }
[[sequence.moving]]
mesh = { file = "meshes/slab.ply", metres_per_unit = 0.01, up_axis = "z" }
position = [0.7, -0.3, 3.2]
motion = { rotation_deg = 20, rotation_axis = "random", translation = 0.2, translation_axis = [-1, 0.4, 0] }
"""
POSITIONS = np.array([(-0.3, 0.1, 2.6), (0.7, -0.3, 3.2)])


def write_meshes(folder: Path) -> None:
    """Two tetrahedra in one file with y up, whose units mean nothing; and a slab in centimetres with z up."""
    folder.mkdir(exist_ok=True)
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    sail = trimesh.Trimesh([[0, 0, 0], [7, 0, 1], [2, 9, 0], [3, 3, 4]], faces, process=False)
    tail = trimesh.Trimesh([[6, 0, 0], [11, -2, 2], [9, 4, 1], [8, 0, 5]], faces, process=False)
    trimesh.Scene({"sail": sail, "tail": tail}).export(folder / "kite.glb")
    trimesh.creation.box((70.0, 40.0, 55.0)).export(folder / "slab.ply")


def fair_card(folder: Path, changed: Callable[[str], str] = str) -> DatasetCard:
    (folder / "fair.toml").write_text(changed(CARD).replace("SCENE", str(folder / "hall.toml")))
    return load_dataset_card(str(folder / "fair.toml"))


@pytest.fixture(scope="module")
def fair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fair")
    write_box_scene(folder, "hall")
    write_meshes(folder / "meshes")
    generate_dataset(fair_card(folder), folder / "data")
    assert generate_dataset(fair_card(folder), folder / "data") == [], "a second run has nothing to do"
    return folder / "data"


@pytest.fixture(scope="module")
def sequence(fair: Path) -> Sequence:
    return read_dataset(fair)[0]


def kite_triangles(folder: Path) -> Array:
    """As the card sets it: upright is y down and z away in the world."""
    corners = np.asarray(trimesh.load_scene(folder / "kite.glb").to_mesh().triangles) * (1, -1, -1)
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    centred = (corners - 0.5 * (low + high)) * 1.1 / np.max(high - low)
    turn = Rotation.from_rotvec([20.0, -40.0, 10.0], degrees=True)
    return np.asarray(turn.apply(centred.reshape(-1, 3)).reshape(-1, 3, 3) + POSITIONS[0])


@pytest.fixture(scope="module")
def world(fair: Path, sequence: Sequence) -> World:
    scene = load_scene(fair.parent / "hall.toml")
    still = [mesh.vertices[mesh.faces] for mesh in scene.seen_from(scene.viewpoints["default"]).meshes]
    slab = np.asarray(trimesh.creation.box((0.7, 0.55, 0.4)).triangles) + POSITIONS[1]
    records = [record["motion"] for record in sequence.manifest["moving"]]
    things = [
        Thing(triangles, place, np.array(record["w"]), np.array(record["d"]))
        for triangles, place, record in zip(
            (kite_triangles(fair.parent / "meshes"), slab), POSITIONS, records, strict=True
        )
    ]
    return World(partial(first_hit, np.concatenate(still)), tuple(things))


@pytest.mark.parametrize(
    ("channel", "frame", "row", "back"),
    [
        ("flow", 0, 0, False),
        ("flow", 1, 0, True),
        ("flow", 2, 0, False),
        ("gs_flow", 2, 24, False),
        ("disparity", 2, 0, False),
    ],
)
def test_every_pixel_lies_where_rays_say(
    sequence: Sequence, world: World, channel: PairChannel, frame: int, row: int, back: bool
) -> None:
    """99.9 % of the visible pixels within 0.01 px, no other class on 99.9 %; of the objects by themselves too."""
    _, close, alike, owner = agreement(sequence, world, channel, "left", frame, row, back)
    assert np.mean(close) >= 0.999 and np.mean(alike) >= 0.999
    for number in (1, 2):
        # Some 200 pixels or more each: one at an edge may round to the other side.
        assert np.sum(owner == number) > 200 and np.sum(~(close & alike)[owner == number]) <= 1


def test_depth_labels_and_instances_are_those_of_the_triangles(sequence: Sequence, world: World) -> None:
    names = [row["name"] for row in sequence.instance_table()]
    own = {number: [name.startswith(f"moving_{number}: ") for name in names] for number in (1, 2)}
    assert [sum(own[number]) for number in (1, 2)] == [2, 1], "each part of a file is an instance"
    for side, frame in views_of(sequence.frames):
        grid = sequence.rig.camera.pixel_grid().reshape(-1, 2)
        tau = line_times(sequence, side, frame, grid[:, 1])
        depth, owner = world.hit(*rays(sequence, side, tau, grid), tau)
        assert np.mean((sequence.labels("rs", side, frame).ravel() & NUMBER) == owner) >= 0.999
        assert np.mean(np.isclose(sequence.depth("rs", side, frame).ravel(), depth, rtol=1e-5)) >= 0.999
        numbers = sequence.instances(side, frame).ravel()
        for number in (1, 2):
            assert np.mean(np.array([False, *own[number]])[numbers] == (owner == number)) >= 0.999


def test_a_pair_of_later_frames_has_the_objects_where_they_are(sequence: Sequence) -> None:
    """A point of an object, moved in the world of the whole, and in that of the pair."""
    pair, tau = sequence.pairs()[1], np.linspace(0.0, 1.9, 5)
    body = sequence.motion.body_from_world(1.0)
    for whole, own in zip(sequence.objects, pair.objects, strict=True):
        X = transform(whole.world_from_object(1.0), np.array([0.3, -0.2, 3.0]))
        moved = transform(whole.world_from_object(tau + 1.0), np.array([0.3, -0.2, 3.0]))
        found = transform(own.world_from_object(tau), transform(body, X))
        np.testing.assert_allclose(found, transform(body, moved), rtol=0, atol=1e-12)
        np.testing.assert_allclose(transform(inverse(body), transform(body, X)), X, atol=1e-12)
    np.testing.assert_array_equal(pair.labels("rs", "left", 1), sequence.labels("rs", "left", 2))


@pytest.mark.slow
def test_verify_finds_nothing_and_renders_again_where_the_meshes_are_named(fair: Path, tmp_path: Path) -> None:
    scene, kite, slab = fair.parent / "hall.toml", *(fair.parent / f"meshes/{n}" for n in ("kite.glb", "slab.ply"))
    (report,) = verify_dataset(fair, rerender="auto", scenes=[scene, kite, slab])
    assert report.faults == () and "the same bits" in report.notes[-1]
    (sequence,) = read_dataset(fair)
    with pytest.raises(RsbenchError, match=r"'slab\.ply' of moving object 2 is a file of yours"):
        Rerenderer("auto", [scene], [kite]).scene(sequence)
    trimesh.creation.box((70.0, 40.0, 56.0)).export(tmp_path / "slab.ply")
    with pytest.raises(RsbenchError, match=r"slab\.ply: what is drawn of it has another sha256"):
        Rerenderer("auto", [scene], [kite, tmp_path / "slab.ply"]).scene(sequence)
    assert str(fair.parent) not in (fair / "fair/sequence.json").read_text(), "a dataset names no folder"


@pytest.mark.parametrize(
    ("plants", "file"),
    [
        ([mask_of("rs_moving/left_2.png", other_object)], "rs_moving/left_2.png"),
        # Of both shutters, so that twins agree.
        (
            [copied(f"{shutter}_moving/left_0.png", f"{shutter}_moving/left_1.png") for shutter in SHUTTERS],
            "_moving/left_1.png",
        ),
        ([values_of("flow_back/left_1.exr", np.negative)], "flow_back/left_1.exr"),
    ],
    ids=["objects exchanged", "objects that stay", "flow"],
)
def test_a_fault_in_a_later_frame_is_named(
    fair: Path, tmp_path: Path, plants: list[Callable[[Path], None]], file: str
) -> None:
    (report,) = verify_dataset(spoilt(fair, tmp_path / "data", *plants, sequence="fair"))
    assert any(file in fault.partition(": ")[0] for fault in report.faults), report.faults


def test_a_mesh_that_changed_makes_another_sequence(fair: Path, tmp_path: Path) -> None:
    shutil.copytree(fair.parent, tmp_path / "again")
    folder = tmp_path / "again"
    trimesh.creation.box((70.0, 40.0, 56.0)).export(folder / "meshes/slab.ply")
    with pytest.raises(RsbenchError, match=r"of another card \(differs in meshes\)"):
        generate_dataset(fair_card(folder), folder / "data")
    (folder / "meshes/slab.ply").unlink()
    with pytest.raises(RsbenchError, match=r"mesh file .*slab\.ply: no such file"):
        generate_dataset(fair_card(folder), folder / "data")


SHORT = f'model = "spline", parameters = {{ interval = 1, shake = {np.zeros((5, 6)).tolist()} }}, '


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("size = 1.1", "size = 0", r"mesh\.size = 0\.0: must be positive"),
        ("meshes/slab.ply", "other/kite.glb", r"two mesh files are named 'kite\.glb'"),
        (
            "rotation_deg = 15",
            f"{SHORT}rotation_deg = 15",
            "motion 'spline' lasts 2 frame periods; the frames need 2.9",
        ),
        (
            'mesh = { file = "meshes/kite',
            'instance = "a"\nmesh = { file = "meshes/kite',
            "one of 'instance', 'box' and 'mesh'",
        ),
    ],
)
def test_what_cannot_move_so_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(RsbenchError, match=words):
        fair_card(tmp_path, lambda text: text.replace(old, new))


def test_lengths_of_mesh_files_scale_and_shakes_last(tmp_path: Path) -> None:
    def larger(text: str) -> str:
        shaken = text.replace("motion = { rotation_deg = 15", 'motion = { model = "spline", rotation_deg = 15')
        return shaken.replace('name = "fair"\nscene', 'name = "fair"\nscale = 2.0\nscene')

    kite, slab = fair_card(tmp_path, larger).sequence[0].moving
    assert kite.mesh is not None and slab.mesh is not None
    assert (kite.mesh.size, slab.mesh.size, slab.mesh.metres_per_unit) == (2.2, None, 0.02)
    assert kite.position == (-0.6, 0.2, 5.2) and kite.thing.motion.lasts >= 2.9
