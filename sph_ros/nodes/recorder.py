# SPDX-License-Identifier: Apache-2.0
"""Hears a fluid node: all it says into a bag, and whether it is there and how it is."""

import time
from functools import partial

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
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


class TopicRecorder:
    """Hears the topics of a fluid node, counts the messages and writes them to a bag.

    Args:
        node: that subscribes.
        fluid: full name of the fluid node.
        failed: called with the exception when the bag cannot be written; None lets it out of the
            callback. Nothing more is written then.

    Attributes:
        counts: messages heard, topic -> number.
    """

    def __init__(self, node, fluid="/fluid", failed=None):
        self._node, self._fluid, self._failed = node, fluid, failed
        self._bag, self._subscriptions = None, {}
        self.counts = {}

    def listen(self, solids):
        """Subscribe to what the node says of its liquid and solids, and to the poses it gets.

        Args:
            solids: name of a solid -> whether it follows poses. May be called again with others.
        """
        self._subscribe(PointCloud2, POINT_CLOUD2, "particles")
        self._subscribe(Marker, MARKER, "surface")
        self._subscribe(MarkerArray, MARKER_ARRAY, "solids")
        for name, controlled in solids.items():
            self._subscribe(WrenchStamped, WRENCH_STAMPED, f"solids/{name}/wrench")
            if controlled:
                best_effort = ReliabilityPolicy.BEST_EFFORT
                self._subscribe(PoseStamped, POSE_STAMPED, f"solids/{name}/pose", best_effort)

    def record(self, bag):
        """From now on write what is heard to an open BagWriter; counts begin at zero."""
        self._bag = bag
        self.counts = {}

    def keep(self, topic, type_name, data):
        """Count a message, and write it if a bag is open."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if self._bag is None:
            return
        try:
            self._bag.write(topic, type_name, time.time_ns(), bytes(data))
        except Exception as error:
            self._bag = None
            if self._failed is None:
                raise
            self._failed(error)

    def close(self):
        """Hear nothing more."""
        self._bag = None
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.popitem()[1])

    def _subscribe(self, message_class, type_name, name, policy=ReliabilityPolicy.RELIABLE):
        topic = f"{self._fluid}/{name}"
        if topic not in self._subscriptions:
            qos = QoSProfile(depth=DEPTH, reliability=policy)
            keep = partial(self.keep, topic, type_name)
            self._subscriptions[topic] = self._node.create_subscription(
                message_class, topic, keep, qos, raw=True
            )


class Recorder:
    """Watches `/fluid` from this process with a node of its own; a context manager.

    Attributes:
        facts: newest diagnostics of the simulation, key -> text.
        counts: messages heard, topic -> number.
        alerts: what other nodes complain of at present, name -> text.
        states: what all parts of nodes said last in their diagnostics, name -> text.
    """

    def __enter__(self):
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("demo")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._topics = TopicRecorder(self._node)
        self.facts, self.alerts, self.states = {}, {}, {}
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._keep_facts, DEPTH, raw=True
        )
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    @property
    def counts(self):
        """Messages heard, topic -> number."""
        return self._topics.counts

    def spin(self, seconds):
        """Take what comes for some time [s]."""
        self._executor.spin_once(timeout_sec=seconds)

    @property
    def fluid_is_ready(self):
        """Whether the fluid node has got past its compilation."""
        return self.is_published("/fluid/particles")

    def is_published(self, topic):
        """Whether somebody publishes a topic."""
        return self._node.count_publishers(topic) > 0

    def hear(self, message_class, topic, take):
        """Have `take` called with the CDR bytes of every message of a topic."""
        self._node.create_subscription(message_class, topic, take, DEPTH, raw=True)

    def listen(self, scene):
        """Subscribe to the fluid's messages and the poses it gets, and count them."""
        self._topics.listen({solid.name: solid.control == "topic" for solid in scene.solids})

    def record(self, bag):
        """From now on write what is heard to an open BagWriter; counts begin at zero."""
        self._topics.record(bag)

    def _keep_facts(self, data):
        self._topics.keep("/diagnostics", DIAGNOSTIC_ARRAY, data)
        for status in deserialize_message(data, DiagnosticArray).status:
            self.states[status.name] = status.message
            if status.name == "fluid: simulation":
                self.facts = {item.key: item.value for item in status.values}
            elif status.level != DiagnosticStatus.OK:
                self.alerts[status.name] = status.message
            else:
                self.alerts.pop(status.name, None)
