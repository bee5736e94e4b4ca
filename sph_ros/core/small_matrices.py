# SPDX-License-Identifier: Apache-2.0
"""Products, Cholesky factors and rotations of matrices of a dozen rows, for kernels to call.

At this size NumPy spends its time on calls, not on numbers: the Kalman filters of two markers take
three milliseconds of it a picture, and a twentieth of that when compiled.
"""

import math

import numpy as np

from sph_ros.core.jit import device

#: A pivot keeps this share of its diagonal element: rounding must not stop a factorisation.
LEAST_PIVOT = 1e-14


@device
def product(a, b):
    """Matrix (n, m) of a @ b, (n, k) and (k, m)."""
    result = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                result[i, j] += a[i, k] * b[k, j]
    return result


@device
def product_transposed(a, b):
    """Matrix (n, m) of a @ b.T, (n, k) and (m, k)."""
    result = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            for k in range(a.shape[1]):
                result[i, j] += a[i, k] * b[j, k]
    return result


@device
def put(target, source):
    """Copy a matrix into another; an assignment takes a second longer to compile."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@device
def applied(a, x):
    """Vector (n,) of a @ x, (n, k) and (k,)."""
    result = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            result[i] += a[i, k] * x[k]
    return result


@device
def cholesky(a):
    """Lower triangular factor (n, n) of a symmetric, positive definite matrix."""
    n = a.shape[0]
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            rest = a[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = math.sqrt(max(rest, LEAST_PIVOT * a[i, i], 1e-300))
            else:
                factor[i, j] = rest / factor[j, j]
    return factor


@device
def forward_solved(factor, b):
    """L^-1 b (n,) for a Cholesky factor L; its squared length is b^T A^-1 b."""
    result = np.empty(len(b))
    for i in range(len(b)):
        rest = b[i]
        for k in range(i):
            rest -= factor[i, k] * result[k]
        result[i] = rest / factor[i, i]
    return result


@device
def solved(factor, b):
    """A^-1 b (n,) for the Cholesky factor of A."""
    result = forward_solved(factor, b)
    for i in range(len(b) - 1, -1, -1):
        for k in range(i + 1, len(b)):
            result[i] -= factor[k, i] * result[k]
        result[i] /= factor[i, i]
    return result


@device
def inverse(a):
    """Of a symmetric, positive definite matrix (n, n)."""
    n = a.shape[0]
    factor = cholesky(a)
    result = np.empty((n, n))
    unit = np.zeros(n)
    for i in range(n):
        unit[i] = 1.0
        column = solved(factor, unit)
        unit[i] = 0.0
        for j in range(n):
            result[j, i] = column[j]
    return result


# ---------------------------------------------------------------- rotations


@device
def rotation_from_vector(vector):
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    if square < 1e-10:  # to the fourth order
        sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        sine, versine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    result = np.empty((3, 3))
    result[0, 0] = 1.0 - versine * (y * y + z * z)
    result[1, 1] = 1.0 - versine * (x * x + z * z)
    result[2, 2] = 1.0 - versine * (x * x + y * y)
    result[0, 1], result[1, 0] = versine * x * y - sine * z, versine * x * y + sine * z
    result[0, 2], result[2, 0] = versine * x * z + sine * y, versine * x * z - sine * y
    result[1, 2], result[2, 1] = versine * y * z - sine * x, versine * y * z + sine * x
    return result


@device
def quaternion_from_rotation(r):
    """Unit quaternion x y z w (4,) of a rotation matrix, w >= 0 (Shepperd 1978)."""
    q = np.empty(4)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    largest = 3
    if max(r[0, 0], r[1, 1], r[2, 2]) > trace:
        largest = 0
        if r[1, 1] > r[0, 0]:
            largest = 1
        if r[2, 2] > r[largest, largest]:
            largest = 2
    if largest == 3:
        q[0], q[1], q[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
        q[3] = 1.0 + trace
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        q[j], q[k] = r[j, i] + r[i, j], r[k, i] + r[i, k]
        q[3] = r[k, j] - r[j, k]
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        length = -length
    for i in range(4):
        q[i] /= length
    return q


@device
def vector_from_rotation(rotation):
    """Rotation vector (3,) [rad], at most pi long, of a rotation matrix."""
    q = quaternion_from_rotation(rotation)
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    scale = 2.0 if sine < 1e-8 else 2.0 * math.atan2(sine, q[3]) / sine
    vector = np.empty(3)
    for i in range(3):
        vector[i] = scale * q[i]
    return vector
