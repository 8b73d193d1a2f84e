"""``rsbench correct`` with a matcher, features and a corrector that are not its own."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here
from small_scenes import write_rig

from rsbench.core.projection import rs_project
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence
from rsbench.storage.files import read_depth, read_png

ORDER = ("left_0", "right_0", "left_1", "right_1")
DISPARITY = 5.0

MATCHER = f"""
from dataclasses import dataclass
import numpy as np
from rsbench.vision.stereo_matcher import StereoMatcher

@dataclass(frozen=True)
class Flat(StereoMatcher):
    '''Everything at one depth.'''
    disparity: float = {DISPARITY}

    def disparities(self, left, right, rig):
        print("a matcher may print what it likes")
        assert left.dtype == np.uint8
        flat = np.full(left.shape[:2], self.disparity)
        return flat, flat
"""
FEATURES = """
from pathlib import Path
import numpy as np
from rsbench.core.correspondences import Correspondences
from rsbench.vision.feature_matcher import FeatureMatcher

class Known(FeatureMatcher):
    '''Tracks from a file beside this one.'''

    def match(self, images):
        tracks = np.load(Path(__file__).with_name("tracks.npy"))
        return Correspondences(tracks=tracks)
"""
CORRECTOR = """
from dataclasses import dataclass
import numpy as np
from rsbench.vision.corrector import Corrector, CorrectorSpec
from rsbench.vision.fusion import Fused

@dataclass(frozen=True)
class Negative(Corrector):
    '''The frame as it is, in negative.'''
    wrong: bool = False
    spec = CorrectorSpec(needs={"motion", "depth"}, reference="this file", assumes="nothing")

    def correct(self, problem, views):
        out = {}
        for view in views:
            image = problem.images[view]
            seen = np.ones(image.shape[:2], bool)
            known = Fused.seen(255 - image, seen)
            out[view] = Fused(image=known.image[: 5 if self.wrong else None], origin=known.origin,
                              depth=problem.depth[view])
        return out
"""


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory, castle: Sequence) -> Path:
    """A folder with a file for each component, its card beside it, and the exact tracks of random points."""
    folder = tmp_path_factory.mktemp("strangers")
    for name, text, cls in (
        ("matcher", MATCHER, "Flat"),
        ("features", FEATURES, "Known"),
        ("corrector", CORRECTOR, "Negative"),
    ):
        (folder / f"strange_{name}.py").write_text(text)
        (folder / f"{name}.toml").write_text(f'class = "strange_{name}:{cls}"\n')
    points = np.random.default_rng(0).uniform((-2, -1.5, 6.0), (2, 1.5, 12.0), (400, 3))
    seen = [rs_project(castle.rig, castle.shutter, castle.motion, side, frame, points) for side, frame in VIEWS]
    size = np.array([castle.rig.camera.width, castle.rig.camera.height])
    left_0, left_1, right_0, right_1 = (each.pixels for each in seen)
    inside = np.all([(each.pixels > 0) & (each.pixels < size - 1) for each in seen], axis=(0, 2))
    tracks = np.concatenate([left_0, right_0, left_1, right_1], axis=1)[inside]
    assert len(tracks) > 50
    np.save(folder / "tracks.npy", tracks)
    return folder


def correct(castle: Sequence, tmp_path: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command on the castle's frames, into ``tmp_path / "out"``."""
    rig = write_rig(tmp_path / "rig.toml", castle.rig, castle.shutter.readout_ratio)
    frames = [castle.folder / "rs" / f"{name}.png" for name in ORDER]
    return run_here("correct", *frames, "--rig", rig, "--out", tmp_path / "out", *arguments)


def test_single_files_with_their_cards_beside_them(castle: Sequence, strangers: Path, tmp_path: Path) -> None:
    names = {"matcher": "matcher", "features": "features", "corrector": "corrector"}
    cards = [word for name in names for word in (f"--{name}", strangers / f"{name}.toml")]
    result = correct(castle, tmp_path, *cards, "--no-sky")
    assert result.returncode == 0, result.stderr
    assert "print what it likes" not in result.stdout
    out = tmp_path / "out"
    record = json.loads((out / "motion.json").read_text("utf-8"))
    # Exact tracks: the motion is known as well as the descent of the solver ends.
    np.testing.assert_allclose(record["motion"]["w"], castle.motion.w, atol=1e-6)
    np.testing.assert_allclose(record["motion"]["d"], castle.motion.d, atol=1e-5)
    assert record["motion"]["solver"] == "rs-stereo-refined"
    for name in ORDER:
        given = read_png(castle.folder / "rs" / f"{name}.png")
        np.testing.assert_array_equal(read_png(out / "corrected" / f"{name}.png"), 255 - given)
        depth = castle.rig.camera.fx * castle.rig.baseline / DISPARITY
        np.testing.assert_allclose(read_depth(out / "depth" / f"{name}.exr"), depth, rtol=1e-6)
    assert {name: record["components"][name]["name"] for name in names} == names


def test_a_component_that_answers_nonsense_is_one_line(castle: Sequence, strangers: Path, tmp_path: Path) -> None:
    card = strangers / "wrong.toml"
    card.write_text((strangers / "corrector.toml").read_text() + "[parameters]\nwrong = true\n")
    result = correct(castle, tmp_path, "--corrector", card)
    assert_refused(result, "corrector 'wrong': left 0: image must be uint8 (96, 128, 3), got uint8 (5, 128, 3)")
    assert not (tmp_path / "out").exists()


def test_a_solver_of_directions_alone_is_refused_with_the_remedy(castle: Sequence, tmp_path: Path) -> None:
    result = correct(castle, tmp_path, "--solver", "gs-8pt")
    assert result.returncode == 1, result.stderr
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("rsbench:")]
    assert "not corrected: solver 'gs-8pt'" in line and "metres" in line and "rs-stereo-refined" in line
    assert not (tmp_path / "out").exists()
