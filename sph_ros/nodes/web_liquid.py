# SPDX-License-Identifier: Apache-2.0
"""The liquid in the browser: particles and surface. No rclpy."""

from dataclasses import dataclass

import numpy as np

from sph_ros.nodes.web_colors import ParticleColors, as_bytes

#: The water's colour and opacity. Both sides are drawn, so that the far side shows through the near
#: one, and a deep liquid looks darker than a thin one.
WATER, WATER_OPACITY = as_bytes((0.16, 0.47, 0.78)), 0.6

#: Diameter of a drawn particle over the distance of particles, beside the user's factor.
POINT_SHARE = 0.9

#: Half floats resolve this share of the distance from the middle.
HALF_FLOAT = 2.0**-11

#: Half floats are used where their steps are below this share of the distance of particles.
FINE_ENOUGH = 0.05


@dataclass
class ViewOptions:
    """What somebody wants to see; changed by the panel, read with every picture.

    Attributes:
        surface, particles, frames, grid: whether they are drawn.
        coloring: of the particles, one of COLORINGS.
        particle_size: diameter over the distance of particles.
    """

    surface: bool = True
    particles: bool = False
    frames: bool = False
    grid: bool = True
    coloring: str = "speed"
    particle_size: float = 1.0


class WebLiquid:
    """The liquid in the browser.

    Args:
        server: a ViserServer.
        options: ViewOptions.

    Attributes:
        colors: ParticleColors.
        bounds: corners of the liquid when it was first drawn, (2, 3) [m]; None before.
    """

    def __init__(self, server, options):
        self._server, self._options = server, options
        self.colors = ParticleColors()
        self._cloud = self._mesh = None
        self.forget()

    def forget(self):
        """Another scene comes: take away what is drawn."""
        for handle in (self._cloud, self._mesh):
            if handle is not None:
                handle.remove()
        self._cloud = self._mesh = None
        self.bounds = None

    def hide_unwanted(self):
        """Hide what the options say shall not be seen."""
        if not self._options.particles:
            _hide(self._cloud)
        if not self._options.surface:
            _hide(self._mesh)

    def show_particles(self, positions, velocities, densities):
        """Draw particles: positions [m], velocities [m/s], (N, 3), densities [kg/m^3], (N,)."""
        if len(positions) == 0:
            _hide(self._cloud)
            return
        positions = np.ascontiguousarray(positions, np.float32)
        self._note_bounds(positions)
        colors = self.colors.of(self._options.coloring, velocities, densities)
        if self._cloud is None:
            self._add_cloud(positions, colors)
        size = POINT_SHARE * self._spacing * self._options.particle_size
        with self._server.atomic():
            self._cloud.points, self._cloud.colors = positions - self._middle, colors
            self._cloud.point_size, self._cloud.visible = size, True

    def show_surface(self, vertices, triangles):
        """Draw the liquid's surface: vertices [m], (V, 3), triangles (T, 3)."""
        if len(triangles) == 0:
            _hide(self._mesh)
            return
        vertices = np.ascontiguousarray(vertices, np.float32)
        triangles = np.ascontiguousarray(triangles, np.uint32)
        self._note_bounds(vertices)
        if self._mesh is None:
            self._mesh = self._server.scene.add_mesh_simple(
                "/surface",
                vertices,
                triangles,
                color=WATER,
                opacity=WATER_OPACITY,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        with self._server.atomic():
            self._mesh.vertices, self._mesh.faces, self._mesh.visible = vertices, triangles, True

    def _add_cloud(self, positions, colors):
        """The points are sent as half floats about their middle where that is fine enough."""
        self._spacing = _spacing(positions)
        self._middle = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
        reach = float(np.abs(positions - self._middle).max())
        fine = reach * HALF_FLOAT < FINE_ENOUGH * self._spacing
        self._cloud = self._server.scene.add_point_cloud(
            "/particles",
            positions - self._middle,
            colors,
            point_size=self._spacing,
            point_shape="circle",
            precision="float16" if fine else "float32",
            position=self._middle,
        )

    def _note_bounds(self, points):
        if self.bounds is None:
            self.bounds = np.array([points.min(axis=0), points.max(axis=0)], float)


def _hide(handle):
    if handle is not None and handle.visible:
        handle.visible = False


def _spacing(positions):
    """Usual distance between particles [m]: median distance of some to their nearest neighbours."""
    some = positions[:: max(1, len(positions) // 20)]
    square = ((some[:, None] - positions[None]) ** 2).sum(axis=2)
    square[square == 0.0] = np.inf
    nearest = np.sqrt(square.min(axis=1))
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if len(nearest) else 0.01
