# SPDX-License-Identifier: Apache-2.0
"""Leap-frog in its synchronised form: half a kick, a drift, new forces, half a kick.

Velocities in the middle of the step carry the positions on, as in Mueller et al. 2003; taking the
kick in two halves gives positions and velocities of the same moment (velocity Verlet).
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.team import parallel_kernel


@parallel_kernel
def kick_and_drift(positions, accelerations, time_step, velocities, ends):
    """First half of the kick, then on with the velocity of the middle of the step.

    Args:
        positions: [m], (N, 3).
        accelerations: at the start of the step [m/s^2], (N, 3).
        time_step: [s], float32.
        velocities: [m/s], (N, 3); changed.
        ends: [m], (N, 3); written.
    """
    half = np.float32(0.5) * time_step
    for i in prange(positions.shape[0]):
        for axis in range(3):
            velocities[i, axis] += half * accelerations[i, axis]
            ends[i, axis] = positions[i, axis] + time_step * velocities[i, axis]


@parallel_kernel
def take_stops(starts, origins, wanted, ends, inverse_step, velocities):
    """Take out of velocities what solids did not let happen.

    Only the difference goes in: velocities from positions would lose the digits that conserve
    momentum.

    Args:
        starts: where particles were [m], (N, 3).
        origins: the same, but for those that had to be rescued from between solids [m], (N, 3).
        wanted: where particles wanted to be [m], (N, 3).
        ends: where the solids let them be [m], (N, 3).
        inverse_step: 1 / dt [1/s], float32.
        velocities: [m/s], (N, 3); changed.
    """
    for i in prange(ends.shape[0]):
        for axis in range(3):
            # Only where there was a stop: terms of this sum may be taken in another order, and then
            # their rounding would brake what flies freely.
            if ends[i, axis] != wanted[i, axis] or origins[i, axis] != starts[i, axis]:
                stop = (ends[i, axis] - wanted[i, axis]) - (origins[i, axis] - starts[i, axis])
                velocities[i, axis] += stop * inverse_step


@parallel_kernel
def kick(accelerations, time_step, velocities, fastest, strongest):
    """Second half of the kick, and the largest speed and acceleration.

    Args:
        accelerations: at the end of the step [m/s^2], (N, 3).
        time_step: [s], float32.
        velocities: [m/s], (N, 3); changed.
        fastest: largest squared speed of each chunk [m^2/s^2], (chunks,) float64; written.
        strongest: largest squared acceleration of each chunk [m^2/s^4], (chunks,) float64; written.
    """
    half = np.float32(0.5) * time_step
    count = velocities.shape[0]
    for chunk in prange(fastest.shape[0]):
        speed, pull = 0.0, 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            v2, a2 = np.float32(0.0), np.float32(0.0)
            for axis in range(3):
                acceleration = accelerations[i, axis]
                velocities[i, axis] += half * acceleration
                v2 += velocities[i, axis] * velocities[i, axis]
                a2 += acceleration * acceleration
            speed, pull = max(speed, v2), max(pull, a2)
        fastest[chunk] = speed
        strongest[chunk] = pull
