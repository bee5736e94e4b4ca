# SPDX-License-Identifier: Apache-2.0
"""Forces between particles by the Lennard-Jones potential (Jones 1924), and what keeps them in.

U(r) = e ((a/r)^12 - 2 (a/r)^6), with its minimum -e at r = a, cut off at the support radius: a
linear function of r is added so that force and energy both vanish there, and nothing jumps when a
pair comes into reach. Particles of two families repel each other like all others, but only a share
of the attraction is left between them.
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.contacts import GRADIENT, add_reaction
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES

#: Pairs do not repel harder than at this distance, in a: a pair that starts closer must not fly
#: apart at any speed.
HARDEST = 0.7


@parallel_kernel
def pair_forces(
    columns,
    velocities,
    support_radius,
    distance,
    depths,
    attractions,
    rubs,
    family,
    pairs,
    lightness,
    accelerations,
):
    """Accelerations by all neighbours.

    Args:
        columns: cell-sorted coordinates [m], (3, N + padding).
        velocities: [m/s], (N, 3).
        support_radius: h [m], float32.
        distance: a, of the minimum [m], float32.
        depths: e between two families [J], (F, F) float32.
        attractions: share of the attraction that is left between two families [-], (F, F) float32.
        rubs: force per relative speed along the line of centres and (1 - r/h) between two families
            [kg/s], (F, F) float32.
        family: of each particle, (N,) uint8.
        pairs: neighbours from `find_neighbors`.
        lightness: 1 / mass of each family's particles [1/kg], (F,) float32.
        accelerations: [m/s^2], (N, 3); written.
    """
    xs, ys, zs = columns[0], columns[1], columns[2]
    one = np.float32(1.0)
    inverse_h = one / support_radius
    square = distance * distance
    nearest = np.float32(HARDEST) * np.float32(HARDEST) * square
    edge = (square * inverse_h * inverse_h) ** 3
    # 12 e / r^2 ((a/r)^12 - (a/r)^6) r at the cut-off, per e and unit vector.
    last = np.float32(12.0) * inverse_h * (edge * edge - edge)
    for i in prange(pairs.start.shape[0]):
        x, y, z = xs[i], ys[i], zs[i]
        vx, vy, vz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        mine = family[i]
        ax, ay, az = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for k in range(pairs.start[i], pairs.end[i], LANES):
            j = np.int64(pairs.neighbors[k])
            dx, dy, dz = x - xs[j], y - ys[j], z - zs[j]
            r2 = dx * dx + dy * dy + dz * dz
            # A particle is its own neighbour: its offset of 0 takes it out.
            inverse_r = one / np.sqrt(r2 + np.float32(1e-20))
            near2 = one / max(r2, nearest)
            six = (square * near2) ** 3
            force = np.float32(12.0) * np.sqrt(near2) * (six * six - six) - last
            if force < np.float32(0.0):
                force *= attractions[mine, family[j]]
            force *= depths[mine, family[j]]
            along = (
                (vx - velocities[j, 0]) * dx
                + (vy - velocities[j, 1]) * dy
                + (vz - velocities[j, 2]) * dz
            ) * inverse_r
            u = max(one - r2 * inverse_r * inverse_h, np.float32(0.0))
            force = (force - rubs[mine, family[j]] * u * along) * inverse_r
            ax += force * dx
            ay += force * dy
            az += force * dz
        scale = lightness[mine]
        accelerations[i, 0] = scale * ax
        accelerations[i, 1] = scale * ay
        accelerations[i, 2] = scale * az


@parallel_kernel
def wall_forces(positions, contacts, motion, strength, family, lightness, accelerations, reactions):
    """Push of the walls: the potential is `strength` times the fourth power of their share.

    Args:
        positions: [m], (N, 3).
        contacts, motion: of this substep.
        strength: energy deep in a wall [J], float32.
        family, lightness: as in `pair_forces`.
        accelerations: [m/s^2], (N, 3); added to.
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    count = positions.shape[0]
    for chunk in prange(reactions.shape[0]):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            force = np.float32(4.0) * strength * contacts.density[i, 0] ** 3
            scale = lightness[family[i]]
            for k in range(contacts.start[i], contacts.end[i]):
                t = contacts.terms[k]
                fx, fy, fz = force * t[GRADIENT], force * t[GRADIENT + 1], force * t[GRADIENT + 2]
                accelerations[i, 0] -= scale * fx
                accelerations[i, 1] -= scale * fy
                accelerations[i, 2] -= scale * fz
                x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
                add_reaction(reactions, chunk, contacts.solid[k], motion, x, y, z, fx, fy, fz)
