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

from sph_ros.core.chunks import PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.jit import inlined
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, larger, smaller, spread
from sph_ros.core.vector_memory import gather_points, load, put, take, take_points

#: Determinant of M, relative to the lattice's, that stands for no neighbours at all [-].
NOTHING = np.float32(1e-9)


@inlined
def solved(matrix, least, x, y, z):
    """Solutions of symmetric systems of three equations, and determinants, at least `least`."""
    xx, yy, zz, xy, xz, yz = matrix
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = larger(xx * a + xy * b + xz * c, spread(least))
    return (
        (a * x + b * y + c * z) / determinant,
        (b * x + d * y + e * z) / determinant,
        (c * x + e * y + f * z) / determinant,
        determinant,
    )


@inlined
def matrix_of_pairs(pairs, positions, first):
    """M of the particles of a slice [-]: xx, yy, zz, xy, xz, yz."""
    zero = np.float32(0.0)
    xx, yy, zz = spread(zero), spread(zero), spread(zero)
    xy, xz, yz = spread(zero), spread(zero), spread(zero)
    x, y, z = take_points(positions, first, 0)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        j = load(pairs.neighbors, k)
        dx, dy, dz = gather_points(positions, j)
        dx, dy, dz = dx - x, dy - y, dz - z
        gx, gy, gz = load(pairs.x, k), load(pairs.y, k), load(pairs.z, k)
        xx += gy * dy + gz * dz
        yy += gx * dx + gz * dz
        zz += gx * dx + gy * dy
        xy -= gx * dy
        xz -= gx * dz
        yz -= gy * dz
    unit = pairs.unit[0]
    return unit * xx, unit * yy, unit * zz, unit * xy, unit * xz, unit * yz


@inlined
def turning_of_pairs(pairs, velocities, first):
    """Sum of g_ij x (v_j - v_i) over the neighbours j of a slice, x, y, z [1/s]."""
    zero = np.float32(0.0)
    x, y, z = spread(zero), spread(zero), spread(zero)
    vx, vy, vz = take_points(velocities, first, 0)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        j = load(pairs.neighbors, k)
        gx, gy, gz = load(pairs.x, k), load(pairs.y, k), load(pairs.z, k)
        a, b, c = gather_points(velocities, j)
        a, b, c = a - vx, b - vy, c - vz
        x += gy * c - gz * b
        y += gz * a - gx * c
        z += gx * b - gy * a
    unit = pairs.unit[0]
    return unit * x, unit * y, unit * z


@parallel_kernel
def rub_spins(
    pairs,
    positions,
    sums,
    velocities,
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
        positions: [m], (N, 3), those of the lists.
        velocities: [m/s], (N, 3).
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
    least = NOTHING * determinant
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                matrix = matrix_of_pairs(pairs, positions, first)
                x, y, z = turning_of_pairs(pairs, velocities, first)
                x, y, z, found = solved(matrix, least, x, y, z)
                known = smaller(found / determinant, spread(one))
                gx, gy, gz = take_points(gradients, first, 0)
                uneven = (take(squares, first) + gx * gx + gy * gy + gz * gz) / square
                known *= known / larger(uneven * uneven, spread(one))
                if new:
                    put((known * x, known * y, known * z), spins, first)
                strength = exchange * known
                share = strength / (square_radius + strength)
                wx, wy, wz = take_points(spins, first, 0)
                x, y, z = wx - x, wy - y, wz - z
                put((wx - share * x, wy - share * y, wz - share * z), spins, first)
                strength *= one - share
                x, y, z, _ = solved(matrix, least, x, y, z)
                put((strength * x, strength * y, strength * z), pushes, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))


@parallel_kernel
def push_by_spins(pairs, pushes, velocities):
    """What flywheels do to the liquid: velocities lose the sum of (p_i + p_j) x g_ij.

    Args:
        pairs: from `sum_densities`.
        pushes: from `rub_spins` [m^2/s], (N, 3).
        velocities: [m/s], (N, 3); changed.
    """
    zero = np.float32(0.0)
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                x, y, z = spread(zero), spread(zero), spread(zero)
                px, py, pz = take_points(pushes, first, 0)
                for k in range(pairs.start[first], pairs.stop[s], LANES):
                    j = load(pairs.neighbors, k)
                    gx, gy, gz = load(pairs.x, k), load(pairs.y, k), load(pairs.z, k)
                    a, b, c = gather_points(pushes, j)
                    a, b, c = px + a, py + b, pz + c
                    x += b * gz - c * gy
                    y += c * gx - a * gz
                    z += a * gy - b * gx
                unit = pairs.unit[0]
                vx, vy, vz = take_points(velocities, first, 0)
                put((vx - unit * x, vy - unit * y, vz - unit * z), velocities, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
