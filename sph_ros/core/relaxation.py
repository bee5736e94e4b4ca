# SPDX-License-Identifier: Apache-2.0
"""Double density relaxation, solved for the pressure instead of taken in one explicit pass.

Clavet, Beaudoin & Poulin 2005 move each pair of neighbours at their predicted positions by
dt^2 [P (1 - q) + P_near (1 - q)^2] with P = k (rho - rho0), P_near = k_near rho_near. One such pass
is explicit in the stiffness k. Here the same displacements are taken with the pressures that the
particles have *after* the move, P = k (rho(x + u) - rho0) >= 0, found by relaxed Jacobi iteration
on the density linearised about the predicted positions (the scheme of Ihmsen et al. 2014, with the
compliance 1/k kept). So k may be that of a nearly incompressible liquid at any time step. The
near-pressure and the cohesive part of the pressure, which make surface tension, are soft and stay
explicit as in the paper.

Each particle gathers from its neighbours. The two sides of a pair are the same numbers with
opposite signs, so momentum is conserved to rounding.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.pair_sums import STEPS, impulse_of_pairs
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, spread
from sph_ros.core.vector_memory import gather, load, put, take, take_points


class Tension(NamedTuple):
    """Stiffnesses that make surface tension, times dt^2 / (rho0 virial); all float32.

    Attributes:
        cohesion: of the cohesive pressure [m^2].
        near: of the near-pressure [m^2].
        virial_ratio: virial of the density weight / virial of the near weight [-].
        adhesion: share of the cohesion that walls exert, 0 to 1 [-].
    """

    cohesion: np.float32
    near: np.float32
    virial_ratio: np.float32
    adhesion: np.float32


@parallel_kernel
def predict_positions(positions, velocities, gravity, time_step, predicted):
    """Positions after a step without any interaction (Clavet 2005, Alg. 1, lines 1-10).

    Args:
        positions: [m], (N, 3).
        velocities: [m/s], (N, 3).
        gravity: [m/s^2], (3,) float32.
        time_step: [s], float32.
        predicted: [m], (N, 3); written.
    """
    for i in prange(positions.shape[0]):
        for axis in range(3):
            velocity = velocities[i, axis] + time_step * gravity[axis]
            predicted[i, axis] = positions[i, axis] + time_step * velocity


@parallel_kernel
def cohesive_displacements(pairs, sums, contact_gradients, tension, weight_ratio, displacements):
    """Displacement by near-pressure and by the cohesive part of the pressure: surface tension.

    Both pressures are scaled by dt^2 / (rho0 virial) [m^2]. In the bulk at rest they cancel: the
    rest density of the cohesive part lies above 1 by near / cohesion. The work they do belongs to a
    potential (a sum of squares of both densities), so they cannot feed energy into a drop.

    Args:
        pairs, sums: from `sum_densities`.
        contact_gradients: gradients of the density and the near-density that walls add [1/m], (N,
            6).
        tension: scaled stiffnesses, `Tension`.
        weight_ratio: 3/2 density lattice sum / near lattice sum: near gradient per density gradient
            and (1 - r/h) [-], float32.
        displacements: [m], (N, 3); written.
    """
    cohesion, near = tension.cohesion, tension.near * tension.virial_ratio
    offset = cohesion + tension.near
    density, near_density = sums.density, sums.near_density
    step = weight_ratio / STEPS
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(density.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                own = cohesion * take(density, first) - offset
                own_near = near * take(near_density, first)
                x, y, z = spread(np.float32(0.0)), spread(np.float32(0.0)), spread(np.float32(0.0))
                for k in range(pairs.start[first], pairs.stop[s], LANES):
                    j = load(pairs.neighbors, k)
                    both = own + (cohesion * gather(density, j) - offset)
                    both_near = own_near + near * gather(near_density, j)
                    c = both + step * load(pairs.nearness, k) * both_near
                    x += c * load(pairs.x, k)
                    y += c * load(pairs.y, k)
                    z += c * load(pairs.z, k)
                unit, wall = -pairs.unit[0], tension.adhesion * own
                gx, gy, gz = take_points(contact_gradients, first, 0)
                nx, ny, nz = take_points(contact_gradients, first, 3)
                x = unit * x - wall * gx - own_near * nx
                y = unit * y - wall * gy - own_near * ny
                z = unit * z - wall * gz - own_near * nz
                put((x, y, z), displacements, first)
            chunk = next_chunk(turns, part, chunk_count(density.shape[0]))


@parallel_kernel
def viscous_impulses(
    pairs, positions, velocities, support_radius, linear, quadratic, most, changed
):
    """Velocities after the viscosity impulses (Clavet 2005, Alg. 5).

    The linear impulse acts on all pairs, not only on approaching ones: one-sided it would also
    press. The quadratic one acts on approaching pairs. All neighbours act at once, so each may take
    only so much of a relative speed that together they do not overshoot: that is `most`.

    Args:
        pairs: from `find_neighbors`.
        positions: [m], (N, 3), those of the lists.
        velocities: [m/s], (N, 3).
        support_radius: h [m], float32.
        linear: impulse per relative speed, time step included [-], float32.
        quadratic: impulse per squared relative speed, time step included [s/m], float32.
        most: share of the relative speed that a pair at zero distance may take [-], float32.
        changed: velocities afterwards [m/s], (N, 3); written.
    """
    inverse_h = np.float32(1.0) / support_radius
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                x, y, z = impulse_of_pairs(
                    pairs, positions, velocities, first, inverse_h, linear, quadratic, most
                )
                vx, vy, vz = take_points(velocities, first, 0)
                put((vx - x, vy - y, vz - z), changed, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))


@parallel_kernel
def viscous_operator(pairs, positions, velocities, support_radius, linear, result):
    """Left side of implicit viscosity: v minus the linear impulses that v itself would cause.

    Symmetric and positive definite, for conjugate gradients; constants pass unchanged, so momentum
    is kept by every iteration.

    Args:
        pairs, positions, velocities, support_radius, linear: as in `viscous_impulses`.
        result: [m/s], (N, 3); written.
    """
    inverse_h = np.float32(1.0) / support_radius
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                x, y, z = impulse_of_pairs(
                    pairs,
                    positions,
                    velocities,
                    first,
                    inverse_h,
                    linear,
                    np.float32(0.0),
                    np.float32(np.inf),
                )
                vx, vy, vz = take_points(velocities, first, 0)
                put((vx + x, vy + y, vz + z), result, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))


@parallel_kernel
def chunk_dots(a, b, sums):
    """Scalar product of (N, 3) arrays per chunk of rows, (chunks,) float64; written."""
    count = a.shape[0]
    for chunk in prange(sums.shape[0]):
        total = 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            for axis in range(3):
                total += np.float64(a[i, axis]) * np.float64(b[i, axis])
        sums[chunk] = total


@parallel_kernel
def finish_positions(predicted, displacements, longest, ends):
    """Relaxed positions: predicted plus displacement, no longer than `longest`.

    Args:
        predicted, displacements: [m], (N, 3).
        longest: [m], float32.
        ends: [m], (N, 3); written.
    """
    for i in prange(predicted.shape[0]):
        x, y, z = displacements[i, 0], displacements[i, 1], displacements[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        scale = np.float32(1.0)
        if length > longest:
            scale = longest / length
        ends[i, 0] = predicted[i, 0] + scale * x
        ends[i, 1] = predicted[i, 1] + scale * y
        ends[i, 2] = predicted[i, 2] + scale * z


@parallel_kernel
def velocities_from_positions(starts, ends, inverse_step, velocities, fastest):
    """Velocity is the way made over the step (Clavet 2005, Alg. 1, line 21).

    Args:
        starts, ends: [m], (N, 3).
        inverse_step: 1 / dt [1/s], float32.
        velocities: [m/s], (N, 3); written.
        fastest: largest squared speed of each chunk [m^2/s^2], (chunks,) float64; written.
    """
    count = starts.shape[0]
    for chunk in prange(fastest.shape[0]):
        most = 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            square = np.float32(0.0)
            for axis in range(3):
                velocity = (ends[i, axis] - starts[i, axis]) * inverse_step
                velocities[i, axis] = velocity
                square += velocity * velocity
            most = max(most, square)
        fastest[chunk] = most
