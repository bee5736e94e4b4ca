# SPDX-License-Identifier: Apache-2.0
"""Surfaces to draw, volumes and sizes of shapes."""

import math
from functools import lru_cache

import numpy as np

from sph_ros.core.distances import signed_distances
from sph_ros.sim.meshes import load_surface
from sph_ros.sim.packing import pack_shapes
from sph_ros.sim.quaternions import to_matrix
from sph_ros.sim.shape_types import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Mesh,
    OpenSurface,
    Placed,
    Plane,
    Pose,
    Shape,
    Sphere,
    Union,
)
from sph_ros.sim.sheets import load_sheet

#: Edge of the square that is drawn for a plane [m].
PLANE_SIZE = 2.0

_SIDES = 48
# Samples along the longest side of a shape whose volume or surface is taken from its distance.
_VOLUME_SAMPLES = 72
_SURFACE_SAMPLES = 44


def bounding_radius(shape: Shape) -> float:
    """Radius [m] of a ball about the shape's origin that holds it; infinite for a plane.

    For a container this is the size of the inner shape.
    """
    lower, upper = extent(shape)
    if isinstance(shape, Sphere):
        return shape.radius
    if isinstance(shape, Capsule):
        return shape.radius + 0.5 * shape.length
    if isinstance(shape, Cylinder):
        return math.hypot(shape.radius, 0.5 * shape.length)
    if isinstance(shape, Mesh | OpenSurface):
        vertices, _ = _triangles(shape)
        return float(np.linalg.norm(vertices, axis=1).max())
    if isinstance(shape, Union):
        return max(_placed_radius(part) for part in shape.of)
    if isinstance(shape, Difference):
        return _placed_radius(shape.of[0])
    if isinstance(shape, Container):
        return bounding_radius(shape.shape)
    return float(np.linalg.norm(np.maximum(np.abs(lower), np.abs(upper))))


def _triangles(shape: Mesh | OpenSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and triangles (T, 3) of a file."""
    if isinstance(shape, OpenSurface):
        return load_sheet(shape)
    surface = load_surface(shape.file, shape.scale)
    return surface.vertices, surface.triangles


def _placed_radius(part: Placed) -> float:
    return float(np.linalg.norm(part.pose.position)) + bounding_radius(part.shape)


def extent(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box along the axes that holds the shape [m]."""
    if isinstance(shape, Box):
        return np.array(shape.min), np.array(shape.max)
    if isinstance(shape, Sphere):
        half = np.full(3, shape.radius)
    elif isinstance(shape, Capsule):
        half = np.array([shape.radius, shape.radius, shape.radius + 0.5 * shape.length])
    elif isinstance(shape, Cylinder):
        half = np.array([shape.radius, shape.radius, 0.5 * shape.length])
    elif isinstance(shape, Plane):
        half = np.full(3, math.inf)
    elif isinstance(shape, Mesh | OpenSurface):
        vertices, _ = _triangles(shape)
        return vertices.min(axis=0), vertices.max(axis=0)
    elif isinstance(shape, Container):
        return extent(shape.shape)
    else:
        parts = shape.of if isinstance(shape, Union) else shape.of[:1]
        extents = [placed_extent(part.shape, part.pose) for part in parts]
        return (
            np.min([corners[0] for corners in extents], axis=0),
            np.max([corners[1] for corners in extents], axis=0),
        )
    return -half, half


def placed_extent(shape: Shape, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box along the parent's axes that holds a placed shape [m].

    Infinite for planes; for a container that of the inner shape.
    """
    lower, upper = extent(shape)
    if not np.isfinite(upper - lower).all():
        return np.full(3, -math.inf), np.full(3, math.inf)
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, -1).T
    corners = corners @ to_matrix(pose.quat_xyzw).T + pose.position
    return corners.min(axis=0), corners.max(axis=0)


def volume(shape: Shape) -> float:
    """Volume of the material [m^3]; infinite for planes and containers, 0 for open surfaces.

    Exact for primitives; a mesh's bodies are added up; of unions and differences to about 1 %, from
    their sampled distance.
    """
    if isinstance(shape, Sphere):
        return 4.0 / 3.0 * math.pi * shape.radius**3
    if isinstance(shape, Box):
        return math.prod(shape.size)
    if isinstance(shape, Cylinder):
        return math.pi * shape.radius**2 * shape.length
    if isinstance(shape, Capsule):
        ends = 4.0 / 3.0 * math.pi * shape.radius**3
        return ends + math.pi * shape.radius**2 * shape.length
    if isinstance(shape, Plane | Container):
        return math.inf
    if isinstance(shape, OpenSurface):
        return 0.0
    lower, upper = extent(shape)
    if not np.isfinite(upper - lower).all():
        return math.inf
    if isinstance(shape, Mesh):
        surface = load_surface(shape.file, shape.scale)
        return _enclosed(surface.vertices, surface.triangles)
    distance, _, cell = _sampled(shape, _VOLUME_SAMPLES)
    return float(np.clip(0.5 - distance / cell, 0.0, 1.0).sum(dtype=np.float64)) * cell**3


@lru_cache(maxsize=32)
def _sampled(shape: Shape, samples: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Signed distance of a bounded shape around its material: (samples, origin (3,), cell) [m]."""
    lower, upper = extent(shape)
    cell = float((upper - lower).max()) / samples
    origin = lower - 1.5 * cell
    counts = np.ceil((upper - lower) / cell).astype(int) + 4
    axes = [origin[axis] + cell * np.arange(counts[axis]) for axis in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.empty(len(points), dtype=np.float32)
    # Only the distance is wanted; the cell stands in for the particles' spacing.
    packed = pack_shapes([shape], 2.0 * cell, cell, 3)
    signed_distances(packed, 0, np.ascontiguousarray(points, dtype=np.float32), distance)
    return distance.reshape(tuple(counts)), origin, cell


@lru_cache(maxsize=64)
def display_mesh(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """A surface to draw, wound outward: (vertices (V, 3) float32 [m], triangles (T, 3) int32).

    Of a container it is the inner shape's surface, of a plane a square about the foot of its
    normal; the parts of a union overlap. The arrays are shared and cannot be written.
    """
    vertices, triangles = _surface(shape)
    vertices = np.ascontiguousarray(vertices, dtype=np.float32)
    triangles = np.ascontiguousarray(triangles, dtype=np.int32)
    vertices.setflags(write=False)
    triangles.setflags(write=False)
    return vertices, triangles


def _surface(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    import trimesh  # slow to import, and a simulation without pictures does without

    if isinstance(shape, Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)
    elif isinstance(shape, Box):
        mesh = trimesh.creation.box(bounds=(shape.min, shape.max))
    elif isinstance(shape, Cylinder):
        mesh = trimesh.creation.cylinder(shape.radius, height=shape.length, sections=_SIDES)
    elif isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(shape.length, shape.radius, count=(_SIDES, _SIDES // 2))
        mesh.vertices -= 0.5 * (mesh.bounds[0] + mesh.bounds[1])
    elif isinstance(shape, Plane):
        return _square(shape)
    elif isinstance(shape, Mesh | OpenSurface):
        return _triangles(shape)
    elif isinstance(shape, Container):
        return display_mesh(shape.shape)
    elif isinstance(shape, Union):
        return _concatenated([_placed_surface(part) for part in shape.of])
    else:
        return _extracted(shape)
    return mesh.vertices, mesh.faces


def _square(plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    normal = np.array(plane.normal)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(normal)))], normal)
    x *= 0.5 * PLANE_SIZE / np.linalg.norm(x)
    y = np.cross(normal, x)
    vertices = plane.offset * normal + np.stack([-x - y, x - y, x + y, y - x])
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


def _placed_surface(part: Placed) -> tuple[np.ndarray, np.ndarray]:
    vertices, triangles = display_mesh(part.shape)
    return vertices @ to_matrix(part.pose.quat_xyzw).T + part.pose.position, triangles


def _concatenated(surfaces) -> tuple[np.ndarray, np.ndarray]:
    first = np.cumsum([0] + [len(vertices) for vertices, _ in surfaces])
    triangles = [t + start for (_, t), start in zip(surfaces, first[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(triangles)


def _extracted(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """The zero surface of the sampled distance; empty when nothing is left of a difference."""
    from skimage.measure import marching_cubes

    if not np.isfinite(np.concatenate(extent(shape))).all():
        raise ValueError(f"{type(shape).__name__.lower()}: cannot draw a shape without end")
    distance, origin, cell = _sampled(shape, _SURFACE_SAMPLES)
    if not distance.min() < 0.0 < distance.max():
        return np.empty((0, 3)), np.empty((0, 3), dtype=int)
    vertices, triangles, _, _ = marching_cubes(distance, 0.0, spacing=(cell,) * 3)
    inward = _enclosed(vertices, triangles) < 0.0
    return vertices + origin, triangles[:, ::-1] if inward else triangles


def _enclosed(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Volume inside a closed surface, negative if it is wound inward (divergence theorem)."""
    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
