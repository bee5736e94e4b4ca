# SPDX-License-Identifier: Apache-2.0
"""Solids in the browser, and the gizmos by which some are dragged. No rclpy."""

import numpy as np
import trimesh

from sph_ros.nodes.web_colors import as_bytes

#: Edges where faces meet at a larger angle [rad] are drawn as lines.
EDGE_ANGLE = 0.5

#: Solids less opaque than this [-] are containers: their edges are drawn.
TRANSPARENT = 0.5

#: A container's faces are drawn larger by this factor: where they coincide with the liquid's they
#: would hide it in patches.
CONTAINER_SCALE = 1.02

#: Side of a gizmo over the extent of its solid.
GIZMO_SCALE = 0.9

#: Thickness of axes, and radius of their origin, over their length.
AXES_THICKNESS, ORIGIN_RADIUS = 0.02, 0.04


class WebSolids:
    """All solids of a scene in the browser.

    Args:
        server: a ViserServer.
        options: ViewOptions.
        on_drag: called with (solid, position, quat_xyzw) while somebody drags it, in the thread of
            the server's event loop.

    Attributes:
        axes_length: of the axes of solids that come from now on [m].
    """

    def __init__(self, server, options, on_drag):
        self._server, self._options, self._on_drag = server, options, on_drag
        self._solids, self.axes_length = {}, 0.05
        server.on_client_disconnect(self._let_go)

    @property
    def names(self):
        """Names of the solids that are drawn."""
        return list(self._solids)

    @property
    def bounds(self):
        """Corners of each solid where it is now, (S, 2, 3) [m]."""
        return np.array([solid.bounds for solid in self._solids.values()]).reshape(-1, 2, 3)

    def show(self, markers, controlled):
        """Draw these solids and no others; returns whether one came, went or has another shape.

        Args:
            markers: decoded triangle markers, one per solid.
            controlled: names of the solids that can be dragged.
        """
        markers = {m.namespace: m for m in markers if len(m.points)}
        old = {
            name: solid
            for name, solid in self._solids.items()
            if name not in markers or not solid.looks_like(markers[name])
        }
        for name, solid in old.items():
            solid.remove()
            del self._solids[name]
        new = [name for name in markers if name not in self._solids]
        for name in new:
            self._solids[name] = WebSolid(self._server, markers[name])
        for name, marker in markers.items():
            solid = self._solids[name]
            solid.make_draggable(self._on_drag if name in controlled else None)
            solid.place(marker.position, marker.quat_xyzw)
            solid.show_frame(self._options.frames, self.axes_length)
        return bool(old or new)

    def forget(self):
        """Take all away."""
        self.show([], ())

    def _let_go(self, client):
        """A browser is gone: what it held is free."""
        for solid in list(self._solids.values()):
            solid.let_go(client.client_id)


class WebSolid:
    """A solid in the browser, with a gizmo if it can be dragged.

    Args:
        server: a ViserServer.
        marker: a decoded triangle marker; its namespace is the solid's name.
    """

    def __init__(self, server, marker):
        self._server, self._name = server, marker.namespace
        self._points, self._color = np.array(marker.points), marker.color
        self._position = np.asarray(marker.position, float)
        self._gizmo = self._frame = None
        self._hand = None  # the browser that holds the gizmo
        mesh = trimesh.Trimesh(
            self._points, np.arange(len(self._points)).reshape(-1, 3), process=True
        )
        self._reach = float(np.linalg.norm(self._points, axis=1).max())
        self._extent = float(np.max(mesh.extents))
        self._root = server.scene.add_frame(f"/solids/{self._name}", show_axes=False)
        self._add_mesh(mesh, *marker.color)

    def _add_mesh(self, mesh, red, green, blue, opacity):
        solid = opacity > TRANSPARENT
        middle = mesh.bounds.mean(axis=0)
        faces_at = middle + (1.0 if solid else CONTAINER_SCALE) * (mesh.vertices - middle)
        self._server.scene.add_mesh_simple(
            f"/solids/{self._name}/mesh",
            faces_at.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=as_bytes((red, green, blue)),
            opacity=None if opacity > 0.99 else opacity,
            side="front" if solid else "back",
            cast_shadow=False,
            receive_shadow=False,
        )
        edges = mesh.face_adjacency_edges[mesh.face_adjacency_angles > EDGE_ANGLE]
        if not solid and len(edges):
            self._server.scene.add_line_segments(
                f"/solids/{self._name}/edges",
                mesh.vertices[edges].astype(np.float32),
                (110, 116, 124),
                line_width=1.5,
            )

    @property
    def bounds(self):
        """Corners of it where it is now, turned any way, (2, 3) [m]."""
        center = 0.5 * (self._points.min(axis=0) + self._points.max(axis=0))
        if np.linalg.norm(center) < 0.1 * self._reach:  # it may turn about its middle
            return np.array([self._position - self._reach, self._position + self._reach])
        return self._position + np.array([self._points.min(axis=0), self._points.max(axis=0)])

    def looks_like(self, marker):
        """Whether the marker has this shape and colour."""
        return marker.color == self._color and np.array_equal(marker.points, self._points)

    def remove(self):
        """Take it away."""
        self._root.remove()
        if self._gizmo is not None:
            self._gizmo.remove()

    def make_draggable(self, on_drag):
        """Put a gizmo on it, or take it away where `on_drag` is None."""
        if on_drag is None:
            if self._gizmo is not None:
                self._gizmo.remove()
                self._gizmo = self._hand = None
            return
        if self._gizmo is not None:
            return
        self._gizmo = self._server.scene.add_transform_controls(
            f"/gizmos/{self._name}",
            scale=GIZMO_SCALE * self._extent,
            line_width=3.0,
            depth_test=False,
            position=self._root.position,
            wxyz=self._root.wxyz,
        )

        @self._gizmo.on_update
        async def _(event):  # in the event loop: in the order in which the hand moved
            self._hand = None if event.phase == "end" else event.client_id
            wxyz = event.target.wxyz
            quat_xyzw = (*map(float, wxyz[1:]), float(wxyz[0]))
            on_drag(self._name, tuple(map(float, event.target.position)), quat_xyzw)

    def let_go(self, client_id):
        """Nobody holds it any more, if this browser did."""
        if self._hand == client_id:
            self._hand = None

    def place(self, position, quat_xyzw):
        """Where it is now; the gizmo follows unless somebody holds it."""
        self._position = np.asarray(position, float)
        wxyz = (quat_xyzw[3], *quat_xyzw[:3])
        handles = [self._root]
        if self._gizmo is not None and self._hand is None:
            handles.append(self._gizmo)
        with self._server.atomic():
            for handle in handles:  # what stands still is not sent
                if not np.array_equal(handle.position, position):
                    handle.position = position
                if not np.array_equal(handle.wxyz, wxyz):
                    handle.wxyz = wxyz

    def show_frame(self, wanted, length):
        """Show or hide its axes of a length [m], and its name."""
        if self._frame is None:
            if not wanted:
                return
            name = f"/solids/{self._name}/axes"
            self._frame = self._server.scene.add_frame(
                name,
                axes_length=length,
                axes_radius=AXES_THICKNESS * length,
                origin_radius=ORIGIN_RADIUS * length,
            )
            low, high = self._points.min(axis=0), self._points.max(axis=0)
            top = (*0.5 * (low + high)[:2], high[2])
            self._server.scene.add_label(f"{name}/label", self._name, position=top)
        if self._frame.visible != wanted:
            self._frame.visible = wanted
