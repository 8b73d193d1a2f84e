"""PoseLib's own robust estimator of a rig's relative pose, from pairs of both cameras.

    pip install poselib                      # 2.0.5, BSD 3-Clause; rsbench installs it anyway
    rsbench leaderboard run points-2 --entry poselib_rig.py:poselib_rig --board board

The code is PoseLib's: LO-RANSAC of minimal samples, then its robust refinement; ``gs-poselib-stereo`` has the
refinement in rsbench's loop. It sees the matches over time of both cameras and assumes a global shutter, a
translation, and a rotation, which shows the length of d. ``poselib_rig_scaled`` gets the matches scaled to one
frame period by the times of their rows, which is right to first order for a constant velocity.
"""

from __future__ import annotations

from importlib.metadata import version

import numpy as np
import poselib

import rsbench
from rsbench.core import so3
from rsbench.solvers.zhuang import scale_flow

RIG = {
    "needs": {"left", "right"},
    "minimum": 8,
    "metric": True,
    "robust": "own",
    "reference": "PoseLib, estimate_generalized_relative_pose; Stewenius et al., OMNIVIS 2005",
    "code": f"PoseLib {version('poselib')}, BSD 3-Clause",
    "tuned_on": "threshold: points-1 of seed 7, 29 November 2026",
}


@rsbench.solver(**RIG, shutter="global")
def poselib_rig(correspondences, rig, shutter, threshold_px: float = 1.0):
    """PoseLib's robust generalised relative pose of both cameras, which are taken for global-shutter ones."""
    c = rig.camera
    pinhole = {"model": "PINHOLE", "width": c.width, "height": c.height, "params": [c.fx, c.fy, c.cx, c.cy]}
    places, pairs = [poselib.CameraPose(), poselib.CameraPose()], []
    for k, matches in enumerate((correspondences.left, correspondences.right)):
        places[k].t = rig.offset(("left", "right")[k])
        pairs.append(pair := poselib.PairwiseMatches())
        pair.cam_id1, pair.cam_id2, pair.x1, pair.x2 = k, k, matches[:, :2], matches[:, 2:]
    options = {"max_epipolar_error": threshold_px, "max_error": threshold_px, "success_prob": 0.999, "seed": 0}
    cameras = places, [pinhole, pinhole]
    pose, _ = poselib.estimate_generalized_relative_pose(pairs, *cameras, *cameras, options)
    return so3.log(np.array(pose.R)), np.array(pose.t)


@rsbench.solver(**RIG, motion_model="twist")
def poselib_rig_scaled(correspondences, rig, shutter, threshold_px: float = 1.0):
    """PoseLib's robust generalised relative pose of both cameras, from matches scaled to one frame period."""
    return poselib_rig(scale_flow(correspondences, rig, shutter), rig, shutter, threshold_px)
