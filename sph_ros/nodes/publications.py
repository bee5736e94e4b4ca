# SPDX-License-Identifier: Apache-2.0
"""What the fluid node publishes: ready CDR bytes, and only for topics that somebody listens to."""

from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.marker import delete_marker, marker_to_cdr, markers_to_cdr
from msg_adapters.mesh import mesh_to_cdr
from msg_adapters.point_cloud import point_cloud_to_cdr
from msg_adapters.wrench import wrench_to_cdr
from sph_ros.core.surface import extract_surface
from sph_ros.scene_markers import SolidMarkers, surface_color, surface_marker
from sph_ros.sim.scene_types import Scene

#: A depth of one loses messages of some megabytes.
DEPTH = 2


class SurfaceJob(NamedTuple):
    """What a surface is made of; nothing in it changes while a thread works on it.

    Attributes:
        positions: [m], (N, 3) float32.
        stamp_ns: of the positions [ns].
        scene: that they belong to.
        families: which of its liquids each particle is of, (N,) uint8; None: all of the first.
    """

    positions: np.ndarray
    stamp_ns: int
    scene: Scene
    families: np.ndarray | None = None


class Publications:
    """Publishers of a fluid node's state.

    Args:
        node: a Node.
        runner: a Runner.
    """

    def __init__(self, node, runner):
        self._node, self._runner = node, runner
        create = self._create = _Creator(node)
        self._particles = create(PointCloud2, "~/particles")
        self._surface = create(Marker, "~/surface")
        self._surface_mesh = create(Mesh, "~/surface_mesh")
        self._solids = create(MarkerArray, "~/solids")
        self._wrenches = {}
        self._forget_solids = False
        self.follow_scene()

    def follow_scene(self):
        """Publish what belongs to the runner's scene; to be called when it has another one."""
        sim = self._runner.sim
        self._frame = sim.scene.frame
        for name in set(self._wrenches) - set(sim.solid_names):
            self._node.destroy_publisher(self._wrenches.pop(name))
        for name in sim.solid_names:
            if name not in self._wrenches:
                self._wrenches[name] = self._create(WrenchStamped, f"~/solids/{name}/wrench")
        self._solid_markers = SolidMarkers(sim)

    def forget_solids(self):
        """Have viewers drop all solids they know before the next ones are drawn."""
        self._forget_solids = True

    def state(self, stamp_ns, surface_due):
        """Publish particles, solids and wrenches.

        Returns:
            a SurfaceJob if it is due and anybody listens, else None.
        """
        sim = self._runner.sim
        wants_surface = surface_due and (_heard(self._surface) or _heard(self._surface_mesh))
        if _heard(self._particles):
            self._particles.publish(point_cloud_to_cdr(sim.particles, stamp_ns, self._frame))
        if _heard(self._solids):
            self._publish_solids(stamp_ns)
        self._publish_wrenches(stamp_ns)
        if not wants_surface:
            return None
        families = sim.families if len(sim.scene.liquids) > 1 else None
        return SurfaceJob(sim.positions, stamp_ns, sim.scene, families)

    def surface(self, job):
        """Extract and publish a surface; returns its number of triangles. For any thread."""
        scene = job.scene
        vertices, triangles, normals = extract_surface(
            job.positions, scene.spacing, scene.support_radius, dimension=scene.dimension
        )
        if _heard(self._surface):
            color = surface_color(scene.liquids, vertices, job.positions, job.families)
            marker = surface_marker(vertices, triangles, normals, job.stamp_ns, scene.frame, color)
            self._surface.publish(marker_to_cdr(marker))
        if _heard(self._surface_mesh):
            self._surface_mesh.publish(mesh_to_cdr(vertices, triangles))
        return len(triangles)

    def _publish_solids(self, stamp_ns):
        markers = self._solid_markers.at(stamp_ns)
        if self._forget_solids:
            markers.insert(0, delete_marker(stamp_ns, self._frame, everything=True))
            self._forget_solids = False
        self._solids.publish(markers_to_cdr(markers))

    def _publish_wrenches(self, stamp_ns):
        wrenches = self._runner.take_wrenches()
        for name, wrench in zip(self._runner.sim.solid_names, wrenches, strict=True):
            publisher = self._wrenches[name]
            if _heard(publisher):
                data = wrench_to_cdr(wrench[:3], wrench[3:], stamp_ns, self._frame)
                publisher.publish(data)


class _Creator:
    """Makes the publishers: reliable, which serves every subscriber; QoS overridden the ROS way."""

    def __init__(self, node):
        self._node = node

    def __call__(self, message_class, topic):
        return self._node.create_publisher(
            message_class,
            topic,
            QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )


def _heard(publisher):
    return publisher.get_subscription_count() > 0
