# SPDX-License-Identifier: Apache-2.0
"""Rigid motions: rotation matrices and positions, their errors and covariances.

An error of a pose is (position [m], rotation vector [rad]), both along the axes of the frame in
which the pose is given: ``position + error[:3]``, ``exp(error[3:]) @ rotation``. This is what the
covariance of ROS's PoseWithCovariance means, too.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sph_ros.core.motion_filter import (
    covariance_of_inverse,
    covariance_of_product,
    quaternion_of,
    rotations_from_vectors,
    vectors_from_rotations,
)
from sph_ros.sim import quaternions


class Pose(NamedTuple):
    """Where a frame lies in another: rotation (3, 3), position (3,) [m]."""

    rotation: np.ndarray
    position: np.ndarray

    def __matmul__(self, other):
        """a_from_b @ b_from_c = a_from_c."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.position + self.position)

    def inverse(self):
        """b_from_a of a_from_b."""
        back = np.ascontiguousarray(self.rotation.T)
        return Pose(back, -back @ self.position)

    def apply(self, points):
        """Points (N, 3) in b as points in a."""
        return points @ self.rotation.T + self.position

    @property
    def quat_xyzw(self):
        """Unit quaternion (4,) with w >= 0."""
        return quaternion_of(np.ascontiguousarray(self.rotation))


IDENTITY = Pose(np.eye(3), np.zeros(3))


def pose_from_quaternion(position, quat_xyzw):
    """A Pose from position (3,) [m] and a quaternion of any length but zero."""
    rotation = quaternions.to_matrix(quaternions.normalized(quat_xyzw))
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
    flat = np.ascontiguousarray(vectors.reshape(-1, 3))
    return rotations_from_vectors(flat).reshape(*vectors.shape, 3)


def log(rotations):
    """Rotation vectors (..., 3) [rad], at most pi long, of matrices (..., 3, 3)."""
    if rotations.ndim == 2:
        return cv2.Rodrigues(rotations)[0][:, 0]
    flat = np.ascontiguousarray(rotations.reshape(-1, 3, 3))
    return vectors_from_rotations(flat).reshape(rotations.shape[:-1])


def difference(pose, reference):
    """The error (6,) that turns `reference` into `pose`."""
    turn = log(pose.rotation @ reference.rotation.T)
    return np.concatenate([pose.position - reference.position, turn])


def composed_covariance(a_from_b, covariance_ab, b_from_c, covariance_bc):
    """Covariance (6, 6) of a_from_b @ b_from_c from those of both, taken as independent."""
    arm = a_from_b.rotation @ b_from_c.position
    return covariance_of_product(
        np.ascontiguousarray(a_from_b.rotation),
        arm,
        np.ascontiguousarray(covariance_ab),
        np.ascontiguousarray(covariance_bc),
    )


def inverse_covariance(a_from_b, covariance):
    """Covariance (6, 6) of b_from_a, the inverse pose."""
    return covariance_of_inverse(
        np.ascontiguousarray(a_from_b.rotation),
        np.ascontiguousarray(a_from_b.position),
        np.ascontiguousarray(covariance),
    )
