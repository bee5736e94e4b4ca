# SPDX-License-Identifier: Apache-2.0
"""The pose of one target over time: Kalman filter, One Euro filter, or measurements as they are.

All three have the same face: ``observe`` a measurement, ask where the target is ``at`` a time.
Times are seconds that do not decrease.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from sph_ros.tracking.filter import (
    Estimate,
    MotionSettings,
    mean,
    predict,
    start,
    surprise,
    update,
)
from sph_ros.tracking.se3 import Pose, difference, exp, log

#: A track is asked for so few moments of each picture that no more are remembered.
KEPT = 8

FILTERS = ("kalman", "one_euro", "none")


@dataclass(frozen=True)
class TrackSettings:
    """How a track trusts what it sees.

    Attributes:
        motion: MotionSettings of the Kalman filter.
        gate: squared Mahalanobis distance beyond which a measurement is an outlier [-]; a right one
            of 6 components exceeds 22.5 once in 1000 times.
        confirmations: so many measurements that agree with each other, and not with the track, mean
            that the world really changed.
        agreement_speed: measurements agree when a motion of this speed [m/s] joins them.
        agreement_spin: the same [rad/s].
        coast_time: without measurements the motion goes on for so long [s].
        stop_time: then it dies away with this time constant [s].
        lost_time: without measurements for so long [s] the target is lost; then it also takes
            `confirmations` to start over.
        min_cutoff: of the One Euro filter, at rest [Hz].
        speed_coefficient: of the One Euro filter, its beta [1/m].
        angular_coefficient: the same for rotations [1/rad].
        derivative_cutoff: of the One Euro filter's speed [Hz].
    """

    motion: MotionSettings = field(default_factory=MotionSettings)
    gate: float = 22.5
    confirmations: int = 2
    agreement_speed: float = 3.0
    agreement_spin: float = 15.0
    coast_time: float = 0.12
    stop_time: float = 0.1
    lost_time: float = 0.5
    min_cutoff: float = 1.0
    speed_coefficient: float = 100.0
    angular_coefficient: float = 12.0
    derivative_cutoff: float = 1.0


def make_track(kind, settings):
    """A track of one of FILTERS."""
    return {"kalman": KalmanTrack, "one_euro": OneEuroTrack, "none": PlainTrack}[kind](settings)


class Track:
    """What all tracks have in common: when the target was seen, and what was refused.

    Attributes:
        seen: time of the last measurement that was used [s]; None before the first.
        rejected: number of measurements that were not used.
    """

    def __init__(self, settings):
        self.settings = settings
        self.seen = None
        self.rejected = 0

    def age(self, time):
        """Time since the target was seen [s]; infinite before."""
        return math.inf if self.seen is None else time - self.seen

    @property
    def candidate(self):
        """(time, pose) of the last refused measurement, which may be a new start; else None."""
        return None

    def status(self, time):
        """One of never seen, tracking, coasting, lost."""
        if self.seen is None:
            return "never seen"
        age = self.age(time)
        if age <= 1e-9:
            return "tracking"
        return "coasting" if age <= self.settings.lost_time else "lost"


class PlainTrack(Track):
    """The last measurement."""

    def observe(self, time, measurement):
        """Take a measurement; returns True."""
        self.seen, self._measurement = time, measurement
        return True

    restart = observe

    def at(self, time):
        """The Estimate at a time; None before the first measurement."""
        if self.seen is None:
            return None
        return _still(self._measurement.pose, self._measurement.covariance)


class OneEuroTrack(Track):
    """Low pass whose cut-off rises with speed (Casiez, Roussel & Vogel 2012, One Euro Filter)."""

    def observe(self, time, measurement):
        """Take a measurement; returns True."""
        if self.seen is None or time - self.seen > self.settings.lost_time:
            return self.restart(time, measurement)
        elapsed = time - self.seen
        if elapsed > 0.0:
            self._filter(elapsed, measurement.pose)
        self.seen, self._covariance = time, measurement.covariance
        return True

    def restart(self, time, measurement):
        """Forget what was; returns True."""
        self.seen, self._covariance = time, measurement.covariance
        self._pose = self._raw = measurement.pose
        self._speed, self._spin = np.zeros(3), np.zeros(3)
        return True

    def _filter(self, elapsed, pose):
        settings = self.settings
        share = smoothing_share(settings.derivative_cutoff, elapsed)
        velocity = (pose.position - self._raw.position) / elapsed
        spin = log(pose.rotation @ self._raw.rotation.T) / elapsed
        self._speed = self._speed + share * (velocity - self._speed)
        self._spin = self._spin + share * (spin - self._spin)
        cutoffs = (
            settings.min_cutoff + settings.speed_coefficient * np.linalg.norm(self._speed),
            settings.min_cutoff + settings.angular_coefficient * np.linalg.norm(self._spin),
        )
        step = difference(pose, self._pose)
        shares = [smoothing_share(cutoff, elapsed) for cutoff in cutoffs]
        self._pose = Pose(
            exp(shares[1] * step[3:]) @ self._pose.rotation,
            self._pose.position + shares[0] * step[:3],
        )
        self._raw = pose

    def at(self, time):
        """The Estimate at a time; None before the first measurement."""
        return None if self.seen is None else _still(self._pose, self._covariance)


class KalmanTrack(Track):
    """Filter with gate, recovery, coasting and a gentle stop."""

    def __init__(self, settings):
        super().__init__(settings)
        self._state = None
        self._before = None  # (state, time) without the last measurement, its surprise
        self._candidates = []
        self._forget()

    @property
    def candidate(self):
        """(time, pose) of the last refused measurement, which may be a new start; else None."""
        if not self._candidates:
            return None
        time, measurement = self._candidates[-1]
        return time, measurement.pose

    def observe(self, time, measurement):
        """Use a measurement, or refuse it as an outlier; returns whether it was used."""
        if self._state is None:
            return self.restart(time, measurement)
        lost = self.age(time) > self.settings.lost_time
        if not lost:
            now = surprise(self._predicted(time), measurement)
            if now <= self.settings.gate:
                return self._update(time, measurement, now)
            now = self._surprise_without_last(time, measurement)
            if now is not None:
                self._state, self.seen, _ = self._before
                self._forget()
                return self._update(time, measurement, now)
        return self._consider(time, measurement)

    def restart(self, time, measurement, rates=None):
        """Forget what was; returns True."""
        self._state = start(measurement, self.settings.motion, rates)
        self.seen, self._candidates, self._before = time, [], None
        self._forget()
        return True

    def at(self, time):
        """The Estimate at a time, also a later one; None before the first measurement."""
        if self._state is None:
            return None
        if time not in self._means:
            _make_room(self._means)
            self._means[time] = mean(self._predicted(time))
        return self._means[time]

    def _update(self, time, measurement, its_surprise):
        self._before = (self._state, self.seen, its_surprise)
        updated = update(self._predicted(time), measurement)
        self._state, self.seen, self._candidates = updated, time, []
        self._forget()
        return True

    def _forget(self):
        """Drop what was worked out from the last state."""
        self._predictions, self._means = {}, {}

    def _predicted(self, time):
        """The state at a time, always from the last measurement: gaps do not add up roundings."""
        if time not in self._predictions:
            _make_room(self._predictions)
            self._predictions[time] = self._predict_from(self._state, time - self.seen)
        return self._predictions[time]

    def _predict_from(self, state, elapsed):
        settings = self.settings
        gap = elapsed - settings.coast_time
        if gap <= 0.0:
            return predict(state, elapsed, settings.motion)
        left = math.exp(-gap / settings.stop_time)
        travel = settings.coast_time + settings.stop_time * (1.0 - left)
        return predict(state, elapsed, settings.motion, (travel, left))

    def _surprise_without_last(self, time, measurement):
        """Surprise when this one fits what was known before the last one better than that one did.

        Then not this one but the last one was an outlier, although it had passed the gate. Else
        None.
        """
        if self._before is None:
            return None
        state, seen, last_surprise = self._before
        now = surprise(self._predict_from(state, time - seen), measurement)
        return now if now < min(last_surprise, self.settings.gate) else None

    def _consider(self, time, measurement):
        """Keep a refused measurement; start over when enough of them agree."""
        if self._candidates and not self._agree(self._candidates[-1], (time, measurement)):
            self._candidates = []
        self._candidates.append((time, measurement))
        if len(self._candidates) >= self.settings.confirmations:
            return self.restart(time, measurement, self._candidate_rates())
        self.rejected += 1
        return False

    def _candidate_rates(self):
        """Velocities (6,) between the last two candidates; None for one alone."""
        if len(self._candidates) < 2:
            return None
        (time_before, a), (time_after, b) = self._candidates[-2:]
        return difference(b.pose, a.pose) / (time_after - time_before)

    def _agree(self, before, after):
        (time_before, a), (time_after, b) = before, after
        elapsed = time_after - time_before
        error = difference(b.pose, a.pose)
        spread = a.covariance + b.covariance
        shift = self.settings.agreement_speed * elapsed + 4.0 * math.sqrt(np.trace(spread[:3, :3]))
        turn = self.settings.agreement_spin * elapsed + 4.0 * math.sqrt(np.trace(spread[3:, 3:]))
        return (
            0.0 < elapsed <= self.settings.lost_time
            and float(np.linalg.norm(error[:3])) <= shift
            and float(np.linalg.norm(error[3:])) <= turn
        )


def _make_room(kept):
    """Forget all when much is kept: a target may stay out of sight for hours."""
    if len(kept) >= KEPT:
        kept.clear()


def smoothing_share(cutoff, elapsed):
    """Weight of a new value in a first-order low pass (Casiez 2012, eq. 3 and 5).

    Args:
        cutoff: [Hz].
        elapsed: time since the last value [s].
    """
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff * elapsed))


def _still(pose, covariance):
    whole = np.zeros((12, 12))
    whole[:6, :6] = covariance
    return Estimate(pose, np.zeros(3), np.zeros(3), whole, np.ones(1))
