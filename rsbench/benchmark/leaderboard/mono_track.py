"""The track of corrected frames for methods that see one camera, beside those of a rig on the same frames.

What a corrector needs is found from the two frames of that camera alone, by dense flow: matches, and a motion
whose translation has no length. Correctors that need the depth of a rig run in the chain of ``correction``, and
their entries say that they use the other camera: what it is worth.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from rsbench.benchmark.leaderboard.correction_track import CorrectionTrack
from rsbench.benchmark.leaderboard.frame_inputs import bare_problems
from rsbench.benchmark.leaderboard.picture_running import CardChain, Making
from rsbench.benchmark.leaderboard.track import ORACLE
from rsbench.benchmark.leaderboard.true_pictures import VIEW
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, View
from rsbench.dataset.imu import MEASURED, gyro_samples
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.pipeline.chain import Given, correct_known_rows
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.mono_correction import find_own_motion, flow_matches, refusal
from rsbench.pipeline.problem import Problem
from rsbench.vision.corrector import CorrectorSpec
from rsbench.vision.fusion import Fused
from rsbench.vision.mono_fusion import find_flows

_SIDE = VIEW[0]
_LAST = {"key": "psnr_last", "title": "PSNR last", "hint": "of the last row's time, common pixels"}
_GYRO = "imu"
"""The channel that has its samples."""
_BESIDE = 1.0
"""Frame periods before the first frame and after the last one of which samples are given."""


class MonoCorrectionTrack(CorrectionTrack):
    """Rolling-shutter frames of one camera as a global shutter would have taken them."""

    name, id = "correction-mono", "correction-mono-1"
    title = "Corrected frames of one camera"
    allowed = (*CorrectionTrack.allowed, "gyro")
    given = "the four rolling-shutter frames; samples of a gyroscope where the dataset has the channel imu"
    rows = ("first", "middle", "last")
    scores = tuple(
        each
        for score in CorrectionTrack.scores
        for each in ((score, replace(score, **_LAST)) if score.key == "psnr_middle" else (score,))
    )
    smoke = ("mono-fusion", "flow-scaled", "zhuang", "fusion", "uncorrected", "fusion-true", ORACLE)

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        assert data is not None
        sequences = zip(bare_problems(data), read_pairs(data), strict=True)
        return islice((_with_gyro(problem, sequence) for problem, sequence in sequences), count)

    def shown(self, sequence: Sequence) -> tuple[str, ...]:
        return (MEASURED,) if _GYRO in sequence.channels else ()

    def chain(self, card: str) -> CardChain:
        made = super().chain(card)
        spec = made.options.corrector.component.spec
        if _of_a_rig(spec):
            return made.choosing()
        others = [name for name, there in (("time", "time" in spec.sees), ("gyro", "gyro" in spec.needs)) if there]
        return made._replace(uses=("readout", "images", *others))

    def corrected(self, making: Making, chain: CorrectionOptions) -> tuple[list[dict[View, Fused]], float]:
        spec = chain.corrector.component.spec
        if _of_a_rig(spec):
            return super().corrected(making, chain)
        problem, known = making.problem, Given()
        images = {view: image for view, image in making.images.items() if view[0] == _SIDE}
        if spec.needs & {"motion", "matches"}:
            making.alone = making.alone or _alone(making, chain)
            known = making.alone
        gyro = problem.correspondences.gyro
        known = replace(known, gyro=gyro if len(gyro) > 0 else None)
        rig, rows, start = (
            problem.rig.about(_SIDE),
            [float(each.row) for each in making.asked],
            time.perf_counter(),
        )
        frames = correct_known_rows(images, known, rig, problem.shutter, chain, (VIEW,), 0.0, rows)
        spent = making.spent.get("alone", 0.0) if spec.needs & {"motion", "matches"} else 0.0
        return frames, time.perf_counter() - start + spent


def _of_a_rig(spec: CorrectorSpec) -> bool:
    """Whether a corrector asks for more than one camera: for depth, or by itself for frames of the other one."""
    return "depth" in spec.needs or ("stereo" in spec.sees and not spec.needs & {"motion", "matches"})


def _alone(making: Making, chain: CorrectionOptions) -> Given:
    """Matches of the asked camera over time, and its motion, whose translation has length 1.

    Raises:
        RsbenchError: its frames show none.
    """
    start = time.perf_counter()
    frames = [making.images[_SIDE, frame] for frame in FRAMES]
    flows = find_flows(frames)
    if reason := refusal(frames, flows):
        raise RsbenchError(reason)
    matches = flow_matches(flows, np.random.default_rng(chain.seed))
    rig, shutter = making.problem.rig, making.problem.shutter
    found = find_own_motion(flows, rig, shutter, _SIDE, chain.robust, chain.seed)
    if found.own.motion is None:
        raise RsbenchError(found.reason)
    making.spent["alone"] = time.perf_counter() - start
    return Given(matches=Correspondences(left=matches), motion=found.own.motion)


def _with_gyro(problem: Problem, sequence: Sequence) -> Problem:
    """With the samples that lie over the frames of a pair, at its own times."""
    if _GYRO not in sequence.manifest.get("channels", ()):
        return problem
    whole = replace(sequence, channels=(_GYRO,))  # a pair of many frames has no channel of them all
    samples = gyro_samples(whole.inertial(), sequence.frame_period_s) - [sequence.first, 0.0, 0.0, 0.0]
    near = (samples[:, 0] > -_BESIDE) & (samples[:, 0] < len(FRAMES) + _BESIDE)
    return replace(problem, correspondences=replace(problem.correspondences, gyro=samples[near]))
