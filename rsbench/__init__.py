"""Rolling-shutter stereo: rendered ground truth, solvers, correction and scores.

The names below are the public interface; everything else may change between versions. Each is imported when it
is first used, so that ``import rsbench`` costs nothing. docs/reference/api.md tells what they do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rsbench.core.version import __version__ as __version__

if TYPE_CHECKING:
    from rsbench.api import (
        correct,
        estimate_motion,
        estimate_trajectory,
        evaluate,
        generate,
        match,
        pose_errors,
        project,
        read_dataset,
        read_rig,
        simulate,
        stereo_depth,
        verify,
    )
    from rsbench.components.motion_models import AcceleratedMotion, LinearMotion, TwistMotion
    from rsbench.core.camera import PinholeCamera
    from rsbench.core.correspondences import Correspondences
    from rsbench.core.errors import RsbenchError
    from rsbench.core.rig import StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.core.spline_motion import SplineMotion
    from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec, list_solvers, load_solver, solver

__all__ = [
    "AcceleratedMotion",
    "Correspondences",
    "LinearMotion",
    "MotionEstimate",
    "PinholeCamera",
    "RollingShutter",
    "RsbenchError",
    "Solver",
    "SolverSpec",
    "SplineMotion",
    "StereoRig",
    "TwistMotion",
    "correct",
    "estimate_motion",
    "estimate_trajectory",
    "evaluate",
    "generate",
    "list_solvers",
    "load_solver",
    "match",
    "pose_errors",
    "project",
    "read_dataset",
    "read_rig",
    "simulate",
    "solver",
    "stereo_depth",
    "verify",
]

_HOMES = {
    "AcceleratedMotion": "rsbench.components.motion_models",
    "Correspondences": "rsbench.core.correspondences",
    "LinearMotion": "rsbench.components.motion_models",
    "MotionEstimate": "rsbench.solvers.engine.base",
    "PinholeCamera": "rsbench.core.camera",
    "RollingShutter": "rsbench.core.shutter",
    "RsbenchError": "rsbench.core.errors",
    "Solver": "rsbench.solvers.engine.base",
    "SolverSpec": "rsbench.solvers.engine.base",
    "SplineMotion": "rsbench.core.spline_motion",
    "StereoRig": "rsbench.core.rig",
    "TwistMotion": "rsbench.components.motion_models",
    "list_solvers": "rsbench.solvers.engine.base",
    "load_solver": "rsbench.solvers.engine.base",
    "solver": "rsbench.solvers.engine.base",
}
"""Modules of the names that ``rsbench.api`` does not define itself."""


if not TYPE_CHECKING:  # a type checker then knows every name, and a misspelt one

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module 'rsbench' has no attribute {name!r}")
        from importlib import import_module

        value = getattr(import_module(_HOMES.get(name, "rsbench.api")), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
