"""GTSAM's bundle adjustment of stereo tracks, with graduated non-convexity against outliers.

    pip install gtsam                        # 4.3.0, BSD
    rsbench leaderboard run points-2 --board board --entry gtsam_stereo.py:gtsam_stereo

The code is GTSAM's: a factor graph of two stereo frames with the points as unknowns, and its optimiser with
truncated least squares (Yang et al.), from no motion. It sees tracks through all four images and assumes a global
shutter. ``gtsam_stereo_scaled`` gets tracks scaled to one frame period by the times of their rows, which is right
to first order for a constant velocity.
"""

from __future__ import annotations

from importlib.metadata import version

import gtsam
from scipy.stats import chi2

import rsbench
from rsbench.core import so3
from rsbench.core.correspondences import with_depth
from rsbench.solvers.zhuang import scale_flow

TRACKS = {"needs": "tracks", "minimum": 6, "metric": True, "reference_point": "left", "robust": "own"}
TRACKS |= {
    "reference": "GTSAM, GenericStereoFactor3D, GncLMOptimizer; Yang et al.: Graduated non-convexity, RA-L 2020",
    "code": f"GTSAM {version('gtsam')}, BSD",
    "tuned_on": "noise: points-1 of seed 7, 29 November 2026",
}


@rsbench.solver(**TRACKS, shutter="global")
def gtsam_stereo(correspondences, rig, shutter, noise_px: float = 1.0):
    """GTSAM's robust bundle adjustment of tracks of both cameras, which are taken for global-shutter ones."""
    tracks, c = with_depth(correspondences.tracks), rig.camera
    if len(tracks) < 6:
        return None
    calibration, still = gtsam.Cal3_S2Stereo(c.fx, c.fy, 0.0, c.cx, c.cy, rig.baseline), gtsam.Pose3()
    camera, noise = gtsam.StereoCamera(still, calibration), gtsam.noiseModel.Isotropic.Sigma(3, noise_px)
    graph, start, poses = gtsam.NonlinearFactorGraph(), gtsam.Values(), [gtsam.symbol("x", k) for k in (0, 1)]
    graph.add(gtsam.NonlinearEqualityPose3(poses[0], still))
    for pose in poses:
        start.insert(pose, still)
    for k, track in enumerate(tracks):
        seen = [gtsam.StereoPoint2(xl, xr, 0.5 * (yl + yr)) for xl, yl, xr, yr in track.reshape(2, 4)]
        start.insert(point := gtsam.symbol("p", k), camera.backproject(seen[0]))
        for pose, pixels in zip(poses, seen, strict=True):
            graph.add(gtsam.GenericStereoFactor3D(pixels, noise, pose, point, calibration))
    options = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    options.setKnownInliers([0])
    optimiser = gtsam.GncLMOptimizer(graph, start, options)
    optimiser.setInlierCostThresholds(0.5 * chi2.ppf(0.99, 3))
    pose = optimiser.optimize().atPose3(poses[1]).inverse()
    return so3.log(pose.rotation().matrix()), pose.translation()


@rsbench.solver(**TRACKS, motion_model="twist")
def gtsam_stereo_scaled(correspondences, rig, shutter, noise_px: float = 1.0):
    """GTSAM's robust bundle adjustment of tracks of both cameras, scaled to one frame period."""
    return gtsam_stereo(scale_flow(correspondences, rig, shutter), rig, shutter, noise_px)
