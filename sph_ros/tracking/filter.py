# SPDX-License-Identifier: Apache-2.0
"""Error-state Kalman filter of a moving pose, with several kinds of motion at once.

State: position [m], rotation, velocity [m/s], angular velocity [rad/s], all along the axes of the
reference frame; the error has 12 components in this order, rotations as in `se3` (Solà 2017,
Quaternion kinematics for the error-state Kalman filter). A hand rests, glides or jerks, and no one
process noise suits all three, so one filter for each runs and they are weighed by how well they
foresaw the measurements (interacting multiple models, Blom & Bar-Shalom 1988).

`predict` and `update` are pure functions; a FilterState is never changed. Their arithmetic is
compiled, see `core.motion_filter`.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sph_ros.core.motion_filter import mean_of, predicted, surprise_of, updated
from sph_ros.tracking.se3 import Pose

POSITION, ROTATION, VELOCITY, SPIN = (slice(i, i + 3) for i in (0, 3, 6, 9))


@dataclass(frozen=True)
class Motion:
    """One kind of motion.

    Attributes:
        acceleration: usual size [m/s^2]; None for a thing at rest.
        angular_acceleration: usual size [rad/s^2].
        drift: of a thing at rest [m/sqrt(s)].
        angular_drift: of a thing at rest [rad/sqrt(s)].
    """

    acceleration: float | None = None
    angular_acceleration: float = 0.0
    drift: float = 5e-5
    angular_drift: float = 1e-3


@dataclass(frozen=True)
class MotionSettings:
    """What moves, and how.

    Attributes:
        kinds: of motion; the weights go from one to another.
        acceleration_time: how long an acceleration usually lasts [s].
        kind_time: how long a kind of motion usually lasts [s].
        rest_speed: that a thing at rest may begin to move with [m/s].
        rest_spin: the same [rad/s].
        start_speed: uncertainty of the velocity at the start [m/s].
        start_spin: the same [rad/s].
    """

    kinds: tuple = (Motion(), Motion(1.5, 5.0), Motion(6.0, 50.0))
    acceleration_time: float = 0.1
    kind_time: float = 1.5
    rest_speed: float = 0.02
    rest_spin: float = 0.1
    start_speed: float = 0.5
    start_spin: float = 3.0


class Measurement(NamedTuple):
    """A measured pose and its covariance (6, 6)."""

    pose: Pose
    covariance: np.ndarray


class FilterState(NamedTuple):
    """Estimates of M kinds of motion; arrays of float64, in the order of `kinds`."""

    positions: np.ndarray  # (M, 3) [m]
    rotations: np.ndarray  # (M, 3, 3)
    velocities: np.ndarray  # (M, 3) [m/s]
    spins: np.ndarray  # (M, 3) [rad/s]
    covariances: np.ndarray  # (M, 12, 12)
    weights: np.ndarray  # (M,), sum 1


class Estimate(NamedTuple):
    """The mean of a FilterState."""

    pose: Pose
    velocity: np.ndarray  # (3,) [m/s]
    spin: np.ndarray  # (3,) [rad/s]
    covariance: np.ndarray  # (12, 12)
    weights: np.ndarray  # (M,)


def start(measurement, settings, rates=None):
    """A state at a first measurement.

    Args:
        measurement: a Measurement.
        settings: MotionSettings.
        rates: velocity and angular velocity (6,), when something is known about them.
    """
    count = len(settings.kinds)
    covariance = np.zeros((12, 12))
    covariance[:6, :6] = measurement.covariance
    covariance[VELOCITY, VELOCITY] = settings.start_speed**2 * np.eye(3)
    covariance[SPIN, SPIN] = settings.start_spin**2 * np.eye(3)
    rates = np.zeros(6) if rates is None else rates
    return FilterState(
        np.tile(measurement.pose.position, (count, 1)),
        np.tile(measurement.pose.rotation, (count, 1, 1)),
        np.tile(rates[:3], (count, 1)),
        np.tile(rates[3:], (count, 1)),
        np.tile(covariance, (count, 1, 1)),
        np.full(count, 1.0 / count),
    )


def predict(state, elapsed, settings, glide=None):
    """The state later.

    Args:
        state: a FilterState.
        elapsed: time that went by [s], not negative.
        settings: MotionSettings.
        glide: (distance covered, velocity left), as time at full velocity [s] and share [-], for a
            thing that comes to a stop; None for one that goes on.
    """
    if elapsed <= 0.0:
        return state
    travel, left = (elapsed, 1.0) if glide is None else glide
    return FilterState(*predicted(*state, *_tables(settings), elapsed, travel, left))


def surprise(state, measurement):
    """Squared Mahalanobis distance [-] from the kind of motion that explains a measurement best.

    A kind that is not likely now has to be paid for: a thing at rest does not suddenly jerk.
    """
    return surprise_of(
        state.positions,
        state.rotations,
        state.covariances,
        state.weights,
        *_arrays(measurement),
    )


def update(state, measurement):
    """The state after a measurement of this moment."""
    return FilterState(*updated(*state, *_arrays(measurement)))


def mean(state):
    """The Estimate that a state amounts to."""
    rotation, position, velocity, spin, covariance = mean_of(*state)
    return Estimate(Pose(rotation, position), velocity, spin, covariance, state.weights)


def _arrays(measurement):
    """Rotation, position and covariance of a measurement as kernels take them."""
    pose, covariance = measurement
    return tuple(np.ascontiguousarray(a) for a in (pose.rotation, pose.position, covariance))


@lru_cache(maxsize=16)
def _tables(settings):
    """Tables of kinds (M, 5) and of times and speeds (4,), see `core.motion_filter`."""
    kinds = [
        (
            kind.acceleration is not None,
            kind.acceleration or 0.0,
            kind.angular_acceleration,
            kind.drift,
            kind.angular_drift,
        )
        for kind in settings.kinds
    ]
    rates = (
        settings.acceleration_time,
        settings.kind_time,
        settings.rest_speed,
        settings.rest_spin,
    )
    return np.array(kinds, float), np.array(rates, float)
