# SPDX-License-Identifier: Apache-2.0
"""Mass, centre of mass and inertia of shapes filled evenly.

Exact for primitives and meshes; of unions and differences, and of cuts that are neither round nor a
box in 2D, from their sampled distance to about half a per cent. In 2D a body is its cut with the
plane y = 0, and masses are per metre of depth.
"""

import math
from dataclasses import dataclass

import numpy as np

from sph_ros.core.distances import signed_distances
from sph_ros.sim.meshes import load_surface
from sph_ros.sim.packing import pack_shapes
from sph_ros.sim.shape_geometry import extent
from sph_ros.sim.shape_types import (
    Box,
    Capsule,
    Container,
    Cylinder,
    Mesh,
    Plane,
    Shape,
    Sphere,
)

# Samples along the longest side of a shape whose moments are taken from its distance.
_SAMPLES = {3: 64, 2: 512}


@dataclass(frozen=True)
class MassProperties:
    """How a rigid body resists being moved.

    Attributes:
        mass: [kg], in 2D per metre of depth [kg/m].
        centre: of mass, solid's frame [m], (3,).
        inertia: about the centre of mass, solid's axes [kg m^2], (3, 3); in 2D all but [1, 1] is
            meaningless [kg m].
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


def mass_properties(shape: Shape, dimension: int, density=None, mass=None) -> MassProperties:
    """Mass properties of a shape filled evenly.

    Args:
        shape: of finite volume.
        dimension: 3 or 2.
        density: [kg/m^3]; or
        mass: of the whole [kg], in 2D per metre of depth.

    Raises:
        ValueError: the shape is endless or has no volume.
    """
    volume, centre, second = _moments(shape, dimension)
    if not (math.isfinite(volume) and volume > 0.0):
        kind = type(shape).__name__.lower()
        raise ValueError(
            f"{kind}: a free solid needs a finite volume, got {volume:g} m^{dimension}"
        )
    scale = density if mass is None else mass / volume
    inertia = np.trace(second) * np.eye(3) - second
    return MassProperties(scale * volume, centre, scale * inertia)


def _moments(shape: Shape, dimension: int):
    """Volume (2D: area), centre (3,), second moments about it: the integral of x x^T, (3, 3)."""
    if isinstance(shape, Plane | Container):
        return math.inf, np.zeros(3), np.zeros((3, 3))
    if dimension == 2:
        return _moments_of_cut(shape)
    if isinstance(shape, Sphere):
        volume = 4.0 / 3.0 * math.pi * shape.radius**3
        return volume, np.zeros(3), volume * shape.radius**2 / 5.0 * np.eye(3)
    if isinstance(shape, Box):
        size = np.array(shape.size)
        volume = math.prod(shape.size)
        return volume, _middle(shape), volume / 12.0 * np.diag(size**2)
    if isinstance(shape, Cylinder):
        volume = math.pi * shape.radius**2 * shape.length
        across, along = shape.radius**2 / 4.0, shape.length**2 / 12.0
        return volume, np.zeros(3), volume * np.diag([across, across, along])
    if isinstance(shape, Capsule):
        return _moments_of_capsule(shape.radius, shape.length)
    if isinstance(shape, Mesh):
        surface = load_surface(shape.file, shape.scale)
        return moments_of_triangles(surface.vertices[surface.triangles])
    return _sampled_moments(shape, 3)


def _middle(box: Box):
    return 0.5 * (np.array(box.min) + np.array(box.max))


def _moments_of_capsule(radius, length):
    """A cylinder and two half balls, whose centres lie 3/8 of the radius beyond its ends."""
    side = math.pi * radius**2 * length
    ends = 4.0 / 3.0 * math.pi * radius**3
    across = side * radius**2 / 4.0 + ends * radius**2 / 5.0
    own = radius**2 / 5.0 - (3.0 / 8.0 * radius) ** 2
    along = side * length**2 / 12.0 + ends * (own + (0.5 * length + 3.0 / 8.0 * radius) ** 2)
    return side + ends, np.zeros(3), np.diag([across, across, along])


def moments_of_triangles(corners):
    """Volume, centre and second moments of what closed triangles (T, 3, 3) enclose.

    Sum over the tetrahedra of each triangle with a point amid them (divergence theorem): for
    corners a, b, c with sum s the integral of x x^T is det/120 (ss^T + aa^T + bb^T + cc^T).
    """
    origin = corners.reshape(-1, 3).mean(axis=0)
    corners = corners - origin
    det = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = corners.sum(axis=1)
    volume = float(det.sum()) / 6.0
    if not volume > 0.0:
        return 0.0, origin, np.zeros((3, 3))
    centre = np.einsum("t,ti->i", det, total) / 24.0 / volume
    second = np.einsum("t,ti,tj->ij", det, total, total)
    second += np.einsum("t,tki,tkj->ij", det, corners, corners)
    return volume, centre + origin, second / 120.0 - volume * np.outer(centre, centre)


def _moments_of_cut(shape: Shape):
    """Area, centre and second moments of the cut with y = 0."""
    if isinstance(shape, Sphere):
        area = math.pi * shape.radius**2
        return area, np.zeros(3), area * shape.radius**2 / 4.0 * np.diag([1.0, 0.0, 1.0])
    if isinstance(shape, Box):
        size = np.array(shape.size) * [1.0, 0.0, 1.0]
        area = size[0] * size[2]
        return area, _middle(shape) * [1.0, 0.0, 1.0], area / 12.0 * np.diag(size**2)
    return _sampled_moments(shape, 2)


def _sampled_moments(shape: Shape, dimension: int):
    """Moments from the signed distance on a grid; cells at the surface count in part."""
    lower, upper = extent(shape)
    if not np.isfinite(upper - lower).all():
        return math.inf, np.zeros(3), np.zeros((3, 3))
    axes_used = (0, 1, 2) if dimension == 3 else (0, 2)
    cell = float((upper - lower)[list(axes_used)].max()) / _SAMPLES[dimension]
    axes = [np.zeros(1)] * 3
    for axis in axes_used:
        count = math.ceil((upper - lower)[axis] / cell) + 2
        middle = 0.5 * (lower[axis] + upper[axis])
        axes[axis] = middle + cell * (np.arange(count) - 0.5 * (count - 1))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.empty(len(points), np.float32)
    # Only the distance is wanted; the cell stands in for the particles' spacing.
    packed = pack_shapes([shape], 2.0 * cell, cell, dimension)
    signed_distances(packed, 0, np.ascontiguousarray(points, np.float32), distance)
    weight = np.clip(0.5 - distance.astype(np.float64) / cell, 0.0, 1.0) * cell**dimension
    volume = float(weight.sum())
    if volume == 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    centre = np.einsum("n,ni->i", weight, points) / volume
    points = points - centre
    return volume, centre, np.einsum("n,ni,nj->ij", weight, points, points)
