# SPDX-License-Identifier: Apache-2.0
"""Points on the surfaces of solids, where free bodies may touch."""

import math

import numpy as np

from sph_ros.core.distances import signed_distances
from sph_ros.core.touching import Samples
from sph_ros.sim.packing import pack_shapes
from sph_ros.sim.shape_geometry import display_mesh, extent
from sph_ros.sim.shape_types import (
    Box,
    Capsule,
    Container,
    Cylinder,
    OpenSurface,
    Plane,
    Shape,
    Sphere,
    Union,
)

#: Samples lie no farther apart than this share of the solid's size, nor closer than a spacing.
_PARTS = 12
#: Samples along the longest side of a cut whose outline is traced, 2D.
_OUTLINE_SAMPLES = 192
#: Directions in which a ball looks for walls.
_PROBES = {3: 162, 2: 48}


def pack_samples(shapes, spacing: float, dimension: int) -> Samples:
    """Samples of all solids; none of planes, containers and other endless ones.

    Args:
        shapes: of the S solids.
        spacing: of the particles [m].
        dimension: 3 or 2.
    """
    rows = [_samples(shape, spacing, dimension) for shape in shapes]
    points, normals, radii = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return Samples(
        np.cumsum([0] + [len(point) for point, _, _ in rows]),
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(normals, np.float32),
        np.ascontiguousarray(radii, np.float32),
        _directions(dimension),
    )


def _directions(dimension: int) -> np.ndarray:
    """Unit vectors all around: a Fibonacci sphere, or a circle in the x-z plane."""
    index = np.arange(_PROBES[dimension])
    if dimension == 2:
        angle = 2.0 * np.pi * index / len(index)
        rows = np.stack([np.cos(angle), np.zeros(len(index)), np.sin(angle)], axis=1)
    else:
        z = 1.0 - (2.0 * index + 1.0) / len(index)
        flat, angle = np.sqrt(1.0 - z * z), index * np.pi * (3.0 - math.sqrt(5.0))
        rows = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return np.ascontiguousarray(rows, np.float32)


def _samples(shape: Shape, spacing: float, dimension: int):
    """Points (P, 3) [m], normals (P, 3) and radii (P,) [m] of one solid, its frame."""
    lower, upper = extent(shape)
    if isinstance(shape, Plane | Container) or not np.isfinite(upper - lower).all():
        points = np.zeros((0, 3))
        return points, points, np.zeros(0)
    if isinstance(shape, Sphere | Capsule):
        return _round_points(shape)
    if isinstance(shape, OpenSurface):  # a body must not slip through between samples
        points, normals = _mesh_points(shape, spacing)
        return points, 0.0 * normals, np.zeros(len(points))
    step = max(spacing, float((upper - lower).max()) / _PARTS)
    if isinstance(shape, Box) or (isinstance(shape, Cylinder) and dimension == 2):
        points, normals = _box_points(lower, upper, step, dimension)
    elif dimension == 2:
        points, normals = _outline_points(shape, lower, upper, step)
    else:
        points, normals = _mesh_points(shape, step)
    return points, normals, np.zeros(len(points))


def _round_points(shape: Sphere | Capsule):
    """The centre, or points on the axis."""
    length = getattr(shape, "length", 0.0)
    count = 2 * math.ceil(length / shape.radius) + 1
    points = np.zeros((count, 3))
    points[:, 2] = np.linspace(-0.5 * length, 0.5 * length, count)
    return points, np.zeros((count, 3)), np.full(count, shape.radius)


def _box_points(lower, upper, step, dimension):
    """A lattice on each face of a box, edges and corners included."""
    parts = np.ceil((upper - lower) / step).astype(int)
    axes = [np.linspace(lower[axis], upper[axis], parts[axis] + 1) for axis in range(3)]
    if dimension == 2:
        axes[1] = np.zeros(1)
    points, normals = [], []
    for axis in (0, 2) if dimension == 2 else (0, 1, 2):
        for side, place in ((-1.0, lower), (1.0, upper)):
            face = [*axes]
            face[axis] = place[axis : axis + 1]
            rows = np.stack(np.meshgrid(*face, indexing="ij"), axis=-1).reshape(-1, 3)
            points.append(rows)
            normals.append(np.broadcast_to(side * np.eye(3)[axis], rows.shape))
    return np.concatenate(points), np.concatenate(normals)


def _mesh_points(shape, step):
    """Corners of the drawn triangles and points on them, thinned to half the step."""
    vertices, triangles = display_mesh(shape)
    corners = vertices.astype(np.float64)[triangles]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    parts = np.clip(np.ceil(edges / step), 1, 64).astype(int)
    points, outward = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for count in np.unique(parts):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        inside = i + j <= count
        weights = np.stack([i, j, count - i - j], axis=-1)[inside] / count
        rows = np.einsum("wk,tkx->twx", weights, corners[parts == count])
        points.append(rows.reshape(-1, 3))
        outward.append(np.repeat(normals[parts == count], len(weights), axis=0))
    points, outward = np.concatenate(points), np.concatenate(outward)
    if isinstance(shape, Union):  # what is inside another part touches nothing
        bare = _distances(shape, points, step, 3) > -0.25 * step
        points, outward = points[bare], outward[bare]
    chosen = _thinned(points, outward, 0.5 * step)
    return points[chosen], outward[chosen]


def _thinned(points, normals, cell):
    """Rows of one point per cell and direction, the first of each.

    Those that are outermost in 26 directions stay, too.
    """
    if len(points) == 0:
        return np.zeros(0, int)
    places = np.floor(points / cell + 0.5).astype(np.int64)
    ways = np.floor(1.5 * normals + 0.5).astype(np.int64)
    _, first = np.unique(np.concatenate([places, ways], axis=1), axis=0, return_index=True)
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return np.unique(np.concatenate([first, np.argmax(points @ grid.T, axis=0)]))


def _outline_points(shape, lower, upper, step):
    """Points on the outline of the cut with y = 0."""
    from skimage.measure import find_contours  # slow to import, and rarely needed

    cell = float((upper - lower)[[0, 2]].max()) / _OUTLINE_SAMPLES
    origin = lower - 2.0 * cell
    counts = np.ceil((upper - lower) / cell).astype(int) + 5
    x, z = (origin[axis] + cell * np.arange(counts[axis]) for axis in (0, 2))
    points = np.stack(np.meshgrid(x, [0.0], z, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = _distances(shape, points, cell, 2).reshape(len(x), len(z))
    lines = [np.zeros((0, 2)), *find_contours(distance, 0.0)]
    place = np.concatenate(lines) * cell
    flat = [origin[0] + place[:, 0], np.zeros(len(place)), origin[2] + place[:, 1]]
    outline = np.stack(flat, axis=1)
    normals = np.zeros_like(outline)
    for axis in (0, 2):
        shift = 0.5 * cell * np.eye(3)[axis]
        normals[:, axis] = _distances(shape, outline + shift, cell, 2)
        normals[:, axis] -= _distances(shape, outline - shift, cell, 2)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    chosen = _thinned(outline, normals, 0.5 * step)
    return outline[chosen], normals[chosen]


def _distances(shape, points, cell, dimension):
    """Signed distances of points [m]; only these are wanted, `cell` stands in for the spacing."""
    packed = pack_shapes([shape], 2.0 * cell, cell, dimension)
    distance = np.empty(len(points), np.float32)
    signed_distances(packed, 0, np.ascontiguousarray(points, np.float32), distance)
    return distance
