# SPDX-License-Identifier: Apache-2.0
"""Who steps the simulation, and when: a thread of its own, or every pose message (lockstep).

Only the driver touches the simulation, so there is no lock that callbacks could wait for. Everybody
else hands in functions (`call`), which run between two steps.
"""

import math
import threading
import time
from collections import deque
from concurrent.futures import Future

from msg_adapters.header import NANOSECONDS

#: A state that does not change is published so often [s], for those who come later.
KEEPALIVE = 1.0

#: A thread that does not step looks around so often [s]; calls wake it.
IDLE = 0.5

#: Weight of the newest measurement in the running mean of the pace.
PACE_WEIGHT = 0.2


class LockstepDriver:
    """One pose message: one publication period of simulated time, and one publication.

    Everything happens in the callback, so the same poses always give the same messages.

    Args:
        runner: a Runner.
        publish: called with (stamp_ns, whether a surface is due).
        report: called with a line of text when a step fails.
    """

    def __init__(self, runner, publish, report):
        self._runner, self._publish, self._report = runner, publish, report
        self.paused = False
        self.publish_period, self.surface_period = 1.0 / 30.0, 1.0 / 15.0
        self._count, self._due = 0, 0.0
        self._latency = 0.0

    def start(self):
        """Nothing to start: callbacks drive."""

    def stop(self):
        """Nothing to stop."""

    def order(self, order):
        """A pose message came; None when it was refused: it counts all the same."""
        if order is not None:
            self._runner.move(order, self.publish_period)
        if not self.paused:
            self._due += self.publish_period
            self._take_steps()
        self._publish_state()
        if order is not None:
            self._latency = max(self._latency, time.monotonic() - order.arrival)

    def take_latency(self):
        """Longest time from a pose to the publication that showed it since the last call [s]."""
        latency, self._latency = self._latency, 0.0
        return latency

    def call(self, function):
        """Run `function` now; returns a finished Future."""
        future = Future()
        try:
            future.set_result(function())
        except Exception as error:
            future.set_exception(error)
        return future

    def step_once(self):
        """One time step while paused, then a publication; returns whether it went well."""
        went_well = self._step()
        self._publish_state()
        return went_well

    def reset(self):
        """Back to the start, without a publication: only poses make those."""
        self._runner.reset()
        self._count, self._due = 0, 0.0

    @property
    def skipped(self):
        """Simulated time left out for want of speed [s]; here nothing ever is."""
        return 0.0

    def stamp_ns(self):
        """Stamp of the present state [ns]."""
        return round(self._runner.sim.time * NANOSECONDS)

    def _take_steps(self):
        """Whole steps for the time that is due; what is left over is due the next time."""
        time_step = self._runner.sim.time_step
        for _ in range(round(self._due / time_step)):
            self._due -= time_step
            if self._runner.fault is None:
                self._step()

    def _step(self):
        went_well = self._runner.step()
        if not went_well:
            self._report(self._runner.fault)
        return went_well

    def _publish_state(self):
        every = max(1, round(self.surface_period / self.publish_period))
        self._publish(self.stamp_ns(), self._count % every == 0)
        self._count += 1


class ThreadDriver:
    """Steps whenever its schedule says so, in a thread of its own.

    Args:
        runner: a Runner.
        schedule: a WallSchedule or ClockSchedule.
        take_orders: gives the Orders that have come, one of each solid at most.
        publish: called in the thread with (stamp_ns, whether a surface is due).
        report: called with a line of text when a step fails.
        restarted: called when the clock jumped back and the simulation was reset.
    """

    def __init__(self, runner, schedule, take_orders, publish, report, restarted):
        self._runner, self._schedule, self._take_orders = runner, schedule, take_orders
        self._publish, self._report, self._restarted = publish, report, restarted
        self.paused = False
        self.publish_period, self.surface_period = 1.0 / 30.0, 1.0 / 15.0
        self.smoothing_time = 0.0
        self._orders, self._calls = {}, deque()
        self._wake, self._stopping = threading.Event(), False
        self._changed, self._next_publish, self._next_surface = True, 0.0, 0.0
        self._last_publish = 0.0
        self._pace, self._pace_mark = 1.0, None
        self._latency, self._felt = 0.0, math.inf
        self._thread = threading.Thread(target=self._run, name="stepping", daemon=True)

    def start(self):
        """Begin to step."""
        self._thread.start()

    def stop(self):
        """End after the present step; what waits in `call` is cancelled."""
        self._stopping = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        while self._calls:
            self._calls.popleft()[1].cancel()

    def take_latency(self):
        """Longest time from a pose to the publication that showed it since the last call [s].

        To be called in the thread. Poses that newer ones replaced do not count.
        """
        latency, self._latency = self._latency, 0.0
        return latency

    def call(self, function):
        """Have `function` run between two steps; returns a concurrent.futures.Future."""
        future = Future()
        self._calls.append((function, future))
        self._wake.set()
        return future

    def step_once(self):
        """One time step while paused; returns whether it went well."""
        self._collect_orders()
        self._apply_orders()
        return self._step()

    def reset(self):
        """Back to the start."""
        self._runner.reset()
        self._collect_orders()
        self._orders.clear()  # what came before counts no more
        self._schedule.restart(0.0)
        self._changed = True

    @property
    def skipped(self):
        """Simulated time left out because the machine was too slow [s]."""
        return self._schedule.skipped

    def stamp_ns(self):
        """Stamp of the present state [ns]."""
        return self._schedule.stamp_ns(self._runner.sim.time)

    # ---------------------------------------------------------------- in the thread

    def _run(self):
        self._schedule.restart(self._runner.sim.time)
        while not self._stopping:
            self._wake.clear()  # before looking for calls, or one that comes now would wait
            try:
                wait = self._turn()
            except Exception as error:  # a thread that dies is noticed by nobody
                self._runner.fail(error)
                self._report(self._runner.fault)
                wait = IDLE
            if wait > 0.0 and not self._stopping:
                self._wake.wait(wait)

    def _turn(self):
        """Do what is due; returns how long there is nothing to do [s]."""
        self._run_calls()
        self._collect_orders()
        if self.paused or self._runner.fault:
            self._schedule.restart(self._runner.sim.time)
            self._pace_mark = None
            wait = IDLE
        else:
            wait = self._step_if_due()
        return min(wait, self._publish_if_due())

    def _run_calls(self):
        while self._calls:
            function, future = self._calls.popleft()
            try:
                result = function()
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)

    def _step_if_due(self):
        """Take a step if one is due; returns how long to wait [s]."""
        sim = self._runner.sim
        due = self._schedule.due(sim.time, sim.time_step)
        if self._schedule.jumped_back():
            self.reset()
            self._restarted()
            return 0.0
        # Stamps are whole nanoseconds: what is less than one short of a step is a step.
        if due < sim.time_step - 1.0e-9:
            return self._schedule.wait_time(sim.time_step)
        self._apply_orders()
        self._step()
        self._schedule.passed(sim.time_step)
        self._measure_pace()
        return 0.0

    def _step(self):
        went_well = self._runner.step()
        self._changed = True
        if not went_well:
            self._report(self._runner.fault)
        return went_well

    def _collect_orders(self):
        """Only the newest of each solid waits, however long there is no step."""
        self._orders.update((order.solid, order) for order in self._take_orders())

    def _apply_orders(self):
        while self._orders:
            _, order = self._orders.popitem()
            self._felt = min(self._felt, order.arrival)
            # The solid needs as long as the hand will until its next pose, in simulated time, and a
            # step for a pose that comes after the start of one. Who is there earlier stands still
            # until then, and the liquid is pushed again and again.
            duration = order.interval * self._pace + self._runner.sim.time_step
            self._runner.move(order, min(duration, self.smoothing_time))

    def _measure_pace(self):
        """Simulated per real time, over some tenths of a second."""
        now, simulated = time.monotonic(), self._runner.sim.time
        if self._pace_mark is None:
            self._pace_mark = (now, simulated)
        elapsed = now - self._pace_mark[0]
        if elapsed > 0.1:
            pace = (simulated - self._pace_mark[1]) / elapsed
            self._pace += PACE_WEIGHT * (max(pace, 0.0) - self._pace)
            self._pace_mark = (now, simulated)

    def _publish_if_due(self):
        """Publish at the rate, an unchanged state now and then; returns how long to wait [s]."""
        now = time.monotonic()
        moment = self._next_publish
        if not self._changed:
            moment = max(moment, self._last_publish + KEEPALIVE)
        if now < moment:
            return moment - now
        # Surfaces go with a publication: the one that is nearest in time.
        surface_due = now >= self._next_surface - 0.5 * self.publish_period
        self._publish(self.stamp_ns(), surface_due)
        if self._felt < math.inf:
            self._latency = max(self._latency, time.monotonic() - self._felt)
            self._felt = math.inf
        self._changed, self._last_publish = False, now
        self._next_publish = _following(moment, self.publish_period, now)
        if surface_due:
            self._next_surface = _following(self._next_surface, self.surface_period, now)
        return 0.0


def _following(moment, period, now):
    """The next moment of a rhythm; periods that were missed are left out."""
    return moment + period if moment + period > now else now
