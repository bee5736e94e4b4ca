# SPDX-License-Identifier: Apache-2.0
"""New particles through the openings of a scene."""

import numpy as np

from sph_ros.core.emission import mark_taken
from sph_ros.sim.jets import make_jet

#: A particle does not appear nearer than this to another one or to a solid [spacings].
NEAREST, NEAREST_SOLID = 0.75, 0.45

#: A column that had to wait makes up for half a particle at most.
MOST_OVERDUE = 1.5


class Emitters:
    """All emitters of a scene while it runs.

    Every column of a jet counts up to 1, then a particle comes out. Where there is no room for it,
    next to a solid or another particle, or because the limit or the capacity is reached, the column
    waits.

    Attributes:
        emitted: particles so far.
    """

    def __init__(self, scene):
        self._scene = scene
        self._jets = [make_jet(emitter, scene) for emitter in scene.emitters]
        self._progress = [1.0 - jet.phases for jet in self._jets]
        self._counts = [0] * len(self._jets)
        self._now = 0.0

    @property
    def emitted(self):
        """Particles that came out so far."""
        return sum(self._counts)

    def state(self):
        """What a later step depends on, for a snapshot."""
        progress = [columns.tolist() for columns in self._progress]
        return {"progress": progress, "counts": list(self._counts), "now": self._now}

    def set_state(self, state):
        """Inverse of `state`."""
        self._progress = [np.array(columns) for columns in state["progress"]]
        self._counts, self._now = list(state["counts"]), state["now"]

    def fastest(self, now):
        """Speed of the fastest jet that runs at a time [s] [m/s]."""
        pairs = zip(self._scene.emitters, self._jets, strict=True)
        return max((jet.speed for e, jet in pairs if e.from_time <= now < e.until), default=0.0)

    def advance(self, fluid, solids, now, next_id):
        """Let out what became due since the last call.

        Args:
            fluid: `Fluid`; particles are added.
            solids: `Solids`, where nothing may appear.
            now: simulated time [s].
            next_id: id of the next particle.

        Returns:
            Id of the next particle after these.
        """
        passed, self._now = (self._now, now), now
        for index, emitter in enumerate(self._scene.emitters):
            begin, end = max(passed[0], emitter.from_time), min(now, emitter.until)
            if begin >= end:
                continue
            progress, jet = self._progress[index], self._jets[index]
            if emitter.nozzle > 0.0 and self._counts[index] != emitter.limit:
                self._hold(emitter, jet, fluid)
            progress += (end - begin) / jet.period
            room = fluid.capacity - len(fluid)
            if emitter.limit is not None:
                room = min(room, emitter.limit - self._counts[index])
            while room > 0:
                due = np.flatnonzero(progress >= 1.0)
                if not len(due):
                    break
                # What was due before the last call could not come out then: it does now, and no
                # farther out than a particle that became due at that call.
                late = np.minimum((progress[due] - 1.0) * jet.period, end - begin) + now - end
                places = jet.places[due] + (jet.speed * late)[:, None] * jet.direction
                free = np.flatnonzero(self._free(places, fluid, solids))[:room]
                if not len(free):
                    break
                due, places = due[free], places[free]
                ids = np.arange(next_id, next_id + len(due), dtype=np.uint32)
                fluid.add(places, jet.speed * jet.direction, ids)
                next_id += len(due)
                progress[due] -= 1.0
                self._counts[index] += len(due)
                room -= len(due)
            np.minimum(progress, MOST_OVERDUE, out=progress)
        return next_id

    def _hold(self, emitter, jet, fluid):
        """Give the liquid in a nozzle the speed of its jet."""
        offsets = fluid.positions - np.array(emitter.position, np.float32)
        along = offsets @ jet.direction
        across = offsets - along[:, None] * jet.direction
        inside = (along > -self._scene.spacing) & (along < emitter.nozzle)
        inside &= np.linalg.norm(across, axis=1) < emitter.radius + self._scene.spacing
        fluid.velocities[inside] = jet.speed * jet.direction

    def _free(self, places, fluid, solids):
        """Which places are clear of solids and particles, (M,) bool."""
        spacing = self._scene.spacing
        taken = np.zeros(len(places), bool)
        mark_taken(places.astype(np.float32), fluid.positions, np.float32(NEAREST * spacing), taken)
        for solid in solids:
            taken |= solid.signed_distance(places) < NEAREST_SOLID * spacing
        return ~taken
