"""Sequences of more than two frames: motions that go on, what verify says of later frames, and their pairs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic_dataset import PLANES, add_channels, card_of, write_analytic_dataset
from attack.planting import copied, exchanged, named, rehash, spoilt
from channel_faults import image_of, mask_of, scaled, values_of
from numpy.typing import NDArray
from yard_dataset import boxes_card

from rsbench.benchmark.images.evaluation import open_evaluation
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.projection import back_project, rs_project
from rsbench.core.rig import FRAMES, SIDES, StereoRig, views_of
from rsbench.core.se3 import compose, inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.card import DatasetCard, MotionCard
from rsbench.dataset.channels import CHANNELS, STEP_PX, Layer, channel_files, pair_layers, write_channels
from rsbench.dataset.sequence import files_of, is_of_sequence, read_dataset, read_pairs
from rsbench.dataset.views import ImageView
from rsbench.renderers.image import Sensor
from rsbench.renderers.render import Frame
from rsbench.renderers.visibility import Surfaces
from rsbench.storage.files import background_writer
from rsbench.verification import verification_steps, verify_dataset

RIG = StereoRig(camera=PinholeCamera.centred(64, 54, 74.0), baseline=0.3)
SHUTTER = RollingShutter(height=54, readout_ratio=0.9)
MOTION = AcceleratedMotion([0.02, -0.03, 0.01], [0.1, -0.05, 0.2], acceleration=0.1)
COUNT = 4
MOTIONS: list[Motion] = [
    LinearMotion([0.1, -0.2, 0.05], [0.3, 0.1, -0.2]),
    TwistMotion([0.1, -0.2, 0.05], [0.3, 0.1, -0.2]),
    MOTION,
    SplineMotion([0.02, -0.03, 0.01], [0.1, -0.05, 0.2], preset="drone", seed=3, periods=6.0),
]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of two planes, in closed form."""
    out = tmp_path_factory.mktemp("frames")
    write_analytic_dataset(out, RIG, SHUTTER, MOTION, frames=COUNT)
    return out


def faults_of(folder: Path) -> tuple[str, ...]:
    return verify_dataset(folder, 3)[-1].faults


def test_a_sound_sequence_has_no_faults_and_every_pair_is_compared(sound: Path) -> None:
    steps: list[str] = []
    (report,) = verify_dataset(sound, progress=steps.append)
    assert report.faults == ()
    # Of each frame its shutters and its cameras, of successive frames all four kinds of pictures; both ways.
    assert len({(each.source, each.target) for each in report.agreements}) == 8 * COUNT + 8 * (COUNT - 1)
    assert all(each.share == 1.0 for each in report.agreements)
    assert len(steps) == verification_steps(json.loads((sound / "dataset.json").read_text()))


def all_of(one: int, other: int) -> list[tuple[str, str]]:
    kinds = (("rs", "png"), ("gs", "png"), ("rs_depth", "exr"), ("gs_depth", "exr"))
    return [
        (f"{kind}/{side}_{one}.{end}", f"{kind}/{side}_{other}.{end}") for kind, end in kinds for side in SIDES
    ]


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "all pictures of frames 1 and 2 exchanged": (exchanged(*all_of(1, 2)), ("left_2.exr", "looks like frame 1")),
    "depth maps of frames 1 and 3 exchanged": (
        exchanged(("rs_depth/left_1.exr", "rs_depth/left_3.exr")),
        ("rs_depth/left_3.exr", "looks like rs_depth/left_1.exr"),
    ),
    "images of frames 2 and 3 exchanged": (
        exchanged(("gs/right_2.png", "gs/right_3.png")),
        ("gs/right_2.png", "looks like gs/right_3.png"),
    ),
    "an image of frame 2 shifted": (
        image_of("rs/left_2.png", lambda image: np.roll(image, 1, axis=0)),
        ("rs/left_2.png", "shifted by one row"),
    ),
    "a depth map of frame 3 scaled": (
        values_of("rs_depth/left_3.exr", scaled(1.002)),
        ("rs_depth/left_3.exr", "scaled by 1.002"),
    ),
    "poses of frame 3 in frame 2": (
        copied("poses/right_3.csv", "poses/right_2.csv"),
        ("poses/right_2.csv", "looks like the poses of right_3"),
    ),
    "a missing frame": (lambda folder: (folder / "rs/right_2.png").unlink(), ("rs/right_2.png", "missing")),
    "flow back negated": (
        values_of("flow_back/left_1.exr", np.negative),
        ("flow_back/left_1.exr", "looks negated"),
    ),
    "flow back and forth exchanged": (
        exchanged(("flow_back/right_2.exr", "flow/right_2.exr")),
        ("flow_back/right_2.exr", "differ from what depth and motion make"),
    ),
    "flow of frame 1 in frame 2": (
        exchanged(("flow/left_1.exr", "flow/left_2.exr"), ("flow_mask/left_1.png", "flow_mask/left_2.png")),
        ("flow/left_2.exr", "differ from what depth and motion make"),
    ),
    "a mask of frame 2 upside down": (
        mask_of("flow_back_mask/left_2.png", np.flipud),
        ("flow_back_mask/left_2.png", "in or out of view"),
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_named(flowing: Path, tmp_path: Path, name: str) -> None:
    plant, words = FAULTS[name]
    fit = name != "a missing frame"
    faults = faults_of(spoilt(flowing, tmp_path / "data", plant, sequence="planes", fit=fit))
    assert named(faults, words), faults
    assert not any(fault.startswith(("sequence.json", "rs_depth/left_0", "gs/left_0")) for fault in faults), faults


def test_the_depth_of_another_motion_is_told_once(tmp_path: Path) -> None:
    wrong = AcceleratedMotion(MOTION.w, 1.02 * MOTION.d, acceleration=0.1)
    write_analytic_dataset(tmp_path, RIG, SHUTTER, MOTION, true_motion=wrong, frames=3)
    found = [fault for fault in faults_of(tmp_path) if "pairs of depth maps disagree" in fault]
    assert len(found) == 1 and "in 2 of 2 pairs of frames" in found[0] and "look at motion" in found[0]


def test_a_sequence_of_fewer_frames_than_its_card_says_is_told(sound: Path, tmp_path: Path) -> None:
    shutil.copytree(sound, tmp_path / "data")
    path = tmp_path / "data/planes/sequence.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"frames": 3}))
    rehash(tmp_path / "data")
    assert any("frames = 3, the card in dataset.json makes 4" in fault for fault in faults_of(tmp_path / "data"))


# Pairs


def test_pairs_see_the_planes_where_they_are(sound: Path) -> None:
    """Seen from a pair's own world, the planes are those of the sequence, moved as the body was."""
    pairs = read_pairs(sound)
    assert [pair.name for pair in pairs] == ["planes.0", "planes.1", "planes.2"]
    (whole,) = read_dataset(sound)
    assert len(whole.images()) == 2 * COUNT
    for first, pair in enumerate(pairs):
        assert (pair.frames, pair.whole) == (2, "planes")
        world = inverse(MOTION.body_from_world(float(first)))
        for side, frame in views_of(2):
            np.testing.assert_array_equal(pair.image("rs", side, frame), whole.image("rs", side, first + frame))
            tau, poses = pair.poses(side, frame)
            expected = RIG.cam_from_world(pair.motion, SHUTTER.line_times(frame, side), side)
            np.testing.assert_allclose(tau, SHUTTER.line_times(frame, side), rtol=0, atol=1e-14)
            np.testing.assert_allclose(poses.R, expected.R, rtol=0, atol=1e-13)
            np.testing.assert_allclose(poses.t, expected.t, rtol=0, atol=1e-13)
            depth, grid = pair.depth("rs", side, frame), RIG.camera.pixel_grid()
            X = transform(world, back_project(pair.rig, pair.shutter, pair.motion, side, frame, grid, depth))
            off = np.min([np.abs(X @ normal - offset) for normal, offset in PLANES], axis=0)
            assert np.max(off) < 1e-5  # float32 depth up to 20 m
        assert [path.name for path in pair.frame_files(("rs",))] == [
            f"{side}_{first + frame}.png" for side in SIDES for frame in FRAMES
        ]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_a_motion_from_a_later_time_on_is_the_same_way(motion: Motion) -> None:
    tau, start, step = np.linspace(-0.173, 2.127, 12), 2.0, 1e-5  # between the knots of splines
    moved = motion.from_time(start)
    expected = compose(motion.body_from_world(tau + start), inverse(motion.body_from_world(start)))
    for found, true in zip(moved.body_from_world(tau), expected, strict=True):
        np.testing.assert_allclose(found, true, rtol=0, atol=1e-13)
    _, t = moved.body_from_world(1.0)
    np.testing.assert_allclose(t, moved.d, rtol=0, atol=1e-13)
    before, after = (moved.body_from_world(tau + by) for by in (-step, step))
    w, speed = moved.velocity(tau)
    # Central differences err by the square of the step, and by rounding over it.
    np.testing.assert_allclose((after.t - before.t) / (2 * step), speed, rtol=0, atol=1e-8)
    turned = (after.R @ np.swapaxes(before.R, 1, 2) - before.R @ np.swapaxes(after.R, 1, 2)) / (4 * step)
    np.testing.assert_allclose(turned[:, [2, 0, 1], [1, 2, 0]], w, rtol=0, atol=1e-8)
    rates = [moved.velocity(tau + by) for by in (-step, step)]
    for found, (low, high) in zip(moved.accelerations(tau), zip(*rates, strict=True), strict=True):
        np.testing.assert_allclose((high - low) / (2 * step), found, rtol=0, atol=1e-6)
    bounds = moved.fastest(0.0, 2.0)
    if bounds is not None and isinstance(moved, LaterMotion):
        inside = moved.velocity(np.linspace(0.0, 2.0, 50))
        assert all(np.max(np.linalg.norm(v, axis=1)) <= b + 1e-12 for v, b in zip(inside, bounds, strict=True))


# Flow


@pytest.fixture(scope="module")
def flowing(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with the channel ``flow``; the planes hide nothing of each other."""
    out = tmp_path_factory.mktemp("flow") / "data"
    shutil.copytree(sound, out)
    (whole,) = read_dataset(out)

    def write(folder: Path) -> None:
        for view in views_of(COUNT):
            image, labels = np.zeros((54, 64, 3), np.float32), np.zeros((54, 64), np.uint8)
            gloss = np.zeros(labels.shape, np.bool_)
            seen = Frame(image=image, depth=whole.depth("rs", *view), labels=labels, gloss=gloss)
            with background_writer() as later:
                write_channels(folder, ["flow"], whole, ImageView("rs", *view), seen, Open(), later)

    add_channels(out, replace(card_of(RIG, SHUTTER, MOTION, COUNT), channels=("flow",)), write)
    return out


class Open:
    """Rays that meet nothing."""

    def blocked(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> NDArray[np.bool_]:
        return np.zeros(len(points), dtype=np.bool_)

    def surfaces(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> Surfaces:
        raise NotImplementedError


def test_flow_leads_to_both_neighbours_in_time(flowing: Path) -> None:
    """Against the row equation, solved by another way; and of a pair, the flow between its two frames."""
    assert faults_of(flowing) == ()
    (whole,), grid = read_dataset(flowing), RIG.camera.pixel_grid()
    for side, frame in views_of(COUNT):
        depth = whole.depth("rs", side, frame)
        X = back_project(RIG, SHUTTER, MOTION, side, frame, grid, depth)
        for target in (frame - 1, frame + 1):
            if not 0 <= target < COUNT:
                continue
            back = target < frame
            flow = whole.offsets("flow", side, frame, back=back)
            expected = rs_project(RIG, SHUTTER, MOTION, side, target, X).pixels - grid
            both = np.isfinite(flow[..., 0]) & np.isfinite(expected[..., 0])
            assert np.mean(both) > 0.5
            assert np.max(np.abs(flow - expected)[both]) < 1.1 * STEP_PX  # half a step of rounding, float32 depth
            pair = whole.pairs()[min(frame, target)]
            np.testing.assert_array_equal(pair.offsets("flow", side, int(back)), flow)
            np.testing.assert_array_equal(
                pair.classes("flow", side, int(back)), whole.classes("flow", side, frame, back=back)
            )
    with pytest.raises(RsbenchError, match="flow of frame 0 leads to no frame before"):
        whole.offsets("flow", "left", 0, back=True)


# Names and cards


def test_channels_name_the_files_of_all_frames() -> None:
    names = channel_files(["flow", "matches", "timing"], (), 4)
    back = [name for name in names if name.startswith("flow_back/")]
    assert back == [f"flow_back/{side}_{frame}.exr" for side in SIDES for frame in (1, 2)]
    assert {f"matches/{k}.npz" for k in range(3)} < {*names} and "timing/right_3.csv" in names
    assert [layer for layer in pair_layers(["flow"], ())] == [Layer("flow")]
    every = files_of({"frames": 12, "channels": list(CHANNELS), "sensor": {}, "twins": [7]})
    assert all(map(is_of_sequence, every)) and len(every) == len({*every})
    for stranger in (
        "rs/left_01.png",
        "rs/left_0_1.png",
        "flow_back/left_1.png",
        "matches/00.npz",
        "gs_back/left_1.exr",
    ):
        assert not is_of_sequence(stranger)


def card(**fields: object) -> DatasetCard:
    motion = MotionCard(
        model="spline", rotation_deg=1.0, rotation_axis=(0, 1, 0), translation=0.1, translation_axis=(1, 0, 0)
    )
    return boxes_card("castle", **({"readout_ratio": 0.5, "motion": motion} | fields))


def test_a_card_lets_the_shake_last_as_long_as_its_frames() -> None:
    two, nine = card().expanded(), card(frames=9).expanded()
    short, long = (each.motion_of(each.sequence[0]) for each in (two, nine))
    assert long.lasts >= 8.5 > short.lasts
    assert "frames" not in two.manifest_of(two.sequence[0])
    manifest = nine.manifest_of(nine.sequence[0])
    assert (manifest["frames"], manifest["conventions"]) == (9, 3)
    np.testing.assert_allclose(short.body_from_world(1.5).t, long.body_from_world(1.5).t, rtol=0, atol=1e-12)


def test_what_does_not_fit_many_frames_is_refused() -> None:
    with pytest.raises(ValueError, match="frames = 1: must lie in"):
        card(frames=1)
    with pytest.raises(ValueError, match="brightness has 2 values: one for each of 3 frames"):
        card(frames=3, sensor=Sensor(brightness=(1.0, 0.5)))
    assert card(frames=3, sensor=Sensor(brightness=(1.0, 0.5, 0.7))).sensor is not None
    given = {"interval": 0.5, "shake": np.zeros((7, 6)).tolist()}
    short = card().motion
    assert short is not None
    with pytest.raises(ValueError, match=r"lasts 2 frame periods; 4 frames need 3\.5"):
        card(frames=4, motion=replace(short, parameters=given)).expanded()


def test_an_evaluation_is_of_all_pairs_and_only_takes_their_sequence(sound: Path, tmp_path: Path) -> None:
    every = {"planes.0", "planes.1", "planes.2"}
    for only, chosen in (((), every), (("planes",), every), (("planes.1",), {"planes.1"})):
        options = EvaluationOptions(solvers=("gs-8pt",), only=only)
        evaluation = open_evaluation(sound, tmp_path / "out", options)
        assert {sequence.name for sequence in evaluation.sequences} == every
        assert evaluation.plan.sequence_names == chosen
    with pytest.raises(RsbenchError, match=r"--only planes\.3: is neither a sequence nor a solver"):
        open_evaluation(sound, tmp_path / "out", EvaluationOptions(solvers=("gs-8pt",), only=("planes.3",)))


def test_two_things_of_one_name_are_refused(sound: Path, tmp_path: Path) -> None:
    shutil.copytree(sound, tmp_path / "data")
    folder = tmp_path / "data"
    shutil.copytree(folder / "planes", folder / "planes.1")
    own = json.loads((folder / "planes.1/sequence.json").read_text()) | {"name": "planes.1", "frames": 2}
    (folder / "planes.1/sequence.json").write_text(json.dumps(own | {"conventions": 1}))
    manifest = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(manifest | {"sequences": ["planes", "planes.1"]}))
    with pytest.raises(RsbenchError, match=r"'planes\.1' is a sequence and a pair of frames of another"):
        read_pairs(folder)
