# SPDX-License-Identifier: Apache-2.0
"""Arrays with a row per particle as a whole: their extent, whether all is finite, their order."""

import numpy as np
from numba import prange

from sph_ros.core.jit import bare_kernel, kernel
from sph_ros.core.team import parallel_kernel

#: Coordinates of sixteen particles.
BLOCK = 48


@kernel
def bounding_box(positions, lower, upper):
    """Smallest box around `positions` (N, 3) [m]; `lower`, `upper` (3,) are written.

    Returns:
        The first row that is not finite, or -1.
    """
    values = positions.reshape(positions.size)
    # Blocks of sixteen rows, so that the compiler makes vectors of it; 0 times a value is 0 unless
    # it is not finite.
    least, most = np.full(BLOCK, np.float32(np.inf)), np.full(BLOCK, np.float32(-np.inf))
    zeros = np.zeros(BLOCK, np.float32)
    whole = values.size // BLOCK * BLOCK
    for first in range(0, whole, BLOCK):
        block = values[first : first + BLOCK]
        for k in range(BLOCK):
            value = block[k]
            least[k] = value if value < least[k] else least[k]
            most[k] = value if value > most[k] else most[k]
            zeros[k] += np.float32(0.0) * value
    for k in range(whole, values.size):
        value, place = values[k], k - whole
        least[place] = min(least[place], value)
        most[place] = max(most[place], value)
        zeros[place] += np.float32(0.0) * value
    lower[:], upper[:] = np.inf, -np.inf
    total = np.float32(0.0)
    for k in range(BLOCK):
        lower[k % 3] = min(lower[k % 3], least[k])
        upper[k % 3] = max(upper[k % 3], most[k])
        total += zeros[k]
    if total == np.float32(0.0):
        return -1
    for i in range(positions.shape[0]):
        if not np.isfinite(positions[i]).all():
            return i
    return -1


def farthest_coordinates(positions):
    """Largest absolute x, y and z of `positions` (N, 3) [m]; 0 where there are none."""
    if not len(positions):
        return 0.0, 0.0, 0.0
    lower, upper = np.empty(3, np.float32), np.empty(3, np.float32)
    bounding_box(positions, lower, upper)
    return tuple(np.maximum(np.abs(lower), np.abs(upper)).tolist())


@kernel
def all_finite(values):
    """Whether no element of a contiguous array is infinite or no number."""
    flat = values.reshape(values.size)
    zeros = np.float32(0.0)
    for k in range(flat.size):
        zeros += np.float32(0.0) * flat[k]
    return zeros == np.float32(0.0)


@bare_kernel
def put_rows(rows, places, result):
    """result[places[k]] = rows[k].

    Args:
        rows: (N, K) float32.
        places: each row once, (N,) int32.
        result: (N, K) float32; written.
    """
    for k in range(places.shape[0]):
        for column in range(rows.shape[1]):
            result[places[k], column] = rows[k, column]


@parallel_kernel
def put_particles(positions, velocities, densities, ids, places, result):
    """Tell of each particle all that others want to know.

    Args:
        positions: [m], (N, 3).
        velocities: [m/s], (N, 3).
        densities: [kg/m^3], (N,).
        ids: (N,) uint32, in the order of the result.
        places: where each row goes, (N,) int32.
        result: x, y, z, vx, vy, vz, density, and the bits of the id, (N, 8) uint32; written.
    """
    numbers = result.view(np.float32)
    for k in prange(places.shape[0]):
        row = places[k]
        for axis in range(3):
            numbers[row, axis] = positions[k, axis]
            numbers[row, 3 + axis] = velocities[k, axis]
        numbers[row, 6] = densities[k]
        result[row, 7] = ids[row]


@parallel_kernel
def gather_state(
    order,
    starts,
    ends,
    velocities,
    pressures,
    clearance,
    particle,
    new_starts,
    new_ends,
    columns,
    new_velocities,
    new_pressures,
    new_clearance,
    new_particle,
):
    """new[k] = old[order[k]] for all that a particle has.

    Args:
        order: (N,).
        starts, ends: positions before and after a step [m], (N, 3); may be the same.
        velocities, pressures, clearance, particle: as in `Fluid`.
        new_starts, new_ends: (N, 3); written.
        columns: coordinates of the ends once more, (3, N + padding); written.
        new_velocities, new_pressures, new_clearance, new_particle: written.
    """
    for k in prange(order.shape[0]):
        i = order[k]
        for axis in range(3):
            new_starts[k, axis] = starts[i, axis]
            new_ends[k, axis] = columns[axis, k] = ends[i, axis]
            new_velocities[k, axis] = velocities[i, axis]
        new_pressures[k] = pressures[i]
        new_clearance[k] = clearance[i]
        new_particle[k] = particle[i]
