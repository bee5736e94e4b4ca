# SPDX-License-Identifier: Apache-2.0
"""What `core.motion_filter` does, written as in the books: matrices, an object for each kind."""

import math

import cv2
import numpy as np

LEAST_WEIGHT = 1e-4


def exp(vector):
    return cv2.Rodrigues(np.asarray(vector, float))[0]


def log(rotation):
    return cv2.Rodrigues(rotation)[0][:, 0]


class Kind:
    """One kind of motion: pose, velocity and angular velocity (6,), covariance (12, 12)."""

    def __init__(self, position, rotation, rates, covariance):
        self.position, self.rotation = np.array(position), np.array(rotation)
        self.rates, self.covariance = np.array(rates), np.array(covariance)

    def error(self, reference):
        """The pose's error from a reference, and the rates, (12,)."""
        turn = log(self.rotation @ reference.rotation.T)
        return np.concatenate([self.position - reference.position, turn, self.rates])


def normalized(weights):
    weights = np.maximum(weights / weights.sum(), LEAST_WEIGHT)
    return weights / weights.sum()


def merged(kinds, weights, reference):
    """One Kind of the same mean and covariance as a mixture."""
    errors = np.array([kind.error(reference) for kind in kinds])
    mean = weights @ errors
    covariance = np.zeros((12, 12))
    for weight, kind, off in zip(weights, kinds, errors - mean, strict=True):
        covariance += weight * (kind.covariance + np.outer(off, off))
    rotation = exp(mean[3:6]) @ reference.rotation
    return Kind(reference.position + mean[:3], rotation, mean[6:], covariance)


def likeliest(kinds, weights):
    return kinds[int(np.argmax(weights))]


def predicted(kinds, weights, settings, elapsed, travel, left):
    """(kinds, weights) after a time: mixing, then each with its own transition and noise."""
    count = len(kinds)
    stay = math.exp(-elapsed / settings.kind_time)
    chances = stay * np.eye(count) + (1.0 - stay) / count  # from row to column
    joint = chances * weights[:, None]
    after = joint.sum(axis=0)
    best = likeliest(kinds, weights)
    mixtures = [merged(kinds, joint[:, m] / after[m], best) for m in range(count)]
    moving = [moved(mixtures[m], settings, m, elapsed, travel, left) for m in range(count)]
    return moving, normalized(after)


def moved(state, settings, m, elapsed, travel, left):
    kind = settings.kinds[m]
    if kind.acceleration is None:
        travel = left = 0.0
    turn = exp(state.rates[3:] * travel)
    f = np.eye(12)
    f[3:6, 3:6] = turn
    f[:6, 6:] = travel * np.eye(6)
    f[6:, 6:] = left * np.eye(6)
    covariance = f @ state.covariance @ f.T + process_noise(kind, settings, elapsed)
    position = state.position + state.rates[:3] * travel
    return Kind(position, turn @ state.rotation, left * state.rates, covariance)


def process_noise(kind, settings, elapsed):
    if kind.acceleration is None:
        drifts = (kind.drift**2 * elapsed, kind.angular_drift**2 * elapsed)
        return np.diag(np.repeat((*drifts, settings.rest_speed**2, settings.rest_spin**2), 3))
    sizes = np.repeat((kind.acceleration, kind.angular_acceleration), 3)
    q = np.diag(sizes**2 * settings.acceleration_time)
    return np.block(
        [[q * elapsed**3 / 3, q * elapsed**2 / 2], [q * elapsed**2 / 2, q * elapsed]]
    )  # fmt: skip


def updated(kinds, weights, pose, covariance):
    """(kinds, weights, squared distances) after a measured pose."""
    results, likelihoods, distances = [], [], []
    for kind in kinds:
        turn = log(pose.rotation @ kind.rotation.T)
        error = np.concatenate([pose.position - kind.position, turn])
        spread = kind.covariance[:6, :6] + covariance
        gain = kind.covariance[:, :6] @ np.linalg.inv(spread)
        step = gain @ error
        corrected = Kind(
            kind.position + step[:3],
            exp(step[3:6]) @ kind.rotation,
            kind.rates + step[6:],
            kind.covariance - gain @ kind.covariance[:6],
        )
        results.append(corrected)
        distances.append(error @ np.linalg.inv(spread) @ error)
        likelihoods.append(-0.5 * (distances[-1] + np.linalg.slogdet(spread)[1]))
    factors = np.exp(np.array(likelihoods) - max(likelihoods))
    return results, normalized(weights * factors), np.array(distances)
