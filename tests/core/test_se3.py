"""Rigid transforms against homogeneous 4 x 4 matrices."""

from __future__ import annotations

import numpy as np

from rsbench.core import so3
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.so3 import FloatArray


def _random_poses(seed: int, n: int = 6) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(so3.exp(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))


def _matrix(pose: Pose) -> FloatArray:
    M = np.zeros((len(pose.R), 4, 4))
    M[:, :3, :3], M[:, :3, 3], M[:, 3, 3] = pose.R, pose.t, 1.0
    return M


def test_transform_is_the_homogeneous_product() -> None:
    pose, x = _random_poses(0), np.random.default_rng(1).normal(size=(6, 3))
    homogeneous = np.concatenate([x, np.ones((6, 1))], axis=1)
    expected = np.einsum("nij,nj->ni", _matrix(pose), homogeneous)[:, :3]
    np.testing.assert_allclose(transform(pose, x), expected, rtol=0, atol=1e-14)


def test_inverse_is_the_matrix_inverse() -> None:
    pose = _random_poses(2)
    np.testing.assert_allclose(_matrix(inverse(pose)), np.linalg.inv(_matrix(pose)), rtol=0, atol=1e-13)


def test_compose_is_the_matrix_product() -> None:
    c_from_b, b_from_a = _random_poses(3), _random_poses(4)
    expected = _matrix(c_from_b) @ _matrix(b_from_a)
    np.testing.assert_allclose(_matrix(compose(c_from_b, b_from_a)), expected, rtol=0, atol=1e-14)


def test_one_pose_broadcasts_over_points_and_one_point_over_poses() -> None:
    poses, x = _random_poses(5), np.random.default_rng(6).normal(size=(4, 3))
    one = Pose(poses.R[0], poses.t[0])
    np.testing.assert_allclose(transform(one, x)[2], one.R @ x[2] + one.t, rtol=0, atol=1e-15)
    np.testing.assert_allclose(transform(poses, x[0])[3], poses.R[3] @ x[0] + poses.t[3], rtol=0, atol=1e-15)
