# SPDX-License-Identifier: Apache-2.0
"""Which of two mirrored poses is the right one: a flip needs evidence, not noise.

In each picture the solution wins that fits corners and prediction best. The share that the corners
alone hold against it adds up over pictures, slowly forgotten; only when it exceeds a bound does the
other solution win against the prediction, and the track starts over from there.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sph_ros.core.motion_filter import squared_distance
from sph_ros.tracking.pose import Solution
from sph_ros.tracking.se3 import difference


@dataclass(frozen=True)
class ChoiceSettings:
    """How much evidence a flip needs; all are log-likelihood ratios times two [-].

    Attributes:
        trust: most that one prediction counts.
        evidence: for the other solution, summed over pictures, that makes it win.
        first_evidence: the same just after the start, where the choice was a guess.
        young: number of pictures over which the bound rises from first to full.
        one_picture: most that one picture counts.
        confidence: most that evidence for the chosen solution counts later, when it may have become
            the wrong one while both were alike.
        memory: share of the sum that is left at the next picture.
    """

    trust: float = 25.0
    evidence: float = 16.0
    first_evidence: float = 8.0
    young: int = 20
    one_picture: float = 8.0
    confidence: float = 4.0
    memory: float = 0.95


class Prediction(NamedTuple):
    """Where a target should be in the camera's frame, and how sure that is."""

    pose: object  # Pose
    covariance: np.ndarray  # (6, 6)


class Choice(NamedTuple):
    """The winner, and whether it overruled the prediction."""

    solution: Solution
    flipped: bool


class PoseChooser:
    """Chooses between the solutions of one target, picture after picture.

    Args:
        settings: a ChoiceSettings.
    """

    def __init__(self, settings=ChoiceSettings()):  # noqa: B008 (frozen)
        self._settings = settings
        self.reset()

    def reset(self):
        """Forget all evidence: the next choice is the first."""
        self.evidence = 0.0
        self._age = 0

    def choose(self, solutions, prediction=None):
        """The right one of one or two solutions.

        Args:
            solutions: of `estimate_poses`.
            prediction: a Prediction; None at the start.
        """
        settings = self._settings
        if prediction is None:
            self.reset()
        self._age += 1
        if len(solutions) == 1:
            self.evidence *= settings.memory
            return Choice(solutions[0], False)
        fits = [solution.chi_squared for solution in solutions]
        distances = self._distances(solutions, prediction)
        costs = [fit + distance for fit, distance in zip(fits, distances, strict=True)]
        chosen = 0 if costs[0] <= costs[1] else 1
        against = fits[chosen] - fits[1 - chosen]
        against = max(-settings.one_picture, min(settings.one_picture, against))
        self.evidence = max(settings.memory * self.evidence + against, -settings.confidence)
        flipped = self.evidence > self._bound()
        if flipped:
            chosen = 1 - chosen
            costs = fits
            self.reset()
        return Choice(_with_doubt(solutions, costs, chosen), flipped)

    def _bound(self):
        settings = self._settings
        share = min(1.0, self._age / settings.young)
        return settings.first_evidence + share * (settings.evidence - settings.first_evidence)

    def _distances(self, solutions, prediction):
        """Squared Mahalanobis distances from the prediction, at most `trust`."""
        if prediction is None:
            return [0.0] * len(solutions)
        distances = []
        for solution in solutions:
            error = difference(solution.pose, prediction.pose)
            spread = prediction.covariance + solution.covariance
            distances.append(squared_distance(error, spread))
        least = min(distances)
        # Relative to the nearer one: a motion that surprises both must not drown the corners.
        return [min(distance - least, self._settings.trust) for distance in distances]


def _with_doubt(solutions, costs, chosen):
    """The chosen solution; its covariance also holds the chance that the other is right."""
    solution, other = solutions[chosen], solutions[1 - chosen]
    advantage = 0.5 * (costs[1 - chosen] - costs[chosen])
    chance = 1.0 / (1.0 + math.exp(max(-50.0, min(50.0, advantage))))
    error = difference(other.pose, solution.pose)
    covariance = solution.covariance + chance * np.outer(error, error)
    return solution._replace(covariance=covariance)
