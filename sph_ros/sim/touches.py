# SPDX-License-Identifier: Apache-2.0
"""Where free bodies touch in a step, ready for the impulses."""

from collections import Counter

import numpy as np

from sph_ros.core import touching
from sph_ros.core.impulses import Touches
from sph_ros.core.touching import Places
from sph_ros.sim.surface_samples import pack_samples

#: Touches are looked for this much farther than solids would get by themselves, in spacings.
REACH_MARGIN = 0.1

#: Touches in a step at most.
MOST_TOUCHES = 4096


class TouchFinder:
    """Samples of all solids and what their surfaces are like.

    Attributes:
        body_of: which free body a solid is, or -1, (S,) int32.
    """

    def __init__(self, scene, packed):
        """Args: the scene; packed shapes of its solids."""
        specs = scene.solids
        self._packed = packed
        self._margin = REACH_MARGIN * scene.spacing
        self._friction = np.array([spec.friction for spec in specs])
        self._restitution = np.array([spec.restitution for spec in specs])
        is_free = np.array([spec.control == "free" for spec in specs], bool)
        self.body_of = np.where(is_free, np.cumsum(is_free) - 1, -1).astype(np.int32)
        if is_free.any():
            shapes = [spec.shape for spec in specs]
            self._samples = pack_samples(shapes, scene.spacing, scene.dimension)

    def find(self, motion, ways, duration, known):
        """Touches of a substep.

        Args:
            motion: `Motion`: all solids at its start, those that are not free also at its end.
            ways: the farthest that a point of each solid may move in it [m], (S,).
            duration: of the substep [s].
            known: impulses of the last substep, from `impulses`.

        Returns:
            `Touches`, their impulses as first guesses, and how many rows of it count.
        """
        none = [0.0, 0.0, 0.0]
        places = Places(motion.old_position, motion.old_rotation, self.body_of, ways + self._margin)
        count, solids, numbers = touching.find_touches(
            self._packed, self._samples, places, MOST_TOUCHES
        )
        solids, numbers = solids[:count], numbers[:count]
        drift = np.zeros((count, 3))
        touching.drift_of_others(
            places, motion.position, motion.rotation, 1.0 / duration, solids, numbers, drift
        )
        first, second = solids[:, 0], solids[:, 1]
        self._keys = keys = self._names(solids, numbers)
        return Touches(
            self.body_of[first],
            self.body_of[second],
            np.ascontiguousarray(numbers[:, :3]),
            np.ascontiguousarray(numbers[:, 3:6]),
            np.ascontiguousarray(numbers[:, 6]),
            drift,
            np.sqrt(self._friction[first] * self._friction[second]),
            np.maximum(self._restitution[first], self._restitution[second]),
            np.zeros(count),
            np.array([known.get(key, none) for key in keys]).reshape(-1, 3),
        ), count

    def impulses(self, touches):
        """Impulses [N s] of the touches found last, by name; the first guess of the next step."""
        return dict(zip(self._keys, touches.impulse.tolist(), strict=True))

    def _names(self, solids, numbers):
        """A name for each touch that the same touch has in the next step."""
        names, seen = [], Counter()
        for (first, second), sample in zip(solids.tolist(), numbers[:, 7].tolist(), strict=True):
            name = f"{first} {second} {sample:.0f}"
            seen[name] += 1
            names.append(f"{name} {seen[name]}")
        return names


def no_touches():
    """`Touches` without rows."""
    none, rows = np.zeros(0), np.zeros((0, 3))
    words = np.zeros(0, np.int32)
    return Touches(words, words, rows, rows, none, rows, none, none, none, rows)
