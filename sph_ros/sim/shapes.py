# SPDX-License-Identifier: Apache-2.0
"""Shapes and everything one asks of them: the one module to import from."""

from sph_ros.sim.shape_types import (
    SHAPES,
    Box,
    Capsule,
    Container,
    Cylinder,
    Difference,
    Mesh,
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
    "Placed",
    "Plane",
    "Pose",
    "Shape",
    "Sphere",
    "Union",
]
