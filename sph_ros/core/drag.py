# SPDX-License-Identifier: Apache-2.0
"""Viscous friction at walls as part of an implicit solve.

Taken after the solve, friction would put back each step the layer of liquid that the solve has just
torn from the wall: a liquid thick enough to be solved implicitly would slip between its first two
layers.
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.contacts import FRACTION, NORMAL, SURFACE_VELOCITY, add_reaction
from sph_ros.core.jit import inlined
from sph_ros.core.team import parallel_kernel


@inlined
def sliding(terms, k, x, y, z):
    """Part of a velocity along the surface of contact k."""
    nx, ny, nz = terms[k, NORMAL], terms[k, NORMAL + 1], terms[k, NORMAL + 2]
    along = x * nx + y * ny + z * nz
    return x - along * nx, y - along * ny, z - along * nz


@parallel_kernel
def add_drag(contacts, rate, moving, velocities, result):
    """Add the drag of velocities relative to the solids' surfaces.

    Args:
        contacts: of this substep.
        rate: speed lost per sliding speed and wall fraction, time step included [-], float32.
        moving: 1 with the surfaces' own velocity, 0 as if they stood still, float32.
        velocities: [m/s], (N, 3).
        result: [m/s], (N, 3); added to.
    """
    terms = contacts.terms
    for i in prange(velocities.shape[0]):
        for k in range(contacts.start[i], contacts.end[i]):
            x, y, z = sliding(
                terms,
                k,
                velocities[i, 0] - moving * terms[k, SURFACE_VELOCITY],
                velocities[i, 1] - moving * terms[k, SURFACE_VELOCITY + 1],
                velocities[i, 2] - moving * terms[k, SURFACE_VELOCITY + 2],
            )
            share = rate * terms[k, FRACTION]
            result[i, 0] += share * x
            result[i, 1] += share * y
            result[i, 2] += share * z


@parallel_kernel
def drag_reactions(positions, contacts, motion, rate, scale, velocities, reactions):
    """Book what the drag gave to the solids.

    Args:
        positions: [m], (N, 3).
        contacts, motion: of this substep.
        rate: as in `add_drag`.
        scale: particle mass / substep [kg/s].
        velocities: that solve the implicit equation [m/s], (N, 3).
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    terms = contacts.terms
    count = positions.shape[0]
    for chunk in prange(reactions.shape[0]):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            for k in range(contacts.start[i], contacts.end[i]):
                x, y, z = sliding(
                    terms,
                    k,
                    velocities[i, 0] - terms[k, SURFACE_VELOCITY],
                    velocities[i, 1] - terms[k, SURFACE_VELOCITY + 1],
                    velocities[i, 2] - terms[k, SURFACE_VELOCITY + 2],
                )
                force = scale * rate * terms[k, FRACTION]
                add_reaction(
                    reactions,
                    np.int64(chunk),
                    contacts.solid[k],
                    motion,
                    positions[i, 0],
                    positions[i, 1],
                    positions[i, 2],
                    force * x,
                    force * y,
                    force * z,
                )
