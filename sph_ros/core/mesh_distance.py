# SPDX-License-Identifier: Apache-2.0
"""Signed distance of a triangle mesh on a grid, with a sign that stands small leaks.

The exact distance to the nearest triangle is found in a narrow band; eight sweeps then carry the
nearest triangle outward (after Bridson's SDFGen and Danielsson 1980). The sign is that of the
generalized winding number (Jacobson, Kavan & Sorkine-Hornung 2013), with far clusters of triangles
as dipoles (Barill et al. 2018, first term of the expansion): |w| >= 1/2 is inside, so it does not
matter whether bodies are wound outward or inward, and cavities stay cavities.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.jit import device, kernel
from sph_ros.core.team import parallel_kernel

#: Triangles of one leaf of the cluster tree.
LEAF_SIZE = 8
# A cluster is a dipole for points farther than this many of its radii.
_FAR_CLUSTER = 2.3
# Nodes along one edge of the blocks that share one winding number where no surface is near.
_BLOCK = 4


class ClusterTree(NamedTuple):
    """Triangles in a complete binary tree: node 1 is the root, 2 n and 2 n + 1 are below node n.

    Attributes:
        triangles: corners, sorted along a space-filling curve [m], (L, LEAF_SIZE, 3, 3) float64.
        centre: area-weighted centre of each node [m], (2 L, 3).
        area: sum of the area vectors of each node [m^2], (2 L, 3).
        radius: of a ball about the centre that holds the node's triangles [m], (2 L,).
    """

    triangles: np.ndarray
    centre: np.ndarray
    area: np.ndarray
    radius: np.ndarray


def _curve_order(points: np.ndarray) -> np.ndarray:
    """Order of points along a Morton curve of 1024^3 cells."""
    lower = points.min(axis=0)
    extent = max(float((points.max(axis=0) - lower).max()), 1e-30)
    cells = np.minimum((points - lower) / extent * 1024.0, 1023.0).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def build_cluster_tree(triangles: np.ndarray) -> ClusterTree:
    """The cluster tree of triangles given by their corners [m], (T, 3, 3)."""
    triangles = np.asarray(triangles, dtype=np.float64)
    triangles = triangles[_curve_order(triangles.mean(axis=1))]
    leaves = 1 << max(0, math.ceil(math.log2(len(triangles) / LEAF_SIZE)))
    padding = leaves * LEAF_SIZE - len(triangles)
    # Points are triangles without area: they add nothing to any sum.
    point = np.broadcast_to(triangles[-1, 0], (padding, 3, 3))
    triangles = np.concatenate([triangles, point]).reshape(leaves, LEAF_SIZE, 3, 3)
    centre, area = np.zeros((2 * leaves, 3)), np.zeros((2 * leaves, 3))
    radius, size = np.zeros(2 * leaves), np.zeros(2 * leaves)

    edges = triangles[:, :, 1:] - triangles[:, :, :1]
    vectors = 0.5 * np.cross(edges[:, :, 0], edges[:, :, 1])
    sizes = np.linalg.norm(vectors, axis=-1) + 1e-30
    area[leaves:] = vectors.sum(axis=1)
    size[leaves:] = sizes.sum(axis=1)
    middle = (triangles.mean(axis=2) * sizes[..., None]).sum(axis=1)
    centre[leaves:] = middle / size[leaves:, None]
    corners = triangles.reshape(leaves, -1, 3) - centre[leaves:, None]
    radius[leaves:] = np.linalg.norm(corners, axis=-1).max(axis=1)

    first = leaves // 2
    while first >= 1:
        node = np.arange(first, 2 * first)
        below = np.stack([2 * node, 2 * node + 1])
        area[node], size[node] = area[below].sum(axis=0), size[below].sum(axis=0)
        weighted = (centre[below] * size[below][..., None]).sum(axis=0)
        centre[node] = weighted / size[node][:, None]
        gap = np.linalg.norm(centre[below] - centre[node], axis=-1)
        radius[node] = (gap + radius[below]).max(axis=0)
        first //= 2
    return ClusterTree(triangles, centre, area, radius)


@device
def solid_angle(ax, ay, az, bx, by, bz, cx, cy, cz):
    """Signed solid angle of a triangle at the origin (Van Oosterom & Strackee 1983, eq. 8)."""
    la = math.sqrt(ax * ax + ay * ay + az * az)
    lb = math.sqrt(bx * bx + by * by + bz * bz)
    lc = math.sqrt(cx * cx + cy * cy + cz * cz)
    triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    ab = ax * bx + ay * by + az * bz
    bc = bx * cx + by * cy + bz * cz
    ca = cx * ax + cy * ay + cz * az
    return 2.0 * math.atan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)


@device
def leaf_solid_angle(triangles, leaf, x, y, z):
    """Sum of the solid angles of a leaf's triangles seen from a point."""
    total = 0.0
    for t in range(triangles.shape[1]):
        c = triangles[leaf, t]
        total += solid_angle(
            c[0, 0] - x,
            c[0, 1] - y,
            c[0, 2] - z,
            c[1, 0] - x,
            c[1, 1] - y,
            c[1, 2] - z,
            c[2, 0] - x,
            c[2, 1] - y,
            c[2, 2] - z,
        )
    return total


@device
def winding_number(tree, x, y, z):
    """Generalized winding number of the mesh about a point [m]: 1 inside, 0 outside when closed."""
    leaves = tree.triangles.shape[0]
    total = 0.0
    node = 1
    while True:
        dx, dy = tree.centre[node, 0] - x, tree.centre[node, 1] - y
        dz = tree.centre[node, 2] - z
        square = dx * dx + dy * dy + dz * dz
        reach = _FAR_CLUSTER * tree.radius[node]
        descend = False
        if square > reach * reach:
            dot = tree.area[node, 0] * dx + tree.area[node, 1] * dy + tree.area[node, 2] * dz
            total += dot / (square * math.sqrt(square))
        elif node >= leaves:
            total += leaf_solid_angle(tree.triangles, node - leaves, x, y, z)
        else:
            descend = True
        if descend:
            node *= 2
            continue
        while node & 1 and node > 1:  # done with a right child: so is its parent
            node >>= 1
        if node <= 1:
            return total / (4.0 * math.pi)
        node += 1


@parallel_kernel
def winding_numbers(tree, points, winding):  # the last one is written
    """Generalized winding numbers about points [m], (M, 3) float64, into (M,) float64."""
    for i in prange(points.shape[0]):
        winding[i] = winding_number(tree, points[i, 0], points[i, 1], points[i, 2])


@device
def segment_square(px, py, pz, ax, ay, az, bx, by, bz):
    """Squared distance from a point to the segment a b."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = px - ax, py - ay, pz - az
    square = ux * ux + uy * uy + uz * uz
    t = 0.0
    if square > 0.0:
        t = min(max((ux * vx + uy * vy + uz * vz) / square, 0.0), 1.0)
    dx, dy, dz = vx - t * ux, vy - t * uy, vz - t * uz
    return dx * dx + dy * dy + dz * dz


@device
def triangle_distance(triangles, t, px, py, pz):
    """Distance from a point to triangle t of (T, 3, 3): to its plane, or else to its edges."""
    ax, ay, az = triangles[t, 0, 0], triangles[t, 0, 1], triangles[t, 0, 2]
    bx, by, bz = triangles[t, 1, 0], triangles[t, 1, 1], triangles[t, 1, 2]
    cx, cy, cz = triangles[t, 2, 0], triangles[t, 2, 1], triangles[t, 2, 2]
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    wx, wy, wz = px - ax, py - ay, pz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square = nx * nx + ny * ny + nz * nz
    if square > 0.0:
        beta = (wy * vz - wz * vy) * nx + (wz * vx - wx * vz) * ny + (wx * vy - wy * vx) * nz
        gamma = (uy * wz - uz * wy) * nx + (uz * wx - ux * wz) * ny + (ux * wy - uy * wx) * nz
        if beta >= 0.0 and gamma >= 0.0 and beta + gamma <= square:
            height = wx * nx + wy * ny + wz * nz
            return abs(height) / math.sqrt(square)
    ab = segment_square(px, py, pz, ax, ay, az, bx, by, bz)
    bc = segment_square(px, py, pz, bx, by, bz, cx, cy, cz)
    ca = segment_square(px, py, pz, cx, cy, cz, ax, ay, az)
    return math.sqrt(min(ab, min(bc, ca)))


@device
def node_range(triangles, t, axis, origin, cell, band, count):
    """First and one past the last grid node along an axis within `band` of a triangle [m]."""
    low = min(triangles[t, 0, axis], min(triangles[t, 1, axis], triangles[t, 2, axis]))
    high = max(triangles[t, 0, axis], max(triangles[t, 1, axis], triangles[t, 2, axis]))
    first = max(0, int(math.ceil((low - band - origin[axis]) / cell)))
    last = min(count - 1, int(math.floor((high + band - origin[axis]) / cell)))
    return first, last + 1


@parallel_kernel
def fill_band(triangles, origin, cell, band, distance, nearest):  # the last two are written
    """Nearest triangle of every grid node within a band around the mesh.

    Args:
        triangles: corners [m], (T, 3, 3) float64.
        origin: of the grid [m], (3,).
        cell: spacing of the grid's nodes [m].
        band: half width of the band [m].
        distance: unsigned [m], (nx, ny, nz) float64, infinite on entry.
        nearest: triangle, (nx, ny, nz) int32, -1 on entry.
    """
    nx, ny, nz = distance.shape
    for i in prange(nx):
        x = origin[0] + i * cell
        for t in range(triangles.shape[0]):
            first, last = node_range(triangles, t, 0, origin, cell, band, nx)
            if i < first or i >= last:
                continue
            j0, j1 = node_range(triangles, t, 1, origin, cell, band, ny)
            k0, k1 = node_range(triangles, t, 2, origin, cell, band, nz)
            for j in range(j0, j1):
                y = origin[1] + j * cell
                for k in range(k0, k1):
                    found = triangle_distance(triangles, t, x, y, origin[2] + k * cell)
                    if found < distance[i, j, k]:
                        distance[i, j, k] = found
                        nearest[i, j, k] = t


@device
def try_neighbor(triangles, origin, cell, node, neighbor, distance, nearest):
    """Take over the nearest triangle of a neighbouring node if it is nearer than the own one."""
    i, j, k = node
    ni, nj, nk = neighbor
    if not (0 <= ni < distance.shape[0] and 0 <= nj < distance.shape[1]):
        return
    if not 0 <= nk < distance.shape[2]:
        return
    t = nearest[ni, nj, nk]
    # A triangle is nearer here than there by one cell at most.
    if t < 0 or t == nearest[i, j, k] or distance[ni, nj, nk] > distance[i, j, k] + cell:
        return
    found = triangle_distance(
        triangles, t, origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell
    )
    if found < distance[i, j, k]:
        distance[i, j, k] = found
        nearest[i, j, k] = t


@kernel
def sweep(triangles, origin, cell, band, distance, nearest):  # the last two are changed
    """Carry nearest triangles from the band of `fill_band` to all nodes: one sweep per octant.

    Arguments as for `fill_band`. Nodes of the band are right already and stay untouched.
    """
    nx, ny, nz = distance.shape
    for octant in range(8):
        di, dj, dk = 1 - 2 * (octant & 1), 1 - (octant & 2), 1 - (octant & 4) // 2
        for a in range(nx):
            i = a if di > 0 else nx - 1 - a
            for b in range(ny):
                j = b if dj > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if dk > 0 else nz - 1 - c
                    if distance[i, j, k] <= band:
                        continue
                    here = (i, j, k)
                    for there in ((i - di, j, k), (i, j - dj, k), (i, j, k - dk)):
                        try_neighbor(triangles, origin, cell, here, there, distance, nearest)


@device
def known_winding(distance, cell, i0, j0, k0, i, j, k):
    """Sign of an earlier node of the block that no surface divides from node (i, j, k), or 0.

    A surface between two neighbours is at some point of the edge between them, so their distances
    add up to the edge at most.
    """
    here = abs(distance[i, j, k])
    if k > k0 and here + abs(distance[i, j, k - 1]) > 1.001 * cell:
        return -1 if distance[i, j, k - 1] < 0.0 else 1
    if j > j0 and here + abs(distance[i, j - 1, k]) > 1.001 * cell:
        return -1 if distance[i, j - 1, k] < 0.0 else 1
    if i > i0 and here + abs(distance[i - 1, j, k]) > 1.001 * cell:
        return -1 if distance[i - 1, j, k] < 0.0 else 1
    return 0


@device
def node_sign(tree, origin, cell, i, j, k):
    """-1 where the winding number says that a grid node is inside, else 1."""
    winding = winding_number(tree, origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell)
    return -1 if abs(winding) >= 0.5 else 1


@parallel_kernel
def apply_signs(tree, origin, cell, distance):  # the last one is changed
    """Make distances negative where the winding number says inside.

    A block of nodes that no surface can cross needs one winding number; in the others a node takes
    the sign of a neighbour in the block where no surface can lie between.

    Args:
        tree: ClusterTree of the mesh, holes closed.
        origin: of the grid [m], (3,).
        cell: spacing of the grid's nodes [m].
        distance: unsigned on entry, signed on return [m], (nx, ny, nz) float32.
    """
    nx, ny, nz = distance.shape
    blocks_y, blocks_z = (ny + _BLOCK - 1) // _BLOCK, (nz + _BLOCK - 1) // _BLOCK
    blocks = (nx + _BLOCK - 1) // _BLOCK * blocks_y * blocks_z
    clear = 0.5 * math.sqrt(3.0) * _BLOCK * cell
    for block in prange(blocks):
        i0 = block // (blocks_y * blocks_z) * _BLOCK
        j0 = block // blocks_z % blocks_y * _BLOCK
        k0 = block % blocks_z * _BLOCK
        im, jm, km = i0 + _BLOCK // 2, j0 + _BLOCK // 2, k0 + _BLOCK // 2
        shared = 0
        if im < nx and jm < ny and km < nz and distance[im, jm, km] > clear:
            shared = node_sign(tree, origin, cell, im, jm, km)
        for i in range(i0, min(i0 + _BLOCK, nx)):
            for j in range(j0, min(j0 + _BLOCK, ny)):
                for k in range(k0, min(k0 + _BLOCK, nz)):
                    sign = shared
                    if sign == 0:
                        sign = known_winding(distance, cell, i0, j0, k0, i, j, k)
                    if sign == 0:
                        sign = node_sign(tree, origin, cell, i, j, k)
                    distance[i, j, k] = sign * distance[i, j, k]


def signed_distance_grid(triangles, origin, cell, shape, band):
    """Signed distance of a mesh at the nodes of a grid [m].

    Args:
        triangles: corners [m], (T, 3, 3).
        origin: position of node (0, 0, 0) [m], (3,).
        cell: spacing of the nodes [m].
        shape: nodes along x, y, z.
        band: distance up to which the nearest triangle is found exactly [m]; farther out the sweeps
            may miss it by a small part of a cell.

    Returns:
        Negative inside, (nx, ny, nz) float32.
    """
    triangles = np.ascontiguousarray(triangles, dtype=np.float64)
    origin = np.asarray(origin, dtype=np.float64)
    exact = np.full(shape, np.inf)
    nearest = np.full(shape, -1, dtype=np.int32)
    fill_band(triangles, origin, cell, band, exact, nearest)
    sweep(triangles, origin, cell, band, exact, nearest)
    distance = exact.astype(np.float32)
    apply_signs(build_cluster_tree(triangles), origin, cell, distance)
    return distance
