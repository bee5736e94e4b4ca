# SPDX-License-Identifier: Apache-2.0
"""Which pose and which liquid belong to a picture. No rclpy.

A camera's pose has the stamp of its picture; a picture waits a little for it. The liquid's stamps
are times of the same clock when the simulation follows the ROS clock; else they are simulated
times, and when a state came says to which picture it belongs.
"""

from collections import deque
from typing import NamedTuple

from msg_adapters.header import NANOSECONDS
from sph_ros.tracking.se3 import Pose, exp, log

#: A picture waits so long for its pose and its liquid [s].
PATIENCE = 0.15

#: A pose this far from a picture's time is still taken for it [s].
POSE_REACH = 0.1

#: Stamps that differ by more belong to different clocks [s].
SAME_CLOCK = 2.0

#: So many pictures may wait, and so many states are kept.
WAITING, POSES, STATES = 8, 64, 32


class Match(NamedTuple):
    """A picture and what belongs to it; None for what there is not."""

    picture: object
    stamp_ns: int
    pose: Pose | None
    pose_age: float  # since the last pose came [s], infinite if none ever did
    state: object | None
    state_age: float  # since the last state came [s], infinite if none ever did
    state_offset: float  # of the state's time to the wanted one [s]


class _Stamped(NamedTuple):
    stamp_ns: int
    arrival: float
    thing: object


class Matcher:
    """Collects pictures, poses and states; times of arrival are of one clock, in seconds.

    Args:
        delay: the liquid of so much later belongs to a picture [s]: the time from a picture to the
            first state whose solids have followed it.
    """

    def __init__(self, delay=0.0):
        self.delay = delay
        self.dropped = 0
        self._pictures = deque(maxlen=WAITING)
        self._poses, self._states = deque(maxlen=POSES), deque(maxlen=STATES)

    def add_picture(self, picture, stamp_ns, age, now):
        """A picture came; `age` [s] says how long ago it was taken, as far as is known."""
        if len(self._pictures) == WAITING:
            self.dropped += 1
        self._pictures.append(_Stamped(stamp_ns, now - age, (picture, now)))

    def add_pose(self, pose, stamp_ns, now):
        """A camera's pose came. Stamps that go back are another run."""
        if self._poses and stamp_ns < self._poses[-1].stamp_ns:
            self._poses.clear()
        self._poses.append(_Stamped(stamp_ns, now, pose))

    def add_state(self, state, stamp_ns, now):
        """A state of the liquid came."""
        if self._states and stamp_ns < self._states[-1].stamp_ns:
            self._states.clear()
        self._states.append(_Stamped(stamp_ns, now, state))

    def take(self, now):
        """The Match of the newest picture that waits for nothing any more, else None.

        Older pictures are dropped.
        """
        for place in range(len(self._pictures) - 1, -1, -1):
            picture = self._pictures[place]
            waited = now - picture.thing[1]
            if waited > PATIENCE + self.delay or self._complete(picture, now):
                for _ in range(place + 1):
                    self._pictures.popleft()
                self.dropped += place
                return self._match(picture, now)
        return None

    def _complete(self, picture, now):
        """Whether nothing that will still come can belong to a picture."""
        if self._poses and now - self._poses[-1].arrival < PATIENCE + POSE_REACH:
            if self._poses[-1].stamp_ns < picture.stamp_ns:
                return False
        if self._states and now - self._states[-1].arrival < PATIENCE:
            return self._state_time(self._states[-1], picture) >= self.delay
        return True

    def _state_time(self, state, picture):
        """Time of a state after a picture [s]."""
        apart = (state.stamp_ns - picture.stamp_ns) / NANOSECONDS
        return apart if abs(apart) < SAME_CLOCK else state.arrival - picture.arrival

    def _match(self, picture, now):
        state, offset = None, 0.0
        if self._states:
            times = [(self._state_time(state, picture) - self.delay) for state in self._states]
            best = min(range(len(times)), key=lambda i: abs(times[i]))
            state, offset = self._states[best].thing, times[best]
        return Match(
            picture.thing[0],
            picture.stamp_ns,
            self._pose_at(picture.stamp_ns),
            now - self._poses[-1].arrival if self._poses else float("inf"),
            state,
            now - self._states[-1].arrival if self._states else float("inf"),
            offset,
        )

    def _pose_at(self, stamp_ns):
        """The pose with a stamp, between its neighbours, or the nearest within reach; else None."""
        before = [pose for pose in self._poses if pose.stamp_ns <= stamp_ns]
        after = [pose for pose in self._poses if pose.stamp_ns >= stamp_ns]
        reach = POSE_REACH * NANOSECONDS
        early = before[-1] if before and stamp_ns - before[-1].stamp_ns <= reach else None
        late = after[0] if after and after[0].stamp_ns - stamp_ns <= reach else None
        if early is None or late is None or early.stamp_ns == late.stamp_ns:
            found = early or late
            return found.thing if found is not None else None
        share = (stamp_ns - early.stamp_ns) / (late.stamp_ns - early.stamp_ns)
        return between(early.thing, late.thing, share)


def between(a, b, share):
    """The Pose a share of the way from a to b."""
    turn = exp(share * log(b.rotation @ a.rotation.T))
    return Pose(turn @ a.rotation, a.position + share * (b.position - a.position))
