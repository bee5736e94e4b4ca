# SPDX-License-Identifier: Apache-2.0
"""TF where it is installed: poses in one frame as poses in another."""

import numpy as np
from rclpy.time import Time

from sph_ros.sim import quaternions

try:
    import tf2_ros
except ImportError:  # it is not on PyPI
    tf2_ros = None


def make_transform(node, frame):
    """A function for `PoseGate` that turns poses into `frame`; None without tf2_ros."""
    if tf2_ros is None:
        return None
    return FrameTransform(tf2_ros, node, frame)


class FrameTransform:
    """Turns poses into one frame; listens to /tf from the first foreign pose on.

    Args:
        tf2: the module tf2_ros.
        node: that listens.
        frame: target.
    """

    def __init__(self, tf2, node, frame):
        self._tf2 = tf2
        self._node = node
        self._frame = frame
        self._buffer = None

    def __call__(self, source, stamp_ns, position, quat_xyzw):
        """Position [m] and quaternion in the target frame; ValueError when TF does not know."""
        if self._buffer is None:
            self._buffer = self._tf2.Buffer(node=self._node)
            self._listener = self._tf2.TransformListener(self._buffer, self._node)
        try:
            moment = Time(nanoseconds=stamp_ns, clock_type=self._node.get_clock().clock_type)
            stamped = self._buffer.lookup_transform(self._frame, source, moment)
        except self._tf2.ExtrapolationException:
            stamped = self._latest(source)
        except self._tf2.TransformException as error:
            raise ValueError(f"frame {source!r}: {error}") from None
        return transformed(stamped.transform, position, quat_xyzw)

    def _latest(self, source):
        """The newest transform: a pose is often newer than the newest transform."""
        try:
            return self._buffer.lookup_transform(self._frame, source, Time())
        except self._tf2.TransformException as error:
            raise ValueError(f"frame {source!r}: {error}") from None


def transformed(transform, position, quat_xyzw):
    """A pose after a geometry_msgs/Transform: (position (3,) [m], quat_xyzw (4,))."""
    shift, turn = transform.translation, transform.rotation
    turn = quaternions.normalized((turn.x, turn.y, turn.z, turn.w))
    place = quaternions.to_matrix(turn) @ np.asarray(position, float)
    place += (shift.x, shift.y, shift.z)
    return tuple(map(float, place)), tuple(map(float, quaternions.multiply(turn, quat_xyzw)))
