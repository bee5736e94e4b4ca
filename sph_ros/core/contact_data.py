# SPDX-License-Identifier: Apache-2.0
"""What kernels keep of solids near particles: poses, contacts, forces; and changes of frame."""

from typing import NamedTuple

import numpy as np

from sph_ros.core.jit import inlined
from sph_ros.core.vector import LANES, spread
from sph_ros.core.vector_memory import take_points

#: Columns of `Contacts.terms`.
FRACTION, NEAR_FRACTION, GRADIENT, NEAR_GRADIENT, NORMAL, SURFACE_VELOCITY = 0, 1, 2, 5, 8, 11
DISTANCE = 14
TERMS = 15


class Motion(NamedTuple):
    """Where the solids are at the start and at the end of a substep.

    Attributes:
        old_position, position: origins, world frame [m], (S, 3) float32.
        old_rotation, rotation: world from solid, (S, 3, 3) float32.
    """

    old_position: np.ndarray
    old_rotation: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


class Contacts(NamedTuple):
    """Contacts of particle i are rows start[i]:end[i].

    Attributes:
        start, end: (N,) int32.
        solid: (K,) int32.
        terms: the columns named above, world frame; gradients already include the other solids'
            share and are [1/m], the surface's velocity [m/s], its distance [m], (K, TERMS) float32.
        density: density and near-density that all solids add to particle i [-], (N, 2).
        gradients: sums of the gradients over the contacts [1/m], (N, 6).
        touching: whether any of sixteen particles has a contact, (ceil(N / LANES),) uint8.
    """

    start: np.ndarray
    end: np.ndarray
    solid: np.ndarray
    terms: np.ndarray
    density: np.ndarray
    gradients: np.ndarray
    touching: np.ndarray


@inlined
def wall_gradients(contacts, first):
    """Gradients of the density that walls add to a slice, x, y, z; read only where there are any.

    Args:
        contacts: from `find_contacts`.
        first: particle of the slice.
    """
    if contacts.touching[first // LANES]:
        return take_points(contacts.gradients, first, 0)
    nothing = spread(np.float32(0.0))
    return nothing, nothing, nothing


@inlined
def to_solid(rotation, origin, s, x, y, z):
    """World point in the frame of solid s."""
    dx, dy, dz = x - origin[s, 0], y - origin[s, 1], z - origin[s, 2]
    r = rotation[s]
    return (
        r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz,
        r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz,
        r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz,
    )


@inlined
def rotate(rotation, s, x, y, z):
    """World direction of a direction in the frame of solid s."""
    r = rotation[s]
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@inlined
def to_world(rotation, origin, s, x, y, z):
    """World point of a point in the frame of solid s."""
    wx, wy, wz = rotate(rotation, s, x, y, z)
    return wx + origin[s, 0], wy + origin[s, 1], wz + origin[s, 2]


@inlined
def write_surface_velocity(motion, s, lx, ly, lz, x, y, z, inverse_step, terms, row):
    """Velocity of the point of solid s that is now at (x, y, z), in its own frame (lx, ly, lz)."""
    # It was there before the substep.
    ox, oy, oz = to_world(motion.old_rotation, motion.old_position, s, lx, ly, lz)
    terms[row, SURFACE_VELOCITY] = (x - ox) * inverse_step
    terms[row, SURFACE_VELOCITY + 1] = (y - oy) * inverse_step
    terms[row, SURFACE_VELOCITY + 2] = (z - oz) * inverse_step


@inlined
def add_reaction(reactions, chunk, s, motion, x, y, z, fx, fy, fz):
    """Add a force at a world point to the wrench on solid s about its origin."""
    rx = x - motion.position[s, 0]
    ry = y - motion.position[s, 1]
    rz = z - motion.position[s, 2]
    reactions[chunk, s, 0] += fx
    reactions[chunk, s, 1] += fy
    reactions[chunk, s, 2] += fz
    reactions[chunk, s, 3] += ry * fz - rz * fy
    reactions[chunk, s, 4] += rz * fx - rx * fz
    reactions[chunk, s, 5] += rx * fy - ry * fx
