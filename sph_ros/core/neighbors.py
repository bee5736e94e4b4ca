# SPDX-License-Identifier: Apache-2.0
"""Cell-sorted particles and their neighbour lists.

Particles are sorted by cell (cells of one support radius), so the candidates of a particle are nine
contiguous runs (three in 2D). The axis along which the liquid is longest changes slowest: then
neighbours are as near in memory as can be, mostly in the nearest cache. A list and the geometry of
each pair are made once a step and read by every pass of the solver. A particle is its own
neighbour: its gradient with itself is zero and its weight is the self term of the density, so no
pass has to make an exception.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from sph_ros.core.chunks import CHUNK, PARTS, chunk_count, fresh_turns, next_chunk, slices_of
from sph_ros.core.jit import device, inlined, kernel, parallel_kernel
from sph_ros.core.near_points import append_within
from sph_ros.core.pair_sums import STEPS, TINY, filling_of, geometry_of_pairs
from sph_ros.core.vector import LANES, inverse_root, larger, spread, where_whole
from sph_ros.core.vector_memory import (
    gather,
    gather_column,
    gather_points,
    lanes_from,
    load,
    put,
    store,
    take,
    take_points,
)


class Grid(NamedTuple):
    """Cells over the particles.

    Attributes:
        axes: in the order of the cells, the one that changes fastest first, (3,) int32.
        lower: corner of the first cell along these axes [m], (3,) float32.
        inverse_cell: 1 / cell size [1/m], float32.
        counts: cells along these axes, (3,) int32.
        cell_start: first particle of each cell in the sorted order, (cells + 1,) int32.
    """

    axes: np.ndarray
    lower: np.ndarray
    inverse_cell: np.float32
    counts: np.ndarray
    cell_start: np.ndarray


class Sums(NamedTuple):
    """What a particle sums over its neighbours.

    Attributes:
        density, near_density: relative to the lattice at rest, walls included [-], (N,).
        gradient: sum of pair gradients [1/m], (N, 3).
        gradient_square: sum of their squares [1/m^2], (N,).
    """

    density: np.ndarray
    near_density: np.ndarray
    gradient: np.ndarray
    gradient_square: np.ndarray


@device
def cell_coordinate(value, lower, inverse_cell, count):
    """Cell index along one axis; what lies outside the grid belongs to the outermost cell.

    Clamping keeps neighbours in adjacent cells, so one stray particle needs no larger grid.
    """
    cell = int(np.floor((value - lower) * inverse_cell))
    return min(max(cell, 0), count - 1)


@kernel
def sort_by_cell(positions, grid, cell_of, order):
    """Stable counting sort of particles by cell.

    Args:
        positions: [m], (N, 3).
        grid: its `cell_start` is written.
        cell_of: cell of each particle, (N,) int32; written.
        order: order[k] is the present row of the particle that is to become row k, (N,) int32;
            written.
    """
    nx, ny, nz = grid.counts[0], grid.counts[1], grid.counts[2]
    a, b, c = grid.axes[0], grid.axes[1], grid.axes[2]
    cell_start, count = grid.cell_start, positions.shape[0]
    cells = nx * ny * nz
    for cell in range(cells):
        cell_start[cell] = 0
    for i in range(count):
        cx = cell_coordinate(positions[i, a], grid.lower[0], grid.inverse_cell, nx)
        cy = cell_coordinate(positions[i, b], grid.lower[1], grid.inverse_cell, ny)
        cz = cell_coordinate(positions[i, c], grid.lower[2], grid.inverse_cell, nz)
        cell = (cz * ny + cy) * nx + cx
        cell_of[i] = cell
        cell_start[cell] += 1
    # First the end of each cell, which then moves down to its start.
    end = 0
    for cell in range(cells):
        end += cell_start[cell]
        cell_start[cell] = end
    cell_start[cells] = count
    for i in range(count - 1, -1, -1):
        cell = cell_of[i]
        cell_start[cell] -= 1
        order[cell_start[cell]] = i


@inlined
def append_neighbors(i, columns, grid, square, neighbors, cursor, limit):
    """Append the neighbours of particle i; the new cursor, or -1 where there is no room."""
    xs, ys, zs = columns[grid.axes[0]], columns[grid.axes[1]], columns[grid.axes[2]]
    x, y, z = xs[i], ys[i], zs[i]
    nx, ny, nz = grid.counts[0], grid.counts[1], grid.counts[2]
    cx = cell_coordinate(x, grid.lower[0], grid.inverse_cell, nx)
    cy = cell_coordinate(y, grid.lower[1], grid.inverse_cell, ny)
    cz = cell_coordinate(z, grid.lower[2], grid.inverse_cell, nz)
    first, last = max(cx - 1, 0), min(cx + 1, nx - 1)
    for kz in range(max(cz - 1, 0), min(cz + 2, nz)):
        for ky in range(max(cy - 1, 0), min(cy + 2, ny)):
            row = (kz * ny + ky) * nx
            begin = np.intp(grid.cell_start[row + first])
            end = np.intp(grid.cell_start[row + last + 1])
            while begin < end:
                if cursor + LANES > limit:
                    return np.intp(-1)
                cursor = append_within(xs, ys, zs, begin, end, x, y, z, square, neighbors, cursor)
                begin += LANES
    return cursor


@inlined
def store_slice(first, staged, pairs, cursor, width):
    """Bring the lists of a slice from one after the other to side by side.

    Args:
        first: particle of the slice.
        staged: the lists; those of particle i are staged[start[i]:end[i]] (M,) uint32.
        pairs: lists are written, and their starts and ends changed to where they are then.
        cursor: where the entries of the slice begin.
        width: length of its longest list.
    """
    starts, ends, neighbors = pairs.start, pairs.end, pairs.neighbors
    count = starts.shape[0]
    own = lanes_from(first, count)
    begins, stops = take(starts, first), take(ends, first)
    for k in range(width):
        places = begins + k
        listed = places < stops
        found = gather(staged, where_whole(listed, places, begins))
        store(where_whole(listed, found, own), neighbors, cursor + k * LANES)
    for i in range(first, min(first + LANES, count)):
        length = ends[i] - starts[i]
        starts[i] = cursor + i - first
        ends[i] = starts[i] + length * LANES
    pairs.stop[first // LANES] = cursor + width * LANES


@parallel_kernel
def find_neighbors(columns, grid, support_radius, chunks, pairs):
    """Neighbour lists of all particles.

    Chunk k of `CHUNK` particles appends to its own part of the list, neighbors[k * room:(k + 1) *
    room] with room = len(neighbors) // chunks, so nothing has to be counted first.

    Args:
        columns: cell-sorted coordinates [m], (3, N + padding) with N = len(pairs.start).
        grid: from `sort_by_cell`.
        support_radius: h [m], float32.
        chunks: `chunk_count(N)`.
        pairs: the lists are written.

    Returns:
        Number of chunks whose part was too small: enlarge the list and call again if it is not 0.
    """
    count = pairs.start.shape[0]
    room = pairs.neighbors.shape[0] // chunks
    square = support_radius * support_radius
    starts, ends = pairs.start, pairs.end
    turns = fresh_turns()
    full = np.zeros(PARTS, np.int64)
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            staged = np.empty(room // 4 + LANES, np.uint32)
            cursor, limit = np.intp(chunk * room), np.intp((chunk + 1) * room)
            for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count), LANES):
                place, width = np.intp(0), np.intp(0)
                for i in range(first, min(first + LANES, count)):
                    begin = place
                    place = append_neighbors(
                        i, columns, grid, square, staged, place, staged.shape[0]
                    )
                    if place < 0:
                        break
                    starts[i], ends[i] = begin, place
                    width = max(width, place - begin)
                if place < 0 or cursor + width * LANES > limit:
                    full[part] += 1
                    break
                store_slice(first, staged, pairs, cursor, width)
                cursor += width * LANES
            chunk = next_chunk(turns, part, chunks)
    return full.sum()


@parallel_kernel
def sum_densities(
    positions, support_radius, power, density_scale, near_scale, wall_density, chunks, pairs, sums
):
    """Pair geometry, both densities and gradient sums of every particle (Clavet 2005, Alg. 2).

    Args:
        positions: [m], (N, 3), those of the lists.
        support_radius: h [m], float32.
        power: of the density's weight (1 - r/h)^power, 2 or 3, float32.
        density_scale, near_scale: 1 / lattice sums of the two weights [-], float32.
        wall_density: density and near-density that walls add [-], (N, 2).
        chunks: `chunk_count(N)`.
        pairs: all but the lists is written.
        sums: all written.
    """
    inverse_h = np.float32(1.0) / support_radius
    slope = -power * density_scale * inverse_h
    bend = power - np.float32(2.0)
    density, near_density = sums.density, sums.near_density
    gradient, gradient_square = sums.gradient, sums.gradient_square
    count = pairs.start.shape[0]
    pairs.unit[0] = slope / STEPS
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count), LANES):
                w, n, square, x, y, z = geometry_of_pairs(pairs, positions, first, inverse_h, bend)
                rows = lanes_from(first, count)
                put(density_scale * w + gather_column(wall_density, rows, 0), density, first)
                put(near_scale * n + gather_column(wall_density, rows, 1), near_density, first)
                put((slope * x, slope * y, slope * z), gradient, first)
                put((slope * slope) * square, gradient_square, first)
            chunk = next_chunk(turns, part, chunks)


@parallel_kernel
def densities_of_pairs(
    positions,
    listed,
    support_radius,
    density_scale,
    wall_density,
    wall_gradients,
    pairs,
    density,
):
    """Densities of particles that have moved a little since their lists were made.

    Args:
        positions: [m], (N, 3).
        listed: where they were then [m], (N, 3).
        support_radius: h [m], float32.
        density_scale: 1 / lattice sum of the weight [-], float32.
        wall_density: density that walls added then, in its first column [-], (N, 2).
        wall_gradients: its gradient, in the first three columns [1/m], (N, 6).
        pairs: from `find_neighbors`.
        density: relative to rest [-], (N,); written.
    """
    inverse_h = np.float32(1.0) / support_radius
    zero, one = np.float32(0.0), np.float32(1.0)
    count = density.shape[0]
    turns = fresh_turns()
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunk_count(count))
        while chunk >= 0:
            for s in slices_of(chunk, pairs.stop.shape[0]):
                first = s * LANES
                rows = lanes_from(first, count)
                x, y, z = take_points(positions, first, 0)
                weights = spread(zero)
                for k in range(pairs.start[first], pairs.stop[s], LANES):
                    j = load(pairs.neighbors, k)
                    dx, dy, dz = gather_points(positions, j)
                    dx, dy, dz = x - dx, y - dy, z - dz
                    r2 = dx * dx + dy * dy + dz * dz + TINY
                    u = larger(one - inverse_h * (r2 * inverse_root(r2)), spread(zero))
                    weights += u * u
                gx, gy, gz = take_points(wall_gradients, first, 0)
                lx, ly, lz = take_points(listed, first, 0)
                wall = gather_column(wall_density, rows, 0)
                wall += gx * (x - lx) + gy * (y - ly) + gz * (z - lz)
                weights = density_scale * (weights - filling_of(pairs, first))
                put(weights + larger(wall, spread(zero)), density, first)
            chunk = next_chunk(turns, part, chunk_count(count))
