# SPDX-License-Identifier: Apache-2.0
"""Bounds on the motion that leaves the tracker: whatever comes in, no solid is made to jump."""

import math
from dataclasses import dataclass

import numpy as np

from sph_ros.tracking.se3 import Pose, exp, log

#: Longer pauses count as this long [s]: the solid does not make up for them in one leap.
LONGEST_STEP = 0.1

#: Of the deceleration that braking in time would take, so that noise does not make it overshoot.
BRAKING = 0.7


@dataclass(frozen=True)
class Limits:
    """What a hand can do, with some reserve.

    Attributes:
        speed: [m/s].
        acceleration: [m/s^2].
        spin: angular speed [rad/s].
        angular_acceleration: [rad/s^2].
    """

    speed: float = 3.0
    acceleration: float = 60.0
    spin: float = 15.0
    angular_acceleration: float = 400.0


class Limiter:
    """Follows a pose exactly where the bounds allow, else as fast as they allow.

    Args:
        limits: Limits.
    """

    def __init__(self, limits=Limits()):  # noqa: B008 (frozen)
        self._limits = limits
        self._time = None

    def follow(self, time, pose, velocity, spin):
        """The bounded pose at a time.

        Args:
            time: [s], not decreasing.
            pose: wanted.
            velocity: of the wanted pose (3,) [m/s].
            spin: angular velocity of the wanted pose (3,) [rad/s].
        """
        if self._time is None:
            self._velocity, self._spin = np.array(velocity), np.array(spin)
            self._time, self._pose = time, pose
            return pose
        elapsed = min(time - self._time, LONGEST_STEP)
        if elapsed <= 0.0:
            return self._pose
        limits = self._limits
        gap = pose.position - self._pose.position
        self._velocity = bounded_rate(
            gap, self._velocity, velocity, elapsed, limits.speed, limits.acceleration
        )
        turn = log(pose.rotation @ self._pose.rotation.T)
        self._spin = bounded_rate(
            turn, self._spin, spin, elapsed, limits.spin, limits.angular_acceleration
        )
        self._time = time
        self._pose = Pose(
            exp(self._spin * elapsed) @ self._pose.rotation,
            self._pose.position + self._velocity * elapsed,
        )
        return self._pose


def bounded_rate(gap, rate, target_rate, elapsed, highest, acceleration):
    """The velocity (3,) for the next step that closes a gap within bounds.

    Args:
        gap: to the target (3,).
        rate: present velocity (3,).
        target_rate: velocity of the target (3,).
        elapsed: length of the step [s].
        highest: bound of the velocity.
        acceleration: bound of its change per second.
    """
    wanted = gap / elapsed
    within = np.linalg.norm(wanted - rate) <= acceleration * elapsed
    if not within:
        distance = float(np.linalg.norm(gap))
        approach = min(distance / elapsed, BRAKING * math.sqrt(2.0 * acceleration * distance))
        if distance > 0.0:
            wanted = target_rate + gap * (approach / distance)
        wanted = rate + _shortened(wanted - rate, acceleration * elapsed)
    return _shortened(wanted, highest)


def _shortened(vector, longest):
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)
