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

from msg_adapters.marker import marker_to_cdr, markers_to_cdr, triangle_marker
from msg_adapters.mesh import mesh_to_cdr
from msg_adapters.point_cloud import particle_cloud_to_cdr
from msg_adapters.wrench import wrench_to_cdr
from sph_ros.core.surface import extract_surface

#: A depth of one loses messages of some megabytes.
DEPTH = 2

#: Red, green, blue, alpha.
LIQUID_COLOR = (0.20, 0.45, 0.75, 0.8)
SOLID_COLOR = (0.85, 0.45, 0.20, 1.0)
CONTAINER_COLOR = (0.70, 0.70, 0.70, 0.15)


class SurfaceJob(NamedTuple):
    """Positions [m], (N, 3) float32, whose surface is to be published with a stamp [ns]."""

    positions: np.ndarray
    stamp_ns: int


class Publications:
    """Publishers of a fluid node's state.

    Args:
        node: a Node.
        runner: a Runner.
    """

    def __init__(self, node, runner):
        self._runner = runner
        self._frame = runner.sim.scene.frame
        create = _Creator(node)
        self._particles = create(PointCloud2, "~/particles")
        self._surface = create(Marker, "~/surface")
        self._surface_mesh = create(Mesh, "~/surface_mesh")
        self._solids = create(MarkerArray, "~/solids")
        self._wrenches = [
            create(WrenchStamped, f"~/solids/{name}/wrench") for name in runner.sim.solid_names
        ]
        self._drawn = [_DrawnSolid(runner.sim, i) for i in _visible(runner.sim.scene)]

    def state(self, stamp_ns, surface_due):
        """Publish particles, solids and wrenches.

        Returns:
            a SurfaceJob if it is due and anybody listens, else None.
        """
        sim = self._runner.sim
        wants_surface = surface_due and (_heard(self._surface) or _heard(self._surface_mesh))
        wants_particles = _heard(self._particles)
        positions = sim.positions if wants_surface or wants_particles else None
        if wants_particles:
            self._particles.publish(
                particle_cloud_to_cdr(
                    positions, sim.velocities, sim.densities, sim.ids, stamp_ns, self._frame
                )
            )
        if _heard(self._solids):
            markers = [solid.marker(stamp_ns, self._frame) for solid in self._drawn]
            self._solids.publish(markers_to_cdr(markers))
        self._publish_wrenches(stamp_ns)
        return SurfaceJob(positions, stamp_ns) if wants_surface else None

    def surface(self, job):
        """Extract and publish a surface; returns its number of triangles. For any thread."""
        scene = self._runner.sim.scene
        vertices, triangles, _ = extract_surface(
            job.positions, scene.spacing, scene.support_radius, dimension=scene.dimension
        )
        if _heard(self._surface):
            marker = triangle_marker(
                vertices,
                triangles,
                job.stamp_ns,
                self._frame,
                namespace="surface",
                color=LIQUID_COLOR,
            )
            self._surface.publish(marker_to_cdr(marker))
        if _heard(self._surface_mesh):
            self._surface_mesh.publish(mesh_to_cdr(vertices, triangles))
        return len(triangles)

    def _publish_wrenches(self, stamp_ns):
        wrenches = self._runner.take_wrenches()
        for publisher, wrench in zip(self._wrenches, wrenches, strict=True):
            if _heard(publisher):
                data = wrench_to_cdr(wrench[:3], wrench[3:], stamp_ns, self._frame)
                publisher.publish(data)


class _DrawnSolid:
    """A solid as a marker; its triangles are looked up once, its pose every time."""

    def __init__(self, sim, index):
        self._solid = sim.solid(sim.solid_names[index])
        self._index = index
        vertices, triangles = self._solid.mesh()
        self._marker = triangle_marker(
            vertices,
            triangles,
            0,
            "",
            namespace=self._solid.name,
            marker_id=index,
            color=solid_color(self._solid),
        )
        # Fields but not the class: a frozen dataclass copies slower than it is made.
        self._fields = dict(vars(self._marker))

    def marker(self, stamp_ns, frame):
        """The solid where it is now."""
        self._fields.update(
            stamp_ns=stamp_ns,
            frame_id=frame,
            position=tuple(self._solid.position),
            quat_xyzw=tuple(self._solid.quat_xyzw),
        )
        return type(self._marker)(**self._fields)


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


def solid_color(solid):
    """Red, green, blue, alpha of a solid: the scene's, or one that suits it."""
    if type(solid.shape).__name__ == "Container":
        return CONTAINER_COLOR
    return (*solid.color, 1.0) if solid.color is not None else SOLID_COLOR


def _visible(scene):
    return [index for index, spec in enumerate(scene.solids) if spec.visible]


def _heard(publisher):
    return publisher.get_subscription_count() > 0
