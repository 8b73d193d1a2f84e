"""Correctors of the rotation only, from a gyroscope or from lines in one image: each row is rotated, without
depth."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from rsbench.components.motion_models import LinearMotion
from rsbench.core.imu import GyroMotion
from rsbench.core.rig import View
from rsbench.vision.correction import WarpOptions
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.correctors import turned
from rsbench.vision.fusion import Fused
from rsbench.vision.straightness import (
    LineOptions,
    ManhattanOptions,
    Points,
    Turn,
    image_curves,
    rotation_of_directions,
    rotation_of_lines,
)

_SHORTEST = 0.08
"""Least length of a curve, in heights of the image."""


@final
@dataclass(frozen=True, kw_only=True)
class GyroCorrector(Corrector):
    """Rotate everything, as if at infinity, by the rates of a gyroscope; its errors (bias, noise, delay)
    remain."""

    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"gyro"},
        sees=set(),
        reference="Karpenko, Jacobs, Baek, Levoy: Rolling shutter correction using gyroscopes, CSTR 2011-03",
        assumes="a gyroscope aligned with the cameras; a scene so far away that translation moves no pixel",
        cameras="rig",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        if problem.gyro is None:
            raise ValueError("there is no gyroscope: 'gyro' must be among the needs of the corrector")
        if len(problem.gyro) < 2 or not np.ptp(problem.gyro[:, 0]) > 0.0:
            reason = f"{len(problem.gyro)} samples of a gyroscope: needs two of different times at least"
            return {view: Fused.failed(problem.images[view], reason) for view in views}
        known = replace(problem, motion=GyroMotion(problem.gyro, np.zeros(3)))
        return {view: turned(known, view, self.warp) for view in views}


@dataclass(frozen=True, kw_only=True)
class ImageRotationCorrector(Corrector):
    """Rotate everything, as if at infinity, by a rotation estimated from curves in this frame, without a second
    image."""

    seed: int = 0
    """Seed of the random samples."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    @abstractmethod
    def turn(self, points: Points | None, rng: np.random.Generator) -> tuple[Turn | str, float]:
        """The rotation that the curves determine, or why there is none; and its expected size, rad."""

    def rotation(self, problem: CorrectionProblem, view: View) -> LinearMotion | str:
        """The rotation of one frame by its own curves, or why there is none."""
        camera = problem.rig.camera
        curves = image_curves(problem.images[view], _SHORTEST * camera.height)
        points = Points.of(curves, camera, problem.shutter, view) if curves else None
        turn, prior = self.turn(points, np.random.default_rng(self.seed))
        if isinstance(turn, str):
            return turn
        w = turn.determined(prior)
        return "the lines leave the rotation open" if w is None else LinearMotion(w, np.zeros(3))

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return self.correct_rows(problem, views, (problem.target_row,))[0]

    def correct_rows(
        self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
    ) -> list[dict[View, Fused]]:
        motions = {view: self.rotation(problem, view) for view in views}

        def corrected(view: View, row: float) -> Fused:
            motion = motions[view]
            if isinstance(motion, str):
                return Fused.failed(problem.images[view], motion)
            return turned(replace(problem, motion=motion, target_row=row), view, self.warp)

        return [{view: corrected(view, row) for view in views} for row in rows]


@final
@dataclass(frozen=True, kw_only=True)
class LinesCorrector(ImageRotationCorrector):
    """Rotate such that curves become straight lines."""

    lines: LineOptions = field(default_factory=LineOptions)
    """Search for the rotation from curves."""

    spec = CorrectorSpec(
        needs=set(),
        sees=set(),
        reference="Lao, Ait-Aider: A Robust Method for Strong Rolling Shutter Effects Correction Using Lines with "
        "Automatic Feature Selection, CVPR 2018",
        assumes="constant rotation without translation; straight lines in space across many rows, some slanted",
    )

    def turn(self, points: Points | None, rng: np.random.Generator) -> tuple[Turn | str, float]:
        return rotation_of_lines(points, self.lines, rng), self.lines.prior


@final
@dataclass(frozen=True, kw_only=True)
class ManhattanCorrector(ImageRotationCorrector):
    """Rotate such that lines run along three orthogonal directions."""

    manhattan: ManhattanOptions = field(default_factory=ManhattanOptions)
    """Search for rotation and directions from curves."""

    spec = CorrectorSpec(
        needs=set(),
        sees=set(),
        reference="Purkait, Zach, Leonardis: Rolling Shutter Correction in Manhattan World, ICCV 2017",
        assumes="constant rotation without translation; lines in space along three orthogonal directions",
    )

    def turn(self, points: Points | None, rng: np.random.Generator) -> tuple[Turn | str, float]:
        return rotation_of_directions(points, self.manhattan, rng), self.manhattan.prior
