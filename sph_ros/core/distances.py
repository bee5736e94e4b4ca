# SPDX-License-Identifier: Apache-2.0
"""Signed distances of packed solids [m], negative inside the material, in each solid's own frame.

A solid is a short postfix program: leaves (primitives, distance grids) and the two operations union
and intersection. Inside-out shapes and differences are turned into these by inverting leaves, which
is done where the solids are packed. The program runs on a stack of `STACK_DEPTH` scalars that are
shifted like a register, so nothing is allocated. Distances of single primitives are exact
everywhere; those of unions and intersections are never larger than the true distance outside the
material.

In 2D the liquid lives in the plane y = 0 of the solid's frame: the transforms of the leaves then
drop y, and gradients have no y component.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.jit import called, inlined
from sph_ros.core.team import parallel_kernel

SPHERE, BOX, CAPSULE, CYLINDER, PLANE, GRID, UNION, INTERSECTION = range(8)

#: Operands that may wait on the stack: enough for eight leaves in the worst nesting, and for any
#: number of them in one list.
STACK_DEPTH = 4

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_TINY = np.float32(1e-20)
_FAR = np.float32(1e30)


class PackedShapes(NamedTuple):
    """Solids as arrays; S solids, N nodes of their programs, T tables, G grids.

    Attributes:
        support_radius: h [m], float32.
        table_scale: rows of a table per metre, float32.
        full_cover: largest share of the density and near-density a wall can have, (2,).
        solid_start: nodes of solid i are solid_start[i]:solid_start[i + 1], (S + 1,).
        bounds: ball around the material, centre and radius [m]; radius 1e30 if endless, (S, 4).
        reach: from this distance on a solid adds no density, at most the support radius [m], (S,).
        node_op: SPHERE ... INTERSECTION, (N,).
        node_sign: +1, or -1 for an inverted leaf, (N,).
        node_transform: rows of [M | b], leaf point = M solid point + b, (N, 3, 4).
        node_size: SPHERE radius; BOX half sizes; CAPSULE, CYLINDER radius, half length; a PLANE
            is z = 0 of its frame [m], (N, 3).
        node_table: wall tables of a leaf: round side (ball, cylinder, strip), a capsule's
            ends, (N, 2).
        node_grid: distance grid of a leaf, or -1, (N,).
        tables: wall shares over distance, see `wall_tables`, (T, rows, 2).
        film_gap: at which films between two solids end [m], float32; 0: there are none.
        film: what films lack of the density, over their gap, see `thin_film_tables`, (rows,).
        grid_origin: position of the first sample in the leaf's frame [m], (G, 3).
        grid_cell: sample spacing [m], (G,).
        grid_shape: samples along x, y, z, (G, 3).
        grid_start: first sample of each grid in the next two, (G,) int64.
        grid_distance: signed distance samples [m], z fastest, (M,).
        grid_ratio: wall share relative to a flat wall's at the same distance, (M, 2).
    """

    support_radius: np.float32
    table_scale: np.float32
    full_cover: np.ndarray
    solid_start: np.ndarray
    bounds: np.ndarray
    reach: np.ndarray
    node_op: np.ndarray
    node_sign: np.ndarray
    node_transform: np.ndarray
    node_size: np.ndarray
    node_table: np.ndarray
    node_grid: np.ndarray
    tables: np.ndarray
    film_gap: np.float32
    film: np.ndarray
    grid_origin: np.ndarray
    grid_cell: np.ndarray
    grid_shape: np.ndarray
    grid_start: np.ndarray
    grid_distance: np.ndarray
    grid_ratio: np.ndarray


@inlined
def to_leaf(shapes, node, x, y, z):
    """A point of the solid's frame in the frame of a leaf [m]."""
    m = shapes.node_transform
    return (
        m[node, 0, 0] * x + m[node, 0, 1] * y + m[node, 0, 2] * z + m[node, 0, 3],
        m[node, 1, 0] * x + m[node, 1, 1] * y + m[node, 1, 2] * z + m[node, 1, 3],
        m[node, 2, 0] * x + m[node, 2, 1] * y + m[node, 2, 2] * z + m[node, 2, 3],
    )


@inlined
def gradient_to_solid(shapes, node, gx, gy, gz):
    """A gradient in the frame of a leaf as a gradient in the solid's frame."""
    m = shapes.node_transform
    return (
        m[node, 0, 0] * gx + m[node, 1, 0] * gy + m[node, 2, 0] * gz,
        m[node, 0, 1] * gx + m[node, 1, 1] * gy + m[node, 2, 1] * gz,
        m[node, 0, 2] * gx + m[node, 1, 2] * gy + m[node, 2, 2] * gz,
    )


@inlined
def normalized(x, y, z):
    """The unit vector along (x, y, z); z where it has no direction."""
    square = x * x + y * y + z * z
    if square < _TINY:
        return _ZERO, _ZERO, _ONE
    scale = _ONE / np.float32(math.sqrt(square))
    return x * scale, y * scale, z * scale


@inlined
def length3(x, y, z):
    """Euclidean length."""
    return np.float32(math.sqrt(x * x + y * y + z * z))


@inlined
def length2(x, y):
    """Euclidean length."""
    return np.float32(math.sqrt(x * x + y * y))


@inlined
def sign_of(value):
    """-1 for negative numbers, else 1."""
    return -_ONE if value < _ZERO else _ONE


@inlined
def corner_distance(ax, ay, az):
    """Distance to the corner where three slabs meet, from the distances to each slab."""
    outside = length3(max(ax, _ZERO), max(ay, _ZERO), max(az, _ZERO))
    return outside + min(max(ax, max(ay, az)), _ZERO)


@inlined
def corner_gradient(ax, ay, az):
    """Gradient of `corner_distance` with respect to its arguments."""
    largest = max(ax, max(ay, az))
    if largest > _ZERO:
        return normalized(max(ax, _ZERO), max(ay, _ZERO), max(az, _ZERO))
    if ax == largest:
        return _ONE, _ZERO, _ZERO
    if ay == largest:
        return _ZERO, _ONE, _ZERO
    return _ZERO, _ZERO, _ONE


@inlined
def box_distance(hx, hy, hz, x, y, z):
    """Distance to a centred box of half sizes (hx, hy, hz) and its gradient."""
    ax, ay, az = abs(x) - hx, abs(y) - hy, abs(z) - hz
    gx, gy, gz = corner_gradient(ax, ay, az)
    return corner_distance(ax, ay, az), gx * sign_of(x), gy * sign_of(y), gz * sign_of(z)


@inlined
def capsule_distance(radius, half_length, x, y, z):
    """Distance to a capsule about z and its gradient; half_length reaches to an end's centre."""
    beyond = z - min(max(z, -half_length), half_length)
    gx, gy, gz = normalized(x, y, beyond)
    return length3(x, y, beyond) - radius, gx, gy, gz


@inlined
def cylinder_distance(radius, half_length, x, y, z):
    """Distance to a centred cylinder about z and its gradient."""
    r = length2(x, y)
    ar, az = r - radius, abs(z) - half_length
    gr, gz, _ = corner_gradient(ar, az, -_FAR)
    ux, uy, uz = normalized(x, y, _ZERO)
    if uz != _ZERO:  # on the axis any radial direction is as good
        ux, uy = _ONE, _ZERO
    return corner_distance(ar, az, -_FAR), gr * ux, gr * uy, gz * sign_of(z)


@inlined
def grid_place(shapes, grid, axis, coordinate):
    """Where a coordinate falls on a grid's axis: cell, place in it (0 ... 1), overshoot [m]."""
    cell = shapes.grid_cell[grid]
    last = shapes.grid_shape[grid, axis] - 1
    u = (coordinate - shapes.grid_origin[grid, axis]) / cell
    inside = min(max(u, _ZERO), np.float32(last))
    index = min(np.int64(inside), np.int64(last - 1))
    return index, inside - np.float32(index), (u - inside) * cell


@inlined
def trilinear(c000, c001, c010, c011, c100, c101, c110, c111, u, v, w):
    """Value in a unit cell from its corners c_xyz, and its exact gradient."""
    c00, c01 = c000 + u * (c100 - c000), c001 + u * (c101 - c001)
    c10, c11 = c010 + u * (c110 - c010), c011 + u * (c111 - c011)
    c0, c1 = c00 + v * (c10 - c00), c01 + v * (c11 - c01)
    x0 = (c100 - c000) + v * ((c110 - c010) - (c100 - c000))
    x1 = (c101 - c001) + v * ((c111 - c011) - (c101 - c001))
    y0, y1 = c10 - c00, c11 - c01
    return c0 + w * (c1 - c0), x0 + w * (x1 - x0), y0 + w * (y1 - y0), c1 - c0


@inlined
def grid_distance(shapes, grid, x, y, z):
    """Distance sampled on a grid and its gradient, not of unit length between samples.

    Outside the grid the nearest point p of its border counts: all material is inside the convex
    grid, so the distance is at least sqrt(|x - p|^2 + d(p)^2), and this joins d at the border.
    """
    i, u, ex = grid_place(shapes, grid, 0, x)
    j, v, ey = grid_place(shapes, grid, 1, y)
    k, w, ez = grid_place(shapes, grid, 2, z)
    ny, nz = np.int64(shapes.grid_shape[grid, 1]), np.int64(shapes.grid_shape[grid, 2])
    n = shapes.grid_start[grid] + (i * ny + j) * nz + k
    m = n + ny * nz
    s = shapes.grid_distance
    d, gx, gy, gz = trilinear(
        s[n], s[n + 1], s[n + nz], s[n + nz + 1], s[m], s[m + 1], s[m + nz], s[m + nz + 1], u, v, w
    )
    scale = _ONE / shapes.grid_cell[grid]
    gx, gy, gz = gx * scale, gy * scale, gz * scale
    if ex == _ZERO and ey == _ZERO and ez == _ZERO:
        return d, gx, gy, gz
    gx = ex if ex != _ZERO else d * gx
    gy = ey if ey != _ZERO else d * gy
    gz = ez if ez != _ZERO else d * gz
    away = np.float32(math.sqrt(ex * ex + ey * ey + ez * ez + d * d))
    return away, gx / away, gy / away, gz / away


@inlined
def leaf_distance(shapes, node, x, y, z):
    """Distance to a leaf and its gradient in the leaf's frame, before inversion.

    Args:
        shapes: PackedShapes.
        node: index of the leaf.
        x: of the point in the leaf's frame [m].
        y: of the point.
        z: of the point.
    """
    op = shapes.node_op[node]
    a, b, c = shapes.node_size[node, 0], shapes.node_size[node, 1], shapes.node_size[node, 2]
    if op == BOX:
        return box_distance(a, b, c, x, y, z)
    if op == SPHERE:
        nx, ny, nz = normalized(x, y, z)
        return length3(x, y, z) - a, nx, ny, nz
    if op == GRID:
        return grid_distance(shapes, shapes.node_grid[node], x, y, z)
    if op == CAPSULE:
        return capsule_distance(a, b, x, y, z)
    if op == CYLINDER:
        return cylinder_distance(a, b, x, y, z)
    return z, _ZERO, _ZERO, _ONE


@inlined
def distance_and_leaf(shapes, solid, x, y, z):
    """Signed distance to a solid [m] and the leaf it is the distance to.

    Args:
        shapes: PackedShapes.
        solid: index of the solid.
        x: of the point in the solid's frame [m], float32.
        y: of the point.
        z: of the point.
    """
    d0 = d1 = d2 = d3 = _FAR
    n0 = n1 = n2 = n3 = np.int64(0)
    for node in range(np.int64(shapes.solid_start[solid]), np.int64(shapes.solid_start[solid + 1])):
        op = shapes.node_op[node]
        if op < UNION:
            px, py, pz = to_leaf(shapes, node, x, y, z)
            distance, _, _, _ = leaf_distance(shapes, node, px, py, pz)
            d3, d2, d1, d0 = d2, d1, d0, distance * shapes.node_sign[node]
            n3, n2, n1, n0 = n2, n1, n0, node
        else:
            if (d1 < d0) == (op == UNION):
                d0, n0 = d1, n1
            d1, d2 = d2, d3
            n1, n2 = n2, n3
    return d0, n0


@inlined
def leaf_normal(shapes, node, x, y, z):
    """Unit normal out of the material of a leaf at a point, both in the solid's frame."""
    px, py, pz = to_leaf(shapes, node, x, y, z)
    _, gx, gy, gz = leaf_distance(shapes, node, px, py, pz)
    sign = shapes.node_sign[node]
    gx, gy, gz = gradient_to_solid(shapes, node, gx, gy, gz)
    return normalized(gx * sign, gy * sign, gz * sign)


@inlined
def signed_distance(shapes, solid, x, y, z):
    """Signed distance to a solid [m], negative inside the material.

    Args:
        shapes: PackedShapes.
        solid: index of the solid.
        x: of the point in the solid's frame [m].
        y: of the point.
        z: of the point.
    """
    distance, _ = distance_and_leaf(shapes, solid, np.float32(x), np.float32(y), np.float32(z))
    return distance


@inlined
def distance_and_normal(shapes, solid, x, y, z):
    """Signed distance [m] and the unit normal out of the material: (d, nx, ny, nz).

    Arguments as for `signed_distance`; the normal is in the solid's frame.
    """
    fx, fy, fz = np.float32(x), np.float32(y), np.float32(z)
    distance, node = distance_and_leaf(shapes, solid, fx, fy, fz)
    nx, ny, nz = leaf_normal(shapes, node, fx, fy, fz)
    return distance, nx, ny, nz


@called
def normal_called(shapes, solid, x, y, z):
    """`distance_and_normal` as a function of its own: inlined everywhere it compiles for long."""
    return distance_and_normal(shapes, solid, x, y, z)


@inlined
def outside_bounds(shapes, solid, x, y, z):
    """Distance to the sphere around a solid's material [m]: never more than the distance to it."""
    centre = shapes.bounds[solid]
    return length3(x - centre[0], y - centre[1], z - centre[2]) - centre[3]


@parallel_kernel
def signed_distances(shapes, solid, points, distance):  # the last one is written
    """Signed distances of many points to one solid [m].

    Args:
        shapes: PackedShapes.
        solid: index of the solid.
        points: in the solid's frame [m], (M, 3) float32.
        distance: (M,) float32.
    """
    for i in prange(points.shape[0]):
        distance[i] = signed_distance(shapes, solid, points[i, 0], points[i, 1], points[i, 2])
