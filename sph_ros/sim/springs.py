# SPDX-License-Identifier: Apache-2.0
"""Springs of a liquid that is half a solid: cream and jelly (Clavet et al. 2005, section 5).

In SI: springs of the stiffness rate k (1 - L/h) give a lattice the shear modulus

    G = k rho / (2 d (d + 2)) sum (1 - r/h) r^2,

the same sum that turns friction along the line of centres into viscosity (`scales.viscous_rate`).
Lengths follow deformations beyond `yield_strain` at the rate `plasticity`. Unlike the paper's, a
new spring is at rest at the distance it finds (the paper's is as long as the support, and pushes
until it has yielded), it lives as long as it is not stretched to `LONGEST` supports, and where
nothing flows (plasticity 0) there are no new ones after the start.
"""

import numpy as np

from sph_ros.core import springs as core
from sph_ros.sim.scales import lattice_neighbors

#: Springs break when they are longer than so many support radii.
LONGEST = 1.5

#: Room for springs, in neighbours on the lattice.
ROOM = 1.6

MATES, LENGTHS = "spring_mates", "spring_lengths"


class Springs:
    """The springs of a liquid; they live in the extras of the fluid."""

    def __init__(self, scene):
        """No springs yet."""
        self._h, self._spacing = scene.support_radius, scene.spacing
        around = sum(r > 0.0 for r, _ in lattice_neighbors(self._h, self._spacing, scene.dimension))
        self._slots = 8 * -(-int(ROOM * around) // 8)
        self._row_of_id = np.empty(0, np.int32)

    def pull(self, fluid, work, material, scale, time_step, pulls):
        """Let the springs yield, break and form, and add what they pull.

        Args:
            fluid: its extras `spring_mates` and `spring_lengths` are changed, or made.
            work: `Workspace` with the neighbours of `predicted` positions.
            material: the liquid.
            scale: acceleration [1/s^2] or displacement [-] per deformation, see
                `core.springs.pull_springs`.
            time_step: [s].
            pulls: [m/s^2] or [m], (N, 3); added to.
        """
        new = MATES not in fluid.extras
        if new:
            fluid.extras[MATES] = np.zeros((len(fluid), self._slots), np.uint32)
            fluid.extras[LENGTHS] = np.zeros((len(fluid), self._slots), np.float32)
        count, wanted = np.zeros((2, len(fluid)), np.int32)
        springs = core.Springs(fluid.extras[MATES], fluid.extras[LENGTHS], count, wanted)
        ids = fluid.ids[fluid.particle]
        self._find_rows(ids)
        yielding = core.Yielding(
            np.float32(material.yield_strain),
            np.float32(min(material.plasticity * time_step, 1.0)),
            np.float32(LONGEST * self._h),
            np.float32(self._h),
        )
        core.pull_springs(
            work.predicted, self._row_of_id, springs, yielding, np.float32(scale), pulls
        )
        if new or material.plasticity > 0.0:
            core.count_unbound(work.pairs, self._row_of_id, work.chunks, springs)
            core.bind_neighbors(
                work.predicted, ids, work.pairs, self._row_of_id, work.chunks, springs
            )

    def _find_rows(self, ids):
        """Where each id is now."""
        most = int(ids.max(initial=0)) + 1
        if len(self._row_of_id) < most:
            self._row_of_id = np.empty(2 * most, np.int32)
        self._row_of_id[:] = -1
        core.find_rows(ids, self._row_of_id)

    @staticmethod
    def forget(fluid):
        """Take all springs off a fluid."""
        for name in (MATES, LENGTHS):
            fluid.extras.pop(name, None)
