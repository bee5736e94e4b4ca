# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/WrenchStamped, in and out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.checks import numbers
from msg_adapters.header import join_stamp, read_header, split_stamp, write_header

if TYPE_CHECKING:
    from geometry_msgs.msg import WrenchStamped as WrenchStampedMessage

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"


class WrenchStamped(NamedTuple):
    """Force [N] and torque [N m] at a time, in the axes of a frame."""

    stamp_ns: int
    frame_id: str
    force: tuple[float, float, float]
    torque: tuple[float, float, float]


def wrench_to_cdr(
    force: Sequence[float], torque: Sequence[float], stamp_ns: int, frame_id: str
) -> bytes:
    """A wrench as a ready geometry_msgs/WrenchStamped.

    Args:
        force: (3,) [N].
        torque: (3,) [N m].
        stamp_ns: Time [ns].
        frame_id: Frame whose axes both are given in.

    Raises:
        ValueError: Wrong number of values, or a time that does not fit.
    """
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.pack("6d", *numbers(force, "force", 3), *numbers(torque, "torque", 3))
    return writer.finish()


def cdr_to_wrench(buffer: bytes) -> WrenchStamped:
    """A geometry_msgs/WrenchStamped from its bytes; ValueError when they are not one."""
    reader = CdrReader(buffer, WRENCH_STAMPED)
    header = read_header(reader)
    values = reader.unpack("6d")
    reader.end()
    return WrenchStamped(header.stamp_ns, header.frame_id, values[:3], values[3:])


def wrench_from_message(message: WrenchStampedMessage) -> WrenchStamped:
    """The same from an rclpy message."""
    stamp, force, torque = message.header.stamp, message.wrench.force, message.wrench.torque
    return WrenchStamped(
        join_stamp(stamp.sec, stamp.nanosec),
        message.header.frame_id,
        (force.x, force.y, force.z),
        (torque.x, torque.y, torque.z),
    )


def wrench_to_message(
    force: Sequence[float], torque: Sequence[float], stamp_ns: int, frame_id: str
) -> WrenchStampedMessage:
    """An rclpy message; arguments and errors as in ``wrench_to_cdr``."""
    from geometry_msgs.msg import WrenchStamped as WrenchStampedMessage

    message = WrenchStampedMessage()
    message.header.stamp.sec, message.header.stamp.nanosec = split_stamp(stamp_ns)
    message.header.frame_id = frame_id
    for vector, values in (
        (message.wrench.force, numbers(force, "force", 3)),
        (message.wrench.torque, numbers(torque, "torque", 3)),
    ):
        vector.x, vector.y, vector.z = values
    return message
