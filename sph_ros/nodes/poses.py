# SPDX-License-Identifier: Apache-2.0
"""Poses that arrive from outside: which are used, which are refused, and why."""

import math
import time
from collections import Counter
from typing import NamedTuple

from msg_adapters.header import NANOSECONDS
from msg_adapters.pose import cdr_to_pose

#: Why a pose can be refused.
REASONS = ("malformed", "unknown_frame", "not_finite", "zero_quaternion", "far_away", "stale")

#: So many older poses one after another, in order among themselves: time itself started over.
OLDER_POSES_OF_A_RESTART = 3

#: float32 positions [m] mean nothing beyond.
FARTHEST = 1.0e4

#: Shorter quaternions have no direction to speak of.
SHORTEST_QUATERNION = 1.0e-6

#: Pauses between poses longer than this [s] say nothing about their rate.
LONGEST_INTERVAL = 0.5

#: A pose may be late by so many mean deviations of the time between poses before it is missed.
LATE = 2.0


class PoseRefusedError(ValueError):
    """A pose is not used.

    Attributes:
        reason: one of REASONS.
    """

    def __init__(self, reason, text):
        super().__init__(text)
        self.reason = reason


class Order(NamedTuple):
    """A solid is to go to a pose in the scene's frame.

    Attributes:
        solid: its name.
        position: [m], (3,).
        quat_xyzw: unit length, (4,).
        interval: within this time the next pose usually comes [s], real time; 0 when unknown.
        arrival: when it came, by the monotonic clock [s].
    """

    solid: str
    position: tuple
    quat_xyzw: tuple
    interval: float
    arrival: float


class PoseGate:
    """Lets through the poses of one solid that can be used, and counts the others.

    Args:
        solid: its name.
        frame: of the scene.
        transform: turns (frame, stamp_ns, position, quat_xyzw) into (position, quat_xyzw) in the
            scene's frame, or raises ValueError; None where there is no TF.
    """

    def __init__(self, solid, frame, transform=None):
        self.solid = solid
        self.accepted = 0
        # All reasons from the start: other threads go through them while one counts.
        self.refused = Counter(dict.fromkeys(REASONS, 0))
        self._frame = frame
        self._transform = transform
        self._arrival = None
        self._interval, self._deviation = 0.0, 0.0
        self.forget_time()

    def forget_time(self):
        """Take whatever stamp comes next: the clock jumped."""
        self._last_ns = None
        self._older = []

    @property
    def age(self):
        """Real time since the last pose that was used [s]; NaN before the first."""
        return math.nan if self._arrival is None else time.monotonic() - self._arrival

    def admit(self, buffer, arrival):
        """The `Order` of a pose that came.

        Args:
            buffer: geometry_msgs/PoseStamped in CDR bytes.
            arrival: when it came, by the monotonic clock [s].

        Raises:
            PoseRefusedError: it cannot be used; it is counted.
        """
        try:
            pose = self._read(buffer)
            position, quat_xyzw = self._in_scene(pose)
            quat_xyzw = _unit(quat_xyzw)
            self._check_order(pose.stamp_ns)
        except PoseRefusedError as error:
            self.refused[error.reason] += 1
            raise
        self.accepted += 1
        self._note_arrival(arrival)
        interval = self._interval + LATE * self._deviation
        return Order(self.solid, position, quat_xyzw, interval, arrival)

    def _read(self, buffer):
        try:
            pose = cdr_to_pose(buffer)
        except ValueError as error:
            raise PoseRefusedError("malformed", str(error)) from None
        if not all(map(math.isfinite, pose.position + pose.quat_xyzw)):
            raise PoseRefusedError(
                "not_finite", f"position {pose.position}, quaternion {pose.quat_xyzw}"
            )
        _unit(pose.quat_xyzw)  # before anybody turns something by it
        return pose

    def _in_scene(self, pose):
        """Position and quaternion in the scene's frame."""
        position, quat_xyzw = pose.position, pose.quat_xyzw
        frame = pose.frame_id.removeprefix("/")
        if frame not in ("", self._frame):
            if self._transform is None:
                raise PoseRefusedError(
                    "unknown_frame",
                    f"frame {frame!r}, expected {self._frame!r} (tf2_ros is not installed, so "
                    "nothing can turn one into the other)",
                )
            try:
                position, quat_xyzw = self._transform(frame, pose.stamp_ns, position, quat_xyzw)
            except ValueError as error:
                raise PoseRefusedError("unknown_frame", str(error)) from None
        # Not NaN now, but a transform may have made it so: hence "not below".
        if not max(map(abs, position)) <= FARTHEST:
            raise PoseRefusedError("far_away", f"position {position}, expected within {FARTHEST} m")
        return position, quat_xyzw

    def _check_order(self, stamp_ns):
        """Refuse stragglers, but follow a recording that starts over. Stamp 0 means not stamped."""
        if stamp_ns == 0:
            return
        if self._last_ns is None or stamp_ns >= self._last_ns:
            self._last_ns, self._older = stamp_ns, []
            return
        if self._older and stamp_ns < self._older[-1]:
            self._older = []
        self._older.append(stamp_ns)
        if len(self._older) >= OLDER_POSES_OF_A_RESTART:
            self._last_ns, self._older = stamp_ns, []
            return
        behind = (self._last_ns - stamp_ns) / NANOSECONDS
        raise PoseRefusedError("stale", f"its stamp is {behind:.3f} s older than the last one's")

    def _note_arrival(self, arrival):
        """Keep running means of the time between poses, and of how far it is from its mean."""
        if self._arrival is not None:
            interval = arrival - self._arrival
            if interval > LONGEST_INTERVAL:
                self._interval, self._deviation = 0.0, 0.0
            elif self._interval == 0.0:
                self._interval = interval
            else:
                error = interval - self._interval
                self._deviation += 0.2 * (abs(error) - self._deviation)
                self._interval += 0.2 * error
        self._arrival = arrival


def _unit(quat_xyzw):
    length = math.hypot(*quat_xyzw)
    if not length >= SHORTEST_QUATERNION or math.isinf(length):
        raise PoseRefusedError("zero_quaternion", f"quaternion {quat_xyzw} is no rotation")
    return tuple(value / length for value in quat_xyzw)
