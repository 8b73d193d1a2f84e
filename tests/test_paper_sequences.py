"""What the product promises on the paper's own setting, in every built-in scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rsbench.benchmark.images.evaluation import open_evaluation, read_scores
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.components.cards import load_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.projection import row_poses
from rsbench.core.se3 import Pose
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.renderers import scene as renderer_scene
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.scenes.model import Scene
from rsbench.verification import verify_dataset

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
SCENES = ("castle", "room")


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory, scenes_once: None) -> Path:
    """Two of the paper's sequences, smaller, of 4 samples a pixel; ``rsbench reproduce images`` has the whole."""
    folder = tmp_path_factory.mktemp("paper") / "paper"
    card = load_dataset_card("paper").only(list(SCENES))
    camera = replace(card.camera, width=360, height=360, focal=card.camera.focal * 360 / card.camera.width)
    generate_dataset(replace(card, camera=camera, renderer="preview"), folder)
    return folder


@pytest.fixture(scope="module")
def scores(paper: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, pd.DataFrame]:
    out = tmp_path_factory.mktemp("evaluation")
    options = EvaluationOptions(solvers=("rs-stereo-refined",))
    open_evaluation(paper, out, options).run("test", lambda name: None)
    return {table: read_scores(out, table).set_index("sequence") for table in ("pose", "correction")}


def test_depth_of_all_frames_agrees(paper: Path) -> None:
    for report in verify_dataset(paper, stride=8, rerender="no"):
        assert report.faults == ()
        assert all(agreement.p99 < 1e-4 for agreement in report.agreements)


@pytest.mark.parametrize("scene", SCENES)
def test_refined_motion_is_accurate(scores: dict[str, pd.DataFrame], scene: str) -> None:
    pose = scores["pose"].loc[scene]
    assert pose.e_R_deg < 0.02
    assert pose.e_T_deg < 0.5
    assert pose.e_s < 0.02


@pytest.mark.parametrize("scene", SCENES)
def test_correction_loses_little_to_true_motion_and_gains_much_over_none(
    scores: dict[str, pd.DataFrame], scene: str
) -> None:
    rows = scores["correction"].loc[scene]
    visible = rows[rows.pixels == "visible"]
    sgm = visible[visible.matcher == "sgm"].groupby("solver").psnr.mean()
    assert sgm["rs-stereo-refined"] > sgm["true"] - 0.5
    estimated = visible[(visible.matcher == "sgm") & (visible.solver == "rs-stereo-refined")]
    uncorrected = visible[visible.corrector == "none"]
    assert len(estimated) == len(uncorrected) == 4
    assert np.all(estimated.psnr.to_numpy() > uncorrected.psnr.to_numpy() + 6.0)


Shot = tuple[renderer_scene.MitsubaScene, PinholeCamera, Pose]


@pytest.fixture(scope="module", params=[("castle", "sunsky"), ("room", "path")])
def shot(
    request: pytest.FixtureRequest,
    built_scene: Callable[[str], Scene],
    scenes_once: None,
    give_back: Callable[[], None],
) -> tuple[Shot, str]:
    """A scene, the rows of its second right frame, an integrator; of module scope: one scene before the next."""
    give_back()
    name, integrator = request.param
    card = load_dataset_card("paper")
    (sequence,) = card.only([name]).sequence
    scene = built_scene(sequence.scene)
    rig = card.rig_of(sequence)
    poses = row_poses(rig, card.shutter_for(sequence), card.motion_of(sequence), "right", 1)
    seen = scene.seen_from(scene.viewpoints[sequence.viewpoint])
    return (renderer_scene.MitsubaScene(seen), rig.camera, poses), integrator


def test_single_pass_equals_stitched_on_the_paper_frame(shot: tuple[Shot, str]) -> None:
    (scene, camera, poses), integrator = shot
    preset = "default" if integrator == "sunsky" else "path"
    options = replace(load_card(RendererOptions, "renderers", preset), samples=1 if integrator == "path" else 4)
    rows = np.linspace(0, 899, 20).astype(int).tolist()
    geometry = scene, camera, LinePoses(*poses)
    whole = render(*geometry, replace(options, method="single-pass"))
    stitched = render(*geometry, replace(options, method="stitched"), rows=rows)
    np.testing.assert_array_equal(whole.image[rows], stitched.image)
    np.testing.assert_array_equal(whole.depth[rows], stitched.depth)
    assert np.std(stitched.image) > 0.01, "a black frame proves nothing"
