# SPDX-License-Identifier: Apache-2.0
"""shape_msgs/Mesh, in and out: indexed triangles."""

from __future__ import annotations

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.checks import rows

MESH = "shape_msgs/msg/Mesh"


def mesh_to_cdr(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    """Triangles as a ready shape_msgs/Mesh.

    Args:
        vertices: (V, 3) float32 or float64 [m].
        triangles: (T, 3) int32, int64 or uint32, indices into ``vertices``.

    Raises:
        ValueError: Wrong shape or dtype, or an index without its vertex.
    """
    check_triangles(vertices, triangles)
    writer = CdrWriter()
    writer.array(triangles.astype("<u4", copy=False), count=len(triangles))
    writer.array(vertices.astype("<f8", copy=False), count=len(vertices))
    return writer.finish()


def cdr_to_mesh(buffer: bytes) -> tuple[np.ndarray, np.ndarray]:
    """A shape_msgs/Mesh from its bytes.

    Returns:
        ``(vertices, triangles)``: (V, 3) float64 [m], (T, 3) int32; read-only views of the buffer.

    Raises:
        ValueError: The bytes are not a mesh, or an index has no vertex.
    """
    reader = CdrReader(buffer, MESH)
    triangles = reader.array(np.uint32, reader.count(), columns=3)
    vertices = reader.array(np.float64, reader.count(), columns=3)
    reader.end()
    if triangles.size and triangles.max() >= len(vertices):
        raise reader.fail(f"index {triangles.max()} in a mesh of {len(vertices)} vertices")
    # Indices below the vertex count also fit the signed type that the rest of the package uses.
    return vertices, triangles.view(np.int32)


def check_triangles(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """ValueError unless these are vertices and triangles with indices that have their vertex."""
    rows(vertices, "vertices", 3, np.float32, np.float64)
    rows(triangles, "triangles", 3, np.int32, np.int64, np.uint32)
    if triangles.size:
        lowest, highest = int(triangles.min()), int(triangles.max())
        if lowest < 0 or highest >= len(vertices):
            raise ValueError(
                f"triangles has indices {lowest} to {highest}, expected 0 to {len(vertices) - 1}"
            )
