# SPDX-License-Identifier: Apache-2.0
"""Error-state Kalman filter of a moving pose, with several kinds of motion at once.

State: position [m], rotation, velocity [m/s], angular velocity [rad/s], all along the axes of the
reference frame; the error has 12 components in this order, rotations as in `se3` (Solà 2017,
Quaternion kinematics for the error-state Kalman filter). A hand rests, glides or jerks, and no one
process noise suits all three, so one filter for each runs and they are weighed by how well they
foresaw the measurements (interacting multiple models, Blom & Bar-Shalom 1988).

`predict` and `update` are pure functions; a FilterState is never changed.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sph_ros.tracking.se3 import Pose, exp, log

POSITION, ROTATION, VELOCITY, SPIN = (slice(i, i + 3) for i in (0, 3, 6, 9))

#: No kind of motion is ever ruled out [-].
LEAST_WEIGHT = 1e-4


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
    state = _mixed(state, elapsed, settings)
    moving = np.array([kind.acceleration is not None for kind in settings.kinds])
    travels = np.where(moving, travel, 0.0)[:, None]
    kept = np.where(moving, left, 0.0)[:, None]
    turns = exp(state.spins * travels)
    count = len(moving)
    transition = np.tile(np.eye(12), (count, 1, 1))
    transition[:, ROTATION, ROTATION] = turns
    for m in range(count):
        transition[m, POSITION, VELOCITY] = transition[m, ROTATION, SPIN] = travels[m] * np.eye(3)
        transition[m, VELOCITY, VELOCITY] = transition[m, SPIN, SPIN] = kept[m] * np.eye(3)
    noise = np.stack([process_noise(kind, elapsed, settings) for kind in settings.kinds])
    covariances = transition @ state.covariances @ transition.transpose(0, 2, 1) + noise
    return FilterState(
        state.positions + state.velocities * travels,
        turns @ state.rotations,
        state.velocities * kept,
        state.spins * kept,
        covariances,
        state.weights,
    )


def process_noise(kind, elapsed, settings):
    """Covariance (12, 12) that a kind of motion adds in a time [s].

    Moving: white acceleration of the density a^2 T, which a hand's acceleration a that lasts T
    looks like over longer times (Bar-Shalom, Li & Kirubarajan 2001, eq. 6.2.2-12).
    """
    noise = np.zeros((12, 12))
    if kind.acceleration is None:
        sizes = (kind.drift**2 * elapsed, kind.angular_drift**2 * elapsed,
                 settings.rest_speed**2, settings.rest_spin**2)  # fmt: skip
        noise[np.diag_indices(12)] = np.repeat(sizes, 3)
        return noise
    pairs = (
        (POSITION, VELOCITY, kind.acceleration),
        (ROTATION, SPIN, kind.angular_acceleration),
    )
    for place, speed, acceleration in pairs:
        density = acceleration**2 * settings.acceleration_time
        noise[place, place] = density * elapsed**3 / 3.0 * np.eye(3)
        noise[place, speed] = noise[speed, place] = density * elapsed**2 / 2.0 * np.eye(3)
        noise[speed, speed] = density * elapsed * np.eye(3)
    return noise


def innovation(state, measurement):
    """What was not foreseen: errors (M, 6), their covariances (M, 6, 6), squared distances (M,)."""
    pose = measurement.pose
    errors = np.concatenate(
        [
            pose.position - state.positions,
            log(pose.rotation @ state.rotations.transpose(0, 2, 1)),
        ],
        axis=1,
    )
    spreads = state.covariances[:, :6, :6] + measurement.covariance
    solved = np.linalg.solve(spreads, errors[:, :, None])[:, :, 0]
    return errors, spreads, np.einsum("mi,mi->m", errors, solved)


def surprise(state, measurement):
    """Squared Mahalanobis distance [-] from the kind of motion that explains a measurement best.

    A kind that is not likely now has to be paid for: a thing at rest does not suddenly jerk.
    """
    distances = innovation(state, measurement)[2]
    return float(np.min(distances - 2.0 * np.log(state.weights)))


def update(state, measurement):
    """The state after a measurement of this moment."""
    errors, spreads, distances = innovation(state, measurement)
    across = state.covariances[:, :, :6]
    gains = np.linalg.solve(spreads, across.transpose(0, 2, 1)).transpose(0, 2, 1)
    steps = np.einsum("mij,mj->mi", gains, errors)
    covariances = state.covariances - gains @ across.transpose(0, 2, 1)
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    likelihoods = -0.5 * (distances + np.linalg.slogdet(spreads)[1])
    weights = state.weights * np.exp(likelihoods - likelihoods.max())
    return FilterState(
        state.positions + steps[:, POSITION],
        exp(steps[:, ROTATION]) @ state.rotations,
        state.velocities + steps[:, VELOCITY],
        state.spins + steps[:, SPIN],
        covariances,
        _normalized(weights),
    )


def mean(state):
    """The Estimate that a state amounts to."""
    reference, errors = _errors(state)
    shift = state.weights @ errors
    return Estimate(
        Pose(exp(shift[ROTATION]) @ reference.rotation, reference.position + shift[POSITION]),
        state.weights @ state.velocities,
        state.weights @ state.spins,
        _moment(state.covariances, errors - shift, state.weights),
        state.weights,
    )


def _mixed(state, elapsed, settings):
    """The states that the kinds begin with, each a mixture of what may have become it."""
    count = len(state.weights)
    stay = math.exp(-elapsed / settings.kind_time)
    chances = stay * np.eye(count) + (1.0 - stay) / count  # from row to column
    joint = chances * state.weights[:, None]
    weights = joint.sum(axis=0)
    shares = (joint / weights).T  # (to, from)
    reference, errors = _errors(state)
    shifts = shares @ errors
    spreads = errors[None] - shifts[:, None]  # (to, from, 12)
    covariances = np.einsum("tf,fij->tij", shares, state.covariances)
    covariances += np.einsum("tf,tfi,tfj->tij", shares, spreads, spreads)
    return FilterState(
        reference.position + shifts[:, POSITION],
        exp(shifts[:, ROTATION]) @ reference.rotation,
        shares @ state.velocities,
        shares @ state.spins,
        covariances,
        _normalized(weights),
    )


def _errors(state):
    """The likeliest pose, and the errors (M, 12) of all states about it; velocities about zero."""
    best = int(np.argmax(state.weights))
    reference = Pose(state.rotations[best], state.positions[best])
    errors = np.concatenate(
        [
            state.positions - reference.position,
            log(state.rotations @ reference.rotation.T),
            state.velocities,
            state.spins,
        ],
        axis=1,
    )
    return reference, errors


def _moment(covariances, errors, weights):
    """Covariance (12, 12) of a mixture."""
    return np.einsum("m,mij->ij", weights, covariances) + np.einsum(
        "m,mi,mj->ij", weights, errors, errors
    )


def _normalized(weights):
    weights = np.maximum(weights / weights.sum(), LEAST_WEIGHT)
    return weights / weights.sum()
