# SPDX-License-Identifier: Apache-2.0
"""A simulation as markers, the same on topics and in bags: the liquid's surface and the solids."""

import numpy as np
from scipy.spatial import cKDTree

from msg_adapters.marker import triangle_marker
from sph_ros.colors import LIQUID, liquid_color, shaded_liquid, solid_colors


def surface_color(liquids, vertices, positions, families):
    """Color of a surface: red, green, blue, alpha, or where liquids meet red, green, blue (V, 3).

    Args:
        liquids: materials of the scene's liquids.
        vertices: of the surface [m], (V, 3); each has the colour of the nearest particle.
        positions: of the particles [m], (N, 3).
        families: index into `liquids` of each particle, (N,).
    """
    if len(liquids) == 1 or not len(vertices):
        return liquid_color(liquids[0])
    table = np.array([liquid_color(material)[:3] for material in liquids])
    return table[families[cKDTree(positions).query(vertices)[1]]]


def surface_marker(vertices, triangles, normals, stamp_ns, frame_id, color=LIQUID):
    """The liquid's surface; a marker that deletes it where there are no triangles.

    A marker has no normals, and RViz shades every triangle by its own: each would show. So every
    vertex gets its shade as a colour, which switches RViz's light off. The surface is opaque,
    because RViz draws transparent triangles in the order of the message, far ones over near ones.

    Args:
        vertices: [m], (V, 3).
        triangles: (T, 3).
        normals: of the vertices, unit and outward, (V, 3).
        stamp_ns: [ns].
        frame_id: of the vertices.
        color: red, green, blue, alpha, or those of each vertex without alpha, (V, 3).
    """
    several = np.ndim(color) == 2
    return triangle_marker(
        vertices,
        triangles,
        stamp_ns,
        frame_id,
        namespace="surface",
        color=LIQUID[:3] if several else color[:3],
        vertex_colors=shaded_liquid(normals, color if several else color[:3]),
    )


class SolidMarkers:
    """Markers of a simulation's visible solids; triangles are looked up once, poses every time."""

    def __init__(self, sim):
        colors, frame = solid_colors(sim.scene), sim.scene.frame
        self._drawn = []
        for index, spec in enumerate(sim.scene.solids):
            if spec.visible:
                solid = sim.solid(spec.name)
                marker = triangle_marker(
                    *solid.mesh(),
                    0,
                    frame,
                    namespace=spec.name,
                    marker_id=index,
                    color=colors[spec.name],
                )
                self._drawn.append((solid, marker))

    def at(self, stamp_ns):
        """The solids where they are now, with a stamp [ns]: a list of markers."""
        return [_placed(solid, marker, stamp_ns) for solid, marker in self._drawn]


def _placed(solid, marker, stamp_ns):
    # Not dataclasses.replace: it takes longer than all the rest.
    fields = {
        **vars(marker),
        "stamp_ns": stamp_ns,
        "position": tuple(solid.position),
        "quat_xyzw": tuple(solid.quat_xyzw),
    }
    return type(marker)(**fields)
