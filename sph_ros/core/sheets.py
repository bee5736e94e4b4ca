# SPDX-License-Identifier: Apache-2.0
"""Open, thin meshes: two sides and no inside, so no signed distance.

What a liquid needs of them are two questions to the triangles near a point: where does a straight
path first go through one, and which of their points are nearest. Each sheet has a uniform grid in
its own frame whose cells list all triangles that are nearer than `reach` to any point of the cell;
the cell of a point is then all that has to be looked at.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.jit import called, inlined, kernel
from sph_ros.core.team import parallel_kernel

#: Triangles count as so much larger when a path is tested against them, as a share of their edges:
#: no path slips through between two that share an edge.
OVERLAP = 1e-3

#: Second and third contacts of a point with one sheet, in its corners, turn away from the others by
#: more than acos of this.
CORNER = 0.7
CORNER_CONTACTS = 3

#: Which points of a triangle are nearest, as bits: its edges 0-1, 1-2, 2-0, its corners 0, 1, 2.
FACE, EDGES, CORNERS = 0, (1, 2, 4), (8, 16, 32)

#: No crossing.
NEVER = 2.0


class Sheets(NamedTuple):
    """K sheets with T triangles and C cells in all, each in the frame of its solid.

    Attributes:
        reach: see above [m], float32.
        solid: index of the solid that each sheet is, (K,) int32.
        sheet_of: the sheet that each solid is, or -1, (S,) int32.
        lower: corner of the grid [m], (K, 3) float32.
        inverse_cell: 1 / cell size [1/m], (K,) float32.
        counts: cells along x, y, z, (K, 3) int32.
        first_cell: of each grid, (K,) int64.
        cell_start: triangles of cell c are cell_triangles[cell_start[c]:cell_start[c + 1]],
            (C + 1,) int64.
        cell_triangles: (M,) int32.
        has_corner: whether triangles of a cell turn away from each other, (C,) bool.
        first_triangle: triangles of sheet k are first_triangle[k]:first_triangle[k + 1], (K + 1,)
            int64.
        corners: of the triangles [m], (T, 3, 3) float32.
        normals: unit vectors, either side, (T, 3) float32.
        balls: centre and radius of a ball around each triangle [m], (T, 4) float32.
        open_parts: bits of the edges and corners that lie on the edge of the sheet, (T,) int32.
        bounce: restitution and friction of each sheet [-], (K, 2) float32.
    """

    reach: np.float32
    solid: np.ndarray
    sheet_of: np.ndarray
    lower: np.ndarray
    inverse_cell: np.ndarray
    counts: np.ndarray
    first_cell: np.ndarray
    cell_start: np.ndarray
    cell_triangles: np.ndarray
    has_corner: np.ndarray
    first_triangle: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    balls: np.ndarray
    open_parts: np.ndarray
    bounce: np.ndarray


# ---------------------------------------------------------------- grid


@kernel
def list_triangles(corners, normals, lower, cell, counts, reach, cell_start, cell_triangles):
    """Sort triangles into the cells of a grid that they are near.

    Called twice: first with an empty `cell_triangles`, to count, then with room for all.

    Args:
        corners: [m], (T, 3, 3) float32.
        normals: (T, 3) float32.
        lower: corner of the grid [m], (3,) float64.
        cell: its cell size [m].
        counts: cells along x, y, z, (3,) int32.
        reach: a cell lists the triangles up to this far away [m].
        cell_start: first entry of each cell, (cells + 1,) int64; written by the first call.
        cell_triangles: (M,) int32; written by the second call.
    """
    counting = cell_triangles.shape[0] == 0
    cells = counts[0] * counts[1] * counts[2]
    # From the middle of a cell to what it must list.
    slack = reach + 0.5 * math.sqrt(3.0) * cell
    cursor = np.zeros(cells, np.int64)
    for t in range(corners.shape[0]):
        first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
        for axis in range(3):
            low = np.float64(corners[t, :, axis].min()) - reach
            high = np.float64(corners[t, :, axis].max()) + reach
            first[axis] = max(int(math.floor((low - lower[axis]) / cell)), 0)
            last[axis] = min(int(math.floor((high - lower[axis]) / cell)), counts[axis] - 1)
        for cz in range(first[2], last[2] + 1):
            for cy in range(first[1], last[1] + 1):
                for cx in range(first[0], last[0] + 1):
                    x = lower[0] + (cx + 0.5) * cell
                    y = lower[1] + (cy + 0.5) * cell
                    z = lower[2] + (cz + 0.5) * cell
                    height = (
                        (x - corners[t, 0, 0]) * normals[t, 0]
                        + (y - corners[t, 0, 1]) * normals[t, 1]
                        + (z - corners[t, 0, 2]) * normals[t, 2]
                    )
                    if abs(height) > slack:
                        continue
                    c = (cz * counts[1] + cy) * counts[0] + cx
                    if not counting:
                        cell_triangles[cell_start[c] + cursor[c]] = t
                    cursor[c] += 1
    if counting:
        cell_start[0] = 0
        for c in range(cells):
            cell_start[c + 1] = cell_start[c] + cursor[c]


@kernel
def find_corners(normals, cell_start, cell_triangles, has_corner):
    """Whether any triangle of a cell turns away from its first by more than `CORNER` says.

    Args:
        normals, cell_start, cell_triangles: as in `list_triangles`.
        has_corner: (cells,) bool; written.
    """
    for c in range(has_corner.shape[0]):
        has_corner[c] = False
        for entry in range(cell_start[c] + 1, cell_start[c + 1]):
            a, b = normals[cell_triangles[cell_start[c]]], normals[cell_triangles[entry]]
            # Half the angle, so that no two of them turn away by more than the whole.
            cosine = abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
            has_corner[c] |= 2.0 * cosine * cosine - 1.0 < CORNER


@inlined
def cell_of(sheets, k, x, y, z):
    """Index of the cell of sheet k that holds a point, -1 outside its grid."""
    scale = sheets.inverse_cell[k]
    fx, fy, fz = (
        (x - sheets.lower[k, 0]) * scale,
        (y - sheets.lower[k, 1]) * scale,
        (z - sheets.lower[k, 2]) * scale,
    )
    nx, ny, nz = sheets.counts[k, 0], sheets.counts[k, 1], sheets.counts[k, 2]
    if not (fx >= 0.0 and fy >= 0.0 and fz >= 0.0 and fx < nx and fy < ny and fz < nz):
        return np.int64(-1)
    return sheets.first_cell[k] + (np.int64(fz) * ny + np.int64(fy)) * nx + np.int64(fx)


# ---------------------------------------------------------------- paths


@inlined
def crossing_share(corners, t, ax, ay, az, dx, dy, dz):
    """Share of the path a + s d at which it goes through triangle t (Moeller & Trumbore 1997)."""
    v = corners[t]
    ex, ey, ez = v[1, 0] - v[0, 0], v[1, 1] - v[0, 1], v[1, 2] - v[0, 2]
    gx, gy, gz = v[2, 0] - v[0, 0], v[2, 1] - v[0, 1], v[2, 2] - v[0, 2]
    px, py, pz = dy * gz - dz * gy, dz * gx - dx * gz, dx * gy - dy * gx
    determinant = ex * px + ey * py + ez * pz
    if determinant == 0.0:
        return NEVER
    inverse = 1.0 / determinant
    sx, sy, sz = ax - v[0, 0], ay - v[0, 1], az - v[0, 2]
    u = (sx * px + sy * py + sz * pz) * inverse
    if not -OVERLAP <= u <= 1.0 + OVERLAP:
        return NEVER
    qx, qy, qz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    w = (dx * qx + dy * qy + dz * qz) * inverse
    if not (w >= -OVERLAP and u + w <= 1.0 + OVERLAP):
        return NEVER
    share = (gx * qx + gy * qy + gz * qz) * inverse
    return share if 0.0 <= share <= 1.0 else NEVER


@called
def first_crossing(sheets, k, ax, ay, az, bx, by, bz):
    """Where the straight path from a to b first goes through sheet k, in the sheet's frame.

    Args:
        sheets: Sheets.
        k: index of the sheet.
        ax, ay, az: start [m], float64.
        bx, by, bz: end [m].

    Returns:
        (share of the path, triangle); (NEVER, -1) where it does not.
    """
    dx, dy, dz = bx - ax, by - ay, bz - az
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    # Each piece is no longer than the reach of the cell that it begins in.
    pieces = int(math.ceil(length / sheets.reach + 1e-9))
    for piece in range(pieces):
        begin, end = piece / pieces, (piece + 1) / pieces
        cell = cell_of(sheets, k, ax + begin * dx, ay + begin * dy, az + begin * dz)
        if cell < 0:
            continue
        best, found = NEVER, np.int64(-1)
        for entry in range(sheets.cell_start[cell], sheets.cell_start[cell + 1]):
            t = np.int64(sheets.cell_triangles[entry])
            share = crossing_share(sheets.corners, t, ax, ay, az, dx, dy, dz)
            if share < best:
                best, found = share, t
        if best <= end:
            return best, found
    return NEVER, np.int64(-1)


# ---------------------------------------------------------------- nearest points


@inlined
def edge_place(ax, ay, az, bx, by, bz):
    """Share of the way from a to b that is nearest to the origin, 0 to 1."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    square = dx * dx + dy * dy + dz * dz
    share = -(ax * dx + ay * dy + az * dz) / square if square > 0.0 else 0.0
    return min(max(share, 0.0), 1.0)


@called
def nearest_point(corners, normals, t, x, y, z):
    """The point of triangle t that is nearest to (x, y, z).

    Returns:
        (dx, dy, dz, part): from it to the point [m], and which part of the triangle it is on.
    """
    v, n = corners[t], normals[t]
    a = v[0, 0] - x, v[0, 1] - y, v[0, 2] - z
    b = v[1, 0] - x, v[1, 1] - y, v[1, 2] - z
    c = v[2, 0] - x, v[2, 1] - y, v[2, 2] - z
    height = a[0] * n[0] + a[1] * n[1] + a[2] * n[2]
    # The foot of the perpendicular is inside if it is on the same side of all edges.
    inside = True
    best, part = 1e30, FACE
    px, py, pz = height * n[0], height * n[1], height * n[2]
    for side in range(3):
        p, q = (a, b) if side == 0 else (b, c) if side == 1 else (c, a)
        ex, ey, ez = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        across = (
            (p[1] * ez - p[2] * ey) * n[0]
            + (p[2] * ex - p[0] * ez) * n[1]
            + (p[0] * ey - p[1] * ex) * n[2]
        )
        inside = inside and across >= 0.0
    if not inside:
        for side in range(3):
            p, q = (a, b) if side == 0 else (b, c) if side == 1 else (c, a)
            share = edge_place(p[0], p[1], p[2], q[0], q[1], q[2])
            rx = p[0] + share * (q[0] - p[0])
            ry = p[1] + share * (q[1] - p[1])
            rz = p[2] + share * (q[2] - p[2])
            square = rx * rx + ry * ry + rz * rz
            if square < best:
                best, px, py, pz = square, rx, ry, rz
                part = 1 << side
                if share == 0.0:
                    part = 8 << side
                elif share == 1.0:
                    part = 8 << ((side + 1) % 3)
    return -px, -py, -pz, part


@inlined
def direction_to(normals, t, dx, dy, dz):
    """(length, unit vector) of an offset from triangle t; where it is zero, along the normal."""
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length < 1e-12:
        return 0.0, np.float64(normals[t, 0]), np.float64(normals[t, 1]), np.float64(normals[t, 2])
    return length, dx / length, dy / length, dz / length


@inlined
def nearest_in_cell(sheets, cell, x, y, z, reach, n0, n1):
    """Nearest point among the triangles of a cell that turn away from two earlier directions.

    Args:
        sheets: Sheets.
        cell: from `cell_of`.
        x, y, z: the point [m], float64.
        reach: what is farther away does not count [m].
        n0, n1: directions found before, (3,) tuples; zeros where there are none. With a first one
            only faces count.

    Returns:
        (distance [m], direction from the sheet to the point x, y, z, part, triangle); a distance of
        `reach` and triangle -1 where there is none.
    """
    later = n0[0] != 0.0 or n0[1] != 0.0 or n0[2] != 0.0
    best, bx, by, bz = reach, 0.0, 0.0, 0.0
    part, found = FACE, np.int64(-1)
    for entry in range(sheets.cell_start[cell], sheets.cell_start[cell + 1]):
        t = np.int64(sheets.cell_triangles[entry])
        ball = sheets.balls[t]
        cx, cy, cz = x - ball[0], y - ball[1], z - ball[2]
        limit = best + ball[3]
        if cx * cx + cy * cy + cz * cz >= limit * limit:
            continue
        if later:
            n = sheets.normals[t]
            if (
                abs(n[0] * n0[0] + n[1] * n0[1] + n[2] * n0[2]) > CORNER
                or abs(n[0] * n1[0] + n[1] * n1[1] + n[2] * n1[2]) > CORNER
            ):
                continue
        dx, dy, dz, where = nearest_point(sheets.corners, sheets.normals, t, x, y, z)
        if later and where != FACE:
            continue
        distance, ux, uy, uz = direction_to(sheets.normals, t, dx, dy, dz)
        if distance < best:
            best, bx, by, bz, part, found = distance, ux, uy, uz, where, t
    return best, bx, by, bz, part, found


@called
def nearest_on_sheet(sheets, k, x, y, z, reach):
    """`nearest_in_cell` of the first kind, for a point anywhere in the frame of sheet k."""
    none = (0.0, 0.0, 0.0)
    cell = cell_of(sheets, k, x, y, z)
    if cell < 0:
        return reach, 0.0, 0.0, 0.0, FACE, np.int64(-1)
    return nearest_in_cell(sheets, cell, x, y, z, reach, none, none)


@parallel_kernel
def sheet_distances(sheets, k, points, distance):
    """Distance of points to sheet k, however far away.

    Args:
        sheets: Sheets.
        k: index of the sheet.
        points: in the sheet's frame [m], (M, 3) float32.
        distance: [m], (M,) float32; written.
    """
    for i in prange(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        best = 1e30
        for t in range(sheets.first_triangle[k], sheets.first_triangle[k + 1]):
            ball = sheets.balls[t]
            cx, cy, cz = x - ball[0], y - ball[1], z - ball[2]
            limit = best + ball[3]
            if cx * cx + cy * cy + cz * cz < limit * limit:
                dx, dy, dz, _ = nearest_point(sheets.corners, sheets.normals, t, x, y, z)
                best = min(best, math.sqrt(dx * dx + dy * dy + dz * dz))
        distance[i] = best
