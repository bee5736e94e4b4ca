# SPDX-License-Identifier: Apache-2.0
"""Unit quaternions (x, y, z, w) on plain float64 arrays of shape (4,).

Sums of few numbers are done on Python's own: numpy's scalars take three times as long.
"""

import math

import numpy as np


def normalized(quat_xyzw):
    """The quaternion divided by its length.

    Raises:
        ValueError: it is not four finite numbers, or its length is zero.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    if quat.shape != (4,) or not np.all(np.isfinite(quat)):
        raise ValueError(f"quat_xyzw: expected four finite numbers, got {quat_xyzw!r}")
    length = math.sqrt(float(quat @ quat))
    if length < 1e-6:
        raise ValueError("quat_xyzw: expected a unit quaternion, got one of length zero")
    return quat / length


def to_matrix(quat_xyzw):
    """Rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = _numbers(quat_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotated_back(vectors, quat_xyzw):
    """Vectors (N, 3) by the inverse rotation.

    Not by a product of matrices: after one, threads of OpenBLAS that were there before this package
    was loaded spin for milliseconds on the processors that the next step wants.
    """
    return np.einsum("ij,jk->ik", vectors, to_matrix(quat_xyzw))


def multiply(a_xyzw, b_xyzw):
    """The rotation b followed by a."""
    ax, ay, az, aw = _numbers(a_xyzw)
    bx, by, bz, bw = _numbers(b_xyzw)
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def conjugate(quat_xyzw):
    """The inverse rotation of a unit quaternion."""
    x, y, z, w = _numbers(quat_xyzw)
    return np.array([-x, -y, -z, w])


def rotation_vector(quat_xyzw):
    """Axis times angle [rad] of the shorter way, (3,)."""
    sign = -1.0 if quat_xyzw[3] < 0.0 else 1.0
    axis = sign * np.asarray(quat_xyzw[:3], dtype=np.float64)
    sine = math.sqrt(float(axis @ axis))
    if sine < 1e-12:
        return 2.0 * axis
    return axis * (2.0 * math.atan2(sine, sign * float(quat_xyzw[3])) / sine)


def from_rotation_vector(vector):
    """Unit quaternion of axis times angle [rad]."""
    angle = math.sqrt(float(np.dot(vector, vector)))
    if angle < 1e-12:
        return normalized([0.5 * vector[0], 0.5 * vector[1], 0.5 * vector[2], 1.0])
    scale = math.sin(0.5 * angle) / angle
    return np.array([*(scale * np.asarray(vector)), math.cos(0.5 * angle)])


def between(start_xyzw, end_xyzw):
    """Rotation vector [rad], world frame, that turns start into end the shorter way."""
    return rotation_vector(multiply(end_xyzw, conjugate(start_xyzw)))


def turned(start_xyzw, vector):
    """`start_xyzw` turned further by a rotation vector [rad] in the world frame."""
    return normalized(multiply(from_rotation_vector(vector), start_xyzw))


def _numbers(quat_xyzw):
    return np.asarray(quat_xyzw, np.float64).tolist()
