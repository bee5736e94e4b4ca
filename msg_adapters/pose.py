# SPDX-License-Identifier: Apache-2.0
"""geometry_msgs/PoseStamped, in and out. Reading one is a hot path: one unpack, no arrays."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from msg_adapters.cdr import CdrWriter, byte_order
from msg_adapters.checks import numbers
from msg_adapters.header import join_stamp, split_stamp, write_header

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped as PoseStampedMessage

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
_FIXED_SIZE = 16  # encapsulation header, sec, nanosec, length of frame_id


class PoseStamped(NamedTuple):
    """A pose at a time in a frame, as sent: NaN and quaternions of any length included."""

    stamp_ns: int
    frame_id: str
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


def pose_to_cdr(
    position: Sequence[float], quat_xyzw: Sequence[float], stamp_ns: int, frame_id: str
) -> bytes:
    """A pose as a ready geometry_msgs/PoseStamped.

    Args:
        position: (3,) [m] in ``frame_id``.
        quat_xyzw: (4,) rotation, x y z w; written as it is.
        stamp_ns: Time [ns].
        frame_id: Frame of the pose.

    Raises:
        ValueError: Wrong number of values, or a time that does not fit.
    """
    writer = CdrWriter()
    write_header(writer, stamp_ns, frame_id)
    writer.pack("7d", *numbers(position, "position", 3), *numbers(quat_xyzw, "quat_xyzw", 4))
    return writer.finish()


def cdr_to_pose(buffer: bytes) -> PoseStamped:
    """A geometry_msgs/PoseStamped from its bytes; ValueError when they are not one."""
    order = byte_order(buffer, POSE_STAMPED)
    if len(buffer) < _FIXED_SIZE:
        raise ValueError(f"{POSE_STAMPED} of {len(buffer)} bytes: truncated inside the header")
    length = int.from_bytes(buffer[12:16], "little" if order == "<" else "big")
    layout = _layout(order, length) if length < len(buffer) else None
    # Exactly one size is right for a given frame_id; middleware may round it up to four bytes.
    if layout is None or not 0 <= len(buffer) - layout.size <= 3:
        raise ValueError(
            f"{POSE_STAMPED} of {len(buffer)} bytes: expected {_size(length)} bytes "
            f"for a frame_id of {length} bytes"
        )
    seconds, nanoseconds, name, x, y, z, qx, qy, qz, qw = layout.unpack_from(buffer)
    return PoseStamped(
        join_stamp(seconds, nanoseconds), _frame_id(name), (x, y, z), (qx, qy, qz, qw)
    )


def pose_from_message(message: PoseStampedMessage) -> PoseStamped:
    """The same from an rclpy message."""
    stamp, position, rotation = (
        message.header.stamp,
        message.pose.position,
        message.pose.orientation,
    )
    return PoseStamped(
        join_stamp(stamp.sec, stamp.nanosec),
        message.header.frame_id,
        (position.x, position.y, position.z),
        (rotation.x, rotation.y, rotation.z, rotation.w),
    )


def pose_to_message(
    position: Sequence[float], quat_xyzw: Sequence[float], stamp_ns: int, frame_id: str
) -> PoseStampedMessage:
    """An rclpy message; arguments and errors as in ``pose_to_cdr``."""
    from geometry_msgs.msg import PoseStamped as PoseStampedMessage

    message = PoseStampedMessage()
    message.header.stamp.sec, message.header.stamp.nanosec = split_stamp(stamp_ns)
    message.header.frame_id = frame_id
    point, rotation = message.pose.position, message.pose.orientation
    point.x, point.y, point.z = numbers(position, "position", 3)
    rotation.x, rotation.y, rotation.z, rotation.w = numbers(quat_xyzw, "quat_xyzw", 4)
    return message


def _size(frame_id_length: int) -> int:
    """Bytes of the whole message: the doubles start at a multiple of 8 after the CDR header."""
    return _FIXED_SIZE + frame_id_length + -(12 + frame_id_length) % 8 + 56


@lru_cache(maxsize=64)
def _layout(order: str, frame_id_length: int) -> struct.Struct:
    padding = -(12 + frame_id_length) % 8
    return struct.Struct(f"{order}4xiI4x{frame_id_length}s{padding}x7d")


@lru_cache(maxsize=64)
def _frame_id(raw: bytes) -> str:
    if raw and raw[-1] != 0:
        raise ValueError(f"{POSE_STAMPED}: frame_id {raw!r} does not end with a zero byte")
    try:
        return raw[:-1].decode()
    except UnicodeDecodeError:
        raise ValueError(f"{POSE_STAMPED}: frame_id {raw!r} is not UTF-8") from None
