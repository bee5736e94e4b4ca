# SPDX-License-Identifier: Apache-2.0
"""Rigid motions: rotation matrices and positions, their errors and covariances.

An error of a pose is (position [m], rotation vector [rad]), both along the axes of the frame in
which the pose is given: ``position + error[:3]``, ``exp(error[3:]) @ rotation``. This is what the
covariance of ROS's PoseWithCovariance means, too.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation


class Pose(NamedTuple):
    """Where a frame lies in another: rotation (3, 3), position (3,) [m]."""

    rotation: np.ndarray
    position: np.ndarray

    def __matmul__(self, other):
        """a_from_b @ b_from_c = a_from_c."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.position + self.position)

    def inverse(self):
        """b_from_a of a_from_b."""
        back = self.rotation.T
        return Pose(back, -back @ self.position)

    def apply(self, points):
        """Points (N, 3) in b as points in a."""
        return points @ self.rotation.T + self.position

    @property
    def quat_xyzw(self):
        """Unit quaternion (4,) with w >= 0."""
        return Rotation.from_matrix(self.rotation).as_quat(canonical=True)


IDENTITY = Pose(np.eye(3), np.zeros(3))


def pose_from_quaternion(position, quat_xyzw):
    """A Pose from position (3,) [m] and a quaternion of any length but zero."""
    rotation = Rotation.from_quat(np.asarray(quat_xyzw, float)).as_matrix()
    return Pose(rotation, np.asarray(position, float))


def hat(vectors):
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    vectors = np.asarray(vectors, float)
    matrices = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -z, y, -x
    matrices[..., 1, 0], matrices[..., 2, 0], matrices[..., 2, 1] = z, -y, x
    return matrices


def exp(vectors):
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    vectors = np.asarray(vectors, float)
    if vectors.ndim == 1:
        return cv2.Rodrigues(vectors)[0]
    return np.array([cv2.Rodrigues(vector)[0] for vector in vectors])


def log(rotations):
    """Rotation vectors (..., 3) [rad], at most pi long, of matrices (..., 3, 3)."""
    if rotations.ndim == 2:
        return cv2.Rodrigues(rotations)[0][:, 0]
    return np.array([cv2.Rodrigues(rotation)[0][:, 0] for rotation in rotations])


def difference(pose, reference):
    """The error (6,) that turns `reference` into `pose`."""
    turn = log(pose.rotation @ reference.rotation.T)
    return np.concatenate([pose.position - reference.position, turn])


def composed_covariance(a_from_b, covariance_ab, b_from_c, covariance_bc):
    """Covariance (6, 6) of a_from_b @ b_from_c from those of both, taken as independent."""
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = a_from_b.rotation
    lever = np.eye(6)
    lever[:3, 3:] = -hat(a_from_b.rotation @ b_from_c.position)
    return lever @ covariance_ab @ lever.T + turned @ covariance_bc @ turned.T


def inverse_covariance(a_from_b, covariance):
    """Covariance (6, 6) of b_from_a, the inverse pose."""
    back = a_from_b.rotation.T
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -back
    jacobian[:3, 3:] = -back @ hat(a_from_b.position)
    return jacobian @ covariance @ jacobian.T
