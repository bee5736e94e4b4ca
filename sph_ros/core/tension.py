# SPDX-License-Identifier: Apache-2.0
"""Surface tension of the incompressible solver: an energy of the colour and of its gradient.

The colour c of a particle is the share of its surroundings within the reach H that is liquid.
Particles of the volume V at the spacing s have the energy

    E = V sum_i e_i,   e = a (sqrt(|s grad c|^2 + d^2) - d) + b/2 max(c_0 - c, 0)^2,
    c_i = sum_j W_ij / (what walls leave free),   W ~ (1 - r^2/H^2)^3.

Only those near the surface have any. The first term is the total variation of the colour (the
area, by the coarea formula) whatever the profile of the surface is: it pulls along the surface, but
loosens it. The second one holds particles together and presses. With the right shares of both the
energy changes as the area when the liquid swells, so it presses as Laplace says. The forces are the
derivative of E: momentum, angular momentum and, but for the time step, energy are kept.

Attraction of smoothed particles needs a longer range than the pressure (Nugent & Posch 2000: twice
as long). At the range of the pressure particles move together until their own weight makes the
density right, and the tension is gone; so it is with the squared gradient of He et al. 2014.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.contact_data import DISTANCE, GRADIENT, NORMAL, add_reaction
from sph_ros.core.jit import device
from sph_ros.core.neighbors import cell_coordinate
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES

#: Cells of one support radius on each side of a particle's own that the reach covers.
CELLS = 2

#: A further wall has to face away from the others by this sine [-].
NEW_WALL = 0.5


class Law(NamedTuple):
    """The energy per volume, in units of surface tension / spacing; all float32.

    Attributes:
        reach: H [m].
        scale: 1 / sum of the weight over the lattice [-].
        spacing: s [m].
        area, cohesion: a and b [-].
        blur: d, gradients times s below it hardly count [-].
        full: c_0 [-].
    """

    reach: np.float32
    scale: np.float32
    spacing: np.float32
    area: np.float32
    cohesion: np.float32
    blur: np.float32
    full: np.float32


class Pulls(NamedTuple):
    """Derivatives of the energy per volume at each particle, by what its walls leave free.

    Attributes:
        colour: c [-], (N,).
        by_colour: de/dc [-], (N,).
        by_gradient: de/d grad c [m], (3, N).
        normals: of the walls beside it, (N, 3, 3).
        walls: the solids that these belong to, -1 for none, (N, 3) int32.
        along: parts of grad c along the normals that the walls took off [1/m], (N, 3).
    """

    colour: np.ndarray
    by_colour: np.ndarray
    by_gradient: np.ndarray
    normals: np.ndarray
    walls: np.ndarray
    along: np.ndarray


@device
def nearby_run(grid, x, y, z, run):
    """First and last particle + 1 of one of the 25 runs of cells around a place; (0, 0): outside.

    A run is the cells along the fastest axis, within reach, at one of the places across.
    """
    place = (x, y, z)
    x, y, z = place[grid.axes[0]], place[grid.axes[1]], place[grid.axes[2]]
    nx, ny, nz = grid.counts[0], grid.counts[1], grid.counts[2]
    width = 2 * CELLS + 1
    ky = cell_coordinate(y, grid.lower[1], grid.inverse_cell, ny) + run % width - CELLS
    kz = cell_coordinate(z, grid.lower[2], grid.inverse_cell, nz) + run // width - CELLS
    if ky < 0 or kz < 0 or ky >= ny or kz >= nz:
        return np.intp(0), np.intp(0)
    cx = cell_coordinate(x, grid.lower[0], grid.inverse_cell, nx)
    row = (kz * ny + ky) * nx
    begin = grid.cell_start[row + max(cx - CELLS, 0)]
    end = grid.cell_start[row + min(cx + CELLS, nx - 1) + 1]
    return np.intp(begin), np.intp(end)


@parallel_kernel
def mark_surface(sums, contact_gradients, mirror, least, marks):
    """Mark particles whose neighbours lie on one side.

    Args:
        sums: from `sum_densities`.
        contact_gradients: gradient of the density that walls add, first three columns [1/m],
            (N, 6).
        mirror: as in `find_pulls`.
        least: length of the gradient of the density from which on they do [1/m], float32.
        marks: (N,) uint8; written.
    """
    gradient = sums.gradient
    for i in prange(marks.shape[0]):
        square = np.float32(0.0)
        for axis in range(3):
            # Walls are mirrors, which move against the particle: half of the gradient is theirs.
            g = gradient[i, axis] + np.float32(0.5) * mirror * contact_gradients[i, axis]
            square += g * g
        marks[i] = square > least * least


@parallel_kernel
def spread_marks(pairs, marks, spread):
    """Mark in `spread` (N,) uint8 whoever has a neighbour with a mark."""
    for i in prange(marks.shape[0]):
        spread[i] = 0
        for k in range(pairs.start[i], pairs.end[i], LANES):
            if marks[pairs.neighbors[k]] != 0:
                spread[i] = 1
                break


@device
def wall_colour(walls, reach, distance):
    """Colour of a flat wall [-] and its slope [1/m], from the table over 0 ... H/2."""
    if distance >= np.float32(0.5) * reach:
        return np.float32(0.0), np.float32(0.0)
    step = np.float32(0.5) * reach / np.float32(walls.shape[0] - 1)
    place = max(distance, np.float32(0.0)) / step
    row = min(int(place), walls.shape[0] - 2)
    slope = walls[row + 1] - walls[row]
    return max(walls[row] + (place - np.float32(row)) * slope, np.float32(0.0)), slope / step


@device
def add_normal(normals, count, x, y, z):
    """Add a direction to `count` perpendicular ones (3, 3) if it is a new one; the new count."""
    for k in range(count):
        along = normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z
        x -= along * normals[k, 0]
        y -= along * normals[k, 1]
        z -= along * normals[k, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if count == 3 or length < np.float32(NEW_WALL):
        return count
    normals[count, 0], normals[count, 1], normals[count, 2] = x / length, y / length, z / length
    return count + 1


@device
def add_walls_of(i, j, positions, contacts, walls, reach, normals, solids, count, free):
    """Add those of the walls that j touches which are new to i; their number, the share free."""
    for row in range(contacts.start[j], contacts.end[j]):
        t = contacts.terms[row]
        more = add_normal(normals, count, t[NORMAL], t[NORMAL + 1], t[NORMAL + 2])
        if more > count:
            solids[count] = contacts.solid[row]
            distance = t[DISTANCE]
            for axis in range(3):
                distance += (positions[i, axis] - positions[j, axis]) * t[NORMAL + axis]
            free *= np.float32(1.0) - wall_colour(walls, reach, distance)[0]
            count = more
    return count, free


@device
def look_at_walls(i, positions, pairs, contacts, walls, reach, normals, solids):
    """Walls beside particle i: those it has contact with, and those its neighbours have.

    Contacts are only those that add density, and the reach goes farther.

    Args:
        normals, solids: (3, 3) and (3,); the first are written.

    Returns:
        Their number, and the share of the surroundings that they leave free [-].
    """
    count, free = add_walls_of(
        i, i, positions, contacts, walls, reach, normals, solids, 0, np.float32(1.0)
    )
    for k in range(pairs.start[i], pairs.end[i], LANES):
        j = np.intp(pairs.neighbors[k])
        count, free = add_walls_of(
            i, j, positions, contacts, walls, reach, normals, solids, count, free
        )
    return count, free


@device
def sum_colour(columns, grid, law, x, y, z):
    """Colour of the liquid at a place [-] and its gradient [1/m]."""
    one, zero = np.float32(1.0), np.float32(0.0)
    inverse = one / (law.reach * law.reach)
    total, gx, gy, gz = zero, zero, zero, zero
    for run in range((2 * CELLS + 1) ** 2):
        begin, end = nearby_run(grid, x, y, z, run)
        xs, ys, zs = columns[0, begin:end], columns[1, begin:end], columns[2, begin:end]
        for k in range(xs.shape[0]):
            dx, dy, dz = x - xs[k], y - ys[k], z - zs[k]
            q = max(one - inverse * (dx * dx + dy * dy + dz * dz), zero)
            w = q * q
            total += w * q
            gx += w * dx
            gy += w * dy
            gz += w * dz
    slope = np.float32(-6.0) * inverse * law.scale
    return law.scale * total, slope * gx, slope * gy, slope * gz


@parallel_kernel
def find_pulls(
    columns, positions, grid, law, marks, near_solids, mirror, pairs, contacts, walls, pulls
):
    """Colours of the particles near a surface, and what the energy makes of them.

    Beside a wall the liquid counts as if mirrored: the colour is divided by what the wall leaves
    free, and the gradient has no part along the wall's normal. So a wall neither draws nor repels.

    Args:
        columns: cell-sorted coordinates [m], (3, N + padding).
        positions: the same [m], (N, 3).
        grid: its cells are half the reach wide.
        law: `Law`.
        marks: whether a particle is near a surface, (N,).
        near_solids: whether there are solids.
        mirror: how much of a mirror walls are, 0 as if there were none, 1 fully [-], float32.
        pairs: neighbours within half the reach.
        contacts: with the solids.
        walls: colour of a flat wall at equally many distances from 0 to H/2 [-], (K,) float32.
        pulls: `Pulls`; written.
    """
    xs, ys, zs = columns[0], columns[1], columns[2]
    colours, by_colour = pulls.colour, pulls.by_colour
    by_gradient, normals = pulls.by_gradient, pulls.normals
    solids, taken = pulls.walls, pulls.along
    zero = np.float32(0.0)
    for row in prange(marks.shape[0]):
        i = np.intp(row)
        colours[i], by_colour[i] = 1.0, 0.0
        by_gradient[0, i], by_gradient[1, i], by_gradient[2, i] = 0.0, 0.0, 0.0
        solids[i, 0], solids[i, 1], solids[i, 2] = -1, -1, -1
        if marks[i] == 0:
            continue
        c, gx, gy, gz = sum_colour(columns, grid, law, xs[i], ys[i], zs[i])
        free = np.float32(1.0)
        if near_solids:
            found, free = look_at_walls(
                i, positions, pairs, contacts, walls, law.reach, normals[i], solids[i]
            )
            free = np.float32(1.0) - mirror * (np.float32(1.0) - free)
            for k in range(found):
                n = normals[i, k]
                along = mirror * (gx * n[0] + gy * n[1] + gz * n[2])
                gx -= along * n[0]
                gy -= along * n[1]
                gz -= along * n[2]
                taken[i, k] = along
        over = np.float32(1.0) / max(free, np.float32(0.05))
        c *= over
        stretch = law.spacing * over
        root = np.sqrt(law.blur * law.blur + stretch * stretch * (gx * gx + gy * gy + gz * gz))
        colours[i] = c
        by_colour[i] = -over * law.cohesion * max(law.full - c, zero)
        size = law.area * stretch * stretch / root
        by_gradient[0, i], by_gradient[1, i], by_gradient[2, i] = size * gx, size * gy, size * gz


@parallel_kernel
def tension_displacements(columns, grid, law, marks, before, pulls, pull, displacements):
    """Displacements by the surface tension of the liquid itself.

    Args:
        columns, grid, law, marks, pulls: as in `find_pulls`.
        before: particles with a mark before each row, (N + 1,) int64.
        pull: surface tension dt^2 / (density spacing) [m^2], float32.
        displacements: [m], (N, 3); written.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    inverse = one / (law.reach * law.reach)
    bend = np.float32(-4.0) * inverse
    scale = np.float32(6.0) * inverse * pull * law.scale
    xs, ys, zs = columns[0], columns[1], columns[2]
    by_colour, by_gradient = pulls.by_colour, pulls.by_gradient
    for i in prange(marks.shape[0]):
        x, y, z, own = xs[i], ys[i], zs[i], by_colour[i]
        tx, ty, tz = by_gradient[0, i], by_gradient[1, i], by_gradient[2, i]
        ax, ay, az = zero, zero, zero
        for run in range((2 * CELLS + 1) ** 2):
            begin, end = nearby_run(grid, x, y, z, run)
            if marks[i] == 0 and before[end] == before[begin]:
                continue
            px, py, pz = columns[0, begin:end], columns[1, begin:end], columns[2, begin:end]
            others, vx = by_colour[begin:end], by_gradient[0, begin:end]
            vy, vz = by_gradient[1, begin:end], by_gradient[2, begin:end]
            for k in range(px.shape[0]):
                dx, dy, dz = x - px[k], y - py[k], z - pz[k]
                ux, uy, uz = tx - vx[k], ty - vy[k], tz - vz[k]
                q = max(one - inverse * (dx * dx + dy * dy + dz * dz), zero)
                w = q * q
                along = w * (own + others[k]) + bend * q * (ux * dx + uy * dy + uz * dz)
                ax += along * dx + w * ux
                ay += along * dy + w * uy
                az += along * dz + w * uz
        displacements[i, 0] = scale * ax
        displacements[i, 1] = scale * ay
        displacements[i, 2] = scale * az


@parallel_kernel
def wall_tension(
    positions,
    contacts,
    motion,
    law,
    pull,
    hold,
    walls,
    turn,
    pulls,
    scale,
    displacements,
    reactions,
):
    """Displacements by what walls do to the surface tension, and the reactions to them.

    The energy of a particle beside a wall depends on the wall's normal n: of its gradient g that
    part does not count. Turning the liquid alone changes the energy, and so does turning the wall
    alone: it bears the torque that pairs of particles lack, (g . n) n x de/dg.

    Args:
        positions: [m], (N, 3).
        contacts, motion: of this substep.
        law, walls, pulls: as in `find_pulls`.
        pull: as in `tension_displacements`, times that part of the walls that is a mirror.
        turn: as `pull` in `tension_displacements` [m^2], float32.
        hold: displacement by adhesion per gradient of the density that walls add [m^2], float32.
        scale: particle mass / substep^2 [kg/s^2].
        displacements: [m], (N, 3); added to.
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    terms = contacts.terms
    count = positions.shape[0]
    solids, taken, normals, by_gradient = pulls.walls, pulls.along, pulls.normals, pulls.by_gradient
    for chunk in prange(reactions.shape[0]):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            for k in range(3):
                s = solids[i, k]
                if s < 0:
                    break
                size = scale * turn * taken[i, k]
                nx, ny, nz = normals[i, k, 0], normals[i, k, 1], normals[i, k, 2]
                tx, ty, tz = by_gradient[0, i], by_gradient[1, i], by_gradient[2, i]
                reactions[chunk, s, 3] += size * (ny * tz - nz * ty)
                reactions[chunk, s, 4] += size * (nz * tx - nx * tz)
                reactions[chunk, s, 5] += size * (nx * ty - ny * tx)
            for k in range(contacts.start[i], contacts.end[i]):
                _, slope = wall_colour(walls, law.reach, terms[k, DISTANCE])
                # dc = c / free times the change of the wall's colour, if it is the only one.
                size = -slope * pull * pulls.by_colour[i] * pulls.colour[i]
                x = size * terms[k, NORMAL] + hold * terms[k, GRADIENT]
                y = size * terms[k, NORMAL + 1] + hold * terms[k, GRADIENT + 1]
                z = size * terms[k, NORMAL + 2] + hold * terms[k, GRADIENT + 2]
                displacements[i, 0] += x
                displacements[i, 1] += y
                displacements[i, 2] += z
                add_reaction(
                    reactions,
                    chunk,
                    contacts.solid[k],
                    motion,
                    positions[i, 0],
                    positions[i, 1],
                    positions[i, 2],
                    -scale * x,
                    -scale * y,
                    -scale * z,
                )
