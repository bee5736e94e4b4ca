# SPDX-License-Identifier: Apache-2.0
"""Liquid pressed to the glass: where a surface lies along a container's wall it becomes the wall.

Particles at a wall leave bumps of some per cent of the spacing, and round edges; behind glass they
would show as hammered metal. Only for pictures: the mesh that is published stays as it is.
"""

import numpy as np

#: Distance from the wall up to which liquid touches it, and from which on it does not [spacings].
TOUCHING, FREE = 0.7, 1.4


def press_to_walls(surface, solids, spacing):
    """Surface whose parts along walls of convex containers lie on these, with their normals.

    Args:
        surface: (vertices (V, 3), triangles (T, 3), normals (V, 3)), or None.
        solids: SolidView sequence; those that are convex containers count.
        spacing: particle spacing [m].

    Returns:
        The same triple with new vertices and normals.
    """
    if surface is None or not len(surface[0]):
        return surface
    vertices, triangles, normals = (np.array(part) for part in surface)
    for solid in solids:
        if solid.container:
            for normal, offset in _convex_planes(solid):
                _press(vertices, normals, normal, offset, spacing)
    return vertices, triangles, normals


def _press(vertices, normals, wall_normal, offset, spacing):
    """Move what faces one wall and is near it onto the wall; vertices and normals are written."""
    wall_normal = wall_normal.astype(np.float32)
    gap = (np.float32(offset) - vertices @ wall_normal) / np.float32(spacing)
    facing = normals @ wall_normal
    near = np.clip((FREE - gap) / (FREE - TOUCHING), 0.0, 1.0)
    share = near * np.clip((facing - 0.25) / 0.4, 0.0, 1.0)
    touched = np.flatnonzero(near > 0.0)
    share, gap = share[touched, None], gap[touched, None]
    vertices[touched] += np.maximum(share, gap < 0.0) * (gap - 0.02) * spacing * wall_normal
    mixed = normals[touched] * (1.0 - share) + wall_normal * share
    normals[touched] = mixed / np.maximum(np.linalg.norm(mixed, axis=1), 1e-6)[:, None]


def _convex_planes(solid):
    """Distinct (outward normal, offset) of a convex solid's faces; none if not convex."""
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
        return []
    return list(zip(normals[first], offsets[first], strict=True))
