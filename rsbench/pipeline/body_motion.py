"""From a solver's answer to the motion of the rig's body, which corrections and tables work with."""

from __future__ import annotations

from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.solvers.engine.base import MotionEstimate, SolverSpec


def body_motion(estimate: MotionEstimate, spec: SolverSpec, rig: StereoRig) -> Motion | str:
    """The body's motion in metres that an estimate stands for, or the reason why it stands for none.

    A left camera's translation t becomes the body's: d = t - o + R o, with o the left camera's offset. The pose
    after one period is then exact. Between the rows a constant twist of the camera is one of the body too; a
    camera that moves linearly has a body that does so up to |w|^2 |o| / 8.

    Args:
        estimate: a solver's answer.
        spec: what that solver declares: the point whose translation d is, and the motion model.
        rig: where the left camera is.
    """
    if not estimate.success:
        return estimate.reason
    if not estimate.metric:
        whose = "the left camera's " if spec.reference_point == "left" else ""
        return f"the length of d is not known in metres, only {whose}direction of translation"
    d = estimate.d
    if spec.reference_point == "left":
        offset = rig.offset("left")
        d = d - offset + so3.exp(estimate.w) @ offset
    return make_motion(spec.motion_model, estimate.w, d, spec.motion_parameters)
