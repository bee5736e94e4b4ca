# SPDX-License-Identifier: Apache-2.0
"""Subscriptions to a camera's pictures and calibration, which last only while they are needed."""

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

_TYPES = {"camera_info": CameraInfo, "image": Image, "compressed": CompressedImage}


def find_topics(node):
    """Full names of the topics `image`, `compressed` and `camera_info` of a node."""
    image = node.resolve_topic_name("image")
    compressed = node.resolve_topic_name("image/compressed")
    if compressed == node.resolve_topic_name("image/compressed", only_expand=True):
        compressed = f"{image}/compressed"  # not remapped itself, so it follows the image
    info = node.resolve_topic_name("camera_info")
    return {"image": image, "compressed": compressed, "camera_info": info}


def acceptable_qos(node, topic):
    """The best that all publishers of a topic offer: best effort loses large messages."""
    offered = [one.qos_profile for one in node.get_publishers_info_by_topic(topic)]
    reliable = all(qos.reliability != ReliabilityPolicy.BEST_EFFORT for qos in offered)
    # A calibration that was published once and for all is sent to those who ask for it.
    latched = DurabilityPolicy.TRANSIENT_LOCAL
    kept = offered and all(qos.durability == latched for qos in offered)
    return QoSProfile(
        depth=2,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=latched if kept else DurabilityPolicy.VOLATILE,
    )


class PictureTopics:
    """The topics `image`, `image/compressed` and `camera_info` of a node.

    Args:
        node: that subscribes.
        callbacks: "image", "compressed" and "camera_info" -> called with CDR bytes.
        group: callback group of the subscriptions; None for the node's own.

    Attributes:
        names: "image", "compressed" and "camera_info" -> full name.
        subscriptions: those that there are now, by the same words.
    """

    def __init__(self, node, callbacks, group=None):
        self._node, self._callbacks, self._group = node, callbacks, group
        self.names, self.subscriptions = find_topics(node), {}

    def attend(self, info, pictures):
        """Hear what is needed now, raw pictures rather than compressed ones. Call it often.

        Args:
            info: whether the calibration is needed.
            pictures: whether pictures are.

        Returns:
            whether any subscription is new.
        """
        wanted = {"camera_info"} if info else set()
        if pictures:
            raw = self._node.count_publishers(self.names["image"])
            compressed = self._node.count_publishers(self.names["compressed"])
            wanted.add("image" if raw or not compressed else "compressed")
        for name in self.subscriptions.keys() - wanted:
            self._node.destroy_subscription(self.subscriptions.pop(name))
        return any([self._subscribe(name) for name in wanted])  # all of them, not up to the first

    def _subscribe(self, name):
        """Subscribe to a topic, or once more with another QoS; returns whether it did."""
        qos = acceptable_qos(self._node, self.names[name])
        present = self.subscriptions.get(name)
        if present is not None:
            if present.qos_profile == qos:
                return False
            self._node.destroy_subscription(present)
        self.subscriptions[name] = self._node.create_subscription(
            _TYPES[name],
            self.names[name],
            self._callbacks[name],
            qos,
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        return True
