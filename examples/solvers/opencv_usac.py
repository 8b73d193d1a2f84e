"""OpenCV's USAC on the left camera: five-point samples, MAGSAC++ scores, local optimisation, final polish.

    pip install opencv-python-headless       # 5.0.0, Apache 2.0; rsbench installs it anyway
    rsbench leaderboard run points-2 --board board --entry opencv_usac.py:opencv_usac \\
        --entry opencv_usac.py:opencv_usac_scaled

The code is OpenCV's: ``findEssentialMat`` with ``UsacParams`` rejects the outliers, ``recoverPose`` decomposes. It
sees the left camera's matches alone and assumes a global shutter and a translation; the length of d stays open.
``opencv_usac_scaled`` gets the matches scaled to one frame period by the times of their rows, which is right to
first order for a constant velocity.
"""

from __future__ import annotations

import cv2
import numpy as np

import rsbench
from rsbench.core import so3
from rsbench.solvers.zhuang import scale_flow

LEFT = {
    "needs": "left",
    "minimum": 6,
    "reference_point": "left",
    "robust": "own",
    "reference": "OpenCV, findEssentialMat with UsacParams; Barath et al.: MAGSAC++, CVPR 2020; Nister, PAMI 2004",
    "code": f"OpenCV {cv2.__version__}, Apache 2.0",
    "tuned_on": "threshold: points-1 of seed 7, 29 November 2026",
}


@rsbench.solver(**LEFT, shutter="global")
def opencv_usac(correspondences, rig, shutter, threshold_px: float = 0.5):
    """OpenCV's USAC with MAGSAC++ on the left camera, which is taken for a global-shutter one."""
    options = cv2.UsacParams()
    options.score = cv2.SCORE_METHOD_MAGSAC
    options.loMethod = cv2.LOCAL_OPTIM_SIGMA
    options.final_polisher = cv2.MAGSAC
    options.confidence, options.maxIterations, options.threshold = 0.999, 10000, threshold_px
    x0, x1 = np.ascontiguousarray(correspondences.left[:, :2]), np.ascontiguousarray(correspondences.left[:, 2:])
    K = rig.camera.K
    try:
        E, inliers = cv2.findEssentialMat(x0, x1, K, K, None, None, options)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, _ = cv2.recoverPose(E, x0, x1, K, mask=inliers)
    except cv2.error:  # degenerate matches
        return None
    return so3.log(R), t


@rsbench.solver(**LEFT, motion_model="twist")
def opencv_usac_scaled(correspondences, rig, shutter, threshold_px: float = 0.5):
    """OpenCV's USAC with MAGSAC++ on the left camera's matches, scaled to one frame period."""
    return opencv_usac(scale_flow(correspondences, rig, shutter), rig, shutter, threshold_px)
