# SPDX-License-Identifier: Apache-2.0
"""What walls add to a particle's density and near-density, and its gradient.

Shares of the rest density come from tables over the distance (`wall_tables`). The table of a flat
wall is wrong at edges and corners, so leaves are put together as products, which is exact where the
weight is a product over the axes and good for the real one:

    solid box       F = c  prod over the axes of the slab's share / c
    container box   F = 1 - prod over the six sides of (1 - F(d))
    cylinder        the same with a radial and an axial factor
    union           1 - (1 - a) (1 - b)
    intersection    a b / c

with c = `full_cover`, the share deep inside a wall. F is the mirrored share; only along the axes of
a solid box or cylinder on which it does not face the particle is it the covered one. Gradients are
those of these very expressions, of the tables' linear interpolants and of the grids' trilinear
ones.
"""

import numpy as np
from numba import prange

from sph_ros.core.distances import (
    BOX,
    CAPSULE,
    CYLINDER,
    GRID,
    PLANE,
    UNION,
    distance_and_leaf,
    gradient_to_solid,
    grid_distance,
    grid_place,
    leaf_distance,
    leaf_normal,
    length2,
    outside_bounds,
    sign_of,
    to_leaf,
    trilinear,
)
from sph_ros.core.jit import inlined
from sph_ros.core.team import parallel_kernel

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)

#: Rows of the flat wall's two readings in the tables.
MIRRORED, COVERED = 0, 1


@inlined
def wall_share(shapes, table, distance):
    """Shares of density and near-density at a distance and their slopes [1/m]: (f, f', g, g')."""
    rows = shapes.tables
    last = rows.shape[1] - 1
    place = (distance + shapes.support_radius) * shapes.table_scale
    if place >= np.float32(last):
        return _ZERO, _ZERO, _ZERO, _ZERO
    if place <= _ZERO:
        return rows[table, 0, 0], _ZERO, rows[table, 0, 1], _ZERO
    row = np.int64(place)
    part = place - np.float32(row)
    f, g = rows[table, row, 0], rows[table, row, 1]
    df, dg = rows[table, row + 1, 0] - f, rows[table, row + 1, 1] - g
    scale = shapes.table_scale
    return f + part * df, df * scale, g + part * dg, dg * scale


@inlined
def slab_factor(shapes, half, coordinate, facing):
    """One axis's factor of a solid box or cylinder with sides at -half and half, and its slope.

    The covered share of the slab, 0 ... 1. On the axis that faces the particle the wall is
    mirrored: distances count twice there, and so half the slab's thickness.

    Returns:
        (factor, slope, near factor, near slope), slopes [1/m].
    """
    u = abs(coordinate)
    side = sign_of(coordinate)
    table = MIRRORED if facing else COVERED
    far = u if facing else u + half
    cf, cg = _ONE / shapes.full_cover[0], _ONE / shapes.full_cover[1]
    f0, df0, g0, dg0 = wall_share(shapes, table, u - half)
    f1, df1, g1, dg1 = wall_share(shapes, table, far)
    return (f0 - f1) * cf, side * (df0 - df1) * cf, (g0 - g1) * cg, side * (dg0 - dg1) * cg


@inlined
def gap_factor(shapes, half, coordinate):
    """One axis's factor of a container: the free share between its sides, as `slab_factor`."""
    u = abs(coordinate)
    side = sign_of(coordinate)
    f0, df0, g0, dg0 = wall_share(shapes, MIRRORED, half - u)
    f1, df1, g1, dg1 = wall_share(shapes, MIRRORED, half + u)
    f0, f1, g0, g1 = _ONE - f0, _ONE - f1, _ONE - g0, _ONE - g1
    return f0 * f1, side * (df0 * f1 - f0 * df1), g0 * g1, side * (dg0 * g1 - g0 * dg1)


@inlined
def radial_factor(shapes, table, radius, r, inverted):
    """The factor of a cylinder's round side, as `slab_factor` or `gap_factor`."""
    if inverted:
        f, df, g, dg = wall_share(shapes, table, radius - r)
        return _ONE - f, df, _ONE - g, dg
    cf, cg = _ONE / shapes.full_cover[0], _ONE / shapes.full_cover[1]
    f, df, g, dg = wall_share(shapes, table, r - radius)
    return f * cf, df * cf, g * cg, dg * cg


@inlined
def product_terms(cover, inverted, a, da, b, db, c, dc):
    """Share and gradient of the product of three factors that each vary along one direction."""
    scale = -_ONE if inverted else cover
    share = a * b * c
    value = _ONE - share if inverted else cover * share
    return value, scale * da * b * c, scale * a * db * c, scale * a * b * dc


@inlined
def box_terms(shapes, node, x, y, z, inverted):
    """(f, fx, fy, fz, g, gx, gy, gz) of a box in its own frame."""
    hx, hy, hz = shapes.node_size[node, 0], shapes.node_size[node, 1], shapes.node_size[node, 2]
    if inverted:
        fx, dfx, gx, dgx = gap_factor(shapes, hx, x)
        fy, dfy, gy, dgy = gap_factor(shapes, hy, y)
        fz, dfz, gz, dgz = gap_factor(shapes, hz, z)
    else:
        ax, ay, az = abs(x) - hx, abs(y) - hy, abs(z) - hz
        nearest = max(ax, max(ay, az))
        fx, dfx, gx, dgx = slab_factor(shapes, hx, x, ax == nearest)
        fy, dfy, gy, dgy = slab_factor(shapes, hy, y, ay == nearest)
        fz, dfz, gz, dgz = slab_factor(shapes, hz, z, az == nearest)
    f = product_terms(shapes.full_cover[0], inverted, fx, dfx, fy, dfy, fz, dfz)
    g = product_terms(shapes.full_cover[1], inverted, gx, dgx, gy, dgy, gz, dgz)
    return f[0], f[1], f[2], f[3], g[0], g[1], g[2], g[3]


@inlined
def cylinder_terms(shapes, node, x, y, z, inverted):
    """(f, fx, fy, fz, g, gx, gy, gz) of a cylinder about z in its own frame."""
    radius, half_length = shapes.node_size[node, 0], shapes.node_size[node, 1]
    r = length2(x, y)
    ux, uy = (x / r, y / r) if r > _ZERO else (_ZERO, _ZERO)
    round_faces = inverted or r - radius >= abs(z) - half_length
    table = shapes.node_table[node, 0 if round_faces else 1]
    fr, dfr, gr, dgr = radial_factor(shapes, table, radius, r, inverted)
    if inverted:
        fz, dfz, gz, dgz = gap_factor(shapes, half_length, z)
    else:
        fz, dfz, gz, dgz = slab_factor(shapes, half_length, z, not round_faces)
    f = product_terms(shapes.full_cover[0], inverted, fr, dfr, fz, dfz, _ONE, _ZERO)
    g = product_terms(shapes.full_cover[1], inverted, gr, dgr, gz, dgz, _ONE, _ZERO)
    return f[0], f[1] * ux, f[1] * uy, f[2], g[0], g[1] * ux, g[1] * uy, g[2]


@inlined
def end_weight(h, half_length, z):
    """How much a capsule's wall is its round end rather than its side (0 ... 1), and the slope.

    Halfway at the joint and linear over the support on both sides of it; a capsule much shorter
    than the support is a ball everywhere.
    """
    reach = min(h, half_length)
    least = _ONE - reach / h
    place = _HALF + _HALF * (abs(z) - half_length) / reach
    if place <= _ZERO:
        return least, _ZERO
    if place >= _ONE:
        return _ONE, _ZERO
    slope = (_ONE - least) * _HALF / reach
    return least + (_ONE - least) * place, slope * sign_of(z)


@inlined
def capsule_terms(shapes, node, x, y, z, inverted):
    """(f, fx, fy, fz, g, gx, gy, gz) of a capsule about z in its own frame."""
    d, nx, ny, nz = leaf_distance(shapes, node, x, y, z)
    sign = -_ONE if inverted else _ONE
    nx, ny, nz = nx * sign, ny * sign, nz * sign
    f0, df0, g0, dg0 = wall_share(shapes, shapes.node_table[node, 0], d * sign)
    f1, df1, g1, dg1 = wall_share(shapes, shapes.node_table[node, 1], d * sign)
    w, dw = end_weight(shapes.support_radius, shapes.node_size[node, 1], z)
    df, dg = df0 + w * (df1 - df0), dg0 + w * (dg1 - dg0)
    fz, gz = df * nz + dw * (f1 - f0), dg * nz + dw * (g1 - g0)
    f, g = f0 + w * (f1 - f0), g0 + w * (g1 - g0)
    return f, df * nx, df * ny, fz, g, dg * nx, dg * ny, gz


@inlined
def ratio_at(shapes, channel, first, row, slice_, u, v, w):
    """Trilinear value and gradient (per cell) of one channel of the ratio grid."""
    s = shapes.grid_ratio
    n, m = first, first + slice_
    return trilinear(
        s[n, channel],
        s[n + 1, channel],
        s[n + row, channel],
        s[n + row + 1, channel],
        s[m, channel],
        s[m + 1, channel],
        s[m + row, channel],
        s[m + row + 1, channel],
        u,
        v,
        w,
    )


@inlined
def grid_terms(shapes, node, x, y, z, inverted):
    """(f, fx, fy, fz, g, gx, gy, gz) of a mesh: the flat share times a sampled ratio."""
    grid = shapes.node_grid[node]
    sign = -_ONE if inverted else _ONE
    d, nx, ny, nz = grid_distance(shapes, grid, x, y, z)
    f, df, g, dg = wall_share(shapes, MIRRORED, d * sign)
    df, dg = df * sign, dg * sign
    i, u, ex = grid_place(shapes, grid, 0, x)
    j, v, ey = grid_place(shapes, grid, 1, y)
    k, w, ez = grid_place(shapes, grid, 2, z)
    if ex != _ZERO or ey != _ZERO or ez != _ZERO:
        return f, df * nx, df * ny, df * nz, g, dg * nx, dg * ny, dg * nz
    row = np.int64(shapes.grid_shape[grid, 2])
    slice_ = row * np.int64(shapes.grid_shape[grid, 1])
    first = shapes.grid_start[grid] + i * slice_ + j * row + k
    p, px, py, pz = ratio_at(shapes, 0, first, row, slice_, u, v, w)
    q, qx, qy, qz = ratio_at(shapes, 1, first, row, slice_, u, v, w)
    scale = _ONE / shapes.grid_cell[grid]
    fs, gs = f * scale, g * scale
    df, dg = df * p, dg * q
    return (
        f * p,
        df * nx + fs * px,
        df * ny + fs * py,
        df * nz + fs * pz,
        g * q,
        dg * nx + gs * qx,
        dg * ny + gs * qy,
        dg * nz + gs * qz,
    )


@inlined
def table_terms(shapes, node, x, y, z, table, inverted):
    """(f, fx, fy, fz, g, gx, gy, gz) of a leaf whose share depends on the distance alone."""
    d, nx, ny, nz = leaf_distance(shapes, node, x, y, z)
    sign = -_ONE if inverted else _ONE
    f, df, g, dg = wall_share(shapes, table, d * sign)
    df, dg = df * sign, dg * sign
    return f, df * nx, df * ny, df * nz, g, dg * nx, dg * ny, dg * nz


@inlined
def leaf_terms(shapes, node, x, y, z):
    """(f, fx, fy, fz, g, gx, gy, gz) of a leaf at a point, all in the solid's frame."""
    px, py, pz = to_leaf(shapes, node, x, y, z)
    op = shapes.node_op[node]
    inverted = shapes.node_sign[node] < _ZERO
    if op == BOX:
        t = box_terms(shapes, node, px, py, pz, inverted)
    elif op == GRID:
        t = grid_terms(shapes, node, px, py, pz, inverted)
    elif op == CAPSULE:
        t = capsule_terms(shapes, node, px, py, pz, inverted)
    elif op == CYLINDER:
        t = cylinder_terms(shapes, node, px, py, pz, inverted)
    elif op == PLANE:
        t = table_terms(shapes, node, px, py, pz, MIRRORED, inverted)
    else:
        t = table_terms(shapes, node, px, py, pz, shapes.node_table[node, 0], inverted)
    f, fx, fy, fz, g, gx, gy, gz = t
    fx, fy, fz = gradient_to_solid(shapes, node, fx, fy, fz)
    gx, gy, gz = gradient_to_solid(shapes, node, gx, gy, gz)
    return f, fx, fy, fz, g, gx, gy, gz


@inlined
def union_terms(a, b):
    """1 - (1 - a) (1 - b) and its gradient, for both weights."""
    fa, fb, ga, gb = _ONE - a[0], _ONE - b[0], _ONE - a[4], _ONE - b[4]
    return (
        _ONE - fa * fb,
        a[1] * fb + b[1] * fa,
        a[2] * fb + b[2] * fa,
        a[3] * fb + b[3] * fa,
        _ONE - ga * gb,
        a[5] * gb + b[5] * ga,
        a[6] * gb + b[6] * ga,
        a[7] * gb + b[7] * ga,
    )


@inlined
def intersection_terms(full_cover, a, b):
    """(a b) / full_cover and its gradient, for both weights."""
    cf, cg = _ONE / full_cover[0], _ONE / full_cover[1]
    fa, fb, ga, gb = a[0] * cf, b[0] * cf, a[4] * cg, b[4] * cg
    return (
        fa * b[0],
        a[1] * fb + b[1] * fa,
        a[2] * fb + b[2] * fa,
        a[3] * fb + b[3] * fa,
        ga * b[4],
        a[5] * gb + b[5] * ga,
        a[6] * gb + b[6] * ga,
        a[7] * gb + b[7] * ga,
    )


@inlined
def solid_terms(shapes, solid, x, y, z):
    """(f, fx, fy, fz, g, gx, gy, gz) of a whole solid: its program on a stack of four."""
    o = _ZERO
    t0 = t1 = t2 = t3 = (o, o, o, o, o, o, o, o)
    for node in range(shapes.solid_start[solid], shapes.solid_start[solid + 1]):
        op = shapes.node_op[node]
        if op < UNION:
            t3, t2, t1 = t2, t1, t0
            t0 = leaf_terms(shapes, node, x, y, z)
        else:
            if op == UNION:
                t0 = union_terms(t1, t0)
            else:
                t0 = intersection_terms(shapes.full_cover, t1, t0)
            t1, t2 = t2, t3
    return t0


@inlined
def wall_terms(shapes, solid, x, y, z, within):
    """Distance to a solid and what it adds to the density and near-density of a particle.

    Args:
        shapes: PackedShapes.
        solid: index of the solid.
        x: of the point in the solid's frame [m].
        y: of the point.
        z: of the point.
        within: distance from which on only the distance is wanted, at most the support radius [m].

    Returns:
        (d, nx, ny, nz, f, fx, fy, fz, g, gx, gy, gz): signed distance [m] and unit normal out of
        the material; share of the rest density [-] and its gradient [1/m]; the same for the
        near-density. From the support radius on, d is only a lower bound that is at least the
        support radius.
    """
    fx, fy, fz = np.float32(x), np.float32(y), np.float32(z)
    d, node = outside_bounds(shapes, solid, fx, fy, fz), np.int64(0)
    if d < shapes.support_radius:
        d, node = distance_and_leaf(shapes, solid, fx, fy, fz)
    if d >= within:
        o = _ZERO
        return d, o, o, o, o, o, o, o, o, o, o, o
    nx, ny, nz = leaf_normal(shapes, node, fx, fy, fz)
    t = solid_terms(shapes, solid, fx, fy, fz)
    return d, nx, ny, nz, t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7]


@parallel_kernel
def wall_terms_at(shapes, solid, points, terms):  # the last one is written
    """`wall_terms` of one solid at many points.

    Args:
        shapes: PackedShapes.
        solid: index of the solid.
        points: in the solid's frame [m], (M, 3) float32.
        terms: (M, 12) float32.
    """
    for i in prange(points.shape[0]):
        found = wall_terms(
            shapes, solid, points[i, 0], points[i, 1], points[i, 2], shapes.support_radius
        )
        for column in range(12):
            terms[i, column] = found[column]
