# SPDX-License-Identifier: Apache-2.0
"""Sums over the pairs of one particle: what nearly all time of a step goes into.

Each comes twice with the same meaning: as a plain loop, which the compiler turns into what vector
code it can, and by hand for processors with AVX-512. Their time goes into reading what belongs to
the neighbours, one element at a time: three floats of a displacement take longer than all
arithmetic. So by hand a displacement is read as one word of fixed-point numbers (`pack`), a third
of the elements.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from sph_ros.core.jit import inlined
from sph_ros.core.vector import FAST, HAS_GATHER, data_pointer, sums_in_vectors

#: Numbers in a packed displacement are whole multiples of `REACH` support radii / 2^20.
REACH = np.float32(4.0)
LARGEST = np.float32((1 << 20) - 1)

#: Added to the squared distance of each pair [m^2], so that a particle may be its own neighbour:
#: 0 / tiny is 0.
TINY = 1e-20


@inlined
def resolution(support_radius):
    """Length of the unit of packed displacements [m]."""
    return support_radius * REACH / np.float32(1 << 20)


@inlined
def _whole(value, inverse):
    """`value` in units of 1 / `inverse`, a whole number; what does not fit becomes the largest."""
    return np.int64(np.rint(max(min(value * inverse, LARGEST), -LARGEST)))


@inlined
def pack(x, y, z, support_radius):
    """A displacement [m] in one word: x and y in 21 bits each, z in 22.

    The lower half of the word holds x and half of z, the upper one y and the rest of z.
    """
    inverse = np.float32(1.0) / resolution(support_radius)
    z_bits = _whole(z, inverse) + (1 << 20)
    low = ((_whole(x, inverse) << 11) & 0xFFFFFFFF) | (z_bits & 0x7FF)
    return (_whole(y, inverse) << 43) | ((z_bits >> 11) << 32) | low


@inlined
def unpacked(word):
    """Components of a packed displacement, whole numbers in its unit, float32."""
    z = ((((word >> 32) & 0x7FF) << 11) | (word & 0x7FF)) - (1 << 20)
    return np.float32((word << 32) >> 43), np.float32(word >> 43), np.float32(z)


def _unpacked(builder, v, source, indices):
    """Components of the packed displacements source[indices], vectors of floats, in their unit."""
    low, high = v.gather_words(source, indices)
    eleven, bits = v.constant(11, integer=True), v.constant(0x7FF, integer=True)
    z_low = builder.and_(low, bits)
    z_high = builder.shl(builder.and_(high, bits), eleven)
    z = builder.sub(builder.or_(z_low, z_high), v.constant(1 << 20, integer=True))
    whole = builder.ashr(low, eleven), builder.ashr(high, eleven), z
    return [builder.sitofp(number, v.floats) for number in whole]


def _bent(builder, v, bend, u):
    """What the weight is times u^2: 1, or u where `bend` is 1; see `geometry_of_pairs`."""
    return v.multiply_add(bend, builder.fsub(u, v.constant(1.0), flags=FAST), v.constant(1.0))


# ---------------------------------------------------------------- pushes


@intrinsic
def _push_in_vectors(typingctx, neighbors, gradients, values, start, end, own):
    signature = types.UniTuple(types.float32, 3)(
        neighbors, gradients, values, types.intp, types.intp, types.float32
    )

    def codegen(context, builder, sig, args):
        neighbors_, gradients_, values_, start_, end_, own_ = args
        js = data_pointer(context, builder, sig.args[0], neighbors_)
        rows = [data_pointer(context, builder, sig.args[1], gradients_, row) for row in range(3)]
        source = data_pointer(context, builder, sig.args[2], values_)

        def body(v, k, sums):
            theirs = v.gather(source, v.load(js, k, integer=True))
            both = builder.fadd(v.splat(own_), theirs, flags=FAST)
            return [
                v.multiply_add(both, v.load(row, k), value)
                for row, value in zip(rows, sums, strict=True)
            ]

        sums = sums_in_vectors(builder, start_, end_, 3, body)
        return context.make_tuple(builder, sig.return_type, sums)

    return signature, codegen


@inlined
def _push_plainly(neighbors, gradients, values, start, end, own):
    x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    js = neighbors[start:end]
    gx, gy, gz = gradients[0, start:end], gradients[1, start:end], gradients[2, start:end]
    for k in range(js.shape[0]):
        both = own + values[js[k]]
        x += both * gx[k]
        y += both * gy[k]
        z += both * gz[k]
    return x, y, z


_push = _push_in_vectors if HAS_GATHER else _push_plainly


@inlined
def push_by_pairs(pairs, values, i):
    """Sum of (a_i + a_j) g_ij over the neighbours j of particle i, x, y, z.

    Args:
        pairs: from `sum_densities`.
        values: a, (N,) float32.
        i: row of the particle.
    """
    return _push(pairs.neighbors, pairs.gradients, values, pairs.start[i], pairs.end[i], values[i])


# ---------------------------------------------------------------- divergences


@intrinsic
def _divergence_in_vectors(typingctx, neighbors, gradients, packed, start, end, x, y, z):
    real = types.float32
    signature = real(neighbors, gradients, packed, types.intp, types.intp, real, real, real)

    def codegen(context, builder, sig, args):
        neighbors_, gradients_, packed_, start_, end_, x_, y_, z_ = args
        js = data_pointer(context, builder, sig.args[0], neighbors_)
        rows = [data_pointer(context, builder, sig.args[1], gradients_, row) for row in range(3)]
        source = data_pointer(context, builder, sig.args[2], packed_)

        def body(v, k, sums):
            theirs = _unpacked(builder, v, source, v.load(js, k, integer=True))
            total = sums[0]
            for row, own, other in zip(rows, (x_, y_, z_), theirs, strict=True):
                way = builder.fsub(v.splat(own), other, flags=FAST)
                total = v.multiply_add(v.load(row, k), way, total)
            return [total]

        return sums_in_vectors(builder, start_, end_, 1, body)[0]

    return signature, codegen


@inlined
def _divergence_by_hand(pairs, displacements, packed, i, support_radius):
    x, y, z = unpacked(packed[i])
    return resolution(support_radius) * _divergence_in_vectors(
        pairs.neighbors, pairs.gradients, packed, pairs.start[i], pairs.end[i], x, y, z
    )


@inlined
def _divergence_plainly(pairs, displacements, packed, i, support_radius):
    x, y, z = displacements[i, 0], displacements[i, 1], displacements[i, 2]
    change = np.float32(0.0)
    start, end = pairs.start[i], pairs.end[i]
    js = pairs.neighbors[start:end]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz = pairs.gradients[2, start:end]
    for k in range(js.shape[0]):
        j = js[k]
        change += (
            gx[k] * (x - displacements[j, 0])
            + gy[k] * (y - displacements[j, 1])
            + gz[k] * (z - displacements[j, 2])
        )
    return change


_divergence = _divergence_by_hand if HAS_GATHER else _divergence_plainly


@inlined
def divergence_of_pairs(pairs, displacements, packed, i, support_radius):
    """Sum of g_ij . (w_i - w_j) over the neighbours j of particle i: how much denser it gets [-].

    Args:
        pairs: from `sum_densities`.
        displacements: w [m], (N, 3).
        packed: the same by `pack`, (N,) int64.
        i: row of the particle.
        support_radius: h [m], float32.
    """
    return _divergence(pairs, displacements, packed, i, support_radius)


# ---------------------------------------------------------------- viscosity


@intrinsic
def _impulse_in_vectors(typingctx, neighbors, gradients, velocities, start, end, own, rates):
    signature = types.UniTuple(types.float32, 3)(
        neighbors, gradients, velocities, types.intp, types.intp, own, rates
    )

    def codegen(context, builder, sig, args):
        neighbors_, gradients_, velocities_, start_, end_, own_, rates_ = args
        js = data_pointer(context, builder, sig.args[0], neighbors_)
        rows = [data_pointer(context, builder, sig.args[1], gradients_, row) for row in range(4)]
        source = data_pointer(context, builder, sig.args[2], velocities_)
        sources = [builder.gep(source, [ir.Constant(start_.type, axis)]) for axis in range(3)]
        centre = [builder.extract_value(own_, axis) for axis in range(3)]
        rates_ = [builder.extract_value(rates_, which) for which in range(4)]

        def body(v, k, sums):
            linear, quadratic, most, bend = (v.splat(rate) for rate in rates_)
            columns = v.constant(3, integer=True)
            indices = builder.mul(v.load(js, k, integer=True), columns)
            gradient = [v.load(row, k) for row in rows[:3]]
            u = v.load(rows[3], k)
            along = v.constant(0.0)
            for slope, velocity, there in zip(gradient, centre, sources, strict=True):
                relative = builder.fsub(v.splat(velocity), v.gather(there, indices), flags=FAST)
                along = v.multiply_add(relative, slope, along)
            above = builder.fadd(u, v.constant(1e-3), flags=FAST)
            above = builder.fmul(above, _bent(builder, v, bend, above), flags=FAST)
            inverse_u = builder.fdiv(v.constant(1.0), above)
            approach = builder.fmul(v.positive(along), inverse_u, flags=FAST)
            wanted = v.multiply_add(quadratic, approach, linear)
            taken = builder.select(builder.fcmp_ordered("<", wanted, most), wanted, most)
            share = builder.fmul(builder.fmul(u, taken, flags=FAST), along, flags=FAST)
            share = builder.fmul(builder.fmul(share, inverse_u, flags=FAST), inverse_u, flags=FAST)
            return [
                v.multiply_add(share, slope, value)
                for slope, value in zip(gradient, sums, strict=True)
            ]

        sums = sums_in_vectors(builder, start_, end_, 3, body)
        return context.make_tuple(builder, sig.return_type, sums)

    return signature, codegen


@inlined
def _impulse_by_hand(pairs, velocities, i, linear, quadratic, most, bend):
    return _impulse_in_vectors(
        pairs.neighbors,
        pairs.gradients,
        velocities,
        pairs.start[i],
        pairs.end[i],
        (velocities[i, 0], velocities[i, 1], velocities[i, 2]),
        (linear, quadratic, most, bend),
    )


@inlined
def _impulse_plainly(pairs, velocities, i, linear, quadratic, most, bend):
    zero, one = np.float32(0.0), np.float32(1.0)
    vx, vy, vz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
    ax, ay, az = zero, zero, zero
    start, end = pairs.start[i], pairs.end[i]
    js = pairs.neighbors[start:end]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
    for k in range(js.shape[0]):
        j = js[k]
        along = (
            (vx - velocities[j, 0]) * gx[k]
            + (vy - velocities[j, 1]) * gy[k]
            + (vz - velocities[j, 2]) * gz[k]
        )
        above = us[k] + np.float32(1e-3)
        inverse_u = one / (above * (one + bend * (above - one)))
        taken = min(linear + quadratic * max(along, zero) * inverse_u, most)
        c = us[k] * taken * along * inverse_u * inverse_u
        ax += c * gx[k]
        ay += c * gy[k]
        az += c * gz[k]
    return ax, ay, az


_impulse = _impulse_by_hand if HAS_GATHER else _impulse_plainly


@inlined
def impulse_of_pairs(pairs, velocities, i, linear, quadratic, most, bend):
    """Sum of (1 - r/h) q_ij n_ij ((v_i - v_j) . n_ij) over the neighbours of i.

    With n_ij the gradient over (1 - r/h), or where the weight is cubic over (1 - r/h)^2;
    q_ij = min(linear + quadratic c_ij, most), and c_ij the speed at which i and j approach each
    other, (v_i - v_j) . n_ij, or 0 if they do not.

    Args:
        pairs: from `sum_densities`.
        velocities: [m/s], (N, 3).
        i: row of the particle.
        linear, quadratic, most: float32.
        bend: as in `geometry_of_pairs`.
    """
    return _impulse(pairs, velocities, i, linear, quadratic, most, bend)


# ---------------------------------------------------------------- densities after displacements


@intrinsic
def _growth_in_vectors(
    typingctx, neighbors, gradients, columns, packed, start, end, at, way, units
):
    signature = types.UniTuple(types.float32, 2)(
        neighbors,
        gradients,
        columns,
        packed,
        types.intp,
        types.intp,
        at,
        way,
        units,
    )

    def codegen(context, builder, sig, args):
        neighbors_, gradients_, columns_, packed_, start_, end_, at_, way_, units_ = args
        unit_, inverse_, bend_ = (builder.extract_value(units_, which) for which in range(3))
        js = data_pointer(context, builder, sig.args[0], neighbors_)
        rows = [data_pointer(context, builder, sig.args[1], gradients_, row) for row in range(4)]
        places = [data_pointer(context, builder, sig.args[2], columns_, row) for row in range(3)]
        source = data_pointer(context, builder, sig.args[3], packed_)
        centre = [builder.extract_value(at_, axis) for axis in range(3)]
        own_way = [builder.extract_value(way_, axis) for axis in range(3)]

        def body(v, k, sums):
            grown, linear = sums
            indices = v.load(js, k, integer=True)
            square = None
            theirs = _unpacked(builder, v, source, indices)
            for axis, other in enumerate(theirs):
                relative = builder.fsub(v.splat(own_way[axis]), other, flags=FAST)
                relative = builder.fmul(relative, v.splat(unit_), flags=FAST)
                linear = v.multiply_add(v.load(rows[axis], k), relative, linear)
                there = v.gather(places[axis], indices)
                apart = builder.fadd(
                    builder.fsub(v.splat(centre[axis]), there, flags=FAST), relative, flags=FAST
                )
                term = builder.fmul(apart, apart, flags=FAST)
                square = term if square is None else builder.fadd(square, term, flags=FAST)
            share = builder.fmul(v.square_root(square), v.splat(inverse_), flags=FAST)
            u = v.positive(builder.fsub(v.constant(1.0), share, flags=FAST))
            before = v.load(rows[3], k)
            for value, add in ((u, builder.fadd), (before, builder.fsub)):
                square = builder.fmul(value, value, flags=FAST)
                weight = builder.fmul(square, _bent(builder, v, v.splat(bend_), value), flags=FAST)
                grown = add(grown, weight, flags=FAST)
            return [grown, linear]

        sums = sums_in_vectors(builder, start_, end_, 2, body)
        return context.make_tuple(builder, sig.return_type, sums)

    return signature, codegen


@inlined
def _growth_by_hand(pairs, columns, displacements, packed, i, support_radius, bend):
    # Its own displacement packed, too: only then a particle does not move against itself.
    return _growth_in_vectors(
        pairs.neighbors,
        pairs.gradients,
        columns,
        packed,
        pairs.start[i],
        pairs.end[i],
        (columns[0, i], columns[1, i], columns[2, i]),
        unpacked(packed[i]),
        (resolution(support_radius), np.float32(1.0) / support_radius, bend),
    )


@inlined
def _growth_plainly(pairs, columns, displacements, packed, i, support_radius, bend):
    one, zero = np.float32(1.0), np.float32(0.0)
    inverse_h = one / support_radius
    xs, ys, zs = columns[0], columns[1], columns[2]
    x, y, z = xs[i], ys[i], zs[i]
    ux, uy, uz = displacements[i, 0], displacements[i, 1], displacements[i, 2]
    grown, linear = zero, zero
    start, end = pairs.start[i], pairs.end[i]
    js = pairs.neighbors[start:end]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
    for k in range(js.shape[0]):
        j = js[k]
        mx = ux - displacements[j, 0]
        my = uy - displacements[j, 1]
        mz = uz - displacements[j, 2]
        linear += gx[k] * mx + gy[k] * my + gz[k] * mz
        dx, dy, dz = x - xs[j] + mx, y - ys[j] + my, z - zs[j] + mz
        u = one - np.sqrt(dx * dx + dy * dy + dz * dz) * inverse_h
        u = u if u > zero else zero
        before = us[k]
        grown += u * u * (one + bend * (u - one))
        grown -= before * before * (one + bend * (before - one))
    return grown, linear


_growth = _growth_by_hand if HAS_GATHER else _growth_plainly


@inlined
def growth_by_pairs(pairs, columns, displacements, packed, i, support_radius, bend):
    """What particle i's sum of weights over its neighbours grows by, and linearised.

    The second is in units of density, see `divergence_of_pairs`.

    Args:
        pairs, displacements, packed, i, support_radius: as in `divergence_of_pairs`.
        columns: coordinates before [m], as in `find_neighbors`.
        bend: as in `geometry_of_pairs`.
    """
    return _growth(pairs, columns, displacements, packed, i, support_radius, bend)


# ---------------------------------------------------------------- geometry


@intrinsic
def _geometry_in_vectors(typingctx, neighbors, gradients, columns, start, end, at, units):
    signature = types.UniTuple(types.float32, 6)(
        neighbors,
        gradients,
        columns,
        types.intp,
        types.intp,
        at,
        units,
    )

    def codegen(context, builder, sig, args):
        neighbors_, gradients_, columns_, start_, end_, at_, units_ = args
        slope_, inverse_, bend_ = (builder.extract_value(units_, which) for which in range(3))
        js = data_pointer(context, builder, sig.args[0], neighbors_)
        rows = [data_pointer(context, builder, sig.args[1], gradients_, row) for row in range(4)]
        places = [data_pointer(context, builder, sig.args[2], columns_, row) for row in range(3)]
        centre = [builder.extract_value(at_, axis) for axis in range(3)]

        def body(v, k, sums):
            indices = v.load(js, k, integer=True)
            square, apart = v.constant(TINY), []
            for place, own in zip(places, centre, strict=True):
                there = v.gather(place, indices)
                apart.append(builder.fsub(v.splat(own), there, flags=FAST))
                square = v.multiply_add(apart[-1], apart[-1], square)
            inverse_r = builder.fdiv(v.constant(1.0), v.square_root(square))
            share = builder.fmul(square, inverse_r, flags=FAST)
            share = builder.fmul(share, v.splat(inverse_), flags=FAST)
            u = builder.fsub(v.constant(1.0), share, flags=FAST)
            bent = _bent(builder, v, v.splat(bend_), u)
            length = builder.fmul(builder.fmul(v.splat(slope_), u, flags=FAST), bent, flags=FAST)
            factor = builder.fmul(length, inverse_r, flags=FAST)
            u2 = builder.fmul(u, u, flags=FAST)
            new = [v.multiply_add(u2, bent, sums[0]), v.multiply_add(u2, u, sums[1])]
            new.append(v.multiply_add(length, length, sums[2]))
            v.store(u, rows[3], k)
            for axis in range(3):
                component = builder.fmul(factor, apart[axis], flags=FAST)
                v.store(component, rows[axis], k)
                new.append(builder.fadd(sums[3 + axis], component, flags=FAST))
            return new

        sums = sums_in_vectors(builder, start_, end_, 6, body)
        return context.make_tuple(builder, sig.return_type, sums)

    return signature, codegen


@inlined
def _geometry_by_hand(pairs, columns, i, slope, inverse_h, bend):
    return _geometry_in_vectors(
        pairs.neighbors,
        pairs.gradients,
        columns,
        pairs.start[i],
        pairs.end[i],
        (columns[0, i], columns[1, i], columns[2, i]),
        (slope, inverse_h, bend),
    )


@inlined
def _geometry_plainly(pairs, columns, i, slope, inverse_h, bend):
    one = np.float32(1.0)
    xs, ys, zs = columns[0], columns[1], columns[2]
    x, y, z = xs[i], ys[i], zs[i]
    w, n, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    tx, ty, tz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    start, end = pairs.start[i], pairs.end[i]
    js = pairs.neighbors[start:end]
    gx, gy = pairs.gradients[0, start:end], pairs.gradients[1, start:end]
    gz, us = pairs.gradients[2, start:end], pairs.gradients[3, start:end]
    # One loop for each array written: with more the compiler gives up proving that they do not
    # overlap with those read, and makes no vector code.
    for k in range(js.shape[0]):
        j = js[k]
        dx = x - xs[j]
        dy = y - ys[j]
        dz = z - zs[j]
        us[k] = dx * dx + dy * dy + dz * dz + np.float32(TINY)
    for k in range(js.shape[0]):
        r2 = us[k]
        inverse_r = one / np.sqrt(r2)
        u = one - r2 * inverse_r * inverse_h
        us[k] = u
        bent = one + bend * (u - one)
        length = slope * u * bent
        gx[k] = length * inverse_r
        w += u * u * bent
        n += u * u * u
        square += length * length
    for k in range(js.shape[0]):
        c = gx[k] * (y - ys[js[k]])
        gy[k] = c
        ty += c
    for k in range(js.shape[0]):
        c = gx[k] * (z - zs[js[k]])
        gz[k] = c
        tz += c
    for k in range(js.shape[0]):
        c = gx[k] * (x - xs[js[k]])
        gx[k] = c
        tx += c
    return w, n, square, tx, ty, tz


_geometry = _geometry_by_hand if HAS_GATHER else _geometry_plainly


@inlined
def geometry_of_pairs(pairs, columns, i, slope, inverse_h, bend):
    """Gradients of the pairs of particle i, and sums over them.

    Args:
        pairs: from `find_neighbors`; the gradients of i's pairs are written.
        columns: as in `find_neighbors`.
        i: row of the particle.
        slope: derivative of the normalised density weight at r = 0 [1/m], float32.
        inverse_h: 1 / h [1/m], float32.
        bend: 0 for the weight (1 - r/h)^2, 1 for (1 - r/h)^3; gradients are the slope times the
            weight over (1 - r/h), float32.

    Returns:
        Sums of the weight, of (1 - r/h)^3 and of the squared gradients, in which a particle counts
        as its own neighbour as often as the list has it; sum of the gradients, x, y, z.
    """
    return _geometry(pairs, columns, i, slope, inverse_h, bend)
