# SPDX-License-Identifier: Apache-2.0
"""Pictures and calibrations from topics, fetched by the thread that works on them.

An executor of rclpy goes through all that a node has each time it wakes up, which takes as long as
tracking a marker. So these subscriptions are left out of it: the tracker's thread waits for the
pictures, takes the newest, and looks for a calibration when it has one. The middleware's queue is
the mailbox, and no picture ever waits behind another.
"""

import threading

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation

from msg_adapters.image import COMPRESSED_IMAGE, IMAGE
from sph_ros.nodes.image_source import Encoded
from sph_ros.nodes.picture_topics import PictureTopics

_PICTURES = {"image": IMAGE, "compressed": COMPRESSED_IMAGE}

#: One message cannot be longer in coming than this many others of its publisher; else it restarted.
LARGEST_GAP = 1000


class _Unexecuted(CallbackGroup):
    """What is in it is no business of the executor."""

    def can_execute(self, entity):
        return False

    def beginning_execution(self, entity):
        return False

    def ending_execution(self, entity):
        pass


def _ignore(_data):
    """The callback that is never called: messages are taken."""


class TopicInput:
    """Hears camera_info, and one of the topics of pictures while that is asked for.

    `listen` belongs to the executor's thread, `get` to one other thread.

    Args:
        node: that subscribes.
        hear_camera: called with each camera_info message in CDR bytes.

    Attributes:
        dropped: number of pictures that were not fetched, because a newer one was there.
    """

    def __init__(self, node, hear_camera):
        self.dropped = 0
        self._node, self._hear_camera = node, hear_camera
        callbacks = dict.fromkeys([*_PICTURES, "camera_info"], _ignore)
        self._topics = PictureTopics(node, callbacks, _Unexecuted())
        self._changed = threading.Event()
        self._last_number = None

    def listen(self, awake):
        """Subscribe to what is needed now; to raw pictures rather than compressed ones."""
        if self._topics.attend(info=True, pictures=awake):
            self._changed.set()

    def get(self, timeout):
        """The newest picture that was not fetched yet, as Encoded; None when none comes in time.

        Args:
            timeout: how long to wait at most [s].
        """
        subscriptions = self._topics.subscriptions.copy()
        name = next((name for name in _PICTURES if name in subscriptions), None)
        messages = []
        try:
            if name is None:
                self._changed.wait(timeout)
                self._changed.clear()
            else:
                _wait_for(subscriptions[name], self._node.context, timeout)
            for data, _ in _taken(subscriptions.get("camera_info")):
                self._hear_camera(data)
            if name is not None:
                messages = _taken(subscriptions[name])
        except rclpy_implementation.InvalidHandle:  # `listen` wants another one now
            return None
        if not messages:
            return None
        data, information = messages[-1]
        self._count(information.get("publication_sequence_number"), len(messages))
        return Encoded(_PICTURES[name], data)

    def _count(self, number, taken):
        """Count what was dropped here or by the middleware, whose numbers then have a gap."""
        gap = 0 if None in (number, self._last_number) else number - self._last_number
        self.dropped += gap - 1 if 0 < gap < LARGEST_GAP else taken - 1
        self._last_number = number


def _wait_for(subscription, context, timeout):
    """Wait until a message is there, or a time [s] is over; as `rclpy.wait_for_message` does it."""
    with subscription.handle, context.handle:
        wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, context.handle)
        wait_set.clear_entities()
        wait_set.add_subscription(subscription.handle)
        wait_set.wait(round(timeout * 1e9))


def _taken(subscription):
    """All messages that are there, oldest first: (bytes, information)."""
    if subscription is None:
        return []
    messages = []
    with subscription.handle:
        while message := subscription.handle.take_message(subscription.msg_type, True):
            messages.append(message)
    return messages
