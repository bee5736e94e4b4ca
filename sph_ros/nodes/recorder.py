# SPDX-License-Identifier: Apache-2.0
"""Watches a fluid node: whether it is there, how it is and, if asked to, all it says."""

import time
from functools import partial

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.marker import MARKER, MARKER_ARRAY
from msg_adapters.point_cloud import POINT_CLOUD2
from msg_adapters.pose import POSE_STAMPED
from msg_adapters.wrench import WRENCH_STAMPED

DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"

#: Messages of some megabytes arrive in bursts while the bag is being written.
DEPTH = 10


class Recorder:
    """Watches `/fluid` from this process; a context manager.

    Attributes:
        facts: newest diagnostics of the simulation, key -> text.
        counts: messages heard, topic -> number.
    """

    def __enter__(self):
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("demo")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self.facts, self.counts = {}, {}
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._keep_facts, DEPTH, raw=True
        )
        self._bag = None
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def spin(self, seconds):
        """Take what comes for some time [s]."""
        self._executor.spin_once(timeout_sec=seconds)

    @property
    def fluid_is_ready(self):
        """Whether the fluid node has got past its compilation."""
        return self._node.count_publishers("/fluid/particles") > 0

    def listen(self, scene):
        """Subscribe to the fluid's messages and the poses it gets, and count them."""
        self._subscribe(PointCloud2, POINT_CLOUD2, "/fluid/particles")
        self._subscribe(Marker, MARKER, "/fluid/surface")
        self._subscribe(MarkerArray, MARKER_ARRAY, "/fluid/solids")
        for solid in scene.solids:
            self._subscribe(WrenchStamped, WRENCH_STAMPED, f"/fluid/solids/{solid.name}/wrench")
            if solid.control == "topic":
                topic = f"/fluid/solids/{solid.name}/pose"
                self._subscribe(PoseStamped, POSE_STAMPED, topic, ReliabilityPolicy.BEST_EFFORT)

    def record(self, bag):
        """From now on write what is heard to an open BagWriter; counts begin at zero."""
        self._bag = bag
        self.counts = {}

    def _subscribe(self, message_class, type_name, topic, policy=ReliabilityPolicy.RELIABLE):
        qos = QoSProfile(depth=DEPTH, reliability=policy)
        keep = partial(self._keep, topic, type_name)
        self._node.create_subscription(message_class, topic, keep, qos, raw=True)

    def _keep(self, topic, type_name, data):
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if self._bag is not None:
            self._bag.write(topic, type_name, time.time_ns(), bytes(data))

    def _keep_facts(self, data):
        self._keep("/diagnostics", DIAGNOSTIC_ARRAY, data)
        for status in deserialize_message(data, DiagnosticArray).status:
            if status.name == "fluid: simulation":
                self.facts = {item.key: item.value for item in status.values}
