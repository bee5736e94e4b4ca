# SPDX-License-Identifier: Apache-2.0
"""The fluid node's messages as what an overlay draws. No rclpy."""

from collections import deque
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from msg_adapters.cdr import CdrReader
from msg_adapters.header import read_stamp
from msg_adapters.marker import ADD, TRIANGLE_LIST, cdr_to_markers
from msg_adapters.point_cloud import cdr_to_particle_cloud
from sph_ros.render.overlay import Liquid
from sph_ros.render.picture import SolidView
from sph_ros.render.walls import convex_planes

#: Solids less opaque than this [-] are containers: the liquid is inside.
TRANSPARENT = 0.5

#: So many arrays of solids are kept, and so many particles tell the spacing.
KEPT, SAMPLED = 16, 400


class PlacedLiquid(NamedTuple):
    """A Liquid for an Overlay, and what people should know about it."""

    liquid: Liquid
    notes: list

    def holds(self, point):
        """Whether a point (3,) is in the liquid."""
        positions = self.liquid.positions
        if not len(positions):
            return False
        nearest = ((positions - point) ** 2).sum(axis=1).min()
        return bool(nearest < self.liquid.spacing**2)


class LiquidStates:
    """Puts particles and solids of one time together.

    Attributes:
        frame: of the particles; "" before the first.
    """

    def __init__(self):
        self.frame = ""
        self._solids = deque(maxlen=KEPT)
        self._shapes, self._spacing = {}, None

    def hear_solids(self, data):
        """Keep a visualization_msgs/MarkerArray in CDR bytes; for any thread."""
        self._solids.append(data)

    def at(self, particles, get):
        """The liquid of a PointCloud2 in CDR bytes, a PlacedLiquid.

        Args:
            particles: CDR bytes.
            get: parameter name -> value, with `cards()`.

        Raises:
            ValueError: the bytes are no particles.
        """
        cloud = cdr_to_particle_cloud(particles)
        self.frame = cloud.header.frame_id
        positions = np.ascontiguousarray(cloud.positions, np.float32)
        sound = np.isfinite(positions).all(axis=1)
        velocities = np.asarray(cloud.velocities)[sound]
        positions = positions[sound]
        markers = self._markers(cloud.header.stamp_ns)
        solids = [self._view(marker, get["boxes"]) for marker in markers]
        cards = [
            (marker.position, marker.quat_xyzw, get.cards()[marker.namespace])
            for marker in markers
            if marker.namespace in get.cards()
        ]
        flat = len(positions) > 0 and np.ptp(positions[:, 1]) == 0.0
        liquid = Liquid(
            positions,
            velocities,
            get["spacing"] or self._measured_spacing(positions, flat),
            2 if flat else 3,
            solids,
            cards,
            get["desk_height"],
        )
        return PlacedLiquid(liquid, [] if len(positions) else ["the liquid has no particles"])

    def _markers(self, stamp_ns):
        """Triangle lists of the solids nearest to a time."""
        arrays = list(self._solids)
        stamps = [_first_stamp(data) for data in arrays]
        if not arrays:
            return []
        nearest = min(range(len(arrays)), key=lambda i: abs(stamps[i] - stamp_ns))
        return [
            marker
            for marker in cdr_to_markers(arrays[nearest])
            if marker.type == TRIANGLE_LIST and marker.action == ADD and len(marker.points)
        ]

    def _view(self, marker, boxes):
        """A SolidView; what does not change is found out once."""
        name = marker.namespace
        known = self._shapes.get(name)
        if known is None or not np.array_equal(known[0], marker.points):
            points = np.array(marker.points)
            triangles = np.arange(len(points)).reshape(-1, 3)
            known = points, triangles, _is_box(SolidView(name, points, triangles))
            self._shapes[name] = known
        points, triangles, is_box = known
        container = marker.color[3] < TRANSPARENT
        return SolidView(
            name,
            points,
            triangles,
            marker.position,
            marker.quat_xyzw,
            container,
            marker.color[:3],
            wireframe=is_box and boxes == "wireframe" and not container,
        )

    def _measured_spacing(self, positions, flat):
        """Spacing of particles [m], from how far their fourth neighbours are; measured once.

        In a liquid at rest density the fourth nearest (in two dimensions the third) is about one
        spacing away, however disordered the particles are.
        """
        if self._spacing is None and len(positions) > 8:
            sample = positions[:: max(1, len(positions) // SAMPLED)]
            count = 3 if flat else 4
            distances = cKDTree(positions).query(sample, count + 1)[0][:, count]
            self._spacing = float(np.median(distances)) / 1.02
        return self._spacing or 0.01


def stamp_of(data):
    """Stamp [ns] of a message in CDR bytes that begins with a header."""
    return read_stamp(CdrReader(data, "a stamped message"))


def _first_stamp(data):
    """Stamp [ns] of the first marker of an array; 0 of an empty one."""
    reader = CdrReader(data, "visualization_msgs/msg/MarkerArray")
    return read_stamp(reader) if reader.count() else 0


def _is_box(solid):
    """Whether a solid is a box: six planes and eight corners."""
    return len(convex_planes(solid)) == 6 and len(np.unique(solid.vertices.round(7), axis=0)) == 8
