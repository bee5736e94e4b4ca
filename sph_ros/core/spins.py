# SPDX-License-Identifier: Apache-2.0
"""Particles that turn: a micropolar liquid (Eringen 1966; in SPH, Bender et al. 2017).

Each particle is a flywheel of angular velocity w [rad/s] with the radius of gyration R, so its
moment of inertia per mass is R^2. It rubs on the liquid around, which turns at

    n_i = M_i^-1 sum_j g_ij x (v_j - v_i),   M_i = sum_j (g_ij . r_ij - g_ij r_ij^T):

half the vorticity, taken so that it is exact where neighbours turn like a rigid body, at a free
surface too. With the rubbing c a_i |w_i - n_i|^2 / 2 of each particle per mass and time, forces and
torques are its derivatives by the velocities and the spins,

    dv_i/dt = -sum_j (p_i + p_j) x g_ij,   R^2 dw_i/dt = -c a_i (w_i - n_i),
    p_i = c a_i M_i^-1 (w_i - n_i).

Pairs push each other with opposite forces: momentum is kept. A rigid rotation of all, flywheels
included, rubs on nothing: angular momentum, with that of the flywheels, is kept. All that happens
to the energy of both is that rubbing takes from it. (The model of Bender et al. lacks the reaction
of the liquid's rotation on itself, -n_i in p_i, and so may feed energy.)
"""

import numpy as np
from numba import prange

from sph_ros.core.jit import device, parallel_kernel

#: Determinant of M, relative to the lattice's, that stands for no neighbours at all [-].
NOTHING = np.float32(1e-9)


@device
def solved(xx, yy, zz, xy, xz, yz, least, x, y, z):
    """Solution of a symmetric system of three equations, and its determinant, at least `least`."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = max(xx * a + xy * b + xz * c, least)
    scale = np.float32(1.0) / determinant
    return (
        scale * (a * x + b * y + c * z),
        scale * (b * x + d * y + e * z),
        scale * (c * x + e * y + f * z),
        determinant,
    )


@device
def matrix_of_pairs(pairs, support_radius, i):
    """M of particle i [-]: xx, yy, zz, xy, xz, yz."""
    xx, yy, zz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    xy, xz, yz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    start, end = pairs.start[i], pairs.end[i]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
    for k in range(us.shape[0]):
        x2, y2, z2 = gx[k] * gx[k], gy[k] * gy[k], gz[k] * gz[k]
        # The distance over the gradient's length; a particle's own gradient is 0.
        length = np.sqrt(max(x2 + y2 + z2, np.float32(1e-20)))
        c = support_radius * (np.float32(1.0) - us[k]) / length
        xx += c * (y2 + z2)
        yy += c * (x2 + z2)
        zz += c * (x2 + y2)
        xy -= c * gx[k] * gy[k]
        xz -= c * gx[k] * gz[k]
        yz -= c * gy[k] * gz[k]
    return xx, yy, zz, xy, xz, yz


@device
def turning_of_pairs(pairs, velocities, i):
    """Sum of g_ij x (v_j - v_i) over the neighbours j of particle i, x, y, z [1/s]."""
    x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    vx, vy, vz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
    start, end = pairs.start[i], pairs.end[i]
    js = pairs.neighbors[start:end]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz = pairs.gradients[2, start:end]
    for k in range(js.shape[0]):
        j = js[k]
        a, b, c = velocities[j, 0] - vx, velocities[j, 1] - vy, velocities[j, 2] - vz
        x += gy[k] * c - gz[k] * b
        y += gz[k] * a - gx[k] * c
        z += gx[k] * b - gy[k] * a
    return x, y, z


@parallel_kernel
def rub_spins(
    pairs,
    sums,
    velocities,
    support_radius,
    determinant,
    square,
    exchange,
    square_radius,
    new,
    spins,
    pushes,
):
    """Spins after a step of rubbing on the liquid, and how it is pushed for that.

    Particles with too few neighbours to say how the liquid turns rub little (a_i), spray nothing,
    and so do those in clumps, where so many would push at once that velocities overshoot. The spin
    is taken at the end of the step, so rubbing may be as strong as it likes against it.

    Args:
        pairs, sums: from `sum_densities`.
        velocities: [m/s], (N, 3).
        support_radius: h [m], float32.
        determinant: of M in the lattice [-], float32.
        square: sum of squared gradients in the lattice [1/m^2], float32.
        exchange: c times the step [m^2], float32.
        square_radius: R^2 [m^2], float32.
        new: whether the spins have to be made up: as the liquid turns.
        spins: angular velocities [rad/s], (N, 3); changed.
        pushes: p_i times the step [m^2/s], (N, 3); written.
    """
    one = np.float32(1.0)
    gradients, squares = sums.gradient, sums.gradient_square
    for i in prange(spins.shape[0]):
        xx, yy, zz, xy, xz, yz = matrix_of_pairs(pairs, support_radius, i)
        least = NOTHING * determinant
        x, y, z = turning_of_pairs(pairs, velocities, i)
        x, y, z, found = solved(xx, yy, zz, xy, xz, yz, least, x, y, z)
        known = min(found / determinant, one)
        gx, gy, gz = gradients[i, 0], gradients[i, 1], gradients[i, 2]
        uneven = (squares[i] + gx * gx + gy * gy + gz * gz) / square
        known *= known / max(uneven * uneven, one)
        if new:
            spins[i, 0], spins[i, 1], spins[i, 2] = known * x, known * y, known * z
        strength = exchange * known
        share = strength / (square_radius + strength)
        x, y, z = spins[i, 0] - x, spins[i, 1] - y, spins[i, 2] - z
        spins[i, 0] -= share * x
        spins[i, 1] -= share * y
        spins[i, 2] -= share * z
        strength *= one - share
        x, y, z, _ = solved(xx, yy, zz, xy, xz, yz, least, x, y, z)
        pushes[i, 0], pushes[i, 1], pushes[i, 2] = strength * x, strength * y, strength * z


@parallel_kernel
def push_by_spins(pairs, pushes, velocities):
    """What flywheels do to the liquid: velocities lose the sum of (p_i + p_j) x g_ij.

    Args:
        pairs: from `sum_densities`.
        pushes: from `rub_spins` [m^2/s], (N, 3).
        velocities: [m/s], (N, 3); changed.
    """
    for i in prange(velocities.shape[0]):
        x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        px, py, pz = pushes[i, 0], pushes[i, 1], pushes[i, 2]
        start, end = pairs.start[i], pairs.end[i]
        js = pairs.neighbors[start:end]
        gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
        gz = pairs.gradients[2, start:end]
        for k in range(js.shape[0]):
            j = js[k]
            a, b, c = px + pushes[j, 0], py + pushes[j, 1], pz + pushes[j, 2]
            x += b * gz[k] - c * gy[k]
            y += c * gx[k] - a * gz[k]
            z += a * gy[k] - b * gx[k]
        velocities[i, 0] -= x
        velocities[i, 1] -= y
        velocities[i, 2] -= z
