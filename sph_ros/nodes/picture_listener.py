# SPDX-License-Identifier: Apache-2.0
"""The newest picture of a topic, raw or compressed, while somebody wants to see it."""

import time

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from msg_adapters.image import COMPRESSED_IMAGE, IMAGE
from sph_ros.nodes.web_pictures import decode_picture

CLASSES = {IMAGE: Image, COMPRESSED_IMAGE: CompressedImage}

#: Pictures shown per second, at most [Hz]: each is decoded and encoded again.
PICTURE_RATE = 20.0

#: The topic is looked for so often [s].
LOOK_PERIOD = 1.0

#: Without a picture for so long [s] there are none.
SILENCE = 5.0


class PictureListener:
    """Listens to a topic that may not be there yet.

    Args:
        node: that subscribes.
        topic: of pictures; empty for none.
    """

    def __init__(self, node, topic):
        self._node = node
        self.topic = node.resolve_topic_name(topic) if topic else ""
        self._subscription = self._type = self._newest = None
        self._next_look, self._next_picture, self._last = 0.0, 0.0, None

    @property
    def gone(self):
        """Whether there were pictures and are none any more."""
        return self._last is not None and time.monotonic() - self._last > SILENCE

    def take(self, wanted):
        """The next picture to show, (H, W, 3) uint8 RGB; None where there is none.

        Args:
            wanted: whether anybody looks.

        Raises:
            ValueError: it cannot be shown; the text says why.
        """
        now = time.monotonic()
        if self.topic and now >= self._next_look:
            self._next_look = now + LOOK_PERIOD
            self._look(wanted)
        if self._newest is None or now < self._next_picture:
            return None
        data, self._newest = self._newest, None
        self._next_picture, self._last = now + 1.0 / PICTURE_RATE, now
        return decode_picture(data, self._type)

    def _look(self, wanted):
        """Subscribe when there is a publisher and somebody looks; else unsubscribe."""
        publishers = self._node.get_publishers_info_by_topic(self.topic) if wanted else []
        kinds = [info.topic_type for info in publishers]
        kind = kinds[0] if kinds else None
        if kind == self._type:
            return
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        self._type, self._newest = kind, None
        if kind is None:
            return
        if kind not in CLASSES:
            raise ValueError(f"messages of {kind}, expected {' or '.join(CLASSES)}")
        # Best effort hears every publisher, and drops what nobody has time for.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscription = self._node.create_subscription(
            CLASSES[kind], self.topic, self._keep, qos, raw=True
        )

    def _keep(self, data):
        self._newest = data
