# SPDX-License-Identifier: Apache-2.0
"""The picture in the browser: liquid, solids, axes and grid, and where one looks from. No rclpy.

viser sends only the newest value of everything to a browser that cannot keep up, so frames are
dropped, never queued.
"""

import math

import numpy as np

from sph_ros.nodes.web_liquid import ViewOptions, WebLiquid
from sph_ros.nodes.web_solids import AXES_THICKNESS, ORIGIN_RADIUS, WebSolids

#: Solids larger than the liquid by this factor are surroundings and need not be seen as a whole.
SURROUNDINGS = 12.0

#: Direction from which a new browser looks, and its distance over the size of the scene.
VIEW_FROM, VIEW_DISTANCE = np.array([0.55, -0.85, 0.45]), 0.95

#: Cells of the grid along the size of the scene, roughly, and side of the grid in cells.
CELLS_ACROSS, GRID_CELLS = 6, 20

#: Cells between thick lines of the grid.
SECTION = 5


class WebScene:
    """The scene in the browser.

    Args:
        server: a ViserServer.
        on_drag: called with (solid, position, quat_xyzw) while somebody drags it, in a thread of
            the server.

    Attributes:
        options: ViewOptions, for a panel to change.
        liquid: WebLiquid.
        solids: WebSolids.
    """

    def __init__(self, server, on_drag):
        self._server = server
        self.options = ViewOptions()
        self.liquid = WebLiquid(server, self.options)
        self.solids = WebSolids(server, self.options, on_drag)
        self._grid = self._label = None
        self._framed, self._bounds, self._frame = set(), None, "world"
        self._liquid_measured = False
        server.scene.set_up_direction("+z")
        self._light()
        server.scene.world_axes.visible = True

    @property
    def watched(self):
        """Whether any browser looks."""
        return bool(self._server.get_clients())

    @property
    def browsers(self):
        """How many browsers look."""
        return len(self._server.get_clients())

    def show_solids(self, markers, controlled, frame):
        """Draw these solids and no others.

        Args:
            markers: decoded triangle markers, one per solid.
            controlled: names of the solids that can be dragged.
            frame: of the markers.
        """
        if self.solids.show(markers, controlled) or frame != self._frame:
            self._frame, self._bounds = frame, None

    def refresh(self):
        """Follow the options, and let every new browser look at the scene."""
        self.liquid.hide_unwanted()
        axes = self._server.scene.world_axes
        for handle, wanted in (
            (self._grid, self.options.grid),
            (axes, True),
            (self._label, self.options.frames),
        ):
            if handle is not None and handle.visible != wanted:
                handle.visible = wanted
        if self._bounds is None or (self.liquid.bounds is not None and not self._liquid_measured):
            self._measure()
        self._frame_cameras()

    def forget(self):
        """Another scene comes: draw nothing until it does."""
        self.liquid.forget()
        self.solids.forget()
        self._bounds = None

    def look_at_all(self):
        """Let all browsers look at the scene as they did at first."""
        self._framed.clear()

    def _light(self):
        """Light from all sides, more of it from above.

        Shadow maps would be drawn anew with every picture of the liquid, and a browser without a
        graphics card takes ten seconds to prepare viser's surroundings as a light.
        """
        scene = self._server.scene
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere(
            "/light", sky_color=(255, 255, 255), ground_color=(140, 156, 184), intensity=2.6
        )

    def _measure(self):
        """Find out how large the scene is, and lay grid and axes out for it."""
        bounds = list(self.solids.bounds)
        if self.liquid.bounds is not None:
            size = _size(self.liquid.bounds)
            bounds = [b for b in bounds if _size(b) < SURROUNDINGS * size]
            bounds.append(self.liquid.bounds)
        if not bounds:
            return
        self._liquid_measured = self.liquid.bounds is not None
        bounds = np.array(bounds)
        bounds = np.array([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
        if self._bounds is not None and np.allclose(bounds, self._bounds, atol=0.1 * _size(bounds)):
            return  # the liquid is where its solids are
        self._bounds = bounds
        self._framed.clear()
        position, middle = self._view()
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(position), tuple(middle)
        self._lay_out()

    def _lay_out(self):
        cell = _round_length(_size(self._bounds) / CELLS_ACROSS)
        middle = np.round(self._bounds.mean(axis=0) / cell) * cell
        if self._grid is not None:
            self._grid.remove()
        self._grid = self._server.scene.add_grid(
            "/grid",
            GRID_CELLS * cell,
            GRID_CELLS * cell,
            cell_size=cell,
            section_size=SECTION * cell,
            cell_thickness=0.5,
            cell_color=(205, 209, 214),
            section_color=(165, 171, 179),
            position=(middle[0], middle[1], self._bounds[0, 2] - 0.01 * cell),
        )
        axes = self._server.scene.world_axes
        axes.axes_length, axes.axes_radius = cell, AXES_THICKNESS * cell
        axes.origin_radius = ORIGIN_RADIUS * cell
        self.solids.axes_length = cell
        if self._label is not None:
            self._label.remove()
        self._label = self._server.scene.add_label("/frame", self._frame, visible=False)

    def _view(self):
        middle = self._bounds.mean(axis=0)
        away = VIEW_DISTANCE * max(_size(self._bounds), 1e-2)
        return middle + away * VIEW_FROM, middle

    def _frame_cameras(self):
        """Let every browser that has not done so yet look at the scene."""
        clients = self._server.get_clients()
        self._framed &= set(clients)
        if self._bounds is None:
            return
        position, middle = self._view()
        for number, client in clients.items():
            if number not in self._framed:
                self._framed.add(number)
                client.camera.position, client.camera.look_at = tuple(position), tuple(middle)


def _size(bounds):
    return float(np.linalg.norm(bounds[1] - bounds[0]))


def _round_length(length):
    """1, 2 or 5 times a power of ten, near `length`."""
    power = 10.0 ** math.floor(math.log10(max(length, 1e-6)))
    return min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(math.log(m * power / length))) * power
