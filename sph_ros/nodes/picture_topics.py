# SPDX-License-Identifier: Apache-2.0
"""Subscriptions to a camera's pictures and calibration, which last only while they are needed."""

from rclpy.event_handler import SubscriptionEventCallbacks
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from msg_adapters.image import COMPRESSED_IMAGE, IMAGE
from sph_ros.nodes.image_source import Encoded
from sph_ros.nodes.marker_input import acceptable_qos, find_topics

_TYPES = {"camera_info": CameraInfo, "image": Image, "compressed": CompressedImage}


class PictureTopics:
    """The topics `image`, `image/compressed` and `camera_info` of a node, heard by its executor.

    Args:
        node: that subscribes.
        on_picture: called with an Encoded.
        on_camera_info: called with CDR bytes.

    Attributes:
        names: "image", "compressed" and "camera_info" -> full name.
    """

    def __init__(self, node, on_picture, on_camera_info):
        self._node, self._subscriptions = node, {}
        self.names = find_topics(node)
        self._callbacks = {
            "camera_info": on_camera_info,
            "image": lambda data: on_picture(Encoded(IMAGE, data)),
            "compressed": lambda data: on_picture(Encoded(COMPRESSED_IMAGE, data)),
        }

    def attend(self, awake):
        """Hear what is needed now, raw pictures rather than compressed ones. Call it often."""
        wanted = set()
        if awake:
            raw = self._node.count_publishers(self.names["image"])
            compressed = self._node.count_publishers(self.names["compressed"])
            wanted = {"camera_info", "image" if raw or not compressed else "compressed"}
        for name in self._subscriptions.keys() - wanted:
            self._node.destroy_subscription(self._subscriptions.pop(name))
        for name in wanted:
            self._subscribe(name, acceptable_qos(self._node, self.names[name]))

    def _subscribe(self, name, qos):
        """Subscribe to a topic, or once more with another QoS."""
        present = self._subscriptions.get(name)
        if present is not None:
            if present.qos_profile == qos:
                return
            self._node.destroy_subscription(present)
        self._subscriptions[name] = self._node.create_subscription(
            _TYPES[name],
            self.names[name],
            self._callbacks[name],
            qos,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
