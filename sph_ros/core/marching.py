# SPDX-License-Identifier: Apache-2.0
"""Marching cubes: the triangles where a field on a grid has a given value.

Lorensen & Cline 1987, with a table that is worked out here and not copied. What is inside is joined
on faces where its corners lie across, and through a cell where its middle is inside: thin threads
of liquid hold together. What depends on a face is the same for both its cells, so that meshes are
closed. All is compiled: scikit-image's stops all other Python threads meanwhile.

Corner c of a cell lies at (c & 1, c >> 1 & 1, c >> 2 & 1). Edge 4 d + i of a cell goes along axis d
from the i-th of the four corners that are 0 along d.
"""

import numpy as np

from sph_ros.core.jit import device, kernel

#: Only two corners are inside, across the cell: it depends on its middle whether they are joined.
_DIAGONAL = (0x81, 0x42, 0x24, 0x18)


def _edge(a, b):
    """Number of the edge between two neighbouring corners."""
    low, axis = min(a, b), (a ^ b).bit_length() - 1
    return 4 * axis + sum(1 for corner in range(low) if not corner >> axis & 1)


def _face(axis, side):
    """Corners of a face, once round; counter-clockwise seen from outside."""
    u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
    ring = (0, u, u | v, v) if side else (0, v, u | v, u)
    return [corner | side << axis for corner in ring]


def _segments(inside):
    """Edge -> edge: how the surface goes over the faces of a cell, the liquid on its left."""
    following = {}
    for axis in range(3):
        for side in range(2):
            ring = _face(axis, side)
            steps = list(zip(ring, ring[1:] + ring[:1], strict=True))
            crossed = [(a, b) for a, b in steps if inside[a] != inside[b]]
            for number, (a, b) in enumerate(crossed):
                if inside[b]:  # the liquid begins here; it is joined with that before
                    following[_edge(a, b)] = _edge(*crossed[number - 1])
    return following


def _faces_of(edge):
    """The two faces (axis, side) on which an edge lies."""
    axis, place = divmod(edge, 4)
    low, high = (other for other in range(3) if other != axis)
    return {(low, place & 1), (high, place >> 1)}


def _divided(loop):
    """Triangles of a loop of edges none of whose diagonals lies on a face; None: there are none.

    On a face a diagonal might be one of the neighbouring cell, too, and belong to four triangles.
    """
    if len(loop) < 3:
        return []
    for middle in range(1, len(loop) - 1):
        sides = (loop[: middle + 1], loop[middle:])
        if any(len(s) > 2 and _faces_of(s[0]) & _faces_of(s[-1]) for s in sides):
            continue
        parts = [_divided(side) for side in sides]
        if None not in parts:
            return [(loop[0], loop[middle], loop[-1]), *parts[0], *parts[1]]
    return None


def _loops(case):
    """Closed loops of edges along which the surface meets the faces of a cell."""
    following, loops = _segments([case >> corner & 1 for corner in range(8)]), []
    while following:
        first = min(following)
        loop = [first]
        while (edge := following.pop(loop[-1])) != first:
            loop.append(edge)
        loops.append(loop)
    return loops


def _middle(edge):
    """Middle of an edge (3,)."""
    axis, place = divmod(edge, 4)
    return np.insert([place & 1, place >> 1], axis, 0.5)


def _tube(first, second):
    """Triangles between two loops of three edges each, untwisted."""

    def pairs(shift):
        return [(first[i], second[(shift - i) % 3]) for i in range(3)]

    def length(shift):
        return sum(np.linalg.norm(_middle(a) - _middle(b)) for a, b in pairs(shift))

    strip = pairs(min(range(3), key=length))
    triangles = []
    for (a, b), (next_a, next_b) in zip(strip, strip[1:] + strip[:1], strict=True):
        triangles += [(a, next_a, b), (next_b, b, next_a)]
    return triangles


def _table():
    """(begin (261,), edges (M, 3)): triangles of row n are edges[begin[n]:begin[n + 1]].

    Rows are the cases, and then those of `_DIAGONAL` once more, joined.
    """
    cases = [sum(map(_divided, _loops(case)), []) for case in range(256)]
    cases += [_tube(*_loops(case)) for case in _DIAGONAL]
    begin = np.cumsum([0] + [len(triangles) for triangles in cases])
    edges = np.array([triangle for triangles in cases for triangle in triangles], np.int32)
    return begin.astype(np.int32), edges


_BEGIN, _EDGES = _table()

#: Indices of both ends of a field along each axis.
_BORDERS = tuple(tuple((slice(None),) * axis + (side,) for side in (0, -1)) for axis in range(3))


@device
def _row(case, field, level, i, j, k):
    """Row of the table for a cell."""
    row = 0
    for n in range(len(_DIAGONAL)):
        if case == _DIAGONAL[n]:
            row = 256 + n
    if row == 0:
        return case
    total = 0.0
    for corner in range(8):
        total += field[i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)]
    return row if total > 8.0 * level else case


@kernel
def _count(field, level, begin, cases):  # the last is written
    """Case of every cell, (nx - 1, ny - 1, nz - 1) uint8; numbers of vertices and of triangles."""
    vertices, triangles = 0, 0
    nx, ny, nz = cases.shape
    for i in range(nx):
        for j in range(ny):
            above = 0
            for k in range(nz + 1):
                case = above >> 4
                above = (
                    (field[i, j, k] > level)
                    | (field[i + 1, j, k] > level) << 1
                    | (field[i, j + 1, k] > level) << 2
                    | (field[i + 1, j + 1, k] > level) << 3
                ) << 4
                if k == 0:
                    continue
                case |= above
                cases[i, j, k - 1] = case
                if 0 < case < 255:
                    here = case & 1
                    vertices += here ^ (case >> 1 & 1)
                    vertices += here ^ (case >> 2 & 1)
                    vertices += here ^ (case >> 4 & 1)
                    row = _row(case, field, level, i, j, k - 1)
                    triangles += begin[row + 1] - begin[row]
    return vertices, triangles


@kernel
def _place_vertices(field, level, cases, numbers, nodes):  # the last two are written
    """Vertices on the edges of the grid; arguments as in `_join`."""
    nx, ny, nz = cases.shape
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                case = cases[i, j, k]
                if case == 0 or case == 255:
                    continue
                here = field[i, j, k]
                for axis in range(3):
                    if (case ^ case >> (1 << axis)) & 1 == 0:
                        continue
                    x, y, z = axis == 0, axis == 1, axis == 2
                    share = (level - here) / (field[i + x, j + y, k + z] - here)
                    nodes[count, 0], nodes[count, 1], nodes[count, 2] = i, j, k
                    nodes[count, axis] += share
                    numbers[i, j, k, axis] = count
                    count += 1


@kernel
def _join(field, level, cases, begin, edges, numbers, triangles):  # the last is written
    """Triangles between the vertices.

    Args:
        field: (nx, ny, nz).
        level: of the surface.
        cases: which corners of each cell are inside, as bits, (nx - 1, ny - 1, nz - 1).
        begin, edges: see `_table`.
        numbers: of the vertex on the edge from a node along each axis, (nx, ny, nz, 3).
        triangles: (T, 3).
    """
    nx, ny, nz = cases.shape
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                row = _row(cases[i, j, k], field, level, i, j, k)
                for t in range(begin[row], begin[row + 1]):
                    for corner in range(3):
                        edge = edges[t, corner]
                        axis, low, high = edge >> 2, edge & 1, edge >> 1 & 1
                        x = low if axis > 0 else 0
                        y = low if axis == 0 else high if axis == 2 else 0
                        z = high if axis < 2 else 0
                        triangles[count, corner] = numbers[i + x, j + y, k + z, axis]
                    count += 1


def marching_cubes(field, level):
    """The surface where a field falls below a level.

    Args:
        field: (nx, ny, nz) float32, below the level on its border.
        level: of the surface.

    Returns:
        vertices in units of the grid (V, 3) float32, triangles (T, 3) int32: a closed mesh,
        counter-clockwise seen from where the field is less.

    Raises:
        ValueError: the surface would leave the field.
    """
    borders = (field[side] for axis in range(3) for side in _BORDERS[axis])
    if max(border.max(initial=-np.inf) for border in borders) > level:
        raise ValueError(f"the field's border exceeds {level}, expected less")
    cases = np.empty([n - 1 for n in field.shape], np.uint8)
    vertex_count, triangle_count = _count(field, np.float32(level), _BEGIN, cases)
    nodes = np.empty((vertex_count, 3), np.float32)
    triangles = np.empty((triangle_count, 3), np.int32)
    numbers = np.empty((*field.shape, 3), np.int32)
    _place_vertices(field, np.float32(level), cases, numbers, nodes)
    _join(field, np.float32(level), cases, _BEGIN, _EDGES, numbers, triangles)
    return nodes, triangles
