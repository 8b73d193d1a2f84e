"""Evaluations and corrections with matchers that need the motion, ours and another package's."""

from __future__ import annotations

from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np
import pytest
from evaluations import evaluate

from rsbench.benchmark.images.evaluation import read_scores
from rsbench.capture.calibration import offset_error
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.plugins import wrap
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.storage.files import read_json
from rsbench.vision.corrector import CORRECTORS, CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import load_matcher

LEVEL = """
from dataclasses import dataclass
import numpy as np
from rsbench.vision.stereo_matcher import MotionMatcher


@dataclass(frozen=True)
class Level(MotionMatcher):
    '''As deep as the rig goes forward in a period.'''

    def depths(self, images, rig, shutter, motion):
        print("this must not reach standard output")
        return {view: np.full(image.shape[:2], 30.0 * np.linalg.norm(motion.d)) for view, image in images.items()}
"""


def test_depth_is_found_with_the_motion_of_the_solver_and_scored(smoke_dataset: Path, tmp_path: Path) -> None:
    evaluate(smoke_dataset, tmp_path, matcher="sweep-time", only=("castle",))
    depth = read_scores(tmp_path, "depth")
    everywhere = depth[depth["pixels"] == "all"]
    assert np.all(depth["success"]) and len(everywhere) == 4
    # One camera, 128 x 96 px: 4 of 5 pixels have a depth, most of them to 2 px.
    assert np.all(everywhere["coverage"] > 0.6) and np.all(everywhere["bad_2px"] < 0.3)
    correction = read_scores(tmp_path, "correction")
    rows = correction[(correction["matcher"] == "sweep-time") & (correction["pixels"] == "visible")]
    assert set(rows["solver"]) == {"rs-stereo-refined", "true"} and np.all(rows["success"])
    before = correction[(correction["corrector"] == "none") & (correction["pixels"] == "visible")]["psnr"].mean()
    assert rows["psnr"].mean() > before + 3.0


@pytest.mark.slow
def test_another_packages_matcher_gets_the_motion_in_a_process_of_its_own(
    smoke_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "level_motion_matcher.py").write_text(LEVEL)
    card = tmp_path / "level.toml"
    card.write_text('class = "level_motion_matcher:Level"\n')
    evaluate(smoke_dataset, tmp_path / "out", matcher=str(card), only=("castle",))
    depth = read_scores(tmp_path / "out", "depth")
    sequence = next(s for s in read_dataset(smoke_dataset) if s.name == "castle")
    truth = sequence.depth("rs", "left", 0)
    row = depth[(depth["pixels"] == "all") & (depth["side"] == "left") & (depth["frame"] == 0)].iloc[0]
    record = read_json(tmp_path / "out/predictions/castle/motion/rs-stereo-refined.json")
    off = np.median(np.abs(truth[truth > 0.0] - 30.0 * np.linalg.norm(record["d"])))
    # Disparities are float32, scores have six digits.
    assert row["coverage"] == 1.0 and row["median_m"] == pytest.approx(off, rel=1e-4)
    assert "must not reach" not in capfd.readouterr().out


class _Still(Corrector):
    spec = CorrectorSpec(needs={"depth"}, reference="none", assumes="a rig at rest")

    def correct(self, problem: CorrectionProblem, views: Many[View]) -> dict[View, Fused]:
        raise NotImplementedError


def test_without_a_motion_the_matcher_is_refused_by_name(smoke_dataset: Path) -> None:
    sequence = read_dataset(smoke_dataset)[0]
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    options = CorrectionOptions(matcher=load_matcher("sweep"), corrector=wrap(CORRECTORS, _Still()))
    with pytest.raises(RsbenchError, match="matcher 'sweep': needs the rig's motion, and corrector"):
        correct_four(images, sequence.rig, KnownInputs(readout_ratio=0.8), options)
    options = CorrectionOptions(matcher=load_matcher("sweep"))
    with pytest.raises(RsbenchError, match=r"disparity_offset = 0\.5: must be 0 with matcher 'sweep'"):
        correct_four(images, sequence.rig, KnownInputs(readout_ratio=0.8, calibration=offset_error(0.5)), options)


def test_the_true_motion_gives_depth_in_each_lines_own_camera(smoke_dataset: Path) -> None:
    sequence = read_dataset(smoke_dataset)[0]
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    options = CorrectionOptions(matcher=load_matcher("sweep"), find_sky=False, depth_from_motion=False)
    given = Given(motion=sequence.motion)
    found = correct_four(images, sequence.rig, KnownInputs(readout_ratio=0.8), options, given=given, views=())
    assert found.pairs is not None and all(pair.timed for pair in found.pairs)
    for side, frame in VIEWS:
        depth, truth = found.pairs[frame].depth[side], sequence.depth("rs", side, frame)
        known = np.isfinite(depth) & (depth > 0.0) & (truth > 0.0)
        off = np.abs(sequence.rig.disparity(depth[known]) - sequence.rig.disparity(truth[known]))
        assert np.mean(known) > 0.6 and np.median(off) < 0.2
