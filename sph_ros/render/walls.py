# SPDX-License-Identifier: Apache-2.0
"""The glass the liquid stands at: planes of the containers in a picture.

The surface of a liquid at a wall is round at its edges and half a spacing from the glass. In a
picture it must lie flat on the glass, so it is extracted once more with the walls known.
"""

import numpy as np

from sph_ros.core.surface import extract_surface

#: With more planes there would be too many mirror images.
MOST_PLANES = 24


def surface_at_walls(frame):
    """The frame's surface, remade from the particles to lie flat on box-like containers.

    Returns:
        (vertices (V, 3), triangles (T, 3), normals (V, 3)); the frame's own if it has no surface,
        no particles or no such container.
    """
    walls = [plane for solid in frame.solids if solid.container for plane in convex_planes(solid)]
    if frame.surface is None or not len(frame.positions) or not 0 < len(walls) <= MOST_PLANES:
        return frame.surface
    return extract_surface(frame.positions, frame.spacing, dimension=frame.dimension, walls=walls)


def convex_planes(solid) -> np.ndarray:
    """Outward normal and offset [m] of a convex solid's faces, (P, 4); (0, 4) if not convex."""
    points = solid.world_vertices()
    corners = points[np.asarray(solid.triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    whole = length > 1e-12
    normals = normals[whole] / length[whole, None]
    offsets = np.einsum("ij,ij->i", normals, corners[whole, 0])
    planes = np.column_stack([normals, offsets])
    _, first = np.unique(planes.round(5), axis=0, return_index=True)
    slack = 1e-4 * max(np.ptp(points, axis=0).max(), 1e-9)
    if (points @ normals[first].T > offsets[first] + slack).any():
        return np.zeros((0, 4))
    return planes[first]
