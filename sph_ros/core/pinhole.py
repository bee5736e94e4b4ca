# SPDX-License-Identifier: Apache-2.0
"""Pixels of points through OpenCV's camera model, and the pose that explains pixels best.

A pose's error is (shift [m], turn [rad]) along the axes of the camera's frame, see `tracking.se3`.
"""

import math

import numpy as np

from sph_ros.core.jit import device, kernel
from sph_ros.core.small_matrices import (
    applied,
    cholesky,
    inverse,
    product,
    product_transposed,
    rotation_from_vector,
    solved,
    vector_from_rotation,
)

#: Nothing nearer than this to the camera's plane has a pixel [m].
NEAR = 1e-6

#: Least share of a well-known direction's information that any direction gets.
UNKNOWN = 1e-8

_STEPS = 30  # of Levenberg and Marquardt, at most
_DONE = 1e-9  # [m, rad]: a smaller step changes nothing
_LARGEST_DAMPING = 1e8


@device
def _distorted(a, b, distortion, tilt):
    """Point (2,) on the ideal plane as the lens bends it, and the derivative (2, 2).

    Coefficients k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 in OpenCV's order; `tilt` is a tilted sensor's
    projection (3, 3).
    """
    d = distortion
    r2 = a * a + b * b
    above = 1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
    below = 1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7]))
    radial = above / below
    slope = d[0] + r2 * (2.0 * d[1] + r2 * 3.0 * d[4])
    slope = (slope - radial * (d[5] + r2 * (2.0 * d[6] + r2 * 3.0 * d[7]))) / below
    p1, p2 = d[2], d[3]
    x = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a) + r2 * (d[8] + r2 * d[9])
    y = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b) + r2 * (d[10] + r2 * d[11])
    prism_x, prism_y = d[8] + 2.0 * r2 * d[9], d[10] + 2.0 * r2 * d[11]
    mixed = 2.0 * (a * b * slope + p1 * a + p2 * b)
    x_a = radial + 2.0 * (a * a * slope + p1 * b + 3.0 * p2 * a + prism_x * a)
    x_b = mixed + 2.0 * prism_x * b
    y_a = mixed + 2.0 * prism_y * a
    y_b = radial + 2.0 * (b * b * slope + 3.0 * p1 * b + p2 * a + prism_y * b)
    w = tilt[2, 0] * x + tilt[2, 1] * y + tilt[2, 2]
    u = (tilt[0, 0] * x + tilt[0, 1] * y + tilt[0, 2]) / w
    v = (tilt[1, 0] * x + tilt[1, 1] * y + tilt[1, 2]) / w
    u_x, u_y = (tilt[0, 0] - u * tilt[2, 0]) / w, (tilt[0, 1] - u * tilt[2, 1]) / w
    v_x, v_y = (tilt[1, 0] - v * tilt[2, 0]) / w, (tilt[1, 1] - v * tilt[2, 1]) / w
    return (
        u,
        v,
        u_x * x_a + u_y * y_a,
        u_x * x_b + u_y * y_b,
        v_x * x_a + v_y * y_a,
        v_x * x_b + v_y * y_b,
    )


@kernel
def projected(points, matrix, distortion, tilt):
    """Pixels (N, 2) of points (N, 3) [m] in the camera's frame and in front of it.

    Args:
        points: (N, 3) [m].
        matrix: K, (3, 3) [pixels].
        distortion: (12,), see `_distorted`.
        tilt: (3, 3).
    """
    pixels = np.empty((len(points), 2))
    for i in range(len(points)):
        a, b = points[i, 0] / points[i, 2], points[i, 1] / points[i, 2]
        u, v, _, _, _, _ = _distorted(a, b, distortion, tilt)
        pixels[i, 0] = matrix[0, 0] * u + matrix[0, 2]
        pixels[i, 1] = matrix[1, 1] * v + matrix[1, 2]
    return pixels


@device
def _normal_equations(rotation, position, points, pixels, matrix, distortion, tilt):
    """How well a pose explains pixels: sum of squares, J^T J (6, 6), J^T errors (6,).

    J is the derivative of the pixels by the pose's error. The sum is infinite where a point is not
    in front of the camera.
    """
    squares = 0.0
    information, pull = np.zeros((6, 6)), np.zeros(6)
    row, arm = np.empty((2, 6)), np.empty(3)
    for i in range(len(points)):
        for k in range(3):
            arm[k] = 0.0
            for m in range(3):
                arm[k] += rotation[k, m] * points[i, m]
        z = arm[2] + position[2]
        if not z > NEAR:
            return np.inf, information, pull
        a, b = (arm[0] + position[0]) / z, (arm[1] + position[1]) / z
        u, v, u_a, u_b, v_a, v_b = _distorted(a, b, distortion, tilt)
        row[0, 0], row[0, 1] = matrix[0, 0] * u_a / z, matrix[0, 0] * u_b / z
        row[1, 0], row[1, 1] = matrix[1, 1] * v_a / z, matrix[1, 1] * v_b / z
        for k in range(2):
            row[k, 2] = -(row[k, 0] * a + row[k, 1] * b)
            # A turn moves the point by turn x arm.
            row[k, 3] = row[k, 2] * arm[1] - row[k, 1] * arm[2]
            row[k, 4] = row[k, 0] * arm[2] - row[k, 2] * arm[0]
            row[k, 5] = row[k, 1] * arm[0] - row[k, 0] * arm[1]
            error = pixels[i, k] - matrix[k, k] * (u if k == 0 else v) - matrix[k, 2]
            squares += error * error
            for m in range(6):
                pull[m] += row[k, m] * error
                for n in range(6):
                    information[m, n] += row[k, m] * row[k, n]
    return squares, information, pull


@device
def _moved(rotation, position, step):
    """The pose with an error (6,) added."""
    moved = np.empty(3)
    for i in range(3):
        moved[i] = position[i] + step[i]
    return product(rotation_from_vector(step[3:]), rotation), moved


@device
def _damped_step(information, pull, damping):
    """Step (6,) of Levenberg and Marquardt, in coordinates that are all known equally well."""
    damped = information.copy()
    for i in range(6):
        damped[i, i] += (damping + UNKNOWN) * information[i, i] + 1e-12
    return solved(cholesky(damped), pull)


@kernel
def best_pose(rotation, position, points, pixels, matrix, distortion, tilt):
    """The pose of least reprojection error near a given one (Levenberg-Marquardt).

    Args:
        rotation, position: where to begin, (3, 3), (3,) [m].
        points: in the target's frame, (N, 3) [m].
        pixels: (N, 2).
        matrix, distortion, tilt: see `projected`.

    Returns:
        rotation, position, sum of squared errors [pixels^2], information J^T J (6, 6). The sum is
        infinite where no pose before the camera was found.
    """
    squares, information, pull = _normal_equations(
        rotation, position, points, pixels, matrix, distortion, tilt
    )
    damping = 1e-3
    for _ in range(_STEPS):
        if not math.isfinite(squares) or damping > _LARGEST_DAMPING:
            break
        step = _damped_step(information, pull, damping)
        new_rotation, new_position = _moved(rotation, position, step)
        new_squares, new_information, new_pull = _normal_equations(
            new_rotation, new_position, points, pixels, matrix, distortion, tilt
        )
        if new_squares <= squares:
            rotation, position, squares = new_rotation, new_position, new_squares
            information, pull = new_information, new_pull
            damping *= 0.1
        else:
            damping *= 10.0
        longest = 0.0
        for i in range(6):
            longest = max(longest, abs(step[i]))
        if longest < _DONE:
            break
    return rotation, position, squares, information


@kernel
def covariance_of(information, variance):
    """Covariance (6, 6) of a pose from J^T J (6, 6) and the variance of a pixel.

    A trace of prior knowledge keeps it finite where an edge-on marker leaves a direction unknown.
    """
    scale = np.empty(6)
    scaled = np.empty((6, 6))
    for i in range(6):
        scale[i] = 1.0 / max(math.sqrt(information[i, i]), 1e-6)
    for i in range(6):
        for j in range(6):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
        scaled[i, i] += UNKNOWN
    result = inverse(scaled)
    for i in range(6):
        for j in range(6):
            result[i, j] *= variance * scale[i] * scale[j]
    return result


@kernel
def most_probable_pose(
    rotation, position, covariance, points, pixels, variance, steps, matrix, distortion, tilt
):
    """What a predicted pose and pixels amount to, and the pixels as a measurement linear about it.

    Args:
        rotation, position, covariance: predicted, (3, 3), (3,) [m], (6, 6).
        points, pixels: (N, 3) [m] in the target's frame, (N, 2).
        variance: of a pixel.
        steps: of Gauss and Newton.
        matrix, distortion, tilt: see `projected`.

    Returns:
        rotation, position and covariance (6, 6) of the pixels alone, and the sum of squared errors
        [pixels^2] of the most probable pose; infinite where that is not before the camera.
    """
    precision = inverse(covariance)
    first_rotation, first_position = rotation, position
    squares, information, pull = _normal_equations(
        rotation, position, points, pixels, matrix, distortion, tilt
    )
    for _ in range(steps):
        if not math.isfinite(squares):
            break
        back = np.empty(6)
        turn = vector_from_rotation(product_transposed(first_rotation, rotation))
        for i in range(3):
            back[i], back[3 + i] = first_position[i] - position[i], turn[i]
        target = applied(precision, back)
        for i in range(6):
            target[i] += pull[i] / variance
            for j in range(6):
                information[i, j] = information[i, j] / variance + precision[i, j]
        rotation, position = _moved(rotation, position, solved(cholesky(information), target))
        squares, information, pull = _normal_equations(
            rotation, position, points, pixels, matrix, distortion, tilt
        )
    alone = covariance_of(information, variance)
    step = applied(alone, pull)
    for i in range(6):
        step[i] /= variance
    rotation, position = _moved(rotation, position, step)
    return rotation, position, alone, squares
