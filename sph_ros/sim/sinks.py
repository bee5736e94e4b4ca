# SPDX-License-Identifier: Apache-2.0
"""Where particles leave a scene: its sinks, and far away from everything."""

import math

import numpy as np

from sph_ros.core.distances import signed_distances
from sph_ros.core.rows import farthest_coordinates
from sph_ros.sim.quaternions import rotated_back
from sph_ros.sim.shapes import pack_shapes

#: A particle so far from the scene is lost: it falls for ever, and the step shrinks with its speed.
FAR, FAR_IN_SIZES = 10.0, 10.0  # [m], [sizes of the scene]


class Sinks:
    """All sinks of a scene while it runs.

    Attributes:
        removed: particles that sinks took so far.
        lost: particles that got too far away so far.
    """

    def __init__(self, scene, solids, positions):
        """Args: the scene, its `Solids` and the first positions of its particles [m], (N, 3)."""
        self._sinks = scene.sinks
        self._packed = pack_shapes(
            [sink.shape for sink in scene.sinks],
            scene.support_radius,
            scene.spacing,
            scene.dimension,
        )
        self._solids = solids
        origins = [emitter.position for emitter in scene.emitters]
        starts = np.concatenate([np.reshape(origins, (-1, 3)), positions])
        self._first_reach = float(np.abs(starts).max(initial=0.0))
        self.removed = self.lost = 0

    def state(self):
        """What changes, for a snapshot."""
        return {"removed": self.removed, "lost": self.lost}

    def set_state(self, state):
        """Inverse of `state`."""
        self.removed, self.lost = state["removed"], state["lost"]

    def advance(self, fluid, now):
        """Remove the particles that are in a sink at a time [s], or far away.

        Returns:
            A distance that no particle is farther than from the origin of the world [m].
        """
        corner = farthest_coordinates(fluid.positions)
        if self._sinks or not max(corner) <= self._farthest():
            self._take(fluid, now)
            corner = farthest_coordinates(fluid.positions)
        return math.hypot(*corner)

    def _take(self, fluid, now):
        taken = np.zeros(len(fluid), bool)
        for index, sink in enumerate(self._sinks):
            if sink.from_time <= now < sink.until and len(fluid):
                taken |= self._distances(index, fluid.positions) < 0.0
        self.removed += int(taken.sum())
        farthest = self._farthest()
        if np.abs(fluid.positions).max(initial=0.0) > farthest:
            # What is infinite has exploded, not flown away: it stays for the simulation to stop at.
            distance = np.abs(fluid.positions).max(axis=1)
            far = (distance > farthest) & np.isfinite(distance) & ~taken
            self.lost += int(far.sum())
            taken |= far
        if taken.any():
            fluid.keep(~taken)

    def _distances(self, index, positions):
        pose = self._sinks[index].pose
        local = rotated_back(positions - np.float32(pose.position), pose.quat_xyzw)
        distance = np.empty(len(local), np.float32)
        signed_distances(self._packed, index, np.ascontiguousarray(local, np.float32), distance)
        return distance

    def _farthest(self):
        """Coordinates up to here belong to the scene [m]."""
        size = self._first_reach
        for solid in self._solids:
            reach = solid.reach if np.isfinite(solid.reach) else 0.0
            size = max(size, float(np.abs(solid.position).max()) + reach)
        return size + max(FAR, FAR_IN_SIZES * size)
