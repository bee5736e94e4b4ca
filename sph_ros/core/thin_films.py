# SPDX-License-Identifier: Apache-2.0
"""Films of liquid between two solids that face each other: what they lack of the density.

The reason is told in `thin_film_tables`.
"""

import numpy as np

from sph_ros.core.contact_data import (
    DISTANCE,
    FRACTION,
    GRADIENT,
    NORMAL,
    TERMS,
    rotate,
    to_solid,
    write_surface_velocity,
)
from sph_ros.core.distances import normal_called
from sph_ros.core.jit import called, inlined


@inlined
def film_share(shapes, gap):
    """Share of the rest density that a film lacks at its gap, and the slope [1/m]."""
    table = shapes.film
    last = table.shape[0] - 1
    place = max(gap, np.float32(0.0)) * (np.float32(last) / shapes.film_gap)
    row = min(np.int64(place), last - 1)
    slope = table[row + 1] - table[row]
    share = table[row] + (place - np.float32(row)) * slope
    return share, slope * (np.float32(last) / shapes.film_gap)


@inlined
def facing(terms, k, other):
    """How much two solids face each other across a particle: 0 (a corner) ... 1; their gap [m]."""
    cosine = np.float32(0.0)
    for axis in range(3):
        cosine += terms[k, NORMAL + axis] * terms[other, NORMAL + axis]
    opposed = max(-cosine, np.float32(0.0))
    return opposed * opposed, terms[k, DISTANCE] + terms[other, DISTANCE]


@inlined
def keep_felt(contacts, shapes, begin, end):
    """Drop the contacts of a particle that have no share in its density and bound no film.

    Args:
        contacts: rows begin:end are of one particle.
        shapes: `PackedShapes`.
        begin, end: see there.

    Returns:
        The end of the rows that stay; they keep their order.
    """
    terms, last = contacts.terms, begin
    for k in range(begin, end):
        felt = terms[k, FRACTION] > np.float32(0.0)
        for other in range(begin, end):
            if not felt and other != k:
                opposed, gap = facing(terms, k, other)
                felt = opposed > np.float32(0.0) and gap < shapes.film_gap
        if felt:
            if last < k:
                contacts.solid[last] = contacts.solid[k]
                for column in range(TERMS):
                    terms[last, column] = terms[k, column]
            last += 1
    return last


@called
def add_film_walls(shapes, motion, x, y, z, inverse_step, contacts, begin, end):
    """Add contacts with those solids that bound a film about a point but are too far to be felt.

    Args:
        shapes, motion: the solids.
        x, y, z: the point [m], world frame.
        inverse_step: 1 / substep [1/s], float32.
        contacts: rows begin:end are those that are felt there; written from `end` on.
        begin, end: see there.

    Returns:
        The end of the rows now.
    """
    solid, terms = contacts.solid, contacts.terms
    felt = end
    for s in range(motion.position.shape[0]):
        known = False
        for k in range(begin, felt):
            known |= solid[k] == s
        if known:
            continue
        lx, ly, lz = to_solid(motion.rotation, motion.position, s, x, y, z)
        distance, nx, ny, nz = normal_called(shapes, s, lx, ly, lz)
        if distance >= min(shapes.film_gap, shapes.support_radius):
            continue
        for column in range(TERMS):
            terms[end, column] = np.float32(0.0)
        nx, ny, nz = rotate(motion.rotation, s, nx, ny, nz)
        terms[end, NORMAL], terms[end, NORMAL + 1], terms[end, NORMAL + 2] = nx, ny, nz
        terms[end, DISTANCE] = distance
        write_surface_velocity(motion, s, lx, ly, lz, x, y, z, inverse_step, terms, end)
        solid[end] = s
        end += 1
    return keep_felt(contacts, shapes, begin, end)


@inlined
def add_films(contacts, shapes, packing, i, begin, end):
    """Add what the films around particle i lack to its density, and to the solids' gradients.

    A film pushes its two walls apart, or pulls them together, and the particle nowhere.
    """
    terms = contacts.terms
    for k in range(begin, end):
        for other in range(k + 1, end):
            opposed, gap = facing(terms, k, other)
            if opposed <= np.float32(0.0) or gap >= shapes.film_gap:
                continue
            share, slope = film_share(shapes, gap)
            contacts.density[i, 0] += packing * opposed * share
            for axis in range(3):
                push = packing * opposed * slope * terms[k, NORMAL + axis]
                pull = packing * opposed * slope * terms[other, NORMAL + axis]
                terms[k, GRADIENT + axis] += push
                terms[other, GRADIENT + axis] += pull
                contacts.gradients[i, axis] += push + pull
