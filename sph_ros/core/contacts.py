# SPDX-License-Identifier: Apache-2.0
"""Where particles feel solids: wall densities, push, friction, and the reaction on each solid.

A contact is one particle near one solid. All solids around a particle act together by the product
rule of `walls`: the liquid's share of the support is the product of what each solid leaves free.
"""

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, fresh_turns, next_chunk, slices_of
from sph_ros.core.contact_data import (
    DISTANCE,
    FRACTION,
    GRADIENT,
    NEAR_FRACTION,
    NEAR_GRADIENT,
    NORMAL,
    SURFACE_VELOCITY,
    TERMS,
    Contacts,
    Motion,
    add_reaction,
    rotate,
    to_solid,
    to_world,
    write_surface_velocity,
)
from sph_ros.core.distances import normal_called, signed_distance
from sph_ros.core.jit import called, inlined
from sph_ros.core.sheet_contacts import add_sheet_contacts
from sph_ros.core.team import parallel_kernel
from sph_ros.core.thin_films import add_film_walls, add_films
from sph_ros.core.vector import LANES
from sph_ros.core.walls import wall_terms

__all__ = ["TERMS", "Contacts", "Motion"]


@inlined
def add_contact(shapes, motion, s, x, y, z, inverse_step, solid, terms, row):
    """Write the contact of a point with solid s to `row` if it is near.

    Returns:
        Whether it was, and a distance to the solid that is at most the true one [m].
    """
    lx, ly, lz = to_solid(motion.rotation, motion.position, s, x, y, z)
    found = wall_terms(shapes, s, lx, ly, lz, shapes.reach[s])
    fraction = found[4]
    if fraction <= np.float32(0.0):
        return False, found[0]
    solid[row] = s
    terms[row, FRACTION] = fraction
    terms[row, NEAR_FRACTION] = found[8]
    for column, first in ((GRADIENT, 5), (NEAR_GRADIENT, 9), (NORMAL, 1)):
        wx, wy, wz = rotate(motion.rotation, s, found[first], found[first + 1], found[first + 2])
        terms[row, column] = wx
        terms[row, column + 1] = wy
        terms[row, column + 2] = wz
    terms[row, DISTANCE] = found[0]
    write_surface_velocity(motion, s, lx, ly, lz, x, y, z, inverse_step, terms, row)
    return True, found[0]


@inlined
def combine_contacts(contacts, packing, i, begin, end):
    """Product rule over the contacts of particle i: densities and gradients."""
    terms = contacts.terms
    free, near_free = np.float32(1.0), np.float32(1.0)
    for k in range(begin, end):
        free *= np.float32(1.0) - terms[k, FRACTION]
        near_free *= np.float32(1.0) - terms[k, NEAR_FRACTION]
    contacts.density[i, 0] = packing * (np.float32(1.0) - free)
    contacts.density[i, 1] = np.float32(1.0) - near_free
    for axis in range(6):
        contacts.gradients[i, axis] = 0.0
    for k in range(begin, end):
        others, near_others = np.float32(1.0), np.float32(1.0)
        for other in range(begin, end):
            if other != k:
                others *= np.float32(1.0) - terms[other, FRACTION]
                near_others *= np.float32(1.0) - terms[other, NEAR_FRACTION]
        for axis in range(3):
            terms[k, GRADIENT + axis] *= packing * others
            terms[k, NEAR_GRADIENT + axis] *= near_others
            contacts.gradients[i, axis] += terms[k, GRADIENT + axis]
            contacts.gradients[i, 3 + axis] += terms[k, NEAR_GRADIENT + axis]


@called
def find_contacts_of_chunk(
    chunk, positions, clearance, shapes, sheets, motion, inverse_step, packing, slots, contacts
):
    """`find_contacts` for one chunk of particles; a function of its own compiles faster."""
    solids = motion.position.shape[0]
    cursor = chunk * CHUNK * slots
    # Who is in a film has one of its walls within half the gap.
    reach = np.float32(0.5) * shapes.film_gap
    if sheets.solid.shape[0] > 0:
        reach = shapes.support_radius
    for s in range(solids):
        reach = max(reach, shapes.reach[s])
    for s in slices_of(chunk, contacts.touching.shape[0]):
        contacts.touching[s] = False
    for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, positions.shape[0])):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        contacts.start[i] = bodies = cursor
        if clearance[i] < reach:
            nearest = next_nearest = np.float32(np.inf)
            for s in range(solids):
                near, distance = add_contact(
                    shapes, motion, s, x, y, z, inverse_step, contacts.solid, contacts.terms, cursor
                )
                next_nearest = min(next_nearest, max(nearest, distance))
                nearest = min(nearest, distance)
                if near:
                    cursor += 1
            if nearest + next_nearest < shapes.film_gap:
                cursor = add_film_walls(
                    shapes, motion, x, y, z, inverse_step, contacts, bodies, cursor
                )
            bodies = cursor
            for k in range(sheets.solid.shape[0]):
                rows, distance = add_sheet_contacts(
                    shapes, sheets, k, motion, x, y, z, inverse_step, contacts, cursor
                )
                nearest = min(nearest, distance)
                cursor += rows
            clearance[i] = nearest
        contacts.end[i] = cursor
        if contacts.start[i] < cursor:
            contacts.touching[i // LANES] = True
        combine_contacts(contacts, packing, i, contacts.start[i], cursor)
        if contacts.start[i] + 1 < bodies:
            add_films(contacts, shapes, packing, i, contacts.start[i], bodies)


@parallel_kernel
def find_contacts(
    positions,
    clearance,
    shapes,
    sheets,
    motion,
    inverse_step,
    packing,
    chunks,
    slots,
    contacts,
):
    """Contacts of all particles with the solids at the end of the substep.

    Args:
        positions: predicted, none inside a solid [m], (N, 3).
        clearance: for each particle a distance that it certainly has from all solids [m], (N,);
            where that is not enough to do without a look it is written anew.
        shapes: packed shapes of the S solids.
        sheets: those of them that are sheets.
        motion: poses of the solids.
        inverse_step: 1 / substep [1/s], float32.
        packing: rest density of the lattice over that of the liquid (`scales.packing`) [-],
            float32.
        chunks: `chunk_count(N)`.
        slots: most contacts of a particle, S and two for each sheet.
        contacts: all written; needs room for chunks * CHUNK * slots contacts.
    """
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            find_contacts_of_chunk(
                chunk,
                positions,
                clearance,
                shapes,
                sheets,
                motion,
                inverse_step,
                packing,
                slots,
                contacts,
            )
            chunk = next_chunk(turns, part, chunks)


@parallel_kernel
def pressure_reactions(positions, contacts, motion, sums, pressures, tension, scale, reactions):
    """Reaction to the solids' push by pressure and cohesion: the terms that moved the particles.

    Args:
        positions: predicted [m], (N, 3).
        contacts, motion: of this substep.
        sums, tension: as in `cohesive_displacements`.
        pressures: scaled [m^2], (N,).
        scale: particle mass / substep^2 [kg/s^2].
        reactions: force [N] and torque [N m] per chunk and solid, (chunks, S, 6) float64; added to.
    """
    count, chunks = positions.shape[0], reactions.shape[0]
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
                if contacts.start[i] == contacts.end[i]:
                    continue
                pull = tension.cohesion * (sums.density[i] - np.float32(1.0)) - tension.near
                push = (pressures[i] + tension.adhesion * pull) * scale
                near_push = tension.near * tension.virial_ratio * sums.near_density[i] * scale
                for k in range(contacts.start[i], contacts.end[i]):
                    t = contacts.terms[k]
                    add_reaction(
                        reactions,
                        chunk,
                        contacts.solid[k],
                        motion,
                        positions[i, 0],
                        positions[i, 1],
                        positions[i, 2],
                        push * t[GRADIENT] + near_push * t[NEAR_GRADIENT],
                        push * t[GRADIENT + 1] + near_push * t[NEAR_GRADIENT + 1],
                        push * t[GRADIENT + 2] + near_push * t[NEAR_GRADIENT + 2],
                    )
            chunk = next_chunk(turns, part, chunks)


@parallel_kernel
def rub_on_solids(positions, contacts, motion, rate, drag, scale, velocities, reactions):
    """Friction: solids take a share of the sliding speed of the liquid along them.

    The share is taken implicitly, so no rate is too large.

    Args:
        positions: [m], (N, 3).
        contacts, motion: of this substep.
        rate: share per unit of wall fraction [-], float32.
        drag: share per unit of wall fraction and sliding speed [s/m], float32.
        scale: mass of each particle / substep [kg/s], (N,).
        velocities: [m/s], (N, 3); changed.
        reactions: as in `pressure_reactions`; added to.
    """
    count, chunks = positions.shape[0], reactions.shape[0]
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
                for k in range(contacts.start[i], contacts.end[i]):
                    t = contacts.terms[k]
                    sx = velocities[i, 0] - t[SURFACE_VELOCITY]
                    sy = velocities[i, 1] - t[SURFACE_VELOCITY + 1]
                    sz = velocities[i, 2] - t[SURFACE_VELOCITY + 2]
                    along = sx * t[NORMAL] + sy * t[NORMAL + 1] + sz * t[NORMAL + 2]
                    sx -= along * t[NORMAL]
                    sy -= along * t[NORMAL + 1]
                    sz -= along * t[NORMAL + 2]
                    speed = np.sqrt(sx * sx + sy * sy + sz * sz)
                    wanted = (rate + drag * speed) * t[FRACTION]
                    share = wanted / (np.float32(1.0) + wanted)
                    velocities[i, 0] -= share * sx
                    velocities[i, 1] -= share * sy
                    velocities[i, 2] -= share * sz
                    add_reaction(
                        reactions,
                        chunk,
                        contacts.solid[k],
                        motion,
                        positions[i, 0],
                        positions[i, 1],
                        positions[i, 2],
                        scale[i] * share * sx,
                        scale[i] * share * sy,
                        scale[i] * share * sz,
                    )
            chunk = next_chunk(turns, part, chunks)


@called
def distance_called(shapes, s, x, y, z):
    """`signed_distance` as a function of its own.

    Only the few particles that touch a solid get here, and inlining it six times would double the
    time to compile.
    """
    return signed_distance(shapes, s, x, y, z)


@called
def first_hit(shapes, s, distance, ax, ay, az, bx, by, bz, length, margin, shortest):
    """Share of the way from a to b, in the frame of solid s, at which a point meets it; 1: never.

    Sphere tracing: the distance is how far one can go in any direction. A start inside counts as no
    hit.
    """
    dx, dy, dz = bx - ax, by - ay, bz - az
    if distance <= margin:
        return np.float32(1.0)
    along = np.float32(0.0)
    for _ in range(64):
        along += max(distance - margin, shortest)
        if along >= length:
            return np.float32(1.0)
        share = along / length
        distance = distance_called(shapes, s, ax + share * dx, ay + share * dy, az + share * dz)
        if distance <= margin:
            return share
    return np.float32(1.0)


@called
def slide(shapes, s, ax, ay, az, bx, by, bz, margin, shortest):
    """End of a motion from a to b that slides along solid s where it meets it, solid's frame."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    distance = distance_called(shapes, s, ax, ay, az)
    if distance > length + margin:
        return bx, by, bz
    # A way to a solid and back to the end would be too long.
    if distance + distance_called(shapes, s, bx, by, bz) > length + np.float32(2.0) * margin:
        return bx, by, bz
    share = first_hit(shapes, s, distance, ax, ay, az, bx, by, bz, length, margin, shortest)
    if share < np.float32(1.0):
        hx, hy, hz = ax + share * dx, ay + share * dy, az + share * dz
        _, nx, ny, nz = normal_called(shapes, s, hx, hy, hz)
        inward = (bx - hx) * nx + (by - hy) * ny + (bz - hz) * nz
        if inward < np.float32(0.0):
            bx, by, bz = bx - inward * nx, by - inward * ny, bz - inward * nz
    for _ in range(4):
        distance, nx, ny, nz = normal_called(shapes, s, bx, by, bz)
        if distance >= margin:
            break
        step = margin - distance
        bx, by, bz = bx + step * nx, by + step * ny, bz + step * nz
    return bx, by, bz


@called
def is_free(shapes, motion, x, y, z, margin):
    """Whether a world point keeps the margin from every solid."""
    for s in range(motion.position.shape[0]):
        lx, ly, lz = to_solid(motion.rotation, motion.position, s, x, y, z)
        if distance_called(shapes, s, lx, ly, lz) < margin:
            return False
    return True


@called
def nearest_free_point(shapes, motion, x, y, z, margin, spacing, planar):
    """A free point near (x, y, z), found on growing spheres (circles in 2D); whether there is one.

    For particles squeezed between solids, where projecting out of one only pushes into the other.
    """
    for ring in range(1, 48):
        radius = np.float32(0.5) * spacing * ring
        samples = 32 + 8 * ring
        for k in range(samples):
            # Fibonacci sphere: even, and the same every time.
            height = np.float32(1.0) - (np.float32(2.0) * k + np.float32(1.0)) / samples
            angle = np.float32(2.3999632) * k
            if planar:
                angle = np.float32(6.2831853) * k / samples
                dx, dy, dz = np.cos(angle), np.float32(0.0), np.sin(angle)
            else:
                flat = np.sqrt(np.float32(1.0) - height * height)
                dx, dy, dz = flat * np.cos(angle), flat * np.sin(angle), height
            px, py, pz = x + radius * dx, y + radius * dy, z + radius * dz
            if is_free(shapes, motion, px, py, pz, margin):
                return True, px, py, pz
    return False, x, y, z


@called
def slide_past_solids(
    i, chunk, starts, ends, shapes, motion, margin, shortest, planar, scale, reactions
):
    """Let particle i slide past each solid once; whether any was in its way.

    Each particle keeps a slightly different margin, so that two that are pushed into the same
    corner do not end up in the same place, where nothing could part them.
    """
    moved = False
    golden = np.float32(0.618034) * np.float32(i % 4096)
    margin *= np.float32(1.0) + np.float32(0.5) * (golden - np.floor(golden))
    for s in range(motion.position.shape[0]):
        x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
        sx, sy, sz = starts[i, 0], starts[i, 1], starts[i, 2]
        ax, ay, az = to_solid(motion.old_rotation, motion.old_position, s, sx, sy, sz)
        bx, by, bz = to_solid(motion.rotation, motion.position, s, x, y, z)
        cx, cy, cz = slide(shapes, s, ax, ay, az, bx, by, bz, margin, shortest)
        if cx == bx and cy == by and cz == bz:
            continue
        moved = True
        wx, wy, wz = to_world(motion.rotation, motion.position, s, cx, cy, cz)
        if planar:
            wy = y
        ends[i, 0], ends[i, 1], ends[i, 2] = wx, wy, wz
        fx, fy, fz = scale * (x - wx), scale * (y - wy), scale * (z - wz)
        add_reaction(reactions, chunk, s, motion, x, y, z, fx, fy, fz)
    return moved


@called
def keep_chunk_outside(
    chunk,
    starts,
    ends,
    origins,
    clearance,
    travel,
    shapes,
    motion,
    margin,
    spacing,
    planar,
    scale,
    reactions,
):
    """`keep_outside` for one chunk of particles; returns how many had to be rescued."""
    shortest = np.float32(0.1) * spacing
    slack = np.float32(0.5) * margin
    rescued = 0
    for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, starts.shape[0])):
        dx, dy, dz = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1], ends[i, 2] - starts[i, 2]
        clearance[i] -= np.sqrt(dx * dx + dy * dy + dz * dz) + travel
        if clearance[i] > np.float32(2.0) * margin:
            continue
        moved = True
        rounds = 0
        while moved and rounds < 8:
            moved = slide_past_solids(
                i,
                chunk,
                starts,
                ends,
                shapes,
                motion,
                margin,
                shortest,
                planar,
                scale[i],
                reactions,
            )
            rounds += 1
        clearance[i] = np.float32(0.0)
        x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
        if not moved or is_free(shapes, motion, x, y, z, slack):
            continue
        rescued += 1
        found, px, py, pz = nearest_free_point(shapes, motion, x, y, z, margin, spacing, planar)
        if found:
            ends[i, 0], ends[i, 1], ends[i, 2] = px, py, pz
            origins[i, 0], origins[i, 1], origins[i, 2] = px, py, pz
    return rescued


@parallel_kernel
def keep_outside(
    starts,
    ends,
    origins,
    clearance,
    travel,
    shapes,
    motion,
    margin,
    spacing,
    planar,
    scale,
    reactions,
    squeezed,
):
    """Stop particles at solids: sweep each along its path relative to each moving solid.

    A particle starts at `starts` beside the solids at their old poses and wants to be at `ends`
    when they are at their new ones. In a solid's own frame it moves on a straight line; where that
    meets the solid the rest of the motion slides along it. So neither a fast particle nor a fast or
    thin solid passes through.

    Args:
        starts: [m], (N, 3).
        ends: [m], (N, 3); changed where needed.
        clearance: for each particle a distance that it certainly has from all solids [m], (N,);
            kept up to date.
        travel: the farthest that a point of any solid moves in this substep [m], float32.
        origins: positions that the velocity will be reckoned from [m], (N, 3); moved along with
            particles that had to be rescued, so that a rescue is no kick.
        shapes, motion: the S solids.
        margin: distance to keep [m], float32.
        spacing: of the particles [m], float32.
        planar: 2D: positions keep y.
        scale: mass of each particle / substep^2 [kg/s^2], (N,).
        reactions: as in `pressure_reactions`; added to.
        squeezed: particles per chunk that had no way out but a rescue, (chunks,) int64; added to.
    """
    chunks = reactions.shape[0]
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            squeezed[chunk] += keep_chunk_outside(
                chunk,
                starts,
                ends,
                origins,
                clearance,
                travel,
                shapes,
                motion,
                margin,
                spacing,
                planar,
                scale,
                reactions,
            )
            chunk = next_chunk(turns, part, chunks)
