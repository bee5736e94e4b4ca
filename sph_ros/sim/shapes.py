# SPDX-License-Identifier: Apache-2.0
"""Shapes and everything one asks of them: the one module to import from."""

from sph_ros.sim.meshes import MeshError
from sph_ros.sim.packing import pack_shapes
from sph_ros.sim.shape_geometry import bounding_radius, display_mesh, placed_extent, volume
from sph_ros.sim.shape_types import (
    SHAPES,
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

__all__ = [
    "SHAPES",
    "Box",
    "Capsule",
    "Container",
    "Cylinder",
    "Difference",
    "Mesh",
    "MeshError",
    "OpenSurface",
    "Placed",
    "Plane",
    "Pose",
    "Shape",
    "Sphere",
    "Union",
    "bounding_radius",
    "display_mesh",
    "pack_shapes",
    "placed_extent",
    "volume",
]
