# SPDX-License-Identifier: Apache-2.0
"""The picture in the browser: particles, surface, solids and a panel, drawn by viser. No rclpy.

viser sends only the newest value of everything to a browser that cannot keep up, so frames are
dropped, never queued.
"""

import errno
import socket

import numpy as np
import trimesh
import viser

from sph_ros.colors import LIQUID, speed_colors

#: Speed with the lightest colour [m/s]; a fall of 10 cm.
FAST = 1.4

#: Edges where faces meet at a larger angle [rad] are drawn as lines.
EDGE_ANGLE = 0.5

#: Solids less opaque than this [-] are containers: their edges are drawn.
TRANSPARENT = 0.5

#: Size of a drawn particle over the distance of particles.
POINT_SHARE = 0.4

#: Side of a gizmo over the extent of its solid.
GIZMO_SCALE = 0.9


class ViewerError(ValueError):
    """The viewer cannot start; one line that says why."""


def start_server(host, port):
    """A ViserServer at an address.

    Raises:
        ViewerError: the port is taken, or the host is not an address of this machine.
    """
    # Asked first, because viser would silently take another port.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                text = f"port {port} is taken by another program; choose another with --port"
            else:
                text = f"cannot listen on {host}:{port}: {error.strerror or error}"
            raise ViewerError(text) from None
    return viser.ViserServer(host, port, label="sph_ros", verbose=False)


class WebScene:
    """The scene in the browser.

    Args:
        server: a ViserServer.
        on_drag: called with (solid, position, quat_xyzw) while somebody drags it.
        on_button: called with "pause", "step" or "reset".
    """

    def __init__(self, server, on_drag, on_button):
        self._server, self._on_drag = server, on_drag
        self._solids, self._cloud, self._mesh = {}, None, None
        self._framed, self._bounds = set(), None
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = True
        axes = server.scene.world_axes
        axes.axes_length, axes.axes_radius, axes.origin_radius = 0.05, 0.001, 0.002
        self._grid = server.scene.add_grid(
            "/grid", 1.0, 1.0, cell_size=0.05, section_size=0.25, cell_thickness=0.5
        )
        self._make_panel(on_button)

    @property
    def watched(self):
        """Whether any browser looks."""
        return bool(self._server.get_clients())

    def _make_panel(self, on_button):
        gui = self._server.gui
        self._status = gui.add_markdown("waiting for the fluid node ...")
        for text, hint in (
            ("pause", "stop or go on"),
            ("step", "one time step while paused"),
            ("reset", "back to the start"),
        ):
            button = gui.add_button(text, hint=hint)
            button.on_click(lambda _event, text=text: on_button(text))
        self._show_particles = gui.add_checkbox("particles", True)
        self._show_surface = gui.add_checkbox("surface", True)
        self._point_size = gui.add_slider("particle size [mm]", 0.5, 40.0, 0.5, 5.0)

    def set_status(self, text):
        """Show a text (Markdown) in the panel."""
        if self._status.content != text:
            self._status.content = text

    def show_particles(self, positions, velocities):
        """Draw particles coloured by speed; positions [m], velocities [m/s], (N, 3)."""
        if not self._show_particles.value or len(positions) == 0:
            self._hide(self._cloud)
            return
        positions = np.ascontiguousarray(positions, np.float32)
        colors = _bytes(speed_colors(np.linalg.norm(velocities, axis=1) / FAST))
        if self._cloud is None:
            self._point_size.value = round(1e3 * POINT_SHARE * _spacing(positions), 1)
        size = 1e-3 * self._point_size.value
        if self._cloud is None:
            self._cloud = self._server.scene.add_point_cloud(
                "/particles", positions, colors, point_size=size, point_shape="circle"
            )
            return
        with self._server.atomic():
            self._cloud.points, self._cloud.colors = positions, colors
            self._cloud.point_size, self._cloud.visible = size, True

    def show_surface(self, vertices, triangles):
        """Draw the liquid's surface: vertices [m], (V, 3), triangles (T, 3)."""
        if not self._show_surface.value or len(triangles) == 0:
            self._hide(self._mesh)
            return
        vertices = np.ascontiguousarray(vertices, np.float32)
        triangles = np.ascontiguousarray(triangles, np.uint32)
        if self._mesh is None:
            self._mesh = self._server.scene.add_mesh_simple(
                "/surface",
                vertices,
                triangles,
                color=_bytes(LIQUID[:3]),
                opacity=0.45,
                cast_shadow=False,
            )
            return
        with self._server.atomic():
            self._mesh.vertices, self._mesh.faces, self._mesh.visible = vertices, triangles, True

    def show_solids(self, markers, controlled):
        """Draw solids.

        Args:
            markers: decoded triangle markers, one per solid.
            controlled: names of the solids that can be dragged.
        """
        for marker in markers:
            name = marker.namespace
            if len(marker.points) == 0:
                continue
            if name not in self._solids:
                self._solids[name] = _WebSolid(self._server, marker)
                self._extend_bounds(marker)
            if name in controlled:
                self._solids[name].make_draggable(self._on_drag)
            self._solids[name].place(marker.position, marker.quat_xyzw)
        self._frame_cameras()

    def _extend_bounds(self, marker):
        points = marker.points + np.asarray(marker.position)
        corners = [points.min(axis=0), points.max(axis=0)]
        if self._bounds is not None:
            corners += self._bounds
        self._bounds = [np.min(corners, axis=0), np.max(corners, axis=0)]
        lower, upper = self._bounds
        self._grid.position = (*(0.5 * (lower + upper))[:2], float(lower[2]) - 1e-3)

    def _frame_cameras(self):
        """Let every new browser look at the solids."""
        clients = self._server.get_clients()
        self._framed &= set(clients)
        if self._bounds is None:
            return
        lower, upper = self._bounds
        middle = 0.5 * (lower + upper)
        away = 0.95 * max(float(np.linalg.norm(upper - lower)), 1e-2)
        for number, client in clients.items():
            if number not in self._framed:
                self._framed.add(number)
                client.camera.position = tuple(middle + away * np.array([0.55, -0.85, 0.45]))
                client.camera.look_at = tuple(middle)

    @staticmethod
    def _hide(handle):
        if handle is not None and handle.visible:
            handle.visible = False


def _bytes(rgb):
    """Colours 0 to 1 as viser takes them."""
    return np.round(255.0 * np.asarray(rgb)).astype(np.uint8)


def _spacing(positions):
    """Usual distance between particles [m]: median distance of some to their nearest neighbours."""
    some = positions[:: max(1, len(positions) // 20)]
    square = ((some[:, None] - positions[None]) ** 2).sum(axis=2)
    square[square == 0.0] = np.inf
    nearest = np.sqrt(square.min(axis=1))
    nearest = nearest[np.isfinite(nearest)]
    return float(np.median(nearest)) if len(nearest) else 0.01


class _WebSolid:
    """A solid in the browser, with a gizmo if it can be dragged."""

    def __init__(self, server, marker):
        self._server, self._name = server, marker.namespace
        self._gizmo, self._dragging = None, False
        mesh = trimesh.Trimesh(
            np.asarray(marker.points), np.arange(len(marker.points)).reshape(-1, 3), process=True
        )
        self._extent = float(np.max(mesh.extents))
        opacity = marker.color[3]
        self._root = server.scene.add_frame(f"/solids/{self._name}", show_axes=False)
        server.scene.add_mesh_simple(
            f"/solids/{self._name}/mesh",
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=_bytes(marker.color[:3]),
            opacity=None if opacity > 0.99 else opacity,
            side="front" if opacity > TRANSPARENT else "back",
            cast_shadow=opacity > TRANSPARENT,
        )
        edges = mesh.face_adjacency_edges[mesh.face_adjacency_angles > EDGE_ANGLE]
        if opacity < TRANSPARENT and len(edges):
            server.scene.add_line_segments(
                f"/solids/{self._name}/edges",
                mesh.vertices[edges].astype(np.float32),
                (90, 90, 90),
                line_width=1.5,
            )

    def make_draggable(self, on_drag):
        """Put a gizmo on it."""
        if self._gizmo is not None:
            return
        self._gizmo = self._server.scene.add_transform_controls(
            f"/gizmos/{self._name}", scale=GIZMO_SCALE * self._extent, depth_test=False
        )

        @self._gizmo.on_update
        def _(event):
            self._dragging = event.phase != "end"
            wxyz = event.target.wxyz
            quat_xyzw = (*map(float, wxyz[1:]), float(wxyz[0]))
            on_drag(self._name, tuple(map(float, event.target.position)), quat_xyzw)

    def place(self, position, quat_xyzw):
        """Where it is now; the gizmo follows unless somebody holds it."""
        wxyz = (quat_xyzw[3], *quat_xyzw[:3])
        with self._server.atomic():
            self._root.position, self._root.wxyz = position, wxyz
            if self._gizmo is not None and not self._dragging:
                self._gizmo.position, self._gizmo.wxyz = position, wxyz
