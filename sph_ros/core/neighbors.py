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
from sph_ros.core.jit import device, inlined
from sph_ros.core.near_points import append_near
from sph_ros.core.pair_sums import STEPS, TINY, filling_of, geometry_of_pairs
from sph_ros.core.team import parallel_kernel
from sph_ros.core.vector import LANES, inverse_root, larger, spread
from sph_ros.core.vector_memory import (
    gather_column,
    gather_points,
    lanes_from,
    load,
    put,
    store,
    take_points,
    turn,
)

#: Particles are sorted in so many pieces at once.
HALVES = 2


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


@parallel_kernel
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
    places = np.zeros((HALVES, cells), np.int32)
    for half in prange(HALVES):
        for i in range(count * half // HALVES, count * (half + 1) // HALVES):
            cx = cell_coordinate(positions[i, a], grid.lower[0], grid.inverse_cell, nx)
            cy = cell_coordinate(positions[i, b], grid.lower[1], grid.inverse_cell, ny)
            cz = cell_coordinate(positions[i, c], grid.lower[2], grid.inverse_cell, nz)
            cell = (cz * ny + cy) * nx + cx
            cell_of[i] = cell
            places[half, cell] += 1
    # From how many there are to where the first one goes.
    place = np.int32(0)
    for cell in range(cells):
        cell_start[cell] = place
        for half in range(HALVES):
            here = places[half, cell]
            places[half, cell] = place
            place += here
    cell_start[cells] = count
    for half in prange(HALVES):
        for i in range(count * half // HALVES, count * (half + 1) // HALVES):
            cell = cell_of[i]
            order[places[half, cell]] = i
            places[half, cell] += 1


@inlined
def cell_of_particle(i, columns, grid):
    """Coordinates of the cell of particle i along the grid's axes."""
    a, b, c = grid.axes[0], grid.axes[1], grid.axes[2]
    nx, ny, nz = grid.counts[0], grid.counts[1], grid.counts[2]
    return (
        cell_coordinate(columns[a, i], grid.lower[0], grid.inverse_cell, nx),
        cell_coordinate(columns[b, i], grid.lower[1], grid.inverse_cell, ny),
        cell_coordinate(columns[c, i], grid.lower[2], grid.inverse_cell, nz),
    )


@inlined
def bring_together(cell, columns, grid, near, indices):
    """Copy what is around a cell; returns how much that is, or -1 where it has no room.

    It lies in nine runs of three cells along the fastest axis. Two vectors of each are copied in
    any case: nearly always that is enough, and the processor has nothing to guess.

    Args:
        cell: from `cell_of_particle`.
        columns: as in `find_neighbors`.
        grid: from `sort_by_cell`.
        near: coordinates of the candidates, (3, M); written, the last vector filled up with places
            that are near nothing.
        indices: of the candidates, (M,) uint32; written.
    """
    xs, ys, zs, x, y, z = columns[0], columns[1], columns[2], near[0], near[1], near[2]
    cx, cy, cz = cell
    nx, ny, nz = grid.counts[0], grid.counts[1], grid.counts[2]
    first, last = max(cx - 1, 0), min(cx + 1, nx - 1)
    count, everywhere = np.intp(0), np.intp(xs.shape[0])
    for kz in range(max(cz - 1, 0), min(cz + 2, nz)):
        for ky in range(max(cy - 1, 0), min(cy + 2, ny)):
            row = (kz * ny + ky) * nx
            begin = np.intp(grid.cell_start[row + first])
            length = np.intp(grid.cell_start[row + last + 1]) - begin
            if count + length + 2 * LANES > indices.shape[0]:
                return np.intp(-1)
            for k in range(0, max(length, 2 * LANES), LANES):
                store(load(xs, begin + k), x, count + k)
                store(load(ys, begin + k), y, count + k)
                store(load(zs, begin + k), z, count + k)
                store(lanes_from(begin + k, everywhere), indices, count + k)
            count += length
    nowhere = spread(np.float32(np.inf))
    store(nowhere, x, count)
    store(nowhere, y, count)
    store(nowhere, z, count)
    return count


@inlined
def store_slice(first, staged, pairs, cursor, width):
    """Bring the lists of a slice from one after the other to side by side.

    Args:
        first: particle of the slice.
        staged: the lists; that of particle first + k is staged[k], its length in end[first + k],
            (LANES, M) uint32.
        pairs: lists are written, and their starts and ends.
        cursor: where the entries of the slice begin; there must be room for whole blocks of LANES
            entries of each.
        width: length of its longest list.
    """
    starts, ends = pairs.start, pairs.end
    last = starts.shape[0] - 1
    for lane in range(LANES):
        i = min(first + lane, last)
        length = ends[i] if first + lane <= last else np.intp(0)
        for k in range(length, width, LANES):
            store(lanes_from(i, i + 1), staged[lane], k)
    for k in range(0, width, LANES):
        turn(staged, k, pairs.neighbors, cursor + k * LANES)
    for i in range(first, min(first + LANES, last + 1)):
        length = ends[i]
        starts[i] = cursor + i - first
        ends[i] = starts[i] + length * LANES
    pairs.stop[first // LANES] = cursor + width * LANES


@parallel_kernel
def find_neighbors(columns, grid, support_radius, chunks, pairs):
    """Neighbour lists of all particles.

    Chunk k of `CHUNK` particles appends to its own part of the list, neighbors[k * room:(k + 1) *
    room] with room = len(neighbors) // chunks, so nothing has to be counted first. Particles of a
    cell have the same candidates, which are brought together for them.

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
    ends = pairs.end
    xs, ys, zs = columns[0], columns[1], columns[2]
    turns = fresh_turns()
    full = np.zeros(PARTS, np.int64)
    for part in prange(PARTS):
        chunk = next_chunk(turns, part, chunks)
        while chunk >= 0:
            # Room for lists four times as long as the mean one.
            longest, most = room // (CHUNK // 4), 1000
            staged = np.empty((LANES, longest + 2 * LANES), np.uint32)
            near, indices = np.empty((3, most), np.float32), np.empty(most, np.uint32)
            cursor, limit = np.intp(chunk * room), np.intp((chunk + 1) * room)
            before, candidates = (-1, -1, -1), np.intp(0)
            for first in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count), LANES):
                width = np.intp(0)
                for i in range(first, min(first + LANES, count)):
                    cell = cell_of_particle(i, columns, grid)
                    if cell != before:
                        before = cell
                        candidates = bring_together(cell, columns, grid, near, indices)
                        while candidates < 0:
                            most *= 2
                            near, indices = (
                                np.empty((3, most), np.float32),
                                np.empty(most, np.uint32),
                            )
                            candidates = bring_together(cell, columns, grid, near, indices)
                    x, y, z, length = xs[i], ys[i], zs[i], np.intp(0)
                    for k in range(0, candidates, LANES):
                        length = append_near(
                            near[0], near[1], near[2], indices, k, x, y, z, square,
                            staged[i - first], min(length, longest),
                        )  # fmt: skip
                    ends[i] = length
                    width = max(width, length)
                if width > longest or cursor + (width + LANES) * LANES > limit:
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
