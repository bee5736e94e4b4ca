# SPDX-License-Identifier: Apache-2.0
"""Sums over the neighbours of sixteen particles at once: what nearly all time of a step goes into.

Lists are stored in slices of sixteen particles (`Pairs`), so that each lane of a vector belongs to
one particle and nothing is ever summed across lanes. Time then goes into reading: what belongs to
the neighbours, one element at a time, and the lists themselves, which no cache near the processor
holds. So a displacement is read as one word of fixed-point numbers (`pack`), a third of the
elements, and gradients are kept in 16 bits.
"""

from typing import NamedTuple

import numpy as np

from sph_ros.core.jit import inlined
from sph_ros.core.vector import (
    LANES,
    as_floats,
    inverse_root,
    larger,
    root,
    rounded,
    smaller,
    spread,
)
from sph_ros.core.vector_memory import (
    gather,
    gather_column,
    gather_words,
    lanes_from,
    load,
    store,
    take,
)

#: Numbers in a packed displacement are whole multiples of `REACH` support radii / 2^20.
REACH = np.float32(4.0)
LARGEST = np.float32((1 << 20) - 1)

#: Gradients and nearness are kept as whole multiples of 1 / `STEPS` of the largest.
STEPS = np.float32(32767.0)

#: Added to the squared distance of each pair [m^2], so that a particle may be its own neighbour:
#: 0 / tiny is 0.
TINY = np.float32(1e-20)


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
def resolution(support_radius):
    """Length of the unit of packed displacements [m]."""
    return support_radius * REACH / np.float32(1 << 20)


@inlined
def _whole(value, inverse):
    """`value` in units of 1 / `inverse`, a whole number; what does not fit becomes the largest."""
    return rounded(larger(smaller(value * inverse, spread(LARGEST)), spread(-LARGEST)))


@inlined
def pack(x, y, z, support_radius):
    """Displacements [m] as words, in a lower and an upper half: x and y in 21 bits each, z in 22.

    The lower half holds x and half of z, the upper one y and the rest of z.
    """
    inverse = np.float32(1.0) / resolution(support_radius)
    z_bits = _whole(z, inverse) + (1 << 20)
    low = (_whole(x, inverse) << 11) | (z_bits & 0x7FF)
    return low, (_whole(y, inverse) << 11) | (z_bits >> 11)


@inlined
def unpacked(low, high):
    """Components of packed displacements, whole numbers in their unit."""
    z = (((high & 0x7FF) << 11) | (low & 0x7FF)) - (1 << 20)
    return as_floats(low >> 11), as_floats(high >> 11), as_floats(z)


@inlined
def filling_of(pairs, first):
    """Entries that only fill up the lists of the slice that begins at particle `first`."""
    width = np.int64(pairs.stop[first // LANES]) - np.int64(pairs.start[first])
    filling = (take(pairs.start, first) - take(pairs.end, first) + width) >> 4
    return as_floats(filling)


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
    own = take(values, first)
    x, y, z = spread(np.float32(0.0)), spread(np.float32(0.0)), spread(np.float32(0.0))
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        both = own + gather(values, load(pairs.neighbors, k))
        x += both * load(pairs.x, k)
        y += both * load(pairs.y, k)
        z += both * load(pairs.z, k)
    unit = pairs.unit[0]
    return own, unit * x, unit * y, unit * z


@inlined
def divergence_of_pairs(pairs, packed, first, support_radius):
    """Sum of g_ij . (w_i - w_j) over the neighbours of a slice: how much denser it gets [-].

    Args:
        pairs: from `sum_densities`.
        packed: displacements w by `pack`, (N,) int64.
        first: particle of the slice.
        support_radius: h [m], float32.
    """
    rows = lanes_from(first, packed.shape[0])
    low, high = gather_words(packed, rows)
    x, y, z = unpacked(low, high)
    change = spread(np.float32(0.0))
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        low, high = gather_words(packed, load(pairs.neighbors, k))
        there_x, there_y, there_z = unpacked(low, high)
        change += load(pairs.x, k) * (x - there_x)
        change += load(pairs.y, k) * (y - there_y)
        change += load(pairs.z, k) * (z - there_z)
    return (pairs.unit[0] * resolution(support_radius)) * change


@inlined
def impulse_of_pairs(pairs, columns, velocities, first, inverse_h, linear, quadratic, most):
    """Sum of (1 - r/h) q_ij n_ij ((v_i - v_j) . n_ij) over the neighbours of a slice, x, y, z.

    With n_ij the direction from j to i; q_ij = min(linear + quadratic c_ij, most), and c_ij the
    speed at which i and j approach each other, (v_j - v_i) . n_ij, or 0 if they do not. Directions
    are found anew: gradients of pairs at the rim of the support are kept with too few digits.

    Args:
        pairs: from `find_neighbors`.
        columns: coordinates [m], as there.
        velocities: [m/s], (N, 3).
        first: particle of the slice.
        inverse_h: 1 / h [1/m], float32.
        linear, quadratic, most: float32.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    xs, ys, zs = columns[0], columns[1], columns[2]
    rows = lanes_from(first, velocities.shape[0])
    px, py, pz = gather(xs, rows), gather(ys, rows), gather(zs, rows)
    vx, vy = gather_column(velocities, rows, 0), gather_column(velocities, rows, 1)
    vz = gather_column(velocities, rows, 2)
    ax, ay, az = spread(zero), spread(zero), spread(zero)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        j = load(pairs.neighbors, k)
        x, y, z = px - gather(xs, j), py - gather(ys, j), pz - gather(zs, j)
        r2 = x * x + y * y + z * z + TINY
        inverse_r = inverse_root(r2)
        along = (vx - gather_column(velocities, j, 0)) * x
        along += (vy - gather_column(velocities, j, 1)) * y
        along += (vz - gather_column(velocities, j, 2)) * z
        along *= inverse_r
        taken = smaller(linear - quadratic * smaller(along, spread(zero)), spread(most))
        share = (one - inverse_h * (r2 * inverse_r)) * taken * along * inverse_r
        ax += share * x
        ay += share * y
        az += share * z
    return ax, ay, az


@inlined
def weights_after(pairs, columns, packed, first, support_radius, bend):
    """Sums of a slice's weights after displacements, and how they grow to first order.

    The second is in units of density, see `divergence_of_pairs`.

    Args:
        pairs, packed, first, support_radius: as in `divergence_of_pairs`.
        columns: coordinates before [m], as in `find_neighbors`.
        bend: as in `geometry_of_pairs`.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    inverse_h, unit = one / support_radius, resolution(support_radius)
    xs, ys, zs = columns[0], columns[1], columns[2]
    rows = lanes_from(first, packed.shape[0])
    x, y, z = gather(xs, rows), gather(ys, rows), gather(zs, rows)
    low, high = gather_words(packed, rows)
    ux, uy, uz = unpacked(low, high)
    weights, linear = spread(zero), spread(zero)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        j = load(pairs.neighbors, k)
        low, high = gather_words(packed, j)
        mx, my, mz = unpacked(low, high)
        mx, my, mz = ux - mx, uy - my, uz - mz
        linear += load(pairs.x, k) * mx
        linear += load(pairs.y, k) * my
        linear += load(pairs.z, k) * mz
        dx = x - gather(xs, j) + unit * mx
        dy = y - gather(ys, j) + unit * my
        dz = z - gather(zs, j) + unit * mz
        u = one - inverse_h * root(dx * dx + dy * dy + dz * dz)
        u = larger(u, spread(zero))
        weights += u * u * (one + bend * (u - one))
    return weights - filling_of(pairs, first), (pairs.unit[0] * unit) * linear


@inlined
def geometry_of_pairs(pairs, columns, first, inverse_h, bend):
    """Gradients of the pairs of a slice, and sums over them.

    Args:
        pairs: all of the slice but the lists is written.
        columns: coordinates [m], as in `find_neighbors`.
        first: particle of the slice.
        inverse_h: 1 / h [1/m], float32.
        bend: power of the density's weight - 2: its gradient is u^(1 + bend), float32.

    Returns:
        Sums of u^(2 + bend) and u^3, with u = 1 - r/h; of the squared gradient and of the gradient
        (x, y, z) per largest gradient.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    xs, ys, zs = columns[0], columns[1], columns[2]
    rows = lanes_from(first, pairs.start.shape[0])
    x, y, z = gather(xs, rows), gather(ys, rows), gather(zs, rows)
    w, n, square = spread(zero), spread(zero), spread(zero)
    tx, ty, tz = spread(zero), spread(zero), spread(zero)
    for k in range(pairs.start[first], pairs.stop[first // LANES], LANES):
        j = load(pairs.neighbors, k)
        dx, dy, dz = x - gather(xs, j), y - gather(ys, j), z - gather(zs, j)
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
