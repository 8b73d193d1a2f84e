"""The metrics that come with rsbench."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from rsbench.benchmark.scoring import (
    WORST_POSE,
    Column,
    DepthCase,
    DepthMetric,
    ImageCase,
    ImageMetric,
    PoseCase,
    PoseMetric,
    pose_errors,
)
from rsbench.core.errors import RsbenchError
from rsbench.vision.quality import LastSsim, flip, psnr
from rsbench.vision.stereo_depth import depth_metrics

_SSIM = LastSsim()
"""One picture is scored in several sets of its pixels."""


@final
@dataclass(frozen=True)
class PoseErrors(PoseMetric):
    """e_R, e_T and e_s: see ``scoring.pose_errors``."""

    columns = (
        Column(name="e_R_deg", better="lower", worst=WORST_POSE["e_R_deg"], unit="deg", title="e_R"),
        Column(name="e_T_deg", better="lower", worst=WORST_POSE["e_T_deg"], unit="deg", title="e_T"),
        Column(name="e_s", better="lower", worst=WORST_POSE["e_s"]),
    )

    def compute(self, case: PoseCase) -> Mapping[str, float]:
        errors = pose_errors(
            case.w,
            case.d,
            true_w=case.truth.w,
            true_d=case.truth.d,
            rig=case.rig,
            metric=case.metric,
            reference_point=case.reference_point,
        )
        return {name: float(value) for name, value in errors.items()}


@final
@dataclass(frozen=True)
class DepthErrors(DepthMetric):
    """Errors over the pixels that have an estimate, and their share: see ``vision.stereo_depth.depth_metrics``."""

    columns = (
        Column(name="median_m", better="lower", worst=math.inf, unit="m", title="median"),
        Column(name="rmse_m", better="lower", worst=math.inf, unit="m", title="RMSE"),
        Column(name="over_2m", better="lower", worst=1.0, title="> 2 m"),
        Column(name="bad_1px", better="lower", worst=1.0, title="> 1 px"),
        Column(name="bad_2px", better="lower", worst=1.0, title="> 2 px"),
        Column(name="bad_3px", better="lower", worst=1.0, title="> 3 px"),
        Column(name="on_sky", better="lower", worst=1.0, title="on sky"),
        Column(name="coverage", better="higher", worst=0.0),
    )

    def compute(self, case: DepthCase) -> Mapping[str, float]:
        if not np.any(case.pixels & (case.truth > 0.0)):
            return {column.name: math.nan for column in self.columns}
        scores = depth_metrics(case.depth, case.truth, case.rig, case.pixels)
        # A map that knows none of these pixels has no error there, but it is no good one.
        nothing = scores["coverage"] == 0.0
        return {column.name: column.worst if nothing else scores[column.name] for column in self.columns}


@final
@dataclass(frozen=True)
class Psnr(ImageMetric):
    """Peak signal-to-noise ratio: see ``vision.quality``."""

    columns = (Column(name="psnr", better="higher", worst=0.0, unit="dB", title="PSNR"),)

    def compute(self, case: ImageCase) -> Mapping[str, float]:
        return {"psnr": psnr(case.image, case.truth, case.pixels)}


@final
@dataclass(frozen=True)
class Ssim(ImageMetric):
    """Structural similarity: see ``vision.quality``."""

    columns = (Column(name="ssim", better="higher", worst=-1.0, title="SSIM"),)

    def compute(self, case: ImageCase) -> Mapping[str, float]:
        return {"ssim": _SSIM.within(case.image, case.truth, case.pixels)}


@final
@dataclass(frozen=True)
class Flip(ImageMetric):
    """Mean FLIP error, see ``vision.quality``; raises RsbenchError if its package has no wheel."""

    columns = (Column(name="flip", better="lower", worst=1.0, title="FLIP"),)

    def compute(self, case: ImageCase) -> Mapping[str, float]:
        errors = flip(case.image, case.truth)
        if errors is None:
            raise RsbenchError("metric 'flip': the package flip-evaluator is not installed")
        return {"flip": float(np.mean(errors[case.pixels])) if np.any(case.pixels) else math.nan}
