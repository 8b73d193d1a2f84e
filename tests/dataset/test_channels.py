"""Channels of ground truth against rays of our own: every triangle tried in float64, rows found by bisection."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from attack.planting import named, spoilt
from channel_faults import FAULTS
from numpy.typing import NDArray
from traced_truth import World, agreement, first_hit, grid_of, line_times, look, rays, row_seeing, within
from yard_dataset import rounds, write_yard, yard_card

from rsbench.components.cards import parse_card
from rsbench.components.rig_tables import RigTables
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, SIDES, VIEWS
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.channels import CHANNELS, PAIR_CHANNELS, TRACKS, PairChannel, matches_file, named_channels
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.point_channels import MATCHED, MatchClass, jacobians_of
from rsbench.dataset.sequence import Sequence, read_dataset, read_sequence
from rsbench.dataset.views import ImageView, PixelClass
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.renderers.image import to_srgb8
from rsbench.scenes.load import load_scene
from rsbench.storage.files import read_grey_png, write_png
from rsbench.verification import Rerender, verify_dataset
from rsbench.verification.content import Comparison, read_content
from rsbench.verification.rerender import Rerenderer
from rsbench.vision.feature_matcher import load_features

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a dataset with every channel, below that of its scene."""
    folder = tmp_path_factory.mktemp("yard")
    write_yard(folder)
    card = yard_card(folder, channels=CHANNELS, twins=("last", 24))
    generate_dataset(card, folder / "data")
    assert generate_dataset(card, folder / "data") == [], "a second run has nothing to do"
    return folder / "data"


@pytest.fixture(scope="module")
def sequence(yard: Path) -> Sequence:
    return read_dataset(yard)[0]


RIG = {
    "left": {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 30.0, "cy": 24.0}
    | {"lens": {"model": "brown-conrady", "k1": -0.2, "k2": 0.03, "p1": 1e-3}},
    "right": {"width": 80, "height": 44, "fx": 66.0, "fy": 65.0, "cx": 42.0, "cy": 20.0}
    | {"lens": {"model": "kannala-brandt", "k1": 0.02}},
    "right_from_left": {"rotation_deg": [1.5, -3.0, 4.0], "translation": [-0.3, 0.02, -0.03]},
    "right_readout_ratio": 0.5,
    "right_delay": 0.05,
}


@pytest.fixture(scope="module", params=["ideal", "rig"])
def any_sequence(request: pytest.FixtureRequest, yard: Path, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """That of the yard, or the same seen by cameras that differ and look in different directions."""
    if request.param == "ideal":
        return read_dataset(yard)[0]
    folder = tmp_path_factory.mktemp("rig")
    write_yard(folder)
    channels = tuple(each for each in CHANNELS if each != "disparity")
    card = yard_card(folder, channels=channels)
    rig = parse_card(RigTables, RIG, "rig")
    generate_dataset(card.with_rig(rig), folder / "data")
    return read_dataset(folder / "data")[0]


@pytest.fixture(scope="module")
def triangles(yard: Path) -> Array:
    """(m, 3, 3) in the world frame."""
    scene = load_scene(yard.parent / "yard.toml")
    seen = scene.seen_from(scene.viewpoints["default"])
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in seen.meshes])


@pytest.fixture(scope="module")
def parts(yard: Path) -> list[str]:
    """(m,) the mesh of each triangle."""
    return [mesh.name for mesh in load_scene(yard.parent / "yard.toml").meshes for _ in mesh.faces]


def _check(sequence: Sequence, triangles: Array, channel: PairChannel, row: int) -> None:
    views = [agreement(sequence, World(partial(first_hit, triangles)), channel, *view, row) for view in VIEWS]
    both, near, alike, _ = (np.concatenate(each) for each in zip(*views, strict=True))
    assert np.mean(near[both]) >= 0.999 and np.mean(alike) >= 0.999


@pytest.mark.parametrize(
    ("channel", "row"), [*((name, 0) for name in PAIR_CHANNELS), ("gs_flow", 24), ("gs_flow", 47)]
)
def test_every_pixel_lies_where_rays_say(
    sequence: Sequence, triangles: Array, channel: PairChannel, row: int
) -> None:
    """The bounds of the issue: 99.9 % of the visible pixels within 0.01 px, and no other class on 99.9 %."""
    seen = np.zeros(len(PixelClass), dtype=int)
    for side, frame in VIEWS:
        stored, kinds = (read(channel, side, frame, row) for read in (sequence.offsets, sequence.classes))
        known = kinds != PixelClass.OUT_OF_VIEW
        assert np.all(np.isfinite(stored[known])) and np.all(np.isnan(stored[~known]))
        seen += np.bincount(kinds.ravel(), minlength=len(seen))
    _check(sequence, triangles, channel, row)
    assert np.all(seen[PixelClass.VISIBLE :] >= 20) and seen[PixelClass.UNSOLVED] == 0, seen


@pytest.mark.parametrize("channel", ["flow", "gs_flow"])
def test_every_pixel_of_another_rig_lies_where_rays_say(
    any_sequence: Sequence, triangles: Array, channel: PairChannel
) -> None:
    _check(any_sequence, triangles, channel, 0)


def test_normals_and_instances_are_those_of_the_triangles_that_rays_hit(
    any_sequence: Sequence, triangles: Array, parts: list[str]
) -> None:
    sequence = any_sequence
    assert [row["name"] for row in sequence.instance_table()] == list(dict.fromkeys(parts))
    numbers = np.array([list(dict.fromkeys(parts)).index(part) + 1 for part in parts])
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    upright = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    right = []
    for side, frame in VIEWS:
        grid = grid_of(sequence, side)
        origins, ways = rays(sequence, side, line_times(sequence, side, frame, grid[:, 1]), grid)
        hits = np.stack([first_hit(triangles[k : k + 1], origins, ways) for k in range(len(triangles))])
        nearest = np.argmin(hits, axis=0)
        met = np.isfinite(hits[nearest, np.arange(len(grid))])
        normal = upright[nearest] * -np.sign(np.sum(upright[nearest] * ways, axis=1, keepdims=True))
        stored = sequence.normals(side, frame).reshape(-1, 3)
        # float32: a unit in the last place of vertices of 10 m over edges of 0.15 m.
        right.append(np.max(np.abs(stored - normal * met[:, None]), axis=1) < 2e-5)
        right.append(sequence.instances(side, frame).ravel() == np.where(met, numbers[nearest], 0))
    assert np.mean(np.concatenate(right)) >= 0.999


def test_tracks_are_where_rays_say(any_sequence: Sequence, triangles: Array) -> None:
    """Surfaces to the rounding of depth to float32; rows by bisection; what is hidden by rays."""
    sequence, hit = any_sequence, partial(first_hit, triangles)
    tracks, views = sequence.tracks(), [(side, frame) for frame in FRAMES for side in SIDES]
    assert np.bincount(tracks.sources).tolist() == [512] * 4
    right = []
    for k, (side, frame) in enumerate(views):
        own = tracks.sources == k
        drawn = tracks.pixels[own, k]
        origins, ways = rays(sequence, side, line_times(sequence, side, frame, drawn[:, 1]), drawn)
        X = origins + ways * hit(origins, ways)[:, None]
        assert np.mean(np.linalg.norm(tracks.points[own] - X, axis=1) < 1e-6 * np.linalg.norm(X, axis=1)) >= 0.99
        tau = line_times(sequence, side, frame, row_seeing(sequence, side, frame, tracks.points))
        lost = np.isnan(tau)
        pixels = look(sequence, side, np.where(lost, 0.0, tau), tracks.points)
        inside = ~lost & within(sequence, side, pixels)
        np.testing.assert_allclose(tracks.pixels[inside, k], pixels[inside], rtol=0, atol=1e-6)
        assert np.all(np.isnan(tracks.pixels[~inside, k]))
        eyes, _ = rays(sequence, side, np.where(lost, 0.0, tau), pixels)
        hidden = hit(eyes, tracks.points - eyes) < 1 - 1e-5
        seen = np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE)
        right.append(tracks.classes[:, k] == np.where(inside, seen, PixelClass.OUT_OF_VIEW))
    assert np.mean(right) >= 0.999
    assert np.all(np.bincount(tracks.classes.ravel(), minlength=4)[1:] >= 50)


def test_affine_frames_are_of_the_triangles_that_rays_hit(any_sequence: Sequence, triangles: Array) -> None:
    """test_affine.py compares the derivatives with rays."""
    sequence = any_sequence
    affine, tracks, own = sequence.affine(), sequence.tracks(), np.arange(2048)
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    upright = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    off = np.abs(np.einsum("nkj,kj->nk", tracks.points[:, None] - triangles[:, 0], upright))
    along = np.abs(affine.normals @ upright.T)
    assert np.mean(np.any((off < 1e-4) & (along > 1 - 1e-6), axis=1)) >= 0.999
    made = jacobians_of(sequence, tracks, affine.normals)
    assert np.array_equal(affine.jacobians, made, equal_nan=True)
    assert np.array_equal(np.isfinite(made).all(axis=(2, 3)), np.isfinite(tracks.tau)) and np.all(
        made[own, tracks.sources] == np.eye(2)
    )


def test_matches_are_labelled_as_rays_say(any_sequence: Sequence, triangles: Array) -> None:
    """Between pixels: depth to the rounding of rays to float32, rows by bisection, what is hidden by rays."""
    sequence, hit = any_sequence, partial(first_hit, triangles)
    matches, seen = sequence.matches(), list[NDArray[np.int_]]()
    for k, ((side, frame), (other, later)) in enumerate(MATCHED.values()):
        pixels, depth, place, error, classes = matches.of_pair(k)
        origins, ways = rays(sequence, side, line_times(sequence, side, frame, pixels[:, 0, 1]), pixels[:, 0])
        z = hit(origins, ways)
        solid = np.isfinite(z)
        assert np.array_equal(solid, depth > 0) and np.all(solid == (classes != MatchClass.NO_SURFACE))
        np.testing.assert_allclose(depth[solid], z[solid], rtol=1e-6)
        X = origins + ways * np.where(solid, z, 1e8)[:, None]
        tau = line_times(sequence, other, later, row_seeing(sequence, other, later, X))
        inside = np.isfinite(tau)
        tau = np.where(inside, tau, 0.0)
        truth = look(sequence, other, tau, X)
        inside &= within(sequence, other, truth)
        # 1e-6 of the depth moves what is nearest, 3 m away, by 6e-6 px.
        np.testing.assert_allclose(place[inside], truth[inside], rtol=0, atol=1e-4)
        assert np.all(np.isnan(place[~inside])) and np.all(np.isnan(error[~inside]))
        distance = np.linalg.norm(pixels[:, 1] - truth, axis=1)
        np.testing.assert_allclose(error[inside], distance[inside], rtol=0, atol=1e-4)
        eyes, _ = rays(sequence, other, tau, truth)
        hidden = hit(eyes, X - eyes) < 1 - 1e-5
        kinds = [~solid, ~inside, hidden, distance <= 3.0]
        names = (MatchClass.NO_SURFACE, MatchClass.OUT_OF_VIEW, MatchClass.OCCLUDED, MatchClass.RIGHT)
        assert np.array_equal(classes, np.select(kinds, names, MatchClass.WRONG))
        seen.append(np.bincount(classes, minlength=6))
    assert np.all(np.sum(seen, axis=0)[[1, 2, 4]] >= ([20, 2, 2] if sequence.rig.aligned else [10, 0, 1]))


def test_matches_are_those_that_a_solver_is_given(sequence: Sequence) -> None:
    matches = sequence.matches()
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    found = find_matches_of_rig(
        images, sequence.rig, sequence.shutter.scanning, CorrectionOptions(features=load_features("sift"))
    )
    given, tracks = matches.correspondences(), matches.tracks
    assert np.array_equal(given.tracks, found.tracks) and len(found.tracks) >= 3
    for name in MATCHED:
        rows, other = (np.unique(getattr(each, name), axis=0) for each in (given, found))
        assert np.array_equal(rows, other) and len(rows) == len(getattr(given, name))
    kept = matches.correspondences((matches.classes == MatchClass.RIGHT) & (tracks != 1))
    assert len(kept.left) == np.sum((matches.classes == 1) & (tracks != 1) & (matches.sets == 0))
    assert len(kept.tracks) < len(given.tracks) and not np.any(np.all(kept.tracks == given.tracks[1], axis=1))
    assert sequence.matcher()["versions"]["opencv"] == cv2.__version__


def test_linear_images_are_the_images_before_rounding(any_sequence: Sequence) -> None:
    """Half floats err by 2^-12 of a value, by 0.03 codes: where one shade fills a picture, all of it may."""
    for side, frame in VIEWS:
        light, codes = any_sequence.radiance(side, frame), any_sequence.clean_image(side, frame)
        shades = [to_srgb8(light * np.float32(factor), 0.8).astype(int) for factor in (1 - 2**-11, 1 + 2**-11)]
        assert np.all((shades[0] <= codes) & (codes <= shades[1])) and np.max(shades[1] - shades[0]) <= 1


def test_rows_are_timed_in_nanoseconds(sequence: Sequence) -> None:
    """48 rows in 0.9 of 0.1 s: 1.875 ms each, exposed for 4 ms about their times."""
    camera = sequence.timing()["right"]
    assert camera["line_delay_ns"] == pytest.approx(1_875_000) and camera["readout_ns"] == pytest.approx(90e6)
    assert camera["exposure_ns"] == pytest.approx(4e6) and camera["reference_ns"] == pytest.approx([0, 1e8])
    for side, frame in VIEWS:
        table = sequence.row_times_ns(side, frame)
        assert np.array_equal(table[:, 1], 100_000_000 * frame + 1_875_000 * np.arange(48))
        assert np.all(table[:, 2] + 2_000_000 == table[:, 1]) and np.all(table[:, 1] + 2_000_000 == table[:, 3])


def test_lines_of_each_camera_of_a_rig_have_its_own_times(any_sequence: Sequence) -> None:
    for side, frame in VIEWS:
        lines = np.arange(any_sequence.rig.sensor(side).height, dtype=np.float64)
        wanted = 1e8 * line_times(any_sequence, side, frame, lines)
        assert np.max(np.abs(any_sequence.row_times_ns(side, frame)[:, 1] - wanted)) <= 0.5


def test_a_sequence_without_channels_has_none(yard: Path, tmp_path: Path) -> None:
    card = yard_card(yard.parent)
    generate_dataset(card, tmp_path / "data")
    (plain,), (full,) = read_dataset(tmp_path / "data"), read_dataset(yard)
    assert "channels" not in plain.manifest and not (plain.folder / "flow").exists()
    with pytest.raises(RsbenchError, match="has no channel 'flow'"):
        plain.offsets("flow", "left", 0)
    own = plain.manifest["files"]
    assert own == {name: digest for name, digest in full.manifest["files"].items() if name in own}
    for folder, other in ((tmp_path / "data", yard_card(yard.parent, channels=("flow",))), (yard, card)):
        with pytest.raises(RsbenchError, match="differs in channels"):
            generate_dataset(other, folder)


def test_an_unknown_channel_is_passed_over(yard: Path, tmp_path: Path) -> None:
    """A dataset of a later version."""
    from rsbench.dataset.sequence import read_sequence
    from rsbench.storage.files import read_json, write_json

    folder = tmp_path / "yard"
    folder.mkdir()
    write_json(folder / "sequence.json", read_json(yard / "yard/sequence.json") | {"channels": ["flow", "smell"]})
    assert read_sequence(folder).channels == ("flow", "smell")


def test_names_of_channels_are_checked() -> None:
    assert named_channels("all") == CHANNELS and named_channels("none") == ()
    assert named_channels("flow, disparity") == ("flow", "disparity")
    for text in ("", "smell", "flow,flow", "flow,"):
        with pytest.raises(RsbenchError, match="allowed are disparity, flow"):
            named_channels(text)
    card = asdict(yard_card(Path()))
    with pytest.raises(RsbenchError, match=r"channels\.0 = 'smell'"):
        parse_card(DatasetCard, card | {"channels": ["smell"]}, "mine.toml")
    with pytest.raises(RsbenchError, match="must differ"):
        parse_card(DatasetCard, card | {"channels": ["flow", "flow"]}, "mine.toml")


def test_twins_that_cannot_be_are_refused(tmp_path: Path) -> None:
    for twins in ((48,), (-1,), ("half",)):
        with pytest.raises(RsbenchError, match="twins"):
            parse_card(DatasetCard, asdict(yard_card(tmp_path)) | {"twins": list(twins)}, "mine.toml")
    card = yard_card(tmp_path, twins=("first", "last", "middle", 24))
    assert card.twins_of(card.sequence[0]) == (24, 47)


# Verification


def test_sound_channels_pass(yard: Path) -> None:
    (report,) = verify_dataset(yard, rerender="all", scenes=[yard.parent / "yard.toml"])
    assert report.faults == () and "the same bits" in report.notes[0]


@pytest.mark.parametrize("names", rounds(), ids=lambda names: names[0])
def test_planted_faults_are_named(yard: Path, tmp_path: Path, names: list[str]) -> None:
    data = spoilt(yard, tmp_path / "data", *(FAULTS[name][0] for name in names), sequence="yard")
    again: Rerender = "all" if any("new computation" in FAULTS[name][1] for name in names) else "no"
    (report,) = verify_dataset(data, rerender=again, scenes=[yard.parent / "yard.toml"])
    assert [name for name in names if not named(report.faults, FAULTS[name][1])] == [], report.faults


def test_a_map_that_others_contradict_is_acquitted_when_it_is_what_rays_meet(yard: Path) -> None:
    """The accused is rendered again, all of it; who else is wrong is then found without it."""
    sequence = read_sequence(yard / "yard")
    content, again = read_content(sequence, ()), Rerenderer("auto", [yard.parent / "yard.toml"])
    one, other = ImageView("rs", "left", 0), ImageView("gs", "left", 0)
    assert all(again.depth_is_rendered(content, view) for view in content.maps)
    assert not Rerenderer("auto").depth_is_rendered(content, one), "a scene that is not known acquits nobody"
    depth = content.maps[other].depth.copy()
    depth[20:30] *= 1.0005
    content.maps[other] = replace(content.maps[other], depth=depth)
    assert again.depth_is_rendered(content, one) and not again.depth_is_rendered(content, other)
    compared = Comparison(content, 1)
    assert len(list(compared.pairs())) > 0
    wrong = list(compared.faults(lambda view: iter(()), partial(again.depth_is_rendered, content)))
    assert any(fault.file == "gs_depth/left_0.exr" for fault in wrong)
    # Whoever is acquitted is not named, and not believed to be wrong.
    assert not [
        fault for fault in compared.faults(lambda view: iter(()), lambda view: True) if "_depth/" in str(fault)
    ]
    assert any("it equals a new rendering" in note for note in compared.notes)


def test_channels_that_depth_contradicts_are_cleared_when_they_are_what_rays_make(
    yard: Path, tmp_path: Path
) -> None:
    """All of a file, bit for bit: one pixel that is not is enough to leave it accused."""
    accused = {"flow/right_1.exr", "gs_flow_mask/left_0.png", "normals/left_1.exr", TRACKS, matches_file(0)}
    again = Rerenderer("auto", [yard.parent / "yard.toml"])
    assert again.cleared(read_content(read_sequence(yard / "yard"), ()), accused) == accused
    shutil.copytree(yard / "yard", tmp_path / "yard")
    mask = read_grey_png(tmp_path / "yard/gs_flow_mask/left_0.png").copy()
    mask[11, 7] = 2 if mask[11, 7] != 2 else 1
    write_png(tmp_path / "yard/gs_flow_mask/left_0.png", mask)
    content = read_content(read_sequence(tmp_path / "yard"), ())
    assert again.cleared(content, accused) == accused - {"gs_flow_mask/left_0.png"}
    assert Rerenderer("auto").cleared(content, accused) == set(), "a scene that is not known clears nothing"
