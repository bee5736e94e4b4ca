# SPDX-License-Identifier: Apache-2.0
"""Which places for new particles are free of others."""

import numpy as np

from sph_ros.core.jit import kernel


@kernel
def mark_taken(places, positions, distance, taken):
    """Mark the places that a particle is nearer to than a distance.

    Args:
        places: where particles shall appear, close together [m], (M, 3) float32.
        positions: of the particles that exist [m], (N, 3) float32.
        distance: to keep [m], float32.
        taken: set where a particle is too near, else left as it is, (M,) bool.
    """
    if places.shape[0] == 0:
        return
    square = distance * distance
    lower, upper = np.empty(3, np.float32), np.empty(3, np.float32)
    for axis in range(3):
        lower[axis] = places[:, axis].min() - distance
        upper[axis] = places[:, axis].max() + distance
    for i in range(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        if (
            x < lower[0]
            or x > upper[0]
            or y < lower[1]
            or y > upper[1]
            or z < lower[2]
            or z > upper[2]
        ):
            continue
        for k in range(places.shape[0]):
            dx, dy, dz = places[k, 0] - x, places[k, 1] - y, places[k, 2] - z
            if dx * dx + dy * dy + dz * dz < square:
                taken[k] = True
