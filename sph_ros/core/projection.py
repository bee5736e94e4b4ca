# SPDX-License-Identifier: Apache-2.0
"""What the incompressible solver does beside the passes that it shares with `relaxation`.

The pressures are those that make the density right after the step (the constant density condition
of IISPH, Ihmsen et al. 2014, and DFSPH, Bender & Koschier 2015, eq. 9-12): with the gradients g_ij
of the *present* positions x, the displacement w_i = dt v_i - sum_j (p_i + p_j) g_ij and

    density_i(x + w) <= 1,   p_i >= 0,

one of the two being an equality. The density after the step is linearised about the displacements
that the last step's pressures would cause, so a step may be long. Forces along the present lines of
centres and x += w make it a symplectic Euler step: momentum and angular momentum are kept to
rounding, and it is stable up to sqrt(3) times the step of prediction-relaxation, which pushes along
predicted lines of centres (a mode of squared frequency k: k dt^2 < 4 against 4/3).
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.contact_data import (
    GRADIENT,
    SURFACE_VELOCITY,
    to_solid,
    to_world,
    wall_gradients,
)
from sph_ros.core.jit import inlined
from sph_ros.core.pair_sums import weights_after
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, larger, smaller, spread, where
from sph_ros.core.vector_memory import gather_column, lanes_from, put, take, take_points

#: Excess of density that may be taken back over several steps [-].
MILD = np.float32(0.01)

#: Density below which a particle counts as spray [-].
SPRAY = 0.6


@inlined
def is_still(motion, s):
    """Whether solid s ends a substep where it began."""
    for axis in range(3):
        if motion.position[s, axis] != motion.old_position[s, axis]:
            return False
        for other in range(3):
            if motion.rotation[s, axis, other] != motion.old_rotation[s, axis, other]:
                return False
    return True


@parallel_kernel
def contact_velocities(positions, motion, inverse_step, contacts):
    """Velocity of the solids at the contacts: from their old pose to the new one in a step.

    Args:
        positions: [m], (N, 3), where the contacts were found with the solids at their old pose.
        motion: poses before and after the step.
        inverse_step: 1 / dt [1/s], float32.
        contacts: found as if in endless time, so that nothing moves; of solids that do, the surface
            velocities among `terms` are written.
    """
    # A name of its own: numba loses writes to arrays of a tuple inside prange.
    terms, solids = contacts.terms, contacts.solid
    moving = np.zeros(motion.position.shape[0], np.bool_)
    for s in range(moving.shape[0]):
        moving[s] = not is_still(motion, s)
    if not moving.any():
        return
    count, chunks = positions.shape[0], chunk_count(positions.shape[0])
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            i = np.intp(chunk * CHUNK)
            # Most contacts are with what stands still, so that of few the particle is looked up.
            for k in range(contacts.start[i], contacts.end[min(i + CHUNK, count) - 1]):
                s = solids[k]
                if not moving[s]:
                    continue
                while contacts.end[i] <= k:
                    i += 1
                x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
                lx, ly, lz = to_solid(motion.old_rotation, motion.old_position, s, x, y, z)
                nx, ny, nz = to_world(motion.rotation, motion.position, s, lx, ly, lz)
                terms[k, SURFACE_VELOCITY] = (nx - x) * inverse_step
                terms[k, SURFACE_VELOCITY + 1] = (ny - y) * inverse_step
                terms[k, SURFACE_VELOCITY + 2] = (nz - z) * inverse_step
            chunk = next_chunk(turns, part, chunks)


@parallel_kernel
def push(velocities, gravity, time_step, pulled, displacements):
    """Velocities under all forces but pressure, and where they lead.

    Args:
        velocities: [m/s], (N, 3); changed.
        gravity: [m/s^2], (3,) float32.
        time_step: [s], float32.
        pulled: whether there are other forces.
        displacements: those by other forces, from rest in one step [m], (N, 3); replaced by the
            way that the changed velocities make. What is in it is of no use if there are none.
    """
    inverse_step = np.float32(1.0) / time_step
    for i in prange(velocities.shape[0]):
        for axis in range(3):
            velocity = velocities[i, axis] + time_step * gravity[axis]
            if pulled:
                velocity += displacements[i, axis] * inverse_step
            velocities[i, axis] = velocity
            displacements[i, axis] = time_step * velocities[i, axis]


@parallel_kernel
def density_targets(
    positions,
    displacements,
    support_radius,
    power,
    density_scale,
    pairs,
    density,
    contacts,
    share,
    rest,
    time_step,
    targets,
    residuals,
):
    """Densities about which the pressures' part may be taken as linear.

    With t the targets, t_i + sum_j g_ij . (w_i - w_j) is the density after a displacement w, exact
    at the given displacements and linear in w.

    Args:
        positions: [m], (N, 3), those of the lists.
        displacements: expected ones [m], (N, 3).
        support_radius: h [m], float32.
        power: of the density's weight, as in `sum_densities`.
        density_scale: 1 / lattice sum of the weight [-], float32.
        pairs: from `sum_densities` at `positions`.
        density: at `positions`, relative to rest [-], (N,).
        contacts: with the solids' velocities.
        share: of an excess of density up to `MILD` that is to be taken back in this step [-],
            float32. A lack of density counts in full: so far a particle may be approached.
        rest: share of what is above `MILD` [-], float32.
        time_step: [s], float32.
        targets: [-], (N,); written.
        residuals: what of the density above 1 is to be taken back at the given displacements [-],
            (N,); written.
    """
    one = np.float32(1.0)
    bend = power - np.float32(2.0)
    count, walls = targets.shape[0], contacts.density
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(count))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                zero = spread(np.float32(0.0))
                weights, linear = weights_after(
                    pairs, positions, displacements, first, support_radius, bend
                )
                now = take(density, first)
                excess, mild = now - one, spread(MILD)
                back = share * smaller(excess, mild) + rest * larger(excess - mild, zero)
                wanted = where(excess > zero, back, excess)
                wall = gather_column(walls, lanes_from(first, count), 0)
                wanted += density_scale * weights - (now - wall)
                put(wanted - linear + one, targets, first)
                x, y, z = take_points(displacements, first, 0)
                gx, gy, gz = wall_gradients(contacts, first)
                put(wanted + gx * x + gy * y + gz * z, residuals, first)
                for i in range(first, min(first + LANES, count)):
                    for k in range(contacts.start[i], contacts.end[i]):
                        t = contacts.terms[k]
                        for axis in range(3):
                            brought = time_step * t[GRADIENT + axis] * t[SURFACE_VELOCITY + axis]
                            targets[i] -= brought
                            residuals[i] -= brought
            chunk = next_chunk(turns, part, chunk_count(count))


@parallel_kernel
def move(positions, free, displacements, longest, inverse_step, ends, wanted, origins, velocities):
    """Positions and velocities after a step.

    Velocities get only what the pressures changed: velocities from positions would lose digits, and
    with them momentum.

    Args:
        positions: [m], (N, 3).
        free: displacements without pressure [m], (N, 3).
        displacements: with pressure [m], (N, 3).
        longest: displacements are cut at this length [m], float32.
        inverse_step: 1 / dt [1/s], float32.
        ends, wanted: where the particles get to [m], (N, 3); written.
        origins: the positions once more; written.
        velocities: those of `free` [m/s], (N, 3); changed.
    """
    for i in prange(positions.shape[0]):
        x, y, z = displacements[i, 0], displacements[i, 1], displacements[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        scale = np.float32(1.0)
        if length > longest:
            scale = longest / length
        for axis in range(3):
            step = scale * displacements[i, axis]
            ends[i, axis] = wanted[i, axis] = positions[i, axis] + step
            origins[i, axis] = positions[i, axis]
            velocities[i, axis] += (step - free[i, axis]) * inverse_step


@parallel_kernel
def take_stops(starts, origins, wanted, ends, inverse_step, density, velocities, fastest):
    """Take out of velocities what solids did not let happen, and go where they let it be.

    Args:
        starts: where particles were [m], (N, 3); the ends afterwards.
        origins: the same, but for those that had to be rescued from between solids [m], (N, 3).
        wanted: where particles wanted to be [m], (N, 3).
        ends: where the solids let them be [m], (N, 3).
        inverse_step: 1 / dt [1/s], float32.
        density: before the step, relative to rest [-], (N,).
        velocities: [m/s], (N, 3); changed.
        fastest: largest squared speed of each chunk [m^2/s^2], (chunks,) float64; written. That of
            spray counts a quarter: a drop may fly farther in a step than liquid among liquid.
    """
    count = ends.shape[0]
    for chunk in prange(fastest.shape[0]):
        most = 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            square = np.float32(0.0)
            for axis in range(3):
                # Only where there was a stop: terms of this sum may be taken in another order, and
                # their rounding would cost momentum.
                if ends[i, axis] != wanted[i, axis] or origins[i, axis] != starts[i, axis]:
                    stop = (ends[i, axis] - wanted[i, axis]) - (origins[i, axis] - starts[i, axis])
                    velocities[i, axis] += stop * inverse_step
                starts[i, axis] = ends[i, axis]
                square += velocities[i, axis] * velocities[i, axis]
            if density[i] < SPRAY:
                square *= np.float32(0.25)
            most = max(most, square)
        fastest[chunk] = most
