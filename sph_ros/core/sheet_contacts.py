# SPDX-License-Identifier: Apache-2.0
"""Particles and sheets: walls on both sides, paths that end at them, pairs that they part.

A particle near a sheet feels a flat wall through the nearest point of it, in a corner up to three.
Whatever way particles move, a path through a triangle is stopped there and projected along it (the
collision of Müller, Charypar & Gross 2003 with triangle meshes), so a particle stays on the side
that it came from.
"""

import math

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK
from sph_ros.core.contact_data import (
    DISTANCE,
    FRACTION,
    GRADIENT,
    NEAR_FRACTION,
    NEAR_GRADIENT,
    NORMAL,
    add_reaction,
    rotate,
    to_solid,
    to_world,
    write_surface_velocity,
)
from sph_ros.core.jit import called, inlined
from sph_ros.core.sheets import (
    CORNER_CONTACTS,
    cell_of,
    first_crossing,
    nearest_in_cell,
    nearest_on_sheet,
)
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES
from sph_ros.core.walls import MIRRORED, wall_share

_ONE = np.float32(1.0)


@inlined
def write_sheet_contact(shapes, sheets, motion, s, found, terms, row):
    """Write the wall that a sheet is at its nearest point `found`; whether it is felt."""
    distance, nx, ny, nz, part, triangle = found
    share = _ONE
    if (sheets.open_parts[triangle] & part) != 0:
        # Beyond the edge of a sheet its wall fades out towards where one sees it edge-on.
        n = sheets.normals[triangle]
        share = np.float32(abs(nx * n[0] + ny * n[1] + nz * n[2]))
    f, df, g, dg = wall_share(shapes, MIRRORED, np.float32(distance))
    if f * share <= np.float32(0.0):
        return False
    terms[row, FRACTION] = f * share
    terms[row, NEAR_FRACTION] = g * share
    wx, wy, wz = rotate(motion.rotation, s, np.float32(nx), np.float32(ny), np.float32(nz))
    for column, size in ((GRADIENT, df * share), (NEAR_GRADIENT, dg * share), (NORMAL, _ONE)):
        terms[row, column] = size * wx
        terms[row, column + 1] = size * wy
        terms[row, column + 2] = size * wz
    terms[row, DISTANCE] = distance
    return True


@called
def add_sheet_contacts(shapes, sheets, k, motion, x, y, z, inverse_step, contacts, row):
    """Write the contacts of a point with sheet k to the rows from `row` on, three at most.

    Returns:
        Number of rows written, and a distance to the sheet that is at most the true one [m].
    """
    s = np.int64(sheets.solid[k])
    lx, ly, lz = to_solid(motion.rotation, motion.position, s, x, y, z)
    px, py, pz = np.float64(lx), np.float64(ly), np.float64(lz)
    cell = cell_of(sheets, k, px, py, pz)
    h = np.float64(shapes.support_radius)
    if cell < 0:
        return 0, np.float32(max(outside_grid(sheets, k, px, py, pz), 0.0) + h)
    if sheets.cell_start[cell] == sheets.cell_start[cell + 1]:
        return 0, np.float32(h)
    first, second = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    nearest, rows = h, 0
    for turn in range(CORNER_CONTACTS if sheets.has_corner[cell] else 1):
        found = nearest_in_cell(sheets, cell, px, py, pz, h, first, second)
        if found[5] < 0:
            break
        if turn == 0:
            nearest, first = found[0], (found[1], found[2], found[3])
        else:
            second = (found[1], found[2], found[3])
        if write_sheet_contact(shapes, sheets, motion, s, found, contacts.terms, row + rows):
            contacts.solid[row + rows] = s
            write_surface_velocity(
                motion, s, lx, ly, lz, x, y, z, inverse_step, contacts.terms, row + rows
            )
            rows += 1
    return rows, np.float32(nearest)


@inlined
def outside_grid(sheets, k, x, y, z):
    """Distance of a point to the box of the grid of sheet k, negative inside [m]."""
    half = 0.5 / sheets.inverse_cell[k]
    hx, hy, hz = half * sheets.counts[k, 0], half * sheets.counts[k, 1], half * sheets.counts[k, 2]
    dx = abs(x - sheets.lower[k, 0] - hx) - hx
    dy = abs(y - sheets.lower[k, 1] - hy) - hy
    dz = abs(z - sheets.lower[k, 2] - hz) - hz
    return max(dx, max(dy, dz))


# ---------------------------------------------------------------- paths


@called
def keep_off(sheets, k, x, y, z, margin):
    """A point moved so far off sheet k that it keeps the margin, without going through it."""
    for _ in range(2):
        distance, nx, ny, nz, _, triangle = nearest_on_sheet(sheets, k, x, y, z, margin)
        if triangle < 0:
            break
        step = margin - distance
        tx, ty, tz = x + step * nx, y + step * ny, z + step * nz
        if first_crossing(sheets, k, x, y, z, tx, ty, tz)[1] >= 0:
            break
        x, y, z = tx, ty, tz
    return x, y, z


@called
def stop_at_sheet(sheets, k, ax, ay, az, bx, by, bz, margin):
    """End of a path from a to b that stops at sheet k and slides along it, in the sheet's frame.

    Every leg of the path that it takes instead was tested against all triangles.

    Returns:
        (whether the end was moved, x, y, z of the end [m]).
    """
    moved = False
    for _ in range(6):
        share, triangle = first_crossing(sheets, k, ax, ay, az, bx, by, bz)
        if triangle < 0:
            ex, ey, ez = keep_off(sheets, k, bx, by, bz, margin)
            return moved or ex != bx or ey != by or ez != bz, ex, ey, ez
        moved = True
        nx = np.float64(sheets.normals[triangle, 0])
        ny = np.float64(sheets.normals[triangle, 1])
        nz = np.float64(sheets.normals[triangle, 2])
        dx, dy, dz = bx - ax, by - ay, bz - az
        drop = -(dx * nx + dy * ny + dz * nz)
        if drop < 0.0:  # the normal that points back to where the path comes from
            nx, ny, nz, drop = -nx, -ny, -nz, -drop
        # Straight on until the margin is left, then along the triangle.
        part = max(share * drop - margin, 0.0) / max(drop, 1e-30)
        ax, ay, az = ax + part * dx, ay + part * dy, az + part * dz
        rest = (1.0 - part) * drop
        bx, by, bz = bx + rest * nx, by + rest * ny, bz + rest * nz
    return True, ax, ay, az


@called
def stop_chunk_at_sheets(chunk, starts, ends, clearance, sheets, motion, margin, scale, reactions):
    """`stop_at_sheets` for one chunk of particles."""
    for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, starts.shape[0])):
        if clearance[i] > np.float32(2.0) * margin:
            continue
        # As for bodies: two particles pushed into one corner must not end up in the same place.
        golden = np.float32(0.618034) * np.float32(i % 4096)
        own = margin * (np.float32(1.0) + np.float32(0.5) * (golden - np.floor(golden)))
        for k in range(sheets.solid.shape[0]):
            s = np.int64(sheets.solid[k])
            x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
            ax, ay, az = to_solid(
                motion.old_rotation,
                motion.old_position,
                s,
                starts[i, 0],
                starts[i, 1],
                starts[i, 2],
            )
            bx, by, bz = to_solid(motion.rotation, motion.position, s, x, y, z)
            moved, cx, cy, cz = stop_at_sheet(
                sheets,
                k,
                np.float64(ax),
                np.float64(ay),
                np.float64(az),
                np.float64(bx),
                np.float64(by),
                np.float64(bz),
                np.float64(own),
            )
            if not moved:
                continue
            clearance[i] = np.float32(0.0)
            wx, wy, wz = to_world(
                motion.rotation,
                motion.position,
                s,
                np.float32(cx),
                np.float32(cy),
                np.float32(cz),
            )
            ends[i, 0], ends[i, 1], ends[i, 2] = wx, wy, wz
            push = scale[i]
            fx, fy, fz = push * (x - wx), push * (y - wy), push * (z - wz)
            add_reaction(reactions, chunk, s, motion, x, y, z, fx, fy, fz)


@parallel_kernel
def stop_at_sheets(starts, ends, clearance, sheets, motion, margin, scale, reactions):
    """Stop particles at sheets, on whichever side they are.

    Args:
        starts: beside the sheets at their old poses [m], (N, 3).
        ends: where the particles want to be when the sheets are at their new ones [m], (N, 3);
            changed where needed.
        clearance: as in `contacts.keep_outside`, which must have been called for these paths.
        sheets, motion: the sheets and the poses of all solids.
        margin: distance to keep [m], float32.
        scale: mass of each particle / substep^2 [kg/s^2], (N,).
        reactions: as in `contacts.pressure_reactions`; added to.
    """
    for chunk in prange(reactions.shape[0]):
        stop_chunk_at_sheets(
            np.int64(chunk), starts, ends, clearance, sheets, motion, margin, scale, reactions
        )


# ---------------------------------------------------------------- pairs


@inlined
def is_behind(contacts, sheet_of, i, dx, dy, dz):
    """Whether a point at an offset from particle i is behind a plane that a sheet is for i."""
    for row in range(contacts.start[i], contacts.end[i]):
        if sheet_of[contacts.solid[row]] >= 0:
            t = contacts.terms[row]
            height = dx * t[NORMAL] + dy * t[NORMAL + 1] + dz * t[NORMAL + 2] + t[DISTANCE]
            if height < np.float32(0.0):
                return True
    return False


@called
def is_parted(sheets, motion, ax, ay, az, bx, by, bz):
    """Whether a sheet where it is now lies between two world points."""
    for k in range(sheets.solid.shape[0]):
        s = np.int64(sheets.solid[k])
        px, py, pz = to_solid(motion.rotation, motion.position, s, ax, ay, az)
        qx, qy, qz = to_solid(motion.rotation, motion.position, s, bx, by, bz)
        _, triangle = first_crossing(
            sheets,
            k,
            np.float64(px),
            np.float64(py),
            np.float64(pz),
            np.float64(qx),
            np.float64(qy),
            np.float64(qz),
        )
        if triangle >= 0:
            return True
    return False


@inlined
def has_between(sheets, motion, contacts, i, j, xs, ys, zs):
    """Whether a sheet parts particle i, which is near a solid, from j."""
    if j == i or contacts.start[j] == contacts.end[j]:
        return False
    dx, dy, dz = xs[j] - xs[i], ys[j] - ys[i], zs[j] - zs[i]
    sheet_of = sheets.sheet_of
    if not (
        is_behind(contacts, sheet_of, i, dx, dy, dz)
        or is_behind(contacts, sheet_of, j, -dx, -dy, -dz)
    ):
        return False
    a, b = min(i, j), max(i, j)
    return is_parted(sheets, motion, xs[a], ys[a], zs[a], xs[b], ys[b], zs[b])


@parallel_kernel
def part_pairs(columns, sheets, motion, contacts, chunks, pairs):
    """Take neighbours off the lists that a sheet parts from the particle.

    The last one of the list takes the place of a parted neighbour, and the particle itself that of
    the last one. Both lists of a pair are decided by the same test, so a pair stays a pair.

    Args:
        columns: coordinates that the lists were made from [m], (3, N + padding).
        sheets, motion: the sheets and the poses of all solids.
        contacts: of the particles.
        chunks: `chunk_count(N)`.
        pairs: neighbours and ends are changed.
    """
    xs, ys, zs = columns[0], columns[1], columns[2]
    neighbors, starts, ends = pairs.neighbors, pairs.start, pairs.end
    first, last = contacts.start, contacts.end
    count = starts.shape[0]
    for chunk in prange(chunks):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            if first[i] == last[i]:
                continue
            k, end = np.int64(starts[i]), np.int64(ends[i])
            while k < end:
                j = np.int64(neighbors[k])
                if has_between(sheets, motion, contacts, i, j, xs, ys, zs):
                    end -= LANES
                    neighbors[k], neighbors[end] = neighbors[end], i
                else:
                    k += LANES
            ends[i] = end


# ---------------------------------------------------------------- impulses


@inlined
def bounced(nx, ny, nz, wx, wy, wz, restitution, friction):
    """Change of a relative velocity w that meets a surface with normal n: (x, y, z) [m/s]."""
    along = wx * nx + wy * ny + wz * nz
    if along >= 0.0:
        return 0.0, 0.0, 0.0
    tx, ty, tz = wx - along * nx, wy - along * ny, wz - along * nz
    speed = math.sqrt(tx * tx + ty * ty + tz * tz)
    # Without restitution the surface stops the particle where it meets it, not where it is now.
    push = -(1.0 + restitution) * along if restitution > 0.0 else 0.0
    share = min(-friction * (1.0 + restitution) * along / max(speed, 1e-12), 1.0)
    return push * nx - share * tx, push * ny - share * ty, push * nz - share * tz


@parallel_kernel
def bounce_off_sheets(
    positions,
    velocities,
    clearance,
    gravity,
    time_step,
    travel,
    sheets,
    motion,
    margin,
    masses,
    reactions,
):
    """Impulses on particles whose path in this substep meets a sheet: restitution and friction.

    Args:
        positions: at the start of the substep [m], (N, 3).
        velocities: [m/s], (N, 3); changed.
        clearance: as in `contacts.keep_outside`, before it is called.
        gravity: [m/s^2], (3,) float32.
        time_step: of the substep [s], float32.
        travel: the farthest that a point of any solid moves in it [m], float32.
        sheets, motion: the sheets and the poses of all solids.
        margin: distance that particles keep [m], float32.
        masses: of the particles [kg], (N,).
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    for chunk in prange(reactions.shape[0]):
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, positions.shape[0])):
            x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
            vx = velocities[i, 0] + time_step * gravity[0]
            vy = velocities[i, 1] + time_step * gravity[1]
            vz = velocities[i, 2] + time_step * gravity[2]
            way = time_step * np.sqrt(vx * vx + vy * vy + vz * vz)
            if clearance[i] > way + travel + margin:
                continue
            for k in range(sheets.solid.shape[0]):
                restitution, friction = sheets.bounce[k, 0], sheets.bounce[k, 1]
                if restitution == 0.0 and friction == 0.0:
                    continue
                s = np.int64(sheets.solid[k])
                ax, ay, az = to_solid(motion.old_rotation, motion.old_position, s, x, y, z)
                ex, ey, ez = x + time_step * vx, y + time_step * vy, z + time_step * vz
                bx, by, bz = to_solid(motion.rotation, motion.position, s, ex, ey, ez)
                dx, dy, dz = np.float64(bx - ax), np.float64(by - ay), np.float64(bz - az)
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                beyond = 1.0 + margin / max(length, 1e-12)
                px, py, pz = np.float64(ax), np.float64(ay), np.float64(az)
                _, triangle = first_crossing(
                    sheets, k, px, py, pz, px + beyond * dx, py + beyond * dy, pz + beyond * dz
                )
                if triangle < 0:
                    continue
                n = sheets.normals[triangle]
                side = -1.0 if dx * n[0] + dy * n[1] + dz * n[2] > 0.0 else 1.0
                cx, cy, cz = bounced(
                    side * n[0],
                    side * n[1],
                    side * n[2],
                    dx / time_step,
                    dy / time_step,
                    dz / time_step,
                    restitution,
                    friction,
                )
                cx, cy, cz = rotate(
                    motion.rotation, s, np.float32(cx), np.float32(cy), np.float32(cz)
                )
                velocities[i, 0] += cx
                velocities[i, 1] += cy
                velocities[i, 2] += cz
                vx, vy, vz = vx + cx, vy + cy, vz + cz
                force = -masses[i] / time_step
                add_reaction(
                    reactions, chunk, s, motion, x, y, z, force * cx, force * cy, force * cz
                )
