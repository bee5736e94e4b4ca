# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of `tracking.filter`: Kalman filters of several kinds of motion at once.

Arrays of M kinds of motion: positions (M, 3) [m], rotations (M, 3, 3), velocities (M, 3) [m/s],
spins (M, 3) [rad/s], covariances (M, 12, 12) in the order position, rotation, velocity, spin, and
weights (M,) of sum 1. Nothing that comes in is changed.
"""

import math

import numpy as np

from sph_ros.core.jit import device, kernel
from sph_ros.core.small_matrices import (
    applied,
    cholesky,
    forward_solved,
    product,
    product_transposed,
    put,
    quaternion_from_rotation,
    rotation_from_vector,
    vector_from_rotation,
)

#: No kind of motion is ever ruled out [-].
LEAST_WEIGHT = 1e-4

#: Columns of a table of kinds: 1 or 0 for moving or resting, then as `tracking.filter.Motion`.
MOVING, ACCELERATION, ANGULAR_ACCELERATION, DRIFT, ANGULAR_DRIFT = range(5)

#: Entries of the table of times and speeds, as `tracking.filter.MotionSettings`.
ACCELERATION_TIME, KIND_TIME, REST_SPEED, REST_SPIN = range(4)


@device
def _normalized(weights):
    """Weights (M,) whose sum is 1 and none of which is lost."""
    total = 0.0
    for m in range(len(weights)):
        total += weights[m]
    result, sum_of_all = np.empty(len(weights)), 0.0
    for m in range(len(weights)):
        result[m] = max(weights[m] / total, LEAST_WEIGHT)
        sum_of_all += result[m]
    for m in range(len(weights)):
        result[m] /= sum_of_all
    return result


@device
def _errors(positions, rotations, velocities, spins, weights):
    """The likeliest kind, and the errors (M, 12) of all about its pose; velocities about zero."""
    best = 0
    for m in range(len(weights)):
        if weights[m] > weights[best]:
            best = m
    errors = np.empty((len(weights), 12))
    for m in range(len(weights)):
        turn = vector_from_rotation(product_transposed(rotations[m], rotations[best]))
        for i in range(3):
            errors[m, i] = positions[m, i] - positions[best, i]
            errors[m, 3 + i] = turn[i]
            errors[m, 6 + i] = velocities[m, i]
            errors[m, 9 + i] = spins[m, i]
    return best, errors


@device
def _moment(covariances, errors, weights):
    """Mean (12,) of the errors of a mixture, and the covariance (12, 12) about it."""
    shift = np.zeros(12)
    for m in range(len(weights)):
        for i in range(12):
            shift[i] += weights[m] * errors[m, i]
    total = np.zeros((12, 12))
    for m in range(len(weights)):
        for i in range(12):
            for j in range(12):
                spread = (errors[m, i] - shift[i]) * (errors[m, j] - shift[j])
                total[i, j] += weights[m] * (covariances[m, i, j] + spread)
    return shift, total


@device
def _mixed(positions, rotations, velocities, spins, covariances, weights, elapsed, kind_time):
    """The states that the kinds begin with, each a mixture of what may have become it."""
    count = len(weights)
    stay = math.exp(-elapsed / kind_time)
    change = (1.0 - stay) / count
    best, errors = _errors(positions, rotations, velocities, spins, weights)
    new_positions, new_rotations = np.empty((count, 3)), np.empty((count, 3, 3))
    new_velocities, new_spins = np.empty((count, 3)), np.empty((count, 3))
    new_covariances, new_weights = np.empty((count, 12, 12)), np.empty(count)
    shares = np.empty(count)
    for m in range(count):
        new_weights[m] = 0.0
        for n in range(count):
            shares[n] = (change + (stay if n == m else 0.0)) * weights[n]
            new_weights[m] += shares[n]
        for n in range(count):
            shares[n] /= new_weights[m]
        shift, covariance = _moment(covariances, errors, shares)
        put(new_covariances[m], covariance)
        put(new_rotations[m], product(rotation_from_vector(shift[3:6]), rotations[best]))
        for i in range(3):
            new_positions[m, i] = positions[best, i] + shift[i]
            new_velocities[m, i], new_spins[m, i] = shift[6 + i], shift[9 + i]
    return (
        new_positions,
        new_rotations,
        new_velocities,
        new_spins,
        new_covariances,
        _normalized(new_weights),
    )


@device
def _add_process_noise(covariance, kind, rates, elapsed):
    """Add to a covariance (12, 12) what a kind of motion does in a time [s].

    Moving: white acceleration of the density a^2 T, which a hand's acceleration a that lasts T
    looks like over longer times (Bar-Shalom, Li & Kirubarajan 2001, eq. 6.2.2-12).
    """
    for axis in range(6):
        turning = axis >= 3
        place, speed = axis, axis + 6
        if kind[MOVING] == 0.0:
            drift = kind[ANGULAR_DRIFT] if turning else kind[DRIFT]
            start = rates[REST_SPIN] if turning else rates[REST_SPEED]
            covariance[place, place] += drift * drift * elapsed
            covariance[speed, speed] += start * start
            continue
        size = kind[ANGULAR_ACCELERATION] if turning else kind[ACCELERATION]
        density = size * size * rates[ACCELERATION_TIME]
        covariance[place, place] += density * elapsed * elapsed * elapsed / 3.0
        covariance[place, speed] += density * elapsed * elapsed / 2.0
        covariance[speed, place] += density * elapsed * elapsed / 2.0
        covariance[speed, speed] += density * elapsed


@kernel
def predicted(
    positions,
    rotations,
    velocities,
    spins,
    covariances,
    weights,
    kinds,
    rates,
    elapsed,
    travel,
    left,
):
    """The states after a time.

    Args:
        positions, rotations, velocities, spins, covariances, weights: see the module.
        kinds: table of kinds, (M, 5).
        rates: table of times and speeds, (4,).
        elapsed: time that went by [s], above 0.
        travel: the same as time at full velocity [s], less for what comes to a stop.
        left: share of the velocity that is left at the end [-].
    """
    positions, rotations, velocities, spins, covariances, weights = _mixed(
        positions, rotations, velocities, spins, covariances, weights, elapsed, rates[KIND_TIME]
    )
    angle = np.empty(3)
    for m in range(len(weights)):
        moving = kinds[m, MOVING]
        for i in range(3):
            angle[i] = spins[m, i] * travel * moving
            positions[m, i] += velocities[m, i] * travel * moving
            velocities[m, i] *= left * moving
            spins[m, i] *= left * moving
        turn = rotation_from_vector(angle)
        transition = np.zeros((12, 12))
        for i in range(3):
            transition[i, i] = 1.0
            transition[i, 6 + i] = transition[3 + i, 9 + i] = travel * moving
            transition[6 + i, 6 + i] = transition[9 + i, 9 + i] = left * moving
            for j in range(3):
                transition[3 + i, 3 + j] = turn[i, j]
        covariance = product_transposed(product(transition, covariances[m]), transition)
        _add_process_noise(covariance, kinds[m], rates, elapsed)
        put(covariances[m], covariance)
        put(rotations[m], product(turn, rotations[m]))
    return positions, rotations, velocities, spins, covariances, weights


@device
def _innovation(m, positions, rotations, covariances, rotation, position, covariance):
    """What kind m did not foresee (6,), and the Cholesky factor of its covariance (6, 6)."""
    error, spread = np.empty(6), np.empty((6, 6))
    turn = vector_from_rotation(product_transposed(rotation, rotations[m]))
    for i in range(3):
        error[i], error[3 + i] = position[i] - positions[m, i], turn[i]
    for i in range(6):
        for j in range(6):
            spread[i, j] = covariances[m, i, j] + covariance[i, j]
    return error, cholesky(spread)


@device
def _square(vector):
    """Its length, squared."""
    total = 0.0
    for i in range(len(vector)):
        total += vector[i] * vector[i]
    return total


@kernel
def surprise_of(positions, rotations, covariances, weights, rotation, position, covariance):
    """Least of all kinds' squared Mahalanobis distances from a measured pose, each plus its price.

    Args:
        positions, rotations, covariances, weights: predicted, see the module.
        rotation, position, covariance: measured, (3, 3), (3,) [m], (6, 6).
    """
    least = np.inf
    for m in range(len(weights)):
        error, factor = _innovation(
            m, positions, rotations, covariances, rotation, position, covariance
        )
        distance = _square(forward_solved(factor, error))
        least = min(least, distance - 2.0 * math.log(weights[m]))
    return least


@kernel
def updated(
    positions,
    rotations,
    velocities,
    spins,
    covariances,
    weights,
    rotation,
    position,
    covariance,
):
    """The states after a measured pose of this moment; arguments as before."""
    positions, rotations = positions.copy(), rotations.copy()
    velocities, spins = velocities.copy(), spins.copy()
    covariances = covariances.copy()
    likelihoods = np.empty(len(weights))
    for m in range(len(weights)):
        error, factor = _innovation(
            m, positions, rotations, covariances, rotation, position, covariance
        )
        off = forward_solved(factor, error)
        likelihoods[m] = -0.5 * _square(off)
        for i in range(6):
            likelihoods[m] -= math.log(factor[i, i])
        # Rows of L^-1 H P; their products with each other and with L^-1 error are gain times both.
        across, column = np.empty((12, 6)), np.empty(6)
        for i in range(12):
            for j in range(6):
                column[j] = covariances[m, i, j]
            row = forward_solved(factor, column)
            for j in range(6):
                across[i, j] = row[j]
        step = applied(across, off)
        reduction = product_transposed(across, across)
        for i in range(12):
            for j in range(12):
                covariances[m, i, j] -= reduction[i, j]
        put(rotations[m], product(rotation_from_vector(step[3:6]), rotations[m]))
        for i in range(3):
            positions[m, i] += step[i]
            velocities[m, i] += step[6 + i]
            spins[m, i] += step[9 + i]
    best = -np.inf
    for m in range(len(weights)):
        best = max(best, likelihoods[m])
    for m in range(len(weights)):
        likelihoods[m] = weights[m] * math.exp(likelihoods[m] - best)
    return positions, rotations, velocities, spins, covariances, _normalized(likelihoods)


@kernel
def mean_of(positions, rotations, velocities, spins, covariances, weights):
    """Mean of the mixture: rotation, position, velocity, spin, covariance (12, 12)."""
    best, errors = _errors(positions, rotations, velocities, spins, weights)
    shift, covariance = _moment(covariances, errors, weights)
    rotation = product(rotation_from_vector(shift[3:6]), rotations[best])
    position, velocity, spin = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        position[i] = positions[best, i] + shift[i]
        velocity[i], spin[i] = shift[6 + i], shift[9 + i]
    return rotation, position, velocity, spin, covariance


# ---------------------------------------------------------------- single poses


@kernel
def squared_distance(error, spread):
    """Squared Mahalanobis distance of an error (n,) of covariance (n, n)."""
    return _square(forward_solved(cholesky(spread), error))


@kernel
def rotations_from_vectors(vectors):
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) [rad]."""
    result = np.empty((len(vectors), 3, 3))
    for i in range(len(vectors)):
        put(result[i], rotation_from_vector(vectors[i]))
    return result


@kernel
def vectors_from_rotations(rotations):
    """Rotation vectors (N, 3) [rad], at most pi long, of rotation matrices (N, 3, 3)."""
    result = np.empty((len(rotations), 3))
    for i in range(len(rotations)):
        vector = vector_from_rotation(rotations[i])
        for j in range(3):
            result[i, j] = vector[j]
    return result


@kernel
def quaternion_of(rotation):
    """Unit quaternion x y z w (4,) of a rotation matrix (3, 3), w >= 0."""
    return quaternion_from_rotation(rotation)


@kernel
def covariance_of_product(rotation, arm, covariance, second):
    """Covariance (6, 6) of a_from_b @ b_from_c from those of both, taken as independent.

    Args:
        rotation: of a_from_b, (3, 3).
        arm: position of b_from_c along the axes of a (3,) [m].
        covariance, second: of a_from_b and of b_from_c, (6, 6), see `tracking.se3`.
    """
    lever, turned = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(6):
        lever[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            turned[i, j] = turned[3 + i, 3 + j] = rotation[i, j]
    lever[0, 4], lever[0, 5], lever[1, 5] = arm[2], -arm[1], arm[0]
    lever[1, 3], lever[2, 3], lever[2, 4] = -arm[2], arm[1], -arm[0]
    total = product_transposed(product(lever, covariance), lever)
    other = product_transposed(product(turned, second), turned)
    for i in range(6):
        for j in range(6):
            total[i, j] += other[i, j]
    return total


@kernel
def covariance_of_inverse(rotation, position, covariance):
    """Covariance (6, 6) of b_from_a from rotation, position and covariance of a_from_b."""
    jacobian = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            jacobian[i, j] = jacobian[3 + i, 3 + j] = -rotation[j, i]
        x, y, z = rotation[0, i], rotation[1, i], rotation[2, i]
        jacobian[i, 3] = z * position[1] - y * position[2]
        jacobian[i, 4] = x * position[2] - z * position[0]
        jacobian[i, 5] = y * position[0] - x * position[1]
    return product_transposed(product(jacobian, covariance), jacobian)
