"""COLMAP's robust pose of a rig in frame 1 from points of frame 0.

    pip install pycolmap                     # 4.2.1, BSD 3-Clause
    rsbench leaderboard run points-2 --entry colmap_rig.py:colmap_rig --board board

The code is COLMAP's: LO-RANSAC with three points, then its refinement. It sees tracks through all four images:
their points are triangulated in frame 0, from whose images in both cameras of frame 1 the pose follows, in metres.
It assumes a global shutter and points without error. ``colmap_rig_scaled`` gets tracks scaled to one frame period
by the times of their rows, which is right to first order for a constant velocity.
"""

from __future__ import annotations

import numpy as np
import pycolmap

import rsbench
from rsbench.core import so3
from rsbench.core.correspondences import stereo_points, with_depth
from rsbench.solvers.zhuang import scale_flow

RIG = {
    "needs": "tracks",
    "minimum": 4,
    "metric": True,
    "robust": "own",
    "reference": "COLMAP, estimate_and_refine_generalized_absolute_pose; Schonberger, Frahm, CVPR 2016",
    "code": f"COLMAP {pycolmap.__version__}, BSD 3-Clause",
    "tuned_on": "threshold: points-1 of seed 7, 29 November 2026",
}


@rsbench.solver(**RIG, shutter="global")
def colmap_rig(correspondences, rig, shutter, threshold_px: float = 4.0):
    """COLMAP's robust pose of the rig from points of frame 0; both cameras are taken for global-shutter ones."""
    tracks, c = with_depth(correspondences.tracks), rig.camera
    if len(tracks) < 4:
        return None
    camera = pycolmap.Camera(model="PINHOLE", width=c.width, height=c.height, params=[c.fx, c.fy, c.cx, c.cy])
    places = [pycolmap.Rigid3d(pycolmap.Rotation3d(), rig.offset(side)) for side in ("left", "right")]
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate([tracks[:, 4:6], tracks[:, 6:8]]),
        np.tile(stereo_points(tracks, rig), (2, 1)),
        np.repeat([0, 1], len(tracks)),
        places,
        [camera, camera],
        pycolmap.RANSACOptions(max_error=threshold_px, confidence=0.999, max_num_trials=10000, random_seed=0),
    )
    if found is None:
        return None
    return so3.log(found["rig_from_world"].rotation.matrix()), found["rig_from_world"].translation


@rsbench.solver(**RIG, motion_model="twist")
def colmap_rig_scaled(correspondences, rig, shutter, threshold_px: float = 4.0):
    """COLMAP's robust pose of the rig from points of frame 0, from tracks scaled to one frame period."""
    return colmap_rig(scale_flow(correspondences, rig, shutter), rig, shutter, threshold_px)
