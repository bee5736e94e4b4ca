# SPDX-License-Identifier: Apache-2.0
"""Pressure, viscosity and colour-field forces of Mueller, Charypar & Gross 2003, gathered.

The weights are those of `mueller_weights`; their constants are folded into a few factors, because a
kernel needs the shapes alone. With q = r/h and u = 1 - q, which `Pairs.gradients` holds for every
pair beside the spiky gradient:

    poly6             (1 - q^2)^3 = (u (2 - u))^3
    spiky slope       u^2
    viscosity         u                      (its Laplacian)
    poly6 slope       q (u (2 - u))^2 = u^2 q (2 - u)^2
    poly6 Laplacian   (1 - q^2) (d - (d + 4) q^2)

Densities are relative to rest and volumes to that of a particle at rest, so that liquids of
different rest densities can touch without seeing a step in the number of neighbours (Solenthaler &
Pajarola 2008). The two sides of a pair are the same numbers with opposite signs.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.contacts import GRADIENT, NEAR_GRADIENT, SURFACE_VELOCITY, add_reaction
from sph_ros.core.pair_sums import STEPS, TINY, filling_of
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, inverse_root, larger, smaller, spread
from sph_ros.core.vector_memory import gather, gather_points, load, put, store, take, take_points


class State(NamedTuple):
    """What the forces on particles depend on beside positions and velocities.

    Attributes:
        density: relative to rest [-], (N,).
        rate: of its change [1/s], (N,).
        volume: relative to that at rest [-], (N,).
        pressure: [Pa], (N,).
        lightness: 1 / rest density [m^3/kg], (N,).
        viscosity: dynamic [Pa s], (N,).
        tension: surface tension [N/m], (N,).
        stiffness: pressure per relative compression [Pa], (N,).
        family: which liquid a particle is of, (N,) uint8.
    """

    density: np.ndarray
    rate: np.ndarray
    volume: np.ndarray
    pressure: np.ndarray
    lightness: np.ndarray
    viscosity: np.ndarray
    tension: np.ndarray
    stiffness: np.ndarray
    family: np.ndarray


class Factors(NamedTuple):
    """What the shapes of the weights are multiplied by; all float32.

    Attributes:
        dimension: 2 or 3.
        density_scale: 1 / lattice sum of poly6's shape [-].
        spiky_scale: length of the normalised spiky gradient over u^2 [1/m].
        push: 1 / virial of spiky: what makes the pressure the transmitted one [-].
        drag: viscosity's Laplacian over u, times the volume of a particle at rest [1/m^2].
        collision: pressure per squared approaching speed [kg/m^3].
        damping: time by which pressures look ahead [s].
        colour_slope: length of the colour's gradient over q (u (2 - u))^2 [1/m].
        colour_laplacian: of the colour, over (1 - q^2) (d - (d + 4) q^2) [1/m^2].
        least_normal: shorter ones belong to no surface [1/m].
        adhesion: share of the colour that walls have [-].
        full_share: of the rest density that a wall adds deep inside [-].
    """

    dimension: np.float32
    density_scale: np.float32
    spiky_scale: np.float32
    push: np.float32
    drag: np.float32
    collision: np.float32
    damping: np.float32
    colour_slope: np.float32
    colour_laplacian: np.float32
    least_normal: np.float32
    adhesion: np.float32
    full_share: np.float32


@parallel_kernel
def sum_densities(positions, velocities, support_radius, factors, pairs, state):
    """Pair geometry, densities and their rates of change (Mueller et al. 2003, eq. 3).

    Args:
        positions: [m], (N, 3), those of the lists.
        velocities: [m/s], (N, 3).
        support_radius: h [m], float32.
        factors: `Factors`.
        pairs: all but the lists is written: spiky gradient at i and u.
        state: `density` and `rate` are written, without the walls.
    """
    zero, one, two = np.float32(0.0), np.float32(1.0), np.float32(2.0)
    inverse_h = one / support_radius
    density_scale, spiky_scale = factors.density_scale, factors.spiky_scale
    # Gradient of poly6 over that of spiky, per q (2 - u)^2.
    ratio = -factors.colour_slope
    density, rate = state.density, state.rate
    pairs.unit[0] = -spiky_scale / STEPS
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                x, y, z = take_points(positions, first, 0)
                vx, vy, vz = take_points(velocities, first, 0)
                w, change = spread(zero), spread(zero)
                for k in range(pairs.start[first], pairs.stop[s], LANES):
                    j = load(pairs.neighbors, k)
                    dx, dy, dz = gather_points(positions, j)
                    dx, dy, dz = x - dx, y - dy, z - dz
                    r2 = dx * dx + dy * dy + dz * dz + TINY
                    inverse_r = inverse_root(r2)
                    u = larger(one - inverse_h * (r2 * inverse_r), spread(zero))
                    factor = u * u * inverse_r
                    dx, dy, dz = factor * dx, factor * dy, factor * dz
                    store(STEPS * u, pairs.nearness, k)
                    store(STEPS * dx, pairs.x, k)
                    store(STEPS * dy, pairs.y, k)
                    store(STEPS * dz, pairs.z, k)
                    c = u * (two - u)
                    w += c * c * c
                    ux, uy, uz = gather_points(velocities, j)
                    along = dx * (vx - ux)
                    along += dy * (vy - uy)
                    along += dz * (vz - uz)
                    change += (one - u) * (two - u) * (two - u) * along
                # Entries that only fill lists have counted as the particle itself, with weight 1.
                put(density_scale * (w - filling_of(pairs, first)), density, first)
                put(ratio * change, rate, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))


@parallel_kernel
def add_walls(velocities, contacts, state):
    """Add to densities and rates what the walls' mirrored liquid adds.

    Args:
        velocities: [m/s], (N, 3).
        contacts: with tables of poly6 and spiky.
        state: `density` and `rate` are changed.
    """
    density, rate = state.density, state.rate
    for i in prange(density.shape[0]):
        density[i] += contacts.density[i, 0]
        for k in range(contacts.start[i], contacts.end[i]):
            t = contacts.terms[k]
            for axis in range(3):
                sliding = velocities[i, axis] - t[SURFACE_VELOCITY + axis]
                rate[i] += t[GRADIENT + axis] * sliding


@parallel_kernel
def pressures_from_densities(damping, state):
    """Equation of state, p = k (density - rest) (eq. 12), with damping of sound; never negative.

    Args:
        damping: time by which pressures look ahead [s], float32.
        state: `pressure` and `volume` are written.
    """
    pressure, volume, stiffness = state.pressure, state.volume, state.stiffness
    for i in prange(pressure.shape[0]):
        compression = state.density[i] - np.float32(1.0) + damping * state.rate[i]
        pressure[i] = stiffness[i] * max(compression, np.float32(0.0))
        volume[i] = np.float32(1.0) / state.density[i]


@parallel_kernel
def pair_forces(pairs, velocities, factors, contact_gradients, state, accelerations):
    """Accelerations by pressure (eq. 10) and viscosity (eq. 14), walls' pressure included.

    Approaching pairs have a pressure more, in proportion to the square of their speed.

    Args:
        pairs: from `sum_densities`.
        velocities: [m/s], (N, 3).
        factors: `Factors`.
        contact_gradients: of the poly6 and spiky shares of walls [1/m], (N, 6).
        state: densities, volumes and pressures are read.
        accelerations: [m/s^2], (N, 3); written.
    """
    pressure, volume, viscosity = state.pressure, state.volume, state.viscosity
    lightness, walls = state.lightness, contact_gradients
    half_drag, push = np.float32(0.5) * factors.drag, factors.push
    zero, step = np.float32(0.0), np.float32(1.0) / STEPS
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                p, mu, own, unit = (
                    take(pressure, first),
                    take(viscosity, first),
                    take(volume, first),
                    pairs.unit[0],
                )
                vx, vy, vz = take_points(velocities, first, 0)
                ax, ay, az = spread(zero), spread(zero), spread(zero)
                for k in range(pairs.start[first], pairs.stop[s], LANES):
                    j = load(pairs.neighbors, k)
                    u = step * load(pairs.nearness, k)
                    x, y, z = load(pairs.x, k), load(pairs.y, k), load(pairs.z, k)
                    dx, dy, dz = gather_points(velocities, j)
                    dx, dy, dz = vx - dx, vy - dy, vz - dz
                    along = smaller(dx * x + dy * y + dz * z, spread(zero))
                    approach = step * along / (u * u + np.float32(1e-6))
                    there = gather(volume, j)
                    both = p + gather(pressure, j) + factors.collision * approach * approach
                    both = (push * unit) * there * both
                    share = half_drag * there * (mu + gather(viscosity, j)) * u
                    ax -= both * x + share * dx
                    ay -= both * y + share * dy
                    az -= both * z + share * dz
                wall = push * own * p
                scale = own * take(lightness, first)
                wx, wy, wz = take_points(walls, first, 3)
                ax, ay, az = ax - wall * wx, ay - wall * wy, az - wall * wz
                put((scale * ax, scale * ay, scale * az), accelerations, first)
            chunk = next_chunk(turns, part, chunk_count(velocities.shape[0]))


@parallel_kernel
def colour_forces(pairs, contacts, laplacians, factors, state, accelerations, totals):
    """Surface tension, -sigma Laplacian(c) n / |n| where n is long enough (eq. 17 to 19).

    Each liquid has its own colour, so there is tension between two as well. Walls count as liquid
    to the share of the adhesion. The forces do not sum to zero.

    Args:
        pairs: from `sum_densities`.
        contacts: with tables of poly6 and spiky.
        laplacians: of a wall's colour, for shares from 0 to `factors.full_share` [1/m^2], (T,).
        factors: `Factors`.
        state: volumes are read.
        accelerations: [m/s^2], (N, 3); added to.
        totals: sum of the forces over each chunk, per volume of a particle at rest [N/m^3],
            (chunks, 3) float64; written.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    volume, lightness, family = state.volume, state.lightness, state.family
    d = factors.dimension
    curve = factors.colour_laplacian
    # Gradient of poly6 over that of spiky, per q (2 - u)^2, and what gradients are kept in.
    slope, step = -factors.colour_slope / STEPS, one / STEPS
    per_row = np.float32(laplacians.shape[0] - 1) / factors.full_share
    count = volume.shape[0]
    for chunk in prange(totals.shape[0]):
        fx, fy, fz = 0.0, 0.0, 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            nx, ny, nz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            bend = np.float32(0.0)
            for k in range(pairs.start[i], pairs.end[i], LANES):
                j, u = np.int64(pairs.neighbors[k]), step * np.float32(pairs.nearness[k])
                q = one - u
                v = volume[j] if family[j] == family[i] else np.float32(0.0)
                c = v * q * (two - u) * (two - u)
                nx += c * np.float32(pairs.x[k])
                ny += c * np.float32(pairs.y[k])
                nz += c * np.float32(pairs.z[k])
                bend += v * u * (two - u) * (d - (d + np.float32(4.0)) * q * q)
            bend *= curve
            nx, ny, nz = slope * nx, slope * ny, slope * nz
            share = contacts.density[i, 0]
            if share > np.float32(0.0):
                row = min(np.int64(share * per_row), laplacians.shape[0] - 1)
                bend += factors.adhesion * laplacians[row]
                # Half of it, because the mirrored liquid moves along with the particle.
                half = np.float32(0.5) * factors.adhesion
                nx += half * contacts.gradients[i, 0]
                ny += half * contacts.gradients[i, 1]
                nz += half * contacts.gradients[i, 2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length < factors.least_normal:
                continue
            # The force per volume, on a particle of a volume relative to that at rest.
            force = -state.tension[i] * bend * volume[i] / length
            fx += force * nx
            fy += force * ny
            fz += force * nz
            force *= lightness[i]
            accelerations[i, 0] += force * nx
            accelerations[i, 1] += force * ny
            accelerations[i, 2] += force * nz
        totals[chunk, 0] = fx
        totals[chunk, 1] = fy
        totals[chunk, 2] = fz


@parallel_kernel
def pressure_reactions(positions, contacts, motion, scale, state, reactions):
    """Reaction to the walls' share of `pair_forces`.

    Args:
        positions: [m], (N, 3).
        contacts, motion: of this substep.
        scale: `Factors.push` times the volume of a particle at rest [m^3], float32.
        state: as in `pair_forces`.
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    count = positions.shape[0]
    for chunk in prange(reactions.shape[0]):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            force = scale * state.volume[i] * state.volume[i] * state.pressure[i]
            for k in range(contacts.start[i], contacts.end[i]):
                t = contacts.terms[k]
                add_reaction(
                    reactions,
                    np.int64(chunk),
                    contacts.solid[k],
                    motion,
                    positions[i, 0],
                    positions[i, 1],
                    positions[i, 2],
                    force * t[NEAR_GRADIENT],
                    force * t[NEAR_GRADIENT + 1],
                    force * t[NEAR_GRADIENT + 2],
                )
