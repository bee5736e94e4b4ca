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

from sph_ros.core.contacts import GRADIENT, NEAR_GRADIENT, SURFACE_VELOCITY, add_reaction
from sph_ros.core.jit import parallel_kernel
from sph_ros.core.neighbors import CHUNK


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
def sum_densities(columns, velocities, support_radius, factors, pairs, state):
    """Pair geometry, densities and their rates of change (Mueller et al. 2003, eq. 3).

    Args:
        columns: cell-sorted coordinates [m], (3, N + padding).
        velocities: [m/s], (N, 3).
        support_radius: h [m], float32.
        factors: `Factors`.
        pairs: `gradients` is written: spiky gradient at i [1/m] and u.
        state: `density` and `rate` are written, without the walls.
    """
    one, two = np.float32(1.0), np.float32(2.0)
    inverse_h = one / support_radius
    density_scale, spiky_scale = factors.density_scale, factors.spiky_scale
    # Gradient of poly6 over that of spiky, per q (2 - u)^2.
    ratio = factors.colour_slope / spiky_scale
    xs, ys, zs = columns[0], columns[1], columns[2]
    density, rate = state.density, state.rate
    for i in prange(pairs.start.shape[0]):
        x, y, z = xs[i], ys[i], zs[i]
        vx, vy, vz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        w, change = np.float32(0.0), np.float32(0.0)
        start, end = pairs.start[i], pairs.end[i]
        js = pairs.neighbors[start:end]
        gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
        gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
        # One loop for each array written, as in `neighbors.sum_densities`.
        for k in range(js.shape[0]):
            j = js[k]
            dx = x - xs[j]
            dy = y - ys[j]
            dz = z - zs[j]
            # The tiny addend lets a particle be its own neighbour: 0 / tiny is 0.
            us[k] = dx * dx + dy * dy + dz * dz + np.float32(1e-20)
        for k in range(js.shape[0]):
            r2 = us[k]
            inverse_r = one / np.sqrt(r2)
            u = max(one - r2 * inverse_r * inverse_h, np.float32(0.0))
            us[k] = u
            gx[k] = -spiky_scale * u * u * inverse_r
            c = u * (two - u)
            w += c * c * c
        for k in range(js.shape[0]):
            gy[k] = gx[k] * (y - ys[js[k]])
        for k in range(js.shape[0]):
            gz[k] = gx[k] * (z - zs[js[k]])
        for k in range(js.shape[0]):
            gx[k] = gx[k] * (x - xs[js[k]])
        for k in range(js.shape[0]):
            j = js[k]
            u = us[k]
            along = (
                gx[k] * (vx - velocities[j, 0])
                + gy[k] * (vy - velocities[j, 1])
                + gz[k] * (vz - velocities[j, 2])
            )
            change += (one - u) * (two - u) * (two - u) * along
        # Each entry that only fills the list has counted as the particle itself, with weight 1.
        filling = np.float32(end - start - pairs.count[i])
        density[i] = density_scale * (w - filling)
        rate[i] = ratio * change


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
    half_drag, push = np.float32(0.5) * factors.drag, factors.push
    inverse_slope = np.float32(1.0) / factors.spiky_scale
    for i in prange(pressure.shape[0]):
        p, mu = pressure[i], viscosity[i]
        vx, vy, vz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        ax, ay, az = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        start, end = pairs.start[i], pairs.end[i]
        js = pairs.neighbors[start:end]
        gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
        gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
        for k in range(js.shape[0]):
            j = js[k]
            u = us[k]
            dx, dy, dz = vx - velocities[j, 0], vy - velocities[j, 1], vz - velocities[j, 2]
            along = max(dx * gx[k] + dy * gy[k] + dz * gz[k], np.float32(0.0))
            approach = along * inverse_slope / (u * u + np.float32(1e-6))
            both = volume[j] * (p + pressure[j] + factors.collision * approach * approach)
            share = half_drag * volume[j] * (mu + viscosity[j]) * u
            ax -= push * both * gx[k] + share * dx
            ay -= push * both * gy[k] + share * dy
            az -= push * both * gz[k] + share * dz
        wall = push * volume[i] * p
        scale = volume[i] * state.lightness[i]
        accelerations[i, 0] = scale * (ax - wall * contact_gradients[i, 3])
        accelerations[i, 1] = scale * (ay - wall * contact_gradients[i, 4])
        accelerations[i, 2] = scale * (az - wall * contact_gradients[i, 5])


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
    slope = factors.colour_slope / factors.spiky_scale
    per_row = np.float32(laplacians.shape[0] - 1) / factors.full_share
    count = volume.shape[0]
    for chunk in prange(totals.shape[0]):
        fx, fy, fz = 0.0, 0.0, 0.0
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            start, end = pairs.start[i], pairs.end[i]
            js = pairs.neighbors[start:end]
            gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
            gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
            nx, ny, nz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            bend = np.float32(0.0)
            for k in range(js.shape[0]):
                j, u = js[k], us[k]
                q = one - u
                v = volume[j] if family[j] == family[i] else np.float32(0.0)
                c = v * q * (two - u) * (two - u)
                nx += c * gx[k]
                ny += c * gy[k]
                nz += c * gz[k]
                bend += v * u * (two - u) * (d - (d + np.float32(4.0)) * q * q)
            filling = np.float32(end - start - pairs.count[i])
            bend = curve * (bend - filling * volume[i] * d)
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
