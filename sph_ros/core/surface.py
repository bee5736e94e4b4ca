# SPDX-License-Identifier: Apache-2.0
"""The liquid's surface: a colour field splatted onto a grid, then marching cubes.

The colour field is 1 inside the liquid and 0 outside,

    c(x) = sum_j V_j W(x - x_j)       (Fujisawa & Kato 2009, eq. 7; Mueller et al. 2003)

and its level 1/2 is the surface. W is a product of cubic B-splines whose support is the support
radius: separable, so cheap to splat, and the splines of a lattice add up to exactly 1, so a flat
liquid is flat and half a spacing outside its last layer. A short binomial blur on the grid takes
out the unrest of the particles. V_j is the particle's volume: the cube of the spacing, but larger
where the field at the particle stays under `LONELY_COLOUR`, so that films, threads and single drops
keep their volume instead of vanishing.

The grid is anchored at the world's origin, not at the liquid: the mesh does not swim when the
liquid moves. It is a dense box while that is small; otherwise (a splash far away) clusters of
particles that cannot touch each other are meshed one by one, so that memory follows the liquid and
not the distances, and nothing is cut off. A single cluster too large for `MAX_NODES` gets a coarser
grid; no part of it vanishes.
"""

from typing import NamedTuple

import numpy as np

from sph_ros.core.jit import bare_kernel, device, inlined, kernel
from sph_ros.core.marching import marching_cubes

#: Level of the colour field that is called the surface: half way between air and liquid.
SURFACE_COLOUR = 0.5

#: A particle is lonely when the colour around it (the field averaged by its own spline) is less;
#: it then gets more volume until it is this. A flat surface has 0.67 at its last layer and is left
#: alone; with this value films keep their thickness within a few per cent, and a single particle
#: becomes a drop of about two particles' volume (support radius of two spacings).
LONELY_COLOUR = 0.53

#: A particle whose nearest node has more colour is inside and needs no closer look.
INSIDE_COLOUR = 0.9

#: Variance of the blur in units of spacing^2 per axis. One [1 2 1]/4 pass has half a cell^2.
BLUR_VARIANCE = 0.5

#: A box of at most this many nodes, or this many per particle, is meshed densely and at once.
DENSE_NODES = 1 << 18
DENSE_NODES_PER_PARTICLE = 24

#: Liquid this near to a wall is mirrored behind it [spacings].
WALL_REACH = 2.2

#: No grid is larger (float32: 64 MB, and as much again for the blur).
MAX_NODES = 1 << 24

#: Edge in nodes of the equal slots into which small clusters are put, and nodes per batch of slots.
SLOT_EDGES = (12, 18)
BATCH_NODES = 1 << 21

#: Beyond so many cells from the world's origin float32 positions mean nothing.
MAX_CELL_INDEX = 1.0e9


class Grid(NamedTuple):
    """A regular grid whose node (i, j, k) stands at (first + (i, j, k)) * cell in the world.

    Attributes:
        cell: distance of nodes per axis [m], (3,) float64.
        first: world index of the first node, (3,) float64; halves occur in the slab of a 2D liquid.
        shape: nodes per axis.
    """

    cell: np.ndarray
    first: np.ndarray
    shape: tuple[int, int, int]


class Surface(NamedTuple):
    """Vertices (V, 3) float32 [m], triangles (T, 3) int32, unit outward normals (V, 3) float32."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray


def extract_surface(
    positions, spacing, support_radius=None, cell_size=None, dimension=3, walls=None
) -> Surface:
    """Closed triangle mesh around the liquid, triangles counter-clockwise seen from outside.

    Args:
        positions: particle positions [m], world frame, (N, 3).
        spacing: particle spacing [m].
        support_radius: reach of a particle's colour [m]; two spacings when None.
        cell_size: distance of grid nodes [m]; the spacing when None. Half of it costs about five
            times as much and rounds small drops.
        dimension: 3, or 2 for a liquid in the x-z plane, which becomes a slab one spacing thick
            around y = 0.
        walls: planes of a convex container, (P, 4): outward unit normal and offset [m]; the liquid
            is where normal . x < offset. Liquid that touches one is then flat along it, with sharp
            edges, instead of round and half a spacing away. None for no such planes.

    Returns:
        Surface; with empty arrays when there are no particles.

    Raises:
        ValueError: positions of another shape, not finite, or too far from the origin; lengths not
            positive.
    """
    support_radius = 2.0 * spacing if support_radius is None else support_radius
    cell_size = spacing if cell_size is None else cell_size
    positions = _checked(positions, spacing, support_radius, cell_size, dimension)
    if len(positions) == 0:
        return _empty()
    if walls is not None and len(walls):
        walls = np.asarray(walls, np.float32)
        mirrored = _mirrored_at_walls(positions, walls, WALL_REACH * spacing)
        mesh = extract_surface(mirrored, spacing, support_radius, cell_size, dimension)
        return _cut_at_walls(mesh, walls)
    grid = _grid_around(positions, spacing, support_radius, cell_size, dimension)
    node_count = np.prod(np.asarray(grid.shape, np.float64))
    if node_count <= max(DENSE_NODES, DENSE_NODES_PER_PARTICLE * len(positions)):
        return _mesh_of_box(positions, grid, spacing, support_radius, dimension)
    return _mesh_of_clusters(positions, spacing, support_radius, cell_size, dimension)


def colour_field(positions, grid, spacing, support_radius, dimension=3, shifts=None):
    """Colour at every node, lonely particles enlarged and all blurred, (nx, ny, nz) float32.

    Args:
        positions: [m], (N, 3) float32, each at least `margin_nodes` from the grid's border.
        grid: where the nodes are.
        spacing: particle spacing [m].
        support_radius: reach of the splines [m].
        dimension: 3 or 2.
        shifts: nodes by which each particle is moved, (N, 3) int64, for slots; None for nowhere.
    """
    if shifts is None:
        shifts = np.zeros((1, 3), np.int64)
    knot = np.full(3, _knot(support_radius, grid.cell[0]))
    weights = np.full(len(positions), (spacing / knot[0]) ** dimension, np.float32)
    passes = _blur_passes(spacing, grid.cell[0])
    flat = dimension == 2
    raw = np.zeros(grid.shape, np.float32)
    field = np.empty_like(raw)
    scratch = np.empty_like(raw)
    arguments = (positions, shifts, grid.cell, grid.first, knot[0], flat)
    splat, lonely_weights = _splat, _lonely_weights
    if not flat and knot[0] == grid.cell[0]:  # as usual
        splat, lonely_weights = _splat_by_cells, _lonely_weights_by_cells
        arguments = (positions, shifts, 1.0 / grid.cell, grid.first)
    splat(*arguments, weights, raw)
    _blur(raw, passes, flat, scratch, field)
    lonely_weights(*arguments, field, weights)
    splat(*arguments, weights, raw)
    _blur(raw, passes, flat, scratch, field)
    _settle(field, flat)
    return field


def margin_nodes(spacing, support_radius, cell_size) -> int:
    """Nodes from a particle's cell to the first node it surely does not colour."""
    reach = 2.0 * _knot(support_radius, cell_size) / cell_size
    return int(np.ceil(reach)) + _blur_passes(spacing, cell_size) + 1


def march(field, grid) -> Surface:
    """Marching cubes on a field, normals by its gradient.

    Vertices are in the world frame [m]. The field's border must be 0, so that the mesh is closed.
    Normals are those of the field blurred once more: they show unrest long before positions do.
    """
    if field.max(initial=0.0) <= SURFACE_COLOUR:
        return _empty()
    nodes, triangles = marching_cubes(field, SURFACE_COLOUR)
    normals = np.empty_like(nodes)
    smooth = np.empty_like(field)
    _blur_pass(field, field.shape[1] == 4, np.empty_like(field), smooth)
    _field_normals(smooth, nodes, 1.0 / grid.cell, normals)
    vertices = ((nodes + grid.first) * grid.cell).astype(np.float32)
    return Surface(vertices, triangles, normals)


def _checked(positions, spacing, support_radius, cell_size, dimension):
    """Positions as C-contiguous (N, 3) float32, or ValueError."""
    for name, length in (
        ("spacing", spacing),
        ("support_radius", support_radius),
        ("cell_size", cell_size),
    ):
        if not (np.isfinite(length) and length > 0.0):
            raise ValueError(f"{name}: {length}, expected a positive length in metres")
    if dimension not in (2, 3):
        raise ValueError(f"dimension: {dimension}, expected 2 or 3")
    positions = np.ascontiguousarray(positions, np.float32)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions: shape {positions.shape}, expected (N, 3)")
    limit = MAX_CELL_INDEX * cell_size
    if len(positions) and not np.abs(positions).max() < limit:  # also false for NaN
        row = int(np.flatnonzero(~(np.abs(positions).max(axis=1) < limit))[0])
        raise ValueError(
            f"positions: row {row} is {positions[row].tolist()}, "
            f"expected finite and within {limit:g} m of the origin"
        )
    return positions


def _empty() -> Surface:
    return Surface(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32)
    )


def _knot(support_radius, cell_size):
    """Distance of the cubic B-spline's knots [m]: half its support, and no less than a cell."""
    return max(0.5 * support_radius, cell_size)


def _blur_passes(spacing, cell_size) -> int:
    return round(2.0 * BLUR_VARIANCE * (spacing / cell_size) ** 2)


def _grid_around(positions, spacing, support_radius, cell_size, dimension) -> Grid:
    """The grid that holds all colour of these particles with a border of zeros."""
    margin = margin_nodes(spacing, support_radius, cell_size)
    cell = np.full(3, float(cell_size))
    low = np.array([column.min() for column in positions.T])  # ten times as fast as along an axis
    high = np.array([column.max() for column in positions.T])
    first = np.floor(low / cell).astype(np.int64) - margin
    last = np.floor(high / cell).astype(np.int64) + 1 + margin
    first = first.astype(np.float64)
    shape = (last - first + 1).astype(np.int64)
    if dimension == 2:  # planes at -0.75, -0.25, 0.25 and 0.75 spacings: the level lies at +-0.5
        cell[1], first[1], shape[1] = 0.5 * spacing, -1.5, 4
    return Grid(cell, first, tuple(int(n) for n in shape))


def _mesh_of_box(positions, grid, spacing, support_radius, dimension) -> Surface:
    return march(colour_field(positions, grid, spacing, support_radius, dimension), grid)


def _mesh_of_clusters(positions, spacing, support_radius, cell_size, dimension) -> Surface:
    """Mesh clusters on their own: small ones many at once in equal slots of one array."""
    margin = margin_nodes(spacing, support_radius, cell_size)
    cluster = _clusters(positions, 2 * margin * cell_size, dimension)
    order = np.argsort(cluster, kind="stable")
    begins = np.flatnonzero(np.diff(cluster[order], prepend=-1))
    members = np.split(order, begins[1:])
    cells = np.floor(positions[order] / cell_size).astype(np.int64)
    low = np.minimum.reduceat(cells, begins) - margin
    high = np.maximum.reduceat(cells, begins) + 1 + margin
    edge = (high - low + 1).max(axis=1)
    parts, smaller = [], 0
    for slot in SLOT_EDGES if dimension == 3 else ():
        chosen = np.flatnonzero((edge > smaller) & (edge <= slot))
        per_batch = BATCH_NODES // slot**3
        for begin in range(0, len(chosen), per_batch):
            batch = chosen[begin : begin + per_batch]
            lengths = (spacing, support_radius, cell_size)
            parts.append(
                _mesh_of_slots(positions, [members[c] for c in batch], low[batch], slot, lengths)
            )
        smaller = slot
    for c in np.flatnonzero(edge > smaller):
        alone = positions[members[c]]
        parts.append(_mesh_of_cluster(alone, spacing, support_radius, cell_size, dimension))
    return _joined(parts)


def _mesh_of_slots(positions, members, low, slot, lengths) -> Surface:
    """Small clusters in a row of cubic slots, so that marching cubes is called once for all.

    Args:
        positions: of all particles [m], (N, 3).
        members: particle indices of each cluster.
        low: world index of each slot's first node, (clusters, 3).
        slot: edge of a slot in nodes.
        lengths: spacing, support radius and cell size [m].
    """
    spacing, support_radius, cell_size = lengths
    grid = Grid(np.full(3, float(cell_size)), np.zeros(3), (slot * len(low), slot, slot))
    world_to_slot = -low
    world_to_slot[:, 0] += np.arange(len(low)) * slot
    shifts = np.repeat(world_to_slot, [len(rows) for rows in members], axis=0)
    rows = np.concatenate(members)
    field = colour_field(positions[rows], grid, spacing, support_radius, 3, shifts)
    mesh = march(field, grid)
    which = (mesh.vertices[:, 0] / (slot * cell_size)).astype(np.int64)
    vertices = mesh.vertices - world_to_slot[which] * grid.cell
    return mesh._replace(vertices=vertices.astype(np.float32))


def _mesh_of_cluster(positions, spacing, support_radius, cell_size, dimension) -> Surface:
    """One large cluster; its cells are doubled until the grid is allowed."""
    while True:
        grid = _grid_around(positions, spacing, support_radius, cell_size, dimension)
        if np.prod(np.asarray(grid.shape, np.float64)) <= MAX_NODES:
            return _mesh_of_box(positions, grid, spacing, support_radius, dimension)
        cell_size = 2.0 * cell_size


def _mirrored_at_walls(positions, walls, reach):
    """Particles and their mirror images behind each wall nearer than `reach`, corners included."""
    for wall in walls:
        gap = wall[3] - positions @ wall[:3]
        near = (gap > 0.0) & (gap < reach)
        images = positions[near] + 2.0 * gap[near, None] * wall[:3]
        positions = np.concatenate([positions, images.astype(np.float32)])
    return np.ascontiguousarray(positions)


def _cut_at_walls(mesh, walls) -> Surface:
    """Move what is behind a wall onto it, and drop what is behind it altogether."""
    vertices, normals = mesh.vertices.copy(), mesh.normals.copy()
    count = len(vertices)
    piece_count, piece = _components(*mesh.triangles[:, [0, 1, 1, 2]].reshape(-1, 2).T, count)
    kept = np.ones(piece_count, bool)
    for wall in walls:
        over = mesh.vertices @ wall[:3] - wall[3]
        kept &= np.bincount(piece, over < 0.0, piece_count) > 0
        behind = over > 0.0
        vertices -= np.maximum(vertices @ wall[:3] - wall[3], 0.0)[:, None] * wall[:3]
        normals[behind] = wall[:3]
    used = kept[piece]
    index = np.cumsum(used, dtype=np.int32) - 1
    triangles = index[mesh.triangles[used[mesh.triangles[:, 0]]]]
    return Surface(vertices[used], np.ascontiguousarray(triangles), normals[used])


def _joined(parts) -> Surface:
    """Several meshes as one."""
    parts = [part for part in parts if len(part.vertices)]
    if not parts:
        return _empty()
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    triangles = [part.triangles + np.int32(o) for part, o in zip(parts, offsets, strict=True)]
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(triangles).astype(np.int32),
        np.concatenate([part.normals for part in parts]),
    )


def _clusters(positions, edge, dimension):
    """Number of the cluster of every particle, (N,) int32.

    Space is cut into cubes; particles in touching cubes belong together. Particles of two clusters
    therefore stand at least one edge apart along some axis.
    """
    cubes = np.floor(positions / edge).astype(np.int64)
    if dimension == 2:
        cubes[:, 1] = 0
    for axis in range(3):  # gaps shrink to one empty cube: three indices then fit one integer
        values, inverse = np.unique(cubes[:, axis], return_inverse=True)
        cubes[:, axis] = np.cumsum(np.minimum(np.diff(values, prepend=values[0] - 1), 2))[inverse]
    stride = cubes.max(axis=0) + 2
    keys, inverse = np.unique(
        (cubes[:, 0] * stride[1] + cubes[:, 1]) * stride[2] + cubes[:, 2], return_inverse=True
    )
    rows, columns = [], []
    for x, y, z in np.ndindex(3, 3, 3):
        offset = ((x - 1) * stride[1] + (y - 1)) * stride[2] + (z - 1)
        if offset > 0:
            at = np.minimum(np.searchsorted(keys, keys + offset), len(keys) - 1)
            found = np.flatnonzero(keys[at] == keys + offset)
            rows.append(found)
            columns.append(at[found])
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    return _components(rows, columns, len(keys))[1][inverse]


def _components(rows, columns, count):
    """Number of connected components of `count` nodes, and that of each node; links of nodes."""
    from scipy.sparse import coo_matrix  # slow to import, and few programs need it
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (count, count))
    return connected_components(links, directed=False)


@device
def _cubic_spline(distance):
    """Cubic B-spline with knots at integers; integral 1, support [-2, 2] (de Boor 1978)."""
    q = abs(distance)
    if q < 1.0:
        return 2.0 / 3.0 - q * q * (1.0 - 0.5 * q)
    if q < 2.0:
        return (2.0 - q) ** 3 / 6.0
    return 0.0


@device
def _reached_nodes(knot, cell):
    """Nodes along an axis where a spline is not 0; one on its very end does not count."""
    return int(np.ceil(4.0 * knot / cell - 1e-6))


@device
def _first_node(coordinate, cell, first, shift, knot):
    """First node along one axis that a particle's spline reaches."""
    return int(np.ceil((coordinate - 2.0 * knot) / cell - first)) + shift


@kernel
def _axis_weights(coordinate, cell, first, shift, knot, axis_weights):  # the last is written
    """Spline of one particle at the nodes along one axis; returns the first node."""
    begin = _first_node(coordinate, cell, first, shift, knot)
    count = len(axis_weights)
    for i in range(count):
        node = (begin + i - shift + first) * cell
        axis_weights[i] = _cubic_spline((node - coordinate) / knot)
    return begin


@kernel
def _splat(positions, shifts, cell, first, knot, flat, weights, field):  # the last is written
    """Add every particle's spline times its weight to the field; weight 0 is skipped.

    Args:
        positions: [m], (N, 3).
        shifts: (N, 3) nodes added to each particle's place, or (1, 3) for all.
        cell: distance of nodes per axis [m], (3,).
        first: world index of node 0 per axis, (3,).
        knot: distance of the spline's knots [m].
        flat: 2D liquid; the field's two middle planes get the colour, the outer ones nothing.
        weights: volume of each particle over knot^dimension [-], (N,).
        field: (nx, ny, nz).
    """
    count = _reached_nodes(knot, cell[0])
    wx = np.empty(count, np.float32)
    wy = np.ones(2, np.float32) if flat else np.empty(count, np.float32)
    wz = np.empty(count, np.float32)
    for p in range(len(positions)):
        if weights[p] == 0.0:
            continue
        s = p if len(shifts) > 1 else 0
        x = _axis_weights(positions[p, 0], cell[0], first[0], shifts[s, 0], knot, wx)
        y = 1
        if not flat:
            y = _axis_weights(positions[p, 1], cell[1], first[1], shifts[s, 1], knot, wy)
        z = _axis_weights(positions[p, 2], cell[2], first[2], shifts[s, 2], knot, wz)
        for i in range(count):
            for j in range(len(wy)):
                w = weights[p] * wx[i] * wy[j]
                for k in range(count):
                    field[x + i, y + j, z + k] += w * wz[k]


@kernel
def _lonely_weights(positions, shifts, cell, first, knot, flat, field, weights):
    """Replace each weight by what it lacks for the wanted colour around the particle; 0 for most.

    Arguments are those of `_splat`, but the field is read and the weights are written. Averaging by
    the spline, unlike interpolation, hardly depends on where in its cell the particle is: a single
    drop does not pulsate while it flies.
    """
    count = _reached_nodes(knot, cell[0])
    wx = np.empty(count, np.float32)
    wy = np.ones(2, np.float32) if flat else np.empty(count, np.float32)
    wz = np.empty(count, np.float32)
    middle = count // 2
    for p in range(len(positions)):
        s = p if len(shifts) > 1 else 0
        x = _first_node(positions[p, 0], cell[0], first[0], shifts[s, 0], knot)
        z = _first_node(positions[p, 2], cell[2], first[2], shifts[s, 2], knot)
        y = 1
        if not flat:
            y = _first_node(positions[p, 1], cell[1], first[1], shifts[s, 1], knot)
        if field[x + middle, y if flat else y + middle, z + middle] >= INSIDE_COLOUR:
            weights[p] = 0.0
            continue
        _axis_weights(positions[p, 0], cell[0], first[0], shifts[s, 0], knot, wx)
        if not flat:
            _axis_weights(positions[p, 1], cell[1], first[1], shifts[s, 1], knot, wy)
        _axis_weights(positions[p, 2], cell[2], first[2], shifts[s, 2], knot, wz)
        colour, total = 0.0, 0.0
        for i in range(count):
            for j in range(len(wy)):
                w = wx[i] * wy[j]
                for k in range(count):
                    colour += w * wz[k] * field[x + i, y + j, z + k]
                    total += w * wz[k]
        wanted = LONELY_COLOUR * total
        weights[p] = weights[p] * (wanted / colour - 1.0) if colour < wanted else 0.0


@inlined
def _cell_weights(coordinate, inverse_cell, first, shift):
    """First node along an axis that a spline with knots a cell apart reaches; its four weights."""
    place = coordinate * inverse_cell - first
    node = np.floor(place)
    one, third = np.float32(1.0), np.float32(1.0 / 3.0)
    b = np.float32(place - node)
    a, half = one - b, np.float32(0.5)
    weights = (
        half * third * a * a * a,
        np.float32(2.0) * third - b * b * (one - half * b),
        np.float32(2.0) * third - a * a * (one - half * a),
        half * third * b * b * b,
    )
    return np.intp(node) - 1 + shift, weights


@bare_kernel
def _splat_by_cells(positions, shifts, inverse_cell, first, weights, field):
    """`_splat` in three dimensions where the knots are a cell apart, in half the time."""
    ny, nz = field.shape[1], field.shape[2]
    colours = field.reshape(field.size)
    for p in range(positions.shape[0]):
        weight = weights[p]
        if weight == 0.0:
            continue
        s = p if shifts.shape[0] > 1 else 0
        x, wx = _cell_weights(positions[p, 0], inverse_cell[0], first[0], shifts[s, 0])
        y, wy = _cell_weights(positions[p, 1], inverse_cell[1], first[1], shifts[s, 1])
        z, wz = _cell_weights(positions[p, 2], inverse_cell[2], first[2], shifts[s, 2])
        corner = (x * ny + y) * nz + z
        for i in range(4):
            for j in range(4):
                w, k = weight * wx[i] * wy[j], corner + (i * ny + j) * nz
                colours[k] += w * wz[0]
                colours[k + 1] += w * wz[1]
                colours[k + 2] += w * wz[2]
                colours[k + 3] += w * wz[3]


@bare_kernel
def _lonely_weights_by_cells(positions, shifts, inverse_cell, first, field, weights):
    """`_lonely_weights` in three dimensions where the knots are a cell apart."""
    ny, nz = field.shape[1], field.shape[2]
    colours = field.reshape(field.size)
    for p in range(positions.shape[0]):
        s = p if shifts.shape[0] > 1 else 0
        x, wx = _cell_weights(positions[p, 0], inverse_cell[0], first[0], shifts[s, 0])
        y, wy = _cell_weights(positions[p, 1], inverse_cell[1], first[1], shifts[s, 1])
        z, wz = _cell_weights(positions[p, 2], inverse_cell[2], first[2], shifts[s, 2])
        corner = (x * ny + y) * nz + z
        if colours[corner + (2 * ny + 2) * nz + 2] >= INSIDE_COLOUR:
            weights[p] = 0.0
            continue
        colour = np.float32(0.0)
        for i in range(4):
            for j in range(4):
                k = corner + (i * ny + j) * nz
                row = wz[0] * colours[k] + wz[1] * colours[k + 1]
                row += wz[2] * colours[k + 2] + wz[3] * colours[k + 3]
                colour += wx[i] * wy[j] * row
        lacking = np.float32(LONELY_COLOUR)  # the weights' sum is 1
        weights[p] = weights[p] * (lacking / colour - 1.0) if colour < lacking else 0.0


@device
def _interpolate(field, x, y, z):
    """Trilinear interpolation at node coordinates inside the grid."""
    i = min(max(int(x), 0), field.shape[0] - 2)
    j = min(max(int(y), 0), field.shape[1] - 2)
    k = min(max(int(z), 0), field.shape[2] - 2)
    a, b, c = x - i, y - j, z - k
    low = (1.0 - b) * ((1.0 - c) * field[i, j, k] + c * field[i, j, k + 1]) + b * (
        (1.0 - c) * field[i, j + 1, k] + c * field[i, j + 1, k + 1]
    )
    high = (1.0 - b) * ((1.0 - c) * field[i + 1, j, k] + c * field[i + 1, j, k + 1]) + b * (
        (1.0 - c) * field[i + 1, j + 1, k] + c * field[i + 1, j + 1, k + 1]
    )
    return (1.0 - a) * low + a * high


@kernel
def _blur_pass(source, flat, scratch, target):  # the last two are written
    """[1 2 1]/4 along x, y and z; the border is 0 and stays so. `source` may be `target`."""
    nx, ny, nz = source.shape
    for i in range(nx):
        for j in range(ny):
            scratch[i, j, 0] = 0.0
            scratch[i, j, nz - 1] = 0.0
            for k in range(1, nz - 1):
                scratch[i, j, k] = 0.25 * (source[i, j, k - 1] + source[i, j, k + 1]) + (
                    0.5 * source[i, j, k]
                )
    if not flat:
        for i in range(nx):
            before = np.zeros(nz, np.float32)
            for j in range(1, ny - 1):
                for k in range(nz):
                    here = scratch[i, j, k]
                    scratch[i, j, k] = 0.25 * (before[k] + scratch[i, j + 1, k]) + 0.5 * here
                    before[k] = here
    target[0] = 0.0
    target[nx - 1] = 0.0
    for i in range(1, nx - 1):
        for j in range(ny):
            for k in range(nz):
                target[i, j, k] = 0.25 * (scratch[i - 1, j, k] + scratch[i + 1, j, k]) + (
                    0.5 * scratch[i, j, k]
                )


def _blur(source, passes, flat, scratch, target):  # the last two are written
    """Several binomial passes from source to target."""
    if passes == 0:
        np.copyto(target, source)
    for n in range(passes):
        _blur_pass(source if n == 0 else target, flat, scratch, target)


@kernel
def _settle(field, flat):  # the field is written
    """Move nodes off the very level, and let a slab be equally thick everywhere.

    A node exactly at the level would give several vertices in one place and triangles without area.
    """
    least = np.float32(1.0e-3)
    for i in range(field.shape[0]):
        for j in range(field.shape[1]):
            for k in range(field.shape[2]):
                colour = field[i, j, k]
                if flat and colour > 1.0:
                    colour = np.float32(1.0)
                if abs(colour - SURFACE_COLOUR) < least:
                    colour = np.float32(SURFACE_COLOUR) + least
                field[i, j, k] = colour


@kernel
def _field_normals(field, nodes, inverse_cell, normals):  # the last is written
    """Unit vectors down the field's gradient (differences over one cell) at node coordinates."""
    for v in range(len(nodes)):
        x, y, z = nodes[v, 0], nodes[v, 1], nodes[v, 2]
        gx = _interpolate(field, x - 0.5, y, z) - _interpolate(field, x + 0.5, y, z)
        gy = _interpolate(field, x, y - 0.5, z) - _interpolate(field, x, y + 0.5, z)
        gz = _interpolate(field, x, y, z - 0.5) - _interpolate(field, x, y, z + 0.5)
        gx, gy, gz = gx * inverse_cell[0], gy * inverse_cell[1], gz * inverse_cell[2]
        length = np.sqrt(gx * gx + gy * gy + gz * gz)
        scale = 1.0 / length if length > 0.0 else 0.0
        normals[v, 0] = gx * scale
        normals[v, 1] = gy * scale
        normals[v, 2] = gz * scale
