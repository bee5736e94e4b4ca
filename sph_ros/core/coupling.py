# SPDX-License-Identifier: Apache-2.0
"""Liquid and free bodies push each other, solved together.

The walls' part of a particle's density changes with the particle's motion against the body:
G . (u_i - U(x_i)), with G the gradient of a contact and U the motion of the body's point. The
particle's pressure p moves the particle by -p G and the body by M^-1 J^T p, J = (G, r x G): the
same numbers with opposite signs, so momentum is conserved, and the pressure's operator stays
symmetric and positive. As the bodies give way *within* the pressure iterations, a body may be
lighter than the liquid it drags along; taking turns with the liquid would diverge then (the added
mass effect, Causin et al. 2005).

All loops here run on one thread, in order: only the few particles that touch free bodies matter.
"""

from typing import NamedTuple

import numpy as np

from sph_ros.core.contact_data import FRACTION, GRADIENT, NORMAL, SURFACE_VELOCITY
from sph_ros.core.impulses import settle_touches
from sph_ros.core.jit import kernel


class Wetted(NamedTuple):
    """Contacts of particles with free bodies; row per contact.

    Attributes:
        particle: row of the particle, (K,) int32.
        contact: row in the `Contacts`, (K,) int64.
        body: (K,) int32.
        jacobian: gradient of the contact G and r x G, r from the body's centre of mass
            [1/m], [-], (K, 6) float64.
        arm: r [m], (K, 3) float64.
    """

    particle: np.ndarray
    contact: np.ndarray
    body: np.ndarray
    jacobian: np.ndarray
    arm: np.ndarray


@kernel
def wetted_contacts(positions, contacts, body_of, centres):
    """The contacts with free bodies, in the order of the particles.

    Args:
        positions: that the contacts were found at [m], (N, 3).
        contacts: `Contacts`.
        body_of: which free body a solid is, or -1, (S,) int32.
        centres: of mass where the contacts were found [m], (B, 3).

    Returns:
        `Wetted`.
    """
    count = 0
    for i in range(positions.shape[0]):
        for k in range(contacts.start[i], contacts.end[i]):
            if body_of[contacts.solid[k]] >= 0:
                count += 1
    particle, contact = np.empty(count, np.int32), np.empty(count, np.int64)
    body, jacobian = np.empty(count, np.int32), np.empty((count, 6))
    arm = np.empty((count, 3))
    row = 0
    for i in range(positions.shape[0]):
        for k in range(contacts.start[i], contacts.end[i]):
            b = body_of[contacts.solid[k]]
            if b < 0:
                continue
            particle[row], contact[row], body[row] = i, k, b
            for axis in range(3):
                arm[row, axis] = positions[i, axis] - centres[b, axis]
                jacobian[row, axis] = contacts.terms[k, GRADIENT + axis]
            r, j = arm[row], jacobian[row]
            j[3] = r[1] * j[2] - r[2] * j[1]
            j[4] = r[2] * j[0] - r[0] * j[2]
            j[5] = r[0] * j[1] - r[1] * j[0]
            row += 1
    return Wetted(particle, contact, body, jacobian, arm)


@kernel
def add_body_diagonal(wetted, roots, scale, diagonal):
    """What bodies that give way add to the diagonal that pressure corrections are divided by.

    For each of the six motions c of a body its part of the operator is scale b_c b_c^T, which is
    never more than the diagonal matrix scale |b_c| sum |b_c| (Gershgorin). With that the Jacobi
    iteration is as stable as without bodies, however light they are.

    Args:
        wetted: `Wetted`.
        roots: matrices L with L L^T = inverse mass matrix, (B, 6, 6).
        scale: mass of a particle [kg], or whatever makes displacements of impulses.
        diagonal: (N,); added to.
    """
    bodies = roots.shape[0]
    sums = np.zeros((bodies, 6))
    rows = np.zeros((wetted.body.shape[0], 6))
    for k in range(wetted.body.shape[0]):
        b = wetted.body[k]
        for c in range(6):
            total = 0.0
            for axis in range(6):
                total += roots[b, axis, c] * wetted.jacobian[k, axis]
            rows[k, c] = abs(total)
            sums[b, c] += rows[k, c]
    for k in range(wetted.body.shape[0]):
        b = wetted.body[k]
        added = 0.0
        for c in range(6):
            added += rows[k, c] * sums[b, c]
        diagonal[wetted.particle[k]] += scale * added


@kernel
def give_way(wetted, pressures, scale, free, inertias, touches, count, tolerance, passes, result):
    """Velocities of the bodies under the present pressures, other bodies and walls in their way.

    Args:
        wetted: `Wetted`.
        pressures: of the particles, (N,).
        scale: pressure times G becomes an impulse [N s] by it.
        free: velocities without pressures and touches, (B, 6).
        inertias, touches, count, tolerance, passes: as in `keep_apart`.
        result: velocities, (B, 6); written.
    """
    impulses = np.zeros(free.shape)
    for k in range(wetted.body.shape[0]):
        push = scale * pressures[wetted.particle[k]]
        if push != 0.0:
            for axis in range(6):
                impulses[wetted.body[k], axis] += push * wetted.jacobian[k, axis]
    for b in range(free.shape[0]):
        for axis in range(3):
            turn = 0.0
            for other in range(3):
                turn += inertias.inverse_inertia[b, axis, other] * impulses[b, 3 + other]
            result[b, axis] = free[b, axis] + inertias.inverse_mass[b, axis] * impulses[b, axis]
            result[b, 3 + axis] = free[b, 3 + axis] + turn
    settle_touches(touches, count, inertias, tolerance, passes, result)


@kernel
def yielded_density(wetted, motion, yielded):
    """How much the walls' part of the density grows where bodies move.

    Args:
        wetted: `Wetted`.
        motion: displacements (or velocities) of the bodies beyond those that the contacts were
            found with [m], [rad], (B, 6).
        yielded: G . U for each particle, (N,); written where a free body is near.
    """
    for k in range(wetted.body.shape[0]):
        yielded[wetted.particle[k]] = 0.0
    for k in range(wetted.body.shape[0]):
        total = 0.0
        for axis in range(6):
            total += wetted.jacobian[k, axis] * motion[wetted.body[k], axis]
        yielded[wetted.particle[k]] += total


@kernel
def move_surfaces(wetted, velocities, contacts):
    """Give the contacts with free bodies the present velocities of the bodies' surfaces."""
    terms = contacts.terms
    for k in range(wetted.body.shape[0]):
        v, r, row = velocities[wetted.body[k]], wetted.arm[k], wetted.contact[k]
        terms[row, SURFACE_VELOCITY] = v[0] + v[4] * r[2] - v[5] * r[1]
        terms[row, SURFACE_VELOCITY + 1] = v[1] + v[5] * r[0] - v[3] * r[2]
        terms[row, SURFACE_VELOCITY + 2] = v[2] + v[3] * r[1] - v[4] * r[0]


@kernel
def friction_system(wetted, contacts, particle_velocities, rate, drag, mass, matrix, right):
    """Friction between liquid and free bodies as the linear system of the bodies' new velocities.

    Each particle takes the share w / (1 + w) of its slip (see `rub_on_solids`), taken against the
    velocity that the body will have: (M + sum m share T^T T) V' = M V + sum m share T^T v, with T
    the motion of the surface across its normal. However thick the liquid is, the body then ends
    between its own velocity and that of the liquid.

    Args:
        wetted, contacts: with the present surface velocities.
        particle_velocities: [m/s], (N, 3).
        rate, drag: as in `rub_on_solids`.
        mass: of a particle [kg].
        matrix: M, (B, 6, 6); added to.
        right: M V, (B, 6); added to.
    """
    across = np.zeros((3, 6))
    for k in range(wetted.body.shape[0]):
        i, b, t = wetted.particle[k], wetted.body[k], contacts.terms[wetted.contact[k]]
        r, v = wetted.arm[k], particle_velocities[i]
        # Rows: the surface's velocity per velocity of the body, without the part along the normal.
        across[:] = 0.0
        for axis in range(3):
            across[axis, axis] = 1.0
        across[0, 4], across[0, 5] = r[2], -r[1]
        across[1, 5], across[1, 3] = r[0], -r[2]
        across[2, 3], across[2, 4] = r[1], -r[0]
        slip, along = 0.0, 0.0
        for axis in range(3):
            along += (v[axis] - t[SURFACE_VELOCITY + axis]) * t[NORMAL + axis]
        for axis in range(3):
            part = v[axis] - t[SURFACE_VELOCITY + axis] - along * t[NORMAL + axis]
            slip += part * part
        for column in range(6):
            along = 0.0
            for axis in range(3):
                along += across[axis, column] * t[NORMAL + axis]
            for axis in range(3):
                across[axis, column] -= along * t[NORMAL + axis]
        wanted = (rate + drag * np.sqrt(slip)) * t[FRACTION]
        weight = mass * wanted / (1.0 + wanted)
        for row in range(6):
            for axis in range(3):
                right[b, row] += weight * across[axis, row] * v[axis]
                for column in range(6):
                    matrix[b, row, column] += weight * across[axis, row] * across[axis, column]
