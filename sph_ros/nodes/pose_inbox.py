# SPDX-License-Identifier: Apache-2.0
"""The poses that move a scene's solids, as they come from ROS.

In real time nobody is called when a pose comes: the thread that steps takes what there is before
each step. To call somebody an executor looks through all that a node has, which takes longer than
all else that is done with a pose, on a processor that the liquid wants just then.
"""

import time

from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from sph_ros.nodes.frames import make_transform
from sph_ros.nodes.poses import PoseGate, PoseRefusedError

#: So many poses wait for a step; then newer ones replace them.
DEPTH = 100

#: Where every pose counts, so many wait.
LOCKSTEP_DEPTH = 1000

#: Warnings of one kind are at least so far apart [s].
WARNING_PERIOD = 5.0

#: A message that waited longer [s] did not: the clock was set in between.
LONGEST_WAIT = 10.0


class PoseInbox:
    """Subscriptions to the poses of a scene's solids, with a `PoseGate` each.

    Args:
        node: a Node.
        use: called with each pose as it comes, an Order or None where it was refused; nothing may
            be lost then. None: poses wait to be taken.

    Attributes:
        gates: of the solids that follow poses.
    """

    def __init__(self, node, use=None):
        self._node, self._use = node, use
        self._group = None if use else _Taken()
        self._subscriptions = {}
        self.gates = []

    def open(self, scene):
        """Subscribe to the poses of the solids of `scene` that poses control."""
        transform = make_transform(self._node, scene.frame)
        solids = [solid.name for solid in scene.solids if solid.control == "topic"]
        self.gates = [PoseGate(solid, scene.frame, transform) for solid in solids]
        for gate in self.gates:
            # Reliable loses nothing, not even what is sent while both sides still discover each
            # other; best effort hears every publisher, reliable ones too.
            self._hear(gate, self._use is not None, QoSOverridingOptions.with_default_policies())

    def close(self):
        """Hear no poses any more, nor give those that wait."""
        self.gates = []
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.popitem()[1])

    def forget_time(self):
        """Take poses whatever their stamps: time started over. For one thread at a time."""
        for gate in self.gates:
            gate.forget_time()

    def take(self):
        """The Orders that wait, the newest of each solid; for one thread at a time."""
        newest = {}
        for gate in self.gates:
            for buffer, info in _messages(self._subscriptions.get(gate.solid)):
                order = self._admit(gate, buffer, info)
                if order is not None:
                    newest[gate.solid] = order
        return newest.values()

    def _hear(self, gate, reliable, options):
        """Subscribe to the poses of a solid; a reliable subscription gives way when it must."""
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        depth = LOCKSTEP_DEPTH if self._use else DEPTH

        def give_way(_event):
            if self._subscriptions.get(gate.solid) is subscription:
                self._node.destroy_subscription(subscription)
                self._hear(gate, reliable=False, options=None)

        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        if reliable:
            # Not in the event's own callback: it belongs to what is destroyed.
            events.incompatible_qos = lambda event: self._node.executor.create_task(give_way, event)
        subscription = self._subscriptions[gate.solid] = self._node.create_subscription(
            PoseStamped,
            f"~/solids/{gate.solid}/pose",
            lambda buffer, info: self._use(self._admit(gate, buffer, info)),
            QoSProfile(depth=depth, reliability=policy),
            callback_group=self._group,
            event_callbacks=events,
            qos_overriding_options=options,
            raw=True,
        )

    def _admit(self, gate, buffer, info):
        """The Order of a message; None, and a warning, if it cannot be used."""
        try:
            return gate.admit(buffer, _arrival(info))
        except PoseRefusedError as error:
            self._node.get_logger().warning(
                f"{gate.solid}: pose refused ({error.reason}): {error}",
                throttle_duration_sec=WARNING_PERIOD,
            )
            return None


class _Taken(MutuallyExclusiveCallbackGroup):
    """Of subscriptions whose messages are taken, so that executors need not look at them."""

    def can_execute(self, entity):
        """Events of the subscriptions are the executor's."""
        return not isinstance(entity, Subscription) and super().can_execute(entity)


def _messages(subscription):
    """What waits in a subscription, (bytes, information) each; nothing if it is gone."""
    if subscription is None:
        return
    handle = subscription.handle
    try:
        with handle:
            while (message := handle.take_message(subscription.msg_type, True)) is not None:
                yield message
    except InvalidHandle:  # another thread has destroyed it
        return


def _arrival(info):
    """When a message came, by the monotonic clock [s]."""
    waited = 1e-9 * (time.time_ns() - info["received_timestamp"])
    return time.monotonic() - (waited if 0.0 <= waited < LONGEST_WAIT else 0.0)
