# SPDX-License-Identifier: Apache-2.0
"""Sums over the neighbours of sixteen particles at once: what nearly all time of a step goes into.

Lists are stored in slices of sixteen particles (`Pairs`), so that each lane of a vector belongs to
one particle and nothing is ever summed across lanes. Time then goes into reading: what belongs to
the neighbours, one row at a time, and the lists themselves, which no cache near the processor
holds. So rows are read whole (`gather_points`), and gradients are kept in 16 bits.
"""

from typing import NamedTuple

import numpy as np

from sph_ros.core.jit import inlined
from sph_ros.core.vector import (
    LANES,
    LAST_CACHE,
    as_floats,
    inverse_root,
    larger,
    root,
    smaller,
    spread,
)
from sph_ros.core.vector_memory import (
    gather,
    gather_points,
    load,
    prefetch,
    store,
    take,
    take_points,
)

#: Gradients and nearness are kept as whole multiples of 1 / `STEPS` of the largest.
STEPS = np.float32(32767.0)

#: Added to the squared distance of each pair [m^2], so that a particle may be its own neighbour:
#: 0 / tiny is 0.
TINY = np.float32(1e-20)

#: Lists of more entries (of 10 bytes) are not in the last cache when they are read again. Those are
#: asked for so many entries ahead: what is read in between hides from the processor that it is to
#: go on. In a cache it finds them sooner than it can be asked, which then costs a tenth.
FAR, AHEAD = LAST_CACHE // 10, 2048


class Pairs(NamedTuple):
    """Neighbours and pair geometry, in slices of `LANES` particles (SELL-C, Kreutzer et al. 2014).

    The list of particle i is entries start[i], start[i] + LANES, ... below end[i]: those of a slice
    lie side by side, the first ones of all, then the second ones. Where a particle has fewer
    neighbours than another of its slice, entries are the particle itself: its gradient with itself
    is zero, so no sum over gradients notices.

    Attributes:
        start, end: (N,) int32.
        stop: end of the entries of each slice, (ceil(N / LANES),) int32.
        neighbors: rows of the neighbours, (M,) uint32.
        x, y, z: gradient at i of the normalised density weight, in `unit`, (M,) int16. Both sides
            of a pair are the same numbers with opposite signs.
        nearness: 1 - r/h, times `STEPS`, (M,) int16.
        unit: of the gradients [1/m], (1,) float32.
    """

    start: np.ndarray
    end: np.ndarray
    stop: np.ndarray
    neighbors: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    nearness: np.ndarray
    unit: np.ndarray


@inlined
def filling_of(pairs, first):
    """Entries that only fill up the lists of the slice that begins at particle `first`."""
    width = np.int64(pairs.stop[first // LANES]) - np.int64(pairs.start[first])
    filling = (take(pairs.start, first) - take(pairs.end, first) + width) >> 4
    return as_floats(filling)


@inlined
def are_far(pairs):
    """Whether the lists are too long for the caches."""
    return pairs.neighbors.shape[0] > FAR


@inlined
def expect(entries, k, far):
    """Have some of the entries behind those at k read beforehand, if they are far."""
    if far:
        prefetch(entries, k + AHEAD)


@inlined
def expect_all(pairs, k, far):
    """The same of neighbours and gradients."""
    expect(pairs.neighbors, k, far)
    expect(pairs.x, k, far)
    expect(pairs.y, k, far)
    expect(pairs.z, k, far)


@inlined
def push_by_pairs(pairs, values, first):
    """Sum of (a_i + a_j) g_ij over the neighbours j of each particle i of a slice.

    Args:
        pairs: from `sum_densities`.
        values: a, (N,) float32.
        first: particle of the slice.

    Returns:
        a of the slice; x, y, z of the sums.
    """
    own, far = take(values, first), are_far(pairs)
    x, y, z = spread(np.float32(0.0)), spread(np.float32(0.0)), spread(np.float32(0.0))
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        expect_all(pairs, k, far)
        both = own + gather(values, load(pairs.neighbors, k))
        x += both * load(pairs.x, k)
        y += both * load(pairs.y, k)
        z += both * load(pairs.z, k)
    unit = pairs.unit[0]
    return own, unit * x, unit * y, unit * z


@inlined
def divergence_of_pairs(pairs, displacements, first):
    """Sum of g_ij . (w_i - w_j) over the neighbours of a slice: how much denser it gets [-].

    Args:
        pairs: from `sum_densities`.
        displacements: w [m], (N, 3).
        first: particle of the slice.
    """
    x, y, z = take_points(displacements, first, 0)
    change, far = spread(np.float32(0.0)), are_far(pairs)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        expect_all(pairs, k, far)
        there_x, there_y, there_z = gather_points(displacements, load(pairs.neighbors, k))
        change += load(pairs.x, k) * (x - there_x)
        change += load(pairs.y, k) * (y - there_y)
        change += load(pairs.z, k) * (z - there_z)
    return pairs.unit[0] * change


@inlined
def impulse_of_pairs(pairs, positions, velocities, first, inverse_h, linear, quadratic, most):
    """Sum of (1 - r/h) q_ij n_ij ((v_i - v_j) . n_ij) over the neighbours of a slice, x, y, z.

    With n_ij the direction from j to i; q_ij = min(linear + quadratic c_ij, most), and c_ij the
    speed at which i and j approach each other, (v_j - v_i) . n_ij, or 0 if they do not. Directions
    are found anew: gradients of pairs at the rim of the support are kept with too few digits.

    Args:
        pairs: from `find_neighbors`.
        positions: [m], (N, 3), those of the lists.
        velocities: [m/s], (N, 3).
        first: particle of the slice.
        inverse_h: 1 / h [1/m], float32.
        linear, quadratic, most: float32.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    px, py, pz = take_points(positions, first, 0)
    vx, vy, vz = take_points(velocities, first, 0)
    ax, ay, az = spread(zero), spread(zero), spread(zero)
    far = are_far(pairs)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        expect(pairs.neighbors, k, far)
        j = load(pairs.neighbors, k)
        x, y, z = gather_points(positions, j)
        x, y, z = px - x, py - y, pz - z
        r2 = x * x + y * y + z * z + TINY
        inverse_r = inverse_root(r2)
        u, v, w = gather_points(velocities, j)
        along = (vx - u) * x
        along += (vy - v) * y
        along += (vz - w) * z
        along *= inverse_r
        taken = smaller(linear - quadratic * smaller(along, spread(zero)), spread(most))
        share = (one - inverse_h * (r2 * inverse_r)) * taken * along * inverse_r
        ax += share * x
        ay += share * y
        az += share * z
    return ax, ay, az


@inlined
def weights_after(pairs, positions, displacements, first, support_radius, bend):
    """Sums of a slice's weights after displacements, and how they grow to first order.

    The second is in units of density, see `divergence_of_pairs`.

    Args:
        pairs, displacements, first: as in `divergence_of_pairs`.
        positions: before [m], (N, 3), those of the lists.
        support_radius: h [m], float32.
        bend: as in `geometry_of_pairs`.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    inverse_h = one / support_radius
    x, y, z = take_points(positions, first, 0)
    ux, uy, uz = take_points(displacements, first, 0)
    weights, linear, far = spread(zero), spread(zero), are_far(pairs)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        expect_all(pairs, k, far)
        j = load(pairs.neighbors, k)
        mx, my, mz = gather_points(displacements, j)
        mx, my, mz = ux - mx, uy - my, uz - mz
        linear += load(pairs.x, k) * mx
        linear += load(pairs.y, k) * my
        linear += load(pairs.z, k) * mz
        dx, dy, dz = gather_points(positions, j)
        dx, dy, dz = x - dx + mx, y - dy + my, z - dz + mz
        u = one - inverse_h * root(dx * dx + dy * dy + dz * dz)
        u = larger(u, spread(zero))
        weights += u * u * (one + bend * (u - one))
    return weights - filling_of(pairs, first), pairs.unit[0] * linear


@inlined
def geometry_of_pairs(pairs, positions, first, inverse_h, bend):
    """Gradients of the pairs of a slice, and sums over them.

    Args:
        pairs: all of the slice but the lists is written.
        positions: [m], (N, 3), those of the lists.
        first: particle of the slice.
        inverse_h: 1 / h [1/m], float32.
        bend: power of the density's weight - 2: its gradient is u^(1 + bend), float32.

    Returns:
        Sums of u^(2 + bend) and u^3, with u = 1 - r/h; of the squared gradient and of the gradient
        (x, y, z) per largest gradient.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    x, y, z = take_points(positions, first, 0)
    w, n, square = spread(zero), spread(zero), spread(zero)
    tx, ty, tz = spread(zero), spread(zero), spread(zero)
    far = are_far(pairs)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        expect_all(pairs, k, far)
        j = load(pairs.neighbors, k)
        dx, dy, dz = gather_points(positions, j)
        dx, dy, dz = x - dx, y - dy, z - dz
        r2 = dx * dx + dy * dy + dz * dz + TINY
        inverse_r = inverse_root(r2)
        u = one - inverse_h * (r2 * inverse_r)
        bent = one + bend * (u - one)
        length = u * bent
        factor = length * inverse_r
        dx, dy, dz = factor * dx, factor * dy, factor * dz
        store(STEPS * u, pairs.nearness, k)
        store(STEPS * dx, pairs.x, k)
        store(STEPS * dy, pairs.y, k)
        store(STEPS * dz, pairs.z, k)
        w += u * length
        n += u * u * u
        square += length * length
        tx += dx
        ty += dy
        tz += dz
    # Entries that only fill the lists have counted as the particle itself, with weight 1.
    filling = filling_of(pairs, first)
    # Its own entry counts in the square, too.
    return w - filling, n - filling, square - filling - one, tx, ty, tz
