# SPDX-License-Identifier: Apache-2.0
"""How much simulated time is due: by this machine's clock, or by the ROS clock.

A schedule never asks for more than `max_catch_up` at once. What a slow machine cannot do in time is
forgotten, so that work does not pile up; `skipped` says how much that was.
"""

import time

from msg_adapters.header import NANOSECONDS

#: A ROS clock that goes back by less [s] was only adjusted; simulated time waits for it.
LEAST_JUMP = 0.05

#: How often the ROS clock is looked at while nothing is due [s].
CLOCK_PERIOD = 0.002


class WallSchedule:
    """Simulated time follows a monotonic clock; stamps begin at zero.

    Attributes:
        speed: simulated per real time [-].
        max_catch_up: [s].
        skipped: simulated time that was not simulated because the machine was too slow [s].
    """

    def __init__(self, speed, max_catch_up):
        self.speed, self.max_catch_up = speed, max_catch_up
        self.skipped = 0.0
        self.restart(0.0)

    def restart(self, _simulated):
        """Nothing is due as of now."""
        self._last = time.monotonic()
        self._due = 0.0

    def due(self, _simulated, time_step):
        """Simulated time that should have passed by now and has not [s]."""
        now = time.monotonic()
        self._due += (now - self._last) * self.speed
        self._last = now
        excess = self._due - max(self.max_catch_up, time_step)
        if excess > 0.0:
            self.skipped += excess
            self._due -= excess
        return self._due

    def passed(self, time_step):
        """A step was taken."""
        self._due -= time_step

    def wait_time(self, time_step):
        """Real time until the next step is due [s]."""
        return (time_step - self._due) / self.speed

    def jumped_back(self):
        """Whether time started over; a monotonic clock never does."""
        return False

    def stamp_ns(self, simulated):
        """Stamp [ns] of the state at a simulated time [s]."""
        return round(simulated * NANOSECONDS)


class ClockSchedule:
    """Simulated time follows the ROS clock; stamps are times of that clock.

    Args:
        read_ns: gives the present time of the clock [ns], 0 as long as it is not known.
        max_catch_up: [s].
    """

    def __init__(self, read_ns, max_catch_up):
        self._read_ns = read_ns
        self.max_catch_up = max_catch_up
        self.skipped = 0.0
        self._jumped = False
        self._origin_ns = None
        self._last_ns = 0

    def restart(self, simulated):
        """Nothing is due as of now: the state at `simulated` [s] has the present time."""
        self._last_ns = self._read_ns()
        self._origin_ns = None
        self._anchor(self._last_ns, simulated)

    def _anchor(self, now_ns, simulated):
        if now_ns > 0:
            self._origin_ns = now_ns - round(simulated * NANOSECONDS)

    def due(self, simulated, time_step):
        """Simulated time that should have passed by now and has not [s]."""
        now_ns = self._read_ns()
        if now_ns < self._last_ns - LEAST_JUMP * NANOSECONDS:
            self._jumped = True
        self._last_ns = now_ns
        if self._origin_ns is None:
            self._anchor(now_ns, simulated)
        if self._origin_ns is None or self._jumped:
            return 0.0
        due = (now_ns - self.stamp_ns(simulated)) / NANOSECONDS
        excess = due - max(self.max_catch_up, time_step)
        if excess > 0.0:
            self.skipped += excess
            self._origin_ns += round(excess * NANOSECONDS)
            due -= excess
        return due

    def passed(self, _time_step):
        """A step was taken; the simulated time says it all."""

    def wait_time(self, _time_step):
        """Real time until the clock should be looked at again [s]."""
        return CLOCK_PERIOD

    def jumped_back(self):
        """Whether the clock went back since the last call."""
        jumped, self._jumped = self._jumped, False
        return jumped

    def stamp_ns(self, simulated):
        """Stamp [ns] of the state at a simulated time [s]."""
        return (self._origin_ns or 0) + round(simulated * NANOSECONDS)
